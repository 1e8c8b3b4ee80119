"""A terminal finds the station that runs on its machine."""

import fcntl
import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from groundstation.gate import user_folders
from groundstation.station.discovery import RunningStation, announced, running, station
from shoal.bus.bus import Bus
from shoal.bus.endpoint import Endpoint
from shoal.bus.memory_transport import MemoryHub, MemoryTransport
from shoal.errors import ConfigError
from shoal.runtime.cli_options import DEFAULT_STATION

pytestmark = pytest.mark.real_time

HERE = Endpoint("tcp/127.0.0.1:17448", router=True)
CHILD = """
import sys
from groundstation.station.discovery import announced
from shoal.bus.bus import Bus
from shoal.bus.endpoint import Endpoint
from shoal.bus.memory_transport import MemoryHub, MemoryTransport
with announced(Endpoint(sys.argv[1], router=True), "shoal", "pool", Bus(MemoryTransport(MemoryHub()))):
    print("here", flush=True)
    sys.stdin.read()
"""


@pytest.fixture(autouse=True)
def place(tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The user's only folder."""
    place = tmp_path_factory.mktemp("p")
    monkeypatch.setenv(user_folders.ONLY, str(place))
    return place


@contextmanager
def standing(endpoint: Endpoint = HERE, experiment: str = "pool") -> Iterator[None]:
    with announced(endpoint, "shoal", experiment, Bus(MemoryTransport(MemoryHub()))):
        yield


def found(given: str | None = None, fleet: str = "shoal") -> str:
    return station(given, fleet).endpoint


def another(address: str) -> "subprocess.Popen[str]":
    child = subprocess.Popen([sys.executable, "-c", CHILD, address], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
    assert child.stdout is not None and child.stdout.readline() == "here\n"
    return child


def test_the_only_station_is_found_while_it_runs(place: Path) -> None:
    assert found() == DEFAULT_STATION
    with standing():
        assert found() == HERE.address
        assert found("tcp/192.0.2.1:1") == "tcp/192.0.2.1:1"
        assert found(fleet="another-fleet") == DEFAULT_STATION
    assert found() == DEFAULT_STATION
    assert list(place.iterdir()) == []


def test_a_named_station_is_known_by_its_port_on_this_machine() -> None:
    with standing(), standing(Endpoint("tls/127.0.0.2:17448", router=True), "islands"):
        assert station("tls/127.0.0.1:17448", "shoal").experiment == "pool"
        assert station("tcp/127.0.0.2:17448", "shoal").experiment == "islands"
        assert len(station("tcp/localhost:17448", "shoal").doors) == 1
        for other in ("tcp/127.0.0.1:17449", "tcp/192.0.2.1:17448"):
            assert station(other, "shoal") == RunningStation(other, "", "", 0)


def test_one_that_listens_everywhere_is_called_by_loopback() -> None:
    with standing(Endpoint("tls/0.0.0.0:7448", router=True)):
        assert found() == "tls/127.0.0.1:7448"


def test_a_station_in_several_folders_is_one_with_several_doors(
    tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv(user_folders.ONLY)
    places = [tmp_path_factory.mktemp("q") for _ in range(2)]
    monkeypatch.setattr(user_folders, "TEMPORARY", places[0])
    monkeypatch.setattr(user_folders, "RUN", places[1] / "missing")
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(places[1]))
    with standing():
        (one,) = running()
        assert len(one.doors) == 2
    assert running() == []


def test_a_station_that_was_killed_is_not_there_and_its_files_go(place: Path) -> None:
    child = another("tcp/127.0.0.1:4")
    try:
        assert found() == "tcp/127.0.0.1:4"
        child.send_signal(signal.SIGKILL)
        child.wait()
        assert len(list(place.iterdir())) == 2
        assert found() == DEFAULT_STATION
        assert list(place.iterdir()) == []
    finally:
        child.kill()
        child.communicate()


def test_several_running_stations_are_named_and_none_is_chosen() -> None:
    child = another("tcp/127.0.0.1:4")
    try:
        with standing(experiment="islands"), pytest.raises(ConfigError, match="several stations run here") as refused:
            station(None, "shoal")
        for part in ("--station tcp/127.0.0.1:4 (pool", f"--station {HERE.address} (islands, process {os.getpid()})"):
            assert part in str(refused.value)
    finally:
        child.kill()
        child.communicate()


@pytest.mark.parametrize(
    "text",
    [
        "",
        "{",
        "[]",
        "{}",
        '{"endpoint": 1}',
        '{"endpoint": 1, "fleet": 1, "experiment": 1, "pid": 1}',
        "[" * 4000,
        "\x00" * 9000,
    ],
)
def test_discovery_ignores_foreign_files(place: Path, text: str) -> None:
    os.mkfifo(place / "2.json")
    with standing(), (place / "1.json").open("w") as file:
        file.write(text)
        file.flush()
        fcntl.flock(file, fcntl.LOCK_EX)
        assert [one.endpoint for one in running() if one.pid == os.getpid()] == [HERE.address]
        assert found() == HERE.address


def test_a_station_without_a_folder_runs_and_says_so(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    for name in (user_folders.ONLY, "XDG_RUNTIME_DIR", "TMPDIR"):
        monkeypatch.delenv(name, raising=False)
    for name in ("RUN", "TEMPORARY"):
        monkeypatch.setattr(user_folders, name, tmp_path / "missing")
    with standing():
        assert running() == []
    assert "find this station by --station only" in caplog.text
