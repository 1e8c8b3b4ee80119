"""SHELL: previews, made in a thread of their own after the poses are out.

They go to the bus and to the page of `--show`; for a camera at this machine the raw frames go to the bus too. The newest
wins: a slow viewer never slows the poses.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import cv2
import numpy as np

from localizer.detection.image_regions import Pixels
from localizer.sources.base import CapturedFrame
from localizer.tracking.fleet_localizer import LocalizationResult
from localizer.view.worker import LatestItemWorker
from shoal.bus.bus import Bus
from shoal.messages import topics
from shoal.messages.messages import Frame, Obstacles, Preview
from shoal.runtime.runtime import Clock, Stop

if TYPE_CHECKING:  # its web server takes long to import
    from localizer.view.mjpeg_server import MjpegServer

PAGE_RATE_HZ = 15.0  # Hz of the page's pictures, each of which takes 5 ms of one core
_JPEG_QUALITY = 70  # about 40 kB at 640 x 480
_BLANK_PX = (480, 640)
_RED = (60, 60, 220)


class RateLimiter:
    """Selects one stamp per period: the nearest, as a camera is as often early as late, and its rate need be no multiple.

    A clock that was set back does not stop it.
    """

    def __init__(self, rate_hz: float) -> None:
        self._period_ns = round(1e9 / rate_hz) if rate_hz > 0 else None
        self._next_ns = self._last_ns = 0

    def due(self, stamp_ns: int) -> bool:
        """True for the stamp that is nearest to the next due instant. The instant after that is a period later."""
        since_last_ns = stamp_ns - self._last_ns
        self._last_ns = stamp_ns
        if self._period_ns is None:
            return False
        was_set_back = since_last_ns < 0
        early_ns = self._next_ns - stamp_ns
        next_stamp_is_nearer = since_last_ns < 2 * early_ns  # if it follows as soon as this one followed the last
        if not was_set_back and next_stamp_is_nearer:
            return False
        has_missed_a_period = -early_ns >= self._period_ns
        if was_set_back or has_missed_a_period:
            self._next_ns = stamp_ns  # begin anew from here
        self._next_ns += self._period_ns
        return True


@dataclass(frozen=True, eq=False)
class _PreviewItem:
    """A frame with its result (None: no frame), and a message for pictures without one; whether bus and page are due one."""

    captured: CapturedFrame | None
    result: LocalizationResult | None
    stamp_ns: int
    obstacles: Obstacles
    message: str
    on_bus: bool
    on_page: bool


def _combined(waiting: _PreviewItem, newer: _PreviewItem) -> _PreviewItem:
    """The newer picture, on what either was due: a slow machine shows each period one."""
    return replace(newer, on_bus=waiting.on_bus or newer.on_bus, on_page=waiting.on_page or newer.on_page)


class PreviewPublisher:
    """The thread, and the outputs that it feeds."""

    def __init__(
        self,
        draw: Callable[[Pixels, LocalizationResult, Obstacles], Pixels],
        bus: Bus,
        clock: Clock,
        stop: Stop,
        preview_rate_hz: float,
        page: "MjpegServer | None" = None,
        publish_frames: bool = False,
        camera: str = "",
    ) -> None:
        """`camera` is one of several, whose topics are published; "" the only one."""
        self._frames, self._previews = topics.FRAME.of_camera(camera), topics.PREVIEW.of_camera(camera)
        self._draw, self._bus, self._clock, self._page, self._publish_frames = draw, bus, clock, page, publish_frames
        self._preview, self._paging = RateLimiter(preview_rate_hz), RateLimiter(PAGE_RATE_HZ if page is not None else 0.0)
        self._worker: LatestItemWorker[_PreviewItem] = LatestItemWorker("previews", self._make, stop, combine=_combined)

    def offer(self, captured: CapturedFrame, result: LocalizationResult, obstacles: Obstacles) -> None:
        """Offer a frame and its result. Never waits."""
        self._offer(captured, result, captured.stamp_ns, obstacles)

    def offer_nothing(self, message: str, stamp_ns: int) -> None:
        """Offer a blank picture with a message: the last frame would look live."""
        self._offer(None, None, stamp_ns, Obstacles(), message)

    def close(self) -> None:
        """Finish the last one."""
        self._worker.close()

    def _offer(
        self,
        captured: CapturedFrame | None,
        result: LocalizationResult | None,
        stamp_ns: int,
        obstacles: Obstacles,
        message: str = "",
    ) -> None:
        """Wake the thread, unless it has nothing to do: it would take Python's lock from the caller."""
        on_bus, on_page = self._preview.due(stamp_ns), self._paging.due(stamp_ns)
        if on_bus or on_page or (self._publish_frames and captured is not None):
            self._worker.offer(_PreviewItem(captured, result, stamp_ns, obstacles, message, on_bus, on_page))

    def _make(self, item: _PreviewItem) -> None:
        """Publish the raw frame of an item, and draw its preview if somebody looks."""
        try:
            self._publish_raw(item)
        finally:
            if item.on_bus or item.on_page:
                self._draw_and_show(item)

    def _publish_raw(self, item: _PreviewItem) -> None:
        captured = item.captured
        if captured is not None and self._publish_frames:
            self._bus.publish(self._frames, Frame(captured.pixels), captured.stamp_ns, age_ns=self._age_ns(item))

    def _age_ns(self, item: _PreviewItem) -> int:
        return 0 if item.captured is None else max(self._clock.now_ns() - item.captured.instant_ns, 0)

    def _draw_and_show(self, item: _PreviewItem) -> None:
        """Draw and show a preview; if drawing fails, a blank one with the reason."""
        try:
            picture = self._picture(item)
        except Exception as error:
            self._show(_blank(f"no preview: {error}"), item)  # the picture before would look live
            raise
        self._show(picture, item)

    def _picture(self, item: _PreviewItem) -> Pixels:
        if item.captured is not None and item.result is not None:
            return self._draw(item.captured.pixels, item.result, item.obstacles)
        return _blank(item.message)

    def _show(self, picture: Pixels, item: _PreviewItem) -> None:
        """Encode a picture as JPEG, and give it to the bus and the page that want it."""
        _, encoded = cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY])
        jpeg = encoded.tobytes()
        if item.on_bus:
            self._bus.publish(self._previews, Preview(jpeg), item.stamp_ns, age_ns=self._age_ns(item))
        if item.on_page and self._page is not None:
            self._page.show(jpeg)


def _blank(message: str) -> Pixels:
    picture = np.full((*_BLANK_PX, 3), 24, np.uint8)
    cv2.putText(picture, message, (20, _BLANK_PX[0] // 2), cv2.FONT_HERSHEY_SIMPLEX, 0.6, _RED, 1, cv2.LINE_AA)
    return picture
