"""The ways into a router with keys, under attack: real sessions, a real guard, strangers on loopback addresses."""

import contextlib
import os
import re
import signal
import socket
import subprocess
import threading
import time
from collections.abc import Iterator
from contextlib import closing
from datetime import UTC, datetime
from pathlib import Path

import pytest
from typer.testing import CliRunner

from groundstation.__main__ import cli as groundstation
from groundstation.deploy import key_ring
from groundstation.gate import admission, guard, user_folders
from groundstation.gate.admission import RETRY
from groundstation.gate.gate import Gate, doors_of, through_door
from groundstation.gate.guard import ANSWER_BYTES, CERTIFICATE_BYTES, Guard
from shoal.bus.access_control import DOOR
from shoal.bus.bus import Bus
from shoal.bus.connection_diagnostics import trouble_reaching
from shoal.bus.endpoint import Endpoint
from shoal.bus.network import endpoint
from shoal.bus.zenoh_transport import ZenohTransport
from shoal.errors import ConfigError
from shoal.messages import messages, topics
from shoal.messages.codec import Header
from shoal.messages.messages import Command, CommandKind, Reply
from shoal.system import programs
from sim_bridge.sil.ports import free_port
from tests.full_pipe import full_pipe
from tests.groundstation.gate.strangers import Strangers
from tests.planted import executed, plant
from tests.waiting import eventually

pytestmark = pytest.mark.real_time

MOST_LINKS = 10  # of the guard in these tests
SOON_S = 5.0  # without a guard nobody comes in for minutes


@pytest.fixture(scope="module")
def ring(tmp_path_factory: pytest.TempPathFactory) -> Path:
    ring, now = tmp_path_factory.mktemp("ring") / "keys", datetime.now(UTC)
    key_ring.init(ring, [], "shoal", now)
    key_ring.add(ring, "robot", 1, now)
    return ring


@pytest.fixture(scope="module")
def address() -> str:
    return f"tls/127.0.0.1:{free_port()}"


ASKED: list[CommandKind] = []  # of the station


def answer(header: Header, command: Command) -> Reply:
    ASKED.append(command.order)
    return Reply(0, command.order is CommandKind.STOP)


@pytest.fixture(scope="module")
def planted(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder in which the station works."""
    return plant(tmp_path_factory.mktemp("planted"))


@pytest.fixture(scope="module")
def station(ring: Path, address: str, planted: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Bus]:
    """A station's bus, which answers orders for the whole fleet."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv(user_folders.ONLY, str(tmp_path_factory.mktemp("r")))
        patch.chdir(planted)
        with Bus(ZenohTransport(endpoint(address, "groundstation", ring, router=True), gate=Gate)) as bus:
            bus.serve(0, answer)
            yield bus


def stopped(ring: Path, address: str) -> bool:
    """True if a remote operator gets a stop through."""
    with Bus(ZenohTransport(endpoint(address, "operator", ring), patience_s=SOON_S)) as bus:
        return bus.command(Command(CommandKind.STOP, 0), 1, SOON_S).accepted


@pytest.mark.parametrize("source", ["127.0.0.1", "127.0.0.2"])  # also from where the members are
@pytest.mark.parametrize(
    ("attack", "first"), [({"knocks_hz": 200.0}, 60), ({"half_open": 900}, 900), ({"handshakes_hz": 20.0}, 4)], ids=str
)
def test_strangers_keep_no_member_out(
    station: Bus, ring: Path, address: str, source: str, attack: dict[str, float], first: int
) -> None:
    """A router without a guard would be busy with the first of them for longer than SOON_S."""
    with Strangers(int(address.rpartition(":")[2]), source, **attack) as strangers:  # type: ignore[arg-type]
        assert eventually(lambda: strangers.made >= first)
        assert stopped(ring, address)
        ZenohTransport(endpoint(address, "agent-1", ring), patience_s=SOON_S).close()


def test_the_guard_imports_nothing_from_the_working_folder(station: Bus, ring: Path, address: str, planted: Path) -> None:
    assert stopped(ring, address)
    assert not executed(planted)


def test_with_keys_too_a_name_is_one_processs(station: Bus, ring: Path, address: str) -> None:
    """Neither has announced itself: they know each other by their claims, which access control lets through."""
    where = endpoint(address, "agent-1", ring)
    with Bus(ZenohTransport(where, patience_s=SOON_S)) as first, Bus(ZenohTransport(where, patience_s=SOON_S)) as second:
        first.claim("agent-1", bool)
        with pytest.raises(ConfigError, match="agent-1: another process of this name"):
            second.claim("agent-1", bool, patience_s=0.5)


def test_a_rejected_stranger_is_logged_in_one_line(
    station: Bus, ring: Path, address: str, caplog: pytest.LogCaptureFixture, capfd: pytest.CaptureFixture[str]
) -> None:
    caplog.clear()
    assert trouble_reaching(address, endpoint(address, "operator", ring).keys) == ""
    assert stopped(ring, address)
    port = int(address.rpartition(":")[2])
    for _ in range(5):
        with socket.create_connection(("127.0.0.1", port), source_address=("127.0.0.3", 0)) as stranger:
            stranger.sendall(b"hello")
            assert stranger.recv(1) == b""
    assert eventually(lambda: "127.0.0.3" in caplog.text)
    lines = [record.getMessage() for record in caplog.records if "127.0.0.3" in record.getMessage()]
    assert len(lines) == 1 and lines[0].startswith("refused a connection from 127.0.0.3 that does not begin as TLS does")
    assert "DEBUG" not in (out := "".join(capfd.readouterr())) and "Hint" not in out


def test_a_guard_that_dies_is_started_again_and_links_come_back(
    station: Bus, ring: Path, address: str, caplog: pytest.LogCaptureFixture
) -> None:
    beats = station.inbox(topics.STATE, messages.RobotState, robot=1)
    with Bus(ZenohTransport(endpoint(address, "agent-1", ring), patience_s=SOON_S)) as agent:

        def heard() -> bool:
            newest = beats.newest_header()
            sequence = newest.sequence if newest is not None else 0
            agent.publish(topics.STATE, messages.RobotState(), 1, robot=1)
            time.sleep(0.02)
            newest = beats.newest_header()
            return newest is not None and newest.sequence > sequence

        assert eventually(heard)
        gate = station.transport._gate  # type: ignore[attr-defined]  # the guard's process is known to the gate alone
        before = gate.guard_pid
        os.kill(before, signal.SIGKILL)
        assert eventually(lambda: gate.guard_pid not in (0, before))
        assert eventually(heard, 10.0)
    assert "has ended (exit code -9): it is started again" in caplog.text


def test_a_guard_that_cannot_be_started_at_once_is_started_later(
    station: Bus, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    gate = station.transport._gate  # type: ignore[attr-defined]  # the guard's process is known to the gate alone
    # the gate starts its guard itself; the first start is made to fail here
    start, tries = gate._start, list[int]()

    def fails_once() -> None:
        tries.append(1)
        if len(tries) == 1:
            raise RuntimeError("can't start new thread")
        start()

    monkeypatch.setattr(gate, "_start", fails_once)
    before = gate.guard_pid
    os.kill(before, signal.SIGKILL)
    assert eventually(lambda: gate.guard_pid not in (0, before))
    assert "cannot be started: RuntimeError: can't start new thread" in caplog.text


# --- the router's door


@pytest.fixture
def place(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The only folder of this user."""
    tmp_path.chmod(0o700)
    monkeypatch.setenv(user_folders.ONLY, str(tmp_path))
    return tmp_path


def test_the_door_accepts_only_requests_to_the_station(station: Bus, ring: Path, address: str) -> None:
    where = through_door(address)
    assert where is not None and where.address.startswith(f"{DOOR}/")
    obeyed: list[CommandKind] = []
    station.serve(1, lambda header, command: obeyed.append(command.order) or Reply(1, True))  # type: ignore[func-returns-value]
    sessions: list[int] = []
    station.subscribe(topics.HEARTBEAT, None, lambda topic, key, header, payload: sessions.append(header.session))
    with Bus(ZenohTransport(where, patience_s=SOON_S)) as bus:
        bus.publish(topics.HEARTBEAT, messages.StationHeartbeat(), 1)
        assert bus.command(Command(CommandKind.STOP, 0), 1, SOON_S).accepted
        assert not bus.command(Command(CommandKind.ARM, 1), 1, 0.2).accepted
    assert (obeyed, bus.session in sessions) == ([], False)


def test_a_terminals_stop_comes_through_the_door_under_attack_and_without_keys(station: Bus, address: str) -> None:
    ASKED.clear()
    port = int(address.rpartition(":")[2])
    with Strangers(port, handshakes_hz=50.0) as strangers:  # from the members' own address: the hardest for who needs the port
        assert eventually(lambda: strangers.made > 4)
        result = CliRunner().invoke(groundstation, ["stop", "--station", f"tcp/127.0.0.1:{port}"])
    assert ASKED[:1] == [CommandKind.STOP], result.output


def test_the_door_needs_no_keys_and_is_only_this_machines(station: Bus, address: str) -> None:
    port = int(address.rpartition(":")[2])
    here = through_door(f"tcp/127.0.0.1:{port}")
    assert here is not None and (here.address, here.keys) == (f"{DOOR}/{doors_of(port)[0]}", None)
    assert through_door(f"tcp/192.0.2.1:{port}") is None  # a documentation address: nobody's


def test_a_door_without_a_station_is_skipped(place: Path) -> None:
    address = "tcp/127.0.0.1:7447"
    assert through_door(address) is None
    (door,) = doors_of(7447)
    with closing(socket.socket(socket.AF_UNIX)) as left:
        left.bind(str(door))  # as after a station that was killed
    assert through_door(address) is None


def test_a_station_without_a_door_says_so_and_runs(
    ring: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    for name in (user_folders.ONLY, "XDG_RUNTIME_DIR", "TMPDIR"):
        monkeypatch.delenv(name, raising=False)
    for name in ("RUN", "TEMPORARY"):
        monkeypatch.setattr(user_folders, name, tmp_path / "missing")
    address = f"tls/127.0.0.1:{free_port()}"
    with Bus(ZenohTransport(endpoint(address, "groundstation", ring, router=True), gate=Gate)) as bus:
        bus.serve(0, lambda header, command: Reply(0, True))
        assert stopped(ring, address)
    assert "no door for this machine" in caplog.text


def test_a_closed_station_gives_its_port_back(ring: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """At once, though the program goes on: a member that calls must not wait for an answer that never comes."""
    monkeypatch.setenv(user_folders.ONLY, str(tmp_path))
    port = free_port()
    transport = ZenohTransport(endpoint(f"tls/127.0.0.1:{port}", "groundstation", ring, router=True), gate=Gate)
    socket.create_connection(("127.0.0.1", port), timeout=SOON_S).close()
    kept = transport._gate  # private: a socket that nothing refers to would be closed by Python
    transport.close()
    assert kept is not None
    with pytest.raises(ConnectionRefusedError):
        socket.create_connection(("127.0.0.1", port), timeout=SOON_S)


def test_a_gate_has_places_for_the_router_and_a_door_as_soon_as_it_is_made_and_others_when_they_are_taken(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setenv(user_folders.ONLY, str(tmp_path))
    port = free_port()
    gate = Gate(Endpoint(f"tls/127.0.0.1:{port}", router=True))
    try:
        places = []
        for _ in range(2):
            new_place, known_place, door = gate.endpoint.listens
            assert door == f"{DOOR}/{tmp_path / f'station-{port}.sock'}"
            places += [part.partition("#")[0] for part in (new_place, known_place)]
            inside = gate.inside
            assert (inside.address, inside.router, inside.access) == (places[-1], False, None)
            gate.draw()
        assert len(set(places)) == 4 and all(re.fullmatch(r"tls/127\.0\.0\.1:\d+", place) for place in places)
        assert gate.guard_pid == 0, "nobody is let in before it is opened"
    finally:
        gate.close()


def test_a_guard_whose_station_reads_nothing_goes_on() -> None:
    """Its sentences about strangers are lost; its work is not."""
    with full_pipe() as output, socket.create_server(("127.0.0.1", 0)) as listener:
        guard = programs.start(
            "groundstation.gate.guard", [str(listener.fileno()), "9", "9"], stdin=subprocess.PIPE, stdout=output,
            inherits=[listener.fileno()],
        )  # fmt: skip
        try:
            for host in (1, 2, 3):  # each origin is told of once
                stranger = socket.create_connection(listener.getsockname(), SOON_S, (f"127.0.0.{host}", 0))
                with stranger:
                    stranger.sendall(b"GET / HTTP/1.1\r\n\r\n")
                    assert stranger.recv(1) == b""
        finally:
            guard.kill()
            guard.communicate()


# --- what the guard passes on


class Passage:
    """A guard in a thread, between a test's client and a test's server that knows no TLS."""

    def __init__(self) -> None:
        self.server = socket.create_server(("127.0.0.1", 0))
        listener = socket.create_server(("127.0.0.1", 0))
        self.port, self.lines = listener.getsockname()[1], list[str]()
        inner = self.server.getsockname()[1]
        self.guard = Guard(listener, (inner, inner), self.lines.append, MOST_LINKS)
        self._end, self._ended = socket.socketpair()
        self.guard.watch(self._ended.fileno())
        self.thread = threading.Thread(target=self.guard.run)
        self.thread.start()

    def pair(self, hello: bytes) -> tuple[socket.socket, socket.socket]:
        """Both ends of a connection, after its hello."""
        client = socket.create_connection(("127.0.0.1", self.port), timeout=SOON_S)
        client.sendall(hello)
        server, _ = self.server.accept()
        server.settimeout(SOON_S)
        assert server.recv(len(hello), socket.MSG_WAITALL) == hello
        return client, server

    def expel(self, text: str) -> None:
        """Tell the guard, as the station does, whom the router does not want."""
        self._end.sendall(text.encode())

    def close(self) -> None:
        self._end.close()
        self.thread.join()
        self.guard.close()
        self._ended.close()
        self.server.close()


@pytest.fixture
def passage() -> Iterator[Passage]:
    with closing(Passage()) as passage:
        yield passage


HELLO = b"\x16\x03\x01\x00\x05\x01\x00\x00\x01\x00"


def test_bytes_pass_unchanged_both_ways_also_more_than_the_other_takes_at_once(passage: Passage) -> None:
    client, server = passage.pair(HELLO)
    with client, server:
        server.sendall(b"answer")
        assert client.recv(6, socket.MSG_WAITALL) == b"answer"
        data = os.urandom(8_000_000)
        for sender, receiver in ((client, server), (server, client)):
            sending = threading.Thread(target=sender.sendall, args=(data,))
            sending.start()
            time.sleep(0.05)  # every buffer on the way is full
            got = bytearray()
            while len(got) < len(data):
                got += receiver.recv(1 << 20)
            sending.join()
            assert bytes(got) == data


def test_the_end_of_one_direction_leaves_the_other(passage: Passage) -> None:
    client, server = passage.pair(HELLO)
    with client, server:
        server.sendall(b"answer")
        assert client.recv(6) == b"answer"
        client.shutdown(socket.SHUT_WR)
        assert server.recv(1) == b""
        server.sendall(b"last words")
        server.close()
        assert client.recv(100, socket.MSG_WAITALL) == b"last words"


@pytest.mark.parametrize("unread", [0, 8_000_000], ids=["all read", "frozen"])
def test_a_link_that_the_router_has_ended_is_dropped_though_the_peer_keeps_its_end(
    passage: Passage, unread: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A member that froze or lost its power would hold its place for ever, and the last one of them keep others out."""
    monkeypatch.setattr("groundstation.gate.guard.STALLED_S", 0.3)
    client, server = passage.pair(HELLO)
    with client, server:
        server.sendall(b"answer")
        assert client.recv(6, socket.MSG_WAITALL) == b"answer"
        client.sendall(bytes(CERTIFICATE_BYTES))  # as a member that has proven itself
        assert len(server.recv(CERTIFICATE_BYTES, socket.MSG_WAITALL)) == CERTIFICATE_BYTES
        server.sendall(bytes(ANSWER_BYTES))
        assert len(client.recv(ANSWER_BYTES, socket.MSG_WAITALL)) == ANSWER_BYTES
        server.setblocking(False)
        with contextlib.suppress(BlockingIOError):
            while unread:
                server.send(bytes(unread))
        server.close()
        assert eventually(lambda: not passage.guard._links)  # held places can be seen nowhere else


def test_a_lost_end_ends_the_other(passage: Passage) -> None:
    client, server = passage.pair(HELLO)
    server.sendall(b"answer")
    assert client.recv(6) == b"answer"
    client.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, b"\x01\0\0\0\0\0\0\0")  # a reset
    client.close()
    with server, pytest.raises(ConnectionError):
        while server.recv(1):
            pass
        raise ConnectionResetError  # an orderly end says the same


def test_bytes_after_a_hello_wait_for_the_routers_answer(passage: Passage) -> None:
    """Else a stranger could have the router's first flight counted as the answer to a certificate."""
    client, server = passage.pair(HELLO)
    with client, server:
        client.sendall(bytes(1000))
        server.settimeout(0.1)
        with pytest.raises(TimeoutError):
            server.recv(1)
        server.sendall(b"answer")
        server.settimeout(SOON_S)
        assert len(server.recv(1000, socket.MSG_WAITALL)) == 1000


def test_a_member_that_is_killed_is_no_stranger(passage: Passage) -> None:
    client, server = passage.pair(HELLO)
    with server:
        server.sendall(b"answer")
        assert client.recv(6) == b"answer"
        client.sendall(bytes(1000))  # as much as a certificate
        assert len(server.recv(1000, socket.MSG_WAITALL)) == 1000
        server.sendall(bytes(1000))  # as the answer to one
        assert len(client.recv(1000, socket.MSG_WAITALL)) == 1000
        client.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, b"\x01\0\0\0\0\0\0\0")  # a reset
        client.close()
        with contextlib.suppress(OSError):
            for _ in range(100):
                server.sendall(bytes(1000))
                time.sleep(0.001)
    with socket.create_connection(("127.0.0.1", passage.port), timeout=SOON_S) as stranger:
        stranger.sendall(b"hello")
        assert stranger.recv(1) == b""
    assert eventually(lambda: bool(passage.lines))
    assert passage.lines == ["refused a connection from 127.0.0.1 that does not begin as TLS does"]  # the stranger alone


def test_a_request_for_another_hello_ends_a_connection(passage: Passage) -> None:
    client, server = passage.pair(HELLO)
    with client, server:
        server.settimeout(admission.PROOF_S / 2)  # by then every connection without a proof ends
        server.sendall(b"\x16\x03\x03\x00\x58\x02\x00\x00\x54\x03\x03" + RETRY + bytes(50))
        assert server.recv(1) == b""


def test_a_link_without_a_proof_is_ended_though_the_router_goes_on_waiting(
    passage: Passage, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(admission, "PROOF_S", 0.3)
    client, server = passage.pair(HELLO)
    with client, server:
        assert ended(client) and ended(server)


def test_a_hello_in_too_many_pieces_is_no_hello(passage: Passage) -> None:
    """Each piece costs the guard a look at all that has come."""
    with socket.create_connection(("127.0.0.1", passage.port), timeout=SOON_S) as stranger:
        stranger.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        with contextlib.suppress(OSError):
            for byte in b"\x16\x03\x01\x40\x00\x01\x00\x3f\xf0" + bytes(1000):
                stranger.sendall(bytes([byte]))
                time.sleep(0.0005)
        with contextlib.suppress(OSError):
            assert stranger.recv(1) == b""
    assert eventually(lambda: len(passage.lines) == 1, admission.HELLO_S / 2)


def test_a_stranger_gone_before_its_turn_is_skipped(passage: Passage) -> None:
    for _ in range(20):
        with socket.create_connection(("127.0.0.1", passage.port), timeout=SOON_S) as stranger:
            stranger.sendall(b"GET / HTTP/1.1\r\n\r\n")
            assert stranger.recv(1) == b""
    client, server = passage.pair(HELLO)
    with client, server:
        assert passage.lines == ["refused a connection from 127.0.0.1 that does not begin as TLS does"]


def reset(one: socket.socket) -> None:
    """Close a socket with a reset instead of an orderly end."""
    one.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, b"\x01\0\0\0\0\0\0\0")
    one.close()


def ended(one: socket.socket, within_s: float = SOON_S) -> bool:
    """True if the other side closes a connection, in whatever way."""
    one.settimeout(within_s)
    try:
        return one.recv(1) == b""
    except TimeoutError:
        return False
    except ConnectionError:
        return True


def test_a_router_that_resets_ends_the_peers_connection(passage: Passage) -> None:
    client, server = passage.pair(HELLO)
    server.sendall(b"answer")
    assert client.recv(6, socket.MSG_WAITALL) == b"answer"
    reset(server)
    with client:
        assert ended(client, admission.PROOF_S / 2)


@pytest.mark.parametrize(
    ("sent", "answered", "member"),
    [
        (guard.CERTIFICATE_BYTES, guard.ANSWER_BYTES, True),
        (guard.CERTIFICATE_BYTES - 1, guard.ANSWER_BYTES, False),
        (guard.CERTIFICATE_BYTES, guard.ANSWER_BYTES - 1, False),
    ],
)
def test_a_certificate_and_its_answer_are_known_by_their_lengths(
    passage: Passage, sent: int, answered: int, member: bool
) -> None:
    client, server = passage.pair(HELLO)
    with server:
        server.sendall(b"answer")
        assert client.recv(6, socket.MSG_WAITALL) == b"answer"
        client.sendall(bytes(sent))
        assert len(server.recv(sent, socket.MSG_WAITALL)) == sent
        server.sendall(bytes(answered))
        assert len(client.recv(answered, socket.MSG_WAITALL)) == answered
        client.close()
        assert ended(server)
    assert eventually(lambda: bool(passage.lines), 0.5) is not member


def test_the_oldest_silent_connection_of_an_address_goes_for_one_too_many(passage: Passage) -> None:
    with contextlib.ExitStack() as stack:
        silent = [
            stack.enter_context(socket.create_connection(("127.0.0.1", passage.port), timeout=SOON_S))
            for _ in range(admission.MOST_WAITING_EACH + 1)
        ]
        assert ended(silent[0], admission.HELLO_S / 2)
        crowded = "refused a connection from 127.0.0.1 because too many wait, or are open"
        assert eventually(lambda: passage.lines == [crowded], admission.HELLO_S / 2)


def test_a_connection_that_waits_for_its_turn_keeps_what_it_has_said_since(passage: Passage) -> None:
    pairs = [passage.pair(HELLO) for _ in range(admission.MOST_TRYING_EACH)]
    with contextlib.ExitStack() as stack:
        for one in (one for pair in pairs for one in pair):
            stack.enter_context(one)
        waiting = stack.enter_context(socket.create_connection(("127.0.0.1", passage.port), timeout=SOON_S))
        waiting.sendall(HELLO)
        time.sleep(0.1)
        waiting.sendall(b"more")
        time.sleep(0.1)
        for one in pairs[0]:
            one.close()
        passage.server.settimeout(SOON_S)
        server = stack.enter_context(passage.server.accept()[0])
        server.settimeout(SOON_S)
        assert server.recv(len(HELLO), socket.MSG_WAITALL) == HELLO
        server.sendall(b"answer")
        assert server.recv(4, socket.MSG_WAITALL) == b"more"


def test_the_router_may_have_a_connection_ended(passage: Passage) -> None:
    pairs = [passage.pair(HELLO) for _ in range(3)]
    ports = [server.getpeername()[1] for _, server in pairs]
    passage.expel(f"nonsense\n-1\n99999999999\n{ports[0]}\n{str(ports[1])[:2]}")
    assert ended(pairs[0][0]) and ended(pairs[0][1])
    assert not ended(pairs[1][0], 0.1)
    passage.expel(f"{str(ports[1])[2:]}\n{ports[0]}\n")
    assert ended(pairs[1][0]) and not ended(pairs[2][0], 0.1)
    for one in (one for pair in pairs for one in pair):
        one.close()
