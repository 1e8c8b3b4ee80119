"""Obstacles in the pool, and the first place at which flying robots would touch one. Pure."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field

import numpy as np

from groundstation.planning.replanning import can_replan
from groundstation.planning.segment import NO_OBSTACLES, PlanSegment, first_contact
from groundstation.telemetry import RobotView
from shoal.config.controller import Safety
from shoal.config.experiment import Experiment
from shoal.frames import Array
from shoal.messages.messages import Obstacles
from shoal.messages.obstacle_memory import ages_s, drift_m, growth_m, is_old

AHEAD_S = 25.0  # of the path is checked for obstacles
DRIFTS_MPS = 0.05  # faster obstacles are left to the robots: they will be elsewhere when the formation comes by
SURE_S = 0.5  # an obstacle must have been seen for this long before a path is changed for it


@dataclass(frozen=True, eq=False)
class ObstacleSet:
    """Obstacles in the pool by number, as discs (k, 3: x, y, radius) in m."""

    ids: tuple[int, ...] = ()
    discs: Array = field(default_factory=lambda: NO_OBSTACLES)


def obstacle_set(news: Obstacles, since_s: float, safety: Safety) -> ObstacleSet:
    """Obstacles of a message that is `since_s` old, as discs around their outlines. Takes those that lie still; also old ones
    that have not been reported for a while, wide enough for the way they may have drifted."""
    discs = []
    for number, outline, velocity, age_s in zip(news.ids, news.outline, news.velocity, ages_s(news, since_s), strict=False):
        old = is_old(age_s)
        if old or float(np.hypot(*velocity)) <= DRIFTS_MPS:
            drift = drift_m(safety, velocity, age_s) if old else np.zeros(2)
            wider_m = growth_m(safety, age_s) if old else 0.0
            middle = outline.mean(axis=0)
            reach_m = float(np.hypot(*(outline - middle).T).max()) + 0.5 * float(np.hypot(*drift)) + wider_m
            discs.append((number, *(middle + 0.5 * drift).tolist(), reach_m))
    return ObstacleSet(tuple(int(n) for n, *_ in discs), np.array([disc for _, *disc in discs]).reshape(-1, 3))


def located(lost: Mapping[int, RobotView]) -> tuple[int, ...]:
    """Those of the lost robots that have a disc, in the order of their discs."""
    return tuple(robot for robot, view in lost.items() if view.is_located)


class ObstacleMonitor:
    """Remembers since when each obstacle has been seen. Discs are (k, 3: x, y, radius) in m."""

    def __init__(self, experiment: Experiment) -> None:
        self.flown = experiment
        self._present = ObstacleSet()
        self._since_ns: dict[int, int] = {}

    def update(self, present: ObstacleSet | None, now_ns: int) -> None:
        """Take in the obstacles that are seen now; None: as before."""
        self._present = present if present is not None else self._present
        self._since_ns = {i: self._since_ns.get(i, now_ns) for i in self._present.ids}

    def discs_to_avoid(
        self, lost: Iterable[RobotView], now_ns: int | None = None, room_m: float | None = None, obstacles: bool = True
    ) -> Array:
        """Discs (k, 3: x, y, radius) in m of obstacles, then of the `lost` robots, where they were last seen.

        `obstacles` False leaves the obstacles out. With `now_ns`, obstacles that have been seen for less than SURE_S are left
        out. Robots keep a growing bubble around a silent one, so the disc of a lost robot has `room_m` around its hull; None:
        safety.bubble_max_m.
        """
        safety = self.flown.safety
        lost_radius_m = safety.radius_m + (safety.bubble_max_m if room_m is None else room_m)
        robots = [(*robot.eta[:2], lost_radius_m) for robot in lost if robot.is_located]
        return np.vstack([self._discs(now_ns) if obstacles else NO_OBSTACLES, np.array(robots).reshape(-1, 3)])

    def first_contact(self, segment: PlanSegment, progress_s: float, lost: Mapping[int, RobotView], now_ns: int | None) -> str:
        """Text with the first place at which a robot, `progress_s` along a segment, would touch an obstacle.

        Empty if there is none, or if the path is not changed for it: in formation only paths of some kinds can be replanned
        (`can_replan`). On separate transfers robots come to rest for a new plan, and lost robots always count.
        """
        detours, separate = self.flown.mission.detours, segment.is_separate(progress_s)
        if not separate and not (detours and can_replan(self.flown)):
            return ""
        obstacles = self.discs_to_avoid(lost.values(), now_ns, room_m=0.0, obstacles=detours)
        return first_contact(self.flown, segment, progress_s, progress_s + AHEAD_S, obstacles, located(lost))

    def _discs(self, now_ns: int | None) -> Array:
        """Discs (k, 3) of the present obstacles; with `now_ns` only of those seen for SURE_S by then."""
        are_sure = [now_ns is None or now_ns - self._since_ns.get(i, now_ns) >= SURE_S * 1e9 for i in self._present.ids]
        return self._present.discs[np.array(are_sure, dtype=bool)] if self._present.ids else NO_OBSTACLES
