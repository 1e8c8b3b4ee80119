"""Constants of the robots' equations of motion: inertia with added mass, drag, buoyancy, righting and disturbance.

A body has six axes; one that stays level has no roll and pitch, and the article's plant (`sim.plant.sway = false`) no sway
either. Origin: the centre of the sphere, which is the centre of buoyancy. The centre of mass lies below it: m z_g = righting
moment / g couples surge with pitch and sway with roll, and rights the hull. Pitch must stay below 90 degrees, where yaw is
undefined; the righting moment keeps it there. kernels.dynamics has the equations.
"""

import numpy as np

from shoal.config.experiment import Experiment
from shoal.errors import ConfigError
from sim_bridge.plant.kernels import GRAVITY_MPS2


class RigidBody:
    """The hull of every robot of an experiment."""

    def __init__(self, experiment: Experiment) -> None:
        plant, vehicle, tilt = experiment.sim.plant, experiment.vehicle, experiment.sim.plant.tilt
        tilts = plant.sway and tilt.enabled
        free = np.array([True, plant.sway, True, tilts, tilts, True])
        first_moment = tilt.righting_nm / GRAVITY_MPS2 if tilts else 0.0
        inertia = np.diag(np.insert(vehicle.inertia, 3, [tilt.inertia_kg_m2] * 2))
        inertia[0, 4] = inertia[4, 0] = first_moment
        inertia[1, 3] = inertia[3, 1] = -first_moment
        inertia *= 1.0 + plant.mass_error
        if np.linalg.eigvalsh(inertia)[0] <= 0:
            surge, sway = vehicle.inertia[:2]
            raise ConfigError(
                f"sim.plant.tilt.righting_nm = {tilt.righting_nm:g}: more than a body of this inertia can have "
                f"(allowed: up to {GRAVITY_MPS2 * np.sqrt(min(surge, sway) * tilt.inertia_kg_m2):.3g})"
            )
        drag = 1.0 + plant.drag_error
        self.constants = (
            plant.sway,
            np.diag(inertia).copy(),
            inertia[0, 4],
            np.linalg.inv(inertia) * free,
            np.insert(vehicle.drag_linear, 3, [tilt.drag_linear] * 2) * drag,
            np.insert(vehicle.drag_quadratic, 3, [tilt.drag_quadratic] * 2) * drag,
            tilt.righting_nm,
            plant.buoyancy_n,
            vehicle.radius_m,
            experiment.pool.walls,  # without walls there is no surface either
            np.array(plant.disturbance_wrench),  # [surge N, heave N, yaw N m] (ambiguity A13)
        )
        self.wave_radps = np.broadcast_to(2.0 * np.pi * np.array(plant.disturbance_hz), len(experiment.robots))[:, None].copy()
