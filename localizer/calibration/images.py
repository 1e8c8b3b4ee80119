"""SHELL: pictures for calibration, from files, folders and videos."""

from collections.abc import Iterator, Sequence
from pathlib import Path

import cv2
import numpy as np

from localizer.detection.image_regions import Pixels
from localizer.sources.base import SUFFIXES, as_colour
from localizer.sources.files import decode_file, picture_files, video_frames
from wire.process.output_files import replacing
from wire.toml_loader import ConfigError


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


def pictures(sources: Sequence[Path], every: int, grey: bool = False) -> Iterator[tuple[str, Pixels]]:
    """(name, BGR picture) of files, of all picture files in folders (by name), and of videos the sharpest of every `every`
    frames.

    Raises ConfigError for a file that is neither, and for pictures of different sizes.
    """
    first: tuple[str, Pixels] | None = None
    for name, picture in _all(sources, every, grey):
        first = first or (name, picture)
        if picture.shape != first[1].shape:
            sizes = [f"{p.shape[1]}x{p.shape[0]}" for p in (picture, first[1])]
            raise ConfigError(f"{name}: {sizes[0]}, but {first[0]} is {sizes[1]}: all must come from one camera at one size")
        yield name, picture


def sharpness(grey: Pixels) -> float:
    """Contrast between neighbouring pixels of a grey picture (height, width): the variance of its Laplacian."""
    return float(np.var(cv2.Laplacian(grey, cv2.CV_32F)))


def _all(sources: Sequence[Path], every: int, grey: bool) -> Iterator[tuple[str, Pixels]]:
    for source in sources:
        if source.is_dir():
            files = picture_files(source)
            if not files:
                raise ConfigError(f"{source}: no pictures in this folder (looked for: {', '.join(SUFFIXES)})")
            yield from ((str(path), read_picture(path, grey)) for path in files)
        elif not source.is_file() or source.suffix.lower() in SUFFIXES:
            yield str(source), read_picture(source, grey)
        else:
            yield from _sharp_frames(source, every)


def _sharp_frames(path: Path, every: int) -> Iterator[tuple[str, Pixels]]:
    """Frames of a video: of each `every` the one with the most contrast between neighbouring pixels."""
    sharpest, best = -1.0, None
    for index, picture in enumerate(video_frames(path), start=1):
        found = sharpness(np.asarray(cv2.cvtColor(picture, cv2.COLOR_BGR2GRAY), dtype=np.uint8))
        if found > sharpest:
            sharpest, best = found, (f"{path}:{index - 1}", picture)
        if best is not None and index % every == 0:
            yield best
            sharpest, best = -1.0, None
    if best is not None:
        yield best
