"""Following regions of the picture over time: what persists gets a number, a velocity and an outline. Pure."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from wire.frames import Array

CORNERS = 12  # of every outline

_PERSISTS_S = 0.4  # a thing shows up only after so long, and is gone when unseen for so long
_MEMORY_S = 1.0  # of places, for the velocity
_REACH_M = 0.1  # a region is the same thing when its middle is this near to where it was expected,
_SURPRISE_MPS = 0.5  # or a little further, by the time since


@dataclass(frozen=True, eq=False)
class Region:
    """Connected foreground: its cells (rows, columns), and their middle (2,) and convex outline (12, 2) in the pool."""

    cells: NDArray[np.bool_]
    middle_m: Array
    outline_m: Array


@dataclass(frozen=True, eq=False)
class Thing:
    """A region followed over time: stamps and middles (n, 2) of the last looks at it, the newest last."""

    id: int  # 0 until it has persisted
    since_ns: int
    region: Region
    stamps_ns: tuple[int, ...]
    middles_m: Array

    @property
    def velocity_mps(self) -> Array:
        """Slope of the straight line through the last second, by least squares, (2,)."""
        t = (np.array(self.stamps_ns) - self.stamps_ns[-1]) * 1e-9
        t = t - t.mean()
        spread = float(t @ t)
        return np.asarray(t @ self.middles_m / spread) if spread > 0.0 else np.zeros(2)

    def unseen_s(self, stamp_ns: int) -> float:
        """Time since the last look at it."""
        return (stamp_ns - self.stamps_ns[-1]) * 1e-9

    def expected_m(self, stamp_ns: int) -> Array:
        """Where its middle should be, (2,). Two looks make no velocity, so a new thing stays where it is."""
        velocity = self.velocity_mps if self.id else np.zeros(2)
        return np.asarray(self.middles_m[-1] + velocity * self.unseen_s(stamp_ns))

    def seen(self, region: Region, stamp_ns: int) -> "Thing":
        """Moved on to where it is now."""
        old = sum(stamp_ns - stamp > _MEMORY_S * 1e9 for stamp in self.stamps_ns[:-1])
        middles = np.vstack([self.middles_m[old:], region.middle_m])
        return replace(self, region=region, stamps_ns=(*self.stamps_ns[old:], stamp_ns), middles_m=middles)


class ThingTracker:
    """All things there are, the oldest first. A thing that has persisted has an `id`."""

    def __init__(self) -> None:
        self.things: tuple[Thing, ...] = ()
        self._numbers = 0

    def take(self, regions: Sequence[Region], stamp_ns: int) -> None:
        """Each thing takes the nearest region that can be it, the oldest thing first; what is left over is new."""
        free, things = list(regions), []
        for thing in self.things:
            unseen_s, expected = thing.unseen_s(stamp_ns), thing.expected_m(stamp_ns)
            nearest = min(free, key=lambda region: _distance(region.middle_m, expected), default=None)
            if nearest is not None and _distance(nearest.middle_m, expected) < _REACH_M + _SURPRISE_MPS * unseen_s:
                free = [region for region in free if region is not nearest]
                things.append(self._numbered(thing.seen(nearest, stamp_ns)))
            elif thing.id and unseen_s <= _PERSISTS_S:
                things.append(thing)
        new = [Thing(0, stamp_ns, region, (stamp_ns,), region.middle_m[None]) for region in free]
        self.things = (*things, *new)

    def clear(self) -> None:
        """All that was followed is lost."""
        self.things = ()

    def _numbered(self, thing: Thing) -> Thing:
        if thing.id or thing.stamps_ns[-1] - thing.since_ns < _PERSISTS_S * 1e9:
            return thing
        self._numbers += 1
        return replace(thing, id=self._numbers)


def convex_outline(points_m: Array) -> Array:
    """Twelve corners (12, 2), in order from x to y, of a convex polygon around points (n, 2): the tightest with sides every
    30 degrees from those of the smallest rectangle around them. Exact for a rectangle, 2 % larger than a disc."""
    _, _, angle_deg = cv2.minAreaRect(points_m.astype(np.float32))
    step = 2.0 * np.pi / CORNERS
    angle = np.deg2rad(angle_deg) + step * np.arange(CORNERS)
    normal = np.stack([np.cos(angle), np.sin(angle)])
    reach = (points_m @ normal).max(axis=0)
    along = (np.roll(reach, -1) - reach * np.cos(step)) / np.sin(step)  # from a side's foot to where it meets the next
    return np.asarray((reach * normal + along * np.array([-normal[1], normal[0]])).T)


def _distance(a: Array, b: Array) -> float:
    return float(np.linalg.norm(a - b))
