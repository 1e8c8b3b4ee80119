"""Robots whose marker is in view twice: two robots that wear one id, or a spare plate in the water. Pure.

One picture that shows an id at two places says so, and so do three pictures in a row that show it here, there and here again,
as when the picture is searched in strips. A marker that has only moved, because plates were exchanged, is never here again.
"""

from collections import deque
from collections.abc import Sequence

import numpy as np

from shoal.frames import Array

_APART_RADII = 2.0  # of the hull: nearer readings are of one plate, or of its reflection
_HERE_RADII = 1.0  # of the hull: so near is the same place; a robot moves by a tenth of it from picture to picture
_KEPT_FRAMES = 12  # in which a picture is searched twice, strip by strip
_NEEDED = 2  # pictures, or turns of strips, that show it
_TOLD_FRAMES = 60  # for which it counts once it was seen: two searches of the picture while no robot is lost


class TwinMarkers:
    """The places at which each robot's marker was read of late."""

    def __init__(self, radius_m: float) -> None:
        self._apart_m, self._here_m = _APART_RADII * radius_m, _HERE_RADII * radius_m
        self._sights: dict[int, deque[tuple[int, Array]]] = {}  # robot -> frame, [x, y]
        self._frames: dict[int, deque[int]] = {}  # robot -> last two frames in which its marker was in view twice

    def note(self, robot: int, poses: Sequence[Array], frame: int) -> None:
        """Note all places [x, y, ...] at which a robot's marker was read in a frame."""
        sights = self._sights.setdefault(robot, deque())
        while sights and frame - sights[0][0] > _KEPT_FRAMES:
            sights.popleft()
        for pose in poses:
            place = np.array(pose[:2])
            frames = self._frames.setdefault(robot, deque(maxlen=_NEEDED))
            if self._is_second(sights, place, frame) and frame not in frames:
                frames.append(frame)
            sights.append((frame, place))

    def _is_second(self, sights: Sequence[tuple[int, Array]], place: Array, frame: int) -> bool:
        """True if an earlier sight is elsewhere, and of this frame, or between this place and an earlier sight of it."""
        here_since: int | None = None
        for at, other in sights:
            away_m = float(np.linalg.norm(other - place))
            if away_m > self._apart_m and (at == frame or here_since is not None):
                return True
            if away_m < self._here_m and here_since is None:
                here_since = at
        return False

    def is_twin(self, robot: int, frame: int) -> bool:
        """True if a robot's marker was in view twice of late, in more than one picture: a misread marker is in one."""
        frames = self._frames.get(robot)
        return frames is not None and len(frames) == _NEEDED and frame - frames[0] <= _TOLD_FRAMES

    def are_apart(self, poses: Sequence[Array]) -> bool:
        """True if poses [x, y, ...] of one picture cannot be of one plate."""
        places = np.array([pose[:2] for pose in poses])
        return len(places) > 1 and bool(np.linalg.norm(places - places[0], axis=1).max() > self._apart_m)

    def twins(self, frame: int) -> list[int]:
        """The robots whose marker was in view twice of late."""
        return [robot for robot in sorted(self._frames) if self.is_twin(robot, frame)]
