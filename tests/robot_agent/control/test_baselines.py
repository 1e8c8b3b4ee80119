"""The laws that the MPC is compared with: each against its own theory, then all of them flown, fuzzed and limited."""

import math
from typing import get_args

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from robot_agent.control import law as laws
from robot_agent.control.baselines import lqr
from robot_agent.control.baselines.adaptive_nn import AdaptiveNn
from robot_agent.control.baselines.backstepping import Backstepping
from robot_agent.control.baselines.feedback import FeedbackLaw
from robot_agent.control.baselines.fuzzy import PEAKS, rule_output
from robot_agent.control.baselines.pid import Pid
from robot_agent.control.baselines.sliding_mode import SlidingMode
from robot_agent.control.baselines.tracking_errors import Axes, TrackingErrors, tracking_errors
from robot_agent.control.controller import ControlOutput, Setting
from robot_agent.control.law import Law, make_law
from robot_agent.control.law_controller import LawController
from robot_agent.guidance.formation import NOWHERE, Neighbour
from robot_agent.guidance.reference import Follow, Goal, Hold
from robot_agent.vehicle.dynamics import Model
from robot_agent.vehicle.estimate import PoseMeasurement, StateMeasurement
from shoal.config import baseline_controllers
from shoal.config.baseline_controllers import LawName
from shoal.config.experiment import load_experiment
from shoal.config.vehicle import Vehicle
from shoal.frames import Array, wrap
from shoal.messages.messages import Plan, Solve, required
from tests.robot_agent.control.drawn_inputs import GOAL, STEP_NS, at, check, goals, measurements, neighbours
from tests.robot_agent.water import integrate

pytestmark = pytest.mark.long

POOL = load_experiment("pool")
VEHICLE = POOL.vehicle
LIMIT, STEP = np.array(VEHICLE.limits.wrench), np.array(VEHICLE.limits.wrench_step(0.05))
MODEL = Model(VEHICLE, sway=False, lag=False)
AXES = Axes(MODEL, (6.0, 3.0, 0.5))
LAWS = [name for name in get_args(baseline_controllers.LawName) if name != "nmpc"]  # that has its own controller and tests
FEEDBACK = [name for name in LAWS if name != "eso-mpc-article"]
SPEED = np.array([0.2, 0.0, 0.03, 0.0])  # of the straight reference, heading along x
STILL = (0.0, 0.0, 0.0, 0.0)
DT = 0.001  # s, in place of continuous time


# --- a robot without sway or lag, with equations of its own, under a law in (nearly) continuous time


def straight(t: float) -> Array:
    return SPEED * t


def look(state: Array, t: float, disturbance: tuple[float, ...] = STILL) -> TrackingErrors:
    return tracking_errors(MODEL, tuple(state.tolist()), disturbance, straight(t).tolist(), SPEED.tolist(), [0.0] * 4)


def rate(state: Array, wrench: Array, disturbance: Array) -> Array:
    yaw, u, _, w, r = state[3:8]
    nu = np.array([u, 0.0, w, r])
    drag = (VEHICLE.drag_linear + VEHICLE.drag_quadratic * np.abs(nu)) * nu
    force = np.array([wrench[0], 0.0, wrench[1], wrench[2]])
    out = np.zeros(11)
    out[:4] = u * math.cos(yaw), u * math.sin(yaw), w, r
    out[4:8] = (force - drag) / VEHICLE.inertia + disturbance
    out[5] = 0.0
    return out


def flown(
    law: FeedbackLaw, state: Array, seconds: float, disturbance: tuple[float, ...] = STILL, dt: float = DT
) -> list[TrackingErrors]:
    """Inputs of the law, every `dt`. It is not told of the disturbance."""
    inputs = []
    for k in range(round(seconds / dt)):
        now = look(state, k * dt)
        inputs.append(now)
        wrench, unknown = np.array(law.wrench(now)), np.array(disturbance)
        law.learn(now, (0.0, 0.0, 0.0), dt)
        middle = state + dt / 2 * rate(state, wrench, unknown)
        state = state + dt * rate(middle, wrench, unknown)
    return inputs


def off(ahead: float = 0.0, below: float = 0.0, turned: float = 0.0) -> Array:
    """At the reference's speed, but not at its place."""
    return np.array([-ahead, 0.0, -below, -turned, SPEED[0], 0.0, SPEED[2], 0.0, 0.0, 0.0, 0.0])


def test_the_load_keeps_the_velocity() -> None:
    nu, unknown = (0.2, -0.05, 0.1, 0.3), (0.02, 0.0, -0.01, 0.1)
    model = Model(VEHICLE, sway=True, lag=False)
    load = tracking_errors(model, (0.0,) * 4 + nu + (0.0,) * 3, unknown, STILL, STILL, STILL).load
    after = integrate(
        VEHICLE, np.array((0.0,) * 4 + nu + (0.0,) * 3), lambda t: load, 1e-4, unknown, lag=False, steps_per_s=100_000
    )
    assert after[[4, 6, 7]] == pytest.approx(np.array(nu)[[0, 2, 3]], abs=1e-7)


@settings(max_examples=50)
@given(st.lists(st.floats(-1, 1), min_size=12, max_size=12))
def test_errors_move_as_the_situation_says(values: list[float]) -> None:
    """Against finite differences: e' = speed error + swing; and the speed error's own rate at constant velocity."""
    state, speed = np.array([*values[:4], values[4], 0.0, values[5], values[6], 0.0, 0.0, 0.0]), np.array(values[7:11])
    h, change = 1e-5, np.array([values[11], -values[11], 0.1, 0.2])

    def seen(t: float) -> TrackingErrors:
        there = state.copy()
        yaw, u, r = state[3], state[4], state[7]
        turn = yaw + r * t / 2  # a short arc
        there[:4] += [u * math.cos(turn) * t, u * math.sin(turn) * t, state[6] * t, r * t]
        goal = speed * t + change * t * t / 2
        return tracking_errors(
            MODEL, tuple(there.tolist()), STILL, goal.tolist(), (speed + change * t).tolist(), change.tolist()
        )

    before, now, after = seen(-h), seen(0.0), seen(h)
    moved = (np.array(after.error) - before.error) / (2 * h)
    assert moved == pytest.approx(np.add(now.speed_error, [now.swing_mps, 0.0, 0.0]), abs=1e-4)
    quickened = (np.array(after.speed_error) - before.speed_error) / (2 * h)
    assert quickened == pytest.approx(np.array(now.acceleration), abs=1e-4)


# --- each law against its own theory


def test_backstepping_s_lyapunov_function_falls_as_it_should() -> None:
    config = baseline_controllers.BacksteppingConfig(
        error_per_s=(0.5, 0.4, 1.0), velocity_per_s=(1.0, 0.8, 2.0), coupling_per_s2=(0.3, 0.5, 0.7)
    )
    k1, k2, c = (np.array(v) for v in (config.error_per_s, config.velocity_per_s, config.coupling_per_s2))
    inputs = flown(Backstepping(AXES, config), off(0.4, -0.3, 0.8), 6.0)
    z1 = np.array([s.error for s in inputs])
    z2 = np.array([s.speed_error for s in inputs]) + k1 * z1
    aside = np.array([s.swing_mps / s.velocity[2] if s.velocity[2] else 0.0 for s in inputs])
    value = 0.5 * (c * z1**2 + z2**2)
    value[:, 0] += 0.5 * c[0] * aside**2
    yaw = -z1[:, 2]
    across = -SPEED[0] * np.sin(yaw)  # W; v = 0 in this water
    fall = -c * k1 * z1**2 - k2 * z2**2
    fall[:, 0] += c[0] * aside * across
    np.testing.assert_allclose((value[2:] - value[:-2])[5:] / (2 * DT), fall[6:-1], rtol=3e-3, atol=3e-4)
    assert np.all(np.diff(value[:, 1:], axis=0) <= 1e-9)  # depth and heading: nothing disturbs the fall
    assert np.all(value[-1, 1:] < 0.02 * value[0, 1:])


def test_pid_integrates_a_constant_disturbance_out() -> None:
    push = (0.05, 0.0, -0.03, 0.4)
    gains = baseline_controllers.PidConfig(p=(20.0, 20.0, 0.8), i=(4.0, 4.0, 0.3), d=(30.0, 30.0, 0.4))
    with_i = flown(Pid(AXES, gains), off(), 40.0, push, 0.005)[-1]
    assert np.abs(with_i.error).max() < 1e-4
    proportional = gains.model_copy(update={"i": (0.0, 0.0, 0.0)})
    without = flown(Pid(AXES, proportional), off(), 40.0, push, 0.005)[-1]
    moving = np.array([SPEED[0], SPEED[2], 0.0])
    linear, quadratic = VEHICLE.drag_linear[[0, 2, 3]], VEHICLE.drag_quadratic[[0, 2, 3]]
    missing = (linear + quadratic * moving) * moving - np.array(AXES.mass) * np.array(push)[[0, 2, 3]]
    np.testing.assert_allclose(without.error, missing / gains.p, rtol=0.01)  # what p alone must leave


def test_pid_does_not_wind_up_beyond_a_limit() -> None:
    law = Pid(AXES, baseline_controllers.PidConfig(p=(1.0, 1.0, 1.0), i=(1.0, 1.0, 1.0), d=(0.0, 0.0, 0.0)))
    far = look(off(ahead=5.0), 0.0)
    for _ in range(100):
        law.learn(far, (1.0, 0.0, 0.0), 0.05)  # wanted more than it got
    assert law.wrench(far)[0] == pytest.approx(5.0)
    for _ in range(1000):
        law.learn(far, (0.0, 0.0, 0.0), 0.05)
    assert law.wrench(far)[0] == pytest.approx(5.0 + LIMIT[0])
    law.reset()
    assert law.wrench(far)[0] == pytest.approx(5.0)


@pytest.mark.parametrize("lag_s", [0.0, 0.1])
def test_lqr_gains_are_the_limit_of_the_riccati_recursion(lag_s: float) -> None:
    weights, effort = np.array([4.0, 1.5]), 1.0 / 36.0
    a, b = lqr.plant(12.0, lag_s, 0.05)
    q = np.zeros_like(a)
    q[[0, 1], [0, 1]] = weights
    value = q.copy()
    for _ in range(5000):
        k = np.linalg.solve(effort + b.T @ value @ b, b.T @ value @ a)
        value = q + a.T @ value @ a - a.T @ value @ b @ k
    np.testing.assert_allclose(lqr.gain(12.0, lag_s, 0.05, weights, effort), k[0], rtol=1e-8)


def test_lqr_s_plant_is_a_mass_behind_a_lag() -> None:
    a, b = lqr.plant(12.0, 0.1, 0.05)
    x = np.array([0.3, -0.1, 0.5])
    fine = x.copy()
    for _ in range(20_000):
        h, (_, fast, f) = 0.05 / 20_000, fine
        fine = fine + h * np.array([fast, -f / 12.0, (2.0 - f) / 0.1])
    np.testing.assert_allclose(a @ x + b[:, 0] * 2.0, fine, atol=1e-5)


def test_sliding_mode_reaches_its_surface_in_time_and_stays() -> None:
    config = baseline_controllers.SlidingModeConfig(
        slope_per_s=(0.5, 0.5, 1.0), reach=(0.2, 0.15, 1.0), layer=(0.02, 0.02, 0.05)
    )
    push = (0.08, 0.0, -0.05, 0.4)  # each less than its reach
    law = SlidingMode(AXES, config)
    inputs = flown(law, off(0.6, -0.5, 0.9), 8.0, push)
    slope, reach, layer = (np.array(v) for v in (config.slope_per_s, config.reach, config.layer))
    surface = np.array([s.speed_error for s in inputs]) + slope * np.array([s.error for s in inputs])
    unknown = np.abs(np.array(push)[[0, 2, 3]])
    latest = np.abs(surface[0]) / (reach - unknown)
    for axis in range(1, 3):  # in surge the swing disturbs as well
        inside = np.abs(surface[round(latest[axis] / DT) + 1 :, axis])
        assert np.all(inside <= layer[axis])
        assert inside[-1] == pytest.approx(layer[axis] * unknown[axis] / reach[axis], rel=0.02)  # where sat balances the push
        assert np.all(
            np.abs(surface[: round(0.5 * np.abs(surface[0, axis]) / (reach + unknown)[axis] / DT), axis]) > layer[axis]
        )
    assert np.abs(surface[-1000:, 0]).max() <= layer[0]


def test_fuzzy_outputs_follow_the_rules() -> None:
    for row, error in enumerate(PEAKS):
        for column, speed in enumerate(PEAKS):
            share = rule_output(error, speed)
            assert share == PEAKS[min(max(row + column - 2, 0), 4)]
            assert rule_output(-error, -speed) == -share
    grid = np.linspace(-1.5, 1.5, 61)
    table = np.array([[rule_output(e, v) for v in grid] for e in grid])
    assert np.all(np.diff(table, axis=0) >= -1e-12) and np.all(np.diff(table, axis=1) >= -1e-12)
    assert np.abs(table).max() == 1.0 and np.abs(np.diff(table, axis=0)).max() < 0.1  # no jumps


def test_the_network_learns_what_the_model_would_have_known() -> None:
    config = baseline_controllers.AdaptiveNnConfig(
        slope_per_s=(0.6, 0.6, 1.0), gain=(20.0, 20.0, 0.5), learning=(15.0, 15.0, 0.5)
    )
    law = AdaptiveNn(AXES, config, (0.48, 0.26, 1.9))
    inputs = flown(law, off(0.3, 0.2, 0.4), 80.0, (0.05, 0.0, -0.03, 0.3), 0.02)
    last = inputs[-1]
    assert np.abs(last.error).max() < 0.003
    missing = np.array(last.load) - np.array(AXES.mass) * [0.05, -0.03, 0.3]
    np.testing.assert_allclose(law.wrench(last), missing, atol=0.05)
    law.reset()
    assert np.abs(law.wrench(last)).max() < 0.1  # knows nothing again


# --- all of them


def settled(name: str, vehicle: Vehicle, model: Model, plan_of: Law, state: Array, lag: bool) -> Array:
    """The state (11,) after 40 s along the straight, in steps of the controller's."""
    wrench = np.zeros(3)
    for k in range(800):
        reference = np.array([straight(0.05 * (k + s)) for s in range(51)])
        plan = plan_of.plan(tuple(state.tolist()), np.zeros(4), wrench, reference, np.ones(4), NOWHERE)
        assert plan.solve is Solve.SOLVED, name
        wrench = plan.wrench
        state = integrate(vehicle, state, lambda t, w=wrench: w, 0.05, lag=lag, steps_per_s=100)  # type: ignore[misc]
    return state


@pytest.mark.parametrize("name", LAWS)
def test_every_law_finds_back_to_a_straight_line(name: str) -> None:
    config = POOL.controller.model_copy(update={"law": name})
    model = MODEL if name == "eso-mpc-article" else Model(VEHICLE)
    law = make_law(VEHICLE, model, config, 0.05, 20)
    error = settled(name, VEHICLE, model, law, off(0.3, 0.2, 0.5), True)[:4] - straight(40.0)
    near = 0.06 if name == "adaptive-nn" else 0.01  # its tuned network takes minutes to learn what drag takes
    assert abs(error[0]) < near and abs(error[2]) < near and abs(error[3]) < near


@pytest.mark.parametrize("name", FEEDBACK)
def test_water_that_streams_is_another_frame_and_nothing_else(name: str) -> None:
    """The same velocities through the water, seen from the floor: the same wrench, and a plan that drifts with the water."""
    current, config = 0.05 - 0.03j, POOL.controller.model_copy(update={"law": name})
    drift = 0.05 * np.arange(51)[:, None] * [current.real, current.imag, 0.0, 0.0]
    reference, state = np.array([straight(0.05 * s) for s in range(51)]), tuple(off(0.1, 0.1, 0.2).tolist())
    still, streaming = (
        make_law(VEHICLE, Model(VEHICLE), config, 0.05, 20).plan(
            state, np.zeros(4), np.zeros(3), aim, np.ones(4), NOWHERE, water
        )
        for aim, water in ((reference, 0j), (reference + drift, current))
    )
    np.testing.assert_allclose(streaming.wrench, still.wrench, atol=1e-9)
    np.testing.assert_allclose(streaming.eta, still.eta + drift, atol=1e-6)


def controller(name: str) -> LawController:
    return LawController(Setting(VEHICLE, POOL.controller.model_copy(update={"law": name}), POOL.safety))


@pytest.mark.parametrize("name", FEEDBACK)
@settings(max_examples=25, deadline=None)
@given(rows=st.lists(st.tuples(measurements, goals, neighbours, st.integers(0, 3)), min_size=1, max_size=10))
def test_no_input_makes_a_law_put_out_nonsense(
    name: str, rows: list[tuple[StateMeasurement, Goal | None, list[Neighbour], int]]
) -> None:
    """NaN, gaps, duplicates, reordering, plans of other sizes: finite, within limits, neutral when there is no goal."""
    one, k = controller(name), 0
    for measurement, goal, others, gap in rows:
        k += gap
        check(one.step(measurement, goal, others, k * STEP_NS))
        check(one.step(at(k), goal, others, k * STEP_NS + 1))


@pytest.mark.parametrize("value", [math.nan, math.inf, 1e308])
@pytest.mark.parametrize("name", FEEDBACK)
def test_a_law_whose_numbers_burst_puts_out_nothing_and_recovers(name: str, value: float) -> None:
    law = make_law(VEHICLE, MODEL, POOL.controller.model_copy(update={"law": name}), 0.05, 20)
    sane = np.tile([1.0, 0.0, 0.0, 0.0], (51, 1))
    first = law.plan((0.0,) * 11, np.zeros(4), np.zeros(3), sane, np.ones(4), NOWHERE)
    burst = law.plan((0.0,) * 11, np.zeros(4), first.wrench, np.full((51, 4), value), np.ones(4), NOWHERE)
    assert burst.solve is Solve.FAILED and not burst.wrench.any() and np.isfinite(burst.eta).all()
    again = law.plan((0.0,) * 11, np.zeros(4), np.zeros(3), sane, np.ones(4), NOWHERE)
    np.testing.assert_array_equal(again.wrench, first.wrench)  # its memory is not spoilt


class Wanderer:
    """A robot whose pose wanders as no robot's would, in changing company, with changing goals."""

    def __init__(self, name: str, seed: int) -> None:
        self.one, self.random = controller(name), np.random.default_rng(seed)
        self.pose, self.k = np.array([0.625, 0.0, 1.5]), 0
        self.goal: Goal | None = GOAL

    def step(self) -> ControlOutput:
        random = self.random
        self.k += 1
        now_ns = self.k * STEP_NS
        self.pose += random.normal(size=3) * [0.02, 0.02, 0.05] * (random.random() < 0.3)
        self.pose[:2] = np.clip(self.pose[:2], -1.5, 1.5)
        if random.random() < 0.005:
            hold = Hold(np.array([*random.uniform(-1.0, 1.0, 2), 0.3, random.uniform(-3.0, 3.0)]))
            self.goal = (hold, None, GOAL, GOAL)[int(random.integers(4))]
        goal = Follow(self.goal.trajectory, 0.05 * self.k) if isinstance(self.goal, Follow) else self.goal
        late_ns = int(random.integers(2, 6)) * 10_000_000
        sighting = PoseMeasurement(now_ns - late_ns, self.pose[0], self.pose[1], wrap(self.pose[2]))
        measurement = StateMeasurement(
            None if random.random() < 0.1 else sighting, 0.3 + 0.01 * random.normal(), 0.1 * random.normal()
        )
        return self.one.step(measurement, goal, self.company(now_ns), now_ns)

    def company(self, now_ns: int) -> list[Neighbour]:
        random = self.random
        if random.random() < 0.5:
            return []
        start = np.array([*(self.pose[:2] + random.normal(size=2)), 0.3, 0.0])
        eta = start + np.arange(51)[:, None] * random.normal(size=4) * 0.01
        plan = Plan(0.05, eta, eta + random.normal(size=4) * 0.1, abs(random.normal()), False)
        return [Neighbour(2, now_ns - STEP_NS, plan, random.random() < 0.8)]


STEEPEST_N_PER_US = float(
    np.max(np.diff(VEHICLE.thruster.curve, axis=0)[:, 1] / np.diff(VEHICLE.thruster.curve, axis=0)[:, 0])
)
ROUNDED_N = 4 * 0.5 * STEEPEST_N_PER_US  # four thrusters, each half a microsecond off
ROUNDED = np.array([ROUNDED_N, ROUNDED_N + 12.0 * 0.5 * math.pi / 1000.0, ROUNDED_N * 0.0833])  # ankles are rounded as well


def wander(name: str, steps: int) -> float:
    """Share of steps in which the law wanted more than it may. What is applied keeps the limits: what is asked of the
    thrusters exactly; what the pulses give by their own curve, to whole microseconds. Only heave may change faster, where it
    gives way to surge and yaw because thrusters have no more."""
    robot, beyond = Wanderer(name, 11), 0
    before: ControlOutput | None = None
    for _ in range(steps):
        output = robot.step()
        check(output)
        if output.control is None:  # the thrusters stand still
            before = None
            continue
        assert np.all(np.abs(required(output.control).wrench_delivered) <= LIMIT + ROUNDED)
        beyond += bool(np.any(np.abs(required(output.control).wrench_wanted) > LIMIT + 1e-9))
        if before is not None and output.solve is before.solve is Solve.SOLVED:
            change = np.abs(required(output.control).wrench_delivered - required(before.control).wrench_delivered)
            short = max(abs(required(o.control).wrench[1] - required(o.control).wrench_delivered[1]) for o in (before, output))
            kept = change <= STEP + 2.0 * ROUNDED
            assert kept[0] and kept[2] and (kept[1] or short > ROUNDED[1])
        before = output
    return beyond / steps


@pytest.mark.parametrize("name", LAWS)
def test_random_steps_stay_within_limits(name: str) -> None:
    beyond = wander(name, 600)
    assert beyond == 0.0 if name == "eso-mpc-article" else beyond > 0.2  # else nothing was to be limited


@pytest.mark.slow
@pytest.mark.parametrize("name", LAWS)
def test_a_hundred_thousand_random_steps_stay_within_limits(name: str) -> None:
    wander(name, 100_000 // len(LAWS) + 1)


def test_every_name_that_the_file_allows_has_a_law() -> None:
    assert {*laws.LAWS, "nmpc", "eso-mpc-article"} == {*get_args(LawName)}
