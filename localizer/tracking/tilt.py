"""By how much a robot may lean, judged by how it moves. Pure.

The marker plate is above the robot's centre, so roll and pitch move it sideways by height * tilt, which looks like a move of
the robot. Nobody tells the localizer roll and pitch. But what makes a robot lean is thrust that acts below its centre, and
thrust is what its motion takes: F = M a + D(v), with mass and drag of the vehicle's file. A robot that has leant swings back
slowly.

The lean is no correction of the pose, whose sign it does not know: it is one standard deviation in the covariance.

Velocity and acceleration are those of a fading-memory polynomial filter of the second degree (Morrison, Introduction to
Sequential Smoothing and Prediction, 1969): the least-squares parabola through the measured places, older ones weighted less.
"""

from dataclasses import dataclass, replace

import numpy as np

from wire.config.vehicle import Vehicle
from wire.frames import Array

_MEMORY_S = 0.25  # shorter: noise of the picture looks like thrust; longer: a start is noticed late (NEES 4 then, 10 at 0.4 s)
_JUDGED_AFTER_S = 3.0 * _MEMORY_S  # before, a robot that was found in motion seems to be speeding up
_SWING_S = 3.0  # a swing falls to 1/e in this: 2 I / drag of roll and pitch (0.12 kg m^2, 0.08 N m s)
_MOST_RAD = 0.5  # more than a robot that swims leans; a robot that is carried moves as if by any force


@dataclass(frozen=True)
class Course:
    """Where a robot's plate is, how it moves (2,) and speeds up (2,), pool frame, and the lean `swung_rad` that is left of
    before."""

    position_m: Array
    velocity_mps: Array
    acceleration_mps2: Array
    swung_rad: float = 0.0
    since_s: float = 0.0  # the last measurement
    followed_s: float = 0.0  # since it began

    @classmethod
    def begin(cls, position_m: Array, swung_rad: float) -> "Course":
        """At rest, as far as one knows."""
        return cls(position_m.copy(), np.zeros(2), np.zeros(2), swung_rad)

    def advanced(self, step_s: float) -> "Course":
        """Time has passed: swings die down."""
        swung_rad = self.swung_rad * float(np.exp(-step_s / _SWING_S))
        return replace(self, since_s=self.since_s + step_s, followed_s=self.followed_s + step_s, swung_rad=swung_rad)

    def measured(self, position_m: Array, law: "LeanLaw") -> "Course":
        """Take in a measured place (2,)."""
        h = self.since_s
        if h <= 0.0:
            return replace(self, position_m=position_m.copy())
        keep = float(np.exp(-h / _MEMORY_S))
        lose = 1.0 - keep
        expected = self.position_m + h * self.velocity_mps + 0.5 * h * h * self.acceleration_mps2
        error = position_m - expected
        velocity = self.velocity_mps + h * self.acceleration_mps2 + 1.5 * lose * lose * (1.0 + keep) / h * error
        acceleration = self.acceleration_mps2 + lose**3 / (h * h) * error
        judged = self.followed_s >= _JUDGED_AFTER_S
        swung_rad = max(self.swung_rad, law.forced_rad(velocity, acceleration)) if judged else self.swung_rad
        return Course(expected + (1.0 - keep**3) * error, velocity, acceleration, swung_rad, 0.0, self.followed_s)


@dataclass(frozen=True)
class LeanLaw:
    """What an experiment says about its robots' lean."""

    height_m: float  # of the plate above the centre of the robot
    standing_rad: float  # one standard deviation of roll and of pitch at rest: trim
    rad_per_n: float
    mass_kg: float
    drag_linear: float
    drag_quadratic: float

    @classmethod
    def of(cls, vehicle: Vehicle, standing_rad: float, rad_per_n: float) -> "LeanLaw":
        """For a vehicle; of surge and sway the axis that takes more."""
        return cls(
            height_m=vehicle.marker.height_m,
            standing_rad=standing_rad,
            rad_per_n=rad_per_n,
            mass_kg=float(vehicle.inertia[:2].max()),
            drag_linear=float(vehicle.drag_linear[:2].max()),
            drag_quadratic=float(vehicle.drag_quadratic[:2].max()),
        )

    def forced_rad(self, velocity_mps: Array, acceleration_mps2: Array) -> float:
        """Lean that a motion takes: the force behind it, times `rad_per_n`."""
        drag = self.drag_linear + self.drag_quadratic * float(np.linalg.norm(velocity_mps))
        force_n = float(np.linalg.norm(self.mass_kg * acceleration_mps2 + drag * velocity_mps))
        return min(self.rad_per_n * force_n, _MOST_RAD)

    def covariance(self, course: Course | None, down: Array) -> Array:
        """What an unknown lean does to a measured [x, y, yaw], (3, 3); without a course, of a robot at rest.

        `down` (2,) is d(x, y) / d depth of the line of sight: a leaning plate's corners lie at other depths than its middle,
        and seen askew that looks like a turn by half of lean times slope."""
        lean2 = self.standing_rad**2 + (0.0 if course is None else course.swung_rad**2)
        aside_m2, turn2 = self.height_m**2 * lean2, 0.25 * lean2 * float(down @ down)
        return np.diag([aside_m2, aside_m2, turn2])
