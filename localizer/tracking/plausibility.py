"""Plausibility of markers and boards: a marker's place, its double, its size, a board's attitude beside the hull's. Pure."""

import math
from collections import deque
from collections.abc import Sequence

import numpy as np

from localizer.camera_model import RefractiveCamera
from localizer.detection.image_regions import in_polygons
from localizer.tracking.tilt import Attitude
from shoal.config.experiment import Experiment
from shoal.frames import Array

TWIN_APART_RADII = 2.0  # of the hull: nearer readings are of one plate, or of its reflection
TWIN_HERE_RADII = 1.0  # of the hull: so near is the same place; a robot moves by a tenth of it from picture to picture
TWIN_KEPT_FRAMES = 12  # in which a picture is searched twice, strip by strip
TWIN_PICTURES = 2  # pictures, or turns of strips, that show it
TWIN_TOLD_FRAMES = 60  # for which it counts once it was seen: two searches of the picture while no robot is lost

SIZE_READINGS = 40  # readings before a size is told, and in which it is averaged: 2 s at 20 Hz
SIZE_ROBOTS = 3  # robots from which on one can be told from the rest
SIZE_APART = 0.015  # from the median of the robots; theirs differ by 0.3 % when all is right
SIZE_WRONG = 0.04  # from the size that is expected; blur, and a focal length that is wrong by 1 %, stay below
STRANGE_SIZE_FRAMES = 20  # for which a marker of another size is told after it was read

ATTITUDE_READINGS = 15  # readings before a board is blamed, and over which differences are averaged
ATTITUDE_APART_RAD = math.radians(2.0)  # RMS difference of roll and pitch together; readings of a right board leave 0.5 deg


class BasinGate:
    """The part of the picture and of the pool in which a robot can be: a pose outside it is none.

    A marker on the deck, one that a person carries, or a reflection in the wall reads like a robot's. The gate lets through
    what lies within the pool's outline and `localizer.basin_margin_m` around it, and in none of the masks
    (`camera.masks_px`).
    """

    def __init__(self, experiment: Experiment) -> None:
        self._half_m = np.array(experiment.pool.size_m[:2]) / 2.0 + experiment.localizer.basin_margin_m
        self._masks_px = experiment.camera.masks_px

    def inside(self, position_m: Array) -> bool:
        """True if a robot can be at x, y (2,) of the pool."""
        return bool(np.all(np.abs(position_m) <= self._half_m))

    def admits(self, view: RefractiveCamera, position_m: Array, depth_m: float) -> bool:
        """True if what was seen at x, y (2,), at a depth, can be a robot."""
        if not self.inside(position_m):
            return False
        return not self._masks_px or not in_polygons(view.pool_to_pixel(np.append(position_m, depth_m)), self._masks_px)


class TwinMarkers:
    """Robots whose marker is in view twice: two robots that wear one id, or a spare plate in the water.

    One picture that shows an id at two places says so, and so do three pictures in a row that show it here, there and here
    again, as when the picture is searched in strips. A marker that has only moved, because plates were exchanged, is never
    here again.
    """

    def __init__(self, radius_m: float) -> None:
        self._apart_m, self._here_m = TWIN_APART_RADII * radius_m, TWIN_HERE_RADII * radius_m
        self._sights: dict[int, deque[tuple[int, Array]]] = {}  # robot -> frame, [x, y]
        self._frames: dict[int, deque[int]] = {}  # robot -> last two frames in which its marker was in view twice

    def note(self, robot: int, poses: Sequence[Array], frame: int) -> None:
        """Note all places [x, y, ...] at which a robot's marker was read in a frame."""
        sights = self._sights.setdefault(robot, deque())
        while sights and frame - sights[0][0] > TWIN_KEPT_FRAMES:
            sights.popleft()
        for pose in poses:
            place = np.array(pose[:2])
            frames = self._frames.setdefault(robot, deque(maxlen=TWIN_PICTURES))
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
        return frames is not None and len(frames) == TWIN_PICTURES and frame - frames[0] <= TWIN_TOLD_FRAMES

    def are_apart(self, poses: Sequence[Array]) -> bool:
        """True if poses [x, y, ...] of one picture cannot be of one plate."""
        places = np.array([pose[:2] for pose in poses])
        return len(places) > 1 and bool(np.linalg.norm(places - places[0], axis=1).max() > self._apart_m)

    def twins(self, frame: int) -> list[int]:
        """The robots whose marker was in view twice of late."""
        return [robot for robot in sorted(self._frames) if self.is_twin(robot, frame)]


class MarkerSizes:
    """Mean sizes of each robot's marker over those expected at its reported depth, by index.

    A depth that is wrong by 10 cm makes a marker 2.5 % too large or too small under a camera 3 m above, and moves poses by
    centimetres; so does a marker that was not printed at true scale. One reading tells the size to 0.3 %, but blur makes all
    markers of a picture some 1 % smaller. So a robot is first held against the others.
    """

    def __init__(self, count: int) -> None:
        self._means, self._readings = np.ones(count), np.zeros(count, dtype=int)
        self._strange: dict[int, tuple[int, float]] = {}  # robot -> frame and size of a marker that was refused for its size

    def note(self, robot: int, size: float) -> None:
        """Take up a reading's size over the expected one."""
        self._readings[robot] += 1
        self._means[robot] += (size - self._means[robot]) / min(int(self._readings[robot]), SIZE_READINGS)

    def note_strange(self, robot: int, size: float, frame: int) -> None:
        """Take up a marker that is too large or too small to be believed."""
        self._strange[robot] = frame, size

    def in_words(self, ids: Sequence[int], frame: int) -> list[str]:
        """Name the robots whose markers have a wrong size, for people."""
        is_known, notes = self._readings >= SIZE_READINGS, list[str]()
        middle = np.median(self._means[is_known]) if np.sum(is_known) >= SIZE_ROBOTS else None
        for i, robot in enumerate(ids):
            off = float(self._means[i] - 1.0)
            if middle is not None and abs(off) <= SIZE_WRONG:
                off = float(self._means[i] - middle)
            if is_known[i] and abs(off) > (SIZE_WRONG if middle is None else SIZE_APART):
                notes.append(
                    f"{_percent(off)} for its depth: is the depth right, was its marker printed at 100 %: robot {robot}"
                )
            elif i in self._strange and frame - self._strange[i][0] <= STRANGE_SIZE_FRAMES:
                notes.append(f"{_percent(self._strange[i][1] - 1.0)}, and is not believed: robot {robot}")
        return [f"marker looks {text}" for text in notes]


def _percent(off: float) -> str:
    return f"{abs(off):.1%} too {'large' if off > 0 else 'small'}"


class AttitudeCheck:
    """Mean square differences of each robot's attitude, as its board reports it, from the lean of its hull, by index.

    A board that is mounted askew, or with the signs or axes of roll and pitch confused, moves its robot's poses by
    centimetres, with a claim of millimetres. One reading of an outline is good to half a degree; what lasts is the board.
    """

    def __init__(self, count: int) -> None:
        self._squares_rad2, self._readings = np.zeros(count), np.zeros(count, dtype=int)

    def note(self, robot: int, reported: Attitude, lean: Attitude) -> None:
        """Take up what a robot's board reports and its hull shows in one picture."""
        apart = math.hypot(reported.roll_rad - lean.roll_rad, reported.pitch_rad - lean.pitch_rad)
        self._readings[robot] += 1
        self._squares_rad2[robot] += (apart**2 - self._squares_rad2[robot]) / min(
            int(self._readings[robot]), ATTITUDE_READINGS
        )

    def in_words(self, ids: Sequence[int]) -> list[str]:
        """Name the boards that are wrong, and by how much, for people."""
        apart_rad = np.sqrt(self._squares_rad2)
        wrong = [i for i in range(len(ids)) if self._readings[i] >= ATTITUDE_READINGS and apart_rad[i] > ATTITUDE_APART_RAD]
        return [
            f"board reports roll and pitch {np.degrees(apart_rad[i]):.1f} deg from what the hull shows (is it level, and "
            f"turned as the vehicle's file says?): robot {ids[i]}"
            for i in wrong
        ]
