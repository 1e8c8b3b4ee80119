"""Forces of the water on a hull that moves through it: drag, buoyancy, and the disturbance of the article's scenes.

Forces and velocities are rows of arrays (axes, n); the first three axes are surge, sway, heave, the last is yaw.
"""

import numpy as np

from sim_bridge.plant.currents_waves import GRAVITY_MPS2
from wire.config.experiment import Experiment
from wire.frames import Array

DENSITY_KGPM3 = 998.0  # fresh water at 20 degrees


class Hydrodynamics:
    """Drag, buoyancy and the disturbance of an experiment."""

    def __init__(self, experiment: Experiment, tilts: bool) -> None:
        plant, vehicle = experiment.sim.plant, experiment.vehicle
        linear, quadratic = vehicle.drag_linear, vehicle.drag_quadratic
        if tilts:
            linear = np.insert(linear, 3, [plant.tilt.drag_linear] * 2)
            quadratic = np.insert(quadratic, 3, [plant.tilt.drag_quadratic] * 2)
        self._linear = linear[:, None] * (1.0 + plant.drag_error)
        self._quadratic = quadratic[:, None] * (1.0 + plant.drag_error)
        self._is_round = plant.sway
        self._buoyancy_n = plant.buoyancy_n
        self._radius_m = vehicle.radius_m
        self._has_surface = experiment.pool.walls
        self._amplitude = np.array(plant.disturbance_wrench)[:, None]
        self._radps = 2.0 * np.pi * np.broadcast_to(np.array(plant.disturbance_hz), len(experiment.robots))
        self.disturbs = bool(self._amplitude.any())

    def drag(self, relative: Array) -> Array:
        """Drag (axes, n) at a velocity relative to the water (axes, n).

        The nominal model takes each axis by itself: (d + q |v|) v. On a round hull the horizontal drag points against the
        flow, so its quadratic part takes the horizontal speed instead of |u| and |v|: the same when the robot moves along
        one axis, up to 1.4 times more when it moves diagonally. Without sway it is the article's model.
        """
        speed = np.abs(relative)
        if self._is_round:
            speed[:2] = np.hypot(relative[0], relative[1])
        force: Array = -(self._linear + self._quadratic * speed) * relative
        return force

    def lift(self, z_m: Array) -> Array | float:
        """Vertical force on hulls at depths (n,), down positive: residual buoyancy, and above water the missing
        displacement of the cap that stands out. One number if it is the same for all."""
        down: Array | float = self._buoyancy_n
        if self._has_surface and z_m.min() < self._radius_m:
            height = np.clip(self._radius_m - z_m, 0.0, 2.0 * self._radius_m)
            down = down + DENSITY_KGPM3 * GRAVITY_MPS2 * np.pi / 3.0 * height**2 * (3.0 * self._radius_m - height)
        return down

    def disturbance(self, time_s: float) -> Array:
        """[surge N, heave N, yaw N m] of the article's waves on each hull, (3, n) (ambiguity A13)."""
        return np.asarray(self._amplitude * np.sin(self._radps * time_s))
