"""The correlation filter on a real overhead video: an animal that bends and turns, uneven light, reflections, compression.

Needs the public `mouse` video (tracktor project) with idTracker's positions; where it is not at hand, nothing is claimed.
"""

import os
from pathlib import Path

import cv2
import numpy as np
import pytest

from localizer.kcf import CorrelationFilter, FilterShape, Real
from tests.localizer.scene import Pixels
from wire.frames import Array

DATA = Path(os.environ.get("SHOAL_TEST_DATA", Path(__file__).parents[3] / "shared" / "data")) / "mouse"
FRAMES = 1000
SIZE = 48  # samples across SPAN_PX of the picture
SPAN_PX = 64.0
RATE = np.full(1, 0.02, np.float32)
ONE = np.zeros(1, dtype=np.intp)


def _patch(picture: Pixels, centre_px: Array) -> Real:
    step = SPAN_PX / SIZE
    matrix = np.array([[step, 0.0, centre_px[0] - step * (SIZE // 2)], [0.0, step, centre_px[1] - step * (SIZE // 2)]])
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    patch = cv2.warpAffine(picture, matrix, (SIZE, SIZE), flags=flags, borderMode=cv2.BORDER_REPLICATE)
    return np.asarray(np.moveaxis(patch, -1, 0)[None], dtype=np.float32)


@pytest.mark.skipif(not DATA.is_dir(), reason=f"no video in {DATA} (SHOAL_TEST_DATA says where)")
def test_follows_a_real_animal() -> None:
    """Started once, never helped again: median error of 1,000 frames <= 3 px, and it is never lost."""
    reference = np.loadtxt(DATA / "mouse_video_idtracked.txt", skiprows=1, usecols=(0, 1)) - 1.0  # 1-based there
    video = cv2.VideoCapture(str(DATA / "mouse_video.mp4"))
    correlation = CorrelationFilter(1, FilterShape(SIZE, SIZE, 3, 2.5, 1.0, windowed=True))
    place, speed, errors = reference[0].copy(), np.zeros(2), []
    for k in range(FRAMES):
        picture = np.asarray(video.read()[1], dtype=np.uint8)
        if k == 0:
            correlation.learn(ONE, _patch(picture, place), np.ones(1, np.float32))
            continue
        before = place
        place = before + speed
        for _ in range(2):
            place = place + correlation.detect(ONE, _patch(picture, place))[0][0] * SPAN_PX / SIZE
        speed = 0.5 * speed + 0.5 * (place - before)
        correlation.learn(ONE, _patch(picture, place), RATE)
        errors.append(float(np.linalg.norm(place - reference[k])))
    video.release()
    assert np.median(errors) <= 3.0
    assert np.max(errors) < 20.0, "less than the animal's length: it was followed throughout"
