"""Recorded traffic played back to real programs, over real sessions: nothing of it is ever obeyed but what takes power away.

On an open network, where anybody may speak: with keys the strangers would not get this far. Every order lives for an hour, so
its age protects nobody, and the old station's heartbeats are played back with its orders.
"""

import subprocess
import sys
import time
from dataclasses import dataclass, field
from pathlib import Path

import pytest

from shoal.bus.bus import Bus
from shoal.bus.endpoint import Endpoint
from shoal.bus.transport import Await
from shoal.bus.zenoh_transport import ZenohTransport
from shoal.config.experiment import load_experiment
from shoal.messages import topics
from shoal.messages.messages import Command, CommandKind, Mode, Reply, RobotState, StationHeartbeat
from shoal.runtime.runtime import WallClock
from sim_bridge.sil.ports import free_port
from tests.waiting import eventually

pytestmark = pytest.mark.real_time

POOL = load_experiment("pool")
HOUR_S = 3600.0
GIVEN = (CommandKind.STOP, CommandKind.CLEAR_STOP, CommandKind.DISARM, CommandKind.STOP, CommandKind.CLEAR_STOP)


@dataclass
class Tape:
    """Everything that was asked, as it was on the wire."""

    orders: list[tuple[str, bytes, bytes]] = field(default_factory=list)

    def record(self, bus: Bus) -> None:
        ask = bus.transport.ask

        def recording(key: str, payload: bytes, header: bytes, timeout_s: float) -> Await:
            self.orders.append((key, payload, header))
            return ask(key, payload, header, timeout_s)

        bus.transport.ask = recording  # type: ignore[method-assign]

    def play(self, address: str) -> list[bytes | None]:
        """As a stranger does it: bytes, from a session of his own."""
        stranger = ZenohTransport(Endpoint(address), patience_s=5.0)
        try:
            return [stranger.ask(*order, 1.0)() for order in self.orders]
        finally:
            stranger.close()


class FleetProgram:
    """A program of the fleet as a person starts it, and its log."""

    def __init__(self, log: Path, *command: str) -> None:
        self._log = log
        with log.open("wb") as output:
            self.process = subprocess.Popen([sys.executable, "-m", *command], stdout=output, stderr=subprocess.STDOUT)

    def said(self, what: str) -> int:
        return self._log.read_text(encoding="utf-8").count(what)

    def end(self) -> None:
        self.process.kill()
        self.process.wait()


class Beating:
    """A station that is heard: its heartbeat goes out while one waits for something."""

    def __init__(self, address: str) -> None:
        self.bus, self._clock = Bus(ZenohTransport(Endpoint(address), patience_s=5.0)), WallClock()
        self.states = self.bus.inbox(topics.STATE, RobotState, 1)

    def beat(self) -> None:
        self.bus.publish(topics.HEARTBEAT, StationHeartbeat(POOL.hash), self._clock.now_ns())

    def until_heard(self, robot: FleetProgram) -> None:
        def heard() -> bool:
            self.beat()
            header = self.states.newest_header()
            return robot.said("ready") == 1 and header is not None and header.sequence > 20

        assert eventually(heard, 30.0)

    def order(self, order: CommandKind) -> Reply:
        self.beat()
        time.sleep(0.05)
        return self.bus.command(Command(order, 1, HOUR_S, POOL.hash), self._clock.now_ns(), 2.0)

    def mode(self) -> Mode | None:
        time.sleep(0.2)
        state = self.states.newest()
        return state.message.mode if state is not None else None


def robot(address: str, log: Path) -> FleetProgram:
    return FleetProgram(log, "robot_agent", "run", "pool", "--robot", "1", "--link", "udp:127.0.0.1:9", "--station", address)


def test_a_robot_ignores_replayed_commands_live_and_after_restarts(address: str, tmp_path: Path) -> None:
    tape, heartbeats = Tape(), []
    agent = robot(address, tmp_path / "agent.log")
    station = Beating(address)
    try:
        station.bus.subscribe(topics.HEARTBEAT, None, lambda topic, key, header, data: heartbeats.append((data, header)))
        tape.record(station.bus)
        station.until_heard(agent)
        assert [station.order(order).accepted for order in GIVEN] == [True] * len(GIVEN)
        assert agent.said(": accepted") == len(GIVEN)
        assert len(tape.orders) == len(GIVEN)  # a STOP is taken without knowing whom it is for
        assert agent.said("CLEAR_STOP: accepted") == 2

        tape.play(address)  # live
        tape.play(address)
        assert (agent.said("CLEAR_STOP: accepted"), station.mode()) == (2, Mode.STOPPED)

        agent.end()  # the robot starts again, and hears the same station
        agent = robot(address, tmp_path / "next.log")
        station.until_heard(agent)
        tape.play(address)
        assert (agent.said("CLEAR_STOP: accepted"), station.mode()) == (0, Mode.STOPPED)

        station.bus.close()  # the station starts again, and its old heartbeats are played back
        later = station = Beating(address)
        station.until_heard(agent)
        assert station.order(CommandKind.CLEAR_STOP).accepted
        put = later.bus.transport.publisher("shoal/station/heartbeat", topics.HEARTBEAT.qos)
        for data, header in heartbeats[-5:]:
            put(data, header.encode())
            tape.play(address)
        assert (agent.said("CLEAR_STOP: accepted"), station.mode()) == (1, Mode.STOPPED)
    finally:
        station.bus.close()
        agent.end()


def test_a_station_ignores_replayed_requests_live_and_after_a_restart(tmp_path: Path) -> None:
    address = f"tcp/127.0.0.1:{free_port()}"

    def station(name: str) -> FleetProgram:
        command = ["run", "pool", "--no-web", "--listen", address, "--run-dir", str(tmp_path / name)]
        return FleetProgram(tmp_path / f"{name}.log", "groundstation", *command)

    tape, program = Tape(), station("first")
    try:
        terminal = Bus(ZenohTransport(Endpoint(address), patience_s=30.0))
        tape.record(terminal)
        wishes = (CommandKind.STOP, CommandKind.CLEAR_STOP)
        assert eventually(lambda: terminal.command(Command(CommandKind.NONE, 0, HOUR_S), 0, 1.0).session != 0, 30.0)
        assert [terminal.command(Command(order, 0, HOUR_S), 0, 2.0).accepted for order in wishes] == [True, True]
        terminal.close()
        tape.play(address)
        assert program.said("CLEAR_STOP asked for") == 1
        program.end()

        program = station("second")
        assert eventually(lambda: program.said("mission: waiting") > 0, 30.0)
        answers = tape.play(address)
        assert None not in answers
        assert (program.said("STOP asked for"), program.said("CLEAR_STOP asked for")) == (1, 0)
    finally:
        program.end()
