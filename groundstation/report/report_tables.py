"""The report's tables of robots and pairs: errors, the article's beside them, wear; in mm and degrees. Pure."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

from groundstation.analysis.numbers import deg, mm
from groundstation.analysis.results import PairResult, Result, RobotResult
from groundstation.analysis.statistics import NOTHING, three

Row = RobotResult | PairResult
XYZ = ("x [mm]", "y [mm]", "z [mm]")
YAW = "yaw [deg]"


@dataclass(frozen=True)
class Cell:
    """A cell's text, and whether it is better ("good") or not ("bad") than what it is compared with."""

    text: str
    sense: str = ""


@dataclass(frozen=True)
class Group:
    """Columns under one heading."""

    title: str
    columns: tuple[str, ...]


@dataclass(frozen=True)
class ReportTable:
    """A table of a row each robot or pair: for each group of columns its cells."""

    title: str
    groups: tuple[Group, ...]
    rows: tuple[tuple[str, tuple[tuple[Cell, ...], ...]], ...]
    note: str


@dataclass(frozen=True)
class _Part:
    group: Group
    cells: Callable[[Any], Sequence[Cell]]


def tables(result: Result) -> list[ReportTable]:
    """The report's tables, without those that would be empty. Only a run that was flown to its end is compared with the
    article's figures, which are of whole runs."""
    rows = list(result.rows.items())
    robots = rows[: len(result.robots)]
    all_tables = [_table("Errors", _errors(), rows, "Root mean square and largest; yaw to the path's tangent.")]
    if result.is_whole and any(row.article for _, row in rows):
        note = "✓ below, ✗ not below the article's figure. “Never moving” is a robot that sits at the middle of its reference."
        all_tables.append(_table("Beside the article", _article(), rows, note))
    all_tables.append(
        _table("Robots", _robots(), robots, "Yaw to the heading commanded; disturbance: estimated minus true, RMS.")
    )
    axes = max((len(row.dtau_rms or ()) for row in result.robots.values()), default=0) or 3
    note = "RMS of the change per control step: chatter wears thrusters out."
    all_tables.append(_table("Wear", _input_steps(axes), robots, note))
    return [table for table in all_tables if table.groups]


def _table(title: str, parts: Iterator[_Part], rows: Sequence[tuple[str, Row]], note: str) -> ReportTable:
    """A table of the parts that have a value in any row."""
    filled = [part for part in parts if any(c.text != NOTHING for _, row in rows for c in part.cells(row))]
    cells = tuple((name, tuple(tuple(part.cells(row)) for part in filled)) for name, row in rows)
    return ReportTable(title, tuple(part.group for part in filled), cells, note)


def _errors() -> Iterator[_Part]:
    """Columns of a robot's or pair's errors: RMS and largest, of the whole run and after 20 s."""
    yield _Part(Group("RMS, whole run", (*XYZ, YAW)), lambda r: [*_lengths(r.rms_m), Cell(deg(r.rms_yaw_rad))])
    yield _Part(
        Group("RMS after 20 s", (*XYZ, YAW)), lambda r: [*_lengths(r.rms_after_20s_m), Cell(deg(r.rms_yaw_after_20s_rad))]
    )
    yield _Part(Group("largest, whole run", XYZ), lambda r: _lengths(r.max_m))
    yield _Part(Group("largest after 20 s", XYZ), lambda r: _lengths(r.max_after_20s_m))


def _article() -> Iterator[_Part]:
    """Columns that compare the errors with the article's, and with those of a robot that never moves."""
    xy = XYZ[:2]
    articles_rms_m = _figure_of("article", "rms_m")
    articles_yaw_rad = _figure_of("article", "rms_yaw_rad")
    articles_max_m = _figure_of("article", "max_m")
    still_rms_m = _figure_of("baseline", "rms_m")
    yield _Part(Group("RMS, whole run", XYZ), lambda r: _lengths(r.rms_m, articles_rms_m(r)))
    yield _Part(Group("the article's", XYZ), lambda r: _lengths(articles_rms_m(r)))
    yield _Part(
        Group("yaw [deg]", ("here", "article")),
        lambda r: [_compared(r.rms_yaw_rad, articles_yaw_rad(r), deg), Cell(deg(articles_yaw_rad(r)))],
    )
    yield _Part(Group("largest", xy), lambda r: _lengths(r.max_m, articles_max_m(r))[:2])
    yield _Part(Group("the article's", xy), lambda r: _lengths(articles_max_m(r))[:2])
    yield _Part(Group("never moving, RMS", xy), lambda r: _lengths(still_rms_m(r))[:2])


def _figure_of(part: str, name: str) -> Callable[[Row], Any]:
    """A function from a row to a figure of its article or baseline; None for a row without."""
    return lambda row: getattr(getattr(row, part), name, None)


def _robots() -> Iterator[_Part]:
    """Columns that only robots have, not pairs: yaw against its command, error of the disturbance, control steps."""
    yield _Part(
        Group("yaw, RMS [deg]", ("whole run", "after 20 s")),
        lambda r: [Cell(deg(r.rms_yaw_command_rad)), Cell(deg(r.rms_yaw_command_after_20s_rad))],
    )
    linear = ("surge [m/s²]", "sway [m/s²]", "heave [m/s²]")
    yield _Part(
        Group("disturbance", (*linear, "yaw [deg/s²]")),
        lambda r: [*_numbers(r.disturbance_error_rms, 4)[:3], Cell(deg((r.disturbance_error_rms or (None,) * 4)[3]))],
    )
    yield _Part(Group("control steps", ("all", "late")), lambda r: [Cell(str(r.control_steps)), Cell(str(r.missed_deadlines))])


def _input_steps(count: int) -> Iterator[_Part]:
    """Columns of the RMS change per control step: of the wrench's first `count` axes (3, or 4 with sway), and of the
    pulses."""
    axes = ("surge [N]", "heave [N]", "yaw [N m]", "sway [N]")[:count]
    yield _Part(Group("input steps, whole run", axes), lambda r: _numbers(r.dtau_rms, len(axes)))
    yield _Part(Group("input steps after 20 s", axes), lambda r: _numbers(r.dtau_rms_after_20s, len(axes)))
    yield _Part(Group("pulse steps", ("whole run [µs]",)), lambda r: [Cell(three(r.pulse_step_rms_us))])


def _lengths(values: Sequence[float] | None, others: Sequence[float] | None = None) -> list[Cell]:
    """Cells of three lengths in mm, each compared with the one of `others` on the same axis where there is one."""
    own, theirs = ([*(lengths or ()), None, None, None] for lengths in (values, others))
    return [_compared(own[axis], theirs[axis], mm) for axis in range(3)]


def _compared(value: float | None, other: float | None, format_value: Callable[[float | None], str]) -> Cell:
    """A value's cell, marked good where it is smaller than the other value, else bad; unmarked where one is missing."""
    sense = "" if value is None or other is None else "good" if value < other else "bad"
    return Cell(format_value(value), sense)


def _numbers(values: Sequence[float] | None, count: int) -> list[Cell]:
    """Cells of the first `count` values with three digits; empty ones where values are missing."""
    return [Cell(three(value)) for value in (*(values or ()), *(None,) * count)[:count]]
