"""Camera health: frozen, dark or wrongly sized frames, of which no poses may be made."""

import numpy as np
from numpy.typing import NDArray

from localizer import kernels
from wire.messages.messages import CameraHealth

# Every seventh pixel of every seventh row: odd, so all four Bayer colours are among them. 25,000 samples of a live picture
# differ somewhere even if noise changes only one pixel in a thousand.
_STRIDE = 7
_BLACK_LEVEL = 8.0  # grey levels, mean: a covered lens shows 0-4, a pool by emergency light more than 20


class FrameHealthMonitor:
    """Health of each frame, by itself and against the one before."""

    def __init__(self, size_px: tuple[int, int], frozen_frames: int) -> None:
        self._shape = (size_px[1], size_px[0])
        self._frozen_frames = frozen_frames
        self._sample = np.zeros([-(-side // _STRIDE) for side in self._shape], np.uint8)  # of the last frame of that shape
        self._same = 0  # frames in a row that are the same, as far as they are sampled; 0: there was none

    @property
    def repeated(self) -> bool:
        """True if the newest frame equals the one before: it holds no new information, frozen already or not."""
        return self._same > 1

    def assess(self, frame: NDArray[np.uint8]) -> CameraHealth:
        """The camera's state after this frame, (height, width) uint8. `frozen_frames` identical ones in a row are FROZEN."""
        if frame.shape != self._shape or frame.dtype != np.uint8:
            self._same = 0
            return CameraHealth.WRONG_SIZE
        total, differing = kernels.sample(frame, _STRIDE, self._sample)
        self._same = self._same + 1 if self._same and not differing else 1
        if total < _BLACK_LEVEL * self._sample.size:
            return CameraHealth.BLACK
        return CameraHealth.FROZEN if self._same >= self._frozen_frames else CameraHealth.OK
