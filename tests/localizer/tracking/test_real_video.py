"""The follower on a real overhead video: an animal that bends and turns, uneven light, reflections, compression.

Needs the public `mouse` video (tracktor project) with idTracker's positions; where it is not at hand, nothing is claimed.
"""

import os
from pathlib import Path

import cv2
import numpy as np
import pytest

from localizer.sources.video import VideoReader
from shoal.frames import wrap
from tests.localizer.plain_video.idtracker import evaluate_plain, read_idtracker
from tests.localizer.plain_video.single_object import SingleObjectTracker

DATA = Path(os.environ.get("SHOAL_DATA", Path(__file__).parents[4] / "shared" / "data")) / "mouse"
VIDEO, TRUTH, BOX_PX = DATA / "mouse_video.mp4", DATA / "mouse_video_idtracked.txt", 64.0
SPIN_RAD = 0.2  # a picture, 6 rad/s at the video's 30 Hz

pytestmark = pytest.mark.skipif(not DATA.is_dir(), reason=f"no video in {DATA} (SHOAL_DATA says where)")


@pytest.mark.long
def test_a_real_animal_is_followed() -> None:
    """Started once, never helped again: median error of 1,000 frames <= 1 px, and it is never lost."""
    (row,) = evaluate_plain(VIDEO, TRUTH, BOX_PX, limit=1000)
    assert row.frames == 999
    assert row.median_px <= 1.0
    assert row.failures == 0 and row.max_px < 8.0, "less than the animal's length: it was followed throughout"


@pytest.mark.long
def test_an_animal_that_spins_is_followed_and_its_heading_is_told() -> None:
    """The picture is turned about the animal's true place by 0.2 rad from frame to frame: the heading differs by that from
    the heading in the plain video."""
    (places,) = read_idtracker(TRUTH)
    followers: list[SingleObjectTracker] = []
    errors_px, errors_rad = [], []
    for k, picture in ((each.number, each.pixels) for each in VideoReader(VIDEO).pictures(300)):
        x, y = places[k].tolist()
        about = cv2.getRotationMatrix2D((x, y), -np.degrees(SPIN_RAD * k), 1.0)
        spun = np.asarray(cv2.warpAffine(picture, about, picture.shape[1::-1], borderMode=cv2.BORDER_REFLECT), dtype=np.uint8)
        if not followers:
            followers = [SingleObjectTracker(each, places[k], BOX_PX) for each in (picture, spun)]
            continue
        (plain, _), (spinning, _) = (f.step(each) for f, each in zip(followers, (picture, spun), strict=True))
        errors_px.append(np.linalg.norm(spinning[:2] - places[k]))
        errors_rad.append(wrap(float(spinning[2] - plain[2]) - SPIN_RAD * k))
    assert np.median(errors_px) < 1.5 and np.max(errors_px) < 8.0
    assert np.sqrt(np.mean(np.square(errors_rad))) < np.radians(6.0)
