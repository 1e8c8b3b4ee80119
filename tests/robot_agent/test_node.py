"""A robot's program: when it steps, what it does when something in it is slow or breaks, how it ends."""

import os
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from socket import SOCK_DGRAM
from typing import Any

import numpy as np
import pytest

from robot_agent import node
from robot_agent.agent import Agent
from robot_agent.control.live_tuning import LiveTuning
from robot_agent.control.nonlinear.nonlinear_controller import NonlinearController
from robot_agent.host.step_clock import StepClock
from shoal.bus.bus import Bus, Inbox
from shoal.bus.memory_transport import MemoryHub, MemoryTransport
from shoal.config.experiment import load_experiment
from shoal.mavlink.agent_link import ACCEPTED, ARM_DISARM
from shoal.mavlink.board_port import Link, open_link
from shoal.messages import topics
from shoal.messages.codec import FARTHEST_NS, LATEST_NS, Header, encode
from shoal.messages.live_gains import tuning
from shoal.messages.messages import (
    Command,
    CommandKind,
    Message,
    Mode,
    Obstacles,
    Plan,
    Pose,
    Reply,
    RobotState,
    StationHeartbeat,
    Track,
    Trajectory,
    Tuning,
)
from shoal.messages.topics import Qos
from shoal.runtime.runtime import Stop, wait
from shoal.runtime.version import code
from sim_bridge.sil.ports import free_port
from sim_bridge.thruster_board.board_link import BoardLink
from tests.robot_agent.autopilot import Autopilot
from tests.robot_agent.obedient_board import Board

PATIENCE_S = 20.0
POOL = load_experiment("pool", ["safety.watch_thrusters=false"])  # nothing that they do moves this robot
NEVER_S = 1e3


@pytest.mark.parametrize("order", [CommandKind.STOP, CommandKind.DISARM])
@pytest.mark.parametrize("mode", [Mode.HOLDING, Mode.ARMED])
def test_an_order_that_takes_the_power_away_does_not_wait_for_the_next_step(
    order: CommandKind, mode: Mode, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Nor one that ends a thruster test, which is made in ARMED."""
    monkeypatch.setattr(StepClock, "due_s", lambda *_: time.monotonic() + NEVER_S)
    hub, stop, link = MemoryHub(), Stop(install=False), open_link(f"udp:127.0.0.1:{free_port(SOCK_DGRAM)}")
    bus, station = Bus(MemoryTransport(hub)), Bus(MemoryTransport(hub))
    states = station.inbox(topics.STATE, RobotState, 1)
    robot = node.AgentNode(load_experiment("pool"), 1, bus, link, stop)
    robot.agent.mode = mode
    thread = threading.Thread(target=robot.run)
    thread.start()
    try:
        while not station.command(Command(order, robot=1), time.time_ns(), 1.0).accepted:  # until it serves, and hears us
            station.publish(topics.HEARTBEAT, StationHeartbeat(), time.time_ns())
        assert wait(station, stop, lambda: states.newest_header() is not None, PATIENCE_S)
    finally:
        stop.request()
        thread.join()
        link.close()
    state = states.newest()
    assert state is not None
    assert state.message.mode is {CommandKind.STOP: Mode.STOPPED, CommandKind.DISARM: Mode.DISARMED}[order]
    assert set(state.message.pulse_us) == {1500}
    assert state.message.code == code().short


def test_a_board_that_is_not_there_is_named_and_once_is_enough(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(node, "LINK_HEARTBEAT_S", 0.0)
    hub, stop, link = MemoryHub(), Stop(install=False), open_link("serial:/dev/none")
    bus, station = Bus(MemoryTransport(hub)), Bus(MemoryTransport(hub))
    states = station.inbox(topics.STATE, RobotState, 1)
    thread = threading.Thread(target=node.AgentNode(load_experiment("pool"), 1, bus, link, stop).run)
    thread.start()
    try:
        assert wait(station, stop, lambda: (header := states.newest_header()) is not None and header.sequence > 3, PATIENCE_S)
    finally:
        stop.request()
        thread.join()
    assert [record.getMessage() for record in caplog.records if record.levelname == "WARNING"] == [
        "thruster board: /dev/none: not there; is the board plugged in, and powered?",
        "told to stop; neutral and disarm may not have reached the thruster board (/dev/none: not there; is the board plugged "
        "in, and powered?), which has not said within 0.25 s that it is disarmed",
    ]


def test_a_program_says_sent_only_of_what_may_have_gone_to_a_board_it_has_heard(caplog: pytest.LogCaptureFixture) -> None:
    """A program that ends just after the opening of its port, which is quiet until the board has spoken."""
    here, there = os.openpty()
    os.set_blocking(here, False)
    link, stop = open_link(f"serial:{os.ttyname(there)}"), Stop(install=False)
    stop.request()
    node.AgentNode(POOL, 1, Bus(MemoryTransport(MemoryHub())), link, stop).run()
    with pytest.raises(BlockingIOError):
        os.read(here, 1)
    assert "neutral and disarm may not have reached the thruster board (it has not been heard yet)" in caplog.text
    link.close()
    os.close(here)
    os.close(there)


class AnswersLater(Link):
    """A board that takes a request to arm, and of the requests to disarm only what `obeys` says."""

    trouble = advice = ""

    def __init__(self, obeys: bool) -> None:
        self._link, self._obeys, self._reads = BoardLink(1), obeys, 0

    def send(self, data: bytes) -> None: ...
    def wait(self, timeout_s: float) -> None: ...
    def close(self) -> None: ...

    def read(self) -> bytes:
        self._reads += 1
        acknowledged = self._link.acknowledge((1, 191), ARM_DISARM, ACCEPTED)
        if self._reads == 1:
            return acknowledged  # to the request to arm; the heartbeat beside it is lost
        obeyed = acknowledged + self._link.heartbeat(False, True)
        return obeyed if self._obeys and self._reads == 10 else b""


@pytest.mark.parametrize("obeys", [True, False])
def test_a_program_that_ends_just_after_arming_does_not_take_that_answer_for_disarmed(
    obeys: bool, caplog: pytest.LogCaptureFixture
) -> None:
    stop, link = Stop(install=False), AnswersLater(obeys)
    robot = node.AgentNode(POOL, 1, Bus(MemoryTransport(MemoryHub())), link, stop)
    robot.mavlink.receive(BoardLink(1).heartbeat(False, True), 0)
    link.send(robot.mavlink.arm(True))
    stop.request()
    with caplog.at_level("INFO"):
        robot.run()
    line = "says that it is disarmed" if obeys else "has not said within 0.25 s that it is disarmed"
    assert line in caplog.text


@dataclass
class Running:
    """A robot's program on a thread, with a station that beats, poses, and a board that does as it is told."""

    robot: node.AgentNode
    station: Bus
    states: Inbox[RobotState]
    ended: list[BaseException | None] = field(default_factory=list)

    def until(self, true: Callable[[], bool]) -> bool:
        """Let the station beat and the camera see until it is so. False if the patience is over before."""
        deadline = time.monotonic() + PATIENCE_S
        while time.monotonic() < deadline:
            if true():
                return True
            pose = Pose(0.0, 0.0, 0.0, 1e-6 * np.eye(3), Track.MARKER, True, 0.9, 0.3)
            self.station.publish(topics.POSE, pose, time.time_ns(), 1)
            self.station.publish(topics.HEARTBEAT, StationHeartbeat(POOL.hash), time.time_ns())
            time.sleep(0.02)
        return False

    def order(self, order: CommandKind, tuning: Tuning | None = None) -> Reply:
        self.station.publish(topics.HEARTBEAT, StationHeartbeat(POOL.hash), time.time_ns())
        return self.station.command(Command(order, 1, experiment_hash=POOL.hash, tuning=tuning), time.time_ns(), 1.0)

    @property
    def state(self) -> RobotState:
        newest = self.states.newest()
        return newest.message if newest is not None else RobotState()


@contextmanager
def program(board: Link) -> Iterator[Running]:
    """The program with this board, running."""
    hub, stop = MemoryHub(), Stop(install=False)
    bus, station = Bus(MemoryTransport(hub)), Bus(MemoryTransport(hub))
    robot = node.AgentNode(POOL, 1, bus, board, stop)
    process = Running(robot, station, station.inbox(topics.STATE, RobotState, 1))

    def run() -> None:
        try:
            robot.run()
            process.ended.append(None)
        except BaseException as error:
            process.ended.append(error)

    thread = threading.Thread(target=run)
    thread.start()
    try:
        yield process
    finally:
        stop.request()
        thread.join()


@pytest.fixture
def running() -> Iterator[Running]:
    with program(Board()) as process:
        assert process.until(lambda: process.order(CommandKind.ARM).accepted)
        assert process.order(CommandKind.HOLD).accepted
        yield process


def test_a_board_that_does_not_report_its_outputs_is_not_armed(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(BoardLink, "servo_output", lambda *_: b"")
    with program(Board()) as process:
        reasons: list[str] = []

        def is_refused_for_it() -> bool:
            reasons.append(process.order(CommandKind.ARM).reason)
            return "does not report its outputs" in reasons[-1]

        assert process.until(is_refused_for_it), set(reasons)


def test_a_step_that_waits_is_as_late_as_one_that_computes(running: Running, monkeypatch: pytest.MonkeyPatch) -> None:
    """For a lock, a page of memory, another program: the robot does not fly on with a loop that takes thrice its period."""
    real = NonlinearController.step

    def waiting(*arguments: Any) -> Any:
        time.sleep(0.1)
        return real(*arguments)

    monkeypatch.setattr(NonlinearController, "step", waiting)
    assert running.until(lambda: running.state.mode is Mode.FAULT)
    assert running.state.fault == "control too slow"
    assert running.state.timing.missed_deadlines >= 3


def test_gains_are_made_ready_beside_the_steps(running: Running, monkeypatch: pytest.MonkeyPatch) -> None:
    real, building, built = LiveTuning.prepare, threading.Event(), threading.Event()

    def slowly(*arguments: Any) -> Any:
        building.set()
        assert built.wait(PATIENCE_S)
        return real(*arguments)

    monkeypatch.setattr(LiveTuning, "prepare", slowly)
    replies: list[Reply] = []
    tuner = threading.Thread(target=lambda: replies.append(running.order(CommandKind.TUNE, tuning(POOL.controller))))
    tuner.start()
    assert building.wait(PATIENCE_S)
    # the number of steps is told only in the log of inputs, which this station does not hear
    before = running.robot._steps
    # the number of steps is told only in the log of inputs, which this station does not hear
    assert running.until(lambda: running.robot._steps > before + 5)
    built.set()
    tuner.join()
    assert [reply.accepted for reply in replies] == [True]


def test_an_order_that_breaks_the_program_ends_it_and_says_why(running: Running, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Agent, "_apply", lambda *arguments: 1 / 0)
    reply = running.order(CommandKind.LOAD)
    assert (reply.accepted, reply.reason) == (False, "carries no trajectory")
    reply = running.order(CommandKind.HOLD)
    assert (reply.accepted, reply.reason) == (False, "HOLD: ZeroDivisionError: division by zero; the robot's program ends")
    assert running.until(lambda: len(running.ended) > 0)
    assert isinstance(running.ended[0], ZeroDivisionError)


def test_a_program_that_is_ending_takes_no_order_that_gives_power(running: Running) -> None:
    running.robot.stop.request()
    assert running.until(lambda: len(running.ended) > 0)
    reply = running.order(CommandKind.HOLD)
    assert (reply.accepted, reply.reason) == (False, "HOLD: the robot's program is ending")
    assert running.order(CommandKind.STOP).accepted


def test_a_request_to_stop_wakes_a_loop_that_sleeps(monkeypatch: pytest.MonkeyPatch) -> None:
    stop, woken = Stop(install=False), threading.Event()
    stop.on_request(woken.set)
    assert not woken.is_set()
    stop.request()
    assert woken.wait(PATIENCE_S) and stop()


@pytest.mark.parametrize("latest_ns", [LATEST_NS, 2**63 - 1])
def test_wild_times_of_another_process_end_no_robot(latest_ns: int) -> None:
    """A step's record has the instants of all that the step acts on, in 64 bits."""
    hub, link = MemoryHub(), open_link(f"udp:127.0.0.1:{free_port(SOCK_DGRAM)}")
    bus, other = Bus(MemoryTransport(hub)), MemoryTransport(hub)
    robot, nodes = node.AgentNode(POOL, 1, bus, link, Stop(install=False)), np.zeros((51, 4))
    sent: dict[str, Message] = {
        topics.PLAN.key(2): Plan(0.05, nodes, nodes),
        topics.POSE.key(1): Pose(0.0, 0.0, 0.0, np.eye(3), Track.MARKER),
        topics.HEARTBEAT.key(): StationHeartbeat(),
        topics.OBSTACLES.key(): Obstacles(watched=1.0),
    }
    headers = [(latest_ns, 0), (-FARTHEST_NS, FARTHEST_NS), (-(2**63), 0), (0, 2**63 - 1), (-FARTHEST_NS, 0)]
    for sequence, (stamp_ns, age_ns) in enumerate(headers, 1):
        for name, message in sent.items():
            other.publisher(f"shoal/{name}", Qos.CONTROL)(encode(message), Header(7, sequence, stamp_ns, age_ns).encode())
        now_ns = robot.clock.now_ns()
        record, _ = robot.step(now_ns, node.StepTime(now_ns))
        bus.publish(topics.INPUTS, record, now_ns, 1)
    assert record.plan_sequences == (len(headers),)
    assert bus.rejected == len(sent) * (2 + (latest_ns > LATEST_NS))
    link.close()


def test_of_two_programs_that_publish_a_robots_poses_by_turns_none_counts(caplog: pytest.LogCaptureFixture) -> None:
    """A simulator that was left running beside the localizer: the robot would believe to leap to and fro."""
    hub, link = MemoryHub(), open_link(f"udp:127.0.0.1:{free_port(SOCK_DGRAM)}")
    bus, camera, simulator = (Bus(MemoryTransport(hub)) for _ in range(3))
    robot = node.AgentNode(POOL, 1, bus, link, Stop(install=False))

    def pose(sender: Bus, x_m: float) -> None:
        pose = Pose(x_m, 0.0, 0.0, 1e-6 * np.eye(3), Track.MARKER, True, 0.9, 0.3)
        sender.publish(topics.POSE, pose, time.time_ns(), 1)

    def stepped() -> tuple[int, Pose | None]:
        record, _ = robot.step(robot.clock.now_ns(), node.StepTime(0))
        return record.pose_instant_ns, record.pose

    pose(camera, 0.0)
    stepped()
    pose(simulator, 1.5)
    pose(camera, 0.0)  # heard again: there are two
    instants = set()
    for _ in range(5):
        pose(simulator, 1.5)
        instant_ns, newest = stepped()
        assert newest is not None and newest.x_m == 0.0
        instants.add(instant_ns)
        pose(camera, 0.0)
    assert len(instants) == 1, "the last pose before grows old"
    assert caplog.text.count("two programs publish poses of this robot by turns") == 1
    link.close()


def test_an_autopilot_gets_no_pulses_and_no_requests_to_arm() -> None:
    hub, stop, there = MemoryHub(), Stop(install=False), Autopilot()
    bus, station = Bus(MemoryTransport(hub)), Bus(MemoryTransport(hub))
    states = station.inbox(topics.STATE, RobotState, 1)
    thread = threading.Thread(target=node.AgentNode(POOL, 1, bus, there, stop).run)
    thread.start()
    try:
        assert wait(station, stop, lambda: (header := states.newest_header()) is not None and header.sequence > 5, PATIENCE_S)
    finally:
        stop.request()
        thread.join()
    assert there.received <= {"HEARTBEAT", "TIMESYNC"}


@pytest.mark.parametrize(("away_m", "accepted"), [(0.0, True), (1.5, False)])
def test_where_the_path_is_at_a_resume_is_judged_with_the_formations_lag(away_m: float, accepted: bool) -> None:
    """The timetable that a RESUME names is ahead of the formation by its lag, 15 s here, of which the heartbeat tells."""
    hub, lag_s, flown_s = MemoryHub(), 15.0, 10.0
    bus, station = Bus(MemoryTransport(hub)), Bus(MemoryTransport(hub))
    robot = node.AgentNode(POOL, 1, bus, Board(), Stop(install=False))
    bus.serve(1, robot.on_command)
    eta, velocity = np.zeros((601, 4)), np.zeros((601, 4))
    eta[:, 0], eta[:, 2], velocity[:, 0] = np.linspace(-1.5, 1.5, 601), 0.3, 0.1
    path, x_m = Trajectory("straight", 0.05, eta, velocity, np.zeros((601, 4))), 0.1 * flown_s - 1.5 + away_m

    def order(order: CommandKind, **content: Any) -> Reply:
        for _ in range(5):
            pose = Pose(x_m, 0.0, 0.0, 1e-6 * np.eye(3), Track.MARKER, True, 0.9, 0.3)
            station.publish(topics.POSE, pose, time.time_ns(), 1)
            station.publish(topics.HEARTBEAT, StationHeartbeat(POOL.hash, lag_s=lag_s), time.time_ns())
            now_ns = robot.clock.now_ns()
            _, outputs = robot.step(now_ns, node.StepTime(now_ns))
            robot.write(outputs, now_ns, now_ns, time.perf_counter_ns())
            time.sleep(0.05)
        return station.command(Command(order, 1, experiment_hash=POOL.hash, **content), time.time_ns(), 1.0)

    order(CommandKind.HOLD)  # the first order learns whom it is for
    assert order(CommandKind.LOAD, trajectory_id=path.id, trajectory=path).accepted
    while not (reply := order(CommandKind.ARM)).accepted:
        assert "parameters" in reply.reason
    assert order(CommandKind.HOLD).accepted
    begins = {"trajectory_id": path.id, "trajectory_s": flown_s + lag_s, "start_ns": time.time_ns() + 500_000_000}
    reply = order(CommandKind.RESUME, **begins)
    assert reply.accepted is accepted, reply.reason
    assert accepted or "is 1.50 m from where its path is at 10.00 s" in reply.reason
