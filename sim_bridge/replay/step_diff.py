"""Comparison of a robot's recorded steps with the same steps done again, field by field. Pure; step_replay.py does the
steps."""

import dataclasses
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from enum import IntEnum
from typing import Any, get_type_hints

import numpy as np
from matplotlib.figure import Figure

from groundstation.formation_clock import FormationPlans
from groundstation.palette import COLOURS
from groundstation.report.drawing import Curve, Panel, TimePlot
from groundstation.report.plotting import picture
from shoal.frames import Array, wrap_angle
from shoal.messages import topics
from shoal.messages.codec import decode
from shoal.messages.messages import Event, Plan, RobotState
from shoal.messages.schema import nested_message
from shoal.messages.topics import Topic

# Measured by the robot's program, not computed by its agent: no step can repeat them.
TIMES = ("step_us", "exposure_to_pwm_ms", "missed_deadlines", "board_round_trip_ms", "board_clock_offset_s")
MEASURED = frozenset({"code", *(f"timing.{name}" for name in TIMES)})
EXPERIMENT_HASH = frozenset({"experiment_hash"})  # differs with any other experiment
ANGLES = {"estimate.eta": 3, "control.eta_reference": 3, "control.eta_command": 3}  # columns that are angles
MOST_GAPS = 5  # listed one by one
DRAWN = ("control.wrench", "control.eta_command", "estimate.nu", "estimate.disturbance")


@dataclass(frozen=True)
class Difference:
    """One field of the states or plans: in how many steps it differs, and by how much. The figures are None where it is no
    number."""

    field: str
    steps: int
    first_s: float  # since the start of the trajectory
    largest: float | None
    rms: float | None  # over all steps compared


@dataclass(frozen=True, eq=False)
class StepComparison:
    """Comparison of one robot's recorded steps with the same steps done again."""

    robot: int
    steps: int  # done again
    compared: int  # with a state in the log
    differing: int  # steps in which anything differs, to the last bit
    differences: tuple[Difference, ...]
    left_out: tuple[str, ...]  # what the log does not hold
    time_s: Array  # (compared,) since the start of the trajectory
    before: dict[str, Array]  # per field (compared, columns), as it was
    after: dict[str, Array]  # and as it would have been

    @property
    def exact(self) -> bool:
        """The log holds every step and all that it names, and each is the same to the last bit."""
        return self.compared > 0 and self.compared == self.steps and not self.differing and not self.left_out

    def as_dict(self) -> dict[str, Any]:
        """The comparison as JSON has it."""
        plain = ("robot", "steps", "compared", "differing", "left_out")
        summary = {name: getattr(self, name) for name in plain}
        return summary | {"exact": self.exact, "differences": [dataclasses.asdict(d) for d in self.differences]}


@dataclass
class StepOutputs:
    """A robot's states and plans by their stamps, as encoded, and events about steps that could not be repeated."""

    states: dict[int, bytes] = field(default_factory=dict)
    plans: dict[int, bytes] = field(default_factory=dict)
    gaps: list[str] = field(default_factory=list)

    def add(self, topic: Topic, stamp_ns: int, payload: bytes) -> None:
        """Take in one message."""
        if topic is topics.EVENT:
            self.gaps.append(decode(Event, payload, "rerun", topic.name).message)
        else:
            (self.states if topic is topics.STATE else self.plans)[stamp_ns] = payload


def compare(robot: int, before: StepOutputs, after: StepOutputs, same_experiment: bool) -> StepComparison:
    """Compare the recorded outputs `before` with the repeated ones `after`, at the stamps that both have.

    `same_experiment` is False for a rerun with changed settings: its hash then differs on purpose, and is not compared.
    """
    stamps = sorted(before.states.keys() & after.states.keys())
    recorded = [decode(RobotState, before.states[stamp], "log", "state") for stamp in stamps]
    repeated = [decode(RobotState, after.states[stamp], "rerun", "state") for stamp in stamps]
    time_s: Array = (np.array(stamps, dtype=np.int64) - _start_ns(stamps, recorded)).astype(np.float64) * 1e-9
    # A robot with an estimate has sent a plan: where the log has none, it was lost on the way to the recorder.
    lost_plans = [
        stamp
        for stamp, state in zip(stamps, recorded, strict=True)
        if state.estimate is not None and stamp not in before.plans
    ]
    lost_at_s = time_s[np.isin(stamps, lost_plans)].tolist()
    unlogged = [f"the plan of robot {robot} at {s:.2f} s is not in the log" for s in lost_at_s]
    if missing := len(after.states) - len(stamps):
        unlogged.append(f"{missing} states of robot {robot} are not in the log: it had no radio, or they were lost")
    ignored = MEASURED if same_experiment else MEASURED | EXPERIMENT_HASH
    names = [name for name in _paths(RobotState) if name not in ignored]
    columns = {name: ([_value(s, name) for s in recorded], [_value(s, name) for s in repeated]) for name in names}
    columns |= _plan_columns(before, after, stamps, frozenset(lost_plans))
    any_differs, differences = np.zeros(len(stamps), dtype=bool), []
    for name, (old, new) in columns.items():
        differs = np.array([not _same(a, b) for a, b in zip(old, new, strict=True)], dtype=bool)
        if differs.any():
            differences.append(_difference(name, old, new, differs, time_s))
        any_differs |= differs
    return StepComparison(
        robot=robot,
        steps=len(after.states),
        compared=len(stamps),
        differing=int(any_differs.sum()),
        differences=tuple(differences),
        left_out=_shortened([*after.gaps, *unlogged]),
        time_s=time_s,
        before={name: _rows(columns[name][0]) for name in DRAWN},
        after={name: _rows(columns[name][1]) for name in DRAWN},
    )


def draw(again: StepComparison) -> Figure | None:
    """Draw recorded and repeated outputs over time."""

    def lines(name: str, column: int) -> list[Curve]:
        old, new = again.before[name][:, column], again.after[name][:, column]
        return [
            Curve("as it was", again.time_s, old, COLOURS[0]),
            Curve("rerun", again.time_s, new, COLOURS[1], "--"),
        ]

    panels = [
        Panel("surge [N]", lines("control.wrench", 0)),
        Panel("heave [N]", lines("control.wrench", 1)),
        Panel("yaw [N m]", lines("control.wrench", 2)),
        *([Panel("sway [N]", lines("control.wrench", 3))] if again.before["control.wrench"].shape[1] > 3 else []),
        Panel("heading command [rad]", lines("control.eta_command", 3)),
        Panel("surge est. [m/s]", lines("estimate.nu", 0)),
        Panel("disturbance, surge [m/s²]", lines("estimate.disturbance", 0)),
    ]
    return picture(TimePlot(panels)) if len(again.time_s) else None


def _paths(cls: Any, above: str = "") -> Iterator[str]:
    """The fields of a message and of the messages within it: `mode`, `estimate.eta`."""
    hints = get_type_hints(cls)
    for f in dataclasses.fields(cls):
        nested = nested_message(hints[f.name])
        yield from [above + f.name] if nested is None else _paths(nested, f"{above}{f.name}.")


def _value(message: Any, path: str) -> Any:
    """A field by its path; None in a message that has no such part."""
    for name in path.split("."):
        message = None if message is None else getattr(message, name)
    return message


def _start_ns(stamps: Sequence[int], states: Sequence[RobotState]) -> int:
    """Instant at which the formation's trajectory began; if it never did, of the first step."""
    clocks_s = (FormationPlans().clock_s(state) or 0.0 for state in states)
    begins_ns = (ns - round(clock_s * 1e9) for ns, clock_s in zip(stamps, clocks_s, strict=True) if clock_s > 0.0)
    return next(begins_ns, min(stamps, default=0))


def _plan_columns(
    before: StepOutputs, after: StepOutputs, stamps: Sequence[int], lost: frozenset[int]
) -> dict[str, tuple[list[Any], list[Any]]]:
    """By field of a plan: its values at each step, recorded and repeated. None on both sides where the log has `lost` the
    plan, which is no difference; None where there was no plan."""

    def read(outputs: StepOutputs) -> list[Plan | None]:
        payloads = (None if stamp in lost else outputs.plans.get(stamp) for stamp in stamps)
        return [None if payload is None else decode(Plan, payload, "log", "plan") for payload in payloads]

    old, new = read(before), read(after)
    names = [f.name for f in dataclasses.fields(Plan)]
    return {f"plan.{name}": ([getattr(p, name, None) for p in old], [getattr(p, name, None) for p in new]) for name in names}


def _same(one: Any, other: Any) -> bool:
    """Compare two values to the last bit."""
    if isinstance(one, np.ndarray) and isinstance(other, np.ndarray):
        return one.shape == other.shape and one.tobytes() == other.tobytes()
    return type(one) is type(other) and bool(one == other)


def _difference(name: str, old: Sequence[Any], new: Sequence[Any], differs: Array, time_s: Array) -> Difference:
    """Summarise how one field differs at the steps (steps,) where `differs`: first time, largest change, and RMS of the worst
    column. Changes are None for a field that is no number or changes its size."""
    steps, first_s = int(differs.sum()), float(time_s[np.flatnonzero(differs)[0]])
    old_rows, new_rows = list[Array](), list[Array]()
    for old_value, new_value in zip(old, new, strict=True):
        old_row, new_row = _row(old_value), _row(new_value)
        if old_row is not None and new_row is not None:  # a part of a state is not there at every step
            old_rows.append(old_row)
            new_rows.append(new_row)
    shapes = {row.shape for row in (*old_rows, *new_rows)}
    if len(shapes) != 1:
        return Difference(name, steps, first_s, None, None)
    change = np.array(new_rows) - np.array(old_rows)
    if name in ANGLES:
        change[:, ANGLES[name]] = wrap_angle(change[:, ANGLES[name]])
    rms = float(np.sqrt((change**2).mean(axis=0)).max())
    return Difference(name, steps, first_s, float(np.abs(change).max()), rms)


def _row(value: Any) -> Array | None:
    """A field as numbers (k,); None if it is no number, or none whose size says anything."""
    if isinstance(value, np.ndarray):
        return value.ravel()
    if isinstance(value, tuple) and value:
        return np.array(value, dtype=np.float64)
    if isinstance(value, float | int) and not isinstance(value, IntEnum | bool):
        return np.array([value], dtype=np.float64)
    return None


def _rows(values: Sequence[Array | None]) -> Array:
    """Values as rows; NaN where there is none."""
    width = max((len(value) for value in values if value is not None), default=4)
    return np.array([np.full(width, np.nan) if value is None else value for value in values]).reshape(-1, width)


def _shortened(gaps: Sequence[str]) -> tuple[str, ...]:
    """The first MOST_GAPS gaps, and the number of the others."""
    more = len(gaps) - MOST_GAPS
    return (*gaps[:MOST_GAPS], f"and {more} more") if more > 0 else tuple(gaps)
