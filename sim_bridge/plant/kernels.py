"""Equations of the plant: actuators, battery, water, contact and rigid bodies, for a whole fleet.

The state of a robot is 12 numbers:

    x, y, z, roll, pitch, yaw    place m and attitude rad in the pool frame, R = Rz(yaw) Ry(pitch) Rx(roll)
    u, v, w, p, q, r             velocity over ground m/s, rad/s on the body's axes

Forces are N, moments N m. Each part's constants come as one tuple, which its class in this package puts together: actuators
(actuators.py), battery (battery.py), flow (currents_waves.py), basin (contact.py) and body (rigid_body.py).

Memory: robots are computed LANES at a time in vector registers. So the numbers of robot i are in lane i % LANES of block
i // LANES: number k of the list below is `fleet[block, k x LANES + lane]`. The distances between numbers are constants, which
is how the compiler sees that none overlaps another. `lanes` is LANES as well, but no constant: short loops with a constant
end would be unrolled instead of running in vector registers. Lanes beyond the last robot repeat it. Other shapes: n robots.

`advance` is the one to read first. It integrates by the classical Runge-Kutta method (RK4).
"""

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from shoal.config.vehicle import OUTPUTS
from shoal.frames import Array
from shoal.kernels.decorator import kernel

STATES = 12  # numbers of a state
THRUSTERS, ANKLES = 8, 4  # at most; ACTUATORS say how many there are
LANES = 8  # float64 numbers in a vector register of 512 bits, or in two of 256
POSE, SPEED, TILT = 0, 4 * LANES, 8 * LANES  # eta, nu on level axes, and [roll, pitch and their rates]: 4 each
FORCE, ANKLE = 12 * LANES, 20 * LANES  # N 8 and rad 4, at a step's start
GAIN, CHARGE, LOST_V, FACTOR, WAVE = 24 * LANES, 32 * LANES, 33 * LANES, 34 * LANES, 35 * LANES  # of thrusters 8, else 1
PULSE, CURVE_N, TARGET_RAD, TARGET_N = 36 * LANES, 44 * LANES, 52 * LANES, 56 * LANES  # us 8, N 8, rad 4, N 8
FORCE_THEN, ANKLE_THEN, WRENCH = 64 * LANES, 72 * LANES, 76 * LANES  # within a step: 8, 4 and 6
START, STATE, RATE, SUM = 82 * LANES, 94 * LANES, 106 * LANES, 118 * LANES  # 12 each: SUM of the weighted rates of a step
TURN, MOTION, CONTACT = 130 * LANES, 139 * LANES, 145 * LANES  # attitude 9; the water's motion 6; contact force 3
NUMBERS = 149  # odd: with 128 all blocks would begin 8192 bytes apart, and share a few lines of the processor's cache
X, Y, Z, ROLL, PITCH, YAW = STATE, STATE + LANES, STATE + 2 * LANES, STATE + 3 * LANES, STATE + 4 * LANES, STATE + 5 * LANES
U, V, W = STATE + 6 * LANES, STATE + 7 * LANES, STATE + 8 * LANES
P, Q, R = STATE + 9 * LANES, STATE + 10 * LANES, STATE + 11 * LANES
TILE = 12  # blocks that are moved by a whole step at once where robots do not touch: they stay in the processor's cache
TO_INTEGER = 1.5 * 2.0**52  # added and taken away again it rounds a number to the nearest integer
HALF_PI_HIGH, HALF_PI_LOW = float.fromhex("0x1.921fb544p0"), 6.077100506506192e-11  # their sum is pi / 2 to 1e-26
AT_ONCE_S = 1e-9  # s after its start at which a step is first evaluated: without lag the force jumps at the start itself
DENSITY_KGPM3 = 998.0  # fresh water at 20 degrees
GRAVITY_MPS2 = 9.81
THRUST_EXPONENT = 1.2  # of thrust over voltage (OpenThruster's A2212 data at 10 to 12.6 V)
NEAR_M = 0.1  # m, distance from which contact is computed; no robot moves farther in one step
SPARE_M = 0.2  # m; where hulls are so much farther apart, they are not looked at again before one has moved by a part of it
# Hunt and Crossley (1975): damping that grows with the penetration, so that the force starts from zero and never pulls. At
# this value 0.6 of the speed is left after a bump at 0.1 m/s, 0.2 at 0.5 m/s.
CONTACT_DAMPING_S_PER_M = 10.0
COINCIDENT_M = 1e-9  # m, least distance of two centres, against division by zero

VECTOR, MATRIX, CUBE = "f8[::1]", "f8[:,::1]", "f8[:,:,::1]"
ACTUATORS = f"Tuple(({VECTOR}, {VECTOR}, {VECTOR}, {VECTOR}, {MATRIX}, i8, f8, f8, i8, i8))"
BATTERY = f"Tuple((b1, {VECTOR}, {VECTOR}, f8, f8, f8, f8, f8, f8, f8, f8, i8))"
FLOW = f"Tuple((b1, {VECTOR}, {VECTOR}, f8, {MATRIX}, {MATRIX}, f8, {VECTOR}, f8, f8, f8))"
BASIN = f"Tuple(({VECTOR}, {MATRIX}, f8, f8))"
BODY = f"Tuple((b1, {VECTOR}, f8, {MATRIX}, {VECTOR}, {VECTOR}, f8, f8, f8, b1, {VECTOR}))"
WORK = f"Tuple((i8[::1], {MATRIX}, {CUBE}, {MATRIX}, {MATRIX}, {MATRIX}))"

Constants = tuple[Any, ...]
Indices = NDArray[np.intp]


@kernel("UniTuple(f8, 2)(f8)", inline=True, part=True)
def sine_cosine(angle_rad: float) -> tuple[float, float]:
    """Sine and cosine of an angle up to 1e6 rad, to 2e-16: Taylor's series about the nearest multiple of pi / 2.

    It needs neither branches nor a mathematical library, so loops that call it run in vector registers.
    """
    turns = (angle_rad * (2.0 / math.pi) + TO_INTEGER) - TO_INTEGER
    x = (angle_rad - turns * HALF_PI_HIGH) - turns * HALF_PI_LOW
    x2 = x * x
    s = x2 * (1.0 / 6227020800.0 - x2 * (1.0 / 1307674368000.0))
    s = x2 * (1.0 / 120.0 - x2 * (1.0 / 5040.0 - x2 * (1.0 / 362880.0 - x2 * (1.0 / 39916800.0 - s))))
    s = x - x * (x2 * (1.0 / 6.0 - s))
    c = x2 * (1.0 / 479001600.0 - x2 * (1.0 / 87178291200.0 - x2 * (1.0 / 20922789888000.0)))
    c = x2 * (1.0 / 24.0 - x2 * (1.0 / 720.0 - x2 * (1.0 / 40320.0 - x2 * (1.0 / 3628800.0 - c))))
    c = 1.0 - x2 * (0.5 - c)
    quarter = turns - 4.0 * ((turns * 0.25 + TO_INTEGER) - TO_INTEGER)  # -2 to 2
    is_odd = quarter * quarter == 1.0
    sine = c if is_odd else s
    cosine = s if is_odd else c
    sine = -sine if quarter < 0.0 or quarter > 1.0 else sine
    cosine = -cosine if quarter > 0.0 or quarter < -1.0 else cosine
    return sine, cosine


@kernel(f"void({MATRIX}, i8, i8, i8, i8, {VECTOR}, {VECTOR})", inline=True, part=True)
def interpolate(fleet: Array, block: int, x: int, y: int, count: int, knots: Array, values: Array) -> None:
    """Write the piecewise linear function through (knots, values), constant beyond its ends, of `count` numbers at x to y."""
    last = len(knots) - 1
    for k in range(count):
        fleet[block, y + k] = values[0]
    for segment in range(last):
        knot, value = knots[segment], values[segment]
        slope = (values[segment + 1] - value) / (knots[segment + 1] - knot)
        for k in range(count):
            at, before = fleet[block, x + k], fleet[block, y + k]
            fleet[block, y + k] = value + slope * (at - knot) if at >= knot else before
    knot, value = knots[last], values[last]
    for k in range(count):
        at, before = fleet[block, x + k], fleet[block, y + k]
        fleet[block, y + k] = value if at >= knot else before


def memory(robots: int) -> Array:
    """Memory of a fleet, all zero; no PULSE has come yet."""
    fleet = np.zeros((-(-robots // LANES), NUMBERS * LANES))
    fleet[:, PULSE:CURVE_N] = np.nan
    return fleet


@kernel(f"void({MATRIX}, {MATRIX}, i8)")
def to_fleet(values: Array, fleet: Array, first: int) -> None:
    """Copy `values` (n, m) to the numbers from `first` on."""
    n, m = values.shape
    for b in range(len(fleet)):
        for lane in range(LANES):
            i = min(b * LANES + lane, n - 1)
            for k in range(m):
                fleet[b, first + k * LANES + lane] = values[i, k]


@kernel(f"void({MATRIX}, i8, {MATRIX})")
def from_fleet(fleet: Array, first: int, values: Array) -> None:
    """Copy the numbers from `first` on to `values` (n, m)."""
    n, m = values.shape
    for i in range(n):
        for k in range(m):
            values[i, k] = fleet[i // LANES, first + k * LANES + i % LANES]


# --- batteries


@kernel(f"void({MATRIX}, i8, i8, {BATTERY})", part=True)
def thrust_factor(fleet: Array, first: int, end: int, battery: Constants) -> None:
    """FACTOR, thrust over the static curve's: (voltage / curve's voltage)^1.2, with thrusters at FORCE.

    The voltage falls with the mean load, and by LOST_V besides. An ideal battery falls by LOST_V alone.
    """
    ideal, curve_charge, curve_v, cells, beyond_v, full_v, load_v, max_thrust_n, _, _, _, thrusters = battery
    per_load_v = load_v / (thrusters * max_thrust_n)
    lanes = fleet.shape[1] // NUMBERS
    for b in range(first, end):
        interpolate(fleet, b, CHARGE, FACTOR, lanes, curve_charge, curve_v)
        for lane in range(lanes):
            load_n = abs(fleet[b, FORCE + lane]) + abs(fleet[b, FORCE + LANES + lane])
            load_n += abs(fleet[b, FORCE + 2 * LANES + lane]) + abs(fleet[b, FORCE + 3 * LANES + lane])
            for k in range(4, thrusters):
                load_n += abs(fleet[b, FORCE + k * LANES + lane])
            voltage = full_v if ideal else fleet[b, FACTOR + lane] * cells + beyond_v - per_load_v * load_n
            fleet[b, FACTOR + lane] = max((voltage - fleet[b, LOST_V + lane]) / full_v, 0.0)
        for lane in range(lanes):
            fleet[b, FACTOR + lane] = fleet[b, FACTOR + lane] ** THRUST_EXPONENT


@kernel(f"void({MATRIX}, i8, i8, f8, {BATTERY})", part=True)
def discharge(fleet: Array, first: int, end: int, seconds: float, battery: Constants) -> None:
    """Take from CHARGE the energy of thrusters at FORCE: power ~ |thrust|^1.5 (momentum theory), and the electronics'."""
    ideal, _, _, _, _, _, _, max_thrust_n, thruster_w, electronics_w, capacity_j, thrusters = battery
    if ideal:
        return
    lanes = fleet.shape[1] // NUMBERS
    for b in range(first, end):
        for lane in range(lanes):
            power_w = electronics_w
            for leg in range(thrusters):
                load = abs(fleet[b, FORCE + leg * LANES + lane]) / max_thrust_n
                power_w += thruster_w * load * math.sqrt(load)
            fleet[b, CHARGE + lane] = max(fleet[b, CHARGE + lane] - power_w * seconds / capacity_j, 0.0)


# --- thrusters and ankles


@kernel(f"void({MATRIX}, i8, i8, {CUBE}, {MATRIX}, i8, {ACTUATORS})", part=True)
def actuator_targets(
    fleet: Array, first: int, end: int, history_us: Array, pulses_us: Array, step: int, actuators: Constants
) -> None:
    """TARGET_N and TARGET_RAD, which thrusters and ankles approach during a step, from the pulses of one dead time ago.

    `history_us` (k, n, 8) are the commands of the k steps before step 0, newest first; `pulses_us` (n, 8) hold from step 0
    on. GAIN and FACTOR scale the static curve, which is looked up where a PULSE has changed.
    """
    curve_us, curve_n, ankle_us, ankle_rad, place, legs = actuators[:6]
    thruster_delay, ankle_delay = actuators[8:]
    thruster_us = history_us[thruster_delay - step - 1] if step < thruster_delay else pulses_us
    turned_us = history_us[ankle_delay - step - 1] if step < ankle_delay else pulses_us
    lanes, last, ankles = fleet.shape[1] // NUMBERS, len(pulses_us) - 1, PULSE + legs * LANES
    for b in range(first, end):
        is_new = False
        for lane in range(LANES):
            i = min(b * LANES + lane, last)
            for k in range(OUTPUTS):
                pulse_us = thruster_us[i, k] if k < len(place) else turned_us[i, k]
                is_new = is_new or fleet[b, PULSE + k * LANES + lane] != pulse_us
                fleet[b, PULSE + k * LANES + lane] = pulse_us
        if is_new:
            interpolate(fleet, b, PULSE, CURVE_N, len(place) * lanes, curve_us, curve_n)
            interpolate(fleet, b, ankles, TARGET_RAD, legs * lanes, ankle_us, ankle_rad)
        for leg in range(len(place)):
            for lane in range(lanes):
                k = leg * LANES + lane
                fleet[b, TARGET_N + k] = fleet[b, FACTOR + lane] * fleet[b, GAIN + k] * fleet[b, CURVE_N + k]


@kernel(f"void({MATRIX}, i8, i8, f8, {ACTUATORS})", part=True)
def move_actuators(fleet: Array, first: int, end: int, since_s: float, actuators: Constants) -> None:
    """FORCE_THEN and ANKLE_THEN, `since_s` after they were FORCE and ANKLE: a first-order lag, and a limited rate. Targets are
    constant meanwhile, so both are exact."""
    place, legs, lag_s, rate_radps = actuators[4:8]
    left = math.exp(-since_s / lag_s) if lag_s > 0.0 else 0.0
    reach_rad = rate_radps * since_s
    lanes = fleet.shape[1] // NUMBERS
    for b in range(first, end):
        for k in range(len(place) * lanes):
            target_n = fleet[b, TARGET_N + k]
            fleet[b, FORCE_THEN + k] = target_n + left * (fleet[b, FORCE + k] - target_n)
        for k in range(legs * lanes):
            target_rad = fleet[b, TARGET_RAD + k]
            to_go = target_rad - fleet[b, ANKLE + k]
            fleet[b, ANKLE_THEN + k] = fleet[b, ANKLE + k] + min(max(to_go, -reach_rad), reach_rad)


@kernel(f"void({MATRIX}, i8, i8, {ACTUATORS})", part=True)
def thrusters_wrench(fleet: Array, first: int, end: int, actuators: Constants) -> None:
    """WRENCH of the thrusters at FORCE_THEN and ANKLE_THEN on surge, sway, heave, roll, pitch, yaw: the sum of (F, r x F).

    A leg at r = (ahead, side, below) thrusts with F = force (cos a, 0, sin a); an ankle at +90 degrees thrusts down. A
    thruster that does not turn has its direction in the last three numbers of its place.
    """
    place, legs = actuators[4], actuators[5]
    lanes = fleet.shape[1] // NUMBERS
    for b in range(first, end):
        for k in range(6 * lanes):
            fleet[b, WRENCH + k] = 0.0
        for leg in range(legs):
            ahead_m, side_m, below_m, k = place[leg, 0], place[leg, 1], place[leg, 2], leg * LANES
            for lane in range(lanes):
                sine, cosine = sine_cosine(fleet[b, ANKLE_THEN + k + lane])
                ahead, down = fleet[b, FORCE_THEN + k + lane] * cosine, fleet[b, FORCE_THEN + k + lane] * sine
                fleet[b, WRENCH + lane] += ahead
                fleet[b, WRENCH + 2 * LANES + lane] += down
                fleet[b, WRENCH + 3 * LANES + lane] += side_m * down
                fleet[b, WRENCH + 4 * LANES + lane] += below_m * ahead - ahead_m * down
                fleet[b, WRENCH + 5 * LANES + lane] -= side_m * ahead
        for i in range(legs, len(place)):
            x, y, z, dx, dy, dz = place[i, 0], place[i, 1], place[i, 2], place[i, 3], place[i, 4], place[i, 5]
            for lane in range(lanes):
                force = fleet[b, FORCE_THEN + i * LANES + lane]
                fleet[b, WRENCH + lane] += dx * force
                fleet[b, WRENCH + LANES + lane] += dy * force
                fleet[b, WRENCH + 2 * LANES + lane] += dz * force
                fleet[b, WRENCH + 3 * LANES + lane] += (y * dz - z * dy) * force
                fleet[b, WRENCH + 4 * LANES + lane] += (z * dx - x * dz) * force
                fleet[b, WRENCH + 5 * LANES + lane] += (x * dy - y * dx) * force


# --- water


@kernel(f"void({MATRIX}, f8, {FLOW}, {MATRIX})")
def water_motion(place_m: Array, time_s: float, flow: Constants, motion: Array) -> None:
    """Velocity m/s and acceleration m/s^2 of the water (n, 6) in the pool frame, at places whose rows begin with x, y, z.

    current + shear z + gusts + Airy's wave of amplitude a in water of depth h, with k (x cos + y sin) - omega t = phase:

        along = a omega cosh(k (h - z)) / sinh(k h) cos(phase),    down = -a omega sinh(k (h - z)) / sinh(k h) sin(phase)
    """
    _, current, shear, gust_mps, gust_radps, gust_phase, wave_mps, wave_way, wave_radps, wave_per_m, depth_m = flow
    gust, gust_rate = np.zeros(2), np.zeros(2)
    if gust_mps > 0.0:
        for axis in range(2):
            for j in range(gust_radps.shape[1]):
                angle = gust_radps[axis, j] * time_s + gust_phase[axis, j]
                gust[axis] += gust_mps * math.cos(angle)
                gust_rate[axis] -= gust_mps * gust_radps[axis, j] * math.sin(angle)
    for i in range(len(place_m)):
        x, y, z = place_m[i, 0], place_m[i, 1], place_m[i, 2]
        for axis in range(2):
            motion[i, axis] = current[axis] + shear[axis] * z + gust[axis]
            motion[i, 3 + axis] = gust_rate[axis]
        motion[i, 2] = current[2]
        motion[i, 5] = 0.0
        if wave_mps > 0.0:
            down_m = min(max(z, 0.0), depth_m)
            falling = math.exp(-wave_per_m * down_m)
            rising = math.exp(-wave_per_m * (2.0 * depth_m - down_m))  # the part that the floor reflects
            scale = wave_mps / -math.expm1(-2.0 * wave_per_m * depth_m)
            phase = wave_per_m * (wave_way[0] * x + wave_way[1] * y) - wave_radps * time_s
            along = scale * (falling + rising)
            across = scale * (falling - rising)
            for axis in range(2):
                motion[i, axis] += wave_way[axis] * along * math.cos(phase)
                motion[i, 3 + axis] += wave_way[axis] * along * wave_radps * math.sin(phase)
            motion[i, 2] -= across * math.sin(phase)
            motion[i, 5] += across * wave_radps * math.cos(phase)


@kernel("f8(f8, f8, f8, b1)", inline=True, part=True)
def lift(z_m: float, buoyancy_n: float, radius_m: float, has_surface: bool) -> float:
    """Vertical force on a hull at depth z, down positive: residual buoyancy, and above water the missing displacement of
    the cap of height c = r - z that stands out, rho g pi / 3 c^2 (3 r - c)."""
    cap_m = min(max(radius_m - z_m, 0.0), 2.0 * radius_m) if has_surface else 0.0
    return buoyancy_n + DENSITY_KGPM3 * GRAVITY_MPS2 * math.pi / 3.0 * cap_m * cap_m * (3.0 * radius_m - cap_m)


# --- contact


@kernel(f"void({MATRIX}, i8[::1])", part=True)
def sort_by_x(place_m: Array, order: Indices) -> None:
    """Sort the indices `order` (n,) by (x, index), in place: insertion, as a step changes the order little."""
    for k in range(1, len(order)):
        i = order[k]
        before = k - 1
        while before >= 0:
            j = order[before]
            if place_m[j, 0] < place_m[i, 0] or (place_m[j, 0] == place_m[i, 0] and j < i):
                break
            order[before + 1] = j
            before -= 1
        order[before + 1] = i


@kernel(f"b1({MATRIX}, i8[::1], {BASIN}, f8, {MATRIX})", part=True)
def is_near(place_m: Array, order: Indices, basin: Constants, margin_m: float, sorted_m: Array) -> bool:
    """True if any hull is within `margin_m` of a wall, the floor, an island or another hull. `order`: see `sort_by_x`;
    `sorted_m` (3, n) is for the places in this order."""
    inside_m, islands_m, radius_m, _ = basin
    within_m = 2.0 * radius_m + margin_m
    xs, ys, zs = sorted_m[0], sorted_m[1], sorted_m[2]
    for k in range(len(order)):
        x, y, z = place_m[order[k], 0], place_m[order[k], 1], place_m[order[k], 2]
        xs[k], ys[k], zs[k] = x, y, z
        if max(abs(x) - inside_m[0], abs(y) - inside_m[1], z - inside_m[2]) > -margin_m:
            return True
        for island in range(len(islands_m)):
            distance = math.hypot(x - islands_m[island, 0], y - islands_m[island, 1])
            if distance < islands_m[island, 2] + radius_m + margin_m:
                return True
    begin = 0
    for k in range(len(order)):
        x, y, z, near = xs[k], ys[k], zs[k], 0
        while x - xs[begin] > within_m:
            begin += 1
        for other in range(begin, k):
            dx, dy, dz = xs[other] - x, ys[other] - y, zs[other] - z
            near += dx * dx + dy * dy + dz * dz < within_m * within_m
        if near > 0:
            return True
    return False


@kernel("f8(f8, f8, f8)", part=True)
def normal_force(stiffness_npm: float, penetration_m: float, closing_mps: float) -> float:
    """Force of a contact: k d (1 + c d'), never negative, for a penetration d that grows by d'."""
    return stiffness_npm * max(penetration_m, 0.0) * max(1.0 + CONTACT_DAMPING_S_PER_M * closing_mps, 0.0)


@kernel(f"void({MATRIX}, {MATRIX}, {MATRIX}, i8[::1], {BASIN}, {MATRIX})", part=True)
def contact_force(start_m: Array, place_m: Array, velocity_mps: Array, order: Indices, basin: Constants, force: Array) -> None:
    """Contact forces (n, 3) in the pool frame, without friction, at places and velocities whose rows begin with x, y, z.

    `order` sorts the places `start_m` at the step's start. Pairs that are 2 r + NEAR_M apart in x there are left out.
    """
    inside_m, islands_m, radius_m, stiffness = basin
    for i in range(len(order)):
        for axis in range(3):
            side = -1.0 if place_m[i, axis] < 0.0 and axis < 2 else 1.0
            penetration = side * place_m[i, axis] - inside_m[axis]
            force[i, axis] = -side * normal_force(stiffness, penetration, side * velocity_mps[i, axis])
        for island in range(len(islands_m)):
            dx, dy = place_m[i, 0] - islands_m[island, 0], place_m[i, 1] - islands_m[island, 1]
            distance = max(math.sqrt(dx * dx + dy * dy), COINCIDENT_M)
            away_x, away_y = dx / distance, dy / distance
            closing = -(velocity_mps[i, 0] * away_x + velocity_mps[i, 1] * away_y)
            push = normal_force(stiffness, islands_m[island, 2] + radius_m - distance, closing)
            force[i, 0] += push * away_x
            force[i, 1] += push * away_y
    for k in range(len(order)):
        i = order[k]
        for other in range(k + 1, len(order)):
            j = order[other]
            if start_m[j, 0] - start_m[i, 0] > 2.0 * radius_m + 2.0 * NEAR_M:
                break
            dx, dy, dz = place_m[i, 0] - place_m[j, 0], place_m[i, 1] - place_m[j, 1], place_m[i, 2] - place_m[j, 2]
            distance = max(math.sqrt(dx * dx + dy * dy + dz * dz), COINCIDENT_M)
            if distance >= 2.0 * radius_m:
                continue
            x, y, z = dx / distance, dy / distance, dz / distance
            closing = -(
                (velocity_mps[i, 0] - velocity_mps[j, 0]) * x
                + (velocity_mps[i, 1] - velocity_mps[j, 1]) * y
                + (velocity_mps[i, 2] - velocity_mps[j, 2]) * z
            )
            push = normal_force(stiffness, 2.0 * radius_m - distance, closing)
            force[i, 0] += push * x
            force[i, 1] += push * y
            force[i, 2] += push * z
            force[j, 0] -= push * x
            force[j, 1] -= push * y
            force[j, 2] -= push * z


# --- rigid bodies


@kernel(f"void({MATRIX}, i8, i8)", part=True)
def pack(fleet: Array, first: int, end: int) -> None:
    """STATE, and START with it, of POSE, SPEED and TILT. SPEED is on level axes that turn with the heading."""
    lanes = fleet.shape[1] // NUMBERS
    for b in range(first, end):
        for lane in range(lanes):
            roll, pitch = fleet[b, TILT + lane], fleet[b, TILT + LANES + lane]
            roll_rate, pitch_rate = fleet[b, TILT + 2 * LANES + lane], fleet[b, TILT + 3 * LANES + lane]
            u, v = fleet[b, SPEED + lane], fleet[b, SPEED + LANES + lane]
            w, yaw_rate = fleet[b, SPEED + 2 * LANES + lane], fleet[b, SPEED + 3 * LANES + lane]
            sr, cr = sine_cosine(roll)
            sp, cp = sine_cosine(pitch)
            down = sp * u + cp * w
            fleet[b, X + lane], fleet[b, Y + lane] = fleet[b, POSE + lane], fleet[b, POSE + LANES + lane]
            fleet[b, Z + lane], fleet[b, YAW + lane] = fleet[b, POSE + 2 * LANES + lane], fleet[b, POSE + 3 * LANES + lane]
            fleet[b, ROLL + lane], fleet[b, PITCH + lane] = roll, pitch
            fleet[b, U + lane] = cp * u - sp * w
            fleet[b, V + lane] = cr * v + sr * down
            fleet[b, W + lane] = cr * down - sr * v
            fleet[b, P + lane] = roll_rate - sp * yaw_rate
            fleet[b, Q + lane] = cr * pitch_rate + sr * cp * yaw_rate
            fleet[b, R + lane] = cr * cp * yaw_rate - sr * pitch_rate
        for k in range(STATES * lanes):
            fleet[b, START + k] = fleet[b, STATE + k]
            fleet[b, SUM + k] = 0.0


@kernel(f"void({MATRIX}, i8, i8)", part=True)
def unpack(fleet: Array, first: int, end: int) -> None:
    """POSE, SPEED and TILT of STATE: the inverse of `pack`."""
    lanes = fleet.shape[1] // NUMBERS
    for b in range(first, end):
        for lane in range(lanes):
            roll, pitch = fleet[b, ROLL + lane], fleet[b, PITCH + lane]
            u, v, w = fleet[b, U + lane], fleet[b, V + lane], fleet[b, W + lane]
            p, q, r = fleet[b, P + lane], fleet[b, Q + lane], fleet[b, R + lane]
            sr, cr = sine_cosine(roll)
            sp, cp = sine_cosine(pitch)
            down, turn = sr * v + cr * w, sr * q + cr * r
            fleet[b, POSE + lane], fleet[b, POSE + LANES + lane] = fleet[b, X + lane], fleet[b, Y + lane]
            fleet[b, POSE + 2 * LANES + lane], fleet[b, POSE + 3 * LANES + lane] = fleet[b, Z + lane], fleet[b, YAW + lane]
            fleet[b, SPEED + lane], fleet[b, SPEED + LANES + lane] = cp * u + sp * down, cr * v - sr * w
            fleet[b, SPEED + 2 * LANES + lane], fleet[b, SPEED + 3 * LANES + lane] = cp * down - sp * u, turn / cp
            fleet[b, TILT + lane], fleet[b, TILT + LANES + lane] = roll, pitch
            fleet[b, TILT + 2 * LANES + lane], fleet[b, TILT + 3 * LANES + lane] = p + turn * sp / cp, cr * q - sr * r


@kernel(f"void({MATRIX}, i8, i8)", part=True)
def kinematics(fleet: Array, first: int, end: int) -> None:
    """First six numbers of RATE: velocity in the pool frame, and rates of roll, pitch and yaw. Also TURN, the attitude R, body
    to pool, row by row."""
    lanes = fleet.shape[1] // NUMBERS
    for b in range(first, end):
        for lane in range(lanes):
            sr, cr = sine_cosine(fleet[b, ROLL + lane])
            sp, cp = sine_cosine(fleet[b, PITCH + lane])
            sy, cy = sine_cosine(fleet[b, YAW + lane])
            u, v, w = fleet[b, U + lane], fleet[b, V + lane], fleet[b, W + lane]
            p, q, r = fleet[b, P + lane], fleet[b, Q + lane], fleet[b, R + lane]
            xx, xy, xz = cp * cy, sr * sp * cy - cr * sy, cr * sp * cy + sr * sy
            yx, yy, yz = cp * sy, sr * sp * sy + cr * cy, cr * sp * sy - sr * cy
            zx, zy, zz = -sp, sr * cp, cr * cp
            fleet[b, TURN + lane], fleet[b, TURN + LANES + lane], fleet[b, TURN + 2 * LANES + lane] = xx, xy, xz
            fleet[b, TURN + 3 * LANES + lane], fleet[b, TURN + 4 * LANES + lane], fleet[b, TURN + 5 * LANES + lane] = (
                yx,
                yy,
                yz,
            )
            fleet[b, TURN + 6 * LANES + lane], fleet[b, TURN + 7 * LANES + lane], fleet[b, TURN + 8 * LANES + lane] = (
                zx,
                zy,
                zz,
            )
            fleet[b, RATE + lane] = xx * u + xy * v + xz * w
            fleet[b, RATE + LANES + lane] = yx * u + yy * v + yz * w
            fleet[b, RATE + 2 * LANES + lane] = zx * u + zy * v + zz * w
            yaw_rate = (sr * q + cr * r) / cp
            fleet[b, RATE + 3 * LANES + lane] = p + sp * yaw_rate
            fleet[b, RATE + 4 * LANES + lane] = cr * q - sr * r
            fleet[b, RATE + 5 * LANES + lane] = yaw_rate


@kernel(f"void({MATRIX}, i8, i8, f8, {BODY})", part=True)
def dynamics(fleet: Array, first: int, end: int, time_s: float, body: Constants) -> None:
    """Last six numbers of RATE (Fossen 2021, chapters 6 to 8), nu_r being the velocity relative to the water:

        nu_r = nu - [R^T water, 0],    nu' = M^-1 (wrench + R^T (lift + contact) + righting - D(nu_r) nu_r - C(nu_r) nu_r)
               + R^T water' - [omega x R^T water, 0]

    C nu_r = [omega x P, omega x L + v x P] with the impulses [P, L] = M nu_r (Kirchhoff). M couples surge with pitch and
    sway with roll by the first moment h = m z_g. An axis whose row of M^-1 is zero does not move: so a level body has no
    roll and pitch. On a round hull the horizontal quadratic drag points against the flow and takes the horizontal speed
    instead of |u| and |v|. Without `sway` it is the article's plant: v = 0, each axis by itself.

    The water's MOTION and CONTACT are in the pool frame, the legs' WRENCH on the body's axes.
    """
    sway, mass, h, inverse, linear, quadratic, righting_nm, buoyancy_n, radius_m, surface, wave_wrench = body
    mass_u, mass_v, mass_w, mass_p, mass_q, mass_r = mass[0], mass[1], mass[2], mass[3], mass[4], mass[5]
    linear_u, linear_v, linear_w, linear_p, linear_q, linear_r = (
        linear[0],
        linear[1],
        linear[2],
        linear[3],
        linear[4],
        linear[5],
    )
    drag_u, drag_v, drag_w = quadratic[0], quadratic[1], quadratic[2]
    drag_p, drag_q, drag_r = quadratic[3], quadratic[4], quadratic[5]
    wave_u, wave_w, wave_r = wave_wrench[0], wave_wrench[1], wave_wrench[2]
    uu, uq, qu, qq, vv, vp = inverse[0, 0], inverse[0, 4], inverse[4, 0], inverse[4, 4], inverse[1, 1], inverse[1, 3]
    pv, pp, ww, rr = inverse[3, 1], inverse[3, 3], inverse[2, 2], inverse[5, 5]
    lanes = fleet.shape[1] // NUMBERS
    for b in range(first, end):
        for lane in range(lanes):
            water_x, water_y, water_z = (
                fleet[b, MOTION + lane],
                fleet[b, MOTION + LANES + lane],
                fleet[b, MOTION + 2 * LANES + lane],
            )
            rate_x, rate_y, rate_z = (
                fleet[b, MOTION + 3 * LANES + lane],
                fleet[b, MOTION + 4 * LANES + lane],
                fleet[b, MOTION + 5 * LANES + lane],
            )
            push_x, push_y, push_z = (
                fleet[b, CONTACT + lane],
                fleet[b, CONTACT + LANES + lane],
                fleet[b, CONTACT + 2 * LANES + lane],
            )
            push_z += lift(fleet[b, Z + lane], buoyancy_n, radius_m, surface)
            xx, xy, xz = fleet[b, TURN + lane], fleet[b, TURN + LANES + lane], fleet[b, TURN + 2 * LANES + lane]
            yx, yy, yz = (
                fleet[b, TURN + 3 * LANES + lane],
                fleet[b, TURN + 4 * LANES + lane],
                fleet[b, TURN + 5 * LANES + lane],
            )
            zx, zy, zz = (
                fleet[b, TURN + 6 * LANES + lane],
                fleet[b, TURN + 7 * LANES + lane],
                fleet[b, TURN + 8 * LANES + lane],
            )
            a = xx * water_x + yx * water_y + zx * water_z  # the water's velocity on the body's axes
            c = xy * water_x + yy * water_y + zy * water_z
            d = xz * water_x + yz * water_y + zz * water_z
            u, v, w = fleet[b, U + lane] - a, fleet[b, V + lane] - c, fleet[b, W + lane] - d
            p, q, r = fleet[b, P + lane], fleet[b, Q + lane], fleet[b, R + lane]

            horizontal = math.sqrt(u * u + v * v)
            speed_u = horizontal if sway else abs(u)
            speed_v = horizontal if sway else abs(v)
            wave, _ = sine_cosine(fleet[b, WAVE + lane] * time_s)
            surge = fleet[b, WRENCH + lane] - (linear_u + drag_u * speed_u) * u + wave * wave_u
            sideways = fleet[b, WRENCH + LANES + lane] - (linear_v + drag_v * speed_v) * v
            heave = fleet[b, WRENCH + 2 * LANES + lane] - (linear_w + drag_w * abs(w)) * w + wave * wave_w
            roll = fleet[b, WRENCH + 3 * LANES + lane] - (linear_p + drag_p * abs(p)) * p - righting_nm * zy
            pitch = fleet[b, WRENCH + 4 * LANES + lane] - (linear_q + drag_q * abs(q)) * q + righting_nm * zx
            yaw = fleet[b, WRENCH + 5 * LANES + lane] - (linear_r + drag_r * abs(r)) * r + wave * wave_r
            surge += xx * push_x + yx * push_y + zx * push_z
            sideways += xy * push_x + yy * push_y + zy * push_z
            heave += xz * push_x + yz * push_y + zz * push_z
            if sway:
                impulse_u, impulse_v, impulse_w = mass_u * u + h * q, mass_v * v - h * p, mass_w * w
                spin_p, spin_q, spin_r = mass_p * p - h * v, mass_q * q + h * u, mass_r * r
                surge -= q * impulse_w - r * impulse_v
                sideways -= r * impulse_u - p * impulse_w
                heave -= p * impulse_v - q * impulse_u
                roll -= q * spin_r - r * spin_q + v * impulse_w - w * impulse_v
                pitch -= r * spin_p - p * spin_r + w * impulse_u - u * impulse_w
                yaw -= p * spin_q - q * spin_p + u * impulse_v - v * impulse_u
            else:
                a, c, d = 0.0, 0.0, 0.0  # no axis couples with another

            fleet[b, RATE + 6 * LANES + lane] = (
                uu * surge + uq * pitch + xx * rate_x + yx * rate_y + zx * rate_z + c * r - d * q
            )
            across = vv * sideways + vp * roll + xy * rate_x + yy * rate_y + zy * rate_z + d * p - a * r
            fleet[b, RATE + 7 * LANES + lane] = across if sway else 0.0
            fleet[b, RATE + 8 * LANES + lane] = ww * heave + xz * rate_x + yz * rate_y + zz * rate_z + a * q - c * p
            fleet[b, RATE + 9 * LANES + lane] = pv * sideways + pp * roll
            fleet[b, RATE + 10 * LANES + lane] = qu * surge + qq * pitch
            fleet[b, RATE + 11 * LANES + lane] = rr * yaw


@kernel(f"void({MATRIX}, i8, i8, f8, b1, {FLOW}, {BASIN}, {BODY}, {WORK})", part=True)
def state_rate(
    fleet: Array,
    first: int,
    end: int,
    time_s: float,
    touches: bool,
    flow: Constants,
    basin: Constants,
    body: Constants,
    work: Constants,
) -> None:
    """RATE, d/dt of STATE, with the legs' WRENCH. MOTION and CONTACT, zero before, are computed for the whole fleet where
    water moves and where the fleet `touches` anything. `work` holds the order and the places of the step's start."""
    order, _, places, water, _, _ = work
    kinematics(fleet, first, end)
    if not flow[0]:
        from_fleet(fleet, X, places[1])
        water_motion(places[1], time_s, flow, water)
        to_fleet(water, fleet, MOTION)
    if touches:
        from_fleet(fleet, X, places[1])
        from_fleet(fleet, RATE, places[2])
        contact_force(places[0], places[1], places[2], order, basin, places[3])
        to_fleet(places[3], fleet, CONTACT)
    dynamics(fleet, first, end, time_s, body)


@kernel(f"b1({MATRIX}, {BASIN}, {WORK})", part=True)
def begins_near(fleet: Array, basin: Constants, work: Constants) -> bool:
    """Tell whether contact has to be computed in this step; else CONTACT is zero. If so, the places at the step's start are
    sorted.

    `calm_m` are the places, (blocks, 3 LANES), at which all were last seen farther apart than NEAR_M + SPARE_M. While each is
    within SPARE_M / 4 of its own on every axis, none is within NEAR_M of anything.
    """
    order, _, places, _, sorted_m, calm_m = work
    lanes, moved = fleet.shape[1] // NUMBERS, 0
    for b in range(len(fleet)):
        for k in range(3 * lanes):
            moved += 0 if abs(fleet[b, POSE + k] - calm_m[b, k]) < SPARE_M / 4.0 else 1  # NaN: never seen
    touches = False
    if moved > 0:
        from_fleet(fleet, POSE, places[0])
        sort_by_x(places[0], order)
        touches = is_near(places[0], order, basin, NEAR_M, sorted_m)
        if not touches and not is_near(places[0], order, basin, NEAR_M + SPARE_M, sorted_m):
            calm_m[:] = fleet[:, POSE : POSE + 3 * LANES]
    if not touches:
        fleet[:, CONTACT : CONTACT + 3 * LANES] = 0.0
    return touches


# --- the fleet


@kernel(f"void({MATRIX}, i8, i8, f8, f8)", part=True)
def add_stage(fleet: Array, first: int, end: int, weight: float, by_s: float) -> None:
    """Add a stage's weighted RATE to SUM. STATE becomes what it would be `by_s` after START at this RATE."""
    lanes = fleet.shape[1] // NUMBERS
    for b in range(first, end):
        for k in range(STATES * lanes):
            fleet[b, SUM + k] += weight * fleet[b, RATE + k]
            fleet[b, STATE + k] = fleet[b, START + k] + by_s * fleet[b, RATE + k]


@kernel(f"void({MATRIX}, i8, i8, f8)", part=True)
def add_step(fleet: Array, first: int, end: int, step_s: float) -> None:
    """STATE at a step's end, START + step / 6 SUM. The legs' forces and angles are those of this instant."""
    lanes = fleet.shape[1] // NUMBERS
    for b in range(first, end):
        for k in range(STATES * lanes):
            fleet[b, STATE + k] = fleet[b, START + k] + step_s / 6.0 * fleet[b, SUM + k]
        for k in range((THRUSTERS + ANKLES) * lanes):
            fleet[b, FORCE + k] = fleet[b, FORCE_THEN + k]


@kernel(
    f"void({MATRIX}, {MATRIX}, {MATRIX}, {MATRIX}, {MATRIX}, {MATRIX}, {CUBE}, {MATRIX}, {MATRIX}, {MATRIX}, i8, i8, f8, "
    f"{ACTUATORS}, {BATTERY}, {FLOW}, {BASIN}, {BODY}, {WORK})"
)
def advance(
    eta: Array,
    nu: Array,
    tilt: Array,
    force_n: Array,
    ankle_rad: Array,
    charge: Array,
    history_us: Array,
    pulses_us: Array,
    gain: Array,
    sag_v: Array,
    first_step: int,
    steps: int,
    step_s: float,
    actuators: Constants,
    battery: Constants,
    flow: Constants,
    basin: Constants,
    body: Constants,
    work: Constants,
) -> None:
    """Move a fleet on by `steps` steps from step `first_step` of the plant's time, with constant pulses (n, 8) on the outputs.

    In place: poses, level velocities and tilts (n, 4), thrusters' forces (n, 4 or 8), ankles' angles (n, 4), charges (n, 1).
    `history_us` (k, n, 8) as in `actuator_targets`, `gain` of the thrusters and `sag_v` (n, 1) of the batteries.
    """
    fleet, half_s = work[1], step_s / 2.0
    to_fleet(eta, fleet, POSE)
    to_fleet(nu, fleet, SPEED)
    to_fleet(tilt, fleet, TILT)
    to_fleet(force_n, fleet, FORCE)
    to_fleet(ankle_rad, fleet, ANKLE)
    to_fleet(charge, fleet, CHARGE)
    to_fleet(gain, fleet, GAIN)
    to_fleet(sag_v, fleet, LOST_V)
    for step in range(steps):
        time_s = (first_step + step) * step_s
        touches = begins_near(fleet, basin, work)
        tile = len(fleet) if touches or not flow[0] else TILE
        for first in range(0, len(fleet), tile):
            end = min(first + tile, len(fleet))
            pack(fleet, first, end)
            thrust_factor(fleet, first, end, battery)
            actuator_targets(fleet, first, end, history_us, pulses_us, step, actuators)
            move_actuators(fleet, first, end, AT_ONCE_S, actuators)
            thrusters_wrench(fleet, first, end, actuators)
            state_rate(fleet, first, end, time_s, touches, flow, basin, body, work)
            add_stage(fleet, first, end, 1.0, half_s)
            move_actuators(fleet, first, end, half_s, actuators)
            thrusters_wrench(fleet, first, end, actuators)
            state_rate(fleet, first, end, time_s + half_s, touches, flow, basin, body, work)
            add_stage(fleet, first, end, 2.0, half_s)
            state_rate(fleet, first, end, time_s + half_s, touches, flow, basin, body, work)
            add_stage(fleet, first, end, 2.0, step_s)
            move_actuators(fleet, first, end, step_s, actuators)
            thrusters_wrench(fleet, first, end, actuators)
            state_rate(fleet, first, end, time_s + step_s, touches, flow, basin, body, work)
            add_stage(fleet, first, end, 1.0, 0.0)
            add_step(fleet, first, end, step_s)
            unpack(fleet, first, end)
            discharge(fleet, first, end, step_s, battery)
    from_fleet(fleet, POSE, eta)
    from_fleet(fleet, SPEED, nu)
    from_fleet(fleet, TILT, tilt)
    from_fleet(fleet, FORCE, force_n)
    from_fleet(fleet, ANKLE, ankle_rad)
    from_fleet(fleet, CHARGE, charge)


@kernel(f"void({MATRIX}, {MATRIX}, {MATRIX}, f8, {MATRIX}, {MATRIX}, {ACTUATORS}, {FLOW}, {BASIN}, {BODY}, {WORK}, {MATRIX})")
def fleet_acceleration(
    eta: Array,
    nu: Array,
    tilt: Array,
    time_s: float,
    force_n: Array,
    ankle_rad: Array,
    actuators: Constants,
    flow: Constants,
    basin: Constants,
    body: Constants,
    work: Constants,
    acceleration: Array,
) -> None:
    """d/dt (n, 4) of the level velocities nu of a fleet with forces of its thrusters and angles (n, 4) of its legs.

    With Q = Ry Rx and v the body's velocity: d/dt (Q v) = Q (v' + omega x v) - yaw' z x Q v. The fourth is yaw''.
    """
    fleet, end = work[1], len(work[1])
    to_fleet(eta, fleet, POSE)
    to_fleet(nu, fleet, SPEED)
    to_fleet(tilt, fleet, TILT)
    to_fleet(force_n, fleet, FORCE_THEN)
    to_fleet(ankle_rad, fleet, ANKLE_THEN)
    pack(fleet, 0, end)
    thrusters_wrench(fleet, 0, end, actuators)
    state_rate(fleet, 0, end, time_s, begins_near(fleet, basin, work), flow, basin, body, work)
    for b in range(end):
        for lane in range(LANES):
            sr, cr = sine_cosine(fleet[b, ROLL + lane])
            sp, cp = sine_cosine(fleet[b, PITCH + lane])
            u, v, w = fleet[b, U + lane], fleet[b, V + lane], fleet[b, W + lane]
            p, q, r = fleet[b, P + lane], fleet[b, Q + lane], fleet[b, R + lane]
            ahead = fleet[b, RATE + 6 * LANES + lane] + q * w - r * v
            side = fleet[b, RATE + 7 * LANES + lane] + r * u - p * w
            below = fleet[b, RATE + 8 * LANES + lane] + p * v - q * u
            roll_rate, pitch_rate = fleet[b, RATE + 3 * LANES + lane], fleet[b, RATE + 4 * LANES + lane]
            yaw_rate = fleet[b, RATE + 5 * LANES + lane]
            down, down_rate = sr * v + cr * w, sr * side + cr * below
            turning = (
                sr * fleet[b, RATE + 10 * LANES + lane] + cr * fleet[b, RATE + 11 * LANES + lane] + pitch_rate * roll_rate
            )
            fleet[b, SPEED + lane] = cp * ahead + sp * down_rate + yaw_rate * (cr * v - sr * w)
            fleet[b, SPEED + LANES + lane] = cr * side - sr * below - yaw_rate * (cp * u + sp * down)
            fleet[b, SPEED + 2 * LANES + lane] = cp * down_rate - sp * ahead
            fleet[b, SPEED + 3 * LANES + lane] = (turning + yaw_rate * sp * pitch_rate) / cp
    from_fleet(fleet, SPEED, acceleration)


@kernel(f"void({MATRIX}, {MATRIX}, f8[::1], f8[::1], f8[::1], b1, {MATRIX})")
def nominal_acceleration(
    nu: Array, wrench: Array, inertia: Array, linear: Array, quadratic: Array, sway: bool, acceleration: Array
) -> None:
    """d/dt (n, 4) of the velocities nu by the vehicle file's numbers, diagonals (4,), in still water: each axis has its own
    drag, and of Coriolis terms m_v v r on surge and -m_u u r on sway. `wrench` (n, 3) is surge, heave, yaw; (n, 4) with sway.
    """
    for i in range(len(nu)):
        for axis in range(4):
            v = nu[i, axis]
            acceleration[i, axis] = -(linear[axis] + quadratic[axis] * abs(v)) * v
        acceleration[i, 0] += wrench[i, 0]
        acceleration[i, 2] += wrench[i, 1]
        acceleration[i, 3] += wrench[i, 2]
        if sway:
            acceleration[i, 0] += inertia[1] * nu[i, 1] * nu[i, 3]
            acceleration[i, 1] -= inertia[0] * nu[i, 0] * nu[i, 3]
            if wrench.shape[1] > 3:
                acceleration[i, 1] += wrench[i, 3]
        else:
            acceleration[i, 1] = 0.0
        for axis in range(4):
            acceleration[i, axis] /= inertia[axis]
