"""SHELL: `localizer`: finds the robots in the overhead camera's pictures."""

import typer

from wire.experiment import load_experiment
from wire.options import (
    DEFAULT_FLEET,
    DEFAULT_STATION,
    ExperimentName,
    FleetName,
    LockstepMode,
    Settings,
    StationAddress,
    Verbose,
)
from wire.runtime import Stop, run_app, start_log

cli = typer.Typer(
    help="Localizer: tracks the robots from an overhead camera and publishes their poses.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
)


@cli.callback()
def main() -> None:
    """Localizer: tracks the robots from an overhead camera and publishes their poses."""


@cli.command()
def run(
    experiment: ExperimentName,
    station: StationAddress = DEFAULT_STATION,
    fleet: FleetName = DEFAULT_FLEET,
    settings: Settings = None,
    lockstep: LockstepMode = False,
    verbose: Verbose = False,
) -> None:
    """Localize the robots of an experiment in the frames that the fleet's camera publishes."""
    from localizer.shell import Shell
    from wire.bus import Bus
    from wire.transport import Endpoint, ZenohTransport

    start_log("localizer", verbose)
    stop = Stop()
    loaded = load_experiment(experiment, settings or ())
    with Bus(ZenohTransport(Endpoint(station, lossless=lockstep)), fleet) as bus:
        Shell(loaded, bus, stop, lockstep).run()


def app() -> None:
    """Entry point."""
    run_app(cli)


if __name__ == "__main__":
    app()
