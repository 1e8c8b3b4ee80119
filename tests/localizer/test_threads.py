"""Settings of the process: cores leave them to the programs."""

from collections.abc import Iterator

import cv2
import numpy as np
import pytest

from localizer.detection.obstacles import ObstacleDetector
from localizer.tracking.fleet_localizer import FleetLocalizer
from shoal.config.experiment import load_experiment


@pytest.fixture
def three_threads() -> Iterator[None]:
    before = cv2.getNumThreads()
    cv2.setNumThreads(3)
    yield
    cv2.setNumThreads(before)


@pytest.mark.usefixtures("three_threads")
def test_localizing_leaves_the_number_of_opencvs_threads_as_it_is() -> None:
    """It belongs to the whole process, where other parts may need another number."""
    pool = load_experiment("pool")
    frame = np.zeros(pool.camera.size_px[::-1], np.uint8)
    FleetLocalizer(pool).step(frame, 0, {})
    ObstacleDetector(pool).step(frame, 0, np.zeros((0, 3)))
    assert cv2.getNumThreads() == 3
