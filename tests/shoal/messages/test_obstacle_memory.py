"""Places where obstacles may be that are not seen any more."""

import numpy as np
import pytest

from shoal.config.controller import Safety
from shoal.messages.messages import Obstacles
from shoal.messages.obstacle_memory import BLIND, ages_s, blindness, drift_m, growth_m, swept

SAFETY = Safety(bubble_mps=0.1, bubble_max_m=0.5)
TURN = np.arange(12) * np.pi / 6
OUTLINE = 0.1 * np.column_stack([np.cos(TURN), np.sin(TURN)]) + [1.0, 2.0]


@pytest.mark.parametrize(("age_s", "grown_m"), [(0.0, 0.0), (0.5, 0.0), (1.5, 0.1), (5.5, 0.5), (600.0, 0.5)])
def test_the_space_grows_as_that_of_a_silent_robot_and_no_further(age_s: float, grown_m: float) -> None:
    assert growth_m(SAFETY, age_s) == pytest.approx(grown_m)


def test_an_obstacle_takes_up_the_ground_of_its_drift_and_no_more_than_it_may_grow() -> None:
    velocity = np.array([0.06, 0.08])
    assert drift_m(SAFETY, velocity, 2.0) == pytest.approx([0.12, 0.16])
    far = drift_m(SAFETY, velocity, 600.0)
    assert far == pytest.approx([0.3, 0.4])
    corners = swept(OUTLINE, far)
    sides = np.roll(corners, -1, axis=0) - corners
    for inside in (*OUTLINE, *(OUTLINE + 0.5 * far), *(OUTLINE + far)):
        off = inside - corners
        assert (sides[:, 0] * off[:, 1] - sides[:, 1] * off[:, 0]).min() > -1e-9
    across = np.array([-0.8, 0.6])
    assert np.ptp(corners @ across) < 0.22, "no wider than it was, but for the polygon's corners"


def test_ages_add_up_and_an_unknown_one_is_the_oldest() -> None:
    obstacles = Obstacles((4, 5, 6), np.stack([OUTLINE] * 3), np.zeros((3, 2)), unseen_s=np.array([0.0, 3.0, np.nan]))
    assert ages_s(obstacles, 0.25) == [0.25, 3.25, 1e6]
    assert ages_s(Obstacles((4,), OUTLINE[None], np.zeros((1, 2)), unseen_s=np.zeros(1)), 0.25) == [0.25]


def test_blindness_without_messages_with_old_ones_and_with_a_blind_localizer() -> None:
    assert blindness(None, 0.0) == BLIND
    assert blindness(Obstacles(), 0.4) == ""
    assert BLIND in blindness(Obstacles(), 0.6)
    assert blindness(Obstacles(blind="the light changed"), 0.1) == "the light changed"
