"""A robot's real program leaves its board neutral and disarmed at once, whether it is asked to end or not.

By its agent's word, not for want of pulses; the simulator's board is at the other end of its link.
"""

import signal
import subprocess
import sys
import threading
import time
from pathlib import Path
from socket import AF_INET, SOCK_DGRAM, socket

import numpy as np
import pytest

from shoal.bus.bus import Bus
from shoal.bus.endpoint import Endpoint
from shoal.bus.zenoh_transport import ZenohTransport
from shoal.config.experiment import load_experiment
from shoal.mavlink.agent_link import AgentLink
from shoal.messages import topics
from shoal.messages.messages import Command, CommandKind, Mode, Pose, RobotState, StationHeartbeat, Track
from sim_bridge.sil.ports import free_port
from sim_bridge.thruster_board.board import ThrusterBoard
from sim_bridge.thruster_board.board_link import Arm, BoardLink, Override
from tests.waiting import wait_for_line

pytestmark = pytest.mark.real_time

# Nothing that the thrusters do moves this robot; its steps are slow, so that a busy machine makes few of them late.
SETTINGS = ("safety.watch_thrusters=false", "controller.period_s=0.1")
POOL = load_experiment("pool", SETTINGS)
PATIENCE_S, NEUTRAL_US = 60.0, (1500,) * 4
TURN_THRUSTERS = """
import sys
from robot_agent.host.config import AgentConfig
from robot_agent.preflight.thrusters import turn_thrusters
from shoal.config.experiment import load_experiment
print(list(turn_thrusters(load_experiment("pool"), AgentConfig(robot=1, experiment="pool", station="", link=sys.argv[1]))))
"""
BROKEN_ON_PURPOSE = """
import runpy, signal, sys
from robot_agent.control.nonlinear.nonlinear_controller import NonlinearController as Controller
step, broken = Controller.step, []
signal.signal(signal.SIGUSR1, lambda *_: broken.append(True))
def stumble(*arguments):
    if broken:
        raise RuntimeError("broken on purpose")
    return step(*arguments)
Controller.step = stumble
sys.argv = sys.argv[1:]
runpy.run_module("robot_agent", run_name="__main__", alter_sys=True)
"""


class UdpBoard:
    """A thruster board on UDP, and what it was told, in order."""

    def __init__(self, port: int) -> None:
        self.board, self._ear = ThrusterBoard(POOL, 1, 1), BoardLink(1)
        self.commands: list[Arm | Override] = []
        self.agent_link = AgentLink(1)  # what the board says
        self._socket, self._over = socket(AF_INET, SOCK_DGRAM), threading.Event()
        self._socket.bind(("127.0.0.1", port))
        self._socket.settimeout(0.002)
        self._thread = threading.Thread(target=self._run)

    def __enter__(self) -> "UdpBoard":
        self._thread.start()
        return self

    def __exit__(self, *exception: object) -> None:
        self._over.set()
        self._thread.join()
        self._socket.close()

    def _run(self) -> None:
        asker, begin_ns = None, time.monotonic_ns()
        while not self._over.is_set():
            now_ns = time.monotonic_ns() - begin_ns
            try:
                data, asker = self._socket.recvfrom(65536)
                self.commands += [event for _, event in self._ear.receive(data, now_ns) if isinstance(event, Arm | Override)]
                self.board.receive(data, now_ns)
            except TimeoutError:
                pass
            data = self.board.step(now_ns, np.array([0.0, 0.0, 0.3, 0.0]), np.zeros(4), np.zeros(4))
            self.agent_link.receive(data, now_ns)
            if asker is not None and data:
                self._socket.sendto(data, asker)


class HeartbeatSender:
    """Sender of the heartbeats and poses that a robot needs to fly."""

    def __init__(self, address: str) -> None:
        self.bus = Bus(ZenohTransport(Endpoint(address), patience_s=5.0))
        self.states, self._over = self.bus.inbox(topics.STATE, RobotState, 1), threading.Event()
        self._thread = threading.Thread(target=self._run)

    def __enter__(self) -> "HeartbeatSender":
        self._thread.start()
        return self

    def __exit__(self, *exception: object) -> None:
        self._over.set()
        self._thread.join()
        self.bus.close()

    def _run(self) -> None:
        away = 0
        while not self._over.wait(0.05):
            away += self.mode is Mode.HOLDING  # the robot seems to drift off, and pushes
            pose = Pose(min(0.002 * away, 0.2), 0.0, 0.0, 1e-6 * np.eye(3), Track.MARKER, True, 0.9, 0.3)
            self.bus.publish(topics.POSE, pose, time.time_ns(), 1)
            self.bus.publish(topics.HEARTBEAT, StationHeartbeat(POOL.hash), time.time_ns())

    @property
    def mode(self) -> Mode | None:
        state = self.states.newest()
        return None if state is None else state.message.mode

    def until_it_pushes(self, bench: UdpBoard) -> None:
        """Have the robot hold its place, and again if its board disarmed because a busy machine kept it waiting."""
        deadline, refused = time.monotonic() + PATIENCE_S, "never asked"
        while bench.board.neutral or not bench.board.armed:
            assert time.monotonic() < deadline, f"it never pushed: {refused}"
            for order in (CommandKind.ARM, CommandKind.HOLD) if not bench.board.armed else ():
                reply = self.bus.command(Command(order, 1, experiment_hash=POOL.hash), time.time_ns(), 1.0)
                refused = refused if reply.accepted else f"{order.name}: {reply.reason}"
            time.sleep(0.05)


@pytest.mark.parametrize(
    ("number", "why", "code"),
    [
        (signal.SIGTERM, "told to stop", 0),
        pytest.param(signal.SIGINT, "told to stop", 0, marks=pytest.mark.slow),  # the same way out as SIGTERM
        pytest.param(signal.SIGHUP, "told to stop", 0, marks=pytest.mark.slow),
        (signal.SIGUSR1, "the control loop has ended: RuntimeError: broken on purpose", 1),
    ],
    ids=["SIGTERM", "Ctrl-C", "hang-up", "exception"],
)
def test_a_program_that_ends_leaves_its_board_neutral_and_disarmed(
    number: signal.Signals, why: str, code: int, address: str, tmp_path: Path
) -> None:
    port, log = free_port(SOCK_DGRAM), tmp_path / "agent.log"
    options = ["run", "pool", "--robot", "1", "--link", f"udp:127.0.0.1:{port}", "--station", address]
    settings = [part for setting in SETTINGS for part in ("--set", setting)]
    with log.open("wb") as output, UdpBoard(port) as bench, HeartbeatSender(address) as station:
        agent = subprocess.Popen(
            [sys.executable, "-c", BROKEN_ON_PURPOSE, "robot_agent", *options, *settings], stdout=output, stderr=output
        )
        try:
            station.until_it_pushes(bench)
            before = len(bench.commands)
            agent.send_signal(number)
            assert agent.wait(PATIENCE_S) == code
        finally:
            agent.kill()
            agent.wait()
    events = bench.commands[before:]
    disarm = events.index(Arm(False))
    assert all(event == Arm(False) or (isinstance(event, Override) and event.pulses_us[:4] == NEUTRAL_US)
               for event in events[disarm:])  # fmt: skip
    assert any(isinstance(event, Override) for event in events[disarm:])
    assert (bench.board.armed, bench.board.neutral) == (False, True)
    newest_first = [text for _, text in reversed(bench.agent_link.telemetry.texts)]
    since_armed = newest_first[: newest_first.index("armed")]
    assert not any("disarmed: no override" in text for text in since_armed)  # it was told, and did not have to find out
    assert f"{why}; neutral and disarm sent to the thruster board, which says that it is disarmed" in log.read_text()


def test_a_second_program_of_a_robot_that_is_stopped_while_it_waits_leaves_the_board_alone(
    address: str, tmp_path: Path
) -> None:
    """The first one may be flying: what the second says on its way out would end that flight."""
    port, log = free_port(SOCK_DGRAM), tmp_path / "agent.log"
    with log.open("wb") as output, UdpBoard(port) as bench, Bus(ZenohTransport(Endpoint(address), patience_s=5.0)) as first:
        first.claim("agent-1", bool)
        options = ["run", "pool", "--robot", "1", "--link", f"udp:127.0.0.1:{port}", "--station", address]
        agent = subprocess.Popen([sys.executable, "-m", "robot_agent", *options], stdout=output, stderr=output)
        try:
            wait_for_line(log, "another process of this name is in the fleet; waiting")
            agent.send_signal(signal.SIGINT)
            assert agent.wait(PATIENCE_S) == 1
        finally:
            agent.kill()
            agent.wait()
        assert bench.commands == []
    assert "agent-1: stopped while another process of this name is in fleet shoal" in log.read_text()


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGHUP])
def test_a_look_at_the_thrusters_that_is_ended_leaves_them_at_rest(number: signal.Signals) -> None:
    port = free_port(SOCK_DGRAM)
    with UdpBoard(port) as bench:
        looking = subprocess.Popen(
            [sys.executable, "-c", TURN_THRUSTERS, f"udp:127.0.0.1:{port}"], stdout=subprocess.PIPE, stderr=subprocess.DEVNULL
        )
        try:
            deadline = time.monotonic() + PATIENCE_S
            while bench.board.neutral and time.monotonic() < deadline:
                time.sleep(0.005)
            assert not bench.board.neutral
            looking.send_signal(number)
            output, _ = looking.communicate(timeout=PATIENCE_S)
        finally:
            looking.kill()
            looking.wait()
    texts = [text for _, text in bench.agent_link.telemetry.texts]
    assert (output, bench.board.armed, bench.commands[-2]) == (b"", False, Arm(False))
    assert "armed" in texts and not any("disarmed: no override" in text for text in texts)
