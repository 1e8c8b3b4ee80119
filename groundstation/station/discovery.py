"""SHELL: discovery of this user's stations on this machine, so that a terminal finds the one that runs.

Each station has its own door, and a file that says what it is, in each of the user's folders (gate/user_folders.py).
It holds a lock on the file for as long as it lives; the kernel lets go of it however the process ends, so a file without a
lock is of a station that is gone.
"""

import fcntl
import json
import os
import secrets
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import IO

from groundstation.gate.gate import is_here
from groundstation.gate.own_door import OwnDoor
from groundstation.gate.user_folders import fits, user_folders
from shoal.bus.bus import Bus
from shoal.bus.endpoint import Endpoint, client_of, parse_address
from shoal.errors import ConfigError
from shoal.runtime.cli_options import DEFAULT_STATION
from shoal.runtime.runtime import log

LARGEST_BYTES = 4096


@dataclass(frozen=True)
class RunningStation:
    endpoint: str  # as it is called from this machine
    fleet: str
    experiment: str
    pid: int
    doors: tuple[Path, ...] = ()  # all lead to it

    @property
    def name(self) -> str:
        """Name for a person's eyes."""
        return f"{self.endpoint} ({self.experiment}, process {self.pid})" if self.pid else self.endpoint


@contextmanager
def announced(endpoint: Endpoint, fleet: str, experiment: str, bus: Bus) -> Iterator[None]:
    """Let terminals find this station meanwhile, and make requests at its own door."""
    standing = RunningStation(client_of(endpoint).address, fleet, experiment, os.getpid())
    name = f"{os.getpid()}-{secrets.token_hex(4)}"  # containers share folders, and count processes each for themselves
    with ExitStack() as places:
        doors = sum([_offer_station(places, folder / name, standing, bus) for folder in user_folders(make=True)])
        if not doors:
            log.warning("no door for this machine: terminals find this station by --station only")
        yield


def _offer_station(places: ExitStack, path: Path, standing: RunningStation, bus: Bus) -> bool:
    """Open a socket for requests (own_door.py), and write the file by which terminals find the station, in one folder. Both
    are removed when `places` ends. Returns True if the socket could be opened."""
    door_path, file_path, new_path = (path.with_suffix(suffix) for suffix in (".sock", ".json", ".new"))
    has_door = False
    try:
        if fits(door_path):
            places.callback(OwnDoor(door_path, bus.answer).close)
            has_door = True
        file = places.enter_context(new_path.open("w", encoding="utf-8"))
        places.callback(file_path.unlink, missing_ok=True)
        places.callback(new_path.unlink, missing_ok=True)
        fcntl.flock(file, fcntl.LOCK_EX)
        json.dump({key: value for key, value in asdict(standing).items() if key != "doors"}, file)
        file.flush()
        new_path.replace(file_path)  # terminals read it from here on: it is locked, and whole
    except OSError as error:  # a full disk: the other folders may be elsewhere
        log.warning("terminals do not find this station in %s: %s", path.parent, error.strerror or error)
        return False
    return has_door


def running() -> list[RunningStation]:
    """Every station of this user on this machine. A running station keeps its file locked; files and sockets of stations that
    have ended are removed."""
    stations: dict[str, RunningStation] = {}
    for path in sorted(file for folder in user_folders() for file in folder.glob("*.json")):
        with suppress(OSError, ValueError, TypeError, RecursionError, ConfigError), _opened(path) as file:
            door = path.with_suffix(".sock")
            try:
                fcntl.flock(file, fcntl.LOCK_SH | fcntl.LOCK_NB)
            except BlockingIOError:
                other = stations.get(path.name) or _read_station_file(file.read(LARGEST_BYTES))
                stations[path.name] = replace(other, doors=(*other.doors, *([door] if door.is_socket() else [])))
            else:
                for abandoned in (path, door):
                    abandoned.unlink(missing_ok=True)
    return list(stations.values())


def _opened(path: Path) -> IO[str]:
    """A file of a folder, for reading: a pipe is not waited for."""
    return open(os.open(path, os.O_RDONLY | os.O_NONBLOCK), encoding="utf-8")  # noqa: PTH123


def _read_station_file(text: str) -> RunningStation:
    """The station that a file tells of. Raises ValueError, TypeError or ConfigError for any other text."""
    station = RunningStation(**json.loads(text))
    if not all(isinstance(part, str) for part in (station.endpoint, station.fleet, station.experiment)):
        raise TypeError("not a station's file")
    parse_address(station.endpoint)
    return station


def named(address: str) -> RunningStation:
    """The station at an endpoint: with its doors where it runs on this machine as this user. Raises ConfigError for what is no
    endpoint."""
    _, host, port = parse_address(address)
    here = [one for one in running() if parse_address(one.endpoint)[2] == port] if is_here(host) else []
    same = [one for one in here if parse_address(one.endpoint)[1] == host] or here
    return same[0] if same else RunningStation(address, "", "", 0)


def station(name: str | None, fleet: str) -> RunningStation:
    """The station that a terminal means: the one it names, the only one of this fleet that runs here, or one at the default
    port. Raises ConfigError if there are several."""
    if name is not None:
        return named(name)
    here = [standing for standing in running() if standing.fleet == fleet]
    if len(here) > 1:
        names = "; ".join(f"--station {s.name}" for s in here)
        raise ConfigError(f"several stations run here; say which: {names}")
    return here[0] if here else RunningStation(DEFAULT_STATION, fleet, "", 0)
