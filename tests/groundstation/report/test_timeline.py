"""A report's figures of limits, links and time, against states and records of known content."""

import io
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from groundstation.analysis.alignment import align, hops_of, messages_lost
from groundstation.analysis.metrics import evaluate
from groundstation.analysis.series import HOPS, Series, TimelineEvent, active_limits
from groundstation.logs.reader import DecodedMessage, RunLog, read_log
from groundstation.report import figures_timeline as drawn
from groundstation.report.drawing import BarPlot, TimePlot
from groundstation.report.plotting import picture
from shoal.frames import Array
from shoal.messages.messages import Guidance, Mode, Pose, RobotState, StepInputs, StepTiming, required
from tests.groundstation.synthetic import Script, write_run

MS = 1_000_000


@pytest.fixture(scope="module")
def flown(tmp_path_factory: pytest.TempPathFactory) -> tuple[Series, Path]:
    folder = tmp_path_factory.mktemp("run")
    experiment = write_run(folder, Script(duration_s=10.0))
    return align(experiment, read_log(folder / "run.mcap")), folder


def with_states(series: Series, robot: int, change: Callable[[int, RobotState], RobotState]) -> Series:
    """A series with changed states of one robot, each changed by its row."""
    mine = series.robots[robot]
    states = replace(mine.states, messages=[change(k, state) for k, state in enumerate(mine.states.messages)])
    return replace(series, robots={**series.robots, robot: replace(mine, states=states)})


def bars(plot: BarPlot | None) -> list[float]:
    """Begin of each bar of a plot, row by row."""
    assert plot is not None
    return [bar.begin_s for _, row in plot.rows for bar in row]


def curve(plot: TimePlot, name: str) -> Array:
    """The values of a line."""
    return next(line for line in plot.panels[0].lines if line.label == name).values


def test_a_limit_counts_where_it_is_reached_and_only_while_under_way(flown: tuple[Series, Path]) -> None:
    series, folder = flown
    bounds, states = series.experiment.vehicle.limits, series.robots[1].states
    rows = np.flatnonzero(states.tracking)
    wrench, slack_m = states.control(lambda c: c.wrench), np.zeros(len(states.time_s))
    wrench[rows[:20], 0] = -bounds.wrench[0]
    wrench[rows[20:60], 2] = 0.98 * bounds.wrench[2]  # near is not at
    wrench[: rows[0], 1] = bounds.wrench[1]  # before the start
    slack_m[rows[5]] = 0.013

    def change(k: int, state: RobotState) -> RobotState:
        control = replace(required(state.control), wrench=wrench[k], slack_m=slack_m[k])
        return replace(state, control=control, board=replace(required(state.board), loss=slack_m[k] * 2.0))

    changed = with_states(series, 1, change)
    limits = active_limits(changed, changed.robots[1])
    assert limits["surge"].sum() == 20 and not limits["yaw"].any()
    result = evaluate(changed, read_log(folder / "run.mcap"))
    steps = sum(states.tracking & (states.time_s >= 0.0) & (states.time_s <= series.end_s))
    assert result.at_limit["surge"] == pytest.approx(20 / steps)
    assert result.at_limit["heave"] == 0.0
    assert result.slack_m == pytest.approx(0.013)
    assert result.board_loss == pytest.approx(0.026)
    assert bars(drawn.limits(changed)) == pytest.approx(states.time_s[[rows[0], rows[5]]])
    assert curve(drawn.slack(changed), "robot 1").max() == pytest.approx(13.0)  # mm
    assert curve(drawn.links(changed), "robot 1").max() == pytest.approx(2.6)  # %
    assert not curve(drawn.links(changed), "robot 2").any()


def test_the_timeline_and_the_events_say_what_decides_the_motion(flown: tuple[Series, Path]) -> None:
    series, _ = flown
    states = series.robots[1].states
    rows = np.flatnonzero(states.tracking)
    guidance = dict.fromkeys(rows.tolist(), Guidance.ON_PATH)
    guidance |= dict.fromkeys(rows[10:30].tolist(), Guidance.GIVING_WAY) | dict.fromkeys(
        rows[30:35].tolist(), Guidance.RETURNING
    )

    def change(k: int, state: RobotState) -> RobotState:
        return replace(state, guidance=guidance.get(k, Guidance.NONE))

    plot = drawn.timeline(with_states(series, 1, change))
    assert plot is not None
    bars = {bar.label: (bar.begin_s, bar.length_s) for bar in plot.rows[0][1]}
    assert bars["giving way"] == pytest.approx((states.time_s[rows[10]], 1.0))
    assert bars["returning"] == pytest.approx((states.time_s[rows[30]], 0.25))
    assert "joining" not in bars and "giving way" not in {bar.label for bar in plot.rows[1][1]}
    led = RobotState(mode=Mode.TRACKING, guidance=Guidance.GIVING_WAY)
    assert led.doing == "tracking, giving way" and replace(led, mode=Mode.HOLDING).doing == "holding"
    assert replace(led, guidance=Guidance.NONE).doing == "tracking"  # a message of an earlier version


def entry(state: RobotState, stamp_ns: int) -> DecodedMessage[RobotState]:
    return DecodedMessage(stamp_ns, stamp_ns, 1, state)


def test_the_hops_add_up_to_the_whole() -> None:
    """30 ms in the localizer, 5 until the step, 2 for the step, 1 to the board."""
    state = RobotState(timing=StepTiming(pose_age_ms=35.0, step_us=2000.0, exposure_to_pwm_ms=38.0))
    inputs = StepInputs(4, Pose(0.0, 0.0, 0.0), pose_instant_ns=65 * MS, pose_told_age_ns=30 * MS)
    hops = hops_of(entry(state, 100 * MS), inputs)
    np.testing.assert_allclose(hops, [30.0, 5.0, 2.0, 1.0], atol=1e-9)
    assert len(hops) == len(HOPS) and hops.sum() == pytest.approx(38.0)


def test_a_step_without_a_new_pose_says_nothing_about_latency() -> None:
    state = RobotState(timing=StepTiming(pose_age_ms=400.0, step_us=2000.0, exposure_to_pwm_ms=403.0))
    inputs = StepInputs(4, Pose(0.0, 0.0, 0.0), pose_instant_ns=0, pose_told_age_ns=30 * MS)
    assert np.isnan(hops_of(entry(state, 400 * MS), inputs)).all()
    assert np.isnan(hops_of(entry(state, 400 * MS), None)).all()
    assert np.isnan(hops_of(entry(state, 400 * MS), StepInputs(0))).all()


def test_numbers_left_out_are_messages_lost_and_a_new_beginning_is_none() -> None:
    def entries(numbers: list[int]) -> list[DecodedMessage[RobotState]]:
        return [DecodedMessage(k, k, number, RobotState()) for k, number in enumerate(numbers)]

    assert messages_lost(entries([1, 2, 3])) == 0
    assert messages_lost(entries([5, 6, 9, 10, 12])) == 3
    assert messages_lost(entries([5, 6, 1, 2])) == 0
    assert messages_lost(entries([5])) == messages_lost([]) == 0


def test_stretches_reach_to_the_next_step() -> None:
    time_s: Array = np.linspace(0.0, 0.35, 8)
    active = np.array([True, True, False, False, True, False, True, True])
    assert np.array(drawn.spans_of(time_s, active)) == pytest.approx(np.array([(0.0, 0.1), (0.2, 0.05), (0.3, 0.1)]))
    assert drawn.spans_of(time_s, ~np.ones(8, dtype=bool)) == []


def test_the_timeline_shows_every_mode_there_was(tmp_path: Path) -> None:
    def mode(robot: int, time_s: float) -> tuple[Mode, str]:
        return (Mode.HOLDING, "the pose is old") if robot == 2 and 4.0 <= time_s < 6.0 else (Mode.TRACKING, "")

    experiment = write_run(tmp_path, Script(duration_s=10.0, mode=mode))
    figure = picture(drawn.timeline(align(experiment, read_log(tmp_path / "run.mcap"))))
    assert figure is not None
    shown = {text.get_text() for text in figure.legends[0].get_texts()}
    assert {"armed", "tracking", "holding", "noticed"} <= shown
    assert [label.get_text() for label in figure.axes[0].get_yticklabels()] == ["robot 1", "robot 2", "faults"]


def test_the_timeline_marks_what_was_broken_apart_from_what_was_noticed(flown: tuple[Series, Path]) -> None:
    series, _ = flown
    first_s = float(series.robots[1].states.time_s[0])
    events = [
        (2.0, "simulator", "fault: thruster 2/3 dead", False),
        (3.0, "robot 2", "HOLDING: the pose is old", True),
        (4.0, "simulator", "fault over: thruster 2/3 dead", False),
        (5.0, "groundstation", "start", False),
        (first_s - 1.0, "simulator", "fault: before anything was recorded", False),
    ]
    plot = drawn.timeline(replace(series, timeline_events=tuple(TimelineEvent(*event) for event in events)))
    assert plot is not None
    assert {meaning: list(times) for _, meaning, times in plot.marks} == {"noticed": [3.0], "injected, or over": [2.0, 4.0]}


def test_a_run_with_nothing_in_it_draws_nothing(tmp_path: Path) -> None:
    empty = align(Script().experiment(), read_log_of_nothing(tmp_path))
    for draw in (drawn.timeline, drawn.limits, drawn.slack, drawn.links, drawn.latency_budget):
        assert picture(draw(empty)) is None


def read_log_of_nothing(folder: Path) -> RunLog:
    path = folder / "run.mcap"
    path.write_bytes(b"")
    return read_log(path)


def test_an_instant_at_the_edge_is_drawn_whole() -> None:
    figure = picture(BarPlot([("robot 1", [])], 0.0, 10.0, [("v", "noticed", [10.0])]))
    assert figure is not None
    png = io.BytesIO()
    figure.savefig(png, format="png", dpi=figure.dpi)
    shown = cv2.imdecode(np.frombuffer(png.getvalue(), np.uint8), cv2.IMREAD_COLOR)
    assert shown is not None
    is_black = np.all(shown[::-1] < 60, axis=2)  # from the bottom, as the axes count
    box = figure.axes[0].bbox
    beside = is_black[int(box.y0) + 2 : int(box.y1) - 2, int(box.x1) + 2 :]
    assert beside.any()
