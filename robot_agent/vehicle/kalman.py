"""Observer that tells a current from a force of the robot, and learns drag, thrust and yaw moment per mass: a bank of Kalman
filters (filter_bank.py) at the exposure of the newest pose.

Inputs, delays, gates and leaps are those of every observer (eso.py); heave keeps its poles at one bandwidth. All noise comes
from the vehicle file and from what poses report (docs/control.md has the table).
"""

import math
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from robot_agent.vehicle.dynamics import (
    LONGEST_STEP_NS,
    STATES,
    Commands,
    Model,
    MotionModel,
    drag,
    loop_delay_s,
    propagate,
)
from robot_agent.vehicle.eso import (
    GATE_RADPS,
    SENSED_LOOKED_AT,
    Estimator,
    Instants,
    Samples,
    Sighting,
    gains,
    gamma_of,
    passes_gate,
    sensed_at,
    state_of,
)
from robot_agent.vehicle.estimate import Deviations, Observation, PoseMeasurement, Ratios, StateMeasurement
from robot_agent.vehicle.filter_bank import (
    ACTING,
    BIAS,
    CURRENT_X,
    CURRENT_Y,
    DRAG,
    ERRORS,
    FORCE_R,
    FORCE_U,
    FORCE_V,
    GYRO,
    LN,
    NUMBERS,
    SIDE,
    YAW,
    Bank,
    MeasuredNumber,
    Noise,
    R,
    Restless,
    U,
    V,
    X,
    Y,
    correct,
    diffuse,
    interact,
    linearise,
    merge,
    predict,
    weigh_filters,
)
from shoal.config.controller import EstimatorConfig
from shoal.config.vehicle import Vehicle
from shoal.frames import Array
from shoal.kernels.decorator import kernel
from shoal.kernels.types import Floats, Table

KINDS = (  # of water: change with time m^2/s^3, over a metre (m/s)^2/m; of forces and moment: share of the thrusters' own
    (5e-8, 5e-7, 0.0, 0.0),  # a basin at rest: 1 mm/s within 10 s. It alone learns drag
    (1e-5, 0.0, 0.0, 0.0),  # with time, 1 cm/s,
    (6e-5, 0.0, 0.0, 0.0),  # 2.5 cm/s,
    (4e-4, 0.0, 0.0, 0.0),  # and 6 cm/s within 10 s: gusts, waves
    (0.0, 3e-4, 0.0, 0.0),  # from place to place: 2 cm/s,
    (0.0, 1.2e-3, 0.0, 0.0),  # and 3.5 cm/s over a metre
    (1e-7, 0.0, 0.1, 0.0),  # a push: no restless moment beside it, because the gyroscope would speak against both
    (1e-7, 0.0, 0.1, 0.1),  # a cable, a hand, a thruster that is not what it was
)
KIND_LASTS_S = 1000.0  # water changes its kind a few times in an hour. With 60 s covariances of still water are twice as large
FACING_S, FACING = 20.0, 0.5  # mean direction of so long, 1 on a straight path: shorter, drag can be told from a current
SHARE, PASSES_S = 0.03, 0.1  # of thrust and drag: what comes and goes, for so long. NEES of the grid is near 1 with it
LASTING_SHARE, LASTS_S = 0.03, 10.0  # of thrust and drag: what lasts, as a cable or unlike thrusters do
RATIO_PER_SQRT_S = 0.005  # by which drag, thrust and moment per mass wander in a second: 4 % in a minute
BIAS_RADPS_PER_SQRT_S = 1e-5  # the same of the gyroscope's bias: its sensor warms up within minutes
SPREAD = 0.06  # standard deviation of a thruster's thrust from its curve: makers say within 10 %
OUTLIER = 5.0  # standard deviations: a pose that is farther off counts less
FORCE_DELAY_SHARE, CURRENT_DELAY_SHARE = 0.6, 0.8  # bandwidth times delay, rad. Flown with 0.4 to 0.6 and 0.6 to 1
BEST_M, BEST_RAD = 1e-4, 3e-4  # no camera's pose is better
WORST_M, WORST_RAD = 0.05, 0.3  # one that is worse has not passed the localizer's gate
GYRO_RADPS, BIAS_RADPS = 0.003, 0.002  # noise and bias of a MEMS gyroscope's sample
DRAG_LOG, MASS_LOG = 0.3, 0.3  # standard deviations of ln drag and ln mass at first, from the vehicle file's,
ALIKE = 0.8  # and their correlation: a larger hull has more of both
# With 0.4, 0.4 and 0.5 NEES is 1 to 3 where the file is wrong by half, instead of 3 to 20; but a current is taken for a
# stronger one, and guidance is softer: 24 mm instead of 9 (mixed, 0).
MOST_FORCE = 2.0  # times the thrusters' largest acceleration: against more no robot holds its place, whatever its mass is
MOST_LOG = 1.4  # of drag, thrust, moment, yaw drag per mass: mass off by +100 % and drag by -50 % are 4 times the file's
AT_REST_MPS, AT_REST_RADPS = 0.03, 0.1  # over ground, when the estimate begins
HAND_S = 0.1  # for so long a hand that holds a robot pushes one way, with up to the thrusters' force
GATE_S = 0.24  # no yaw rate changes by more than the thrusters' moment does in 0.2 s, and a fifth
SMALL_M = 1e-6  # lever: a thruster with a smaller one turns no robot
IDLE_SHARE = 0.05  # of the largest thrust: the curve's slope is taken there where thrusters do not idle. Legs idle at it
NEUTRAL = 1e-6  # of the thrusters' force: that much is none
BANDWIDTH_S = 4.0  # over which the bandwidth is averaged

LEARNS, FACED_X, FACED_Y, BANDWIDTH = range(4)  # of `track`
OWN_U, OWN_V, OWN_R, WATER_X, WATER_Y = 11, 12, 14, 15, 16  # of the belief: own forces per mass, and the current


class LearnedModel(NamedTuple):
    """The model, and what is known of it."""

    nominal: Table  # (3, 4) by the vehicle file
    motion: MotionModel  # its coefficients as learned: written
    estimates: float  # 1; 0: no disturbance, no current
    heave_radps: float  # bandwidth of the heave observer
    fastest_mps: float  # no current is faster
    most_n: float  # surge force and
    most_nm: float  # yaw moment of the thrusters
    delay_s: float  # of the control loop, half a period left out


class Belief(NamedTuple):
    """Belief of the observer, and the arrays for its results."""

    numbers: Floats  # (NUMBERS,)
    track: Floats  # (4,): 1 if drag is learned, mean direction of late x, y, bandwidth rad/s
    deviation: Floats  # (12,) as `Deviations`
    now: Table  # (4, 4) as `Estimator._observe`
    action: Floats  # (12,)


@kernel(part=True)
def rate_before(samples: Samples, after_ns: int, until_ns: int) -> int:
    """Row of the newest yaw rate between two instants; -1 if there is none."""
    for i in range(samples.taken - 1, max(samples.taken - SENSED_LOOKED_AT, 0) - 1, -1):
        if after_ns < samples.sensed_ns[i] <= until_ns and not math.isnan(samples.sensed[i, 1]):
            return i
    return -1


@kernel(part=True)
def quickest(learned: LearnedModel, sighting: Sighting, step_s: float) -> Restless:
    """Largest intensities that filters may assume. The plan gives what they learn back to the thrusters, a delay later: more
    quickly learned than the delay allows, it makes the robot swing, and the swing is learned. The filter's bandwidth w is that
    at which the intensity, integrated to a place, is as large as the place's noise: w^6 = intensity / noise for a force, and
    w^4 for a current."""
    delay_s, noise = learned.delay_s + 0.5 * step_s, sighting.variance_m2 * step_s
    return Restless((FORCE_DELAY_SHARE / delay_s) ** 6 * noise, (CURRENT_DELAY_SHARE / delay_s) ** 4 * noise)


@kernel(part=True)
def cross(
    learned: LearnedModel,
    bank: Bank,
    noise: Noise,
    numbers: Floats,
    there: Floats,
    step_s: float,
    steps: int,
    restless: Restless,
) -> None:
    """Move the bank's errors on to the pose, `step_s` later, in equal `steps` between the belief and the state `there`. Forces
    and currents are no more `restless` than `quickest` says."""
    f, q, dt = bank.work[0], bank.work[1, 0], step_s / steps
    is_held = True
    for k, most in ((ACTING, learned.most_n), (ACTING + 1, learned.most_n), (ACTING + 2, learned.most_nm)):
        is_held &= max(abs(numbers[k]), abs(there[k])) < NEUTRAL * most
    is_held &= max(abs(numbers[SIDE]), abs(there[STATES - 1])) < NEUTRAL * learned.most_n
    between = numbers.copy()
    for i in range(steps):
        share = (i + 0.5) / steps
        for k in range(11):
            between[k] = numbers[k] + share * (there[k] - numbers[k])
        between[SIDE] = numbers[SIDE] + share * (there[STATES - 1] - numbers[SIDE])
        linearise(learned.motion.coefficients, learned.motion.sway, between, dt, noise, f)
        diffuse(learned.motion.coefficients, learned.motion.sway, between, dt, noise, is_held, q)
        predict(bank, learned.motion.sway, between, dt, f, q, restless)


@kernel(part=True)
def weigh_pose(
    bank: Bank,
    error: tuple[float, float, float],
    rate_error: float,
    rate_variance: float,
    sighting: Sighting,
    learns_drag: bool,
) -> None:
    """Correct every filter by a pose and a yaw rate (NaN: none), and weigh them by their likelihood. A pose farther off than
    OUTLIER deviations of each filter counts as if it were so much worse. With `learns_drag` the filter of still water does."""
    ex, ey, turned = error
    nearest2, spread = math.inf, 0.0
    for j in range(len(bank.weight)):
        p, mean = bank.covariance[j], bank.mean[j]
        dx, dy = ex - mean[X], ey - mean[Y]
        sxx, sxy, syy = p[X, X] + sighting.variance_m2, p[X, Y], p[Y, Y] + sighting.variance_m2
        far2 = (syy * dx * dx - 2.0 * sxy * dx * dy + sxx * dy * dy) / (sxx * syy - sxy * sxy)
        if far2 < nearest2:
            nearest2, spread = far2, max(sxx, syy)
    more_m2 = max(nearest2 / OUTLIER**2 - 1.0, 0.0) * spread
    likelihood, gain = bank.work[3, 1], bank.work[3, 2]
    for j in range(len(bank.weight)):
        p, mean, learns = bank.covariance[j], bank.mean[j], learns_drag and j == 0
        total = correct(p, mean, MeasuredNumber(X, -1, ex, sighting.variance_m2 + more_m2), learns, gain)
        total += correct(p, mean, MeasuredNumber(Y, -1, ey, sighting.variance_m2 + more_m2), learns, gain)
        total += correct(p, mean, MeasuredNumber(YAW, -1, turned, sighting.variance_rad2), learns, gain)
        if not math.isnan(rate_error):
            total += correct(p, mean, MeasuredNumber(R, GYRO, rate_error, rate_variance), learns, gain)
        likelihood[j] = total
    weigh_filters(bank, likelihood[: len(bank.weight)])


@kernel(part=True)
def inject(learned: LearnedModel, numbers: Floats, change: Floats) -> None:
    """Add the mean error to the belief, within bounds, and write the learned ratios into the model."""
    model, nominal, sway = learned.motion.coefficients, learned.nominal, learned.motion.sway
    # pose (0 to 3) and velocity (4 to 7)
    numbers[0] += change[X]
    numbers[1] += change[Y]
    numbers[3] += change[YAW]
    numbers[4] += change[U]
    numbers[5] += sway * change[V]
    numbers[7] += change[R]
    # own forces, no larger than a few times what thrusters can
    numbers[OWN_U] += learned.estimates * change[FORCE_U]
    numbers[OWN_V] += learned.estimates * sway * change[FORCE_V]
    numbers[OWN_R] += learned.estimates * change[FORCE_R]
    most_mps2 = MOST_FORCE * learned.most_n / nominal[0, 0]
    most_radps2 = MOST_FORCE * learned.most_nm / nominal[0, 3]
    numbers[OWN_U] = min(max(numbers[OWN_U], -most_mps2), most_mps2)
    numbers[OWN_V] = min(max(numbers[OWN_V], -most_mps2), most_mps2)
    numbers[OWN_R] = min(max(numbers[OWN_R], -most_radps2), most_radps2)
    # ratios and the gyroscope's bias
    for i in range(4):
        numbers[LN + i] = min(max(numbers[LN + i] + change[DRAG + i], -MOST_LOG), MOST_LOG)
    numbers[BIAS] += change[GYRO]
    # the current, no faster than one can be: what is beyond is the robot's motion through the water
    numbers[WATER_X] += sway * change[CURRENT_X]
    numbers[WATER_Y] += sway * change[CURRENT_Y]
    current_mps = math.hypot(numbers[WATER_X], numbers[WATER_Y])
    if current_mps > learned.fastest_mps:
        share = 1.0 - learned.fastest_mps / current_mps
        beyond_x, beyond_y = share * numbers[WATER_X], share * numbers[WATER_Y]
        cos, sin = math.cos(numbers[3]), math.sin(numbers[3])
        numbers[WATER_X] -= beyond_x
        numbers[WATER_Y] -= beyond_y
        numbers[4] += cos * beyond_x + sin * beyond_y
        numbers[5] += sway * (cos * beyond_y - sin * beyond_x)
    # inertia and both kinds of drag: of surge and sway, then of yaw
    drag_ratio, thrust_ratio = math.exp(numbers[LN]), math.exp(numbers[LN + 1])
    moment_ratio, yaw_drag_ratio = math.exp(numbers[LN + 2]), math.exp(numbers[LN + 3])
    for i in range(2):
        model[0, i] = nominal[0, i] / thrust_ratio
        model[1, i] = nominal[1, i] * drag_ratio / thrust_ratio
        model[2, i] = nominal[2, i] * drag_ratio / thrust_ratio
    model[0, 3] = nominal[0, 3] / moment_ratio
    model[1, 3] = nominal[1, 3] * yaw_drag_ratio / moment_ratio
    model[2, 3] = nominal[2, 3] * yaw_drag_ratio / moment_ratio


@kernel(part=True)
def correct_heave(learned: LearnedModel, numbers: Floats, depth_m: float, step_s: float) -> None:
    """Correction (31) of heave."""
    b1, b2, b3 = gains(learned.heave_radps, step_s)
    error = depth_m - numbers[2]
    numbers[2] += b1 * error
    numbers[6] += b2 * error
    numbers[13] += learned.estimates * b3 * error


@kernel(part=True)
def follow(bank: Bank, belief: Belief, sighting: Sighting, step_s: float) -> None:
    """Keep `track`: whether drag can be told from a current, and the bandwidth."""
    numbers, track = belief.numbers, belief.track
    share = -math.expm1(-step_s / FACING_S)
    track[FACED_X] += share * (math.cos(numbers[3]) - track[FACED_X])
    track[FACED_Y] += share * (math.sin(numbers[3]) - track[FACED_Y])
    track[LEARNS] = 1.0 if math.hypot(track[FACED_X], track[FACED_Y]) < FACING else 0.0
    left = max(1.0 - 0.5 * (bank.mixed[X, X] + bank.mixed[Y, Y]) / sighting.variance_m2, 1e-3)
    bandwidth = -0.5 * math.log(left) / step_s
    track[BANDWIDTH] += -math.expm1(-step_s / BANDWIDTH_S) * (bandwidth - track[BANDWIDTH]) if track[BANDWIDTH] else bandwidth


@kernel(part=True)
def tell_ground(learned: LearnedModel, now: Table, water_x: float, water_y: float) -> None:
    """Change the rows of `now` that a current changes: velocities are over ground, and what a model of still water does not
    explain is the drag too."""
    eta, nu, unexplained = now[0], now[1], now[3]
    in_water_u, in_water_v = drag(learned.motion.coefficients, nu[0], nu[1])
    cos, sin = math.cos(eta[3]), math.sin(eta[3])
    nu[0] += cos * water_x + sin * water_y
    nu[1] += cos * water_y - sin * water_x
    over_ground_u, over_ground_v = drag(learned.motion.coefficients, nu[0], nu[1])
    unexplained[0] += over_ground_u - in_water_u
    unexplained[1] += over_ground_v - in_water_v


@kernel(part=True)
def longer_axis(xx: float, xy: float, yy: float) -> float:
    """Longer half axis of the ellipse of a covariance."""
    return math.sqrt(max(0.5 * (xx + yy) + math.hypot(0.5 * (xx - yy), xy), 0.0))


@kernel(part=True)
def tell_deviations(p: Table, yaw: float, out: Floats) -> None:
    """Write the standard deviations of `Deviations`, own forces and ratios one by one."""
    cos, sin = math.cos(yaw), math.sin(yaw)
    ux, uy = cos * p[U, CURRENT_X] + sin * p[U, CURRENT_Y], cos * p[U, CURRENT_Y] - sin * p[U, CURRENT_X]  # u with the current
    vx, vy = cos * p[V, CURRENT_X] + sin * p[V, CURRENT_Y], cos * p[V, CURRENT_Y] - sin * p[V, CURRENT_X]  # on body axes
    xx, xy, yy = p[CURRENT_X, CURRENT_X], p[CURRENT_X, CURRENT_Y], p[CURRENT_Y, CURRENT_Y]
    ahead = cos * cos * xx + 2.0 * cos * sin * xy + sin * sin * yy
    aside = sin * sin * xx - 2.0 * cos * sin * xy + cos * cos * yy
    both = cos * sin * (yy - xx) + (cos * cos - sin * sin) * xy
    out[0], out[1] = longer_axis(p[X, X], p[X, Y], p[Y, Y]), math.sqrt(p[YAW, YAW])
    out[2] = longer_axis(p[U, U], p[U, V], p[V, V])
    out[3] = longer_axis(p[U, U] + 2.0 * ux + ahead, p[U, V] + uy + vx + both, p[V, V] + 2.0 * vy + aside)
    out[4], out[5] = math.sqrt(p[R, R]), longer_axis(xx, xy, yy)
    for i in range(3):
        out[6 + i], out[9 + i] = math.sqrt(max(p[FORCE_U + i, FORCE_U + i], 0.0)), math.sqrt(max(p[DRAG + i, DRAG + i], 0.0))


@kernel
def observe(
    learned: LearnedModel,
    noise: Noise,
    bank: Bank,
    belief: Belief,
    commands: Commands,
    samples: Samples,
    sighting: Sighting,
    instants: Instants,
) -> bool:
    """One step of the observer: the belief, corrected by a pose if there is a later one, and predicted to now and on to when a
    command given now acts. False, and the belief stays, if the pose is farther off than GATE_M or GATE_RAD."""
    numbers, motion, at_ns, stamp_ns, passes = belief.numbers, learned.motion, instants.at_ns, sighting.stamp_ns, True
    if stamp_ns > at_ns:
        state, gamma, water = state_of(numbers), gamma_of(numbers), (numbers[WATER_X], numbers[WATER_Y])
        expected = propagate(motion, state, gamma, water, commands, at_ns, stamp_ns)
        passes, ex, ey, turned = passes_gate(expected, sighting)
        if passes:
            step_s = (stamp_ns - at_ns) * 1e-9
            steps = (stamp_ns - at_ns + LONGEST_STEP_NS - 1) // LONGEST_STEP_NS
            arrived = np.array(expected)
            # The gyroscope against what the model expects at its own instant: between two samples a light hull turns freely
            sample, rate_error, late_s = rate_before(samples, at_ns, stamp_ns), math.nan, 0.0
            if sample >= 0:
                sensed_ns = samples.sensed_ns[sample]
                sensing = propagate(motion, state, gamma, water, commands, at_ns, sensed_ns)
                rate_error = samples.sensed[sample, 1] - sensing[7] - numbers[BIAS]
                late_s = (stamp_ns - sensed_ns) * 1e-9
            # Predict the filters and the belief to the pose's instant; own forces fade
            interact(bank, -math.expm1(-step_s / KIND_LASTS_S))
            restless = quickest(learned, sighting, step_s)
            cross(learned, bank, noise, numbers, arrived, step_s, steps, restless)
            for i in range(11):
                numbers[i] = arrived[i]
            numbers[SIDE] = arrived[STATES - 1]
            numbers[OWN_U] *= math.exp(-step_s / noise.lasts_s)
            numbers[OWN_V] *= math.exp(-step_s / noise.lasts_s)
            numbers[OWN_R] *= math.exp(-step_s / noise.lasts_s)
            # Correct them by the pose, the yaw rate and the depth
            rate_variance = GYRO_RADPS**2 + bank.work[1, 0, R] * steps / step_s * late_s
            weigh_pose(bank, (ex, ey, turned), rate_error, rate_variance, sighting, belief.track[LEARNS] > 0.0)
            change = bank.work[3, 3]
            merge(bank, change)
            inject(learned, numbers, change)
            depth = sensed_at(samples, 0, stamp_ns)
            if not math.isnan(depth):
                correct_heave(learned, numbers, depth, step_s)
            follow(bank, belief, sighting, step_s)
            at_ns = stamp_ns
    # Predict the robot's state now, and when a command given now acts
    gamma, water = gamma_of(numbers), (numbers[WATER_X], numbers[WATER_Y])
    present = propagate(motion, state_of(numbers), gamma, water, commands, at_ns, instants.now_ns)
    acting = propagate(motion, present, gamma, water, commands, instants.now_ns, instants.acts_ns)
    now = belief.now
    for i in range(4):
        now[0, i], now[1, i], now[2, i], now[3, i] = present[i], present[4 + i], gamma[i], gamma[i]
    tell_ground(learned, now, water[0], water[1])
    tell_deviations(bank.mixed, numbers[3], belief.deviation)
    for i in range(STATES):
        belief.action[i] = acting[i]
    return passes


def unlike_vehicle() -> Array:
    """Covariance (4, 4) of ln drag, thrust, yaw moment and yaw drag per mass, for a robot that differs from its vehicle file.

    Drag per mass and thrust per mass share the mass, so they are correlated; the two of yaw share the inertia.
    """
    both = ALIKE * DRAG_LOG * MASS_LOG
    drag2, mass2 = DRAG_LOG**2 + MASS_LOG**2 - 2.0 * both, MASS_LOG**2
    p = np.zeros((4, 4))
    p[0, 0] = p[3, 3] = drag2
    p[1, 1] = p[2, 2] = mass2
    p[0, 1] = p[1, 0] = p[2, 3] = p[3, 2] = mass2 - both
    return p


def vehicle_noise(vehicle: Vehicle) -> Noise:
    """Process noise that follows from a vehicle: rounding of its pulses, idle thrust, and a hand that pushes it."""
    mass_kg, inertia_kg_m2 = float(vehicle.inertia[0]), float(vehicle.inertia[3])
    surge_n, _, yaw_nm = vehicle.limits.wrench[:3]
    arm_m, turning = _lever_of(vehicle)
    idle_n = 2.0 * SPREAD * (0.0 if vehicle.legs is None else vehicle.legs.idle_thrust_n)  # of four against each other
    rounding_n = math.sqrt(turning) * _step_n(vehicle) / math.sqrt(12.0)
    hand_mps2, hand_radps2 = surge_n / mass_kg, yaw_nm / inertia_kg_m2
    return Noise(
        share=SHARE,
        passes_s=PASSES_S,
        lasting_share=LASTING_SHARE,
        lasts_s=LASTS_S,
        rounding_mps2=rounding_n / mass_kg,
        rounding_radps2=rounding_n * arm_m / inertia_kg_m2,
        idle_mps2=math.hypot(idle_n, rounding_n) / mass_kg,
        idle_radps2=math.hypot(idle_n, rounding_n) * arm_m / inertia_kg_m2,
        arm_m=arm_m,
        ratio_per_s=RATIO_PER_SQRT_S**2,
        bias_per_s=BIAS_RADPS_PER_SQRT_S**2,
        hand_m2ps3=2.0 * HAND_S * hand_mps2**2,
        hand_rad2ps3=2.0 * HAND_S * hand_radps2**2,
    )


def _lever_of(vehicle: Vehicle) -> tuple[float, int]:
    """Mean lever in m by which thrusters turn the robot, and how many do."""
    if vehicle.legs is not None:
        levers = np.abs(np.array(vehicle.legs.position_m)[:, 1])
    else:
        levers = np.abs(vehicle.mixing[2])
        levers = levers[levers > SMALL_M]
    return float(levers.mean()), len(levers)


def _step_n(vehicle: Vehicle) -> float:
    """By how much a thruster's force changes with a microsecond of its pulse at idle thrust."""
    idle_n = IDLE_SHARE * vehicle.thruster.max_thrust_n if vehicle.legs is None else vehicle.legs.idle_thrust_n
    pulse_us = vehicle.thruster.pulse_us(np.array(idle_n))
    return float(vehicle.thruster.force_n(pulse_us + 0.5) - vehicle.thruster.force_n(pulse_us - 0.5))


class KalmanEstimator(Estimator):
    """One robot's observer; see `Estimator` for its use."""

    numbers = NUMBERS

    def __init__(
        self, vehicle: Vehicle, model: Model, config: EstimatorConfig, dead_time_s: float, fastest_mps: float = math.inf
    ) -> None:
        """`fastest_mps` limits the estimated current."""
        kinds, count = np.array(KINDS).T.copy(), len(KINDS)
        self._vehicle, self._process = vehicle, vehicle_noise(vehicle)
        self._bank = Bank(
            by_time_m2ps3=kinds[0],
            by_place_mps2=kinds[1],
            force_m2ps5=2.0 / LASTS_S * (kinds[2] * vehicle.limits.wrench[0] / float(vehicle.inertia[0])) ** 2,
            moment_rad2ps5=2.0 / LASTS_S * (kinds[3] * vehicle.limits.wrench[2] / float(vehicle.inertia[3])) ** 2,
            weight=np.full(count, 1.0 / count),
            mean=np.zeros((count, ERRORS)),
            covariance=np.zeros((count, ERRORS, ERRORS)),
            mixed=np.zeros((ERRORS, ERRORS)),
            work=np.empty((4, ERRORS, ERRORS)),
        )
        self._track, self._deviation = np.zeros(4), np.zeros(12)
        self._fastest_mps = fastest_mps
        super().__init__(model, config, dead_time_s)
        self._gate_radps = max(GATE_S * vehicle.limits.wrench[2] / float(vehicle.inertia[3]), GATE_RADPS)

    def tune(self, config: EstimatorConfig) -> None:
        """Use other settings from the next pose on; the estimate stays."""
        surge_n, _, yaw_nm = self._vehicle.limits.wrench[:3]
        model = self._model
        self._uses_yaw_rate = config.use_imu_yaw_rate
        self._learned = LearnedModel(
            model.nominal, model.motion, float(config.enabled), config.bandwidth_radps, self._fastest_mps, surge_n, yaw_nm,
            loop_delay_s(self._vehicle, 0.0, model.lag_s),
        )  # fmt: skip

    def update(self, measurement: StateMeasurement, now_ns: int) -> Observation | None:
        """See `Estimator.update`. A belief that is no number any more is given up."""
        estimate = super().update(measurement, now_ns)
        if estimate is None:
            return None
        numbers, deviations = self._belief.tolist(), self._deviation.tolist()
        if not math.isfinite(sum(numbers) + sum(deviations)):
            self._forget()
            self._belief[:], self._bank.mixed[:], self._model.coefficients[:] = 0.0, 0.0, self._model.nominal
            return None
        drag_ratio, thrust_ratio, moment_ratio = (math.exp(value) for value in numbers[LN : LN + 3])
        place, yaw, velocity, ground, rate, current = deviations[:6]
        own_force = self._deviation[6:9].copy()
        drag_deviation, thrust_deviation, moment_deviation = deviations[9:]
        ratios = Ratios(drag_deviation, thrust_deviation, moment_deviation)
        return estimate._replace(
            estimate=replace(estimate.estimate, drag_ratio=drag_ratio, thrust_ratio=thrust_ratio),
            moment_ratio=moment_ratio,
            bandwidth_radps=self._track.item(BANDWIDTH),
            deviations=Deviations(place, yaw, velocity, ground, rate, current, own_force, ratios),
        )

    def _observe(self, pose: PoseMeasurement | None, now_ns: int, now: Array, action: Array) -> bool:
        """Update the bank of filters with a pose, if there is one, and predict to `now` and `action`, which are written.
        Returns False if the pose is outside the gate, and so was not used."""
        at_ns = self._at_ns
        sighting = Sighting(0.0, 0.0, 0.0, 1.0, 1.0, at_ns) if pose is None else _sighting(pose)
        return observe(
            self._learned,
            self._process,
            self._bank,
            Belief(self._belief, self._track, self._deviation, now, action),
            self._commands(),
            self._sensed_samples(),
            sighting,
            Instants(at_ns, now_ns, now_ns + self._dead_ns),
        )

    def _begin(self, pose: PoseMeasurement) -> None:
        """Begin at a pose, at rest over ground: the velocities through the water are those of the unknown current, reversed.
        The gyroscope's bias and the four ratios keep what was learned of them before."""
        super()._begin(pose)
        bank, noise, sway = self._bank, self._process, self._model.sway
        learned = np.array(bank.mixed[GYRO:, GYRO:])  # covariance of bias and ratios; 0 at the first begin
        p = np.zeros((ERRORS, ERRORS))
        if learned.any():
            p[GYRO:, GYRO:] = learned
        else:
            p[DRAG:, DRAG:] = sway * self._learned.estimates * unlike_vehicle()
            p[GYRO, GYRO] = BIAS_RADPS**2
        sighting = _sighting(pose)
        p[X, X] = p[Y, Y] = sighting.variance_m2
        p[YAW, YAW] = sighting.variance_rad2
        current2 = sway * (0.5 * min(self._fastest_mps, 1.0)) ** 2
        p[CURRENT_X, CURRENT_X] = p[CURRENT_Y, CURRENT_Y] = current2
        p[U, U], p[V, V] = AT_REST_MPS**2 + current2, sway * (AT_REST_MPS**2 + current2)
        cos, sin = math.cos(pose.yaw_rad), math.sin(pose.yaw_rad)
        for row, x, y in ((U, cos, sin), (V, -sin, cos)):  # at rest over ground: the water passes by as it streams
            p[row, CURRENT_X] = p[CURRENT_X, row] = -x * current2
            p[row, CURRENT_Y] = p[CURRENT_Y, row] = -y * current2
        p[R, R] = AT_REST_RADPS**2
        p[FORCE_U, FORCE_U], p[FORCE_R, FORCE_R] = noise.idle_mps2**2, noise.idle_radps2**2
        p[FORCE_V, FORCE_V] = sway * noise.rounding_mps2**2
        bank.covariance[:], bank.mean[:], bank.mixed[:] = p, 0.0, p
        bank.weight[0], bank.weight[1:] = 0.5, 0.5 / (len(bank.weight) - 1)  # as likely at rest as not
        self._track[:] = 0.0, cos, sin, 0.0


def _sighting(pose: PoseMeasurement) -> Sighting:
    """A pose with variances that can be: one that is no number says nothing good."""
    variance_m2, variance_rad2 = _within(pose.variance_m2, BEST_M, WORST_M), _within(pose.variance_rad2, BEST_RAD, WORST_RAD)
    return Sighting(pose.x_m, pose.y_m, pose.yaw_rad, variance_m2, variance_rad2, pose.stamp_ns)


def _within(variance: float, best: float, worst: float) -> float:
    return min(max(variance, best**2), worst**2) if math.isfinite(variance) else worst**2


def make_estimator(vehicle: Vehicle, model: Model, config: EstimatorConfig) -> Estimator:
    """The observer that a configuration asks for."""
    dead_time_s = vehicle.thruster.dead_time_s
    if config.kind == "kalman":
        return KalmanEstimator(vehicle, model, config, dead_time_s, vehicle.limits.speed_mps)
    return Estimator(model, config, dead_time_s)
