"""Keys under [sim.plant]: the simulated water and robots, what the controller does not know."""

from typing import Annotated

from pydantic import Field

from wire.config.vehicle import NotNegative, Positive
from wire.toml_loader import Section

Vec2 = tuple[float, float]
Vec3 = tuple[float, float, float]
Amplitudes = tuple[NotNegative, NotNegative, NotNegative]


class Tilt(Section):
    """Roll and pitch: free, and righted by weight below buoyancy. Disabled, the robot stays level (4 degrees of freedom).

    The defaults are the article's sphere with 6.5 kg of it 3 cm below its centre: it swings once in 1.6 s.
    """

    enabled: bool = True
    righting_nm: Positive = 1.9  # moment per sine of the tilt: weight times its depth below the centre of buoyancy
    inertia_kg_m2: Positive = 0.12  # about either axis, as in yaw
    drag_linear: Positive = 0.08  # N m s, as in yaw
    drag_quadratic: NotNegative = 0.10  # N m s^2
    legs_below_m: Annotated[float, Field(ge=-1, le=1)] = 0.05  # thrusters below the centre: thrust ahead lifts the bow


class WavesConfig(Section):
    """A regular long-crested wave (Airy's linear theory): water goes round in circles that shrink with depth."""

    height_m: NotNegative = 0.0  # trough to crest
    period_s: Positive = 2.0
    direction_rad: float = 0.0  # where it runs, from pool x to pool y


class PlantBatteryConfig(Section):
    """Each robot's battery. It starts at sim.sensors.battery_v; thrust goes with its voltage under load."""

    capacity_wh: NotNegative = 55.0  # 3 cells of 5 Ah; 0: never drains, and thrusters follow their curve exactly
    curve_v: Positive = 12.0  # at which vehicle.thruster.curve was measured
    thruster_w: NotNegative = 25.0  # of one thruster at full thrust; goes with thrust^1.5, as a propeller's power does
    electronics_w: NotNegative = 10.0  # computer and board


class PlantConfig(Section):
    """The simulated water and robots: what the controller does not know."""

    sway: bool = True  # False, with tilt disabled: the article's plant
    tilt: Tilt = Tilt()
    mass_error: Annotated[float, Field(gt=-1)] = 0.0  # true = nominal * (1 + error)
    drag_error: Annotated[float, Field(gt=-1)] = 0.0
    current_mps: Vec3 = (0.0, 0.0, 0.0)  # at the surface
    current_shear_per_s: Vec2 = (0.0, 0.0)  # change of its x and y per metre of depth
    gust_mps: NotNegative = 0.0  # standard deviation of what fluctuates, x and y each
    gust_s: Positive = 10.0  # its correlation time: spectrum of a first-order Gauss-Markov process
    waves: WavesConfig = WavesConfig()
    thruster_spread: Annotated[float, Field(ge=0, lt=1)] = 0.10
    thruster_lag_s: NotNegative | None = None  # default: the vehicle file's
    battery: PlantBatteryConfig = PlantBatteryConfig()
    buoyancy_n: float = -0.2  # residual, positive sinks
    disturbance_wrench: Amplitudes = (0.0, 0.0, 0.0)  # amplitude of a sine [N, N, N m] (ambiguity A13)
    disturbance_hz: NotNegative | Annotated[tuple[NotNegative, ...], Field(min_length=1)] = 0.0  # or one per robot
    step_s: Annotated[float, Field(gt=0, le=0.05)] = 0.005  # contact needs 0.02 or less
