"""The cause of a run is what a person would name first, and the verdict, the report and the terminal follow it."""

import re
from dataclasses import replace
from pathlib import Path

import pytest

from groundstation.analysis.cause import missed
from groundstation.analysis.numbers import mm
from groundstation.analysis.results import Check, Result
from groundstation.report import terminal
from groundstation.report.report import write_report
from groundstation.station.process import INTERRUPTED, TERMINATED
from groundstation.web.run_desk import run_end
from shoal.messages.messages import Mode
from tests.groundstation.synthetic import Script, write_run

pytestmark = pytest.mark.long

FLOWN_S = 8.0


def judged(folder: Path, script: Script) -> Result:
    folder.mkdir(exist_ok=True)
    write_run(folder, script)
    return write_report(folder)


def holds(since_s: float, until_s: float = 1e9) -> Script:
    """Robot 1 holds by itself for a while."""

    def mode(robot: int, at_s: float) -> tuple[Mode, str]:
        late = robot == 1 and since_s <= at_s < until_s
        return (Mode.HOLDING, "pose late") if late else (Mode.TRACKING, "")

    return Script(duration_s=FLOWN_S, mode=mode)


@pytest.mark.parametrize(
    ("line", "words"),
    [
        ("STOP asked for", "pressed the emergency stop"),
        ("DISARM asked for", "disarmed the robots"),
        ("END asked for", "ended the run"),
        ("RETURN asked for", "sent the fleet back to the start"),
        (INTERRUPTED, "interrupted the program (Ctrl-C)"),
    ],
)
def test_a_persons_act_is_the_cause_before_a_hold_that_healed(tmp_path: Path, line: str, words: str) -> None:
    script = holds(2.0, 3.6)
    script.lines, script.until_s = ((5.0, line), (5.6, "END asked for")), 6.0
    result = judged(tmp_path, script)
    assert result.cause is not None
    assert (result.cause.noticed_by, result.cause.text, result.verdict) == ("a person", words, "not judged")
    assert result.cause.time_s == pytest.approx(5.0, abs=0.01)
    assert result.cause.sentence.startswith(f"A person {words} at 5.0 s, the fleet's middle at x ")
    assert not result.passed
    lines = list(terminal.lines(result))
    assert lines[0] == f"cause: {result.cause.sentence}"
    assert any(line.startswith("also at ") and line.endswith(", robot 1: holding: pose late") for line in lines)
    assert not any(line.startswith(("not met", "not reached")) for line in lines)
    shown = run_end(tmp_path)
    assert shown is not None
    assert (shown["verdict"], shown["cause"], shown["outcome"]) == ("not judged", result.cause.sentence, "6.0 s of 8 s flown")
    page = (tmp_path / "report.html").read_text()
    assert "– not judged" in page and "✗ failed" not in page


@pytest.mark.parametrize("goes_on", ["RESUME asked for", "PATH square asked for", "FORMATION line 0.8 asked for"])
def test_a_return_that_was_called_off_is_not_the_cause_of_a_later_end(tmp_path: Path, goes_on: str) -> None:
    script = holds(4.0)
    script.lines, script.until_s = ((2.0, "RETURN asked for"), (2.5, "HOLD asked for"), (3.0, goes_on)), 6.0
    result = judged(tmp_path, script)
    assert result.cause is not None
    assert (result.cause.noticed_by, result.cause.text, result.verdict) == ("robot 1", "holding: pose late", "failed")


def test_a_fault_that_lasts_is_the_cause_also_if_a_person_stops_the_fleet_then(tmp_path: Path) -> None:
    script = holds(4.0)
    script.lines, script.until_s = ((5.0, "STOP asked for"),), 6.0
    result = judged(tmp_path, script)
    assert result.cause is not None
    assert (result.cause.noticed_by, result.cause.text, result.verdict) == ("robot 1", "holding: pose late", "failed")
    assert result.cause.place.startswith("at x ")


@pytest.mark.parametrize("still", [True, False], ids=["stood still", "messages lost"])
@pytest.mark.parametrize(
    ("processes", "fault", "sources"),
    [
        ((0,), "station silent", "groundstation"),
        ((0, 1, 2), "thruster board silent", "robot 1, robot 2, groundstation"),
    ],
)
def test_a_process_that_stood_still_is_the_cause_of_what_others_and_it_itself_noticed(
    tmp_path: Path, processes: tuple[int, ...], fault: str, sources: str, still: bool
) -> None:
    """A computer that slept for 3 s: its messages go on with the next number. Of lost ones the numbers are missing."""

    def mode(robot: int, at_s: float) -> tuple[Mode, str]:
        noticed_s = 2.5 if processes == (0,) else 5.0
        return (Mode.FAULT, fault) if robot == 1 and at_s >= noticed_s else (Mode.TRACKING, "")

    times = tuple((process, 2.0, 5.0) for process in processes)
    script = Script(duration_s=FLOWN_S, mode=mode, still=times if still else (), lost=() if still else times)
    cause = judged(tmp_path, script).cause
    assert cause is not None
    if still:
        assert (cause.noticed_by, cause.text) == (sources, f"process stood still for 3.0 s (robot 1: fault: {fault})")
        assert cause.time_s == pytest.approx(2.0, abs=0.06)
    else:
        assert (cause.noticed_by, cause.text) == ("robot 1", f"fault: {fault}")


LED = "mission: running without a robot: robot 2: led by a person"


@pytest.mark.parametrize(
    ("lines", "noticed_by", "text"),
    [
        (((2.0, LED), (5.0, TERMINATED)), "groundstation", TERMINATED),
        (((2.0, "mission: holding: no way round"), (3.0, "mission: running"), (5.0, TERMINATED)), "groundstation", TERMINATED),
        (((2.0, LED),), "the report", None),  # killed: the flight went on until then
        (((2.0, LED), (5.0, "mission: holding: no way round")), "groundstation", "holding: no way round"),
    ],
    ids=["told to end", "after a hold", "killed", "held"],
)
def test_a_reason_before_the_flight_went_on_is_not_the_cause_of_its_end(
    tmp_path: Path, lines: tuple[tuple[float, str], ...], noticed_by: str, text: str | None
) -> None:
    result = judged(tmp_path, Script(duration_s=FLOWN_S, lines=lines, until_s=6.0))
    assert result.cause is not None and result.verdict == "failed"
    assert result.cause.noticed_by == noticed_by and "led by a person" not in result.cause.text
    assert text is None or result.cause.text == text


def test_of_a_flight_that_came_to_its_end_without_a_robot_the_cause_is_who_led_it_and_not_who_ended_the_run_then(
    tmp_path: Path,
) -> None:
    lines = ((2.0, LED), (6.0, "mission: done"), (7.0, "END asked for"))
    result = judged(tmp_path, Script(duration_s=FLOWN_S, lines=lines, until_s=7.5))
    assert result.cause is not None and result.verdict == "not judged"
    assert result.cause.sentence.startswith("A person led robot 2 alone at 2.0 s")


def test_faults_after_a_stop_are_not_its_cause(tmp_path: Path) -> None:
    script = holds(5.5)
    script.lines, script.until_s = ((5.0, "STOP asked for"),), 6.0
    result = judged(tmp_path, script)
    assert result.cause is not None and result.cause.text == "pressed the emergency stop"


def test_a_hold_that_healed_is_the_cause_only_of_a_run_that_misses_nothing_else(tmp_path: Path) -> None:
    result = judged(tmp_path, holds(2.0, 3.6))
    assert result.cause is not None
    assert (result.cause.text, result.verdict) == ("holding: pose late", "failed")
    script = holds(2.0, 3.6)
    script.settings = ("limits.rms_m=0.001",)
    result = judged(tmp_path / "strict", script)
    assert result.cause is not None and result.cause.text.startswith("RMS error, whole run")


def test_of_a_limit_that_the_whole_run_missed_no_injection_is_said_to_have_come_before(tmp_path: Path) -> None:
    """The largest error came at 40 s, and "injected before" named a gust at 86 s."""
    script = Script(duration_s=FLOWN_S, lines=((FLOWN_S - 0.5, "fault: water gust 0.05"),), settings=("limits.rms_m=0.001",))
    result = judged(tmp_path, script)
    assert result.cause is not None and result.cause.time_s is None
    assert f"  injected in the flight: {result.cause.injected}" in list(terminal.lines(result))
    assert "water gust" in result.cause.injected and "injected before" not in (tmp_path / "report.html").read_text()
    shown = run_end(tmp_path)
    assert shown is not None and shown["injected"] == ""


def test_a_stop_after_the_end_of_the_path_is_no_cause(tmp_path: Path) -> None:
    result = judged(tmp_path, Script(duration_s=FLOWN_S, lines=((FLOWN_S + 0.2, "STOP asked for"),)))
    assert (result.passed, result.verdict, result.cause) == (True, "passed", None)
    shown = run_end(tmp_path)
    assert shown is not None
    assert shown["figures"]["heads"] == ["RMS, whole run", "the article's"]  # it is over before 20 s
    rms_m = result.robots["1"].rms_m
    assert rms_m is not None
    assert shown["figures"]["rows"][0] == {"name": "robot 1", "cells": [[mm(v) for v in rms_m[:2]], ["70.0", "110"]]}
    assert {one["met"] for one in shown["requirements"]} == {"yes"}
    (tmp_path / "result.json").write_text('{"verdict": "passed"}')  # of another version
    assert run_end(tmp_path) is None


def test_a_run_without_a_flight_is_not_judged(tmp_path: Path) -> None:
    result = judged(tmp_path, Script(duration_s=FLOWN_S, started=False, lines=((1.0, "END asked for"),)))
    assert result.cause is not None
    assert (result.cause.text, result.verdict) == ("ended the run", "not judged")
    assert re.match(r"A person ended the run \d\.\d s after the log began", result.cause.sentence)  # no flight has a time 0


def test_a_limit_that_was_missed_by_less_than_is_shown_says_by_how_much() -> None:
    check = Check("max_after_20s_m", "1-2, y", 0.080016, 0.08, False, "m")
    assert missed(check).endswith("(1-2, y): 80.0 mm (0.0160 mm beyond), at most 80.0 mm")
    assert "beyond" not in missed(replace(check, value=0.07999, passed=True)) + missed(replace(check, value=0.09))
