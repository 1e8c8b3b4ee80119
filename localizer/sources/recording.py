"""SHELL: raw frames with all that the localizer goes by: `localizer run --record FOLDER` writes them, `rerun` reads them.

    FOLDER/experiment.toml   the experiment
    FOLDER/frames.mcap       of each frame: `localizer/inputs` (JSON), `robot/N/pose` as published, `camera/frame`

Frames are written by a thread of their own, one by one and not packed (1.2 MB each at 1280 x 960), and no pose waits for the
disk. A gap between what the localizer saw and what is in the file would make `rerun` worthless: so a disk that is too slow,
blocks or vanishes ends the recording, which is whole up to there. A killed process loses the frames that waited.
"""

import json
import queue
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from localizer.detection.image_regions import Pixels
from shoal.config.experiment import Experiment, dump_experiment
from shoal.errors import ConfigError, os_errors_as_config_errors
from shoal.messages import topics
from shoal.messages.codec import DecodeError, decode, encode, protobuf_class
from shoal.messages.messages import Frame, Pose
from shoal.runtime import mcap_records as log_records
from shoal.runtime.output_files import check_named, disk_free, replace_text
from shoal.runtime.runtime import log
from shoal.system.regular_files import open_regular

EXPERIMENT, FRAMES = "experiment.toml", "frames.mcap"
_INPUTS = "localizer/inputs"
_WAITING_BYTES = 64 * 1024 * 1024  # of frames that wait for the disk: 2.7 s of 1280 x 960 at 20 Hz
_BESIDE_BYTES = 4096  # of a frame's record beside its pixels, at most


@dataclass(frozen=True, eq=False)
class RecordedFrame:
    """A raw frame (height, width) and what the localizer was told with it, by robot id: depth of the centre, and [roll, pitch,
    standard deviation] at the exposure. `poses` are those that it published, encoded."""

    pixels: Pixels
    stamp_ns: int  # the camera's clock
    instant_ns: int  # the localizer's clock
    depths_m: dict[int, float] = field(default_factory=dict)
    attitudes: dict[int, tuple[float, float, float]] = field(default_factory=dict)
    poses: dict[int, bytes] = field(default_factory=dict)
    number: int = 0  # from 0


class FrameRecorder:
    """The writing end. An error of the disk, or too little room on it, ends the recording; the log and `failure` tell it."""

    def __init__(
        self,
        folder: Path,
        experiment: Experiment,
        free_bytes: Callable[[Path], int] = disk_free,
        waits: bool = False,
        patience_s: float = 10.0,
    ) -> None:
        """If it `waits`, frames wait for the disk. `close` waits for it for `patience_s`.
        Raises ConfigError if the folder is there already, or cannot be made, or if frames are too large to be read again."""
        from mcap.writer import CompressionType, IndexType, Writer

        width, height = experiment.camera.size_px
        if width * height + _BESIDE_BYTES > log_records.LARGEST_BYTES:
            raise ConfigError(
                f"--record {folder}: frames of camera.size_px {width}x{height} are larger than what can be read again "
                f"(allowed: {log_records.LARGEST_BYTES - _BESIDE_BYTES} pixels)"
            )
        self._waits, self._patience_s = waits, patience_s
        self._folder, self._free_bytes = folder, free_bytes
        self._least_bytes = round(experiment.recording.stop_video_below_gb * 1e9)
        if folder.exists():
            raise ConfigError(f"--record {folder}: is there already, and would be lost (take a new folder)")
        with os_errors_as_config_errors(folder):
            folder.mkdir(parents=True)
            replace_text(folder / EXPERIMENT, dump_experiment(experiment))
            self._file = (folder / FRAMES).open("xb")
        indexed = IndexType.CHUNK | IndexType.MESSAGE
        self._writer: Any = Writer(  # Any: mcap is typed in part
            self._file, compression=CompressionType.NONE, index_types=indexed
        )
        self._writer.start(library="shoal")
        self._channels: dict[str, int] = {}
        self._frames = 0
        self.failure = ""  # why frames are missing; "" while none are
        self._ended = False  # no more frames are taken
        self._failed = False  # none are written any more
        self._waiting: queue.Queue[RecordedFrame | None] = queue.Queue(max(2, _WAITING_BYTES // (width * height)))
        # a daemon: a disk that never answers must not keep the process
        self._thread = threading.Thread(target=self._write_all, name="recording", daemon=True)
        self._thread.start()

    def put(self, frame: RecordedFrame) -> None:
        """Have one frame written. Never waits for the disk, unless it is to: when too many frames wait, the recording
        ends."""
        if self._ended:
            return
        try:
            self._waiting.put(frame, block=self._waits)
        except queue.Full:
            self._ended = True
            self._fail(" ends: the disk is too slow, or does not answer")

    def _write_all(self) -> None:
        """Write frames until None comes; after the end of the recording they only leave the queue."""
        while (frame := self._waiting.get()) is not None:
            if self._failed:
                continue
            try:
                self._write_frame(frame)
            except FileNotFoundError as error:
                self._end(f": {error.strerror}")
            except Exception as error:  # poses go on, whatever the disk does
                text = error.strerror if isinstance(error, OSError) else f"{type(error).__name__}: {error}"
                self._end(f" ends after {self._frames} frames: {text}")

    def _write_frame(self, frame: RecordedFrame) -> None:
        """Write one frame; its picture last, so that a frame which is there is whole."""
        check_named(self._file.fileno(), self._folder / FRAMES)
        if self._free_bytes(self._folder) < self._least_bytes:
            least_gb = self._least_bytes / 1e9
            self._end(f" ends after {self._frames} frames: less than recording.stop_video_below_gb = {least_gb:g} GB are free")
            return
        inputs = {"instant_ns": frame.instant_ns, "depths_m": frame.depths_m, "attitudes": frame.attitudes}
        self._write(_INPUTS, None, json.dumps(inputs).encode(), frame.stamp_ns)
        for robot, pose in frame.poses.items():
            self._write(topics.POSE.key(robot), Pose, pose, frame.stamp_ns)
        self._write(topics.FRAME.name, Frame, encode(Frame(frame.pixels), frame.stamp_ns), frame.stamp_ns)
        self._writer.flush()  # a process that is killed loses the frames that waited, and no more
        self._file.flush()
        self._frames += 1

    def close(self) -> None:
        """Write what waits, and the file's index."""
        self._ended = True
        deadline_s = time.monotonic() + self._patience_s
        try:
            self._waiting.put(None, timeout=self._patience_s)
        except queue.Full:
            deadline_s = 0.0
        self._thread.join(max(deadline_s - time.monotonic(), 0.0))
        if self._thread.is_alive():
            self._fail(": the disk does not answer; its last frames and its end are missing")
        elif not self._failed:
            try:
                if not self.failure:  # else frames are missing: its end is left out, by which every reader knows that
                    self._writer.finish()
                self._file.flush()
                check_named(self._file.fileno(), self._folder / FRAMES)
                self._file.close()
            except FileNotFoundError as error:
                self._fail(f": {error.strerror}")
            except OSError as error:
                self._fail(f": its end is missing: {error.strerror}")
            if not self._frames:
                self._remove()

    def _remove(self) -> None:
        """Remove a recording without frames: the next start, with the same folder, would be refused for it."""
        with suppress(OSError):
            for name in (FRAMES, EXPERIMENT):
                (self._folder / name).unlink(missing_ok=True)
            self._folder.rmdir()
        log.warning("recording %s: there was no frame: removed", self._folder)

    def _write(self, topic: str, kind: type | None, data: bytes, stamp_ns: int) -> None:
        if topic not in self._channels:
            self._channels[topic] = self._register(topic, kind)
        self._writer.add_message(self._channels[topic], stamp_ns, data, stamp_ns, self._frames)

    def _register(self, topic: str, kind: type | None) -> int:
        """Number of a new channel of the recording, of a message's type or of JSON."""
        from mcap_protobuf.schema import build_file_descriptor_set

        if kind is None:
            schema = self._writer.register_schema(topic, "jsonschema", b'{"type": "object"}')
            return int(self._writer.register_channel(topic, "json", schema))
        cls = protobuf_class(kind)
        files = build_file_descriptor_set(cls).SerializeToString()
        return int(
            self._writer.register_channel(
                topic, "protobuf", self._writer.register_schema(cls.DESCRIPTOR.full_name, "protobuf", files)
            )
        )

    def _end(self, what: str) -> None:
        """End the recording, and report why."""
        self._ended = self._failed = True
        with suppress(OSError):
            self._file.close()
        self._fail(what)

    def _fail(self, what: str) -> None:
        text = f"recording {self._folder}{what}"
        self.failure = self.failure or text
        log.error("%s", text)


def frame_estimate(folder: Path, size_px: tuple[int, int]) -> int:
    """Number of frames of a recording by its size, some too many: what is beside the pixels counts as pixels."""
    with os_errors_as_config_errors(folder):
        return (folder / FRAMES).stat().st_size // (size_px[0] * size_px[1])


def require_recording(folder: Path) -> None:
    """Raise ConfigError unless a folder is such a recording."""
    missing = [name for name in (FRAMES, EXPERIMENT) if not (folder / name).is_file()]
    if missing:
        run = f"; its agents' steps: sim-bridge rerun {folder}" if (folder / "run.mcap").is_file() else ""
        names, are = " and ".join(missing), "are" if len(missing) > 1 else "is"
        raise ConfigError(f"{folder}: {names} {are} missing there (allowed: a folder of `localizer run --record`){run}")


def recorded_frames(folder: Path, damage: list[str] | None = None) -> Iterator[RecordedFrame]:
    """The frames of a recording, in order, as far as they are whole; `damage` takes where it was cut. Raises ConfigError for a
    file that is none."""
    path = folder / FRAMES
    inputs: dict[str, Any] | None = None
    poses: dict[int, bytes] = {}
    count = 0
    try:
        with open_regular(path) as file:
            for topic, stamp_ns, data in log_records.messages(file):
                if topic == _INPUTS:
                    inputs, poses = json.loads(data), {}
                elif topic == topics.FRAME.name and inputs is not None:
                    yield _frame(decode(Frame, data, "recording", topic).pixels, stamp_ns, inputs, poses, count)
                    count, inputs = count + 1, None
                elif topic.endswith("/pose"):
                    poses[int(topic.split("/")[-2])] = data
    except log_records.Damaged as error:
        if count == 0:
            raise ConfigError(f"{path}: no recording of frames: {error}") from None
        if damage is not None:
            damage.append(f"{path}: was cut, and ends after {count} frames: {error}")
    except (DecodeError, KeyError, TypeError, ValueError) as error:
        raise ConfigError(f"{path}: after frame {count}: not written by `localizer run --record`: {error}") from None
    except OSError as error:
        raise ConfigError(f"{path}: {error.strerror}") from None


def _frame(pixels: Pixels, stamp_ns: int, inputs: dict[str, Any], poses: dict[int, bytes], number: int) -> RecordedFrame:
    attitudes = {int(robot): (float(a), float(b), float(sigma)) for robot, (a, b, sigma) in inputs["attitudes"].items()}
    depths_m = {int(robot): float(depth) for robot, depth in inputs["depths_m"].items()}
    return RecordedFrame(pixels, stamp_ns, int(inputs["instant_ns"]), depths_m, attitudes, poses, number)
