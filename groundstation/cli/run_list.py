"""SHELL: `groundstation log list`, `label` and `delete`: the runs of a folder, their names and tags, and their end."""

import dataclasses
import json
import re
import shutil
from collections.abc import Iterator
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Annotated, Any

import typer

from wire.process.cli_options import AsJson
from wire.process.output_files import replace_text
from wire.toml_loader import ConfigError

LABEL = "label.json"  # in a run's folder: its name and tags
TAG = re.compile(r"[\w-]+")
NO_RESULT = "no result"  # not evaluated, or what result.json holds cannot be read


@dataclass(frozen=True)
class ListedRun:
    """A run's folder, as its files tell it."""

    run: str  # the folder
    name: str  # given by `log label`
    tags: tuple[str, ...]  # given there, or as #words in remarks while it was flown
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
    """List the runs of a folder, the newest last: date, experiment, mode, length, size, verdict, name and tags.

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
        label = " ".join([*([f'"{run.name}"'] if run.name else []), *(f"#{tag}" for tag in run.tags)])
        typer.echo(f"{run.date:16}  {run.run:{wide}}  {figures}  {run.verdict}  {label}".rstrip())
    if not found:
        typer.echo(f"{folder}: no such run", err=True)
    raise typer.Exit(0 if found else 1)


def label(
    run_folder: Annotated[Path, typer.Argument(metavar="RUN", help="Folder of a run.")],
    name: Annotated[str | None, typer.Option(help="Its name, in a few words; empty for none.")] = None,
    tag: Annotated[list[str] | None, typer.Option(metavar="WORD", help="Add a tag. Repeatable.")] = None,
    untag: Annotated[list[str] | None, typer.Option(metavar="WORD", help="Take a tag away. Repeatable.")] = None,
) -> None:
    """Give a run a name and tags, which `log list` shows and finds.

    Examples:  groundstation log label runs/pool-20260101-120000 --name "first dive" --tag lamp
    """
    _of_a_run(run_folder)
    found = _label(run_folder)
    tags = [known for known in dict.fromkeys([*found["tags"], *map(_word, tag or ())]) if known not in (untag or ())]
    replace_text(run_folder / LABEL, json.dumps({"name": found["name"] if name is None else name, "tags": tags}) + "\n")


def delete(
    run_folders: Annotated[list[Path], typer.Argument(metavar="RUN", help="Folders of runs.")],
    yes: Annotated[bool, typer.Option("--yes", help="Do not ask.")] = False,
) -> None:
    """Delete runs, with everything in their folders. Asks first.

    Example:  groundstation log delete runs/pool-20260101-120000
    """
    for folder in run_folders:
        _of_a_run(folder)
    size_mb = sum(_size_mb(folder) for folder in run_folders)
    if not yes and not typer.confirm(f"delete {', '.join(map(str, run_folders))} ({size_mb:.1f} MB)?"):
        raise typer.Exit(1)
    for folder in run_folders:
        shutil.rmtree(folder)


def _of_a_run(folder: Path) -> None:
    if folder.is_symlink() or not (folder / "run.mcap").is_file():
        raise ConfigError(f"{folder}: no folder of a run (allowed: one with run.mcap, and no link)")


def _word(tag: str) -> str:
    if not TAG.fullmatch(tag):
        raise ConfigError(f"--tag {tag}: must be a word (allowed: letters, digits, _ and -)")
    return tag


def _label(folder: Path) -> dict[str, Any]:
    """Name and tags of a run's folder; none where the file is missing or is something else."""
    found = _json(folder / LABEL)
    tags = found.get("tags")
    return {"name": str(found.get("name", "")), "tags": [str(tag) for tag in tags] if isinstance(tags, list) else []}


def _size_mb(folder: Path) -> float:
    return sum(file.stat().st_size for file in folder.rglob("*") if file.is_file()) / 1e6


def _runs(folder: Path) -> Iterator[ListedRun]:
    for log in folder.glob("*/run.mcap"):
        result, given = _json(log.parent / "result.json"), _label(log.parent)
        passed, said = result.get("passed"), result.get("tags")
        yield ListedRun(
            run=str(log.parent),
            name=given["name"],
            tags=tuple(dict.fromkeys([*given["tags"], *(map(str, said) if isinstance(said, list) else ())])),
            date=datetime.fromtimestamp(_begun_s(log)).isoformat(" ", "minutes"),
            experiment=str(result.get("scene", "")),
            mode=str(result.get("mode", "")),
            duration_s=float(result.get("duration_s") or 0.0),
            size_mb=_size_mb(log.parent),
            verdict=NO_RESULT if passed is None else "passed" if passed else "failed",
            commit=str(result.get("commit", "")),
        )


def _begun_s(log: Path) -> float:
    """Time at which a run began: its experiment is written first, and never again. A log without one tells its end."""
    first = log.parent / "experiment.toml"
    return (first if first.exists() else log).stat().st_mtime


def _json(file: Path) -> dict[str, Any]:
    try:
        found = json.loads(file.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return {}
    return found if isinstance(found, dict) else {}


def _has(run: ListedRun, word: str) -> bool:
    return any(word.lower() in str(value).lower() for value in dataclasses.astuple(run))
