"""The model along a horizon: poses at all nodes as an affine function of the wrenches to come (17-25, 33, condensed).

Linearised along a nominal trajectory, each node around its own point, the horizon is a chain of recursions that is
triangular and banded: heave and yaw rate alone, then surge with sway, then poses as running sums. LAPACK's banded solve
runs each chain for the free response and all input blocks at once (5 us; a Python loop over 50 nodes takes 100).
Horizontal vectors are complex numbers, x + iy in the pool and u + iv in the body: a rotation is one product.
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.linalg.lapack import dtbtrs

from robot_agent.model import Model, State
from wire.frames import Array

TINY = 1e-12  # m/s: keeps 0/0 out


class Prediction:
    """Workspaces for `horizon` nodes `period_s` apart with the inputs held over `blocks` (the last block to the end).

    After `linearise` the rows hold, per input block and last the free response, at nodes 1..horizon:
    `position` (2 blocks + 1, horizon) complex: x + iy by surge blocks, yaw blocks, free; `yaw` (blocks + 1, horizon) by yaw
    blocks, free; `heave` (blocks + 1, horizon): z by heave blocks, free.
    """

    def __init__(self, model: Model, period_s: float, horizon: int, blocks: tuple[int, ...]) -> None:
        self.blocks, self.horizon, self._model, self._dt = len(blocks), horizon, model, period_s
        n, h = len(blocks), horizon
        self.nominal = np.zeros((8, h + 1))  # eta, nu to linearise along, nodes 0..horizon
        self.position = np.zeros((2 * n + 1, h), dtype=np.complex128)
        self.yaw = np.zeros((n + 1, h))
        self.heave = np.zeros((n + 1, h))
        self._rate = np.zeros((n + 1, h))  # of yaw
        self._climb = np.zeros((n + 1, h))
        self._speed = np.zeros((2 * n + 1, h, 2))  # surge and sway, rows as `position`
        self._complex_speed = self._speed.view(np.complex128)[:, :, 0]
        self._velocity = np.zeros_like(self.position)
        self._flow = np.zeros((4, h))  # speeds that drag depends on, at nodes 0..horizon-1
        self._band_rate, self._band_climb = np.zeros((2, h), order="F"), np.zeros((2, h), order="F")
        self._band_speed = np.zeros((4, 2 * h), order="F")
        self._mass = np.array(model.mass)[:, None]
        self._linear, self._quadratic = (np.array(d)[:, None] / self._mass for d in (model.linear, model.quadratic))
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
        return response, np.array([mean * left**k for k in range(self.horizon)])

    def restart(self, state: State) -> None:
        """Forget the nominal trajectory: linearise around this state at every node."""
        self.nominal[:] = np.array(state[:8])[:, None]

    def shift(self) -> None:
        """Move the nominal trajectory on by one step; its last node stands twice."""
        self.nominal[:, :-1] = self.nominal[:, 1:]

    def linearise(self, state: State, wrench: Array, disturbance: Array) -> None:
        """Fill the responses for a start `state`, the wrench (3,) that the blocks are changes to, and Gamma (4,)."""
        nominal, flow = self.nominal, self._flow
        nominal[3] += state[3] - nominal[3, 0]  # the plan's turn, from the heading there is
        nominal[:, 0] = state[:8]
        velocity = nominal[4:, :-1]
        np.abs(velocity, out=flow)
        np.hypot(velocity[0], velocity[1], out=flow[0])
        flow[1] = flow[0]
        bent = self._quadratic * flow
        slope = velocity * velocity
        slope /= np.maximum(flow, TINY)
        slope *= self._quadratic
        slope += bent
        slope += self._linear
        keep = np.exp(slope * -self._dt)
        gain = (1.0 - keep) / slope
        bent *= velocity
        bent += disturbance[:, None]
        push = gain * bent  # of quadratic drag's offset and Gamma
        thrust = np.multiply.outer((state[8] - wrench[0], state[9] - wrench[1], state[10] - wrench[2]), self._remains)
        thrust += wrench[:, None]
        force = gain[[0, 2, 3]] / self._mass[[0, 2, 3]]  # velocity per newton
        thrust *= force
        self._turn(state, keep[3], force[2], push[3] + thrust[2])
        self._surge_sway(state, keep, gain, force[0], push, thrust[0])
        self._move(state)
        self._dive(state, keep[2], force[1], push[2] + thrust[1])

    def _turn(self, state: State, keep: Array, force: Array, free: Array) -> None:
        rate = self._rate
        np.multiply(self._response, force, out=rate[:-1])
        rate[-1] = free
        _run(self._band_rate, keep, rate, state[7])
        _integrate(rate, self._dt, state[7], state[3], self.yaw)

    def _surge_sway(self, state: State, keep: Array, gain: Array, force: Array, push: Array, thrust: Array) -> None:
        """A chain with 2 x 2 blocks; u r and v r are linearised: v r ~ v0 r + r0 v - v0 r0."""
        n, speed, band, sway = self.blocks, self._speed, self._band_speed, self._model.sway
        u, v, r = self.nominal[4, :-1], self.nominal[5, :-1], self.nominal[7, :-1]
        coriolis_u = gain[0] * self._model.coriolis
        coriolis_v = gain[1] / (-self._model.coriolis if sway else -np.inf)
        turn_u, turn_v = coriolis_u * v, coriolis_v * u  # velocity per yaw rate
        np.multiply(self._response, force, out=speed[:n, :, 0])
        speed[:n, :, 1] = 0.0
        speed[n:, 0] = 0.0
        np.multiply(self._rate[:, :-1], turn_u[1:], out=speed[n:, 1:, 0])
        np.multiply(self._rate[:, :-1], turn_v[1:], out=speed[n:, 1:, 1])
        free = speed[-1]
        free[:, 0] += push[0] + thrust - turn_u * r
        free[:, 1] += push[1] - turn_v * r if sway else 0.0
        along = u * v / np.maximum(self._flow[0], TINY)  # how each axis adds to the other's drag
        cross_u = coriolis_u * r - gain[0] * self._quadratic[0] * along
        cross_v = coriolis_v * r - gain[1] * self._quadratic[1] * along if sway else coriolis_v
        keep_v = keep[1] if sway else coriolis_v
        # node 0 is given: what it hands to node 1 joins the free response (its yaw rate is the state's own)
        free[0, 0] += keep[0, 0] * state[4] + cross_u[0] * state[5] + turn_u[0] * state[7]
        free[0, 1] += keep_v[0] * state[5] + cross_v[0] * state[4] + turn_v[0] * state[7]
        # unknowns u1 v1 u2 v2 ...: LAPACK's lower band, row d holds the entry d places below the diagonal
        np.negative(cross_u[1:], out=band[1, 1:-1:2])  # v_k -> u_k+1
        np.negative(keep[0, 1:], out=band[2, 0:-2:2])
        np.negative(keep_v[1:], out=band[2, 1:-2:2])
        np.negative(cross_v[1:], out=band[3, 0:-3:2])  # u_k -> v_k+1
        dtbtrs(band, speed.reshape(2 * n + 1, -1).T, uplo="L", diag="U", overwrite_b=1)

    def _move(self, state: State) -> None:
        """(x + iy)' = (u + iv) exp(i yaw), linearised at nodes 1..horizon."""
        nominal, velocity = self.nominal[:, 1:], self._velocity
        rotation = np.exp(1j * nominal[3])
        turn = 1j * rotation * (nominal[4] + 1j * nominal[5])
        np.multiply(self._complex_speed, rotation, out=velocity)
        velocity[self.blocks :] += turn * self.yaw
        velocity[-1] -= turn * nominal[3]
        start_velocity = complex(state[4], state[5]) * complex(np.exp(1j * state[3]))
        _integrate(velocity, self._dt, start_velocity, complex(state[0], state[1]), self.position)

    def _dive(self, state: State, keep: Array, force: Array, free: Array) -> None:
        climb = self._climb
        np.multiply(self._response, force, out=climb[:-1])
        climb[-1] = free
        _run(self._band_climb, keep, climb, state[6])
        _integrate(climb, self._dt, state[6], state[2], self.heave)

    def follow(self, surge_yaw: Array, heave: Array) -> None:
        """Make the response to block changes `surge_yaw` (2 blocks) and `heave` (blocks) the nominal trajectory."""
        planar, climb, turn = np.append(surge_yaw, 1.0), np.append(heave, 1.0), np.append(surge_yaw[self.blocks :], 1.0)
        nominal, rows = self.nominal[:, 1:], len(planar)
        nominal[0:2] = (planar @ self.position.view(np.float64)).reshape(-1, 2).T
        nominal[2] = climb @ self.heave
        nominal[3] = turn @ self.yaw
        nominal[4:6] = (planar @ self._speed.reshape(rows, -1)).reshape(-1, 2).T
        nominal[6] = climb @ self._climb
        nominal[7] = turn @ self._rate


def _run(band: Array, keep: Array, rows: Array, start: float) -> None:
    """v_k+1 = keep_k v_k + row_k in place, for every row; the start value belongs to the last row, the free response."""
    np.negative(keep[1:], out=band[1, :-1])
    rows[-1, 0] += keep[0] * start
    dtbtrs(band, rows.T, uplo="L", diag="U", overwrite_b=1)


def _integrate(rate: NDArray[Any], dt_s: float, start_rate: complex, start: complex, out: NDArray[Any]) -> None:
    """Trapezoidal running integral of every row at nodes 1..horizon; starts belong to the last row, the free response."""
    np.cumsum(rate, axis=1, out=out)
    out -= 0.5 * rate
    out[-1] += 0.5 * start_rate
    out *= dt_s
    out[-1] += start
