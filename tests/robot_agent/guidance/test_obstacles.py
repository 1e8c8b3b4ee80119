"""Obstacles as pieces: outlines covered, motion carried on, one's own hull taken for no obstacle."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from robot_agent.guidance.obstacles import SPACING_M, OwnHullFilter, is_inside, obstacles_from_message
from shoal.messages.messages import Obstacles
from tests.robot_agent.guidance.expectations import NS


def box(x: float, y: float, half_x: float, half_y: float, velocity: tuple[float, float] = (0.0, 0.0)) -> Obstacles:
    """Twelve corners, some of them twice, as the localizer sends them."""
    corners = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]], dtype=np.float64).repeat(3, axis=0)
    outline = np.array([x, y]) + corners * [half_x, half_y]
    return Obstacles((7,), outline[None], np.array([velocity]), 0.3, 1.0, unseen_s=np.zeros(1))


@given(st.floats(0.05, 1.0), st.floats(0.02, 1.0), st.floats(0.0, 6.28), st.floats(0.2, 1.5))
def test_a_place_is_as_far_from_the_pieces_as_from_the_box(half_x: float, half_y: float, angle: float, off: float) -> None:
    """To 1 cm where it matters, at 0.3 m and beyond; the distance to a box is known in closed form."""
    (obstacle,) = obstacles_from_message(box(0.0, 0.0, half_x, half_y), 0, 0.3)
    place = (half_x + half_y + off) * np.exp(1j * angle)
    outside = np.maximum(np.abs([place.real, place.imag]) - [half_x, half_y], 0.0)
    from_box = float(np.hypot(*outside))
    distance_m = float(np.abs(place - obstacle.edge_points).min())
    assert not is_inside((place - obstacle.edge_points)[None])[0]
    assert from_box - 1e-9 <= distance_m <= np.hypot(from_box, SPACING_M / 2.0) + 1e-9
    assert not obstacle.overlaps(complex(place), 0.15, 0)


def test_drifting_obstacle_is_expected_where_it_will_be() -> None:
    (obstacle,) = obstacles_from_message(box(1.0, 0.0, 0.1, 0.1, (0.0, 0.05)), NS, 0.3)
    assert obstacle.displacement(3 * NS) == pytest.approx(0.1j)


def test_a_place_within_the_outline_is_inside() -> None:
    (obstacle,) = obstacles_from_message(box(0.0, 0.0, 0.5, 0.25), 0, 0.3)
    places = np.array([0.03 + 0.2j, 0.45 - 0.01j, 0.6 + 0.0j])
    assert is_inside(places[:, None] - obstacle.edge_points).tolist() == [True, True, False]


@pytest.mark.parametrize("place", [0.0, 0.05 + 0.1j, 0.35, 0.2 - 0.3j])
def test_obstacle_at_the_robots_place_is_the_robot_itself(place: complex) -> None:
    (obstacle,) = obstacles_from_message(box(0.0, 0.0, 0.25, 0.25), 0, 0.3)
    assert obstacle.overlaps(complex(place), 0.15, 0)


@pytest.mark.parametrize("poison", [np.nan, np.inf, 1e9])
def test_nonsense_is_no_obstacle(poison: float) -> None:
    bad = box(1.0, 0.0, 0.1, 0.1)
    bad.outline[0, 3, 1] = poison
    assert obstacles_from_message(bad, 0, 0.3) == ()
    assert obstacles_from_message(Obstacles(), 0, 0.3) == ()


@pytest.mark.parametrize(("speed_mps", "believed"), [(2.1, 2.0), (-5.0, -2.0), (1e9, 2.0), (np.nan, 0.0), (np.inf, 0.0)])
def test_obstacle_faster_than_anything_can_be_is_kept(speed_mps: float, believed: float) -> None:
    """An arm in the water, or an outline that grows at once: the slope of its middle is no reason to swim into it."""
    (obstacle,) = obstacles_from_message(box(1.0, 0.0, 0.1, 0.1, (speed_mps, 0.0)), 0, 0.3)
    assert obstacle.velocity == pytest.approx(believed) and obstacle.centre == pytest.approx(1.0)


def test_an_obstacle_that_drifts_against_the_hull_stays_one() -> None:
    """It was seen beside the robot before; one that never was is the robot itself."""
    own_hull = OwnHullFilter(0.15)
    square = np.array([[x, y] for x in (-0.1, 0.1) for y in (-0.1, 0.1)] * 3)
    looks = []
    for k, ball_x in enumerate((0.5, 0.3, 0.1, 0.0, 0.1, 0.5)):
        outlines = np.array([square + np.array([ball_x, 0.0]), square])
        obstacles = obstacles_from_message(Obstacles((7, 8), outlines, np.zeros((2, 2)), unseen_s=np.zeros(2)), k, 0.3)
        looks.append([obstacle.id for obstacle in own_hull.remove_own_hull(obstacles, 0j, k)])
    assert looks == [[7]] * 6


def test_an_obstacle_that_went_away_is_judged_anew() -> None:
    own_hull, square = OwnHullFilter(0.15), np.array([[x, y] for x in (-0.1, 0.1) for y in (-0.1, 0.1)] * 3)
    beside, on_top = (
        obstacles_from_message(
            Obstacles((7,), square[None] + np.array([x, 0.0]), np.zeros((1, 2)), unseen_s=np.zeros(1)), 0, 0.3
        )
        for x in (0.5, 0.0)
    )
    assert [len(own_hull.remove_own_hull(obstacles, 0j, 0)) for obstacles in (beside, on_top, (), on_top)] == [1, 1, 0, 0]
