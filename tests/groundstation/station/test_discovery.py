"""A terminal finds the station that runs on its machine."""

import os
import signal
import subprocess
import sys
import tempfile
from pathlib import Path

import pytest

from groundstation.station.discovery import announced, folder, running, station
from wire.process.cli_options import DEFAULT_STATION
from wire.toml_loader import ConfigError
from wire.transport.endpoint import Endpoint

pytestmark = pytest.mark.real_time

HERE = Endpoint("tcp/127.0.0.1:17448", router=True)
CHILD = """
import sys
from groundstation.station.discovery import announced
from wire.transport.endpoint import Endpoint
with announced(Endpoint(sys.argv[1], router=True), "shoal", "pool"):
    print("here", flush=True)
    sys.stdin.read()
"""


@pytest.fixture(autouse=True)
def place(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    return tmp_path / "shoal"


def another(address: str) -> "subprocess.Popen[str]":
    child = subprocess.Popen([sys.executable, "-c", CHILD, address], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
    assert child.stdout is not None and child.stdout.readline() == "here\n"
    return child


def test_the_only_station_is_found_while_it_runs(place: Path) -> None:
    assert station(None, "shoal") == DEFAULT_STATION
    with announced(HERE, "shoal", "pool"):
        assert station(None, "shoal") == HERE.address
        assert station("tcp/other:1", "shoal") == "tcp/other:1"
        assert station(None, "another-fleet") == DEFAULT_STATION
    assert station(None, "shoal") == DEFAULT_STATION
    assert list(place.iterdir()) == []


def test_one_that_listens_everywhere_is_called_by_loopback() -> None:
    with announced(Endpoint("tls/0.0.0.0:7448", router=True), "shoal", "pool"):
        assert station(None, "shoal") == "tls/127.0.0.1:7448"


def test_a_station_that_was_killed_is_not_there_and_its_file_goes(place: Path) -> None:
    child = another("tcp/127.0.0.1:4")
    try:
        assert station(None, "shoal") == "tcp/127.0.0.1:4"
        child.send_signal(signal.SIGKILL)
        child.wait()
        assert len(list(place.iterdir())) == 1
        assert station(None, "shoal") == DEFAULT_STATION
        assert list(place.iterdir()) == []
    finally:
        child.kill()
        child.communicate()


def test_several_running_stations_are_named_and_none_is_chosen() -> None:
    child = another("tcp/127.0.0.1:4")
    try:
        with (
            announced(HERE, "shoal", "islands"),
            pytest.raises(ConfigError, match="several stations run here") as refused,
        ):
            station(None, "shoal")
        for part in ("--station tcp/127.0.0.1:4 (pool", f"--station {HERE.address} (islands, process {os.getpid()})"):
            assert part in str(refused.value)
    finally:
        child.kill()
        child.communicate()


@pytest.mark.parametrize("text", ["", "{", "[]", "{}", '{"endpoint": 1}', "\x00" * 9000])
def test_discovery_ignores_foreign_files(place: Path, text: str) -> None:
    import fcntl

    with announced(HERE, "shoal", "pool"), (place / "1.json").open("w") as file:
        file.write(text)
        file.flush()
        fcntl.flock(file, fcntl.LOCK_EX)
        assert [found.endpoint for found in running() if found.pid == os.getpid()] == [HERE.address]
        assert station(None, "shoal") == HERE.address


def test_a_folder_that_others_can_write_to_is_not_believed(place: Path, caplog: pytest.LogCaptureFixture) -> None:
    """Else anybody on the machine could lead a stop astray."""
    place.mkdir(mode=0o700)
    place.chmod(0o777)
    assert folder() is None
    with announced(HERE, "shoal", "pool"):
        assert station(None, "shoal") == DEFAULT_STATION
    place.chmod(0o700)
    assert folder() == place


def test_without_a_runtime_folder_there_is_one_of_the_user_s_own(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.delenv("XDG_RUNTIME_DIR")
    monkeypatch.setattr(tempfile, "gettempdir", lambda: str(tmp_path))
    assert folder() == tmp_path / f"shoal-{os.getuid()}"
    with announced(HERE, "shoal", "pool"):
        assert station(None, "shoal") == HERE.address
