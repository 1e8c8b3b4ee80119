"""Boards in HIL mode, each a process of its own on UDP or a pseudo-terminal: killed, frozen, restarted, outside HIL mode."""

import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from socket import SOCK_DGRAM

import numpy as np
import pytest

from shoal.config.experiment import load_experiment
from shoal.errors import ConfigError
from shoal.mavlink.agent_link import AgentLink
from shoal.mavlink.board_port import Link, open_link
from shoal.mavlink.parameters import ParameterClient
from shoal.mavlink.signing_key import Signing, agent_end, new_key
from shoal.runtime.runtime import Failed
from sim_bridge.node import hil_board
from sim_bridge.node.hil_board import HilBoard, connect
from sim_bridge.node.wires import PoolWires, real_boards
from sim_bridge.sil.ports import free_base_port, free_port
from sim_bridge.thruster_board.board_link import Arm, BoardLink
from tests.sim_bridge.boards import board
from tests.waiting import wait_for_line

pytestmark = pytest.mark.real_time

EXPERIMENT = load_experiment("pool")
STILL = np.zeros(4)
NEUTRAL, AHEAD = (1500,) * 8, (1600, 1600, 1600, 1600, 1500, 1500, 1500, 1500)


class Tapped(Link):
    """A link to a board, with the requests to arm that were sent over it."""

    def __init__(self, link: Link) -> None:
        self._link, self._judge = link, BoardLink(1)
        self.arms = 0

    def send(self, data: bytes) -> None:
        self.arms += sum(event == Arm(True) for _, event in self._judge.receive(data, time.monotonic_ns()))
        self._link.send(data)

    def read(self) -> bytes:
        return self._link.read()

    def wait(self, timeout_s: float) -> None:
        self._link.wait(timeout_s)

    def close(self) -> None:
        self._link.close()

    @property
    def trouble(self) -> str:
        return self._link.trouble


class HilPool:
    """The simulator's part and the agent's, by the wall clock: a robot that stands still 2 m deep."""

    def __init__(self, where: str, link: Link, signing: Signing | None = None, agent: AgentLink | None = None) -> None:
        self.link = Tapped(link)
        self.hil = HilBoard(EXPERIMENT, 1, 1, where, self.link, signing)
        self.agent = agent or AgentLink(1)
        self.pulses, self.wants_arm = NEUTRAL, True
        self._begin_ns, self._steps = time.monotonic_ns(), 0

    def run(self, seconds: float, done: Callable[[], bool] = lambda: False) -> bool:
        """Fly for so long, or until `done()`, which is returned."""
        end_ns = time.monotonic_ns() + round(seconds * 1e9)
        while time.monotonic_ns() < end_ns and not done():
            now_ns = time.monotonic_ns() - self._begin_ns
            if self._steps % 10 == 0:
                self.hil.receive(self.agent.pulses(self.pulses), now_ns)
            if self._steps % 10 == 5 and self.wants_arm:
                self.hil.receive(self.agent.arm(True), now_ns)
            data = self.hil.step(now_ns, np.array([0.0, 0.0, 2.0, 0.0]), STILL, STILL, 12.0, STILL)
            self.agent.receive(data, time.monotonic_ns())
            self._steps += 1
            time.sleep(0.005)
        return done()

    def follows(self) -> bool:
        """Have the board armed, and thrust: again if this machine is so busy that the board disarms for want of pulses."""
        for _ in range(20):
            self.pulses = NEUTRAL
            self.run(10.0, lambda: self.hil.armed)
            self.pulses = AHEAD
            if self.run(10.0, lambda: self.hil.pulses == AHEAD or not self.hil.armed) and self.hil.pulses == AHEAD:
                return True
        return False


SHIPPED_S = hil_board.SILENT_NS * 1e-9, hil_board.MODE_NS * 1e-9  # before `patience`


def test_a_silent_board_ends_a_run_as_soon_as_the_manual_says() -> None:
    """A second without an echo, as docs/hil.md shows it; two heartbeats of one a second, and a little, without its mode."""
    assert SHIPPED_S == (1.0, 2.5)


@pytest.fixture(autouse=True)
def patience(monkeypatch: pytest.MonkeyPatch) -> None:
    """On a busy machine a board that is well may be silent for longer than a run allows."""
    monkeypatch.setattr("sim_bridge.node.hil_board.SILENT_NS", 4_000_000_000)
    monkeypatch.setattr("sim_bridge.node.hil_board.MODE_NS", 8_000_000_000)


def address(kind: str, folder: Path) -> tuple[str, str]:
    """A board's own address, and its computer's."""
    if kind == "pty":
        return f"pty:{folder}/plug", f"serial:{folder}/plug"
    port = free_port(SOCK_DGRAM)
    return f"udp:127.0.0.1:{port}", f"udp:127.0.0.1:{port}"


@contextmanager
def flying(kind: str, folder: Path) -> Iterator[tuple[HilPool, "subprocess.Popen[str]", tuple[str, str]]]:
    """A board in HIL mode that is armed and follows."""
    ours, theirs = address(kind, folder)
    with board(ours, folder / "kept") as process:
        link, _ = connect(1, theirs, None, insecure=False)
        try:
            pool = HilPool(theirs, link)
            assert pool.follows()
            yield pool, process, (ours, theirs)
        finally:
            link.close()


@pytest.mark.parametrize("kind", ["udp", "pty"])
def test_outputs_of_a_board_in_hil_mode_drive_the_water_until_it_is_killed(kind: str, tmp_path: Path) -> None:
    with flying(kind, tmp_path) as (pool, process, (_, where)):
        assert pool.run(5.0, lambda: abs(pool.agent.telemetry.depth_m - 2.0) < 0.1)
        assert pool.agent.telemetry.hil and pool.follows() and not pool.hil.neutral
        process.kill()
        (tmp_path / "plug").unlink(missing_ok=True)  # the terminal that it names may soon be another test's
        with pytest.raises(Failed, match=f"robot 1: the board at {where} is silent for "):
            pool.run(30.0)


def test_a_board_that_freezes_ends_the_run(tmp_path: Path) -> None:
    with flying("udp", tmp_path) as (pool, process, _):
        process.send_signal(signal.SIGSTOP)
        try:
            with pytest.raises(Failed, match=r"is silent for \d"):
                pool.run(30.0)
        finally:
            process.send_signal(signal.SIGCONT)


def test_a_board_that_leaves_hil_mode_ends_the_run(tmp_path: Path) -> None:
    """Somebody sets HIL_MODE = 0 over a link of his own. Through the agent's port it is not passed on."""
    with flying("udp", tmp_path) as (pool, _, (_, where)):
        pool.wants_arm = False
        pool.link.send(pool.agent.arm(False))
        assert pool.run(5.0, lambda: not pool.hil.armed)
        pool.hil.receive(ParameterClient(1).set("HIL_MODE", 0.0), 0)
        pool.run(1.5)
        other = open_link(where)
        try:
            other.send(ParameterClient(1).set("HIL_MODE", 0.0))
            with pytest.raises(Failed, match="is not in HIL mode"):
                pool.run(30.0)
        finally:
            other.close()


def test_a_board_that_was_restarted_is_not_armed_and_ends_the_run(tmp_path: Path) -> None:
    """It comes back outside HIL mode, while the agent goes on asking it to arm: on its pins thrusters would turn."""
    with flying("pty", tmp_path) as (pool, process, (ours, _)):
        process.kill()
        (tmp_path / "plug").unlink()
        with board(ours, tmp_path / "kept") as again:
            with pytest.raises(Failed, match=r"not in HIL mode|is silent for"):
                pool.run(30.0)
            again.terminate()
            assert again.stderr is not None
            assert " armed," not in again.stderr.read()


@pytest.mark.parametrize("kind", ["udp", "pty"])
def test_a_board_outside_hil_mode_is_refused_and_never_gets_an_arm(kind: str, tmp_path: Path) -> None:
    ours, theirs = address(kind, tmp_path)
    with board(ours, tmp_path / "kept") as process:
        link = open_link(theirs)
        try:
            pool = HilPool(theirs, link)  # as if it had left HIL mode since `connect`
            with pytest.raises(Failed, match=f"robot 1: the board at {theirs} is not in HIL mode"):
                pool.run(30.0)
            assert pool.link.arms == 0
        finally:
            link.close()
        process.terminate()
        assert process.stderr is not None
        assert " armed," not in process.stderr.read()


def test_a_signed_board_flies_with_its_key_and_says_why_without(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    folder = tmp_path / "boards"
    folder.mkdir()
    key, (ours, theirs) = folder / "robot-1.key", address("pty", tmp_path)
    new_key(key)
    with board(ours, folder):
        with pytest.raises(ConfigError, match="a board is heard that signs"):
            connect(1, theirs, None, insecure=False)
        link, signing = connect(1, theirs, key, insecure=False)
        try:
            pool = HilPool(theirs, link, signing, agent_end(1, Signing.of(key, "agent")))
            assert pool.run(15.0, lambda: pool.hil.armed and abs(pool.agent.telemetry.depth_m - 2.0) < 0.1)
            assert signing is not None
            # private: half a minute of flight later, when the disk has gone
            signing.stamps._path, signing.stamps._limit = tmp_path / "gone" / "stamps", 0
            assert pool.run(15.0, lambda: "the times of signatures cannot be kept" in caplog.text)
            pool.run(0.3)
            assert pool.run(15.0, lambda: pool.hil.armed)
        finally:
            link.close()


def test_no_board_or_a_wrong_address_is_explained(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sim_bridge.node.hil_board.HEARD_WITHIN_S", 0.3)
    with pytest.raises(ConfigError, match=r"--board 1=serial:/no/board: /no/board: not there"):
        connect(1, "serial:/no/board", None, insecure=False)
    for text, reason in (
        ("3=simulated", "no robot of pool .allowed: N=WHERE, N one of 1, 2"),
        ("1", "not an address of a thruster board"),
        ("1=tcp:1.2.3.4:5", "not an address of a thruster board"),
    ):
        with pytest.raises(ConfigError, match=reason):
            real_boards(EXPERIMENT, [text])
    with pytest.raises(ConfigError, match="robot 1 has a board already"):
        real_boards(EXPERIMENT, ["1=simulated", "1=serial:/dev/x"])
    assert real_boards(EXPERIMENT, ["1=simulated", "2=udp:127.0.0.1:9"]) == {2: "udp:127.0.0.1:9"}


def test_links_leave_this_machine_only_signed(tmp_path: Path) -> None:
    def wires(host: str, insecure: bool = False) -> PoolWires:
        return PoolWires("tcp/127.0.0.1:7447", "shoal", None, False, 14550, host, tmp_path, insecure)

    new_key(tmp_path / "robot-1.key")
    wires("127.0.0.1").check_host((1, 2))
    wires("0.0.0.0").check_host((1,))
    wires("0.0.0.0", insecure=True).check_host((1, 2))
    with pytest.raises(ConfigError, match="that of robot 2 has no key"):
        wires("0.0.0.0").check_host((1, 2))
    with pytest.raises(ConfigError, match="no address of a host"):
        wires("no such host").check_host((1,))


def test_the_command_ends_with_the_reason_when_a_board_is_killed(tmp_path: Path) -> None:
    """The whole command beside a station, without agents: exit code 1."""
    ours, theirs = address("udp", tmp_path)
    station, log = f"tcp/127.0.0.1:{free_port()}", tmp_path / "hil.log"
    run = ["groundstation", "run", "pool", "--no-web", "--listen", station, "--run-dir", str(tmp_path / "run")]
    hil = ["sim_bridge", "hil", "pool", "--poses", "--station", station, "--ports", str(free_base_port((1, 2)))]
    started: list[subprocess.Popen[bytes]] = []
    with board(ours, tmp_path / "kept") as process, log.open("wb") as output:
        try:
            started.append(subprocess.Popen([sys.executable, "-m", *run], stderr=subprocess.DEVNULL))
            started.append(subprocess.Popen([sys.executable, "-m", *hil, "--board", f"1={theirs}"], stderr=output))
            wait_for_line(log, "robots are in the water", 60.0)
            process.kill()
            (tmp_path / "plug").unlink(missing_ok=True)
            assert started[1].wait(30) == 1
        finally:
            for each in reversed(started):
                each.terminate()
                each.wait(30)
    assert f"robot 1: the board at {theirs} is silent for" in log.read_text()
