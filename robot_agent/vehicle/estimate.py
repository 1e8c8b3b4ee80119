"""Records between sensors, observer and control law: what is measured, and what is believed of the robot and its water.

A current keeps its direction in the pool; a force of the robot (unlike thrusters, a trailing cable) turns along with it. A
plan over several seconds has to know which is which, so the estimate keeps them apart: `current`, and `own_force` per mass.
"""

from typing import NamedTuple

from shoal.frames import Array
from shoal.messages.messages import Estimate


class PoseMeasurement(NamedTuple):
    """A pose from the localizer, in the pool frame."""

    stamp_ns: int  # middle of the exposure, on the robot's clock
    x_m: float
    y_m: float
    yaw_rad: float
    variance_m2: float = 0.0  # of x and of y
    variance_rad2: float = 0.0  # of yaw


class StateMeasurement(NamedTuple):
    """The newest sensor values. Missing ones are None; the same pose may be given more than once."""

    pose: PoseMeasurement | None = None
    depth_m: float | None = None  # of the robot's centre, from the pressure sensor
    yaw_rate_radps: float | None = None  # gyroscope
    board_ns: int | None = None  # instant of depth and yaw rate; None: now
    pitch_rad: float = 0.0  # bow up is positive; 0 where it is not measured
    roll_rad: float = 0.0  # starboard down is positive; likewise
    pitch_rate_radps: float = 0.0  # d/dt of them
    roll_rate_radps: float = 0.0


class Ratios(NamedTuple):
    """Drag, thrust and yaw moment per mass (yaw: per inertia) over the vehicle file's, as learned in flight."""

    drag: float = 1.0
    thrust: float = 1.0
    moment: float = 1.0


class Deviations(NamedTuple):
    """Standard deviations of an estimate, those of two axes along the worse of them."""

    place_m: float  # of x, y
    yaw_rad: float
    velocity_mps: float  # of u, v through the water
    ground_mps: float  # of the velocity over ground
    yaw_rate_radps: float
    current_mps: float
    own_force: Array  # (3,) m/s^2, m/s^2, rad/s^2
    ratios: Ratios  # relative


class Observation(NamedTuple):
    """An observer's result. `estimate` is what the robot tells; the rest stays in its controller. Velocities and
    `disturbance` are in the body frame, `current` in the pool frame."""

    estimate: Estimate  # now; yaw continuous, not wrapped
    disturbance: Array  # (4,) acceleration that the model does not explain, in water that streams at `current`
    current: complex  # x + iy of the water's own velocity, m/s
    action: Array  # (12,) state when a command given now begins to act; velocities through the water
    pose_age_s: float
    depth_age_s: float  # of the last depth that did not contradict the estimate; infinite before the first
    leap: str = ""  # what was told and what had been believed, in the step that gave up a believed place for another one
    depth_leap: str = ""  # the same for the depth
    moment_ratio: float = 0.0  # of yaw moment per inertia; 0 if it is not learned
    bandwidth_radps: float = 0.0  # with which the observer follows the poses now; 0: not known
    deviations: Deviations | None = None  # None: the observer has no covariance

    @property
    def eta(self) -> Array:
        """Pose now, (4,)."""
        return self.estimate.eta

    @property
    def nu(self) -> Array:
        """Velocity now over ground, (4,)."""
        return self.estimate.nu

    @property
    def through_water(self) -> Array:
        """Velocity u, v, w, r through the water when a command given now begins to act, (4,)."""
        return self.action[4:8]

    @property
    def own_force(self) -> Array:
        """Acceleration (3,) by forces of the robot that turn along with it: surge, sway m/s^2, yaw rad/s^2."""
        return self.disturbance[[0, 1, 3]]
