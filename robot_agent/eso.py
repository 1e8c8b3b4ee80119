"""Extended state observer (31): pose, velocity and lumped disturbance, computed where the delay is accounted for."""

from dataclasses import dataclass


@dataclass(frozen=True)
class Sighting:
    """A pose from the localizer, in the pool frame."""

    stamp_ns: int  # middle of the exposure, on the robot's clock
    x_m: float
    y_m: float
    yaw_rad: float


@dataclass(frozen=True)
class Measurement:
    """The newest of what was sensed. What is missing is None; a pose that was seen before may be handed in again."""

    pose: Sighting | None = None
    depth_m: float | None = None  # of the robot's centre, from the pressure sensor
    yaw_rate_radps: float | None = None  # gyroscope
    board_ns: int | None = None  # instant of depth and yaw rate; None: now
