"""SHELL: `groundstation foxglove layout`, and where live viewers are served."""

import json
from pathlib import Path
from typing import Annotated

import typer

from shoal.errors import ConfigError
from shoal.runtime.cli_options import DEFAULT_FLEET, FleetName, experiments
from shoal.runtime.output_files import check_output, replace_text

foxglove_cli = typer.Typer(help="Viewers of the Foxglove family.", no_args_is_help=True, pretty_exceptions_enable=False)
LayoutFile = Annotated[Path | None, typer.Option("--out", metavar="FILE", help="Write it there instead of to stdout.")]
Foxglove = Annotated[
    str | None,
    typer.Option(
        metavar="HOST:PORT",
        help="Serve Foxglove-family viewers there, e.g. 127.0.0.1:8765. Viewers that reach it see all, and send nothing.",
    ),
]


@foxglove_cli.command("layout")
def foxglove_layout(
    experiment: Annotated[
        str,
        typer.Argument(
            metavar="EXPERIMENT", help="A shipped experiment, or a path ending in .toml.", autocompletion=experiments
        ),
    ] = "pool",
    out: LayoutFile = None,
    fleet: FleetName = DEFAULT_FLEET,
) -> None:
    """Print a layout for Foxglove, Lichtblick and their kin, for the robots of an experiment.

    Examples:  groundstation foxglove layout pool --out layout.json
               groundstation log export runs/pool-20260101-120000 --foxglove --out viewer
    """
    from groundstation.export.foxglove_layout import layout
    from shoal.config.experiment import experiment_path, load_experiment

    if out is not None:
        check_output(out, [experiment_path(experiment)])
    text = json.dumps(layout(load_experiment(experiment), fleet), indent=1) + "\n"
    if out is None:
        typer.echo(text, nl=False)
    else:
        replace_text(out, text)
        typer.echo(out)


def address(text: str) -> tuple[str, int]:
    """Host and port of `HOST:PORT`. Raises ConfigError."""
    host, _, port = text.rpartition(":")
    if not host or not port.isdecimal() or not 0 <= int(port) < 65536:
        raise ConfigError(f"--foxglove {text}: must be HOST:PORT, e.g. 127.0.0.1:8765")
    return host, int(port)
