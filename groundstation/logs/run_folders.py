"""SHELL: the runs of a folder: what their files tell, their names and tags, and their end.

for run in list_runs(Path("runs")): ...
give_label(Path("runs/pool-20260101-120000"), name="first dive", tags=["lamp"])
"""

import fcntl
import json
import os
import re
import shutil
from collections.abc import Iterable
from contextlib import suppress
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Any

from groundstation.logs.recorder import claim, mode_text
from shoal.config.loader import read_toml
from shoal.errors import ConfigError, os_errors_as_config_errors
from shoal.runtime.output_files import replace_text
from shoal.system.printable import printable
from shoal.system.regular_files import open_regular, read_regular

LABEL = "label.json"  # in a run's folder: its name and tags
TAG = re.compile(r"[\w-]+")
MOST_JSON_BYTES = 8_000_000  # of result.json: a flight of 20 robots has a hundredth
MOST_TEXT, MOST_TAGS = 200, 50  # characters of a text, and tags, that the list shows
LONGEST_S = 1e7  # of a run: four months
_LATEST_S = 250e9  # of a date: in the year 9892
NO_RESULT = "no result"  # not evaluated, or what result.json holds cannot be read


@dataclass(frozen=True)
class ListedRun:
    """A run's folder, as its files tell it."""

    run: str  # the folder
    name: str  # given with `give_label`
    tags: tuple[str, ...]  # given there, or as #words in remarks while it was flown
    date: str  # local time at which it began
    experiment: str
    mode: str
    duration_s: float
    size_mb: float  # of the whole folder
    verdict: str  # passed, failed, not judged, or NO_RESULT
    commit: str  # of the code that recorded it

    @property
    def mode_text(self) -> str:
        """The kind of time that it had, for people."""
        return mode_text(self.mode)


def list_runs(folder: Path) -> list[ListedRun]:
    """The runs of a folder, the newest last. A run that is just deleted is left out."""
    runs = []
    for log in folder.glob("*/run.mcap"):
        try:
            runs.append(_listed(log))
        except OSError:
            continue
    return sorted(runs, key=lambda run: (run.date, run.run))


def run_named(folder: Path, name: str) -> Path:
    """The run of this name in a folder, as it is or as it is shown (system/printable.py). The name is compared with the
    folder's entries, so that none leads out of it. Raises ConfigError."""
    with os_errors_as_config_errors(folder):
        entries = {entry.name: entry for entry in folder.iterdir()}
    entries = {printable(own): entry for own, entry in entries.items()} | entries
    if name in entries:
        check_run(entries[name])
        return entries[name]
    raise ConfigError(f"{name}: no such run")


def check_run(folder: Path) -> None:
    """Raise ConfigError if a folder is not that of a run."""
    if folder.is_symlink() or not (folder / "run.mcap").is_file():
        raise ConfigError(f"{folder}: no folder of a run (allowed: one with run.mcap, and no link)")


def label_of(folder: Path) -> tuple[str, tuple[str, ...]]:
    """Name and tags that a run was given; none where the file is missing or is something else."""
    label = read_json(folder / LABEL)
    return _text(label.get("name")), _texts(label.get("tags"))


def give_label(folder: Path, name: str, tags: Iterable[str]) -> None:
    """Replace a run's name and tags. Raises ConfigError."""
    check_run(folder)
    kept = list(dict.fromkeys(tags))
    for tag in kept:
        if not TAG.fullmatch(tag):
            raise ConfigError(f"tag {tag}: must be a word (allowed: letters, digits, _ and -)")
    with os_errors_as_config_errors(folder / LABEL):
        replace_text(folder / LABEL, json.dumps({"name": name, "tags": kept}) + "\n")


def change_label(folder: Path, name: str | None, add: Iterable[str], remove: Iterable[str]) -> None:
    """Give a run another name (None: the same), more tags and fewer. One change waits for another to end, so that none is
    lost. Raises ConfigError."""
    check_run(folder)
    with os_errors_as_config_errors(folder):
        lock = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
        try:
            with suppress(OSError):  # a file system that knows no locks
                fcntl.flock(lock, fcntl.LOCK_EX)
            named, tags = label_of(folder)
            dropped = set(remove)
            give_label(folder, named if name is None else name, (tag for tag in (*tags, *add) if tag not in dropped))
        finally:
            os.close(lock)


def delete_run(folder: Path) -> None:
    """Delete a run with everything in its folder. Raises ConfigError for a run that is being flown: its recorder has the
    log."""
    check_run(folder)
    path = folder / "run.mcap"
    with os_errors_as_config_errors(path), open_regular(path) as log:
        claim(log.fileno(), path, fcntl.LOCK_EX, "its run still goes on")
        shutil.rmtree(folder)


def size_mb(folder: Path) -> float:
    """Size of all files below a folder."""
    return sum(file.lstat().st_size for file in folder.rglob("*") if file.is_file()) / 1e6


def _listed(log: Path) -> ListedRun:
    """The row of one run in the list, from its log, its result and its label."""
    result = read_json(log.parent / "result.json")
    name, tags = label_of(log.parent)
    passed = result.get("passed")
    verdict = NO_RESULT
    if isinstance(passed, bool):
        verdict = _text(result.get("verdict")) or ("passed" if passed else "failed")
    return ListedRun(
        run=str(log.parent),
        name=name,
        tags=tuple(dict.fromkeys([*tags, *_texts(result.get("tags"))])),
        date=datetime.fromtimestamp(_begun_s(log)).isoformat(" ", "minutes"),
        experiment=_text(result.get("scene")) or _experiment_name(log.parent),
        mode=_text(result.get("mode")),
        duration_s=_seconds(result.get("duration_s")),
        size_mb=size_mb(log.parent),
        verdict=verdict,
        commit=_text(result.get("commit")),
    )


def _experiment_name(folder: Path) -> str:
    """Name of the experiment of a run that is not evaluated, as while it is flown; empty if its file cannot be read."""
    try:
        return _text(read_toml(folder / "experiment.toml").get("name"))
    except ConfigError:
        return ""


def _begun_s(log: Path) -> float:
    """Time at which a run began: its experiment is written first, and never again. A log without one tells its end. Within
    the years of a calendar, which a file's date need not be."""
    first = log.parent / "experiment.toml"
    return min(max((first if first.exists() else log).stat().st_mtime, 0.0), _LATEST_S)


def read_json(file: Path) -> dict[str, Any]:
    """The object that a file holds; none where it is missing or holds something else."""
    try:
        content = json.loads(read_regular(file, MOST_JSON_BYTES))
    except (OSError, ValueError, RecursionError):
        return {}
    return content if isinstance(content, dict) else {}


def _text(value: Any) -> str:
    """A text or a number of a file as text, cut where no reader would go on; nothing for any other value."""
    return str(value)[:MOST_TEXT] if isinstance(value, str | int | float) else ""


def _texts(value: Any) -> tuple[str, ...]:
    return tuple(_text(one) for one in value[:MOST_TAGS]) if isinstance(value, list) else ()


def _seconds(value: Any) -> float:
    """A duration of a file; 0 for a value that is none."""
    is_one = isinstance(value, int | float) and not isinstance(value, bool) and 0 <= value < LONGEST_S
    return float(value) if is_one else 0.0
