"""Paths of the formation's centre, flown at constant speed (equations 12, 13), with their exact time derivatives.

A waypoint path is a natural cubic spline over chord length, then re-parametrised by its TRUE arc length: flown over chord
length the speed would be wrong by up to 21 % (ambiguity A8). Pool frame: z is depth, yaw grows from x to y.
"""

from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Protocol

import numpy as np
from scipy.interpolate import CubicSpline

from shoal.config.scene import Circle, Waypoints
from shoal.frames import Array, wrap_angle

MOST_POINTS = 20_000  # of a path that is made dense, every 0.25 m: more than the longest run flies. A spline takes 3 s
PIECES = 64  # per span between waypoints: Gauss-Legendre then gives arc length to 1e-12 m on paths of tens of metres
SLOWEST = 0.05  # of |f'| over chord length, which is about 1: below it the curve all but reverses, and has no heading there
CONVERGED = 1e-13  # of the chord parameter, in m
NEWTON_STEPS = 8  # from a linear guess within a piece; converges quadratically, 4 reach machine precision
_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(5)
_NODES, _WEIGHTS = 0.5 * (_NODES + 1.0), 0.5 * _WEIGHTS  # on [0, 1]


@dataclass(frozen=True, eq=False)
class PathState:
    """State of a path at n instants. Yaw is the tangent's direction in the horizontal plane, unwrapped."""

    position_m: Array  # (n, 3)
    velocity_mps: Array  # (n, 3)
    acceleration_mps2: Array  # (n, 3)
    yaw_rad: Array  # (n,)
    yaw_rate_radps: Array  # (n,)
    yaw_acceleration_radps2: Array  # (n,)
    climb_rad: Array  # (n,) angle of the tangent towards +z: positive dives


class Path(Protocol):
    """Motion of the formation's centre as a function of time."""

    end_s: float  # of the path

    def at(self, time_s: Array) -> PathState: ...

    def share_at(self, time_s: float) -> float:
        """Share of the path, by its own time, that lies behind at an instant; NaN for one that has no end."""
        ...


def curve_through(points: Array) -> tuple[Array, CubicSpline]:
    """Knots (n,) and natural cubic spline over chord length through points (n, 2), of which no two in a row are the same."""
    knots = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(points, axis=0).T))])
    return knots, CubicSpline(knots, points, bc_type="natural")


class CirclePath:
    """A circle around the origin with heading that grows: x = R cos wt, y = R sin wt, yaw = wt + pi/2."""

    end_s = float("inf")

    def __init__(self, circle: Circle) -> None:
        self._radius_m = circle.diameter_m / 2.0
        self._rate_radps = 2.0 * np.pi / circle.lap_s
        self._depth_m = circle.depth_m

    def at(self, time_s: Array) -> PathState:
        angle = self._rate_radps * time_s
        zero, still = np.zeros_like(angle), np.full_like(angle, self._rate_radps)
        out = np.stack([np.cos(angle), np.sin(angle), zero], axis=1)
        along = np.stack([-np.sin(angle), np.cos(angle), zero], axis=1)
        return PathState(
            position_m=self._radius_m * out + [0.0, 0.0, self._depth_m],
            velocity_mps=self._radius_m * self._rate_radps * along,
            acceleration_mps2=-self._radius_m * self._rate_radps**2 * out,
            yaw_rad=angle + np.pi / 2.0,
            yaw_rate_radps=still,
            yaw_acceleration_radps2=zero,
            climb_rad=zero,
        )

    def share_at(self, time_s: float) -> float:
        """See `Path`: a circle goes on for ever."""
        return float("nan")


class SplinePath:
    """A natural cubic spline through waypoints at constant horizontal speed; time 0 is at waypoint `start_index`.

    Past its last waypoint the path goes straight on (natural ends have no curvature, so nothing jumps there), or stops.
    """

    def __init__(self, waypoints: Waypoints) -> None:
        """Raises ValueError for waypoints that no robot can follow: two at one place, or a turn on the spot."""
        points = np.array(waypoints.all_points_m)
        chords = np.hypot(*np.diff(points, axis=0).T)
        if np.any(chords <= 0.0):
            first = int(np.flatnonzero(chords <= 0.0)[0])
            raise ValueError(f"path.points_m: points {first} and {first + 1} are the same place")
        if waypoints.start_index >= len(points) - 1:
            raise ValueError(f"path.start_index = {waypoints.start_index}: allowed are 0 to {len(points) - 2}")
        # The curve by its parameter q, in fine pieces between knots
        knots, self._curve = curve_through(points)
        fine = [np.linspace(a, b, PIECES, endpoint=False) for a, b in pairwise(knots)]
        self._q = np.concatenate([*fine, [knots[-1]]])
        slowest = int(np.argmin(np.linalg.norm(self._curve(self._q, 1), axis=1)))
        if np.linalg.norm(self._curve(self._q[slowest], 1)) < SLOWEST:
            x, y = self._curve(self._q[slowest])
            raise ValueError(f"path.points_m: the path turns on the spot at ({x:.2f}, {y:.2f}) m; give it room to turn")
        # Arc length [m] and direction [rad] at the ends of the pieces
        self._arc = np.concatenate([[0.0], np.cumsum(self._length(self._q[:-1], np.diff(self._q)))])
        self._yaw = np.unwrap(self._angle(self._q))
        self._start_m = float(self._arc[waypoints.start_index * PIECES])
        self._speed, self._dive, self._depth = waypoints.speed_mps, waypoints.dive_mps, waypoints.depth_m
        self.length_m = float(self._arc[-1])
        self._duration_s = (self.length_m - self._start_m) / self._speed
        self._stops = waypoints.stop
        self.end_s = float("inf") if self._stops else self._duration_s

    def _length(self, start: Array, width: Array) -> Array:
        """Arc length of the curve over [start, start + width] of the chord parameter, shape (n,)."""
        tangent = self._curve(start[:, None] + width[:, None] * _NODES, 1)
        return np.asarray(width * (np.hypot(tangent[..., 0], tangent[..., 1]) @ _WEIGHTS))

    def _angle(self, q: Array) -> Array:
        tangent = self._curve(q, 1)
        return np.asarray(np.arctan2(tangent[:, 1], tangent[:, 0]))

    def chord_parameter(self, arc_m: Array) -> Array:
        """The spline's parameter at arc lengths within [0, length_m], shape (n,)."""
        piece = np.clip(np.searchsorted(self._arc, arc_m, side="right") - 1, 0, len(self._q) - 2)
        start, width = self._q[piece], np.diff(self._q)[piece]
        length_m = arc_m - self._arc[piece]
        q = start + width * length_m / np.diff(self._arc)[piece]
        for _ in range(NEWTON_STEPS):
            tangent = self._curve(q, 1)
            step = (self._length(start, q - start) - length_m) / np.hypot(tangent[:, 0], tangent[:, 1])
            q = np.clip(q - step, start, start + width)
            if float(np.abs(step).max(initial=0.0)) < CONVERGED:
                break
        return np.asarray(q)

    def at(self, time_s: Array) -> PathState:
        return self._stopped(time_s) if self._stops else self._moving(time_s)

    def share_at(self, time_s: float) -> float:
        """See `Path`."""
        return min(time_s / self._duration_s, 1.0)

    def _stopped(self, time_s: Array) -> PathState:
        """Motion along the path that is at rest from the last waypoint on."""
        at = self._moving(np.minimum(time_s, self._duration_s))
        moves = (time_s < self._duration_s).astype(np.float64)
        return replace(
            at,
            velocity_mps=at.velocity_mps * moves[:, None],
            acceleration_mps2=at.acceleration_mps2 * moves[:, None],
            yaw_rate_radps=at.yaw_rate_radps * moves,
            yaw_acceleration_radps2=at.yaw_acceleration_radps2 * moves,
        )

    def _moving(self, time_s: Array) -> PathState:
        """Motion along the path at constant speed, straight on beyond its ends."""
        arc = self._start_m + self._speed * time_s
        inside = np.clip(arc, 0.0, self.length_m)
        q = self.chord_parameter(inside)
        piece = np.clip(np.searchsorted(self._q, q, side="right") - 1, 0, len(self._q) - 2)
        yaw = self._yaw[piece] + wrap_angle(self._angle(q) - self._yaw[piece])
        curvature, sharpening = self._bend(q)
        beyond = arc - inside
        curvature, sharpening = np.where(beyond == 0.0, curvature, 0.0), np.where(beyond == 0.0, sharpening, 0.0)
        ahead, side = np.stack([np.cos(yaw), np.sin(yaw)], axis=1), np.stack([-np.sin(yaw), np.cos(yaw)], axis=1)
        u, w, column = self._speed, self._dive, np.ones((len(time_s), 1))
        return PathState(
            position_m=np.hstack([self._curve(q) + beyond[:, None] * ahead, (self._depth + w * time_s)[:, None]]),
            velocity_mps=np.hstack([u * ahead, w * column]),
            acceleration_mps2=np.hstack([(u**2 * curvature)[:, None] * side, 0.0 * column]),
            yaw_rad=yaw,
            yaw_rate_radps=u * curvature,
            yaw_acceleration_radps2=u**2 * sharpening,
            climb_rad=np.full(len(time_s), np.arctan2(w, u)),
        )

    def _bend(self, q: Array) -> tuple[Array, Array]:
        """Signed curvature in 1/m (13) and its derivative over arc length in 1/m^2, both (n,)."""
        (x1, y1), (x2, y2), (x3, y3) = (self._curve(q, order).T for order in (1, 2, 3))
        g = np.hypot(x1, y1)
        cross = x1 * y2 - y1 * x2
        stretch = (x1 * x2 + y1 * y2) / g  # dg/dq
        return cross / g**3, ((x1 * y3 - y1 * x3) / g**3 - 3.0 * cross * stretch / g**4) / g
