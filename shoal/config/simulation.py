"""Settings that only the simulator reads: picture, sensors, boards, moving things."""

from typing import Annotated

import numpy as np
from pydantic import Field

from shoal.config.fault_injection import Fault
from shoal.config.loader import Section
from shoal.config.plant import PlantConfig
from shoal.config.scene import Vec3
from shoal.config.vehicle import Fraction, NotNegative, Positive, Vehicle
from shoal.frames import Array

NO_ANKLE_US = 1000, 2000  # range of a board's pulses for ankles that are not there
TRIMS = tuple(f"{part}{i}_TRIM_US" for part in ("THR", "ANK") for i in (1, 2, 3, 4))  # of the board at hand, not of a vehicle
HIL = "HIL_MODE", "HIL_OUTPUTS"  # set for a flight on the desk; 0 at power-on

Metre = Annotated[float, Field(ge=-1, le=1)]
Turn = Annotated[float, Field(ge=-0.5, le=0.5)]


class PictureConfig(Section):
    """The look of the simulated picture, apart from the robots."""

    noise: NotNegative = 2.0
    """Standard deviation at mid grey, in grey levels of 255."""
    ripples_m: NotNegative = 0.0015
    """Height of the surface waves."""
    caustics: Fraction = 0.25
    """Strength of the light pattern on the floor."""
    glare: Fraction = 0.3
    """Strength of the lamps' reflections."""
    vignetting: Fraction = 0.15
    """Loss of light at the picture's corners."""
    bubbles: Annotated[int, Field(ge=0, le=50)] = 0
    """Streams of rising bubbles."""
    shadows: bool = True
    """Draw the robots' shadows."""
    alike: bool = False
    """Robots in one paint and without numbers."""


class Sensors(Section):
    """The sensors of the simulated thruster board: noise is a standard deviation, a bias the largest that is
    drawn for a robot."""

    rate_hz: Annotated[float, Field(ge=5, le=400)] = 50.0
    """Bursts of sensor messages per second."""
    gyro_noise_radps: NotNegative = 0.003
    """Noise of the yaw rate."""
    gyro_bias_radps: NotNegative = 0.002
    """Bias of the yaw rate."""
    heading_noise_rad: NotNegative = 0.01
    """Noise of the heading."""
    heading_bias_rad: NotNegative = 0.03
    """Bias of the heading."""
    tilt_noise_rad: NotNegative = 0.002
    """Noise of roll and pitch."""
    tilt_bias_rad: NotNegative = 0.005
    """Bias of roll and pitch."""
    pressure_noise_m: NotNegative = 0.002
    """Noise of the depth."""
    pressure_bias_m: NotNegative = 0.003
    """Bias of the depth."""
    battery_v: Positive = 12.4
    """Voltage at the start, without load. Default: 4.13 V for each of the vehicle's cells."""
    battery_noise_v: NotNegative = 0.02
    """Noise of the voltage."""
    battery_sag_v: NotNegative = 0.5
    """Loss of voltage with all thrusters at full thrust."""


class BoardRules(Section):
    """The safety rules of the thruster board (docs/board.md). A robot does not arm if its board has other values."""

    neutral_after_s: Annotated[float, Field(gt=0, le=0.3)] = 0.25
    """Age of the last pulses at which the board goes to neutral and disarms."""
    slew_us_per_s: Positive = 8000.0
    """Largest rate of the pulses. 8000 is full reverse to full ahead in 0.1 s."""

    def parameters(self, vehicle: Vehicle) -> dict[str, float]:
        """Values of all parameters that the board of a vehicle should have, by their names in docs/board.md."""
        thruster, battery = vehicle.thruster, vehicle.battery
        ankle_us = NO_ANKLE_US if vehicle.legs is None else vehicle.legs.ankle_us
        values: dict[str, float] = {
            "CMD_AGE_MS": round(self.neutral_after_s * 1000.0), "SLEW_US_S": self.slew_us_per_s,
            "THR_COUNT": vehicle.thruster_count, "THR_NEUTRAL_US": thruster.neutral_us,
            "THR_MIN_US": thruster.curve[0][0], "THR_MAX_US": thruster.curve[-1][0],
            "ANK_MIN_US": ankle_us[0], "ANK_MAX_US": ankle_us[1],
            **dict.fromkeys(TRIMS, 0),
            "BAT_WARN_V": battery.warn_v, "BAT_NOARM_V": battery.no_arm_v, "BAT_NEUTRAL_V": battery.neutral_v,
            "BAT_HYST_V": battery.hysteresis_v, **dict.fromkeys(HIL, 0),
        }  # fmt: skip
        for i, (pulse_us, force_n) in enumerate(thruster.curve, 1):
            values |= {f"CRV{i:02}_US": pulse_us, f"CRV{i:02}_N": force_n}
        return values


class Numeric(Section):
    """The poses of a numeric flight: the true pose with this noise, sim.latency_s old."""

    pose_noise_m: NotNegative = 0.0
    """Standard deviation of x and of y."""
    yaw_noise_rad: NotNegative = 0.0
    """Standard deviation of yaw."""
    obstacle_noise_m: NotNegative = 0.01
    """Standard deviation of the places of sim.drifters, x and y each."""
    obstacle_noise_mps: NotNegative = 0.01
    """Standard deviation of their velocities, x and y each."""


class CameraMotion(Section):
    """The motion of the simulated camera about [camera]'s pose, as under a drone. It needs [[landmarks]]."""

    sway_m: NotNegative = 0.0
    """Largest deviation along each axis."""
    tilt_rad: NotNegative = 0.0
    """Largest turn about each axis."""
    period_s: Positive = 8.0
    """Period of the slowest swing."""

    @property
    def moves(self) -> bool:
        """True if the camera moves at all."""
        return self.sway_m > 0.0 or self.tilt_rad > 0.0


class Drifter(Section):
    """A red ball adrift. The camera has to see it; no robot bounces off it."""

    radius_m: Positive = 0.1
    """Radius of this obstacle."""
    start_m: Vec3
    """Position of this obstacle at from_s."""
    velocity_mps: Vec3 = (0.0, 0.0, 0.0)
    """Velocity in the pool frame."""
    from_s: NotNegative = 0.0
    """Time at which it comes into the water."""

    def place_m(self, time_s: float) -> Array | None:
        """The place of its middle, (3,); None before it comes."""
        since_s = time_s - self.from_s
        return np.array(self.start_m) + since_s * np.array(self.velocity_mps) if since_s >= 0.0 else None


class CameraErrors(Section):
    """Errors of the calibration: the simulated cameras and plates are as their keys say, plus this. Without it the localizer
    knows lens, pose and plates exactly."""

    focal_error: Annotated[float, Field(gt=-0.5, lt=0.5)] = 0.0
    """Relative error of the focal lengths: true = camera.focal_px (1 + error)."""
    position_error_m: tuple[Metre, Metre, Metre] = (0.0, 0.0, 0.0)
    """Error of the position: true = camera.position_m + error."""
    rotation_error_rad: tuple[Turn, Turn, Turn] = (0.0, 0.0, 0.0)
    """Error of the attitude: a further turn (rotation vector) in the camera's frame."""
    plate_error_m: Annotated[float, Field(gt=-0.1, lt=0.1)] = 0.0
    """Error of the plates' height: true = vehicle.marker.height_m + error."""


class Sim(Section):
    """All settings of the simulator."""

    latency_s: Annotated[float, Field(ge=0, le=0.5)] = 0.03
    """Time from an exposure to the control step, in lockstep, numeric flights and with --poses."""
    numeric: Numeric = Numeric()
    """Poses of numeric flights."""
    plant: PlantConfig = PlantConfig()
    """Water and robots."""
    faults: tuple[Fault, ...] = ()
    """Faults to inject."""
    picture: PictureConfig = PictureConfig()
    """The camera's picture."""
    camera: CameraErrors = CameraErrors()
    """Errors of the camera's calibration."""
    camera_motion: CameraMotion = CameraMotion()
    """Motion of the camera."""
    drifters: tuple[Drifter, ...] = ()
    """Obstacles adrift."""
    sensors: Sensors = Sensors()
    """Sensors of the thruster boards."""
    board: BoardRules = BoardRules()
    """Rules of the thruster boards."""
