"""Whole missions flown in the dry pool: the station's decisions, the robots' programs, boards and water, one with another."""

import numpy as np
import pytest

from groundstation.mission.state_machine import MissionState
from groundstation.mission.timetable import START_IN_S
from groundstation.planning.segment import BESIDE_M, sample
from shoal.config.experiment import NO_CAMERA, load_experiment
from shoal.messages.messages import CommandKind, Mode, required
from sim_bridge.fault_schedule import ActuatorFaults
from tests.closed_loop.crewed_pool import CrewedPool

pytestmark = pytest.mark.long


def flying(scene: str, *settings: str) -> CrewedPool:
    pool = CrewedPool(load_experiment(scene, settings))
    pool.run(0.5)
    assert pool.request(CommandKind.START) == ""
    pool.until(MissionState.RUNNING, within_s=4.0)
    return pool


def test_everybody_comes_home_and_disarms() -> None:
    pool = flying("pool", "duration_s=60")
    pool.run(15.0)
    begin = len(pool.truth)
    assert pool.request(CommandKind.RETURN) == ""
    pool.until(MissionState.DONE, MissionState.FAILED, within_s=60.0)
    assert pool.mission.state is MissionState.DONE
    assert MissionState.RETURNING in pool.phases
    assert {robot.states[-1].mode for robot in pool.robots} == {Mode.DISARMED}
    for i, start in enumerate(pool.starts.values()):
        assert np.hypot(*(pool.truth[-1][i][:2] - start[:2])) < 0.1
    assert pool.separation_m(begin) > 0.6
    pool.run(1.0)
    assert np.all(pool.pulses[-1][:, :4] == 1500)


@pytest.mark.slow
def test_stopped_robot_comes_home_later() -> None:
    pool = flying("pool", "duration_s=60")
    pool.run(8.0)
    assert pool.request(CommandKind.DISARM) == ""
    pool.until(MissionState.CANCELLED, within_s=3.0)
    assert pool.mission.reason == "a person asked for disarm while running"
    pool.run(2.0)
    assert pool.request(CommandKind.RETURN) == ""
    pool.until(MissionState.RETURNING, within_s=5.0)
    pool.until(MissionState.DONE, within_s=60.0)
    for i, start in enumerate(pool.starts.values()):
        assert np.hypot(*(pool.truth[-1][i][:2] - start[:2])) < 0.1


@pytest.mark.parametrize("order", [pytest.param(CommandKind.HOLD, marks=pytest.mark.slow), CommandKind.STOP])
def test_on_the_way_home_one_can_hold_and_stop(order: CommandKind) -> None:
    pool = flying("pool", "duration_s=60")
    pool.run(10.0)
    pool.request(CommandKind.RETURN)
    pool.until(MissionState.RETURNING, within_s=15.0)
    assert pool.request(order) == ""
    pool.run(2.0)
    assert {robot.states[-1].mode for robot in pool.robots} == {Mode.HOLDING if order is CommandKind.HOLD else Mode.STOPPED}
    if order is CommandKind.HOLD:
        assert pool.request(CommandKind.RESUME) == ""
        pool.until(MissionState.DONE, within_s=60.0)


def test_a_start_that_one_robot_takes_late_keeps_it_in_step() -> None:
    """Half a second after the first order all set off; robot 2 gets its own 1.2 s after that order."""
    pool = CrewedPool(load_experiment("figure-eight"))
    pool.run(0.5)
    assert pool.request(CommandKind.START) == ""
    pool.until(MissionState.STARTING, within_s=3.0)
    first_ns = pool.now_ns
    pool.loses = lambda command: (
        command.robot == 2 and command.order is CommandKind.START and pool.now_ns < first_ns + 1_200_000_000
    )
    pool.until(MissionState.RUNNING, within_s=3.0)
    assert pool.now_ns >= first_ns + 1_200_000_000
    pool.run(2.0)
    assert pool.mission.state is MissionState.RUNNING and pool.mission.reason == ""
    reached = [robot.states[-1].trajectory_s for robot in pool.robots]
    assert np.ptp(reached) < 1e-9 and reached[0] == pytest.approx((pool.now_ns - first_ns) * 1e-9 - START_IN_S)


def test_a_robot_whose_clock_leaps_makes_all_hold_and_they_go_on_in_step() -> None:
    pool = CrewedPool(load_experiment("figure-eight"), automatic=True)
    pool.until(MissionState.RUNNING, within_s=4.0)
    pool.run(4.0)
    reached_s = pool.mission.plans.progress_s
    pool.ahead_ns[1] += 800_000_000
    pool.until(MissionState.PAUSED, within_s=1.0)
    assert pool.mission.reason == "robot 2 is 0.8 s ahead of the others"
    pool.until(MissionState.RUNNING, within_s=4.0)
    reached = [robot.states[-1].trajectory_s for robot in pool.robots]
    assert np.ptp(reached) < 1e-9 and 0.0 <= reached[0] - reached_s < 2.0  # 0.3 s until it was noticed, and the way to rest
    pool.run(1.0)
    assert pool.mission.state is MissionState.RUNNING


def test_when_one_robot_misses_a_switch_all_get_one_new_plan_before_they_go_on() -> None:
    pool = flying("blocked-path", "sim.drifters=[]")
    pool.run(4.0)
    pool.loses = lambda command: command.robot == 2 and command.order is CommandKind.SWITCH
    assert pool.request(CommandKind.GO, [(-2.0, 1.0)]) == ""
    pool.until(MissionState.PAUSED, within_s=4.0)
    assert "robot 2 has not gone over in time" in pool.mission.reason
    pool.run(1.0)
    assert {robot.states[-1].mode for robot in pool.robots} == {Mode.HOLDING}
    assert pool.request(CommandKind.RESUME) == ""
    assert "has another plan" in pool.mission.reason
    while pool.mission.state is not MissionState.RUNNING:
        pool.run(0.05)
        ids = {robot.states[-1].trajectory_id for robot in pool.robots if robot.states[-1].mode is Mode.TRACKING}
        assert ids <= {t.id for t in pool.mission.segment.trajectories.values()}  # nobody moves on what the others do not fly
    segment = pool.mission.segment
    assert {robot.states[-1].trajectory_id for robot in pool.robots} == {t.id for t in segment.trajectories.values()}
    later = [sample(t, np.array([segment.transfer_end_s + 5.0])).eta[0, :2] for t in segment.trajectories.values()]
    apart = [float(np.linalg.norm(later[a] - later[b])) for a, b in ((0, 1), (0, 2), (1, 2))]
    assert apart == pytest.approx([0.9] * 3, abs=0.01)  # one triangle, on one path


@pytest.mark.slow
def test_obstacle_on_a_robots_way_home_is_passed_around() -> None:
    pool = flying("blocked-path", "sim.drifters=[]")
    pool.run(10.0)
    assert pool.request(CommandKind.RETURN) == ""
    pool.until(MissionState.RETURNING, within_s=15.0)
    home = pool.mission.segment
    half_way = home.trajectories[1].eta[len(home.trajectories[1].eta) // 2, :2]
    pool.things = np.array([[*half_way, 0.05]])
    pool.until(MissionState.HALTING, within_s=2.0)
    assert "something lies at" in pool.mission.reason
    pool.until(MissionState.RETURNING, within_s=15.0)
    assert pool.mission.segment is not home
    for anew in pool.mission.segment.trajectories.values():
        away_m = np.hypot(*(anew.eta[:, :2] - half_way).T)
        assert away_m.min() > min(0.05 + pool.experiment.safety.radius_m, away_m[0]) - BESIDE_M
    pool.run(3.0)
    assert pool.mission.state is MissionState.RETURNING  # and not to rest once more


BALL = np.array([[1.0, 0.1, 0.2]])  # where blocked-path's own ball comes to lie


def jumps(pool: CrewedPool, begin: int, end: int) -> tuple[float, float, float]:
    """The largest jump in any robot's reference between two steps, in position, velocity and acceleration, beyond what the
    derivatives explain."""
    goal = np.array(pool.references[begin:end])
    p, v, a = goal[..., :3], goal[..., 4:7], goal[..., 8:11]
    return (
        float(np.abs(np.diff(p, axis=0) - 0.025 * (v[1:] + v[:-1])).max()),
        float(np.abs(np.diff(v, axis=0) - 0.025 * (a[1:] + a[:-1])).max()),
        float(np.abs(np.diff(a, axis=0)).max()),
    )


def test_a_formation_goes_round_what_comes_to_lie_on_its_path() -> None:
    pool = flying("blocked-path")
    pool.run(2.0)
    begin = len(pool.references)
    pool.run(9.0)
    pool.things = BALL
    pool.until(MissionState.SWITCHING, within_s=3.0)
    assert "something lies at (1.00, 0.10) m, on the path of robot" in pool.mission.reason
    pool.until(MissionState.RUNNING, within_s=3.0)
    pool.run(33.0)
    truth = np.array(pool.truth[begin:])
    assert truth[-1, :, 0].min() > 0.3 and MissionState.PAUSED not in pool.phases
    assert np.hypot(*(truth[:, :, :2] - BALL[0, :2]).transpose(2, 0, 1)).min() > 0.2 + pool.experiment.safety.radius_m + 0.2
    assert pool.separation_m(begin) > 0.85  # of 0.9: the triangle stays one
    position, velocity, acceleration = jumps(pool, begin, len(pool.references))
    assert position < 1e-4 and velocity < 1e-4 and acceleration < 0.015
    for robot in pool.robots:
        assert (
            max(np.hypot(*(required(s.estimate).eta - required(s.control).eta_reference)[:2]) for s in robot.states[begin:])
            < 0.04
        )


def test_where_there_is_no_way_round_it_holds_says_why_and_goes_on_when_it_is_clear() -> None:
    pool = CrewedPool(load_experiment("blocked-path", ["sim.drifters=[]"]), automatic=True)
    pool.until(MissionState.RUNNING, within_s=6.0)
    pool.run(3.0)
    pool.things = np.array([[0.0, y, 0.3] for y in np.arange(-4.0, 4.1, 0.5)])
    pool.until(MissionState.PAUSED, within_s=3.0)
    assert "no way round" in pool.mission.reason
    pool.run(4.0)
    assert {robot.states[-1].mode for robot in pool.robots} == {Mode.HOLDING}
    pool.things = np.zeros((0, 3))
    pool.until(MissionState.RUNNING, within_s=4.0)


@pytest.mark.slow
def test_a_person_sends_the_formation_elsewhere_under_way() -> None:
    pool = flying("blocked-path", "sim.drifters=[]")
    pool.run(4.0)
    begin = len(pool.references) - 20
    assert "where to?" in pool.request(CommandKind.GO)
    assert pool.request(CommandKind.GO, [(-2.0, 1.0)]) == ""
    pool.until(MissionState.RUNNING, within_s=4.0)
    pool.run(8.0)
    assert max(jumps(pool, begin, len(pool.references))[:2]) < 1e-4
    assert pool.mission.segment.via == ((-2.0, 1.0),)
    pool.run(12.0)
    centre = np.mean([truth[:2] for truth in pool.truth[-1]], axis=0)
    assert np.hypot(*(centre - [-2.0, 1.0])) < 0.05


def lagging(*settings: str) -> tuple[CrewedPool, float]:
    """A formation with a robot that has 0.3 of its thrust from 3 s on, and its worst error in the 14 s after that."""
    pool = flying("blocked-path", "sim.drifters=[]", "path.speed_mps=0.25", "duration_s=45", *settings)
    pool.run(3.0)
    healthy = pool.world.faults.actuators
    thrust = healthy.thrust.copy()
    thrust[1] = 0.3
    pool.world.faults.actuators = ActuatorFaults(thrust, healthy.sag_v)
    begin = len(pool.truth)
    pool.run(14.0)
    return pool, max(
        float(np.hypot(*(required(s.estimate).eta - s.control.eta_reference)[:2]))
        for s in pool.robots[1].states[begin:]
        if s.control is not None
    )


@pytest.mark.slow
def test_the_formation_waits_for_a_robot_that_lags() -> None:
    """Alone it falls behind until its watch stops it; where the others wait for it, all fly on."""
    without, far = lagging()
    waited, near = lagging("mission.wait_from_m=0.04", "mission.wait_at_m=0.15")
    assert without.mission.state is MissionState.FAILED and "robot 2: fault (off its path" in without.mission.reason
    assert without.mission.governor.lag_s == 0.0 and MissionState.SLOWED not in without.phases
    assert far > 0.3 and near < 0.15
    assert MissionState.SLOWED in waited.phases and waited.mission.governor.lag_s > 2.0
    assert {robot.states[-1].mode for robot in waited.robots} == {Mode.TRACKING}
    reached = [robot.states[-1].trajectory_s for robot in waited.robots]
    assert np.ptp(reached) < 1e-9  # all at the same place of the plan, though one is slow
    goal = np.array(waited.references[-300:])
    assert np.abs(np.diff(goal[..., 4:7], axis=0)).max() < 0.02  # m/s in a step: nobody's reference jumps


def lose(pool: CrewedPool, i: int) -> None:
    """The i-th robot's program dies; its board goes to neutral by itself."""
    pool.agents_work[i] = False


@pytest.mark.parametrize(
    ("policy", "ends_in"),
    [("abort", MissionState.FAILED), pytest.param("hold", MissionState.PAUSED, marks=pytest.mark.slow),
     pytest.param("go-on", MissionState.DEGRADED, marks=pytest.mark.slow), ("close-up", MissionState.DEGRADED)],
)  # fmt: skip
def test_a_robot_is_lost(policy: str, ends_in: MissionState) -> None:
    pool = flying("blocked-path", "sim.drifters=[]", f'mission.lost="{policy}"')
    pool.run(4.0)
    begin = len(pool.truth)
    lose(pool, 0)
    pool.until(ends_in, within_s=40.0)
    reasons = pool.mission.reason if policy != "abort" else " ".join(pool.reasons)
    assert "robot 1: silent" in reasons
    pool.run(4.0)
    modes = [robot.states[-1].mode for robot in pool.robots[1:]]
    flies = {MissionState.FAILED: Mode.DISARMED, MissionState.PAUSED: Mode.HOLDING, MissionState.DEGRADED: Mode.TRACKING}
    assert modes == [flies[ends_in]] * 2
    assert pool.separation_m(begin) > 0.5  # hulls touch at 0.3; who is out drifts
    if policy == "close-up":
        slots = {pool.mission.roster.slots[r] for r in (2, 3)}
        assert slots == {1, 2} and MissionState.HALTING in pool.phases
    assert np.all(pool.pulses[-1][0, :4] == 1500)


@pytest.mark.slow
def test_those_who_held_for_a_lost_robot_go_on_past_it_when_asked() -> None:
    """It coasts towards the place of the one before it, and lies there when a person lets the others go on. They keep clear of
    the end of its last plan too, as of all silent robots, before they are on their path."""
    pool = flying("blocked-path", "sim.drifters=[]", 'mission.lost="hold"')
    pool.run(6.0)
    lose(pool, 1)
    pool.until(MissionState.PAUSED, within_s=5.0)
    pool.run(8.0)
    begin = len(pool.truth)
    assert pool.request(CommandKind.RESUME) == ""
    pool.until(MissionState.DEGRADED, within_s=15.0)
    assert MissionState.RELOADING in pool.phases  # straight back to the plan, and they would have been beside it
    pool.run(30.0)
    assert pool.mission.state is MissionState.DEGRADED and "robot 2: silent" in pool.mission.reason
    assert {pool.robots[i].states[-1].mode for i in (0, 2)} == {Mode.TRACKING}
    assert pool.separation_m(begin) > 0.5
    for i in (0, 2):
        state = pool.robots[i].states[-1]
        error_m = (required(state.estimate).eta - required(state.control).eta_reference)[:2]
        assert np.hypot(*error_m) < 0.05


@pytest.mark.slow
@pytest.mark.parametrize("policy", ["go-on", "close-up"])
def test_a_robot_that_was_restarted_takes_its_place_again_when_asked(policy: str) -> None:
    pool = flying("blocked-path", "sim.drifters=[]", f'mission.lost="{policy}"')
    pool.run(4.0)
    lose(pool, 1)
    pool.until(MissionState.DEGRADED, within_s=40.0)
    pool.run(5.0)
    assert "robot 2: not heard" in pool.request(CommandKind.REJOIN)
    pool.restart(1)
    pool.run(1.0)
    assert pool.robots[1].states[-1].mode is Mode.DISARMED  # nothing arms it but a person's order
    begin = len(pool.truth)
    assert pool.request(CommandKind.REJOIN) == ""
    pool.until(MissionState.RELEASING, within_s=15.0)
    pool.until(MissionState.RUNNING, within_s=3.0)
    while pool.mission.plans.progress_s < pool.mission.segment.transfer_end_s + 5.0:
        pool.run(1.0)
    assert pool.mission.roster.lost == {} and {robot.states[-1].mode for robot in pool.robots} == {Mode.TRACKING}
    assert pool.separation_m(begin) > 0.5  # hulls touch at 0.3; who is out drifts
    goal = np.array(pool.references[-1])
    apart = [float(np.linalg.norm(goal[a, :2] - goal[b, :2])) for a, b in ((0, 1), (0, 2), (1, 2))]
    assert apart == pytest.approx([0.9] * 3, abs=0.01)  # the triangle is whole again
    for robot in pool.robots:
        assert (
            np.hypot(*(required(robot.states[-1].estimate).eta - required(robot.states[-1].control).eta_reference)[:2]) < 0.15
        )


def test_thrusters_are_tested_on_request_and_a_test_may_be_made_a_condition() -> None:
    pool = CrewedPool(load_experiment("pool", ["mission.thruster_test=true", "duration_s=20"]))
    pool.run(0.5)
    assert "robot 1: thruster test: not done (groundstation mission test)" in pool.request(CommandKind.START)
    assert pool.request(CommandKind.TEST) == ""
    pool.until(MissionState.TESTING, within_s=3.0)
    begin = len(pool.pulses)
    pool.until(MissionState.WAITING, within_s=10.0)
    moved = np.array(pool.pulses[begin:])[:, :, :4] != 1500
    assert np.all(moved.any(axis=0)) and moved.sum(axis=2).max() == 1  # every thruster of every robot, one at a time
    assert {robot.states[-1].mode for robot in pool.robots} == {Mode.DISARMED}
    assert pool.request(CommandKind.START) == ""
    pool.until(MissionState.RUNNING, within_s=4.0)


def test_robots_fly_their_own_way_into_another_form() -> None:
    """Plans kept 2R, robots give way at 2R and 0.12 m: they left such plans by up to 0.9 m, and flights failed."""
    corners = "points_m=[[-0.6,-0.6],[0.6,-0.6],[0.6,0.6],[-0.6,0.6]]"
    square = f'{{kind="waypoints",{corners},laps=2,speed_mps=0.12,depth_m=0.5,corner="stop"}}'
    three = ('formation={shape="line",spacing_m=0.8}', "robots=[{id=1},{id=2},{id=3}]", "pool.size_m=[6,4,1.5]", NO_CAMERA)
    pool = flying("pool", f"path={square}", *three, "article=[]", "duration_s=100")
    pool.run(12.0)
    assert pool.request(CommandKind.HOLD) == ""
    pool.until(MissionState.PAUSED, within_s=6.0)
    pool.run(4.0)
    assert pool.mission.request(CommandKind.FORMATION, pool.fleet(), pool.now_ns, text="triangle 0.8") == ""
    pool.until(MissionState.RUNNING, within_s=4.0)
    for _ in range(400):
        pool.step()
        for robot in pool.robots:
            state = robot.states[-1]
            off = required(state.estimate).eta - required(state.control).eta_reference
            assert np.hypot(*off[:2]) < 0.1
