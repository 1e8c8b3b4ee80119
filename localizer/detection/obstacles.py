"""Obstacle detection: what is in the pool and is no robot (arms, poles, drifting objects). Pure.

    frame -> cells -> distance from the background (background_model.py) -> robots and their shadows masked -> connected
    blobs above a size -> tracked over time (blob_tracker.py) -> blobs that persist, with outline and velocity

One camera cannot tell an obstacle's depth. Outlines are given at the depth of the robots' path, where the obstacle would be
in their way. Objects that were there from the start are background. An object that comes later and lies still remains an
obstacle for as long as it is seen.

When most of the picture changes at once, the light has changed or the camera has moved, and the background is learnt anew.
Until that is done the detector reports that it is blind. It goes on reporting obstacles that it had followed for 2 s,
with the time for which they were not seen, until it finds one there again: an object that lies still meanwhile is learnt as
water.

Measured in the simulated pool, two robots moving, water that never repeats: no false alarm in five minutes of strong glare,
caustics and ripples, none in five minutes of the pool scene's water (five seeds, one minute each). A red ball, a grey box and
a black pole are reported after 0.5 s; intersection over union 0.84, 0.70, 0.62, velocities within 0.01 m/s (medians).
"""

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from localizer.camera_model import RefractiveCamera
from localizer.detection.background_model import LAG_S, BackgroundModel, CellGrid, Mask, Planes, TemporalSmoother
from localizer.detection.blob_tracker import CORNERS, Blob, BlobTracker, TrackedBlob, convex_outline
from localizer.detection.image_regions import Pixels
from shoal.config.experiment import Experiment
from shoal.frames import Array
from shoal.messages.messages import Obstacles
from shoal.messages.obstacle_memory import drift_m, growth_m

_PERIOD_S = 0.1  # s between examined frames: 1 cm at walking pace under water; the frames between cost nothing
_LEARN_EVERY = 2  # examined frames; nearer ones are correlated, as the picture is averaged over time
_LONGEST_STEP_S = 0.3  # s; a longer gap between frames counts as this long
_FOREGROUND = 4.5  # Mahalanobis distance of a cell's colour; background_model.py gives what water reaches
_EDGE = 0.5  # of the largest distance nearby: the edge lies where a cell is half covered
_EDGE_REACH = np.ones((5, 5), np.uint8)  # cells: a sharp edge is three wide after averaging, and its flank is one more
_GAP = np.ones((3, 3), np.uint8)  # cells; closes gaps that caustics cut into an obstacle
_SURE_S = 2.0  # s for which a blob must have been followed to be remembered when the background is learnt anew
_SAME_M = 0.1  # m; a blob found this near to where a remembered one may be is the same
_LEAST_M = 0.01  # m, lower limit of localizer.obstacle_min_m: smaller objects cannot be told from noise
_FLOODED = 0.35  # share of the watched cells; more foreground is a change of light, or a camera that moved
_JUDGED = 0.5  # share of the pool's cells; with fewer of them watched the detector is blind
_LEARNS = "the localizer learns what the water looks like"
_CHANGED = "the light changed or the camera moved, and the localizer learns anew what the water looks like"
_HIDDEN = "too little of the pool is in sight"
_FAILED = "the obstacle watch failed, and the localizer learns anew what the water looks like"

_LEGS_M = 0.025  # m, reach of a robot's legs and trim beyond its hull
_CELLS_AROUND = 1.5  # cells around a robot that show part of it: half a cell's reach, and the averaging over neighbours
_LAMP_SLOPE = 0.6  # m sideways per metre of water below a robot, the farthest that its shadow lies aside (31 degrees)
_ANGLES = np.linspace(0.0, 2.0 * np.pi, 24, endpoint=False)
_RING = np.column_stack([np.cos(_ANGLES), np.sin(_ANGLES)])
_FRACTION_BITS = 4  # OpenCV draws in 16ths of a cell


class ObstacleDetector:
    """The detector of one camera: call `step` once per frame, in order, with the robots that the localizer sees."""

    def __init__(self, experiment: Experiment) -> None:
        self._experiment, self._view = experiment, RefractiveCamera(experiment.camera)
        self._shape_px = experiment.camera.size_px[::-1]
        self._grid = CellGrid(experiment.camera.size_px)
        self._depth_m, self._safety = experiment.path.depth_m, experiment.safety
        self._floor_m = experiment.pool.size_m[2]
        self._least_m2 = max(experiment.localizer.obstacle_min_m, _LEAST_M) ** 2
        self._corners_m, self._cell_m2, self._in_pool = self._cell_geometry(experiment.pool.size_m)
        self._in_pool &= ~self._masked(experiment.camera.masks_px)
        cell_m = float(np.sqrt(self._cell_m2[self._in_pool].mean())) if self._in_pool.any() else 0.0
        self._robot_reach_m = experiment.vehicle.radius_m + _LEGS_M + _CELLS_AROUND * cell_m
        shape = (self._grid.rows, self._grid.columns)
        self._smoother, self._background = TemporalSmoother(shape), BackgroundModel(shape)
        self._shaded_from_start = np.zeros(shape, np.bool_)  # learnt while a shadow may have lain there
        self._tracker = BlobTracker()
        self._remembered: tuple[TrackedBlob, ...] = ()  # blobs from before the background was learnt anew
        self._blind_reason = _LEARNS
        self._steps = 0
        self._stamp_ns: int | None = None

    def step(self, frame: Pixels, stamp_ns: int, robots_m: Array) -> Obstacles | None:
        """Obstacles in `frame` (height, width) Bayer RGGB, exposed at `stamp_ns`; None if this frame was not examined.

        `robots_m` (n, 3) are the positions of the robots' centres. A robot that is missing there is an obstacle like any
        other.
        """
        if frame.shape != self._shape_px:
            return None
        elapsed_s = _PERIOD_S if self._stamp_ns is None else (stamp_ns - self._stamp_ns) * 1e-9
        if 0.0 <= elapsed_s < 0.9 * _PERIOD_S:
            return None
        if elapsed_s < 0.0:
            self._tracker.clear()  # the clock was set back: displacements have no known duration
            self._remembered = ()
        self._stamp_ns = stamp_ns
        self._steps += 1
        step_s = min(abs(elapsed_s), _LONGEST_STEP_S)
        hidden, shaded = self._robots(robots_m)
        colours, steady = self._smoother.update(self._grid.colours(frame), hidden, step_s)
        distance = self._background.distance(colours, shaded)
        watched = self._in_pool & self._background.is_known & steady
        foreground = self._foreground(distance, watched)
        if np.count_nonzero(foreground) > _FLOODED * np.count_nonzero(watched):
            self._background.forget(np.ones_like(watched))
            self._remembered, self._blind_reason = (*self._remembered, *self._long_followed(stamp_ns)), _CHANGED
            self._tracker.clear()
            watched, foreground = np.zeros_like(watched), np.zeros_like(foreground)
        self._tracker.update(self._regions(foreground), stamp_ns)
        self._remembered = tuple(blob for blob in self._remembered if not self._reappeared(blob))
        if self._steps % _LEARN_EVERY == 0:
            self._learn(colours, distance, hidden, shaded, step_s * _LEARN_EVERY)
        share = int(np.count_nonzero(watched)) / max(int(np.count_nonzero(self._in_pool)), 1)
        self._blind_reason = _HIDDEN if share >= _JUDGED else self._blind_reason
        return self._message(share, stamp_ns)

    def begun_anew(self, stamp_ns: int) -> "tuple[ObstacleDetector, Obstacles]":
        """A new detector that learns the water again, after an error in this one; and its message: blind, with the obstacles
        that this one reported last."""
        detector = ObstacleDetector(self._experiment)
        detector._remembered, detector._blind_reason = (*self._remembered, *self._reported), _FAILED
        detector._tracker = self._tracker  # whose numbers go on
        detector._tracker.clear()
        return detector, detector._message(0.0, stamp_ns)

    # --- in the order of `step`

    def _robots(self, robots_m: Array) -> tuple[Mask, Mask]:
        """Masks of the cells that may show a robot, and of the cells where its shadow may lie on the floor, wherever the lamps
        hang."""
        hidden, shaded = (np.zeros(self._in_pool.shape, np.uint8) for _ in range(2))
        if len(robots_m):
            reach = self._robot_reach_m
            shade = reach + _LAMP_SLOPE * np.maximum(self._floor_m - robots_m[:, 2], 0.0)
            places = np.repeat(robots_m[:, None, None, :], 2, axis=1).repeat(len(_RING), axis=2)  # (n, 2, ring, 3)
            places[:, 0, :, :2] += reach * _RING
            places[:, 1, :, :2] += shade[:, None, None] * _RING
            places[:, 1, :, 2] = self._floor_m
            for robot_px, shadow_px in self._view.pool_to_pixel(places):
                self._fill(hidden, robot_px)
                self._fill(shaded, shadow_px)
        return hidden.astype(np.bool_), shaded.astype(np.bool_)

    def _fill(self, mask: NDArray[np.uint8], corners_px: Array) -> None:
        """Fill a convex polygon, without its corners behind the lens, which are NaN."""
        before = corners_px[~np.isnan(corners_px[:, 0])]
        if len(before) > 2:
            cv2.fillConvexPoly(mask, self._in_cells(before), 1, shift=_FRACTION_BITS)

    def _foreground(self, distance: Planes, watched: Mask) -> NDArray[np.uint8]:
        """Mask of the cells that are at least half covered by an object."""
        clear = distance * watched
        if not clear.max() > _FOREGROUND:  # bare water
            return np.zeros(clear.shape, np.uint8)
        peak = cv2.dilate(clear, _EDGE_REACH)
        foreground = ((clear > _FOREGROUND) & (clear >= np.float32(_EDGE) * peak)).astype(np.uint8)
        return np.asarray(cv2.morphologyEx(foreground, cv2.MORPH_CLOSE, _GAP), dtype=np.uint8)

    def _regions(self, foreground: NDArray[np.uint8]) -> list[Blob]:
        """Connected cells that cover enough of the pool, the largest first."""
        if not foreground.any():
            return []
        count, labels = cv2.connectedComponents(foreground)
        areas = np.bincount(labels.ravel(), self._cell_m2.ravel(), count)
        areas[0] = 0.0  # water
        largest_first = np.argsort(-areas, kind="stable")
        return [self._region(np.asarray(labels == label)) for label in largest_first if areas[label] >= self._least_m2]

    def _region(self, cells: Mask) -> Blob:
        """A region of grid cells as a blob: its centre of area and convex outline, in the pool."""
        row, column = np.nonzero(cells)
        around = np.stack([self._corners_m[row + i, column + j] for i in (0, 1) for j in (0, 1)])  # (4, cells, 2)
        weight = self._cell_m2[row, column]
        return Blob(cells, weight @ around.mean(axis=0) / weight.sum(), convex_outline(around.reshape(-1, 2)))

    def _learn(self, colours: Planes, distance: Planes, hidden: Mask, shaded: Mask, step_s: float) -> None:
        """Learn the water: not the obstacles, and not the shadow of a robot that passes over known water.

        Around a robot that was there from the start only its shadow can be learnt; it is forgotten when the robot leaves.
        """
        known_water = self._background.is_known
        stale = (self._shaded_from_start & ~shaded) | (hidden & ~known_water)
        self._shaded_from_start = shaded & (self._shaded_from_start | ~known_water)
        clear = ~hidden & (~shaded | self._shaded_from_start)
        if self._tracker.blobs:
            followed = np.zeros(clear.shape, np.uint8)
            for blob in self._tracker.blobs:
                followed |= blob.region.cells
            clear &= cv2.dilate(followed, _EDGE_REACH) == 0
        self._background.forget(stale)
        self._background.learn(colours, distance, clear, step_s)

    @property
    def _reported(self) -> tuple[TrackedBlob, ...]:
        """The blobs that have persisted."""
        return tuple(blob for blob in self._tracker.blobs if blob.id)

    def _long_followed(self, stamp_ns: int) -> tuple[TrackedBlob, ...]:
        """The blobs that were there before the light began to change: a lamp takes some time to come up."""
        return tuple(blob for blob in self._reported if stamp_ns - blob.since_ns >= _SURE_S * 1e9)

    def _reappeared(self, unseen: TrackedBlob) -> bool:
        """True if a blob that is followed now may be `unseen`, which was there before the background was learnt anew: it was
        found where that may have been by then. One found elsewhere, which only passes, is another."""
        return any(self._may_be(unseen, blob.found_m, blob.since_ns) for blob in self._reported)

    def _may_be(self, unseen: TrackedBlob, place_m: Array, stamp_ns: int) -> bool:
        """True if a blob that is not seen any more may have been at a place (2,) at an instant."""
        drift = drift_m(self._safety, unseen.velocity_mps, unseen.unseen_s(stamp_ns))
        reach_m = 0.5 * float(np.hypot(*drift)) + growth_m(self._safety, unseen.unseen_s(stamp_ns)) + _SAME_M
        return float(np.hypot(*(place_m - unseen.centroids_m[-1] - 0.5 * drift))) <= reach_m

    def _message(self, watched: float, stamp_ns: int) -> Obstacles:
        """The blobs that have persisted and those that are remembered. Outlines are moved on by the lag of the temporal
        average."""
        visible_blobs = self._reported
        blobs = [*visible_blobs, *self._remembered]
        return Obstacles(
            ids=tuple(blob.id for blob in blobs),
            outline=np.array([blob.region.outline_m + LAG_S * blob.velocity_mps for blob in blobs]).reshape(-1, CORNERS, 2),
            velocity=np.array([blob.velocity_mps for blob in blobs]).reshape(-1, 2),
            depth_m=self._depth_m,
            watched=watched,
            blind="" if watched >= _JUDGED else self._blind_reason,
            unseen_s=np.array([0.0] * len(visible_blobs) + [blob.unseen_s(stamp_ns) for blob in self._remembered]),
        )

    # --- at the start

    def _masked(self, polygons_px: Sequence[Sequence[Sequence[float]]]) -> Mask:
        """Mask of the cells that a polygon of the picture touches."""
        masked = np.zeros((self._grid.rows, self._grid.columns), np.uint8)
        for polygon in polygons_px:
            cv2.fillPoly(masked, [self._in_cells(np.array(polygon))], 1, shift=_FRACTION_BITS)
        return masked.astype(np.bool_)

    def _in_cells(self, pixels: Array) -> NDArray[np.int32]:
        """Pixels (..., 2) in cells, as OpenCV's fixed-point numbers."""
        cells = (pixels + 0.5) / self._grid.cell_px - 0.5
        return np.asarray(np.rint(np.clip(cells, -1e3, 1e3) * 2**_FRACTION_BITS), dtype=np.int32)

    def _cell_geometry(self, size_m: tuple[float, float, float]) -> tuple[Array, Array, Mask]:
        """Corners (rows + 1, columns + 1, 2) and areas of the cells at the assumed depth, and a mask of those inside the
        pool."""
        rows, columns, step = self._grid.rows, self._grid.columns, self._grid.cell_px
        row, column = np.mgrid[: rows + 1, : columns + 1]
        corners = self._view.pixel_to_pool(np.stack([column, row], axis=-1) * step - 0.5, self._depth_m)
        diagonal, other = corners[1:, 1:] - corners[:-1, :-1], corners[1:, :-1] - corners[:-1, 1:]
        area = 0.5 * np.abs(diagonal[..., 0] * other[..., 1] - diagonal[..., 1] * other[..., 0])
        inside = np.all(np.abs(corners) < np.array(size_m[:2]) / 2.0, axis=-1)
        return corners, area, inside[:-1, :-1] & inside[1:, 1:] & inside[1:, :-1] & inside[:-1, 1:]
