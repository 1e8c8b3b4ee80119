"""The C firmware's board in this process: the shared library of firmware/, built when it is missing or old."""

import ctypes
import fcntl
import os
import shutil
import subprocess
from collections.abc import Sequence
from pathlib import Path

import pytest

from shoal.config.experiment import load_experiment
from shoal.mavlink.agent_link import CHANNELS, STANDARD_GRAVITY_MPS2, SURFACE_HPA, depth_to_hpa
from shoal.mavlink.frame_codec import Peer
from shoal.mavlink.signing import Key
from sim_bridge.plant.sensors import Reading
from sim_bridge.thruster_board.parameters import Parameters
from sim_bridge.thruster_board.sensor_zero import BoardStart, Zeros

FIRMWARE = Path(__file__).parents[2] / "firmware"
POOL = load_experiment("pool")
PARAMETERS = Parameters.of(POOL)
OUTBOX_BYTES = 1000
REST = Reading(0.0, 0.0, (0.0, 0.0, -STANDARD_GRAVITY_MPS2), 0.0)


CORE_TESTS = [f"tests/firmware/{name}" for name in ("test_rules.py", "test_memory.py", "test_board.py")]  # that take `core()`


def built(file: str, *options: str, compiler: str = "gcc") -> Path:
    """A file that firmware/Makefile makes, up to date. Skips the test if the compiler is not there."""
    for program in ("make", compiler):
        if shutil.which(program) is None:
            pytest.skip(f"{program} is not installed")
    with (FIRMWARE / "Makefile").open() as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        made = subprocess.run(["make", "-s", "-C", str(FIRMWARE), file, *options], capture_output=True, text=True)
    assert made.returncode == 0, made.stdout + made.stderr
    return FIRMWARE / file


def core() -> ctypes.CDLL:
    """The C core, or another build of it that SHOAL_CORE_LIBRARY names: one with a change, or one that counts its lines."""
    return load(Path(os.environ.get("SHOAL_CORE_LIBRARY") or built("build/libboard.so")))


class CPeer(ctypes.Structure):
    """`struct peer` of signing.h."""

    _fields_ = [("system", ctypes.c_uint8), ("component", ctypes.c_uint8)]


class CReading(ctypes.Structure):
    """`struct reading` of messages.h."""

    _fields_ = [
        ("heading_rad", ctypes.c_float),
        ("yaw_rate_radps", ctypes.c_float),
        ("acceleration_mps2", ctypes.c_float * 3),
        ("excess_hpa", ctypes.c_float),
        ("temperature_cdegc", ctypes.c_int16),
        ("battery_v", ctypes.c_float),
        ("chip", ctypes.c_uint8 * 2),
    ]

    @classmethod
    def of(cls, reading: Reading, battery_v: float) -> "CReading":
        """The reading of the Python board's sensors."""
        acceleration = (ctypes.c_float * 3)(*reading.acceleration_mps2)
        excess_hpa = depth_to_hpa(reading.depth_m) - SURFACE_HPA
        return cls(
            reading.heading_rad, reading.yaw_rate_radps, acceleration, excess_hpa, 2000, battery_v, (ctypes.c_uint8 * 2)()
        )


def load(path: Path) -> ctypes.CDLL:
    """The library, with the types of its calls."""
    library = ctypes.CDLL(str(path))
    board, time_us, u16 = ctypes.c_void_p, ctypes.c_uint64, ctypes.c_uint16
    calls = {
        "library_board_bytes": (ctypes.c_uint32, []),
        "library_begin": (None, [board, ctypes.c_uint8, ctypes.c_char_p, ctypes.c_uint64, ctypes.c_uint64]),
        "library_start": (None, [board, ctypes.c_uint8, ctypes.c_bool, ctypes.c_bool, ctypes.c_float, ctypes.c_float]),
        "library_receive": (ctypes.c_bool, [board, ctypes.c_char_p, ctypes.c_uint32, time_us]),
        "library_step": (None, [board, time_us, ctypes.POINTER(CReading)]),
        "library_take_output": (u16, [board, ctypes.c_char_p]),
        "library_state": (None, [board, ctypes.c_void_p, ctypes.c_void_p]),
        "library_take_texts": (u16, [board, ctypes.c_char_p]),
        "board_measures": (ctypes.c_bool, [board, time_us]),
        "library_eeprom": (ctypes.POINTER(ctypes.c_uint8), []),
        "library_cut": (None, [ctypes.c_uint32, ctypes.c_uint8]),
        "library_wear": (None, [u16, u16]),
        "library_store_bytes": (ctypes.c_uint32, []),
        "library_busy": (None, [ctypes.c_bool]),
        "board_measure": (None, [board, time_us, ctypes.POINTER(CReading)]),
        "library_boot": (None, [board, board, ctypes.c_uint8]),
        "library_put": (None, [board, ctypes.c_char_p, u16, time_us]),
        "library_pass": (None, [board, board, time_us]),
        "library_parameter": (ctypes.c_float, [board, ctypes.c_int]),
        "rules_override": (ctypes.c_bool, [board, CPeer, ctypes.c_void_p, time_us]),
        "rules_arm": (ctypes.c_int, [board, ctypes.c_bool, time_us]),
        "rules_change": (ctypes.c_int, [board, ctypes.c_int, ctypes.c_float]),
        "rules_take_key": (ctypes.c_bool, [board]),
        "rules_battery": (None, [board, ctypes.c_float, ctypes.c_float]),
        "rules_step": (None, [board, time_us]),
    }
    for name, (result, arguments) in calls.items():
        call = getattr(library, name)
        call.restype, call.argtypes = result, arguments
    return library


class FirmwareBoard:
    """The C board, with the calls of ThrusterBoard that tests use. Times in ns, whole microseconds."""

    def __init__(
        self, library: ctypes.CDLL, key: Key | None = None, peer_stamp: int = 0, sent: int = 0, robot_id: int = 1
    ) -> None:
        self._library = library
        self._board = ctypes.create_string_buffer(library.library_board_bytes())
        self._outputs, self._state = (ctypes.c_uint16 * CHANNELS)(), (ctypes.c_uint32 * 4)()
        self._bytes = ctypes.create_string_buffer(OUTBOX_BYTES)
        library.library_begin(self._board, robot_id, None if key is None else key.secret, peer_stamp, sent)

    def start(self, start: BoardStart) -> None:
        """Have this life begin so."""
        zeros = start.zeros or Zeros(0.0)
        has_zeros, surface_hpa, bias = start.zeros is not None, zeros.surface_hpa, zeros.gyro_bias_radps
        self._library.library_start(self._board, start.causes, start.is_power_on, has_zeros, surface_hpa, bias)

    def receive(self, data: bytes, now_ns: int) -> bool:
        """True if a frame was taken."""
        return bool(self._library.library_receive(self._board, data, len(data), now_ns // 1000))

    def measures(self, now_ns: int) -> bool:
        """True if the step to this instant reads the sensors."""
        return bool(self._library.board_measures(self._board, now_ns // 1000))

    def step(self, now_ns: int, reading: Reading = REST, battery_v: float = 12.0) -> bytes:
        """A step, with a reading if it measures. Returns the bytes to send."""
        sample = ctypes.byref(CReading.of(reading, battery_v)) if self.measures(now_ns) else None
        self._library.library_step(self._board, now_ns // 1000, sample)
        count = self._library.library_take_output(self._board, self._bytes)
        return self._bytes.raw[:count]

    # --- the rules alone

    def override(self, sender: Peer, pulses_us: Sequence[int], now_ns: int) -> bool:
        """True if it was taken."""
        pulses = (ctypes.c_uint16 * CHANNELS)(*pulses_us)
        return bool(self._library.rules_override(self._board, CPeer(*sender), pulses, now_ns // 1000))

    def arm(self, wanted: bool, now_ns: int) -> int:
        return int(self._library.rules_arm(self._board, wanted, now_ns // 1000))

    def change(self, parameter: int, value: float) -> int:
        """0 if it was taken."""
        return int(self._library.rules_change(self._board, parameter, value))

    def value(self, name: str) -> float:
        """A parameter's present value."""
        return float(self._library.library_parameter(self._board, PARAMETERS.index[name]))

    def take_key(self) -> bool:
        return bool(self._library.rules_take_key(self._board))

    def battery(self, voltage_v: float, elapsed_s: float) -> None:
        self._library.rules_battery(self._board, voltage_v, elapsed_s)

    def step_rules(self, now_ns: int) -> None:
        self._library.rules_step(self._board, now_ns // 1000)

    def texts(self) -> list[tuple[int, str]]:
        """Severity and words of what the rules have said since the last call."""
        count = self._library.library_take_texts(self._board, self._bytes)
        return [(text[0], text[1:].decode("ascii")) for text in self._bytes.raw[:count].split(b"\0")[:-1]]

    # --- its state

    def state(self) -> tuple[bool, int, int, int]:
        """Armed, charge level, overrides refused, frames that found no room to be sent."""
        self._library.library_state(self._board, self._outputs, self._state)
        armed, charge, refused, unsent = self._state
        return bool(armed), charge, refused, unsent

    @property
    def armed(self) -> bool:
        return self.state()[0]

    @property
    def pulses(self) -> tuple[int, ...]:
        """Pulses on the outputs, us."""
        self.state()
        return tuple(self._outputs)
