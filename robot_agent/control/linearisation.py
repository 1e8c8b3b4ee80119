"""Linearised model over the horizon: poses at all nodes as an affine function of the wrenches to come (17-25, 33, condensed).

The model of dynamics.py, linearised around the present state (eta0, nu0) at every node: the article's. Every quantity is

    free response + sum over blocks j of (response to a unit of block j) x (wrench of block j)

so it is an array (nodes, columns) with a column per block, and the free response last. Planar quantities x, y, u, v have
2 blocks + 1 columns: surge blocks, yaw blocks, free. Those of one axis, z and w, yaw and r, have blocks + 1: the blocks of
heave or of yaw, free. Units are SI, velocities in the body frame and through the water.

Kernels that Python calls take these quantities stacked: `planar` (4, nodes, 2 blocks + 1) is x, y, u, v; `axial` (4, nodes,
blocks + 1) is z, yaw, w, r; `nominal` (2, nodes, 4) is eta0, nu0.
"""

import math

import numpy as np
from numpy.typing import NDArray

from robot_agent.guidance.formation import HalfSpaces, Places
from robot_agent.vehicle.dynamics import Model, State
from shoal.frames import Array
from shoal.kernels.decorator import kernel

HEAVE, YAW = 2, 3  # axes in eta and nu
TINY_MPS = 1e-12  # keeps 0/0 out


@kernel("void(f8[:,::1], i8, f8, f8, f8, f8, f8[:,::1], f8[:,::1], f8[::1], f8[:,::1], f8[:,::1])", part=True)
def single_axis(
    model: Array,
    axis: int,
    dt: float,
    gamma: float,
    commanded: float,
    acting: float,
    nu0: Array,
    response: Array,
    fading: Array,
    rate: Array,
    place: Array,
) -> None:
    """Heave or yaw: w' = (Z - d(w) w) / m + Gamma, place' = w, from rows 0 of `rate` and `place` on (nodes, blocks + 1).

    `model` (3, 4): m, linear and quadratic drag of the four axes; `nu0` (nodes, 4). `response` (horizon, blocks) is the thrust
    in a step for a unit of each block; the free response's is `commanded`, which `acting` approaches: `fading` (horizon,) of
    the difference is left.
    """
    m, linear, quadratic = model[0, axis], model[1, axis], model[2, axis]
    horizon, free = response.shape
    for k in range(horizon):
        w0 = nu0[k, axis]
        slope = (linear + 2.0 * quadratic * abs(w0)) / m
        keep = math.exp(-slope * dt)
        phi_dt = (1.0 - keep) / slope
        thrust = commanded + fading[k] * (acting - commanded)
        for j in range(free):
            rate[k + 1, j] = keep * rate[k, j] + phi_dt * response[k, j] / m
        # where quadratic drag's tangent meets zero speed, it pushes
        rate[k + 1, free] = keep * rate[k, free] + phi_dt * (gamma + (thrust + quadratic * abs(w0) * w0) / m)
        for j in range(free + 1):
            place[k + 1, j] = place[k, j] + 0.5 * dt * (rate[k, j] + rate[k + 1, j])


@kernel("void(f8[:,::1], f8, f8, f8[::1], f8, f8, f8[:,::1], f8[:,::1], f8[::1], f8[:,::1], f8[:,::1], f8[:,::1])", part=True)
def surge_and_sway(
    model: Array,
    sway: float,
    dt: float,
    gamma: Array,
    commanded: float,
    acting: float,
    nu0: Array,
    response: Array,
    fading: Array,
    r: Array,
    u: Array,
    v: Array,
) -> None:
    """Surge and sway, coupled by the speed that both drags share and by the turn:

        u' = (X - d(u) u) / m_u + c v r + Gamma_u        v' = -d(v) v / m_v - u r / c + Gamma_v        c = m_v / m_u

    with products linearised: v r = v0 r + r0 v - v0 r0. `sway` 0 leaves the whole second equation out, 1 has it. `r`
    (nodes, blocks + 1) is known; `u` and `v` (nodes, 2 blocks + 1) are solved from their rows 0 on.
    """
    m_u, m_v = model[0, 0], model[0, 1]
    c = m_v / m_u
    horizon, n = response.shape
    free = 2 * n
    for k in range(horizon):
        u0, v0, r0 = nu0[k, 0], nu0[k, 1], nu0[k, 3]
        speed = max(math.sqrt(u0 * u0 + v0 * v0), TINY_MPS)
        slope_u = (model[1, 0] + model[2, 0] * (speed + u0 * u0 / speed)) / m_u
        slope_v = (model[1, 1] + model[2, 1] * (speed + v0 * v0 / speed)) / m_v
        keep_u, keep_v = math.exp(-slope_u * dt), math.exp(-slope_v * dt)
        phi_dt_u, phi_dt_v = (1.0 - keep_u) / slope_u, (1.0 - keep_v) / slope_v
        # entries of A: how u' depends on v and r, v' on u and r
        u_v, u_r = c * r0 - model[2, 0] * u0 * v0 / speed / m_u, c * v0
        v_u, v_r = -sway * r0 / c - model[2, 1] * u0 * v0 / speed / m_v, -sway * u0 / c
        for j in range(free + 1):
            u[k + 1, j] = keep_u * u[k, j] + phi_dt_u * u_v * v[k, j]
            v[k + 1, j] = keep_v * v[k, j] + phi_dt_v * v_u * u[k, j]
        for j in range(n):
            u[k + 1, j] += phi_dt_u * response[k, j] / m_u
        for j in range(n + 1):
            u[k + 1, n + j] += phi_dt_u * u_r * r[k, j]
            v[k + 1, n + j] += phi_dt_v * v_r * r[k, j]
        thrust = commanded + fading[k] * (acting - commanded)
        u[k + 1, free] += phi_dt_u * (gamma[0] + (thrust + model[2, 0] * speed * u0) / m_u - u_r * r0)
        v[k + 1, free] += phi_dt_v * (sway * gamma[1] + model[2, 1] * speed * v0 / m_v - v_r * r0)


@kernel("void(f8, f8, f8, f8[:,::1], f8[:,::1], f8[:,::1], f8[:,::1], f8[:,::1], f8[:,::1], f8[:,::1])", part=True)
def move(
    dt: float, current_x: float, current_y: float, eta0: Array, nu0: Array, u: Array, v: Array, yaw: Array, x: Array, y: Array
) -> None:
    """(x, y)' = R(yaw) (u, v) + current, from rows 0 of `x` and `y` on, by the trapezoidal rule. Linearised in yaw:

    R(yaw) (u, v) = R(yaw0) (u, v) + R'(yaw0) (u0, v0) (yaw - yaw0); -yaw0 belongs to the free response alone.
    """
    nodes, columns = x.shape
    n, free = yaw.shape[1] - 1, columns - 1
    half = 0.5 * dt
    for k in range(nodes):
        cos, sin = math.cos(eta0[k, 3]), math.sin(eta0[k, 3])
        turn_x, turn_y = -sin * nu0[k, 0] - cos * nu0[k, 1], cos * nu0[k, 0] - sin * nu0[k, 1]
        for j in range(columns):
            # half of this node's velocity belongs to the interval before it, half to the one after
            step_x, step_y = half * (cos * u[k, j] - sin * v[k, j]), half * (sin * u[k, j] + cos * v[k, j])
            if j >= n:
                step_x += half * turn_x * yaw[k, j - n]
                step_y += half * turn_y * yaw[k, j - n]
            if j == free:
                step_x += half * (current_x - turn_x * eta0[k, 3])
                step_y += half * (current_y - turn_y * eta0[k, 3])
            if k > 0:
                x[k, j] += step_x
                y[k, j] += step_y
            if k < nodes - 1:
                x[k + 1, j] = x[k, j] + step_x
                y[k + 1, j] = y[k, j] + step_y


@kernel(
    "void(f8[:,::1], f8, f8, f8[::1], f8[::1], f8[::1], f8[::1], c16, f8[:,:,::1], f8[:,::1], f8[::1],"
    " f8[:,:,::1], f8[:,:,::1])",
    part=True,
)
def linearise(
    model: Array,
    sway: float,
    dt: float,
    state: Array,
    asked: Array,
    delivered: Array,
    gamma: Array,
    current: complex,
    nominal: Array,
    response: Array,
    fading: Array,
    planar: Array,
    axial: Array,
) -> None:
    """All responses, for a start `state` (11,) and Gamma (4,), along the nominal trajectory, which from here on begins at
    that state: the plan's turn goes on from the heading there is. What `delivered` (3,) lacks of the wrench that was `asked`
    for (3,) goes on to lack."""
    eta, nu = nominal[0], nominal[1]
    x, y, u, v = planar[0], planar[1], planar[2], planar[3]
    z, yaw, w, r = axial[0], axial[1], axial[2], axial[3]
    turned = state[3] - eta[0, 3]
    for k in range(len(eta)):
        eta[k, 3] += turned
    for i in range(4):
        eta[0, i], nu[0, i] = state[i], state[4 + i]
    n, free = len(yaw[0]) - 1, len(x[0]) - 1
    x[0, free], y[0, free], z[0, n], yaw[0, n] = state[0], state[1], state[2], state[3]
    u[0, free], v[0, free], w[0, n], r[0, n] = state[4], state[5], state[6], state[7]
    single_axis(model, HEAVE, dt, gamma[2], delivered[1] - asked[1], state[9], nu, response, fading, w, z)
    single_axis(model, YAW, dt, gamma[3], delivered[2] - asked[2], state[10], nu, response, fading, r, yaw)
    surge_and_sway(model, sway, dt, gamma, delivered[0] - asked[0], state[8], nu, response, fading, r, u, v)
    move(dt, current.real, current.imag, eta, nu, u, v, yaw, x, y)


@kernel("void(f8[:,:,::1], f8[:,:,::1], f8[:,::1], f8[::1], f8[:,::1], f8[:,::1], f8[::1])", part=True)
def condense(planar: Array, axial: Array, reference: Array, weight: Array, smooth: Array, p: Array, q: Array) -> None:
    """The errors' part of the cost (35), 1/2 b'Pb + q'b over all blocks b: P = smooth + S'WS, q += S'W (free - reference),
    nodes 1 on.

    `reference` (nodes, 4) and `weight` W (4,) as eta; `smooth`, `p` (3 blocks, 3 blocks), `q` (3 blocks,): surge, yaw, heave.
    Only the lower triangle of `p` is summed; then it is copied to the upper one.
    """
    x, y, z, yaw = planar[0], planar[1], axial[0], axial[1]
    p[:] = smooth
    nodes, free = x.shape[0], x.shape[1] - 1
    n = free // 2
    for k in range(1, nodes):
        error_x, error_y = x[k, free] - reference[k, 0], y[k, free] - reference[k, 1]
        error_z, error_yaw = z[k, n] - reference[k, 2], yaw[k, n] - reference[k, 3]
        for i in range(free):
            w_x, w_y = weight[0] * x[k, i], weight[1] * y[k, i]
            q[i] += w_x * error_x + w_y * error_y
            for j in range(i + 1):
                p[i, j] += w_x * x[k, j] + w_y * y[k, j]
        for i in range(n):
            w_z, w_yaw = weight[2] * z[k, i], weight[3] * yaw[k, i]
            q[n + i] += w_yaw * error_yaw
            q[free + i] += w_z * error_z
            for j in range(i + 1):
                p[n + i, n + j] += w_yaw * yaw[k, j]
                p[free + i, free + j] += w_z * z[k, j]
    for i in range(3 * n):
        for j in range(i):
            p[j, i] = p[i, j]


@kernel(
    "void(f8[:,::1], f8, f8, f8[::1], f8[::1], f8[::1], f8[::1], c16, f8[:,:,::1], f8[:,::1], f8[::1],"
    " f8[:,:,::1], f8[:,:,::1], f8[:,::1], f8[::1], f8[:,::1], f8[::1], f8[:,::1], f8[::1])"
)
def linearise_and_condense(
    model: Array,
    sway: float,
    dt: float,
    state: Array,
    asked: Array,
    delivered: Array,
    gamma: Array,
    current: complex,
    nominal: Array,
    response: Array,
    fading: Array,
    planar: Array,
    axial: Array,
    reference: Array,
    weight: Array,
    smooth: Array,
    r: Array,
    p: Array,
    q: Array,
) -> None:
    """Responses (`linearise`), and the cost (35) of a reference and of changes between blocks (`condense`). The first change
    of surge, heave and yaw counts from the wrench that was `asked` for, at the price `r` (3,)."""
    linearise(model, sway, dt, state, asked, delivered, gamma, current, nominal, response, fading, planar, axial)
    n = response.shape[1]
    q[:] = 0.0
    q[0], q[n], q[2 * n] = -r[0] * asked[0], -r[2] * asked[2], -r[1] * asked[1]
    condense(planar, axial, reference, weight, smooth, p, q)


@kernel("void(f8[:,:,::1], i8[::1], c16[::1], f8[::1], f8[::1], f8[:,::1], f8[::1])")
def half_space_rows(
    planar: Array, node: NDArray[np.int64], normal: Places, offset: Array, give: Array, a: Array, lower: Array
) -> None:
    """Rows of the constraints normal . (x, y) + give slack >= offset (36) at `node` (rows,): a b >= lower over all blocks and
    the slack b.

    `normal` x + iy, `offset` m; results `a` (most, 3 blocks + 1) and `lower` (most,): rows that are left bound nothing.
    """
    x, y = planar[0], planar[1]
    free, slack = x.shape[1] - 1, a.shape[1] - 1
    a[:], a[:, slack], lower[:] = 0.0, 1.0, -np.inf
    for i in range(len(node)):
        k, n_x, n_y = node[i], normal[i].real, normal[i].imag
        for j in range(free):
            a[i, j] = n_x * x[k, j] + n_y * y[k, j]
        a[i, slack] = give[i]
        lower[i] = offset[i] - n_x * x[k, free] - n_y * y[k, free]


@kernel("void(f8[::1], f8[:,::1], f8[:,::1], f8[:,::1], f8[:,::1], f8[:,::1])", part=True)
def superpose(b: Array, x: Array, y: Array, z: Array, yaw: Array, out: Array) -> None:
    """Response to all blocks `b` (3 blocks,), surge, yaw, heave: free + sum of columns x blocks, into `out` (nodes, 4). Poses,
    or velocities in their place."""
    nodes, free = x.shape[0], x.shape[1] - 1
    n = free // 2
    for k in range(nodes):
        at_x, at_y, at_z, at_yaw = x[k, free], y[k, free], z[k, n], yaw[k, n]
        for j in range(free):
            at_x += x[k, j] * b[j]
            at_y += y[k, j] * b[j]
        for j in range(n):
            at_z += z[k, j] * b[free + j]
            at_yaw += yaw[k, j] * b[n + j]
        out[k, 0], out[k, 1], out[k, 2], out[k, 3] = at_x, at_y, at_z, at_yaw


@kernel("void(f8[::1], f8[:,:,::1], f8[:,:,::1], f8[:,::1])")
def follow_plan(b: Array, planar: Array, axial: Array, eta: Array) -> None:
    """Poses `eta` (nodes, 4) under the blocks `b` (3 blocks,)."""
    superpose(b, planar[0], planar[1], axial[0], axial[1], eta)


class Prediction:
    """Memory of the linearised model, for `horizon` nodes `period_s` apart, with inputs held over `blocks` (the last to the
    end). After `linearise_and_condense`: x, y, z, yaw (nodes, columns) as the module says, nodes 0..horizon."""

    def __init__(self, model: Model, period_s: float, horizon: int, blocks: tuple[int, ...]) -> None:
        n, nodes = len(blocks), horizon + 1
        self._dt, self._sway, self._model = period_s, model.sway, model.coefficients
        self._nominal, self.planar, self.axial = (
            np.zeros((2, nodes, 4)), np.zeros((4, nodes, 2 * n + 1)), np.zeros((4, nodes, n + 1))
        )  # fmt: skip
        self.eta, self.nu = self._nominal  # the nominal trajectory
        self.x, self.y, self.z, self.yaw = (*self.planar[:2], *self.axial[:2])
        left, mean = model.lag(period_s)
        self._fading: Array = mean * np.power(
            left, np.arange(horizon), dtype=np.float64
        )  # of a thrust that is to end, the mean in each step
        self._response = np.zeros((horizon, n))
        thrust, block_of = np.zeros(n), np.minimum(np.searchsorted(np.cumsum(blocks), np.arange(horizon), "right"), n - 1)
        for k in range(horizon):
            commanded = np.eye(n)[block_of[k]]
            self._response[k] = commanded + (thrust - commanded) * mean
            thrust = commanded + (thrust - commanded) * left

    def restart(self, state: State | Array) -> None:
        """Linearise around this state at every node."""
        self.eta[:], self.nu[:] = state[:4], state[4:8]

    def linearise_and_condense(
        self,
        state: Array,
        asked: Array,
        delivered: Array,
        disturbance: Array,
        current: complex,
        reference: Array,
        weight: Array,
        smooth: Array,
        r: Array,
        p: Array,
        q: Array,
    ) -> None:
        """Compute the responses for a start `state` (11,), Gamma (4,), and water that streams at `current` (x + iy, m/s), and
        write the cost of a reference (nodes, 4): see the kernel. Velocities are through the water."""
        linearise_and_condense(
            self._model, self._sway, self._dt, state, asked, delivered, disturbance, current, self._nominal, self._response,
            self._fading, self.planar, self.axial, reference, weight, smooth, r, p, q,
        )  # fmt: skip

    def half_space_rows(self, keep_clear: HalfSpaces, a: Array, lower: Array) -> None:
        """Write the rows (36) over all blocks and the slack into `a` (most, 3 blocks + 1) and their bounds into `lower`
        (most,)."""
        give = np.ones(len(keep_clear.node)) if keep_clear.give is None else keep_clear.give
        half_space_rows(self.planar, keep_clear.node, keep_clear.normal, keep_clear.offset, give, a, lower)

    def follow_plan(self, blocks: Array) -> Array:
        """Poses (nodes, 4) under the blocks (3 blocks,), surge, yaw, heave."""
        eta = np.empty(self.eta.shape)
        follow_plan(blocks, self.planar, self.axial, eta)
        return eta
