"""SHELL: the command line of `localizer latency`, `evaluate`, `track` and `rerun`."""

import hashlib
import sys
from contextlib import ExitStack, closing
from dataclasses import replace
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Annotated

import typer

from shoal.errors import ConfigError
from shoal.runtime.cli_options import (
    DEFAULT_FLEET,
    DEFAULT_STATION,
    AsJson,
    CameraName,
    ExperimentName,
    FleetName,
    Insecure,
    KeyRing,
    Settings,
    StationAddress,
    finite,
)
from shoal.runtime.output_files import check_output, replace_text

LOG = ".mcap"  # ends the name of a run's log

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
    seconds: Annotated[float, typer.Option(min=0.5, help="How long to measure.", callback=finite)] = 5.0,
    json: JsonFile = None,
    station: StationAddress = DEFAULT_STATION,
    fleet: FleetName = DEFAULT_FLEET,
    keys: KeyRing = None,
    insecure: Insecure = False,
    camera: CameraName = "",
    settings: Settings = None,
) -> None:
    """Measure how old poses are and how even the pictures come. Exit code 1 if something is not as it should be.

    Example:  localizer latency lab.toml --source v4l2:/dev/video0
    """
    import cv2

    from localizer.evaluation.latency import assess, localize_in_process, measure
    from localizer.sources.base import FrameSource
    from localizer.sources.bus import BusSource
    from localizer.sources.factory import BUS, open_own
    from localizer.tracking.check_marks import with_camera
    from shoal.bus.bus import Bus
    from shoal.bus.network import endpoint
    from shoal.bus.zenoh_transport import ZenohTransport
    from shoal.config.experiment import experiment_path, load_experiment
    from shoal.messages.topics import Role, process_name
    from shoal.runtime.runtime import Stop, WallClock, start_log

    start_log("localizer")
    if json is not None:
        check_output(json, [experiment_path(experiment), *([Path(source.split(":")[1])] if ":" in source else [])])
    cv2.setNumThreads(1)  # as `run`
    loaded, clock = with_camera(load_experiment(experiment, settings or ()), camera), WallClock()
    stop = Stop()
    with ExitStack() as stack:
        if source == BUS:
            where = endpoint(station, process_name(Role.LOCALIZER), keys, insecure=insecure)
            bus = stack.enter_context(Bus(ZenohTransport(where, stop), fleet))
            pictures: FrameSource = BusSource(bus, clock, loaded.camera.rate_hz, camera)
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
        typer.Option(metavar="FILE", help="True poses in a video: a CSV with a line for each frame and robot."),
    ] = None,
    experiment: Annotated[
        str | None, typer.Option(metavar="EXPERIMENT", help="The experiment whose pool a video shows.")
    ] = None,
    marker: Annotated[bool, typer.Option(help="Read markers in a video.")] = True,
    frames: Annotated[int | None, typer.Option(min=2, help="Look at the first so many only.")] = None,
    json: JsonFile = None,
    camera: CameraName = "",
    settings: Settings = None,
) -> None:
    """Print a table of the localizer's errors against a known truth. Exit code 1 if the recording is not whole.

    Examples:  localizer evaluate runs/pool-20260101-120000/run.mcap
    localizer evaluate pool.mkv --truth poses.csv --experiment lab.toml --no-marker
    """
    import cv2

    from localizer.evaluation import runner
    from localizer.tracking.check_marks import with_camera
    from shoal.config.experiment import experiment_path, load_experiment

    if json is not None:
        read = [recording, *([truth] if truth is not None else [])]
        check_output(json, [*read, *([experiment_path(experiment)] if experiment is not None else [])])
    cv2.setNumThreads(1)  # as `run`

    if recording.suffix == ".mcap":
        rows, damage = runner.evaluate_log(recording)
    elif truth is None or experiment is None:
        raise ConfigError(f"{recording}: no log (a run's is RUN/run.mcap), and a video needs --truth FILE and --experiment")
    else:
        changed = [*(settings or ()), f"localizer.markers={str(marker).lower()}"]
        loaded = with_camera(load_experiment(experiment, changed), camera)
        rows, damage = runner.evaluate_pool(recording, truth, loaded, frames)
    typer.echo(runner.table(rows))
    if json is not None:
        replace_text(json, runner.to_json(rows))
    if damage:
        typer.echo(damage, err=True)
        raise typer.Exit(1)


def track(
    recording: Annotated[
        Path, typer.Argument(metavar="RECORDING", help="A video of a pool, a run's run.mcap, or a folder of `run --record`.")
    ],
    out: Annotated[Path, typer.Option(metavar="FILE", help="The table: a row for each robot and frame, .csv or .parquet.")],
    experiment: Annotated[
        str | None, typer.Option(metavar="EXPERIMENT", help="Camera, robots and pool. A folder holds its own.")
    ] = None,
    reports: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="CSV of what the robots' boards measured: frame,robot,depth_m,roll_rad,pitch_rad."),
    ] = None,
    resume: Annotated[bool, typer.Option("--resume", help="Go on where a run that was stopped ended.")] = False,
    camera: CameraName = "",
    settings: Settings = None,
) -> None:
    """Localize the robots of an experiment in a recording, without a station, and write their poses to a table. Exit code 1 if
    the recording is not whole, or pictures failed.

    Examples:  localizer track pool.mkv --experiment lab.toml --out poses.csv
    localizer track frames-1 --out poses.parquet
    localizer track runs/pool-20260101-120000/run.mcap --out poses.csv
    """
    import cv2

    from localizer.evaluation.offline import PoseTable, frames_of_video
    from localizer.sources.log_film import film_of_log
    from localizer.sources.recording import EXPERIMENT, frame_estimate, recorded_frames
    from localizer.sources.video import VideoReader
    from localizer.tracking.check_marks import with_camera
    from shoal.config.experiment import experiment_path, load_experiment
    from shoal.runtime.runtime import start_log

    start_log("localizer")
    if experiment is None and recording.suffix == LOG and (recording.parent / EXPERIMENT).is_file():
        experiment = str(recording.parent / EXPERIMENT)
    raw = recording.is_dir()
    if experiment is None and not raw:
        raise ConfigError(f"{recording}: a video needs --experiment EXPERIMENT")
    if raw and reports is not None:
        raise ConfigError(f"--reports: {recording} holds what the boards measured (allowed: with a video)")
    name = str(recording / EXPERIMENT) if experiment is None else experiment
    check_output(out, [recording, experiment_path(name), *([reports] if reports is not None else [])])
    cv2.setNumThreads(1)  # as `run`
    loaded = with_camera(load_experiment(name, settings or ()), camera)
    table = PoseTable(out, _fingerprint(f"{loaded.hash} {camera}", recording, reports))
    table.check(resume)
    with ExitStack() as stack:
        film, first_ns, left_out, cut = recording, 0, "", list[str]()
        if recording.suffix == LOG:
            film = Path(stack.enter_context(TemporaryDirectory())) / "film.mkv"
            first_ns, left_out = film_of_log(recording, camera, film)
        video = None if raw else stack.enter_context(closing(VideoReader(film)))
        frames = recorded_frames(recording, cut) if video is None else frames_of_video(video, recording, loaded, reports)
        frames = (replace(frame, stamp_ns=frame.stamp_ns + first_ns) for frame in frames) if first_ns else frames
        count = frame_estimate(recording, loaded.camera.size_px) if video is None else len(video.stamps_ns)
        with typer.progressbar(length=count, label=recording.name, file=sys.stderr) as bar:
            for finished in table.write(frames, loaded):
                bar.update(finished - bar.pos)
        damage = "" if video is None else video.damage()
    typer.echo(f"Wrote {out}: {table.rows} poses from {table.frames} pictures.")
    troubles = [trouble for trouble in (table.failures, left_out, damage, *cut) if trouble]
    for trouble in troubles:
        typer.echo(trouble, err=True)
    if troubles:
        raise typer.Exit(1)


def _fingerprint(settings: str, *files: Path | None) -> str:
    """Eight digits that change with the settings and with each of the files."""
    stats = [None if file is None else file.resolve().stat() for file in files]
    parts = [settings, *("" if stat is None else f"{stat.st_size} {stat.st_mtime_ns}" for stat in stats)]
    return hashlib.sha256("\n".join(parts).encode()).hexdigest()[:8]


def rerun(
    recording: Annotated[Path, typer.Argument(metavar="FOLDER", help="A folder of `localizer run --record`.")],
    settings: Settings = None,
    as_json: AsJson = False,
) -> None:
    """Localize in recorded frames once more, and compare with the poses that were published then.

    Nothing changed: the same to the last bit, on the same kind of machine. With --set: other poses, in the same pictures.
    Exit code 1 if nothing was changed and something differs, or if the recording is not whole.

    Examples:  localizer rerun frames-1
    localizer rerun frames-1 --set localizer.corner_sigma_px=0.4
    """
    import cv2

    from localizer.evaluation.offline import compare_again
    from localizer.evaluation.runner import table, to_json
    from localizer.sources.recording import EXPERIMENT, require_recording
    from shoal.config.experiment import load_experiment
    from shoal.runtime.runtime import start_log

    start_log("localizer")
    cv2.setNumThreads(1)  # as `run`
    require_recording(recording)
    damage = list[str]()
    rows, failures = compare_again(recording, load_experiment(str(recording / EXPERIMENT), settings or ()), damage)
    typer.echo(to_json(rows) if as_json else table(rows))
    for trouble in filter(None, (failures, *damage)):
        typer.echo(trouble, err=True)
    raise typer.Exit(1 if damage or (not settings and any(row.differing for row in rows)) else 0)
