"""The model that estimator and controller share, and the observer's equations on it: body velocities with sway, quadratic
drag and lagging thrusters.

Equations (3-11) with the sway that the article leaves out (it is what pushes a slow robot off a circle):

    u' = (X - d(u) u) / m_u + (m_v / m_u) v r + Gamma_u        eta' = J(yaw) [u, v, w, r]
    v' = (Y - d(v) v) / m_v - (m_u / m_v) u r + Gamma_v        d = linear + quadratic speed
    w' = (Z - d(w) w) / m_w + Gamma_w                          lag X' = X_commanded - X, Y, Z and N alike
    r' = (N - d(r) r + (m_u - m_v) u v) / m_r + Gamma_r

The side force Y is zero unless the vehicle has thrusters for it (`limits.wrench` with a fourth number).

The speed in d is |w|, |r|, and for surge and sway that of both: water presses against a sphere along its path. (Each axis with
its own speed, as in the article, makes a sliding robot's side drag three times too small at 0.3 m/s: 4 cm in a bend.)
(m_u - m_v) u v is the Munk moment, which turns a hull across the flow; it is zero for a sphere.

A vehicle file says mass and drag as well as they are known. The observer can learn the ratios of drag and of thrust to mass
for surge and sway in flight; everything that predicts uses them (`Model.coefficients`).

Velocities advance by v+ = v + dt phi(a dt) v', phi(s) = (1 - exp(-s)) / s, a = the slope of drag / m (exponential Euler:
exact for linear drag, stable for any step); poses advance by the trapezoidal rule.
"""

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from shoal.config.vehicle import AXES, Vehicle
from shoal.frames import TURN, Array
from shoal.kernels.decorator import kernel

Wrench = tuple[float, ...]  # surge N, heave N, yaw N m, and sway N of a vehicle with side thrust
State = tuple[float, ...]  # 12 numbers: eta (4), nu (4), thrust that acts now [X N, Z N, N N m, Y N]

STATES = 12
LONGEST_STEP_NS = 50_000_000  # the model's step is first order in the Coriolis terms
GATE_M, GATE_RAD = 0.3, 1.0  # between two poses nothing moves this far: 0.5 m/s x 0.2 s, 1.9 rad/s x 0.2 s, and doubled
OUTLIER = 5.0  # standard deviations: a pose that is farther off counts less
MOST_RATIO = 2.5  # of drag and of thrust, per mass, to the vehicle file's or the other way round: 30 % each make 1.9
TELLS_MPS = 0.1  # slower, dead zone and unlike thrusters are as large as drag and thrust: nothing is learned of these
SENSED_LOOKED_AT = 16  # board samples, one per step: reaches back 0.8 s
SENSED_HELD_NS = 150_000_000  # so long a board sample stands for what came after it: three bursts at 20 Hz


@kernel("UniTuple(f8,2)(f8, f8)")
def lag(lag_s: float, dt: float) -> tuple[float, float]:
    """Share of (thrust - command) that is left after `dt`, and its mean over `dt` (s)."""
    if dt <= 0.0:
        return 1.0, 1.0
    if lag_s <= 0.0:
        return 0.0, 0.0
    left = math.exp(-dt / lag_s)
    return left, lag_s / dt * (1.0 - left)


@kernel("f8(f8, f8)", part=True)
def phi_dt(slope: float, dt: float) -> float:
    """dt phi(a dt), s: effective time of a constant acceleration against drag of slope a (1/s, per mass)."""
    return -math.expm1(-slope * dt) / slope


@kernel("UniTuple(f8,12)(f8[:,::1], f8, f8, UniTuple(f8,12), UniTuple(f8,4), UniTuple(f8,4), f8)")
def advance(
    model: Array, sway: float, lag_s: float, state: State, gamma: tuple[float, ...], wrench: tuple[float, ...], dt: float
) -> State:
    """State after `dt` (one control step or less) of a constant commanded wrench and Gamma: the module's equations.

    `model` (3, 4): m, linear and quadratic drag of the four axes. `sway` 0: v stays zero.
    """
    x, y, z, yaw, u, v, w, r, acting_x, acting_z, acting_n, acting_y = state
    m_u, m_v, m_w, m_r = model[0]
    linear_u, linear_v, linear_w, linear_r = model[1]
    quadratic_u, quadratic_v, quadratic_w, quadratic_r = model[2]
    c = m_v / m_u
    left, mean = lag(lag_s, dt)
    surge_n = wrench[0] + (acting_x - wrench[0]) * mean
    heave_n = wrench[1] + (acting_z - wrench[1]) * mean
    yaw_nm = wrench[2] + (acting_n - wrench[2]) * mean
    sway_n = wrench[3] + (acting_y - wrench[3]) * mean
    speed = math.sqrt(u * u + v * v)
    bend = 1.0 / speed if speed > 0.0 else 0.0
    slope_u = (linear_u + quadratic_u * (speed + u * u * bend)) / m_u
    slope_v = (linear_v + quadratic_v * (speed + v * v * bend)) / m_v
    slope_w = (linear_w + 2.0 * quadratic_w * abs(w)) / m_w
    slope_r = (linear_r + 2.0 * quadratic_r * abs(r)) / m_r
    u_dot = (surge_n - (linear_u + quadratic_u * speed) * u) / m_u + c * v * r + gamma[0]
    v_dot = (sway_n - (linear_v + quadratic_v * speed) * v) / m_v - u * r / c + gamma[1]
    w_dot = (heave_n - (linear_w + quadratic_w * abs(w)) * w) / m_w + gamma[2]
    r_dot = (yaw_nm - (linear_r + quadratic_r * abs(r)) * r + (m_u - m_v) * u * v) / m_r + gamma[3]
    u1 = u + phi_dt(slope_u, dt) * u_dot
    v1 = sway * (v + phi_dt(slope_v, dt) * v_dot)
    w1 = w + phi_dt(slope_w, dt) * w_dot
    r1 = r + phi_dt(slope_r, dt) * r_dot
    yaw1 = yaw + 0.5 * dt * (r + r1)
    cos, sin, cos1, sin1 = math.cos(yaw), math.sin(yaw), math.cos(yaw1), math.sin(yaw1)
    x1 = x + 0.5 * dt * (cos * u - sin * v + cos1 * u1 - sin1 * v1)
    y1 = y + 0.5 * dt * (sin * u + cos * v + sin1 * u1 + cos1 * v1)
    z1 = z + 0.5 * dt * (w + w1)
    acting_x = wrench[0] + (acting_x - wrench[0]) * left
    acting_z = wrench[1] + (acting_z - wrench[1]) * left
    acting_n = wrench[2] + (acting_n - wrench[2]) * left
    acting_y = wrench[3] + (acting_y - wrench[3]) * left
    return x1, y1, z1, yaw1, u1, v1, w1, r1, acting_x, acting_z, acting_n, acting_y


@kernel("UniTuple(f8,12)(f8[:,::1], f8, f8, UniTuple(f8,12), UniTuple(f8,4), UniTuple(f8,2), i8[::1], f8[:,::1], i8, i8, i8)")
def propagate(
    model: Array,
    sway: float,
    lag_s: float,
    state: State,
    gamma: tuple[float, ...],
    current: tuple[float, float],
    acts_ns: NDArray[np.int64],
    wrenches: Array,
    count: int,
    from_ns: int,
    to_ns: int,
) -> State:
    """State at `to_ns`, from that at `from_ns`, under the first `count` of `wrenches` (inputs, 4), each from its instant
    `acts_ns` on and none before, in water that streams at `current` (x, y, m/s), in steps of at most LONGEST_STEP_NS."""
    wrench = (0.0, 0.0, 0.0, 0.0)
    for i in range(count + 1):
        until_ns = min(acts_ns[i], to_ns) if i < count else to_ns
        if until_ns > from_ns:
            steps = (until_ns - from_ns + LONGEST_STEP_NS - 1) // LONGEST_STEP_NS
            dt = (until_ns - from_ns) * 1e-9 / steps
            for _ in range(steps):
                state = advance(model, sway, lag_s, state, gamma, wrench, dt)
            from_ns = until_ns
            x, y, z, yaw, u, v, w, r, acting_x, acting_z, acting_n, acting_y = state
            x += current[0] * dt * steps
            y += current[1] * dt * steps
            state = (x, y, z, yaw, u, v, w, r, acting_x, acting_z, acting_n, acting_y)
        if i < count:
            wrench = (wrenches[i, 0], wrenches[i, 1], wrenches[i, 2], wrenches[i, 3])
    return state


@kernel("UniTuple(f8,2)(f8[:,::1], f8, f8)")
def drag(model: Array, u: float, v: float) -> tuple[float, float]:
    """Deceleration in m/s^2 by drag at horizontal velocities u, v through the water."""
    speed = math.hypot(u, v)
    along, aside = model[1, 0] + model[2, 0] * speed, model[1, 1] + model[2, 1] * speed
    return along * u / model[0, 0], aside * v / model[0, 1]


# --- the observer (31) on this model


@kernel("UniTuple(f8,3)(f8, f8)", part=True)
def gains(bandwidth_radps: float, step_s: float) -> tuple[float, float, float]:
    """Innovation gains b1, b2, b3 for pose, velocity and Gamma: all three observer poles at exp(-w dt)."""
    beta = math.exp(-bandwidth_radps * step_s)
    rest = 1.0 - beta
    return 1.0 - beta**3, 1.5 * rest * rest * (1.0 + beta) / step_s, rest**3 / (step_s * step_s)


@kernel("UniTuple(f8,3)(f8, f8)", part=True)
def gains_with_rate(bandwidth_radps: float, step_s: float) -> tuple[float, float, float]:
    """Gains b1, b2, b3 if velocity is measured too: pose by the pose error; velocity and Gamma by the velocity error."""
    beta = math.exp(-bandwidth_radps * step_s)
    rest = 1.0 - beta
    return rest, 1.0 - beta * beta, rest * rest / step_s


@kernel("Tuple((f8, c16, f8))(f8, c16, f8, f8, f8, f8)", part=True)
def split_side_force(
    side: float, current: complex, yaw: float, slope: float, share: float, fastest_mps: float
) -> tuple[float, complex, float]:
    """Division of a side force (m/s^2) between Gamma_v and the current: both anew, and by how much the current grew to the
    side (m/s). The sway velocity through the water falls by as much.

    `slope` is that of the sway drag, `share` the part that goes to the current. A current at its limit grows no further: the
    rest stays a side force.
    """
    drift = share * side / slope
    aside = complex(-math.sin(yaw), math.cos(yaw))
    if abs(current + drift * aside) > fastest_mps:
        along = current.real * aside.real + current.imag * aside.imag  # |current + t aside| = fastest at t = -along +- half
        half = math.sqrt(max(along**2 + fastest_mps**2 - abs(current) ** 2, 0.0))
        drift = min(max(drift, min(-along - half, 0.0)), max(-along + half, 0.0))
    return side - drift * slope, current + drift * aside, drift


@kernel("f8(f8[:,::1], f8, f8)", part=True)
def sway_slope(model: Array, u: float, v: float) -> float:
    """Rate (1/s) at which sideways motion decays at velocities u, v through the water: slope of the drag, per mass."""
    speed = math.sqrt(u * u + v * v)
    bend = v * v / speed if speed > 0.0 else 0.0
    return float((model[1, 1] + model[2, 1] * (speed + bend)) / model[0, 1])


@kernel("void(f8[:,::1], f8, f8[::1], f8, f8[::1], f8[:,::1], f8[:,:,::1])")
def spread(model: Array, sway: float, belief: Array, dt: float, noise: Array, p: Array, work: Array) -> None:
    """Covariance `p` (8, 8) of the planar belief `dt` later: F P F^T + Q dt, F from the module's equations at the belief.

    Its order is x, y, u, v, Gamma_u, Gamma_v, drag and thrust per mass. `noise` (8,) is the diagonal of Q; `work` (2, 8, 8) is
    overwritten. Drag and thrust are learned above TELLS_MPS only.
    """
    f, fp = work[0], work[1]
    yaw, u, v, r, surge_n = belief[3], belief[4], belief[5], belief[7], belief[8]
    speed, c = math.sqrt(u * u + v * v), model[0, 1] / model[0, 0]
    bend = 1.0 / speed if speed > 0.0 else 0.0
    along, aside = (model[1, 0] + model[2, 0] * speed) / model[0, 0], (model[1, 1] + model[2, 1] * speed) / model[0, 1]
    slope_u, slope_v = along + model[2, 0] * u * u * bend / model[0, 0], aside + model[2, 1] * v * v * bend / model[0, 1]
    phi_u, phi_v = phi_dt(slope_u, dt), sway * phi_dt(slope_v, dt)
    tells = speed**4 / (speed**4 + TELLS_MPS**4)
    f[:] = 0.0
    for i in range(8):
        f[i, i] = 1.0
    f[2, 2], f[2, 3], f[2, 4] = 1.0 - phi_u * slope_u, phi_u * c * r, phi_u
    f[3, 2], f[3, 3], f[3, 5] = -phi_v * r / c, 1.0 - phi_v * slope_v, phi_v
    f[2, 6], f[3, 6] = -tells * phi_u * along * u / belief[17], -tells * phi_v * aside * v / belief[17]
    f[2, 7] = tells * phi_u * surge_n / model[0, 0] / belief[18]
    cos, sin = math.cos(yaw + 0.5 * dt * r), math.sin(yaw + 0.5 * dt * r)
    for j in range(2, 8):  # half of the way by the velocity before, half by that after
        ahead = 0.5 * dt * (f[2, j] + (1.0 if j == 2 else 0.0))
        across = 0.5 * dt * (f[3, j] + (1.0 if j == 3 else 0.0))
        f[0, j], f[1, j] = cos * ahead - sin * across, sin * ahead + cos * across
    for i in range(8):
        for j in range(8):
            total = 0.0
            for k in range(8):
                total += f[i, k] * p[k, j]
            fp[i, j] = total
    for i in range(8):
        for j in range(i + 1):
            total = 0.0
            for k in range(8):
                total += fp[i, k] * f[j, k]
            p[i, j] = p[j, i] = total
        p[i, i] += noise[i] * dt


@kernel("void(f8[:,::1], f8, f8, f8, f8, f8[:,::1], f8[::1])")
def weigh(p: Array, error_x: float, error_y: float, variance_m2: float, told_m2: float, gain: Array, change: Array) -> None:
    """Kalman's correction of the planar belief by a pose that is off by an error: `change` (8,) = K e, and `p` after it.

        S = H P H^T + variance I      K = P H^T S^-1      P -= K S K^T      H takes x and y

    An error of more than OUTLIER deviations counts as if its pose were so much worse. If the pose tells that it is worse than
    it is believed to be, `told_m2`, deviations are those of what it tells: noise that is told is no reason to slow down.
    `gain` (8, 8) is overwritten.
    """
    s_xx, s_xy, s_yy = p[0, 0] + variance_m2, p[0, 1], p[1, 1] + variance_m2
    det = s_xx * s_yy - s_xy * s_xy
    more_m2 = max(told_m2 - variance_m2, 0.0)
    d_xx, d_yy = s_xx + more_m2, s_yy + more_m2
    distance2 = d_yy * error_x * error_x - 2.0 * s_xy * error_x * error_y + d_xx * error_y * error_y
    worse = max(math.sqrt(distance2 / (d_xx * d_yy - s_xy * s_xy)) / OUTLIER, 1.0)
    for i in range(8):
        gain[i, 0] = (s_yy * p[i, 0] - s_xy * p[i, 1]) / (det * worse)
        gain[i, 1] = (s_xx * p[i, 1] - s_xy * p[i, 0]) / (det * worse)
        change[i] = gain[i, 0] * error_x + gain[i, 1] * error_y
    for i in range(8):
        by_x, by_y = gain[i, 0] * s_xx + gain[i, 1] * s_xy, gain[i, 0] * s_xy + gain[i, 1] * s_yy
        for j in range(i + 1):
            p[i, j] -= worse * (by_x * gain[j, 0] + by_y * gain[j, 1])
            p[j, i] = p[i, j]


@kernel("void(f8[:,::1], f8[:,::1], f8[::1], f8[::1], f8, f8[::1])", part=True)
def correct_planar(nominal: Array, model: Array, belief: Array, change: Array, step_s: float, settings: Array) -> None:
    """Add a `change` (8,) to the planar part of the belief, share the side force out (`split_side_force`), and write drag
    and thrust per mass into the `model`: as the mass and the drag that fit the thrust that is commanded. See `observe`."""
    belief[0] += change[0]
    belief[1] += change[1]
    belief[4] += change[2]
    belief[5] += change[3]
    belief[11] += change[4]
    belief[12] += change[5]
    belief[17] = min(max(belief[17] + change[6], 1.0 / MOST_RATIO), MOST_RATIO)
    belief[18] = min(max(belief[18] + change[7], 1.0 / MOST_RATIO), MOST_RATIO)
    for i in range(2):
        model[0, i] = nominal[0, i] / belief[18]
        model[1, i] = nominal[1, i] * belief[17] / belief[18]
        model[2, i] = nominal[2, i] * belief[17] / belief[18]
    if settings[4] > 0.0:
        slope, share = sway_slope(model, belief[4], belief[5]), -math.expm1(-settings[4] * step_s)
        belief[12], current, drift = split_side_force(
            belief[12], complex(belief[15], belief[16]), belief[3], slope, share, settings[3]
        )
        belief[5] -= drift
        belief[15], belief[16] = current.real, current.imag


@kernel("void(f8[::1], f8, f8, f8, f8, f8, f8, f8)", part=True)
def correct_heave_and_yaw(
    belief: Array,
    error_yaw: float,
    depth_m: float,
    rate_radps: float,
    step_s: float,
    bandwidth_radps: float,
    yaw_bandwidth_radps: float,
    estimates: float,
) -> None:
    """Correction (31) of heave and yaw, `step_s` after the last one: eta += b1 e, nu += b2 e, Gamma += b3 e.

    `depth_m` and `rate_radps` are NaN when not known; `estimates` 0: no Gamma.
    """
    if not math.isnan(depth_m):
        b1, b2, b3 = gains(bandwidth_radps, step_s)
        error_z = depth_m - belief[2]
        belief[2] += b1 * error_z
        belief[6] += b2 * error_z
        belief[13] += estimates * b3 * error_z
    if math.isnan(rate_radps):
        b1, b2, b3 = gains(yaw_bandwidth_radps, step_s)
        error_r = error_yaw
    else:  # the gyroscope sees the rate at once, the camera keeps the heading; a gyro bias of 2 mrad/s moves it by 0.5 mrad
        b1, b2, b3 = gains_with_rate(yaw_bandwidth_radps, step_s)
        error_r = rate_radps - belief[7]
    belief[3] += b1 * error_yaw
    belief[7] += b2 * error_r
    belief[14] += estimates * b3 * error_r


@kernel("f8(i8[::1], f8[:,::1], i8, i8, i8)")
def sensed_at(sensed_ns: NDArray[np.int64], sensed: Array, count: int, column: int, at_ns: int) -> float:
    """Depth (column 0) or yaw rate (1) at an instant, from the last SENSED_LOOKED_AT of the first `count` samples of `sensed`
    (samples, 2): interpolated, held at the ends; NaN if there is none, or the newest is SENSED_HELD_NS older."""
    later_ns, later = 0, math.nan
    for i in range(count - 1, max(count - SENSED_LOOKED_AT, 0) - 1, -1):
        value = float(sensed[i, column])
        if math.isnan(value):
            continue
        if sensed_ns[i] <= at_ns:
            if math.isnan(later):
                return value if at_ns - sensed_ns[i] <= SENSED_HELD_NS else math.nan
            return float(value + (later - value) * (at_ns - sensed_ns[i]) / (later_ns - sensed_ns[i]))
        later_ns, later = sensed_ns[i], value
    return later


@kernel(
    "b1(f8[:,::1], f8[:,::1], f8, f8, f8[::1], f8[::1], f8[::1], f8[:,::1], f8[:,:,::1], i8[::1], f8[:,::1], i8, i8[::1],"
    " f8[:,::1], i8, f8[::1], i8, i8, i8, i8, f8[:,::1], f8[::1])"
)
def observe(
    nominal: Array,
    model: Array,
    sway: float,
    lag_s: float,
    settings: Array,
    noise: Array,
    belief: Array,
    covariance: Array,
    work: Array,
    acts_ns: NDArray[np.int64],
    wrenches: Array,
    inputs: int,
    sensed_ns: NDArray[np.int64],
    sensed: Array,
    samples: int,
    pose: Array,
    stamp_ns: int,
    at_ns: int,
    now_ns: int,
    acts_at_ns: int,
    now: Array,
    action: Array,
) -> bool:
    """One step of the observer: the `belief` of `at_ns`, corrected by a pose of `stamp_ns` if that is later, and predicted to
    now and on to when a command given now acts.

    `belief` (19,) is the state (11), Gamma (4), the current x, y (m/s), and drag and thrust per mass over those of the
    `nominal` model (3, 4), which are kept in `model` (3, 4) too; `covariance` (8, 8) is that of its planar part, `noise` (8,)
    and `work` (2, 8, 8) are as in `spread`. `settings` (5,): bandwidths of heave and of yaw (rad/s), 1 or without Gamma 0, the
    fastest current, the rate at which a side force goes to it. `pose` (5,): x, y, yaw, variance of x and y as it is believed
    and as it is told. The first `inputs` of `wrenches` act as in `propagate`; the first `samples` of `sensed` are depth and
    yaw rate as in `sensed_at`. Results: `now` (4, 4) has the rows eta; nu over ground; Gamma; Gamma with the acceleration by
    which the current changes drag; `action` (11,) is the state, its velocities through the water. Returns False, and leaves
    the belief as it was, if the pose is farther off than GATE_M or GATE_RAD.
    """
    state: State = (
        belief[0], belief[1], belief[2], belief[3], belief[4], belief[5], belief[6], belief[7],
        belief[8], belief[9], belief[10], 0.0,
    )  # fmt: skip
    gamma: tuple[float, ...] = (belief[11], belief[12], belief[13], belief[14])
    water, passes = (belief[15], belief[16]), True
    if stamp_ns > at_ns:
        there = propagate(model, sway, lag_s, state, gamma, water, acts_ns, wrenches, inputs, at_ns, stamp_ns)
        turned = np.fmod(pose[2] - there[3], TURN)
        turned = turned - TURN if turned >= math.pi else turned + TURN if turned < -math.pi else turned
        error_x, error_y = pose[0] - there[0], pose[1] - there[1]
        passes = math.hypot(error_x, error_y) <= GATE_M and abs(turned) <= GATE_RAD
        if passes:
            step_s = (stamp_ns - at_ns) * 1e-9
            steps = (stamp_ns - at_ns + LONGEST_STEP_NS - 1) // LONGEST_STEP_NS
            for _ in range(steps):
                spread(model, sway, belief, step_s / steps, noise, covariance, work)
            for i in range(11):
                belief[i] = there[i]
            weigh(covariance, error_x, error_y, pose[3], pose[4], work[0], work[1, 0])
            correct_planar(nominal, model, belief, work[1, 0], step_s, settings)
            correct_heave_and_yaw(
                belief, turned, sensed_at(sensed_ns, sensed, samples, 0, stamp_ns),
                sensed_at(sensed_ns, sensed, samples, 1, stamp_ns), step_s, settings[0], settings[1], settings[2],
            )  # fmt: skip
            at_ns = stamp_ns
            state = (
                belief[0], belief[1], belief[2], belief[3], belief[4], belief[5], belief[6], belief[7],
                belief[8], belief[9], belief[10], 0.0,
            )  # fmt: skip
            gamma = (belief[11], belief[12], belief[13], belief[14])
            water = (belief[15], belief[16])
    here = propagate(model, sway, lag_s, state, gamma, water, acts_ns, wrenches, inputs, at_ns, now_ns)
    then = propagate(model, sway, lag_s, here, gamma, water, acts_ns, wrenches, inputs, now_ns, acts_at_ns)
    for i in range(4):
        now[0, i], now[1, i], now[2, i], now[3, i] = here[i], here[4 + i], gamma[i], gamma[i]
    for i in range(11):
        action[i] = then[i]
    if water[0] != 0.0 or water[1] != 0.0:
        carried = complex(water[0], water[1]) * complex(math.cos(-here[3]), math.sin(-here[3]))
        through_u, through_v = drag(model, here[4], here[5])
        now[1, 0], now[1, 1] = here[4] + carried.real, here[5] + carried.imag
        over_u, over_v = drag(model, now[1, 0], now[1, 1])
        now[3, 0], now[3, 1] = gamma[0] + over_u - through_u, gamma[1] + over_v - through_v
    return passes


def flow_moment_nm(model: Array, velocity: Array) -> float:
    """Munk moment of a model (3, 4) at a velocity (4,) through the water, N m."""
    u, v = velocity[:2].tolist()
    return float((model.item(0) - model.item(1)) * u * v)


class Model:
    """Nominal dynamics of a vehicle. `sway = False` gives the article's model: v stays zero."""

    def __init__(self, vehicle: Vehicle, sway: bool = True, lag: bool = True) -> None:
        self.mass = tuple(float(m) for m in vehicle.inertia)
        self.linear = vehicle.drag.linear
        self.quadratic = vehicle.drag.quadratic
        self.nominal = np.array((self.mass, self.linear, self.quadratic), dtype=np.float64)  # (3, 4) for kernels
        self.coefficients = self.nominal.copy()  # as the observer has found them in flight
        self.sway = 1.0 if sway else 0.0
        self.lag_s = vehicle.thruster.lag_s if lag else 0.0
        self.coriolis = self.mass[1] / self.mass[0]  # m_v / m_u

    def lag(self, dt_s: float) -> tuple[float, float]:
        """Return the share of (thrust - command) that is left after `dt_s`, and its mean over `dt_s`."""
        return lag(self.lag_s, dt_s)

    def drag(self, u: float, v: float) -> tuple[float, float]:
        """Deceleration (2,) in m/s^2 by drag at horizontal velocities u, v through the water."""
        return drag(self.coefficients, u, v)

    def advance(self, state: State, disturbance: Sequence[float], wrench: Sequence[float], dt_s: float) -> State:
        """Return the state after `dt_s` (one control step or less) of a constant commanded wrench and disturbance (4,).
        Without side thrust `state` may have 11 numbers, and `wrench` 3."""
        whole, pushed = (*state, 0.0)[:STATES], (*wrench, 0.0)[: len(AXES)]
        after = advance(self.coefficients, self.sway, self.lag_s, whole, tuple(disturbance), pushed, dt_s)
        return after[: len(state)]
