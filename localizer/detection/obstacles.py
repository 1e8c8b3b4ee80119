"""What is in the pool and is no robot: people's arms, poles, things adrift. Pure.

    frame -> cells -> how far each is from its usual look (background_model.py) -> robots and their shadows left out -> regions
    above a size -> followed from look to look -> those that persist, with outline and velocity

A camera alone cannot tell how deep a thing is: outlines are given at the depth of the robots' path, where it would be in their
way. What was there from the start is background. What comes later and lies still stays an obstacle for as long as it is seen.

When most of the picture changes at once, the light has changed or the camera has moved, and everything has to be learned anew.
Until that is done the watch says that it is blind. What it had followed for 2 s by then it goes on telling, with the time for
which it was not seen, until it sees something there again: what lies still meanwhile is learned as water.

Measured in the simulated pool, two robots moving, water whose loop of 24 s is longer than the background's memory: no false
alarm in five minutes of strong glare, caustics and ripples, none in five minutes of the pool scene's water (five seeds, one
minute each). A red ball, a grey box and a black pole show up after 0.5 s; intersection over union 0.84, 0.70, 0.62, velocities
within 0.01 m/s (medians).
"""

import cv2
import numpy as np
from numpy.typing import NDArray

from localizer.camera_model import PoolView
from localizer.detection.background_model import LAG_S, Background, Calm, Mask, Planes, Reduction
from localizer.detection.blob_tracker import CORNERS, Region, Thing, ThingTracker, convex_outline
from localizer.detection.image_regions import Pixels
from wire.config.experiment import Experiment
from wire.frames import Array
from wire.messages.messages import Obstacles
from wire.obstacle_memory import drift_m, growth_m

_LOOK_S = 0.1  # between looks: 1 cm at walking pace under water, and half the frames cost nothing
_LEARN_EVERY = 2  # looks: nearer ones tell nothing new, as the picture is averaged over time
_LONGEST_STEP_S = 0.3  # a gap in the pictures counts as one of this length
_FOREGROUND = 4.5  # distance of a cell's colour from its usual one: background_model.py says what water reaches
_EDGE = 0.5  # of the strongest cell nearby: half covered
_EDGE_REACH = np.ones((5, 5), np.uint8)  # cells: a sharp edge is three wide after averaging, and its flank is one more
_GAP = np.ones((3, 3), np.uint8)  # cells: caustics may cut a thing in two for a moment
_SURE_S = 2.0  # for so long a thing must have been followed to be kept when everything has to be learned anew
_SAME_M = 0.1  # a thing that is found this near to where one that was lost may be is that one
_LEAST_M = 0.01  # whatever the experiment asks for: nothing smaller can be told from noise
_FLOODED = 0.35  # share of the watched cells: more is the light that changed, or the camera that moved
_JUDGED = 0.5  # share of the pool's cells: with less of them watched nobody can tell what lies in the pool
_LEARNS = "the localizer learns what the water looks like"
_CHANGED = "the light changed or the camera moved, and the localizer learns anew what the water looks like"
_HIDDEN = "too little of the pool is in sight"

_ROBOT_MARGIN_M = 0.06  # around a robot: its legs, half a cell's reach, and the averaging over neighbours
_LAMP_SLOPE = 0.6  # a robot's shadow lies up to so far aside, per metre of water below it (31 degrees)
_ANGLES = np.linspace(0.0, 2.0 * np.pi, 24, endpoint=False)
_RING = np.column_stack([np.cos(_ANGLES), np.sin(_ANGLES)])
_FRACTION_BITS = 4  # OpenCV draws in 16ths of a cell


class ObstacleWatch:
    """`step` once per frame, in order, with robots where the localizer sees them."""

    def __init__(self, experiment: Experiment) -> None:
        self._view = PoolView(experiment.camera)
        self._shape_px = experiment.camera.size_px[::-1]
        self._reduction = Reduction(experiment.camera.size_px)
        self._depth_m, self._safety = experiment.path.depth_m, experiment.safety
        self._floor_m = experiment.pool.size_m[2]
        self._radius_m = experiment.vehicle.radius_m
        self._least_m2 = max(experiment.localizer.obstacle_min_m, _LEAST_M) ** 2
        self._corners_m, self._cell_m2, self._in_pool = self._lie_of_the_cells(experiment.pool.size_m)
        shape = (self._reduction.rows, self._reduction.columns)
        self._calm, self._background = Calm(shape), Background(shape)
        self._shaded_from_start = np.zeros(shape, np.bool_)  # learnt where a robot may have cast its shadow all the time
        self._tracker = ThingTracker()
        self._unseen: tuple[Thing, ...] = ()  # there when everything had to be learned anew, and not found again
        self._why = _LEARNS  # if it is blind
        self._looks = 0
        self._stamp_ns: int | None = None

    def step(self, frame: Pixels, stamp_ns: int, robots_m: Array) -> Obstacles | None:
        """Obstacles in `frame` (height, width) Bayer RGGB, exposed at `stamp_ns`; None if this frame was not looked at.

        `robots_m` (n, 3) are the places of the robots' centres. A robot that is left out, because nobody knows where it is,
        is an obstacle like any other.
        """
        if frame.shape != self._shape_px:
            return None
        elapsed_s = _LOOK_S if self._stamp_ns is None else (stamp_ns - self._stamp_ns) * 1e-9
        if 0.0 <= elapsed_s < 0.9 * _LOOK_S:
            return None
        if elapsed_s < 0.0:
            self._tracker.clear()  # time was set anew; nothing can be said of what moved how far
            self._unseen = ()
        self._stamp_ns = stamp_ns
        self._looks += 1
        step_s = min(abs(elapsed_s), _LONGEST_STEP_S)
        hidden, shaded = self._robots(robots_m)
        colours, steady = self._calm.take(self._reduction.colours(frame), hidden, step_s)
        distance = self._background.distance(colours, shaded)
        watched = self._in_pool & self._background.known & steady
        foreground = self._foreground(distance, watched)
        if np.count_nonzero(foreground) > _FLOODED * np.count_nonzero(watched):
            self._background.forget(np.ones_like(watched))
            self._unseen, self._why = (*self._unseen, *self._followed_long(stamp_ns)), _CHANGED
            self._tracker.clear()
            watched, foreground = np.zeros_like(watched), np.zeros_like(foreground)
        self._tracker.take(self._regions(foreground), stamp_ns)
        self._unseen = tuple(thing for thing in self._unseen if not self._is_back(thing, stamp_ns))
        if self._looks % _LEARN_EVERY == 0:
            self._learn(colours, distance, hidden, shaded, step_s * _LEARN_EVERY)
        share = int(np.count_nonzero(watched)) / max(int(np.count_nonzero(self._in_pool)), 1)
        self._why = _HIDDEN if share >= _JUDGED else self._why
        return self._message(share, stamp_ns)

    # --- in the order of `step`

    def _robots(self, robots_m: Array) -> tuple[Mask, Mask]:
        """Cells that may show a robot, and cells on whose floor its shadow may lie: the lamps are anywhere above."""
        hidden, shaded = (np.zeros(self._in_pool.shape, np.uint8) for _ in range(2))
        if len(robots_m):
            reach = self._radius_m + _ROBOT_MARGIN_M
            shade = reach + _LAMP_SLOPE * np.maximum(self._floor_m - robots_m[:, 2], 0.0)
            places = np.repeat(robots_m[:, None, None, :], 2, axis=1).repeat(len(_RING), axis=2)  # (n, 2, ring, 3)
            places[:, 0, :, :2] += reach * _RING
            places[:, 1, :, :2] += shade[:, None, None] * _RING
            places[:, 1, :, 2] = self._floor_m
            cells = (self._view.pixel(places) + 0.5) / self._reduction.cell_px - 0.5
            fixed = np.rint(np.clip(cells, -1e3, 1e3) * 2**_FRACTION_BITS).astype(np.int32)
            for robot, shadow in fixed:
                cv2.fillConvexPoly(hidden, robot, 1, shift=_FRACTION_BITS)
                cv2.fillConvexPoly(shaded, shadow, 1, shift=_FRACTION_BITS)
        return hidden.astype(np.bool_), shaded.astype(np.bool_)

    def _foreground(self, distance: Planes, watched: Mask) -> NDArray[np.uint8]:
        """Cells at least half covered by something else than water."""
        clear = distance * watched
        peak = cv2.dilate(clear, _EDGE_REACH)
        found = ((clear > _FOREGROUND) & (clear >= np.float32(_EDGE) * peak)).astype(np.uint8)
        return np.asarray(cv2.morphologyEx(found, cv2.MORPH_CLOSE, _GAP), dtype=np.uint8)

    def _regions(self, foreground: NDArray[np.uint8]) -> list[Region]:
        """Connected cells that cover enough of the pool, the largest first."""
        count, labels = cv2.connectedComponents(foreground)
        areas = np.bincount(labels.ravel(), self._cell_m2.ravel(), count)
        areas[0] = 0.0  # water
        largest_first = np.argsort(-areas, kind="stable")
        return [self._region(np.asarray(labels == label)) for label in largest_first if areas[label] >= self._least_m2]

    def _region(self, cells: Mask) -> Region:
        row, column = np.nonzero(cells)
        around = np.stack([self._corners_m[row + i, column + j] for i in (0, 1) for j in (0, 1)])  # (4, cells, 2)
        weight = self._cell_m2[row, column]
        return Region(cells, weight @ around.mean(axis=0) / weight.sum(), convex_outline(around.reshape(-1, 2)))

    def _learn(self, colours: Planes, distance: Planes, hidden: Mask, shaded: Mask, step_s: float) -> None:
        """Take in the water, not what is in it, and not the shadow of a robot that passes over water known before.

        Around a robot that has been there from the start there is nothing better to learn than its shadow; when it leaves,
        that is forgotten.
        """
        known = self._background.known
        stale = (self._shaded_from_start & ~shaded) | (hidden & ~known)
        self._shaded_from_start = shaded & (self._shaded_from_start | ~known)
        clear = ~hidden & (~shaded | self._shaded_from_start)
        followed = np.zeros(clear.shape, np.uint8)
        for thing in self._tracker.things:
            followed |= thing.region.cells
        clear &= cv2.dilate(followed, _EDGE_REACH) == 0
        self._background.forget(stale)
        self._background.learn(colours, distance, clear, step_s)

    @property
    def _numbered(self) -> tuple[Thing, ...]:
        """What has persisted."""
        return tuple(thing for thing in self._tracker.things if thing.id)

    def _followed_long(self, stamp_ns: int) -> tuple[Thing, ...]:
        """What was surely there before the light began to change: a lamp takes some time to come up."""
        return tuple(thing for thing in self._numbered if stamp_ns - thing.since_ns >= _SURE_S * 1e9)

    def _is_back(self, unseen: Thing, stamp_ns: int) -> bool:
        """Whether something that is followed now may be a thing that was there before everything was learned anew."""
        drift = drift_m(self._safety, unseen.velocity_mps, unseen.unseen_s(stamp_ns))
        reach_m = 0.5 * float(np.hypot(*drift)) + growth_m(self._safety, unseen.unseen_s(stamp_ns)) + _SAME_M
        middle = unseen.middles_m[-1] + 0.5 * drift
        return any(float(np.hypot(*(thing.middles_m[-1] - middle))) <= reach_m for thing in self._numbered)

    def _message(self, watched: float, stamp_ns: int) -> Obstacles:
        """What has persisted, and what was there before. Averaging over time shows moving things where they were a moment
        ago."""
        seen = self._numbered
        shown = [*seen, *self._unseen]
        return Obstacles(
            ids=tuple(thing.id for thing in shown),
            outline=np.array([thing.region.outline_m + LAG_S * thing.velocity_mps for thing in shown]).reshape(-1, CORNERS, 2),
            velocity=np.array([thing.velocity_mps for thing in shown]).reshape(-1, 2),
            depth_m=self._depth_m,
            watched=watched,
            blind="" if watched >= _JUDGED else self._why,
            unseen_s=np.array([0.0] * len(seen) + [thing.unseen_s(stamp_ns) for thing in self._unseen]),
        )

    # --- at the start

    def _lie_of_the_cells(self, size_m: tuple[float, float, float]) -> tuple[Array, Array, Mask]:
        """Corners (rows + 1, columns + 1, 2) and areas of the cells at the assumed depth, and which lie in the pool there."""
        rows, columns, step = self._reduction.rows, self._reduction.columns, self._reduction.cell_px
        row, column = np.mgrid[: rows + 1, : columns + 1]
        corners = self._view.pool(np.stack([column, row], axis=-1) * step - 0.5, self._depth_m)
        diagonal, other = corners[1:, 1:] - corners[:-1, :-1], corners[1:, :-1] - corners[:-1, 1:]
        area = 0.5 * np.abs(diagonal[..., 0] * other[..., 1] - diagonal[..., 1] * other[..., 0])
        inside = np.all(np.abs(corners) < np.array(size_m[:2]) / 2.0, axis=-1)
        return corners, area, inside[:-1, :-1] & inside[1:, 1:] & inside[1:, :-1] & inside[:-1, 1:]
