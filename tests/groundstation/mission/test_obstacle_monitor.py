"""Obstacles as discs: which count, how wide they are, and from when on a path is changed for them."""

import numpy as np
import pytest

from groundstation.mission.mission import Mission
from groundstation.mission.obstacle_monitor import ObstacleMonitor, ObstacleSet, obstacle_set
from groundstation.planning.feasibility import PlanError
from groundstation.planning.segment import first_segment
from groundstation.telemetry import RobotView
from shoal.config.controller import Safety
from shoal.config.experiment import load_experiment
from shoal.messages.messages import Estimate, Mode, Obstacles, RobotState

SAFETY = Safety(bubble_mps=0.1, bubble_max_m=0.5)
SQUARE = 0.1 * np.array([(1, 1), (1, -1), (-1, -1), (-1, 1)] * 3) + [1.0, 2.0]  # corners 0.141 m from (1, 2)
REACH_M = 0.1 * np.sqrt(2.0)
S = 1_000_000_000


def _discs(velocity: tuple[float, float], unseen_s: float, since_s: float = 0.0) -> list[list[float]]:
    news = Obstacles((7,), SQUARE[None], np.array([velocity]), unseen_s=np.array([unseen_s]))
    present = obstacle_set(news, since_s, SAFETY)
    assert present.ids == ((7,) if len(present.discs) else ())
    discs: list[list[float]] = present.discs.tolist()
    return discs


@pytest.mark.parametrize(
    ("velocity", "unseen_s", "since_s", "disc"),
    [
        ((0.0, 0.0), 0.0, 0.0, (1.0, 2.0, REACH_M)),
        ((0.03, 0.04), 0.0, 0.0, (1.0, 2.0, REACH_M)),
        ((0.03, 0.041), 0.0, 0.0, None),  # faster: it will be elsewhere
        ((0.3, 0.4), 0.25, 0.25, None),  # and it is not old yet
        ((0.3, 0.4), 0.35, 0.25, (1.09, 2.12, REACH_M + 0.15 + 0.01)),  # half of the drift of 0.3 m, and 0.1 s of growth
        ((0.0, 0.0), 1.5, 0.0, (1.0, 2.0, REACH_M + 0.1)),
        ((0.0, 0.4), 60.0, 0.0, (1.0, 2.25, REACH_M + 0.25 + 0.5)),  # neither drifts nor grows further than a silent robot
    ],
)
def test_an_obstacle_that_lies_still_or_is_not_seen_any_more_is_a_disc(
    velocity: tuple[float, float], unseen_s: float, since_s: float, disc: tuple[float, ...] | None
) -> None:
    assert _discs(velocity, unseen_s, since_s) == ([] if disc is None else [pytest.approx(disc)])


def test_a_path_is_changed_for_an_obstacle_that_was_seen_for_half_a_second_without_a_gap() -> None:
    monitor = ObstacleMonitor(load_experiment("pool"))
    one, both = np.array([[1.0, 0.0, 0.1]]), np.array([[1.0, 0.0, 0.1], [0.0, 1.0, 0.2]])
    monitor.update(ObstacleSet((4,), one), 0)
    monitor.update(ObstacleSet((4, 5), both), S // 4)
    assert len(monitor.discs_to_avoid((), S // 2 - 1)) == 0
    assert monitor.discs_to_avoid((), S // 2).tolist() == one.tolist()
    assert monitor.discs_to_avoid((), S).tolist() == both.tolist()
    monitor.update(None, S)  # nothing new: as before
    assert monitor.discs_to_avoid((), S).tolist() == both.tolist()
    monitor.update(ObstacleSet((5,), both[1:]), S)
    monitor.update(ObstacleSet((4, 5), both), 2 * S)
    assert monitor.discs_to_avoid((), 2 * S).tolist() == both[1:].tolist(), "4 was gone meanwhile"
    assert monitor.discs_to_avoid(()).tolist() == both.tolist(), "those of this instant"
    assert len(monitor.discs_to_avoid((), obstacles=False)) == 0


def test_a_lost_robot_is_a_disc_where_it_was_last_seen_and_none_if_it_never_was() -> None:
    experiment = load_experiment("pool", ["safety.bubble_max_m=0.4"])
    monitor = ObstacleMonitor(experiment)
    located = RobotView(RobotState(mode=Mode.FAULT, estimate=Estimate(np.array([0.5, -0.5, 0.3, 0.0]))), 9.0)
    assert monitor.discs_to_avoid((located, RobotView())).tolist() == [pytest.approx([0.5, -0.5, 0.7])]
    assert monitor.discs_to_avoid((located,), room_m=0.1).tolist() == [pytest.approx([0.5, -0.5, 0.4])]


def test_another_form_is_not_taken_into_what_lies_on_its_way() -> None:
    experiment = load_experiment("pool", ["duration_s=60"])
    segment = first_segment(experiment)
    starts = {robot: trajectory.eta[0] for robot, trajectory in segment.trajectories.items()}
    mission = Mission(experiment, segment, starts, False)
    fleet = dict.fromkeys(experiment.robot_ids, RobotView())
    make = mission.plans.form_plan("turn 30 over 10", 20.0, fleet, 2 * S)
    assert make().end_s > 20.0
    x, y = make().trajectories[1].eta[-1, :2]
    mission.plans.monitor.update(ObstacleSet((7,), np.array([[x, y, 0.1]])), 0)
    with pytest.raises(PlanError, match="something lies"):
        mission.plans.form_plan("turn 30 over 10", 20.0, fleet, 2 * S)()
