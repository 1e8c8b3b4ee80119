"""The model that estimator and controller share: body velocities with sway, quadratic drag and lagging thrusters.

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
from typing import Any, NamedTuple

import numpy as np

from shoal.config.vehicle import AXES, Vehicle
from shoal.frames import Array
from shoal.kernels.decorator import kernel
from shoal.kernels.types import Ints, Table

Wrench = tuple[float, ...]  # surge N, heave N, yaw N m, and sway N of a vehicle with side thrust
State = tuple[float, ...]  # 12 numbers: eta (4), nu (4), thrust that acts now [X N, Z N, N N m, Y N]
Pair = tuple[float, float]
PerAxis4 = tuple[float, float, float, float]
State12 = tuple[float, float, float, float, float, float, float, float, float, float, float, float]

STATES = 12
LAG_SHARE = 0.3  # of the thrusters' lag that counts as delay: the plan knows it, and inverts most of it
LONGEST_STEP_NS = 50_000_000  # the model's step is first order in the Coriolis terms


class MotionModel(NamedTuple):
    """The model's numbers."""

    coefficients: Table  # (3, 4): m, linear and quadratic drag of the four axes
    sway: float  # 0: v stays zero
    lag_s: float


class Commands(NamedTuple):
    """Wrenches sent, each with the instant from which it acts."""

    acts_ns: Ints
    wrenches: Table  # (commands, 4)
    sent: int  # so many of them


@kernel
def lag(lag_s: float, dt: float) -> Pair:
    """Share of (thrust - command) that is left after `dt`, and its mean over `dt` (s)."""
    if dt <= 0.0:
        return 1.0, 1.0
    if lag_s <= 0.0:
        return 0.0, 0.0
    left = math.exp(-dt / lag_s)
    return left, lag_s / dt * (1.0 - left)


@kernel(part=True)
def phi_dt(slope: float, dt: float) -> float:
    """dt phi(a dt), s: effective time of a constant acceleration against drag of slope a (1/s, per mass)."""
    return -math.expm1(-slope * dt) / slope


@kernel
def advance(motion: MotionModel, state: State12, gamma: PerAxis4, wrench: PerAxis4, dt: float) -> State12:
    """State after `dt` (one control step or less) of a constant commanded wrench and Gamma: the module's equations."""
    model = motion.coefficients
    x, y, z, yaw, u, v, w, r, acting_x, acting_z, acting_n, acting_y = state
    m_u, m_v, m_w, m_r = model[0]
    linear_u, linear_v, linear_w, linear_r = model[1]
    quadratic_u, quadratic_v, quadratic_w, quadratic_r = model[2]
    c = m_v / m_u
    left, mean = lag(motion.lag_s, dt)
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
    v1 = motion.sway * (v + phi_dt(slope_v, dt) * v_dot)
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


@kernel
def propagate(
    motion: MotionModel, state: State12, gamma: PerAxis4, current: Pair, commands: Commands, from_ns: int, to_ns: int
) -> State12:
    """State at `to_ns`, from that at `from_ns`, under commands, before the first of which no thrust acts, in water that
    streams at `current` (x, y, m/s), in steps of at most LONGEST_STEP_NS."""
    count, acts_ns, wrenches = commands.sent, commands.acts_ns, commands.wrenches
    wrench = (0.0, 0.0, 0.0, 0.0)
    for i in range(count + 1):
        until_ns = min(acts_ns[i], to_ns) if i < count else to_ns
        if until_ns > from_ns:
            steps = (until_ns - from_ns + LONGEST_STEP_NS - 1) // LONGEST_STEP_NS
            dt = (until_ns - from_ns) * 1e-9 / steps
            for _ in range(steps):
                state = advance(motion, state, gamma, wrench, dt)
            from_ns = until_ns
            x, y, z, yaw, u, v, w, r, acting_x, acting_z, acting_n, acting_y = state
            x += current[0] * dt * steps
            y += current[1] * dt * steps
            state = (x, y, z, yaw, u, v, w, r, acting_x, acting_z, acting_n, acting_y)
        if i < count:
            wrench = (wrenches[i, 0], wrenches[i, 1], wrenches[i, 2], wrenches[i, 3])
    return state


@kernel(part=True)
def drag(model: Table, u: float, v: float) -> Pair:
    """Deceleration in m/s^2 by drag at horizontal velocities u, v through the water."""
    speed = math.hypot(u, v)
    along, aside = model[1, 0] + model[2, 0] * speed, model[1, 1] + model[2, 1] * speed
    return along * u / model[0, 0], aside * v / model[0, 1]


class FlowMoment(NamedTuple):
    """Yaw moment of the water past the hull, (m_u - m_v) u v (Munk), and its standard deviation."""

    expected_nm: float
    deviation_nm: float


NO_FLOW = FlowMoment(0.0, 0.0)


def flow_moment(model: Array, velocity: Array, deviation_mps: float) -> FlowMoment:
    """Flow moment of a model (3, 4) at a velocity (4,) through the water that is known to within `deviation_mps`."""
    u, v = velocity[:2].tolist()
    difference_kg = model.item(0) - model.item(1)
    return FlowMoment(difference_kg * u * v, abs(difference_kg) * deviation_mps * math.hypot(u, v, deviation_mps))


def loop_delay_s(vehicle: Vehicle, period_s: float, lag_s: float) -> float:
    """Delay of the control loop that a plan cannot take into account: half a period, dead time, part of the lag."""
    return vehicle.thruster.dead_time_s + 0.5 * period_s + LAG_SHARE * lag_s


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
        self.motion = MotionModel(self.coefficients, self.sway, self.lag_s)

    def advance(self, state: State, disturbance: Sequence[float], wrench: Sequence[float], dt_s: float) -> State:
        """Return the state after `dt_s` (one control step or less) of a constant commanded wrench and disturbance (4,).
        Without side thrust `state` may have 11 numbers, and `wrench` 3."""
        whole: Any = (*state, 0.0)[:STATES]
        pushed: Any = (*wrench, 0.0)[: len(AXES)]
        gamma: Any = tuple(disturbance)
        return advance(self.motion, whole, gamma, pushed, dt_s)[: len(state)]
