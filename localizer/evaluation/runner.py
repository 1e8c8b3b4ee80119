"""SHELL: `localizer evaluate`: tables of errors from a recording and its truth.

A run's log holds poses and the plant's truth. A video of an experiment's pool is localized again, with all of the localizer.
"""

import csv
import dataclasses
import io
import json
import math
from collections.abc import Iterator, Sequence
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np

from localizer.evaluation.metrics import GroundTruthTrajectory, PoseRow, PublishedPose, camera_rows, pose_rows
from localizer.sources.base import as_bayer
from localizer.sources.video import VideoReader
from localizer.tracking.fleet_localizer import FleetLocalizer
from shoal.config.experiment import Experiment
from shoal.errors import ConfigError
from shoal.frames import Array
from shoal.messages import topics
from shoal.messages.codec import DecodeError, decode
from shoal.messages.messages import LocalizerStatus, Pose, Truth
from shoal.messages.session_clocks import SessionClocks
from shoal.runtime import mcap_records as log_records
from shoal.runtime.mcap_records import RecordedMessage
from shoal.system.regular_files import open_regular

_READ = (topics.TRUTH.name, topics.LOCALIZER.name, "/pose")

COLUMNS = ("frame", "robot", "x_m", "y_m", "yaw_rad")  # of `read_poses`


def table(rows: Sequence[Any]) -> str:
    """Rows as text: one line each, a column per field."""
    fields = [field.name for field in dataclasses.fields(rows[0])]
    lines = [fields, *([_cell(getattr(row, name)) for name in fields] for row in rows)]
    columns: list[list[str]] = []
    for column in zip(*lines, strict=True):
        width = max(len(cell) for cell in column)
        is_first = not columns
        columns.append([cell.ljust(width) if is_first else cell.rjust(width) for cell in column])
    return "\n".join("  ".join(line) for line in zip(*columns, strict=True))


def to_json(rows: Sequence[Any]) -> str:
    """Rows as JSON; NaN is null."""
    plain = [{k: None if v != v else v for k, v in dataclasses.asdict(row).items()} for row in rows]
    return json.dumps(plain, indent=1, allow_nan=False) + "\n"


def _cell(value: Any) -> str:
    return f"{value:.2f}" if isinstance(value, float) else str(value)


# --- files of the truth


def read_poses(
    path: Path, experiment: Experiment, stamps_ns: Sequence[int]
) -> tuple[dict[int, GroundTruthTrajectory], dict[int, dict[int, float]], int]:
    """Trajectories by robot, and known depths by frame and robot, from a table with COLUMNS and, where it is known, `depth_m`.
    A pose that is not known (an empty cell, NaN) stays a gap. Frames beyond `stamps_ns` are left out; the last of the table is
    returned too."""
    samples: dict[int, list[tuple[int, Array]]] = {}
    last = -1
    depths: dict[int, dict[int, float]] = {}
    for frame, robot, value in read_frame_table(path, experiment, COLUMNS[2:], ("depth_m",)):
        last = max(last, frame)
        if frame >= len(stamps_ns):
            continue
        pose = np.array([value.get(name, math.nan) for name in COLUMNS[2:]])
        samples.setdefault(robot, []).append((stamps_ns[frame], pose))
        if "depth_m" in value:
            depths.setdefault(frame, {})[robot] = value["depth_m"]
    return {robot: trajectory(rows) for robot, rows in samples.items()}, depths, last


def read_frame_table(
    path: Path, experiment: Experiment, needed: Sequence[str], allowed: Sequence[str]
) -> Iterator[tuple[int, int, dict[str, float]]]:
    """Frame (from 0), robot and values by name of each line of comma-separated values, a line of names first, in any order.

    The columns `frame`, `robot` and those `needed` must be there; of others only those `allowed` are read. A value that is not
    known (an empty cell, NaN, an infinity) is left out. Raises ConfigError, which names line and column.
    """
    needed = (*COLUMNS[:2], *needed)
    try:
        with io.TextIOWrapper(open_regular(path), encoding="utf-8-sig", newline="") as file:
            table = csv.reader(file)
            names = [name.strip() for name in next(table, [])]
            if missing := [name for name in needed if name not in names]:
                may = f"; {', '.join(allowed)} may follow" if allowed else ""
                raise ConfigError(f"{path}: the first line lacks {', '.join(missing)} (needed: {','.join(needed)}{may})")
            for cells in table:
                where = f"{path}: line {table.line_num}"
                if len(cells) != len(names):
                    raise ConfigError(f"{where}: {len(cells)} values, but the first line has {len(names)} names")
                line = dict(zip(names, cells, strict=True))
                frame, robot = (_cell_count(f"{where}, column {name}", line[name]) for name in COLUMNS[:2])
                value = {name: _cell_number(f"{where}, column {name}", line.get(name, "")) for name in (*needed[2:], *allowed)}
                yield frame, experiment.robot(robot).id, {name: v for name, v in value.items() if math.isfinite(v)}
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise ConfigError(f"{path}: {error}") from None


def _cell_number(where: str, cell: str) -> float:
    """The number of a cell; NaN for an empty one."""
    try:
        return float(cell) if cell.strip() else math.nan
    except ValueError:
        raise ConfigError(f"{where}: {cell!r} is no number (allowed: a number; empty or nan for what is not known)") from None


def _cell_count(where: str, cell: str) -> int:
    """The whole number, from 0, of a cell."""
    value = _cell_number(where, cell)
    if not (value >= 0 and value.is_integer()):
        raise ConfigError(f"{where}: {cell!r} must be a whole number (allowed: 0, 1, 2, ...)")
    return int(value)


def trajectory(samples: list[tuple[int, Array]]) -> GroundTruthTrajectory:
    """A trajectory from (instant in ns, [x, y, yaw]) in any order."""
    ordered = sorted(samples, key=lambda sample: sample[0])
    return GroundTruthTrajectory(np.array([stamp for stamp, _ in ordered]), np.array([pose for _, pose in ordered]))


# --- a run's log


def evaluate_log(path: Path) -> tuple[list[PoseRow], str]:
    """Poses of a recorded run against the plant's truth in it; with several cameras the fused ones, and then rows about the
    cameras. A log that was cut off counts as far as it goes; the sentence behind the rows says so. Each sender stamps by its
    own clock; what belongs together does by the recorder's."""
    damage = list[str]()
    published, truths, clocks = list[tuple[RecordedMessage, Pose]](), list[tuple[RecordedMessage, Truth]](), SessionClocks()
    for record in _records(path, damage):
        one = record._replace(data=b"")  # what is kept is decoded
        try:
            if one.topic.endswith(topics.TRUTH.name):
                truths.append((one, decode(Truth, record.data, "log", one.topic)))
                clocks.note(topics.TRUTH, one.session, one.stamp_ns, one.arrived_ns, truths[-1][1])
            elif one.topic.endswith(topics.LOCALIZER.name):
                status = decode(LocalizerStatus, record.data, "log", one.topic)
                clocks.note(topics.LOCALIZER, one.session, one.stamp_ns, one.arrived_ns, status)
            elif one.topic.split("/")[-3:-2] == ["robot"]:
                published.append((one, decode(Pose, record.data, "log", one.topic)))
        except (DecodeError, ValueError) as error:
            raise ConfigError(f"{path}: {error}") from None

    def at_ns(one: RecordedMessage) -> int:
        """Instant that a message is about, on the recorder's clock."""
        return one.stamp_ns + clocks.shift_ns(one.topic, one.session, one.stamp_ns)

    true: dict[int, list[tuple[int, Array]]] = {}
    for one, truth in truths:
        for robot, eta in zip(truth.robots, truth.eta, strict=False):
            true.setdefault(robot, []).append((at_ns(one), eta[[0, 1, 3]]))
    poses = [_published(one, pose, at_ns(one)) for one, pose in published]
    paths = {robot: trajectory(samples) for robot, samples in true.items()}
    rows = pose_rows([pose for pose in poses if not pose.camera], paths) + camera_rows(poses, paths)
    if not rows:
        raise ConfigError(f"{path}: no poses with a truth to compare with ({len(poses)} poses, truth of {len(true)} robots)")
    return rows, "".join(damage)


def _published(one: RecordedMessage, pose: Pose, at_ns: int) -> PublishedPose:
    parts = one.topic.split("/")
    camera = parts[-4] if parts[-5:-4] == ["camera"] else ""
    return PublishedPose(int(parts[-2]), at_ns, pose, camera)


def _records(path: Path, damage: list[str]) -> Iterator[RecordedMessage]:
    """The poses and truths of a log, and the localizers' status, up to a cut or damaged record, which `damage` takes."""
    try:
        with open_regular(path) as file:
            yield from (one for one in log_records.recorded_messages(file) if one.topic.endswith(_READ))
    except ImportError:
        raise ConfigError(f"{path}: its chunks are packed: reading it needs pip install 'shoal[station]'") from None
    except log_records.Damaged as error:  # the recorder was killed: what lies before is good
        damage.append(f"{path}: was cut, and what lies behind is not evaluated: {error}")
    except OSError as error:
        raise ConfigError(f"{path}: {error.strerror}") from None


# --- videos


def evaluate_pool(path: Path, truth: Path, experiment: Experiment, limit: int | None) -> tuple[list[PoseRow], str]:
    """Localize the robots of an experiment in a video, picture by picture, and compare with a truth file (see read_poses).
    Returns rows, and a sentence if pictures are missing."""
    with closing(VideoReader(path)) as video:
        trajectories, depths, last = read_poses(truth, experiment, video.stamps_ns)
        check_size(path, video.size_px, experiment)
        locator, poses, message = FleetLocalizer(experiment), list[PublishedPose](), ""
        for picture in video.pictures(limit):
            pixels = as_bayer(picture.pixels)
            assert pixels is not None, "a video's pictures are BGR"
            located = locator.step(pixels, picture.stamp_ns, depths.get(picture.number, {}))
            message = located.status.message
            poses += [PublishedPose(robot, picture.stamp_ns, pose) for robot, pose in located.poses]
        damage = video.damage(limit) or _beyond(truth, min(last + 1, limit or last + 1), len(video.stamps_ns))
    rows = pose_rows(poses, trajectories)
    if not rows:
        raise ConfigError(f"{path}: no robot was ever found where {truth} has a truth ({message or 'no marker'})")
    return rows, damage


def _beyond(truth: Path, frames: int, pictures: int) -> str:
    """A sentence about a truth of more frames than there are pictures of, as where the video was cut; else empty."""
    return f"{truth}: tells of {frames} frames, and the video has {pictures}" if frames > pictures else ""


def check_size(path: Path, size_px: tuple[int, int], experiment: Experiment) -> None:
    """Raises ConfigError for pictures of another size than the experiment's camera has."""
    if size_px != experiment.camera.size_px:
        sizes = ["x".join(map(str, size)) for size in (size_px, experiment.camera.size_px)]
        raise ConfigError(
            f"{path}: {sizes[0]}, but camera.size_px of experiment {experiment.name!r} is {sizes[1]} "
            "(allowed: pictures as they were when the camera was calibrated)"
        )
