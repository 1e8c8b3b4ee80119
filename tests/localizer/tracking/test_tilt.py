"""By how much a robot may lean, judged by how it moves."""

import numpy as np
import pytest

from localizer.tracking.fleet_localizer import FleetLocalizer
from localizer.tracking.tilt import MotionEstimate, TiltModel
from sim_bridge.camera.renderer import Renderer
from tests.closed_loop.dry_pool import DryPool
from wire.config.experiment import Experiment, load_experiment
from wire.frames import Array, wrap
from wire.messages.messages import Pose

EXPERIMENT = load_experiment("pool")
LAW = TiltModel.of(EXPERIMENT.vehicle, 0.002, 0.026)
PERIOD_S = 0.05


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
    assert np.sqrt(LAW.covariance(course, np.zeros(2))[0, 0]) == pytest.approx(0.15 * np.hypot(0.0702, 0.002), rel=0.02)


def test_a_robot_at_rest_leans_by_its_trim_only() -> None:
    """Measured places are noisy by 0.4 mm: what that feigns in thrust stays below half a millimetre."""
    places = np.random.default_rng(1).normal(0.0, 0.0004, (400, 2))
    lean = LAW.covariance(follow(places), np.zeros(2))
    assert 0.3e-3 <= np.sqrt(lean[0, 0]) < 0.6e-3
    assert LAW.covariance(None, np.zeros(2))[0, 0] == pytest.approx((0.15 * 0.002) ** 2)


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
    assert np.sqrt(law.covariance(None, np.array([slope, 0.0]))[2, 2]) == pytest.approx(turned_rad, rel=0.01)


class SeenPool(DryPool):
    """Robots that fly by what the localizer makes of rendered pictures, tilt and all."""

    def __init__(self, experiment: Experiment) -> None:
        super().__init__(experiment)
        self._renderer, self._locator, self._frames = Renderer(self.experiment, 1), FleetLocalizer(self.experiment), 0
        self.nees: list[float] = []
        self.lean_rad: list[float] = []

    def expose(self, stamp_ns: int) -> None:
        world, ids = self.world, self.experiment.robot_ids
        frame = self._renderer.render(world.eta, world.nu, world.now_ns * 1e-9, self._frames, world.tilt)
        self._frames += 1
        depths = {i: robot.states[-1].depth_m for i, robot in zip(ids, self.robots, strict=True) if robot.states}
        poses = dict(self._locator.step(frame, stamp_ns, depths).poses)
        if len(poses) == len(ids):
            self.seen.append((stamp_ns, [poses[i] for i in ids]))
            self.nees += [nees(poses[i], eta) for i, eta in zip(ids, world.eta, strict=True)]
            self.lean_rad += np.hypot(*world.tilt[:, :2].T).tolist()


def nees(pose: Pose, eta: Array) -> float:
    error = np.array([pose.x_m - eta[0], pose.y_m - eta[1], wrap(pose.yaw_rad - float(eta[3]))])
    return float(error @ np.linalg.solve(pose.covariance, error))


def test_the_covariance_holds_in_a_flight_of_leaning_robots() -> None:
    """Two robots off their starts at once, then at 0.1 m/s: 3 on average is right, some caution is allowed. For robots
    taken to be level it is above 100."""
    pool = SeenPool(load_experiment("figure-eight"))
    pool.take_off()
    pool.run(3.5)
    assert max(pool.lean_rad) > np.deg2rad(2.0), "else this flight shows nothing"
    assert 0.5 < np.mean(pool.nees) < 4.5
