"""SHELL: `groundstation`: plan, fly, record, report. The commands are in the modules *_commands.py."""

import typer

from groundstation.deploy_commands import deploy
from groundstation.flight_commands import plan, run
from groundstation.keys_commands import keys_cli
from groundstation.order_commands import come_back, end, go, order, phases, stop, tune
from groundstation.replay_commands import replay
from groundstation.rerun_commands import moment, rerun
from groundstation.run_commands import compare, comparison, export, record, recover, report
from groundstation.viewer_commands import foxglove_layout
from wire.extras import run_role
from wire.options import Version
from wire.runtime import run_app

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
