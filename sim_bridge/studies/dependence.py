"""A campaign's answer: each measure against each swept key, the same seeds and draws paired, failures with reasons. Pure.

found = dependences(campaign, rows)             # once: a bootstrap of each figure
for line in lines(rows, found): ...             # for the terminal; report.py draws the same
"""

import math
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from groundstation.analysis.measures import TIMINGS
from groundstation.analysis.statistics import Interval, mean
from sim_bridge.studies.campaign import Campaign
from sim_bridge.studies.statistics import rate

SHOWN = ("rms_after_20s_m", "max_after_20s_m", "rms_yaw_after_20s_rad", "wrench_step_rms")
UNITS = {"_m": ("mm", 1e3), "_rad": ("deg", 180.0 / math.pi), "_us": ("µs", 1.0)}  # by the ends of measures' names
MOST_REASONS = 8
CELL, VALUE = 24, 14  # widths of the terminal's columns in characters

Row = Mapping[str, Any]


@dataclass(frozen=True)
class KeyValue:
    """The flights with one value of a swept key. Means leave out flights in which a robot told of a fault: after it no robot
    has to follow anything, and figures look better than they are."""

    value: str
    flights: int
    within: Interval  # share within every limit
    faults: int
    points: dict[str, list[float]]  # by measure: one for each flight without a fault, in what it is shown in
    means: dict[str, Interval | None]
    against_first: dict[str, Interval | None]  # mean difference from the first value, over flights that differ in nothing else


def unit_of(measure: str) -> tuple[str, float]:
    """The unit that a measure is shown in, and the factor to it; shares in per cent."""
    return next((shown for end, shown in UNITS.items() if measure.endswith(end)), ("%", 100.0))


def shown_measures(rows: Sequence[Row]) -> list[str]:
    """Measures of the tables: those that these flights have, of flights under 20 s that of the whole run; and what a control
    step takes."""

    def had(names: Sequence[str]) -> list[str]:
        return [name for name in names if any(row.get(name) is not None for row in rows)]

    return (had(SHOWN) or ["rms_m"]) + had(TIMINGS)


def dependence(campaign: Campaign, key: str, flown: Sequence[Row], measures: Sequence[str]) -> list[KeyValue]:
    """A line for each value of a swept key, in the file's order."""
    others = [name for name in ("seed", *campaign.sweep) if name != key]

    def pair_of(row: Row) -> tuple[str, ...]:
        """Seed and other swept values of a flight: the same in flights that differ in this key alone."""
        return tuple(str(row[name]) for name in others)

    values = list(dict.fromkeys(str(row[key]) for row in flown))
    firsts = {pair_of(row): row for row in flown if str(row[key]) == values[0] and not row.get("at_fault")}
    lines = []
    for value in values:
        flights = [row for row in flown if str(row[key]) == value]
        sound = [row for row in flights if not row.get("at_fault")]
        pairs = [(row, firsts[pair_of(row)]) for row in sound if pair_of(row) in firsts and value != values[0]]
        points, differences = dict[str, list[float]](), dict[str, list[float]]()
        for measure in measures:
            _, factor = unit_of(measure)
            points[measure] = [factor * row[measure] for row in sound if row.get(measure) is not None]
            differences[measure] = [
                factor * (row[measure] - first[measure])
                for row, first in pairs
                if row.get(measure) is not None and first.get(measure) is not None
            ]
        lines.append(
            KeyValue(
                value,
                flights=len(flights),
                within=rate(sum(bool(row["passed"]) for row in flights), len(flights)),
                faults=len(flights) - len(sound),
                points=points,
                means=_means(points),
                against_first=_means(differences),
            )
        )
    return lines


def _means(numbers_by_measure: Mapping[str, list[float]]) -> dict[str, Interval | None]:
    """Mean of each measure's numbers; None where there are none."""
    return {measure: mean(numbers) if numbers else None for measure, numbers in numbers_by_measure.items()}


def dependences(campaign: Campaign, rows: Sequence[Row]) -> dict[str, list[KeyValue]]:
    """The lines of each swept key, for the measures that are shown; none if nothing was flown."""
    flown = [row for row in rows if row["status"] == "flown"]
    measures = shown_measures(flown)
    return {key: dependence(campaign, key, flown, measures) for key in campaign.sweep} if flown else {}


def reasons(rows: Sequence[Row]) -> list[tuple[int, str]]:
    """Numbers of flights that did not pass, by reason, the most frequent first."""
    failed = [row for row in rows if row["status"] != "flown" or not row.get("passed")]
    counts = Counter[str]()
    for row in failed:  # a flight that was flown may have several reasons, each of which counts once
        row_reasons = row["reason"].split("; ") if row["status"] == "flown" else [row["reason"]]
        counts.update(dict.fromkeys(row_reasons, 1))
    return [(count, reason) for reason, count in counts.most_common()]


def lines(rows: Sequence[Row], by_key: Mapping[str, Sequence[KeyValue]]) -> Iterator[str]:
    """A terminal's 80 columns: a table for each swept key with the first two measures, then the reasons of failures."""
    for key, values in by_key.items():
        measures = list(values[0].means)[:2]
        yield f"{key}: mean [95 %] over flights without a fault"
        heads = "".join(f"{f'{name} [{unit_of(name)[0]}]':>{CELL}}" for name in measures)
        yield f"{'value':{VALUE}}{'flights':>8}{'passed':>8}{heads}"
        for line in values:
            passed = round(line.within.value * line.flights)
            cells = "".join(f"{line.means[name] or '–'!s:>{CELL}}" for name in measures)
            yield f"{line.value[: VALUE - 1]:{VALUE}}{line.flights:>8}{passed:>8}{cells}"
    failed = reasons(rows)
    if failed:
        total = sum(row["status"] != "flown" or not row.get("passed") for row in rows)
        yield f"{total} of {len(rows)} flights did not pass:"
        yield from (f"  {count} x {reason}" for count, reason in failed[:MOST_REASONS])
        if len(failed) > MOST_REASONS:
            yield f"  and {len(failed) - MOST_REASONS} more reasons (in the report)"
