"""SHELL: the command line of `localizer setup`."""

from contextlib import ExitStack, closing
from pathlib import Path
from typing import Annotated

import typer

from shoal.runtime.cli_options import (
    DEFAULT_FLEET,
    DEFAULT_STATION,
    ExperimentName,
    FleetName,
    FrameRingOption,
    Insecure,
    KeyRing,
    StationAddress,
    Verbose,
)


def setup(
    experiment: ExperimentName,
    camera: Annotated[
        str, typer.Option(help="The camera: bus, v4l2:/dev/video0, video:FILE[:FPS], folder:DIR[:FPS].")
    ] = "bus",
    out: Annotated[
        Path | None, typer.Option(metavar="FILE", help="A new file for what is found; needed for a shipped experiment.")
    ] = None,
    port: Annotated[int, typer.Option(min=0, max=65535, help="Where the page is served, on 127.0.0.1; 0: anywhere.")] = 8092,
    station: StationAddress = DEFAULT_STATION,
    fleet: FleetName = DEFAULT_FLEET,
    frame_ring: FrameRingOption = None,
    keys: KeyRing = None,
    insecure: Insecure = False,
    verbose: Verbose = False,
) -> None:
    """Set up a camera in a browser: light, focus, lens, pose, masks; then see the changes and save them. Prints the address.

    A file without the table `camera` gets one when lens and pose are found.

    Examples:  localizer setup lab.toml --camera v4l2:/dev/video0          localizer setup pool --out lab.toml
    """
    import secrets

    from localizer.setup.camera_feed import CameraFeed
    from localizer.setup.experiment_file import ExperimentFile
    from localizer.setup.server import SetupServer
    from localizer.setup.session import SetupSession
    from localizer.sources.base import FrameSource
    from localizer.sources.bus import BusSource
    from localizer.sources.factory import BUS, open_own
    from localizer.sources.v4l2_controls import V4l2Controls
    from localizer.view.local_server import bind
    from shoal.bus.bus import Bus
    from shoal.bus.frame_ring import codec_of
    from shoal.bus.network import endpoint
    from shoal.bus.zenoh_transport import ZenohTransport
    from shoal.config.experiment import NO_CAMERA, experiment_path, load_experiment
    from shoal.messages.topics import Role, process_name
    from shoal.runtime.runtime import Stop, WallClock, start_log

    start_log("localizer", verbose)
    file = ExperimentFile(experiment_path(experiment), out)
    loaded = load_experiment(experiment, () if file.has_camera else [NO_CAMERA])
    clock, stop = WallClock(), Stop()
    kind, _, device = camera.partition(":")
    with ExitStack() as stack:
        bound = stack.enter_context(closing(bind(port, "--port")))
        if camera == BUS:
            typer.echo(f"Pictures come through the station at {station}.", err=True)
            where = endpoint(station, process_name(Role.LOCALIZER), keys, insecure=insecure)
            bus = stack.enter_context(Bus(ZenohTransport(where, stop), fleet, *codec_of(frame_ring)))
            source: FrameSource = BusSource(bus, clock, loaded.camera.rate_hz)
        else:
            source = open_own(camera, loaded.camera, clock, "--camera")
        session = SetupSession(loaded, file, camera, V4l2Controls(device) if kind == "v4l2" else None)
        feed = stack.enter_context(closing(CameraFeed(source, session, stop)))
        server = SetupServer(session, feed, bound, secrets.token_urlsafe(16))
        typer.echo(f"Set up the camera at {server.address} (Ctrl-C ends it)")
        server.run(stop)
    stop.raise_failure()
