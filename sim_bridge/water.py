"""What surrounds the robots: water that resists, carries and lifts, and the basin's walls.

Forces come as (n, 4) arrays on nu's axes [surge N, sway N, heave N, yaw N m]. Roll and pitch would need a centre of buoyancy
above the centre of mass here, and two more columns.
"""

import numpy as np

from wire.experiment import Experiment
from wire.frames import Array

DENSITY_KGPM3 = 998.0  # fresh water at 20 degrees
GRAVITY_MPS2 = 9.81

# Contact is a spring that one robot's mass swings on at this rate: 0.5 m/s dents 8 mm, which steps of 5 ms resolve.
CONTACT_RADPS = 30.0
# Hunt and Crossley (1975): damping that grows with the dent, so that the force starts from zero and never pulls. At this
# value 0.6 of the speed is left after a bump at 0.1 m/s, 0.2 at 0.5 m/s. Contact has no friction.
CONTACT_DAMPING_S_PER_M = 10.0
NEAR_M = 0.1  # contact is looked at from this far; no robot gets further in one step


class Water:
    """Drag, current, buoyancy and the disturbance of an experiment."""

    def __init__(self, experiment: Experiment) -> None:
        plant, vehicle = experiment.sim.plant, experiment.vehicle
        self._linear = vehicle.drag_linear * (1.0 + plant.drag_error)
        self._quadratic = vehicle.drag_quadratic * (1.0 + plant.drag_error)
        self._is_round = plant.sway
        self._current_mps = plant.current_mps
        self._buoyancy_n = plant.buoyancy_n
        self._radius_m = vehicle.radius_m
        self._has_surface = plant.walls
        self._amplitude = np.array(plant.disturbance_wrench)
        self._radps = 2.0 * np.pi * np.broadcast_to(np.array(plant.disturbance_hz), len(experiment.robots))

    def current(self, cos_yaw: Array, sin_yaw: Array) -> Array:
        """The current seen from bodies of heading (n,), as a velocity (n, 4)."""
        x, y, z = self._current_mps
        current = np.zeros((len(cos_yaw), 4))
        current[:, 0] = cos_yaw * x + sin_yaw * y
        current[:, 1] = cos_yaw * y - sin_yaw * x
        current[:, 2] = z
        return current

    def drag(self, relative: Array) -> Array:
        """Force against a velocity relative to the water (n, 4).

        The nominal model takes each axis by itself: (d + q |v|) v. On a round hull the horizontal drag points against the
        flow, so its quadratic part takes the horizontal speed instead of |u| and |v|: the same when the robot moves along
        one axis, up to 1.4 times more when it crabs. Without sway it is the article's model.
        """
        speed = np.abs(relative)
        if self._is_round:
            speed[:, 0] = speed[:, 1] = np.hypot(relative[:, 0], relative[:, 1])
        force: Array = -(self._linear + self._quadratic * speed) * relative
        return force

    def lift(self, z_m: Array) -> Array:
        """Vertical force on hulls at depths (n,), down positive: residual buoyancy, and above water the missing displacement
        of the cap that stands out."""
        down = np.full_like(z_m, self._buoyancy_n)
        if self._has_surface and z_m.min() < self._radius_m:
            height = np.clip(self._radius_m - z_m, 0.0, 2.0 * self._radius_m)
            down += DENSITY_KGPM3 * GRAVITY_MPS2 * np.pi / 3.0 * height**2 * (3.0 * self._radius_m - height)
        return down

    def disturbance(self, time_s: float) -> Array:
        """[surge N, heave N, yaw N m] that waves put on each hull, shape (n, 3) (ambiguity A13)."""
        return np.asarray(np.sin(self._radps * time_s)[:, None] * self._amplitude)


class Basin:
    """Walls, floor and other robots: what a hull, a sphere, can bump into."""

    def __init__(self, experiment: Experiment) -> None:
        length, width, depth = experiment.pool.size_m
        self._radius_m = experiment.vehicle.radius_m
        has_walls = experiment.sim.plant.walls
        reach = np.array([length / 2, width / 2, depth]) if has_walls else np.full(3, np.inf)
        self._inside_m = reach - self._radius_m  # for centres; z has a floor only, the surface is water's business
        self._stiffness_npm = float(experiment.vehicle.mass.surge_kg) * CONTACT_RADPS**2

    def is_near(self, position_m: Array) -> bool:
        """Whether any hull at (n, 3) is about to touch something."""
        into_wall, _ = self._wall_dents(position_m)
        return bool((into_wall > -NEAR_M).any() or (self._pair_dents(position_m)[0] > -NEAR_M).any())

    def touches(self, position_m: Array) -> list[int]:
        """Indices of the hulls that touch a wall, the floor or another hull."""
        into_wall, _ = self._wall_dents(position_m)
        into_other, _ = self._pair_dents(position_m)
        return [int(i) for i in np.flatnonzero((into_wall > 0).any(axis=1) | (into_other > 0).any(axis=1))]

    def push(self, position_m: Array, velocity_mps: Array) -> Array:
        """Contact forces (n, 3) on hulls at (n, 3) that move at (n, 3), all in the pool frame."""
        dent, outward = self._wall_dents(position_m)
        force = -outward * self._normal_force(dent, outward * velocity_mps)
        dent, normal = self._pair_dents(position_m)
        closing = -np.sum((velocity_mps[:, None] - velocity_mps) * normal, axis=2)
        return np.asarray(force + np.sum(self._normal_force(dent, closing)[..., None] * normal, axis=1))

    def _wall_dents(self, position_m: Array) -> tuple[Array, Array]:
        """How deep each hull is in a wall per axis (n, 3), negative when clear, and which way that wall faces (+-1)."""
        outward = np.where(position_m < 0.0, -1.0, 1.0)
        outward[:, 2] = 1.0
        return outward * position_m - self._inside_m, outward

    def _pair_dents(self, position_m: Array) -> tuple[Array, Array]:
        """How deep hulls are in one another (n, n), negative when clear, and unit vectors (n, n, 3) from column to row."""
        apart = position_m[:, None] - position_m
        distance = np.sqrt(np.sum(apart**2, axis=2))
        np.fill_diagonal(distance, np.inf)
        return 2.0 * self._radius_m - distance, apart / np.maximum(distance, 1e-9)[..., None]

    def _normal_force(self, dent_m: Array, dent_rate_mps: Array) -> Array:
        damping = np.maximum(1.0 + CONTACT_DAMPING_S_PER_M * dent_rate_mps, 0.0)
        return self._stiffness_npm * np.maximum(dent_m, 0.0) * damping
