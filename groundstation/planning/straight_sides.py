"""Paths with straight sides between waypoints: with round corners at constant speed, or a stop and a turn at each. Pure.

path = make_path(experiment.path)     # of any kind; groundstation/planning/paths.py has curves and circles
"""

import numpy as np

from groundstation.planning.formation import quintic_blend
from groundstation.planning.paths import MOST_POINTS, CirclePath, Path, PathState, SplinePath
from groundstation.planning.transfer import RAMP_S, ramp
from shoal.config.scene import Circle, Waypoints
from shoal.frames import Array, wrap_angle

BEND_POINTS = 13  # of a rounded corner: the spline through them is then within 1 mm of it
SIDE_POINTS_M = 0.25  # between points of a side, which keep the spline straight
TURN_RADPS = 0.8  # largest rate of a turn on the spot: as in a transfer that turns half round in 7 s
LEAST_TURN_S = 1.0  # of a slight bend
STRAIGHT_RAD = 1e-6  # less is no corner: there is nothing to stop for
PEAK = 1.875  # rate of a quintic blend in its middle, of its mean rate


def make_path(path: Circle | Waypoints) -> Path:
    """The path of an experiment file. Raises ValueError for waypoints that are no path."""
    if isinstance(path, Circle):
        return CirclePath(path)
    if path.corner == "stop":
        return StoppingPath(path)
    return SplinePath(path if path.corner == "smooth" else _rounded(path))


def _rounded(path: Waypoints) -> Waypoints:
    """Waypoints so dense that a spline through them has straight sides. A corner is spread over `corner_m` to either side,
    less where sides are shorter than twice that; the direction changes there without a jump in curvature."""
    points = _distinct(path)
    sides = np.diff(points, axis=0)
    lengths = np.hypot(*sides.T)
    ahead = sides / lengths[:, None]
    count = float(np.sum(lengths / SIDE_POINTS_M + BEND_POINTS))
    if count > MOST_POINTS:
        raise ValueError(
            f"path.points_m: {len(lengths)} sides of {lengths.sum():.0f} m in all are too many or too long for round corners "
            f"(allowed: {SIDE_POINTS_M * MOST_POINTS:.0f} m, to which each corner adds {SIDE_POINTS_M * BEND_POINTS:g} m)"
        )
    x = np.linspace(-1.0, 1.0, BEND_POINTS)[:, None]
    turned = (1.0 + x) ** 2 / 4.0 - (1.0 + np.cos(np.pi * x)) / (2.0 * np.pi**2)  # integral of the share of the new direction
    dense, middle = [points[:1]], [0]
    left_m = 0.0  # of the side, already taken by the corner behind
    for k, length_m in enumerate(lengths):
        last = k + 1 == len(lengths)
        reach_m = 0.0 if last else min(path.corner_m, length_m / 2.0, lengths[k + 1] / 2.0)
        straight_m = length_m - left_m - reach_m
        steps = max(int(np.ceil(straight_m / SIDE_POINTS_M)), 1)
        if straight_m > STRAIGHT_RAD:
            along = left_m + straight_m * np.arange(1, steps + 1)[:, None] / steps
            dense.append(points[k] + along * ahead[k])
        if not last:
            bend = points[k + 1] + reach_m * (ahead[k] * (x - turned) + ahead[k + 1] * turned)
            middle.append(sum(map(len, dense)) + BEND_POINTS // 2 - 1)
            dense.append(bend[1:])
        left_m = reach_m
    chosen = middle[path.start_index] if path.start_index < len(middle) else path.start_index
    places = tuple((float(x), float(y)) for x, y in np.vstack(dense))
    return path.model_copy(update={"points_m": places, "laps": 1, "start_index": chosen, "corner": "smooth"})


def _distinct(path: Waypoints) -> Array:
    """Waypoints (n, 2) of all laps. Raises ValueError if two in a row are the same."""
    points = np.array(path.all_points_m)
    same = np.flatnonzero(np.hypot(*np.diff(points, axis=0).T) <= 0.0)
    if len(same):
        raise ValueError(f"path.points_m: points {same[0]} and {same[0] + 1} are the same place")
    if path.start_index >= len(points) - 1:
        raise ValueError(f"path.start_index = {path.start_index}: allowed are 0 to {len(points) - 2}")
    return points


class StoppingPath:
    """Straight sides from rest to rest, and a turn on the spot at each corner; time 0 is at waypoint `start_index`.

    After its last waypoint it stays there; without `stop` the run must end before."""

    def __init__(self, path: Waypoints) -> None:
        points = _distinct(path)[path.start_index :]
        sides = np.diff(points, axis=0)
        lengths = np.hypot(*sides.T)
        yaw = np.unwrap(np.arctan2(sides[:, 1], sides[:, 0]))
        turns = wrap_angle(np.diff(yaw, append=yaw[-1:]))
        self._speed = np.minimum(path.speed_mps, lengths / RAMP_S)
        self._cruise_s = lengths / self._speed - RAMP_S
        moves_s = self._cruise_s + 2.0 * RAMP_S
        self._turn_s = np.maximum(PEAK * np.abs(turns) / TURN_RADPS, LEAST_TURN_S) * (np.abs(turns) > STRAIGHT_RAD)
        self._begin_s = np.concatenate([[0.0], np.cumsum(moves_s + self._turn_s)[:-1]])
        self._moves_s, self._turns, self._yaw = moves_s, turns, yaw
        self._from, self._ahead = points[:-1], sides / lengths[:, None]
        self._depth_m = path.depth_m
        self._duration_s = float(self._begin_s[-1] + moves_s[-1])
        self.end_s = float("inf") if path.stop else self._duration_s

    def share_at(self, time_s: float) -> float:
        """See `Path`."""
        return min(time_s / self._duration_s, 1.0)

    def at(self, time_s: Array) -> PathState:
        k = np.clip(np.searchsorted(self._begin_s, time_s, side="right") - 1, 0, len(self._begin_s) - 1)
        since_s = np.minimum(time_s - self._begin_s[k], self._moves_s[k])
        up, down = ramp(np.maximum(since_s, 0.0)), ramp(np.maximum(since_s - self._cruise_s[k] - RAMP_S, 0.0))
        distance_m, speed, push = (self._speed[k] * (a - b) for a, b in zip(up, down, strict=True))
        turn_s = np.where(self._turn_s[k] > 0.0, self._turn_s[k], 1.0)
        tau = np.clip((time_s - self._begin_s[k] - self._moves_s[k]) / turn_s, 0.0, 1.0)
        share, rate, bend = quintic_blend(tau, 1.0)
        zero = np.zeros((len(time_s), 1))
        ahead = np.hstack([self._ahead[k], zero])
        return PathState(
            position_m=np.hstack([self._from[k], zero + self._depth_m]) + distance_m[:, None] * ahead,
            velocity_mps=speed[:, None] * ahead,
            acceleration_mps2=push[:, None] * ahead,
            yaw_rad=self._yaw[k] + self._turns[k] * share,
            yaw_rate_radps=self._turns[k] * rate / turn_s,
            yaw_acceleration_radps2=self._turns[k] * bend / turn_s**2,
            climb_rad=zero[:, 0],
        )
