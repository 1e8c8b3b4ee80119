"""Tilt of robots, told by their boards or bounded by their motion."""

import numpy as np
import pytest

from localizer.tracking.fleet_localizer import FleetLocalizer
from localizer.tracking.tilt import Attitude, MotionEstimate, TiltModel
from shoal.config.experiment import Experiment, load_experiment
from shoal.frames import Array, wrap
from shoal.messages.messages import Pose, required
from sim_bridge.camera.renderer import Renderer
from tests.closed_loop.dry_pool import DryPool
from tests.localizer.numpy_geometry import leaning

EXPERIMENT = load_experiment("pool")
LAW = TiltModel.of(EXPERIMENT.vehicle, 0.002, 0.026)
PERIOD_S, STEP_S = 0.05, 0.02  # of pictures and of control
ATTITUDE_SIGMA_RAD = EXPERIMENT.localizer.attitude_sigma_rad


def follow(places_m: Array, period_s: float = PERIOD_S, law: TiltModel = LAW) -> MotionEstimate:
    """A course through places (n, 2), one a period."""
    course = MotionEstimate.at_rest(places_m[0], 0.0)
    for place_m in places_m[1:]:
        course = course.predicted(period_s).with_position(place_m, law)
    return course


@pytest.mark.parametrize("period_s", [0.01, 0.05, 0.2])
def test_a_parabola_is_followed_exactly_at_any_rate(period_s: float) -> None:
    """After three seconds nothing is left of having begun at rest."""
    t_s = np.arange(0.0, 6.0, period_s)[:, None]
    velocity, acceleration = np.array([0.2, -0.1]), np.array([0.01, 0.03])
    course = follow(t_s * velocity + 0.5 * t_s**2 * acceleration, period_s)
    assert course.acceleration_mps2 == pytest.approx(acceleration, abs=1e-3)
    assert course.velocity_mps == pytest.approx(velocity + t_s[-1] * acceleration, abs=1e-3)


def test_a_steady_speed_takes_the_thrust_that_its_drag_does() -> None:
    """0.3 m/s: 3 N s/m * 0.3 m/s + 20 kg/m * 0.09 m^2/s^2 = 2.7 N, times 0.026 rad/N."""
    t_s = np.arange(0.0, 20.0, PERIOD_S)[:, None]
    course = follow(t_s * np.array([0.3, 0.0]))
    assert course.residual_tilt_rad == pytest.approx(0.0702, rel=0.02)
    assert np.sqrt(LAW.covariance(course, None, np.zeros(2))[0, 0]) == pytest.approx(0.15 * np.hypot(0.0702, 0.002), rel=0.02)


def test_a_robot_at_rest_leans_by_its_trim_only() -> None:
    """Measured places are noisy by 0.4 mm: what that feigns in thrust stays below half a millimetre."""
    places = np.random.default_rng(1).normal(0.0, 0.0004, (400, 2))
    lean = LAW.covariance(follow(places), None, np.zeros(2))
    assert 0.3e-3 <= np.sqrt(lean[0, 0]) < 0.6e-3
    assert LAW.covariance(None, None, np.zeros(2))[0, 0] == pytest.approx((0.15 * 0.002) ** 2)


def test_a_swing_dies_down_when_the_robot_has_stopped() -> None:
    moving, still = np.arange(100)[:, None] * np.array([0.01, 0.0]), np.full((100, 2), [0.99, 0.0])
    stopped = follow(np.concatenate([moving, still[:20]]))
    later = follow(np.concatenate([moving, still]))
    assert later.residual_tilt_rad < 0.5 * stopped.residual_tilt_rad


def test_seen_askew_a_lean_looks_like_a_turn() -> None:
    """A plate of 0.1 m, leaning by 0.1 rad across the way a slanting line of sight runs: each corner is moved along
    that line's foot by its depth's error, and the square that fits best is turned."""
    slope, lean = 0.3, 0.1
    corners = 0.05 * np.array([[1.0, -1.0], [1.0, 1.0], [-1.0, 1.0], [-1.0, -1.0]])
    moved = corners + np.outer(corners[:, 1] * lean, [slope, 0.0])
    cross = corners[:, 0] * moved[:, 1] - corners[:, 1] * moved[:, 0]
    turned_rad = abs(np.arctan2(np.sum(cross), np.sum(corners * moved)))
    law = TiltModel.of(EXPERIMENT.vehicle, lean, 0.0)
    assert np.sqrt(law.covariance(None, None, np.array([slope, 0.0]))[2, 2]) == pytest.approx(turned_rad, rel=0.01)


class SeenPool(DryPool):
    """Robots that fly by what the localizer makes of rendered pictures, tilt and all."""

    def __init__(self, experiment: Experiment, measured: bool) -> None:
        super().__init__(experiment)
        self._measured = measured  # True if the boards measure roll and pitch
        self.error_m: list[float] = []
        self._renderer, self._locator, self._frames = Renderer(self.experiment, 1), FleetLocalizer(self.experiment), 0
        self.nees: list[float] = []
        self.lean_rad: list[float] = []

    def expose(self, stamp_ns: int) -> None:
        world, ids = self.world, self.experiment.robot_ids
        frame = self._renderer.render(world.eta, world.nu, world.now_ns * 1e-9, self._frames, world.tilt)
        self._frames += 1
        depths = {
            i: required(robot.states[-1].board).depth_m for i, robot in zip(ids, self.robots, strict=True) if robot.states
        }
        states = {i: robot.states[-1] for i, robot in zip(ids, self.robots, strict=True) if robot.states and self._measured}
        readings = {
            i: Attitude.at(required(s.board).tilt, STEP_S + required(s.timing.board_age_ms) * 1e-3, ATTITUDE_SIGMA_RAD)
            for i, s in states.items()
        }
        attitudes = {i: attitude for i, attitude in readings.items() if attitude is not None}
        assert len(attitudes) == len(states)
        poses = dict(self._locator.step(frame, stamp_ns, depths, attitudes).poses)
        if len(poses) == len(ids):
            self.poses.append((stamp_ns, [poses[i] for i in ids]))
            self.error_m += [
                float(np.hypot(poses[i].x_m - eta[0], poses[i].y_m - eta[1])) for i, eta in zip(ids, world.eta, strict=True)
            ]
            self.nees += [nees(poses[i], eta) for i, eta in zip(ids, world.eta, strict=True)]
            self.lean_rad += np.hypot(*world.tilt[:, :2].T).tolist()


def nees(pose: Pose, eta: Array) -> float:
    error = np.array([pose.x_m - eta[0], pose.y_m - eta[1], wrap(pose.yaw_rad - float(eta[3]))])
    return float(error @ np.linalg.solve(pose.covariance, error))


@pytest.mark.long
def test_the_covariance_holds_in_a_flight_of_leaning_robots() -> None:
    """Two robots off their starts at once, then at 0.1 m/s: 3 on average is right, some caution is allowed. For robots
    taken to be level it is above 100."""
    pool = SeenPool(load_experiment("figure-eight"), measured=False)
    pool.take_off()
    pool.run(3.5)
    assert max(pool.lean_rad) > np.deg2rad(2.0), "else this flight shows nothing"
    assert 0.3 < np.mean(pool.nees) < 4.5


@pytest.mark.long
def test_a_measured_attitude_takes_the_lean_out_of_the_poses() -> None:
    """The same flight, by boards that tell roll and pitch with noise and a bias."""
    pool = SeenPool(load_experiment("figure-eight"), measured=True)
    pool.take_off()
    pool.run(3.5)
    assert max(pool.lean_rad) > np.deg2rad(2.0), "else this flight shows nothing"
    assert np.sqrt(np.mean(np.square(pool.error_m))) < 0.0015
    assert 0.3 < np.mean(pool.nees) < 4.5


@pytest.mark.long
@pytest.mark.parametrize(("roll_deg", "pitch_deg"), [(8.0, 0.0), (0.0, -8.0), (-5.0, 6.0)])
def test_a_robot_that_leans_is_where_its_centre_is(roll_deg: float, pitch_deg: float) -> None:
    """Seen askew, at rest, with its attitude told exactly."""
    tilt = np.deg2rad([[roll_deg, pitch_deg], [pitch_deg, roll_deg]])
    eta = np.array([[1.0, 0.6, 0.3, 0.8], [-0.9, -0.5, 0.3, -2.0]])
    locator, renderer = FleetLocalizer(EXPERIMENT), Renderer(EXPERIMENT, 1)
    attitudes = {i: Attitude(lean[0], lean[1], 0.0) for i, lean in zip((1, 2), tilt.tolist(), strict=True)}
    errors = []
    for k in range(12):
        frame = renderer.render(eta, np.zeros((2, 4)), k * PERIOD_S, k, tilt)
        poses = locator.step(frame, round(k * PERIOD_S * 1e9), {1: 0.3, 2: 0.3}, attitudes).poses
        errors += [[p.x_m - eta[i - 1, 0], p.y_m - eta[i - 1, 1], wrap(p.yaw_rad - float(eta[i - 1, 3]))] for i, p in poses]
    rms = np.sqrt(np.mean(np.square(errors), axis=0))
    assert np.hypot(rms[0], rms[1]) < 1e-3 and rms[2] < np.deg2rad(0.4)


def test_an_attitude_is_carried_over_to_the_exposure() -> None:
    attitude = Attitude.at(np.array([0.1, -0.05, 0.2, 0.4]), -0.05, 0.003)
    assert attitude is not None
    assert (attitude.roll_rad, attitude.pitch_rad) == pytest.approx((0.09, -0.07))
    assert attitude.sigma_rad == pytest.approx(np.hypot(0.003, 0.002))


@pytest.mark.parametrize(
    ("tilt", "later_s"), [(np.zeros(0), 0.0), (np.zeros(4), 0.3), (np.zeros(4), -0.3), (np.zeros(4), float("nan"))]
)
def test_no_attitude_of_an_old_measurement_or_none(tilt: Array, later_s: float) -> None:
    assert Attitude.at(tilt, later_s, 0.003) is None


@pytest.mark.parametrize(("roll_rad", "pitch_rad"), [(0.2, 0.0), (0.0, 0.2), (-0.15, 0.1)])
def test_the_plate_is_where_the_rotation_matrix_puts_it(roll_rad: float, pitch_rad: float) -> None:
    ahead, aside, up = Attitude(roll_rad, pitch_rad, 0.0).above_m(0.15)
    assert leaning(roll_rad, pitch_rad) @ np.array([0.0, 0.0, -0.15]) == pytest.approx([ahead, aside, -up])
