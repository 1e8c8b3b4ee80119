"""The correlation filter on a real overhead video: an animal that bends and turns, uneven light, reflections, compression.

Needs the public `mouse` video (tracktor project) with idTracker's positions; where it is not at hand, nothing is claimed.
"""

import os
from pathlib import Path

import pytest

from localizer.evaluation.runner import evaluate_plain

DATA = Path(os.environ.get("SHOAL_DATA", Path(__file__).parents[4] / "shared" / "data")) / "mouse"


@pytest.mark.skipif(not DATA.is_dir(), reason=f"no video in {DATA} (SHOAL_DATA says where)")
def test_follows_a_real_animal() -> None:
    """Started once, never helped again: median error of 1,000 frames <= 3 px, and it is never lost."""
    (row,) = evaluate_plain(DATA / "mouse_video.mp4", DATA / "mouse_video_idtracked.txt", box_px=64.0, limit=1000)
    assert row.frames == 999
    assert row.median_px <= 3.0
    assert row.failures == 0 and row.max_px < 20.0, "less than the animal's length: it was followed throughout"
