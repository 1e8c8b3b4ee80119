"""A robot's program on a bus in memory, and its steps done again from what it published: the same to the last bit."""

import math
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pytest

from groundstation.logs.reader import LogMessage
from groundstation.planning import planner
from robot_agent.node import AgentNode, StepTime
from shoal.bus.bus import Bus, Received
from shoal.bus.memory_transport import MemoryHub, MemoryTransport
from shoal.config.experiment import Experiment, load_experiment
from shoal.frames import Array
from shoal.messages import topics
from shoal.messages.codec import Header, encode
from shoal.messages.messages import (
    Command,
    CommandKind,
    Control,
    Estimate,
    Event,
    Mode,
    Obstacles,
    Plan,
    Pose,
    Reply,
    RobotState,
    StationHeartbeat,
    Track,
)
from shoal.messages.topics import Topic
from shoal.runtime.runtime import Stop
from sim_bridge.replay.rerun import Rerun
from tests.robot_agent.obedient_board import Board

pytestmark = pytest.mark.long

ME, OTHER = 1, 2
PERIOD_NS = 50_000_000
HOUR_NS = 3_600_000_000_000
BEHIND_NS = 3_000_000_000
UNMOVED = ("safety.watch_thrusters=false",)  # nothing that its thrusters do moves the robot of these tests: it follows


class SkewedClock:
    """Goes on when told. The senders' clocks are another matter: theirs are 3 s behind."""

    waits = False

    def __init__(self) -> None:
        self.tick_ns = 1_700_000_000_000_000_000

    def now_ns(self) -> int:
        return self.tick_ns

    def arrival_ns(self, stamp_ns: int) -> int:
        return self.now_ns()

    def instant_ns(self, received: Received[Any]) -> int:
        return received.header.stamp_ns + BEHIND_NS


@dataclass
class Pond:
    """One robot's program with its surroundings, stepped by hand."""

    experiment: Experiment
    lines: list[LogMessage] = field(default_factory=list)
    states: list[RobotState] = field(default_factory=list)
    plans: list[Plan] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.hub = MemoryHub()
        self.agents = Bus(MemoryTransport(self.hub))
        self.world = Bus(MemoryTransport(self.hub))
        self.station = Bus(MemoryTransport(self.hub))
        listener = Bus(MemoryTransport(self.hub))
        for topic in (topics.INPUTS, topics.COMMANDS, topics.PLAN, topics.OBSTACLES):
            listener.subscribe(topic, None, self._hear)
        self.clock = SkewedClock()
        self.node = AgentNode(self.experiment, ME, self.agents, Board(), Stop(install=False))
        self.node.clock = self.clock
        self.agents.serve(ME, self.node.on_command)
        self.random = np.random.default_rng(4)
        self.trajectory = planner.plan(self.experiment)[ME]

    @property
    def sent_ns(self) -> int:
        """Time of the other processes' clocks."""
        return self.clock.tick_ns - BEHIND_NS

    @property
    def place(self) -> Array:
        """The robot's place, (4,): where its trajectory says, whatever its thrusters do."""
        control = self.states[-1].control if self.states else None
        return self.trajectory.eta[0] if control is None else control.eta_reference

    def _hear(self, topic: Topic, key: str, header: Header, payload: bytes) -> None:
        robot = int(key.split("/")[2]) if "/robot/" in key else 0
        if topic is not topics.PLAN or robot != ME:
            self.lines.append(LogMessage(topic, robot, header, payload, header.stamp_ns))

    def order(self, order: CommandKind) -> Reply:
        command = Command(
            order, ME, 1e6, self.experiment.hash, self.trajectory.id,
            trajectory=self.trajectory if order is CommandKind.LOAD else None, start_ns=self.sent_ns + 100_000_000,
        )  # fmt: skip
        return self.station.command(command, self.sent_ns, 1.0)

    def step(self, count: int = 1) -> None:
        for _ in range(count):
            x, y, _, yaw = (self.place + self.random.normal(0.0, 0.002, 4)).tolist()
            pose = Pose(x, y, yaw, 1e-6 * np.eye(3), Track.MARKER, True, 0.9, 0.3)
            self.world.publish(topics.POSE, pose, self.sent_ns, ME, age_ns=7_000_000)
            beside = self.trajectory.eta[:30] + self.random.normal((0.0, 0.7, 0.0, 0.0), 0.01, (30, 4))
            self.world.publish(topics.PLAN, Plan(0.05, beside, beside), self.sent_ns, OTHER)
            corner = np.array([0.6, 0.4]) + 0.1 * np.array([[math.cos(a), math.sin(a)] for a in np.arange(12) * math.tau / 12])
            ball = Obstacles((3,), corner[None], np.zeros((1, 2)), 0.3, 1.0, unseen_s=np.zeros(1))
            self.world.publish(topics.OBSTACLES, ball, self.sent_ns)
            self.station.publish(topics.HEARTBEAT, StationHeartbeat(self.experiment.hash, False, "RUNNING"), self.sent_ns)
            self.clock.tick_ns += PERIOD_NS
            now_ns = self.clock.tick_ns
            record, outputs = self.node.step(now_ns, StepTime(now_ns))
            self.agents.publish(topics.INPUTS, record, now_ns, ME)
            self.node.write(outputs, now_ns, now_ns, time.perf_counter_ns() + HOUR_NS)  # never late
            self.states.append(outputs.state)
            self.plans += [outputs.plan] if outputs.plan is not None else []


@pytest.fixture(scope="module")
def flown() -> Pond:
    """Three seconds. The robot, which nothing moves, tracks for a second: longer, and it would be found to be held fast."""
    pond = Pond(load_experiment("pool", UNMOVED))
    pond.step(20)
    for order in (CommandKind.LOAD, CommandKind.ARM, CommandKind.START):
        reply = pond.order(order)
        assert reply.accepted, reply.reason
        pond.step(2)
    refused = pond.order(CommandKind.ARM)
    assert not refused.accepted
    pond.step(20)
    assert pond.order(CommandKind.HOLD).accepted
    pond.step(14)
    assert {state.mode for state in pond.states} == {Mode.DISARMED, Mode.ARMED, Mode.TRACKING, Mode.HOLDING}
    return pond


def again(lines: list[LogMessage], experiment: Experiment) -> tuple[list[RobotState], list[Plan], list[str]]:
    states, plans, messages = [], [], []
    for _, message, _ in Rerun(experiment, ME).run(iter(lines)):
        if isinstance(message, RobotState):
            states.append(message)
        elif isinstance(message, Plan):
            plans.append(message)
        else:
            assert isinstance(message, Event)
            messages.append(message.message)
    return states, plans, messages


def parts(part: Estimate | Control | None, name: str) -> bytes | None:
    """The bytes of an array of a state's part; None where there is none."""
    return None if part is None else bytes(getattr(part, name).tobytes())


def same(one: list[RobotState], other: list[RobotState]) -> list[bool]:
    return [encode(a) == encode(b) for a, b in zip(one, other, strict=True)]


def test_every_step_comes_out_the_same(flown: Pond) -> None:
    states, plans, messages = again(flown.lines, flown.experiment)
    assert messages == []
    assert all(same(states, flown.states))
    assert [encode(plan) for plan in plans] == [encode(plan) for plan in flown.plans]
    assert any(state.control is not None and state.control.solve for state in states)


def with_states(flown: Pond) -> list[LogMessage]:
    """The flight as in a station's log: each step followed by its state."""
    states, lines = iter(flown.states), []
    for line in flown.lines:
        lines.append(line)
        if line.topic is topics.INPUTS:
            lines.append(LogMessage(topics.STATE, ME, line.header, encode(next(states)), line.arrived_ns))
    return lines


def test_another_tuning_comes_out_otherwise_and_is_not_refused(flown: Pond) -> None:
    changed = load_experiment("pool", [*UNMOVED, "controller.nmpc.turning_m=0.1"])
    states, _, messages = again(with_states(flown), changed)
    assert messages == []
    assert [state.mode for state in states] == [state.mode for state in flown.states]  # its orders are obeyed
    wrenches = [
        np.abs(a.control.wrench - b.control.wrench).max()
        for a, b in zip(states, flown.states, strict=True)
        if a.control is not None and b.control is not None
    ]
    assert max(wrenches) > 1e-3


def test_observer_uses_the_pulses_that_really_went_out(flown: Pond) -> None:
    """With the log's states behind its steps a changed agent sees no disturbance in thrust that it never gave."""
    changed, corrected = load_experiment("pool", [*UNMOVED, "controller.nmpc.turning_m=0.1"]), with_states(flown)
    states_again, _, _ = again(corrected, changed)
    assert all(parts(a.estimate, "eta") == parts(b.estimate, "eta") for a, b in zip(states_again, flown.states, strict=True))
    assert any(
        parts(a.control, "wrench") != parts(b.control, "wrench") for a, b in zip(states_again, flown.states, strict=True)
    )
    unchanged, _, _ = again(corrected, flown.experiment)
    assert all(same(unchanged, flown.states))


@pytest.mark.parametrize(
    "settings", [["vehicle=vectored"], ["vehicle.thruster.curve=NARROW", "vehicle.thruster.max_thrust_n=1"]]
)
def test_pulses_that_another_vehicle_cannot_put_out_do_not_count(flown: Pond, settings: list[str]) -> None:
    """Of a log that is repeated with other settings, one time for all steps."""
    inner = [list(point) for point in flown.experiment.vehicle.thruster.curve if 1400 <= point[0] <= 1700]
    other = load_experiment("pool", [*UNMOVED, *(setting.replace("NARROW", str(inner)) for setting in settings)])
    states, _, messages = again(with_states(flown), other)
    assert len(states) == len(flown.states)
    assert messages == ["the log has pulses or wrenches that this vehicle does not have: its own count instead"]


@pytest.mark.parametrize("topic", [topics.PLAN, topics.OBSTACLES, topics.INPUTS])
def test_input_missing_in_the_log_is_named(flown: Pond, topic: Topic) -> None:
    of_this = [k for k, line in enumerate(flown.lines) if line.topic is topic]
    gap = of_this[len(of_this) // 2]
    states, _, messages = again(flown.lines[:gap] + flown.lines[gap + 1 :], flown.experiment)
    assert len(messages) == 1
    assert "not in the log" in messages[0]
    assert len(states) == len(flown.states) - (topic is topics.INPUTS)


def test_a_record_of_halves_is_left_out(flown: Pond) -> None:
    def broken() -> Iterator[LogMessage]:
        yield LogMessage(topics.INPUTS, ME, Header(1, 1, 1), b"\x50\x01", 1)  # plan_robots = [1], nothing else
        yield LogMessage(topics.INPUTS, ME, Header(1, 1, 1), b"\xff\xff", 1)

    assert len(again(list(broken()), flown.experiment)[2]) == 2


def test_with_a_new_station_a_disarmed_robot_begins_anew_and_its_log_is_whole() -> None:
    pond = Pond(load_experiment("pool"))
    pond.step(10)
    old = pond.order(CommandKind.LOAD)
    assert old.accepted
    pond.step(5)
    pond.station = Bus(MemoryTransport(pond.hub))
    first = len(pond.states)
    before = len(pond.lines)
    pond.step(3)
    assert pond.states[-1].trajectory_id == ""  # what the old station had loaded is gone
    for order in (CommandKind.LOAD, CommandKind.ARM, CommandKind.START):
        assert pond.order(order).accepted
    pond.step(10)
    states, _, messages = again(pond.lines[before:], pond.experiment)
    assert messages == []
    assert all(same(states, pond.states[first:]))
    # and the log of both lives, as a recorder that outlived the station would have it
    states, _, messages = again(pond.lines, pond.experiment)
    assert messages == []
    assert all(same(states, pond.states))


def test_a_new_station_changes_nothing_for_a_robot_that_is_up_to_something() -> None:
    pond = Pond(load_experiment("pool"))
    pond.step(10)
    assert pond.order(CommandKind.LOAD).accepted
    assert pond.order(CommandKind.ARM).accepted
    pond.step(2)
    pond.station = Bus(MemoryTransport(pond.hub))
    pond.step(3)
    assert pond.states[-1].mode is Mode.ARMED
    assert pond.order(CommandKind.START).accepted


def test_an_order_of_the_old_station_is_not_taken_after_the_new_beginning() -> None:
    pond = Pond(load_experiment("pool"))
    pond.step(10)
    old = pond.station
    assert pond.order(CommandKind.LOAD).accepted
    pond.station = Bus(MemoryTransport(pond.hub))
    pond.step(3)
    command = Command(CommandKind.LOAD, ME, 1e6, pond.experiment.hash, trajectory=pond.trajectory)
    assert not old.command(command, pond.sent_ns, 1.0).accepted
