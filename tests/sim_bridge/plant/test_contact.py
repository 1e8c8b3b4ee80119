"""Contact with islands and among many."""

import numpy as np
import pytest

from shoal.config.experiment import load_experiment
from shoal.errors import ConfigError
from shoal.frames import Array
from sim_bridge.plant import kernels
from sim_bridge.plant.contact import ContactModel
from sim_bridge.plant.fleet import Plant

ISLAND = ("pool.size_m=[10,10,2]", "islands=[{position_m=[1.0,0.5],radius_m=0.4}]", "sim.plant.buoyancy_n=0")


def test_an_island_stops_a_robot_and_lets_it_slide_off() -> None:
    fleet = Plant(load_experiment("pool", ISLAND), 1)
    state = fleet.start(np.array([[-0.5, 0.5, 0.5, 0.0], [-0.5, -2.0, 0.5, 0.0]]))
    nearest = np.inf
    for _ in range(3000):
        state = fleet.step(state, np.tile([1700.0] * 4 + [1500.0] * 4, (2, 1)))
        nearest = min(nearest, float(np.hypot(*(state.eta[0, :2] - [1.0, 0.5]))))
    assert 0.4 + 0.15 - 0.03 < nearest < 0.4 + 0.15
    assert state.eta[1, 0] > 3.0  # the other one passes


def test_robot_that_starts_in_an_island_is_refused() -> None:
    fleet = Plant(load_experiment("pool", ISLAND), 1)
    with pytest.raises(ConfigError, match=r"robot 2: starts at \(1.3, 0.5, 0.5\), in a wall, an island or another robot"):
        fleet.start(np.array([[-0.5, 0.5, 0.5, 0.0], [1.3, 0.5, 0.5, 0.0]]))


def contact_force(basin: ContactModel, place_m: Array, velocity_mps: Array) -> Array:
    order, force = np.arange(len(place_m)), np.empty(place_m.shape)
    kernels.sort_by_x(place_m, order)
    kernels.contact_force(place_m, place_m, velocity_mps, order, basin.constants, force)
    return force


def test_a_crowd_pushes_like_any_pair() -> None:
    """Forces of many, found by a sweep along x, are the sums of the forces of their pairs; and they cancel."""
    random = np.random.default_rng(3)
    basin = ContactModel(load_experiment("pool", ["pool.walls=false"]))
    place, speed = random.uniform(-0.8, 0.8, (60, 3)), random.uniform(-0.5, 0.5, (60, 3))
    found = contact_force(basin, place, speed)
    expected, touching = np.zeros_like(place), set[int]()
    for i in range(len(place)):
        for j in range(i):
            expected[[i, j]] += contact_force(basin, place[[i, j]], speed[[i, j]])
            touching |= {i, j} if np.linalg.norm(place[i] - place[j]) < 0.3 else set()
    assert found == pytest.approx(expected, abs=1e-9)
    assert found.sum(axis=0) == pytest.approx(np.zeros(3), abs=1e-8)
    assert basin.touching(place) == sorted(touching)


def test_nearness_is_that_of_the_nearest_pair() -> None:
    """From 2 r + 0.1 m on hulls are near, however they lie; the sweep along x finds them as a table of all pairs does."""
    random = np.random.default_rng(5)
    basin = ContactModel(load_experiment("pool", ["pool.walls=false"]))
    answers = set()
    for _ in range(300):
        place, order = random.uniform(-1.5, 1.5, (12, 3)), random.permutation(12)
        kernels.sort_by_x(place, order)
        assert (np.diff(place[order, 0]) >= 0).all()
        apart = np.linalg.norm(place[:, None] - place, axis=2)[np.triu_indices(12, 1)]
        for margin_m in (0.1, 0.3):
            near = bool(apart.min() < 2 * 0.15 + margin_m)
            assert kernels.is_near(place, order, basin.constants, margin_m, np.empty((3, 12))) is near
            answers.add(near)
    assert answers == {True, False}


def test_nearness_is_not_forgotten_while_nobody_is_near() -> None:
    """Robots that swarm about: with the places remembered at which all were far apart, a step finds contact exactly where a
    search without any memory does. Now and then they are put anywhere."""
    random = np.random.default_rng(8)
    basin = ContactModel(load_experiment("pool", ["pool.size_m=[6, 5, 3]"]))
    n, fleet = 5, kernels.memory(5)
    memory = np.arange(n), fleet, np.empty((4, n, 3)), np.empty((n, 6)), np.empty((3, n)), np.full((1, 24), np.nan)
    place, speed, answers, searches = np.zeros((n, 3)), np.zeros((n, 3)), [], 0
    for step in range(4000):
        if step % 400 == 0:
            place = random.uniform([-2.8, -2.3, 0.2], [2.8, 2.3, 2.8], (n, 3))
        speed = 0.98 * speed + random.normal(0.0, 0.002, (n, 3)) - 0.0005 * (place - [0.0, 0.0, 1.2])
        place = place + speed
        kernels.to_fleet(np.column_stack([place, np.zeros(n)]), fleet, kernels.POSE)
        calm_m, order = memory[5].copy(), np.arange(n)
        near = kernels.begins_near(fleet, basin.constants, memory)
        kernels.sort_by_x(place, order)
        assert near is kernels.is_near(place, order, basin.constants, kernels.NEAR_M, np.empty((3, n)))
        answers.append(near)
        searches += near or not np.array_equal(calm_m, memory[5], equal_nan=True)
    assert 0.1 < np.mean(answers) < 0.9
    assert searches < 0.9 * len(answers)
