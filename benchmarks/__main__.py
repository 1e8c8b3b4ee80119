"""`python -m benchmarks [NAME ...] [--json FILE] [--evidence] [--list]`: measure, print a table, write the rows. `robots` has
options and tables of its own: `python -m benchmarks robots --help`."""

import importlib
import inspect
import json
import os
import platform
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.table import Table

from benchmarks import evidence
from benchmarks.harness import ROOT, Row
from shoal.runtime.cli_options import finite
from shoal.runtime.output import terminal
from shoal.runtime.output_files import replace_text

# Name: a module of this package with `run() -> Iterable[Row]`, and what it measures.
BENCHMARKS = {
    "codec": ("shoal.codec", "a message to bytes, and bytes to a checked message"),
    "bus": ("shoal.bus", "there and back between two processes through the router"),
    "frames": ("shoal.frames", "camera frames between processes of one host: network and shared memory (2 minutes)"),
    "guard": ("shoal.guard", "the guard of a router with keys: there and back through it and past it"),
    "control_step": ("robot_agent.control_step", "one complete control step, closed loop, beside peers (3 minutes)"),
    "control_growth": ("robot_agent.control_growth", "a control step with more neighbours"),
    "observer": ("robot_agent.observer", "a step of the observer that tells a current from a force, beside the ESO's"),
    "agent": ("robot_agent.agent", "a robot's program: start to ready, memory, CPU at 20 Hz (1 minute)"),
    "neighbours": (
        "robot_agent.neighbours",
        "a robot's program that hears 0, 1 and 19 plans: processor time of a step (1 minute)",
    ),
    "robustness": (
        "robot_agent.robustness",
        "flights in currents, and with mass, drag, timing and localisation wrong at once (8 minutes)",
    ),
    "thrusters": (
        "robot_agent.thrusters",
        "how soon a broken thruster is noticed, and how often one that is not (10 minutes)",
    ),
    "error_budget": (
        "robot_agent.error_budget",
        "flights in which one source of error is exchanged for the truth (20 minutes)",
    ),
    "optimum": ("robot_agent.optimum", "whole runs of numeric scenes and `pool` beside the best possible (2 minutes)"),
    "localizer": ("localizer.frame", "the localizer per frame for 1 to 20 robots; its filter alone (2 minutes)"),
    "encounters": ("robot_agent.encounters", "robots in one another's way: 200 random starts of each scene (30 minutes)"),
    "simulation": ("simulation", "the plant, a frame, numeric flights, and lockstep with all processes (3 minutes)"),
    "accuracy": ("localizer.accuracy", "the localizer against the truth of rendered frames (10 minutes)"),
    "photoreal": (
        "localizer.photoreal",
        "the localizer on pictures by another renderer: tilt, waves, glare, covered plates (1 minute)",
    ),
    "recorder": (
        "groundstation.recorder",
        "the log of 20 robots and the camera's film: CPU, what is missing, control beside it, SIGKILL (2 minutes)",
    ),
    "planner": ("groundstation.planner", "planning and replanning, ways in a thousand random worlds (3 minutes)"),
    "page": ("groundstation.page", "the operator's page in Chromium: latency, frames, CPU with 2 and 49 robots (3 minutes)"),
}

# Name: a module of this package with a command line of its own, `main`, and what it measures.
PROGRAMS = {"robots": ("robots.program", "robots that nobody tuned for: a grid of numeric flights (10 minutes; --help)")}

TABLE_WIDTH = 120


def _table(rows: Sequence[Row]) -> Table:
    machine = f"{platform.machine()}, {os.cpu_count()} cores, Python {platform.python_version()}"
    table = Table(title=machine)
    for column in ("benchmark", "case", "subject", "p50", "p99", "max", "unit", "n"):
        table.add_column(column, justify="right" if column in ("p50", "p99", "max", "n") else "left")
    previous = ("", "")
    for row in rows:
        if previous not in (("", ""), (row.benchmark, row.case)):
            table.add_section()
        previous = (row.benchmark, row.case)
        figures = (f"{value:.3g}" if value < 1000 else f"{value:,.0f}" for value in (row.p50, row.p99, row.max))
        table.add_row(row.benchmark, row.case, row.subject, *figures, row.unit, str(row.n))
    return table


def _evidence(name: str, rows: Sequence[Row]) -> dict[str, Any]:
    """Content of a benchmark's file of evidence."""
    command = f"make evidence ARGS={name}"
    module = importlib.import_module(f"benchmarks.{BENCHMARKS[name][0]}")
    return {
        "name": name,
        "written": evidence.written_by(command),
        "seeds": ", ".join(map(str, getattr(module, "SEEDS", ()))),
        "about": inspect.getdoc(module) or "",
        "rows": [evidence.plain(row.as_dict()) for row in rows],
    }


def main(
    names: Annotated[list[str] | None, typer.Argument(help="which to run; all of them if none is named")] = None,
    json_file: Annotated[Path | None, typer.Option("--json", help="write the rows here as well")] = None,
    as_evidence: Annotated[bool, typer.Option("--evidence", help="write docs/evidence/NAME.md and NAME.json anew")] = False,
    minutes: Annotated[
        float | None, typer.Option(help="with `page` alone: watch it for so long instead, whether it grows", callback=finite)
    ] = None,
    show_list: Annotated[bool, typer.Option("--list", help="say which there are, and stop")] = False,
) -> None:
    """Measure ours beside its peers, in the same run."""
    if show_list:
        for name, (_, what) in {**BENCHMARKS, **PROGRAMS}.items():
            print(f"{name:12} {what}")
        return
    unknown = [name for name in names or () if name not in BENCHMARKS]
    if unknown:
        raise typer.BadParameter(f"{', '.join(unknown)}: no such benchmark (allowed: {', '.join(BENCHMARKS)})")
    for library in ("OMP", "OPENBLAS"):  # as every process of the fleet runs; numpy is not yet imported
        os.environ.setdefault(f"{library}_NUM_THREADS", "1")
    rows: list[Row] = []
    if minutes is not None:
        if names != ["page"]:
            raise typer.BadParameter("--minutes goes with `page` alone")
        rows.extend(importlib.import_module("benchmarks.groundstation.page_soak").run(minutes))
        names = []
    for name in BENCHMARKS if names is None else names:
        module, what = BENCHMARKS[name]
        print(f"{name}: {what} ...", file=sys.stderr)
        measured = list(importlib.import_module(f"benchmarks.{module}").run())
        rows.extend(measured)
        if as_evidence:
            content = _evidence(name, measured)
            evidence.write(ROOT / "docs" / "evidence" / name, evidence.of_benchmark(content), content)
    console = terminal()
    console.width = max(console.width, TABLE_WIDTH)  # a pipe has no width; a table that wraps cannot be read
    console.print(_table(rows))
    if json_file is not None:
        replace_text(json_file, json.dumps([row.as_dict() for row in rows], indent=1) + "\n")


if __name__ == "__main__":
    program = PROGRAMS.get(sys.argv[1]) if len(sys.argv) > 1 else None
    if program is None:
        typer.run(main)
    else:
        app = typer.Typer(add_completion=False)
        app.command()(importlib.import_module(f"benchmarks.{program[0]}").main)
        app(sys.argv[2:], prog_name=f"python -m benchmarks {sys.argv[1]}")
