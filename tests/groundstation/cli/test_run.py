"""`groundstation run`: a folder for each run and none for one that was refused, and what its end says."""

from collections.abc import Generator
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from groundstation.__main__ import cli
from groundstation.station import process
from shoal.errors import ConfigError
from sim_bridge.sil.ports import free_port
from tests.groundstation.synthetic import Script, write_run


@pytest.mark.parametrize("report", [[], ["--no-report"]])
def test_a_refused_experiment_leaves_no_folder(tmp_path: Path, report: list[str]) -> None:
    out = tmp_path / "runs"
    where = ["--out", str(out), "--listen", f"tcp/127.0.0.1:{free_port()}", "--no-web"]
    refused = CliRunner().invoke(cli, ["run", "straight", "--set", "duration_s=2000", *where, *report]).exception
    assert isinstance(refused, ConfigError) and "the path ends" in str(refused)
    assert not out.exists()


@pytest.mark.parametrize(
    ("lines", "succeeded", "sentence"),
    [
        ((), True, None),
        (
            ((12.0, "START asked for"), (13.0, "mission: failed")),
            False,
            "another start was asked for, and nobody flew: failed.",
        ),
    ],
)
def test_a_run_that_failed_beside_a_report_that_passed_says_why(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    lines: tuple[tuple[float, str], ...],
    succeeded: bool,
    sentence: str | None,
) -> None:
    """The flight is a log that was written, for a real one takes a minute; router, report and exit code are real."""

    def cycles(experiment: Any, bus: Any, run_dir: Path, *others: Any) -> Generator[None, None, bool]:
        write_run(run_dir, Script(duration_s=10.0, lines=lines))
        yield
        return succeeded

    monkeypatch.setattr(process, "cycles", cycles)
    (tmp_path / "run").mkdir()
    where = ["--run-dir", str(tmp_path / "run"), "--listen", f"tcp/127.0.0.1:{free_port()}", "--no-web"]
    ended = CliRunner().invoke(cli, ["run", "pool", *where])
    assert ended.exit_code == (0 if succeeded else 1), ended.output
    assert "report.html (passed)" in ended.output
    assert (sentence is not None) == ("nobody flew" in ended.output)
    assert sentence is None or sentence in ended.output
