"""Folders of `groundstation run`: one for each run, and none for a run that was refused."""

from pathlib import Path

import pytest
from typer.testing import CliRunner

from groundstation.__main__ import cli
from shoal.errors import ConfigError
from sim_bridge.sil.ports import free_port


@pytest.mark.parametrize("report", [[], ["--no-report"]])
def test_a_refused_experiment_leaves_no_folder(tmp_path: Path, report: list[str]) -> None:
    out = tmp_path / "runs"
    where = ["--out", str(out), "--listen", f"tcp/127.0.0.1:{free_port()}", "--no-web"]
    refused = CliRunner().invoke(cli, ["run", "straight", "--set", "duration_s=2000", *where, *report]).exception
    assert isinstance(refused, ConfigError) and "the path ends" in str(refused)
    assert not out.exists()
