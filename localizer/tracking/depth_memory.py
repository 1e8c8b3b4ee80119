"""The depth of each robot: as it reported last, less certain with each second since, or as the experiment starts it. Pure.

The localizer's process and the commands that work on recordings use the same: robots that report now and then, are silent for
a while or never report.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from shoal.config.experiment import Experiment

ASSUMED_SIGMA_M = 0.05  # m, of the experiment's depth, for a robot that has never reported one
_SHALLOWEST_M = -0.2  # m, least depth that is believed: a robot lying on the surface
_SINKING_MPS = 0.05  # m/s, standard deviation of a robot's vertical speed while it is silent: half its speed up and down
_MOST_SIGMA_M = 0.3  # m; robots stay in the upper metre of most pools


@dataclass(frozen=True)
class KnownDepth:
    """Depth of a robot's centre, and its standard deviation."""

    centre_m: float
    sigma_m: float


class DepthMemory:
    """The last known depths of the robots of an experiment."""

    def __init__(self, experiment: Experiment, start_m: Sequence[float]) -> None:
        """`start_m`: depths at the start, in the experiment's order."""
        self._start_m = dict(zip(experiment.robot_ids, start_m, strict=True))
        self._deepest_m, self._sigma_m = experiment.pool.size_m[2], experiment.localizer.depth_sigma_m
        self._last: dict[int, tuple[float, int]] = {}  # depth, and the stamp for which it was reported

    def update(self, reported_m: Mapping[int, float], stamp_ns: int) -> dict[int, KnownDepth]:
        """Take up what robots (by id) reported for an exposure; returns the depths of all robots then."""
        for robot, depth_m in reported_m.items():
            if _SHALLOWEST_M <= depth_m <= self._deepest_m:
                self._last[robot] = (depth_m, stamp_ns)
        return {robot: self._known_depth(robot, stamp_ns) for robot in self._start_m}

    def _known_depth(self, robot: int, stamp_ns: int) -> KnownDepth:
        """The depth that was last reported. Its uncertainty grows with the time since then."""
        if robot not in self._last:
            return KnownDepth(float(self._start_m[robot]), max(self._sigma_m, ASSUMED_SIGMA_M))
        depth_m, reported_ns = self._last[robot]
        silent_s = max(stamp_ns - reported_ns, 0) * 1e-9
        if silent_s == 0.0:
            return KnownDepth(depth_m, self._sigma_m)
        return KnownDepth(
            depth_m, min(float(np.hypot(self._sigma_m, _SINKING_MPS * silent_s)), max(_MOST_SIGMA_M, self._sigma_m))
        )
