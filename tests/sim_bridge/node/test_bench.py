"""A board on a bench as a process of its own, on a real pseudo-terminal and on UDP: parameters, conformance, unplugging."""

import json
import time
from collections.abc import Iterator
from pathlib import Path
from select import select
from socket import SOCK_DGRAM

import pytest
from pymavlink.dialects.v20 import common as dialect
from typer.testing import CliRunner

from robot_agent.host.params import cli as params
from shoal.config.experiment import load_experiment
from shoal.errors import ConfigError
from shoal.mavlink.agent_link import AgentLink
from shoal.mavlink.board_port import SerialLink, UdpLink, open_link
from shoal.mavlink.framing import Sender
from shoal.mavlink.signing import Key
from shoal.mavlink.signing_key import Signing, agent_end, new_key
from sim_bridge.__main__ import cli as sim_bridge
from sim_bridge.node.bench import PseudoTerminal, open_socket
from sim_bridge.node.board_ports import UdpPort
from sim_bridge.sil.ports import free_port
from sim_bridge.thruster_board.board import ThrusterBoard
from tests.sim_bridge.boards import board

pytestmark = pytest.mark.real_time

BURST = AgentLink(1).heartbeat()  # a whole frame: on a serial port the computer is silent until it has read one
HEARTBEAT = dialect.MAVLink_heartbeat_message(6, 8, 0, 0, 4, 3)  # of a ground station


def say(*arguments: str) -> tuple[int, str]:
    """`robot-agent params` in this process: exit code, output."""
    result = CliRunner().invoke(params, arguments)
    return result.exit_code, result.output + (str(result.exception) if isinstance(result.exception, ConfigError) else "")


@pytest.fixture(autouse=True)
def patience(monkeypatch: pytest.MonkeyPatch) -> None:
    """On a busy machine a board's process answers late."""
    monkeypatch.setattr("robot_agent.host.params.WITHIN_S", 30.0)


@pytest.fixture
def port() -> Iterator[UdpPort]:
    udp_port = UdpPort("127.0.0.1", 0)
    yield udp_port
    udp_port.close()


def test_a_terminal_takes_the_place_of_one_whose_board_was_killed(tmp_path: Path) -> None:
    plug = tmp_path / "plug"
    with board(f"pty:{plug}", tmp_path / "boards") as killed:
        killed.kill()
        killed.wait()
        assert plug.is_symlink()
        with board(f"pty:{plug}", tmp_path / "boards"):
            assert say("get", "--link", f"serial:{plug}", "THR1_TRIM_US") == (0, "0\n")


def test_parameters_over_a_serial_port_and_across_a_restart(tmp_path: Path) -> None:
    link = f"serial:{tmp_path}/plug"
    with board(f"pty:{tmp_path}/plug", tmp_path / "boards"):
        code, listed = say("list", "--link", link)
        assert (code, len(listed.splitlines())) == (0, 46)
        assert "SLEW_US_S        8000\n" in listed
        assert say("set", "--link", link, "THR1_TRIM_US", "--", "-12") == (0, "THR1_TRIM_US = -12\n")
        code, output = say("set", "--link", link, "CMD_AGE_MS", "5000")
        assert code == 1 and "CMD_AGE_MS is still 250: CMD_AGE_MS: out of range (50 to 300, whole)" in output
        code, output = say("get", "--link", link, "NO_SUCH_THING")
        assert code == 1 and "the board has no such parameter" in output
    with board(f"pty:{tmp_path}/plug", tmp_path / "boards"):
        assert say("get", "--link", link, "THR1_TRIM_US") == (0, "-12\n")
        assert say("set", "--link", link, "HIL_MODE", "1")[0] == 0
        examined = CliRunner().invoke(sim_bridge, ["board-conformance", "--port", link, "--dry"])
        assert f"--port {link}: the board is in HIL mode" in str(examined.exception)


def test_rules_that_need_thrust_are_not_left_out_by_a_person_who_is_not_ready(tmp_path: Path) -> None:
    """After a no nothing says that the board passed: without thrust it was not tried as was asked for."""
    link = f"serial:{tmp_path}/plug"
    with board(f"pty:{tmp_path}/plug", tmp_path / "boards"):
        examined = CliRunner().invoke(sim_bridge, ["board-conformance", "--port", link], input="n\n")
    assert examined.exit_code != 0 and "passed" not in examined.output
    assert "nothing was tried (allowed: with all hands away; --dry" in str(examined.exception)


def test_bench_command_with_invalid_options_is_refused(tmp_path: Path) -> None:
    for name in ("", "SLÉW", "A_NAME_OF_17_CHAR"):
        assert "no parameter's name (allowed: 1 to 16 ASCII characters" in say("get", name)[1]
    for value in ("inf", "nan"):
        assert f"{value} (allowed: finite numbers)" in say("set", "SLEW_US_S", value)[1]
    for value in ("1e39", "-- -1e39"):
        assert "no value for a parameter (allowed: numbers up to 3.4" in say("set", "SLEW_US_S", *value.split())[1]


def test_a_board_that_is_not_there_says_why(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("robot_agent.host.params.WITHIN_S", 0.5)
    monkeypatch.setattr("sim_bridge.board_conformance.cli.HEARD_WITHIN_S", 0.5)
    (tmp_path / "file").touch()
    nobody = free_port(SOCK_DGRAM)
    for port, says in (
        (f"serial:{tmp_path}/plug", f"{tmp_path}/plug: not there; is the board plugged in"),
        (f"serial:{tmp_path}/file", f"{tmp_path}/file: is no serial port"),
        (f"udp:127.0.0.1:{nobody}", "connection refused: the machine is there, but nothing listens on that port"),
    ):
        assert f"--link {port}: {says}" in say("list", "--link", port)[1]
        examined = CliRunner().invoke(sim_bridge, ["board-conformance", "--port", port, "--dry"])
        assert f"--port {port}: {says}" in str(examined.exception)


def test_a_key_is_given_over_the_cable_and_kept(tmp_path: Path) -> None:
    link, key = f"serial:{tmp_path}/plug", tmp_path / "robot-1.key"
    new_key(key)
    with board(f"pty:{tmp_path}/plug", tmp_path / "boards"):
        code, output = say("give-key", str(key), "--link", link)
        assert (code, output) == (0, f"robot 1: the link is signed with {key}\n")
        assert say("get", "--link", link, "--link-key", str(key), "SLEW_US_S") == (0, "8000\n")
    with board(f"pty:{tmp_path}/plug", tmp_path / "boards"):
        assert say("get", "--link", link, "--link-key", str(key), "SLEW_US_S") == (0, "8000\n")


def test_parameters_over_signed_udp(tmp_path: Path) -> None:
    folder = tmp_path / "boards"
    folder.mkdir()
    new_key(folder / "robot-1.key")
    port = free_port(SOCK_DGRAM)
    with board(f"udp:127.0.0.1:{port}", folder):
        signed = ("--link", f"udp:127.0.0.1:{port}", "--link-key", str(folder / "robot-1.key"))
        assert say("set", *signed, "SLEW_US_S", "5000") == (0, "SLEW_US_S = 5000\n")
        assert say("get", *signed, "SLEW_US_S") == (0, "5000\n")
        agent, wires = agent_end(1, Signing.of(folder / "robot-1.key", "agent")), open_link(f"udp:127.0.0.1:{port}")
        stranger = AgentLink(1)
        try:
            deadline = time.monotonic() + 60
            while not (agent.telemetry.armed and agent.telemetry.round_trips) and time.monotonic() < deadline:
                now_ns = time.monotonic_ns()
                wires.send(agent.pulses([1500] * 8))
                wires.send(agent.arm(True) + agent.timesync(now_ns))
                wires.wait(0.05)
                data = wires.read()
                agent.receive(data, time.monotonic_ns())
                stranger.receive(data, now_ns)
            assert agent.telemetry.armed
            assert agent.telemetry.round_trip_ns > 0
            assert (stranger.telemetry.board_ms, stranger.telemetry.forged_frames > 0) == (-1, True)
        finally:
            wires.close()


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["pty", "udp"])
def test_the_reference_board_conforms_over_a_real_wire(kind: str, tmp_path: Path) -> None:
    folder, port = tmp_path / "boards", free_port(SOCK_DGRAM)
    folder.mkdir()
    new_key(folder / "robot-1.key")
    ours, theirs = (f"pty:{tmp_path}/plug", f"{tmp_path}/plug") if kind == "pty" else (f"udp:127.0.0.1:{port}",) * 2
    with board(ours, folder):
        run = ["board-conformance", "--port", theirs, "--link-key", str(folder / "robot-1.key"), "--yes", "--json"]
        result = CliRunner().invoke(sim_bridge, run)
    report = json.loads(result.output)
    assert [rule for rule in report["rules"] if rule["verdict"] != "passed"] == []
    assert (result.exit_code, report["board"], report["failed"]) == (0, 1, 0)


def test_a_serial_board_that_is_pulled_out_and_put_back(tmp_path: Path) -> None:
    """The computer goes on sending; the port comes back under another number, as USB's do."""
    link = open_link(f"serial:{tmp_path}/plug")
    assert isinstance(link, SerialLink)
    try:
        for _ in range(3):
            terminal = PseudoTerminal(tmp_path / "plug")
            override_bytes = burst_bytes = b""
            deadline = time.monotonic() + 60
            while not (override_bytes and burst_bytes) and time.monotonic() < deadline:
                link.send(b"override")
                terminal.send(BURST, 0)
                override_bytes += b"".join(data for data, _ in terminal.read())
                burst_bytes += link.read()
            assert b"override" in override_bytes and BURST in burst_bytes
            terminal.close()
            for _ in range(5):
                link.send(b"into the void")
                assert link.read() == b""
                link.wait(0.001)
    finally:
        link.close()


def test_a_terminal_that_nobody_reads_does_not_hold_the_board_up(tmp_path: Path) -> None:
    terminal = PseudoTerminal(tmp_path / "plug")
    try:
        for _ in range(1000):
            terminal.send(bytes(1000), 0)
        assert str((tmp_path / "plug").readlink()).startswith("/dev/")
    finally:
        terminal.close()
    assert not (tmp_path / "plug").is_symlink()


@pytest.mark.parametrize(
    "port", ["udp:127.0.0.1", "udp:127.0.0.1:99999", "serial:/dev/x", "pty:", "", "pty:/no/such/folder/x"]
)
def test_nowhere_to_be_plugged_in_is_explained(port: str) -> None:
    with pytest.raises(ConfigError, match="--port"):
        open_socket(port, signed=True)


def test_an_unsigned_board_stays_on_this_machine() -> None:
    with pytest.raises(ConfigError, match="needs a key"):
        open_socket("udp:0.0.0.0:0", signed=False)


# --- whom a board answers over UDP


def spoken(port: UdpPort, board: ThrusterBoard, link: UdpLink, data: bytes, now_ns: int) -> None:
    """A datagram on its way to the board, as the bench has it."""
    link.send(data)
    select([port.socket], [], [], 5.0)
    for datagram, peer in port.read():
        if board.receive(datagram, now_ns):
            port.hear(peer, now_ns)


def test_strangers_take_nobody_s_place_at_a_signed_board_and_are_told_nothing(port: UdpPort) -> None:
    """Nine of them, with a byte, an unsigned frame and one of another key, before the robot's computer comes."""
    key, wrong = Key(bytes(range(32))), Key(bytes(32))
    board = ThrusterBoard(load_experiment("pool"), 1, 1, key)
    links = [UdpLink("127.0.0.1", port.socket.getsockname()[1]) for _ in range(10)]
    *strangers, computer = links
    try:
        for k, link in enumerate(strangers):
            frames = (b"x", AgentLink(1).heartbeat(), AgentLink(1, wrong, lambda: 1000).heartbeat())
            spoken(port, board, link, frames[k % 3], k)
        assert not port.has_peer
        spoken(port, board, computer, AgentLink(1, key, lambda: 1000).heartbeat(), 100)
        port.send(b"telemetry", 200)
        select([computer.socket], [], [], 5.0)
        assert [link.read() for link in links] == [b""] * 9 + [b"telemetry"]
    finally:
        for link in links:
            link.close()


def test_when_there_are_too_many_the_one_that_was_silent_longest_makes_room(port: UdpPort) -> None:
    board = ThrusterBoard(load_experiment("pool"), 1, 1)
    links = [UdpLink("127.0.0.1", port.socket.getsockname()[1]) for _ in range(9)]
    try:
        for k, link in enumerate((*links[:8], links[0], links[8])):
            spoken(port, board, link, Sender((200 + k, 1), None, lambda: 0).pack(HEARTBEAT), k)
        port.send(b"telemetry", 100)
        select([links[8].socket], [], [], 5.0)
        assert [bool(link.read()) for link in links] == [True, False, *[True] * 7]
    finally:
        for link in links:
            link.close()


def test_a_flooded_port_is_read_a_little_at_a_time(port: UdpPort) -> None:
    link = UdpLink("127.0.0.1", port.socket.getsockname()[1])
    try:
        for k in range(25):
            link.send(bytes([k]))
        reads = [port.read() for _ in range(4)]
        assert [len(datagrams) for datagrams in reads] == [10, 10, 5, 0]
        assert b"".join(data for datagrams in reads for data, _ in datagrams) == bytes(range(25))
        assert not port.is_flooded
    finally:
        link.close()
