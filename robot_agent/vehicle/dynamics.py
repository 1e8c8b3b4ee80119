"""The model that estimator and controller share: body velocities with sway, quadratic drag and lagging thrusters.

Equations (3-11) with the sway that the article leaves out (it is what pushes a slow robot off a circle):

    u' = (X - d(u) u) / m_u + (m_v / m_u) v r + Gamma_u        eta' = J(yaw) [u, v, w, r]
    v' = (    - d(v) v) / m_v - (m_u / m_v) u r + Gamma_v      d = linear + quadratic speed
    w' = (Z - d(w) w) / m_w + Gamma_w                          lag X' = X_commanded - X, Z and N alike
    r' = (N - d(r) r) / m_r + Gamma_r

The speed in d is |w|, |r|, and for surge and sway that of both: water presses against a sphere along its path. (Each axis with
its own speed, as in the article, makes a sliding robot's side drag three times too small at 0.3 m/s: 4 cm in a bend.)
The Munk moment (m_u - m_v) u v is left out: it is zero for a sphere, and Gamma_r carries it otherwise.

Velocities advance by v+ = v + dt phi(a dt) v', phi(s) = (1 - exp(-s)) / s, a = the slope of drag / m (exponential Euler:
exact for linear drag, stable for any step); poses advance by the trapezoidal rule.
"""

import math
from collections.abc import Sequence

import numpy as np

from wire.config.vehicle import Vehicle

Wrench = tuple[float, float, float]  # surge N, heave N, yaw N m
State = tuple[float, ...]  # 11 numbers: eta (4), nu (4), thrust that acts now [X N, Z N, N N m]


class Model:
    """Nominal dynamics of a vehicle. `sway = False` gives the article's model: v stays zero."""

    def __init__(self, vehicle: Vehicle, sway: bool = True, lag: bool = True) -> None:
        self.mass = tuple(float(m) for m in vehicle.inertia)
        self.linear = vehicle.drag.linear
        self.quadratic = vehicle.drag.quadratic
        self.sway = sway
        self.lag_s = vehicle.thruster.lag_s if lag else 0.0
        self.coriolis = self.mass[1] / self.mass[0]  # m_v / m_u
        self.coefficients = np.array((self.mass, self.linear, self.quadratic))  # (3, 4) for kernels

    def lag(self, dt_s: float) -> tuple[float, float]:
        """Return the share of (thrust - command) that is left after `dt_s`, and its mean over `dt_s`."""
        if self.lag_s <= 0.0 or dt_s <= 0.0:
            return (0.0, 0.0) if dt_s > 0.0 else (1.0, 1.0)
        left = math.exp(-dt_s / self.lag_s)
        return left, self.lag_s / dt_s * (1.0 - left)

    def drag(self, u: float, v: float) -> tuple[float, float]:
        """Deceleration (2,) in m/s^2 by drag at horizontal velocities u, v through the water."""
        speed = math.hypot(u, v)
        along, aside = self.linear[0] + self.quadratic[0] * speed, self.linear[1] + self.quadratic[1] * speed
        return along * u / self.mass[0], aside * v / self.mass[1]

    def sway_slope(self, u: float, v: float) -> float:
        """Rate (1/s) at which sideways motion decays at velocities u, v: slope of the drag, per mass."""
        speed = math.hypot(u, v)
        bend = v * v / speed if speed > 0.0 else 0.0
        return (self.linear[1] + self.quadratic[1] * (speed + bend)) / self.mass[1]

    def advance(self, state: State, disturbance: Sequence[float], wrench: Sequence[float], dt_s: float) -> State:
        """Return the state after `dt_s` (one control step or less) of a constant commanded wrench and disturbance (4,)."""
        x, y, z, yaw, u, v, w, r, fx, fz, fn = state
        left, mean = self.lag(dt_s)
        cx, cz, cn = wrench
        mass_u, mass_v, mass_w, mass_r = self.mass
        linear_u, linear_v, linear_w, linear_r = self.linear
        quadratic_u, quadratic_v, quadratic_w, quadratic_r = self.quadratic
        speed, speed_w, speed_r = math.sqrt(u * u + v * v), abs(w), abs(r)
        bend = 1.0 / speed if speed > 0.0 else 0.0
        force = cx + (fx - cx) * mean - (linear_u + quadratic_u * speed) * u
        phi_dt = _phi_dt((linear_u + quadratic_u * (speed + u * u * bend)) / mass_u, dt_s)
        u1 = u + phi_dt * (force / mass_u + self.coriolis * v * r + disturbance[0])
        v1 = 0.0
        if self.sway:
            phi_dt = _phi_dt((linear_v + quadratic_v * (speed + v * v * bend)) / mass_v, dt_s)
            v1 = v + phi_dt * (disturbance[1] - (linear_v + quadratic_v * speed) * v / mass_v - u * r / self.coriolis)
        force = cz + (fz - cz) * mean - (linear_w + quadratic_w * speed_w) * w
        w1 = w + _phi_dt((linear_w + 2.0 * quadratic_w * speed_w) / mass_w, dt_s) * (force / mass_w + disturbance[2])
        force = cn + (fn - cn) * mean - (linear_r + quadratic_r * speed_r) * r
        r1 = r + _phi_dt((linear_r + 2.0 * quadratic_r * speed_r) / mass_r, dt_s) * (force / mass_r + disturbance[3])
        half = 0.5 * dt_s
        yaw1 = yaw + half * (r + r1)
        c, s, c1, s1 = math.cos(yaw), math.sin(yaw), math.cos(yaw1), math.sin(yaw1)
        x1, y1 = x + half * (c * u - s * v + c1 * u1 - s1 * v1), y + half * (s * u + c * v + s1 * u1 + c1 * v1)
        rest = (cx + (fx - cx) * left, cz + (fz - cz) * left, cn + (fn - cn) * left)
        return (x1, y1, z + half * (w + w1), yaw1, u1, v1, w1, r1, *rest)


def _phi_dt(slope: float, dt_s: float) -> float:
    """dt phi(a dt), s: effective time of a constant acceleration against drag of slope a (1/s, per mass)."""
    return -math.expm1(-slope * dt_s) / slope
