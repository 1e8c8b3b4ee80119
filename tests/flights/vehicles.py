"""Vehicles of the grid: the shipped robot made heavier or lighter, stronger or weaker, slower to turn or to push.

Heavier means larger, of the same shape and density: lengths go with the cube root of the mass, and all limits of speed are
those at which drag balances full thrust, as in the shipped file. One vehicle is of another kind: it pushes sideways too.
"""

import math
from dataclasses import dataclass

import numpy as np

from robot_agent.control.nonlinear import tuning
from shoal.config.plant import PlantConfig
from shoal.config.vehicle import Mass, Vehicle, load_vehicle
from shoal.messages.messages import required

SPHERICAL = load_vehicle("spherical")
SWING_S = SPHERICAL.righting.swing_s if SPHERICAL.righting is not None else 1.6
TILT, BUOYANCY_N = PlantConfig().tilt, PlantConfig().buoyancy_n


@dataclass(frozen=True)
class ScaledVehicle:
    """A vehicle as factors on the shipped one. Thrust and inertia are factors beyond what the mass brings along."""

    mass: float = 1.0
    thrust: float = 1.0
    inertia: float = 1.0  # of yaw
    lag_s: float = SPHERICAL.thruster.lag_s
    dead_time_s: float = SPHERICAL.thruster.dead_time_s

    def settings(self) -> list[str]:
        """The vehicle, and its righting moment in the simulator, as settings of an experiment."""
        length, surface, bulk = self.mass ** (1.0 / 3.0), self.mass ** (2.0 / 3.0), self.mass ** (5.0 / 3.0)
        mass, legs, thruster = SPHERICAL.mass, required(SPHERICAL.legs), SPHERICAL.thruster
        turning = surface * length**2
        linear = np.array(SPHERICAL.drag.linear) * [surface, surface, surface, turning]
        quadratic = np.array(SPHERICAL.drag.quadratic) * [surface, surface, surface, bulk]
        strength = self.thrust * np.array([1.0, 1.0, length])
        wrench = np.array(SPHERICAL.limits.wrench) * strength
        speeds = [steady_speed(linear[i], quadratic[i], w) for i, w in zip((0, 2, 3), wrench.tolist(), strict=True)]
        values = {
            "vehicle.radius_m": SPHERICAL.radius_m * length,
            "vehicle.mass.surge_kg": mass.surge_kg * self.mass,
            "vehicle.mass.sway_kg": mass.sway_kg * self.mass,
            "vehicle.mass.heave_kg": mass.heave_kg * self.mass,
            "vehicle.mass.yaw_kg_m2": mass.yaw_kg_m2 * bulk * self.inertia,
            "vehicle.drag.linear": linear.tolist(),
            "vehicle.drag.quadratic": quadratic.tolist(),
            "vehicle.limits.wrench": wrench.tolist(),
            "vehicle.limits.wrench_rate_per_s": (np.array(SPHERICAL.limits.wrench_rate_per_s) * strength).tolist(),
            "vehicle.limits.speed_mps": speeds[0],
            "vehicle.limits.heave_mps": speeds[1],
            "vehicle.limits.yaw_rate_radps": speeds[2],
            "vehicle.legs.position_m": [[x * length, y * length] for x, y in legs.position_m],
            "vehicle.legs.idle_thrust_n": legs.idle_thrust_n * self.thrust,
            "vehicle.thruster.max_thrust_n": thruster.max_thrust_n * self.thrust,
            "vehicle.thruster.lag_s": self.lag_s,
            "vehicle.thruster.dead_time_s": self.dead_time_s,
            "vehicle.thruster.curve": [[us, force_n * self.thrust] for us, force_n in thruster.curve],
            "vehicle.righting.moment_nm": TILT.righting_nm * self.mass * length,
            "vehicle.righting.thrusters_below_m": TILT.legs_below_m * length,
            "vehicle.righting.swing_s": SWING_S * math.sqrt(length),
            "sim.plant.buoyancy_n": BUOYANCY_N * self.mass,
            "sim.plant.tilt.righting_nm": TILT.righting_nm * self.mass * length,
            "sim.plant.tilt.inertia_kg_m2": TILT.inertia_kg_m2 * bulk,
            "sim.plant.tilt.drag_linear": TILT.drag_linear * turning,
            "sim.plant.tilt.drag_quadratic": TILT.drag_quadratic * bulk,
            "sim.plant.tilt.legs_below_m": TILT.legs_below_m * length,
        }
        return [f"{key}={_rounded(value)}" for key, value in values.items()]


def _rounded(value: object) -> object:
    """The value with six digits: enough for any file, and short enough to read."""
    return (
        [_rounded(part) for part in value]
        if isinstance(value, list)
        else float(f"{value:.6g}")
        if isinstance(value, float)
        else value
    )


def steady_speed(linear: float, quadratic: float, force: float) -> float:
    """The speed at which linear v + quadratic v^2 balances a force."""
    return (math.sqrt(linear**2 + 4.0 * quadratic * force) - linear) / (2.0 * quadratic) if quadratic else force / linear


def fastest_mps(vehicle: Vehicle, mass_error: float, drag_error: float) -> float:
    """The fastest that a vehicle can really swim upright, and may by its file, which is wrong about its mass and drag by
    relative errors. Mass counts: the water's moment on a hull that pitches grows with the added mass."""
    mass, drag = vehicle.mass.model_copy(update=_scaled(vehicle.mass, 1.0 + mass_error)), 1.0 + drag_error
    linear, quadratic = (tuple(drag * axis for axis in part) for part in (vehicle.drag.linear, vehicle.drag.quadratic))
    water = vehicle.drag.model_copy(update={"linear": linear, "quadratic": quadratic})
    true = vehicle.model_copy(update={"mass": mass, "drag": water})
    steady_mps = steady_speed(linear[0], quadratic[0], vehicle.limits.wrench[0])
    return min(tuning.fastest_mps(vehicle), tuning.fastest_mps(true), steady_mps)


def _scaled(mass: Mass, share: float) -> dict[str, float]:
    """All masses and inertias of a vehicle, scaled alike."""
    return {axis: share * kg for axis, kg in mass.model_dump().items()}


@dataclass(frozen=True)
class FileVehicle:
    """A vehicle with a file of its own, and what the simulator has to know besides: weight, and the drag of a swing."""

    name: str
    buoyancy_n: float
    swing_drag: tuple[float, float]  # of roll and pitch, N m s, and N m s^2
    battery_v: float
    curve_v: float  # at which the thrust curve was measured

    def settings(self) -> list[str]:
        """The vehicle, and its body in the simulator, as settings of an experiment."""
        linear, quadratic = self.swing_drag
        return [
            f"vehicle={self.name}",
            "controller.law=nmpc",
            f"sim.plant.buoyancy_n={self.buoyancy_n:g}",
            f"sim.plant.tilt.drag_linear={linear:g}",
            f"sim.plant.tilt.drag_quadratic={quadratic:g}",
            f"sim.sensors.battery_v={self.battery_v:g}",
            f"sim.plant.battery.curve_v={self.curve_v:g}",
        ]


VEHICLES: dict[str, ScaledVehicle | FileVehicle] = {
    "2.3kg": ScaledVehicle(mass=2.3 / 12.0, thrust=0.5),
    "24kg": ScaledVehicle(mass=2.0),
    "40kg": ScaledVehicle(mass=40.0 / 12.0),
    "thrust-0.5": ScaledVehicle(thrust=0.5),
    "thrust-3": ScaledVehicle(thrust=3.0),
    "inertia-0.25": ScaledVehicle(inertia=0.25),
    "inertia-8": ScaledVehicle(inertia=8.0),
    "slow-thrusters": ScaledVehicle(lag_s=0.5, dead_time_s=0.15),
    "quick-thrusters": ScaledVehicle(lag_s=0.05, dead_time_s=0.0),
    "vectored": FileVehicle("vectored", -1.0, (0.07, 1.55), 14.8, 14.0),  # sources: the file's A, and for the drag B
}


def any_build(random: np.random.Generator) -> ScaledVehicle:
    """A vehicle between the extremes: each factor drawn alike on a logarithmic scale. A larger robot has larger thrusters."""
    mass = _between(random, 2.3 / 12.0, 40.0 / 12.0)
    thrust = mass ** (2.0 / 3.0) * _between(random, 0.5, 3.0)
    return ScaledVehicle(
        mass, thrust, _between(random, 0.25, 8.0), _between(random, 0.05, 0.5), float(random.uniform(0.0, 0.15))
    )


def _between(random: np.random.Generator, low: float, high: float) -> float:
    return float(np.exp(random.uniform(np.log(low), np.log(high))))
