"""A thruster's curve from bench measurements: pulse against what a kitchen scale shows. Pure.

The thruster pushes a lever onto the scale. Readings are averaged for each pulse, made monotonic by isotonic regression (pool
adjacent violators; Barlow et al. 1972), set to 0 N within the dead zone, and thinned to the number of points of a vehicle's
curve.
"""

import csv
import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, NamedTuple

from shoal.errors import ConfigError
from shoal.mavlink.agent_link import PULSE_RANGE_US, STANDARD_GRAVITY_MPS2

COLUMNS = ["pulse_us", "grams"]
LEAST_PULSES = 6  # different ones: two on each side, and the dead zone
OUTLIER = 0.1  # of the largest thrust: a reading that is further from the curve is a mistake of the bench

Curve = tuple[tuple[int, float], ...]  # (us, N), rising


@dataclass(frozen=True)
class ThrustReading:
    """One row of a measurement; `line` is its line of the file."""

    line: int
    pulse_us: int
    force_n: float


@dataclass(frozen=True)
class ThrustFit:
    """A curve, and how far the readings are from it."""

    curve: Curve
    rms_n: float
    worst: ThrustReading
    worst_n: float


def read_rows(lines: Iterable[str], name: str, lever: float = 1.0) -> list[ThrustReading]:
    """Readings of a CSV file with a head `pulse_us,grams`; grams are negative astern, times `lever` they are the thrust.
    Raises ConfigError naming line, column and value of a row that cannot be used."""
    rows, readings = csv.reader(lines), []
    head = _next_row(rows, name) or []
    if [cell.strip() for cell in head] != COLUMNS:
        raise ConfigError(f"{name}: line 1: {','.join(head)!r} is not the head (allowed: {','.join(COLUMNS)})")
    while (row := _next_row(rows, name)) is not None:
        if not any(cell.strip() for cell in row):
            continue
        where = f"{name}: line {rows.line_num}"
        if len(row) != len(COLUMNS):
            raise ConfigError(f"{where}: {len(row)} columns (allowed: {','.join(COLUMNS)})")
        pulse, grams = (_cell_number(cell, f"{where}: {column}") for cell, column in zip(row, COLUMNS, strict=True))
        low, high = PULSE_RANGE_US
        if not low <= pulse <= high or pulse != int(pulse):
            raise ConfigError(f"{where}: pulse_us = {pulse:g} (allowed: whole numbers from {low} to {high})")
        readings.append(ThrustReading(rows.line_num, int(pulse), grams * 1e-3 * STANDARD_GRAVITY_MPS2 * lever))
    return readings


def _next_row(rows: Any, name: str) -> list[str] | None:
    """The next row of csv's reader; None after the last one. Raises ConfigError."""
    try:
        row: list[str] | None = next(rows, None)
    except csv.Error as error:
        raise ConfigError(f"{name}: line {rows.line_num}: {error}") from None
    return row


def _cell_number(cell: str, where: str) -> float:
    """A finite number from a cell of the table. Raises ConfigError."""
    try:
        value = float(cell)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise ConfigError(f"{where} = {cell.strip()!r}: not a number")
    return value


def fit(readings: Sequence[ThrustReading], name: str, points: int, still_n: float) -> ThrustFit:
    """The curve of some readings; thrust up to `still_n` counts as none. Raises ConfigError for those of no thruster: too few,
    one-sided, without a dead zone, or with a reading that does not fit the others."""
    ordered = sorted(readings, key=lambda reading: reading.pulse_us)
    forces_at: dict[int, list[float]] = {}
    for reading in ordered:
        forces_at.setdefault(reading.pulse_us, []).append(reading.force_n)
    if len(forces_at) < LEAST_PULSES:
        raise ConfigError(f"{name}: {len(forces_at)} different pulses (allowed: {LEAST_PULSES} or more)")
    means = [sum(values) / len(values) for values in forces_at.values()]
    weights = [len(values) for values in forces_at.values()]
    forces = [0.0 if abs(force) <= still_n else force for force in _isotonic(means, weights)]
    dense = tuple(zip(forces_at, forces, strict=True))
    if not (forces[0] < 0.0 < forces[-1]):
        raise ConfigError(f"{name}: {forces[0]:.2f} N to {forces[-1]:.2f} N: must reach from astern (negative grams) to ahead")
    if forces.count(0.0) < 2:
        raise ConfigError(f"{name}: no two pulses at which the thruster stands still (measure both edges of the dead zone)")
    curve = _thinned(dense, points)
    misses_n = [abs(interpolate(curve, reading.pulse_us) - reading.force_n) for reading in ordered]
    worst_n = max(misses_n)
    worst = ordered[misses_n.index(worst_n)]
    if worst_n > OUTLIER * max(-forces[0], forces[-1]) + still_n:
        raise ConfigError(
            f"{name}: line {worst.line}: {worst.force_n:.2f} N at {worst.pulse_us} us is {worst_n:.2f} N off the curve of the "
            "others; measure it again, or remove it"
        )
    rms_n = math.sqrt(sum(miss_n * miss_n for miss_n in misses_n) / len(misses_n))
    return ThrustFit(tuple((pulse, round(force, 3)) for pulse, force in curve), rms_n, worst, worst_n)


class _Block(NamedTuple):
    """Neighbouring values that get one value, their mean."""

    mean: float
    weight: int
    size: int  # number of values


def _isotonic(values: Sequence[float], weights: Sequence[int]) -> list[float]:
    """The nearest values, in weighted least squares, that never fall (pool adjacent violators)."""
    blocks: list[_Block] = []
    for value, weight in zip(values, weights, strict=True):
        block = _Block(value, weight, 1)
        while blocks and blocks[-1].mean > block.mean:  # a fall: one block with the mean of both
            before = blocks.pop()
            total = before.weight + block.weight
            mean = (before.mean * before.weight + block.mean * block.weight) / total
            block = _Block(mean, total, before.size + block.size)
        blocks.append(block)
    return [block.mean for block in blocks for _ in range(block.size)]


def interpolate(curve: Sequence[tuple[int, float]], pulse_us: float) -> float:
    """Thrust in N at a pulse within the curve."""
    for (low_us, low_n), (high_us, high_n) in pairwise(curve):
        if pulse_us <= high_us:
            return low_n + (high_n - low_n) * (pulse_us - low_us) / (high_us - low_us)
    return curve[-1][1]


def _thinned(dense: Curve, points: int) -> Curve:
    """At most `points` of a dense curve's points: the ends, the edges of the dead zone, and then one by one the point that is
    farthest off the curve through those kept so far."""
    still = [point for point in dense if point[1] == 0.0]
    kept = {dense[0], still[0], still[-1], dense[-1]}
    while len(kept) < min(points, len(dense)):
        curve = sorted(kept)
        misses_n = {point: abs(interpolate(curve, point[0]) - point[1]) for point in dense if point not in kept}
        kept.add(max(misses_n, key=lambda point: misses_n[point]))
    return tuple(sorted(kept))
