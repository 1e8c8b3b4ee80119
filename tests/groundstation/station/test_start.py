"""The station as a program: starts that fail leave nothing behind; its terminal stops, and goes."""

import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from shoal.bus.bus import Bus
from shoal.bus.endpoint import Endpoint
from shoal.bus.zenoh_transport import ZenohTransport
from shoal.messages.messages import Command, CommandKind
from sim_bridge.sil.ports import free_port
from tests.forked import ended
from tests.waiting import eventually

pytestmark = pytest.mark.real_time


def test_a_start_with_a_taken_page_address_is_refused_and_leaves_no_folder(tmp_path: Path) -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        web = f"127.0.0.1:{taken.getsockname()[1]}"
        listen = f"tcp/127.0.0.1:{free_port()}"
        command = ["run", "pool", "--out", str(tmp_path / "runs"), "--listen", listen, "--web", web]
        code, _, errors = ended("groundstation", *command)
    assert code == 2
    assert f"--web {web}: Address already in use" in errors
    assert not (tmp_path / "runs").exists()


@contextmanager
def listening(folder: Path, terminal: int) -> Iterator[tuple["subprocess.Popen[bytes]", str]]:
    """A station that waits for its fleet, in a session of its own with this terminal, and its address."""
    address = f"tcp/127.0.0.1:{free_port()}"
    command = [sys.executable, "-m", "groundstation", "run", "pool", "--no-web", "--listen", address, "--out", str(folder)]
    station = subprocess.Popen(command, stdin=terminal, stdout=terminal, stderr=terminal, start_new_session=True)
    try:
        assert eventually(lambda: list(folder.glob("*/run.mcap")))
        yield station, address
    finally:
        station.kill()
        station.wait()


def read_until(terminal: int, text: str) -> None:
    output = ""
    while text not in output:
        output += os.read(terminal, 4096).decode()


def test_the_stop_gets_through_while_the_terminal_is_stopped(tmp_path: Path) -> None:
    """Ctrl-S in the station's terminal. An order before the stop has it log a line."""
    person, terminal = os.openpty()
    with listening(tmp_path, terminal) as (_, address):
        read_until(person, "waiting for the fleet")
        os.write(person, b"\x13")  # Ctrl-S
        with Bus(ZenohTransport(Endpoint(address))) as bus:
            for order in (CommandKind.HOLD, CommandKind.STOP):
                reply = bus.command(Command(order, 0), time.monotonic_ns(), 20.0, to=0)
                assert not reply.silent
            assert reply.accepted
        os.write(person, b"\x11")  # Ctrl-Q
        read_until(person, "HOLD refused")
    os.close(terminal)
    os.close(person)


def test_a_station_whose_terminal_has_gone_ends_as_when_told_to(tmp_path: Path) -> None:
    """The kernel and the shell each send a hang-up."""
    person, terminal = os.openpty()
    with listening(tmp_path, terminal) as (station, _):
        os.close(terminal)
        os.close(person)
        for _ in range(2):
            station.send_signal(signal.SIGHUP)
        station.wait(60)
        assert {"result.json", "report.html"} <= {path.name for path in next(tmp_path.iterdir()).iterdir()}
