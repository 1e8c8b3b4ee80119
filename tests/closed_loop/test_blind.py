"""A mission in a pool of which nobody can tell what lies in it: policy `mission.blind`. Poses are fresh all the time."""

from dataclasses import replace

import pytest

from groundstation.mission.state_machine import MissionState
from groundstation.telemetry import findings
from shoal.config.experiment import load_experiment
from shoal.messages.messages import Mode
from tests.closed_loop.crewed_pool import CrewedPool

pytestmark = pytest.mark.long

LAMP = "the light changed or the camera moved"


class DimPool(CrewedPool):
    """`blind` is what the localizer says of itself; a localizer that is not `telling` tells of poses only."""

    blind, telling = "", True

    def expose(self, stamp_ns: int) -> None:
        super().expose(stamp_ns)
        if self.watched and self.watched[-1].instant_ns == stamp_ns:
            watched = self.watched.pop()
            if self.telling:
                self.watched.append(replace(watched, obstacles=replace(watched.obstacles, blind=self.blind)))


def flying(*settings: str) -> DimPool:
    pool = DimPool(load_experiment("pool", ["duration_s=30", *settings]), automatic=True)
    pool.until(MissionState.RUNNING, within_s=5.0)
    pool.run(1.0)
    assert pool.mission.state is MissionState.RUNNING
    return pool


def alarms(pool: DimPool) -> set[str]:
    return {f.text for r, view in pool.fleet().items() for f in findings(pool.experiment, r, view) if f.key == "blind"}


def test_robots_hold_while_the_localizer_is_blind_and_go_on_when_it_sees_again() -> None:
    pool = flying()
    assert alarms(pool) == set()
    pool.blind = LAMP
    pool.until(MissionState.PAUSED, within_s=0.5)
    assert pool.mission.reason == f"robots 1, 2 blind: {LAMP}"
    assert alarms(pool) == {f"blind: {LAMP}"}
    pool.run(3.0)
    assert pool.mission.state is MissionState.PAUSED
    assert [robot.agent.mode for robot in pool.robots] == [Mode.HOLDING] * 2
    reached_s = pool.mission.plans.progress_s
    pool.blind = ""
    pool.until(MissionState.RUNNING, within_s=3.0)
    assert reached_s <= pool.mission.plans.progress_s < reached_s + 2.0, "they go on from where they stopped"
    assert alarms(pool) == set()


def test_robots_hold_when_nobody_tells_of_obstacles_any_more() -> None:
    pool = flying()
    pool.telling = False
    pool.run(0.4)
    assert pool.mission.state is MissionState.RUNNING
    pool.until(MissionState.PAUSED, within_s=0.5)
    assert pool.mission.reason == "robots 1, 2 blind: nobody tells of obstacles any more"


def test_with_warn_they_fly_on_and_the_alarm_is_there() -> None:
    pool = flying('mission.blind="warn"')
    pool.blind = LAMP
    pool.run(2.0)
    assert pool.mission.state is MissionState.RUNNING
    assert alarms(pool) == {f"blind: {LAMP}"}


@pytest.mark.parametrize(("policy", "phase"), [("hold", MissionState.WAITING), ("warn", MissionState.RUNNING)])
def test_robots_do_not_arm_while_the_localizer_learns_unless_allowed(policy: str, phase: MissionState) -> None:
    pool = DimPool(load_experiment("pool", ["duration_s=30", f"mission.blind={policy}"]), automatic=True)
    pool.blind = "the localizer learns what the water looks like"
    pool.run(4.0)
    assert pool.mission.state is phase
    assert (pool.blind in pool.mission.reason) == (policy == "hold")


def test_localizer_told_to_watch_for_nothing_is_not_blind() -> None:
    pool = DimPool(load_experiment("pool", ["duration_s=30", "localizer.obstacle_min_m=0"]), automatic=True)
    pool.run(4.0)
    assert not pool.watched and alarms(pool) == set()
    assert pool.mission.state is MissionState.RUNNING


def test_a_robot_keeps_away_from_where_an_unseen_pole_may_be() -> None:
    """The localizer goes silent about everything but poses, and the mission flies on."""
    pool = flying('mission.blind="warn"', "sim.drifters=[{start_m=[0.9,-0.75,0.3]}]")
    agent, radius_m = pool.robots[0].agent, pool.experiment.safety.radius_m
    (obstacle,) = agent.obstacles(agent.inputs, pool.now_ns)
    pool.telling = False
    pool.run(6.0)
    (kept,) = agent.obstacles(agent.inputs, pool.now_ns)
    assert obstacle.clearance_m == radius_m
    assert kept.clearance_m == pytest.approx(radius_m + pool.experiment.safety.bubble_max_m)
    assert abs(kept.centre - obstacle.centre) < 0.08, "it lay still, as far as noise can tell"
