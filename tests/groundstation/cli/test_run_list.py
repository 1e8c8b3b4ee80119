"""Runs are listed with what their files tell, whatever is missing."""

import json
import os
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from groundstation.__main__ import cli
from groundstation.analysis.series import TimelineEvent
from groundstation.analysis.timeline import tags
from groundstation.logs.run_folders import NO_RESULT, change_label, label_of, list_runs
from shoal.errors import ConfigError

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
    runs_read: list[dict[str, Any]] = json.loads(
        CliRunner().invoke(cli, ["log", "list", "--in", str(folder), "--json", *words]).stdout
    )
    return runs_read


def test_runs_come_in_the_order_of_their_beginning_with_size_and_verdict(runs: Path) -> None:
    rows = listed(runs)
    assert [(Path(run["run"]).name, run["verdict"]) for run in rows] == [
        ("first", "failed"),
        ("second", "passed"),
        ("cut", "no result"),
        ("strange", "no result"),
    ]
    assert all(run["size_mb"] == pytest.approx(2.0, abs=0.01) for run in rows)
    assert rows[1]["experiment"] == "pool" and rows[1]["commit"] == "a" * 40


@pytest.mark.parametrize("date_s", [-4e11, 4e11, 1e18])
def test_a_run_with_the_date_of_no_calendar_is_listed(runs: Path, monkeypatch: pytest.MonkeyPatch, date_s: float) -> None:
    """Some file systems hold such dates, and a clock that was never set writes them."""
    stat = Path.stat

    def dated(path: Path, **options: Any) -> os.stat_result:
        real = stat(path, **options)
        return os.stat_result((*real[:8], date_s, real[9])) if path.parent.name == "cut" else real

    monkeypatch.setattr(Path, "stat", dated)
    assert sorted(Path(run.run).name for run in list_runs(runs)) == ["cut", "first", "second", "strange"]


def test_a_result_with_other_types_is_listed_as_far_as_it_can_be_read(tmp_path: Path) -> None:
    a_run(tmp_path, "odd", json.dumps({"scene": 3, "duration_s": "long", "tags": "lamp", "passed": 1}), 1)
    (row,) = listed(tmp_path)
    assert (row["experiment"], row["duration_s"], row["tags"], row["verdict"]) == ("3", 0.0, [], "no result")


def test_a_run_whose_length_is_not_known_yet_has_none_in_the_list(runs: Path) -> None:
    lines = CliRunner().invoke(cli, ["log", "list", "--in", str(runs)]).stdout.splitlines()
    assert [" 40 s " in line for line in lines] == [True, True, False, False]
    assert not any(" 0 s " in line for line in lines)
    assert len({line.index(" MB") for line in lines}) == 1, "the columns stand below one another"


def test_every_word_narrows_the_list(runs: Path) -> None:
    assert [Path(run["run"]).name for run in listed(runs, "POOL", "failed", "simulated")] == ["first"]
    done = CliRunner().invoke(cli, ["log", "list", "--in", str(runs), "nothing-like-this"])
    assert done.exit_code == 1


def test_the_table_has_a_line_for_each_run(runs: Path) -> None:
    lines = CliRunner().invoke(cli, ["log", "list", "--in", str(runs)]).stdout.splitlines()
    assert len(lines) == 4 and "simulated time" in lines[0] and lines[0].endswith("failed")


def test_a_run_is_found_by_its_name_and_tags_until_it_is_deleted(runs: Path) -> None:
    def station(*words: str) -> int:
        return CliRunner().invoke(cli, ["log", *words]).exit_code

    folder = str(runs / "second")
    assert station("label", folder, "--name", "first dive", "--tag", "lamp", "--tag", "cold") == 0
    assert station("label", folder, "--untag", "cold") == 0
    (row,) = listed(runs, "dive", "lamp")
    assert (Path(row["run"]).name, row["name"], row["tags"]) == ("second", "first dive", ["lamp"])
    assert listed(runs, "cold") == []
    assert station("delete", folder) == 1 and Path(folder).is_dir()  # nobody says yes
    assert station("delete", folder, "--yes") == 0 and not Path(folder).exists()
    for words in (["delete", str(runs / "notes"), "--yes"], ["label", str(runs), "--tag", "x"]):
        assert isinstance(CliRunner().invoke(cli, ["log", *words]).exception, ConfigError)
    assert (runs / "notes").is_dir()


def test_a_run_that_is_named_twice_is_deleted_once(runs: Path) -> None:
    twice = [str(runs / "second"), str(runs / "first" / ".." / "second")]
    assert CliRunner().invoke(cli, ["log", "delete", *twice, "--yes"]).exit_code == 0
    assert not (runs / "second").exists() and (runs / "first").exists()


def test_tags_that_are_given_at_once_are_all_kept(runs: Path) -> None:
    words = [f"word-{k}" for k in range(24)]
    with ThreadPoolExecutor(8) as people:
        list(people.map(lambda word: change_label(runs / "second", None, [word], ()), words))
    assert set(label_of(runs / "second")[1]) == set(words)


@pytest.mark.parametrize("passed", ['"no"', "0", "[]", "1e3"])
def test_a_verdict_that_is_neither_true_nor_false_is_none(runs: Path, passed: str) -> None:
    (runs / "second" / "result.json").write_text(f'{{"passed": {passed}}}')
    (row,) = [run for run in list_runs(runs) if Path(run.run).name == "second"]
    assert row.verdict == NO_RESULT


def test_hash_words_of_remarks_are_tags() -> None:
    remarks = ("remark: lamp off #lamp, #cold-water", "remark: a#b #lamp", "mission: #no")
    assert tags([TimelineEvent(float(k), "groundstation", text, False) for k, text in enumerate(remarks)]) == (
        "lamp",
        "cold-water",
    )
