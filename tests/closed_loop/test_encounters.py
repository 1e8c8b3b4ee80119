"""Robots whose paths run through one another, in the real plant: they leave their paths, pass, arrive."""

import numpy as np
import pytest

from groundstation.planning import planner
from shoal.config.experiment import load_experiment
from shoal.messages.messages import Mode
from sim_bridge.in_process.fleet import AgentFleet, DirectPlant
from tests.flights.encounters import SCENES, meet
from tests.flights.scene_flights import flew

pytestmark = pytest.mark.long


@pytest.mark.parametrize("name", SCENES)
def test_everyone_arrives_and_nobody_comes_near(name: str) -> None:
    experiment = load_experiment(name)
    flight = meet(experiment, 1)
    assert not flight.deadlock
    assert flight.nearest_m > 2.0 * experiment.safety.radius_m - 0.005
    assert flight.clear_m > experiment.vehicle.radius_m + 0.05


def test_robot_that_has_to_give_way_while_it_is_still_off_its_path_is_not_stopped() -> None:
    """It starts 7 cm off, falls 14 cm behind as its path sets off, and is never as fast as it before it has to turn aside."""
    assert not meet(load_experiment("crossing-2"), 72).deadlock


def test_robot_that_drives_off_before_others_are_in_its_way_is_stopped() -> None:
    fleet = flew(
        load_experiment(
            "swap", ["safety.watch_thrusters=false", "duration_s=10"], [f"t=2 thruster 1/{k} reversed" for k in (1, 2)]
        )
    )
    assert fleet.robots[0].states[-1].mode is Mode.FAULT


@pytest.mark.parametrize("apart_m", [0.31, 0.41])
def test_robots_that_begin_inside_one_another_s_space_come_out_of_it(apart_m: float) -> None:
    """The hardest first problem there is: no plan can fulfil it, and nothing is known to begin from."""
    experiment = load_experiment("numeric", ["duration_s=10", "safety.join_within_m=5"])
    trajectories = planner.plan(experiment)
    planned = planner.start_poses(experiment, trajectories)
    starts = np.array([planned[robot] for robot in experiment.robot_ids])
    starts[1] = starts[0] + [apart_m, 0.0, 0.0, 0.5]
    water = DirectPlant(experiment, 1, starts)
    fleet = AgentFleet(experiment, trajectories, water, 1)
    fleet.start()
    while fleet.time_s < 10.0:
        fleet.step()
        assert all(robot.states[-1].mode is Mode.TRACKING for robot in fleet.robots)
    place = np.array(fleet.truth)[:, :, :2]
    separation = np.hypot(*(place[:, 0] - place[:, 1]).T)
    assert separation.min() > apart_m - 0.02 and separation[-1] > 0.6
