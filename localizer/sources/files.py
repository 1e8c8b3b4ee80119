"""SHELL: recorded pictures: videos and folders, played as a camera. A folder may still be growing.

At a rate they behave like a live camera: a picture is exposed when it is due, a slow reader gets the newest, and the rest
is counted as dropped. As fast as possible (`max`), every picture comes, with stamps as if it had come when it was due.
"""

import bisect
import math
import re
import time
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from localizer.detection.image_regions import Pixels
from localizer.sources.base import SUFFIXES, CapturedFrame, as_bayer, silent_after_s
from localizer.sources.video import VideoReader
from shoal.errors import ConfigError
from shoal.runtime.runtime import SLICE_S, Clock, Stop, log
from shoal.system.regular_files import read_regular

MOST_PICTURE_BYTES = 500_000_000  # of a file
_POLL_NS = 10_000_000  # ns between checks of a folder for new images
_SETTLED_NS = 100_000_000  # ns; file systems stamp in steps of 4 ms or more, so a younger change may not be the last


def sleep_until(clock: Clock, due_ns: int, stop: Stop) -> bool:
    """Sleep to an instant of the clock; False if the program is to stop before."""
    while not stop.requested:
        left_s = (due_ns - clock.now_ns()) * 1e-9
        if left_s <= 0.0:
            return True
        time.sleep(min(left_s, SLICE_S))
    return False


class FramePacer:
    """Schedule of a recording's frames."""

    def __init__(self, clock: Clock, rate_hz: float, as_fast_as_possible: bool) -> None:
        self.period_ns = round(1e9 / rate_hz)
        self._clock, self._fast = clock, as_fast_as_possible
        self._next_ns: int | None = None

    def rest(self) -> None:
        """Note that there is nothing to show: the next picture is new, not late."""
        if not self._fast:
            self._next_ns = None

    def overdue(self) -> int:
        """Number of pictures to skip, because a newer one is due already."""
        if self._fast or self._next_ns is None:
            return 0
        return max((self._clock.now_ns() - self._next_ns) // self.period_ns, 0)

    def release(self, left_out: int, stop: Stop) -> int | None:
        """Wait until the picture after the skipped ones is due. Returns its instant, None if told to stop."""
        due_ns = self._clock.now_ns() if self._next_ns is None else self._next_ns + left_out * self.period_ns
        self._next_ns = due_ns + self.period_ns
        return due_ns if self._fast or sleep_until(self._clock, due_ns, stop) else None


def decode_file(path: Path) -> NDArray[Any] | None:
    """A picture file as OpenCV reads it; None for what it does not read, or has too many pixels. Raises OSError."""
    data = read_regular(path, MOST_PICTURE_BYTES)
    try:
        return cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED) if data else None
    except cv2.error:
        return None


def picture_files(folder: Path) -> list[Path]:
    """The picture files of a folder in the order of their names, numbers inside names as numbers; without hidden files, of
    which cameras and systems leave some that only look like pictures (`._IMG_1.JPG`). Raises OSError."""
    named = (path for path in folder.iterdir() if path.suffix.lower() in SUFFIXES and not path.name.startswith("."))
    return sorted((path for path in named if not path.is_dir()), key=_by_number)


def _by_number(path: Path) -> tuple[tuple[int, int, str], ...]:
    parts = re.split(r"(\d+)", path.name)
    return tuple((1, int(part), part) if part.isdecimal() else (0, 0, part) for part in parts)


class VideoSource:
    """A video file, once through."""

    trouble, silent_after_s = "", math.inf

    def __init__(self, path: Path, rate_hz: float | None, clock: Clock, as_fast_as_possible: bool = False) -> None:
        """`rate_hz` None: as the file's stamps say. Raises ConfigError if the file cannot be played."""
        self._path, self._clock, self._fast = path, clock, as_fast_as_possible
        self._reader = VideoReader(path)
        own_ns = self._reader.stamps_ns
        self._stamps_ns = own_ns if rate_hz is None else [round(1e9 * number / rate_hz) for number in range(len(own_ns))]

    def frames(self, stop: Stop) -> Iterator[CapturedFrame | None]:
        """See FrameSource. Ends with the file."""
        start_ns: int | None = None  # instant of the file's stamp 0
        newest = 0
        while not stop.requested and (picture := self._reader.next(newest)) is not None:
            pixels = as_bayer(picture.pixels)
            assert pixels is not None, "a video's pictures are BGR"
            stamp_ns = self._stamps_ns[picture.number]
            start_ns = self._clock.now_ns() - stamp_ns if start_ns is None else start_ns
            due_ns, dropped = start_ns + stamp_ns, picture.number + 1 - self._reader.decoded
            if self._fast or sleep_until(self._clock, due_ns, stop):
                yield CapturedFrame(pixels, due_ns, due_ns, self._clock.now_ns(), dropped)
            if not self._fast:
                newest = bisect.bisect_right(self._stamps_ns, self._clock.now_ns() - start_ns) - 1
                newest = min(newest, len(self._stamps_ns) - 1)
        log.info("end of %s", self._path)
        if self._fast and not stop.requested and (damage := self._reader.damage()):
            log.warning("%s", damage)

    def close(self) -> None:
        self._reader.close()


class FolderSource:
    """Images of a folder in the order of their names (frame2 before frame10), then the ones that are added or replaced.

    A writer adds pictures under another name (`.part`) and renames them, so that none is read half written.
    """

    def __init__(self, path: Path, rate_hz: float, clock: Clock, as_fast_as_possible: bool = False) -> None:
        """Raises ConfigError if there is no such folder."""
        if not path.is_dir():
            raise ConfigError(f"folder {path}: no such folder")
        self.trouble, self.silent_after_s = "", silent_after_s(rate_hz)
        self._path, self._clock = path, clock
        self._pace = FramePacer(clock, rate_hz, as_fast_as_possible)
        self._shown: dict[str, int] = {}  # file name -> time of its last change
        self._listed_ns: int | None = None  # time of the folder's last change, once all of it was listed
        self._dropped = 0

    def frames(self, stop: Stop) -> Iterator[CapturedFrame | None]:
        """See FrameSource. Never ends by itself."""
        pending: list[Path] = []
        silent_since = time.monotonic()
        while not stop.requested:
            pending = pending or self._new()
            captured = self._next(pending, stop) if pending else None
            if captured is not None:
                yield captured
            elif not pending:
                self._pace.rest()
                sleep_until(self._clock, self._clock.now_ns() + _POLL_NS, stop)
            if captured is None and time.monotonic() - silent_since < self.silent_after_s:
                continue
            if captured is None and not stop.requested:
                yield None
            silent_since = time.monotonic()

    def close(self) -> None:
        """Do nothing: no resource is held."""

    def _next(self, pending: list[Path], stop: Stop) -> CapturedFrame | None:
        """Take one picture from the front of `pending`, and those it overtakes; None if it is unreadable, or told to stop."""
        late = min(self._pace.overdue(), len(pending) - 1)
        self._dropped += late
        path = pending[late]
        del pending[: late + 1]
        pixels = self._read_picture(path)
        due_ns = self._pace.release(late, stop) if pixels is not None else None
        if pixels is None or due_ns is None:
            return None
        return CapturedFrame(pixels, due_ns, due_ns, self._clock.now_ns(), self._dropped)

    def _read_picture(self, path: Path) -> Pixels | None:
        """A picture of a folder; None, with a warning, for a file that holds none."""
        picture = None
        with suppress(OSError):  # taken away, or no file
            picture = decode_file(path)
        pixels = None if picture is None else as_bayer(picture)
        self.trouble = "" if pixels is not None else f"{path} is no 8-bit image"
        if self.trouble:
            log.warning("%s: left out", self.trouble)
        return pixels

    def _new(self) -> list[Path]:
        """Images not shown yet, in order. Cheap while the folder does not change."""
        try:
            changed_ns = self._path.stat().st_mtime_ns
            if changed_ns == self._listed_ns:
                return []
            times_ns = {path: path.stat().st_mtime_ns for path in picture_files(self._path)}
        except OSError as error:  # the folder, or a file of it, is being taken away
            self.trouble, self._listed_ns = str(error), None
            return []
        self._listed_ns = changed_ns if time.time_ns() - changed_ns > _SETTLED_NS else None
        new = [path for path, when_ns in times_ns.items() if self._shown.get(path.name) != when_ns]
        self._shown = {path.name: when_ns for path, when_ns in times_ns.items()}
        self.trouble = "" if new else f"nothing new in {self._path}"
        return new
