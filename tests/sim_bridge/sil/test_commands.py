"""Checks before a run in software is started."""

import io
from pathlib import Path
from typing import Any

import pytest
from rich.console import Console
from typer.testing import CliRunner

from shoal.config.experiment import load_experiment
from shoal.errors import ConfigError
from sim_bridge.__main__ import cli
from sim_bridge.sil import launcher
from sim_bridge.sil.commands import RunOptions, check, pace_of, programs


@pytest.mark.parametrize(
    ("name", "settings", "complaint"),
    [
        ("islands", ("localizer.uses_camera=true",), "camera.position_m.2 = -32: from there markers are 3 pixels wide"),
        ("numeric-disturbed", (), "localizer.uses_camera = false: no camera locates these robots"),
    ],
)
def test_robot_outside_the_picture_flies_without_the_camera_or_not_at_all(
    name: str, settings: tuple[str, ...], complaint: str
) -> None:
    experiment = load_experiment(name, settings)
    check(experiment, RunOptions(poses=True))
    with pytest.raises(ConfigError, match=f"{complaint}.*--poses"):
        check(experiment, RunOptions())


@pytest.mark.parametrize(
    ("options", "faults", "complaint"),
    [
        (RunOptions(lockstep=True, one_process=True, keys=Path("keys")), (), "--keys: with --one-process there is no link"),
        (RunOptions(lockstep=True, one_process=True, signed=True), (), "--signed: with --one-process there is no link"),
        (RunOptions(lockstep=True, one_process=True, manual=True), (), "--manual: with --one-process only the page"),
        (
            RunOptions(lockstep=True, one_process=True),
            ("t=1 process agent-1 killed",),
            "sim.faults.0.what = 'process agent-1 killed': --one-process has none to break: it needs --real-time",
        ),
    ],
)
def test_options_that_need_processes_are_refused_without_them(
    options: RunOptions, faults: tuple[str, ...], complaint: str
) -> None:
    with pytest.raises(ConfigError, match=complaint):
        check(load_experiment("pool", (), faults), options)


@pytest.mark.parametrize("option", ["lockstep", "one_process", "pace"])
def test_the_wall_clock_excludes_what_stops_it(option: str) -> None:
    given: dict[str, Any] = {"lockstep": False, "one_process": False, "pace": None}
    given[option] = 2.0 if option == "pace" else True
    with pytest.raises(ConfigError, match=rf"^--{option.replace('_', '-')}: .*allowed: without --real-time"):
        pace_of(real_time=True, **given)


def test_a_step_of_the_plant_that_does_not_go_into_the_control_period_is_refused_in_lockstep() -> None:
    experiment = load_experiment("pool", ["sim.plant.step_s=0.02"])
    check(experiment, RunOptions())
    with pytest.raises(ConfigError, match=r"sim\.plant\.step_s = 0\.02: must go into controller\.period_s = 0\.05"):
        check(experiment, RunOptions(lockstep=True))


def test_a_run_goes_in_real_time_at_most_unless_its_options_say_otherwise() -> None:
    assert pace_of(lockstep=False, real_time=False, one_process=False, pace=None) == 1.0
    assert pace_of(lockstep=True, real_time=False, one_process=False, pace=None) is None
    assert pace_of(lockstep=True, real_time=False, one_process=True, pace=2.0) == 2.0
    started = programs((1, 2), RunOptions(lockstep=True, pace=2.0), Path("run"), "tcp/127.0.0.1:7447", 14550)
    assert [program.name for program in started if "--pace" in program.arguments] == ["sim-bridge"]


def test_simulator_and_localizer_alone_are_handed_the_ring_of_frames(tmp_path: Path) -> None:
    started = programs((1, 2), RunOptions(), tmp_path, "tcp/127.0.0.1:7447", 14550, frame_ring=9)
    handed = {program.name: program.arguments[-2:] for program in started if program.inherits == (9,)}
    assert handed == {"sim-bridge": ("--frame-ring", "9"), "localizer": ("--frame-ring", "9")}
    without = programs((1, 2), RunOptions(), tmp_path, "tcp/127.0.0.1:7447", 14550)
    assert not any(program.inherits or "--frame-ring" in program.arguments for program in without)


BROKEN_REPORT = """
from groundstation.report import report
def broken(*_):
    raise MemoryError("on purpose")
report.write_report = broken
"""


@pytest.mark.long
@pytest.mark.parametrize("earlier", [None, '{"passed": true}'])
def test_a_report_that_ends_with_an_error_is_none(
    earlier: str | None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A Python program that raises ends with 1, as the report of a run that did not pass does. What was there before is no
    result of this run."""
    (tmp_path / "sitecustomize.py").write_text(BROKEN_REPORT)  # Python reads it in each process
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    (tmp_path / "run.mcap").touch()
    if earlier is not None:
        (tmp_path / "result.json").write_text(earlier)
    console = Console(record=True, width=500, file=io.StringIO())
    assert not launcher.report(tmp_path, console)
    assert "no report: Traceback" in (text := console.export_text()) and "MemoryError: on purpose" in text


@pytest.mark.long
def test_a_key_ring_of_the_environment_does_not_keep_one_process_from_flying(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SHOAL_KEYS", "keys")
    words = ["sil", "pool", "--lockstep", "--one-process", "--no-web", "--dry-run"]
    done = CliRunner().invoke(cli, words)
    assert done.exit_code == 0, done.output
    named = CliRunner().invoke(cli, [*words, "--keys", "keys"])
    assert isinstance(named.exception, ConfigError) and "--keys: with --one-process" in str(named.exception)
