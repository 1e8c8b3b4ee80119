"""The result of `sim-bridge compare`: flights of several variants of an experiment on the same seeds, as JSON.

Distances in m against the plant's truth; "after 20 s" leaves out the first 20 s; "wanted" is what a law came to before its
magnitude and rate were limited. Changes of inputs are told as shares of the largest that is allowed.
"""

import dataclasses
import json
from dataclasses import dataclass

SETTLED_S = 20.0


def settled(flown_s: float) -> bool:
    """True if a flight of that length has a part after SETTLED_S. Shorter flights are not judged by that part."""
    return flown_s > SETTLED_S


@dataclass(frozen=True)
class FlightMetrics:
    """The metrics of one flight."""

    rms_m: float  # distance from the reference, over all robots and the whole run
    rms_after_20s_m: float
    max_after_20s_m: float
    rms_yaw_rad: float  # to the path's tangent, whole run
    rms_yaw_after_20s_rad: float
    formation_rms_m: float  # of the pairs' offsets, whole run; 0 for one robot
    formation_after_20s_m: float
    min_separation_m: float | None  # of the two closest; None for one robot
    input_step_rms: float  # of what was applied, of the axis and robot where it is largest
    wanted_too_large: float  # share of control steps
    wanted_too_fast: float
    wanted_beyond: float  # either
    wanted_most: float  # largest wanted, in limits
    under_way: float  # share of control steps in which the robots tracked: 1, or something failed


@dataclass(frozen=True)
class Traces:
    """A flight to look at. Lists are over time; `wanted` and `applied` per robot and for its surge only, from the start."""

    error_period_s: float
    error_m: list[float]  # RMS over the robots
    input_period_s: float
    wanted_n: list[list[float]]
    applied_n: list[list[float]]


@dataclass(frozen=True)
class FlightRecord:
    """One variant on one seed."""

    seed: int
    figures: FlightMetrics
    traces: Traces | None = None  # of the first seed


@dataclass(frozen=True)
class Variant:
    """One variant of the experiment: its changed settings and its flights."""

    name: str
    settings: list[str]
    flights: list[FlightRecord]


@dataclass(frozen=True)
class Comparison:
    """The content of comparison.json."""

    scene: str
    title: str
    duration_s: float
    scatter: float  # starts are moved by up to this much, m and rad
    settings: list[str]  # of all variants
    surge_limit_n: float
    robots: list[int]
    variants: list[Variant]
    separation_m: float = 0.0  # the least that robots may come to one another; 0: not told, in older files
    commit: str = ""  # of the code that flew; empty: not told, in older files

    def to_json(self) -> str:
        """The content of comparison.json."""
        return json.dumps(dataclasses.asdict(self), indent=1, allow_nan=False) + "\n"

    @classmethod
    def from_json(cls, text: str) -> "Comparison":
        """Raises KeyError, TypeError or ValueError for what is no comparison."""
        table = json.loads(text)
        variants = [
            Variant(v["name"], v["settings"], [_flight(flight) for flight in v["flights"]]) for v in table.pop("variants")
        ]
        return cls(variants=variants, **table)


def _flight(table: dict[str, object]) -> FlightRecord:
    figures, traces = table["figures"], table["traces"]
    if not isinstance(figures, dict) or not isinstance(traces, dict | None):
        raise TypeError("figures and traces must be objects")
    return FlightRecord(int(str(table["seed"])), FlightMetrics(**figures), Traces(**traces) if traces is not None else None)
