"""The observer's equations: a bank of Kalman filters for one error state, that take the water for more or less restless.

Errors (ERRORS) of the belief, in this order:

    x, y, yaw | u, v, r through the water | b_u, b_v, b_r: accelerations by forces of the robot, which turn along with it
    c_x, c_y: current, fixed in the pool | gyroscope's bias
    ln of drag, thrust, yaw moment, yaw drag per mass or inertia over the vehicle file's

The belief moves by the model (dynamics.py), with mass m / t, drag d / t, inertia I / n and yaw drag a / n. Its errors e have
covariance P:

    P <- F P F' + Q dt      F: derivative of the model's step            predict
    e <- e + K (z - H e)    K = P H' / (H P H' + R)    P <- P - K H P     correct, one number after the other

Nobody knows how fast the water changes: still water and gusts differ by a factor of 4,000 in Q. Nor how: a current that
changes with time takes the hull along, one that differs from place to place does not. So each filter of the bank assumes one
kind of water, and the poses tell which is right: its weight grows with the likelihood of what it expected (multiple models;
Blom and Bar-Shalom 1988). All share belief and F; the mean of their errors goes into the belief after each pose, and P of the
whole is that of the mixture. One more filter has surge and sway forces that change quickly: a push. Its moment is no more
restless than that of the others: the gyroscope speaks against a restless moment at every pose, the filter loses its weight, is
filled with the mixture at every pose, and never has a force of its own. Another has both: a cable, a broken thruster.

Drag and current are one direction on a straight path. There drag is considered and not learned (Schmidt): it keeps its
variance, and that of the others counts it. So it is in the filters of restless water, on any path. The filter of still water
learns it whatever its weight is: a wrong drag looks like restless water, until that filter has learned.
"""

import math
from typing import NamedTuple

from robot_agent.vehicle.dynamics import phi_dt
from shoal.kernels.decorator import kernel
from shoal.kernels.types import Cube, Floats, Table

ERRORS = 16
X, Y, YAW, U, V, R, FORCE_U, FORCE_V, FORCE_R, CURRENT_X, CURRENT_Y, GYRO, DRAG, THRUST, MOMENT, TURN_DRAG = range(ERRORS)
NUMBERS = 23  # of the belief: state 11, own forces 4, current 2, the four ln, gyroscope's bias, side thrust
ACTING, LN, BIAS, SIDE = 8, 17, 21, 22  # of the belief: thrust that acts now: surge, heave, yaw; and sway: last, as in eso.py
# Water of another place also drifts past a robot that rests: without it HOLD in a current was twice as far off.
PASSES_MPS = 0.03  # measured at currents of 0.6 to 0.8 of the speed, not derived
LEAST_WEIGHT = 1e-6  # of a filter: it comes back within a second when the water turns out to be as it says


class Noise(NamedTuple):
    """Process noise of a vehicle: of its forces, per mass. Each has a part that lasts and one that comes and goes."""

    share: float  # of thrust and drag: what comes and goes,
    passes_s: float  # and for how long it stays
    lasting_share: float  # what lasts,
    lasts_s: float  # and for how long
    rounding_mps2: float  # by pulses that are whole microseconds
    rounding_radps2: float
    idle_mps2: float  # by idle thrusters that are not alike: lasts
    idle_radps2: float
    arm_m: float  # unlike thrusters turn the robot as they push
    ratio_per_s: float  # variance by which drag, thrust and moment per mass wander in a second
    bias_per_s: float  # (rad/s)^2: the same for the gyroscope's bias
    hand_m2ps3: float  # intensity of a hand that holds a robot without thrust,
    hand_rad2ps3: float  # and turns it


class Bank(NamedTuple):
    """The filters with their memory. Every array is changed in place."""

    by_time_m2ps3: Floats  # (filters,) intensity of the current's change with time that each assumes,
    by_place_mps2: Floats  # (filters,) variance of its change over a metre of the robot's way,
    force_m2ps5: Floats  # (filters,) intensity of surge and sway forces beyond what `Noise` says,
    moment_rad2ps5: Floats  # (filters,) and of the yaw moment
    weight: Floats  # (filters,) their sum is 1
    mean: Table  # (filters, ERRORS) of the error, about the common belief: that of the whole is 0 between two poses
    covariance: Cube  # (filters, ERRORS, ERRORS)
    mixed: Table  # (ERRORS, ERRORS) covariance of the whole bank
    work: Cube  # (4, ERRORS, ERRORS), overwritten


class Restless(NamedTuple):
    """Largest intensities of changes that filters may assume."""

    force_m2ps5: float
    current_m2ps3: float


class MeasuredNumber(NamedTuple):
    """A measured number: of the error in `row`, or of the sum of two errors."""

    row: int
    other: int  # row of the second error; -1: none
    error: float  # measured less believed
    variance: float


@kernel(part=True)
def linearise(model: Table, sway: float, belief: Floats, dt: float, noise: Noise, f: Table) -> None:
    """Write F (ERRORS, ERRORS), derivative of `dynamics.advance` at the middle of a step of `dt`, with thrusts that act.

        u' = (thrust - d(w) u) / m_u + m_v / m_u v r            d(w) = linear + quadratic sqrt(u^2 + v^2)
        v' = (side thrust - d(w) v) / m_v - m_u / m_v u r
        r' = (moment + (m_u - m_v) u v - d(r) r) / m_r          d(r) = linear + quadratic |r|

    F = 1 + phi A with the derivative A of these; of each axis, phi = (1 - exp(-slope dt)) / slope, and slope is minus the
    derivative by its own velocity.
    """
    yaw, u, v, r = belief[3], belief[4], belief[5], belief[7]
    m_u, m_v, m_r = model[0, 0], model[0, 1], model[0, 3]
    speed = math.sqrt(u * u + v * v)
    per_speed = 1.0 / speed if speed > 1e-9 else 0.0
    ratio = m_v / m_u
    drag_u, drag_v = (model[1, 0] + model[2, 0] * speed) / m_u, (model[1, 1] + model[2, 1] * speed) / m_v  # d / m, 1/s
    drag_r = (model[1, 3] + model[2, 3] * abs(r)) / m_r
    slope_u, slope_v = drag_u + model[2, 0] * u * u * per_speed / m_u, drag_v + model[2, 1] * v * v * per_speed / m_v
    slope_r = drag_r + model[2, 3] * abs(r) / m_r
    phi_u, phi_v, phi_r = phi_dt(slope_u, dt), sway * phi_dt(slope_v, dt), phi_dt(slope_r, dt)
    f[:] = 0.0
    for i in range(ERRORS):
        f[i, i] = 1.0
    # surge
    f[U, U], f[U, R] = 1.0 - phi_u * slope_u, phi_u * ratio * v
    f[U, V] = phi_u * (ratio * r - model[2, 0] * u * v * per_speed / m_u)
    f[U, FORCE_U], f[U, DRAG], f[U, THRUST] = phi_u, -phi_u * drag_u * u, phi_u * belief[ACTING] / m_u
    # sway
    f[V, V] = 1.0 - phi_v * slope_v if sway > 0.0 else 0.0
    f[V, U] = -phi_v * (r / ratio + model[2, 1] * u * v * per_speed / m_v)
    f[V, R] = -phi_v * u / ratio
    f[V, FORCE_V], f[V, DRAG], f[V, THRUST] = phi_v, -phi_v * drag_v * v, phi_v * belief[SIDE] / m_v
    # yaw
    munk = (m_u - m_v) * u * v  # grows with the masses that are learned, 1 / t
    f[R, R], f[R, U], f[R, V] = 1.0 - phi_r * slope_r, phi_r * (m_u - m_v) * v / m_r, phi_r * (m_u - m_v) * u / m_r
    f[R, FORCE_R], f[R, MOMENT], f[R, THRUST] = phi_r, phi_r * (belief[ACTING + 2] + munk) / m_r, -phi_r * munk / m_r
    f[R, TURN_DRAG] = -phi_r * drag_r * r
    f[FORCE_U, FORCE_U] = f[FORCE_V, FORCE_V] = f[FORCE_R, FORCE_R] = math.exp(-dt / noise.lasts_s)
    # place and heading: half of the way by the velocity before the step, half by that after it
    cos, sin = math.cos(yaw), math.sin(yaw)
    for j in range(U, ERRORS):
        ahead = 0.5 * dt * (f[U, j] + (1.0 if j == U else 0.0))
        aside = 0.5 * dt * (f[V, j] + (1.0 if j == V else 0.0))
        f[X, j], f[Y, j] = cos * ahead - sin * aside, sin * ahead + cos * aside
        f[YAW, j] = 0.5 * dt * (f[R, j] + (1.0 if j == R else 0.0))
    f[X, YAW], f[Y, YAW] = dt * (-sin * u - cos * v), dt * (cos * u - sin * v)
    f[X, CURRENT_X] = f[Y, CURRENT_Y] = dt


@kernel(part=True)
def diffuse(model: Table, sway: float, belief: Floats, dt: float, noise: Noise, is_held: bool, q: Floats) -> None:
    """Write the diagonal of Q dt (ERRORS,), the current's left out. A robot without thrust may be in somebody's hand."""
    u, v, r = belief[4], belief[5], belief[7]
    speed = math.sqrt(u * u + v * v)
    drag_u, drag_v = (
        (model[1, 0] + model[2, 0] * speed) * u / model[0, 0],
        (model[1, 1] + model[2, 1] * speed) * v / model[0, 1],
    )
    drag_r = (model[1, 3] + model[2, 3] * abs(r)) * r / model[0, 3]
    thrust, moment = belief[ACTING] / model[0, 0], belief[ACTING + 2] / model[0, 3]
    push = belief[SIDE] / model[0, 1]
    unlike = noise.arm_m * math.hypot(belief[ACTING], belief[SIDE]) / model[0, 3]
    along2, aside2 = thrust * thrust + drag_u * drag_u + drag_v * drag_v, drag_u * drag_u + drag_v * drag_v
    along2, aside2 = along2 + push * push, aside2 + push * push
    around2 = moment * moment + drag_r * drag_r + unlike * unlike
    passing, lasting2 = 2.0 * noise.passes_s * dt, noise.lasting_share**2
    q[:] = 0.0
    q[U] = passing * (noise.rounding_mps2**2 + noise.share**2 * along2)
    q[V] = sway * passing * (noise.rounding_mps2**2 + noise.share**2 * aside2)
    q[R] = passing * (noise.rounding_radps2**2 + noise.share**2 * around2)
    q[FORCE_U] = 2.0 * dt / noise.lasts_s * (noise.idle_mps2**2 + lasting2 * along2)
    q[FORCE_V] = sway * 2.0 * dt / noise.lasts_s * (noise.rounding_mps2**2 + lasting2 * along2)
    q[FORCE_R] = 2.0 * dt / noise.lasts_s * (noise.idle_radps2**2 + lasting2 * around2)
    q[DRAG] = q[THRUST] = q[MOMENT] = q[TURN_DRAG] = noise.ratio_per_s * dt
    q[GYRO] = noise.bias_per_s * dt
    if is_held:
        q[U] += noise.hand_m2ps3 * dt
        q[V] += sway * noise.hand_m2ps3 * dt
        q[R] += noise.hand_rad2ps3 * dt


@kernel(part=True)
def multiply(f: Table, p: Table, product: Table) -> None:
    """Write F p, and transpose it. Most of F is zero."""
    for i in range(ERRORS):
        for j in range(ERRORS):
            product[j, i] = 0.0
        for k in range(ERRORS):
            factor = f[i, k]
            if factor != 0.0:
                for j in range(ERRORS):
                    product[j, i] += factor * p[k, j]


@kernel(part=True)
def stream(p: Table, by_time: float, kept: float, cos: float, sin: float) -> None:
    """Add the variances by which the current has changed. Water that changes with time takes the hull along, and leaves its
    motion through the water alone. Water that is another at another place does not: the hull has `kept` its motion over
    ground."""
    p[CURRENT_X, CURRENT_X] += by_time + kept
    p[CURRENT_Y, CURRENT_Y] += by_time + kept
    p[U, U] += kept
    p[V, V] += kept
    p[U, CURRENT_X] -= kept * cos
    p[U, CURRENT_Y] -= kept * sin
    p[V, CURRENT_X] += kept * sin
    p[V, CURRENT_Y] -= kept * cos
    for i in (CURRENT_X, CURRENT_Y):
        p[i, U], p[i, V] = p[U, i], p[V, i]


@kernel(part=True)
def predict(bank: Bank, sway: float, belief: Floats, dt: float, f: Table, q: Floats, restless: Restless) -> None:
    """Move the errors of each filter on by `dt`: e = F e, P = F P F' + Q dt. Forces and currents are no more `restless`."""
    half, moved = bank.work[2], bank.work[3, 0]
    cos, sin = math.cos(belief[3]), math.sin(belief[3])
    ahead, across = cos * belief[4] - sin * belief[5] + belief[15], sin * belief[4] + cos * belief[5] + belief[16]
    way_m = dt * max(math.hypot(ahead, across), PASSES_MPS)
    for j in range(len(bank.weight)):
        p, mean = bank.covariance[j], bank.mean[j]
        multiply(f, p, half)
        multiply(f, half, p)
        for i in range(ERRORS):
            total = 0.0
            for k in range(ERRORS):
                total += f[i, k] * mean[k]
            moved[i] = total
            if p[i, i] > 0.0 or (U <= i <= CURRENT_Y):  # ratios and bias that are not learned have no variance
                p[i, i] += q[i]
        for i in range(ERRORS):
            mean[i] = moved[i]
        force = min(bank.force_m2ps5[j], restless.force_m2ps5)
        p[FORCE_U, FORCE_U] += force * dt
        p[FORCE_V, FORCE_V] += sway * force * dt
        p[FORCE_R, FORCE_R] += bank.moment_rad2ps5[j] * dt
        most = restless.current_m2ps3 * dt
        by_time, by_place = min(bank.by_time_m2ps3[j] * dt, most), min(bank.by_place_mps2[j] * way_m, most)
        stream(p, sway * by_time, sway * by_place, cos, sin)


@kernel(part=True)
def correct(p: Table, mean: Floats, measured: MeasuredNumber, learns: bool, gain: Floats) -> float:
    """Correct one filter's covariance `p` and `mean` by one measured number; returns the innovation's log-likelihood. `gain`
    (ERRORS,) is overwritten."""
    row, other = measured.row, measured.other
    for i in range(ERRORS):
        gain[i] = p[i, row] + (p[i, other] if other >= 0 else 0.0)
    s: float = gain[row] + (gain[other] if other >= 0 else 0.0) + measured.variance
    innovation: float = measured.error - mean[row] - (mean[other] if other >= 0 else 0.0)
    for i in range(ERRORS):
        if i != DRAG or learns:
            mean[i] += gain[i] / s * innovation
    for i in range(ERRORS):
        for j in range(i + 1):
            if i != DRAG or j != DRAG or learns:
                p[i, j] -= gain[i] * gain[j] / s
            p[j, i] = p[i, j]
    return -0.5 * (innovation * innovation / s + math.log(s))


@kernel(part=True)
def interact(bank: Bank, change: float) -> None:
    """Let the water change its kind: the share `change` of all weight, with mean and covariance of the whole bank, goes to
    every filter in equal parts."""
    for j in range(len(bank.weight)):
        p, mean, new = bank.covariance[j], bank.mean[j], change / len(bank.weight)
        kept = (1.0 - change) * bank.weight[j]
        bank.weight[j] = kept + new
        old, fresh = kept / (kept + new), new / (kept + new)
        for a in range(ERRORS):
            for b in range(ERRORS):
                p[a, b] = old * (p[a, b] + fresh * mean[a] * mean[b]) + fresh * bank.mixed[a, b]
        for a in range(ERRORS):
            mean[a] *= old


@kernel(part=True)
def weigh_filters(bank: Bank, likelihood: Floats) -> None:
    """Weigh the filters by the logarithms of their `likelihood` (filters,)."""
    most = likelihood[0]
    for j in range(1, len(likelihood)):
        most = max(most, likelihood[j])
    total = 0.0
    for j in range(len(likelihood)):
        bank.weight[j] = max(bank.weight[j] * math.exp(likelihood[j] - most), LEAST_WEIGHT)
        total += bank.weight[j]
    for j in range(len(likelihood)):
        bank.weight[j] /= total


@kernel(part=True)
def merge(bank: Bank, change: Floats) -> None:
    """Write the mean error of the bank, `change` (ERRORS,), and `bank.mixed`, its covariance. The filters' means are about the
    belief that `change` corrects."""
    change[:] = 0.0
    for j in range(len(bank.weight)):
        for a in range(ERRORS):
            change[a] += bank.weight[j] * bank.mean[j, a]
    bank.mixed[:] = 0.0
    for j in range(len(bank.weight)):
        for a in range(ERRORS):
            bank.mean[j, a] -= change[a]
        for a in range(ERRORS):
            for b in range(a + 1):
                bank.mixed[a, b] += bank.weight[j] * (bank.covariance[j, a, b] + bank.mean[j, a] * bank.mean[j, b])
    for a in range(ERRORS):
        for b in range(a):
            bank.mixed[b, a] = bank.mixed[a, b]
