"""SHELL: video files: every picture with its number and its stamp, also where pictures are damaged.

The stamps of all packets are read first, without decoding them: they say how many pictures there are, and number them. So a
picture that cannot be decoded keeps its number, and a rate that varies gives the stamps that were filmed. A phone's note that
the picture is turned is ignored, as in picture files: a lens is calibrated for the sensor's own rows and columns.
"""

import bisect
import struct
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import IO

import cv2
import numpy as np

from localizer.detection.image_regions import Pixels
from shoal.errors import ConfigError, os_errors_as_config_errors
from shoal.system.regular_files import open_regular

_MOST_HZ = 1e4  # a larger rate is a file that does not know its own
_ON_GRID = 0.25  # of a period: stamps so near to multiples of it are those of a constant rate. Matroska rounds to 1 ms
_LONGEST_END = 2.0  # times the longest time between two pictures: a video that ends so long before its duration was cut
_MOST_LISTED = 1_000_000  # pictures: 14 h at 20 Hz. A damaged index says any number, and each is looked for
_MOST_NAMED = 5  # ranges of missing pictures that a message names


@dataclass(frozen=True, eq=False)
class VideoPicture:
    """A picture BGR (height, width, 3), its number from 0, and its stamp, which is 0 for the first of the file."""

    number: int
    stamp_ns: int
    pixels: Pixels


class VideoReader:
    """A video file, once through."""

    def __init__(self, path: Path) -> None:
        """Raises ConfigError if the file cannot be played, or holds no picture."""
        self._path = path
        self._capture = _open(path)
        self._capture.set(cv2.CAP_PROP_ORIENTATION_AUTO, 0)
        width, height = (int(self._capture.get(key)) for key in (cv2.CAP_PROP_FRAME_WIDTH, cv2.CAP_PROP_FRAME_HEIGHT))
        self.size_px = (width, height)
        own_hz = self._capture.get(cv2.CAP_PROP_FPS)
        self.rate_hz = own_hz if 0.0 < own_hz < _MOST_HZ else None  # the mean, as far as the file knows it
        listed = int(self._capture.get(cv2.CAP_PROP_FRAME_COUNT))  # pictures by the file's index
        self._listed = listed if 0 < listed <= _MOST_LISTED else 0  # 0: unknown
        self._packets_ms = _packet_stamps_ms(path, self._listed)
        if not self._packets_ms:
            raise ConfigError(f"video {path}: no picture can be read")
        self._decoded: list[int] = []  # numbers
        self._numbers_by_stamp = len(set(self._packets_ms)) == len(self._packets_ms)
        has_stamps = self.rate_hz is not None and self._numbers_by_stamp
        self._is_constant_rate = has_stamps and _is_constant(self._packets_ms, self.rate_hz or 0.0)
        self._undamaged_numbers = self._numbers_by_avi_index()  # by packet; empty: as the stamps say
        self.stamps_ns = self._stamps_ns()  # by number

    @property
    def decoded(self) -> int:
        """Number of pictures that were read so far."""
        return len(self._decoded)

    def next(self, at_least: int = 0) -> VideoPicture | None:
        """The next picture that can be decoded, of those with this number or a later one; None at the end."""
        number, failures = self._decoded[-1] if self._decoded else -1, 0
        while failures <= len(self.stamps_ns) - number:  # a damaged packet fails by itself; behind the end all do
            if not self._capture.grab():
                failures += 1
                continue
            number = self._picture_number(number)
            if number < at_least:
                continue
            good, pixels = self._capture.retrieve()
            if good:
                self._decoded.append(number)
                return VideoPicture(number, self.stamps_ns[number], np.asarray(pixels, dtype=np.uint8))
        return None

    def pictures(self, limit: int | None = None) -> Iterator[VideoPicture]:
        """All pictures that can be decoded, with numbers below `limit`. Raises ConfigError if there are none."""
        while (limit is None or not self._decoded or self._decoded[-1] < limit - 1) and (picture := self.next()) is not None:
            if limit is None or picture.number < limit:  # those before it may be damaged
                yield picture
        if not self._decoded:
            raise ConfigError(f"video {self._path}: no picture can be decoded")

    def damage(self, limit: int | None = None) -> str:
        """A sentence about pictures below `limit` that the file should hold and that were not read; "" if there are none."""
        count = len(self.stamps_ns) if limit is None else min(limit, len(self.stamps_ns))
        missing = sorted(set(range(count)) - set(self._decoded))
        if not missing:
            short_s = self._cut_s() if limit is None else 0.0
            return f"video {self._path}: ends {short_s:.1f} s too early" if short_s else ""
        text = f"video {self._path}: {len(missing)} of {count} pictures cannot be read: {number_ranges(missing)}"
        if self._lost_without_trace and not self._undamaged_numbers:
            text += "; it was cut off there" + (
                ", or has lost pictures in between, and later numbers and stamps are too low" if self._is_avi else ""
            )
        return text

    def close(self) -> None:
        self._capture.release()

    @property
    def _lost_without_trace(self) -> bool:
        """True if packets are gone and the stamps of the others do not say which ones."""
        has_gap = round(self._packets_ms[-1] * 1e-3 * (self.rate_hz or 0.0)) + 1 > len(self._packets_ms)
        return self._is_constant_rate and len(self._packets_ms) < self._listed and not has_gap

    @property
    def _is_avi(self) -> bool:
        """True for a file without stamps, whose packets are counted instead."""
        with self._path.open("rb") as file:
            return file.read(4) == b"RIFF"

    def _numbers_by_avi_index(self) -> list[int]:
        """Numbers of the packets that are left in a damaged AVI file."""
        if not (self._lost_without_trace and self._is_avi):
            return []
        numbers = _avi_chunks_left(self._path, self._listed)
        return numbers if len(numbers) == len(self._packets_ms) else []

    def _cut_s(self) -> float:
        """Time by which a video of varying rate ends before the duration that it states; 0 if it does not, by much."""
        if self._is_constant_rate or self.rate_hz is None or len(self._packets_ms) < 2:
            return 0.0
        short_s = self._listed / self.rate_hz - self._packets_ms[-1] * 1e-3
        return short_s if short_s > _LONGEST_END * 1e-3 * float(np.diff(self._packets_ms).max()) else 0.0

    def _stamps_ns(self) -> list[int]:
        """Times of the pictures from the first: the container's where they fit, else by the constant rate."""
        if not self._is_constant_rate and self._numbers_by_stamp:
            return [round(1e6 * (stamp_ms - self._packets_ms[0])) for stamp_ms in self._packets_ms]
        if self.rate_hz is None:
            raise ConfigError(f"video {self._path}: has neither stamps nor a frame rate (convert it to one that has)")
        count = max(len(self._packets_ms), self._listed)
        if self._is_constant_rate:
            count = max(count, round(self._packets_ms[-1] * 1e-3 * self.rate_hz) + 1)
        if count > max(len(self._packets_ms), _MOST_LISTED):
            raise ConfigError(f"video {self._path}: {len(self._packets_ms)} pictures, and stamps for {count} (convert it)")
        return [round(1e9 * number / self.rate_hz) for number in range(count)]

    def _picture_number(self, last: int) -> int:
        """Number of the picture just grabbed, by its stamp if stamps can be used; `last` is the number of the one before."""
        stamp_ms = self._capture.get(cv2.CAP_PROP_POS_MSEC)
        if self._is_constant_rate:
            number = round(stamp_ms * 1e-3 * (self.rate_hz or 0.0))
            if number < len(self._undamaged_numbers):  # FFmpeg stamps a damaged AVI by counting what is left
                number = self._undamaged_numbers[number]
        elif self._numbers_by_stamp:
            number = bisect.bisect_left(self._packets_ms, stamp_ms - 1e-3)
        else:
            number = last + 1
        return min(max(number, last + 1), len(self.stamps_ns) - 1)


def _open(path: Path, *options: int) -> cv2.VideoCapture:
    """A video file by OpenCV's FFmpeg. Raises ConfigError if it cannot be played."""
    if not path.exists():
        raise ConfigError(f"video {path}: no such file")
    with os_errors_as_config_errors(path):
        open_regular(path).close()  # a pipe would be waited for
    capture = cv2.VideoCapture(str(path), cv2.CAP_FFMPEG, list(options))
    if not capture.isOpened():
        raise ConfigError(f"video {path}: cannot be read as a video")
    return capture


def _packet_stamps_ms(path: Path, listed: int) -> list[float]:
    """Stamps in ms of all packets of a file, in the order in which they are shown. Nothing is decoded.

    `listed`: pictures by the file's index, 0 if unknown. As many reads may fail as pictures of the index are still missing.
    """
    capture, stamps_ms, failures = _open(path, cv2.CAP_PROP_FORMAT, -1), list[float](), 0
    try:
        while failures <= max(listed - len(stamps_ms), 0):
            if capture.grab():
                stamps_ms.append(capture.get(cv2.CAP_PROP_POS_MSEC))
            else:
                failures += 1
    finally:
        capture.release()
    return sorted(stamps_ms)


def _is_constant(stamps_ms: list[float], rate_hz: float) -> bool:
    """True if all stamps are near multiples of the rate's period."""
    periods = np.array(stamps_ms) * 1e-3 * rate_hz
    return bool(np.all(np.abs(periods - np.rint(periods)) < _ON_GRID))


def number_ranges(numbers: list[int]) -> str:
    """Rising numbers in words: 3, 7 to 9, ..."""
    listed = set(numbers)
    starts = [number for number in numbers if number - 1 not in listed]
    ends = [number for number in numbers if number + 1 not in listed]
    parts = [str(a) if a == b else f"{a} to {b}" for a, b in zip(starts, ends, strict=True)]
    return ", ".join(parts[:_MOST_NAMED]) + (", ..." if len(parts) > _MOST_NAMED else "")


def _avi_chunks_left(path: Path, listed: int) -> list[int]:
    """Numbers of the pictures of an AVI file that its index lists and that begin where it says; [] without such an index."""
    with path.open("rb") as file, suppress(struct.error):
        entries, movie_at = _avi_index(file)
        if len(entries) != listed:
            return []
        numbers = []
        for number, (name, offset) in enumerate(entries):
            for start in (movie_at + offset, offset):  # both are in use
                file.seek(start)
                if file.read(4) == name:
                    numbers.append(number)
                    break
        return numbers
    return []


def _avi_index(file: IO[bytes]) -> tuple[list[tuple[bytes, int]], int]:
    """Name and offset of each picture's chunk, and the place from which offsets count. Raises struct.error for a file that is
    no AVI."""
    movie_at, at = 0, 12
    while True:
        file.seek(at)
        name, size = struct.unpack("<4sI", file.read(8))
        if name == b"LIST" and file.read(4) == b"movi":
            movie_at = at + 8
        if name == b"idx1":
            rows = struct.iter_unpack("<4s4xI4x", file.read(size // 16 * 16))
            return [(chunk, offset) for chunk, offset in rows if chunk[2:] in (b"dc", b"db")], movie_at
        at += 8 + size + size % 2
