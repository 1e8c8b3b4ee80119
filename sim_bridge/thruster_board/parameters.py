"""The parameters of a thruster board: their table, bounds, and relations. Pure.

On the wire every one is a MAV_PARAM_TYPE_REAL32, whole numbers too: MAVLink has two ways to send an integer, and clients
disagree on which. So a value is single precision from the start.
"""

import math
import struct
from collections.abc import Mapping
from dataclasses import dataclass, replace
from enum import Enum
from functools import cached_property
from itertools import pairwise

from shoal.config.experiment import Experiment
from shoal.config.simulation import HIL
from shoal.mavlink.agent_link import PULSE_RANGE_US

TRIM_US = 100.0  # us, largest trim; a larger one hides a fault of the linkage
MOST_VOLTS = 60.0


@dataclass(frozen=True)
class Parameter:
    """One row of the table: at most 16 characters of name, and the range of its value."""

    name: str
    low: float
    high: float
    whole: bool
    meaning: str

    @property
    def bounds(self) -> str:
        """The range as text."""
        return f"{self.low:g} to {self.high:g}{', whole' if self.whole else ''}"

    def takes(self, value: float) -> bool:
        """True if a value is in range; NaN never is."""
        return self.low <= value <= self.high and (not self.whole or value == int(value))


def _us(name: str, meaning: str, low: float = PULSE_RANGE_US[0], high: float = PULSE_RANGE_US[1]) -> Parameter:
    """A whole number of microseconds, by default within the range of pulses."""
    return Parameter(name, low, high, True, meaning)


FIXED = (
    Parameter("CMD_AGE_MS", 50, 300, True, "age of the last override at which the board disarms itself, ms"),
    Parameter("SLEW_US_S", 100, 100_000, False, "how fast a thruster's pulse may move, us/s"),
    Parameter("THR_COUNT", 4, 8, True, "first outputs, which are thrusters', no fewer than the vehicle has; then ankles'"),
    _us("THR_NEUTRAL_US", "pulse at which a thruster stands still; in the dead zone, and in that as built"),
    _us("THR_MIN_US", "lowest pulse taken for a thruster; within the curve"),
    _us("THR_MAX_US", "highest pulse taken for a thruster; within the curve"),
    _us("ANK_MIN_US", "lowest pulse taken for an ankle"),
    _us("ANK_MAX_US", "highest pulse taken for an ankle"),
    *(_us(f"THR{i}_TRIM_US", f"added to output {i}, within its limits; neutral stays in the dead zone", -TRIM_US, TRIM_US)
      for i in (1, 2, 3, 4)),
    *(_us(f"ANK{i}_TRIM_US", f"added to output {i + 4}, within its limits", -TRIM_US, TRIM_US) for i in (1, 2, 3, 4)),
    Parameter("BAT_WARN_V", 0, MOST_VOLTS, False, "battery: warn below, V"),
    Parameter("BAT_NOARM_V", 0, MOST_VOLTS, False, "battery: do not arm below, V; under BAT_WARN_V"),
    Parameter("BAT_NEUTRAL_V", 0, MOST_VOLTS, False, "battery: disarm below, V; under BAT_NOARM_V"),
    Parameter("BAT_HYST_V", 0, 5, False, "battery: how far above its threshold a level is left, V"),
    Parameter("HIL_MODE", 0, 1, True, "1: measurements are the simulator's; not kept without power"),
    Parameter("HIL_OUTPUTS", 0, 1, True, "1: pins follow in HIL mode too, only with HIL_MODE = 1; not kept without power"),
)  # fmt: skip
VOLATILE = HIL  # 0 at power-on, whatever was set


def _curve(points: int) -> tuple[Parameter, ...]:
    """The rows of a thrust curve; it rises, strictly in us."""
    rows = []
    for i in range(1, points + 1):
        rows.append(_us(f"CRV{i:02}_US", f"thrust curve, point {i}: pulse"))
        rows.append(Parameter(f"CRV{i:02}_N", -1000, 1000, False, f"thrust curve, point {i}: thrust, N"))
    return tuple(rows)


def _curve_points(values: tuple[float, ...]) -> tuple[tuple[float, float], ...]:
    flat = values[len(FIXED) :]
    return tuple(zip(flat[::2], flat[1::2], strict=True))


def _dead_zone_us(values: tuple[float, ...]) -> tuple[float, float]:
    still = [us for us, force in _curve_points(values) if force == 0.0]
    return (min(still), max(still)) if still else (math.inf, -math.inf)


class Refusal(Enum):
    """Reason for refusing a parameter: MAV_PARAM_ERROR, and text."""

    UNKNOWN = (1, "no such parameter")
    RANGE = (2, "out of range")
    TYPE = (2, "not a REAL32")
    INCONSISTENT = (2, "does not fit the others")
    ARMED = (3, "armed")

    def __init__(self, code: int, words: str) -> None:
        self.code, self.words = code, words


def single(value: float) -> float:
    """The nearest number of single precision; infinite for one that has none."""
    try:
        rounded: float = struct.unpack("<f", struct.pack("<f", value))[0]
    except OverflowError:
        return math.copysign(math.inf, value)
    return rounded


@dataclass(frozen=True)
class Parameters:
    """A board's parameters, consistent with one another."""

    table: tuple[Parameter, ...]
    values: tuple[float, ...]
    built: tuple[float, ...]  # those of the vehicle for which the firmware was built

    @classmethod
    def of(cls, experiment: Experiment) -> "Parameters":
        """The parameters of the experiment's vehicle and board."""
        values = experiment.sim.board.parameters(experiment.vehicle)
        fixed = (replace(row, low=values[row.name]) if row.name == "THR_COUNT" else row for row in FIXED)
        table = (*fixed, *_curve(len(experiment.vehicle.thruster.curve)))
        built = tuple(single(values[row.name]) for row in table)
        return cls(table, built, built)

    def changed(self, name: str, value: float) -> "Parameters | Refusal":
        """The parameters with one value changed, or the refusal."""
        index = self.index.get(name)
        if index is None:
            return Refusal.UNKNOWN
        if not self.table[index].takes(value):
            return Refusal.RANGE
        new = replace(self, values=(*self.values[:index], single(value), *self.values[index + 1 :]))
        return new if new.is_consistent() else Refusal.INCONSISTENT

    def restored(self, values: Mapping[str, float]) -> "Parameters":
        """The parameters with stored values, if together they are acceptable; those of an older table may be missing."""
        kept = {name: value for name, value in values.items() if name not in VOLATILE}
        new = replace(self, values=tuple(single(kept.get(row.name, self[row.name])) for row in self.table))
        return new if all(row.takes(new[row.name]) for row in self.table) and new.is_consistent() else self

    def is_consistent(self) -> bool:
        """True if the values fit one another."""
        curve_us, curve_n = zip(*self.curve, strict=True)
        lowest_us, highest_us = self.thruster_us
        least_ankle_us, most_ankle_us = self.ankle_us
        return (
            all(before < after for before, after in pairwise(curve_us))
            and all(before <= after for before, after in pairwise(curve_n))
            and curve_n[0] < 0.0 < curve_n[-1]
            and curve_us[0] <= lowest_us < self.neutral_us < highest_us <= curve_us[-1]
            and self._has_safe_neutral()
            and self["BAT_WARN_V"] > self["BAT_NOARM_V"] > self["BAT_NEUTRAL_V"]
            and least_ankle_us < most_ankle_us
            and self["HIL_OUTPUTS"] <= self["HIL_MODE"]
        )

    def _has_safe_neutral(self) -> bool:
        """True if no thruster of the vehicle for which the firmware was built pushes at neutral, by the present curve and by
        that vehicle's own: a wrong curve must not make a disarmed board push. (A count below the vehicle's, which would have a
        thruster hold its thrust, is out of range.)"""
        trims_us = (0.0, *self.trims_us[: self.thrusters])
        zones = self.dead_zone_us, _dead_zone_us(self.built)
        return all(low <= self.neutral_us + trim <= high for trim in trims_us for low, high in zones)

    @cached_property
    def index(self) -> Mapping[str, int]:
        """Position of each name in the table."""
        return {row.name: i for i, row in enumerate(self.table)}

    def __getitem__(self, name: str) -> float:
        return self.values[self.index[name]]

    @cached_property
    def curve(self) -> tuple[tuple[float, float], ...]:
        """Points of the thrust curve, (us, N)."""
        return _curve_points(self.values)

    @cached_property
    def dead_zone_us(self) -> tuple[float, float]:
        """Lowest and highest pulse at which the curve is 0 N; an empty range if it never is."""
        return _dead_zone_us(self.values)

    @cached_property
    def thrusters(self) -> int:
        """Number of the outputs, from the first on, that are thrusters'."""
        return int(self["THR_COUNT"])

    @property
    def neutral_us(self) -> float:
        """Pulse at which a thruster stands still."""
        return self["THR_NEUTRAL_US"]

    @cached_property
    def thruster_us(self) -> tuple[float, float]:
        """Range of pulses taken for a thruster."""
        return self["THR_MIN_US"], self["THR_MAX_US"]

    @cached_property
    def ankle_us(self) -> tuple[float, float]:
        """Range of pulses taken for an ankle."""
        return self["ANK_MIN_US"], self["ANK_MAX_US"]

    @cached_property
    def age_ns(self) -> int:
        """Age of the last override at which the board disarms."""
        return int(self["CMD_AGE_MS"]) * 1_000_000

    @cached_property
    def hil(self) -> bool:
        """True in HIL mode: measurements are the simulator's."""
        return self["HIL_MODE"] == 1.0

    @cached_property
    def pins_held(self) -> bool:
        """True if the pins stay at neutral, whatever the outputs are."""
        return self.hil and self["HIL_OUTPUTS"] == 0.0

    @cached_property
    def trims_us(self) -> tuple[float, ...]:
        """Offsets added to the 8 outputs."""
        first = self.index["THR1_TRIM_US"]
        return self.values[first : first + 8]

    @cached_property
    def thresholds_v(self) -> tuple[float, float, float]:
        """Battery voltages below which it warns, does not arm, disarms."""
        return self["BAT_WARN_V"], self["BAT_NOARM_V"], self["BAT_NEUTRAL_V"]
