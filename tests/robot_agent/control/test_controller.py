"""The whole control step: flown in an independent plant, fuzzed, and with everything missing that can be."""

import dataclasses
import math
from copy import deepcopy

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from robot_agent.control.controller import ControlOutput, Setting
from robot_agent.control.law_controller import LawController
from robot_agent.guidance.formation import Neighbour
from robot_agent.guidance.reference import Follow, Goal
from robot_agent.vehicle.estimate import PoseMeasurement, StateMeasurement
from shoal.config.experiment import Experiment, load_experiment
from shoal.frames import wrap
from shoal.messages.messages import Plan, Solve, required
from sim_bridge.plant.fleet import Plant
from tests.robot_agent.control.drawn_inputs import (
    ARTICLE as POOL,
)
from tests.robot_agent.control.drawn_inputs import (
    GOAL,
    STEP_NS,
    VEHICLE,
    at,
    check,
    goals,
    measurements,
    neighbours,
    pool_circle,
)
from tests.shoal.strategies import same

pytestmark = pytest.mark.long


def controller(*settings_: str) -> LawController:
    experiment = load_experiment("pool", ["controller.law=eso-mpc-article", *settings_]) if settings_ else POOL
    return LawController(Setting(VEHICLE, experiment.controller, experiment.safety))


class Pool:
    """The pool scene with the sensors' noise and delay but without cameras, boards and buses."""

    def __init__(self, experiment: Experiment, seed: int) -> None:
        self.paths = [pool_circle(robot.node_m[0]) for robot in experiment.robots]
        self.plant, self.random = Plant(experiment, seed), np.random.default_rng(seed)
        offsets = np.array([robot.start_offset for robot in experiment.robots])
        self.state = self.plant.start(np.array([p.eta[0] for p in self.paths]) + offsets)
        self.past = [self.state.eta]
        self.controllers = [LawController(Setting(VEHICLE, experiment.controller, experiment.safety)) for _ in self.paths]
        self.plans: list[Plan | None] = [None] * len(self.paths)
        self.k = 0

    def measure(self, i: int) -> StateMeasurement:
        back = min(int(self.random.integers(6, 11)), len(self.past) - 1)  # 30 to 50 ms in steps of 5
        noise = self.random.normal(size=5) * [0.0015, 0.0015, 0.009, 0.002, 0.003]
        x, y, _, yaw = self.past[-1 - back][i]
        sighting = PoseMeasurement(self.k * STEP_NS - back * 5_000_000, x + noise[0], y + noise[1], wrap(yaw + noise[2]))
        return StateMeasurement(sighting, self.state.eta[i, 2] + noise[3], self.state.nu[i, 3] + noise[4])

    def step(self, goals: list[Goal]) -> list[ControlOutput]:
        outputs = []
        for i, goal in enumerate(goals):
            others = [
                Neighbour(j, (self.k - 1) * STEP_NS, plan, True, hears_us=True)
                for j, plan in enumerate(self.plans)
                if j != i and plan is not None
            ]
            outputs.append(self.controllers[i].step(self.measure(i), goal, others, self.k * STEP_NS))
            check(outputs[-1])
        self.plans = [Plan(0.05, o.plan_eta, o.plan_reference, o.tracking_error_m, False) for o in outputs]
        pulses = np.array([o.pulse_us for o in outputs], dtype=np.float64)
        for _ in range(10):
            self.state = self.plant.step(self.state, pulses)
            self.past.append(self.state.eta)
        self.k += 1
        return outputs


def fly(pool: Pool, seconds: float) -> tuple[np.ndarray, np.ndarray, list[ControlOutput]]:
    """Position errors (steps, robots, 3) and wrench steps (steps, robots, 3) along the circle."""
    errors, changes, last = [], [], []
    for k in range(round(seconds / 0.05)):
        errors.append([pool.state.eta[i, :3] - path.eta[k, :3] for i, path in enumerate(pool.paths)])
        last = pool.step([Follow(path, k * 0.05) for path in pool.paths])
        changes.append([required(o.control).wrench_step for o in last])
    return np.array(errors), np.array(changes), last


def test_the_articles_controller_drifts_off_the_same_circle() -> None:
    """Without sway, heading guidance and lag compensation: what the rest of this package is for."""
    errors, _, _ = fly(Pool(POOL, 4), 32.0)
    assert np.abs(errors[400:, :, :2]).max() > 0.08


def test_two_runs_are_the_same_bit_for_bit() -> None:
    runs = []
    for _ in range(2):
        pool = Pool(POOL, 7)
        runs.append([[o.pulse_us for o in pool.step([Follow(p, k * 0.05) for p in pool.paths])] for k in range(60)])
    assert runs[0] == runs[1]


# --- one controller, no plant


def test_without_a_pose_there_is_no_thrust() -> None:
    output = controller().step(StateMeasurement(), GOAL, (), STEP_NS)
    check(output)
    assert output.solve is Solve.NONE and output.estimate is None and output.control is None


def test_without_a_goal_there_is_no_thrust_but_an_estimate() -> None:
    one = controller()
    for k in range(1, 10):
        output = one.step(at(k), None, (), k * STEP_NS)
    check(output)
    assert output.control is None and required(output.estimate).eta[0] == pytest.approx(0.625)
    assert np.array_equal(output.plan_eta[-1], required(output.estimate).eta)


def test_poses_that_stop_are_bridged_then_thrust_ends() -> None:
    one, outputs = controller(), []
    for k in range(1, 60):
        outputs.append(one.step(at(min(k, 20)), GOAL, (), k * STEP_NS))
        check(outputs[-1])
    assert outputs[22].solve is Solve.SOLVED and outputs[-1].solve is Solve.NONE and outputs[-1].estimate is None


def test_plan_starts_at_the_estimate_and_now() -> None:
    one = controller()
    for k in range(1, 40):
        output = one.step(at(k), GOAL, (), k * STEP_NS)
    assert output.plan_eta.shape == (26, 4) == output.plan_reference.shape
    assert output.plan_eta[0] == pytest.approx(required(output.estimate).eta)
    assert np.abs(np.diff(output.plan_eta[:, :3], axis=0)).max() < 0.03


def test_whole_turns_between_path_and_camera_do_not_count() -> None:
    """The path's yaw may be whole turns away from the camera's: nobody unwinds them."""
    far = dataclasses.replace(GOAL.trajectory, eta=GOAL.trajectory.eta + np.array([0, 0, 0, 6 * math.pi]))
    one = controller()
    for k in range(1, 30):
        output = one.step(at(k), Follow(far, 0.0), (), k * STEP_NS)
    assert abs(required(output.control).eta_command[3] - required(output.estimate).eta[3]) < 0.6


@pytest.mark.parametrize("count", [1, 20])
def test_neighbours_are_told_the_path_without_the_formations_pull(count: int) -> None:
    """Neighbours measure deviations from the path that is told: with the pull in it, a deviation that all share would look
    smaller the more they are."""
    eta = np.tile([9.0, 9.0, 0.3, 0.0], (51, 1))
    off = eta - np.array([0.1, -0.2, 0.05, 0.4])
    others = [Neighbour(j, 10 * STEP_NS, Plan(0.05, eta, off), True) for j in range(2, 2 + count)]
    together, alone = controller(), controller()
    for k in range(1, 11):
        pulled, free = (c.step(at(k), GOAL, near, k * STEP_NS) for c, near in ((together, others), (alone, ())))
    share = 0.15 * count / (1.0 + 0.15 * count)
    assert required(pulled.control).eta_command[:3] - required(free.control).eta_command[:3] == pytest.approx(
        share * np.array([0.1, -0.2, 0.05])
    )
    assert pulled.plan_reference[:, :3] == pytest.approx(free.plan_reference[:, :3])


def test_a_neighbours_heading_error_is_shared() -> None:
    eta, headings = np.tile([9.0, 9.0, 0.3, 0.0], (51, 1)), []
    for turned in (0.0, 0.4):
        one, off = controller(), eta - np.array([0.0, 0.0, 0.0, turned])
        for k in range(1, 3):
            output = one.step(at(k), GOAL, [Neighbour(2, k * STEP_NS, Plan(0.05, eta, off), True)], k * STEP_NS)
        headings.append(required(output.control).eta_command[3])
    assert headings[1] - headings[0] == pytest.approx(0.4 * 0.15 / 1.15, abs=1e-3)


@pytest.mark.parametrize("turned", [0.48, 0.52])
def test_a_robot_that_starts_facing_away_turns_the_shorter_way(turned: float) -> None:
    one, path_yaw = controller(), float(GOAL.trajectory.eta[0, 3])
    for k in range(1, 12):
        output = one.step(at(k, yaw=path_yaw + 2.0 * math.pi * turned), GOAL, (), k * STEP_NS)
        assert abs(required(output.control).eta_command[3] - required(output.estimate).eta[3]) < math.pi + 0.05


def test_arrays_handed_out_are_never_written_again() -> None:
    one = controller()
    outputs, copies = [], []
    for k in range(1, 15):
        output = one.step(at(k, 0.6 + 0.002 * k), GOAL, (), k * STEP_NS)
        outputs.append(output)
        copies.append(deepcopy(output))
    for output, copy in zip(outputs, copies, strict=True):
        assert np.array_equal(output.plan_eta, copy.plan_eta) and np.array_equal(output.plan_reference, copy.plan_reference)
        assert same(output.estimate, copy.estimate) and same(output.control, copy.control)


def test_gains_are_adopted_beside_another_robot_too() -> None:
    """The plan has a slack then. With the gains that it had, it flies as one that adopts none."""
    config = load_experiment("pool", ["controller.law=eso-mpc-article"]).controller
    near = np.tile([1.1, 0.0, 0.3, 0.0], (51, 1))
    flown = []
    for adopts in (False, True):
        one = LawController(Setting(POOL.vehicle, config, POOL.safety))
        for k in range(1, 12):
            if adopts and k == 11:
                one.adopt_gains(config)
            output = one.step(at(k), GOAL, [Neighbour(2, k * STEP_NS, Plan(0.05, near, near), True)], k * STEP_NS)
            check(output)
        assert output.solve is Solve.SOLVED and required(output.control).slack_m > 0.05
        flown.append(output)
    assert np.array_equal(required(flown[1].control).wrench, required(flown[0].control).wrench)
    assert np.array_equal(flown[1].plan_eta, flown[0].plan_eta)


@settings(max_examples=60, deadline=None)
@given(st.lists(st.tuples(measurements, goals, neighbours, st.integers(0, 3)), min_size=1, max_size=15))
def test_no_input_makes_it_put_out_nonsense(rows: list[tuple[StateMeasurement, Goal | None, list[Neighbour], int]]) -> None:
    """NaN, gaps, duplicates, reordering, plans of other sizes: finite, within limits, neutral when not solved."""
    one, k = controller(), 0
    for measurement, goal, others, gap in rows:
        k += gap
        check(one.step(measurement, goal, others, k * STEP_NS))
        check(one.step(at(k), goal, others, k * STEP_NS + 1))


def test_ten_thousand_random_steps_stay_within_limits() -> None:
    """A robot whose pose wanders as no robot's would, at the edge of what the gates let through."""
    random, one, pose = np.random.default_rng(5), controller(), np.array([0.625, 0.0, 1.5])
    path = GOAL.trajectory
    solved = 0
    for k in range(1, 10_001):
        pose = pose + random.normal(size=3) * [0.02, 0.02, 0.05] * (random.random() < 0.3)
        pose[:2] = np.clip(pose[:2], -1.5, 1.5)
        lost, late_ns = random.random() < 0.1, int(random.integers(2, 6)) * 10_000_000
        sighting = None if lost else PoseMeasurement(k * STEP_NS - late_ns, pose[0], pose[1], wrap(pose[2]))
        measurement = StateMeasurement(sighting, 0.3 + 0.01 * random.normal(), 0.1 * random.normal())
        output = one.step(measurement, Follow(path, 0.05 * k), (), k * STEP_NS)
        check(output)
        solved += output.solve is Solve.SOLVED
    assert solved > 9_900
