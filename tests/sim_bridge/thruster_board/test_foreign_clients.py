"""Clients that nobody here wrote, the real packages against a board of its own process: MAVSDK and MAVProxy."""

import importlib.util
import os
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from socket import SOCK_DGRAM

import pytest

from shoal.mavlink.agent_link import AgentLink
from shoal.mavlink.board_port import open_link
from sim_bridge.sil.ports import free_port
from tests.sim_bridge.boards import board

pytestmark = pytest.mark.real_time

NEUTRAL = (1500,) * 8
WITHIN_S = 30.0


class Computer:
    """The robot's computer: sends neutral overrides, and keeps what the board says."""

    def __init__(self, port: int) -> None:
        self.agent, self._link = AgentLink(1), open_link(f"udp:127.0.0.1:{port}")
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run)
        self._thread.start()

    def _run(self) -> None:
        while not self._stop.wait(0.04):
            self._link.send(self.agent.pulses(NEUTRAL))
            self.agent.receive(self._link.read(), time.monotonic_ns())

    def close(self) -> None:
        self._stop.set()
        self._thread.join()
        self._link.close()


@contextmanager
def computer(port: int) -> Iterator[AgentLink]:
    running = Computer(port)
    try:
        yield running.agent
    finally:
        running.close()


def wait_for(done: Callable[[], bool]) -> bool:
    deadline = time.monotonic() + WITHIN_S
    while not done() and time.monotonic() < deadline:
        time.sleep(0.05)
    return done()


@pytest.mark.skipif(importlib.util.find_spec("mavsdk") is None, reason="mavsdk is not installed")
def test_mavsdk_discovers_reads_sets_and_arms_as_the_rules_allow(tmp_path: Path) -> None:
    """In a process of its own: it is a C++ library with threads."""
    port = free_port(SOCK_DGRAM)
    with board(f"udp:127.0.0.1:{port}", tmp_path):
        script = Path(__file__).parents[1] / "mavsdk_client.py"
        client = subprocess.Popen(
            [sys.executable, str(script), str(port)], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, bufsize=1
        )
        assert client.stdin is not None and client.stdout is not None
        lines: list[str] = []

        def until(word: str) -> None:
            assert client.stdout is not None
            for line in client.stdout:
                if line.startswith("client "):
                    lines.append(line.strip())
                    if line.startswith(f"client {word}"):
                        return
            raise AssertionError(f"{word} was never said: {lines}")

        try:
            until("alone")
            with computer(port) as agent:
                assert wait_for(lambda: agent.telemetry.board_ms >= 0)
                client.stdin.write("go\n")
                until("armed")
                assert wait_for(lambda: agent.telemetry.armed)
                client.stdin.write("go\n")
                until("disarmed")
                assert wait_for(lambda: not agent.telemetry.armed)
        finally:
            client.kill()
            client.communicate()
    assert lines == [
        "client system 1",
        "client yaw True",
        "client volts True",
        "client parameters 46",
        "client set 7000",
        "client refused VALUE_OUT_OF_RANGE",
        "client alone COMMAND_DENIED",
        "client armed",
        "client disarmed",
    ]


@pytest.mark.skipif(importlib.util.find_spec("MAVProxy") is None, reason="MAVProxy is not installed")
def test_mavproxy_discovers_reads_sets_and_arms_as_the_rules_allow(tmp_path: Path) -> None:
    port = free_port(SOCK_DGRAM)
    with board(f"udp:127.0.0.1:{port}", tmp_path / "boards"):
        command = [
            str(Path(sys.executable).with_name("mavproxy.py")),
            f"--master=udpout:127.0.0.1:{port}",
            "--target-system=1",
        ]
        command += [f"--state-basedir={tmp_path}", "--default-modules=param,arm"]
        environment = {**os.environ, "HOME": str(tmp_path), "TERM": "dumb"}
        log = tmp_path / "mavproxy.log"
        with log.open("w") as output:
            client = subprocess.Popen(
                command,
                stdin=subprocess.PIPE,
                stdout=output,
                stderr=output,
                text=True,
                bufsize=1,
                cwd=tmp_path,
                env=environment,
            )
        assert client.stdin is not None

        def ask(line: str, answer: str) -> None:
            """Type, again if need be: a question of a MAVLink client may be lost."""
            assert client.stdin is not None
            begin = len(log.read_text())
            for _ in range(10):
                client.stdin.write(line + "\n")
                end = time.monotonic() + 3.0
                while time.monotonic() < end:
                    if answer in log.read_text()[begin:]:
                        return
                    time.sleep(0.05)
            raise AssertionError(f"{line}: no {answer!r} in {log.read_text()[begin:]!r}")

        try:
            assert wait_for(lambda: "Detected vehicle 1:1" in log.read_text()), log.read_text()
            ask("param fetch", "Received 46 parameters")
            ask("param show SLEW_US_S", "8000.0")
            ask("status ATTITUDE", "yaw :")
            ask("arm throttle", "not armed: no override is arriving")
            ask("arm throttle", "TEMPORARILY_REJECTED")
            with computer(port) as agent:
                assert wait_for(lambda: agent.telemetry.board_ms >= 0)
                ask("arm throttle", "COMPONENT_ARM_DISARM: ACCEPTED")
                assert wait_for(lambda: agent.telemetry.armed)
                ask("disarm", "COMPONENT_ARM_DISARM: ACCEPTED")
                assert wait_for(lambda: not agent.telemetry.armed)
            client.stdin.write("param set SLEW_US_S 6000\n")
            ask("param show SLEW_US_S", "6000.0")
        finally:
            client.kill()
            client.communicate()
