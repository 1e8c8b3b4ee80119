"""A run that has ended, on its page: what a person chooses there."""

import json
import subprocess
import sys
import threading
from pathlib import Path
from typing import Any

import pytest
from rich.console import Console

from shoal.config.experiment import Experiment, dump_experiment, load_experiment
from shoal.runtime.runtime import Stop
from shoal.system import programs
from sim_bridge.sil import after_run
from sim_bridge.sil.after_run import EndedRun, next_experiment
from sim_bridge.sil.commands import RunOptions

PATIENCE_S = 20.0


def test_an_experiment_that_is_longer_than_a_pipe_holds_is_flown_next(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Some thousand waypoints are more than 64 KiB."""
    experiment = load_experiment("pool")
    text = dump_experiment(experiment) + "# a waypoint more\n" * 10_000
    choice = tmp_path / "choice.json"
    choice.write_text(json.dumps({"what": "edited", "experiment": text}) + "\n", encoding="utf-8")

    def page(module: str, arguments: list[str], **options: Any) -> subprocess.Popen[bytes]:
        return subprocess.Popen(
            [sys.executable, "-c", f"print(open({str(choice)!r}).read(), end='')"], stdout=options["stdout"]
        )

    monkeypatch.setattr(programs, "start", page)
    monkeypatch.setattr(after_run, "Stop", lambda: Stop(install=False))
    chosen = list[Experiment | None]()
    run, options, stop = EndedRun(experiment, tmp_path, 0), RunOptions(page="127.0.0.1:1"), Stop(install=False)
    asking = threading.Thread(
        target=lambda: chosen.append(next_experiment(run, options, "refused", stop, Console(quiet=True))), daemon=True
    )
    asking.start()
    asking.join(PATIENCE_S)
    assert [one and one.hash for one in chosen] == [experiment.hash]
