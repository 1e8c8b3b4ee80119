"""Zeros of a board's sensors, and how its present life began: docs/board.md, "After a reset". Pure.

Surface pressure and gyro bias survive every reset except a power-on in air. In air is where the pressure is at most `AIR_HPA`
above the kept surface pressure.
"""

import math
from dataclasses import dataclass
from enum import Enum, IntFlag

SURFACE_SAMPLES, STILL_SAMPLES = 8, 64
MOVES_RADPS = 0.0625  # two rates of a robot at rest are less apart: the noise is 0.001
AIR_HPA = 10.0  # 0.1 m of water; the air's own pressure rarely rises by more between two days
AIR_MOST_HPA = 46.75  # without a kept surface pressure: 1060 hPa, more than the air ever has


class ResetCause(IntFlag):
    """Causes of a reset, as an ATmega's MCUSR has them; 0: unknown, a bootloader has cleared them."""

    POWER_ON = 0x01
    PIN = 0x02
    BROWN_OUT = 0x04
    WATCHDOG = 0x08


RESTARTED, ZERO_IN_QUESTION = 0x100, 0x200  # with the causes in HEARTBEAT's custom_mode
CAUSE_NAMES = {
    ResetCause.WATCHDOG: "watchdog",
    ResetCause.BROWN_OUT: "brown-out",
    ResetCause.PIN: "reset pin",
    ResetCause.POWER_ON: "power-on",
}  # the first that applies names a restart


@dataclass(frozen=True)
class Zeros:
    """Zeros of the sensors, which a board keeps without power."""

    surface_hpa: float  # above 1013.25 hPa
    gyro_bias_radps: float = 0.0


@dataclass(frozen=True)
class BoardStart:
    """Begin of a life of a board: its causes, and the zeros kept from before."""

    causes: int = int(ResetCause.POWER_ON)
    is_power_on: bool = True  # no RAM outlived it
    zeros: Zeros | None = None  # that were kept

    @property
    def cause_name(self) -> str:
        """Name of the cause."""
        return next((name for cause, name in CAUSE_NAMES.items() if self.causes & cause), "unknown cause")


class ZeroEvent(Enum):
    """Change of the zeros by a measurement."""

    SAME = 0  # none
    TAKEN = 1  # new surface pressure
    QUESTIONED = 2  # the kept surface pressure may be wrong
    BIAS_TAKEN = 3  # new gyro bias
    MISSED = 4  # a person's new surface pressure could not be measured


class _Purpose(Enum):
    """Use of the pressures that come."""

    JUDGE = 0  # after a start: is the kept surface pressure still right?
    TAKE = 1  # a person asked for a new surface pressure
    DONE = 2  # none: the surface pressure stays


class SensorZero:
    """Surface pressure and gyro bias of one life of a board. Pressures are those above 1013.25 hPa."""

    def __init__(self, start: BoardStart) -> None:
        self.start = start
        self.surface_hpa = None if start.zeros is None else start.zeros.surface_hpa
        self.gyro_bias_radps = 0.0 if start.zeros is None else start.zeros.gyro_bias_radps
        self.is_restarted = not start.is_power_on
        self.is_in_question = True  # until the pressure is known
        self._has_pressure = False
        self._purpose, self._pressures = _Purpose.JUDGE, list[float]()
        self._rates: list[float] | None = None  # while the bias is taken

    @classmethod
    def settled(cls) -> "SensorZero":
        """Zeros of a board that was switched on in air some time ago: what its sensors measure is right."""
        zero = cls(BoardStart())
        for _ in range(STILL_SAMPLES):
            zero.take_pressure(0.0)
            zero.take_rate(0.0)
        return zero

    @property
    def kept(self) -> Zeros | None:
        """The zeros to keep without power."""
        return None if self.surface_hpa is None else Zeros(self.surface_hpa, self.gyro_bias_radps)

    @property
    def status(self) -> int:
        """HEARTBEAT's custom_mode."""
        restarted = RESTARTED if self.is_restarted else 0
        return self.start.causes | restarted | (ZERO_IN_QUESTION if self.is_in_question else 0)

    def take_pressure(self, pressure_hpa: float) -> ZeroEvent:
        """Take in a pressure. The mean of the first SURFACE_SAMPLES decides once: it becomes the new surface pressure after a
        power-on in air (the gyro's bias is then measured too) and when a person asked for it; after any other start the kept
        surface pressure stays, and is in question where the mean is far from it."""
        self._has_pressure = math.isfinite(pressure_hpa)
        if not self._has_pressure and self._purpose is _Purpose.TAKE:
            self._purpose = _Purpose.DONE
            return ZeroEvent.MISSED
        if self._purpose is _Purpose.DONE or not self._has_pressure:
            return ZeroEvent.SAME
        self._pressures.append(pressure_hpa)
        if len(self._pressures) < SURFACE_SAMPLES:
            return ZeroEvent.SAME
        mean_hpa = sum(self._pressures) / SURFACE_SAMPLES
        is_start = self._purpose is _Purpose.JUDGE
        self._purpose = _Purpose.DONE
        if is_start:
            if not (self.start.is_power_on and self._is_in_air(mean_hpa)):
                self.is_restarted = True
                self.is_in_question = self.surface_hpa is None or abs(mean_hpa - self.surface_hpa) > AIR_HPA
                return ZeroEvent.QUESTIONED if self.is_in_question else ZeroEvent.SAME
            self._rates = []
        self.surface_hpa = mean_hpa
        self.is_in_question = False
        return ZeroEvent.TAKEN

    def _is_in_air(self, pressure_hpa: float) -> bool:
        return pressure_hpa <= (AIR_MOST_HPA if self.surface_hpa is None else self.surface_hpa + AIR_HPA)

    def take_rate(self, rate_radps: float) -> ZeroEvent:
        """Take in a yaw rate of the gyro. The mean of STILL_SAMPLES in a row that differ little becomes its bias."""
        if self._rates is None or not math.isfinite(rate_radps):
            return ZeroEvent.SAME
        if self._rates and abs(rate_radps - self._rates[0]) > MOVES_RADPS:
            self._rates.clear()
        self._rates.append(rate_radps)
        if len(self._rates) < STILL_SAMPLES:
            return ZeroEvent.SAME
        self.gyro_bias_radps, self._rates = sum(self._rates) / STILL_SAMPLES, None
        return ZeroEvent.BIAS_TAKEN

    def leave_bias(self) -> None:
        """Keep the gyro's bias as it is, for the robot no longer lies still."""
        self._rates = None

    def calibrate(self, pressure: bool, gyro: bool) -> bool:
        """Carry out a person's request. With `pressure` or `gyro` that zero is measured anew, from the samples that come now;
        with neither the kept zeros are confirmed. Returns False for a request that is refused."""
        if pressure and not self._has_pressure:  # samples that come later may be those of water
            return False
        if gyro:
            self._rates = []
        if pressure:
            self._purpose, self._pressures = _Purpose.TAKE, []
        if pressure or gyro:
            return True
        if self.surface_hpa is None:  # nothing to confirm
            return False
        self._purpose, self.is_in_question = _Purpose.DONE, False
        return True
