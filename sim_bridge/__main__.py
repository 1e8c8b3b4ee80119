"""SHELL: `sim-bridge`: the pool in software, and whole experiments in it."""

import typer

from sim_bridge.compare_commands import compare, tune
from sim_bridge.conformance_shell import board_conformance
from sim_bridge.flight_commands import campaign, numeric, sil
from sim_bridge.pool_commands import board, pool
from wire.extras import run_role
from wire.options import Version
from wire.runtime import run_app

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
cli.command()(pool)
cli.command()(board)
cli.command("board-conformance")(board_conformance)
cli.command()(compare)
cli.command()(tune)


def app() -> None:
    """Entry point."""
    run_role(lambda: run_app(cli), "all")


if __name__ == "__main__":
    app()
