"""Plates that are covered, glared on, dimmed or exchanged: poses that claim to be good are right, the rest coasts openly."""

import numpy as np
import pytest

from shoal.messages.messages import Track
from tests.localizer.spoiled_plates import Film, SpoiledPose, spoiled_poses

pytestmark = pytest.mark.long


@pytest.fixture(scope="module")
def film() -> Film:
    return Film.render(seed=1, frames=50)


def _check(poses: list[SpoiledPose]) -> None:
    assert not [pose for pose in poses if pose.false]
    guessed = [pose for pose in poses if pose.pose.track in (Track.COAST, Track.KCF)]
    assert guessed and np.mean([pose.nees for pose in guessed]) < 5.0


def test_no_pose_of_a_spoiled_plate_is_wrong_beyond_its_claim(film: Film) -> None:
    _check(list(spoiled_poses(film, seed=1, frames=100)))


@pytest.mark.slow
@pytest.mark.timeout(3600)
@pytest.mark.parametrize("seed", range(1, 5))
def test_no_pose_of_many_spoiled_plates_is_wrong_beyond_its_claim(seed: int) -> None:
    """Four films of six robots, 14 times 300 pictures each: a robot is seen 100,800 times."""
    film = Film.render(seed, frames=50)
    _check([pose for draw in range(2, 16) for pose in spoiled_poses(film, 100 * seed + draw, frames=300)])
