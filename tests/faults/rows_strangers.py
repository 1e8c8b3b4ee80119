"""SHELL: strangers, and holders of certificates, at the port of a station that has keys: members must come in all the same."""

import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from datetime import UTC, datetime
from pathlib import Path

from groundstation.deploy import key_ring
from groundstation.gate.own_door import DoorTransport
from groundstation.station import discovery
from shoal.bus.bus import Bus
from shoal.bus.endpoint import Endpoint
from shoal.bus.network import endpoint
from shoal.bus.zenoh_transport import ZenohTransport
from shoal.errors import Unreached
from shoal.messages.messages import Command, CommandKind
from sim_bridge.sil.ports import free_port
from tests.faults.onlooker import PATIENCE_S, Stuck
from tests.faults.row import Random, Sample
from tests.groundstation.gate.strangers import Sessions, Strangers

ATTACKS: tuple[dict[str, float], ...] = (
    {"knocks_hz": 12.0},
    {"knocks_hz": 200.0},
    {"half_open": 900},
    {"handshakes_hz": 50.0},
)
SESSIONS, SILENT = 1000, 200  # what holders of a certificate try to open; Zenoh's own limits are 1,000 and 100
ATTACK_S = 8.0  # before anybody wants to come in
Attack = AbstractContextManager[object]
PROGRAM = [sys.executable, "-m"]


@contextmanager
def _process(log: Path, *command: str) -> Iterator[subprocess.Popen[bytes]]:
    with log.open("ab") as file:
        child = subprocess.Popen([*PROGRAM, *command], stdout=file, stderr=file)
    try:
        yield child
    finally:
        child.send_signal(signal.SIGTERM)
        try:
            child.wait(10.0)
        except subprocess.TimeoutExpired:
            child.kill()
            child.wait()


def _arrived(where: Endpoint) -> ZenohTransport:
    try:
        return ZenohTransport(where, patience_s=PATIENCE_S)
    except Unreached as error:
        raise Stuck(str(error)) from None


def _stop_s(where: Endpoint | None, address: str) -> float:
    """The time from an operator's start to the station's reply to a stop, s: at the station's own door, or over a network."""
    begin_s = time.monotonic()
    here = discovery.named(address)
    if where is None and not here.doors:
        raise Stuck("the station has no door")
    with Bus(_arrived(where) if where is not None else DoorTransport(here.doors)) as bus:
        while not (reply := bus.command(Command(CommandKind.STOP, 0), time.time_ns(), 2.0)).accepted:
            if time.monotonic() - begin_s > PATIENCE_S:
                raise Stuck(f"no stop: {reply.reason}")
    return time.monotonic() - begin_s


def _joins_s(there: Bus, where: Endpoint) -> float:
    """The time from the start of an agent's link until the others see the agent, s."""
    begin_s = time.monotonic()
    with Bus(_arrived(where)) as agent:
        agent.announce("agent-1")
        if not there.wait(lambda: "agent-1" in there.present, PATIENCE_S):
            raise Stuck("agent-1 is not there")
        return time.monotonic() - begin_s


def strangers_knock(rig: None, random: Random) -> Sample:
    """Strangers from the members' own address, or another; whole handshakes only from another (docs/security.md)."""
    attack = ATTACKS[int(random.integers(len(ATTACKS)))]
    source = "127.0.0.2" if "handshakes_hz" in attack or random.integers(2) else "127.0.0.1"
    return _under(lambda port, ring: Strangers(port, source, **attack))  # type: ignore[arg-type]


def members_flood(rig: None, random: Random) -> Sample:
    """Holders of certificates: sessions of a revoked one, sessions of a viewer's, or handshakes with it that say no more."""
    kind = int(random.integers(3))

    def attack(port: int, ring: Path) -> Attack:
        if kind == 2:
            return Strangers(port, "127.0.0.2", half_open=SILENT, certificate=ring / "viewer")
        return Sessions(f"tls/127.0.0.1:{port}", "127.0.0.2", ring / ("viewer" if kind else "stolen"), SESSIONS)

    return _under(attack)


def _under(attack: Callable[[int, Path], Attack]) -> Sample:
    """Measure a stop and a robot that joins at a station that is attacked so."""
    folder = Path(tempfile.mkdtemp(prefix="shoal-strangers-"))
    ring, now, port = folder / "keys", datetime.now(UTC), free_port()
    key_ring.init(ring, [], "shoal", now)
    for robot in (1, 2):
        key_ring.add(ring, "robot", robot, now)
    shutil.copytree(ring / "agent-2", ring / "stolen")
    key_ring.revoke(ring, "agent-2", now)
    address = f"tls/127.0.0.1:{port}"
    station = ["groundstation", "run", "pool", "--listen", address, "--keys", str(ring), "--no-web", "--no-report"]
    with (
        _process(folder / "station.log", *station, "--run-dir", str(folder / "run")),
        Bus(_arrived(endpoint(address, "viewer", ring))) as there,
    ):
        there.watch_presence()
        if not there.wait(lambda: "groundstation" in there.present, PATIENCE_S):
            raise Stuck("the station is not there")
        operator = endpoint(address, "operator", ring)
        with attack(port, ring):
            time.sleep(ATTACK_S)
            return {
                "stop answered, this machine": _stop_s(None, address),
                "stop answered": _stop_s(operator, address),
                "agent joins": _joins_s(there, endpoint(address, "agent-1", ring)),
            }
