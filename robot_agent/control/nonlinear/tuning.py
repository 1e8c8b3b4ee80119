"""Weights, horizon and bandwidths as formulas of vehicle, control period and noise. No number here is a vehicle's own.

A triple integrator that may change its force at a rate F', and has to correct an error e, is as quick as (F' / (m e))^(1/3).
From this come both bandwidths: `quickness` of the place and `turning` of the heading. They are limited by the delay of the
loop, by the noise (estimates must not move the inputs by more than ROUGH of their rate limits) and by the observer.
`formulas` is the table of docs/control.md.
"""

import math
from typing import NamedTuple

import numpy as np

from robot_agent.control.nonlinear.prediction import FIRST_S, Hull
from robot_agent.control.nonlinear.program import InputLimits, Weights
from robot_agent.guidance.velocity_obstacles import FASTEST_SHARE, Agility
from robot_agent.vehicle.dynamics import loop_delay_s
from robot_agent.vehicle.estimate import Deviations, Ratios
from shoal.config.controller import WAY_ROOM_M
from shoal.config.vehicle import Vehicle
from shoal.frames import Array

REACH_SHARE = 0.4  # of the hull's radius: an error of the place that may use the whole force rate
REACH_RAD = 0.35  # the same of the heading
DELAY_SHARE, TURN_DELAY_SHARE = 0.4, 0.6  # bandwidth times delay: phase lost in the loop, rad
ROUGH = 0.05  # of the rate limits that noise alone may use
TRUST = 2.0  # a thrust that is known to 50 % halves the bandwidth
SHORTEST_S, LONGEST_S = 6.0, 12.0  # horizon: flown from 5 to 14 s; shorter ones do not find the turn round, longer are coarse
TILT_RAD = 0.35  # most pitch by thrust alone, and in steady flight: at 0.8 rad a hull rose by 0.24 m within 2 s
GRAVITY_MPS2 = 9.81
STEP_S = 0.2  # longest step of the integration; 1/slope of the drag for light robots
TURNING_M = 0.01  # m s: turning at 1 rad/s for a second costs as much as 1 cm
SLOW_MPS = 0.02  # through the water: slower, the heading does not matter
FACING_S = 1000.0  # for so long and longer flies stern first who does so at the horizon's end: to the path's end
END_SHARE = 2.0  # weight at the end: that of an error which fades at the bandwidth, twice
CHANGE_SHARE = 0.3  # of the acceleration by full thrust: that of the point that goes around others
RETURN_SHARE = 0.4  # of the place's bandwidth: the same point's way back, no overshoot
LOOK_AHEAD_S = 7.0  # of the same point: two robots at 0.1 m/s begin to turn 1.4 m before they would touch
SLOWEST_RADPS = 0.2  # poses that say nothing for a while must not end the loop: an error then lasts 10 s
MODEL_SHARE = 0.5  # of the observer's bandwidth of depth: with 0.7 a robot of half the mass swung up and down at 50 Hz


SURGE, SWAY, YAW = range(3)  # of the plan's axes
NAMES = ("surge", "sway", "yaw")
WRENCH_AXIS = {SURGE: 0, SWAY: 3, YAW: 2}  # of a wrench: number of the plan's axis


class Bandwidths(NamedTuple):
    """Bandwidths, rad/s."""

    quickness: float  # of the place
    calm_quickness: float  # of the place, for an error of REACH_SHARE radius: what counts at the horizon's end
    turning: float  # of the heading
    depth: float


class Manner(NamedTuple):
    """Manner in which a kind of goal is flown."""

    turning_m: float  # m s: what turning at 1 rad/s for a second costs
    facing_s: float  # for so long counts the heading at the horizon's end
    is_steered: bool = False  # a person asks for a heading and a speed, and for no line


def planar_axes(vehicle: Vehicle) -> tuple[int, ...]:
    """The plan's axes that have thrusters."""
    return (SURGE, SWAY, YAW) if vehicle.limits.has_sway else (SURGE, YAW)


def horizon_s(vehicle: Vehicle) -> float:
    """Twice the time to turn round and to stop from full speed."""
    mass, _, _, inertia = vehicle.inertia.tolist()
    force_n, _, moment_nm = vehicle.limits.wrench[:3]
    turn_s = 2.0 * math.sqrt(math.pi * inertia / moment_nm) + math.pi / (2.0 * vehicle.limits.yaw_rate_radps)
    stop_s = mass * vehicle.limits.speed_mps / force_n
    return float(min(max(2.0 * (turn_s + stop_s), SHORTEST_S), LONGEST_S))


def fastest_mps(vehicle: Vehicle) -> float:
    """The file's greatest speed, or that at which steady flight pitches the hull by TILT_RAD: thrust as large as the drag
    (l + q v) v, below the centre, and the water by (m_w - m_u) v^2 per radian, against the righting moment."""
    righting, limit_mps = vehicle.righting, vehicle.limits.speed_mps
    if righting is None:
        return limit_mps
    square = vehicle.drag.quadratic[0] * righting.thrusters_below_m
    square += TILT_RAD * (vehicle.mass.heave_kg - vehicle.mass.surge_kg)
    linear, most = vehicle.drag.linear[0] * righting.thrusters_below_m, TILT_RAD * righting.moment_nm
    if (linear + square * limit_mps) * limit_mps <= most:
        return limit_mps
    return 2.0 * most / (linear + math.sqrt(linear**2 + 4.0 * square * most))


def agility(vehicle: Vehicle) -> Agility:
    """Agility of the point that goes around others. It returns as fast as it may, and slower near the path: no overshoot."""
    mass, around_mps = vehicle.mass.surge_kg, FASTEST_SHARE * fastest_mps(vehicle)
    change_mps2 = CHANGE_SHARE * vehicle.limits.wrench[0] / mass
    quickness = cube_root(vehicle.limits.wrench_rate_per_s[0], mass, REACH_SHARE * vehicle.radius_m)
    return Agility(WAY_ROOM_M, LOOK_AHEAD_S, around_mps, change_mps2, RETURN_SHARE * quickness, around_mps)


def cube_root(rate: float, inertia: float, reach: float) -> float:
    """Bandwidth at which an error `reach` uses the whole rate."""
    return math.pow(rate / (inertia * reach), 1.0 / 3.0)


def derive(vehicle: Vehicle, delay: float, sigma: Deviations, observer_radps: tuple[float, float], off_m: float) -> Bandwidths:
    """Bandwidths for a robot that is `off_m` away from its path; the observer has one for the place and one for depth."""
    mass, mass_v, mass_w, inertia = vehicle.inertia.tolist()
    force_rate, lift_rate, moment_rate, *side_rate = vehicle.limits.wrench_rate_per_s
    for rate in side_rate:  # the slower of both axes moves the place
        mass, force_rate = max((mass, force_rate), (mass_v, rate), key=lambda axis: axis[0] / axis[1])
    reach_m = REACH_SHARE * vehicle.radius_m
    observer = observer_radps[0] / (1.0 + TRUST * sigma.ratios.thrust)
    late = DELAY_SHARE / delay
    error_m = max(sigma.place_m / ROUGH, min(off_m, reach_m), 1e-4)
    rough = math.sqrt(ROUGH * force_rate / (mass * max(sigma.ground_mps, 1e-4)))
    calm = cube_root(force_rate, mass, reach_m)
    quickness = max(min(cube_root(force_rate, mass, error_m), rough, late, observer), SLOWEST_RADPS)
    turning = min(
        cube_root(moment_rate, inertia, REACH_RAD),
        cube_root(ROUGH * moment_rate, inertia, max(sigma.yaw_rad, 1e-5)),
        TURN_DELAY_SHARE / delay,
    )
    depth = max(min(cube_root(lift_rate, mass_w, reach_m), late, MODEL_SHARE * observer_radps[1]), SLOWEST_RADPS)
    return Bandwidths(quickness, min(quickness, calm), turning, depth)


def rate_weight(mass: float, bandwidth_radps: float, arm_m: float = 1.0) -> float:
    """Weight of a force's squared rate with which errors fade at a bandwidth; `arm_m` is what a radian is worth."""
    return (arm_m / (mass * bandwidth_radps**3)) ** 2


def planar_weights(vehicle: Vehicle, tuning: Bandwidths, arm_m: float, manner: Manner, entry: float) -> Weights:
    """Weights of surge, sway if the vehicle has it, and yaw."""
    mass, mass_v, _, inertia = vehicle.inertia.tolist()
    of = {
        SURGE: rate_weight(mass, tuning.quickness),
        SWAY: rate_weight(mass_v, tuning.quickness),
        YAW: rate_weight(inertia, tuning.turning, arm_m),
    }
    rate = np.array([of[axis] for axis in planar_axes(vehicle)])
    end_s, lead_s = END_SHARE / tuning.calm_quickness, 1.0 / tuning.calm_quickness
    return Weights(rate, manner.turning_m**2, end_s, lead_s, manner.facing_s, entry, manner.is_steered)


def depth_weights(vehicle: Vehicle, tuning: Bandwidths) -> Weights:
    """Weights of heave. Depth has no heading, so those of turning and facing are 0."""
    rate = np.array([rate_weight(vehicle.mass.heave_kg, tuning.depth)])
    end_s, lead_s = END_SHARE / tuning.depth, 1.0 / tuning.depth
    return Weights(
        rate, turning_m2=0.0, end_s=end_s, lead_s=lead_s, facing_s=0.0, entry=1.0, is_steered=False
    )  # fmt: skip


def planar_limits(vehicle: Vehicle) -> InputLimits:
    """Limits of surge, sway and yaw. A force that would tilt the hull by more than TILT_RAD is not asked for, nor within less
    than half a swing: a hull that pitches lifts itself off its depth, and no observer of four axes knows why. Nor is more
    asked for than steady flight takes at the greatest speed that the hull stands, if that is less than the file's."""
    axes = planar_axes(vehicle)
    size = np.array([vehicle.limits.wrench[WRENCH_AXIS[axis]] for axis in axes])
    rate = np.array([vehicle.limits.wrench_rate_per_s[WRENCH_AXIS[axis]] for axis in axes])
    if vehicle.righting is not None:
        moment_nm, below_m, swing_s = vehicle.righting.moment_nm, vehicle.righting.thrusters_below_m, vehicle.righting.swing_s
        for i, axis in enumerate(axes[:-1]):  # of the thrust, and of the mass it speeds up
            lever_m = below_m + moment_nm / (GRAVITY_MPS2 * float(vehicle.inertia[axis]))
            level_n = moment_nm * math.sin(TILT_RAD) / lever_m
            size[i], rate[i] = min(size[i], level_n), min(rate[i], 2.0 * level_n / swing_s)
        fast_mps = fastest_mps(vehicle)
        if fast_mps < vehicle.limits.speed_mps:
            size[0] = min(size[0], (vehicle.drag.linear[0] + vehicle.drag.quadratic[0] * fast_mps) * fast_mps)
    return InputLimits(size, rate)


def depth_limits(vehicle: Vehicle) -> InputLimits:
    """Limits of heave: force (1,) in N, and its rate (1,) in N/s."""
    return InputLimits(np.array([vehicle.limits.wrench[1]]), np.array([vehicle.limits.wrench_rate_per_s[1]]))


def planar_hull(coefficients: Array, sway: float, lag_s: float, longest_s: float) -> Hull:
    """Mass and drag of surge, sway and yaw from the model's `coefficients` (3, 4)."""
    (m_u, m_v, _, m_r), (l_u, l_v, _, l_r), (q_u, q_v, _, q_r) = coefficients.tolist()
    return Hull(m_u, m_v, m_r, l_u, l_v, l_r, q_u, q_v, q_r, sway, lag_s, longest_s)


def depth_hull(coefficients: Array, lag_s: float, longest_s: float) -> Hull:
    """Mass and drag of heave, as motion along x."""
    mass, linear, quadratic = coefficients[:, 2].tolist()
    return Hull(mass, mass, 1.0, linear, linear, 1.0, quadratic, quadratic, 0.0, 0.0, lag_s, longest_s)


def step_s(vehicle: Vehicle) -> float:
    """Longest step of the integration: no longer than the fastest motion takes to decay."""
    mass, limits = vehicle.inertia, vehicle.limits
    slopes = (vehicle.drag_linear + 2.0 * vehicle.drag_quadratic * np.array(
        [limits.speed_mps, limits.speed_mps, limits.heave_mps, limits.yaw_rate_radps]
    )) / mass  # fmt: skip
    return float(min(STEP_S, 1.0 / slopes.max(), 2.0 * FIRST_S))


def formulas(vehicle: Vehicle, period_s: float) -> list[tuple[str, str, str]]:
    """Quantity, formula and value of everything above, for poses with a noise of 1.5 mm: the table of docs/control.md."""
    delay = loop_delay_s(vehicle, period_s, vehicle.thruster.lag_s)
    usual = Deviations(0.001, 0.002, 0.002, 0.002, 0.0, 0.0, np.zeros(3), Ratios(0.0, 0.0, 0.0))
    on_path = derive(vehicle, delay, usual, (4.0, 2.0), 0.0)
    off_path = derive(vehicle, delay, usual, (4.0, 2.0), vehicle.radius_m)
    *pushes, yaw = planar_weights(vehicle, on_path, 0.2, Manner(TURNING_M, FACING_S), 1.0).rate.tolist()
    limits, axes, way = planar_limits(vehicle), planar_axes(vehicle)[:-1], agility(vehicle)
    forces = zip(axes, limits.size.tolist(), limits.rate.tolist(), strict=False)
    reach = f"2 to {100.0 * REACH_SHARE * vehicle.radius_m:.0f} cm"
    return [
        ("delay d", "dead time + period / 2 + 0.3 lag", f"{delay:.3f} s at {1.0 / period_s:.0f} Hz"),
        ("longest step of the integration", "min(0.2 s, 1 / slope of the drag at full speed)", f"{step_s(vehicle):.2f} s"),
        ("horizon", "2 (2 sqrt(pi I / N) + pi / (2 r_max) + m U / F), 6 to 12 s", f"{horizon_s(vehicle):.1f} s"),
        ("reach e", "20 sd_place; the distance off the path if that is more, up to 0.4 R", reach),
        (
            "quickness w1",
            "min((F' / (m e))^(1/3), (0.05 F' / (m sd_ground))^(1/2), 0.4 / d, w_observer / (1 + 2 sd_thrust))",
            f"{on_path.quickness:.1f} rad/s; {off_path.quickness:.1f} off the path",
        ),
        (
            "turning w2", "min((N' / (0.35 rad I))^(1/3), (0.05 N' / (I sd_yaw))^(1/3), 0.6 / d)",
            f"{on_path.turning:.1f} rad/s",
        ),
        ("depth w3", "min((Z' / (0.4 R m_w))^(1/3), 0.4 / d, 0.5 bandwidth_radps)", f"{on_path.depth:.1f} rad/s"),
        ("weight of a force's rate", "(1 / (m w^3))^2", f"{'; '.join(f'{push:.1e}' for push in pushes)} m^2 s^2/N^2"),
        ("weight of the moment's rate", "(arm_m / (I w2^3))^2", f"{yaw:.1e} m^2 s^2/(N m)^2"),
        (
            "end of the horizon", "2 / w of the error 1 / w later; w = w1, at most that for e = 0.4 R",
            f"{on_path.calm_quickness:.1f} rad/s",
        ),
        (
            "way around others", "speed 0.8 U, change 0.3 F / m, return at 0.4 w, at most sqrt(change distance)",
            f"{way.fastest_mps:.2f} m/s, {way.change_mps2:.2f} m/s^2, {way.return_per_s:.2f} per s",
        ),
        (
            "most surge, sway, and their rates", "M sin(0.35 rad) / (depth of the thrusters + M / (g m)), within half a swing",
            "; ".join(f"{NAMES[axis]} {size:.1f} N, {rate:.1f} N/s" for axis, size, rate in forces),
        ),
    ]  # fmt: skip
