"""Links to boards on a desk in HIL mode, which are stepped as they are read: the reference, and an Arduino Mega in simavr."""

import numpy as np

from shoal.mavlink.parameters import ParameterClient
from sim_bridge.thruster_board.board import ThrusterBoard
from tests.firmware.library import built
from tests.firmware.mega import Mega

STILL = np.zeros(4)
STEP_NS = 5_000_000


class HilDesk:
    """The link to a board on a desk, in HIL mode and at rest, which makes a step of 5 ms each time that it is read."""

    trouble = advice = ""
    first_word_s = 0.0

    def __init__(self, robot: int, board: ThrusterBoard) -> None:
        self.board, self._now_ns = board, 0
        board.receive(ParameterClient(robot).set("HIL_MODE", 1.0), 0)
        self.pins: set[tuple[int, ...]] = set()

    def send(self, data: bytes) -> None:
        self.board.receive(data, self._now_ns)

    def read(self) -> bytes:
        self._now_ns += STEP_NS
        data = self.board.step(self._now_ns, STILL, STILL, STILL)
        self.pins.add(self.board.pulses)
        return data

    def wait(self, timeout_s: float) -> None: ...
    def close(self) -> None: ...


class MegaDesk:
    """The link to an Arduino Mega in simavr, in HIL mode and at rest, which runs for 5 ms each time that it is read."""

    trouble = advice = ""
    first_word_s = 0.0

    def __init__(self, robot: int) -> None:
        build = f"build/robot-{robot}"
        self.mega = Mega(elf=built(f"{build}/board.elf", f"BUILD={build}", f"ROBOT={robot}", compiler="avr-gcc"))
        self._now_ns, self.worst_cycles, self.widths_us = 0, 0, np.empty(0)
        while self._now_ns < 400 * STEP_NS:  # starts, and measures its gyro's bias
            self.read()
        self.send(ParameterClient(robot).set("HIL_MODE", 1.0))
        for _ in range(20):  # a heartbeat of before it may still be on its way
            self.read()

    def send(self, data: bytes) -> None:
        self.mega.receive(data, self._now_ns)

    def read(self) -> bytes:
        self._now_ns += STEP_NS
        data = self.mega.step(self._now_ns)
        self.worst_cycles = max(self.worst_cycles, self.mega.loop_cycles()[0])
        widths_us = [pulse.width_us for channel in self.mega.pulses() for pulse in channel]
        self.widths_us = np.union1d(self.widths_us, widths_us)
        return data

    def wait(self, timeout_s: float) -> None: ...
    def close(self) -> None: ...
