"""Ways around islands against closed forms and a search on a fine grid that shares no code with them."""

import math

import numpy as np
import pytest
from scipy.interpolate import CubicSpline
from scipy.sparse import coo_array
from scipy.sparse.csgraph import dijkstra

from groundstation.planning.route_planner import NoRoute, find_route
from shoal.frames import Array

WIDE = (8.0, 8.0)
START, GOAL = (-7.0, -7.0), (7.0, 7.0)
GRID_M = 0.1


def length(points: Array) -> float:
    return float(np.hypot(*np.diff(points, axis=0).T).sum())


def flown(points: Array) -> Array:
    """The spline through the waypoints, a point every few millimetres."""
    knots = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(points, axis=0).T))])
    return np.asarray(CubicSpline(knots, points, bc_type="natural")(np.linspace(0.0, knots[-1], 4000)))


def world(random: np.random.Generator) -> Array:
    """Discs of a few islands as three robots in a line see them."""
    count = int(random.integers(1, 7))
    islands = np.column_stack([random.uniform(-6, 6, (count, 2)), random.uniform(0.3, 1.5, count)])
    return np.concatenate([islands + np.array([0.0, -y, 0.3]) for y in (-0.8, 0.0, 0.8)])


def grid_length(discs: Array, half_m: float) -> float:
    """Shortest way on a grid with 16 directions: at most 2.8 % too long, infinite if there is none."""
    axis = np.arange(-half_m, half_m + GRID_M / 2, GRID_M)
    x, y = np.meshgrid(axis, axis, indexing="ij")
    free = np.all(np.hypot(x[..., None] - discs[:, 0], y[..., None] - discs[:, 1]) >= discs[:, 2], axis=2)
    number = np.arange(x.size).reshape(x.shape)
    rows, columns, costs = [], [], []
    for dx, dy in ((1, 0), (0, 1), (1, 1), (1, -1), (2, 1), (1, 2), (2, -1), (1, -2)):
        a = (slice(0, len(axis) - dx), slice(max(0, -dy), len(axis) - max(0, dy)))
        b = (slice(dx, len(axis)), slice(max(0, dy), len(axis) - max(0, -dy)))
        both = free[a] & free[b]
        rows.append(number[a][both])
        columns.append(number[b][both])
        costs.append(np.full(int(both.sum()), math.hypot(dx, dy) * GRID_M))
    edges = (np.concatenate(costs), (np.concatenate(rows), np.concatenate(columns)))
    ends = [int(number[round((p[0] + half_m) / GRID_M), round((p[1] + half_m) / GRID_M)]) for p in (START, GOAL)]
    graph = coo_array(edges, shape=(x.size, x.size)).tocsr()
    return float(dijkstra(graph, directed=False, indices=np.array(ends[:1]))[0, ends[1]])


def test_a_route_without_obstacles_is_a_straight_line() -> None:
    points = find_route([START, GOAL], np.zeros((0, 3)), WIDE)
    assert length(points) == pytest.approx(14.0 * math.sqrt(2.0))
    assert np.abs(points[:, 0] - points[:, 1]).max() < 1e-12


def test_ends_stay_however_short_the_way() -> None:
    for length_m in (0.02, 0.3, 0.8, 1.7):
        points = find_route([(0.0, 0.0), (length_m, 0.0)], np.array([[0.0, 3.0, 0.5]]), WIDE, smooth_m=2.0)
        assert np.abs(points[[0, -1]] - [(0.0, 0.0), (length_m, 0.0)]).max() < 1e-12


@pytest.mark.parametrize("radius", [0.4, 1.0, 2.5])
def test_around_one_island_it_is_two_tangents_and_an_arc(radius: float) -> None:
    distance = 5.0
    points = find_route([(-distance, 0.0), (distance, 0.0)], np.array([[0.0, 0.0, radius]]), WIDE)
    exact = 2.0 * math.sqrt(distance**2 - radius**2) + radius * (math.pi - 2.0 * math.acos(radius / distance))
    assert exact <= length(points) * 1.001 and length(points) < 1.02 * exact


@pytest.mark.parametrize("seed", range(40))
def test_routes_in_random_worlds_are_clear_and_short(seed: int) -> None:
    discs = world(np.random.default_rng(seed))
    for end in (START, GOAL):
        if np.any(np.hypot(*(discs[:, :2] - end).T) < discs[:, 2]):
            with pytest.raises(NoRoute, match="too near an island"):
                find_route([START, GOAL], discs, WIDE)
            return
    try:
        points = find_route([START, GOAL], discs, WIDE)
    except NoRoute:
        assert grid_length(discs + np.array([0.0, 0.0, 0.05]), 8.0) == math.inf
        return
    curve = flown(points)
    assert np.all(np.hypot(*(curve[:, None] - discs[:, :2]).transpose(2, 0, 1)) >= discs[:, 2] - 1e-6)
    assert np.abs(curve).max() <= 8.0 + 1e-9
    assert length(points) <= 1.05 * grid_length(discs, 8.0)


@pytest.mark.slow
def test_a_thousand_random_worlds_are_clear() -> None:
    refused = 0
    for seed in range(1000):
        discs = world(np.random.default_rng([seed, 1]))
        try:
            curve = flown(find_route([START, GOAL], discs, WIDE))
        except NoRoute:
            refused += 1
            continue
        assert np.all(np.hypot(*(curve[:, None] - discs[:, :2]).transpose(2, 0, 1)) >= discs[:, 2] - 1e-6), seed
    assert refused < 100


def test_it_goes_through_its_waypoints_in_order() -> None:
    via = [START, (3.0, -5.0), (-2.0, 4.0), GOAL]
    points = find_route(via, np.array([[0.0, 0.0, 1.5]]), WIDE)
    places = [int(np.argmin(np.hypot(*(points - p).T))) for p in via]
    assert places == sorted(places)
    assert all(np.hypot(*(points[i] - p)) < 0.5 for i, p in zip(places, via, strict=True))


def test_it_says_what_is_wrong() -> None:
    ring = np.array([[math.cos(a) * 3.0, math.sin(a) * 3.0, 1.0] for a in np.linspace(0.0, 2.0 * np.pi, 12)])
    with pytest.raises(NoRoute, match=r"no way from \(0\.00, 0\.00\) to \(7\.00, 0\.00\) m: the gaps"):
        find_route([(0.0, 0.0), (7.0, 0.0)], ring, WIDE)
    with pytest.raises(NoRoute, match=r"\(9\.00, 0\.00\) m: there the formation would touch a wall"):
        find_route([START, (9.0, 0.0)], ring, WIDE)
    with pytest.raises(NoRoute, match=r"\(3\.00, 0\.00\) m: there the formation is 1\.00 m too near an island"):
        find_route([START, (3.0, 0.0)], ring, WIDE)
    with pytest.raises(NoRoute, match=r"leads nowhere: all its places are \(1\.00, 2\.00\) m"):  # not what a spline says of it
        find_route([(1.0, 2.0), (1.0, 2.0)], np.zeros((0, 3)), WIDE)
    with pytest.raises(NoRoute, match="bends too sharply"):
        find_route([START, (1.0, 2.0), START], np.zeros((0, 3)), WIDE)


def test_walls_close_a_gap() -> None:
    """The way past an island is on the side where there is room."""
    island = np.array([[0.0, 1.0, 1.2]])
    points = find_route([(-3.0, 1.0), (3.0, 1.0)], island, (4.0, 2.0))
    assert points[:, 1].min() < -0.1
    with pytest.raises(NoRoute):
        find_route([(-3.0, 1.0), (3.0, 1.0)], np.array([[0.0, 1.0, 1.2], [0.0, -1.3, 1.2]]), (4.0, 2.0))
