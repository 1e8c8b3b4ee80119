"""SHELL: `localizer track` and `localizer rerun`: poses from recordings. No station, no network.

`track` writes a table of the poses of all robots, from a video or from a recording of raw frames. Rows gather in
`OUT.KEY.part`, which becomes the table when it is whole. A run that was stopped goes on with the last frame there that is
whole: the localizer is led up to it again, from WARM_UP_FRAMES before. Appearances are learnt anew then, so that poses
without a marker may differ from those of one run.

`rerun` feeds a recording of raw frames to the localizer, and compares its poses with those in the recording.
"""

import csv
import fcntl
import glob
import importlib
import os
from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from itertools import takewhile
from pathlib import Path
from typing import IO, Any

import numpy as np

from localizer.evaluation.runner import COLUMNS, check_size, read_frame_table
from localizer.sources.base import as_bayer
from localizer.sources.recording import RecordedFrame, recorded_frames
from localizer.sources.video import VideoReader
from localizer.tracking.fleet_localizer import FleetLocalizer, LocalizationResult
from localizer.tracking.tilt import Attitude
from shoal.config.experiment import Experiment
from shoal.errors import ConfigError, os_errors_as_config_errors
from shoal.messages.codec import decode, encode
from shoal.messages.messages import Pose
from shoal.runtime.output_files import check_named, replace_text, replacing, sync_folder
from shoal.runtime.runtime import Failed, log
from shoal.system.regular_files import open_regular

WARM_UP_FRAMES = 40  # 2 s at 20 Hz: markers are believed, velocities known, appearances learnt
REPORTED = ("depth_m", "roll_rad", "pitch_rad")  # columns of what robots' boards measured
_SIGMAS = ("sigma_x_m", "sigma_y_m", "sigma_yaw_rad")
FIELDS = (*COLUMNS, "depth_m", "stamp_ns", "track", "identity_verified", "peak", *_SIGMAS)
_TYPES = {"frame": "int64", "robot": "int64", "stamp_ns": "int64", "track": "string", "identity_verified": "bool"}


def frames_of_video(video: VideoReader, path: Path, experiment: Experiment, reports: Path | None) -> Iterator[RecordedFrame]:
    """The frames of the video at `path`, with what a table of robots' `reports` says: frame, robot, REPORTED. Raises
    ConfigError at once for a table that cannot be read, and for pictures of another size than the camera's."""
    check_size(path, video.size_px, experiment)
    sigma_rad = experiment.localizer.attitude_sigma_rad
    depths: dict[int, dict[int, float]] = {}
    attitudes: dict[int, dict[int, tuple[float, float, float]]] = {}
    for frame, robot, value in read_frame_table(reports, experiment, (), REPORTED) if reports is not None else ():
        if "depth_m" in value:
            depths.setdefault(frame, {})[robot] = value["depth_m"]
        if "roll_rad" in value and "pitch_rad" in value:
            attitudes.setdefault(frame, {})[robot] = (value["roll_rad"], value["pitch_rad"], sigma_rad)

    def frames() -> Iterator[RecordedFrame]:
        for picture in video.pictures():
            pixels, number, at_ns = as_bayer(picture.pixels), picture.number, picture.stamp_ns
            assert pixels is not None, "a video's pictures are BGR"
            yield RecordedFrame(pixels, at_ns, at_ns, depths.get(number, {}), attitudes.get(number, {}), number=number)

    return frames()


class FrameLocalizer:
    """A localizer of recorded frames. As in flight, an exception costs one frame's poses and is counted."""

    def __init__(self, experiment: Experiment) -> None:
        self.failed: dict[int, str] = {}  # pictures by number, each with the reason
        self._localizer = FleetLocalizer(experiment)

    def poses(self, frame: RecordedFrame) -> LocalizationResult | None:
        """The poses in a frame; None for one that was skipped."""
        attitudes = {robot: Attitude(*values) for robot, values in frame.attitudes.items()}
        result = None
        try:
            result = self._localizer.locate(frame.pixels, frame.instant_ns, frame.depths_m, attitudes)
            self._localizer.finish()
        except Exception as error:
            self.failed[frame.number] = reason = f"{type(error).__name__}: {error}"
            if len(self.failed) == 1:
                log.error("picture %d: %s", frame.number, reason, exc_info=error)
        return result


def failures(failed: Mapping[int, str]) -> str:
    """Text about pictures that failed, by number; empty if there are none."""
    return f"{len(failed)} pictures could not be localized in, the first: {failed[min(failed)]}" if failed else ""


# --- track


class PoseTable:
    """The table that `track` writes: `OUT.KEY.part` until it is whole. Beside it `OUT.KEY.failed` has the pictures that
    failed: they make no rows."""

    def __init__(self, out: Path, key: str) -> None:
        """`key` stands for all that the poses come from: rows of another camera, recording or setting are never gone on with.
        Raises ConfigError if Parquet cannot be written."""
        self.rows, self.frames, self.failures = 0, 0, ""
        self._out = out
        self._part, self._failed = (out.with_name(f"{out.name}.{key}.{kind}") for kind in ("part", "failed"))
        self._write = _parquet() if out.suffix == ".parquet" else _csv

    def check(self, resume: bool) -> None:
        """Raises ConfigError if a table, or a part of one, is there that this run would lose."""
        if self._out.exists():
            raise ConfigError(f"{self._out}: is there already (write to another file)")
        parts = sorted(self._out.parent.glob(f"{glob.escape(self._out.name)}.*.part"))
        if not resume and parts:
            raise ConfigError(f"{parts[0]}: is there already (write to another file, or --resume)")
        if resume and parts and self._part not in parts:
            raise ConfigError(
                f"{parts[0]}: its poses are of another recording, or of other settings (allowed to --resume: the same again)"
            )

    def write(self, frames: Iterator[RecordedFrame], experiment: Experiment) -> Iterator[int]:
        """Write a row for each robot and frame, behind those that are there; yields the number of frames that are done. Raises
        ConfigError for a part of other columns, or that another program still writes, and Failed if no robot is ever found:
        then there is no table."""
        localizer, message = FrameLocalizer(experiment), ""
        for path in filter(Path.exists, (self._part, self._failed)):  # a device or a pipe is not opened to write
            with os_errors_as_config_errors(path):
                open_regular(path).close()
        # What is there stays there: a run that is killed loses no more than the rows of a frame.
        with os_errors_as_config_errors(self._part), self._part.open("a", encoding="utf-8", newline="") as file:
            self._claim(file)
            kept, frame_count = _complete_lines(self._part)
            self.rows = max(kept.count("\n") - 1, 0)
            file.truncate(len(kept.encode()))
            table = csv.writer(file, lineterminator="\n")
            if not kept:
                table.writerow(FIELDS)
            failed = _failed_before(self._failed, frame_count)
            for frame in frames:
                if frame.number < frame_count - WARM_UP_FRAMES:
                    continue
                result = localizer.poses(frame)
                message = result.status.message or message if result is not None else message
                if frame.number >= frame_count:
                    if (why := localizer.failed.get(frame.number)) is not None:
                        failed[frame.number] = why
                        _note_failed(self._failed, frame.number, why)
                    poses = result.poses if result is not None else ()
                    table.writerows(_row(frame.number, robot, pose, frame.stamp_ns) for robot, pose in poses)
                    file.flush()
                    check_named(file.fileno(), self._part)
                    self.rows += len(poses)
                    self.frames = frame.number + 1
                    yield self.frames
            file.flush()
            os.fsync(file.fileno())
            self.failures = failures(failed)
            if self.rows:
                if self._out.exists():
                    raise ConfigError(f"{self._out}: came meanwhile (move it, then --resume: the poses are in {self._part})")
                self._write(self._part, self._out)
            else:
                self._part.unlink()
            self._failed.unlink(missing_ok=True)
        if self.rows:
            return
        why = self.failures or message or "no marker was read"
        raise Failed(f"no robot was found in any picture: {why}; no table was written")

    def _claim(self, file: IO[str]) -> None:
        """Lock the part for as long as it is open: of two programs that write it, each would add its rows to the other's. A
        file system that knows no locks lets everybody in. Raises ConfigError."""
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise ConfigError(f"{self._part}: another program still writes it (allowed: --resume after it)") from None
        except OSError:
            pass
        if self._out.exists():
            raise ConfigError(f"{self._out}: is there already (write to another file)")


def _row(frame: int, robot: int, pose: Pose, stamp_ns: int) -> tuple[object, ...]:
    """A line of the pose table: one robot in one frame."""
    sigmas = np.sqrt(np.diag(pose.covariance))
    numbers = (pose.x_m, pose.y_m, pose.yaw_rad, pose.depth_m)
    return (
        frame, robot, *(f"{number:.6f}" for number in numbers), stamp_ns, pose.track.name.lower(),
        int(pose.identity_verified), f"{pose.peak:.3f}", *(f"{sigma:.6f}" for sigma in sigmas),
    )  # fmt: skip


def _complete_lines(part: Path) -> tuple[str, int]:
    """The lines of a table before its last frame, whose rows may not all be there, and that frame's number."""
    with os_errors_as_config_errors(part), open_regular(part) as file:
        header, *lines = file.read().decode("ascii", "replace").splitlines(keepends=True) or [""]
    columns = ",".join(FIELDS)
    if not header.endswith("\n") and columns.startswith(header):
        return "", 0
    if header.strip() != columns:
        raise ConfigError(f"{part}: cannot be gone on with: its columns are not {', '.join(FIELDS)}")
    whole = list(takewhile(_is_row, lines))
    last = int(whole[-1].split(",")[0]) if whole else 0
    return "".join([header, *(line for line in whole if int(line.split(",")[0]) < last)]), last


def _failed_before(path: Path, frame: int) -> dict[int, str]:
    """The pictures before a frame that failed, as an earlier run has noted them; no others are noted then."""
    if not path.exists():
        return {}
    with open_regular(path) as file:
        lines = file.read().decode("utf-8", "replace").splitlines(keepends=True)
    lines = [line for line in lines if line.partition(" ")[0].isdecimal() and int(line.partition(" ")[0]) < frame]
    replace_text(path, "".join(lines), durable=False)
    return {int(number): why.strip() for number, _, why in (line.partition(" ") for line in lines)}


def _note_failed(path: Path, number: int, why: str) -> None:
    """Note that a picture failed, for a run that goes on."""
    with path.open("a", encoding="utf-8") as file:
        file.write(f"{number} {' '.join(why.split())}\n")


def _is_row(line: str) -> bool:
    """True for a whole row of the table; False for what a disk makes of one when the power fails."""
    cells = line.split(",")
    return line.isascii() and line.endswith("\n") and len(cells) == len(FIELDS) and cells[0].isdecimal()


def _csv(part: Path, out: Path) -> None:
    part.replace(out)
    sync_folder(out.parent)


def _parquet() -> Any:
    """A function like `_csv` that makes Parquet. Raises ConfigError if that cannot be written here."""
    try:
        arrow, files = importlib.import_module("pyarrow.csv"), importlib.import_module("pyarrow.parquet")
    except ModuleNotFoundError:
        raise ConfigError("--out: Parquet: not installed here (pip install pyarrow, or write to a .csv file)") from None

    def write(part: Path, out: Path) -> None:
        types = {name: _TYPES.get(name, "double") for name in FIELDS}
        rows = arrow.read_csv(part, convert_options=arrow.ConvertOptions(column_types=types))
        with replacing(out) as file:
            files.write_table(rows, file)
        part.unlink()

    return write


# --- rerun


@dataclass(frozen=True)
class PoseComparison:
    """A robot's poses in a recording beside those of another run: how many there are, how many differ in any bit, in which
    frame first, and by how much at most."""

    robot: int
    poses: int
    differing: int
    first_frame: int | None
    largest_mm: float


def compare_again(folder: Path, experiment: Experiment, damage: list[str]) -> tuple[list[PoseComparison], str]:
    """Localize in the frames of a recording again. Returns the comparisons, and a text about the pictures that failed;
    `damage` takes where the recording was cut. Raises ConfigError for what is no recording, and Failed for one in whose frames
    nothing could be done."""
    localizer = FrameLocalizer(experiment)
    poses, differing = Counter[int](), Counter[int]()
    first: dict[int, int] = {}
    largest_m = dict.fromkeys(experiment.robot_ids, 0.0)
    frames = 0
    for number, frame in enumerate(recorded_frames(folder, damage)):
        frames += 1
        result = localizer.poses(frame)
        again = dict(result.poses) if result is not None else {}
        for robot in sorted(again.keys() | frame.poses.keys()):
            poses[robot] += 1
            if robot in again and encode(again[robot]) == frame.poses.get(robot):
                continue
            differing[robot] += 1
            first.setdefault(robot, number)
            if robot in again and robot in frame.poses:
                then = decode(Pose, frame.poses[robot], "recording", "pose")
                apart_m = float(np.hypot(again[robot].x_m - then.x_m, again[robot].y_m - then.y_m))
                largest_m[robot] = max(largest_m[robot], apart_m)
    if not frames:
        raise Failed(f"{folder}: holds no frame, so nothing was compared")
    if len(localizer.failed) == frames:
        raise Failed(f"{folder}: nothing was compared: {failures(localizer.failed)}")
    comparisons = [PoseComparison(i, poses[i], differing[i], first.get(i), 1e3 * largest_m[i]) for i in experiment.robot_ids]
    return comparisons, failures(localizer.failed)
