"""The model along a horizon: poses at all nodes as an affine function of the wrenches to come (17-25, 33, condensed).

Linearised along a nominal trajectory, each node around its own point, the horizon is a chain of recursions that is
triangular and banded: heave and yaw rate alone, then surge with sway, then poses as running sums. LAPACK's banded solve
runs each chain for the free response and all input blocks at once (5 us; a Python loop over 50 nodes takes 100).
"""

import numpy as np
from scipy.linalg.lapack import dtbtrs

from robot_agent.model import Model, State
from wire.frames import Array

TINY = 1e-12  # m/s: keeps 0/0 out


class Prediction:
    """Workspaces for `horizon` nodes `period_s` apart with the inputs held over `blocks` (the last block to the end).

    After `linearise` the rows hold, per input block and last the free response, at nodes 1..horizon:
    `planar` (2 blocks + 1, 3, horizon): x, y, yaw by surge blocks, yaw blocks, free; `heave` (blocks + 1, horizon): z.
    """

    def __init__(self, model: Model, period_s: float, horizon: int, blocks: tuple[int, ...]) -> None:
        self.blocks, self.horizon, self._model, self._dt = len(blocks), horizon, model, period_s
        n, h = len(blocks), horizon
        self.nominal = np.zeros((8, h + 1))  # eta, nu to linearise along, nodes 0..horizon
        self.planar = np.zeros((2 * n + 1, 3, h))
        self.heave = np.zeros((n + 1, h))
        self._input_yaw = np.zeros((n + 1, h))  # mean thrust in each step, per block and free
        self._rate = np.zeros((n + 1, h))  # yaw rate by yaw blocks, free
        self._speed = np.zeros((2 * n + 1, h, 2))  # surge and sway, interleaved, by surge blocks, yaw blocks, free
        self._climb = np.zeros((n + 1, h))
        self._speeds = np.zeros((4, h))  # that drag depends on, at nodes 0..horizon-1
        self._band_rate, self._band_climb = np.zeros((2, h), order="F"), np.zeros((2, h), order="F")
        self._band_speed = np.zeros((4, 2 * h), order="F")
        mass = np.array(model.mass)[:, None]
        self._mass, self._linear, self._quadratic = mass, np.array(model.linear)[:, None], np.array(model.quadratic)[:, None]
        self._response, self._remains = self._lag_response(blocks)

    def _lag_response(self, blocks: tuple[int, ...]) -> tuple[Array, Array]:
        """Mean thrust in each step for a unit of each block (blocks, horizon), and of the thrust there was (horizon,)."""
        left, mean = self._model.lag(self._dt)
        starts = np.concatenate([[0], np.cumsum(blocks)])
        active = np.zeros((len(blocks), self.horizon))
        for b in range(len(blocks)):
            active[b, starts[b] : starts[b + 1] if b + 1 < len(blocks) else None] = 1.0
        response, thrust = np.zeros_like(active), np.zeros(len(blocks))
        for k in range(self.horizon):
            response[:, k] = active[:, k] + (thrust - active[:, k]) * mean
            thrust = active[:, k] + (thrust - active[:, k]) * left
        return response, mean * left ** np.arange(self.horizon)

    def restart(self, state: State) -> None:
        """Forget the nominal trajectory: linearise around this state at every node."""
        self.nominal[:] = np.array(state[:8])[:, None]

    def shift(self) -> None:
        """Move the nominal trajectory on by one step; its last node stands twice."""
        self.nominal[:, :-1] = self.nominal[:, 1:]

    def linearise(self, state: State, wrench: Array, disturbance: Array) -> None:
        """Fill the responses for a start `state`, the wrench (3,) that the blocks are changes to, and Gamma (4,)."""
        nominal = self.nominal
        nominal[3] += state[3] - nominal[3, 0]  # the plan's turn, from the heading there is
        nominal[:, 0] = state[:8]
        velocity, speed = nominal[4:, :-1], self._speeds
        np.abs(nominal[4:, :-1], out=speed)
        np.hypot(nominal[4, :-1], nominal[5, :-1], out=speed[0])
        speed[1] = speed[0]
        bent = self._quadratic * speed
        share = velocity * velocity / np.maximum(speed, TINY)  # of an axis in its speed
        slope = (self._linear + bent + self._quadratic * share) / self._mass
        keep = np.exp(-slope * self._dt)
        gain = (1.0 - keep) / slope
        push = gain * (bent * velocity / self._mass + disturbance[:, None])  # of quadratic drag's offset and Gamma
        gain /= self._mass
        free_thrust = wrench[:, None] + (np.array(state[8:11]) - wrench)[:, None] * self._remains
        self._yaw(state, keep[3], gain[3], push[3] + gain[3] * free_thrust[2])
        self._surge_sway(state, keep, gain, push, free_thrust[0])
        self._positions(state)
        self._heave(state, keep[2], gain[2], push[2] + gain[2] * free_thrust[1])

    def _yaw(self, state: State, keep: Array, gain: Array, free: Array) -> None:
        rate = self._rate
        np.multiply(self._response, gain, out=rate[:-1])
        rate[-1] = free
        _run(self._band_rate, keep, rate, state[7])
        _integrate(rate, self._dt, state[7], state[3], self.planar[self.blocks :, 2])

    def _surge_sway(self, state: State, keep: Array, gain: Array, push: Array, thrust: Array) -> None:
        n, speed, band = self.blocks, self._speed, self._band_speed
        u, v, r = self.nominal[4, :-1], self.nominal[5, :-1], self.nominal[7, :-1]
        # u r and v r, linearised: v r ~ v0 r + r0 v - v0 r0
        hold_u = gain[0] * self._mass[1, 0]  # dt phi m_v / m_u
        hold_v = -gain[1] * self._mass[0, 0] if self._model.sway else np.zeros_like(u)
        np.multiply(self._response, gain[0], out=speed[:n, :, 0])
        speed[:n, :, 1] = 0.0
        rate = speed[n:]
        rate[:, 1:, 0] = self._rate[:, :-1] * (hold_u * v)[1:]
        rate[:, 1:, 1] = self._rate[:, :-1] * (hold_v * u)[1:]
        rate[:-1, 0] = 0.0
        rate[-1, 0] = 0.0
        free = speed[-1]
        free[:, 0] += push[0] + gain[0] * thrust - hold_u * v * r
        free[:, 1] += (push[1] if self._model.sway else 0.0) - hold_v * u * r
        along = u * v / np.maximum(self._speeds[0], TINY)  # how each axis's speed adds to the other's drag
        cross_u = hold_u * r - gain[0] * self._quadratic[0] * along
        cross_v, keep_v = np.zeros_like(u), np.zeros_like(u)
        if self._model.sway:
            cross_v, keep_v = hold_v * r - gain[1] * self._quadratic[1] * along, keep[1]
        # node 0 is given: what it hands to node 1 joins the free response (r there is the state's own)
        free[0, 0] += keep[0, 0] * state[4] + cross_u[0] * state[5] + hold_u[0] * v[0] * state[7]
        free[0, 1] += keep_v[0] * state[5] + cross_v[0] * state[4] + hold_v[0] * u[0] * state[7]
        # unknowns u1 v1 u2 v2 ...: LAPACK's lower band, row d holds the entry d places below the diagonal
        band[1, 1:-1:2] = -cross_u[1:]  # v_k -> u_k+1
        band[2, 0:-2:2] = -keep[0, 1:]
        band[2, 1:-2:2] = -keep_v[1:]
        band[3, 0:-3:2] = -cross_v[1:]  # u_k -> v_k+1
        dtbtrs(band, speed.reshape(2 * n + 1, -1).T, uplo="L", diag="U", overwrite_b=1)

    def _positions(self, state: State) -> None:
        """x' = u cos yaw - v sin yaw, y' = u sin yaw + v cos yaw, linearised at nodes 1..horizon."""
        n, nominal = self.blocks, self.nominal[:, 1:]
        c, s = np.cos(nominal[3]), np.sin(nominal[3])
        turn_x, turn_y = -s * nominal[4] - c * nominal[5], c * nominal[4] - s * nominal[5]
        u, v, yaw = self._speed[:, :, 0], self._speed[:, :, 1], self.planar[n:, 2]
        along, across = u * c - v * s, u * s + v * c
        along[n:] += turn_x * yaw
        across[n:] += turn_y * yaw
        along[-1] -= turn_x * nominal[3]
        across[-1] -= turn_y * nominal[3]
        c0, s0 = float(np.cos(state[3])), float(np.sin(state[3]))
        _integrate(along, self._dt, c0 * state[4] - s0 * state[5], state[0], self.planar[:, 0])
        _integrate(across, self._dt, s0 * state[4] + c0 * state[5], state[1], self.planar[:, 1])

    def _heave(self, state: State, keep: Array, gain: Array, free: Array) -> None:
        np.multiply(self._response, gain, out=self._climb[:-1])
        self._climb[-1] = free
        _run(self._band_climb, keep, self._climb, state[6])
        _integrate(self._climb, self._dt, state[6], state[2], self.heave)

    def follow(self, surge_yaw: Array, heave: Array) -> None:
        """Make the response to block changes `surge_yaw` (2 blocks) and `heave` (blocks) the nominal trajectory."""
        n = self.blocks
        planar, climb, yaw = np.append(surge_yaw, 1.0), np.append(heave, 1.0), np.append(surge_yaw[n:], 1.0)
        nominal = self.nominal[:, 1:]
        nominal[0:2] = (planar @ self.planar[:, :2].reshape(2 * n + 1, -1)).reshape(2, -1)
        nominal[2] = climb @ self.heave
        nominal[3] = yaw @ self.planar[n:, 2]
        nominal[4:6] = (planar @ self._speed.reshape(2 * n + 1, -1)).reshape(-1, 2).T
        nominal[6] = climb @ self._climb
        nominal[7] = yaw @ self._rate


def _run(band: Array, keep: Array, rows: Array, start: float) -> None:
    """v_k+1 = keep_k v_k + row_k in place, for every row; the start value belongs to the last row, the free response."""
    band[1, :-1] = -keep[1:]
    rows[-1, 0] += keep[0] * start
    dtbtrs(band, rows.T, uplo="L", diag="U", overwrite_b=1)


def _integrate(rate: Array, dt_s: float, start_rate: float, start: float, out: Array) -> None:
    """Trapezoidal running integral of every row at nodes 1..horizon; starts belong to the last row, the free response."""
    np.cumsum(rate, axis=1, out=out)
    out -= 0.5 * rate
    out[-1] += 0.5 * start_rate
    out *= dt_s
    out[-1] += start
