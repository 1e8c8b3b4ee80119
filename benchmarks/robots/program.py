"""`python -m benchmarks robots`: fly the grid on two cores, print its tables, write the evidence."""

import fnmatch
import json
import os
from collections.abc import Iterator, Sequence
from concurrent.futures import as_completed
from dataclasses import asdict, replace
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console

from benchmarks import evidence
from benchmarks.robots import report
from benchmarks.robots.report import GridRun
from shoal.config.experiment import load_experiment
from shoal.runtime.cli_options import finite
from shoal.runtime.output import terminal
from sim_bridge.studies.worker_pool import one_thread, worker_pool
from tests.flights.cells import CELLS, draw
from tests.flights.figures import FlightFigures, figures
from tests.flights.grid_flights import FlightLog, fly

EVIDENCE = Path(__file__).parents[2] / "docs" / "evidence" / "robots"
HOUR_S = 3600.0
WRITE_EVERY = 10  # flights


def main(
    cells: Annotated[str, typer.Option(metavar="NAME,...", help="Cells by name; * stands for anything.")] = "*",
    flights: Annotated[int, typer.Option(min=1, help="Flights of each cell, the same ones every time.")] = 12,
    flight: Annotated[int | None, typer.Option(min=0, help="Fly this one only, and say all about it.")] = None,
    law: Annotated[str, typer.Option(help="Control law: the same as --set controller.law=LAW.")] = "",
    settings: Annotated[list[str] | None, typer.Option("--set", metavar="KEY=VALUE", help="Any key of an experiment.")] = None,
    hold_s: Annotated[
        float, typer.Option(min=20.0, max=HOUR_S, help="Duration of HOLD; the target is for 600.", callback=finite)
    ] = 60.0,
    workers: Annotated[int, typer.Option(min=1, help="Flights at a time.")] = min(2, os.cpu_count() or 1),
    compare: Annotated[Path | None, typer.Option(exists=True, help="JSON of an earlier run, to show beside this one.")] = None,
    json_file: Annotated[
        Path | None, typer.Option("--json", help="Write all figures here, now and then on the way too.")
    ] = None,
    resume: Annotated[
        bool, typer.Option("--resume", help="Fly only what is not in the --json file of an earlier run.")
    ] = False,
    write: Annotated[bool, typer.Option("--write", help="Write docs/evidence/robots.md and robots.json.")] = False,
    show_list: Annotated[bool, typer.Option("--list", help="Name the cells, and stop.")] = False,
) -> None:
    """Fly robots that nobody tuned for through a grid of numeric flights (some ten minutes). Ctrl-C shows what was flown."""
    console = terminal()
    if show_list:
        for name in CELLS:
            print(f"{name:20} {CELLS[name].about}")
        return
    patterns = cells.split(",")
    chosen = [name for name in CELLS if any(fnmatch.fnmatchcase(name, pattern) for pattern in patterns)]
    unknown = [pattern for pattern in patterns if not fnmatch.filter(CELLS, pattern)]
    if unknown:
        raise typer.BadParameter(f"{', '.join(unknown)}: no such cell (--list names them)")
    if write and (cells != "*" or flight is not None):
        raise typer.BadParameter("--write needs all cells: leave --cells and --flight out")
    overrides = (*([f"controller.law={law}"] if law else []), *(settings or ()))
    one_thread()
    flown_law = _law(overrides)
    if flight is not None:
        for cell in chosen:
            _show(cell, flight, overrides, hold_s, console)
        return
    begun = GridRun(flown_law, overrides, hold_s, evidence.written_by("python -m benchmarks robots"), ())
    if resume:
        begun = _begun(begun, json_file)
    finished = {(figure.cell, figure.number) for figure in begun.flights}
    pairs = [(cell, number) for number in range(flights) for cell in chosen if (cell, number) not in finished]
    run = begun
    for figure in _fly_all(pairs, overrides, hold_s, workers, console):
        run = run.with_flight(figure)
        if json_file is not None and len(run.flights) % WRITE_EVERY == 0:
            evidence.write_json(json_file, report.as_json(run))
    if not run.flights:
        raise typer.Exit(130)
    before = report.from_json(json.loads(compare.read_text(encoding="utf-8"))) if compare is not None else None
    page = report.markdown(run, before)
    console.print(page, markup=False, highlight=False, soft_wrap=True)
    if write:
        evidence.write(EVIDENCE, report.markdown(run), report.as_json(run))
    if json_file is not None:
        evidence.write_json(json_file, report.as_json(run))


def _begun(run: GridRun, file: Path | None) -> GridRun:
    """The run with the flights of an earlier one. Raises BadParameter if that was flown otherwise."""
    if file is None or not file.exists():
        raise typer.BadParameter("--resume needs the --json file of an earlier run")
    earlier = report.from_json(json.loads(file.read_text(encoding="utf-8")))
    if (earlier.law, earlier.settings, earlier.hold_s) != (run.law, run.settings, run.hold_s):
        raise typer.BadParameter(
            f"--resume: {file} was flown with {earlier.law}, {earlier.settings}, --hold-s {earlier.hold_s:g}"
        )
    return replace(run, flights=earlier.flights)


def _law(overrides: Sequence[str]) -> str:
    """Control law and observer in words."""
    controller = load_experiment("straight", overrides).controller
    observer = getattr(controller.estimator, "kind", "eso")  # there may be only one
    return f"law {controller.law}, observer {observer}"


def _flown(cell: str, number: int, overrides: tuple[str, ...], hold_s: float) -> FlightFigures:
    """The figures of one flight. A law that raises is a finding, not the end of the grid."""
    plan = draw(cell, number, overrides)
    try:
        return figures(fly(plan, hold_s))
    except Exception as error:
        return figures(FlightLog(plan, 1.0 / plan.rate_hz, refused=f"{type(error).__name__}: {error}"))


def _fly_all(
    pairs: Sequence[tuple[str, int]], overrides: tuple[str, ...], hold_s: float, workers: int, console: Console
) -> Iterator[FlightFigures]:
    """Fly in worker processes, with progress. Ctrl-C ends it with the flights that are done."""
    count = 0
    with evidence.progress(console) as progress, worker_pool(workers) as pool:
        task = progress.add_task("flights", total=len(pairs))
        pending = [pool.submit(_flown, cell, number, overrides, hold_s) for cell, number in pairs]
        try:
            for future in as_completed(pending):
                figure = future.result()
                count += 1
                yield figure
                progress.advance(task)
                trouble = figure.refused or figure.left or ("never settled" if figure.never_settled else "")
                about = f"{figure.cell} {figure.number} ({figure.scene}, {figure.rate_hz} Hz)"
                if trouble or not console.is_terminal:
                    console.print(f"{count} of {len(pairs)}: {about} {trouble}", highlight=False, markup=False, soft_wrap=True)
        except KeyboardInterrupt:
            console.print(f"interrupted after {count} of {len(pairs)} flights")
            pool.shutdown(wait=False, cancel_futures=True)


def _show(cell: str, number: int, overrides: tuple[str, ...], hold_s: float, console: Console) -> None:
    """Fly one flight in this process; print its settings, figures, and each change of mode."""
    plan = draw(cell, number, overrides)
    print(f"{cell} {number}: {CELLS[cell].about}; {plan.scene} at {plan.speed_mps:.3f} m/s, {plan.rate_hz} Hz")
    print(f"fastest {plan.fastest_mps:.3f} m/s, current {plan.current_mps[0]:.3f}, {plan.current_mps[1]:.3f} m/s")
    for setting in plan.settings:
        print(f"  --set {setting}")
    log = fly(plan, hold_s)
    for i, states in enumerate(log.states):
        before = None
        for k, state in enumerate(states):
            if (state.mode, state.fault) != before:
                before = state.mode, state.fault
                x, y, z, _ = (log.truth[k, i] - log.path[k, i]).tolist()
                off = f"off its path by {1e3 * x:.0f}, {1e3 * y:.0f}, {1e3 * z:.0f} mm"
                print(f"robot {i + 1}, {(k + 1) * log.period_s:.2f} s: {state.mode.name} {state.fault} ({off})")
    for key, value in asdict(figures(log)).items():
        console.print(f"{key:14} {value}", markup=False)
