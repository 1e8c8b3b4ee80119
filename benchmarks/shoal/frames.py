"""A camera's frames from one process to another of the same host: over the network, and through shared memory.

1280 x 960 at 20 Hz, camera, router and reader each a process, both ways by turns. The time is from the exposure, here the
call that publishes, to the pixels in the reader's hand; the processor time is that of all three processes together.
"""

import json
import os
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import closing

import numpy as np

from benchmarks.harness import Row
from shoal.bus import frame_ring
from shoal.bus.bus import Bus
from shoal.bus.endpoint import Endpoint
from shoal.bus.zenoh_transport import ZenohTransport
from shoal.messages import topics
from shoal.messages.messages import Frame
from sim_bridge.sil.ports import free_port

SIZE_PX = (1280, 960)
RATE_HZ = 20.0
FRAMES = 300  # a turn
TURNS = 2  # of each way
PATIENCE_S = 1.0  # without a frame after which the camera has ended
WAYS = ("network", "shared memory")


def _router(address: str, ring: int | None) -> list[float]:
    with closing(ZenohTransport(Endpoint(address, router=True))):
        sys.stdin.read()
    return []


def _camera(address: str, ring: int | None) -> list[float]:
    pictures = np.random.default_rng(1).integers(0, 256, (8, *SIZE_PX[::-1]), dtype=np.uint8)
    with Bus(ZenohTransport(Endpoint(address)), "shoal", *frame_ring.codec_of(ring)) as bus:
        sys.stdin.readline()  # the reader hears
        time.sleep(PATIENCE_S)  # and the router knows
        begin_s = time.monotonic()
        for k in range(FRAMES):
            time.sleep(max(begin_s + k / RATE_HZ - time.monotonic(), 0.0))
            bus.publish(topics.FRAME, Frame(pictures[k % len(pictures)]), time.monotonic_ns())
        time.sleep(PATIENCE_S)
    return []


def _reader(address: str, ring: int | None) -> list[float]:
    ages_ms: list[float] = []
    head = None
    with Bus(ZenohTransport(Endpoint(address)), "shoal", *frame_ring.codec_of(ring)) as bus:
        inbox = bus.inbox(topics.FRAME, Frame)
        print(flush=True)  # says that it hears
        while bus.wait(lambda head=head: inbox.newest_header() is not head, 60.0 if not ages_ms else PATIENCE_S):  # type: ignore[misc]
            head = inbox.newest_header()
            received = inbox.newest()
            if received is not None and head is not None and received.header is head:
                ages_ms.append((time.monotonic_ns() - head.stamp_ns) * 1e-6)
    return ages_ms


def _start(role: str, address: str, ring: int | None) -> "subprocess.Popen[str]":
    handed = () if ring is None else (ring,)
    command = [sys.executable, "-m", "benchmarks.shoal.frames", role, address, *map(str, handed)]
    return subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, pass_fds=handed)


def _turn(way: str) -> tuple[list[float], float]:
    """Ages of the frames in ms, and ms of processor per frame in all three processes."""
    address, ring = f"tcp/127.0.0.1:{free_port()}", frame_ring.create([SIZE_PX]) if way == WAYS[1] else None
    router = _start("router", address, None)
    reader, camera = _start("reader", address, ring), _start("camera", address, ring)
    if ring is not None:
        os.close(ring)
    assert reader.stdout is not None
    reader.stdout.readline()
    reports = [json.loads(child.communicate("\n")[0].splitlines()[-1]) for child in (camera, reader, router)]
    return reports[1]["ages_ms"], sum(each["cpu_ms"] for each in reports) / FRAMES


def run() -> Iterator[Row]:
    """Both ways by turns."""
    ages_ms: dict[str, list[float]] = {way: [] for way in WAYS}
    cpu_ms: dict[str, list[float]] = {way: [] for way in WAYS}
    for _ in range(TURNS):
        for way in WAYS:
            ages, cpu = _turn(way)
            ages_ms[way] += ages
            cpu_ms[way].append(cpu)
    for way in WAYS:
        share_pct = 100.0 * len(ages_ms[way]) / (TURNS * FRAMES)
        yield Row.of("frames", "camera to reader", way, "ms", ages_ms[way])
        yield Row.of("frames", "camera to reader", way, "ms of processor per frame", cpu_ms[way])
        yield Row("frames", "camera to reader", way, "% heard", share_pct, share_pct, share_pct, TURNS * FRAMES)


if __name__ == "__main__":
    _, role, address, *descriptor = sys.argv
    begun_s = time.process_time()
    program = {"router": _router, "camera": _camera, "reader": _reader}[role]
    result = program(address, int(descriptor[0]) if descriptor else None)
    print(json.dumps({"ages_ms": result, "cpu_ms": (time.process_time() - begun_s) * 1e3}), flush=True)
