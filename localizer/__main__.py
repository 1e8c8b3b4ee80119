"""SHELL: the command line `localizer`: track robots in an overhead camera's frames, calibrate and check the camera."""

from pathlib import Path
from typing import Annotated

import typer

from localizer.calibration.cli import calibrate, check, print_markers
from localizer.evaluation.cli import SourceName, evaluate, latency, rerun, track
from localizer.setup.cli import setup
from shoal.runtime.cli_options import (
    DEFAULT_FLEET,
    DEFAULT_STATION,
    CameraName,
    ExperimentName,
    FleetName,
    FrameRingOption,
    Insecure,
    KeyRing,
    Settings,
    StationAddress,
    Verbose,
    Version,
)
from shoal.runtime.optional_packages import run_role
from shoal.runtime.runtime import Stop, run_app, start_log

cli = typer.Typer(
    help="Localizer: tracks the robots from an overhead camera and publishes their poses.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
)


@cli.callback()
def main(version: Version = False) -> None:
    """Localizer: tracks the robots from an overhead camera and publishes their poses."""


@cli.command()
def run(
    experiment: ExperimentName,
    station: StationAddress = DEFAULT_STATION,
    fleet: FleetName = DEFAULT_FLEET,
    settings: Settings = None,
    source: SourceName = "bus",
    publish_frames: Annotated[bool, typer.Option("--publish-frames", help="Put an own camera's pictures on the bus.")] = False,
    show: Annotated[bool, typer.Option("--show", help="Annotated pictures for a browser on this machine.")] = False,
    show_port: Annotated[int, typer.Option(help="Where --show serves them, on 127.0.0.1.")] = 8090,
    record: Annotated[
        Path | None,
        typer.Option(metavar="FOLDER", help="Keep raw frames and all that poses come from there, for `rerun` and `track`."),
    ] = None,
    camera: CameraName = "",
    frame_ring: FrameRingOption = None,
    keys: KeyRing = None,
    insecure: Insecure = False,
    verbose: Verbose = False,
) -> None:
    """Localize the robots of an experiment in the fleet's camera frames, or be the camera. Of several cameras each has a
    localizer of its own, and `localizer fuse` publishes the robots' poses.

    Examples:  localizer run pool --show          localizer run lab.toml --source v4l2:/dev/video0 --publish-frames
    """
    import cv2

    from localizer import node
    from shoal.bus.network import endpoint
    from shoal.config.experiment import load_experiment
    from shoal.messages.topics import Role, localizer_name, process_name

    start_log(localizer_name(camera), verbose)
    # Regions are small, and more threads only compete with the other processes of the machine.
    cv2.setNumThreads(1)
    loaded = load_experiment(experiment, settings or ())
    options = node.NodeOptions(source, publish_frames, show_port if show else None, frame_ring, record, camera)
    where = endpoint(station, process_name(Role.LOCALIZER), keys, insecure=insecure)
    node.run(loaded, where, fleet, Stop(), options)


@cli.command()
def fuse(
    experiment: ExperimentName,
    station: StationAddress = DEFAULT_STATION,
    fleet: FleetName = DEFAULT_FLEET,
    settings: Settings = None,
    keys: KeyRing = None,
    insecure: Insecure = False,
    verbose: Verbose = False,
) -> None:
    """Fuse the poses that the localizers of several cameras publish (docs/several-cameras.md).

    Example:  localizer fuse two-cameras
    """
    from localizer import fusion_node
    from shoal.bus.network import endpoint
    from shoal.config.experiment import load_experiment
    from shoal.messages.topics import Role, process_name

    start_log("localizer", verbose)
    where = endpoint(station, process_name(Role.LOCALIZER), keys, insecure=insecure)
    fusion_node.run(load_experiment(experiment, settings or ()), where, fleet, Stop())


cli.command()(calibrate)
cli.command()(check)
cli.command()(setup)
cli.command()(print_markers)
cli.command()(latency)
cli.command()(evaluate)
cli.command()(track)
cli.command()(rerun)


def app() -> None:
    """Entry point of the installed command."""
    run_role(lambda: run_app(cli), "localizer")


if __name__ == "__main__":
    app()
