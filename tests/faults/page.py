"""SHELL: results of fault injections, as JSON and as docs/faults.md. A row that is flown again replaces its older figures."""

import json
import os
import platform
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from tests.faults.row import FaultRow, Sample

RESULTS = Path(__file__).parent / "results.json"


NOT_MEASURED = "not measured"


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
boards do. The figures are the median and the **worst** of N injections, in seconds unless it says otherwise; a limit with a
percentage holds for that share of them. One row again: `make faults ARGS="--row {example} --times 5"`.

What a robot does by itself is in `docs/modes.md`, what a board does in `docs/board.md`. Known gaps:

* A failed thruster may stay unnoticed when it is commanded to give almost no thrust, when it has lost a third of its thrust or
  less, or when it keeps the thrust that is commanded at that moment: then the gyroscope measures no difference. A stuck
  thruster makes the robot turn to and fro, more and more, and that may be the only sign; then the distance from its path
  decides, `safety.off_path_m`. In still water 0.1 m is enough, as measured below; the default of 0.3 m leaves room for waves
  and gusts. In waves and gusts the missing thrust of a leg must turn the robot more strongly than they do. A disturbance that
  turns the robot as strongly as an idle leg, for two seconds, in water that was still before, is taken for a broken leg. The
  measurement does not tell which thruster is broken: test them one by one.
* A pressure sensor that sticks is found after 3 s of exactly the same value, if it showed noise before. One that sticks from
  the start is not found while its robot keeps its depth: the robot then drifts slowly from that depth without an alarm.
* When a robot's marker plate comes off, the localizer's filters no longer recognize the robot: it holds, then goes to neutral.
  A marker that is only unreadable (glare, a cable) is bridged.
* On a link that is not signed, a MAVLink frame that is delayed by more than 6.4 s may be taken for a new one, because its
  sequence number of 8 bits has wrapped around. An attacker who can write on such a link can also make a board ignore frames
  for half a second, with a number far ahead. The board is disarmed by then, and the first frame that it accepts after that may
  be old.
* A marker that is turned cannot be found before the robot pushes: no sensor of the board measures an absolute heading,
  for its yaw is the gyroscope's integral. One that is turned by less than some 10 degrees is not found. One that is
  turned by 20 degrees is found after 3 to 7 s, or not at all on a slow path: thrust of one direction may be a current,
  so only its changes tell, and after 3 s they give the direction to 6 to 10 degrees. The limit is 3 standard deviations
  beyond 4 degrees; with 2 it would be found after 2.2 to 6.9 s, but waves of 5 cm alone reach 1.95 of them within the
  first 4 s of a flight.
* A robot that stops so suddenly that the gyroscope notices it first is said to have a broken thruster, or to be held:
  the poses tell which only some tenths of a second later.

What a robot cannot do, it stops for (`controller.law = "nmpc"`). These are numeric flights of `python -m benchmarks robots
--cells 'held-*,turned-*,swept'` at 10, 20 and 50 Hz, and of `ordinary` with a wrong sensor:

| What | What happens | Time until neutral, s |
|---|---|---|
| a net holds the robot at the start | FAULT "held fast" | 1.6 to 3.2, median 1.8, of 12: it pushes little at first |
| a net holds it in flight | FAULT "thrusters do not do as told: ... may be held fast" | 0.1 to 0.6, of 6 |
| a net holds it while it gives way | the same | 0.2 to 1.3, of 6 |
| a net holds it while a person drives it | the same, or "held fast" | below 3, of 1 |
| its marker is turned by 20 degrees | FAULT "marker turned by about 20 degrees" | 2.7 to 7.3, median 4.6, of 12; two: never |
| by 57 degrees | the same, "by about 57 degrees" | 1.5 to 1.7, of 6 |
| by 90 degrees | the same | 1.4 to 2.3, of 6 |
| by 180 degrees | the same; one said "does not follow its plan" | 1.4 to 2.1, of 6 |
| a current of 1.3 to 1.8 of its speed | FAULT "current too strong", or "does not follow its plan" | 0.8 to 1.5, of 6 |
| the gyroscope measures 0 from power-on | FAULT "gyroscope in doubt" | 1.3 to 1.9, of 6 |
| a fifth of the rate | the same | 1.4 to 2.9, of 6 |
| twice the rate | the same | 1.4 to 6.9, of 6: it has to turn by 0.35 rad |
| the rate reversed | the same, or "thrusters do not do as told" | 0.4 to 1.7, of 6 |
| the depth stays as it was at 10 s | FAULT "depth sensor stuck"; up to 30 mm off its depth by then | 3.1 to 3.2, of 3 |
"""


def write_page(path: Path, rows: Sequence[FaultRow]) -> None:
    """The page, from all results that there are."""
    kept = json.loads(RESULTS.read_text(encoding="utf-8")) if RESULTS.exists() else {}
    found = {key: RowOutcome.from_json(table) for key, table in kept.items()}
    lines = [HEAD.format(example=rows[0].key)]
    lines += ["| Row | Fault | How | Measured | N | median | worst | limit | |", "|---|---|---|---|---|---|---|---|---|"]
    for row in rows:
        if row.key not in found:
            lines.append(f"| `{row.key}` | {row.fault} | {row.how} | {NOT_MEASURED} | | | | | |")
            continue
        result = found[row.key]
        for name, figure in result.figures.items():
            mark = _mark(figure.kept) if figure.times else NOT_MEASURED
            lines.append(f"| `{row.key}` | {row.fault} | {row.how} | {name} | {' | '.join(figure.shown)} | {mark} |")
        lines += [f"| `{row.key}` | | | stuck {len(result.stuck)} times | | | | | {_mark(False)} |"] if result.stuck else []
    wrong, not_finite = (sum(getattr(r, name) for r in found.values()) for name in ("wrong", "not_finite"))
    machines = sorted({result.machine for result in found.values()})
    seeds = sorted({result.seed for result in found.values()})
    lines += [
        "",
        f"Commands that a board took though its computer had not sent them, or not in this order, or not as often, over the "
        f"whole matrix: {wrong}. Numbers in the water that were not finite: {not_finite}.",
        "",
        f"Measured on: {'; '.join(machines)}. Seed {', '.join(map(str, seeds))}.",
        "",
    ]
    path.write_text("\n".join(lines), encoding="utf-8")


def _mark(kept: bool) -> str:
    return "✓" if kept else "**not kept**"
