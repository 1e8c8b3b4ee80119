"""The article's optimisation: within limits, clear of half-spaces, and what happens when it fails."""

import numpy as np
import pytest

from robot_agent.control import mpc as mpc_module
from robot_agent.control.mpc import Mpc, bridged_steps
from robot_agent.guidance.formation import NOWHERE, HalfSpaces
from robot_agent.vehicle.dynamics import Model, State
from shoal.config.controller import MpcConfig
from shoal.config.vehicle import load_vehicle
from shoal.frames import Array
from shoal.messages.messages import Solve

VEHICLE = load_vehicle("spherical")
PERIOD_S, ROWS = 0.05, 20
BRIDGED = bridged_steps(PERIOD_S)
LIMIT, STEP = np.array(VEHICLE.limits.wrench), np.array(VEHICLE.limits.wrench_step(0.05))
WEIGHT = np.ones(4)
START: State = (0.0,) * 11
MODEL = Model(VEHICLE, sway=False, lag=False)


def mpc(**changes: object) -> Mpc:
    return Mpc(VEHICLE, MODEL, MpcConfig().model_copy(update=changes), PERIOD_S, ROWS)


def ahead(x: float, speed: float = 0.0, z: float = 0.0, yaw: float = 0.0) -> Array:
    reference = np.zeros((51, 4))
    reference[:, 0], reference[:, 2], reference[:, 3] = x + speed * PERIOD_S * np.arange(51), z, yaw
    return reference


def test_limits_hold_from_any_state() -> None:
    random, controller, wrench = np.random.default_rng(0), mpc(), np.zeros(3)
    for _ in range(150):
        state: State = tuple(random.normal(size=11) * [1, 1, 0.3, 3, 0.3, 0.1, 0.1, 1, 3, 2, 0.2])
        reference = ahead(random.normal() * 3, random.normal() * 0.3, random.normal(), state[3] + random.normal())
        plan = controller.plan(state, random.normal(size=4) * 0.05, wrench, reference, WEIGHT, NOWHERE)
        assert np.all(np.abs(plan.wrench) <= LIMIT) and np.all(np.abs(plan.wrench - wrench) <= STEP + 1e-12)
        assert np.isfinite(plan.eta).all() and plan.eta.shape == (51, 4)
        wrench = plan.wrench


def test_the_articles_setting_is_there() -> None:
    controller = mpc(horizon=25, blocks=(1,) * 15, r=(0.01, 0.01, 0.01))
    plan = controller.plan(START, np.zeros(4), np.zeros(3), ahead(1.0)[:26], WEIGHT, NOWHERE)
    assert plan.solve is Solve.SOLVED and plan.wrench[0] == pytest.approx(STEP[0], abs=1e-3)


def wall(x: float) -> HalfSpaces:
    """Stay at x <= `x` at five nodes."""
    nodes = np.array([10, 20, 30, 40, 50])
    return HalfSpaces(nodes, np.full(5, -1.0 + 0.0j), np.full(5, -x))


def test_half_spaces_stop_it() -> None:
    """Driving at a wall with the reference beyond: it stops short of it, and says so if it cannot."""
    controller, model = mpc(), MODEL
    state: State = (0.0, 0.0, 0.0, 0.0, 0.2, *([0.0] * 6))
    wrench, furthest = np.zeros(3), 0.0
    for _ in range(160):
        plan = controller.plan(state, np.zeros(4), wrench, ahead(1.0), WEIGHT, wall(0.3))
        wrench = plan.wrench
        state = model.advance(state, (0.0,) * 4, tuple(wrench), PERIOD_S)
        furthest = max(furthest, state[0])
    assert furthest < 0.31 and state[0] > 0.27
    late = mpc().plan((0.5, *START[1:]), np.zeros(4), np.zeros(3), ahead(0.5), WEIGHT, wall(0.3))
    assert late.solve is Solve.SOLVED and 0.1 < late.slack_m < 0.25 and late.wrench[0] < -0.2


def refuse(patch: pytest.MonkeyPatch) -> None:
    """From now on no solver finds anything."""
    patch.setattr(mpc_module, "solve_from", lambda program, working: 0)
    patch.setattr(mpc_module, "solve_by_osqp", lambda program, working: 0)


def test_failures_are_bridged_by_the_last_plan_then_neutral(monkeypatch: pytest.MonkeyPatch) -> None:
    controller = mpc(blocks=(1,) * 6)
    wrench = controller.plan(START, np.zeros(4), np.zeros(3), ahead(0.5), WEIGHT, NOWHERE).wrench
    refuse(monkeypatch)
    outcomes = []
    for _ in range(BRIDGED + 2):
        plan = controller.plan(START, np.zeros(4), wrench, ahead(0.5), WEIGHT, NOWHERE)
        assert np.all(np.abs(plan.wrench - wrench) <= STEP + 1e-12) or plan.solve is Solve.FAILED
        wrench = plan.wrench
        outcomes.append(plan.solve)
    assert outcomes == [Solve.SHIFTED] * BRIDGED + [Solve.FAILED] * 2 and not wrench.any()
    monkeypatch.undo()
    assert controller.plan(START, np.zeros(4), wrench, ahead(0.5), WEIGHT, NOWHERE).solve is Solve.SOLVED


def test_the_bridge_is_the_rest_of_the_plan(monkeypatch: pytest.MonkeyPatch) -> None:
    """With one block per step, the next solve would have said nearly the same as the last plan's second step."""
    bridging, solving = mpc(blocks=(1,) * 10), mpc(blocks=(1,) * 10)
    first = bridging.plan(START, np.zeros(4), np.zeros(3), ahead(0.3), WEIGHT, NOWHERE).wrench
    solving.plan(START, np.zeros(4), np.zeros(3), ahead(0.3), WEIGHT, NOWHERE)
    state = MODEL.advance(START, (0.0,) * 4, tuple(first), PERIOD_S)
    solved = solving.plan(state, np.zeros(4), first, ahead(0.3), WEIGHT, NOWHERE)
    refuse(monkeypatch)
    bridged = bridging.plan(state, np.zeros(4), first, ahead(0.3), WEIGHT, NOWHERE)
    assert bridged.solve is Solve.SHIFTED and bridged.wrench == pytest.approx(solved.wrench, abs=0.01)


def test_nothing_solved_yet_means_neutral(monkeypatch: pytest.MonkeyPatch) -> None:
    controller = mpc()
    refuse(monkeypatch)
    plans = [controller.plan(START, np.zeros(4), np.zeros(3), ahead(0.5), WEIGHT, NOWHERE) for _ in range(BRIDGED + 2)]
    assert [plan.solve for plan in plans] == [Solve.SHIFTED] * BRIDGED + [Solve.FAILED] * 2
    assert not any(plan.wrench.any() for plan in plans)


def test_nonsense_in_the_reference_is_a_failure_not_an_output() -> None:
    controller = mpc()
    reference = ahead(0.5)
    controller.plan(START, np.zeros(4), np.zeros(3), reference, WEIGHT, NOWHERE)
    reference[7, 1] = np.nan
    assert controller.plan(START, np.zeros(4), np.zeros(3), reference, WEIGHT, NOWHERE).solve is Solve.SHIFTED
    assert controller.plan(START, np.zeros(4), np.zeros(3), ahead(0.5), WEIGHT, NOWHERE).solve is Solve.SOLVED


def test_weights_of_zero_stay_solvable() -> None:
    controller = mpc(q=(1.0, 1.0, 0.0, 0.0), r=(0.0, 0.0, 0.0))
    plan = controller.plan(START, np.zeros(4), np.zeros(3), ahead(0.1), np.array([1.0, 1.0, 0.0, 0.0]), NOWHERE)
    assert plan.solve is Solve.SOLVED and np.isfinite(plan.wrench).all()


@pytest.mark.parametrize("period_s", [0.025, 0.05, 0.1])
def test_the_wrench_grows_as_fast_per_second_at_every_control_period(period_s: float) -> None:
    controller, wrench = Mpc(VEHICLE, MODEL, MpcConfig(), period_s, ROWS), np.zeros(3)
    for _ in range(round(0.4 / period_s)):
        wrench = controller.plan(START, np.zeros(4), wrench, ahead(50.0, z=50.0), WEIGHT, NOWHERE).wrench
    assert wrench[:2] == pytest.approx([0.4 * 6.0, 0.4 * 6.0], rel=1e-3)


def test_prediction_does_not_expect_thrust_that_could_not_be_given() -> None:
    """2 N were asked for and 1 N came: the plan goes on from 1 N, the limits of what is asked from 2 N."""
    demand, delivered = np.array([2.0, 0.0, 0.0]), np.array([1.0, 0.0, 0.0])
    controller = mpc(blocks=(10, 10))
    start: State = (*START[:8], 1.0, 0.0, 0.0)
    plan = controller.plan(start, np.zeros(4), demand, ahead(0.5), WEIGHT, NOWHERE, 0j, delivered)
    assert abs(plan.wrench[0] - demand[0]) <= STEP[0] + 1e-12
    state = start
    for _ in range(10):
        state = MODEL.advance(state, (0.0,) * 4, tuple(delivered + plan.wrench - demand), PERIOD_S)
    assert plan.eta[10, 0] == pytest.approx(state[0], abs=2e-3)


def test_a_plan_is_bridged_as_long_at_every_control_period() -> None:
    assert [bridged_steps(period_s) for period_s in (0.025, 0.05, 0.075, 0.1, 0.2)] == [6, 3, 2, 1, 0]


def test_the_plan_hardly_depends_on_the_control_period() -> None:
    """`r` is scaled with the period; unscaled it would weigh half as much against errors at 0.025 s."""
    poses = {}
    for period_s in (0.025, 0.05):
        nodes = round(2.5 / period_s)
        config = MpcConfig(
            horizon=nodes, blocks=tuple(round(seconds / period_s) for seconds in (0.25, 0.5, 0.75)), r=(3.0, 3.0, 3.0)
        )
        controller = Mpc(VEHICLE, MODEL, config, period_s, ROWS)
        reference = np.zeros((nodes + 1, 4))
        reference[:, 0] = 0.1
        plan = controller.plan(START, np.zeros(4), np.zeros(3), reference, WEIGHT, NOWHERE)
        poses[period_s] = plan.eta[:: round(0.25 / period_s), 0]
    assert poses[0.05][-1] > 0.02
    assert poses[0.025] == pytest.approx(poses[0.05], rel=0.03, abs=5e-4)


def test_other_weights_count_from_the_next_step_on() -> None:
    """A controller whose gains are changed plans as one that had them from the beginning."""
    tuned, made = mpc(), mpc(r=(5.0, 5.0, 5.0))
    before = tuned.plan(START, np.zeros(4), np.zeros(3), ahead(0.01), WEIGHT, NOWHERE)
    tuned.tune(MpcConfig(r=(5.0, 5.0, 5.0)))
    after, expected = (c.plan(START, np.zeros(4), np.zeros(3), ahead(0.01), WEIGHT, NOWHERE) for c in (tuned, made))
    assert after.wrench == pytest.approx(expected.wrench, abs=1e-9) and after.wrench[0] < 0.5 * before.wrench[0]
