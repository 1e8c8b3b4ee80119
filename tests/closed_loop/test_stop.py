"""The emergency stop of a terminal in every situation that a person may be in: real stations, real terminals, real sockets.

The stations' and terminals' programs run as ever, with one difference: the folders that all logins of a machine share are the
test's own, so that no station that runs here for other reasons is stopped. Robots are links that confirm what they are told.
"""

import os
import shutil
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from types import MappingProxyType

import pytest

from groundstation.deploy import key_ring
from shoal.bus.bus import Bus
from shoal.bus.endpoint import Endpoint
from shoal.bus.network import endpoint
from shoal.bus.zenoh_transport import MOST_LINKS_OF_ONE, ZenohTransport
from shoal.messages import topics
from shoal.messages.codec import Header
from shoal.messages.messages import Command, CommandKind, Mode, Reply, RobotState
from sim_bridge.sil.ports import free_port
from tests.full_pipe import full_pipe
from tests.groundstation.gate.strangers import Sessions, Strangers
from tests.waiting import eventually, wait_for_line

pytestmark = pytest.mark.real_time

PROGRAM = """
import sys
from pathlib import Path
from groundstation.gate import user_folders
user_folders.RUN, user_folders.TEMPORARY = Path(sys.argv.pop(1)), Path(sys.argv.pop(1))
from groundstation.__main__ import app
sys.argv[0] = "groundstation"
app()
"""
LOGIN = ("PATH", "PYTHONPATH", "LD_LIBRARY_PATH", "VIRTUAL_ENV")  # of this process's environment: what every login has
CONFIRMED = "stop: confirmed by 1, 2"


class Robot:
    """A robot's link: it tells its mode ten times a second, and confirms a STOP."""

    def __init__(self, number: int, where: Endpoint) -> None:
        self._number, self._mode, self._over = number, Mode.DISARMED, threading.Event()
        self._bus = Bus(ZenohTransport(where, patience_s=60.0))
        self._bus.serve(number, self._obey)
        self._bus.announce(f"agent-{number}")
        self._thread = threading.Thread(target=self._tell, daemon=True)
        self._thread.start()

    def _obey(self, header: Header, command: Command) -> Reply:
        if command.order is CommandKind.STOP:
            self._mode = Mode.STOPPED
        return Reply(self._number, True)

    def _tell(self) -> None:
        while not self._over.wait(0.1):
            self._bus.publish(topics.STATE, RobotState(mode=self._mode), time.time_ns(), self._number)

    def close(self) -> None:
        self._over.set()
        self._thread.join()
        self._bus.close()


@dataclass
class StationProcess:
    """A running `groundstation run`."""

    process: "subprocess.Popen[bytes]"
    log: Path
    address: str

    def stops(self) -> int:
        """The number of stops that have reached it."""
        return self.log.read_text().count("STOP asked for")


@dataclass
class Machine:
    """A machine: the folders that its logins share, and the programs that are started from them."""

    folder: Path
    ends: ExitStack = field(default_factory=ExitStack)

    def command(self, *arguments: str) -> list[str]:
        return [sys.executable, "-c", PROGRAM, str(self.folder / "run"), str(self.folder / "tmp"), *arguments]

    def environment(self, more: Mapping[str, str]) -> dict[str, str]:
        own = {name: value.format(self.folder) for name, value in more.items()}
        return {name: os.environ[name] for name in LOGIN if name in os.environ} | own

    def station(
        self, name: str, address: str, *more: str, robots: Sequence[int] = (1, 2), keys: Path | None = None, **login: str
    ) -> StationProcess:
        """Start a station, and wait until its robots are heard."""
        log = self.folder / f"{name}.log"
        arguments = ["run", "pool", "--no-web", "--listen", address, "--run-dir", str(self.folder / name), *more]
        arguments += ["--keys", str(keys)] if keys is not None else []
        with log.open("wb") as file:
            process = subprocess.Popen(
                self.command(*arguments), stdout=file, stderr=file, env=self.environment(login), cwd=self.folder
            )
        self.ends.callback(process.wait)
        self.ends.callback(process.kill)
        wait_for_line(log, "waiting for the fleet", 60.0)
        for number in robots:
            robot = Robot(number, endpoint(address, f"agent-{number}", keys))
            self.ends.callback(robot.close)
        return StationProcess(process, log, address)

    def stop(self, *arguments: str, login: Mapping[str, str] = MappingProxyType({})) -> tuple[int, str, str]:
        """Exit code and what a terminal prints to stdout and stderr, of a command in a login with this environment."""
        done = subprocess.run(
            self.command(*arguments), env=self.environment(login), cwd=self.folder, capture_output=True, text=True,
            timeout=60, check=False,
        )  # fmt: skip
        return done.returncode, done.stdout, done.stderr


@contextmanager
def a_machine(folder: Path) -> Iterator[Machine]:
    for name in ("run", "tmp", "own", "scratch"):
        (folder / name).mkdir()
    (folder / "run" / str(os.geteuid())).mkdir(mode=0o700)
    machine = Machine(folder)
    with machine.ends:
        yield machine


@pytest.fixture(scope="module")
def machine(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Machine]:
    with a_machine(tmp_path_factory.mktemp("m")) as machine:
        yield machine


@pytest.fixture(scope="module")
def ring(tmp_path_factory: pytest.TempPathFactory) -> Path:
    ring, now = tmp_path_factory.mktemp("ring") / "keys", datetime.now(UTC)
    key_ring.init(ring, [], "shoal", now)
    for robot in (1, 2, 3):
        key_ring.add(ring, "robot", robot, now)
    shutil.copytree(ring / "agent-3", ring / "stolen")
    key_ring.revoke(ring, "agent-3", now)
    return ring


@pytest.fixture(scope="module")
def station(machine: Machine, ring: Path) -> StationProcess:
    """A station with keys, started in a login with a runtime folder and another TMPDIR."""
    address = f"tls/127.0.0.1:{free_port()}"
    return machine.station("station", address, keys=ring, XDG_RUNTIME_DIR="{}/own", TMPDIR="{}/scratch")


LOGINS: dict[str, dict[str, str]] = {
    "the same login": {"XDG_RUNTIME_DIR": "{}/own", "TMPDIR": "{}/scratch"},
    "su or cron": {},
    "another runtime folder": {"XDG_RUNTIME_DIR": "{}/run"},
    "another TMPDIR": {"TMPDIR": "{}/own"},
    "a TMPDIR that is gone": {"TMPDIR": "{}/missing", "XDG_RUNTIME_DIR": "{}/missing"},
    "keys that are not there": {"SHOAL_KEYS": "keys"},
    "keys that cannot be read": {"SHOAL_KEYS": "/dev/null"},
    "nonsense": {
        "SHOAL_RUNTIME_DIR": "nonsense",
        "SHOAL_STATION": "x",
        "SHOAL_FLEET": "y",
        "TERM": "z",
        "LC_ALL": "C",
        "TZ": "?",
    },
    "a proxy and no home": {"HOME": "/missing", "http_proxy": "http://192.0.2.1:1", "ZENOH_RUNTIME": "nonsense"},
}


@pytest.mark.parametrize("login", LOGINS.values(), ids=LOGINS.keys())
def test_stop_from_any_login(machine: Machine, station: StationProcess, login: dict[str, str]) -> None:
    before = station.stops()
    code, out, err = machine.stop("stop", login=login)
    assert (code, station.stops()) == (0, before + 1), out + err
    assert ("counts for nothing" in err) == ("SHOAL_RUNTIME_DIR" in login)
    assert out.splitlines() == [
        f"station {station.address} (pool, process {station.process.pid})",
        "  robot 1: confirmed",
        "  robot 2: confirmed",
        CONFIRMED,
    ]


MISTAKES: dict[str, str] = {
    "--verbose stop now": "'--verbose' means nothing to `stop`",
    "mission stop": "",
    "order stop --robot 1": "'--robot' means nothing to `stop`",
    "stop --wait -1": "--wait '-1' cannot be used",
    "stop --wait soon --keys": "--keys has no value",
    "stop --wait 100000": "--wait '100000' cannot be used",
    "stop --keys missing --insecure": "",
    "stop --station 7447": "'7447': not a place where a station can be",
    "stop --fleet nobody": "--fleet nobody: no such station runs here; every station of this machine was stopped",
    "stop --station tcp/127.0.0.1:1 --wait 1": "nobody answers there; every station of this machine was stopped",
}


@pytest.mark.parametrize(("line", "complaint"), MISTAKES.items(), ids=MISTAKES)
def test_stop_whatever_else_is_wrong_in_the_line(machine: Machine, station: StationProcess, line: str, complaint: str) -> None:
    before = station.stops()
    code, out, err = machine.stop(*line.split())
    assert station.stops() == before + 1, out + err
    assert out.splitlines()[-1] == CONFIRMED
    assert complaint in err and bool(err) == bool(complaint)
    assert code == (1 if "127.0.0.1:1" in line else 0)  # the station that was named did not confirm


def test_stop_from_a_folder_that_is_gone_into_an_output_that_nobody_reads(machine: Machine, station: StationProcess) -> None:
    before = station.stops()
    gone = machine.folder / "gone"
    gone.mkdir()
    begin = ["sh", "-c", 'rmdir "$1"; shift; exec "$@"', "sh", str(gone)]
    with full_pipe() as output:
        terminal = subprocess.Popen(begin + machine.command("stop"), cwd=gone, env=machine.environment({}), stdout=output)
        try:
            assert eventually(lambda: station.stops() > before)
            assert terminal.poll() is None  # it still waits to be read
        finally:
            terminal.kill()
            terminal.wait()


def test_stop_from_another_machine_or_user_over_tls(
    machine: Machine, ring: Path, station: StationProcess, tmp_path: Path
) -> None:
    before = station.stops()
    with a_machine(tmp_path) as other:
        code, out, err = other.stop("stop", "--station", station.address, "--keys", str(ring))
        assert (code, out.splitlines()[-1], station.stops()) == (0, CONFIRMED, before + 1), err
        code, out, err = other.stop("stop", "--station", station.address, login={"SHOAL_KEYS": "missing"})
        assert (code, station.stops()) == (1, before + 1)
        assert "NOT HEARD" in out and "missing" in err


def test_stop_while_holders_of_certificates_and_strangers_flood_the_port(
    machine: Machine, ring: Path, station: StationProcess, tmp_path: Path
) -> None:
    """150 handshakes that say no more; sessions of a revoked and of a valid certificate; 300 half-open connections."""
    port, before = int(station.address.rpartition(":")[2]), station.stops()
    silent = Strangers(port, "127.0.0.2", half_open=150, certificate=ring / "viewer")
    sessions = [
        Sessions(station.address, "127.0.0.4", ring / "stolen", 20),
        Sessions(station.address, "127.0.0.5", ring / "viewer", MOST_LINKS_OF_ONE + 20),
    ]
    with Strangers(port, "127.0.0.3", half_open=300), silent, sessions[0], sessions[1]:
        assert eventually(lambda: silent.made >= 40 and sessions[0].tried >= 10 and sessions[1].tried > MOST_LINKS_OF_ONE)
        for _ in range(3):
            code, out, err = machine.stop("stop")
            assert (code, out.splitlines()[-1]) == (0, CONFIRMED), out + err
        with a_machine(tmp_path) as other:
            code, out, err = other.stop("stop", "--station", station.address, "--keys", str(ring))
            assert (code, out.splitlines()[-1]) == (0, CONFIRMED), out + err
        Bus(ZenohTransport(endpoint(station.address, "agent-1", ring), patience_s=5.0)).close()  # a robot comes back
        assert station.stops() == before + 4
        assert eventually(lambda: sessions[0].open() == 0 and sessions[1].open() <= MOST_LINKS_OF_ONE)
    log = station.log.read_text()
    assert "is not on the list of members (revoked?): its connections are closed" in log
    assert f"has {MOST_LINKS_OF_ONE} connections: more of them are closed" in log


def test_stop_reaches_every_station_and_says_of_each_what_it_confirmed(
    machine: Machine, station: StationProcess, tmp_path: Path
) -> None:
    """One without keys for another fleet, and one that hangs, both without robots."""
    addresses = [f"tcp/127.0.0.1:{free_port()}" for _ in range(2)]
    other = machine.station("other", addresses[0], "--fleet", "second", robots=())
    hung = machine.station("hung", addresses[1], robots=(), TMPDIR="{}/own")
    hung.process.send_signal(signal.SIGSTOP)
    before = station.stops()
    code, out, err = machine.stop("stop", "--wait", "1")
    assert code == 1 and err == ""
    assert (station.stops(), other.stops(), hung.stops()) == (before + 1, 1, 0)
    outcomes = {part.partition(" ")[0]: part.splitlines()[1:] for part in out.split("station ")[1:]}
    assert outcomes == {
        station.address: ["  robot 1: confirmed", "  robot 2: confirmed", CONFIRMED],
        other.address: [*(f"  robot {n}: NOT confirmed: not heard" for n in (1, 2)), "stop: not done within 1 s"],
        hung.address: ["stop: not heard: no answer within 2 s"],
    }
    with a_machine(tmp_path) as elsewhere:
        code, out, err = elsewhere.stop("stop", "--station", other.address, "--fleet", "second", "--wait", "0")
        assert (code, out.splitlines()[-1], other.stops()) == (0, "stop: taken by the station", 2), err
    hung.process.send_signal(signal.SIGCONT)
    for one in (other, hung):
        one.process.terminate()
        one.process.wait()


def test_stop_of_a_station_that_hangs_stops_the_others_soon(machine: Machine, station: StationProcess) -> None:
    """Its router still takes the connection, so there is a reply: that nobody has answered."""
    hung = machine.station("named", f"tcp/127.0.0.1:{free_port()}", robots=())
    hung.process.send_signal(signal.SIGSTOP)
    before = station.stops()
    line = machine.command("stop", "--station", hung.address, "--wait", "600")
    with subprocess.Popen(line, env=machine.environment({}), cwd=machine.folder, stdout=subprocess.DEVNULL) as terminal:
        try:
            assert eventually(lambda: station.stops() == before + 1, 15.0)
        finally:
            terminal.kill()
            hung.process.kill()


def test_without_a_station_stop_says_so(tmp_path: Path) -> None:
    with a_machine(tmp_path) as empty:
        code, out, _ = empty.stop("stop", "--wait", "0", "--fleet", "nobody")  # no station at the default port is one of it
    assert (code, out.splitlines()[0]) == (1, "station tcp/127.0.0.1:7447")
