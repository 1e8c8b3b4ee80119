"""SHELL: `localizer check`: the pool's grid by the calibration, drawn over a picture or over live frames."""

from pathlib import Path
from typing import TYPE_CHECKING

import cv2
import numpy as np

from localizer.calibration.images import write_picture
from localizer.calibration.pool_grid import GRID_M, draw_grid, view_figures
from localizer.calibration.report import view_lines
from localizer.detection.image_regions import BAYER_TO_BGR, Pixels
from shoal.bus.bus import Bus
from shoal.config.experiment import Experiment
from shoal.errors import ConfigError
from shoal.messages import topics
from shoal.messages.codec import Header
from shoal.messages.messages import Frame
from shoal.runtime.runtime import Stop, wait

if TYPE_CHECKING:  # its web server takes long to import
    from localizer.view.mjpeg_server import MjpegServer

LIVE_PATIENCE_S = 5.0


def check_camera(experiment: Experiment, picture: Pixels | None, what: str, depth_m: float, out: Path) -> list[str]:
    """Draw the experiment's pool over a BGR picture called `what` (on black without one) into `out`; returns the report's
    lines. Raises ConfigError."""
    if picture is None:
        width, height = experiment.camera.size_px
        picture = np.zeros((height, width, 3), np.uint8)
    _check_size(experiment, picture, what)
    lines = view_lines(view_figures(experiment.camera, experiment.pool, depth_m), depth_m)
    drawn = picture.copy()
    draw_grid(drawn, experiment.camera, experiment.pool, depth_m)
    write_picture(out, drawn)
    return [*lines, f"Wrote {out}: pink the grid ({GRID_M} m) at {depth_m:g} m, yellow the surface's edge, green the floor's."]


class LivePictures:
    """Frames of the bus as BGR pictures, each newer than the last."""

    def __init__(self, bus: Bus, camera: str = "") -> None:
        """Make it for the only camera, or for one of several."""
        self._bus, self._frames = bus, bus.inbox(topics.FRAME.of_camera(camera), Frame)
        self._last_header: Header | None = None

    def next(self, stop: Stop) -> Pixels | None:
        """The next new picture; None when told to stop. Raises ConfigError when none comes."""
        frames = self._frames
        new = wait(self._bus, stop, lambda: frames.newest_header() is not self._last_header, LIVE_PATIENCE_S)
        self._last_header = frames.newest_header()
        received = frames.newest() if new else None
        if received is not None:
            return np.asarray(cv2.cvtColor(received.message.pixels, BAYER_TO_BGR), dtype=np.uint8)
        if stop.requested:
            return None
        why = frames.last_error or "is the station up, and a camera or simulator running?"
        raise ConfigError(f"--live: no frame on {frames.name} within {LIVE_PATIENCE_S:g} s: {why}")


def show_live(experiment: Experiment, pictures: LivePictures, page: "MjpegServer", depth_m: float, stop: Stop) -> None:
    """Show every new frame under the grid in a browser, until told to stop, for aiming the camera. Raises ConfigError when
    no frame comes, or one of another size."""
    while (picture := pictures.next(stop)) is not None:
        _check_size(experiment, picture, "the newest frame")
        draw_grid(picture, experiment.camera, experiment.pool, depth_m)
        good, jpeg = cv2.imencode(".jpg", picture)
        if good:
            page.show(jpeg.tobytes())


def _check_size(experiment: Experiment, picture: Pixels, what: str) -> None:
    width, height = experiment.camera.size_px
    if picture.shape[:2] != (height, width):
        size = f"{picture.shape[1]}x{picture.shape[0]}"
        raise ConfigError(f"{what}: {size}, but camera.size_px of experiment {experiment.name!r} is {width}x{height}")
