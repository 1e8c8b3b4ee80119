"""An island stops a robot and lets it slide off, and robots in a crowd push one another like any pair."""

import numpy as np
import pytest

from shoal.config.experiment import load_experiment
from shoal.errors import ConfigError
from shoal.frames import Array
from sim_bridge.plant.contact import ContactModel, hulls_force
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
    """Forces (n, 3) of level hulls with heading 0 on each other."""
    still = np.zeros_like(place_m)
    states = np.column_stack([place_m, still, velocity_mps, still])
    return np.array([hulls_force(basin.constants, states, i) for i in range(len(states))])


def test_a_crowd_pushes_like_any_pair() -> None:
    """Forces of many are the sums of the forces of their pairs; and they cancel."""
    random = np.random.default_rng(3)
    basin = ContactModel(load_experiment("pool", ["pool.walls=false"]))
    place, speed = random.uniform(-0.8, 0.8, (60, 3)), random.uniform(-0.5, 0.5, (60, 3))
    force = contact_force(basin, place, speed)
    expected, touching = np.zeros_like(place), set[int]()
    for i in range(len(place)):
        for j in range(i):
            expected[[i, j]] += contact_force(basin, place[[i, j]], speed[[i, j]])
            touching |= {i, j} if np.linalg.norm(place[i] - place[j]) < 0.3 else set()
    assert force == pytest.approx(expected, abs=1e-9)
    assert force.sum(axis=0) == pytest.approx(np.zeros(3), abs=1e-8)
    assert basin.touching(place) == sorted(touching)


def test_hulls_without_clearance_are_those_that_touch() -> None:
    """The experiment's distance to walls, floor and islands, against the plant's contact, for single hulls everywhere."""
    island = "islands=[{position_m=[0.5,0.4],radius_m=0.3}]"
    for walls in ("true", "false"):
        experiment = load_experiment("pool", [f"pool.walls={walls}", island])
        basin = ContactModel(experiment)
        place = np.random.default_rng(4).uniform([-1.9, -1.4, 0.0], [1.9, 1.4, 1.1], (2000, 3))
        touches = [bool(basin.touching(one[None])) for one in place]
        assert list(experiment.clearance_m(place) < 0.0) == touches and 0.05 < np.mean(touches) < 0.6
    assert np.isposinf(load_experiment("pool", ["pool.walls=false"]).clearance_m(place)).all()
