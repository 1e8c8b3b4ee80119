"""Runs are listed with what their files tell, whatever is missing."""

import json
import os
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from groundstation.__main__ import cli

RESULT = {"scene": "pool", "mode": "lockstep", "duration_s": 40.0, "passed": True, "commit": "a" * 40}


def a_run(folder: Path, name: str, result: str | None, begun_s: int) -> None:
    run = folder / name
    run.mkdir()
    (run / "run.mcap").write_bytes(bytes(2_000_000))
    (run / "experiment.toml").touch()
    os.utime(run / "experiment.toml", (begun_s, begun_s))
    if result is not None:
        (run / "result.json").write_text(result)


@pytest.fixture
def runs(tmp_path: Path) -> Path:
    a_run(tmp_path, "second", json.dumps(RESULT), 2_000_000)
    a_run(tmp_path, "first", json.dumps({**RESULT, "passed": False}), 1_000_000)
    a_run(tmp_path, "cut", None, 3_000_000)
    a_run(tmp_path, "strange", "[1]", 4_000_000)
    (tmp_path / "notes").mkdir()
    return tmp_path


def listed(folder: Path, *words: str) -> list[dict[str, Any]]:
    found: list[dict[str, Any]] = json.loads(
        CliRunner().invoke(cli, ["log", "list", "--in", str(folder), "--json", *words]).stdout
    )
    return found


def test_runs_come_in_the_order_of_their_beginning_with_size_and_verdict(runs: Path) -> None:
    found = listed(runs)
    assert [(Path(run["run"]).name, run["verdict"]) for run in found] == [
        ("first", "failed"),
        ("second", "passed"),
        ("cut", "no result"),
        ("strange", "no result"),
    ]
    assert all(run["size_mb"] == pytest.approx(2.0, abs=0.01) for run in found)
    assert found[1]["experiment"] == "pool" and found[1]["commit"] == "a" * 40


def test_every_word_narrows_the_list(runs: Path) -> None:
    assert [Path(run["run"]).name for run in listed(runs, "POOL", "failed")] == ["first"]
    done = CliRunner().invoke(cli, ["log", "list", "--in", str(runs), "nothing-like-this"])
    assert done.exit_code == 1


def test_the_table_has_a_line_for_each_run(runs: Path) -> None:
    lines = CliRunner().invoke(cli, ["log", "list", "--in", str(runs)]).stdout.splitlines()
    assert len(lines) == 4 and "lockstep" in lines[0] and lines[0].endswith("failed")
