"""Which pictures of a board become views."""

import cv2
import numpy as np

from localizer.camera_model import Intrinsics
from localizer.detection.image_regions import Pixels
from localizer.setup.lens_step import LensStep
from tests.localizer.board_scene import chessboard

LENS = Intrinsics(size_px=(640, 480), focal_px=(500.0, 500.0), centre_px=(319.5, 239.5))


def picture(right_px: float) -> Pixels:
    """A board, so far to the right of its first place."""
    texture, _, _ = chessboard(9, 6, 0.015)
    shift = np.array([[1.0, 0.0, 20.0 + right_px], [0.0, 1.0, 80.0]])
    return np.asarray(cv2.warpAffine(texture, shift, LENS.size_px, borderValue=(225.0,)), dtype=np.uint8)


def test_a_view_is_kept_of_a_board_that_is_held_still_at_a_new_place() -> None:
    step, advice = LensStep("chessboard:9x6:0.015", LENS), []
    for right_px in (0.0, 10.0, 20.0, 20.2, 20.0, 170.0, 170.2):
        step.offer(picture(right_px))
        advice.append(step.advice)
    still, alike = "hold it still", "as in a view before: move or tilt it"
    assert advice == [still, still, still, "kept view 1", alike, still, "kept view 2"]
    assert len(step.views) == 2
