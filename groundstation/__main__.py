"""SHELL: `groundstation`: plan, fly, record, report. The commands are in groundstation/cli."""

import typer

from groundstation.cli.deploy import deploy
from groundstation.cli.foxglove import foxglove_cli
from groundstation.cli.keys import keys_cli
from groundstation.cli.keys_of import keys_of
from groundstation.cli.mission import gains_cli, mission_cli, register
from groundstation.cli.replay import ended, replay
from groundstation.cli.run import plan, run
from groundstation.cli.run_list import delete, label, list_runs
from groundstation.cli.runs import benchmark_report, compare, export, repair, report
from groundstation.cli.stop import ProgramGroup, register_stop
from shoal.runtime.cli_options import Version
from shoal.runtime.optional_packages import run_role
from shoal.runtime.runtime import run_app

cli = typer.Typer(
    cls=ProgramGroup,
    help="Ground station: plans trajectories, commands the fleet, records everything, writes the report.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
)


@cli.callback()
def main(version: Version = False) -> None:
    """Ground station: plans trajectories, commands the fleet, records everything, writes the report."""


def _group(text: str) -> typer.Typer:
    return typer.Typer(help=text, no_args_is_help=True, pretty_exceptions_enable=False)


log_cli = _group("Recorded runs: list, label, delete, report, compare, export, repair, replay (docs/runs.md).")
for command in (report, compare, export, repair, replay):
    log_cli.command()(command)
log_cli.command("list")(list_runs)
log_cli.command()(label)
log_cli.command()(delete)
benchmark_cli = _group("Results of `sim-bridge compare`.")
benchmark_cli.command("report")(benchmark_report)

cli.command()(run)
cli.command()(plan)
cli.command()(keys_of)
cli.add_typer(mission_cli, name="mission")
register_stop(cli)
register(cli, "end")
cli.add_typer(gains_cli, name="gains")
cli.add_typer(log_cli, name="log")
cli.add_typer(benchmark_cli, name="benchmark")
cli.add_typer(keys_cli, name="keys")
cli.command()(deploy)
cli.add_typer(foxglove_cli, name="foxglove")
cli.command(hidden=True)(ended)


def app() -> None:
    """Entry point."""
    run_role(lambda: run_app(cli), "station")


if __name__ == "__main__":
    app()
