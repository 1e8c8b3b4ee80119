"""One robot in one frame: where it is expected, the piece of picture around it, and how good a measurement there is.

The noise figures were measured against the plant's truth in the pool scene with waves, caustics and sensor noise on.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from localizer.camera_model import Tangent
from localizer.detection.image_regions import BodyFrame, Region
from wire.config.experiment import Experiment
from wire.frames import Array


@dataclass(frozen=True)
class Noise:
    """One standard deviation of a way of measuring: of the centre per axis, and of a turn by how far it moves the hull's rim.
    In pixels, to hold at any scale, and besides as shares of the hull's radius: what light and shade feign."""

    centre_px: float
    rim_px: float
    centre_share: float = 0.0
    rim_share: float = 0.0


MARKER_NOISE = Noise(centre_px=0.03, rim_px=0.15)
KCF_NOISE = Noise(centre_px=0.2, rim_px=0.22, centre_share=0.008, rim_share=0.008)
_DEPTH_ASSUMED_SIGMA_M = 0.05  # nobody reported one: the experiment's depth is taken
_SHALLOWEST_M = -0.2  # a robot lying on the surface
_LEAST_SHOWN = 0.2  # of the hull's radius, beyond its middle: filters turn a robot of which less is in view by 30 degrees
_WAVE_SLOPE_RAD = 0.0043  # of ripples on the surface; each bends the line of sight by (1 - 1/n) of itself


@dataclass(frozen=True)
class Measurement:
    """A measured pose [x, y, yaw] with its covariance (3, 3), and the correlation's peak (0 where none was looked for)."""

    pose: Array
    covariance: Array
    peak: float = 0.0

    @property
    def finite(self) -> bool:
        """False for what a solver made of nothing: such a measurement is no measurement."""
        return bool(np.isfinite(self.pose).all() and np.isfinite(self.covariance).all() and np.isfinite(self.peak))


@dataclass(frozen=True)
class Depth:
    """How deep a robot's centre and the marker plate on its back are, and how sure that is."""

    centre_m: float
    plate_m: float
    sigma_m: float


def depths_of(experiment: Experiment, start_m: Sequence[float], reported_m: Mapping[int, float]) -> tuple[Depth, ...]:
    """Every robot's depth, in the experiment's order: as reported (by id), or as at the start, (robots,)."""
    height_m, deepest_m = experiment.vehicle.marker.height_m, experiment.pool.size_m[2]
    known_sigma_m = experiment.localizer.depth_sigma_m
    depths = []
    for robot_id, start in zip(experiment.robot_ids, start_m, strict=True):
        depth = reported_m.get(robot_id, float("nan"))
        known = _SHALLOWEST_M <= depth <= deepest_m
        centre = depth if known else float(start)
        depths.append(Depth(centre, centre - height_m, known_sigma_m if known else max(known_sigma_m, _DEPTH_ASSUMED_SIGMA_M)))
    return tuple(depths)


@dataclass(frozen=True)
class Sight:
    """A robot (by index) expected where `tangent` was taken, at the depth of its plate."""

    robot: int
    radius_m: float
    depth: Depth
    tangent: Tangent
    mapping: Array  # (3, 3), covariance of [x, y, yaw] here by what is unsure about the camera's pose
    region: Region

    def distance_m(self, pose: Array) -> float:
        """How far [x, y, ...] lies from where the robot was expected."""
        return float(np.linalg.norm(pose[:2] - self.tangent.position_m))

    def shows(self, pose: Array) -> bool:
        """Whether enough of a robot at `pose` [x, y, ...] is in the picture."""
        corner, size = (self.region.left_px, self.region.top_px), self.region.bayer.shape[::-1]
        inside = self.tangent.to_px(pose[:2]) - corner
        margin_px = _LEAST_SHOWN * self.radius_m * self.tangent.px_per_m
        return bool(np.all((inside >= margin_px) & (inside <= np.array(size) - 1 - margin_px)))

    def body(self, pose: Array) -> BodyFrame:
        """Where the robot is drawn if it is at `pose` [x, y, yaw]."""
        c, s = np.cos(pose[2]), np.sin(pose[2])
        at = self.tangent
        return BodyFrame(at.to_px(pose[:2]), at.pool_to_px @ np.array([[c, -s], [s, c]]), at.down_px)

    def measurement(self, pose: Array, noise: Noise, peak: float = 0.0) -> Measurement:
        """A pose found here, with the picture's noise, the moving water, depth's and camera's errors as covariance."""
        wave_m = 0.25 * _WAVE_SLOPE_RAD * max(self.depth.plate_m, 0.0)
        round_m2 = wave_m**2 + (noise.centre_share * self.radius_m) ** 2
        spread = self.tangent.jacobian * np.array([noise.centre_px, noise.centre_px, self.depth.sigma_m])
        covariance = self.mapping.copy()
        covariance[:2, :2] += spread @ spread.T + round_m2 * np.eye(2)
        covariance[2, 2] += (noise.rim_px / (self.tangent.px_per_m * self.radius_m)) ** 2 + noise.rim_share**2
        return Measurement(pose, covariance, peak)
