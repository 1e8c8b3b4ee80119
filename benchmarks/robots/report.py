"""Tables of the grid: targets, cells, encounters, traps, worst flights; the same beside those of an earlier run."""

import math
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict, dataclass, fields, replace
from typing import Any

from benchmarks import evidence
from tests.flights.cells import CELLS
from tests.flights.claims import GROUPS
from tests.flights.figures import FlightFigures

NEAREST_M = 0.6  # 2 R of every flight of the grid
SETTLED_S, HELD_M, STOPPED_S, EIGHT_M = 15.0, 0.02, 3.0, 0.005  # targets
BACK_S = {"meet-2": 20.0, "meet-8": 45.0}
CALIBRATED = (0.5, 1.5)  # NEES of a group of states, mean of a cell
REPEAT = "python -m benchmarks robots --cells {} --flight {}"
NOTHING = "0 of 0"
MODELS = ("model-30", "model+30", "model+100", "model-50")


@dataclass(frozen=True)
class GridRun:
    """All flights of a run, and what they were flown with."""

    law: str  # control law and observer
    settings: tuple[str, ...]  # laid over those of the flights
    hold_s: float
    origin: str  # date, commit, machine
    flights: tuple[FlightFigures, ...]

    def with_flight(self, flight: FlightFigures) -> "GridRun":
        """The run with one more flight, in the grid's order."""
        flights = sorted((*self.flights, flight), key=lambda f: (list(CELLS).index(f.cell), f.number))
        return replace(self, flights=tuple(flights))

    def of(self, cell: str) -> list[FlightFigures]:
        """Flights of a cell."""
        return [flight for flight in self.flights if flight.cell == cell]

    @property
    def cells(self) -> list[str]:
        """Cells that were flown, in the grid's order."""
        return [cell for cell in CELLS if self.of(cell)]

    @property
    def command(self) -> str:
        """The command that flies a flight again, with {} for cell and number."""
        return " ".join([REPEAT, *(f"--set {setting}" for setting in self.settings), f"--hold-s {self.hold_s:g}"])


def as_json(run: GridRun) -> dict[str, Any]:
    """A run as a dictionary."""
    return asdict(run)


def from_json(content: dict[str, Any]) -> GridRun:
    """The run of `as_json`, after it was in a file."""
    kinds = {field.name: field.type for field in fields(FlightFigures)}
    flights = [
        FlightFigures(**{key: _value(value, kinds[key]) for key, value in flight.items()}) for flight in content["flights"]
    ]
    return GridRun(content["law"], tuple(content["settings"]), content["hold_s"], content["origin"], tuple(flights))


def _value(value: Any, kind: Any) -> Any:
    """A value of a file: numbers may be unknown or infinite."""
    if kind not in (float, "float"):
        return value
    return math.nan if value is None else math.inf if value == evidence.NEVER else float(value)


def severity(flight: FlightFigures) -> tuple[float, ...]:
    """Order of flights of a cell, the worst last."""
    cell = CELLS[flight.cell]
    if cell.is_trap:
        return _known(flight.stop_s), -float(flight.is_named)
    if flight.robots > 1:
        return float(bool(flight.refused)), float(flight.is_stop), NEAREST_M - _known(flight.nearest_m), _known(flight.back_s)
    shares = (flight.settled_s / SETTLED_S, flight.hold_m / HELD_M, flight.rms_m / EIGHT_M)
    return float(bool(flight.refused)), float(flight.is_stop), float(flight.never_settled), max(map(_known, shares))


def _known(value: float) -> float:
    return 0.0 if math.isnan(value) else value


def worst_of(flights: Sequence[FlightFigures]) -> FlightFigures:
    """The flight that says most against a cell."""
    return max(flights, key=severity)


def targets(run: GridRun) -> list[tuple[str, str, str]]:
    """Figure, target, and what was found."""
    fair = [flight for flight in run.flights if not CELLS[flight.cell].is_trap]
    calm = [flight for flight in fair if CELLS[flight.cell].is_calm]
    held = [flight.hold_m for flight in calm if not math.isnan(flight.hold_m)]
    strong = [flight for flight in run.of("start-current-0.8") if not flight.refused]
    traps = [flight for flight in run.flights if CELLS[flight.cell].is_trap]
    stopped = sorted(flight.stop_s for flight in traps)
    settled = sum(flight.settled_s <= SETTLED_S and not flight.is_stop for flight in strong)
    rows = [
        (
            "HOLD in still water: largest distance from the place after 10 s, worst of the grid",
            "20 mm",
            f"{1e3 * max(held):.0f} mm; {sum(h > HELD_M for h in held)} of {len(held)} beyond 20 mm" if held else "",
        ),
        (
            "stopped in HOLD in still water",
            "0",
            _share(sum(f.is_stop and f.holds for f in calm), calm),
        ),
        (
            "input steps on the path in still water, RMS, of their limit",
            "20 %",
            f"{_worst((f.steps for f in calm), 100.0)} %" if calm else "",
        ),
        ("never settle, orbit, or are led for ever", "0 of 2,000", _share(sum(_is_lost(f) for f in fair), fair)),
        (
            f"eight, {', '.join(MODELS)}: RMS after 20 s, worst",
            "5 mm each",
            ", ".join(f"{evidence.short(1e3 * worst)} mm" for m in MODELS if (worst := _worst_eight(run.of(m))) > 0.0),
        ),
        ("starts 0.5 to 2 m off in a current of 0.6 to 0.8: within 5 cm after 15 s", "all", _share(settled, strong)),
        ("false stops", "<= 1 of 2,000", _share(sum(f.is_stop for f in fair), fair)),
        (
            "held fast, marker turned, swept away: time until it stops",
            "<= 3 s, cause named",
            f"{_times(stopped)}; {_share(sum(s <= STOPPED_S for s in stopped), stopped)} in time; "
            f"{sum(f.is_named for f in traps)} named"
            if stopped
            else "",
        ),
    ]
    for cell, limit_s in BACK_S.items():
        met = run.of(cell)
        if met:
            near = min(_nearest(met), default=math.nan)
            rows.append(
                (
                    CELLS[cell].about,
                    f"2R = {NEAREST_M:g} m; back within {limit_s:g} s",
                    f"{near:.3f} m; {_times(f.back_s for f in met)}",
                )
            )
    pooled = [_nees(run.of(cell)) for cell in run.cells if not CELLS[cell].is_trap]
    means = [mean for nees in pooled for mean in nees.values()]
    off = [mean for mean in means if not CALIBRATED[0] <= mean <= CALIBRATED[1]]
    what = "NEES per degree of freedom, mean of each cell and group of states, traps aside"
    result = f"{len(off)} of {len(means)} outside; {min(off):.2g} to {max(off):.2g}" if off else _share(0, means)
    rows.append((what, "0.5 to 1.5", result))
    for group in GROUPS:
        values = [nees[group] for nees in pooled if group in nees]
        if values:
            rows.append((f"NEES of {group}, mean of all cells", "0.5 to 1.5", f"{sum(values) / len(values):.2g}"))
    return [row for row in rows if row[2] not in ("", NOTHING)]


def _is_lost(flight: FlightFigures) -> bool:
    return not flight.is_stop and (flight.never_settled or flight.back_s == math.inf)


def _share(count: int, of: Sequence[object]) -> str:
    return f"{count} of {len(of)}"


def _worst_eight(flights: Sequence[FlightFigures]) -> float:
    """The worst RMS of figures of eight; infinity if one stopped on its path."""
    eights = [f for f in flights if f.scene == "eight"]
    return max((math.inf if math.isnan(f.rms_m) else f.rms_m for f in eights), default=0.0)


def _times(values: Iterable[float]) -> str:
    times = evidence.spread(values, 1.0)
    return f"{times} s" if times else "none"


def _nearest(flights: Sequence[FlightFigures]) -> list[float]:
    return [f.nearest_m for f in flights if not math.isnan(f.nearest_m)]


def _nees(flights: Sequence[FlightFigures]) -> dict[str, float]:
    """Mean over the flights of each group of states that is claimed."""
    nees = {group: [f.nees[group] for f in flights if group in f.nees] for group in GROUPS}
    return {group: sum(values) / len(values) for group, values in nees.items() if values}


Column = tuple[str, Callable[[Sequence[FlightFigures]], str]]


def _worst(values: Iterable[float], scale: float) -> str:
    """The largest; empty where nothing is known."""
    return evidence.spread(values, scale).partition(" ")[0]


def _trouble(group: Sequence[FlightFigures]) -> str:
    """Flights of each kind of trouble; empty if there is none."""
    counts = {
        "refused": sum(bool(f.refused) for f in group),
        "stopped": sum(f.is_stop for f in group),
        "lost": sum(_is_lost(f) for f in group),
        "below 2R": sum(near < NEAREST_M for near in _nearest(group)),
    }
    return ", ".join(f"{count} {name}" for name, count in counts.items() if count)


def _worst_nees(group: Sequence[FlightFigures]) -> str:
    """The mean NEES of a group of states that is farthest from 1 as a ratio, and the group; empty if none is claimed."""
    nees = {name: mean for name, mean in _nees(group).items() if mean > 0.0}
    if not nees:
        return ""
    name = max(nees, key=lambda each: abs(math.log(nees[each])))
    return f"{nees[name]:.2g} {name}"


NEES: Column = ("NEES", _worst_nees)
PATH_COLUMNS: tuple[Column, ...] = (
    ("Within 5 cm, s", lambda group: _worst((f.settled_s for f in group), 1.0)),
    ("RMS, mm", lambda group: _worst((f.rms_m for f in group), 1e3)),
    ("HOLD, mm", lambda group: _worst((f.hold_m for f in group), 1e3)),
    ("Steps, %", lambda group: _worst((f.steps for f in group), 100.0)),
    NEES,
)
MEETING_COLUMNS: tuple[Column, ...] = (
    ("Nearest, m", lambda group: f"{min(_nearest(group)):.3f}" if _nearest(group) else ""),
    ("Back, s", lambda group: _worst((f.back_s for f in group), 1.0)),
    NEES,
)
TRAP_COLUMNS: tuple[Column, ...] = (
    ("Stops after, s", lambda group: _worst((f.stop_s for f in group), 1.0)),
    ("Cause named", lambda group: str(sum(f.is_named for f in group))),
)


def _sections(run: GridRun) -> list[tuple[str, tuple[Column, ...], list[str]]]:
    """Heading, columns and cells of each table."""
    traps = [cell for cell in run.cells if CELLS[cell].is_trap]
    meetings = [cell for cell in run.cells if cell not in traps and cell.startswith("meet-")]
    paths = [cell for cell in run.cells if cell not in traps and cell not in meetings]
    return [("Paths and HOLD", PATH_COLUMNS, paths), ("Encounters", MEETING_COLUMNS, meetings), ("Traps", TRAP_COLUMNS, traps)]


def markdown(run: GridRun, before: GridRun | None = None) -> str:
    """The page of evidence; the targets beside those of another run if there is one."""
    worst = worst_of([flight for flight in run.flights if not CELLS[flight.cell].is_trap] or run.flights)
    lines = [
        "# Robots that nobody tuned for: a grid of numeric flights",
        "",
        f"{run.origin}. Flown: **{run.law}**{_with(run.settings)}.",
        *([f"Before it: **{before.law}**{_with(before.settings)}, {before.origin}."] if before else []),
        "",
        "Poses are the simulation's with noise, without a camera. Figures are against the plant's truth; each cell's are",
        f"those of its worst of {_fewest_and_most(run)} flights, which differ in path, control rate (10, 20, 50 Hz), speed,",
        f"start and sensors. RMS is from 20 s on; HOLD lasts {run.hold_s:g} s, measured from 10 s on. Steps are those of",
        "the inputs, RMS of their limit. NEES, of the worst group of states, is 1 where the observer's covariances are true.",
        "The observer is not told the cell: what it claims is an average over waters and models that it cannot tell apart, so",
        "it claims less than it knows in the calm ones, and more in the wild ones. A flight is lost if it never settles or",
        "never comes back.",
        "",
        f"A flight again: `{run.command.format('CELL', 'N')}`. The worst one of all:",
        f"`{run.command.format(worst.cell, worst.number)}`.",
        "",
        "## Targets",
        "",
        *evidence.table(*_target_table(run, before)),
    ]
    for heading, columns, cells in _sections(run):
        if cells:
            names = ("Cell", *(name for name, _ in columns), "Worst", "What")
            lines += ["", f"## {heading}", "", *evidence.table(names, (_row(cell, columns, run) for cell in cells))]
    return "\n".join([*lines, "", "## Stops and refusals", "", *(_reasons(run) or ["None in any flight."]), ""])


def _with(settings: Sequence[str]) -> str:
    return f", with `{' '.join(settings)}`" if settings else ""


def _target_table(run: GridRun, before: GridRun | None) -> tuple[tuple[str, ...], list[tuple[str, ...]]]:
    now = targets(run)
    if before is None:
        return ("Figure", "Target", "Found"), list(now)
    then = {figure: result for figure, _, result in targets(before)}
    return ("Figure", "Target", "Before", "Now"), [
        (figure, target, then.get(figure, ""), result) for figure, target, result in now
    ]


def _row(cell: str, columns: Sequence[Column], run: GridRun) -> list[str]:
    group, about = run.of(cell), CELLS[cell].about
    is_named = about.split() == cell.split("-", 1)  # a vehicle: its name says it
    what = "; ".join(part for part in ("" if is_named else about, _trouble(group)) if part)
    return [cell, *(show(group) for _, show in columns), str(worst_of(group).number), what]


def _fewest_and_most(run: GridRun) -> str:
    """Flights of a cell, as text: a number, or the least and the largest."""
    counts = sorted({len(run.of(cell)) for cell in run.cells})
    return f"{counts[0]}" if len(counts) == 1 else f"{counts[0]} to {counts[-1]}"


def _reasons(run: GridRun) -> list[str]:
    """Reasons of stops and refusals, the most frequent first, each with the cells in which it was given."""
    cells: dict[str, Counter[str]] = {}
    for flight in run.flights:
        if reason := flight.refused or _reason(flight.left):
            cells.setdefault(reason, Counter())[flight.cell] += 1
    ordered = sorted(cells.items(), key=lambda item: -item[1].total())
    return [f"* {reason}: {', '.join(f'{n} {cell}' for cell, n in counts.items())}" for reason, counts in ordered]


def _reason(left: str) -> str:
    """Mode and reason, without the time and the details that differ from flight to flight."""
    before, _, reason = left.partition(" s: ")
    return f"{before.partition(' after ')[0].rpartition(' ')[2]}: {reason.partition(':')[0]}" if left else ""
