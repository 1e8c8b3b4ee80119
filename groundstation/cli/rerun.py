"""SHELL: `groundstation log rerun`."""

import json
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from shoal.runtime.cli_options import AsJson, Settings, finite
from shoal.runtime.output import terminal

if TYPE_CHECKING:
    from groundstation.replay.step_diff import StepComparison


def rerun(
    run_folder: Annotated[Path, typer.Argument(metavar="RUN", help="Folder of a run.")],
    settings: Settings = None,
    robots: Annotated[list[int] | None, typer.Option("--robot", help="Only this robot. Repeatable.")] = None,
    figures: Annotated[Path | None, typer.Option(metavar="FOLDER", help="Draw both there, one PDF a robot.")] = None,
    as_json: AsJson = False,
) -> None:
    """Feed what the robots were told in a run to their program once more, and compare what it does with what it did.

    Nothing changed: the same to the last bit, on the same kind of machine. With --set: what it would have done. Its pulses
    move nothing, the next step's poses are again those of the log: `sim-bridge sil --from` shows where it would have led.
    Exit code 1 if nothing was changed and something differs, or the log does not hold all that it takes.

    Examples:  groundstation log rerun runs/pool-20260101-120000
               groundstation log rerun runs/pool-20260101-120000 --robot 1 --set controller.nmpc.turning_m=0.1 --figures out
    """
    from groundstation.replay.step_diff import draw
    from groundstation.replay.step_replay import rerun as do_again
    from groundstation.report.report import write_pdf

    found = do_again(run_folder, robots or (), settings or ())
    if figures is not None:
        figures.mkdir(parents=True, exist_ok=True)
        for again in found:
            figure = draw(again)
            if figure is not None:
                write_pdf(figure, figures / f"rerun-{again.robot}.pdf")
    if as_json:
        typer.echo(json.dumps([again.as_dict() for again in found], indent=1))
    else:
        _tell(found)
    raise typer.Exit(0 if settings or all(again.exact for again in found) else 1)


def moment(
    run_folder: Annotated[Path, typer.Argument(metavar="RUN", help="Folder of a run.")],
    at: Annotated[float, typer.Option(help="Seconds along the trajectories.", callback=finite)],
    robot: Annotated[int, typer.Option(help="Which robot.")],
) -> None:
    """Hand over to stdout what a robot had been through up to a moment, for `sim-bridge sil --from`."""
    from groundstation.replay.state_export import hand_over

    hand_over(run_folder, at, robot, sys.stdout.buffer)


def _tell(found: "list[StepComparison]") -> None:
    """The comparison as tables."""
    from rich.table import Table

    console = terminal()
    for again in found:
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
