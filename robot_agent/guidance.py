"""Heading from the force that the path asks for; see robot_agent/reference.py for why."""

import math

import numpy as np

from robot_agent.reference import Path
from wire.experiment import Guidance as GuidanceConfig
from wire.frames import Array, wrap
from wire.vehicle import Vehicle


class Guidance:
    """One robot's reference heading, with its memory: filtered force, direction of thrust, what is left of a jump."""

    def __init__(self, vehicle: Vehicle, config: GuidanceConfig, period_s: float) -> None:
        self._config = config
        self._mass, self._linear, self._quadratic = vehicle.mass.surge_kg, vehicle.drag.linear[0], vehicle.drag.quadratic[0]
        self._blend = 1.0 - math.exp(-period_s / config.filter_s)
        self._settle = math.exp(-period_s / config.filter_s)
        self.reset()

    def reset(self) -> None:
        """Start anew: the next force counts in full."""
        self._force: Array | None = None
        self._direction = 1.0
        self._jump = 0.0
        self._hold_yaw: float | None = None
        self._turning = False

    def follow(self, path: Path, eta: Array, nu: Array, disturbance: Array) -> Array:
        """Reference headings (horizon + 2,) for a path with its rows for now and all nodes. `eta`, `nu`, Gamma: estimates."""
        c, s = math.cos(eta[3]), math.sin(eta[3])
        velocity = np.array([c * nu[0] - s * nu[1], s * nu[0] + c * nu[1]])
        aside = disturbance[1] * np.array([-s, c])
        config = self._config
        asked = self._mass * (
            config.position_gain_per_s2 * (path.eta[0, :2] - eta[:2])
            + config.velocity_gain_per_s * (path.velocity[0, :2] - velocity)
            - aside
        )
        self._force = asked if self._force is None else self._force + self._blend * (asked - self._force)
        speed = np.hypot(path.velocity[:, 0], path.velocity[:, 1])[:, None]
        force = (
            self._force
            + self._mass * path.acceleration[:, :2]
            + (self._linear + self._quadratic * speed) * path.velocity[:, :2]
        )
        tangent = path.eta[:, 3]
        along = np.cos(tangent) * force[:, 0] + np.sin(tangent) * force[:, 1]
        across = -np.sin(tangent) * force[:, 0] + np.cos(tangent) * force[:, 1]
        if self._direction * along[0] < -config.turning_force_n:
            before = self._correction(along[0], across[0])
            self._direction = -self._direction
            self._jump += float(before - self._correction(along[0], across[0]))
        self._jump *= self._settle
        return tangent + self._correction(along, across) + self._jump

    def _correction(self, along: Array, across: Array) -> Array:
        ahead = np.maximum(self._direction * along, self._config.turning_force_n)
        limit = self._config.max_correction_rad
        return np.clip(np.arctan(self._direction * across / ahead), -limit, limit)

    def hold(self, point: Array, eta: Array, count: int) -> Array:
        """Reference headings (count,) for keeping station at `point`: as it is while near, else along the line to the point,
        forwards or backwards, whichever is nearer."""
        if self._hold_yaw is None:
            self._hold_yaw = float(eta[3])
        dx, dy = float(point[0] - eta[0]), float(point[1] - eta[1])
        distance = math.hypot(dx, dy)
        radius = self._config.hold_radius_m
        self._turning = distance > (0.5 * radius if self._turning else radius)
        if self._turning:
            line = math.atan2(dy, dx)
            turn = wrap(2.0 * (line - self._hold_yaw)) / 2.0  # to the line, either way round
            self._hold_yaw += self._blend * turn
        return np.full(count, self._hold_yaw)
