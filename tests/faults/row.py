"""The definition of a row of the table of faults. table.py has the rows; rows_*.py the functions, one for each row. One call
is one injection: it gets a rig whose robots fly, breaks something at a random instant, measures, and mends it."""

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from shoal.messages.messages import Mode
from tests.faults.rig import Rig

Random = np.random.Generator
Sample = Mapping[str, float]

STEP_S = 0.1  # two control steps: what a limit "after 3 s" may be late
HELD = {Mode.HOLDING, Mode.FAULT, Mode.DISARMED}
OFF = {Mode.FAULT, Mode.DISARMED}
POWERED = {Mode.TRACKING, Mode.HOLDING}
RESUMED = "thrust again unasked"  # a measure of all rows whose robots must stay where they are
LEFT = "robots that left their path"  # of all rows whose robots must fly on


@dataclass(frozen=True)
class Measure:
    """A figure and its limit; `quantile` of the injections must keep it (1: the worst)."""

    limit: float
    unit: str = "s"
    quantile: float = 1.0


SECONDS = Measure  # reads well: {"neutral": SECONDS(0.35)}


def TIMES(limit: float = 0) -> Measure:
    """A limit on a count."""
    return Measure(limit, "times")


@dataclass(frozen=True)
class FaultRow:
    """One fault. `rig` names how the lab is set up; `inject` is one injection."""

    key: str
    how: str
    measures: Mapping[str, Measure]
    inject: Callable[[Any, Random], Sample]
    times: int = 100
    rig: str = "lab"


def resumed(rig: Rig, robots: tuple[int, ...], for_s: float) -> float:
    """The number of robots at neutral that thrust again though nobody asked."""
    time.sleep(for_s)
    return float(sum(rig.boards[r].thrusting for r in robots))


def left(rig: Rig, ns: int) -> float:
    """The number of robots that did anything but track since an instant."""
    return float(sum(any(h.state.mode is not Mode.TRACKING for h in rig.since(r, ns)) for r in rig.robots))
