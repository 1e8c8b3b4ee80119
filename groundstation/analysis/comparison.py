"""The result of `sim-bridge compare`: flights of several variants of an experiment on the same seeds, as JSON. Pure.

Errors here are against the trajectory by the clock, whatever a robot's own clock says: a law that gives up stays wrong.

Distances in m against the plant's truth; "after 20 s" leaves out the first 20 s; "wanted" is what a law came to before its
magnitude and rate were limited. Changes of inputs are shares of the largest that is allowed.
"""

import dataclasses
import json
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from itertools import combinations

import numpy as np

from shoal.config.experiment import Experiment
from shoal.frames import Array, pose_error
from shoal.messages.messages import Mode, RobotState

SETTLED_S = 20.0
ERROR_STRIDE = 10  # of control steps, in a plot's trace
SHOWN_S = 20.0  # of the inputs, in a plot's trace


def settled(flown_s: float) -> bool:
    """True if a flight of that length has a part after SETTLED_S. Shorter flights are not judged by that part."""
    return flown_s > SETTLED_S


@dataclass(frozen=True)
class FlightMetrics:
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
class StepTimes:
    """Processor time of the control steps of a flight, in µs: estimate, plan and allocation."""

    median: float
    p99: float
    most: float


@dataclass(frozen=True)
class FlightRecord:
    """One variant on one seed."""

    seed: int
    figures: FlightMetrics
    traces: Traces | None = None  # of the first seed
    step_us: StepTimes | None = field(default=None, compare=False)  # the machine's, so no two flights have the same


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
    separation_m: float  # the least that robots may come to one another
    commit: str  # of the code that flew

    def to_json(self) -> str:
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
    """A flight's record from its JSON object. Raises TypeError for one of another shape."""
    figures, traces, step_us = table["figures"], table["traces"], table.get("step_us")
    if not isinstance(figures, dict) or not isinstance(traces, dict | None) or not isinstance(step_us, dict | None):
        raise TypeError("figures, traces and step_us must be objects")
    return FlightRecord(
        int(str(table["seed"])),
        FlightMetrics(**figures),
        Traces(**traces) if traces is not None else None,
        StepTimes(**step_us) if step_us is not None else None,
    )


def step_times(states: Iterable[Sequence[RobotState]]) -> StepTimes | None:
    """Times of all robots' control steps; None where none was measured."""
    took_us = np.array([state.timing.step_us for each in states for state in each])
    took_us = took_us[took_us > 0.0]
    if not len(took_us):
        return None
    median, p99 = np.quantile(took_us, [0.5, 0.99]).tolist()
    return StepTimes(median, p99, float(took_us.max()))


def flight_figures(experiment: Experiment, states: list[list[RobotState]], truth: Array, error: Array) -> FlightMetrics:
    """A comparison's figures of a flight. `truth` and `error` (steps, n, 4); `states` per robot and step."""
    limits, first = experiment.vehicle.limits, round(SETTLED_S / experiment.controller.period_s)
    distance = np.linalg.norm(error[:, :, :3], axis=2)
    formation, separation = _pairs(truth, error)
    axes = len(limits.wrench)
    wanted = wrenches(states, "wrench_wanted", axes) / np.array(limits.wrench)
    quick = np.diff(wanted, axis=1) * np.array(limits.wrench) / experiment.wrench_step
    large = (np.abs(wanted) > 1.0 + 1e-9).any(axis=2)[:, 1:]
    fast = (np.abs(quick) > 1.0 + 1e-9).any(axis=2)
    steps = wrenches(states, "wrench_step", axes) / experiment.wrench_step
    return FlightMetrics(
        rms_m=_rms_all(distance),
        rms_after_20s_m=_rms_all(distance[first:]),
        max_after_20s_m=float(distance[first:].max()),
        rms_yaw_rad=_rms_all(error[:, :, 3]),
        rms_yaw_after_20s_rad=_rms_all(error[first:, :, 3]),
        formation_rms_m=_rms_all(formation),
        formation_after_20s_m=_rms_all(formation[first:]),
        min_separation_m=separation,
        input_step_rms=float(np.sqrt(np.mean(steps**2, axis=1)).max()),
        wanted_too_large=float(large.mean()),
        wanted_too_fast=float(fast.mean()),
        wanted_beyond=float((large | fast).mean()),
        wanted_most=float(np.abs(wanted).max()),
        under_way=float(np.mean([[state.mode is Mode.TRACKING for state in each] for each in states])),
    )


def _pairs(truth: Array, error: Array) -> tuple[Array, float | None]:
    """Formation errors (steps, pairs) in m, and the least distance of two robots."""
    pairs = list(combinations(range(error.shape[1]), 2))
    if not pairs:
        return np.zeros((len(error), 1)), None
    apart = [np.linalg.norm(pose_error(error[:, a], error[:, b])[:, :3], axis=1) for a, b in pairs]
    return np.array(apart).T, min(float(np.linalg.norm((truth[:, a] - truth[:, b])[:, :3], axis=1).min()) for a, b in pairs)


def flight_traces(period_s: float, states: list[list[RobotState]], error: Array) -> Traces:
    """Error and inputs over time, for a comparison's plots."""
    shown = round(SHOWN_S / period_s)
    root = np.sqrt(np.mean(np.sum(error[::ERROR_STRIDE, :, :3] ** 2, axis=2), axis=1))
    return Traces(
        error_period_s=round(ERROR_STRIDE * period_s, 9),
        error_m=[round(value, 6) for value in root.tolist()],
        input_period_s=round(period_s, 9),
        wanted_n=np.round(wrenches(states, "wrench_wanted", 1)[:, :shown, 0], 4).tolist(),
        applied_n=np.round(wrenches(states, "wrench", 1)[:, :shown, 0], 4).tolist(),
    )


def wrenches(states: list[list[RobotState]], key: str, axes: int) -> Array:
    """The first axes of a wrench in all states, (n, steps, axes). 0 for a robot that has given up: it wants and gives none."""
    rows = np.zeros((len(states), len(states[0]), axes))
    for i, each in enumerate(states):
        for k, state in enumerate(each):
            if state.control is not None:
                rows[i, k] = getattr(state.control, key)[:axes]
    return rows


def _rms_all(values: Array) -> float:
    return float(np.sqrt(np.mean(values**2)))
