"""Settings that only the simulator reads: picture, sensors, boards, moving things."""

from typing import Annotated

import numpy as np
from pydantic import Field

from wire.config.fault_injection import Fault
from wire.config.plant import PlantConfig
from wire.config.scene import Vec3
from wire.config.vehicle import Fraction, NotNegative, Positive
from wire.frames import Array
from wire.toml_loader import Section


class PictureConfig(Section):
    """The look of the simulated picture, apart from the robots."""

    noise: NotNegative = 2.0  # standard deviation at mid grey, in grey levels of 255
    ripples_m: NotNegative = 0.0015  # height of the surface waves
    caustics: Fraction = 0.25
    glare: Fraction = 0.3
    vignetting: Fraction = 0.15
    shadows: bool = True
    alike: bool = False  # robots in one paint and without numbers; else each has a shade of its own


class Sensors(Section):
    """The sensors of the simulated thruster board: one standard deviation of noise, and biases drawn for each robot."""

    rate_hz: Annotated[float, Field(ge=5, le=400)] = 50.0
    gyro_noise_radps: NotNegative = 0.003
    gyro_bias_radps: NotNegative = 0.002
    heading_noise_rad: NotNegative = 0.01
    heading_bias_rad: NotNegative = 0.03
    tilt_noise_rad: NotNegative = 0.002
    tilt_bias_rad: NotNegative = 0.005
    pressure_noise_m: NotNegative = 0.002
    pressure_bias_m: NotNegative = 0.003
    battery_v: Positive = 12.4
    battery_noise_v: NotNegative = 0.02
    battery_sag_v: NotNegative = 0.5  # with all thrusters at full thrust


class BoardRules(Section):
    """The safety rules of the thruster board (docs/board.md). A firmware has the same values built in."""

    neutral_after_s: Annotated[float, Field(gt=0, le=0.3)] = 0.25  # age of the last override; then neutral, disarmed
    slew_us_per_s: Positive = 8000.0  # full reverse to full ahead in 0.1 s, a thruster's own time constant


class Numeric(Section):
    """The poses of a numeric flight, in place of camera and localizer: the true pose with this noise, sim.latency_s old."""

    pose_noise_m: NotNegative = 0.0  # one standard deviation, x and y each
    yaw_noise_rad: NotNegative = 0.0
    obstacle_noise_m: NotNegative = 0.01  # of sim.drifters
    obstacle_noise_mps: NotNegative = 0.01


class CameraMotion(Section):
    """The motion of the simulated camera about [camera]'s pose, as under a hovering drone. Only the simulator knows it: an
    experiment with a moving camera needs [[landmarks]]."""

    sway_m: NotNegative = 0.0  # largest deviation along each axis
    tilt_rad: NotNegative = 0.0  # largest turn about each axis
    period_s: Positive = 8.0  # of the slowest swing

    @property
    def moves(self) -> bool:
        """True if the camera moves at all."""
        return self.sway_m > 0.0 or self.tilt_rad > 0.0


class Drifter(Section):
    """A red ball adrift in the simulated pool. Nobody is told of it: the camera has to see it, and no robot bounces off it."""

    radius_m: Positive = 0.1
    start_m: Vec3  # where it is at from_s
    velocity_mps: Vec3 = (0.0, 0.0, 0.0)
    from_s: NotNegative = 0.0  # when it comes into the water

    def place_m(self, time_s: float) -> Array | None:
        """Its middle, (3,); None before it comes."""
        since_s = time_s - self.from_s
        return np.array(self.start_m) + since_s * np.array(self.velocity_mps) if since_s >= 0.0 else None


class Sim(Section):
    """All settings of the simulator."""

    # in lockstep, numeric flights and with --poses: from the middle of an exposure to the control step
    latency_s: Annotated[float, Field(ge=0, le=0.5)] = 0.03
    numeric: Numeric = Numeric()
    plant: PlantConfig = PlantConfig()
    faults: tuple[Fault, ...] = ()
    picture: PictureConfig = PictureConfig()
    camera_motion: CameraMotion = CameraMotion()
    drifters: tuple[Drifter, ...] = ()
    sensors: Sensors = Sensors()
    board: BoardRules = BoardRules()
