"""SHELL: opens the source of frames that a command line names."""

import math
from pathlib import Path

from localizer.sources.base import FrameSource
from localizer.sources.files import FolderSource, VideoSource
from localizer.sources.v4l2 import V4l2Source, check_device
from shoal.config.perception import Camera
from shoal.errors import ConfigError
from shoal.runtime.runtime import Clock

BUS = "bus"
ALLOWED = "bus, v4l2:/dev/video0, video:FILE[:FPS|:max], folder:DIR[:FPS|:max]"
FASTEST = math.inf


def open_own(name: str, camera: Camera, clock: Clock, option: str = "--source") -> FrameSource:
    """A camera at this machine, or recorded pictures in its place, as an option names it. Raises ConfigError, naming the
    allowed forms."""
    kind, _, where = name.partition(":")
    if not where:
        raise ConfigError(f"{option} {name}: unknown (allowed: {ALLOWED})")
    if kind == "v4l2":
        check_device(where)
        return V4l2Source(where, camera, clock)
    path, rate_hz = _with_rate(where)
    fastest = rate_hz == FASTEST
    if kind == "video":
        return VideoSource(Path(path), None if fastest else rate_hz, clock, fastest)
    if kind == "folder":
        return FolderSource(Path(path), camera.rate_hz if fastest or rate_hz is None else rate_hz, clock, fastest)
    raise ConfigError(f"{option} {name}: unknown (allowed: {ALLOWED})")


def _with_rate(where: str) -> tuple[str, float | None]:
    """Split `FILE:25` into FILE and 25 Hz, `FILE:max` into FILE and as fast as possible. Any other colon belongs to the
    name."""
    path, colon, last = where.rpartition(":")
    if not colon:
        return where, None
    if last == "max":
        return path, FASTEST
    try:
        rate_hz = float(last)
    except ValueError:
        return where, None
    if not 0.0 < rate_hz <= 1000.0:
        raise ConfigError(f"{where}: a frame rate of {last} is not possible (allowed: above 0 to 1000, or max)")
    return path, rate_hz
