"""The observer against the truth it cannot see: convergence, delay, gaps, wrong order, nonsense."""

import dataclasses
import math
from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from robot_agent.vehicle.dynamics import Model
from robot_agent.vehicle.eso import (
    COAST_NS,
    EsoSettings,
    Estimator,
    Samples,
    correct,
    gains,
    gains_with_rate,
    sensed_at,
)
from robot_agent.vehicle.estimate import Observation, PoseMeasurement, StateMeasurement
from shoal.config.controller import EstimatorConfig
from shoal.config.vehicle import load_vehicle
from shoal.frames import Array, wrap
from tests.robot_agent.water import integrate

pytestmark = pytest.mark.long

VEHICLE = load_vehicle("spherical")
STEP_NS, DEAD_S = 50_000_000, VEHICLE.thruster.dead_time_s
STEP_S = STEP_NS / 1e9
YAW_RAD = 0.7
Wrench = tuple[float, float, float]


def estimator(dead_time_s: float = DEAD_S, **changes: object) -> Estimator:
    return Estimator(Model(VEHICLE), EstimatorConfig().model_copy(update=changes), dead_time_s)


@dataclasses.dataclass
class TrueFlight:
    """A true robot and what it did; `true(t)` is its pose at any past time."""

    states: list[Array]  # every 5 ms, as seen by one who drifts with the water
    current: complex = 0j

    def true(self, t: float) -> Array:
        """Over ground: water that streams evenly is another frame of reference, nothing else (Galilei)."""
        place = t / 0.005
        low = min(int(place), len(self.states) - 2)
        state = self.states[low] + (self.states[low + 1] - self.states[low]) * (place - low)
        carried = self.current * np.exp(-1j * state[3])
        state[:2] += self.current.real * t, self.current.imag * t
        state[4:6] += carried.real, carried.imag
        return np.asarray(state)


def constant(wrench: Wrench) -> Callable[[float], Wrench]:
    return lambda t: wrench


def fly(
    command: Callable[[float], Wrench],
    seconds: float,
    observer: Estimator,
    *,
    latency_s: Callable[[int], float] = lambda k: 0.04,
    told_age: bool = True,
    is_visible: Callable[[int], bool] = lambda k: True,
    disturbance: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0),
    gyro: bool = True,
    current: complex = 0j,
) -> tuple[list[Observation | None], TrueFlight]:
    """A control loop without control: poses arrive late, the board is fresh, wrenches act after the dead time."""
    flight, estimates = TrueFlight([np.array([0.3, -0.2, 0.3, 3.0, *([0.0] * 7)])], current), []
    sighting: PoseMeasurement | None = None
    for k in range(round(seconds / STEP_S)):
        now_s, now_ns = k * STEP_S, k * STEP_NS
        late = latency_s(k)
        if is_visible(k) and now_s >= late:
            x, y, _, yaw = flight.true(now_s - late)[:4]
            sighting = PoseMeasurement(now_ns - (round(late * 1e9) if told_age else 0), x, y, wrap(yaw))
        here = flight.states[-1]
        estimates.append(observer.update(StateMeasurement(sighting, here[2], here[7] if gyro else None), now_ns))
        observer.note_wrench(command(now_s), now_ns)
        for i in range(10):
            acts = now_s + 0.005 * i - DEAD_S
            held = command(math.floor(acts / STEP_S + 1e-9) * STEP_S) if acts > -1e-9 else (0.0, 0.0, 0.0)
            flight.states.append(integrate(VEHICLE, flight.states[-1], constant(held), 0.005, disturbance, True, 400))
    return estimates, flight


def weave(t: float) -> Wrench:
    return 2.5 + math.sin(0.7 * t), 0.3 * math.sin(0.5 * t), 0.08 * math.sin(0.9 * t)


def errors(estimates: list[Observation | None], flight: TrueFlight, since_s: float) -> Array:
    """Estimate minus truth, [eta, nu] (steps, 8)."""
    rows = []
    for k, estimate in enumerate(estimates):
        if estimate is not None and k * STEP_S >= since_s:
            true = flight.true(k * STEP_S)
            error = np.concatenate([estimate.eta, estimate.nu]) - true[:8]
            error[3] = wrap(error[3])
            rows.append(error)
    return np.array(rows)


def test_a_late_pose_is_carried_to_now() -> None:
    compensated, flight = fly(weave, 8.0, estimator())
    late = np.abs(errors(compensated, flight, 3.0)).max(axis=0)
    assert np.hypot(late[0], late[1]) < 0.001 and late[3] < 0.003
    assert late[4] < 0.01 and late[5] < 0.01 and late[7] < 0.02


def test_the_same_without_the_age_is_off_by_the_way_flown_meanwhile() -> None:
    """0.25 m/s x 40 ms = 10 mm. If this fails the test above proves nothing."""
    ignorant, flight = fly(weave, 8.0, estimator(), told_age=False)
    assert np.hypot(*np.abs(errors(ignorant, flight, 3.0))[:, :2].T).max() > 0.006


def test_dead_time_counts() -> None:
    right, flight = fly(weave, 8.0, estimator())
    wrong, other = fly(weave, 8.0, estimator(dead_time_s=0.0))
    yaw_rate_error = [np.abs(errors(e, f, 3.0))[:, 7].max() for e, f in ((right, flight), (wrong, other))]
    assert yaw_rate_error[1] > 2 * yaw_rate_error[0]


def test_state_at_action_is_where_the_robot_will_be() -> None:
    estimates, flight = fly(weave, 6.0, estimator())
    for k in range(60, 110):
        estimate = estimates[k]
        assert estimate is not None
        true = flight.true(k * STEP_S + DEAD_S)
        action = np.array(estimate.action)
        assert np.abs(action[:2] - true[:2]).max() < 0.002
        assert action[8:11] == pytest.approx(true[8:11], abs=0.01)  # thrust that acts by then


def test_jittering_ages_are_no_noise() -> None:
    random = np.random.default_rng(3)
    ages = random.uniform(0.02, 0.06, 400)
    estimates, flight = fly(weave, 8.0, estimator(), latency_s=lambda k: float(ages[k]))
    error = np.abs(errors(estimates, flight, 3.0)).max(axis=0)
    assert np.hypot(error[0], error[1]) < 0.001 and error[4] < 0.01


@pytest.mark.parametrize("gyro", [True, False])
def test_constant_disturbances_are_found(gyro: bool) -> None:
    gamma = (0.01, -0.008, 0.0125, 0.05)
    estimates, _ = fly(lambda t: (0.5, 0.0, 0.0), 15.0, estimator(), disturbance=gamma, gyro=gyro)
    last = estimates[-1]
    assert last is not None
    assert last.disturbance == pytest.approx(gamma, abs=1.5e-3)
    assert np.array_equal(last.estimate.disturbance, last.disturbance) and last.current == 0j


def test_without_sway_the_side_channel_stays_silent() -> None:
    observer = Estimator(Model(VEHICLE, sway=False), EstimatorConfig(sway=False), DEAD_S)
    estimates, _ = fly(weave, 4.0, observer)
    assert all(e.nu[1] == 0.0 and e.disturbance[1] == 0.0 for e in estimates if e is not None)


def test_disabled_means_no_disturbance() -> None:
    estimates, _ = fly(weave, 4.0, estimator(enabled=False), disturbance=(0.02, 0.0, 0.0, 0.0))
    assert all(not e.disturbance.any() for e in estimates if e is not None)


def test_poses_missing_for_a_while_are_bridged_by_the_model() -> None:
    """0.3 s without a pose at full swing: a few millimetres, and nothing left a second later."""
    estimates, flight = fly(weave, 9.0, estimator(), is_visible=lambda k: not 100 <= k < 106)
    error = np.abs(errors(estimates, flight, 4.0))
    assert np.hypot(error[:, 0], error[:, 1]).max() < 0.005
    assert np.hypot(error[60:, 0], error[60:, 1]).max() < 0.001


def test_coasting_ends() -> None:
    observer = estimator()
    estimates, _ = fly(weave, 4.0, observer, is_visible=lambda k: k < 30)
    gone = [e is None for e in estimates]
    assert not any(gone[2:45]) and all(gone[30 + COAST_NS // STEP_NS + 2 :])


def test_old_and_repeated_poses_change_nothing() -> None:
    """Reordering: an older pose that arrives later, and the same one again, count once."""
    plain, twice = estimator(), estimator()
    for k in range(1, 40):
        now = k * STEP_NS
        sighting = PoseMeasurement(now - 40_000_000, 0.01 * k, 0.0, 0.02 * k)
        a = plain.update(StateMeasurement(sighting), now)
        twice.update(StateMeasurement(sighting), now)
        stale = sighting._replace(stamp_ns=sighting.stamp_ns - 30_000_000, x_m=0.2)
        twice.update(StateMeasurement(stale), now)
        b = twice.update(StateMeasurement(sighting), now)
        assert a is not None and b is not None
        assert np.array_equal(a.eta, b.eta) and np.array_equal(a.nu, b.nu)


def test_a_pose_from_the_future_is_not_believed() -> None:
    observer = estimator()
    assert observer.update(StateMeasurement(PoseMeasurement(STEP_NS + 1, 0.0, 0.0, 0.0)), STEP_NS) is None


def test_yaw_is_continuous_across_half_a_turn() -> None:
    observer, yaws = estimator(), []
    for k in range(1, 200):
        estimate = observer.update(StateMeasurement(PoseMeasurement(k * STEP_NS, 0.0, 0.0, wrap(0.05 * k))), k * STEP_NS)
        assert estimate is not None
        yaws.append(estimate.eta[3])
    assert np.abs(np.diff(yaws)).max() < 0.3 and yaws[-1] > 9.0


def test_yaw_stays_continuous_through_a_leap_that_is_believed() -> None:
    """A robot that keeps station by a heading of three turns ago would unwind them."""
    observer, x = estimator(), 0.0
    for k in range(1, 420):
        leap, turned = (0.0 if k < 400 else 0.5), 0.05 * min(k, 400)
        pose = PoseMeasurement(k * STEP_NS, leap, 0.0, wrap(turned))
        estimate = observer.update(StateMeasurement(pose, yaw_rate_radps=1.0), k * STEP_NS)
        assert estimate is not None and abs(estimate.eta[3] - turned) < 0.5
        x = estimate.eta[0]
    assert x == pytest.approx(0.5, abs=0.01)


def test_a_single_leap_is_ignored_and_a_lasting_one_believed() -> None:
    observer, x = estimator(), 0.0
    for k in range(1, 60):
        leap = 1.0 if k == 30 or k >= 45 else 0.0
        estimate = observer.update(StateMeasurement(PoseMeasurement(k * STEP_NS, leap, 0.0, 0.0)), k * STEP_NS)
        assert estimate is not None
        x = estimate.eta[0]
        assert k >= 45 or abs(x) < 1e-9
    assert x == pytest.approx(1.0)


def test_a_single_leap_is_ignored_however_often_it_is_handed_in() -> None:
    """Poses that stop with a leap: the newest there is comes with every step."""
    observer = estimator()
    for k in range(1, 40):
        pose = PoseMeasurement(k * STEP_NS, 0.0, 0.0, 0.0) if k < 30 else PoseMeasurement(30 * STEP_NS, 1.0, 0.0, 0.0)
        estimate = observer.update(StateMeasurement(pose), k * STEP_NS)
        assert estimate is not None and abs(estimate.eta[0]) < 1e-9


def test_single_leaps_are_ignored_however_many_there_are() -> None:
    """Five in a row count, not five in a flight."""
    observer = estimator()
    for k in range(1, 80):
        leap = 1.0 if k % 4 == 0 else 0.0
        estimate = observer.update(StateMeasurement(PoseMeasurement(k * STEP_NS, leap, 0.0, 0.0)), k * STEP_NS)
        assert estimate is not None and abs(estimate.eta[0]) < 1e-9 and not estimate.leap


def test_poses_that_contradict_the_estimate_and_one_another_are_not_believed() -> None:
    observer, random = estimator(), np.random.default_rng(2)
    for k in range(1, 60):
        x, y = (0.0, 0.0) if k < 45 else (3.0 * k, float(random.uniform(-1.0, 1.0)))
        estimate = observer.update(StateMeasurement(PoseMeasurement(k * STEP_NS, x, y, 0.0)), k * STEP_NS)
        assert estimate is not None and abs(estimate.eta[0]) < 1e-9 and not estimate.leap


def test_a_leap_that_is_believed_says_what_was_told_and_what_was_believed() -> None:
    observer, leaps = estimator(), []
    for k in range(1, 60):
        pose = PoseMeasurement(k * STEP_NS, 1.0 if k >= 40 else 0.0, 0.0, 0.0)
        estimate = observer.update(StateMeasurement(pose, depth_m=0.3), k * STEP_NS)
        assert estimate is not None and estimate.eta[2] == pytest.approx(0.3, abs=1e-6)  # no pose tells of the depth
        leaps += [(k, estimate.leap)] if estimate.leap else []
    assert leaps == [(44, "poses say (1.00 m, 0.00 m, 0.00 rad), (0.00 m, 0.00 m, 0.00 rad) was believed")]


# --- depth and yaw rate that cannot be


def sensing(reading: Callable[[int], tuple[float | None, float | None]], steps: int = 60) -> list[Observation]:
    """A robot at rest at 0.3 m, whose board says this depth and yaw rate at each step."""
    observer, states = estimator(), []
    for k in range(1, steps + 1):
        depth_m, rate = reading(k)
        late = PoseMeasurement(k * STEP_NS - 40_000_000, 0.0, 0.0, 0.0)
        estimate = observer.update(StateMeasurement(late, depth_m, rate, k * STEP_NS), k * STEP_NS)
        assert estimate is not None
        states.append(estimate)
    return states


@pytest.mark.parametrize("bad", [(10.0, 0.0), (-0.4, 0.0), (0.3, 50.0), (0.3, -1.5)])
def test_one_bad_depth_or_yaw_rate_moves_nothing(bad: tuple[float, float]) -> None:
    for spoilt, missing in zip(
        sensing(lambda k: bad if k % 7 == 0 else (0.3, 0.0)),
        sensing(lambda k: (0.3 if bad[0] == 0.3 else None, 0.0 if bad[1] == 0.0 else None) if k % 7 == 0 else (0.3, 0.0)),
        strict=True,
    ):
        assert np.array_equal(spoilt.eta, missing.eta) and np.array_equal(spoilt.nu, missing.nu)
        assert np.array_equal(spoilt.disturbance, missing.disturbance)
        assert np.abs(spoilt.eta - [0.0, 0.0, 0.3, 0.0]).max() < 1e-9 and not spoilt.depth_leap


def test_a_depth_that_lasts_against_the_estimate_is_believed_and_told() -> None:
    states = sensing(lambda k: (0.3 if k < 40 else 10.0, 0.0))
    leaps = [(k, e.depth_leap) for k, e in enumerate(states, 1) if e.depth_leap]
    assert leaps == [(44, "the sensor says 10.00 m, 0.30 m was believed")]
    assert states[42].eta[2] == pytest.approx(0.3) and states[-1].eta[2] == pytest.approx(10.0)
    assert np.abs(states[-1].nu).max() < 1e-6 and np.abs(states[-1].disturbance).max() < 1e-6  # it leapt, it did not dive


def test_the_first_depth_is_taken_at_once_however_long_poses_came_without_one() -> None:
    """Nothing was believed before it, so it contradicts nothing: a robot that is armed a moment later has no fault."""
    states = sensing(lambda k: (None if k < 20 else 2.0, 0.0))
    assert not any(e.depth_leap for e in states)
    assert states[18].depth_age_s == math.inf and states[19].depth_age_s == 0.0
    assert all(e.eta[2] == pytest.approx(2.0, abs=1e-6) and abs(e.nu[2]) < 1e-6 for e in states[19:])


def test_depths_that_agree_with_nothing_age() -> None:
    states = sensing(lambda k: (0.3 if k < 40 else 1.0 + 0.5 * k, 0.0))
    assert not any(e.depth_leap for e in states) and states[-1].eta[2] == pytest.approx(0.3)
    assert states[38].depth_age_s == 0.0 and states[-1].depth_age_s == pytest.approx(21 * STEP_S)


def test_a_yaw_rate_that_lasts_is_believed() -> None:
    """A robot that was hit."""
    states = sensing(lambda k: (0.3, 0.0 if k < 40 else 2.0), 46)
    assert abs(states[42].nu[3]) < 0.1 and states[45].nu[3] > 1.5


@pytest.mark.parametrize("step_s", [0.01, 0.05, 0.1, 0.4])
@pytest.mark.parametrize("bandwidth", [0.5, 2.0, 8.0])
def test_gains_put_all_poles_where_they_say(step_s: float, bandwidth: float) -> None:
    beta = math.exp(-bandwidth * step_s)
    a = np.array([[1, step_s, step_s**2 / 2], [0, 1, step_s], [0, 0, 1]])
    correction = np.eye(3) - np.outer(gains(bandwidth, step_s), [1, 0, 0])
    assert np.abs(np.linalg.eigvals(correction @ a) - beta).max() < 2e-4  # a triple root: cube root of rounding
    double = np.eye(2) - np.outer(gains_with_rate(bandwidth, step_s)[1:], [1, 0])
    assert np.abs(np.linalg.eigvals(double @ a[:2, :2]) - beta).max() < 1e-6


def test_gains_tend_to_the_articles_bandwidth_form() -> None:
    """(31): b1 = 3w, b2 = 3w^2, b3 = w^3 per second."""
    w, dt = 2.0, 1e-4
    assert np.array(gains(w, dt)) / dt == pytest.approx([3 * w, 3 * w**2, w**3], rel=1e-3)


values = st.floats(allow_nan=True, allow_infinity=True) | st.floats(-2, 2)
Row = tuple[int, float, float, float, float, float | None, float | None, int | None]
times = st.integers(-STEP_NS, 30 * STEP_NS)


@settings(max_examples=150, deadline=None)
@given(
    st.lists(
        st.tuples(times, values, values, values, values, values | st.none(), values | st.none(), times | st.none()),
        min_size=1,
        max_size=30,
    )
)
def test_no_input_makes_it_lose_its_numbers(rows: list[Row]) -> None:
    observer = estimator()
    for k, (stamp, x, y, yaw, variance, depth, rate, board) in enumerate(rows):
        pose = PoseMeasurement(stamp, x, y, yaw, variance)
        estimate = observer.update(StateMeasurement(pose, depth, rate, board), k * STEP_NS)
        observer.note_wrench((0.1, 0.0, 0.0), k * STEP_NS)
        if estimate is not None:
            numbers = np.concatenate([estimate.eta, estimate.nu, estimate.disturbance, estimate.action])
            assert np.isfinite(numbers).all() and np.abs(numbers[4:12]).max() < 1e3


@pytest.mark.parametrize("seed", range(12))
def test_the_correction_is_equation_31_in_matrices(seed: int) -> None:
    """eta += b1 e, nu += b2 J' e, Gamma += b3 J' e; the gyroscope's rate in the place of the heading's for nu and Gamma."""
    random, on, sway = np.random.default_rng(seed), float(seed % 3 != 0), float(seed % 4 != 0)
    belief, error = 0.1 * random.normal(size=18), 0.05 * random.normal(size=3)
    step_s, settings_ = float(random.uniform(0.02, 0.3)), EsoSettings(2.0, 4.0, on)
    depth_m, rate_radps = (math.nan if seed % 2 else 0.3), (math.nan if seed % 5 == 0 else 0.1)
    state, expected = belief.copy(), belief.copy()
    correct(settings_, sway, state, tuple(error.tolist()), depth_m, rate_radps, step_s)

    (b1, b2, b3), turn = gains(2.0, step_s), belief[3]
    body = np.array([[np.cos(turn), np.sin(turn)], [-sway * np.sin(turn), sway * np.cos(turn)]]) @ error[:2]
    expected[:2] += b1 * error[:2]
    expected[4:6] += b2 * body
    expected[11:13] += on * b3 * body
    if not math.isnan(depth_m):
        expected[[2, 6, 13]] += np.array([b1, b2, on * b3]) * (depth_m - belief[2])
    yaw_gains = (gains if math.isnan(rate_radps) else gains_with_rate)(4.0, step_s)
    off = error[2] if math.isnan(rate_radps) else rate_radps - belief[7]
    expected[[3, 7, 14]] += np.array(yaw_gains) * [error[2], off, on * off]
    assert state == pytest.approx(expected, abs=1e-9)


def test_a_late_pose_finds_what_the_board_measured_then_in_the_fastest_loop_too() -> None:
    """One sample per step of 10 ms: 0.8 s ago they had other values than the oldest of the last few."""
    at_ns = 10_000_000 * np.arange(1, 121, dtype=np.int64)
    samples = Samples(at_ns, np.stack([at_ns * 1e-9, -at_ns * 1e-9], axis=1), len(at_ns))
    for column, sign in ((0, 1.0), (1, -1.0)):
        assert sensed_at(samples, column, 405_000_000) == pytest.approx(sign * 0.405)
