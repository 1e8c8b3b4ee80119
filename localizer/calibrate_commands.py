"""SHELL: the command line of `localizer calibrate` and `localizer check`."""

from contextlib import ExitStack
from pathlib import Path
from typing import Annotated

import typer

from wire.experiment import load_experiment
from wire.options import DEFAULT_FLEET, DEFAULT_STATION, ExperimentName, FleetName, Settings, StationAddress


def calibrate(
    sources: Annotated[
        list[Path] | None,
        typer.Argument(
            metavar="[PICTURES...]", help="Files, folders or videos that show the board, in air.", show_default=False
        ),
    ] = None,
    board: Annotated[
        str | None,
        typer.Option(help="chessboard:9x6:0.03 (inner corners, m) or charuco:7x5:0.04:0.03:DICT_4X4_50 (squares, m)."),
    ] = None,
    every: Annotated[int, typer.Option(min=1, help="Of a video, the sharpest of each so many frames.")] = 15,
    lens: Annotated[Path | None, typer.Option(metavar="FILE", help="Take the lens from an earlier camera file.")] = None,
    pool_points: Annotated[
        Path | None, typer.Option(metavar="FILE", help="TOML: at least four points of the pool, and where they are seen.")
    ] = None,
    pool_points_image: Annotated[
        Path | None, typer.Option(metavar="FILE", help="The picture that they are seen in, if the file names no other.")
    ] = None,
    rate: Annotated[
        float | None, typer.Option(min=1, max=240, help="Written down: pictures per second; 20 if not known.")
    ] = None,
    exposure: Annotated[
        float | None, typer.Option(min=1e-5, max=0.05, help="Written down: exposure in s; 0.008 if not known.")
    ] = None,
    water_index: Annotated[
        float | None, typer.Option(min=1, max=2, help="Refractive index: 1.333 in fresh water (default), 1.34 in sea water.")
    ] = None,
    out: Annotated[Path, typer.Option(help="The camera file; a picture goes beside it.")] = Path("camera.toml"),
) -> None:
    """Find lens and pose of a camera from pictures of a board and points of the pool (docs/calibration.md).

    Examples:  localizer calibrate board/ --board chessboard:9x6:0.03 --pool-points points.toml
    localizer calibrate --lens camera.toml --pool-points points.toml --out moved.toml
    """
    from localizer.calibrate_shell import Request
    from localizer.calibrate_shell import calibrate as run

    files = tuple(sources or ())
    request = Request(
        files, board, every, lens, pool_points, pool_points_image, out,
        rate_hz=rate, exposure_s=exposure, water_index=water_index,
    )  # fmt: skip
    typer.echo("\n".join(run(request)))


def check(
    experiment: ExperimentName,
    image: Annotated[Path | None, typer.Option(metavar="FILE", help="A picture of the experiment's camera.")] = None,
    live: Annotated[bool, typer.Option("--live", help="Take the newest frame from the bus instead.")] = False,
    depth: Annotated[float, typer.Option(min=-1, max=20, help="Depth of the grid, m.")] = 0.3,
    out: Annotated[Path, typer.Option(help="The picture to write.")] = Path("check.png"),
    station: StationAddress = DEFAULT_STATION,
    fleet: FleetName = DEFAULT_FLEET,
    settings: Settings = None,
) -> None:
    """Draw the pool's grid where the calibration puts it, over a picture, or on black: does it lie on the pool?

    Examples:  localizer check lab.toml --image pool.png          localizer check pool --live
    """
    from localizer.board_files import read_picture
    from localizer.calibrate_shell import check_camera, live_picture
    from wire.bus import Bus
    from wire.runtime import Stop
    from wire.transport import Endpoint, ZenohTransport

    loaded = load_experiment(experiment, settings or ())
    if live and image is not None:
        raise typer.BadParameter("give --live or --image, not both")
    with ExitStack() as stack:
        picture = None if image is None else read_picture(image)
        if live:
            typer.echo(f"Waiting for a frame through the station at {station} ...", err=True)
            picture = live_picture(stack.enter_context(Bus(ZenohTransport(Endpoint(station)), fleet)), Stop())
    what = "the newest frame" if live else str(image)
    typer.echo("\n".join(check_camera(loaded, picture, what, depth, out)))
