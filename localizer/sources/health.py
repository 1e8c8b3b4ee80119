"""Camera health: frozen, dark or wrongly sized frames, of which no poses may be made."""

import zlib
from collections import deque

import numpy as np
from numpy.typing import NDArray

from shoal.messages.messages import CameraHealth

# Every seventh pixel of every seventh row: odd, so all four Bayer colours are among them. 25,000 samples of a live picture
# differ somewhere even if noise changes only one pixel in a thousand.
_STRIDE = 7
# Frames of which the newest may be a copy: a camera or driver that hangs may hand out its buffers, with old pictures, in turn.
# OpenCV asks a V4L2 driver for 10 at most. No two live pictures are alike, however long ago the first was.
_REMEMBERED = 16
_BLACK_LEVEL = 8.0  # grey levels, mean: a covered lens shows 0-4, a pool by emergency light more than 20


class FrameHealthMonitor:
    """Health of each frame, by itself and against the last ones before."""

    def __init__(self, size_px: tuple[int, int], frozen_frames: int) -> None:
        self._shape = (size_px[1], size_px[0])
        self._frozen_frames = frozen_frames
        self._recent = deque[int](maxlen=_REMEMBERED)  # checksums of the samples of the last frames
        self._copies = 0  # frames in a row, up to the newest, that are copies of recent ones, as far as they are sampled

    @property
    def repeated(self) -> bool:
        """True if the newest frame equals one of the last: it holds no new information, frozen already or not."""
        return self._copies > 0

    def assess(self, frame: NDArray[np.uint8]) -> CameraHealth:
        """The camera's state after this frame, (height, width) uint8. FROZEN with the `frozen_frames`-th of a row that shows
        nothing new: the same one, or the last few in turn."""
        if frame.shape != self._shape or frame.dtype != np.uint8:
            self._recent.clear()
            self._copies = 0
            return CameraHealth.WRONG_SIZE
        sample = np.ascontiguousarray(frame[::_STRIDE, ::_STRIDE])
        checksum = zlib.crc32(sample.data)
        self._copies = self._copies + 1 if checksum in self._recent else 0
        self._recent.append(checksum)
        if sample.sum() < _BLACK_LEVEL * sample.size:
            return CameraHealth.BLACK
        return CameraHealth.FROZEN if self._copies >= self._frozen_frames - 1 else CameraHealth.OK
