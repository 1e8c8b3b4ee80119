"""There and back between two processes, as the fleet does it: encode, send through the router, decode, and all that again.

Beside ours: the same Zenoh sessions with bytes that nobody looks at (the difference is our encoding, checking and inboxes),
and three that go straight from one process to the other, with no router between: ZeroMQ, DDS and a bare TCP socket.
"""

import functools
import os
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing, contextmanager
from typing import Any

from benchmarks.harness import Row, run_peer, time_us
from benchmarks.shoal.codec import examples
from shoal.bus.bus import Bus, Inbox
from shoal.bus.endpoint import Endpoint
from shoal.bus.transport import Deliver
from shoal.bus.zenoh_transport import ZenohTransport
from shoal.messages import codec, topics
from shoal.messages.topics import Topic
from sim_bridge.sil.ports import free_port

ROUND_TRIPS = 2000
FRAME_ROUND_TRIPS = 300
PATIENCE_S = 2.0  # a lost message shows as this in the column "max"
SOCKET_BUFFER = 4 * 1024 * 1024  # a whole picture; with the default the floor is no floor
PEERS = {"bus_zeromq": ("pyzmq==27.3.0",), "bus_dds": ("cyclonedds==11.0.1",)}

CASES: dict[str, Topic] = {"RobotState": topics.STATE, "Plan": topics.PLAN, "Frame": topics.FRAME}


def _robot(topic: Topic) -> int | None:
    return 1 if "{robot}" in topic.name else None


@contextmanager
def _process(role: str, argument: str) -> Iterator[None]:
    """Another process of this benchmark. It ends when its standard input does, so also when we are killed."""
    child = subprocess.Popen([sys.executable, "-m", "benchmarks.shoal.bus", role, argument], stdin=subprocess.PIPE)
    try:
        yield
    finally:
        child.communicate()


# --- the other processes


def _router(address: str) -> None:
    with closing(ZenohTransport(Endpoint(address, router=True))):
        threading.Event().wait()


def _echo(address: str) -> None:
    """Answer each message of the fleet `ping` with the same message in the fleet `pong`."""
    transport = ZenohTransport(Endpoint(address))
    ping, pong = Bus(transport, "ping"), Bus(transport, "pong")
    inboxes: dict[Topic, Inbox[Any]] = {t: ping.inbox(t, t.type, _robot(t)) for t in CASES.values()}
    last_ns = dict.fromkeys(inboxes, -1)

    def fresh() -> bool:
        return any(
            (h := inbox.newest_header()) is not None and h.stamp_ns > last_ns[topic] for topic, inbox in inboxes.items()
        )

    while True:
        ping.wait(fresh, PATIENCE_S)
        for topic, inbox in inboxes.items():
            received = inbox.newest()
            if received is not None and received.header.stamp_ns > last_ns[topic]:
                last_ns[topic] = received.header.stamp_ns
                pong.publish(topic, received.message, received.header.stamp_ns, _robot(topic))


def _echo_bytes(address: str) -> None:
    """The same without looking at the bytes: straight from Zenoh's callback."""
    transport = ZenohTransport(Endpoint(address))
    for topic in CASES.values():
        send_back = _back_through(transport.publisher(f"pong/{topic.key(1)}", topic.qos))
        transport.subscribe(f"ping/{topic.key(1)}", topic.qos, send_back)
    threading.Event().wait()


def _back_through(put: Callable[[bytes, bytes], None]) -> Deliver:
    return lambda key, payload, header: put(payload, header)


def _echo_socket(port: str) -> None:
    with socket.create_connection(("127.0.0.1", int(port))) as link:
        _prepare(link)
        while True:
            link.sendall(_receive(link))


def _prepare(link: socket.socket) -> None:
    link.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    link.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, SOCKET_BUFFER)
    link.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, SOCKET_BUFFER)


def _receive(link: socket.socket) -> bytes:
    """One message: its length in four bytes, then the message. Returned with its length."""
    head = link.recv(4, socket.MSG_WAITALL)
    return head + link.recv(int.from_bytes(head), socket.MSG_WAITALL)


# --- ours


def _until_it_works(round_trip: Callable[[], bool]) -> None:
    """Sessions open and subscriptions spread in their own time; that is not what is measured."""
    deadline = time.monotonic() + 20.0
    while not round_trip():
        if time.monotonic() > deadline:
            raise TimeoutError("no echo within 20 s")


def _measure_bus(address: str, case: str, message: Any) -> list[float]:
    topic = CASES[case]
    with closing(ZenohTransport(Endpoint(address))) as transport:
        ping, pong = Bus(transport, "ping"), Bus(transport, "pong")
        inbox: Inbox[Any] = pong.inbox(topic, topic.type, _robot(topic))

        def back(stamp_ns: int) -> bool:
            header = inbox.newest_header()
            return header is not None and header.stamp_ns == stamp_ns

        def round_trip(patience_s: float = PATIENCE_S) -> bool:
            stamp_ns = time.monotonic_ns()
            ping.publish(topic, message, stamp_ns, _robot(topic))
            return pong.wait(lambda: back(stamp_ns), patience_s) and inbox.newest() is not None

        _until_it_works(functools.partial(round_trip, 0.2))
        return time_us(round_trip, _count(case))


def _measure_bytes(address: str, case: str, message: Any) -> list[float]:
    topic, payload = CASES[case], codec.encode(message)
    with closing(ZenohTransport(Endpoint(address))) as transport:
        answered = threading.Event()
        transport.subscribe(f"pong/{topic.key(1)}", topic.qos, lambda key, payload, header: answered.set())
        put = transport.publisher(f"ping/{topic.key(1)}", topic.qos)

        def round_trip(patience_s: float = PATIENCE_S) -> bool:
            answered.clear()
            put(payload, b"")
            return answered.wait(patience_s)

        _until_it_works(functools.partial(round_trip, 0.2))
        return time_us(round_trip, _count(case))


# --- the floor


def _measure_socket(case: str, message: Any) -> list[float]:
    payload = codec.encode(message)
    framed = len(payload).to_bytes(4) + payload
    with socket.create_server(("127.0.0.1", 0)) as server, _process("echo-socket", str(server.getsockname()[1])):
        link, _ = server.accept()
        with link:
            _prepare(link)

            def round_trip() -> bytes:
                link.sendall(framed)
                return _receive(link)

            return time_us(round_trip, _count(case))


def _count(case: str) -> int:
    return FRAME_ROUND_TRIPS if case == "Frame" else ROUND_TRIPS


def run() -> Iterator[Row]:
    """Round trips of a robot's state, a plan and a camera picture."""
    messages = {case: message for case, message in examples().items() if case in CASES}
    task = [{"case": case, "bytes": len(codec.encode(m)), "n": _count(case)} for case, m in messages.items()]
    peers = [row for name, requirements in PEERS.items() for row in run_peer(name, requirements, task)]
    address = f"tcp/127.0.0.1:{free_port()}"
    with ExitStack() as processes:
        processes.enter_context(_process("router", address))
        for case, message in messages.items():
            title = f"round trip, {case}"
            with _process("echo", address):
                yield Row.of("bus", title, "ours", "us", _measure_bus(address, case, message))
            with _process("echo-bytes", address):
                yield Row.of("bus", title, "ours, bytes alone", "us", _measure_bytes(address, case, message))
            yield Row.of("bus", title, "tcp socket, no router", "us", _measure_socket(case, message))
            yield from (row for row in peers if row.case == title)


ROLES = {"router": _router, "echo": _echo, "echo-bytes": _echo_bytes, "echo-socket": _echo_socket}

if __name__ == "__main__":
    threading.Thread(target=lambda: (sys.stdin.read(), os._exit(0)), daemon=True).start()
    ROLES[sys.argv[1]](sys.argv[2])
