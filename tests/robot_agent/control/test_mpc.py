"""The controller's optimisation: optimal against an independent solver, within limits, and what happens when it fails."""

import numpy as np
import pytest
from scipy.optimize import Bounds, LinearConstraint, minimize

from robot_agent.control.mpc import Mpc, bridged_steps
from robot_agent.control.qp import Solution
from robot_agent.guidance.formation import NOWHERE, Formation, HalfSpaces, Neighbour, Priority
from robot_agent.vehicle.dynamics import Model, State
from shoal.config.controller import MpcConfig, Safety
from shoal.config.vehicle import load_vehicle
from shoal.frames import Array
from shoal.messages.messages import Plan, Solve

VEHICLE = load_vehicle("spherical")
PERIOD_S, ROWS = 0.05, 20
BRIDGED = bridged_steps(PERIOD_S)
LIMIT, STEP = np.array(VEHICLE.limits.wrench), np.array(VEHICLE.limits.wrench_step(0.05))
WEIGHT = np.ones(4)
START: State = (0.0,) * 11


def mpc(**changes: object) -> Mpc:
    return Mpc(VEHICLE, Model(VEHICLE), MpcConfig().model_copy(update=changes), PERIOD_S, ROWS)


def ahead(x: float, speed: float = 0.0, z: float = 0.0, yaw: float = 0.0) -> Array:
    reference = np.zeros((51, 4))
    reference[:, 0], reference[:, 2], reference[:, 3] = x + speed * PERIOD_S * np.arange(51), z, yaw
    return reference


def rollout(state: State, plan: Array, blocks: tuple[int, ...]) -> Array:
    """Poses (50, 4) under blocked wrenches (blocks, 3), through the nonlinear model."""
    model, poses = Model(VEHICLE), []
    of = np.minimum(np.searchsorted(np.cumsum(blocks), np.arange(50), side="right"), len(blocks) - 1)
    for k in range(50):
        state = model.advance(state, (0.0,) * 4, tuple(plan[of[k]]), PERIOD_S)
        poses.append(state[:4])
    return np.array(poses)


def test_the_plan_minimises_the_nonlinear_cost() -> None:
    """A general optimiser on the nonlinear model, with the same cost and limits, finds nothing better (2 %)."""
    config, reference = MpcConfig(blocks=(2, 4, 8)), ahead(0.15, 0.05, 0.02, 0.3)
    controller = mpc(blocks=(2, 4, 8))
    r = np.array(config.r)

    def cost(flat: Array) -> float:
        plan = flat.reshape(3, 3)
        error = rollout(START, plan, config.blocks) - reference[1:]
        change = np.diff(np.vstack([np.zeros(3), plan]), axis=0)
        return float((error**2).sum() + (r * change**2).sum())

    step = np.kron(np.eye(3) - np.eye(3, k=-1), np.eye(3))
    best = minimize(
        cost,
        np.zeros(9),
        method="SLSQP",
        bounds=Bounds(-np.tile(LIMIT, 3), np.tile(LIMIT, 3)),
        constraints=[LinearConstraint(step, -np.tile(STEP, 3), np.tile(STEP, 3))],
        options={"maxiter": 200, "ftol": 1e-9},
    )
    first = None
    for _ in range(6):  # the same state again: linearised along its own plan, it converges
        # the public step shifts the plan; the optimum without a shift is seen only if that is undone
        for nominal in (controller._prediction.eta, controller._prediction.nu):
            nominal[1:] = nominal[:-1].copy()  # undo the shift
        first = controller.plan(START, np.zeros(4), np.zeros(3), reference, WEIGHT, NOWHERE)
    assert first is not None and first.solve is Solve.SOLVED
    assert first.wrench == pytest.approx(best.x[:3], abs=0.05 * float(STEP.max()))


@pytest.mark.parametrize("solver", ["osqp", "daqp"])
def test_limits_hold_from_any_state(solver: str) -> None:
    random, controller, wrench = np.random.default_rng(0), mpc(solver=solver), np.zeros(3)
    for _ in range(150):
        state: State = tuple(random.normal(size=11) * [1, 1, 0.3, 3, 0.3, 0.1, 0.1, 1, 3, 2, 0.2])
        reference = ahead(random.normal() * 3, random.normal() * 0.3, random.normal(), state[3] + random.normal())
        plan = controller.plan(state, random.normal(size=4) * 0.05, wrench, reference, WEIGHT, NOWHERE)
        assert np.all(np.abs(plan.wrench) <= LIMIT) and np.all(np.abs(plan.wrench - wrench) <= STEP + 1e-12)
        assert np.isfinite(plan.eta).all() and plan.eta.shape == (51, 4)
        wrench = plan.wrench


def test_both_backends_agree() -> None:
    random = np.random.default_rng(1)
    a, b, wrench = mpc(solver="osqp"), mpc(solver="daqp"), np.zeros(3)
    for k in range(40):
        state: State = tuple(random.normal(size=11) * [0.05, 0.05, 0.02, 0.1, 0.02, 0.01, 0.01, 0.1, 0.1, 0.1, 0.01])
        reference = ahead(0.02 * k, 0.1)
        plans = [c.plan(state, np.zeros(4), wrench, reference, WEIGHT, NOWHERE) for c in (a, b)]
        assert plans[0].wrench == pytest.approx(plans[1].wrench, abs=0.02 * float(STEP.max()))
        wrench = plans[1].wrench


def test_the_articles_setting_is_there() -> None:
    controller = mpc(horizon=25, blocks=(1,) * 15, linearise="point", r=(0.01, 0.01, 0.01), model_lag=False)
    plan = controller.plan(START, np.zeros(4), np.zeros(3), ahead(1.0)[:26], WEIGHT, NOWHERE)
    assert plan.solve is Solve.SOLVED and plan.wrench[0] == pytest.approx(STEP[0], abs=1e-3)


def wall(x: float) -> HalfSpaces:
    """Stay at x <= `x` at five nodes."""
    nodes = np.array([10, 20, 30, 40, 50])
    return HalfSpaces(nodes, np.full(5, -1.0 + 0.0j), np.full(5, -x))


def test_half_spaces_stop_it() -> None:
    """Driving at a wall with the reference beyond: it stops short of it, and says so if it cannot."""
    controller, model = mpc(), Model(VEHICLE)
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


class Refusing:
    """A solver that gives up when told to."""

    def __init__(self, controller: Mpc) -> None:
        # the controller makes its solver itself; the test makes it fail
        self._real, self.refuse = controller._plain_solver, False
        # the controller makes its solver itself; the test makes it fail
        controller._plain_solver = self

    def warm_start(self, x: Array, multipliers: Array) -> None:
        self._real.warm_start(x, multipliers)

    def solve(self, p: Array, q: Array, a: Array | None, lower: Array, upper: Array) -> Solution:
        return Solution(np.zeros(len(q)), False, 100) if self.refuse else self._real.solve(p, q, a, lower, upper)


def test_failures_are_bridged_by_the_last_plan_then_neutral() -> None:
    controller = mpc(blocks=(1,) * 6)
    solver = Refusing(controller)
    wrench = controller.plan(START, np.zeros(4), np.zeros(3), ahead(0.5), WEIGHT, NOWHERE).wrench
    solver.refuse, seen = True, []
    for _ in range(BRIDGED + 2):
        plan = controller.plan(START, np.zeros(4), wrench, ahead(0.5), WEIGHT, NOWHERE)
        assert np.all(np.abs(plan.wrench - wrench) <= STEP + 1e-12) or plan.solve is Solve.FAILED
        wrench = plan.wrench
        seen.append(plan.solve)
    assert seen == [Solve.SHIFTED] * BRIDGED + [Solve.FAILED] * 2 and not wrench.any()
    solver.refuse = False
    assert controller.plan(START, np.zeros(4), wrench, ahead(0.5), WEIGHT, NOWHERE).solve is Solve.SOLVED


def test_the_bridge_is_the_rest_of_the_plan() -> None:
    """With one block per step, the next solve would have said nearly the same as the last plan's second step."""
    bridging, solving = mpc(blocks=(1,) * 10), mpc(blocks=(1,) * 10)
    solver = Refusing(bridging)
    first = bridging.plan(START, np.zeros(4), np.zeros(3), ahead(0.3), WEIGHT, NOWHERE).wrench
    solving.plan(START, np.zeros(4), np.zeros(3), ahead(0.3), WEIGHT, NOWHERE)
    solver.refuse = True
    state = Model(VEHICLE).advance(START, (0.0,) * 4, tuple(first), PERIOD_S)
    bridged, solved = (c.plan(state, np.zeros(4), first, ahead(0.3), WEIGHT, NOWHERE) for c in (bridging, solving))
    assert bridged.solve is Solve.SHIFTED and bridged.wrench == pytest.approx(solved.wrench, abs=0.01)


def test_nothing_solved_yet_means_neutral() -> None:
    controller = mpc()
    Refusing(controller).refuse = True
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


def test_after_a_reset_it_expects_to_stay_where_it_is_now() -> None:
    """Not where it was when it last had a plan: half-spaces are laid across the line to a neighbour from there."""
    controller = mpc()
    controller.plan(START, np.zeros(4), np.zeros(3), ahead(0.5), WEIGHT, NOWHERE)
    controller.reset()
    elsewhere: State = (1.0, 2.0, 0.3, 0.5, *([0.0] * 7))
    expected = controller.predicted_path(elsewhere)
    assert np.array_equal(expected, np.tile([1.0, 2.0, 0.3, 0.5], (51, 1)))


@pytest.mark.parametrize("period_s", [0.025, 0.05, 0.1])
def test_the_wrench_grows_as_fast_per_second_at_every_control_period(period_s: float) -> None:
    controller, wrench = Mpc(VEHICLE, Model(VEHICLE), MpcConfig(), period_s, ROWS), np.zeros(3)
    for _ in range(round(0.4 / period_s)):
        wrench = controller.plan(START, np.zeros(4), wrench, ahead(50.0, z=50.0), WEIGHT, NOWHERE).wrench
    assert wrench[:2] == pytest.approx([0.4 * 6.0, 0.4 * 6.0], rel=1e-3)


def test_prediction_does_not_expect_thrust_that_could_not_be_given() -> None:
    """2 N were asked for and 1 N came: the plan goes on from 1 N, the limits of what is asked from 2 N."""
    asked, delivered = np.array([2.0, 0.0, 0.0]), np.array([1.0, 0.0, 0.0])
    controller = mpc(blocks=(10, 10))
    start: State = (*START[:8], 1.0, 0.0, 0.0)
    plan = controller.plan(start, np.zeros(4), asked, ahead(0.5), WEIGHT, NOWHERE, 0j, delivered)
    assert abs(plan.wrench[0] - asked[0]) <= STEP[0] + 1e-12
    state = start
    for _ in range(10):
        state = Model(VEHICLE).advance(state, (0.0,) * 4, tuple(delivered + plan.wrench - asked), PERIOD_S)
    assert plan.eta[10, 0] == pytest.approx(state[0], abs=2e-3)


def test_a_plan_is_bridged_as_long_at_every_control_period() -> None:
    assert [bridged_steps(period_s) for period_s in (0.025, 0.05, 0.075, 0.1, 0.2)] == [6, 3, 2, 1, 0]


def test_a_neighbour_does_not_push_a_robot_into_a_wall() -> None:
    """The other comes nearer from behind, the wall is ahead, and there is not room for all that should be kept."""
    pushed = {}
    for walls in (None, (3.5, 2.5)):
        near = Formation(MpcConfig(), Safety(), PERIOD_S, 0.0, walls, VEHICLE.radius_m)
        controller, model, wrench, state = mpc(), Model(VEHICLE), np.zeros(3), (1.5, *START[1:])
        for k in range(60):
            eta = np.tile([0.95 + 0.0025 * k, 0.0, 0.0, 0.0], (51, 1))
            predictions = near.predict_neighbours([Neighbour(2, 0, Plan(PERIOD_S, eta, eta), True)], 0)
            lines = near.half_spaces(predictions, controller.predicted_path(state), Priority(False, 0.0), 0)
            wrench = controller.plan(state, np.zeros(4), wrench, ahead(1.5), WEIGHT, lines).wrench
            state = model.advance(state, (0.0,) * 4, tuple(wrench), PERIOD_S)
        pushed[walls] = state[0] + VEHICLE.radius_m - 1.75
    assert pushed[None] > -0.01 and pushed[3.5, 2.5] < -0.03  # m beyond the wall


def test_the_plan_hardly_depends_on_the_control_period() -> None:
    """`r` is scaled with the period; unscaled it would weigh half as much against errors at 0.025 s."""
    poses = {}
    for period_s in (0.025, 0.05):
        nodes = round(2.5 / period_s)
        config = MpcConfig(
            horizon=nodes, blocks=tuple(round(seconds / period_s) for seconds in (0.25, 0.5, 0.75)), r=(3.0, 3.0, 3.0)
        )
        controller = Mpc(VEHICLE, Model(VEHICLE), config, period_s, ROWS)
        reference = np.zeros((nodes + 1, 4))
        reference[:, 0] = 0.1
        plan = controller.plan(START, np.zeros(4), np.zeros(3), reference, WEIGHT, NOWHERE)
        poses[period_s] = plan.eta[:: round(0.25 / period_s), 0]
    assert poses[0.05][-1] > 0.02
    assert poses[0.025] == pytest.approx(poses[0.05], rel=0.03, abs=5e-4)
