"""A robot's link and clock from message headers, and the findings about them."""

import math
from dataclasses import replace
from typing import Any, cast

import numpy as np
import pytest

from groundstation.telemetry import LinkMonitor, RobotView, findings, first_lost_robot, other_code
from shoal.bus.bus import Bus
from shoal.bus.memory_transport import MemoryHub, MemoryTransport
from shoal.config.experiment import load_experiment
from shoal.messages import topics
from shoal.messages.codec import Header, encode
from shoal.messages.messages import BoardReading, Control, Estimate, Mode, Plan, Pose, RobotState, Solve, StepTiming, Track

MS = 1_000_000


@pytest.mark.parametrize(("lost", "share"), [((), 0.0), ((3, 7), 0.2), ((2, 4, 6, 8), 0.4)])
def test_only_missing_sequence_numbers_count_as_lost(lost: tuple[int, ...], share: float) -> None:
    """Two messages between two looks, then none, again and again: a robot and a station that keep time alike."""
    inbox, ear = Bus(MemoryTransport(MemoryHub())).inbox(topics.PLAN, Plan, 1), LinkMonitor()
    for k in range(200):
        if k % 10 not in lost:
            inbox.store(Header(7, k + 1, k * 50 * MS), encode(Plan(0.05)))
        newest = inbox.newest()
        if k % 2 and newest is not None:
            ear.add(inbox.headers(), newest.header, (k * 50 - 3) * MS)
    assert ear.loss == pytest.approx(share, abs=0.02)
    assert 0.002 < ear.clock_offset_s < 0.004


@pytest.mark.parametrize(("limit", "key", "age_s"), [("pose_hold_s", "pose", 0.4), ("plan_max_age_s", "plan", 0.7)])
def test_message_ages_are_judged_by_the_experiments_limits(limit: str, key: str, age_s: float) -> None:
    """At a lower rate an experiment allows more; the station must not bar what the robots would fly with."""
    view = RobotView(
        RobotState(mode=Mode.HOLDING, board=BoardReading(battery_v=16.0), timing=StepTiming(board_age_ms=20.0)), 0.02,
        Pose(0.0, 0.0, 0.0, np.eye(3), Track.MARKER, True, 1.0, 0.0), age_s, age_s,
    )  # fmt: skip
    for limit_s, is_alarm in ((age_s - 0.1, True), (age_s + 0.1, False)):
        experiment = load_experiment("pool", [f"safety.{limit}={limit_s}", "safety.pose_neutral_s=0.9"])
        assert (key in [finding.key for finding in findings(experiment, 1, view)]) is is_alarm


UNHEARD_BATTERY = RobotState(timing=StepTiming(board_age_ms=20.0), board=BoardReading())


def test_an_unheard_battery_is_not_reported_empty() -> None:
    experiment = load_experiment("pool")
    alarms_by_key = {f.key: f for f in findings(experiment, 1, RobotView(UNHEARD_BATTERY, 0.02))}
    assert (alarms_by_key["battery"].text, alarms_by_key["battery"].blocks_arming) == ("battery not heard yet", True)
    low = {
        f.key: f
        for f in findings(
            experiment, 1, RobotView(RobotState(timing=StepTiming(board_age_ms=20.0), board=BoardReading(battery_v=9.0)), 0.02)
        )
    }
    assert low["battery"].text == "battery 9.0 V, needs 10.5 V"


@pytest.mark.parametrize(
    ("age_ms", "board", "text"),
    [
        (2500.0, BoardReading(5), "thruster board silent for 2.5 s"),
        (None, None, "thruster board not heard"),
        (None, BoardReading(5), "thruster board not heard"),
    ],
)
def test_a_board_never_heard_is_reported_without_an_age(age_ms: float | None, board: BoardReading | None, text: str) -> None:
    view = RobotView(RobotState(timing=StepTiming(board_age_ms=age_ms), board=board), 0.02, None, 0.02)
    assert text in [finding.text for finding in findings(load_experiment("pool"), 1, view)]


def test_code_that_is_not_known_is_not_taken_for_the_stations() -> None:
    assert other_code("1.0 abc", "1.0 abc") == ""
    assert "nobody knows" not in other_code("1.0 abd", "1.0 abc")
    for other, own in (("1.0 unknown", "1.0 abc"), ("1.0 abc", "1.0 unknown"), ("1.0 unknown", "1.0 unknown")):
        assert "nobody knows" in other_code(other, own)


def test_a_robot_that_was_never_heard_has_no_mode() -> None:
    assert RobotView().mode is None
    assert RobotView(RobotState()).mode is Mode.DISARMED


@pytest.mark.parametrize(("behind_s", "text"), [(0.8, "is 0.8 s behind the others"), (-0.6, "is 0.6 s ahead of the others")])
def test_a_robot_out_of_step_raises_an_alarm_and_does_not_block_arming(behind_s: float, text: str) -> None:
    experiment = load_experiment("pool")
    view = RobotView(RobotState(mode=Mode.TRACKING), 0.02, None, 0.02, behind_s=behind_s)
    (alarm,) = [f for f in findings(experiment, 1, view) if f.key == "step"]
    assert (alarm.level, alarm.blocks_arming, alarm.text) == ("critical", False, text)
    assert not [f for f in findings(experiment, 1, replace(view, behind_s=0.4)) if f.key == "step"]


# --- every finding, just before it is one and just after

POOL = load_experiment("pool")
START = np.array([0.4, 0.0, 0.3, 0.0])
WELL = RobotView(
    RobotState(
        mode=Mode.ARMED,
        experiment_hash=POOL.hash,
        board=BoardReading(battery_v=12.0, depth_m=0.3),
        timing=StepTiming(pose_age_ms=20.0, board_age_ms=20.0),
        estimate=Estimate(START),
        control=Control(),
    ),
    0.02,
    Pose(0.4, 0.0, 0.3, np.eye(3), Track.MARKER, True, 1.0, 0.0),
    0.02,
    0.02,
    localizer_hash=POOL.hash,
)


def _with(view: RobotView, path: str, value: object) -> RobotView:
    """The view with another value of a field, or of one of its state, or of a part of that."""
    *parents, name = path.split(".")
    holders: list[Any] = [view]
    for parent in parents:
        holders.append(getattr(holders[-1], parent))
    changed: Any = value
    for holder, part in zip(reversed(holders), reversed([*parents, name]), strict=True):
        changed = replace(holder, **{part: changed})
    return cast(RobotView, changed)


@pytest.mark.parametrize(
    ("path", "sound", "wrong", "key", "level", "blocks"),
    [
        ("state_age_s", 0.3, 0.31, "silent", "critical", True),
        ("state.experiment_hash", POOL.hash, "other", "experiment", "critical", True),
        ("other_code", "", "runs 2, the station 1", "code", "warning", False),
        ("localizer_hash", "", "other", "localizer", "critical", True),
        ("two_pose_senders", False, True, "poses", "critical", True),
        ("pose", WELL.pose, None, "pose", "warning", True),
        ("pose_age_s", 0.19, 0.2, "pose", "warning", True),
        ("pose.track", Track.KCF, Track.COAST, "pose", "warning", True),
        ("pose.identity_verified", True, False, "identity", "warning", True),
        ("state.board", BoardReading(battery_v=12.0), None, "board", "critical", True),
        ("state.timing.board_age_ms", 300.0, 301.0, "board", "critical", True),
        ("state.board.loss", 0.2, 0.21, "loss", "warning", True),
        ("state.board.depth_m", -0.3, -0.31, "depth", "warning", True),
        ("state.board.depth_m", POOL.pool.size_m[2] + 0.3, POOL.pool.size_m[2] + 0.31, "depth", "warning", True),
        ("state.board.battery_v", 12.0, 0.0, "battery", "warning", True),
        ("state.board.battery_v", 10.8, 10.79, "battery", "warning", False),
        ("state.board.battery_v", 12.0, 10.49, "battery", "critical", True),
        ("loss", 0.2, 0.21, "link", "warning", True),
        ("clock_offset_s", 0.02, 0.021, "clock", "notice", True),
        ("clock_offset_s", -0.02, -0.021, "clock", "notice", True),
        ("state.mode", Mode.ARMED, Mode.STOPPED, "mode", "critical", True),
        ("state.mode", Mode.ARMED, Mode.FAULT, "mode", "critical", True),
        ("state.fault", "", "late", "fault", "warning", False),
        ("other_gains", False, True, "gains", "warning", True),
        ("behind_s", 0.5, 0.51, "step", "critical", False),
        ("behind_s", -0.5, -0.51, "step", "critical", False),
        ("state.control.solve", Solve.SOLVED, Solve.FAILED, "solve", "critical", False),
        ("state.control.solve", Solve.NONE, Solve.SHIFTED, "solve", "notice", False),
        ("state.timing.step_us", 25_000.0, 25_100.0, "late", "notice", False),
        ("state.control.slack_m", 0.01, 0.011, "close", "warning", False),
        ("state.blind", "", "no camera", "blind", "warning", True),
        ("state.estimate.eta", START + np.array([0.5, 0, 0, 0]), START + np.array([0.51, 0, 0, 0]), "start", "notice", True),
    ],
)
def test_a_check_finds_what_is_wrong_and_not_its_edge(
    path: str, sound: object, wrong: object, key: str, level: str, blocks: bool
) -> None:
    assert findings(POOL, 1, _with(WELL, path, sound), START) == ()
    assert [(f.key, f.level, f.blocks_arming) for f in findings(POOL, 1, _with(WELL, path, wrong), START)] == [
        (key, level, blocks)
    ]


@pytest.mark.parametrize("mode", [Mode.TRACKING, Mode.HOLDING, Mode.DRIVEN, Mode.ARMED])
def test_the_age_of_a_plan_matters_in_flight_and_once_there_was_one(mode: Mode) -> None:
    limit_s = POOL.safety.plan_max_age_s
    for age_s, is_old in ((limit_s, False), (limit_s + 0.01, mode is not Mode.ARMED), (math.inf, False)):
        view = replace(_with(WELL, "state.mode", mode), plan_age_s=age_s)
        assert (["plan"] if is_old else []) == [f.key for f in findings(POOL, 1, view)], age_s


def test_thrusters_are_to_be_tested_before_the_flight_where_the_mission_says_so() -> None:
    tested = load_experiment("pool", ["mission.thruster_test=true"])
    view = _with(WELL, "state.experiment_hash", tested.hash)
    view = replace(view, localizer_hash=tested.hash)
    texts = {
        (mode, result): [
            f.text for f in findings(tested, 1, _with(_with(view, "state.mode", mode), "state.thruster_test", result))
        ]
        for mode in (Mode.ARMED, Mode.TRACKING)
        for result in ("", "running", "passed")
    }
    assert texts[Mode.ARMED, ""] == ["thruster test: not done"] and texts[Mode.ARMED, "running"] == ["thruster test: running"]
    assert not any(texts[key] for key in texts if key[0] is Mode.TRACKING or key[1] == "passed")
    assert findings(POOL, 1, WELL) == ()


def test_the_start_matters_only_by_a_fresh_pose_and_markers_only_where_there_are_any() -> None:
    away = _with(WELL, "state.estimate.eta", START + 1.0)
    for age_ms in (None, 191.0):
        assert findings(POOL, 1, _with(away, "state.timing.pose_age_ms", age_ms), START) == ()
    assert [f.key for f in findings(POOL, 1, _with(away, "state.timing.pose_age_ms", 190.0), START)] == ["start"]
    assert findings(POOL, 1, _with(away, "state.estimate", None), START) == ()
    plain = load_experiment("pool", ["localizer.markers=false", "mission.blind=warn", "pool.walls=false"])
    view = replace(_with(WELL, "state.experiment_hash", plain.hash), localizer_hash=plain.hash)
    assert findings(plain, 1, _with(view, "pose.identity_verified", False)) == ()
    assert findings(plain, 1, _with(view, "state.board.depth_m", 99.0)) == ()
    (blind,) = findings(plain, 1, _with(view, "state.blind", "no camera"))
    assert not blind.blocks_arming


def test_a_robot_is_silent_before_it_was_heard_and_worse_after_it_was() -> None:
    (never,), (no_more,) = findings(POOL, 1, RobotView()), findings(POOL, 1, replace(WELL, state_age_s=2.0))
    assert (never.level, never.text) == ("warning", "not heard")
    assert (no_more.level, no_more.text) == ("critical", "not heard for 2.0 s")
    (out,) = findings(POOL, 1, RobotView(out=True))
    assert (out.key, out.blocks_arming) == ("out", False)


def test_a_restarted_robots_link_is_judged_anew() -> None:
    ear = LinkMonitor()
    ear.add([first := Header(7, 1, 0)], first, -5 * MS)
    assert (ear.loss, ear.clock_offset_s) == (0.0, 0.005)
    ear.add([Header(7, 5, 0)], Header(7, 5, 0), 0)
    assert ear.loss == 0.75
    ear.add([Header(8, 90, 0)], Header(8, 90, 0), 3 * MS)
    assert (ear.loss, ear.clock_offset_s, len(ear.headers)) == (0.0, -0.003, 1)
    ear.add([Header(8, 89, 0), Header(8, 90, 0)], Header(8, 90, 0), 0)
    assert len(ear.headers) == 1, "known already"


@pytest.mark.parametrize(
    ("change", "to_arm", "reason"),
    [
        ({"state_age_s": 0.31}, (), "silent"),
        ({"state": None}, (), "silent"),
        ({"state": RobotState(mode=Mode.STOPPED, fault="leak")}, (), "stopped (leak)"),
        ({"state": RobotState(mode=Mode.FAULT)}, (2,), "fault"),
        ({"state": RobotState(mode=Mode.DISARMED)}, (), "disarmed"),
        ({"state": RobotState(mode=Mode.DISARMED)}, (2,), None),
        ({"state": RobotState(mode=Mode.HOLDING)}, (), None),
    ],
)
def test_a_robot_is_lost_when_it_is_silent_or_under_no_power(
    change: dict[str, Any], to_arm: tuple[int, ...], reason: str | None
) -> None:
    fleet = {1: WELL, 2: replace(WELL, **change)}
    assert first_lost_robot((1, 2), fleet, to_arm) == (None if reason is None else (2, reason))
    assert first_lost_robot((1,), fleet) is None
