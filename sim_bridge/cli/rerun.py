"""SHELL: `sim-bridge rerun`."""

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from shoal.runtime.cli_options import AsJson, RunFolder, Settings
from shoal.runtime.output import terminal
from shoal.system.printable import printable

if TYPE_CHECKING:
    from sim_bridge.replay.step_diff import StepComparison


def rerun(
    run_folder: RunFolder,
    settings: Settings = None,
    robots: Annotated[list[int] | None, typer.Option("--robot", help="Only this robot. Repeatable.")] = None,
    figures: Annotated[Path | None, typer.Option(metavar="FOLDER", help="Draw both there, one PDF a robot.")] = None,
    as_json: AsJson = False,
) -> None:
    """Give each robot's agent its recorded inputs again, and compare what it does with what it did.

    Nothing changed: the same to the last bit, on the same kind of machine. With --set: what it would have done. Its pulses
    move nothing, the next step's poses are again those of the log: `sim-bridge sil --from` shows where it would have led.
    Exit code 1 if nothing was changed and something differs, or the log does not hold all that it takes.

    Examples:  sim-bridge rerun runs/pool-20260101-120000
               sim-bridge rerun runs/pool-20260101-120000 --robot 1 --set controller.nmpc.turning_m=0.1 --figures out
    """
    from groundstation.logs.reader import read_log
    from groundstation.report.report import write_pdf
    from sim_bridge.replay.step_diff import draw
    from sim_bridge.replay.step_replay import rerun as do_again

    comparisons = do_again(run_folder, robots or (), settings or ())
    trouble = read_log(run_folder / "run.mcap", ()).trouble
    if figures is not None:
        figures.mkdir(parents=True, exist_ok=True)
        for again in comparisons:
            figure = draw(again)
            if figure is not None:
                write_pdf(figure, figures / f"rerun-{again.robot}.pdf")
    if as_json:
        typer.echo(json.dumps([again.as_dict() for again in comparisons], indent=1))
    else:
        _print_comparisons(comparisons)
    if trouble:
        typer.echo(printable(trouble), err=True)
    raise typer.Exit(0 if not trouble and (settings or all(again.exact for again in comparisons)) else 1)


def _print_comparisons(comparisons: "list[StepComparison]") -> None:
    """Print a table of the fields that differ for each robot, and the gaps of the log."""
    from rich.table import Table

    console = terminal()
    for again in comparisons:
        title = f"robot {again.robot}: {again.compared} of {again.steps} steps compared"
        for gap in again.left_out:
            console.print(f"robot {again.robot}: {gap}", soft_wrap=True)
        if not again.differing:
            console.print(f"{title}: no difference")
            continue
        table = Table(title=f"{title}, {again.differing} differ")
        for column in ("", "steps", "first at", "largest", "RMS"):
            table.add_column(column, justify="left" if not column else "right")
        for d in again.differences:
            figures = (f"{value:.3g}" if value is not None else "–" for value in (d.largest, d.rms))
            table.add_row(d.field, str(d.steps), f"{d.first_s:.2f} s", *figures)
        console.print(table)
