"""Impossible depths and poses: whole control steps of an agent, on the rehearsal's robot."""

import itertools
from collections.abc import Callable, Iterator
from dataclasses import replace

import pytest

from robot_agent.agent import Outputs
from robot_agent.inputs import Inputs, StationView
from robot_agent.preflight.rehearsal import ARM_AFTER, DEPTH_M, STATION, rehearse
from robot_agent.safety.thruster_selftest import ThrusterSelftest
from robot_agent.vehicle.dynamics import Model
from robot_agent.vehicle.eso import Estimator
from robot_agent.vehicle.estimate import PoseMeasurement, StateMeasurement
from shoal.config.experiment import load_experiment
from shoal.messages.codec import Header
from shoal.messages.messages import Command, CommandKind, Mode, required

POOL = load_experiment("pool")
BAD = ARM_AFTER + 40  # the first step at which something is wrong
Change = Callable[[Inputs, int], Inputs]


def flown(change: Change, steps: int) -> Iterator[tuple[int, Outputs]]:
    """Step number and outputs of a robot that is armed, started, and told otherwise from BAD on."""
    for k, (agent, inputs, now_ns) in enumerate(itertools.islice(rehearse(POOL, 1), BAD + steps)):
        yield k, agent.step(change(inputs, k - BAD) if k >= BAD else inputs, now_ns)


def depth(inputs: Inputs, depth_m: float) -> Inputs:
    return replace(inputs, board=replace(inputs.board, depth_m=depth_m))


def test_one_bad_depth_is_flown_over() -> None:
    for k, outputs in flown(lambda inputs, n: depth(inputs, 10.0) if n == 0 else inputs, 20):
        if k >= BAD:
            assert (outputs.state.mode, outputs.state.fault) == (Mode.TRACKING, "")
            assert required(outputs.state.estimate).eta[2] == pytest.approx(DEPTH_M, abs=1e-3)


def test_a_depth_that_lasts_against_the_estimate_is_a_fault_that_names_both() -> None:
    for k, outputs in flown(lambda inputs, n: depth(inputs, 10.0), 20):
        if k >= BAD + 6:
            assert outputs.state.mode is Mode.FAULT and set(outputs.pulse_us) == {1500}
            assert outputs.state.fault == "depth in doubt: the sensor says 10.00 m, 0.30 m was believed"
        assert outputs.state.control is None or abs(outputs.state.control.wrench[1]) < 0.5  # it never rose to meet it


def test_depths_that_make_no_sense_at_all_are_no_depth() -> None:
    states = [o.state for _, o in flown(lambda inputs, n: depth(inputs, 1.0 + n), 20)]
    assert states[BAD + 7].mode is Mode.TRACKING and states[-1].mode is Mode.FAULT
    assert states[-1].fault.startswith("no depth: none that can be true for 0.5")


def test_a_robot_that_does_not_keep_its_depth_stops() -> None:
    """A dead ankle, or a thruster that only pushes ahead: the sensor is right, and the robot sinks at 5 cm/s."""
    sinking = [o.state for _, o in flown(lambda inputs, n: depth(inputs, DEPTH_M + 0.0025 * n), 100)]
    faults = [(k - BAD, state.fault) for k, state in enumerate(sinking) if state.mode is Mode.FAULT]
    assert faults[0][1] == "off its depth" and 60 <= faults[0][0] <= 80  # 0.15 m, and half a second more


def leapt(inputs: Inputs, by_m: float) -> Inputs:
    assert inputs.pose is not None
    return replace(inputs, pose=replace(inputs.pose, pose=replace(inputs.pose.pose, y_m=inputs.pose.pose.y_m + by_m)))


def test_a_place_that_has_to_be_given_up_means_hold_where_the_robot_is_now() -> None:
    holds = None
    for k, outputs in flown(lambda inputs, n: leapt(inputs, -0.6), 20):
        if k >= BAD + 6:
            assert outputs.state.mode is Mode.HOLDING and outputs.state.fault.startswith("position leapt: poses say (")
            holds = required(outputs.state.control).eta_reference if holds is None else holds
            assert abs(required(outputs.state.control).eta_reference - holds).max() == 0.0
    assert holds is not None


def test_poses_that_make_no_sense_at_all_are_no_pose() -> None:
    """Reflections here and there: nothing is corrected any more, so thrust goes by the model alone."""
    states = [o.state for _, o in flown(lambda inputs, n: leapt(inputs, 0.6 if n % 2 else -0.6), 12)]
    assert states[BAD + 7].mode is Mode.TRACKING
    assert (states[-1].mode, set(states[-1].pulse_us)) == (Mode.FAULT, {1500})
    assert states[-1].fault.startswith("no pose that can be true: for 0.")


@pytest.mark.parametrize(("depth_m", "why"), [(1.4, "the depth sensor says 1.40 m in a pool of 1 m"), (-0.4, "says -0.40 m")])
def test_a_robot_does_not_arm_on_a_depth_outside_the_pool(depth_m: float, why: str) -> None:
    for agent, inputs, now_ns in itertools.islice(rehearse(POOL, 1), ARM_AFTER - 2):
        outputs = agent.step(depth(inputs, depth_m), now_ns)
    command = Command(CommandKind.ARM, 1, 1.0, outputs.state.experiment_hash)
    reply = agent.handle_command(Header(STATION, 1, now_ns), command, StationView(STATION, now_ns, 0.0), now_ns)
    assert not reply.accepted and why in reply.reason


def test_a_robot_tells_whom_it_hears() -> None:
    experiment = load_experiment("fleet-20")
    for agent, inputs, now_ns in itertools.islice(rehearse(experiment, 7), 3):
        some = {robot: plan for robot, plan in inputs.plans.items() if robot in (2, 11)}
        outputs = agent.step(replace(inputs, plans=some), now_ns)
    assert outputs.plan is not None and outputs.plan.heard == (2, 11)


def test_no_thrust_is_asked_of_a_board_that_is_not_armed() -> None:
    """It would put out none, and the estimator would take what lacks for a disturbance."""
    for agent, inputs, now_ns in itertools.islice(rehearse(POOL, 1), ARM_AFTER + 10):
        outputs = agent.step(replace(inputs, board=replace(inputs.board, armed=False)), now_ns)
    assert outputs.state.mode is Mode.TRACKING and outputs.state.control is None and set(outputs.pulse_us) == {1500}


def test_a_thruster_test_that_was_passed_counts_no_more_once_the_thrusters_are_in_doubt() -> None:
    """Preflight asks for one that was passed: nobody takes off again on what was so before they broke."""
    steps = rehearse(POOL, 1)
    for agent, inputs, now_ns in itertools.islice(steps, ARM_AFTER + 1):
        agent.step(inputs, now_ns)
    # through the order TEST the robot would have to go through every thruster first
    agent._selftest = ThrusterSelftest(POOL.vehicle, agent.neutral_us)
    # through the order TEST the robot would have to go through every thruster first
    agent._selftest.result = "passed"
    for agent, inputs, now_ns in itertools.islice(steps, 20):
        state = agent.step(inputs, now_ns).state
    assert (state.mode, state.thruster_test) == (Mode.TRACKING, "passed")
    for agent, inputs, now_ns in itertools.islice(steps, 20):
        stuck = replace(inputs.board, echo_us=(1900, *agent.neutral_us[1:]))
        state = agent.step(replace(inputs, board=stuck), now_ns).state
    assert (state.mode, state.fault, state.thruster_test) == (Mode.FAULT, "thruster board disobeys", "")


def test_a_thruster_test_that_was_passed_counts_no_more_for_another_board() -> None:
    """A board that restarted, or that was silent and may be another one, is one whose parameters are not known yet."""
    steps = rehearse(POOL, 1)
    for agent, inputs, now_ns in itertools.islice(steps, 5):
        agent.step(inputs, now_ns)
    # through the order TEST the robot would have to go through every thruster first
    agent._selftest = ThrusterSelftest(POOL.vehicle, agent.neutral_us)
    # through the order TEST the robot would have to go through every thruster first
    agent._selftest.result = "passed"
    tests = []
    for objection in ("", "the thruster board's parameters are not known yet: none so far", ""):
        agent, inputs, now_ns = next(steps)
        tests.append(agent.step(replace(inputs, board=replace(inputs.board, objection=objection)), now_ns).state.thruster_test)
    assert tests == ["passed", "", ""]


@pytest.mark.parametrize("testing", [False, True])
def test_a_thruster_that_runs_by_itself_is_noticed_before_the_start(testing: bool) -> None:
    """In ARMED, where people are nearest. A test says itself what it finds, and what it found stays."""
    agent = None
    for agent, inputs, now_ns in itertools.islice(rehearse(POOL, 1), ARM_AFTER):
        agent.step(inputs, now_ns)
    assert agent is not None
    agent.mode = Mode.ARMED
    if testing:
        # through the order TEST the robot would have to go through every thruster first
        agent._selftest = ThrusterSelftest(POOL.vehicle, agent.neutral_us)
    states = []
    for k in range(20):
        at_ns = now_ns + (k + 1) * 50_000_000
        echo_us = (1900, *agent.neutral_us[1:])
        board = replace(inputs.board, armed=True, echo_us=echo_us, board_ms=at_ns // 1_000_000, arrival_ns=at_ns)
        station, pose = StationView(STATION, at_ns, 0.0), replace(inputs.pose, instant_ns=at_ns) if inputs.pose else None
        states.append(agent.step(replace(inputs, board=board, station=station, pose=pose), at_ns).state)
    first = next(k for k, state in enumerate(states) if state.mode is Mode.FAULT)
    assert states[first].fault == "thruster board disobeys" and first <= (12 if testing else 6)
    assert states[-1].thruster_test.startswith("thruster 1 was asked for") is testing


@pytest.mark.parametrize("gyroscope", [True, False])
def test_one_bad_burst_is_judged_once_however_often_it_is_seen(gyroscope: bool) -> None:
    """Its depth contradicts, and so does its rate: nothing of it is kept."""
    period_ns = 50_000_000
    config = POOL.controller.estimator.model_copy(update={"use_imu_yaw_rate": gyroscope})
    observer = Estimator(Model(POOL.vehicle), config, 0.05)
    for k in range(60):
        now_ns = (k + 1) * period_ns
        bad = 40 <= k < 46  # the board is silent for 0.25 s after the bad burst
        pose = PoseMeasurement(now_ns - 20_000_000, 0.0, 0.0, 0.0, 2e-6)
        board_ns = 41 * period_ns if bad else now_ns
        estimate = observer.update(StateMeasurement(pose, 0.6 if bad else 0.3, 9.0 if bad else 0.0, board_ns), now_ns)
        assert estimate is not None and estimate.depth_leap == "" and abs(estimate.nu[3]) < 0.1
        observer.note_wrench((0.0, 0.0, 0.0), now_ns)
