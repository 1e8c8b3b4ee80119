"""Cost of the guard in front of a router with keys: round trip between two processes, through it and past it.

Both ways are mutual TLS through the same router. A round trip passes the guard four times (there: sender to router, router to
echo; and back), so a quarter of the difference is what it adds to one passage of one message.
"""

import os
import subprocess
import sys
import tempfile
import threading
from collections.abc import Iterator
from contextlib import ExitStack, closing
from datetime import UTC, datetime
from pathlib import Path

from benchmarks.harness import Row, time_us
from benchmarks.shoal.bus import FRAME_ROUND_TRIPS, PATIENCE_S, ROUND_TRIPS, _back_through, _until_it_works
from benchmarks.shoal.codec import examples
from groundstation.deploy import key_ring
from groundstation.gate.gate import Gate
from shoal.bus.endpoint import Endpoint
from shoal.bus.key_ring import Keys
from shoal.bus.zenoh_transport import ZenohTransport
from shoal.messages import codec, topics
from shoal.messages.topics import Topic
from sim_bridge.sil.ports import free_port

CASES: dict[str, tuple[Topic, int]] = {"RobotState": (topics.STATE, ROUND_TRIPS), "Frame": (topics.FRAME, FRAME_ROUND_TRIPS)}


def _key(fleet: str, topic: Topic) -> str:
    return f"{fleet}/{topic.key(1)}"


def _router(ring: str, address: str) -> None:
    """The router and its guard; says where one gets past it."""
    with closing(
        ZenohTransport(Endpoint(address, router=True, keys=Keys(Path(ring) / "groundstation")), gate=Gate)
    ) as transport:
        gate = transport._gate
        assert isinstance(gate, Gate)
        print(gate.inside.address, flush=True)
        threading.Event().wait()


def _echo(ring: str, address: str) -> None:
    """Send back what comes, and say when that stands."""
    with closing(ZenohTransport(Endpoint(address, keys=Keys(Path(ring) / "agent-1")))) as transport:
        for topic, _ in CASES.values():
            send_back = _back_through(transport.publisher(_key("pong", topic), topic.qos))
            transport.subscribe(_key("ping", topic), topic.qos, send_back)
        print("ready", flush=True)
        threading.Event().wait()


def _round_trips_us(ring: Path, address: str, topic: Topic, payload: bytes, count: int) -> list[float]:
    with closing(ZenohTransport(Endpoint(address, keys=Keys(ring / "viewer")))) as transport:
        answered = threading.Event()
        transport.subscribe(_key("pong", topic), topic.qos, lambda key, payload, header: answered.set())
        put = transport.publisher(_key("ping", topic), topic.qos)

        def round_trip(patience_s: float = PATIENCE_S) -> bool:
            answered.clear()
            put(payload, b"")
            return answered.wait(patience_s)

        _until_it_works(lambda: round_trip(0.2))
        return time_us(round_trip, count)


def run() -> Iterator[Row]:
    """Round trips of a robot's state and of a picture."""

    def process(stack: ExitStack, role: str, address: str) -> str:
        """Start another process of this benchmark, which ends with us. Returns the line that it begins with."""
        command = [sys.executable, "-m", "benchmarks.shoal.guard", role, str(ring), address]
        child = stack.enter_context(subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True))
        assert child.stdin is not None and child.stdout is not None
        stack.callback(child.stdin.close)
        return child.stdout.readline().strip()

    with tempfile.TemporaryDirectory() as folder, ExitStack() as processes:
        ring, now = Path(folder) / "keys", datetime.now(UTC)
        key_ring.init(ring, [], "shoal", now)
        key_ring.add(ring, "robot", 1, now)
        public = f"tls/127.0.0.1:{free_port()}"
        inside = process(processes, "router", public)
        for case, message in examples().items():
            if case not in CASES:
                continue
            topic, count = CASES[case]
            payload = codec.encode(message)
            for subject, address in (("past the guard", inside), ("through the guard", public)):
                with ExitStack() as echo:
                    process(echo, "echo", address)
                    samples = _round_trips_us(ring, address, topic, payload, count)
                yield Row.of("guard", f"round trip, {case}, {len(payload)} bytes, TLS", subject, "us", samples)


ROLES = {"router": _router, "echo": _echo}

if __name__ == "__main__":
    threading.Thread(target=lambda: (sys.stdin.read(), os._exit(0)), daemon=True).start()
    ROLES[sys.argv[1]](sys.argv[2], sys.argv[3])
