"""Kernelized correlation filter (Henriques et al., IEEE TPAMI 37(3), 2015), batched over robots; equation numbers are theirs.

One class serves both filters. Over a picture patch (rows x columns) the peak is a shift of the robot; over rings around its
centre (1 x angles, the rings stacked as channels) the same circular correlation is a turn, and truly circular, so it needs
no window. Patches arrive in the body frame, turned by the predicted heading: plain KCF drifts off a turning robot.

Colour channels rather than grey: 2.9 px against 4.5 px median error on a real overhead video. float32 throughout, as the
pictures have 8 bits.
"""

from dataclasses import dataclass

import numpy as np
import scipy.fft
from numpy.typing import NDArray

Real = NDArray[np.float32]
Complex = NDArray[np.complex64]

_FLAT = 1.0  # grey levels of 255; a patch with less contrast than this is not stretched to look like one


@dataclass(frozen=True)
class FilterShape:
    """What the filter looks at: (rows, columns) of a patch, channels of a pixel, and how the target is cut and marked."""

    rows: int
    columns: int
    channels: int
    target_width: float  # standard deviation of the Gaussian target [samples]
    kernel_width: float  # sigma of the Gaussian kernel (equation 16), for features of unit contrast
    windowed: bool  # cosine window: needed where the patch's opposite edges do not belong together
    regularisation: float = 1e-2  # lambda of equation 5


class CorrelationFilter:
    """One filter per robot; `detect` finds what `learn` was shown."""

    def __init__(self, count: int, shape: FilterShape) -> None:
        self._shape = shape
        bins = shape.columns // 2 + 1
        self._dual = np.zeros((count, shape.rows, bins), np.complex64)  # alpha-hat
        self._model = np.zeros((count, shape.channels, shape.rows, bins), np.complex64)  # x-hat
        self._window = _window(shape)
        self._target = scipy.fft.rfft2(_target(shape))

    def detect(self, robots: NDArray[np.intp], patches: Real) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Where the learnt pattern of `robots` (n,) lies in `patches` (n, channels, rows, columns), grey levels.

        Returns shifts (n, 2) in samples [columns, rows], sub-sample, in +- half a patch, and peaks (n,), 1 for the very
        patch that was learnt.
        """
        spectrum = self._spectrum(patches)
        kernel = self._kernel(self._model[robots], spectrum)
        response = scipy.fft.irfft2(kernel * self._dual[robots], s=(self._shape.rows, self._shape.columns))  # equation 22
        return _peaks(response)

    def learn(self, robots: NDArray[np.intp], patches: Real, rates: Real) -> None:
        """Blend `patches` (n, channels, rows, columns), robot at the centre, into the filters; rate 1 starts anew."""
        spectrum = self._spectrum(patches)
        dual = self._target / (self._kernel(spectrum, spectrum) + np.float32(self._shape.regularisation))  # equation 17
        blend = rates.astype(np.float32)[:, None, None]
        self._dual[robots] += blend * (dual - self._dual[robots])
        self._model[robots] += blend[..., None] * (spectrum - self._model[robots])

    def _spectrum(self, patches: Real) -> Complex:
        """Features: each patch to zero mean per channel and unit contrast over all (the light changes), windowed."""
        features = patches - patches.mean(axis=(-2, -1), keepdims=True)
        contrast = np.sqrt(np.mean(features**2, axis=(-3, -2, -1), keepdims=True))
        return np.asarray(scipy.fft.rfft2(features / np.maximum(contrast, np.float32(_FLAT)) * self._window))

    def _kernel(self, model: Complex, spectrum: Complex) -> Complex:
        """Spectrum of the Gaussian kernel of all circular shifts (equation 31), (n, rows, bins)."""
        shape = self._shape
        size = (shape.rows, shape.columns)
        cross = scipy.fft.irfft2(np.sum(np.conj(model) * spectrum, axis=1), s=size)
        distance = _energy(model, shape)[:, None, None] + _energy(spectrum, shape)[:, None, None] - 2.0 * cross
        numel = np.float32(shape.rows * shape.columns * shape.channels)
        scale = np.float32(-1.0 / (shape.kernel_width**2)) / numel
        return np.asarray(scipy.fft.rfft2(np.exp(scale * np.maximum(distance, np.float32(0.0)))))


def _window(shape: FilterShape) -> Real:
    if not shape.windowed:
        return np.ones((shape.rows, shape.columns), np.float32)
    # periodic rather than symmetric: its peak lies ON sample n // 2, where the patch's centre is
    rows, columns = (0.5 - 0.5 * np.cos(2.0 * np.pi * np.arange(n) / n) for n in (shape.rows, shape.columns))
    return np.outer(rows, columns).astype(np.float32)


def _target(shape: FilterShape) -> Real:
    """Gaussian of the circular distance from sample (0, 0), which stands for "no shift"."""
    rows, columns = (scipy.fft.fftfreq(n, 1.0 / n) for n in (shape.rows, shape.columns))
    squared = rows[:, None] ** 2 + columns[None, :] ** 2
    return np.exp(-0.5 * squared / shape.target_width**2).astype(np.float32)


def _energy(spectrum: Complex, shape: FilterShape) -> Real:
    """||x||^2 of (n, channels, rows, bins) half spectra, by Parseval; the mirrored bins count twice."""
    power = np.sum(spectrum.real**2 + spectrum.imag**2, axis=(1, 2))
    mirrored = power[:, 1:-1] if shape.columns % 2 == 0 else power[:, 1:]
    total = power.sum(axis=1) + mirrored.sum(axis=1)
    return np.asarray(total / np.float32(shape.rows * shape.columns), dtype=np.float32)


def _peaks(response: Real) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Sub-sample position and height of each response's maximum.

    A parabola through the logarithm of three samples: exact for the Gaussian that the target makes of the response, where a
    parabola through the samples themselves is pulled towards the middle one.
    """
    count, rows, columns = response.shape
    n = np.arange(count)
    best = response.reshape(count, -1).argmax(axis=1)
    row, column = best // columns, best % columns
    height = response[n, row, column].astype(np.float64)
    shifts = np.zeros((count, 2))
    for axis, (size, index) in enumerate(((columns, column), (rows, row))):
        if size == 1:
            continue
        before, after = (index - 1) % size, (index + 1) % size
        sides = (
            (response[n, row, before], response[n, row, after])
            if axis == 0
            else (response[n, before, column], response[n, after, column])
        )
        low, middle, high = (np.log(np.maximum(v, 1e-6).astype(np.float64)) for v in (sides[0], height, sides[1]))
        bend = low - 2.0 * middle + high
        step = np.where(bend < -1e-9, 0.5 * (low - high) / np.where(bend < -1e-9, bend, -1.0), 0.0)
        shifts[:, axis] = (index + np.clip(step, -0.5, 0.5) + size / 2) % size - size / 2
    return shifts, height
