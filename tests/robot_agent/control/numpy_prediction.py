"""The linearised model in NumPy and LAPACK in place of loops, an independent oracle; and steps of the one with loops."""

import numpy as np
from numpy.typing import NDArray
from scipy.linalg.lapack import dtbtrs

from robot_agent.control.linearisation import Prediction, superpose
from robot_agent.vehicle.dynamics import Model, State
from shoal.frames import Array

TINY = 1e-12  # m/s: keeps 0/0 out


class NumpyPrediction:
    """Affine prediction of poses for `horizon` nodes `period_s` apart, with the inputs held over `blocks` (the last to the
    end).

    After `linearise` the rows hold, per input block and last the free response, at nodes 0..horizon: `position` (2 blocks + 1,
    nodes) complex: x + iy by surge blocks, yaw blocks, free; `heave` and `yaw` (blocks + 1, nodes) by heave or yaw blocks,
    free. `eta` and `nu` (2, nodes, 2) are the nominal trajectory: (x, y), (z, yaw); (u, v), (w, r).
    """

    def __init__(self, model: Model, period_s: float, horizon: int, blocks: tuple[int, ...]) -> None:
        self._n, self._dt, self._mass = len(blocks), period_s, model.mass
        rows, planar, nodes = len(blocks) + 1, 2 * len(blocks) + 1, horizon + 1
        self.eta, self.nu = np.zeros((2, nodes, 2)), np.zeros((2, nodes, 2))
        self.position = np.zeros((planar, nodes), dtype=np.complex128)
        self._sunk_turned = np.zeros((rows, nodes), dtype=np.complex128)
        self.heave, self.yaw = self._sunk_turned.real, self._sunk_turned.imag
        self._turning = np.zeros((rows, nodes, 2))  # (w, r), rows as `yaw`
        self._speed = np.zeros((planar, nodes, 2))  # (u, v), rows as `position`
        self._flow = np.zeros((2, horizon, 2))  # the speeds that press on u and v, w, r: |u + iv| twice, |w|, |r|
        self._levels = np.zeros((2, 2, 2))
        self._planar, self._changes = np.ones(planar), np.ones((2, rows))  # block changes, and one for the free response
        self._drag_and_coriolis(model, horizon)
        self._thrust(model, horizon, blocks)
        # LAPACK's lower bands, transposed: a row per unknown, entry d lies d places below the diagonal. Unknowns are w0 r0 w1
        # r1 ... and u0 v0 u1 v1 ...: each depends on its value at the node before, u and v on one another's too.
        turning, speed = np.zeros((2 * nodes, 3)), np.zeros((2 * nodes, 4))
        self._turning_band, self._speed_band = turning.T, speed.T
        self._turning_keep = turning[:-2, 2]
        self._speed_keep, self._u_from_v, self._v_from_u = speed[:-2, 2], speed[1:-2:2, 1], speed[:-2:2, 3]

    def _drag_and_coriolis(self, model: Model, horizon: int) -> None:
        """Repeat the coefficients for every node: with rows of four NumPy's inner loops would be of length four."""
        dt, sway = self._dt, 1.0 if model.sway else 0.0

        def at_nodes(u: float, v: float, w: float, r: float) -> Array:
            return np.repeat(np.array(((u, v), (w, r)))[:, None], horizon, axis=1)

        per_mass = -dt / np.array(model.mass)
        self._linear, self._quadratic = at_nodes(*per_mass * model.linear), at_nodes(*per_mass * model.quadratic)
        self._coriolis_u, self._coriolis_v = dt * model.coriolis, -sway * dt / model.coriolis
        self._quadratic_u, self._quadratic_v = (float(q) for q in self._quadratic[0, 0])
        self._sway_step = sway * dt

    def _thrust(self, model: Model, horizon: int, blocks: tuple[int, ...]) -> None:
        """Compute the inputs of the chains: per step, for a unit of each block, and for the decaying thrust that acts now
        (thrusters lag)."""
        n, dt, mass = self._n, self._dt, model.mass
        left, mean = model.lag(dt)
        starts = np.concatenate([[0], np.cumsum(blocks)])
        active = np.zeros((n, horizon))
        for b in range(n):
            active[b, starts[b] : starts[b + 1] if b + 1 < n else None] = 1.0
        response, thrust = np.zeros_like(active), np.zeros(n)
        for k in range(horizon):
            response[:, k] = active[:, k] + (thrust - active[:, k]) * mean
            thrust = active[:, k] + (thrust - active[:, k]) * left
        self._fading = np.stack([np.ones(horizon), mean * left ** np.arange(horizon)], axis=1)
        self._turning_drive, self._speed_drive = np.zeros((n + 1, horizon, 2)), np.zeros((2 * n + 1, horizon, 2))
        self._turning_drive[:-1] = response[:, :, None] * (dt / mass[2], dt / mass[3])
        self._speed_drive[:n, :, 0] = response * (dt / mass[0])

    def restart(self, state: State) -> None:
        """Forget the nominal trajectory: linearise around this state at every node."""
        self.eta[0], self.eta[1], self.nu[0], self.nu[1] = state[:2], state[2:4], state[4:6], state[6:8]

    def poses(self) -> Array:
        """Copy of the nominal trajectory's poses (nodes, 4)."""
        return np.concatenate((self.eta[0], self.eta[1]), axis=1)

    def linearise(self, state: State, wrench: Array, disturbance: Array, current: complex = 0j) -> None:
        """Compute the responses for a start `state`, the wrench (3,) that the blocks are changes to, Gamma (4,), and water
        that streams at `current` (x + iy, m/s). Velocities are through the water."""
        eta, nu, flow = self.eta, self.nu, self._flow
        turned = eta[1, :, 1]
        turned += state[3] - turned[0]  # the plan's turn, from the heading there is
        eta[0, 0], eta[1, 0], nu[0, 0], nu[1, 0] = state[:2], state[2:4], state[4:6], state[6:8]
        before = nu[:, :-1]
        speed = np.abs(before[0].view(np.complex128))
        np.maximum(speed, TINY, out=flow[0])
        np.abs(before[1], out=flow[1])
        slope = before * before
        slope[0] /= flow[0]
        slope[1] = flow[1]
        slope += flow
        slope *= self._quadratic
        slope += self._linear
        keep = np.exp(slope)
        held = keep - 1.0
        held /= slope
        push = flow * before  # where quadratic drag's tangent meets zero speed
        push *= self._quadratic
        np.subtract(self._applied(state, wrench, disturbance), push, out=push)
        self._turn_and_dive(state, keep[1], held[1], push[1])
        self._surge_and_sway(state, keep[0], held[0], push[0])
        self._move(state, current)

    def _applied(self, state: State, wrench: Array, disturbance: Array) -> Array:
        """Velocity per step (2, horizon, 2) of the disturbance and of the wrench that thrusters approach."""
        dt, (mass_u, _, mass_w, mass_r) = self._dt, self._mass
        x, z, n = wrench.tolist()
        u, v, w, r = disturbance.tolist()
        per_u, per_w, per_r = dt / mass_u, dt / mass_w, dt / mass_r
        lasts_uv, fades_uv = (dt * u + per_u * x, self._sway_step * v), (per_u * (state[8] - x), 0.0)
        lasts_wr, fades_wr = (dt * w + per_w * z, dt * r + per_r * n), (per_w * (state[9] - z), per_r * (state[10] - n))
        self._levels.reshape(-1)[:] = (*lasts_uv, *fades_uv, *lasts_wr, *fades_wr)
        return np.asarray(np.matmul(self._fading, self._levels))

    def _turn_and_dive(self, state: State, keep: Array, held: Array, push: Array) -> None:
        """Solve heave and yaw rate, each by itself, and their integrals z and yaw."""
        rates, drive = self._turning, self._turning_drive
        drive[-1] = push
        np.multiply(drive, held, out=rates[:, 1:])
        rates[-1, 0] = state[6:8]
        np.negative(keep.ravel(), out=self._turning_keep)
        dtbtrs(self._turning_band, rates.reshape(self._n + 1, -1).T, uplo="L", diag="U", overwrite_b=1)
        _integrate(rates.view(np.complex128)[:, :, 0], 0.5 * self._dt, complex(state[2], state[3]), self._sunk_turned)

    def _surge_and_sway(self, state: State, keep: Array, held: Array, push: Array) -> None:
        """Solve surge and sway, coupled by the common drag speed and by the turn; v r is linearised as v0 r + r0 v - v0 r0."""
        n, speed, drive = self._n, self._speed, self._speed_drive
        u, v, r = self.nu[0, :-1, 0], self.nu[0, :-1, 1], self.nu[1, :-1, 1]
        u_from_r, v_from_r = self._coriolis_u * v, self._coriolis_v * u
        rate = self._turning[:, :-1, 1]
        np.multiply(rate, u_from_r, out=drive[n:, :, 0])
        np.multiply(rate, v_from_r, out=drive[n:, :, 1])
        u_from_r *= r
        v_from_r *= r
        push[:, 0] -= u_from_r
        push[:, 1] -= v_from_r
        drive[-1] += push
        np.multiply(drive, held, out=speed[:, 1:])
        speed[-1, 0] = state[4:6]
        mixed = u * v
        mixed /= self._flow[0, :, 0]
        np.negative(keep.ravel(), out=self._speed_keep)
        np.multiply(-self._coriolis_u * r - self._quadratic_u * mixed, held[:, 0], out=self._u_from_v)
        np.multiply(-self._coriolis_v * r - self._quadratic_v * mixed, held[:, 1], out=self._v_from_u)
        dtbtrs(self._speed_band, speed.reshape(2 * n + 1, -1).T, uplo="L", diag="U", overwrite_b=1)

    def _move(self, state: State, current: complex) -> None:
        """Integrate (x + iy)' = (u + iv) exp(i yaw) + current, linearised in yaw."""
        yaw = self.eta[1, :, 1]
        rotation = np.exp(1j * yaw)
        turn = self.nu[0].view(np.complex128)[:, 0] * rotation
        turn *= 1j
        velocity = self._speed.view(np.complex128)[:, :, 0] * rotation
        velocity[self._n :] += turn * self.yaw
        turn *= yaw
        turn -= current
        velocity[-1] -= turn
        _integrate(velocity, 0.5 * self._dt, complex(state[0], state[1]), self.position)

    def set_nominal(self, surge_yaw: Array, heave: Array) -> None:
        """Make the response to block changes `surge_yaw` (2 blocks) and `heave` (blocks) the nominal trajectory."""
        n, planar, turning = self._n, self._planar, self._changes
        planar[:-1] = surge_yaw
        turning[0, :-1], turning[1, :-1] = heave, surge_yaw[n:]
        np.dot(planar, self.position.view(np.float64), out=self.eta[0].reshape(-1))
        np.dot(planar, self._speed.reshape(2 * n + 1, -1), out=self.nu[0].reshape(-1))
        sunk_turned = np.dot(turning, self._sunk_turned.view(np.float64))
        rates = np.dot(turning, self._turning.reshape(n + 1, -1))
        self.eta[1, :, 0], self.eta[1, :, 1] = sunk_turned[0, ::2], sunk_turned[1, 1::2]
        self.nu[1, :, 0], self.nu[1, :, 1] = rates[0, ::2], rates[1, 1::2]


def _integrate(rate: NDArray[np.complex128], half_step_s: float, start: complex, out: NDArray[np.complex128]) -> None:
    """Trapezoidal running integral of every row (rows, nodes); `start` belongs to the last row, the free response."""
    steps = rate[:, 1:] + rate[:, :-1]
    steps *= half_step_s
    steps[-1, 0] += start
    np.add.accumulate(steps, axis=1, out=out[:, 1:])
    out[-1, 0] = start


def numpy_cost(prediction: NumpyPrediction, reference: Array, weight: Array) -> tuple[Array, Array]:
    """P and q of (35) as Gram matrices of unit responses, over surge, yaw and heave blocks."""
    n = len(prediction.yaw) - 1
    free, root = prediction.position[-1] - reference @ (1.0, 1j, 0.0, 0.0), np.sqrt(weight)
    planar = np.vstack([prediction.position[:-1], free])[:, 1:]
    turned = np.vstack([np.zeros((n, len(reference))), prediction.yaw[:-1], prediction.yaw[-1] - reference[:, 3]])[:, 1:]
    sunk = np.vstack([prediction.heave[:-1], prediction.heave[-1] - reference[:, 2]])[:, 1:]
    rows = np.hstack([root[0] * planar.real, root[1] * planar.imag, root[3] * turned])
    moving, sinking = rows @ rows.T, weight[2] * sunk @ sunk.T
    p = np.zeros((3 * n, 3 * n))
    p[: 2 * n, : 2 * n], p[2 * n :, 2 * n :] = moving[:-1, :-1], sinking[:-1, :-1]
    return p, np.append(moving[-1, :-1], sinking[-1, :-1])


def linearise(
    prediction: Prediction, state: State | Array, lacking: Array, gamma: Array, current: complex = 0j
) -> tuple[Array, Array]:
    """Linearise, and return P and q of (35) at unit weights for a reference at the origin, without a price of changes."""
    nodes, blocks = prediction.yaw.shape[0], prediction.yaw.shape[1] - 1
    p, q, nothing = np.zeros((3 * blocks, 3 * blocks)), np.zeros(3 * blocks), np.zeros((3 * blocks, 3 * blocks))
    prediction.linearise_and_condense(
        np.array(state), np.zeros(3), lacking, gamma, current, np.zeros((nodes, 4)), np.ones(4), nothing, np.zeros(3), p, q
    )
    return p, q


def follow_without_moving_on(prediction: Prediction, blocks: Array) -> Array:
    """Make the response to the blocks the nominal trajectory from the same instant on. Returns its poses."""
    eta = prediction.follow_plan(blocks)
    u, v, w, r = (*prediction.planar[2:], *prediction.axial[2:])
    superpose(blocks, u, v, w, r, prediction.nu)
    prediction.eta[:] = eta
    return eta
