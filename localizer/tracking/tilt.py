"""Tilt of a robot: told by its board, or bounded by its motion. Pure.

The marker plate is above the robot's centre, so roll and pitch move it sideways by height * tilt, which looks like motion of
the robot. A board that measures roll and pitch tells them (`Attitude`), or the hull's outline does (`LeanReader`), and the
pose is corrected. The marker alone does not tell: a degree moves its corners, 33 px apart, by 0.03 px against each other.

Otherwise the tilt is not known. But a robot tilts because thrust acts below its centre, and its motion tells the
thrust: F = M a + D(v), with mass and drag of the vehicle's file. A robot that has tilted swings back slowly. This tilt is no
correction, because its sign is not known: it is one standard deviation in the covariance.

Velocity and acceleration are those of a fading-memory polynomial filter of the second degree (Morrison, Introduction to
Sequential Smoothing and Prediction, 1969): the least-squares parabola through the measured positions, older ones weighted
less.
"""

import math
from dataclasses import dataclass, replace

import numpy as np

from localizer.camera_model import LocalLinearization, RefractiveCamera
from localizer.detection.hull_outline import find_hull
from localizer.detection.image_regions import Pixels, cut
from shoal.config.vehicle import Vehicle
from shoal.frames import Array, pool_to_body

_MEMORY_S = 0.25  # s; if shorter, picture noise looks like thrust; if longer, a start is seen late (NEES 4 then, 10 at 0.4 s)
_JUDGED_AFTER_S = 3.0 * _MEMORY_S  # s; before, a robot that was found in motion seems to accelerate
_SWING_S = 3.0  # s in which a swing falls to 1/e: 2 I / drag of roll and pitch (0.12 kg m^2, 0.08 N m s)
_SWINGS_RADPS2 = 1.6  # rad/s^2, standard deviation of d2/dt2 of roll and pitch: righting moment / inertia at 0.1 rad
_OLDEST_S = 0.2  # s; a measured attitude that is further from the exposure is not used (32 mrad by the line above)
_MOST_RAD = 0.5  # rad, upper limit: no swimming robot tilts more, but one that is carried moves as if by any force
_MOST_LEAN_RAD = 0.3  # rad; more lean is not looked for
_LEAST_RADIUS_PX = 15.0  # px; on a smaller hull _LEAN_SIGMA_PX alone is more than 3 degrees of lean
_LEAN_SIGMA_PX = 0.15  # px, floor of the standard deviation: light and shade on the rim, corners of the marker
_BENT = 0.25  # of the water's slope: by so much it bends lines of sight, which plate and rim see 0.15 m apart


@dataclass(frozen=True)
class Attitude:
    """Roll and pitch of a robot at an exposure, and their standard deviation."""

    roll_rad: float
    pitch_rad: float
    sigma_rad: float

    @classmethod
    def at(cls, tilt: Array, later_s: float, sigma_rad: float) -> "Attitude | None":
        """Carry a measurement [roll, pitch, and d/dt of them] over to an exposure `later_s` after it (negative: before it), at
        constant rates. None if nothing was measured, or too long from the exposure."""
        if len(tilt) != 4 or not abs(later_s) <= _OLDEST_S:
            return None
        roll, pitch = (tilt[:2] + later_s * tilt[2:]).tolist()
        return cls(roll, pitch, float(np.hypot(sigma_rad, 0.5 * _SWINGS_RADPS2 * later_s**2)))

    def above_m(self, height_m: float) -> tuple[float, float, float]:
        """Place of a point `height_m` above the robot's centre, on level axes: ahead, to starboard, up."""
        up = height_m * np.cos(self.roll_rad)
        return -up * np.sin(self.pitch_rad), height_m * np.sin(self.roll_rad), up * np.cos(self.pitch_rad)


def body_to_level(roll_rad: float, pitch_rad: float) -> Array:
    """Rotation (3, 3) from the body's axes (ahead, to starboard, down) to level ones with the same heading: Ry(p) Rx(r)."""
    cr, sr, cp, sp = np.cos(roll_rad), np.sin(roll_rad), np.cos(pitch_rad), np.sin(pitch_rad)
    return np.array([[cp, sp * sr, sp * cr], [0.0, cr, -sr], [-sp, cp * sr, cp * cr]])


@dataclass(frozen=True)
class MotionEstimate:
    """Position, velocity (2,) and acceleration (2,) of a robot's plate, pool frame, and the tilt `residual_tilt_rad` that
    remains of earlier motion."""

    position_m: Array
    velocity_mps: Array
    acceleration_mps2: Array
    residual_tilt_rad: float = 0.0
    since_s: float = 0.0  # time since the last measurement
    followed_s: float = 0.0  # time since the first

    @classmethod
    def at_rest(cls, position_m: Array, residual_tilt_rad: float) -> "MotionEstimate":
        """An estimate of zero velocity at a first position."""
        return cls(position_m.copy(), np.zeros(2), np.zeros(2), residual_tilt_rad)

    def predicted(self, step_s: float) -> "MotionEstimate":
        """The estimate some time later: the remaining tilt decays."""
        residual_tilt_rad = self.residual_tilt_rad * float(np.exp(-step_s / _SWING_S))
        return replace(
            self, since_s=self.since_s + step_s, followed_s=self.followed_s + step_s, residual_tilt_rad=residual_tilt_rad
        )

    def with_position(self, position_m: Array, model: "TiltModel") -> "MotionEstimate":
        """The estimate after a measured position (2,), by a fading-memory filter of second order: with keep = exp(-h / T) its
        gains are 1 - keep^3, 1.5 (1 - keep)^2 (1 + keep) / h and (1 - keep)^3 / h^2."""
        h = self.since_s
        if h <= 0.0:
            return replace(self, position_m=position_m.copy())
        keep = float(np.exp(-h / _MEMORY_S))
        lose = 1.0 - keep
        expected = self.position_m + h * self.velocity_mps + 0.5 * h * h * self.acceleration_mps2
        error = position_m - expected
        velocity = self.velocity_mps + h * self.acceleration_mps2 + 1.5 * lose * lose * (1.0 + keep) / h * error
        acceleration = self.acceleration_mps2 + lose**3 / (h * h) * error
        residual_tilt_rad = self.residual_tilt_rad
        if self.followed_s >= _JUDGED_AFTER_S:
            residual_tilt_rad = max(residual_tilt_rad, model.tilt_of_motion_rad(velocity, acceleration))
        return MotionEstimate(
            position_m=expected + (1.0 - keep**3) * error,
            velocity_mps=velocity,
            acceleration_mps2=acceleration,
            residual_tilt_rad=residual_tilt_rad,
            followed_s=self.followed_s,
        )


@dataclass(frozen=True)
class TiltModel:
    """Relation between a robot's motion and its tilt, and the tilt at rest."""

    height_m: float  # of the plate above the centre of the robot
    rest_tilt_rad: float  # one standard deviation of roll and of pitch at rest: trim
    rad_per_n: float
    mass_kg: float
    drag_linear: float
    drag_quadratic: float

    @classmethod
    def of(cls, vehicle: Vehicle, rest_tilt_rad: float, rad_per_n: float) -> "TiltModel":
        """The model of a vehicle; of surge and sway the larger mass and drag."""
        return cls(
            height_m=vehicle.marker.height_m,
            rest_tilt_rad=rest_tilt_rad,
            rad_per_n=rad_per_n,
            mass_kg=float(vehicle.inertia[:2].max()),
            drag_linear=float(vehicle.drag_linear[:2].max()),
            drag_quadratic=float(vehicle.drag_quadratic[:2].max()),
        )

    def tilt_of_motion_rad(self, velocity_mps: Array, acceleration_mps2: Array) -> float:
        """Tilt that goes with a motion: the force behind it, times `rad_per_n`."""
        drag = self.drag_linear + self.drag_quadratic * float(np.linalg.norm(velocity_mps))
        force_n = float(np.linalg.norm(self.mass_kg * acceleration_mps2 + drag * velocity_mps))
        return min(self.rad_per_n * force_n, _MOST_RAD)

    def covariance(self, motion: MotionEstimate | None, attitude: Attitude | None, down: Array) -> Array:
        """Covariance (3, 3) of a measured [x, y, yaw] due to tilt that is not known: the error of a measured `attitude`, or
        all of it; with `motion` None, of a robot at rest.

        `down` (2,) is d(x, y) / d depth of the line of sight: a tilted plate's corners lie at other depths than its
        middle, and seen obliquely that looks like a rotation by half of tilt times slope.
        """
        if attitude is not None:
            tilt2 = attitude.sigma_rad**2
        else:
            tilt2 = self.rest_tilt_rad**2 + (0.0 if motion is None else motion.residual_tilt_rad**2)
        aside_m2, turn2 = self.height_m**2 * tilt2, 0.25 * tilt2 * float(down @ down)
        return np.diag([aside_m2, aside_m2, turn2])


class LeanReader:
    """Reader of the lean of one kind of robot: from the places of the plate on top of its hull and of the hull's outline."""

    def __init__(self, vehicle: Vehicle) -> None:
        self._radius_m, self._height_m = vehicle.radius_m, vehicle.marker.height_m

    def read(
        self, view: RefractiveCamera, frame: Pixels, at: LocalLinearization, plate: Array, depth_m: float, slope_rad: float
    ) -> Attitude | None:
        """Roll and pitch of a robot whose `plate` [x, y, yaw] was measured in a frame (height, width), in the row's own
        instant, with its centre at `depth_m`. None where the hull's outline does not tell."""
        if self._height_m <= 0.0 or at.px_per_m * self._radius_m < _LEAST_RADIUS_PX or depth_m < self._radius_m / 2.0:
            return None
        reach_m = self._height_m * _MOST_LEAN_RAD
        region = cut(frame, at.nearby_px(plate[:2]), (self._radius_m + 2.0 * reach_m) * at.px_per_m)
        if region is None:
            return None
        expected = np.array([plate[0], plate[1], depth_m])
        hull = find_hull(view, region.demosaiced(2), expected, self._radius_m, math.ceil(reach_m * at.px_per_m))
        if hull is None:
            return None
        ahead, aside = (pool_to_body(plate[:2] - hull.position_m, float(plate[2])) / self._height_m).tolist()
        if math.hypot(ahead, aside) > math.sin(_MOST_LEAN_RAD):
            return None
        sigma_rad = math.hypot(_LEAN_SIGMA_PX, hull.sigma_px) / (at.px_per_m * self._height_m)
        return Attitude(math.asin(aside), -math.asin(ahead), math.hypot(sigma_rad, _BENT * slope_rad))
