"""Tracking of foreground blobs over time: a blob that persists gets a number, a velocity and an outline. Pure."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

from shoal.frames import Array

CORNERS = 12  # of every outline

_PERSISTS_S = 0.4  # s for which a blob must be followed before it is reported, and unseen before it is dropped
_MEMORY_S = 1.0  # s of positions that the velocity is fitted to
_REACH_M = 0.1  # m, gate around the expected centroid,
_REACH_MPS = 0.5  # m/s, and its growth while the blob is unseen
_FORBIDDEN_M = 1e3  # m, cost of an assignment outside the gate: more than any sum of allowed ones


@dataclass(frozen=True, eq=False)
class Blob:
    """Connected foreground: its cells (rows, columns), their centroid (2,) and convex outline (12, 2) in the pool."""

    cells: NDArray[np.bool_]
    centroid_m: Array
    outline_m: Array


@dataclass(frozen=True, eq=False)
class TrackedBlob:
    """A blob followed over time: stamps and centroids (n, 2) of its last observations, the newest last."""

    id: int  # 0 until it has persisted
    since_ns: int
    found_m: Array  # its centroid (2,) then
    region: Blob
    stamps_ns: tuple[int, ...]
    centroids_m: Array

    @property
    def velocity_mps(self) -> Array:
        """Slope of the least-squares line through the centroids of the last second, (2,)."""
        t = (np.array(self.stamps_ns) - self.stamps_ns[-1]) * 1e-9
        t = t - t.mean()
        spread = float(t @ t)
        return np.asarray(t @ self.centroids_m / spread) if spread > 0.0 else np.zeros(2)

    def unseen_s(self, stamp_ns: int) -> float:
        """Time since the last observation."""
        return (stamp_ns - self.stamps_ns[-1]) * 1e-9

    def expected_m(self, stamp_ns: int) -> Array:
        """Predicted centroid (2,). Two observations make no velocity, so a blob without id is expected at rest."""
        velocity = self.velocity_mps if self.id else np.zeros(2)
        return np.asarray(self.centroids_m[-1] + velocity * self.unseen_s(stamp_ns))

    def with_observation(self, region: Blob, stamp_ns: int) -> "TrackedBlob":
        old = sum(stamp_ns - stamp > _MEMORY_S * 1e9 for stamp in self.stamps_ns[:-1])
        middles = np.vstack([self.centroids_m[old:], region.centroid_m])
        return replace(self, region=region, stamps_ns=(*self.stamps_ns[old:], stamp_ns), centroids_m=middles)


class BlobTracker:
    """All blobs that are followed, the oldest first. One that has persisted has an `id`."""

    def __init__(self) -> None:
        self.blobs: tuple[TrackedBlob, ...] = ()
        self._numbers = 0

    def update(self, blobs: Sequence[Blob], stamp_ns: int) -> None:
        """Assign this frame's blobs to the tracked ones so that the summed distance is least, inside the gate; the rest
        are new."""
        tracked = []
        assigned = self._assign(blobs, stamp_ns)
        for blob, index in zip(self.blobs, assigned, strict=True):
            if index is not None:
                tracked.append(self._with_id(blob.with_observation(blobs[index], stamp_ns)))
            elif blob.id and blob.unseen_s(stamp_ns) <= _PERSISTS_S:
                tracked.append(blob)
        new = [
            TrackedBlob(0, stamp_ns, blob.centroid_m, blob, (stamp_ns,), blob.centroid_m[None])
            for i, blob in enumerate(blobs)
            if i not in assigned
        ]
        self.blobs = (*tracked, *new)

    def _assign(self, blobs: Sequence[Blob], stamp_ns: int) -> list[int | None]:
        """Index of the blob that each tracked one takes, None for none."""
        if not (self.blobs and blobs):
            return [None] * len(self.blobs)
        expected = np.array([blob.expected_m(stamp_ns) for blob in self.blobs])
        distance_m = np.linalg.norm(expected[:, None] - np.array([blob.centroid_m for blob in blobs]), axis=2)
        gate_m = np.array([_REACH_M + _REACH_MPS * blob.unseen_s(stamp_ns) for blob in self.blobs])
        allowed = distance_m < gate_m[:, None]
        rows, columns = linear_sum_assignment(np.where(allowed, distance_m, _FORBIDDEN_M))
        assignment = {int(row): int(column) for row, column in zip(rows, columns, strict=True) if allowed[row, column]}
        return [assignment.get(row) for row in range(len(self.blobs))]

    def clear(self) -> None:
        self.blobs = ()

    def _with_id(self, blob: TrackedBlob) -> TrackedBlob:
        """The blob, with the next number once it has lasted _PERSISTS_S."""
        if blob.id or blob.stamps_ns[-1] - blob.since_ns < _PERSISTS_S * 1e9:
            return blob
        self._numbers += 1
        return replace(blob, id=self._numbers)


def convex_outline(points_m: Array) -> Array:
    """Corners (12, 2), in order from x to y, of the tightest convex polygon around points (n, 2) whose sides are 30
    degrees apart, starting from those of the smallest rectangle around them. Exact for a rectangle, 2 % larger than a
    disc."""
    _, _, angle_deg = cv2.minAreaRect(points_m.astype(np.float32))
    step = 2.0 * np.pi / CORNERS
    angle = np.deg2rad(angle_deg) + step * np.arange(CORNERS)
    normal = np.stack([np.cos(angle), np.sin(angle)])
    reach = (points_m @ normal).max(axis=0)
    along = (np.roll(reach, -1) - reach * np.cos(step)) / np.sin(step)  # from a side's foot to where it meets the next
    return np.asarray((reach * normal + along * np.array([-normal[1], normal[0]])).T)
