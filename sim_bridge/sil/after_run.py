"""SHELL: shows a run that has ended to its page, if that is open, until a person closes it or flies again."""

import json
import subprocess
import tempfile
from dataclasses import dataclass
from pathlib import Path

from rich.console import Console

from shoal.config.experiment import Experiment, load_experiment
from shoal.runtime.output_files import page_was_open
from shoal.runtime.runtime import SLICE_S, Stop
from shoal.system import programs
from sim_bridge.sil.commands import RunOptions


@dataclass(frozen=True)
class EndedRun:
    """A run that was flown: what, into which folder, and the exit code."""

    experiment: Experiment
    folder: Path
    code: int


def next_experiment(run: EndedRun, options: RunOptions, problem: str, stop: Stop, console: Console) -> Experiment | None:
    """Show an ended run to its page, if that was open at the end, until a person has chosen. Returns the experiment to fly
    next; None for none. `problem`: why the last choice was not flown, while the page waits for it. `stop` is the run's own."""
    opened = page_was_open(run.folder) or bool(problem)
    if options.page is None or not opened or stop.terminated:
        return None
    if not problem and run.code == 1 and _result_passed(run.folder):
        problem = f"a process of this run failed: what each said is in {run.folder / 'logs'}"
    console.print(
        f"the page shows the recorded run: Close there, close the page, or press Ctrl-C (exit code {run.code})", soft_wrap=True
    )
    arguments = ["ended", str(run.folder), "--web", options.page, "--problem", problem]
    closing = Stop()  # a person's next Ctrl-C is for the page alone
    with programs.start("groundstation", arguments, stdout=subprocess.PIPE) as page:
        while (output := _output(page)) is None:  # an experiment may be longer than what a pipe holds
            if closing.requested:
                page.terminate()
                return None
        lines = output.decode("utf-8", errors="replace").splitlines()
    choice = json.loads(lines[-1]) if lines and page.returncode == 0 else {"what": "close"}
    if choice["what"] == "again":
        return run.experiment
    return _experiment(choice["experiment"]) if choice["what"] == "edited" else None


def _output(page: subprocess.Popen[bytes]) -> bytes | None:
    """All that a program has said, once it has ended; None if it has not within SLICE_S."""
    try:
        return page.communicate(timeout=SLICE_S)[0]
    except subprocess.TimeoutExpired:
        return None


def _experiment(text: str) -> Experiment:
    """Load an experiment from its text."""
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "experiment.toml"
        file.write_text(text, encoding="utf-8")
        return load_experiment(str(file))


def _result_passed(folder: Path) -> bool:
    file = folder / "result.json"
    return file.exists() and json.loads(file.read_text(encoding="utf-8")).get("verdict") == "passed"
