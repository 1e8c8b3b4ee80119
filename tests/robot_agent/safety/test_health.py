"""Reasons not to arm, and the memory of health from mode to mode."""

from dataclasses import replace

import numpy as np
import pytest

from robot_agent.control.any_controller import make_controller
from robot_agent.control.controller import ControlOutput, Setting
from robot_agent.control.nonlinear.tuning import horizon_s
from robot_agent.inputs import Inputs, StampedPose, StationView
from robot_agent.safety.health import ARM_AGAIN_S, DISARM_S, HealthMonitor
from robot_agent.safety.sensor_checks import LEVEL_MPS2
from robot_agent.vehicle.estimate import Observation, StateMeasurement
from shoal.config.experiment import load_experiment
from shoal.messages.messages import BoardReading, Control, Estimate, Guidance, Mode, Pose, Track

POOL = load_experiment("pool")
NOW_NS, MS = 10_000_000_000, 1_000_000
POSE = Pose(0.0, 0.0, 0.0, 1e-6 * np.eye(3), Track.MARKER, True, 0.9, 0.3)
BOARD = BoardReading(
    board_ms=10_000, arrival_ns=NOW_NS - 20 * MS, acceleration_mps2=np.array(LEVEL_MPS2), battery_v=12.4, battery_reports=1,
    echo_us=(1500,) * 8,
)  # fmt: skip
STATION = StationView(7, NOW_NS, 0.03)
WELL = Inputs(StampedPose(POSE, NOW_NS - 40 * MS), BOARD, STATION)
CONTROLLER = make_controller(Setting(POOL.vehicle, POOL.controller, POOL.safety))
OUTPUT = CONTROLLER.step(StateMeasurement(), None, (), NOW_NS)


def observation(aside_m: float) -> Observation:
    """At rest, beside the place (0, 0)."""
    estimate = Estimate(eta=np.array([0.0, aside_m, 0.3, 0.0]))
    return Observation(estimate, np.zeros(4), 0j, np.zeros(12), pose_age_s=0.0, depth_age_s=0.02)


def unfit(inputs: Inputs, station: StationView = STATION) -> str:
    monitor = HealthMonitor(POOL)
    monitor.note_inputs(inputs, Mode.DISARMED, NOW_NS)
    monitor.note_output(OUTPUT._replace(observation=observation(0.0)), Mode.DISARMED, NOW_NS)
    return monitor.arming_refusal(inputs, station, NOW_NS)


def test_a_robot_that_is_well_arms() -> None:
    assert unfit(WELL) == ""


@pytest.mark.parametrize(
    ("inputs", "station", "reason"),
    [
        (replace(WELL, board=replace(BOARD, depth_m=POOL.pool.size_m[2] + 0.29)), STATION, ""),
        (replace(WELL, board=replace(BOARD, depth_m=-0.29)), STATION, ""),
        (replace(WELL, board=replace(BOARD, depth_m=POOL.pool.size_m[2] + 0.31)), STATION,
         "the depth sensor says 1.31 m in a pool of 1 m: check it, or its zero"),
        (replace(WELL, board=replace(BOARD, depth_m=-0.31)), STATION,
         "the depth sensor says -0.31 m in a pool of 1 m: check it, or its zero"),
        (replace(WELL, emergency_stop=True), STATION, "the emergency stop is down"),
        (WELL, StationView(7, NOW_NS, 1.01), "no station is heard"),
        (WELL, StationView(), "no station is heard"),
        (replace(WELL, board=BoardReading(battery_v=12.4)), STATION, "the thruster board was last heard inf s ago"),
        (replace(WELL, board=replace(BOARD, arrival_ns=NOW_NS - 200 * MS)), STATION,
         "the thruster board was last heard 0.20 s ago"),
        (replace(WELL, board=replace(BOARD, armed=True)), STATION, "the thruster board is still armed"),
        (replace(WELL, board=replace(BOARD, autopilot=12)), STATION,
         "autopilot 12 (PX4) is on the link, no thruster board: it takes pulses for a pilot's sticks"),
        (replace(WELL, board=replace(BOARD, autopilot=8)), STATION, ""),
        (replace(WELL, board=replace(BOARD, power_on_depth_m=0.2)), STATION,
         "the thruster board restarted at 0.20 m and took its depth zero there: restart it in air; or, if it was in air, "
         "confirm that on the robot with `robot-agent confirm-zero`"),
        (replace(WELL, board=replace(BOARD, power_on_depth_m=0.04)), STATION, ""),
        (replace(WELL, board=replace(BOARD, zero_in_question=True)), STATION,
         "the thruster board restarted, and its depth zero is in question: confirm it on the robot with "
         "`robot-agent confirm-zero`, or in air have it taken anew with `robot-agent confirm-zero --in-air`"),
        (replace(WELL, board=replace(BOARD, acceleration_mps2=np.array([0.0, -9.8, 0.0]))), STATION, ""),  # one sample
        (replace(WELL, pose=None), STATION, "the last pose is inf s old"),
        (replace(WELL, pose=StampedPose(POSE, NOW_NS - 200 * MS)), STATION, "the last pose is 0.20 s old"),
        (replace(WELL, pose=StampedPose(replace(POSE, track=Track.COAST), NOW_NS)), STATION, "the last pose is inf s old"),
        (replace(WELL, pose=StampedPose(replace(POSE, identity_verified=False), NOW_NS)), STATION,
         "its identity is not verified: no marker was read"),
        (replace(WELL, board=replace(BOARD, battery_v=0.0, battery_reports=0)), STATION,
         "the battery's voltage has not been told by the thruster board yet"),
        (replace(WELL, board=replace(BOARD, battery_v=10.4)), STATION,
         "the battery has 10.4 V, needs 10.8 V since it was below 10.5 V"),
        (replace(WELL, board=replace(BOARD, charge=3)), STATION,
         "the thruster board does not arm with this battery: charge state 3, 12.4 V"),
    ],
)  # fmt: skip
def test_reason_against_arming_is_told(inputs: Inputs, station: StationView, reason: str) -> None:
    assert unfit(inputs, station) == reason


def test_a_robot_that_leans_or_whose_accelerometer_is_turned_does_not_arm() -> None:
    monitor = HealthMonitor(POOL)
    for k in range(40):
        at_ns = NOW_NS - (40 - k) * 50 * MS
        board = replace(BOARD, arrival_ns=at_ns, acceleration_mps2=np.array([0.0, -9.8, 0.0]))
        monitor.note_inputs(replace(WELL, pose=StampedPose(POSE, at_ns), board=board), Mode.DISARMED, at_ns)
        monitor.note_output(OUTPUT._replace(observation=observation(0.0)), Mode.DISARMED, at_ns)
    reason = monitor.arming_refusal(replace(WELL, board=replace(board, arrival_ns=NOW_NS - MS)), STATION, NOW_NS)
    assert reason.startswith("accelerometer in doubt: off gravity by ")


def test_a_board_that_reports_disarmed_once_is_not_asked_to_arm() -> None:
    monitor = HealthMonitor(POOL)
    for k, armed in enumerate([True, False, False, True]):
        now_ns = NOW_NS + 500 * k * MS
        inputs = replace(WELL, board=replace(BOARD, armed=armed, heartbeats=(1, 2, 2, 3)[k]))
        monitor.note_inputs(inputs, Mode.TRACKING, now_ns)
        assert monitor.health(inputs, False, now_ns).board_disarmed_s < 1.5
        assert monitor.arming_command(armed, Mode.TRACKING, now_ns) is None
    for k, heartbeats in enumerate([4, 5]):
        inputs = replace(WELL, board=replace(BOARD, armed=False, heartbeats=heartbeats))
        monitor.note_inputs(inputs, Mode.TRACKING, NOW_NS + (2000 + 50 * k) * MS)
        assert (monitor.health(inputs, False, NOW_NS).board_disarmed_s > 1.5) is (k == 1)


def test_to_ask_how_a_robot_is_changes_nothing() -> None:
    monitor = HealthMonitor(POOL)
    wrong = replace(WELL, board=replace(BOARD, armed=True, echo_us=(1700,) * 8))
    monitor.note_pulses((1500,) * 8, NOW_NS - 1000 * MS)
    for k in range(3):
        monitor.note_inputs(wrong, Mode.TRACKING, NOW_NS + 50 * k * MS)
    later_ns = NOW_NS + 140 * MS
    verdicts = [monitor.health(wrong, False, later_ns) for _ in range(20)]
    assert verdicts == verdicts[:1] * 20 and verdicts[0].echo_wrong_s > 0.0
    assert monitor.arming_refusal(wrong, STATION, later_ns) == monitor.arming_refusal(wrong, STATION, later_ns)


def off_the_path(aside_m: float) -> ControlOutput:
    control = Control(eta_reference=np.array([0.0, 0.0, 0.3, 0.0]))
    return OUTPUT._replace(observation=observation(aside_m), control=control, is_free=True)


def risen_m(seconds: float, fastest_mps: float) -> float:
    """Way at a speed that rises for 2 s."""
    return fastest_mps * (0.25 * max(min(seconds, 2.0), 0.0) ** 2 + max(seconds - 2.0, 0.0))


@pytest.mark.parametrize(
    ("reference_mps", "follows_mps", "is_off"), [(0.2, 0.2, False), (0.0, 0.1, True), (0.2, 0.0, True), (-0.2, 0.0, True)]
)
def test_a_driven_robot_is_off_its_depth_if_it_does_not_follow(reference_mps: float, follows_mps: float, is_off: bool) -> None:
    """A person's stick rises slowly, so that the reference never leaps; a robot that follows is a second behind."""
    monitor = HealthMonitor(POOL)
    for at_s in np.arange(0.0, 6.0, 0.05):
        depth_m, before_m = (0.5 + risen_m(seconds, follows_mps) for seconds in (at_s - 1.0, at_s - 1.05))
        eta = np.array([0.0, 0.0, depth_m, 0.0])
        estimate = Estimate(eta=eta, nu=np.array([0.0, 0.0, (depth_m - before_m) / 0.05, 0.0]))
        control = Control(eta_reference=np.array([0.0, 0.0, 0.5 + risen_m(at_s, reference_mps), 0.0]))
        result = observation(0.0)._replace(estimate=estimate)
        output = OUTPUT._replace(observation=result, control=control)
        monitor.note_output(output, Mode.DRIVEN, NOW_NS + round(at_s * 1000.0) * MS)
    assert monitor.health(WELL, False, NOW_NS).off_depth is is_off


def test_a_robot_that_was_off_its_path_is_not_so_for_ever() -> None:
    monitor, now_ns = HealthMonitor(POOL), NOW_NS

    def fly(mode: Mode, seconds: float, aside_m: float) -> bool:
        nonlocal now_ns
        for _ in range(round(seconds / 0.05)):
            now_ns += 50 * MS
            monitor.note_inputs(WELL, mode, now_ns)
            monitor.note_output(off_the_path(aside_m), mode, now_ns)
        return monitor.health(WELL, False, now_ns).off_path

    assert not fly(Mode.TRACKING, 1.0, 0.0)
    assert fly(Mode.TRACKING, 2.0, 1.0)
    monitor.note_inputs(WELL, Mode.FAULT, now_ns)
    assert not monitor.health(WELL, False, now_ns).off_path
    assert not fly(Mode.TRACKING, 1.0, 0.0)


@pytest.mark.parametrize(("yaw_rad", "reason"), [(0.0, "held fast"), (np.pi, "")])
def test_a_robot_is_held_fast_by_poses_that_fit_its_estimate_alone(yaw_rad: float, reason: str) -> None:
    """Of a marker that is read the wrong way round nothing is concluded about the thrust."""
    monitor, now_ns = HealthMonitor(POOL, plan_period_s=0.1), NOW_NS
    pushes = (1700,) * 4 + monitor.neutral_us[4:]
    for k in range(60):
        now_ns += 50 * MS
        pose = StampedPose(replace(POSE, yaw_rad=yaw_rad), now_ns - 40 * MS)
        inputs = replace(WELL, pose=pose, board=replace(BOARD, arrival_ns=now_ns - 20 * MS))
        monitor.note_inputs(inputs, Mode.TRACKING, now_ns)
        monitor.note_pulses(pushes if k > 20 else monitor.neutral_us, now_ns)
        monitor.note_output(off_the_path(0.0), Mode.TRACKING, now_ns)
    assert monitor.health(inputs, False, now_ns).watch_reason == reason


@pytest.mark.parametrize("aside_m", [0.0, 1.0])
def test_a_robot_gives_way_until_nothing_has_been_in_its_way_for_half_a_horizon(aside_m: float) -> None:
    """Then it is back on its path, or on its way there. What it avoids near its path keeps it giving way."""
    monitor, now_ns, clears_s = HealthMonitor(POOL), NOW_NS, 0.5 * horizon_s(POOL.vehicle)

    def fly(seconds: float, avoids: bool, blocks: bool) -> Guidance:
        nonlocal now_ns
        for _ in range(round(seconds / 0.05)):
            now_ns += 50 * MS
            monitor.note_inputs(WELL, Mode.TRACKING, now_ns)
            output = off_the_path(aside_m)._replace(is_free=not avoids, avoids=avoids, path_is_blocked=blocks)
            monitor.note_output(output, Mode.TRACKING, now_ns)
        return monitor.guidance

    assert fly(1.0, False, False) is not Guidance.GIVING_WAY
    assert fly(2.0, True, True) is Guidance.GIVING_WAY
    assert fly(clears_s + 2.0, True, False) is Guidance.GIVING_WAY
    assert fly(0.5 * clears_s, False, False) is Guidance.GIVING_WAY
    assert fly(clears_s, False, False) is (Guidance.RETURNING if aside_m else Guidance.ON_PATH)


def test_an_estimate_that_ends_under_power_is_remembered_until_the_power_is_gone() -> None:
    monitor = HealthMonitor(POOL)

    def fly(mode: Mode, estimated: bool) -> bool:
        monitor.note_inputs(WELL, mode, NOW_NS)
        monitor.note_output(OUTPUT._replace(observation=observation(0.0) if estimated else None), mode, NOW_NS)
        return monitor.health(WELL, False, NOW_NS).estimate_ended

    assert not fly(Mode.HOLDING, False)  # there was none yet
    assert not fly(Mode.HOLDING, True)
    assert fly(Mode.HOLDING, False)
    assert fly(Mode.HOLDING, True)
    assert not fly(Mode.FAULT, True)
    assert not fly(Mode.ARMED, False)


def asked(modes: list[Mode], armed: list[bool], period_s: float = 0.05) -> list[bool | None]:
    monitor = HealthMonitor(POOL)
    pairs = zip(modes, armed, strict=True)
    return [monitor.arming_command(is_armed, mode, round(k * period_s * 1e9)) for k, (mode, is_armed) in enumerate(pairs)]


def test_every_step_disarms_for_half_a_second_when_the_power_is_taken_away() -> None:
    """Even within the time after which an order to arm is repeated, and though the board has not said that it is armed."""
    n = round(DISARM_S / 0.05)
    commands = asked([Mode.DISARMED] * 20 + [Mode.ARMED] * 2 + [Mode.STOPPED] * 30, [False] * 52)
    assert commands[20:22] == [True, None]
    assert commands[22 : 22 + n] == [False] * n
    assert commands[22 + n :] == [None] * (30 - n)


def test_a_program_that_begins_disarms_its_board_first() -> None:
    n = round(DISARM_S / 0.05)
    assert asked([Mode.DISARMED] * (n + 5), [False] * (n + 5)) == [False] * n + [None] * 5


def test_a_board_that_stays_armed_is_told_again_and_again() -> None:
    commands = asked([Mode.DISARMED] * 60, [True] * 60)[20:]
    assert commands.count(False) == round(40 * 0.05 / ARM_AGAIN_S) and True not in commands


def test_a_board_that_does_not_arm_is_asked_again_and_not_at_every_step() -> None:
    commands = asked([Mode.ARMED] * 21, [False] * 21)
    assert commands.count(True) == 1 + round(20 * 0.05 / ARM_AGAIN_S) and False not in commands
