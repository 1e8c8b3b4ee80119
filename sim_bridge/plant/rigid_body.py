"""Rigid bodies in water: inertia with added mass, Coriolis forces, drag, buoyancy, righting and disturbance.

`body_acceleration` is the one to read first: the equations of motion (Fossen 2021, chapters 6 to 8). A body has six axes. One
that stays level has no roll and pitch; the article's plant (`sim.plant.sway = false`) has no sway either. The origin is the
centre of the sphere and of buoyancy. The centre of mass lies below it: m z_g = righting moment / g couples surge with pitch
and sway with roll, and rights the hull. Pitch must stay below 90 degrees, where yaw is undefined; the righting moment keeps it
there.
"""

import math
from typing import NamedTuple

import numpy as np

from shoal.config.experiment import Experiment
from shoal.errors import ConfigError
from shoal.frames import Array
from shoal.kernels.decorator import kernel
from shoal.kernels.types import Floats, Table
from sim_bridge.plant.currents_waves import GRAVITY_MPS2, WaterMotion
from sim_bridge.plant.vectors import NO_VECTOR, Rotation, SixVector, Vector, add, cross, dot, row_vector, subtract, to_body

DENSITY_KGPM3 = 998.0  # fresh water at 20 degrees


class BodyConstants(NamedTuple):
    """The hull of every robot of an experiment: constants of the equations of motion."""

    sway: bool  # False: the article's plant. v = 0, each axis by itself
    inertia: Table  # M (6, 6)
    inverse: Table  # M^-1, with rows of zeros for axes that do not move
    drag_linear: SixVector  # of D, N s/m and N m s
    drag_quadratic: SixVector
    righting_nm: float
    buoyancy_n: float  # weight less buoyancy
    radius_m: float
    has_surface: bool
    disturbance: SixVector  # amplitude of a sinusoidal force
    disturbance_radps: Floats  # (n,) of each robot


def hull_of(experiment: Experiment) -> BodyConstants:
    """The hull of an experiment. Raises ConfigError for one that cannot be."""
    plant, vehicle, tilt = experiment.sim.plant, experiment.vehicle, experiment.sim.plant.tilt
    tilts = plant.sway and tilt.enabled

    def with_tilt(per_axis: Array, of_tilt: float) -> Array:
        """Numbers of surge, sway, heave and yaw with those of roll and pitch between them, (6,)."""
        surge, sway, heave, yaw = per_axis
        return np.array([surge, sway, heave, of_tilt, of_tilt, yaw])

    first_moment = tilt.righting_nm / GRAVITY_MPS2 if tilts else 0.0
    inertia = np.diag(with_tilt(vehicle.inertia, tilt.inertia_kg_m2))
    inertia[0, 4] = inertia[4, 0] = first_moment
    inertia[1, 3] = inertia[3, 1] = -first_moment
    inertia *= 1.0 + plant.mass_error
    if np.linalg.eigvalsh(inertia)[0] <= 0:
        surge, sway = vehicle.inertia[:2]
        raise ConfigError(
            f"sim.plant.tilt.righting_nm = {tilt.righting_nm:g}: more than a body of this inertia can have "
            f"(allowed: up to {GRAVITY_MPS2 * np.sqrt(min(surge, sway) * tilt.inertia_kg_m2):.3g})"
        )
    moves = np.array([True, plant.sway, True, tilts, tilts, True])
    drag = 1.0 + plant.drag_error
    surge_n, heave_n, yaw_nm = plant.disturbance_wrench  # (ambiguity A13)
    return BodyConstants(
        sway=plant.sway,
        inertia=inertia,
        inverse=np.linalg.inv(inertia) * moves[:, None],
        drag_linear=six_axes(with_tilt(vehicle.drag_linear, tilt.drag_linear) * drag),
        drag_quadratic=six_axes(with_tilt(vehicle.drag_quadratic, tilt.drag_quadratic) * drag),
        righting_nm=tilt.righting_nm,
        buoyancy_n=plant.buoyancy_n,
        radius_m=vehicle.radius_m,
        has_surface=experiment.pool.walls,  # without walls there is no surface either
        disturbance=SixVector(Vector(surge_n, 0.0, heave_n), Vector(0.0, 0.0, yaw_nm)),
        disturbance_radps=np.broadcast_to(2.0 * np.pi * np.array(plant.disturbance_hz), len(experiment.robots)).copy(),
    )


def six_axes(values: Floats) -> SixVector:
    """The record of six numbers."""
    u, v, w, p, q, r = values.tolist()
    return SixVector(Vector(u, v, w), Vector(p, q, r))


@kernel(inline=True, part=True)
def row_product(matrix: Table, row: int, vector: SixVector) -> float:
    """A row of a matrix (6, 6) times a vector."""
    return dot(row_vector(matrix, row, 0), vector.linear) + dot(row_vector(matrix, row, 3), vector.angular)


@kernel(inline=True, part=True)
def product(matrix: Table, vector: SixVector) -> SixVector:
    """A matrix (6, 6) times a vector."""
    return SixVector(
        Vector(row_product(matrix, 0, vector), row_product(matrix, 1, vector), row_product(matrix, 2, vector)),
        Vector(row_product(matrix, 3, vector), row_product(matrix, 4, vector), row_product(matrix, 5, vector)),
    )


@kernel(inline=True, part=True)
def coriolis(hull: BodyConstants, nu: SixVector) -> SixVector:
    """C(nu) nu = [omega x P, omega x L + v x P] with the momenta [P, L] = M nu (Kirchhoff)."""
    if not hull.sway:
        return SixVector(NO_VECTOR, NO_VECTOR)
    momentum = product(hull.inertia, nu)
    turning = add(cross(nu.angular, momentum.angular), cross(nu.linear, momentum.linear))
    return SixVector(cross(nu.angular, momentum.linear), turning)


@kernel(inline=True, part=True)
def damping(hull: BodyConstants, nu: SixVector) -> SixVector:
    """D(nu) nu: each axis has linear and quadratic drag. On a round hull the horizontal quadratic drag points against the
    flow, and takes the horizontal speed instead of |u| and |v|."""
    (u, v, w), (p, q, r) = nu
    linear, quadratic = hull.drag_linear, hull.drag_quadratic
    horizontal = math.sqrt(u * u + v * v)
    force = Vector(
        (linear.linear.x + quadratic.linear.x * (horizontal if hull.sway else abs(u))) * u,
        (linear.linear.y + quadratic.linear.y * horizontal) * v,
        (linear.linear.z + quadratic.linear.z * abs(w)) * w,
    )
    moment = Vector(
        (linear.angular.x + quadratic.angular.x * abs(p)) * p,
        (linear.angular.y + quadratic.angular.y * abs(q)) * q,
        (linear.angular.z + quadratic.angular.z * abs(r)) * r,
    )
    return SixVector(force, moment)


@kernel(inline=True, part=True)
def restoring(hull: BodyConstants, turn: Rotation, z_m: float) -> SixVector:
    """g(eta) of a hull at a depth: residual buoyancy, above water the missing displacement of the cap of height c = r - z that
    stands out, rho g pi / 3 c^2 (3 r - c), and the righting moment of the low centre of mass."""
    radius_m = hull.radius_m
    cap_m = min(max(radius_m - z_m, 0.0), 2.0 * radius_m) if hull.has_surface else 0.0
    sinking_n = hull.buoyancy_n + DENSITY_KGPM3 * GRAVITY_MPS2 * math.pi / 3.0 * cap_m * cap_m * (3.0 * radius_m - cap_m)
    moment = Vector(hull.righting_nm * turn.sin_roll * turn.cos_pitch, hull.righting_nm * turn.sin_pitch, 0.0)
    return SixVector(to_body(turn, Vector(0.0, 0.0, -sinking_n)), moment)


@kernel(part=True)
def body_acceleration(
    hull: BodyConstants, turn: Rotation, z_m: float, nu: SixVector, tau: SixVector, water: WaterMotion
) -> SixVector:
    """nu' of a body with forces tau on its axes, in water that moves:

        M nu_r' + C(nu_r) nu_r + D(nu_r) nu_r + g(eta) = tau,    nu_r = nu - [R^T water, 0]

    so that nu' = nu_r' + [R^T water' - omega x R^T water, 0].
    """
    stream = to_body(turn, water.velocity_mps)
    nu_r = SixVector(subtract(nu.linear, stream), nu.angular)
    c, d, g = coriolis(hull, nu_r), damping(hull, nu_r), restoring(hull, turn, z_m)
    force = subtract(subtract(subtract(tau.linear, c.linear), d.linear), g.linear)
    moment = subtract(subtract(subtract(tau.angular, c.angular), d.angular), g.angular)
    relative = product(hull.inverse, SixVector(force, moment))
    carried = to_body(turn, water.acceleration_mps2)
    carried = subtract(carried, cross(nu.angular, stream)) if hull.sway else Vector(carried.x, 0.0, carried.z)
    return SixVector(add(relative.linear, carried), relative.angular)
