"""Background model of the water: mean and covariance of each cell's colour; cells that do not fit are foreground.

The picture is reduced to cells (160 x 120 for 1280 x 960). Each is the logarithm of its mean red, green and blue, averaged
with its neighbours and over the last quarter of a second. Caustics multiply all three colours alike and glare pulls them
towards white, so a cell of bare water moves along one or two lines in this space. Every cell learns its own mean and 3 x 3
covariance. The Mahalanobis distance forgives these movements, and reveals a grey box (redder than the floor, seen through
more water) or a dark pole that is no stronger than a caustic. The distance is the same in any basis, so hue and brightness
need not be separated.

Measured in the simulated pool with strong caustics, glare and ripples (0.6, 0.8, 3 mm) over five minutes: water stays
below a distance of 3.2 in 99.999 % of cells and steps, 3.5 at most; a grey box reaches 8, a black pole 11, a red ball 30.
Without the average over time water reaches 5.3, and the grey box 5.7. In the pool scene's own water the maximum was 1.9.
"""

import cv2
import numpy as np
from numpy.typing import NDArray

from localizer.detection.image_regions import Pixels

Planes = NDArray[np.float32]
Mask = NDArray[np.bool_]

_CELLS_ACROSS = 160
_NEIGHBOURS = 3  # cells, side of the spatial average: 7 cm in the pool, the smallest obstacle to be reported
_DARK_LEVEL = 6.0  # grey levels, added before the logarithm; without it sensor noise in the dark looks like colour
_BLUR_S = 0.25  # s, time constant of the average over time; shorter ones let caustics through (see above)
LAG_S = float(np.log(2.0)) * _BLUR_S  # s, lag of a moving obstacle's edge, which is where half of the average is covered
_LOGARITHM = np.log(np.arange(256) + _DARK_LEVEL).astype(np.float32)

_SETTLE_S = 4.0  # s of unobstructed view before a cell is judged: several periods of the slowest ripples
MEMORY_S = 20.0  # s, memory of mean and covariance after that; follows daylight and clouds, which are slower than obstacles
_NOISE = 0.03  # log units, least standard deviation of each colour, however still the water was while learning
_FLICKER = 0.08  # log units, least standard deviation of the brightness of all three colours together
_SHADE = 0.5  # log units, the same where a robot may cast its shadow: 0.4 to 0.6 of the light are left in its middle
_POOLED_CELLS = 7  # cells, side of the pool: covariances are half the cell's own and half the pool's, as 4 s hold few samples
_LONGEST_LEAP = 4.0  # Mahalanobis distance; a colour farther from a known cell's mean is learnt as if it lay at this distance

_PAIRS = ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))  # the six different entries of a symmetric 3 x 3 matrix


class CellGrid:
    """The grid of cells, and the reduction of a raw picture to it."""

    def __init__(self, size_px: tuple[int, int]) -> None:
        self.cell_px = max(2 * round(size_px[0] / _CELLS_ACROSS / 2), 2)  # even: whole Bayer squares
        self.columns, self.rows = size_px[0] // self.cell_px, size_px[1] // self.cell_px

    def colours(self, frame: Pixels) -> Planes:
        """Logarithms of red, green, blue, (3, rows, columns), of a Bayer RGGB picture (height, width)."""
        used = frame[: self.rows * self.cell_px, : self.columns * self.cell_px]
        pairs = used.reshape(used.shape[0], used.shape[1] // 2, 2)  # red, green in even rows; green, blue in odd ones
        rows = 4 if self.cell_px >= 8 else 2  # of large cells every other Bayer row: half the time, and noise is small enough
        upper, lower = (self._reduced(pairs[first::rows]) for first in (0, 1))
        return np.stack([upper[..., 0], (upper[..., 1] + lower[..., 0]) * np.float32(0.5), lower[..., 1]])

    def _reduced(self, pairs: Pixels) -> Planes:
        mean = cv2.resize(pairs, (self.columns, self.rows), interpolation=cv2.INTER_AREA)
        return np.asarray(cv2.blur(cv2.LUT(mean, _LOGARITHM), (_NEIGHBOURS, _NEIGHBOURS)), dtype=np.float32)


class TemporalSmoother:
    """Exponential average of each cell's colour over the last quarter of a second, restarted when the cell was hidden."""

    def __init__(self, shape: tuple[int, int]) -> None:
        self._colours = np.zeros((3, *shape), np.float32)
        self._seen_s = np.zeros(shape, np.float32)

    def update(self, colours: Planes, hidden: Mask, step_s: float) -> tuple[Planes, Mask]:
        """Take in `colours` (3, rows, columns). Returns the averages, and a mask of those that cover enough time."""
        self._seen_s = np.minimum(self._seen_s + np.float32(step_s), np.float32(1.0)) * ~hidden
        rate = np.maximum(np.float32(step_s) / np.maximum(self._seen_s, np.float32(step_s)), np.float32(_share(step_s)))
        self._colours += rate * (colours - self._colours)
        return self._colours, np.asarray(self._seen_s >= _BLUR_S)


def _share(step_s: float) -> float:
    return 1.0 - float(np.exp(-step_s / _BLUR_S))


class BackgroundModel:
    """Mean and covariance of every cell's colour, learnt from the colours that it shows most of the time."""

    def __init__(self, shape: tuple[int, int]) -> None:
        self._mean = np.zeros((3, *shape), np.float32)
        self._covariance = np.zeros((6, *shape), np.float32)
        self._inverse = np.zeros((6, *shape), np.float32)
        self._bright = np.zeros(shape, np.float32)  # 1' C^-1 1: how precisely the brightness alone is known
        self._seen_s = np.zeros(shape, np.float32)

    @property
    def is_known(self) -> Mask:
        """Mask of the cells that were seen for long enough to be judged, (rows, columns)."""
        return np.asarray(self._seen_s >= _SETTLE_S)

    def distance(self, colours: Planes, shaded: Mask) -> Planes:
        """Mahalanobis distance of `colours` (3, rows, columns) from each cell's mean; 0 where the cell is not known yet.

        `shaded` masks cells on which a robot's shadow may fall: brightness counts for hardly anything there. That is
        another term s^2 1 1' in the covariance, which the Sherman-Morrison formula takes to the distance.
        """
        deviation = colours - self._mean
        whitened = self._whitened(deviation)
        squared = deviation[0] * whitened[0] + deviation[1] * whitened[1] + deviation[2] * whitened[2]
        extra = np.float32(_SHADE**2)
        brighter = whitened[0] + whitened[1] + whitened[2]
        squared -= shaded * (extra * brighter * brighter / (np.float32(1.0) + extra * self._bright))
        return np.asarray(np.sqrt(np.maximum(squared, np.float32(0.0))) * self.is_known)

    def learn(self, colours: Planes, distance: Planes, where: Mask, step_s: float) -> None:
        """Take in `colours` at the cells of `where`, with the `distance` that was measured for them."""
        is_known = self.is_known
        self._seen_s[where] += np.float32(step_s)
        rate = where * (np.float32(step_s) / np.clip(self._seen_s, np.float32(step_s), np.float32(MEMORY_S)))
        leap = np.float32(_LONGEST_LEAP)
        deviation = (colours - self._mean) * np.where(
            is_known & (distance > leap), leap / np.maximum(distance, leap), np.float32(1.0)
        )
        self._mean += rate * deviation
        keep = np.float32(1.0) - rate
        for plane, (i, j) in zip(self._covariance, _PAIRS, strict=True):
            plane += rate * deviation[i] * deviation[j]
            plane *= keep
        self._invert()

    def forget(self, where: Mask) -> None:
        """Start these cells anew, because their history was not background."""
        for planes in (self._mean, self._covariance):
            planes[:, where] = 0.0
        self._seen_s[where] = 0.0

    def _whitened(self, deviation: Planes) -> tuple[Planes, Planes, Planes]:
        """C^-1 times `deviation`, both (3, rows, columns)."""
        rr, rg, rb, gg, gb, bb = self._inverse
        red, green, blue = deviation
        return (
            rr * red + rg * green + rb * blue,
            rg * red + gg * green + gb * blue,
            rb * red + gb * green + bb * blue,
        )

    def _invert(self) -> None:
        """Invert every cell's covariance by cofactors."""
        spread = []
        for plane, (i, j) in zip(self._covariance, _PAIRS, strict=True):
            around = cv2.blur(plane, (_POOLED_CELLS, _POOLED_CELLS))
            spread.append((plane + around) * np.float32(0.5) + np.float32(_FLICKER**2 + (_NOISE**2 if i == j else 0.0)))
        rr, rg, rb, gg, gb, bb = spread
        cofactors = (
            gg * bb - gb * gb, rb * gb - rg * bb, rg * gb - rb * gg, rr * bb - rb * rb, rg * rb - rr * gb, rr * gg - rg * rg,
        )  # fmt: skip
        per_determinant = np.float32(1.0) / (rr * cofactors[0] + rg * cofactors[1] + rb * cofactors[2])
        np.multiply(cofactors, per_determinant, out=self._inverse)
        rr, rg, rb, gg, gb, bb = self._inverse
        self._bright = rr + gg + bb + np.float32(2.0) * (rg + rb + gb)
