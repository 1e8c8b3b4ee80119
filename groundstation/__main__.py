"""SHELL: `groundstation`: plan, fly, record, report. The commands are in the modules *_commands.py."""

import typer

from groundstation.cli.deploy import deploy
from groundstation.cli.foxglove import foxglove_layout
from groundstation.cli.keys import keys_cli
from groundstation.cli.mission import come_back, end, go, order, phases, stop, tune
from groundstation.cli.replay import replay
from groundstation.cli.rerun import moment, rerun
from groundstation.cli.run import plan, run
from groundstation.cli.runs import compare, comparison, export, record, recover, report
from wire.process.cli_options import Version
from wire.process.optional_packages import run_role
from wire.process.runtime import run_app

cli = typer.Typer(
    help="Ground station: plans trajectories, commands the fleet, records everything, writes the report.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
)


@cli.callback()
def main(version: Version = False) -> None:
    """Ground station: plans trajectories, commands the fleet, records everything, writes the report."""


for command in (
    run,
    plan,
    order,
    stop,
    end,
    phases,
    replay,
    rerun,
    report,
    compare,
    comparison,
    export,
    recover,
    record,
    deploy,
):
    cli.command()(command)
cli.command("return")(come_back)
cli.command("set")(tune)
cli.command(context_settings={"ignore_unknown_options": True})(go)  # places may be negative
cli.command()(foxglove_layout)
cli.command(hidden=True)(moment)
cli.add_typer(keys_cli, name="keys")


def app() -> None:
    """Entry point."""
    run_role(lambda: run_app(cli), "station")


if __name__ == "__main__":
    app()
