"""An Arduino Mega in simavr by the wall clock, as a process: on a pseudo-terminal or a UDP port, for `sim-bridge hil`.

    python -m tests.firmware.plugged_mega ELF PORT

At its end it says how fast simavr was, and the pulses at its pins.
"""

import select
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from subprocess import Popen

from shoal.runtime.runtime import Stop
from sim_bridge.node.bench import BoardSocket, open_socket
from tests.firmware.library import built
from tests.firmware.mega import Mega, simavr_library
from tests.sim_bridge.boards import plugged

STEP_S = 0.002
EDGES_S = 1.0  # between two looks at the pins, of which simavr_board.c keeps a minute


def run(mega: Mega, socket: BoardSocket, stop: Stop) -> None:
    """Keep up with time until told to stop."""
    begin_ns, spent_s, late_s, looked_s = time.monotonic_ns(), 0.0, 0.0, 0.0
    widths_us: set[float] = set()
    while not stop.requested:
        now_ns = time.monotonic_ns() - begin_ns
        for data, peer in socket.read():
            mega.receive(data, now_ns)
            socket.hear(peer, now_ns)
        late_s = max(late_s, now_ns * 1e-9 - mega.now_us * 1e-6)
        before_s = time.thread_time()
        data = mega.step(now_ns)
        spent_s += time.thread_time() - before_s
        if data:
            socket.send(data, now_ns)
        if now_ns * 1e-9 - looked_s > EDGES_S:
            looked_s = now_ns * 1e-9
            widths_us |= {pulse.width_us for channel in mega.pulses() for pulse in channel}
        select.select([socket.fileno()], [], [], STEP_S)
    flown_s = mega.now_us * 1e-6
    print(f"{flown_s:.1f} s in {spent_s:.1f} s of the processor: {flown_s / spent_s:.1f} x real time", file=sys.stderr)
    print(f"at most {late_s * 1e3:.0f} ms behind; pins {min(widths_us):.1f} to {max(widths_us):.1f} us", file=sys.stderr)


@contextmanager
def plugged_mega(port: str, folder: Path, robot: int = 1) -> Iterator["Popen[str]"]:
    """An Arduino of a robot that is plugged in when this begins. A board in simavr keeps nothing in `folder`."""
    simavr_library()  # else the process had to skip the test
    build = f"build/robot-{robot}"
    elf = built(f"{build}/board.elf", f"BUILD={build}", f"ROBOT={robot}", compiler="avr-gcc")
    with plugged(["tests.firmware.plugged_mega", str(elf), port], "runs at ") as process:
        yield process


if __name__ == "__main__":
    _, elf, port = sys.argv
    end = Stop()
    wire = open_socket(port, signed=True)
    try:
        print(f"an Arduino in simavr runs at {port}", file=sys.stderr, flush=True)
        run(Mega(elf=Path(elf)), wire, end)
    finally:
        wire.close()
