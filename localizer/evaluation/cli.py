"""SHELL: the command line of `localizer latency`, `localizer evaluate` and `localizer track`."""

from contextlib import ExitStack, closing
from functools import partial
from pathlib import Path
from typing import Annotated

import typer

from wire.config.experiment import experiment_path, load_experiment
from wire.process.cli_options import (
    DEFAULT_FLEET,
    DEFAULT_STATION,
    ExperimentName,
    FleetName,
    Insecure,
    KeyRing,
    Settings,
    StationAddress,
)
from wire.process.output_files import check_output, replace_text
from wire.toml_loader import ConfigError

SourceName = Annotated[
    str,
    typer.Option(
        "--source",
        metavar="SOURCE",
        help="Where pictures come from: `bus`, `v4l2:/dev/video0`, `video:FILE[:FPS|:max]` or `folder:DIR[:FPS|:max]`.",
    ),
]
JsonFile = Annotated[Path | None, typer.Option("--json", metavar="FILE", help="Write the figures there too.")]


def latency(
    experiment: ExperimentName,
    source: SourceName = "bus",
    seconds: Annotated[float, typer.Option(min=0.5, help="How long to measure.")] = 5.0,
    json: JsonFile = None,
    station: StationAddress = DEFAULT_STATION,
    fleet: FleetName = DEFAULT_FLEET,
    keys: KeyRing = None,
    insecure: Insecure = False,
    settings: Settings = None,
) -> None:
    """Measure how old poses are and how even the pictures come. Exit code 1 if something is not as it should be.

    Example:  localizer latency lab.toml --source v4l2:/dev/video0
    """
    import cv2

    from localizer.evaluation.latency import assess, localize_in_process, measure
    from localizer.sources.factory import BUS, open_bus, open_own
    from wire.messages.topics import Role, process_name
    from wire.process.runtime import Stop, WallClock, start_log
    from wire.transport.bus import Bus
    from wire.transport.network import endpoint
    from wire.transport.zenoh_transport import ZenohTransport

    start_log("localizer")
    if json is not None:
        check_output(json, [experiment_path(experiment), *([Path(source.split(":")[1])] if ":" in source else [])])
    cv2.setNumThreads(1)  # as `run`
    loaded, clock = load_experiment(experiment, settings or ()), WallClock()
    stop = Stop()
    with ExitStack() as stack:
        if source == BUS:
            where = endpoint(station, process_name(Role.LOCALIZER), keys, insecure=insecure)
            bus = stack.enter_context(Bus(ZenohTransport(where, stop), fleet))
            pictures = open_bus(bus, clock, stop, loaded.camera.rate_hz, {})
        else:
            pictures = open_own(source, loaded.camera, clock)
        stack.enter_context(closing(pictures))
        timings, dropped = measure(pictures, partial(localize_in_process, loaded, clock, stop), clock, seconds)
        trouble = pictures.trouble
    result = assess(timings, dropped, loaded.camera.rate_hz)
    if result is None:
        typer.echo(f"no pictures within {seconds:g} s{f': {trouble}' if trouble else ''}", err=True)
        raise typer.Exit(1)
    typer.echo(result.to_text())
    if json is not None:
        replace_text(json, result.to_json())
    raise typer.Exit(1 if result.warnings else 0)


def evaluate(
    recording: Annotated[Path, typer.Argument(metavar="RECORDING", help="A video, or a run's log (run.mcap).")],
    truth: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="idTracker's text for a plain video; with --experiment a CSV of poses per frame."),
    ] = None,
    experiment: Annotated[
        str | None, typer.Option(metavar="EXPERIMENT", help="The video shows this experiment's pool: localize in metres.")
    ] = None,
    marker: Annotated[bool, typer.Option(help="Read markers (with --experiment).")] = True,
    box: Annotated[float, typer.Option(min=8, help="Side of a plain video's target, pixels.")] = 64.0,
    frames: Annotated[int | None, typer.Option(min=2, help="Look at the first so many only.")] = None,
    json: JsonFile = None,
    settings: Settings = None,
) -> None:
    """Print a table of the localizer's errors against a known truth.

    Examples:  localizer evaluate runs/pool-20260101-120000/run.mcap
    localizer evaluate mouse.mp4 --truth mouse_idtracked.txt --frames 3000
    localizer evaluate pool.mkv --truth poses.csv --experiment lab.toml --no-marker
    """
    import cv2

    from localizer.evaluation import runner

    if json is not None:
        read = [recording, *([truth] if truth is not None else [])]
        check_output(json, [*read, *([experiment_path(experiment)] if experiment is not None else [])])
    cv2.setNumThreads(1)  # as `run`

    if recording.suffix == ".mcap":
        rows: runner.Rows = runner.evaluate_log(recording)
    elif truth is None:
        raise ConfigError(f"{recording}: no log (a run's is RUN/run.mcap), and a video needs --truth FILE")
    elif experiment is None:
        rows = runner.evaluate_plain(recording, truth, box, frames)
    else:
        loaded = load_experiment(experiment, [*(settings or ()), f"localizer.markers={str(marker).lower()}"])
        rows = runner.evaluate_pool(recording, truth, loaded, frames)
    typer.echo(runner.table(rows))
    if json is not None:
        replace_text(json, runner.to_json(rows))


def track(
    video: Annotated[Path, typer.Argument(metavar="VIDEO", help="A video of the experiment's pool.")],
    experiment: Annotated[str, typer.Option(metavar="EXPERIMENT", help="Camera, robots and pool.")],
    out: Annotated[Path, typer.Option(metavar="FILE", help="The table to write: a row for each robot and frame, CSV.")],
    resume: Annotated[bool, typer.Option("--resume", help="Go on with a table that is there already.")] = False,
    settings: Settings = None,
) -> None:
    """Localize the robots of an experiment in a recorded video, without a station, and write their poses to a table.

    Example:  localizer track pool.mkv --experiment lab.toml --out poses.csv
    """
    import cv2

    from localizer.evaluation.offline import track_video
    from localizer.sources.files import frame_count

    check_output(out, [video, experiment_path(experiment)])
    if out.exists() and not resume:
        raise ConfigError(f"{out}: is there already (--resume goes on with it; or write to another file)")
    cv2.setNumThreads(1)  # as `run`
    loaded = load_experiment(experiment, settings or ())
    with typer.progressbar(length=frame_count(video), label=video.name) as bar:
        for done in track_video(video, loaded, out, resume):
            bar.update(done - bar.pos)
