"""What lies in the pool besides robots that fly, and whether it lies in their way. Pure."""

from collections.abc import Iterable
from dataclasses import dataclass, field

import numpy as np

from groundstation.planning.replanning import can_detour
from groundstation.planning.segment import NOTHING, Leg, first_contact
from groundstation.telemetry import RobotView
from wire.config.controller import Safety
from wire.config.experiment import Experiment
from wire.frames import Array
from wire.messages.messages import Obstacles
from wire.obstacle_memory import ages_s, drift_m, growth_m, is_old

AHEAD_S = 25.0  # along the path, for things that lie on it
DRIFTS_MPS = 0.05  # what moves faster will lie elsewhere when the formation comes by
SURE_S = 0.5  # that long something must have lain there


@dataclass(frozen=True, eq=False)
class Surroundings:
    """What the station knows besides its robots: things that lie in the pool, (k, 3: x, y, radius), and their numbers."""

    ids: tuple[int, ...] = ()
    things: Array = field(default_factory=lambda: NOTHING)


def surroundings(seen: Obstacles, since_s: float, safety: Safety) -> Surroundings:
    """Obstacles of a message that is `since_s` old, as circles around their outlines: those that lie still, and those that
    nobody has told of for a while, whatever they did then, wide enough for where they may be by now."""
    found = []
    for number, outline, velocity, age_s in zip(seen.ids, seen.outline, seen.velocity, ages_s(seen, since_s), strict=False):
        old = is_old(age_s)
        if old or float(np.hypot(*velocity)) <= DRIFTS_MPS:
            drift = drift_m(safety, velocity, age_s) if old else np.zeros(2)
            wider_m = growth_m(safety, age_s) if old else 0.0
            middle = outline.mean(axis=0)
            reach_m = float(np.hypot(*(outline - middle).T).max()) + 0.5 * float(np.hypot(*drift)) + wider_m
            found.append((number, *(middle + 0.5 * drift).tolist(), reach_m))
    return Surroundings(tuple(int(n) for n, *_ in found), np.array([thing for _, *thing in found]).reshape(-1, 3))


class Lookout:
    """Remembers since when something lies there. Things are (k, 3: x, y, radius)."""

    def __init__(self, experiment: Experiment) -> None:
        self._experiment = experiment
        self._around = Surroundings()
        self._since_ns: dict[int, int] = {}

    def see(self, around: Surroundings | None, now_ns: int) -> None:
        """What lies there now; None: as before."""
        self._around = around if around is not None else self._around
        self._since_ns = {i: self._since_ns.get(i, now_ns) for i in self._around.ids}

    def in_the_way(
        self, lost: Iterable[RobotView], now_ns: int | None = None, room_m: float | None = None, things: bool = True
    ) -> Array:
        """Things (if `things`; with `now_ns`: that have lain there for a while), and robots that are out: they lie where they
        were last seen, and as robots keep a growing bubble around one that is silent, plans leave room for it."""
        safety = self._experiment.safety
        wide_m = safety.radius_m + (safety.bubble_max_m if room_m is None else room_m)
        robots = [(*robot.eta[:2], wide_m) for robot in lost if robot.pose or robot.state]
        return np.vstack([self._things(now_ns) if things else NOTHING, np.array(robots).reshape(-1, 3)])

    def contact(self, leg: Leg, reached_s: float, lost: Iterable[RobotView], now_ns: int | None) -> str:
        """Where robots, `reached_s` along a leg, would touch something; empty if nowhere, or if the path is not to be changed
        for it. In formation a path is changed under way, if it can be. On ways of their own robots come to rest for another
        way, and robots that are out always count: they were to be gone when the others come by."""
        detours, apart = self._experiment.mission.detours, leg.apart(reached_s)
        if not apart and not (detours and can_detour(self._experiment)):
            return ""
        things = self.in_the_way(lost, now_ns, room_m=0.0, things=detours)
        return first_contact(self._experiment, leg, reached_s, reached_s + AHEAD_S, things)

    def _things(self, now_ns: int | None) -> Array:
        sure = [now_ns is None or now_ns - self._since_ns.get(i, now_ns) >= SURE_S * 1e9 for i in self._around.ids]
        return self._around.things[np.array(sure, dtype=bool)] if self._around.ids else NOTHING
