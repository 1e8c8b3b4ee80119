"""Equations of the plant: actuators, battery, water, contact and rigid bodies, for a whole fleet.

Shapes: n robots; an index i is a robot. A fleet's state is a row of STATE numbers per robot:

    x, y, z, roll, pitch, yaw    place m and attitude rad in the pool frame, R = Rz(yaw) Ry(pitch) Rx(roll)
    u, v, w, p, q, r             velocity over ground m/s, rad/s on the body's axes

Forces are N, moments N m. Each part's constants come as one tuple, which its class in this package puts together: actuators
(actuators.py), battery (battery.py), flow (currents_waves.py), basin (contact.py) and body (rigid_body.py).

`advance` is the one to read first. It integrates by the classical Runge-Kutta method (RK4).
"""

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from wire.frames import Array
from wire.kernels import kernel

STATE = 12
THRUSTERS = 4
AT_ONCE_S = 1e-9  # s after its start at which a step is first evaluated: without lag the force jumps at the start itself
DENSITY_KGPM3 = 998.0  # fresh water at 20 degrees
GRAVITY_MPS2 = 9.81
THRUST_EXPONENT = 1.2  # of thrust over voltage (OpenThruster's A2212 data at 10 to 12.6 V)
NEAR_M = 0.1  # m, distance from which contact is computed; no robot moves farther in one step
# Hunt and Crossley (1975): damping that grows with the penetration, so that the force starts from zero and never pulls. At
# this value 0.6 of the speed is left after a bump at 0.1 m/s, 0.2 at 0.5 m/s.
CONTACT_DAMPING_S_PER_M = 10.0
COINCIDENT_M = 1e-9  # m, least distance of two centres, against division by zero

VECTOR, MATRIX, CUBE = "f8[::1]", "f8[:,::1]", "f8[:,:,::1]"
ACTUATORS = f"Tuple(({VECTOR}, {VECTOR}, {VECTOR}, {VECTOR}, {MATRIX}, f8, f8, f8, i8, i8))"
BATTERY = f"Tuple((b1, {VECTOR}, {VECTOR}, f8, f8, f8, f8, f8, f8, f8, f8, f8))"
FLOW = f"Tuple((b1, {VECTOR}, {VECTOR}, f8, {MATRIX}, {MATRIX}, f8, {VECTOR}, f8, f8, f8))"
BASIN = f"Tuple(({VECTOR}, {MATRIX}, f8, f8))"
BODY = f"Tuple((b1, {VECTOR}, f8, {MATRIX}, {VECTOR}, {VECTOR}, f8, f8, f8, b1, {VECTOR}, {VECTOR}))"
WORK = f"Tuple((i8[::1], {', '.join([MATRIX] * 6)}, {CUBE}, {CUBE}, {', '.join([MATRIX] * 6)}, {VECTOR}))"

Constants = tuple[Any, ...]
Indices = NDArray[np.intp]


@kernel(f"f8(f8, {VECTOR}, {VECTOR})")
def interpolate(x: float, knots: Array, values: Array) -> float:
    """Piecewise linear function through (knots, values), constant beyond its ends; knots rise."""
    last = len(knots) - 1
    if x <= knots[0]:
        return float(values[0])
    if x >= knots[last]:
        return float(values[last])
    k = 0
    while knots[k + 1] <= x:
        k += 1
    slope = (values[k + 1] - values[k]) / (knots[k + 1] - knots[k])
    return float(values[k] + slope * (x - knots[k]))


# --- batteries


@kernel(f"void({VECTOR}, {BATTERY}, {VECTOR})")
def rest_voltage(charge: Array, battery: Constants, voltage: Array) -> None:
    """Voltage (n,) V of batteries with a charge (n,), 0 to 1, without load."""
    ideal, curve_charge, curve_v, cells, beyond_v, start_v = battery[:6]
    for i in range(len(charge)):
        voltage[i] = start_v if ideal else interpolate(charge[i], curve_charge, curve_v) * cells + beyond_v


@kernel(f"void({VECTOR}, {MATRIX}, {VECTOR}, {BATTERY}, {VECTOR})")
def thrust_factor(charge: Array, force_n: Array, sag_v: Array, battery: Constants, factor: Array) -> None:
    """Thrust (n,) over the static curve's: (voltage / curve's voltage)^1.2, with thrusters at forces (n, 4).

    The voltage falls with the mean load, and by `sag_v` (n,) besides. An ideal battery falls by `sag_v` alone.
    """
    ideal, _, _, _, _, _, full_v, load_v, max_thrust_n, _, _, _ = battery
    rest_voltage(charge, battery, factor)
    for i in range(len(charge)):
        if ideal:
            ratio = 1.0 - sag_v[i] / full_v
        else:
            load = 0.0
            for leg in range(THRUSTERS):
                load += abs(force_n[i, leg])
            load /= THRUSTERS * max_thrust_n
            ratio = (factor[i] - load_v * load - sag_v[i]) / full_v
        factor[i] = max(ratio, 0.0) ** THRUST_EXPONENT


@kernel(f"void({VECTOR}, {MATRIX}, f8, {BATTERY})")
def discharge(charge: Array, force_n: Array, seconds: float, battery: Constants) -> None:
    """Take from the charge (n,), in place, the energy of thrusters at forces (n, 4): power ~ |thrust|^1.5 (momentum
    theory), and the electronics'."""
    ideal, _, _, _, _, _, _, _, max_thrust_n, thruster_w, electronics_w, capacity_j = battery
    if ideal:
        return
    for i in range(len(charge)):
        power_w = electronics_w
        for leg in range(THRUSTERS):
            load = abs(force_n[i, leg]) / max_thrust_n
            power_w += thruster_w * load * math.sqrt(load)
        charge[i] = max(charge[i] - power_w * seconds / capacity_j, 0.0)


# --- thrusters and ankles


@kernel(f"void({CUBE}, {MATRIX}, i8, {MATRIX}, {VECTOR}, {ACTUATORS}, {MATRIX}, {MATRIX})")
def actuator_targets(
    history_us: Array,
    pulses_us: Array,
    step: int,
    gain: Array,
    factor: Array,
    actuators: Constants,
    target_n: Array,
    target_rad: Array,
) -> None:
    """Forces and angles (n, 4) that thrusters and ankles approach during a step, from the pulses of one dead time ago.

    `history_us` (k, n, 8) are the commands of the k steps before step 0, newest first; `pulses_us` (n, 8) hold from step 0
    on. `gain` (n, 4) and `factor` (n,) scale the static curve.
    """
    curve_us, curve_n, ankle_us, ankle_rad = actuators[:4]
    thruster_delay, ankle_delay = actuators[8:]
    for i in range(len(pulses_us)):
        for leg in range(THRUSTERS):
            ankle = THRUSTERS + leg
            thruster_us, turned_us = pulses_us[i, leg], pulses_us[i, ankle]
            if step < thruster_delay:
                thruster_us = history_us[thruster_delay - step - 1, i, leg]
            if step < ankle_delay:
                turned_us = history_us[ankle_delay - step - 1, i, ankle]
            target_n[i, leg] = factor[i] * gain[i, leg] * interpolate(thruster_us, curve_us, curve_n)
            target_rad[i, leg] = interpolate(turned_us, ankle_us, ankle_rad)


@kernel(f"void({MATRIX}, {MATRIX}, {MATRIX}, {MATRIX}, f8, {ACTUATORS}, {MATRIX}, {MATRIX})")
def move_actuators(
    force_n: Array,
    ankle_rad: Array,
    target_n: Array,
    target_rad: Array,
    since_s: float,
    actuators: Constants,
    force_after: Array,
    ankle_after: Array,
) -> None:
    """Forces and angles (n, 4) `since_s` after they were `force_n` and `ankle_rad`: a first-order lag, and a limited rate.
    Targets are constant meanwhile, so both are exact."""
    _, _, _, _, _, _, lag_s, rate_radps, _, _ = actuators
    left = math.exp(-since_s / lag_s) if lag_s > 0.0 else 0.0
    reach_rad = rate_radps * since_s
    for i in range(len(force_n)):
        for leg in range(THRUSTERS):
            force_after[i, leg] = target_n[i, leg] + left * (force_n[i, leg] - target_n[i, leg])
            to_go = target_rad[i, leg] - ankle_rad[i, leg]
            ankle_after[i, leg] = ankle_rad[i, leg] + min(max(to_go, -reach_rad), reach_rad)


@kernel(f"void({MATRIX}, {MATRIX}, {ACTUATORS}, {MATRIX})")
def legs_wrench(force_n: Array, ankle_rad: Array, actuators: Constants, wrench: Array) -> None:
    """Forces and moments (n, 6) of the legs on surge, sway, heave, roll, pitch, yaw: the sum of (F, r x F).

    A leg at r = (ahead, side, below) thrusts with F = force (cos a, 0, sin a); an ankle at +90 degrees thrusts down.
    """
    position_m, below_m = actuators[4], actuators[5]
    for i in range(len(force_n)):
        surge, heave, roll, pitch, yaw = 0.0, 0.0, 0.0, 0.0, 0.0
        for leg in range(THRUSTERS):
            ahead = force_n[i, leg] * math.cos(ankle_rad[i, leg])
            down = force_n[i, leg] * math.sin(ankle_rad[i, leg])
            ahead_m, side_m = position_m[leg, 0], position_m[leg, 1]
            surge += ahead
            heave += down
            roll += side_m * down
            pitch += below_m * ahead - ahead_m * down
            yaw -= side_m * ahead
        wrench[i, 0], wrench[i, 1], wrench[i, 2] = surge, 0.0, heave
        wrench[i, 3], wrench[i, 4], wrench[i, 5] = roll, pitch, yaw


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


@kernel("f8(f8, f8, f8, b1)")
def lift(z_m: float, buoyancy_n: float, radius_m: float, has_surface: bool) -> float:
    """Vertical force on a hull at depth z, down positive: residual buoyancy, and above water the missing displacement of
    the cap of height c = r - z that stands out, rho g pi / 3 c^2 (3 r - c)."""
    if not has_surface or z_m >= radius_m:
        return buoyancy_n
    cap_m = min(radius_m - z_m, 2.0 * radius_m)
    return buoyancy_n + DENSITY_KGPM3 * GRAVITY_MPS2 * math.pi / 3.0 * cap_m * cap_m * (3.0 * radius_m - cap_m)


# --- contact


@kernel(f"void({MATRIX}, i8[::1])")
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


@kernel(f"b1({MATRIX}, i8[::1], {BASIN})")
def is_near(place_m: Array, order: Indices, basin: Constants) -> bool:
    """True if any hull is within NEAR_M of a wall, the floor, an island or another hull. `order`: see `sort_by_x`."""
    inside_m, islands_m, radius_m, _ = basin
    within_m = 2.0 * radius_m + NEAR_M
    for k in range(len(order)):
        i = order[k]
        x, y, z = place_m[i, 0], place_m[i, 1], place_m[i, 2]
        if max(abs(x) - inside_m[0], abs(y) - inside_m[1], z - inside_m[2]) > -NEAR_M:
            return True
        for island in range(len(islands_m)):
            distance = math.hypot(x - islands_m[island, 0], y - islands_m[island, 1])
            if distance < islands_m[island, 2] + radius_m + NEAR_M:
                return True
        for other in range(k + 1, len(order)):
            j = order[other]
            dx, dy, dz = place_m[j, 0] - x, place_m[j, 1] - y, place_m[j, 2] - z
            if dx > within_m:
                break
            if dx * dx + dy * dy + dz * dz < within_m * within_m:
                return True
    return False


@kernel("f8(f8, f8, f8)")
def normal_force(stiffness_npm: float, penetration_m: float, closing_mps: float) -> float:
    """Force of a contact: k d (1 + c d'), never negative, for a penetration d that grows by d'."""
    return stiffness_npm * max(penetration_m, 0.0) * max(1.0 + CONTACT_DAMPING_S_PER_M * closing_mps, 0.0)


@kernel(f"void({MATRIX}, {MATRIX}, {MATRIX}, i8[::1], {BASIN}, {MATRIX})")
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


@kernel(f"void({MATRIX}, {MATRIX}, {MATRIX}, {MATRIX})")
def pack(eta: Array, nu: Array, tilt: Array, state: Array) -> None:
    """State (n, 12) of poses eta, velocities nu on level axes that turn with the heading, and tilts [roll, pitch and their
    rates], (n, 4) each."""
    for i in range(len(eta)):
        roll, pitch, roll_rate, pitch_rate = tilt[i, 0], tilt[i, 1], tilt[i, 2], tilt[i, 3]
        cr, sr, cp, sp = math.cos(roll), math.sin(roll), math.cos(pitch), math.sin(pitch)
        u, v, w, yaw_rate = nu[i, 0], nu[i, 1], nu[i, 2], nu[i, 3]
        down = sp * u + cp * w
        state[i, 0], state[i, 1], state[i, 2] = eta[i, 0], eta[i, 1], eta[i, 2]
        state[i, 3], state[i, 4], state[i, 5] = roll, pitch, eta[i, 3]
        state[i, 6] = cp * u - sp * w
        state[i, 7] = cr * v + sr * down
        state[i, 8] = cr * down - sr * v
        state[i, 9] = roll_rate - sp * yaw_rate
        state[i, 10] = cr * pitch_rate + sr * cp * yaw_rate
        state[i, 11] = cr * cp * yaw_rate - sr * pitch_rate


@kernel(f"void({MATRIX}, {MATRIX}, {MATRIX}, {MATRIX})")
def unpack(state: Array, eta: Array, nu: Array, tilt: Array) -> None:
    """Poses, level velocities and tilts (n, 4) of a state (n, 12): the inverse of `pack`."""
    for i in range(len(eta)):
        roll, pitch = state[i, 3], state[i, 4]
        cr, sr, cp, sp = math.cos(roll), math.sin(roll), math.cos(pitch), math.sin(pitch)
        u, v, w, p, q, r = state[i, 6], state[i, 7], state[i, 8], state[i, 9], state[i, 10], state[i, 11]
        down, turn = sr * v + cr * w, sr * q + cr * r
        eta[i, 0], eta[i, 1], eta[i, 2], eta[i, 3] = state[i, 0], state[i, 1], state[i, 2], state[i, 5]
        nu[i, 0], nu[i, 1], nu[i, 2], nu[i, 3] = cp * u + sp * down, cr * v - sr * w, cp * down - sp * u, turn / cp
        tilt[i, 0], tilt[i, 1], tilt[i, 2], tilt[i, 3] = roll, pitch, p + turn * sp / cp, cr * q - sr * r


@kernel(f"void({MATRIX}, {MATRIX}, {CUBE})")
def kinematics(state: Array, rate: Array, turn: Array) -> None:
    """First six columns of d/dt state: velocity in the pool frame, and rates of roll, pitch and yaw. Also the attitudes R
    (n, 3, 3), body to pool."""
    for i in range(len(state)):
        roll, pitch, yaw = state[i, 3], state[i, 4], state[i, 5]
        cr, sr, cp, sp = math.cos(roll), math.sin(roll), math.cos(pitch), math.sin(pitch)
        cy, sy = math.cos(yaw), math.sin(yaw)
        p, q, r = state[i, 9], state[i, 10], state[i, 11]
        turn[i, 0, 0], turn[i, 0, 1], turn[i, 0, 2] = cp * cy, sr * sp * cy - cr * sy, cr * sp * cy + sr * sy
        turn[i, 1, 0], turn[i, 1, 1], turn[i, 1, 2] = cp * sy, sr * sp * sy + cr * cy, cr * sp * sy - sr * cy
        turn[i, 2, 0], turn[i, 2, 1], turn[i, 2, 2] = -sp, sr * cp, cr * cp
        for axis in range(3):
            rate[i, axis] = turn[i, axis, 0] * state[i, 6] + turn[i, axis, 1] * state[i, 7] + turn[i, axis, 2] * state[i, 8]
        yaw_rate = (sr * q + cr * r) / cp
        rate[i, 3] = p + sp * yaw_rate
        rate[i, 4] = cr * q - sr * r
        rate[i, 5] = yaw_rate


@kernel(f"void({MATRIX}, {CUBE}, f8, {MATRIX}, {MATRIX}, {MATRIX}, {BODY}, {MATRIX})")
def dynamics(
    state: Array,
    turn: Array,
    time_s: float,
    wrench: Array,
    motion: Array,
    contact: Array,
    body: Constants,
    rate: Array,
) -> None:
    """Last six columns of d/dt state (Fossen 2021, chapters 6 to 8), nu_r being the velocity relative to the water:

        nu_r = nu - [R^T water, 0],    nu' = M^-1 (wrench + R^T (lift + contact) + righting - D(nu_r) nu_r - C(nu_r) nu_r)
               + R^T water' - [omega x R^T water, 0]

    C nu_r = [omega x P, omega x L + v x P] with the impulses [P, L] = M nu_r (Kirchhoff). M couples surge with pitch and
    sway with roll by the first moment h = m z_g. An axis whose row of M^-1 is zero does not move: so a level body has no
    roll and pitch. On a round hull the horizontal quadratic drag points against the flow and takes the horizontal speed
    instead of |u| and |v|. Without `sway` it is the article's plant: v = 0, each axis by itself.

    Water's `motion` (n, 6), legs' `wrench` (n, 6) and `contact` (n, 3), the latter and the water in the pool frame.
    """
    sway, mass, h, inverse, linear, quadratic, righting_nm, buoyancy_n, radius_m, surface, wave_wrench, wave_radps = body
    disturbs = wave_wrench[0] != 0.0 or wave_wrench[1] != 0.0 or wave_wrench[2] != 0.0
    for i in range(len(state)):
        water_x, water_y, water_z = motion[i, 0], motion[i, 1], motion[i, 2]
        rate_x, rate_y, rate_z = motion[i, 3], motion[i, 4], motion[i, 5]
        push_x, push_y, push_z = contact[i, 0], contact[i, 1], contact[i, 2]
        push_z += lift(state[i, 2], buoyancy_n, radius_m, surface)
        xx, xy, xz = turn[i, 0, 0], turn[i, 0, 1], turn[i, 0, 2]
        yx, yy, yz = turn[i, 1, 0], turn[i, 1, 1], turn[i, 1, 2]
        zx, zy, zz = turn[i, 2, 0], turn[i, 2, 1], turn[i, 2, 2]
        a = xx * water_x + yx * water_y + zx * water_z  # the water's velocity on the body's axes
        b = xy * water_x + yy * water_y + zy * water_z
        c = xz * water_x + yz * water_y + zz * water_z
        u, v, w = state[i, 6] - a, state[i, 7] - b, state[i, 8] - c
        p, q, r = state[i, 9], state[i, 10], state[i, 11]

        horizontal = math.sqrt(u * u + v * v)
        speed_u, speed_v = (horizontal, horizontal) if sway else (abs(u), abs(v))
        wave = math.sin(wave_radps[i] * time_s) if disturbs else 0.0
        surge = wrench[i, 0] - (linear[0] + quadratic[0] * speed_u) * u + wave * wave_wrench[0]
        sideways = wrench[i, 1] - (linear[1] + quadratic[1] * speed_v) * v
        heave = wrench[i, 2] - (linear[2] + quadratic[2] * abs(w)) * w + wave * wave_wrench[1]
        roll = wrench[i, 3] - (linear[3] + quadratic[3] * abs(p)) * p - righting_nm * zy
        pitch = wrench[i, 4] - (linear[4] + quadratic[4] * abs(q)) * q + righting_nm * zx
        yaw = wrench[i, 5] - (linear[5] + quadratic[5] * abs(r)) * r + wave * wave_wrench[2]
        surge += xx * push_x + yx * push_y + zx * push_z
        sideways += xy * push_x + yy * push_y + zy * push_z
        heave += xz * push_x + yz * push_y + zz * push_z
        if sway:
            impulse_u, impulse_v, impulse_w = mass[0] * u + h * q, mass[1] * v - h * p, mass[2] * w
            spin_p, spin_q, spin_r = mass[3] * p - h * v, mass[4] * q + h * u, mass[5] * r
            surge -= q * impulse_w - r * impulse_v
            sideways -= r * impulse_u - p * impulse_w
            heave -= p * impulse_v - q * impulse_u
            roll -= q * spin_r - r * spin_q + v * impulse_w - w * impulse_v
            pitch -= r * spin_p - p * spin_r + w * impulse_u - u * impulse_w
            yaw -= p * spin_q - q * spin_p + u * impulse_v - v * impulse_u
        else:
            a, b, c = 0.0, 0.0, 0.0  # no axis couples with another

        rate[i, 6] = inverse[0, 0] * surge + inverse[0, 4] * pitch + xx * rate_x + yx * rate_y + zx * rate_z + b * r - c * q
        rate[i, 7] = inverse[1, 1] * sideways + inverse[1, 3] * roll + xy * rate_x + yy * rate_y + zy * rate_z + c * p - a * r
        rate[i, 8] = inverse[2, 2] * heave + xz * rate_x + yz * rate_y + zz * rate_z + a * q - b * p
        rate[i, 9] = inverse[3, 1] * sideways + inverse[3, 3] * roll
        rate[i, 10] = inverse[4, 0] * surge + inverse[4, 4] * pitch
        rate[i, 11] = inverse[5, 5] * yaw
        if not sway:
            rate[i, 7] = 0.0


@kernel(f"void({MATRIX}, f8, {MATRIX}, b1, {FLOW}, {BASIN}, {BODY}, {WORK}, {MATRIX})")
def state_rate(
    state: Array,
    time_s: float,
    wrench: Array,
    touches: bool,
    flow: Constants,
    basin: Constants,
    body: Constants,
    work: Constants,
    rate: Array,
) -> None:
    """d/dt of a state (n, 12) with the legs' wrench (n, 6). Contact counts if the fleet `touches` anything. `work` holds
    the order and the places of the step's start."""
    order, start, _, _, _, _, _, turn, _, motion, contact, _, _, _, _, _ = work
    kinematics(state, rate, turn)
    if not flow[0]:
        water_motion(state, time_s, flow, motion)
    for i in range(len(contact)):
        contact[i, 0], contact[i, 1], contact[i, 2] = 0.0, 0.0, 0.0
    if touches:
        contact_force(start, state, rate, order, basin, contact)
    dynamics(state, turn, time_s, wrench, motion, contact, body, rate)


# --- the fleet


@kernel(f"void({MATRIX}, {MATRIX}, f8, {MATRIX})")
def extrapolate(start: Array, rate: Array, by_s: float, state: Array) -> None:
    """State (n, 12) that is `by_s` on from `start` at a constant rate."""
    for i in range(len(start)):
        for k in range(STATE):
            state[i, k] = start[i, k] + by_s * rate[i, k]


@kernel(
    f"void({MATRIX}, {MATRIX}, {MATRIX}, {MATRIX}, {MATRIX}, {VECTOR}, {CUBE}, {MATRIX}, {MATRIX}, {VECTOR}, i8, i8, f8, "
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
    first: int,
    steps: int,
    step_s: float,
    actuators: Constants,
    battery: Constants,
    flow: Constants,
    basin: Constants,
    body: Constants,
    work: Constants,
) -> None:
    """Move a fleet on by `steps` steps from step `first` of the plant's time, with constant pulses (n, 8) on the outputs.

    In place: poses, level velocities and tilts (n, 4), thrusters' forces and ankles' angles (n, 4), and charges (n,).
    `history_us` (k, n, 8), `gain` (n, 4) and `sag_v` (n,) as in `actuator_targets` and `thrust_factor`.
    """
    order, start, state, k1, k2, k3, k4, _, wrench, _, _, target_n, target_rad, force_then, ankle_then, factor = work
    half_s = step_s / 2.0
    for step in range(steps):
        time_s = (first + step) * step_s
        pack(eta, nu, tilt, start)
        thrust_factor(charge, force_n, sag_v, battery, factor)
        actuator_targets(history_us, pulses_us, step, gain, factor, actuators, target_n, target_rad)
        move_actuators(force_n, ankle_rad, target_n, target_rad, AT_ONCE_S, actuators, force_then, ankle_then)
        legs_wrench(force_then, ankle_then, actuators, wrench[0])
        move_actuators(force_n, ankle_rad, target_n, target_rad, half_s, actuators, force_then, ankle_then)
        legs_wrench(force_then, ankle_then, actuators, wrench[1])
        move_actuators(force_n, ankle_rad, target_n, target_rad, step_s, actuators, force_n, ankle_rad)
        legs_wrench(force_n, ankle_rad, actuators, wrench[2])

        sort_by_x(start, order)
        touches = is_near(start, order, basin)
        state_rate(start, time_s, wrench[0], touches, flow, basin, body, work, k1)
        extrapolate(start, k1, half_s, state)
        state_rate(state, time_s + half_s, wrench[1], touches, flow, basin, body, work, k2)
        extrapolate(start, k2, half_s, state)
        state_rate(state, time_s + half_s, wrench[1], touches, flow, basin, body, work, k3)
        extrapolate(start, k3, step_s, state)
        state_rate(state, time_s + step_s, wrench[2], touches, flow, basin, body, work, k4)
        for i in range(len(start)):
            for k in range(STATE):
                start[i, k] += step_s / 6.0 * (k1[i, k] + 2.0 * (k2[i, k] + k3[i, k]) + k4[i, k])
        unpack(start, eta, nu, tilt)
        discharge(charge, force_n, step_s, battery)


@kernel(f"void({MATRIX}, {MATRIX}, {MATRIX}, f8, {MATRIX}, {FLOW}, {BASIN}, {BODY}, {WORK}, {MATRIX})")
def fleet_acceleration(
    eta: Array,
    nu: Array,
    tilt: Array,
    time_s: float,
    wrench: Array,
    flow: Constants,
    basin: Constants,
    body: Constants,
    work: Constants,
    acceleration: Array,
) -> None:
    """d/dt (n, 4) of the level velocities nu of a fleet with the legs' wrench (n, 6).

    With Q = Ry Rx and v the body's velocity: d/dt (Q v) = Q (v' + omega x v) - yaw' z x Q v. The fourth is yaw''.
    """
    order, state, _, rate, _, _, _, _, _, _, _, _, _, _, _, _ = work
    pack(eta, nu, tilt, state)
    sort_by_x(state, order)
    state_rate(state, time_s, wrench, is_near(state, order, basin), flow, basin, body, work, rate)
    for i in range(len(state)):
        roll, pitch = state[i, 3], state[i, 4]
        cr, sr, cp, sp = math.cos(roll), math.sin(roll), math.cos(pitch), math.sin(pitch)
        u, v, w, p, q, r = state[i, 6], state[i, 7], state[i, 8], state[i, 9], state[i, 10], state[i, 11]
        ahead = rate[i, 6] + q * w - r * v
        side = rate[i, 7] + r * u - p * w
        below = rate[i, 8] + p * v - q * u
        roll_rate, pitch_rate, yaw_rate = rate[i, 3], rate[i, 4], rate[i, 5]
        down, down_rate = sr * v + cr * w, sr * side + cr * below
        acceleration[i, 0] = cp * ahead + sp * down_rate + yaw_rate * (cr * v - sr * w)
        acceleration[i, 1] = cr * side - sr * below - yaw_rate * (cp * u + sp * down)
        acceleration[i, 2] = cp * down_rate - sp * ahead
        turning = sr * rate[i, 10] + cr * rate[i, 11] + pitch_rate * roll_rate
        acceleration[i, 3] = (turning + yaw_rate * sp * pitch_rate) / cp
