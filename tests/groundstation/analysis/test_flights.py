"""A log with several flights, paths that are over, fleets that go home, clocks that leap: what the report then judges."""

import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from groundstation.__main__ import cli
from groundstation.analysis.alignment import HOMEWARD, align, zero_ns
from groundstation.analysis.comparison import settled
from groundstation.analysis.metrics import evaluate
from groundstation.analysis.results import WHOLE_RUN, Result
from groundstation.logs.reader import DecodedMessage, RunLog, read_log
from groundstation.logs.recorder import Recorder
from groundstation.mission.state_machine import MissionState
from groundstation.report.report import write_report
from groundstation.scripting.runs import open_run
from shoal.config.experiment import Experiment, dump_experiment, load_experiment
from shoal.errors import ConfigError
from shoal.messages import topics
from shoal.messages.codec import Header, encode
from shoal.messages.messages import Event, Mode, RobotState, StationHeartbeat, Trajectory
from tests.groundstation.synthetic import PERIOD_S, START_S, Script, write_run

SECOND = 1_000_000_000
DURATION_S = 6.0
AWAY_S = 40.0  # the second flight begins so long after the first


@pytest.fixture(scope="module")
def flown(tmp_path_factory: pytest.TempPathFactory) -> tuple[Experiment, RunLog, Path]:
    folder = tmp_path_factory.mktemp("run")
    return write_run(folder, Script(duration_s=DURATION_S)), read_log(folder / "run.mcap"), folder


def later(entry: DecodedMessage[RobotState], by_s: float, **changes: object) -> DecodedMessage[RobotState]:
    return dataclasses.replace(
        entry,
        stamp_ns=entry.stamp_ns + round(by_s * SECOND),
        message=dataclasses.replace(entry.message, **changes),  # type: ignore[arg-type]
    )


def with_aborted_flight(log: RunLog, until_s: float) -> RunLog:
    """The flight, and AWAY_S before it one that robot 2's fault ended after `until_s`, 3 m off."""
    entries = dict(log.entries)
    for (name, robot), messages in log.entries.items():
        if name == topics.STATE.name:
            before = [e for e in messages if e.stamp_ns <= (START_S + until_s) * SECOND]
            fault = [later(e, -AWAY_S) for e in before]
            fault += [later(before[-1], PERIOD_S - AWAY_S, mode=Mode.FAULT, fault="no pose")]
            entries[name, robot] = fault + messages
        elif name == topics.TRUTH.name:
            off = [
                dataclasses.replace(
                    e,
                    stamp_ns=e.stamp_ns - round(AWAY_S * SECOND),
                    message=dataclasses.replace(e.message, eta=e.message.eta + 3.0),
                )
                for e in messages
            ]
            entries[name, robot] = off + messages
    return dataclasses.replace(log, entries=entries)


def result_of(experiment: Experiment, log: RunLog, flight: int | None = None) -> Result:
    return evaluate(align(experiment, log, flight), log)


@pytest.mark.parametrize("until_s", [1.0, 4.0])
def test_of_two_flights_the_last_is_judged_alone(flown: tuple[Experiment, RunLog, Path], until_s: float) -> None:
    experiment, log, _ = flown
    alone, both = result_of(experiment, log), result_of(experiment, with_aborted_flight(log, until_s))
    assert alone.passed and both.passed
    assert both.duration_s == alone.duration_s
    for robot in ("1", "2"):
        assert both.robots[robot].rms_m == pytest.approx(alone.robots[robot].rms_m)
        assert both.robots[robot].control_steps == alone.robots[robot].control_steps
    assert both.pairs["1-2"].max_m == pytest.approx(alone.pairs["1-2"].max_m)
    assert (alone.flight, len(alone.flights)) == (1, 1)
    assert (both.flight, len(both.flights)) == (2, 2)
    assert both.flights[0].flown_s == pytest.approx(until_s)
    assert both.flights[0].begin_s == pytest.approx(PERIOD_S - AWAY_S)
    assert both.notes[0].startswith("The log holds 2 flights. This is a report of number 2 alone")


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (("START asked for", "mission: aborting: robot 2 does not follow ARM", "mission: failed"),
         ", and nobody flew: aborting: robot 2 does not follow ARM."),
        (("START asked for", "mission: aborting: robot 1: no pose", "START asked for", "mission: emergency stop"),
         ", and nobody flew: emergency stop."),
        (("mission: emergency stop", "START asked for", "mission: emergency stop"), ", and nobody flew: emergency stop."),
        (("START asked for", "mission: loading trajectories"), ", and nobody flew."),
        (("TEST asked for", "mission: failed"), None),
        (("START refused: robot 2: not heard",), None),
    ],
)  # fmt: skip
def test_a_start_by_which_nobody_flew_is_said_in_the_report_of_the_flight_before(
    flown: tuple[Experiment, RunLog, Path], words: tuple[str, ...], sentence: str | None
) -> None:
    experiment, log, _ = flown
    kept, last_ns = log.of(topics.EVENT, Event), log.of(topics.STATE, RobotState, 1)[-1].stamp_ns
    stamps = [last_ns + k * SECOND for k in range(1, len(words) + 1)]
    events = [
        DecodedMessage(ns, ns, k, Event(2, "groundstation", text))
        for k, (ns, text) in enumerate(zip(stamps, words, strict=True))
    ]
    result = result_of(experiment, dataclasses.replace(log, entries={**log.entries, (topics.EVENT.name, 0): [*kept, *events]}))
    assert result.passed, "the flight is judged by itself"
    sentences = [note for note in result.notes if "another start was asked for" in note]
    assert len(sentences) == (sentence is not None)
    assert all(note.endswith(str(sentence)) for note in sentences)


def test_the_flight_that_was_aborted_can_be_asked_for(flown: tuple[Experiment, RunLog, Path]) -> None:
    experiment, log, _ = flown
    result = result_of(experiment, with_aborted_flight(log, 4.0), flight=1)
    assert not result.passed
    assert result.duration_s == pytest.approx(4.0, abs=0.1)
    assert result.robots["1"].rms_m is not None and result.robots["1"].rms_m[2] == pytest.approx(3.0, abs=0.01)
    assert {fault.text for fault in result.faults} == {"fault: no pose"}
    with pytest.raises(ConfigError, match=r"--flight 3: the log holds 2 .allowed: 1 to 2."):
        align(experiment, log=with_aborted_flight(log, 4.0), flight=3)


def test_the_report_has_a_table_of_flights(flown: tuple[Experiment, RunLog, Path], monkeypatch: pytest.MonkeyPatch) -> None:
    _, log, folder = flown
    both = with_aborted_flight(log, 4.0)
    monkeypatch.setattr("groundstation.report.report.FIGURES", ())  # they take seconds
    monkeypatch.setattr("groundstation.report.report.read_log", lambda path: both)
    assert write_report(folder).flight == 2
    text = (folder / "report.html").read_text()
    assert "this report" in text and "2 of 2" in text
    assert [part["flown_s"] for part in json.loads((folder / "result.json").read_text())["flights"]] == pytest.approx(
        [4.0, 6.0]
    )
    done = CliRunner().invoke(cli, ["log", "report", str(folder), "--flight", "1"])
    assert done.exit_code == 1 and "(failed)" in done.output


def test_a_robot_that_falls_out_and_comes_back_is_in_the_same_flight(flown: tuple[Experiment, RunLog, Path]) -> None:
    """Its program began anew, its clock is at 0, and it goes on a little behind where it was."""
    experiment, log, _ = flown
    states = log.of(topics.STATE, RobotState, 2)

    def away(entry: DecodedMessage[RobotState]) -> bool:
        return (START_S + 3.0) * SECOND < entry.stamp_ns < (START_S + 4.0) * SECOND

    gone = [later(e, 0.0, mode=Mode.ARMED, trajectory_s=0.0) if away(e) else e for e in states]
    changed = dataclasses.replace(log, entries={**log.entries, (topics.STATE.name, 2): gone})
    alignment = align(experiment, changed)
    assert len(alignment.flights) == 1 and alignment.reached_s == pytest.approx(DURATION_S)


def test_a_robot_that_joins_after_a_hold_does_not_move_the_beginning_of_the_flight(tmp_path: Path) -> None:
    """Robot 1 has a fault at 1 s; robot 2 is put in while it holds from 3 s to 9 s, and flies from there."""

    def mode(robot: int, time_s: float) -> tuple[Mode, str]:
        if robot == 2 and time_s < 9.5:
            return Mode.DISARMED, ""
        if 1.0 < time_s < 1.5:
            return Mode.HOLDING, "no pose"
        return (Mode.HOLDING if 3.0 <= time_s < 9.0 else Mode.TRACKING), ""

    script = Script(duration_s=12.0, clock=lambda since_s: min(since_s, 3.0) + max(since_s - 9.0, 0.0), mode=mode)
    experiment = write_run(tmp_path, script)
    log = read_log(tmp_path / "run.mcap")
    series = align(experiment, log)
    assert series.start_ns == zero_ns(log, experiment.robot_ids) == pytest.approx(START_S * SECOND, abs=0.01 * SECOND)
    assert [fault.text for fault in evaluate(series, log).faults] == ["holding: no pose"]
    unknown = np.isnan(series.robots[2].reference[:, 0])
    assert unknown[series.time_s < 8.9].all() and not unknown[series.time_s > 9.6].any()
    assert np.isfinite(series.robots[1].reference[series.time_s < 0.9]).all()


def test_a_flight_in_a_pool_whose_beginning_nobody_saw_has_not_passed(tmp_path: Path) -> None:
    experiment = write_run(tmp_path, Script(duration_s=DURATION_S, truth=False))
    log = read_log(tmp_path / "run.mcap")
    late = {
        key: [e for e in messages if key[0] != topics.POSE.name or e.stamp_ns > (START_S + 0.6 * DURATION_S) * SECOND]
        for key, messages in log.entries.items()
    }
    assert result_of(experiment, log).passed
    result = result_of(experiment, dataclasses.replace(log, entries=late))
    separation = next(check for check in result.checks if check.name == "separation")
    assert separation.failed and "pair 1-2: known for 40%" in separation.where
    assert not result.passed


def test_a_warning_that_goes_on_from_before_the_flight_is_a_fault_of_the_flight(
    flown: tuple[Experiment, RunLog, Path],
) -> None:
    experiment, log, _ = flown
    stamps = [round((START_S + at_s) * SECOND) for at_s in (-4.0, -1.0, 2.0, 5.0)]
    warning = Event(3, "localizer", "camera absent: no frame for 0.25 s")
    events = [DecodedMessage(ns, ns, k, warning) for k, ns in enumerate(stamps)]
    result = result_of(experiment, dataclasses.replace(log, entries={**log.entries, (topics.EVENT.name, 0): events}))
    (fault,) = result.faults
    assert (fault.text, fault.times) == (warning.message, 2)
    assert (fault.time_s, fault.last_s) == pytest.approx((2.0, 5.0))
    assert not result.passed


@pytest.mark.parametrize("source", ["agent-1", "localizer"])
def test_a_line_just_before_the_flight_hides_none_of_the_flight(flown: tuple[Experiment, RunLog, Path], source: str) -> None:
    experiment, log, _ = flown
    stamps = [round((START_S + at_s) * SECOND) for at_s in (-0.4, 0.3)]
    events = [DecodedMessage(ns, ns, k, Event(4, source, "the board is silent")) for k, ns in enumerate(stamps)]
    result = result_of(experiment, dataclasses.replace(log, entries={**log.entries, (topics.EVENT.name, 0): events}))
    assert [fault.time_s for fault in result.faults] == pytest.approx([0.3])
    assert not result.passed


def test_a_flight_has_no_cause_in_the_next_one(flown: tuple[Experiment, RunLog, Path]) -> None:
    experiment, log, _ = flown
    both = with_aborted_flight(log, 4.0)
    unfaulted = {
        key: [e for e in messages if key[0] != topics.STATE.name or not e.message.fault]
        for key, messages in both.entries.items()
    }
    ns = round((START_S + 3.0) * SECOND)
    lines = ["mission: holding: robot 2 is 1.4 s behind the others", "fault: camera frozen"]
    unfaulted[topics.EVENT.name, 0] = [DecodedMessage(ns, ns, k, Event(2, "groundstation", t)) for k, t in enumerate(lines)]
    result = result_of(experiment, dataclasses.replace(both, entries=unfaulted), flight=1)
    assert result.cause is not None and result.cause.noticed_by == "the report"
    assert result.cause.injected == ""


def test_a_fault_injected_before_the_flight_counts_only_if_it_was_not_over(flown: tuple[Experiment, RunLog, Path]) -> None:
    """In an earlier flight of the session. What was not over when this one began is named, with a time before its start."""
    experiment, log, _ = flown
    lines = ((-9.0, "fault: battery 1 sag 2"), (-8.0, "fault: thruster 1/2 dead"), (-7.0, "fault over: battery 1 sag 2"))
    whys = ((1.0, "the board is silent", 4),)
    events = []
    for k, (at_s, text, level) in enumerate([*((at_s, text, 2) for at_s, text in lines), *whys]):
        ns = round((START_S + at_s) * SECOND)
        events.append(DecodedMessage(ns, ns, k, Event(level, "sim-bridge" if level == 2 else "agent-1", text)))
    for left_out, injected in (("", "thruster 1/2 dead at -8.0 s"), ("thruster", "")):
        kept = [e for e in events if not left_out or left_out not in e.message.message]
        entries = {**log.entries, (topics.EVENT.name, 0): kept}
        result = result_of(experiment, dataclasses.replace(log, entries=entries))
        assert result.cause is not None and result.cause.text == "the board is silent"
        assert result.cause.injected == injected


def beats(log: RunLog, from_s: float, mission: str) -> RunLog:
    stamps = [round((START_S + from_s + k * PERIOD_S) * SECOND) for k in range(200)]
    heartbeats = [DecodedMessage(ns, ns, k, StationHeartbeat(mission=mission)) for k, ns in enumerate(stamps)]
    return dataclasses.replace(log, entries={**log.entries, (topics.HEARTBEAT.name, 0): heartbeats})


def test_a_robot_that_was_out_of_the_water_is_not_reported_as_flown(flown: tuple[Experiment, RunLog, Path]) -> None:
    experiment, log, _ = flown
    stamps = [round((START_S + k * PERIOD_S) * SECOND) for k in range(200)]
    heartbeats = [DecodedMessage(ns, ns, k, StationHeartbeat(mission="DEGRADED", out=(2,))) for k, ns in enumerate(stamps)]
    entries = {**log.entries, (topics.HEARTBEAT.name, 0): heartbeats, (topics.STATE.name, 2): []}
    result = result_of(experiment, dataclasses.replace(log, entries=entries))
    whole = next(check for check in result.checks if check.name == WHOLE_RUN)
    assert result.robots["2"].end.out_of_water and not result.robots["1"].end.out_of_water
    assert whole.failed and whole.where == "robot 2 out of the water" and not result.passed


def test_a_robot_taken_out_after_a_flight_is_not_why_it_was_cut_short(flown: tuple[Experiment, RunLog, Path]) -> None:
    experiment, log, _ = flown
    over_ns, states = (START_S + 3.0) * SECOND, {}
    for robot in (1, 2):
        states[topics.STATE.name, robot] = [e for e in log.of(topics.STATE, RobotState, robot) if e.stamp_ns < over_ns]
    heartbeats = []
    for k in range(120):
        beat = StationHeartbeat(mission="RUNNING", out=(2,) if k > 80 else ())
        ns = round((START_S + k * PERIOD_S) * SECOND)
        heartbeats.append(DecodedMessage(ns, ns, k, beat))
    entries = {**log.entries, **states, (topics.HEARTBEAT.name, 0): heartbeats}
    result = result_of(experiment, dataclasses.replace(log, entries=entries))
    whole = next(check for check in result.checks if check.name == WHOLE_RUN)
    assert result.robots["2"].end.out_of_water
    assert whole.failed and whole.where == "slowest robot"


@pytest.mark.parametrize("flight", [1, 2, None])
def test_tables_count_their_time_as_the_report_does(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, flight: int | None
) -> None:
    def mode(robot: int, time_s: float) -> tuple[Mode, str]:
        return (Mode.DISARMED if 6.0 <= time_s < 12.0 else Mode.TRACKING), ""

    write_run(tmp_path, Script(duration_s=18.0, clock=lambda s: s if s < 6.0 else max(s - 12.0, 0.0), mode=mode))
    monkeypatch.setattr("groundstation.report.report.FIGURES", ())  # they take seconds
    part = write_report(tmp_path, flight).flights[(flight or 2) - 1]
    state = open_run(tmp_path).table("state", robot=1)
    flies = state["trajectory_s"] > 0.0
    begins_s = state["time_s"][1:][flies[1:] & ~flies[:-1]]
    assert begins_s[(flight or 2) - 1] == pytest.approx(part.begin_s, abs=1e-6)
    assert part.begin_s == pytest.approx(PERIOD_S, abs=0.01)


def test_a_fleet_that_is_sent_home_has_not_flown_the_run(flown: tuple[Experiment, RunLog, Path]) -> None:
    experiment, log, _ = flown
    assert MissionState[HOMEWARD] is MissionState.RETURNING
    result = result_of(experiment, beats(log, 2.0, HOMEWARD))
    assert not result.passed
    assert "sent home after 2.0 s of 6 s" in result.notes[0]
    assert result_of(experiment, beats(log, 2.0, MissionState.RUNNING.name)).passed


def test_a_fleet_that_is_sent_home_after_a_long_hold_has_not_flown_the_run(tmp_path: Path) -> None:
    """It holds at 4 s of 12 s for longer than the flight, and its clock goes on to 9 s on the way home."""
    script = Script(duration_s=30.0, clock=lambda since_s: min(since_s, 4.0) + min(max(since_s - 20.0, 0.0), 5.0))
    experiment = write_run(tmp_path, script).model_copy(update={"duration_s": 12.0})
    log = with_path_until(read_log(tmp_path / "run.mcap"), experiment, 8.0, ends_log=False)
    assert any(check.name == WHOLE_RUN and check.passed for check in result_of(experiment, log).checks)
    result = result_of(experiment, beats(log, 20.0, HOMEWARD))
    whole = next(check for check in result.checks if check.name == WHOLE_RUN)
    assert whole.failed and (whole.value, whole.limit) == pytest.approx((4.0, 12.0), abs=0.1)
    assert "sent home after 4.0 s of 12 s" in result.notes[0] and not result.passed


@pytest.mark.parametrize("begin_s", [0.0, PERIOD_S])
def test_the_way_home_is_no_flight_to_judge(flown: tuple[Experiment, RunLog, Path], begin_s: float) -> None:
    """Flown, and then, from where everybody lay, home, along a path that begins at 0, or a control period later."""
    experiment, log, _ = flown
    entries = dict(log.entries)
    for (name, robot), messages in log.entries.items():
        if name == topics.STATE.name:
            stands = [e.message.trajectory_s <= begin_s for e in messages]
            entries[name, robot] = [
                later(e, 0.0, mode=Mode.ARMED, trajectory_s=begin_s) if s else e for e, s in zip(messages, stands, strict=True)
            ]
    both = beats(with_aborted_flight(dataclasses.replace(log, entries=entries), 4.0), 0.1, HOMEWARD)
    series = align(experiment, both)
    assert [flight.home for flight in series.flights] == [False, True]
    assert series.flight == 1


def with_path_until(log: RunLog, experiment: Experiment, end_s: float, ends_log: bool = True) -> RunLog:
    """The same, but the path is over then; robots stay where it ends, and their clocks go on a little."""
    samples = round(end_s / PERIOD_S) + 1 + experiment.controller.mpc.horizon
    entries = dict(log.entries)
    for key, messages in log.entries.items():
        if key[0] == topics.TRAJECTORY.name:
            cut = [
                dataclasses.replace(
                    e, message=dataclasses.replace(e.message, **{n: getattr(e.message, n)[:samples] for n in ARRAYS})
                )
                for e in messages
            ]
            entries[key] = cut
        elif key[0] == topics.STATE.name and ends_log:
            entries[key] = [e for e in messages if e.stamp_ns <= (START_S + end_s) * SECOND]
    return dataclasses.replace(log, entries=entries)


ARRAYS = ("eta", "velocity", "acceleration")


def test_a_reference_whose_beginning_is_left_out_is_unknown_there_and_right_after_it(
    flown: tuple[Experiment, RunLog, Path],
) -> None:
    experiment, log, _ = flown
    cut, entries = round(2.0 / PERIOD_S), dict(log.entries)
    for key, messages in log.entries.items():
        if key[0] == topics.TRAJECTORY.name:
            rest = [{n: getattr(e.message, n)[cut:] for n in ARRAYS} for e in messages]
            entries[key] = [
                dataclasses.replace(e, message=dataclasses.replace(e.message, begin_s=2.0, **parts))
                for e, parts in zip(messages, rest, strict=True)
            ]
    whole, short = align(experiment, log), align(experiment, dataclasses.replace(log, entries=entries))
    for robot in experiment.robot_ids:
        late = whole.time_s >= 2.0
        np.testing.assert_allclose(short.robots[robot].reference[late], whole.robots[robot].reference[late], atol=1e-9)
        assert np.isnan(short.robots[robot].reference[whole.time_s < 2.0 - 2.0 * PERIOD_S]).all()


def test_a_robot_that_flew_on_beyond_the_beginning_of_the_next_plan_is_judged_by_the_plan_that_it_flew(
    flown: tuple[Experiment, RunLog, Path],
) -> None:
    """The next plan begins where the slowest robot was."""
    experiment, log, _ = flown
    plan, entries = log.of(topics.TRAJECTORY, Trajectory, 1)[-1], dict(log.entries)
    planned = plan.message
    eta = planned.eta.copy()
    eta[round((2.5 - planned.begin_s) / planned.period_s) :, 0] += 0.5
    after = dataclasses.replace(planned, id="after", eta=eta)
    entries[topics.TRAJECTORY.name, 1] = [plan, dataclasses.replace(plan, message=after)]
    states = log.of(topics.STATE, RobotState, 1)
    entries[topics.STATE.name, 1] = [
        later(e, 0.0, trajectory_id="after") if e.message.trajectory_s >= 3.0 else e for e in states
    ]
    error = align(experiment, dataclasses.replace(log, entries=entries)).robots[1].error[:, 0]
    before = align(experiment, log).robots[1].error[:, 0]
    moved = np.abs(error - before) > 0.4
    first_s = align(experiment, log).time_s[np.flatnonzero(moved)[0]]
    assert first_s == pytest.approx(3.0, abs=2.0 * PERIOD_S) and moved.sum() > 10


def test_a_path_that_is_over_is_no_failure(flown: tuple[Experiment, RunLog, Path]) -> None:
    experiment, log, _ = flown
    result = result_of(experiment, with_path_until(log, experiment, 4.0))
    assert result.passed
    assert result.asked_s == pytest.approx(4.0)
    assert result.notes == ("The path was over after 4.0 s, before the 6 s of the experiment.",)
    whole = next(check for check in result.checks if check.name.startswith("whole run"))
    assert [whole.value, whole.limit] == pytest.approx([4.0, 4.0]) and whole.passed


def test_a_flight_that_ends_before_its_path_fails_and_says_why(flown: tuple[Experiment, RunLog, Path]) -> None:
    """The fault comes after the last step under way: it ended the flight, so it is told."""
    experiment, log, _ = flown
    entries = dict(log.entries)
    for robot in (1, 2):
        states = [e for e in log.of(topics.STATE, RobotState, robot) if e.stamp_ns <= (START_S + 4.0) * SECOND]
        lost = [later(states[-1], k * PERIOD_S, mode=Mode.HOLDING, fault="pose late") for k in range(1, 5)]
        lost += [later(states[-1], k * PERIOD_S, mode=Mode.FAULT, fault="no pose") for k in range(5, 9)]
        entries[topics.STATE.name, robot] = states + lost
    result = result_of(experiment, dataclasses.replace(log, entries=entries))
    assert not result.passed
    assert [fault.text for fault in result.faults] == ["holding: pose late"] * 2 + ["fault: no pose"] * 2
    assert result.cause is not None
    assert (result.cause.text, result.cause.noticed_by) == ("holding: pose late", "robot 1")
    assert result.cause.time_s == pytest.approx(4.0, abs=0.11)
    assert result.cause.outcome.startswith("4.0 s of ")


def test_a_flight_under_20_s_has_no_settled_figures(flown: tuple[Experiment, RunLog, Path]) -> None:
    """By a campaign as by a report, also where the path ends before 20 s."""
    experiment = flown[0]
    limits = experiment.limits.model_copy(update={"rms_after_20s_m": 0.01, "wrench_step_rms": 0.1, "rms_m": 0.5})
    short = experiment.model_copy(update={"limits": limits})
    long = short.model_copy(update={"duration_s": 30.0})
    assert not settled(20.0) and settled(20.1)
    over = with_path_until(flown[1], long, 4.0)
    unjudged = {check.name for check in result_of(long, over).checks if check.passed is None and not check.failed}
    assert {"rms_after_20s_m", "input steps after 20 s, RMS of the bound"} <= unjudged  # told, and no failure


# --- clocks and values that cannot be


def test_a_clock_that_leaps_neither_fills_the_memory_nor_passes_unsaid(flown: tuple[Experiment, RunLog, Path]) -> None:
    """A year ahead in mid-flight, as if a computer's clock had been set."""
    experiment, log, _ = flown
    entries = dict(log.entries)
    for key, messages in log.entries.items():
        entries[key] = [
            dataclasses.replace(e, stamp_ns=e.stamp_ns + (31_536_000 * SECOND if e.stamp_ns > (START_S + 3.0) * SECOND else 0))
            for e in messages
        ]
    series = align(experiment, dataclasses.replace(log, entries=entries))
    assert len(series.time_s) < 100_000
    notes = evaluate(series, log).notes
    assert any("a clock leaps" in note for note in notes)


def test_stamps_that_come_twice_and_a_flight_of_no_length(flown: tuple[Experiment, RunLog, Path]) -> None:
    experiment, log, _ = flown
    twice = {key: [e for e in messages for _ in range(2)] for key, messages in log.entries.items()}
    doubled = result_of(experiment, dataclasses.replace(log, entries=twice))
    assert doubled.robots["1"].rms_m == pytest.approx(result_of(experiment, log).robots["1"].rms_m)
    one = {key: messages[:1] if key[0] != topics.STATE.name else messages[30:32] for key, messages in log.entries.items()}
    short = result_of(experiment, dataclasses.replace(log, entries=one))
    assert not short.passed and short.duration_s < 0.1
    json.loads(short.to_json())


@pytest.mark.parametrize("clock_s", [1e12, 1e-300, 3.0])
def test_any_clock_along_the_path_gives_a_result(flown: tuple[Experiment, RunLog, Path], clock_s: float) -> None:
    experiment, log, _ = flown
    states = [later(e, 0.0, trajectory_s=clock_s) for e in log.of(topics.STATE, RobotState, 1)]
    result = result_of(experiment, dataclasses.replace(log, entries={**log.entries, (topics.STATE.name, 1): states}))
    json.loads(result.to_json())


def test_a_trajectory_without_samples_is_left_out(flown: tuple[Experiment, RunLog, Path]) -> None:
    experiment, log, _ = flown
    for period_s, samples in ((5e-324, 10), (1e12, 10), (0.05, 0), (0.05, 1)):
        still = np.zeros((samples, 4))
        bad = Trajectory("bad", period_s, still, still, still)
        entries = {**log.entries, (topics.TRAJECTORY.name, 1): [DecodedMessage(0, 0, 1, bad)]}
        result = result_of(experiment, dataclasses.replace(log, entries=entries))
        assert result.robots["1"].rms_m is None and result.robots["2"].rms_m is not None
        assert not result.passed or not experiment.limits.rms_m


@pytest.mark.parametrize("missing", [topic for topic in topics.TOPICS if topic.recorded], ids=lambda topic: topic.name)
def test_a_log_without_a_topic_gives_a_result(flown: tuple[Experiment, RunLog, Path], missing: topics.Topic) -> None:
    experiment, log, _ = flown
    left = {key: messages for key, messages in log.entries.items() if key[0] != missing.name}
    result = result_of(experiment, dataclasses.replace(log, entries=left))
    json.loads(result.to_json())
    assert result.passed or missing.name in (topics.STATE.name, topics.TRUTH.name, topics.TRAJECTORY.name)


def test_time_0_of_a_table_is_the_reports(flown: tuple[Experiment, RunLog, Path]) -> None:
    experiment, log, _ = flown
    for some in (log, with_aborted_flight(log, 4.0), RunLog()):
        assert zero_ns(some, experiment.robot_ids) == align(experiment, some).start_ns


# --- robots that a person leads


def led_alone(log: RunLog, robot: int, from_s: float, base_s: float = 0.0) -> RunLog:
    """The log with one robot on a trajectory of its own from an instant on: its clock begins anew, and it is 3 m off."""
    name = topics.STATE.name, robot
    changed = [
        later(e, 0.0, trajectory_s=since_s - from_s + base_s + PERIOD_S, trajectory_id="alone-1", mode=Mode.TRACKING)
        if (since_s := e.stamp_ns / SECOND - START_S) >= from_s
        else e
        for e in log.entries[name]
    ]
    return dataclasses.replace(log, entries={**log.entries, name: changed})


def test_a_trip_of_one_robot_after_the_flight_is_no_flight(flown: tuple[Experiment, RunLog, Path]) -> None:
    experiment, log, _ = flown
    last = log.entries[topics.STATE.name, 1][-1]
    transfer = [
        later(last, 10.0 + 0.05 * k, mode=Mode.TRACKING, trajectory_s=0.05 * k, trajectory_id="alone-1") for k in range(1, 100)
    ]
    states = [*log.entries[topics.STATE.name, 1], *transfer]
    after = dataclasses.replace(log, entries={**log.entries, (topics.STATE.name, 1): states})
    result, before = result_of(experiment, after), result_of(experiment, log)
    assert (result.flight, len(result.flights), result.passed) == (1, 1, before.passed)
    assert result.robots["1"].rms_m == before.robots["1"].rms_m


def test_a_robot_that_is_led_away_is_judged_by_what_it_flew_with_the_formation(
    flown: tuple[Experiment, RunLog, Path],
) -> None:
    experiment, log, _ = flown
    result, before = result_of(experiment, led_alone(log, 2, 3.0)), result_of(experiment, log)
    rms_m, usual_m = result.robots["2"].max_m, before.robots["2"].max_m
    assert rms_m is not None and usual_m is not None and max(rms_m) <= max(usual_m) + 1e-6
    whole = next(check for check in result.checks if check.name == "whole run flown")
    assert not whole.passed and whole.value == pytest.approx(3.0, abs=0.1)
    assert any(f"{whole.value:.1f} s of" in note for note in result.notes)
    assert result.robots["1"].rms_m == before.robots["1"].rms_m


def test_a_driven_robot_that_holds_far_off_has_no_error_until_it_flies_again(flown: tuple[Experiment, RunLog, Path]) -> None:
    experiment, log, _ = flown
    modes = {2.0: Mode.DRIVEN, 3.0: Mode.HOLDING, 4.0: Mode.TRACKING}
    name = topics.STATE.name, 2
    states = []
    for e in log.entries[name]:
        since_s = e.stamp_ns / SECOND - START_S
        mode = next((mode for at_s, mode in reversed(modes.items()) if since_s >= at_s), None)
        states.append(e if mode is None or e.message.mode is not Mode.TRACKING else later(e, 0.0, mode=mode))
    series = align(experiment, dataclasses.replace(log, entries={**log.entries, name: states}))
    has_error = np.isfinite(series.robots[2].error[:, 0])
    away = (series.time_s > 2.06) & (series.time_s < 3.94)
    assert not has_error[away].any() and has_error[series.time_s < 1.94].all() and has_error[series.time_s > 4.06].all()


def test_a_separation_and_errors_that_are_unknown_for_long_fail(flown: tuple[Experiment, RunLog, Path]) -> None:
    experiment, log, _ = flown
    truths = [e for e in log.entries[topics.TRUTH.name, 0] if not 2.0 < e.stamp_ns / SECOND - START_S < 4.0]
    limited = experiment.model_copy(update={"limits": experiment.limits.model_copy(update={"rms_m": 0.5})})
    result = result_of(limited, dataclasses.replace(log, entries={**log.entries, (topics.TRUTH.name, 0): truths}))
    separation, rms = (next(check for check in result.checks if check.name == name) for name in ("separation", "rms_m"))
    assert separation.value is not None and separation.value > separation.limit and not separation.passed
    assert "known for" in separation.where
    assert rms.value is not None and rms.value < rms.limit and not rms.passed and "known for" in rms.where


def test_a_clock_is_not_invented_across_a_gap_of_the_log(flown: tuple[Experiment, RunLog, Path]) -> None:
    """A robot out of reach flies on for a second, then holds: where it should have been meanwhile nobody knows."""
    experiment, log, _ = flown
    name = topics.STATE.name, 2
    states = [e for e in log.entries[name] if not 2.0 < e.stamp_ns / SECOND - START_S < 4.0]
    series = align(experiment, dataclasses.replace(log, entries={**log.entries, name: states}))
    has_error = np.isfinite(series.robots[2].error[:, 0])
    out = (series.time_s > 2.06) & (series.time_s < 3.94)
    assert not has_error[out].any() and has_error[series.time_s < 1.94].all() and has_error[series.time_s > 4.06].all()


@pytest.mark.parametrize("behind_s", [0.0, 7200.0])
def test_lines_of_an_earlier_run_that_a_robot_has_kept_are_none_of_a_later_one(tmp_path: Path, behind_s: float) -> None:
    """A robot's program outlives the station's, and a new station gets the last lines of its log. Its clock may be behind."""
    experiment, zero = load_experiment("pool"), 1_700_000_000 * SECOND
    recorder = Recorder(tmp_path / "run.mcap", dump_experiment(experiment), {"mode": "real-time"})
    behind = round(behind_s * SECOND)

    def line(number: int, text: str, level: int, stamp_ns: int, arrived_ns: int) -> None:
        recorder.put(
            topics.EVENT,
            "shoal/event",
            Header(11, number, stamp_ns - behind),
            encode(Event(level, "agent-1", text)),
            arrived_ns,
        )

    for number, text in enumerate(("holding: pose late", "fault: no pose"), start=1):  # of an hour ago
        line(number, text, 3, zero - 3600 * SECOND, zero + SECOND)
    for k in range(200):
        now_ns, state = zero + k * SECOND // 20, encode(RobotState(experiment_hash=experiment.hash))
        recorder.put(topics.STATE, "shoal/robot/1/state", Header(11, k + 1, now_ns - behind), state, now_ns + 2_000_000)
    line(3, "LOAD: accepted", 2, zero + 5 * SECOND, zero + 5 * SECOND + 1_000_000)
    recorder.close()
    log = read_log(tmp_path / "run.mcap")
    series = align(experiment, log)
    result = evaluate(series, log)
    assert [event.text for event in series.timeline_events] == ["disarmed", "LOAD: accepted"]
    assert series.timeline_events[1].time_s == pytest.approx(5.0, abs=0.01)
    assert (result.faults, result.verdict) == ((), "not judged")
