"""Figures of a live picture for people who set up a camera: light, focus, motion blur, rate; each judged in words. Pure."""

from dataclasses import dataclass

import numpy as np

from localizer.calibration.images import sharpness
from localizer.detection.image_regions import Pixels

BINS = 64
_DARKEST, _BRIGHTEST = 1, 254  # grey levels from which on a pixel is clipped, noise of one level included
_MOST_BRIGHT, _MOST_DARK = 0.02, 0.25  # shares of clipped pixels; caustics and glare of the simulated pool are 0.005
_DIMMEST = 40.0  # grey levels, mean; markers at 15 % of the simulated light are still read, with twice the noise
_SHARP = 0.9  # of the best sharpness seen; turning the ring past the best shows as a fall
SPEED_MPS = 0.1  # that motion blur is told for
_MOST_BLUR_MM = 1.0  # at that speed; 10 ms, above which localizer/sources/v4l2.py warns
_LEAST_RATE = 0.9  # of the wanted rate


@dataclass(frozen=True)
class Verdict:
    """A figure in words: `good`, or what to do."""

    good: bool
    text: str


@dataclass(frozen=True)
class PictureFigures:
    """Figures of one picture. `histogram`: shares of BINS equal steps of brightness. `blur_px` None: scale not known."""

    histogram: tuple[float, ...]
    dark_share: float
    bright_share: float
    focus: float
    best_focus: float
    blur_mm: float
    blur_px: float | None
    verdicts: tuple[Verdict, ...]


class PictureJudge:
    """Judge of a camera's pictures, one after the other; it remembers the best focus."""

    def __init__(self) -> None:
        self._best = 0.0

    def forget_focus(self) -> None:
        """Begin anew: another scene is in sight."""
        self._best = 0.0

    def judge(self, raw: Pixels, grey: Pixels, exposure_s: float, px_per_m: float | None) -> PictureFigures:
        """Figures of a raw mosaic and its grey picture, both (height, width)."""
        counts = np.bincount(raw.ravel(), minlength=256) / raw.size
        dark, bright = float(counts[: _DARKEST + 1].sum()), float(counts[_BRIGHTEST:].sum())
        focus = sharpness(grey)
        self._best = max(self._best, focus)
        blur_m = exposure_s * SPEED_MPS
        verdicts = (
            _light(float(counts @ np.arange(256)), dark, bright),
            Verdict(
                focus >= _SHARP * self._best,
                f"focus {focus:.0f}, best so far {self._best:.0f}"
                + ("" if focus >= _SHARP * self._best else f": below {_SHARP:.0%} of it, turn the ring back"),
            ),
            _blur(exposure_s, blur_m),
        )
        shares = counts.reshape(BINS, -1).sum(axis=1)
        blur_px = None if px_per_m is None else blur_m * px_per_m
        return PictureFigures(
            tuple(np.round(shares, 5).tolist()), dark, bright, focus, self._best, 1e3 * blur_m, blur_px, verdicts
        )


def _light(mean: float, dark: float, bright: float) -> Verdict:
    """Judge the light by the mean grey level (of 255) and the shares of black and white pixels."""
    if bright > _MOST_BRIGHT:
        return Verdict(
            False, f"too bright: {bright:.1%} of the pixels are white (limit {_MOST_BRIGHT:.1%}): less light or gain"
        )
    if dark > _MOST_DARK:
        return Verdict(False, f"too dark: {dark:.0%} of the pixels are black (limit {_MOST_DARK:.0%}): more light or gain")
    if mean < _DIMMEST:
        return Verdict(False, f"dim: mean brightness {mean:.0f} of 255 (wanted: {_DIMMEST:.0f}): more light or gain")
    return Verdict(True, f"light is right: mean brightness {mean:.0f}, {bright:.2%} white, {dark:.1%} black")


def _blur(exposure_s: float, blur_m: float) -> Verdict:
    finding = f"a robot at {SPEED_MPS:g} m/s smears over {1e3 * blur_m:.2f} mm in {1e3 * exposure_s:.1f} ms"
    good = 1e3 * blur_m <= _MOST_BLUR_MM
    return Verdict(good, finding if good else f"{finding} (limit {_MOST_BLUR_MM:g} mm): expose shorter, with more light")


def rate_verdict(rate_hz: float, wanted_hz: float, dropped: int) -> Verdict:
    """Verdict on the rate at which pictures come."""
    finding = f"{rate_hz:.1f} pictures a second, {dropped} dropped"
    good = rate_hz >= _LEAST_RATE * wanted_hz
    return Verdict(good, finding if good else f"{finding}: below {_LEAST_RATE:.0%} of camera.rate_hz = {wanted_hz:g}")
