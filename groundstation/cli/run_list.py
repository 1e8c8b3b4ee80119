"""SHELL: `groundstation log list`, `label` and `delete`: the runs of a folder, their names and tags, and their end."""

import dataclasses
import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from shoal.errors import ConfigError
from shoal.runtime.cli_options import AsJson, RunFolder, as_run
from shoal.system.printable import printable

if TYPE_CHECKING:  # what reads logs is imported where it is needed: a robot's board has none of it
    from groundstation.logs.run_folders import ListedRun


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
    from groundstation.logs import run_folders

    if not folder.is_dir():
        raise ConfigError(f"{folder}: no such folder (--in says where the runs are)")
    runs = [run for run in run_folders.list_runs(folder) if all(_has(run, word) for word in words or ())]
    if as_json:
        typer.echo(json.dumps([dataclasses.asdict(run) for run in runs], indent=1))
        raise typer.Exit(0 if runs else 1)
    wide = max((len(run.run) for run in runs), default=0)
    for run in runs:
        length = f"{run.duration_s:6.0f} s" if run.duration_s > 0.0 else f"{'-':>6}  "  # not known while it is flown
        figures = f"{run.experiment:16} {run.mode_text:17} {length} {run.size_mb:8.1f} MB"
        label = " ".join([*([f'"{run.name}"'] if run.name else []), *(f"#{tag}" for tag in run.tags)])
        typer.echo(printable(f"{run.date:16}  {run.run:{wide}}  {figures}  {run.verdict}  {label}".rstrip()))
    if not runs:
        typer.echo(f"{folder}: no such run", err=True)
    raise typer.Exit(0 if runs else 1)


def label(
    run_folder: RunFolder,
    name: Annotated[str | None, typer.Option(help="Its name, in a few words; empty for none.")] = None,
    tag: Annotated[list[str] | None, typer.Option(metavar="WORD", help="Add a tag. Repeatable.")] = None,
    untag: Annotated[list[str] | None, typer.Option(metavar="WORD", help="Take a tag away. Repeatable.")] = None,
) -> None:
    """Give a run a name and tags, which `log list` shows and finds.

    Examples:  groundstation log label runs/pool-20260101-120000 --name "first dive" --tag lamp
    """
    from groundstation.logs import run_folders

    run_folders.change_label(run_folder, name, tag or (), untag or ())


def delete(
    runs: Annotated[list[Path], typer.Argument(metavar="RUN", help="Folders of runs.", callback=as_run)],
    yes: Annotated[bool, typer.Option("--yes", help="Do not ask.")] = False,
) -> None:
    """Delete runs, with everything in their folders. Asks first; refuses a run that is being flown.

    Example:  groundstation log delete runs/pool-20260101-120000
    """
    from groundstation.logs import run_folders

    for folder in runs:
        run_folders.check_run(folder)
    runs = list({folder.resolve(): folder for folder in runs}.values())  # one that is named twice is deleted once
    size_mb = sum(map(run_folders.size_mb, runs))
    if not yes and not typer.confirm(f"delete {', '.join(map(str, runs))} ({size_mb:.1f} MB)?"):
        raise typer.Exit(1)
    for folder in runs:
        run_folders.delete_run(folder)


def _has(run: "ListedRun", word: str) -> bool:
    return any(word.lower() in str(value).lower() for value in (*dataclasses.astuple(run), run.mode_text))
