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

from wire.vehicle import Vehicle

State = tuple[float, ...]  # 11 numbers: eta (4), nu (4), thrust that acts now [X N, Z N, N N m]


class Model:
    """A vehicle's nominal dynamics. `sway = False` is the article's model: v stays zero."""

    def __init__(self, vehicle: Vehicle, sway: bool = True, lag: bool = True) -> None:
        self.mass = tuple(float(m) for m in vehicle.inertia)
        self.linear = vehicle.drag.linear
        self.quadratic = vehicle.drag.quadratic
        self.sway = sway
        self.lag_s = vehicle.thruster.lag_s if lag else 0.0
        self.coriolis = self.mass[1] / self.mass[0]  # m_v / m_u

    def lag(self, dt_s: float) -> tuple[float, float]:
        """How much of (thrust - command) is left after `dt_s`, and its mean over `dt_s`."""
        if self.lag_s <= 0.0 or dt_s <= 0.0:
            return (0.0, 0.0) if dt_s > 0.0 else (1.0, 1.0)
        left = math.exp(-dt_s / self.lag_s)
        return left, self.lag_s / dt_s * (1.0 - left)

    def advance(self, state: State, disturbance: Sequence[float], wrench: Sequence[float], dt_s: float) -> State:
        """The state after `dt_s` (one control step or less) of a constant commanded wrench and disturbance (4,)."""
        x, y, z, yaw, u, v, w, r, fx, fz, fn = state
        left, mean = self.lag(dt_s)
        cx, cz, cn = wrench
        linear, quadratic, mass, ratio = self.linear, self.quadratic, self.mass, self.coriolis
        speed = math.hypot(u, v)
        push = cx + (fx - cx) * mean - (linear[0] + quadratic[0] * speed) * u
        u1 = u + self.held(0, speed, u, dt_s) * (push / mass[0] + ratio * v * r + disturbance[0])
        v1 = 0.0
        if self.sway:
            push = -(linear[1] + quadratic[1] * speed) * v
            v1 = v + self.held(1, speed, v, dt_s) * (push / mass[1] - u * r / ratio + disturbance[1])
        push = cz + (fz - cz) * mean - (linear[2] + quadratic[2] * abs(w)) * w
        w1 = w + self.held(2, abs(w), w, dt_s) * (push / mass[2] + disturbance[2])
        push = cn + (fn - cn) * mean - (linear[3] + quadratic[3] * abs(r)) * r
        r1 = r + self.held(3, abs(r), r, dt_s) * (push / mass[3] + disturbance[3])
        half = 0.5 * dt_s
        yaw1 = yaw + half * (r + r1)
        c, s, c1, s1 = math.cos(yaw), math.sin(yaw), math.cos(yaw1), math.sin(yaw1)
        x1, y1 = x + half * (c * u - s * v + c1 * u1 - s1 * v1), y + half * (s * u + c * v + s1 * u1 + c1 * v1)
        thrust = (cx + (fx - cx) * left, cz + (fz - cz) * left, cn + (fn - cn) * left)
        return (x1, y1, z + half * (w + w1), yaw1, u1, v1, w1, r1, *thrust)

    def held(self, axis: int, speed: float, velocity: float, dt_s: float) -> float:
        """dt phi(a dt): how long a constant acceleration counts while drag eats it."""
        bend = speed + velocity * velocity / speed if speed > 0.0 else 0.0
        slope = (self.linear[axis] + self.quadratic[axis] * bend) / self.mass[axis]
        return -math.expm1(-slope * dt_s) / slope
