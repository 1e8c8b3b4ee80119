"""SHELL: `sim-bridge`: the pool in software, and whole experiments in it."""

import typer

from shoal.runtime.cli_options import Version
from shoal.runtime.optional_packages import run_role
from shoal.runtime.runtime import run_app
from sim_bridge.board_conformance.cli import board_conformance
from sim_bridge.cli.compare import compare, tune
from sim_bridge.cli.new import new
from sim_bridge.cli.pool import board, hil, pool
from sim_bridge.cli.rerun import rerun
from sim_bridge.cli.sil import campaign, numeric, sil

cli = typer.Typer(
    help="The pool in software: water, robots, thruster boards and an overhead camera, on the same wires as the real ones.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
)


@cli.callback()
def main(version: Version = False) -> None:
    """The pool in software, on the same wires as the real one."""


cli.command()(sil)
cli.command()(numeric)
cli.command()(campaign)
cli.command()(rerun)
cli.command()(new)
cli.command()(pool)
cli.command()(hil)
cli.command()(board)
cli.command("board-conformance")(board_conformance)
cli.command()(compare)
cli.command()(tune)


def app() -> None:
    """Entry point."""
    run_role(lambda: run_app(cli), "all")


if __name__ == "__main__":
    app()
