"""Lean of a robot read from the picture: from the place of the plate on top of its hull, and the hull's centre by its outline.
Pure."""

import math

import numpy as np

from localizer.camera_model import LocalLinearization, RefractiveCamera
from localizer.detection.hull_outline import find_hull
from localizer.detection.image_regions import Pixels, cut
from localizer.tracking.tilt import Attitude
from shoal.config.vehicle import Vehicle
from shoal.frames import Array, pool_to_body

_MOST_RAD = 0.3  # rad; more lean is not looked for
_LEAST_RADIUS_PX = 15.0  # px; on a smaller hull _SIGMA_PX alone is more than 3 degrees of lean
_SIGMA_PX = 0.15  # px, floor of the standard deviation: light and shade on the rim, corners of the marker
_BENT = 0.25  # of the water's slope: by so much it bends lines of sight, which plate and rim see 0.15 m apart


class LeanReader:
    """Reader of lean for one kind of robot."""

    def __init__(self, vehicle: Vehicle) -> None:
        self._radius_m, self._height_m = vehicle.radius_m, vehicle.marker.height_m

    def read(
        self, view: RefractiveCamera, frame: Pixels, at: LocalLinearization, plate: Array, depth_m: float, slope_rad: float
    ) -> Attitude | None:
        """Roll and pitch of a robot whose `plate` [x, y, yaw] was measured in a frame (height, width), in the row's own
        instant, with its centre at `depth_m`. None where the hull's outline does not tell."""
        if self._height_m <= 0.0 or at.px_per_m * self._radius_m < _LEAST_RADIUS_PX or depth_m < self._radius_m / 2.0:
            return None
        reach_m = self._height_m * _MOST_RAD
        region = cut(frame, at.nearby_px(plate[:2]), (self._radius_m + 2.0 * reach_m) * at.px_per_m)
        if region is None:
            return None
        expected = np.array([plate[0], plate[1], depth_m])
        hull = find_hull(view, region.demosaiced(2), expected, self._radius_m, math.ceil(reach_m * at.px_per_m))
        if hull is None:
            return None
        ahead, aside = (pool_to_body(plate[:2] - hull.position_m, float(plate[2])) / self._height_m).tolist()
        if math.hypot(ahead, aside) > math.sin(_MOST_RAD):
            return None
        sigma_rad = math.hypot(_SIGMA_PX, hull.sigma_px) / (at.px_per_m * self._height_m)
        return Attitude(math.asin(aside), -math.asin(ahead), math.hypot(sigma_rad, _BENT * slope_rad))
