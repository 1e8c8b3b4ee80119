"""Right of way in flight: true hulls, held against one another at every instant of the plant."""

from itertools import combinations

import numpy as np
import pytest

from groundstation.planning import planner
from shoal.config.experiment import Experiment, load_experiment
from shoal.messages.messages import CommandKind, Mode
from sim_bridge.in_process.fleet import AgentFleet, DirectPlant

pytestmark = pytest.mark.long

SETTINGS = ("controller.law=nmpc", "controller.estimator.kind=kalman", "controller.period_s=0.1", "duration_s=45.0")


class Meeting:
    """A scene in which robots meet, with the least distance of any two centres by the plant's truth."""

    def __init__(self, experiment: Experiment) -> None:
        trajectories = planner.plan(experiment)
        starts = planner.start_poses(experiment, trajectories)
        self.water = DirectPlant(experiment, 3, np.array([starts[robot] for robot in experiment.robot_ids]))
        self.fleet = AgentFleet(experiment, trajectories, self.water, 3)
        self.fleet.start()
        self.nearest_m = np.inf

    def step(self) -> float:
        """One control period; returns the distance of the first two."""
        self.fleet.step()
        truth = self.fleet.truth[-1]
        apart_m = [float(np.linalg.norm(truth[a, :3] - truth[b, :3])) for a, b in combinations(range(len(truth)), 2)]
        self.nearest_m = min(self.nearest_m, *apart_m)
        return apart_m[0]


def off_m(meeting: Meeting, robot: int) -> float:
    return float(np.hypot(*meeting.fleet.errors()[-1, robot, :2]))


def test_urgent_robot_goes_around_one_that_drifts_without_thrust() -> None:
    """The second is disarmed head on before it, and goes on with what speed it has, and a current."""
    plain = load_experiment("swap", (*SETTINGS, "sim.plant.current_mps=[0.0,0.01,0.0]"))
    urgent = plain.robots[0].model_copy(update={"urgent": True})
    meeting = Meeting(plain.model_copy(update={"robots": (urgent, *plain.robots[1:])}))
    second = meeting.fleet.robots[1]
    while meeting.step() > 2.0:
        assert meeting.fleet.time_s < 40.0
    assert second.plan is not None and not second.plan.plan.adrift
    assert meeting.fleet.order(CommandKind.DISARM, 1).accepted
    begin = meeting.fleet.truth[-1][1].copy()
    meeting.step()
    last_plan = second.plan.plan
    assert last_plan.adrift
    for _ in range(50):
        meeting.step()
    went = meeting.fleet.truth[-1][1] - begin
    assert np.hypot(*(last_plan.eta[26, :2] - begin[:2] - went[:2])) < 0.05 < np.hypot(*went[:2])  # 0.2 s a row
    while meeting.fleet.time_s < 44.0:
        meeting.step()
    assert meeting.nearest_m > 0.65  # the rule's distance; the half-spaces alone let it come to 0.616 m
    assert meeting.fleet.robots[0].agent.mode is Mode.TRACKING and off_m(meeting, 0) < 0.05


def test_two_that_exchange_places_keep_clear_and_are_back_soon() -> None:
    meeting, away_s = Meeting(load_experiment("swap", SETTINGS)), np.zeros(2)
    while meeting.fleet.time_s < 44.0:
        meeting.step()
        away_s += 0.1 * (np.array([off_m(meeting, robot) for robot in range(2)]) > 0.05)
    assert meeting.nearest_m > 0.6
    assert away_s.max() < 20.0 and max(off_m(meeting, robot) for robot in range(2)) < 0.05
