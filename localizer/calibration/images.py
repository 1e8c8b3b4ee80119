"""SHELL: pictures for calibration, from files, folders and videos."""

import os
from collections.abc import Iterator, Sequence
from contextlib import closing
from pathlib import Path

import cv2
import numpy as np

from localizer.detection.image_regions import Pixels
from localizer.sources.base import SUFFIXES, as_colour
from localizer.sources.files import decode_file, picture_files
from localizer.sources.video import VideoReader
from shoal.errors import ConfigError
from shoal.runtime.output_files import replacing


def read_picture(path: Path, grey: bool = False) -> Pixels:
    """A picture file as BGR (height, width, 3); one channel is raw Bayer RGGB, or grey with `grey`. Raises ConfigError."""
    try:
        picture = decode_file(path)
    except OSError as error:
        raise ConfigError(f"{path}: cannot be read: {error.strerror}") from None
    if picture is None:
        kinds = ", ".join(s[1:] for s in SUFFIXES)
        raise ConfigError(f"{path}: not a picture that OpenCV reads (allowed: {kinds}; at most 134 million pixels)")
    colour = as_colour(picture, grey)
    if colour is None:
        raise ConfigError(f"{path}: {picture.dtype}, must be a picture of 8 bits a channel")
    return colour


def write_picture(path: Path, picture: Pixels) -> None:
    """Write a BGR picture (height, width, 3) in the format of the suffix, completely or not at all. Raises ConfigError."""
    if path.suffix.lower() not in SUFFIXES:
        raise ConfigError(f"{path}: {path.suffix!r} is no kind of picture (allowed: {', '.join(SUFFIXES)})")
    _, data = cv2.imencode(path.suffix, picture)
    try:
        with replacing(path) as file:
            file.write(data.tobytes())
    except OSError as error:
        raise ConfigError(f"{path}: cannot be written: {error.strerror}") from None


def pictures(
    sources: Sequence[Path], every: int, grey: bool = False, left_out: dict[str, str] | None = None
) -> Iterator[tuple[str, Pixels]]:
    """(name, BGR picture) of files, of all picture files in folders (by name), and of videos the sharpest of every `every`
    frames.

    A folder's files that cannot be read go into `left_out`, by name, with the reason, and so does damage of a video. Raises
    ConfigError for a file that was named itself.
    """
    reasons = {} if left_out is None else left_out
    for source in sources:
        if source.is_dir():
            files = picture_files(source)
            if not files:
                raise ConfigError(f"{source}: no pictures in this folder (looked for: {', '.join(SUFFIXES)})")
            for path in files:
                try:
                    picture = read_picture(path, grey)
                except ConfigError as error:
                    reasons[shown(path)] = str(error).removeprefix(f"{path}: ")
                else:
                    yield shown(path), picture
        elif not source.is_file() or source.suffix.lower() in SUFFIXES:
            yield shown(source), read_picture(source, grey)
        else:
            yield from _sharp_frames(source, every, reasons)


def shown(path: Path) -> str:
    """The name of a file as it can be printed, whatever bytes it is made of."""
    return os.fsencode(path).decode(errors="replace")


def sharpness(grey: Pixels) -> float:
    """Contrast between neighbouring pixels of a grey picture (height, width): the variance of its Laplacian."""
    return float(np.var(cv2.Laplacian(grey, cv2.CV_32F)))


def _sharp_frames(path: Path, every: int, left_out: dict[str, str]) -> Iterator[tuple[str, Pixels]]:
    """The sharpest frame of each `every` frames of a video: the one with the most contrast between neighbouring pixels."""
    sharpest, best, group = -1.0, None, 0
    with closing(VideoReader(path)) as video:
        for picture in video.pictures():
            if best is not None and picture.number // every > group:
                yield best
                sharpest, best = -1.0, None
            group = picture.number // every
            contrast = sharpness(np.asarray(cv2.cvtColor(picture.pixels, cv2.COLOR_BGR2GRAY), dtype=np.uint8))
            if contrast > sharpest:
                sharpest, best = contrast, (f"{shown(path)}:{picture.number}", picture.pixels)
        if best is not None:
            yield best
        if damage := video.damage():
            left_out[shown(path)] = damage.removeprefix(f"video {path}: ")
