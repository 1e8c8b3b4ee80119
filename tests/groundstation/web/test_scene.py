"""The scene that a page gets once: long paths are thinned, and keep their pace and their ends within a step."""

import numpy as np
import pytest

from groundstation.web.scene import MOST_POINTS, paths
from shoal.messages.messages import Trajectory


@pytest.mark.parametrize("flown", [1, 2, MOST_POINTS - 1, MOST_POINTS, MOST_POINTS + 1, 5 * MOST_POINTS + 3])
def test_a_path_has_points_enough_and_never_too_many(flown: int) -> None:
    eta = np.arange(4.0 * (flown + 7)).reshape(-1, 4)
    (path,) = paths({3: Trajectory("way", 0.02, eta, np.zeros_like(eta), np.zeros_like(eta))}, flown)
    points = np.frombuffer(path["eta"], "<f4").reshape(-1, 4)
    apart = round(path["every_s"] / 0.02)
    assert min(flown, MOST_POINTS // 2) <= len(points) <= MOST_POINTS
    np.testing.assert_array_equal(points, eta[:flown:apart].astype(np.float32))
