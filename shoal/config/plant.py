"""Keys under [sim.plant]: the simulated water and robots, what the controller does not know."""

from typing import Annotated

from pydantic import Field

from shoal.config.loader import Section
from shoal.config.vehicle import NotNegative, Positive

Vec2 = tuple[float, float]
Vec3 = tuple[float, float, float]
Amplitudes = tuple[NotNegative, NotNegative, NotNegative]


class Tilt(Section):
    """Roll and pitch. The defaults are the article's sphere with 6.5 kg of it 3 cm below its centre: a swing takes 1.6 s."""

    enabled: bool = True
    """Simulate them. False: 4 degrees of freedom."""
    righting_nm: Positive = 1.9
    """Righting moment per sine of the tilt. Default: the vehicle's."""
    inertia_kg_m2: Positive = 0.12
    """Inertia about the axes of roll and pitch, added mass included. Default: by the vehicle's free swing."""
    drag_linear: Positive = 0.08
    """Linear drag of roll and pitch, N m s."""
    drag_quadratic: NotNegative = 0.10
    """Quadratic drag of roll and pitch, N m s^2."""
    legs_below_m: Annotated[float, Field(ge=-1, le=1)] = 0.05
    """Thrusters' distance below the centre. If positive, thrust ahead lifts the bow. Default: the vehicle's."""


class WavesConfig(Section):
    """A regular long-crested wave (Airy's linear theory)."""

    height_m: NotNegative = 0.0
    """Height from trough to crest."""
    period_s: Positive = 2.0
    """Period."""
    direction_rad: float = 0.0
    """Direction of travel, from pool x to pool y."""


class PlantBatteryConfig(Section):
    """Each robot's battery. Thrust goes with its voltage under load."""

    capacity_wh: NotNegative = 55.0
    """Capacity. 0: it never drains, and thrusters follow their curve exactly."""
    curve_v: Positive = 12.0
    """Voltage at which vehicle.thruster.curve was measured. Default: 4 V for each of the vehicle's cells."""
    thruster_w: NotNegative = 25.0
    """Power of one thruster at full thrust; it goes with thrust^1.5."""
    electronics_w: NotNegative = 10.0
    """Power of computer and board."""


class PlantConfig(Section):
    """The simulated water and robots: what the controller does not know."""

    sway: bool = True
    """Simulate sideways motion. False, with tilt disabled: the article's plant."""
    tilt: Tilt = Tilt()
    """Roll and pitch."""
    mass_error: Annotated[float, Field(gt=-1)] = 0.0
    """Relative error of the controller's mass: true = nominal (1 + error)."""
    drag_error: Annotated[float, Field(gt=-1)] = 0.0
    """Relative error of the controller's drag, as for the mass."""
    current_mps: Vec3 = (0.0, 0.0, 0.0)
    """Current at the surface, x, y and z of the pool."""
    current_shear_per_s: Vec2 = (0.0, 0.0)
    """Change of the current's x and y per metre of depth."""
    gust_mps: NotNegative = 0.0
    """Standard deviation of the current's fluctuation, x and y each."""
    gust_s: Positive = 10.0
    """Correlation time of the fluctuation (Gauss-Markov)."""
    waves: WavesConfig = WavesConfig()
    """A wave on the surface."""
    thruster_spread: Annotated[float, Field(ge=0, lt=1)] = 0.10
    """Largest relative difference of a thruster from the curve, drawn for each."""
    thruster_lag_s: Annotated[NotNegative | None, Field(examples=[0.15])] = None
    """Time constant of the simulated thrusters; left out: the vehicle file's."""
    battery: PlantBatteryConfig = PlantBatteryConfig()
    """The robots' batteries."""
    buoyancy_n: float = -0.2
    """Residual weight in water; positive sinks."""
    disturbance_wrench: Amplitudes = (0.0, 0.0, 0.0)
    """Amplitude of a sinusoidal disturbance, N, N and N m (ambiguity A13)."""
    disturbance_hz: Annotated[
        NotNegative | Annotated[tuple[NotNegative, ...], Field(min_length=1)], Field(examples=[0.05])
    ] = 0.0
    """Frequency of that disturbance: one, or one per robot."""
    step_s: Annotated[float, Field(gt=0, le=0.05)] = 0.005
    """Integration step. Contact with walls needs 0.02 or less."""
