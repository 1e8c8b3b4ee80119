"""Camera faults of the timeline, applied to raw pictures."""

from collections.abc import Sequence
from functools import lru_cache

import numpy as np

from shoal.config.fault_injection import Break
from sim_bridge.camera.optics import Bytes

DARK = 16  # divisor of the picture when the lights fail
CABLE_GREY = 12  # grey level of the object that hides part of the picture
SOFT_EDGE = 0.15  # width of a glare's edge over its radius


class CameraFaults:
    """The faults of one camera. It keeps the last picture, for `frozen`."""

    def __init__(self) -> None:
        self._last: Bytes | None = None

    def apply(self, raw: Bytes, broken: Sequence[Break]) -> Bytes:
        """The picture with these faults."""
        if self._last is not None and any(b.effect == "frozen" for b in broken):
            return self._last
        for b in broken:
            if b.effect == "dark":
                raw = raw // np.uint8(DARK)
            elif b.effect == "occluded":
                raw = raw.copy()
                raw[:, : round(b.value * raw.shape[1])] = CABLE_GREY
            elif b.effect == "glare":
                raw = np.maximum(raw, _glare(raw.shape, b.value))
            elif b.effect == "lamp":
                raw = np.rint(np.minimum(np.arange(256) * b.value, 255.0)).astype(np.uint8)[raw]
            elif b.effect == "bump":
                raw = _moved(raw, 2 * round(b.value / 2))
        self._last = raw
        return raw


@lru_cache(maxsize=4)  # the same for every picture of a fault; drawing one takes as long as a period of a fast camera
def _glare(shape: tuple[int, ...], fraction: float) -> Bytes:
    """A lamp's reflection: a saturated disc in the middle that covers this fraction of the picture."""
    rows, columns = np.ogrid[: shape[0], : shape[1]]
    radius = max(np.sqrt(fraction * shape[0] * shape[1] / np.pi), 1.0)
    distance = np.hypot(rows - shape[0] / 2, columns - shape[1] / 2) / radius
    glare = np.asarray(255.0 * np.clip((1.0 + SOFT_EDGE - distance) / SOFT_EDGE, 0.0, 1.0), dtype=np.uint8)
    glare.setflags(write=False)
    return glare


def _moved(raw: Bytes, pixels: int) -> Bytes:
    """The picture of a camera that was turned: shifted right and down, the edge repeated in whole Bayer squares (`pixels`
    is even)."""
    rows, columns = (np.maximum(np.arange(n) - pixels, np.arange(n) % 2) for n in raw.shape)
    return np.ascontiguousarray(raw[np.ix_(rows, columns)])
