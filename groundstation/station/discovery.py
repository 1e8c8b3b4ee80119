"""SHELL: discovery of this user's stations on this machine, so that a terminal finds the one that runs.

Each station holds a lock on a file of its own in the user's runtime folder for as long as it lives; the kernel lets go of it
however the process ends, so a file without a lock is of a station that is gone.
"""

import fcntl
import json
import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass
from pathlib import Path

from wire.process.cli_options import DEFAULT_STATION
from wire.process.runtime import log
from wire.toml_loader import ConfigError
from wire.transport.endpoint import Endpoint, beside
from wire.transport.gate import private_folder

LARGEST_BYTES = 4096


@dataclass(frozen=True)
class RunningStation:
    """A running station."""

    endpoint: str  # as it is called from this machine
    fleet: str
    experiment: str
    pid: int


def folder() -> Path | None:
    """Folder of the running stations; None if there is none that is the user's alone."""
    return private_folder(make=True)


@contextmanager
def announced(endpoint: Endpoint, fleet: str, experiment: str) -> Iterator[None]:
    """Let terminals find this station meanwhile. Without a runtime folder they need --station."""
    place = folder()
    if place is None:
        log.warning("no runtime folder of this user's own: terminals find this station by --station only")
        yield
        return
    standing = RunningStation(beside(endpoint).address, fleet, experiment, os.getpid())
    path = place / f"{os.getpid()}.json"
    new = path.with_suffix(".new")
    try:
        with new.open("w", encoding="utf-8") as file:
            fcntl.flock(file, fcntl.LOCK_EX)
            json.dump(asdict(standing), file)
            file.flush()
            new.replace(path)  # only now it is looked at: locked, and whole
            yield
    finally:
        path.unlink(missing_ok=True)


def running() -> list[RunningStation]:
    """Every station of this user on this machine. Removes the files of stations that are gone."""
    place, found = folder(), []
    for path in sorted(place.glob("*.json")) if place is not None else []:
        with suppress(OSError, ValueError, TypeError), path.open(encoding="utf-8") as file:
            try:
                fcntl.flock(file, fcntl.LOCK_SH | fcntl.LOCK_NB)
            except BlockingIOError:
                found.append(RunningStation(**json.loads(file.read(LARGEST_BYTES))))
            else:
                path.unlink(missing_ok=True)
    return found


def station(given: str | None, fleet: str) -> str:
    """Endpoint of the station that a terminal means: the one it names, or the only one of this fleet that runs here, or where
    one listens by default. Raises ConfigError if there are several."""
    if given is not None:
        return given
    here = [standing for standing in running() if standing.fleet == fleet]
    if len(here) > 1:
        names = "; ".join(f"--station {s.endpoint} ({s.experiment}, process {s.pid})" for s in here)
        raise ConfigError(f"several stations run here; say which: {names}")
    return here[0].endpoint if here else DEFAULT_STATION
