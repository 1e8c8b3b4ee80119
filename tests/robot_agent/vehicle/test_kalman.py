"""The Kalman observer in the simulator's water: true covariances, a current told from a force, hands, gaps and nonsense."""

import math
from dataclasses import dataclass, field
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.linalg import solve_continuous_are

from robot_agent.vehicle.allocation import Allocator
from robot_agent.vehicle.dynamics import Model
from robot_agent.vehicle.eso import NS, Sighting
from robot_agent.vehicle.estimate import Observation, PoseMeasurement, StateMeasurement
from robot_agent.vehicle.kalman import KalmanEstimator, LearnedModel, make_estimator, quickest
from shoal.config.controller import EstimatorConfig
from shoal.config.experiment import Experiment, load_experiment
from shoal.frames import Array, wrap
from shoal.messages.messages import Mode, required
from sim_bridge.in_process.fleet import DirectPlant, fly
from tests.flights.scene_flights import prepared

pytestmark = pytest.mark.long

STEP_NS, LATE_NS = 50_000_000, 40_000_000
SETTLED_S = 8.0
ALONE = ("robots=[{id=1,node_m=[0.0,0.0,0.0]}]", "pool.walls=false", "localizer.uses_camera=false")


def asked(t: float) -> Array:
    """A wrench that weaves ahead, with turns both ways."""
    return np.array([1.2 + 0.4 * math.sin(0.5 * t), 0.0, 0.10 * math.sin(0.35 * t) + 0.02])


@dataclass
class Drift:
    """An observer in a flight without control, and its errors (rows, 8): x, y, yaw, u, v, r, current; NEES of pose, velocity
    and current, per degree of freedom."""

    observer: KalmanEstimator
    errors: list[Array] = field(default_factory=list)
    nees: list[tuple[float, float, float]] = field(default_factory=list)
    estimates: list[Observation] = field(default_factory=list)


def drift(experiment: Experiment, seed: int, noise: float = 1.0, seconds: float = 40.0, held_s: float = 0.0) -> Drift:
    """Fly the plant by `asked`, in poses with `noise` times 1.5 mm and 8 mrad; before, the robot is held without thrust."""
    vehicle, random = experiment.vehicle, np.random.default_rng(seed)
    water = DirectPlant(experiment, seed, np.array([[0.0, 0.0, 0.5, 0.4]]))
    observer = make_estimator(vehicle, Model(vehicle), EstimatorConfig(kind="kalman"))
    assert isinstance(observer, KalmanEstimator)
    flight, allocator, held_ns = Drift(observer), Allocator(vehicle), round(held_s * NS)
    sd_m, sd_rad = 0.0015 * noise, 0.008 * noise
    for k in range(1, round((seconds + held_s) / 0.05)):
        now_ns = k * STEP_NS
        if now_ns > held_ns:
            water.advance(now_ns - held_ns - LATE_NS)
        eta, nu, stamp_ns = water.eta[0].copy(), water.nu[0].copy(), now_ns - LATE_NS
        # private: only the plant knows its water
        motion = water._plant._flow.motion(water.eta[:, :3], water._plant.time_s(water._state))
        if now_ns > held_ns:
            water.advance(now_ns - held_ns)
        x, y, yaw = eta[[0, 1, 3]] + random.standard_normal(3) * [sd_m, sd_m, sd_rad]
        pose = PoseMeasurement(stamp_ns, x, y, wrap(yaw), sd_m**2, sd_rad**2)
        board = water.telemetry(0, now_ns)
        estimate = observer.update(StateMeasurement(pose, board.depth_m, board.yaw_rate_radps), now_ns)
        assert estimate is not None
        flight.estimates.append(estimate)
        wrench = asked((now_ns - held_ns) * 1e-9) if now_ns >= held_ns else np.zeros(3)
        pulses, delivered = allocator.allocate(wrench) if now_ns >= held_ns else allocator.neutral()
        water.act(0, SimpleNamespace(pulse_us=pulses, arm=None))  # type: ignore[arg-type]
        observer.note_wrench(delivered, now_ns)
        if now_ns - held_ns > SETTLED_S * NS:
            note(flight, eta, nu, motion[0])
    return flight


def note(flight: Drift, eta: Array, nu: Array, motion: Array) -> None:
    """Note the belief's error against the truth at the same exposure."""
    # private: the belief at the exposure, where the truth is known
    b, turn = flight.observer._belief, complex(math.cos(eta[3]), -math.sin(eta[3]))
    carried = complex(motion[0], motion[1]) * turn
    error = np.array([
        b[0] - eta[0], b[1] - eta[1], wrap(b[3] - eta[3]), b[4] - nu[0] + carried.real, b[5] - nu[1] + carried.imag,
        b[7] - nu[3], b[15] - motion[0], b[16] - motion[1],
    ])  # fmt: skip
    # private: no robot publishes its covariances
    p = flight.observer._bank.mixed
    flight.errors.append(error)
    parts = (([0, 1, 2], [0, 1, 2]), ([3, 4, 5], [3, 4, 5]), ([6, 7], [9, 10]))
    flight.nees.append(tuple(error[i] @ np.linalg.solve(p[np.ix_(j, j)], error[i]) / len(i) for i, j in parts))  # type: ignore[arg-type]


CELLS = {
    "still": ((), 1.0),
    "noise x 10": ((), 10.0),
    "current": (("sim.plant.current_mps=[0.05,0.08,0.0]",), 1.0),
    "gusts": (("sim.plant.gust_mps=0.03", "sim.plant.gust_s=8.0"), 1.0),
    "a force of a quarter of the thrust": (
        ("sim.plant.disturbance_wrench=[1.5,0.0,0.0]", "sim.plant.disturbance_hz=0.02"),
        1.0,
    ),
    "too light a file": (("sim.plant.mass_error=0.3", "sim.plant.drag_error=0.3"), 1.0),
}


@pytest.mark.parametrize("cell", CELLS)
def test_covariances_are_true(cell: str) -> None:
    """Mean over seeds. Too sure is what harms: a plan trusts what is not so. Too modest by up to a factor of five in variance
    is the water's kind, which a minute cannot tell."""
    changes, noise = CELLS[cell]
    nees = np.array([drift(load_experiment("pool", [*ALONE, *changes]), seed, noise).nees for seed in range(1, 5)])
    pose, velocity, current = nees.mean(axis=(0, 1)).tolist()
    assert 0.5 < pose < 1.6, (pose, velocity, current)
    assert 0.15 < velocity < 1.5 and 0.05 < current < 1.5, (pose, velocity, current)


def test_a_current_is_told_from_a_force_that_turns_along() -> None:
    """The same deceleration once by water and once by thrusters that give less: the one is a current, the other a ratio."""
    stream = drift(load_experiment("pool", [*ALONE, "sim.plant.current_mps=[0.1,0.0,0.0]"]), 1)
    weak = drift(load_experiment("pool", [*ALONE, "sim.plant.mass_error=0.5", "sim.plant.drag_error=0.5"]), 1)
    in_stream, in_still = stream.estimates[-1], weak.estimates[-1]
    assert abs(in_stream.current - 0.1) < 0.015 and 0.9 < required(in_stream.estimate.thrust_ratio) < 1.2
    assert (
        abs(in_still.current) < 0.015
        and 0.6 < required(in_still.estimate.thrust_ratio) < 0.8
        and 0.6 < in_still.moment_ratio < 0.8
    )


@pytest.mark.parametrize("mass, drag", [(-0.3, 0.3), (0.3, -0.3)])
def test_drag_is_learned_though_mass_is_wrong_the_other_way(mass: float, drag: float) -> None:
    """Surge drag and yaw drag per mass are 1.86 and 0.54 times the vehicle file's: no current, and no lasting moment."""
    water = (f"sim.plant.mass_error={mass}", f"sim.plant.drag_error={drag}")
    last = drift(load_experiment("pool", [*ALONE, *water]), 1, seconds=60.0).estimates[-1]
    expected = (1.0 + drag) / (1.0 + mass)
    assert last.estimate.drag_ratio == pytest.approx(expected, rel=0.15) and abs(last.current) < 0.015
    assert abs(last.own_force[2]) < 0.06


def test_a_robot_held_in_a_current_does_not_learn_that_the_water_stands() -> None:
    flight = drift(load_experiment("pool", [*ALONE, "sim.plant.current_mps=[0.0,0.15,0.0]"]), 2, seconds=15.0, held_s=10.0)
    held, last = flight.estimates[180], flight.estimates[-1]
    assert held.deviations is not None and held.deviations.current_mps > 0.15 and held.deviations.ground_mps < 0.08
    assert abs(last.current - 0.15j) < 0.03


def test_gaps_and_nonsense_leave_a_covariance_that_is_one() -> None:
    """Poses missing, twice, wrong by metres, without a variance or without a number, for five minutes."""
    vehicle, random = load_experiment("pool", ALONE).vehicle, np.random.default_rng(7)
    observer = make_estimator(vehicle, Model(vehicle), EstimatorConfig(kind="kalman"))
    assert isinstance(observer, KalmanEstimator)
    nonsense = (math.nan, math.inf, -math.inf, 1e300, -1.0, 0.0)
    for k in range(1, 6000):
        now_ns, kind = k * STEP_NS, random.integers(12)
        variance = float(random.choice(nonsense)) if kind < 3 else 2e-6
        x = float(random.choice(nonsense)) if kind == 3 else 0.3 * math.sin(0.01 * k) + (2.0 if kind == 4 else 0.0)
        pose = None if kind > 8 else PoseMeasurement(now_ns - LATE_NS, x, 0.0, 0.02 * k, variance, variance)
        rate = float(random.choice(nonsense)) if kind == 5 else 0.4
        estimate = observer.update(StateMeasurement(pose, 0.3, rate), now_ns)
        observer.note_wrench(random.uniform(-1.0, 1.0, 3) * vehicle.limits.wrench[:3], now_ns)
        assert estimate is not None or k < 20
        if estimate is not None:
            assert np.isfinite(np.concatenate([estimate.eta, estimate.nu, estimate.disturbance, estimate.action])).all()
            # private: no robot publishes its covariances
            assert np.isfinite(observer._deviation).all() and abs(estimate.current) <= vehicle.limits.speed_mps + 1e-9
            # private: no robot publishes its covariances
            p = observer._bank.mixed / np.outer(*[np.sqrt(observer._bank.mixed.diagonal())] * 2)
            assert np.linalg.eigvalsh(p)[0] > -1e-6


def test_a_belief_that_is_no_number_is_given_up_for_the_next_pose() -> None:
    vehicle = load_experiment("pool", ALONE).vehicle
    model = Model(vehicle)
    observer = make_estimator(vehicle, model, EstimatorConfig(kind="kalman"))
    assert isinstance(observer, KalmanEstimator)

    def step(k: int) -> Observation | None:
        pose = PoseMeasurement(k * STEP_NS - LATE_NS, 0.2, 0.1, 0.3, 2e-6, 6e-5)
        return observer.update(StateMeasurement(pose, 0.3, 0.0), k * STEP_NS)

    assert all(step(k) is not None for k in range(1, 20))
    # private: no robot publishes its covariances
    observer._bank.covariance[2, 3, 3] = math.nan
    assert step(20) is None
    after = step(21)
    assert after is not None and np.isfinite(after.action).all() and np.array_equal(model.coefficients, model.nominal)


def test_an_agent_flies_with_it_and_tells_what_it_learns() -> None:
    settings = ("controller.estimator.kind='kalman'", "duration_s=25", "localizer.uses_camera=false")
    fleet, water = prepared(load_experiment("figure-eight", settings))
    fleet.start()
    for _ in fly(fleet, water):
        pass
    last = fleet.robots[0].states[-1]
    assert last.mode is Mode.TRACKING and not last.fault and 0.8 < required(required(last.estimate).thrust_ratio) < 1.25
    late = fleet.errors()[round(18.0 / fleet.experiment.controller.period_s) :, :, :2]
    assert np.sqrt(np.mean(np.sum(late**2, axis=2), axis=0)).max() < 0.015


@pytest.mark.parametrize("step_s", [0.02, 0.05, 0.1])
def test_the_most_restless_force_makes_a_filter_as_quick_as_the_loop_s_delay_allows(step_s: float) -> None:
    """Against the continuous filter of a force integrated to a measured number: its poles are that far from zero."""
    model, delay_s = Model(load_experiment("pool").vehicle), 0.08
    learned = LearnedModel(model.nominal, model.motion, 1.0, 2.0, 0.5, 6.0, 0.5, delay_s)
    sighting = Sighting(0.0, 0.0, 0.0, 0.0015**2, 0.008**2, 1)
    force, current = quickest(learned, sighting, step_s)
    loop_s = delay_s + 0.5 * step_s
    for order, intensity, noise, phase_rad in ((3, force, 0.0015**2, 0.6), (2, current, 0.0015**2, 0.8)):
        a, h = np.eye(order, k=1), np.eye(1, order)
        p = solve_continuous_are(a.T, h.T, intensity * np.diag(np.eye(order)[-1]), noise * step_s * np.eye(1))
        poles = np.linalg.eigvals(a - p @ h.T @ h / (noise * step_s))
        assert np.abs(poles) == pytest.approx(phase_rad / loop_s, rel=1e-3)
