"""SHELL: `localizer track`: the poses of all robots in a recorded video, as a table. No station, no network.

A run that was stopped goes on with the last frame of its table that is whole: the localizer is led up to it again, from
WARM_UP_FRAMES before. Appearances are learnt anew then, so that poses without a marker may differ from those of one run.
"""

import csv
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from localizer.evaluation.runner import COLUMNS
from localizer.sources.base import as_bayer
from localizer.sources.files import video_frames
from localizer.tracking.fleet_localizer import FleetLocalizer
from wire.config.experiment import Experiment
from wire.messages.messages import Pose
from wire.toml_loader import ConfigError

WARM_UP_FRAMES = 40  # 2 s at 20 Hz: markers are believed, velocities known, appearances learnt
_SIGMAS = ("sigma_x_m", "sigma_y_m", "sigma_yaw_rad")
FIELDS = (*COLUMNS, "depth_m", "track", "identity_verified", "peak", *_SIGMAS)  # `evaluate --truth` reads the first six


def track_video(video: Path, experiment: Experiment, out: Path, resume: bool) -> Iterator[int]:
    """Write the table `out`, a row for each robot and frame; yields the number of frames that are done.

    With `resume` what is there is kept and gone on with. Raises ConfigError for a table of other columns.
    """
    kept, done = _kept(out) if resume and out.exists() else ("", 0)
    locator, period_ns = FleetLocalizer(experiment), round(1e9 / experiment.camera.rate_hz)
    with out.open("w", encoding="utf-8", newline="") as file:
        file.write(kept)
        table = csv.writer(file, lineterminator="\n")
        if not kept:
            table.writerow(FIELDS)
        for frame, picture in enumerate(video_frames(video)):
            if frame < done - WARM_UP_FRAMES:
                continue
            pixels = as_bayer(picture)
            assert pixels is not None, "a video's pictures are BGR"
            poses = locator.step(pixels, frame * period_ns, {}).poses
            if frame >= done:
                table.writerows(_row(frame, robot, pose) for robot, pose in poses)
                file.flush()
                yield frame + 1


def _row(frame: int, robot: int, pose: Pose) -> tuple[object, ...]:
    sigmas = np.sqrt(np.diag(pose.covariance))
    numbers = (pose.x_m, pose.y_m, pose.yaw_rad, pose.depth_m)
    return (
        frame, robot, *(f"{number:.6f}" for number in numbers), pose.track.name.lower(), int(pose.identity_verified),
        f"{pose.peak:.3f}", *(f"{sigma:.6f}" for sigma in sigmas),
    )  # fmt: skip


def _kept(out: Path) -> tuple[str, int]:
    """The lines of a table before its last frame, whose rows may not all be there, and that frame's number."""
    header, *lines = out.read_text(encoding="utf-8").splitlines(keepends=True) or [""]
    if header.strip() != ",".join(FIELDS):
        raise ConfigError(f"{out}: cannot be gone on with: its columns are not {', '.join(FIELDS)}")
    whole = [line for line in lines if line.endswith("\n") and line.count(",") == len(FIELDS) - 1]
    last = int(whole[-1].split(",")[0]) if whole else 0
    return "".join([header, *(line for line in whole if int(line.split(",")[0]) < last)]), last
