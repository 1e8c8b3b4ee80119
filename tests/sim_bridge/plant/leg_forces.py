"""The forces of legs, written a second time, and runs of the plant that are compared with it."""

import numpy as np

from shoal.config.vehicle import Vehicle
from shoal.frames import Array
from shoal.messages.messages import required
from sim_bridge.plant.fleet import Plant, PlantState

NEUTRAL = np.full((2, 8), 1500.0)
APART = np.array([[-40.0, 0.0, 5.0, 0.0], [40.0, 0.0, 5.0, 0.0]])
LOPSIDED = ("vehicle.mass.surge_kg=11", "vehicle.mass.sway_kg=17", "vehicle.mass.yaw_kg_m2=0.3")


def run(plant: Plant, state: PlantState, steps: int, pulses_us: Array = NEUTRAL) -> list[PlantState]:
    states = [state]
    for _ in range(steps):
        states.append(plant.step(states[-1], pulses_us))
    return states


def leg_forces(vehicle: Vehicle, pulses_us: Array, time_s: float) -> Array:
    """Forces (4, 3) of the legs in the body's axes, `time_s` after these pulses came on at rest."""
    steady = np.interp(pulses_us[:4], *np.array(vehicle.thruster.curve).T)
    force = steady * -np.expm1(-max(time_s - vehicle.thruster.dead_time_s, 0.0) / vehicle.thruster.lag_s)
    goal = (pulses_us[4:] - 1500.0) / 500.0 * required(vehicle.legs).ankle_range_rad
    turned = required(vehicle.legs).ankle_rate_radps * max(time_s - required(vehicle.legs).ankle_dead_time_s, 0.0)
    angle = np.sign(goal) * np.minimum(np.abs(goal), turned)
    return np.stack([force * np.cos(angle), np.zeros(4), force * np.sin(angle)], axis=1)
