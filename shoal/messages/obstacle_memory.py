"""Places where obstacles may be that were seen and are not seen any more. Pure; robots and station use the same.

A robot that cannot see keeps the obstacles that were there last. An obstacle may have drifted on at the velocity that was
measured, or have stopped, or have done something else. So it takes up the ground of the way that it would have drifted, and
around that the space that grows like that of a robot which is not heard (safety.bubble_mps, safety.bubble_max_m).
"""

import numpy as np

from shoal.config.controller import Safety
from shoal.frames import Array
from shoal.messages.messages import Obstacles
from shoal.messages.topics import OBSTACLES

LONGEST_S = 1e6  # unseen for longer is the same: nothing grows any more
SIDES = 12  # of an outline that covers the ground of a drift
BLIND = "nobody tells of obstacles"


def ages_s(message: Obstacles, since_s: float) -> list[float]:
    """The ages of the obstacles, in s, in a message that is `since_s` old."""
    if not message.ids:  # in most messages
        return []
    ages: list[float] = np.nan_to_num(np.clip(since_s + message.unseen_s, 0.0, LONGEST_S), nan=LONGEST_S).tolist()
    return ages


def is_old(age_s: float) -> bool:
    """True if an obstacle seen so long ago may be elsewhere."""
    return age_s > OBSTACLES.max_age_s


def growth_m(safety: Safety, age_s: float) -> float:
    """The distance beyond its outline, in m, at which an obstacle may be that was last seen `age_s` ago."""
    return min(safety.bubble_mps * max(age_s - OBSTACLES.max_age_s, 0.0), safety.bubble_max_m)


def drift_m(safety: Safety, velocity_mps: Array, age_s: float) -> Array:
    """The drift (2,), in m, of an obstacle since it was seen, limited to safety.bubble_max_m."""
    drift = velocity_mps * age_s
    return np.asarray(drift * min(1.0, safety.bubble_max_m / max(float(np.hypot(*drift)), 1e-9)))


def swept(outline: Array, drift_m: Array) -> Array:
    """Corners (12, 2), in order from x to y, of a polygon around an outline (n, 2) and the same one `drift_m` further on."""
    points = np.vstack([outline, outline + drift_m])
    step = 2.0 * np.pi / SIDES
    angle = float(np.arctan2(drift_m[1], drift_m[0])) + step * np.arange(SIDES)
    normal = np.stack([np.cos(angle), np.sin(angle)])
    reach = (points @ normal).max(axis=0)
    along = (np.roll(reach, -1) - reach * np.cos(step)) / np.sin(step)  # from a side's foot to where it meets the next
    return np.asarray((reach * normal + along * np.array([-normal[1], normal[0]])).T)


def blindness(message: Obstacles | None, since_s: float) -> str:
    """The reason why a reader of this message, `since_s` old, cannot tell which obstacles there are; empty if it can."""
    if message is None:
        return BLIND
    return f"{BLIND} any more" if is_old(since_s) else message.blind
