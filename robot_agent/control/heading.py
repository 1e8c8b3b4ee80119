"""Reference heading: the direction in which thrust produces the force that the reference needs.

The robot has no side force, so its heading is the direction in which it can push, as for a quadrotor. With the sway-aware
model the heading is that of the force F, so that no part of it is left along the body's y axis j:

    F = M (a_ref + kp e_position + kd e_velocity - Gamma_v j) + d_v(|V|) V        V = V_ref - current

This holds the crab angle of a turn, leans into a current, looks ahead along a bend, and steers back to the path. Of Gamma only
the side force counts: surge thrust compensates a surge disturbance. (With the whole of Gamma a robot with a strong thruster
oscillated by 0.4 rad.) The opposite heading is as good: thrust reverses.

The article keeps the path's tangent, and never corrects a lateral error at walking pace: 0.33 m on its own circle. Its model
without sway moves where it points, so there the heading is that of the velocity V + (kp / kd) e_position.
"""

import math

import numpy as np

from robot_agent.guidance.reference import Reference
from wire.config.controller import GuidanceConfig
from wire.config.vehicle import Vehicle
from wire.frames import Array, wrap

Vector = tuple[float, float]

HOLD_RADPS = 0.3  # station keeping turns no faster: at 1.2 rad/s a robot kept spinning on the side force of its own spin


class HeadingReference:
    """One robot's reference heading, with its memory: filtered request, direction of thrust, rest of a jump."""

    def __init__(self, vehicle: Vehicle, config: GuidanceConfig, period_s: float, sway: bool) -> None:
        self._sway, self._period_s = sway, period_s
        self._mass = vehicle.mass.surge_kg
        self._linear, self._quadratic = vehicle.drag.linear[1], vehicle.drag.quadratic[1]
        self._per_force = 1.0 if sway else 1.0 / vehicle.drag.linear[0]
        self.tune(config)
        self.reset()

    def tune(self, config: GuidanceConfig) -> None:
        """Use other gains from now on; the memory stays."""
        self._config = config
        self._keep = math.exp(-self._period_s / config.filter_s)
        self._worth = config.turning_force_n * self._per_force

    def reset(self) -> None:
        """Start anew, from the goal's own heading."""
        self._asked: Vector = (0.0, 0.0)
        self._direction = 1.0  # of thrust: 1 ahead, -1 astern
        self._jump = 0.0
        self._hold_yaw: float | None = None

    def heading_along(self, reference: Reference, eta: Array, nu: Array, disturbance: Array, current: complex = 0j) -> Array:
        """Headings (rows,) for the rows of a reference: now, then all nodes. `eta`, `nu` over ground, Gamma (4,), and the
        water's velocity x + iy are estimates."""
        request = self._force(reference, eta, nu, float(disturbance[1])) if self._sway else self._velocity(reference, eta)
        # Filtered in the tangent's frame: what feeds back in a bend, model errors above all, turns with it.
        tangent = reference.eta[:, 3]
        c, s = math.cos(tangent[0]), math.sin(tangent[0])
        request = (c * request[0] + s * request[1], c * request[1] - s * request[0])
        return self._headings(reference, tangent, self._filter(request), current)

    def heading_on_hold(self, reference: Reference, eta: Array, nu: Array, disturbance: Array, current: complex = 0j) -> Array:
        """Headings (rows,) for keeping station: the line of the needed force, ahead or astern, whichever is nearer; unchanged
        while the robot is near and no force is needed. Here all of Gamma counts: a robot in a current ends up in line with it.
        (A heading towards the point makes the robot circle it: it drifts on for 4 s after each turn.)"""
        if self._hold_yaw is None:
            self._hold_yaw = float(eta[3])
        radius = self._config.hold_radius_m
        distance = math.hypot(float(reference.eta[0, 0] - eta[0]), float(reference.eta[0, 1] - eta[1]))
        care = min(max(2.0 * distance / radius - 1.0, 0.0), 1.0)  # none within half the radius, all from the radius on
        push_x, push_y = self._force(reference, eta, nu, 0.0)
        c, s = math.cos(eta[3]), math.sin(eta[3])
        side, ahead = float(disturbance[1]), float(disturbance[0])
        drag = (self._linear + self._quadratic * abs(current)) * current
        force_x, force_y = self._filter(
            (
                care * push_x - self._mass * (c * ahead - s * side) - drag.real,
                care * push_y - self._mass * (s * ahead + c * side) - drag.imag,
            )
        )
        size = force_x * force_x + force_y * force_y
        turn = 0.5 * wrap(2.0 * (math.atan2(force_y, force_x) - self._hold_yaw))
        rate = turn / self._config.filter_s * size / (size + self._config.turning_force_n**2)
        self._hold_yaw += self._period_s * min(max(rate, -HOLD_RADPS), HOLD_RADPS)
        return np.full(len(reference.eta), self._hold_yaw)

    def _headings(self, reference: Reference, tangent: Array, feedback: Vector, current: complex) -> Array:
        """Headings from the feedback, in the tangent's frame: along + i across."""
        back = np.exp(-1j * tangent)
        if self._sway:
            velocity = reference.velocity.view(np.complex128)[:, 0] - current
            drag = np.abs(velocity)
            drag *= self._quadratic
            drag += self._linear
            velocity *= drag
            wish = self._mass * reference.acceleration.view(np.complex128)[:, 0]
            wish += velocity
            wish *= back
        else:
            wish = (back * reference.velocity.view(np.complex128)[:, 0]).real + 0j
        wish += complex(*feedback)
        along, across = wish.real, wish.imag
        if self._direction * along[0] < -self._worth:
            before = self._angle(along[:1], across[:1])
            self._direction = -self._direction
            self._jump += float(before[0] - self._angle(along[:1], across[:1])[0])
        self._jump *= self._keep
        angle = self._angle(along, across)
        angle += tangent
        angle += self._jump
        return angle

    def _force(self, reference: Reference, eta: Array, nu: Array, side: float) -> Vector:
        """Feedback part of F in the pool frame, N; `side` is Gamma_v."""
        x, y, _, yaw = eta.tolist()
        u, v, _, _ = nu.tolist()
        goal_x, goal_y, _, _ = reference.eta[0].tolist()
        speed_x, speed_y, _, _ = reference.velocity[0].tolist()
        c, s = math.cos(yaw), math.sin(yaw)
        stiff, damp = self._config.position_gain_per_s2, self._config.velocity_gain_per_s
        return (
            self._mass * (stiff * (goal_x - x) + damp * (speed_x - c * u + s * v) + side * s),
            self._mass * (stiff * (goal_y - y) + damp * (speed_y - s * u - c * v) - side * c),
        )

    def _velocity(self, reference: Reference, eta: Array) -> Vector:
        """Correction of the velocity in the pool frame, m/s."""
        rate = self._config.position_gain_per_s2 / max(self._config.velocity_gain_per_s, 1e-6)
        return rate * float(reference.eta[0, 0] - eta[0]), rate * float(reference.eta[0, 1] - eta[1])

    def _filter(self, asked: Vector) -> Vector:
        keep, before = self._keep, self._asked
        self._asked = (keep * before[0] + (1.0 - keep) * asked[0], keep * before[1] + (1.0 - keep) * asked[1])
        return self._asked

    def _angle(self, along: Array, across: Array) -> Array:
        tangent = across / np.maximum(self._direction * along, self._worth)
        tangent *= self._direction
        angle = np.arctan(tangent)
        limit = self._config.max_correction_rad
        np.maximum(angle, -limit, out=angle)
        return np.minimum(angle, limit, out=angle)
