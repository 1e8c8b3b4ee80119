"""Agents, boards and water together, against the plant's truth."""

import math
from dataclasses import replace

import numpy as np
import pytest

from robot_agent.inputs import StampedPose
from shoal.config.experiment import load_experiment
from shoal.messages.messages import CommandKind, Mode, required
from sim_bridge.thruster_board.board import ThrusterBoard
from tests.closed_loop.dry_pool import DryPool

pytestmark = pytest.mark.long

NEUTRAL_US = 1500


def neutral_after_s(pool: DryPool, robot: int, since_step: int) -> float:
    """Time from a control step until the board's thruster outputs are neutral for good."""
    moving = [k for k in range(since_step, len(pool.pulses)) if np.any(pool.pulses[k][robot, :4] != NEUTRAL_US)]
    return (moving[-1] + 1 - since_step) * pool.period_ns * 1e-9 if moving else 0.0


def flying(seconds: float = 3.0) -> DryPool:
    pool = DryPool(load_experiment("pool", ["duration_s=60"]))
    pool.take_off()
    pool.run(seconds)
    assert [r.agent.mode for r in pool.robots] == [Mode.TRACKING] * 2
    return pool


@pytest.mark.parametrize("seed", [1, 2])
def test_the_pool_scene_is_flown_within_three_centimetres_and_smoothly(seed: int) -> None:
    pool = DryPool(load_experiment("pool", ["duration_s=32"]), seed)
    pool.take_off()
    pool.run(32.0)
    errors = pool.errors()
    settled = errors[400:]
    formation = errors[:, 0] - errors[:, 1]
    for error in (*errors.transpose(1, 0, 2), formation):
        assert np.all(np.sqrt(np.mean(error[:, :2] ** 2, axis=0)) < 0.07)  # the article's Table 6
        assert np.all(np.sqrt(np.mean(error[400:, :3] ** 2, axis=0)) < 0.03)
        assert np.all(np.abs(error[400:, :3]) < 0.08)
    still = np.linalg.norm(pool.errors()[400:, :, :2] - settled[:, :, :2].mean(axis=(0, 1)), axis=2)
    assert still.max() < 0.08
    steps = np.array([[required(s.control).wrench_step for s in robot.states[-240:]] for robot in pool.robots])
    bound = np.array(pool.experiment.wrench_step)
    assert np.all(np.abs(steps) <= bound + 1e-9)


def test_without_poses_a_robot_holds_within_200_ms_and_is_neutral_within_500() -> None:
    for phase in range(3):
        pool = flying(2.0 + phase * 0.35)
        pool.camera_works = False
        blind = len(pool.truth)
        pool.run(0.25)
        assert all(r.agent.mode is Mode.HOLDING for r in pool.robots)
        pool.run(2.0)
        assert all(r.agent.mode is Mode.FAULT for r in pool.robots)
        assert max(neutral_after_s(pool, i, blind) for i in range(2)) <= 0.5
        pool.camera_works = True
        pool.run(1.0)
        assert all(r.agent.mode is Mode.FAULT for r in pool.robots)  # poses alone bring nothing back


def test_a_dead_agent_leaves_a_neutral_board_within_350_ms_and_the_other_robot_flies_on() -> None:
    pool = flying()
    pool.agents_work[0] = False
    dead = len(pool.truth)
    pool.run(5.0)
    assert neutral_after_s(pool, 0, dead) <= 0.35
    assert pool.robots[1].agent.mode is Mode.TRACKING
    pool.agents_work[0] = True
    pool.run(3.0)
    assert pool.robots[0].agent.mode is Mode.FAULT  # its board has disarmed itself; that is not armed again unasked


def test_a_board_that_disarmed_itself_is_not_armed_again_unasked() -> None:
    """A computer that stalls for 0.4 s, while what it asks for is next to nothing: the board would arm if it were told to."""
    pool = flying()
    pool.agents_work[0] = False
    pool.run(0.4)
    assert not pool.world.boards[0].armed
    allocator = pool.robots[0].agent.controller.allocator
    allocator.allocate = lambda wrench: allocator.neutral()  # type: ignore[method-assign]
    pool.agents_work[0] = True
    pool.run(1.0)
    assert pool.robots[0].agent.mode is Mode.FAULT
    assert pool.robots[0].states[-1].fault == "thruster board disarmed"
    assert not any(required(state.board).armed for state in pool.robots[0].states[-15:])


def test_a_board_that_missed_the_first_request_to_arm_arms_at_a_later_one() -> None:
    """A board arms on neutral pulses only, and the station's START comes long before the second request."""
    pool = DryPool(load_experiment("pool"))
    link = pool.links[0]
    ask, requests = link.arm, []

    def missed_once(arm: bool) -> bytes:
        requests.append(arm)
        return ask(arm) if len(requests) > 1 else b""

    link.arm = missed_once  # type: ignore[method-assign]
    pool.take_off(start_in_s=1.0)
    pool.run(3.0)
    assert len(requests) > 1
    for robot in pool.robots:
        assert (robot.states[-1].mode, required(robot.states[-1].board).armed) == (Mode.TRACKING, True)
        assert robot.states[-1].trajectory_s > 1.0 and required(robot.states[-1].control).wrench.any()


def test_a_robot_told_to_hold_in_the_dark_holds_where_it_finds_itself() -> None:
    pool = DryPool(load_experiment("pool"))
    pool.run(0.5)
    assert pool.order(CommandKind.ARM, 0).accepted
    pool.run(0.5)
    pool.camera_works = False
    pool.run(1.5)
    pool.camera_works = True
    assert pool.order(CommandKind.HOLD, 0).accepted
    pool.expose(pool.now_ns)
    there = pool.truth[-1][0]
    pool.run(3.0)
    assert pool.robots[0].agent.mode is Mode.HOLDING
    assert required(pool.robots[0].states[-1].control).eta_reference[:3] == pytest.approx(there[:3], abs=0.05)
    assert pool.truth[-1][0, :3] == pytest.approx(there[:3], abs=0.06)


def test_a_robot_whose_pressure_sensor_dies_does_not_fly_on_by_its_last_depth() -> None:
    pool = flying()
    board = pool.world.boards[0]
    assert isinstance(board, ThrusterBoard)
    link = board.link
    read_pressure = link.pressure
    link.pressure = lambda board_ms, depth_m: read_pressure(board_ms, math.nan)  # type: ignore[method-assign]
    dead = len(pool.truth)
    pool.run(1.0)
    assert pool.robots[0].agent.mode is Mode.FAULT
    assert neutral_after_s(pool, 0, dead) <= 0.4
    assert pool.robots[1].agent.mode is Mode.TRACKING


def test_control_steps_that_are_late_three_times_in_a_row_end_in_neutral() -> None:
    pool = flying()
    agent = pool.robots[0].agent
    inputs = agent.inputs
    for late_steps, mode in ((2, Mode.TRACKING), (0, Mode.TRACKING), (3, Mode.FAULT)):
        outputs = agent.step(replace(inputs, late_steps=late_steps), pool.now_ns)
        assert outputs.state.mode is mode
    assert outputs.pulse_us[:4] == (NEUTRAL_US,) * 4


def test_a_robot_that_was_off_its_path_flies_again_when_it_is_told_to() -> None:
    """Its thrusters are dead for a while, and nobody watches them, nor its depth."""
    settings = ["duration_s=60", "safety.watch_thrusters=false", "safety.off_path_m=0.025", "robots.0.start_offset=[0,0,0,0]"]
    settings.append("safety.off_depth_m=5")
    pool = DryPool(load_experiment("pool", settings, [f"t=1 for=9 thruster 1/{k} dead" for k in (1, 2, 3, 4)]))
    world, step = pool.world, pool.world.step
    world.step = lambda until_ns=0: (world.apply_faults(), step(until_ns))[1]  # type: ignore[method-assign]
    pool.take_off()
    world.start_ns = world.now_ns
    agent, states = pool.robots[0].agent, pool.robots[0].states
    pool.run(10.5)
    assert agent.mode is Mode.FAULT and states[-1].fault.startswith("off its path: it does not move")
    reached_s = states[-1].trajectory_s
    assert pool.order(CommandKind.DISARM, 0).accepted
    pool.run(0.2)
    assert not required(states[-1].board).armed
    for order in (CommandKind.LOAD, CommandKind.ARM, CommandKind.HOLD):
        reply = pool.order(order, 0)
        assert reply.accepted, reply.reason
    pool.run(0.3)
    assert pool.order(CommandKind.START, 0, start_in_s=0.2, trajectory_s=reached_s).accepted
    pool.run(1.0)
    assert (agent.mode, states[-1].fault, required(states[-1].board).armed) == (Mode.TRACKING, "", True)
    assert required(states[-1].control).wrench.any()


def test_thrust_does_not_come_back_unasked_however_late_poses_may_be() -> None:
    """With ages that no experiment file may have: the estimate ends before the robot takes poses for missing."""
    experiment = load_experiment("pool")
    late = experiment.safety.model_copy(update={"pose_hold_s": 2.0, "pose_neutral_s": 3.0})
    pool = DryPool(experiment.model_copy(update={"safety": late}))
    pool.take_off()
    pool.run(2.0)
    pool.camera_works = False
    pool.run(1.5)
    pool.camera_works = True
    back = len(pool.pulses)
    pool.run(1.0)
    for robot in pool.robots:
        assert (robot.agent.mode, robot.states[-1].fault) == (Mode.FAULT, "estimate ended")
    assert all((pulses[:, :4] == NEUTRAL_US).all() for pulses in pool.pulses[back:])


def test_a_stop_right_after_an_arm_disarms_the_board_at_the_next_step() -> None:
    """Though the rate of requests is limited, and the board has not said yet that it is armed."""
    pool = DryPool(load_experiment("pool"))
    pool.run(1.0)
    assert pool.order(CommandKind.ARM, 0).accepted
    pool.run(0.05)
    assert pool.world.boards[0].armed
    assert pool.order(CommandKind.STOP, 0).accepted
    pool.run(0.05)
    assert not pool.world.boards[0].armed


@pytest.mark.parametrize("place", [{"x_m": 2.6, "y_m": 0.0}, {"x_m": 0.0, "y_m": -1.9}])
def test_a_pose_outside_the_pool_is_none(place: dict[str, float]) -> None:
    """Not even one that stays there for so long that the observer would believe it."""
    pool = flying()
    there = pool.pose

    def outside(i: int) -> StampedPose | None:
        newest = there(i)
        return newest and StampedPose(replace(newest.pose, x_m=place["x_m"], y_m=place["y_m"]), newest.instant_ns)

    pool.pose = outside  # type: ignore[method-assign]
    modes = []
    for _ in range(20):
        pool.run(0.05)
        state = pool.robots[0].states[-1]
        modes.append(state.mode)
        assert state.mode is Mode.FAULT or np.abs(required(state.estimate).eta[:2] - pool.truth[-1][0, :2]).max() < 0.05
    assert modes[:3] == [Mode.TRACKING] * 3 and modes[4] is Mode.HOLDING and modes[10:] == [Mode.FAULT] * 10


def test_a_step_is_due_when_the_pose_gets_too_old_for_what_the_robot_does() -> None:
    pool = flying()
    agent, safety = pool.robots[0].agent, pool.experiment.safety
    pool.camera_works = False
    pool.run(0.05)
    seen_ns = pool.poses[-1][0]
    hold_ns, neutral_ns = (seen_ns + round(limit_s * 1e9) + 1 for limit_s in (safety.pose_hold_s, safety.pose_neutral_s))
    deadlines = [(agent.react_by_ns, agent.mode)]
    for now_ns in (hold_ns - 1, hold_ns, neutral_ns - 1, neutral_ns):
        telemetry = replace(agent.inputs.board, arrival_ns=now_ns)
        agent.step(replace(agent.inputs, station=pool.station(), board=telemetry), now_ns)
        deadlines.append((agent.react_by_ns, agent.mode))
    assert deadlines[:2] == [(hold_ns, Mode.TRACKING)] * 2
    assert deadlines[2:] == [(neutral_ns, Mode.HOLDING)] * 2 + [(None, Mode.FAULT)]


def test_a_trajectory_that_leaves_the_pool_is_not_loaded() -> None:
    pool = DryPool(load_experiment("pool"))
    pool.run(0.5)
    good = pool.trajectories[1]
    eta = good.eta.copy()
    eta[-1, :3] = [1.76, 0.0, 0.3]
    eta[:-1] = eta[-1]
    pool.trajectories = {**pool.trajectories, 1: replace(good, eta=eta)}
    reply = pool.order(CommandKind.LOAD, 0)
    assert (reply.accepted, reply.reason) == (False, "trajectory.eta leaves the pool at 0.00 s")


def test_a_lost_station_means_hold_then_neutral_then_disarmed_and_no_way_back_by_itself() -> None:
    pool = flying()
    pool.station_works = False
    lost = len(pool.truth)
    pool.run(1.2)
    assert all(r.agent.mode is Mode.HOLDING for r in pool.robots)
    pool.run(2.2)
    assert all(r.agent.mode is Mode.FAULT for r in pool.robots)
    pool.run(7.0)
    assert all(r.agent.mode is Mode.DISARMED for r in pool.robots)
    assert 1.0 < max(neutral_after_s(pool, i, lost) for i in range(2)) <= 3.2
    pool.station_works = True
    pool.run(1.0)
    assert all(r.agent.mode is Mode.DISARMED for r in pool.robots)


def test_a_robot_that_never_heard_a_station_cannot_arm() -> None:
    pool = DryPool(load_experiment("pool"))
    pool.station_works = False
    pool.run(1.0)
    assert not pool.order(CommandKind.ARM, 0).accepted


def test_a_formation_that_held_goes_on_where_it_was() -> None:
    pool = flying(4.0)
    reached = pool.robots[0].states[-1].trajectory_s
    for robot in range(2):
        assert pool.order(CommandKind.HOLD, robot).accepted
    pool.run(4.0)
    assert pool.robots[0].states[-1].trajectory_s == pytest.approx(reached, abs=0.051)
    held = np.array(pool.truth[-80:])[:, :, :2]
    assert np.ptp(held, axis=0).max() < 0.10
    for robot in range(2):
        assert pool.order(CommandKind.RESUME, robot, start_in_s=0.3, trajectory_s=reached).accepted
    pool.run(2.3)
    assert [r.agent.mode for r in pool.robots] == [Mode.TRACKING] * 2
    times = [r.states[-1].trajectory_s for r in pool.robots]
    assert times[0] == pytest.approx(times[1], abs=1e-9)
    assert times[0] == pytest.approx(reached + 2.0, abs=0.051)


def test_a_current_of_the_robots_own_speed_is_ridden_out() -> None:
    pool = DryPool(load_experiment("pool", ["duration_s=32", "sim.plant.current_mps=[0.0, 0.014, 0.0]"]), 3)
    pool.take_off()
    pool.run(32.0)
    for i in range(2):
        assert np.all(np.sqrt(np.mean(pool.errors()[400:, i, :2] ** 2, axis=0)) < 0.04)


def test_a_robot_that_leaves_the_picture_says_so() -> None:
    """Its camera hangs elsewhere than the plan was told: the robot is at the picture's edge when poses stop coming."""
    pool = flying()
    aside = pool.experiment.camera.model_copy(update={"position_m": (-1.3, 0.0, -2.8)})
    # with another experiment from the beginning it would refuse the fleet's orders
    pool.robots[0].agent._experiment = pool.experiment.model_copy(update={"camera": aside})
    pool.camera_works = False
    pool.run(0.25)
    assert pool.robots[0].states[-1].fault == "pose late: it has left the camera's picture"
    assert pool.robots[1].states[-1].fault == "pose late"
    pool.run(0.5)
    assert pool.robots[0].states[-1].fault == "no pose: it has left the camera's picture"
