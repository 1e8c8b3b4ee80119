"""One robot in one frame: its predicted view, the region around it, and the covariance of a pose measured there.

The noise figures were measured against the plant's truth in the pool scene with waves, caustics and sensor noise on, that of
markers' corners (`localizer.corner_sigma_px`) on pictures of another renderer (tests/localizer/photoreal).
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from localizer import kernels
from localizer.camera_model import LocalLinearization
from localizer.detection.fiducials import MarkerPose
from localizer.detection.image_regions import BodyProjection, ImageRegion
from localizer.tracking.depth_memory import KnownDepth
from localizer.tracking.tilt import Attitude
from shoal.config.experiment import Experiment
from shoal.frames import Array, body_to_pool


@dataclass(frozen=True)
class MeasurementNoise:
    """Standard deviations of a way of measuring: of the centre per axis, and of a rotation as displacement of the hull's rim.

    Each has a part in pixels, which holds at any scale, and a part as share of the hull's radius, from light and shade.
    """

    centre_px: float
    rim_px: float
    centre_share: float = 0.0
    rim_share: float = 0.0
    lean_px: float = 0.0  # error, along the way of the hull's top and turning its rim, over that way in radii of the hull


# Of a robot whose marker is covered: what covers it hides part of the robot, too.
COVERED_NOISE = MeasurementNoise(centre_px=0.2, rim_px=0.22, centre_share=0.008, rim_share=0.008)
# Of a robot without marker. Light and rim stay where they are when a hull leans: of the way of its top they hide so much.
LOOKS_NOISE = MeasurementNoise(centre_px=0.04, rim_px=0.05, centre_share=0.003, rim_share=0.003, lean_px=1.6)
# Corners that are farther from a square than so many standard deviations of a corner are an error. Found well they are 0.7
# from it: a corner's error turns and moves the square more than it deforms it.
_CORNER_SIGMAS = 1.4
_LEAST_SHOWN = 0.2  # of the hull's radius, beyond its middle; with less in view filters rotate a robot by up to 30 degrees


@dataclass(frozen=True)
class TrackMeasurement:
    """A measured pose [x, y, yaw] with its covariance (3, 3), and the correlation's peak (0 for a marker)."""

    pose: Array
    covariance: Array
    peak: float = 0.0

    @property
    def finite(self) -> bool:
        """False if a solver returned NaN or infinity; such a measurement is not used."""
        return bool(np.isfinite(self.pose).all() and np.isfinite(self.covariance).all() and np.isfinite(self.peak))


@dataclass(frozen=True)
class Depth:
    """Depths of a robot's centre and of the marker plate on its back, with their standard deviation."""

    centre_m: float
    plate_m: float
    sigma_m: float
    above_m: float = 0.0  # height of the plate over the centre while the robot is level


def depths_of(experiment: Experiment, by_id: Mapping[int, KnownDepth], attitudes: Mapping[int, Attitude]) -> tuple[Depth, ...]:
    """Every robot's depth, (robots,), in the experiment's order, from that of its centre (by id)."""
    height_m = experiment.vehicle.marker.height_m
    depths = []
    for robot_id in experiment.robot_ids:
        centre = by_id[robot_id].centre_m
        up_m = attitudes[robot_id].above_m(height_m)[2] if robot_id in attitudes else height_m
        depths.append(Depth(centre, centre - up_m, by_id[robot_id].sigma_m, height_m))
    return tuple(depths)


@dataclass(frozen=True)
class PredictedView:
    """A robot (by index) expected where `tangent` was taken, at the depth of its plate."""

    robot: int
    radius_m: float
    depth: Depth
    body_to_level: Array  # (3, 3), rotation by roll and pitch, as far as they are known
    slope_rad: float  # standard deviation of the water's slope, which bends the line of sight by (1 - 1/n) of it
    tangent: LocalLinearization
    camera_covariance: Array  # (3, 3), of [x, y, yaw] measured here, due to the error of the camera's pose
    region: ImageRegion
    plate: ImageRegion  # the part of it that the marker plate is expected in

    def marker(self, reading: MarkerPose, side_m: float, corner_px: float) -> TrackMeasurement:
        """The measurement of a marker's reading, `corner_px` the standard deviation s of a corner's coordinates: that of their
        mean is s / 2, that of the square's rotation s / 2 r, with the corners r = side / sqrt(2) from its middle.

        Corners that make no square (glare over one of them, blur, short waves) have been found wrong, and so are place and
        heading.
        """
        noise = MeasurementNoise(centre_px=corner_px / 2.0, rim_px=corner_px * self.radius_m / (math.sqrt(2.0) * side_m))
        expected_m = corner_px / self.tangent.px_per_m
        excess_m2 = max(reading.residual_m**2 - (_CORNER_SIGMAS * expected_m) ** 2, 0.0)
        own = np.diag([0.5 * excess_m2, 0.5 * excess_m2, excess_m2 / side_m**2])
        return self.measurement(reading.pose, noise, own)

    def distance_m(self, pose: Array) -> float:
        """Distance of [x, y, ...] from the predicted position."""
        return float(np.linalg.norm(pose[:2] - self.tangent.position_m))

    def shows(self, pose: Array) -> bool:
        """True if enough of a robot at `pose` [x, y, ...] lies in the region."""
        corner, size = (self.region.left_px, self.region.top_px), self.region.bayer.shape[::-1]
        inside = self.tangent.nearby_px(pose[:2]) - corner
        margin_px = _LEAST_SHOWN * self.radius_m * self.tangent.px_per_m
        return bool(np.all((inside >= margin_px) & (inside <= np.array(size) - 1 - margin_px)))

    def body(self, pose: Array) -> BodyProjection:
        """Projection of the robot's body at `pose` [x, y, yaw]."""
        c, s = np.cos(pose[2]), np.sin(pose[2])
        at = self.tangent
        to_pool = np.array([[c, -s], [s, c]])
        sight = np.append(-self.tangent.jacobian[:, 2] @ to_pool, -1.0)  # up along the line of sight, on level axes
        return BodyProjection(
            at.nearby_px(pose[:2]),
            np.column_stack([at.pool_to_px @ to_pool, at.down_px]) @ self.body_to_level,
            sight / np.linalg.norm(sight) @ self.body_to_level,
        )

    def top_m(self, pose: Array) -> Array:
        """Place (2,), in the pool, of the hull's top from its centre, as far as the lean of the robot at `pose` is known."""
        return body_to_pool(-self.depth.above_m * self.body_to_level[:2, 2], float(pose[2]))

    def measurement(self, pose: Array, noise: MeasurementNoise, own: Array, peak: float = 0.0) -> TrackMeasurement:
        """A measurement of `pose`: its covariance sums the picture's noise, moving water, depth error, the camera's pose
        error, and its `own` part (3, 3), from the residuals of this one."""
        wave_m = 0.25 * self.slope_rad * max(self.depth.plate_m, 0.0)
        lean_m = noise.lean_px / self.tangent.px_per_m * self.top_m(pose) / self.radius_m
        own = own + np.pad(np.outer(lean_m, lean_m), (0, 1))
        own[2, 2] += float(lean_m @ lean_m) / self.radius_m**2
        round_m2 = wave_m**2 + (noise.centre_share * self.radius_m) ** 2
        yaw_rad2 = (noise.rim_px / (self.tangent.px_per_m * self.radius_m)) ** 2 + noise.rim_share**2
        covariance = np.empty((3, 3))
        kernels.measurement_covariance(
            self.tangent.jacobian,
            self.camera_covariance + own,
            noise.centre_px,
            self.depth.sigma_m,
            round_m2,
            yaw_rad2,
            covariance,
        )
        return TrackMeasurement(pose, covariance, peak)
