"""The Arduino Mega's firmware in simavr, in this process and in its own time."""

import ctypes
import math
import os
import shutil
import subprocess
from dataclasses import dataclass
from enum import IntEnum, IntFlag
from pathlib import Path

import pytest

from sim_bridge.thruster_board.board import HPA_PER_M
from tests.firmware.library import built

CYCLES_PER_US, BAUD = 16, 250_000
RAM_BEGIN = 0x200
EEPROM_BYTES, RING, EDGES = 4096, 1 << 16, 1 << 16
BOOTLOADER = Path("/usr/share/arduino/hardware/arduino/avr/bootloaders/stk500v2/stk500boot_v2_mega2560.hex")
BOOT_START = 0x3E000
IMU, PRESSURE = 0, 1  # chips
LEVEL = (0, 0, 8192, 0, 0, 0, 0)  # what the IMU measures at rest: acceleration, temperature, gyro, in its own numbers
AIR_RAW, RAW_PER_M = 4510376, 14680.0  # of the pressure sensor, with the coefficients of its data sheet's example


class ChipFault(IntEnum):
    """`enum fault` of simavr_board.c."""

    ABSENT = 0
    FROZEN = 1  # answers, with the same value again and again
    WRONG = 2  # another WHO_AM_I, a damaged PROM
    LATE = 3  # conversions take four times as long; the IMU holds the clock
    ASLEEP = 4  # answers, but converts nothing, whatever it is told


class Reset(IntFlag):
    """Causes of a reset, as MCUSR has them."""

    POWER_ON = 1
    PIN = 2
    BROWN_OUT = 4
    WATCHDOG = 8


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

    def __init__(self, eeprom: bytes | None = None, elf: Path | None = None, bootloader: bool = False) -> None:
        self._library = ctypes.CDLL(str(simavr_library()))
        self._library.simulation_open.restype = ctypes.c_void_p
        self._library.simulation_cycle.restype = ctypes.c_uint64
        elf = elf or built("build/board.elf", compiler="avr-gcc")
        self._symbols = symbols = _symbols(elf)
        self.static_bytes = (symbols["_end"] & 0xFFFF) - RAM_BEGIN
        self._simulation = ctypes.c_void_p(
            self._library.simulation_open(
                str(elf).encode(), BAUD, symbols["loop_once"], symbols["hal_idle"], symbols["_end"] & 0xFFFF
            )
        )
        assert self._simulation.value is not None
        self._bytes = ctypes.create_string_buffer(RING)
        self._edges = (CEdge * EDGES)()
        self._risen: dict[int, float] = {}
        memory = b"\xff" * EEPROM_BYTES if eeprom is None else eeprom
        self._library.simulation_eeprom(self._simulation, ctypes.create_string_buffer(memory, EEPROM_BYTES), 1)
        if bootloader:
            self.load_bootloader()
            self.reset(Reset.POWER_ON)

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

    def watch(self, function: str) -> None:
        """Count the calls of a function from now on."""
        self._library.simulation_watch(self._simulation, self._symbols[function])

    def calls(self) -> tuple[int, float]:
        """Count of calls of the watched function, and the longest time between two calls, us."""
        calls = (ctypes.c_uint64 * 2)()
        self._library.simulation_calls(self._simulation, calls)
        return calls[0], calls[1] / CYCLES_PER_US

    @property
    def stack_bytes(self) -> int:
        """Bytes of stack that were ever used."""
        return int(self._library.simulation_stack(self._simulation))

    @property
    def eeprom(self) -> bytes:
        memory = ctypes.create_string_buffer(EEPROM_BYTES)
        self._library.simulation_eeprom(self._simulation, memory, 0)
        return memory.raw

    @eeprom.setter
    def eeprom(self, memory: bytes) -> None:
        self._library.simulation_eeprom(self._simulation, ctypes.create_string_buffer(memory, EEPROM_BYTES), 1)

    # --- what is done to it

    def reset(self, causes: Reset = Reset.BROWN_OUT) -> None:
        """A reset that the RAM outlives."""
        self._library.simulation_reset(self._simulation, int(causes), 0, 0)

    def lose_power(self, torn: int = 0xFF) -> None:
        """The supply fails, and comes back: only the EEPROM outlives it; a byte that is being written becomes `torn`."""
        self._library.simulation_reset(self._simulation, int(Reset.POWER_ON | Reset.BROWN_OUT), 1, torn)
        self.power_chip(IMU)
        self.power_chip(PRESSURE)

    def load_bootloader(self) -> None:
        """Start at Arduino's bootloader from the next reset on, as a stock board does. Skips the test if it is not there."""
        if not BOOTLOADER.exists():
            pytest.skip("no bootloader: arduino-core-avr is not installed")
        assert self._library.simulation_bootloader(self._simulation, str(BOOTLOADER).encode(), BOOT_START)

    @property
    def is_in_bootloader(self) -> bool:
        return int(self._library.simulation_pc(self._simulation)) >= BOOT_START

    def fault(self, chip: int, fault: ChipFault, is_on: bool = True) -> None:
        """Something is wrong with a chip, or no longer."""
        self._library.simulation_fault(self._simulation, chip, int(fault), is_on)

    def power_chip(self, chip: int) -> None:
        """The supply of a chip fails for a moment."""
        self._library.simulation_power_chip(self._simulation, chip)

    def glitch(self, register: int, value: int) -> None:
        """A register of the IMU changes by itself."""
        self._library.simulation_glitch(self._simulation, register, value)

    def hold_bus(self, after_bytes: int = 1, clocks: int = 5) -> None:
        """A chip stops in the middle of a byte of the read that comes, and holds the bus for so many clocks."""
        self._library.simulation_hold_bus(self._simulation, after_bytes, clocks)

    def free_bus(self) -> None:
        """No chip holds the bus any longer."""
        self._library.simulation_free_bus(self._simulation)

    def measure(self, depth_m: float = 0.0, yaw_rate_radps: float = 0.0, air_hpa: float = 0.0) -> None:
        """Have the sensors measure a depth, with the air's pressure above that in which it began, and a turn."""
        gyro = round(-yaw_rate_radps / (math.radians(1.0) / 65.5))
        raw = AIR_RAW + round(RAW_PER_M * (depth_m + air_hpa / HPA_PER_M))
        self._library.simulation_measure(self._simulation, (ctypes.c_int16 * 7)(*LEVEL[:6], gyro), raw)

    def charge(self, battery_v: float) -> None:
        """The battery's voltage, which a divider of 5 leads to A0."""
        self._library.simulation_battery(self._simulation, round(battery_v * 1000.0 / 5.0))

    def eeprom_counts(self) -> tuple[int, int]:
        """Bytes that were begun to be written; accesses while one was."""
        counts = (ctypes.c_uint32 * 2)()
        self._library.simulation_eeprom_counts(self._simulation, counts)
        return counts[0], counts[1]

    def hang(self, hangs: bool) -> None:
        """Have the program hang in its loop, or no longer."""
        self._library.simulation_hang(self._simulation, hangs)


def simavr_library() -> Path:
    """The simulated Arduino's library, up to date. Skips the test if a compiler, simavr or libelf is not there."""
    built("build/board.elf", compiler="avr-gcc")
    headers = ["-include", "simavr/sim_avr.h", "-include", "gelf.h"]
    if shutil.which("gcc") and subprocess.run(["gcc", "-E", "-x", "c", *headers, os.devnull], capture_output=True).returncode:
        pytest.skip("simavr is not installed")
    return built("build/libsimavr_board.so")


def _symbols(elf: Path) -> dict[str, int]:
    listed = subprocess.run(["avr-nm", str(elf)], capture_output=True, text=True, check=True).stdout
    rows = [line.split() for line in listed.splitlines()]
    return {row[2]: int(row[0], 16) for row in rows if len(row) == 3}
