"""The Arduino Mega's firmware in simavr, in this process and in its own time."""

import ctypes
import subprocess
from dataclasses import dataclass
from pathlib import Path

from tests.firmware.library import built

CYCLES_PER_US, BAUD = 16, 250_000
RAM_BEGIN = 0x200
EEPROM_BYTES, RING, EDGES = 4096, 1 << 16, 1 << 16


class CEdge(ctypes.Structure):
    """`struct edge` of simavr_board.c."""

    _fields_ = [("cycle", ctypes.c_uint64), ("channel", ctypes.c_uint32), ("level", ctypes.c_uint32)]


@dataclass(frozen=True)
class Pulse:
    """A pulse at a servo pin, us."""

    begin_us: float
    width_us: float


class Mega:
    """An Arduino Mega with the firmware, from power-on."""

    def __init__(self, eeprom: bytes | None = None, elf: Path | None = None) -> None:
        self._library = ctypes.CDLL(str(built("build/libsimavr_board.so", compiler="avr-gcc")))
        self._library.simulation_open.restype = ctypes.c_void_p
        self._library.simulation_cycle.restype = ctypes.c_uint64
        elf = elf or built("build/board.elf", compiler="avr-gcc")
        symbols = _symbols(elf)
        self.static_bytes = (symbols["__bss_end"] & 0xFFFF) - RAM_BEGIN
        self._simulation = ctypes.c_void_p(
            self._library.simulation_open(
                str(elf).encode(), BAUD, symbols["loop_once"], symbols["hal_idle"], symbols["__bss_end"] & 0xFFFF
            )
        )
        assert self._simulation.value is not None
        self._bytes = ctypes.create_string_buffer(RING)
        self._edges = (CEdge * EDGES)()
        self._risen: dict[int, float] = {}
        if eeprom is not None:
            self._library.simulation_eeprom(self._simulation, ctypes.create_string_buffer(eeprom, EEPROM_BYTES), 1)

    def close(self) -> None:
        self._library.simulation_close(self._simulation)

    # --- as a board on a bench

    def receive(self, data: bytes, now_ns: int) -> bool:
        self._library.simulation_receive(self._simulation, data, len(data))
        return True

    def step(self, now_ns: int) -> bytes:
        """Run to this time; the bytes that came out."""
        runs = self._library.simulation_run(self._simulation, ctypes.c_uint64(now_ns * CYCLES_PER_US // 1000))
        assert runs, "the processor crashed"
        count = self._library.simulation_take(self._simulation, self._bytes)
        return self._bytes.raw[:count]

    # --- what is measured

    @property
    def now_us(self) -> float:
        return float(self._library.simulation_cycle(self._simulation)) / CYCLES_PER_US

    @property
    def unread(self) -> int:
        """Bytes that are still on their way to the board."""
        return int(self._library.simulation_waiting(self._simulation))

    def pulses(self) -> list[list[Pulse]]:
        """The pulses of each channel that have ended since the last call."""
        pulses: list[list[Pulse]] = [[] for _ in range(8)]
        count = self._library.simulation_take_edges(self._simulation, self._edges)
        for edge in self._edges[:count]:
            at_us = edge.cycle / CYCLES_PER_US
            if edge.level:
                self._risen[edge.channel] = at_us
            elif edge.channel in self._risen:
                begin_us = self._risen.pop(edge.channel)
                pulses[edge.channel].append(Pulse(begin_us, at_us - begin_us))
        return pulses

    def loop_cycles(self) -> tuple[int, int]:
        """Cycles of the worst loop, and of all together, since the last call; without what the processor slept."""
        cycles = (ctypes.c_uint64 * 2)()
        self._library.simulation_loop(self._simulation, cycles)
        return cycles[0], cycles[1]

    @property
    def stack_bytes(self) -> int:
        """Bytes of stack that were ever used."""
        return int(self._library.simulation_stack(self._simulation))

    @property
    def eeprom(self) -> bytes:
        memory = ctypes.create_string_buffer(EEPROM_BYTES)
        self._library.simulation_eeprom(self._simulation, memory, 0)
        return memory.raw

    # --- what is done to it

    def reset(self) -> None:
        """A brown-out."""
        self._library.simulation_reset(self._simulation)

    def chip(self, chip: int, asleep: bool = False, absent: bool = False) -> None:
        """State of the IMU (0) or the pressure sensor (1): `asleep` after a loss of its supply, or not on the bus."""
        self._library.simulation_chip(self._simulation, chip, asleep, absent)

    def hang(self, hangs: bool) -> None:
        """Have the program hang in its loop, or no longer."""
        self._library.simulation_hang(self._simulation, hangs)


def _symbols(elf: Path) -> dict[str, int]:
    listed = subprocess.run(["avr-nm", str(elf)], capture_output=True, text=True, check=True).stdout
    rows = [line.split() for line in listed.splitlines()]
    return {row[2]: int(row[0], 16) for row in rows if len(row) == 3}
