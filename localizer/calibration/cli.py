"""SHELL: the command line of `localizer calibrate`, `localizer check` and `localizer print-markers`."""

import re
from contextlib import ExitStack, closing
from pathlib import Path
from typing import Annotated, cast, get_args

import typer

from shoal.errors import ConfigError
from shoal.runtime.cli_options import (
    DEFAULT_FLEET,
    DEFAULT_STATION,
    CameraName,
    ExperimentName,
    FleetName,
    Insecure,
    KeyRing,
    Settings,
    StationAddress,
    finite,
)
from shoal.runtime.output_files import check_output

Grey = Annotated[bool, typer.Option("--grey", help="Pictures of one channel are grey; otherwise they are raw Bayer RGGB.")]


def calibrate(
    sources: Annotated[
        list[Path] | None,
        typer.Argument(metavar="PICTURES", help="Files, folders or videos that show the board, in air.", show_default=False),
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
        float | None, typer.Option(min=1, max=240, help="Written down: pictures per second; 20 if not known.", callback=finite)
    ] = None,
    exposure: Annotated[
        float | None,
        typer.Option(min=1e-5, max=0.05, help="Written down: exposure in s; 0.008 if not known.", callback=finite),
    ] = None,
    water_index: Annotated[
        float | None,
        typer.Option(
            min=1, max=2, help="Refractive index: 1.333 in fresh water (default), 1.34 in sea water.", callback=finite
        ),
    ] = None,
    grey: Grey = False,
    out: Annotated[
        Path,
        typer.Option(help="The camera file; a picture goes beside it. A file that is there keeps what is not found anew."),
    ] = Path("camera.toml"),
    force: Annotated[bool, typer.Option("--force", help="Write a lens that the report warns against.")] = False,
) -> None:
    """Find lens and pose of a camera from pictures of a board and points of the pool (docs/calibration.md).

    Examples:  localizer calibrate board/ --board chessboard:9x6:0.03 --pool-points points.toml
    localizer calibrate --lens camera.toml --pool-points points.toml --out moved.toml
    """
    from localizer.calibration.workflow import CalibrationRequest
    from localizer.calibration.workflow import calibrate as run

    files = tuple(sources or ())
    request = CalibrationRequest(
        files, board, every, lens, pool_points, pool_points_image, out,
        rate_hz=rate, exposure_s=exposure, water_index=water_index, grey=grey, force=force,
    )  # fmt: skip
    report = run(request)
    typer.echo("\n".join(report.lines))
    if report.refusal:
        typer.echo(report.refusal, err=True)
        raise typer.Exit(1)


def print_markers(
    ids: Annotated[str, typer.Option(metavar="LIST", help="Their ids: 1-6, or 0,3,7-9.")],
    size: Annotated[float, typer.Option(help="Side of the black square, mm.", callback=finite)] = 60.0,
    dictionary: Annotated[str, typer.Option(help="4x4_50 or apriltag_36h11, as localizer.marker_family.")] = "4x4_50",
    paper: Annotated[str, typer.Option(help="A4 or A3.")] = "A4",
    out: Annotated[
        Path, typer.Option("--out", "-o", help="The file to write: .pdf, or .svg for what fits on one sheet.")
    ] = Path("markers.pdf"),
) -> None:
    """Draw markers for robots and survey points on sheets at true scale, with a ruler to check the printer by.

    Examples:  localizer print-markers --ids 1-6          localizer print-markers --ids 40-43 --size 200 --paper A3
    """
    from localizer.calibration.marker_sheet import as_pdf, as_svg, marker_sheets, mirrored_ids
    from shoal.config.perception import MarkerFamily
    from shoal.runtime.output_files import replacing

    families = get_args(MarkerFamily)
    if dictionary not in families:
        raise ConfigError(f"--dictionary {dictionary}: not known (allowed: {', '.join(families)})")
    if out.suffix not in (".pdf", ".svg"):
        raise ConfigError(f"--out {out}: must end in .pdf or .svg")
    check_output(out)
    family = cast(MarkerFamily, dictionary)
    numbers, mirrored = _numbers(ids), mirrored_ids(family)
    left_out = [number for number in numbers if number in mirrored]
    if left_out == numbers:
        why = f"the markers {', '.join(map(str, mirrored))} are read in a mirror too, so that a reflection looks like a robot"
        raise ConfigError(f"--ids {ids}: {why} (take others; robots.marker_id says which one a robot has)")
    sheets = marker_sheets([number for number in numbers if number not in mirrored], size, family, paper)
    if out.suffix == ".svg" and len(sheets) > 1:
        raise ConfigError(f"--out {out}: they need {len(sheets)} sheets, and an SVG has one (write a .pdf, or take fewer)")
    with replacing(out) as file:
        file.write(as_pdf(sheets) if out.suffix == ".pdf" else as_svg(sheets[0]).encode())
    typer.echo(f"Wrote {out}: {len(sheets)} sheet{'s' if len(sheets) > 1 else ''}. Print at 100 %, and measure the ruler.")
    if left_out:
        typer.echo(
            f"Left out: {', '.join(map(str, left_out))}, which are read in a mirror too, so that a reflection looks like a "
            "robot. Give those robots another marker: robots.marker_id."
        )


def _numbers(text: str) -> list[int]:
    """The numbers of a list such as `0,3,7-9`, each once. Raises ConfigError."""
    numbers: list[int] = []
    for part in text.split(","):
        match = re.fullmatch(r"\s*(\d{1,4})\s*(?:-\s*(\d{1,4})\s*)?", part)
        first, last = (int(match[1]), int(match[2] or match[1])) if match else (0, -1)
        if last < first:
            raise ConfigError(f"--ids {text}: must be a list of ids and ranges, for example 1-6 or 0,3,7-9")
        numbers += range(first, last + 1)
    return list(dict.fromkeys(numbers))


def check(
    experiment: ExperimentName,
    image: Annotated[Path | None, typer.Option(metavar="FILE", help="A picture of the experiment's camera.")] = None,
    grey: Grey = False,
    live: Annotated[bool, typer.Option("--live", help="Take the newest frame from the bus instead.")] = False,
    show: Annotated[bool, typer.Option("--show", help="Every new frame, in a browser of this machine, until Ctrl-C.")] = False,
    show_port: Annotated[int, typer.Option(help="Where --show serves them, on 127.0.0.1.")] = 8091,
    depth: Annotated[float, typer.Option(min=-1, max=20, help="Depth of the grid, m.", callback=finite)] = 0.3,
    out: Annotated[Path, typer.Option(help="The picture to write.")] = Path("check.png"),
    station: StationAddress = DEFAULT_STATION,
    fleet: FleetName = DEFAULT_FLEET,
    keys: KeyRing = None,
    insecure: Insecure = False,
    camera: CameraName = "",
    settings: Settings = None,
) -> None:
    """Draw the pool's grid where the calibration puts it, over a picture, or on black: does it lie on the pool?

    Examples:  localizer check lab.toml --image pool.png          localizer check pool --show
    """
    from localizer.calibration.images import read_picture
    from localizer.calibration.verify import LivePictures, check_camera, show_live
    from localizer.view.mjpeg_server import MjpegServer
    from shoal.bus.bus import Bus
    from shoal.bus.network import endpoint
    from shoal.bus.zenoh_transport import ZenohTransport
    from shoal.config.experiment import experiment_path, load_experiment
    from shoal.messages.topics import Role, process_name
    from shoal.runtime.runtime import Stop, start_log

    loaded = load_experiment(experiment, settings or ()).of_camera(camera)
    check_output(out, [experiment_path(experiment), *([image] if image is not None else [])])
    if image is not None and (live or show):
        raise typer.BadParameter("give --image, or --live or --show, not both")
    if not (live or show):
        picture = None if image is None else read_picture(image, grey)
        typer.echo("\n".join(check_camera(loaded, picture, str(image), depth, out)))
        return
    start_log("localizer", False)
    stop = Stop()
    with ExitStack() as stack:
        page = stack.enter_context(closing(MjpegServer(show_port, stop))) if show else None
        typer.echo(f"Waiting for a frame through the station at {station} ...", err=True)
        where = endpoint(station, process_name(Role.LOCALIZER), keys, insecure=insecure)
        pictures = LivePictures(stack.enter_context(Bus(ZenohTransport(where, stop), fleet)), camera)
        picture = pictures.next(stop)
        if picture is not None:
            typer.echo("\n".join(check_camera(loaded, picture, "the newest frame", depth, out)))
        if page is not None:
            show_live(loaded, pictures, page, depth, stop)
