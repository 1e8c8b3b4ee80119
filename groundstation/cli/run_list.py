"""SHELL: `groundstation log list`: the runs of a folder, with date, size and verdict."""

import dataclasses
import json
from collections.abc import Iterator
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Annotated, Any

import typer

from wire.process.cli_options import AsJson
from wire.toml_loader import ConfigError

NO_RESULT = "no result"  # not evaluated, or what result.json holds cannot be read


@dataclass(frozen=True)
class ListedRun:
    """A run's folder, as its files tell it."""

    run: str  # the folder
    date: str  # local time at which it began
    experiment: str
    mode: str
    duration_s: float
    size_mb: float  # of the whole folder
    verdict: str  # passed, failed, or NO_RESULT
    commit: str  # of the code that recorded it


def list_runs(
    words: Annotated[
        list[str] | None, typer.Argument(metavar="[WORD]...", help="Only runs with all these words in a column.")
    ] = None,
    folder: Annotated[Path, typer.Option("--in", metavar="FOLDER", help="Where the runs are.")] = Path("runs"),
    as_json: AsJson = False,
) -> None:
    """List the runs of a folder, the newest last: date, experiment, mode, length, size, verdict.

    Exit code 1 if there is none.

    Examples:  groundstation log list        groundstation log list pool failed
               groundstation log list --in /data/runs --json
    """
    if not folder.is_dir():
        raise ConfigError(f"{folder}: no such folder (--in says where the runs are)")
    found = sorted(_runs(folder), key=lambda run: (run.date, run.run))
    found = [run for run in found if all(_has(run, word) for word in words or ())]
    if as_json:
        typer.echo(json.dumps([dataclasses.asdict(run) for run in found], indent=1))
        raise typer.Exit(0 if found else 1)
    wide = max((len(run.run) for run in found), default=0)
    for run in found:
        figures = f"{run.experiment:16} {run.mode:10} {run.duration_s:6.0f} s {run.size_mb:8.1f} MB"
        typer.echo(f"{run.date:16}  {run.run:{wide}}  {figures}  {run.verdict}")
    if not found:
        typer.echo(f"{folder}: no such run", err=True)
    raise typer.Exit(0 if found else 1)


def _runs(folder: Path) -> Iterator[ListedRun]:
    for log in folder.glob("*/run.mcap"):
        result = _result(log.parent / "result.json")
        passed = result.get("passed")
        yield ListedRun(
            run=str(log.parent),
            date=datetime.fromtimestamp(_begun_s(log)).isoformat(" ", "minutes"),
            experiment=str(result.get("scene", "")),
            mode=str(result.get("mode", "")),
            duration_s=float(result.get("duration_s") or 0.0),
            size_mb=sum(file.stat().st_size for file in log.parent.rglob("*") if file.is_file()) / 1e6,
            verdict=NO_RESULT if passed is None else "passed" if passed else "failed",
            commit=str(result.get("commit", "")),
        )


def _begun_s(log: Path) -> float:
    """Time at which a run began: its experiment is written first, and never again. A log without one tells its end."""
    first = log.parent / "experiment.toml"
    return (first if first.exists() else log).stat().st_mtime


def _result(file: Path) -> dict[str, Any]:
    try:
        found = json.loads(file.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return {}
    return found if isinstance(found, dict) else {}


def _has(run: ListedRun, word: str) -> bool:
    return any(word.lower() in str(value).lower() for value in dataclasses.astuple(run))
