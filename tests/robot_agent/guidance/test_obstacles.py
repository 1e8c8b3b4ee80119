"""Obstacles as pieces: outlines covered, motion carried on, one's own hull taken for no obstacle, half-spaces in the way."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from robot_agent.guidance.formation import Formation, Priority
from robot_agent.guidance.obstacles import SPACING_M, OwnHullFilter, island_obstacles, nearest_border, obstacles_from_message
from shoal.config.scene import Island
from shoal.messages.messages import Obstacles
from tests.robot_agent.guidance.expectations import CONFIG, NS, PERIOD_S, SAFETY, expecting

ALONE = Priority(False, 0.0)


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
    _, away, distance = nearest_border(obstacle, np.array([place]), [0])
    found = distance[0]
    assert (away[0] * place.conjugate()).real > 0.0
    assert from_box - 1e-9 <= found <= np.hypot(from_box, SPACING_M / 2.0) + 1e-9
    assert not obstacle.overlaps(complex(place), 0.15, 0)


def test_drifting_obstacle_is_expected_where_it_will_be() -> None:
    (obstacle,) = obstacles_from_message(box(1.0, 0.0, 0.1, 0.1, (0.0, 0.05)), NS, 0.3)
    near, _, _ = nearest_border(obstacle, np.array([0.0, 0.0j]), [NS, 3 * NS])
    assert near[0].imag == pytest.approx(0.0, abs=0.101) and near[1].imag == pytest.approx(0.0, abs=0.01)
    assert near[0].real == near[1].real == pytest.approx(0.9)
    assert obstacle.displacement(3 * NS) == pytest.approx(0.1j)


def test_inside_the_nearest_border_is_the_way_out() -> None:
    (obstacle,) = obstacles_from_message(box(0.0, 0.0, 0.5, 0.25), 0, 0.3)
    _, away, distance = nearest_border(obstacle, np.array([0.03 + 0.2j, 0.45 - 0.01j, 0.6 + 0.0j]), [0, 0, 0])
    assert away == pytest.approx(np.array([1j, 1.0, 1.0]), abs=0.7)
    assert distance == pytest.approx([-0.05, -0.05, 0.1], abs=0.03)


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


@pytest.mark.parametrize(("told", "believed"), [(2.1, 2.0), (-5.0, -2.0), (1e9, 2.0), (np.nan, 0.0), (np.inf, 0.0)])
def test_obstacle_faster_than_anything_can_be_is_kept(told: float, believed: float) -> None:
    """An arm in the water, or an outline that grows at once: the slope of its middle is no reason to swim into it."""
    (obstacle,) = obstacles_from_message(box(1.0, 0.0, 0.1, 0.1, (told, 0.0)), 0, 0.3)
    assert obstacle.velocity == pytest.approx(believed) and obstacle.centre == pytest.approx(1.0)


def test_half_spaces_keep_clear_of_a_box_that_comes() -> None:
    """It is 0.5 m away now, and at the end of the horizon its near side would be 2 cm behind the robot's place."""
    seen = obstacles_from_message(box(0.6, 0.0, 0.1, 0.1, (-0.208, 0.0)), 0, 0.3)
    formation = Formation(CONFIG, SAFETY, PERIOD_S)
    rows = formation.half_spaces(formation.predict_neighbours([], 0), expecting(0.0), ALONE, 0, seen)
    assert len(rows.node) == 5 and np.allclose(rows.normal.real, -1.0, atol=0.3)
    last = int(np.argmax(rows.node))
    assert rows.offset[last] == pytest.approx(-(0.5 - 0.208 * 2.5) + 0.3, abs=0.02)
    later = formation.half_spaces(formation.predict_neighbours([], 0), expecting(0.0), ALONE, -10 * NS, seen)
    assert len(later.node) == 0  # ten seconds ago it was 2.5 m away


def test_islands_are_kept_from_by_the_hull() -> None:
    known = island_obstacles([Island(position_m=(1.0, 0.0), radius_m=0.4)], 0.15)
    formation = Formation(CONFIG, SAFETY, PERIOD_S)

    def rows_at(x: float) -> int:
        return len(formation.half_spaces(formation.predict_neighbours([], 0), expecting(x), ALONE, 0, known).node)

    assert rows_at(0.35) == 0 and rows_at(0.41) == 5


def test_robots_and_things_share_the_rows_there_are() -> None:
    formation = Formation(CONFIG, SAFETY, PERIOD_S)
    crowd = [obstacles_from_message(box(0.2 + 0.02 * i, 0.0, 0.01, 0.01), 0, 0.3)[0] for i in range(6)]
    rows = formation.half_spaces(formation.predict_neighbours([], 0), expecting(0.0), ALONE, 0, crowd)
    assert len(rows.node) == formation.rows


def test_an_obstacle_that_drifts_against_the_hull_stays_one() -> None:
    """It was seen beside the robot before; one that never was is the robot itself."""
    own_hull = OwnHullFilter(0.15)
    square = np.array([[x, y] for x in (-0.1, 0.1) for y in (-0.1, 0.1)] * 3)
    looks = []
    for k, ball_x in enumerate((0.5, 0.3, 0.1, 0.0, 0.1, 0.5)):
        outlines = np.array([square + np.array([ball_x, 0.0]), square])
        seen = obstacles_from_message(Obstacles((7, 8), outlines, np.zeros((2, 2)), unseen_s=np.zeros(2)), k, 0.3)
        looks.append([obstacle.id for obstacle in own_hull.exclude(seen, 0j, k)])
    assert looks == [[7]] * 6


def test_an_obstacle_that_went_away_is_judged_anew() -> None:
    own_hull, square = OwnHullFilter(0.15), np.array([[x, y] for x in (-0.1, 0.1) for y in (-0.1, 0.1)] * 3)
    beside, on_top = (
        obstacles_from_message(
            Obstacles((7,), square[None] + np.array([x, 0.0]), np.zeros((1, 2)), unseen_s=np.zeros(1)), 0, 0.3
        )
        for x in (0.5, 0.0)
    )
    assert [len(own_hull.exclude(seen, 0j, 0)) for seen in (beside, on_top, (), on_top)] == [1, 1, 0, 0]
