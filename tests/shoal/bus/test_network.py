"""Beyond this machine only with keys, or when the open network was asked for; and what is said about it."""

import contextlib
import os
import re
import shutil
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from datetime import UTC, datetime
from pathlib import Path

import pytest

from groundstation.deploy import key_ring
from groundstation.gate.gate import Gate
from shoal.bus import connection_diagnostics
from shoal.bus.access_control import INSECURE
from shoal.bus.connection_diagnostics import trouble_reaching
from shoal.bus.endpoint import FLOOD, Endpoint, parse_address
from shoal.bus.key_ring import Keys
from shoal.bus.network import endpoint
from shoal.bus.zenoh_transport import ZenohTransport
from shoal.errors import ConfigError, Unreached
from shoal.messages import topics
from sim_bridge.sil.ports import free_port
from tests.groundstation.gate.strangers import Strangers
from tests.waiting import eventually

pytestmark = pytest.mark.real_time


@pytest.fixture
def ring(tmp_path: Path) -> Path:
    key_ring.init(tmp_path / "keys", ["192.168.1.10"], "shoal", datetime.now(UTC))
    return tmp_path / "keys"


@pytest.mark.parametrize("address", ["tcp/127.0.0.1:7447", "tcp/localhost:7447", "tcp/[::1]:7447", "tcp/127.0.0.1:1#iface=lo"])
def test_this_machine_needs_no_keys(address: str) -> None:
    assert endpoint(address, "viewer", None) == Endpoint(address)


@pytest.mark.parametrize("address", ["tcp/0.0.0.0:7447", "tcp/192.168.1.10:7447", "tcp/[::]:7447", "tcp/pool.local:7447"])
def test_beyond_this_machine_keys_are_not_optional(address: str, caplog: pytest.LogCaptureFixture) -> None:
    with pytest.raises(ConfigError, match=r"other machines could command the robots.*--keys.*--insecure"):
        endpoint(address, "viewer", None)
    assert endpoint(address, "viewer", None, insecure=True) == Endpoint(address, insecure=True)
    assert INSECURE in caplog.text


@pytest.mark.parametrize(
    "address",
    [
        "", "7447", "tcp/host", "tcp/:7447", "tcp/a..b:7447", "tcp/" + "a" * 64 + ":7447", "udp/1.2.3.4:7447", "tcp/1.2.3.4:0",
        "tls/host:0", "tcp/1.2:x", "tcp/1.2.3.4:65536", "tcp/1.2.3.4:-1", "tcp/1.2.3.4", "tcp1.2.3.4:7447", "tcp/[]:7447",
    ],
)  # fmt: skip
def test_a_malformed_address_is_refused(address: str) -> None:
    with pytest.raises(ConfigError, match="allowed: tcp/HOST:PORT or tls/HOST:PORT"):
        endpoint(address, "viewer", None, insecure=True)


@pytest.mark.parametrize("port", [1, 65535])
def test_the_first_and_the_last_port_are_ports(port: int) -> None:
    assert parse_address(f"tcp/127.0.0.1:{port}#bind=127.0.0.1:0") == ("tcp", "127.0.0.1", port)
    assert parse_address(f"tls/[::1]:{port}") == ("tls", "::1", port)


def test_with_keys_it_is_always_tls_and_only_a_router_has_access_control(ring: Path) -> None:
    client = endpoint("tcp/192.168.1.10:7447", "viewer", ring)
    assert (client.address, client.access, client.insecure) == ("tls/192.168.1.10:7447", None, False)
    router = endpoint("tcp/0.0.0.0:7447", "groundstation", ring, router=True)
    assert router.access is not None
    assert router.access["default_permission"] == "deny"
    assert router.access["enabled"] is True


def test_the_station_says_whose_certificate_ends_soon(ring: Path, caplog: pytest.LogCaptureFixture) -> None:
    key_ring.add(ring, "robot", 4, datetime.now(UTC), days=29.0)
    endpoint("tls/127.0.0.1:7447", "groundstation", ring, router=True)
    assert [record.getMessage()[:29] for record in caplog.records] == ["the certificate of agent-4 en"]


def test_keys_that_others_can_read_are_refused(ring: Path) -> None:
    (ring / "viewer" / "key.pem").chmod(0o640)
    with pytest.raises(ConfigError, match=r"key\.pem: mode 0640 lets others read the private key .*chmod 600"):
        endpoint("tls/127.0.0.1:7447", "viewer", ring)


def test_missing_or_damaged_keys_are_refused(ring: Path) -> None:
    made = "(made by `groundstation keys add`, copied by `deploy`)"
    with pytest.raises(ConfigError, match=re.escape(f"--keys {ring}: {ring}/agent-9/ca.pem is missing {made}")):
        endpoint("tls/127.0.0.1:7447", "agent-9", ring)
    for name in ("ca.pem", "cert.pem", "key.pem"):
        shutil.copytree(ring / "viewer", ring / "agent-9", dirs_exist_ok=True)
        (ring / "agent-9" / name).write_text("junk")
        with pytest.raises(ConfigError, match=rf"agent-9/{name}.*not a certificate"):
            endpoint("tls/127.0.0.1:7447", "agent-9", ring)
    shutil.copytree(ring / "viewer", ring / "agent-9", dirs_exist_ok=True)
    shutil.copy(ring / "operator" / "key.pem", ring / "agent-9" / "key.pem")
    with pytest.raises(ConfigError, match="not a certificate and its key: key values mismatch"):
        endpoint("tls/127.0.0.1:7447", "agent-9", ring)
    with pytest.raises(ConfigError, match="TLS needs --keys"):
        endpoint("tls/127.0.0.1:7447", "viewer", None)
    with pytest.raises(ConfigError, match="--insecure and --keys"):
        endpoint("tls/127.0.0.1:7447", "viewer", ring, insecure=True)
    shutil.copytree(ring / "groundstation", ring.parent / "robot" / "groundstation")
    with pytest.raises(ConfigError, match=r"members\.toml is missing"):
        endpoint("tls/127.0.0.1:7447", "groundstation", ring.parent / "robot", router=True)


@pytest.mark.parametrize(("mine", "given"), [("agent-1", "viewer"), ("agent-1", "agent-11"), ("agent-11", "agent-1")])
def test_another_ones_certificate_is_refused(ring: Path, mine: str, given: str) -> None:
    """The router would let it in and hear nothing of what it says in its own name."""
    for robot in (1, 11):
        key_ring.add(ring, "robot", robot, datetime.now(UTC))
    endpoint("tls/127.0.0.1:7447", mine, ring)
    shutil.copytree(ring / given, ring / mine, dirs_exist_ok=True)
    with pytest.raises(ConfigError, match=rf"{mine}/cert\.pem: is {given}\.[0-9a-f]+'s, this is {mine} "):
        endpoint("tls/127.0.0.1:7447", mine, ring)


def test_a_reason_is_given_for_every_way_of_not_being_there(ring: Path) -> None:
    assert "no station listens" in trouble_reaching(f"tcp/127.0.0.1:{free_port()}", None)
    with pytest.raises(Unreached, match="no station listens"):
        ZenohTransport(Endpoint(f"tcp/127.0.0.1:{free_port()}"), patience_s=0.1)
    address = f"tcp/127.0.0.1:{free_port()}"
    plain = ZenohTransport(Endpoint(address, router=True))
    try:
        assert trouble_reaching(address, None) == ""
        with pytest.raises(Unreached):  # a station without keys is not the fleet's
            ZenohTransport(endpoint(address, "viewer", ring), patience_s=0.1)
        with pytest.raises(ConfigError, match=r"cannot listen at .*: Address already in use$"):
            ZenohTransport(Endpoint(address, router=True))
    finally:
        plain.close()
    guarded = ZenohTransport(endpoint(address, "groundstation", ring, router=True), gate=Gate)
    try:
        with pytest.raises(Unreached, match=r"wants --keys FOLDER"):  # what is easily forgotten
            ZenohTransport(Endpoint(address), patience_s=0.1)
    finally:
        guarded.close()


class Impostor:
    """A server on this machine that does one thing with each connection."""

    def __init__(self, once: Callable[[socket.socket], None]) -> None:
        self._server, self._once = socket.create_server(("127.0.0.1", 0)), once
        self.address = f"tls/127.0.0.1:{self._server.getsockname()[1]}"
        threading.Thread(target=self._serve, daemon=True).start()

    def _serve(self) -> None:
        with contextlib.suppress(OSError):  # closed
            while True:
                connection, _ = self._server.accept()
                with connection:
                    self._once(connection)

    def close(self) -> None:
        self._server.close()


def alert(number: int) -> Callable[[socket.socket], None]:
    """Answer with a fatal TLS alert."""
    return lambda connection: connection.sendall(b"\x15\x03\x03\x00\x02\x02" + bytes([number]))


@pytest.mark.parametrize(
    ("once", "says"),
    [
        (lambda connection: connection.sendall(b"220 mail\r\n"), "TLS failed: WRONG_VERSION_NUMBER"),
        (alert(0x74), "accept this process's certificate: none was shown"),
        (alert(0x2a), "accept this process's certificate: it is damaged"),
        (alert(0x28), "TLS failed: "),
        (
            lambda connection: connection.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, b"\x01\0\0\0\0\0\0\0"),
            "the station closed the connection: Connection reset by peer",
        ),
    ],
    ids=["another protocol", "certificate_required", "bad_certificate", "handshake_failure", "reset"],
)  # fmt: skip
def test_a_handshake_that_fails_says_why(ring: Path, once: Callable[[socket.socket], None], says: str) -> None:
    def after_the_hello(connection: socket.socket) -> None:
        connection.recv(65536)
        once(connection)

    with contextlib.closing(Impostor(after_the_hello)) as impostor:
        assert says in trouble_reaching(impostor.address, Keys(ring / "viewer"))


def test_keys_that_cannot_be_used_are_told_when_the_station_is_called(tmp_path: Path) -> None:
    for name in ("ca.pem", "cert.pem", "key.pem"):
        (tmp_path / name).write_text("junk")
    with contextlib.closing(Impostor(lambda connection: None)) as station:
        assert f"the keys in {tmp_path} cannot be used" in trouble_reaching(station.address, Keys(tmp_path))


def test_a_machine_that_does_not_answer_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(connection_diagnostics, "CONNECT_S", 0.05)
    with contextlib.ExitStack() as held:
        server = held.enter_context(socket.create_server(("127.0.0.1", 0), backlog=0))
        for _ in range(4):  # nobody accepts them: the system answers no more
            waiting = held.enter_context(socket.socket())
            waiting.setblocking(False)
            waiting.connect_ex(server.getsockname())
        answer = trouble_reaching(f"tcp/127.0.0.1:{server.getsockname()[1]}", None)
    assert answer == "no answer: is it switched on, and on this network?"


@pytest.mark.parametrize(
    ("number", "link", "first"),
    [
        (signal.SIGINT, "udp:127.0.0.1:9", "waiting for the station"),
        (signal.SIGTERM, "serial:/dev/no-board", "thruster board: /dev/no-board: not there; is the board plugged in"),
    ],
)
def test_a_process_that_waits_for_its_station_says_so_and_can_be_stopped(number: int, link: str, first: str) -> None:
    """As a person does it: the agent is started where there is no station, and is told to stop. That its board is not there
    it says at once."""
    command = [
        "robot_agent",
        "run",
        "pool",
        "--robot",
        "1",
        "--link",
        link,
        "--station",
        f"tcp/127.0.0.1:{free_port()}",
    ]
    with subprocess.Popen(
        [sys.executable, "-m", *command], stderr=subprocess.PIPE, text=True, env={**os.environ, "PYTHONUNBUFFERED": "1"}
    ) as process:
        assert process.stderr is not None
        try:
            assert first in (line := process.stderr.readline())
            assert "waiting for the station" in line or "waiting for the station" in process.stderr.readline()
            process.send_signal(number)
            assert process.wait(20.0) == 1
            assert "stopped while waiting" in process.stderr.read()
        finally:
            process.kill()


def test_a_robot_that_floods_is_not_let_through_and_the_others_are() -> None:
    address, counts = f"tcp/127.0.0.1:{free_port()}", {1: 0, 2: 0}
    router = ZenohTransport(Endpoint(address, router=True))
    wild, calm, ear = (ZenohTransport(Endpoint(address)) for _ in range(3))
    try:

        def count(key: str, payload: bytes, header: bytes) -> None:
            counts[int(key.split("/")[2])] += 1

        ear.subscribe(f"shoal/{topics.PLAN.key()}", topics.PLAN.qos, count)
        flood, plan = (t.publisher(f"shoal/{topics.PLAN.key(r)}", topics.PLAN.qos) for t, r in ((wild, 1), (calm, 2)))
        deadline = time.monotonic() + 10.0
        while not all(counts.values()) and time.monotonic() < deadline:  # until the subscription is known
            flood(b"x", b"")
            plan(b"x", b"")
            time.sleep(0.05)
        before, begin_s = dict(counts), time.monotonic()
        for _ in range(20):
            for _ in range(250):
                flood(b"x", b"")
            plan(b"x", b"")
            time.sleep(0.05)
        time.sleep(0.5)
        until_s = time.monotonic() + 5.0
        while counts[2] - before[2] < 20 and time.monotonic() < until_s:  # a busy machine brings the last one late
            time.sleep(0.05)
        passed = counts[1] - before[1]
        assert 0 < passed <= FLOOD * topics.PLAN.rate_hz * (time.monotonic() - begin_s) + 1
        assert counts[2] - before[2] == 20
    finally:
        for transport in (wild, calm, ear, router):
            transport.close()


@pytest.mark.real_time
@pytest.mark.timeout(60)
def test_silent_connections_to_a_router_keep_nobody_out() -> None:
    """More of them than Zenoh would take by itself at a time, which keeps each for 10 s."""
    address = f"tcp/127.0.0.1:{free_port()}"
    router = ZenohTransport(Endpoint(address, router=True))
    try:
        with Strangers(int(address.rpartition(":")[2]), half_open=200) as strangers:
            assert eventually(lambda: strangers.held >= 200)
            time.sleep(0.5)  # the router has them all
            ZenohTransport(Endpoint(address), patience_s=2.0).close()
    finally:
        router.close()
