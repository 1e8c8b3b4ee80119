"""SHELL: results of fault injections, as docs/evidence/faults.json and faults.md. A row that is flown again replaces its
older figures."""

import json
import os
import platform
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from tests.faults.row import LEFT, RESUMED, FaultRow, Sample

PAGE = Path(__file__).parents[2] / "docs" / "evidence" / "faults.md"
RESULTS = PAGE.with_suffix(".json")


NOT_MEASURED = "not measured"
MARKS = {RESUMED: "†", LEFT: "‡"}  # of what never happened in many rows


def machine() -> str:
    """This one, in a line."""
    names = [line.split(":", 1)[1].strip() for line in _cpuinfo() if line.startswith("model name")]
    cpu = names[0] if names else platform.processor() or platform.machine()
    return f"{cpu}, {os.cpu_count()} cores, {platform.system()}, Python {platform.python_version()}"


def _cpuinfo() -> list[str]:
    path = Path("/proc/cpuinfo")
    return path.read_text(encoding="utf-8").splitlines() if path.exists() else []


def verdict(kept: bool, times: int = 1) -> str:
    """In a word, after so many injections."""
    return ("kept" if kept else "NOT KEPT") if times else NOT_MEASURED


@dataclass(frozen=True)
class Figure:
    """One measure of a row."""

    times: int
    median: float
    worst: float
    judged: float  # the quantile that has a limit
    limit: float
    unit: str
    quantile: float

    @property
    def kept(self) -> bool:
        """True if the limit was kept. Without a measurement it was not."""
        return self.times > 0 and self.judged <= self.limit

    @property
    def shown(self) -> tuple[str, str, str, str]:
        """Injections, median, worst, limit."""
        if not self.times:
            return "0", "", "", ""
        digits = 0 if self.unit == "times" else 3
        limit = f"{self.limit:g} {self.unit}".strip() + (f" ({self.quantile:.0%})" if self.quantile < 1.0 else "")
        return str(self.times), f"{self.median:.{digits}f}", f"{self.worst:.{digits}f}", limit


@dataclass(frozen=True)
class RowOutcome:
    """All injections of a row."""

    key: str
    seed: int
    machine: str
    figures: Mapping[str, Figure]
    stuck: Sequence[str]
    wrong: int  # commands that boards took and should not have
    not_finite: int

    @classmethod
    def of(
        cls, row: FaultRow, samples: Sequence[Sample], seed: int, stuck: Sequence[str], wrong: int, not_finite: int
    ) -> "RowOutcome":
        """From what was measured."""
        figures = {}
        for name, measure in row.measures.items():
            values = np.array([sample[name] for sample in samples if name in sample])
            median, worst, judged = (
                (float(np.median(values)), float(values.max()), float(np.quantile(values, measure.quantile, method="higher")))
                if len(values)
                else (0.0, 0.0, 0.0)
            )
            figures[name] = Figure(len(values), median, worst, judged, measure.limit, measure.unit, measure.quantile)
        return cls(row.key, seed, machine(), figures, list(stuck), wrong, not_finite)

    @classmethod
    def from_json(cls, table: dict[str, Any]) -> "RowOutcome":
        """As `as_json` gave it."""
        return cls(**{**table, "figures": {name: Figure(**figure) for name, figure in table["figures"].items()}})

    def as_json(self) -> dict[str, Any]:
        """As a table of plain values."""
        return {**vars(self), "figures": {name: vars(figure) for name, figure in self.figures.items()}}

    @property
    def kept(self) -> bool:
        """True if every limit was kept."""
        return all(f.kept for f in self.figures.values()) and not self.stuck and not self.wrong and not self.not_finite


HEAD = """# Faults

Written by `make faults`, which injects every fault below into real processes at random instants and measures what the thruster
boards do. Each figure is the worst of N injections / its limit, from the fault on. A limit with a percentage holds for that
share of the injections. †: no robot had thrust again unasked. ‡: no robot left its path. faults.json has medians. One row
again: `make faults ARGS="--row {example} --times 5"`.

A user can inject the faults of [reference/faults.md](../reference/faults.md); the others need the tests' own tools.
Known gaps: [safety.md](../safety.md). Robots that are held fast, with a turned marker, or in too strong a current:
[robots.md](robots.md#traps).
"""


def write_page(path: Path, rows: Sequence[FaultRow]) -> None:
    """The page, from all results that there are."""
    kept = json.loads(RESULTS.read_text(encoding="utf-8")) if RESULTS.exists() else {}
    outcomes = {key: RowOutcome.from_json(table) for key, table in kept.items()}
    lines = [HEAD.format(example=rows[0].key)]
    lines += ["| Row | How | N | Worst / limit |", "|---|---|---|---|"]
    for row in rows:
        outcome = outcomes.get(row.key)
        times = max((figure.times for figure in outcome.figures.values()), default=0) if outcome else 0
        lines.append(f"| `{row.key}` | {row.how} | {times} | {_measured(outcome)} |")
    wrong, not_finite = (sum(getattr(r, name) for r in outcomes.values()) for name in ("wrong", "not_finite"))
    machines = sorted({result.machine for result in outcomes.values()})
    seeds = sorted({result.seed for result in outcomes.values()})
    lines += [
        "",
        f"Commands that a board took though its computer had not sent them, or not in this order, or not as often, over the "
        f"whole matrix: {wrong}. Numbers in the water that were not finite: {not_finite}.",
        "",
        f"Measured on: {'; '.join(machines)}. Seed {', '.join(map(str, seeds))}.",
        "",
    ]
    path.write_text("\n".join(lines), encoding="utf-8")


def _measured(outcome: RowOutcome | None) -> str:
    """Worst value and limit of each figure of a row. What never happened, and must not, shares one word."""
    if outcome is None:
        return NOT_MEASURED
    never = [name for name, figure in outcome.figures.items() if figure.times and figure.worst == figure.limit == 0.0]
    words = [_worst(name, figure) for name, figure in outcome.figures.items() if name not in never]
    others = [name for name in never if name not in MARKS]
    words += [f"never {' or '.join(others)}"] if others else []
    words += [f"**stuck {len(outcome.stuck)} times**"] if outcome.stuck else []
    return "; ".join(words) + "".join(MARKS[name] for name in never if name in MARKS)


def _worst(name: str, figure: Figure) -> str:
    if not figure.times:
        return f"{name}: {NOT_MEASURED}"
    _, _, worst, limit = figure.shown
    return f"{name} {worst}/{limit}" if figure.kept else f"**{name} {worst}, not kept: {limit}**"
