"""Equations of motion of rigid bodies with added mass in moving water: level (4 axes) or free to tilt (6).

Rows of arrays (rows, n), one column per robot. Velocities are over ground in the body frame; M is the inertia with added
mass, relative = velocity less the water's (Fossen 2021, chapters 6 to 8). Origin: the centre of the sphere, which is the
centre of buoyancy. Where the water's velocity changes, a neutrally buoyant body is taken along (Froude and Krylov): the
water's acceleration adds to the body's.
"""

import numpy as np

from sim_bridge.plant.contact import ContactModel
from sim_bridge.plant.currents_waves import GRAVITY_MPS2, WaterFlow
from sim_bridge.plant.hydrodynamics import Hydrodynamics
from wire.config.experiment import Experiment
from wire.frames import Array
from wire.toml_loader import ConfigError


class FourDofBody:
    """Surge, sway, heave, yaw. State: x, y, z, yaw, u, v, w, r.

        m_u u' - m_v v r = X        m_w w' = Z
        m_v v' + m_u u r = Y        m_r r' - (m_u - m_v) u v = N

    With `sim.plant.sway = false` it is the article's plant: v = 0, and no axis couples with another.
    """

    def __init__(self, experiment: Experiment, flow: WaterFlow, basin: ContactModel) -> None:
        plant = experiment.sim.plant
        self._sway, self._flow, self._basin = plant.sway, flow, basin
        self._water = Hydrodynamics(experiment, tilts=False)
        self._inertia = (experiment.vehicle.inertia * (1.0 + plant.mass_error))[:, None]

    def pack(self, eta: Array, nu: Array, tilt: Array) -> Array:
        """State rows of poses, velocities and tilts (n, 4)."""
        return np.concatenate([eta.T, nu.T])

    def unpack(self, x: Array) -> tuple[Array, Array, Array]:
        """Poses, velocities and tilts (n, 4) of state rows: the inverse of `pack`."""
        return x[:4].T.copy(), x[4:].T.copy(), np.zeros((x.shape[1], 4))

    def acceleration(self, x: Array, rate: Array) -> Array:
        """d nu / dt (n, 4), from a state and its rate."""
        return rate[4:].T.copy()

    def rate(self, x: Array, legs: Array, time_s: float, contact: bool) -> Array:
        """d/dt of the state, with the legs' forces (6, n) on surge, sway, heave, roll, pitch, yaw given."""
        nu = x[4:]
        c, s = np.cos(x[3]), np.sin(x[3])
        rate = np.empty_like(x)
        rate[0] = c * nu[0] - s * nu[1]
        rate[1] = s * nu[0] + c * nu[1]
        rate[2:4] = nu[2:]
        relative = nu if self._flow.still else nu - self._level(self._flow.velocity(x[:3], time_s), c, s)
        force = self._water.drag(relative)
        force[0] += legs[0]
        force[2:4] += legs[2::3]
        force[2] += self._water.lift(x[2])
        if self._water.disturbs:
            force[[0, 2, 3]] += self._water.disturbance(time_s)
        if contact:
            force += self._level(self._basin.contact_force(x[:3].T, rate[:3].T).T, c, s)
        acceleration = force / self._inertia
        if self._sway:
            m_u, m_v, _, m_r = self._inertia
            u, v, r = relative[0], relative[1], relative[3]
            acceleration[0] += m_v / m_u * v * r
            acceleration[1] -= m_u / m_v * u * r
            acceleration[3] += (m_u - m_v) / m_r * u * v
            if not self._flow.still:  # the water's velocity turns in the turning body's frame
                acceleration[0] += (nu[1] - v) * r
                acceleration[1] -= (nu[0] - u) * r
        if not self._flow.steady:
            acceleration += self._level(self._flow.acceleration(x[:3], time_s), c, s)
        if not self._sway:
            acceleration[1] = 0.0
        rate[4:] = acceleration
        return rate

    def _level(self, vectors: Array, c: Array, s: Array) -> Array:
        """Pool vectors (3, n) on the body's axes (4, n)."""
        x, y, z = vectors
        return np.array([c * x + s * y, c * y - s * x, z, np.zeros_like(z)])


class SixDofBody:
    """All six axes. State: x, y, z, roll, pitch, yaw (R = Rz Ry Rx), u, v, w, p, q, r.

    M nu_r' + C(nu_r) nu_r = force, with C from the impulses P, L of M nu_r (Kirchhoff): [omega x P; omega x L + v x P]. That
    is quadratic in nu_r, so one product of a fixed matrix with all pairs nu_j nu_k gives it for the whole fleet.

    The centre of mass lies below the centre of buoyancy: m z_g = righting moment / g couples surge with pitch and sway
    with roll in M, and rights the hull. Pitch must stay below 90 degrees, where yaw is undefined; the righting moment
    keeps it there.
    """

    def __init__(self, experiment: Experiment, flow: WaterFlow, basin: ContactModel) -> None:
        plant, tilt = experiment.sim.plant, experiment.sim.plant.tilt
        self._flow, self._basin = flow, basin
        self._water = Hydrodynamics(experiment, tilts=True)
        self._righting = tilt.righting_nm * np.array([[-1.0], [1.0]])  # N m about roll and pitch, per R[2, 1] and R[2, 0]
        surge, sway, heave, yaw = experiment.vehicle.inertia
        inertia = np.diag([surge, sway, heave, tilt.inertia_kg_m2, tilt.inertia_kg_m2, yaw])
        first_moment = tilt.righting_nm / GRAVITY_MPS2
        inertia[0, 4] = inertia[4, 0] = first_moment
        inertia[1, 3] = inertia[3, 1] = -first_moment
        inertia *= 1.0 + plant.mass_error
        if np.linalg.eigvalsh(inertia)[0] <= 0:
            raise ConfigError(
                f"sim.plant.tilt.righting_nm = {tilt.righting_nm:g}: more than a body of this inertia can have "
                f"(allowed: up to {GRAVITY_MPS2 * np.sqrt(min(surge, sway) * tilt.inertia_kg_m2):.3g})"
            )
        self._inverse = np.linalg.inv(inertia)
        self._coupling = -self._inverse @ _coriolis(inertia)  # (6, 36)

    def pack(self, eta: Array, nu: Array, tilt: Array) -> Array:
        """State rows of poses and level velocities (n, 4), and tilts [roll, pitch, and their rates] (n, 4)."""
        roll, pitch, roll_rate, pitch_rate = tilt.T
        (cr, cp), (sr, sp) = np.cos(tilt.T[:2]), np.sin(tilt.T[:2])
        u, v, w, yaw_rate = nu.T
        ahead, down = cp * u - sp * w, sp * u + cp * w
        return np.array([
            *eta[:, :3].T, roll, pitch, eta[:, 3],
            ahead, cr * v + sr * down, cr * down - sr * v,
            roll_rate - sp * yaw_rate, cr * pitch_rate + sr * cp * yaw_rate, cr * cp * yaw_rate - sr * pitch_rate,
        ])  # fmt: skip

    def unpack(self, x: Array) -> tuple[Array, Array, Array]:
        """Poses, velocities on level axes that turn with the heading, and tilts, (n, 4) each: the inverse of `pack`."""
        (cr, cp), (sr, sp) = np.cos(x[3:5]), np.sin(x[3:5])
        u, v, w, p, q, r = x[6:]
        down, turn = sr * v + cr * w, sr * q + cr * r
        nu = np.array([cp * u + sp * down, cr * v - sr * w, cp * down - sp * u, turn / cp]).T.copy()
        tilt = np.array([x[3], x[4], p + turn * sp / cp, cr * q - sr * r]).T.copy()
        return x[[0, 1, 2, 5]].T.copy(), nu, tilt

    def acceleration(self, x: Array, rate: Array) -> Array:
        """d nu / dt (n, 4) of the level velocities, from a state and its rate, by differences: exact to 1e-9."""
        step_s, n = 1e-4, x.shape[1]
        _, nu, _ = self.unpack(np.concatenate([x + step_s * rate, x - step_s * rate], axis=1))
        return np.asarray((nu[:n] - nu[n:]) / (2.0 * step_s))

    def rate(self, x: Array, legs: Array, time_s: float, contact: bool) -> Array:
        """d/dt of the state, with the legs' forces (6, n) on surge, sway, heave, roll, pitch, yaw given."""
        (cr, cp, cy), (sr, sp, sy) = np.cos(x[3:6]), np.sin(x[3:6])
        turn = np.array([
            [cp * cy, sr * sp * cy - cr * sy, cr * sp * cy + sr * sy],
            [cp * sy, sr * sp * sy + cr * cy, cr * sp * sy - sr * cy],
            [-sp, sr * cp, cr * cp],
        ])  # body to pool, (3, 3, n)  # fmt: skip
        nu = x[6:]
        p, q, r = nu[3:]
        rate = np.empty_like(x)
        np.add.reduce(turn * nu[:3], axis=1, out=rate[:3])
        yaw_rate = (sr * q + cr * r) / cp
        rate[3] = p + sp * yaw_rate
        rate[4] = cr * q - sr * r
        rate[5] = yaw_rate
        relative = nu
        if not self._flow.still:
            stream = _turned(self._flow.velocity(x[:3], time_s), turn)
            relative = nu.copy()
            relative[:3] -= stream
        force = self._water.drag(relative)
        force[:3] += turn[2] * self._water.lift(x[2])
        push = legs.copy()
        push[3:5] += self._righting * turn[2, 1::-1]
        force += push
        if self._water.disturbs:
            force[[0, 2, 5]] += self._water.disturbance(time_s)
        if contact:
            force[:3] += _turned(self._basin.contact_force(x[:3].T, rate[:3].T).T, turn)
        np.add(self._inverse @ force, self._coupling @ (relative[:, None] * relative).reshape(36, -1), out=rate[6:])
        if not self._flow.still:  # the water's velocity turns in the turning body's frame
            a, b, c = stream
            rate[6:9] += np.array([b * r - c * q, c * p - a * r, a * q - b * p])
        if not self._flow.steady:
            rate[6:9] += _turned(self._flow.acceleration(x[:3], time_s), turn)
        return rate


def _turned(vectors: Array, turn: Array) -> Array:
    """Pool vectors (3, n) on the bodies' axes, `turn` (3, 3, n) being their attitudes."""
    return np.asarray(np.add.reduce(turn * vectors[:, None], axis=0))


def _coriolis(inertia: Array) -> Array:
    """Matrix (6, 36) that takes all products nu_j nu_k to C(nu) nu."""
    products = np.zeros((6, 6, 6))
    for j in range(6):
        velocity, spin = np.split(np.eye(6)[j], 2)
        for k in range(6):
            impulse, angular = np.split(inertia[:, k], 2)
            products[:, j, k] = [*np.cross(spin, impulse), *(np.cross(spin, angular) + np.cross(velocity, impulse))]
    return products.reshape(6, 36)
