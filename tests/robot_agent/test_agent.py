"""A robot's core: what it takes off its sensors, and the last guard before the wire."""

import itertools
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from groundstation.planning.segment import first_segment
from robot_agent.agent import Agent
from robot_agent.control.controller import ControlOutput
from robot_agent.guidance.trajectory_clock import TrajectoryClock
from robot_agent.inputs import Inputs, StationView
from robot_agent.preflight.rehearsal import ARM_AFTER, DEPTH_M, RADIUS_M, SPEED_MPS, STATION, rehearse
from shoal.config.experiment import load_experiment
from shoal.messages.codec import Header
from shoal.messages.live_gains import tuned, tuning
from shoal.messages.messages import Command, CommandKind, Control, Mode, Reply, Solve, Trajectory, is_finite, required

NEUTRAL_US = (1500,) * 4
POOL = load_experiment("pool")
VECTORED = load_experiment("straight", ["vehicle=vectored", "sim.sensors.battery_v=15.5"])


def flying() -> tuple[Agent, Inputs, int]:
    """A robot that tracks, what it has to go by at its next step, and when that is."""
    steps = rehearse(POOL, 1)
    for agent, inputs, now_ns in itertools.islice(steps, ARM_AFTER + 20):
        agent.step(inputs, now_ns)
    assert agent.mode is Mode.TRACKING
    return next(steps)


@pytest.mark.parametrize(
    "broken",
    [
        {"control": Control(wrench=np.array([np.nan, 0.0, 0.0]))},
        {"control": Control(wrench_step=np.array([0.0, np.inf, 0.0]))},
        {"plan_eta": np.full((51, 4), np.nan)},
        {"tracking_error_m": float("nan")},
        {"control": Control(slack_m=float("inf"))},
        {"pulse_us": (1901, *[1500] * 7)},
        {"pulse_us": (1099, *[1500] * 7)},
        {"pulse_us": (*[1500] * 7, 2001)},
        {"pulse_us": (*[1500] * 7, 999)},
    ],
    ids=["wrench", "step", "plan", "error", "slack", "ahead", "astern", "ankle high", "ankle low"],
)
def test_invalid_pulse_ends_in_neutral(broken: dict[str, Any], monkeypatch: pytest.MonkeyPatch) -> None:
    agent, inputs, now_ns = flying()
    controller = agent.controller
    real = controller.step
    monkeypatch.setattr(controller, "step", lambda *arguments: real(*arguments)._replace(**broken))
    outputs = agent.step(inputs, now_ns)
    assert (outputs.pulse_us[:4], required(outputs.state.control).solve, outputs.plan) == (NEUTRAL_US, Solve.FAILED, None)
    assert outputs.state.estimate is None and is_finite(outputs.state.control) and is_finite(outputs.state.timing)
    monkeypatch.undo()
    outputs = agent.step(inputs, now_ns + 50_000_000)
    assert (outputs.state.mode, outputs.state.fault) == (Mode.FAULT, "no control solution")


@pytest.mark.parametrize("below_0", [(0, 0), (1, 1), (2, 2)])
def test_a_robot_holds_where_its_poses_have_variances_that_none_can_have(below_0: tuple[int, int]) -> None:
    """A localizer of one's own may send them. The robot's program must not end by them, nor the robot fly by them."""
    agent, inputs, now_ns = flying()
    received, covariance = required(inputs.pose), np.array(required(inputs.pose).pose.covariance)
    covariance[below_0] = -1e-4
    impossible = replace(received.pose, covariance=covariance)
    for k in range(20):
        later_ns = k * 50_000_000
        pose = replace(received, pose=impossible, instant_ns=received.instant_ns + later_ns)
        board = replace(inputs.board, board_ms=inputs.board.board_ms + 50 * k, arrival_ns=inputs.board.arrival_ns + later_ns)
        outputs = agent.step(replace(inputs, pose=pose, board=board), now_ns + later_ns)
        if outputs.state.mode is not Mode.TRACKING:
            break
    assert (outputs.state.mode, outputs.state.fault) == (Mode.HOLDING, "pose late")


def test_a_trajectory_is_judged_beside_the_steps_and_not_again_in_their_turn(monkeypatch: pytest.MonkeyPatch) -> None:
    agent, inputs, now_ns = next(rehearse(POOL, 1))
    path, hash_ = first_segment(POOL).trajectories[1], agent.step(inputs, now_ns).state.experiment_hash
    away = replace(path, eta=path.eta + 9.0)
    loads = [Command(CommandKind.LOAD, 1, experiment_hash=hash_, trajectory_id=it.id, trajectory=it) for it in (path, away)]
    prepared = [agent.prepare(load) for load in loads]
    assert prepared == ["", "trajectory.eta leaves the pool at 0.00 s"]
    monkeypatch.setattr(TrajectoryClock, "flaw", lambda *_: pytest.fail("judged again while a step waits"))
    replies = [
        agent.handle_command(Header(STATION, 1000 + k, now_ns), load, inputs.station, now_ns, prepared[k])
        for k, load in enumerate(loads)
    ]
    assert [reply.reason for reply in replies] == ["", prepared[1]]


def test_an_invalid_step_keeps_the_goal_of_the_step_before_and_the_shape_of_its_wrenches(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Of a vehicle with side thrust."""
    steps = rehearse(VECTORED, 1)
    for agent, inputs, now_ns in itertools.islice(steps, ARM_AFTER + 20):
        before = agent.step(inputs, now_ns).state.control
    real = agent.controller.step
    monkeypatch.setattr(agent.controller, "step", lambda *arguments: real(*arguments)._replace(tracking_error_m=np.nan))
    _, inputs, now_ns = next(steps)
    control = required(agent.step(inputs, now_ns).state.control)
    assert control.solve is Solve.FAILED and before is not None and required(before).solve is Solve.SOLVED
    np.testing.assert_array_equal(control.eta_reference, before.eta_reference)
    np.testing.assert_array_equal(control.eta_command, before.eta_command)
    for wrench in (control.wrench, control.wrench_step, control.wrench_wanted, control.wrench_delivered):
        np.testing.assert_array_equal(wrench, np.zeros(4))


def test_a_depth_offset_is_taken_off_everywhere() -> None:
    """A sensor that says 2 cm too much, and is beliefs to, is one that is right."""
    true_m = next(rehearse(POOL, 1))[1].board.depth_m
    corrected = load_experiment("pool", ["robots.0.depth_offset_m=0.02"])
    states = []
    for agent, inputs, now_ns in itertools.islice(rehearse(corrected, 1), ARM_AFTER):
        high = replace(inputs, board=replace(inputs.board, depth_m=true_m + 0.02))
        states.append(agent.step(high, now_ns).state)
    assert required(states[-1].board).depth_m == pytest.approx(true_m) and required(states[-1].estimate).eta[
        2
    ] == pytest.approx(true_m)


def test_a_robot_that_has_fallen_silent_is_where_the_camera_sees_it(monkeypatch: pytest.MonkeyPatch) -> None:
    """Not at the end of its last plan. It may fly that plan on for a while, from there."""
    steps = rehearse(POOL, 1)
    for agent, inputs, now_ns in itertools.islice(steps, ARM_AFTER + 20):
        agent.step(inputs, now_ns)
    last_plan, real = inputs.plans[2], agent.controller.step
    beliefs: list[tuple[complex, complex, float]] = []  # of the other: place, velocity, distance to keep

    def step(measurement: Any, goal: Any, neighbours: Any, at_ns: int, obstacles: Any) -> ControlOutput:
        of = agent.controller.formation
        others = of.predict_neighbours(neighbours, at_ns)
        beliefs.append(
            (complex(others.place_now[0]), complex(others.intended_velocity[0]), of.clearances_m(others, at_ns).item())
        )
        return real(measurement, goal, neighbours, at_ns, obstacles)

    monkeypatch.setattr(agent.controller, "step", step)
    end, place = complex(*last_plan.plan.eta[-1, :2]), -1.5 - 0.5j
    touching_m, period_s = 2.0 * POOL.safety.radius_m, POOL.controller.period_s
    for k, (_, fresh, at_ns) in enumerate(itertools.islice(steps, 401)):
        places = {2: place} if k < 300 else {}
        plans = {2: last_plan} if k < 400 else fresh.plans
        agent.step(replace(fresh, plans=plans, station=replace(fresh.station, sightings=places)), at_ns)
    assert agent.mode is Mode.TRACKING
    assert len(last_plan.plan.eta) * last_plan.plan.period_s < 290 * period_s
    assert beliefs[0][0] != place and beliefs[0][2] == touching_m  # a plan that is fresh counts
    assert abs(beliefs[40][0] - place) < 1e-9 and abs(beliefs[40][1]) > 0.05 and beliefs[40][2] == pytest.approx(touching_m)
    assert abs(beliefs[299][0] - place) < 1e-9 and beliefs[299][1] == 0.0  # its plan has ended
    away, gone_s = [abs(beliefs[399][0] - it) for it in (place, end)], 100 * period_s
    assert away[0] < 1e-9 < away[1]  # it is no longer seen
    growth_m = min(POOL.safety.bubble_mps * gone_s, POOL.safety.bubble_max_m)
    assert beliefs[399][2] == pytest.approx(touching_m + growth_m)
    assert abs(beliefs[400][0] - complex(*fresh.plans[2].plan.eta[0, :2])) < 0.1 and beliefs[400][2] == touching_m


class OrderedRobot:
    """A robot that tracks, steps on, and is given commands."""

    def __init__(self) -> None:
        self.steps = rehearse(POOL, 1)
        self.number, self.board_armed = ARM_AFTER, True
        for _ in range(ARM_AFTER + 20):
            self.step()
        assert self.state.mode is Mode.TRACKING

    def step(self) -> None:
        self.agent, inputs, self.now_ns = next(self.steps)
        inputs = replace(inputs, board=replace(inputs.board, armed=inputs.board.armed and self.board_armed))
        self.state = self.agent.step(inputs, self.now_ns).state

    def give(self, order: CommandKind, **fields: Any) -> Reply:
        """The reply to a command of the station of this moment; another step follows."""
        self.number += 1
        now: dict[str, Any] = {
            "experiment_hash": self.state.experiment_hash,
            "trajectory_id": "rehearsal",
            "start_ns": self.now_ns,
        }
        header, station = Header(STATION, self.number, self.now_ns), StationView(STATION, self.now_ns, 0.0)
        reply = self.agent.handle_command(header, Command(order, 1, **(now | fields)), station, self.now_ns)
        self.step()
        return reply


@pytest.mark.parametrize("end", [CommandKind.DISARM, CommandKind.STOP])
def test_gains_that_wait_for_a_later_lap_are_not_taken_in_the_next_run(end: CommandKind) -> None:
    robot, ahead_s = OrderedRobot(), 3.0
    flown_id, gains = robot.state.tuning_id, tuning(POOL.controller)
    other = tuning(tuned(POOL.controller, {gains.keys[0]: 1.1 * float(gains.values[0])}))
    assert robot.give(CommandKind.TUNE, tuning=other).accepted
    assert robot.give(CommandKind.ADOPT, tuning_id=other.id, trajectory_s=ahead_s).accepted
    robot.board_armed = False
    for order in (end, *([CommandKind.CLEAR_STOP] if end is CommandKind.STOP else []), CommandKind.ARM):
        assert robot.give(order).reason == ""
    robot.board_armed = True
    robot.step()
    assert robot.give(CommandKind.START, trajectory_s=ahead_s - 0.5).reason == ""
    for _ in range(30):
        robot.step()
    assert robot.state.mode is Mode.TRACKING
    assert robot.state.tuning_id == flown_id


def test_a_trajectory_that_was_loaded_for_later_is_forgotten_when_the_robot_holds() -> None:
    robot, period_s, begin_s = OrderedRobot(), POOL.controller.period_s, 5.0
    angle = np.arange(0.0, 60.0, period_s) * SPEED_MPS / RADIUS_M  # the circle that the rehearsal flies
    x_m, y_m, depth_m = RADIUS_M * np.cos(angle), RADIUS_M * np.sin(angle), np.full_like(angle, DEPTH_M)
    eta = np.column_stack([x_m, y_m, depth_m, angle + np.pi / 2.0])
    velocity = np.gradient(eta, period_s, axis=0)
    rows = slice(round(begin_s / period_s), None)
    acceleration = np.gradient(velocity, period_s, axis=0)
    later = Trajectory("later", period_s, eta[rows], velocity[rows], acceleration[rows], begin_s)

    def load() -> Reply:
        return robot.give(CommandKind.LOAD, trajectory=later, trajectory_id=later.id)

    assert load().reason == ""
    assert robot.give(CommandKind.HOLD).accepted
    assert robot.give(CommandKind.RESUME, trajectory_s=1.0).accepted
    assert robot.give(CommandKind.SWITCH, trajectory_id=later.id).reason == "trajectory later is not loaded"
    assert load().accepted and robot.give(CommandKind.SWITCH, trajectory_id=later.id).accepted


def test_a_silent_robot_that_the_camera_sees_counts_though_no_plan_of_it_ever_came(monkeypatch: pytest.MonkeyPatch) -> None:
    """Its last plan came before this robot's program was started again."""
    steps, places, depths, keeps_m = rehearse(POOL, 1), list[complex](), list[float](), list[float]()
    for agent, inputs, now_ns in itertools.islice(steps, ARM_AFTER + 20):
        agent.step(replace(inputs, plans={}), now_ns)
    real = agent.controller.step

    def step(measurement: Any, goal: Any, neighbours: Any, at_ns: int, obstacles: Any) -> ControlOutput:
        of = agent.controller.formation
        others = of.predict_neighbours(neighbours, at_ns)
        places.extend(others.place_now.tolist())
        depths.extend(others.depth_now.tolist())
        keeps_m.extend(of.clearances_m(others, at_ns).tolist())
        return real(measurement, goal, neighbours, at_ns, obstacles)

    monkeypatch.setattr(agent.controller, "step", step)
    touching_m = 2.0 * POOL.safety.radius_m
    sightings = {2: -1.5 - 0.5j, 1: 0j}  # and this robot itself, whose plans are not heard
    for k, (_, fresh, at_ns) in enumerate(itertools.islice(steps, 60)):
        station = replace(fresh.station, sightings=sightings if k < 40 else {}, out=(2,) if k >= 50 else ())
        state = agent.step(replace(fresh, plans={}, station=station), at_ns).state
    assert agent.mode is Mode.TRACKING and state.heard == ()
    assert places == [sightings[2]] * 50, "until a person says that it is out of the water"
    assert depths[:40] == [pytest.approx(inputs.board.depth_m)] * 40, "how deep it is nobody knows: it is in the way"
    grown_m = 10 * POOL.controller.period_s * POOL.safety.bubble_mps
    assert keeps_m[0] == pytest.approx(touching_m) and keeps_m[-1] == pytest.approx(touching_m + grown_m)
