"""SHELL: a camera at this machine, through Video4Linux.

A thread grabs every frame, so the driver's queue never ages; the newest one wins. OpenCV maps the time that the driver put on
the buffer (V4L2's `timestamp`, seconds and microseconds of CLOCK_MONOTONIC) to CAP_PROP_POS_MSEC, valid from `grab` to the
next `grab`; time.monotonic is the same clock. Drivers stamp the end of the frame's exposure or its start
(`camera.stamp_marks`); with UVC cameras it is the arrival of the first data, after the exposure. OpenCV does not tell which
clock a driver used. An impossible stamp is rejected: the arrival counts, and `localizer latency` reports it. A driver whose
stamps have been possible once is believed however old they are: after a standstill of this process its buffers hold pictures
from before, which no arrival may make new.

Two buffers rather than one: with a single buffer the driver has none to fill while a frame is being decoded, and USB
cameras deliver every other frame only.
"""

import math
import os
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal, Protocol

import cv2

from localizer.sources.base import CapturedFrame, as_bayer, silent_after_s
from localizer.sources.latest_value import LatestValue
from localizer.sources.v4l2_controls import EXPOSURE_UNIT_S, V4l2Controls, set_all
from shoal.config.perception import Camera
from shoal.errors import ConfigError
from shoal.runtime.runtime import SLICE_S, Clock, Stop, guarded_thread, log

DEVICES = Path("/dev")
RETRY_S = 1.0  # s between attempts to open a camera that is gone
OLDEST_STAMP_NS = 1_000_000_000  # ns, largest age of a stamp of a clock that is not known; an older one is of another
LONGEST_EXPOSURE_S = 0.010  # s, for a warning: a robot at 0.3 m/s smears over 3 mm in that time
JOIN_S = 3.0
_SELECT_TIMEOUT_S = 2  # s that a hanging camera may block the grabbing thread; OpenCV's default is 10 s
_BUFFERS = 2
_MANUAL_EXPOSURE = 1  # V4L2_EXPOSURE_MANUAL
_TOLERANCE = 0.1  # relative, of a setting, as cameras round
_MJPG = 0x47504A4D  # four-character code


class Capture(Protocol):
    """The part of cv2.VideoCapture that is used."""

    def isOpened(self) -> bool: ...
    def set(self, propId: int, value: float, /) -> bool: ...
    def get(self, propId: int, /) -> float: ...
    def grab(self) -> bool: ...
    def retrieve(self) -> tuple[bool, Any]: ...
    def release(self) -> None: ...


def open_capture(device: str) -> Capture:
    """The device by OpenCV; check `isOpened`."""
    os.environ.setdefault("OPENCV_VIDEOIO_V4L_SELECT_TIMEOUT", str(_SELECT_TIMEOUT_S))
    return cv2.VideoCapture(device, cv2.CAP_V4L2)


def check_device(device: str, open_device: Callable[[str], Capture] = open_capture, folder: Path = DEVICES) -> None:
    """Raise ConfigError, naming the devices in `folder`, if the device cannot be opened as a camera now."""
    capture = open_device(device) if Path(device).exists() else None
    if capture is not None:
        opened = capture.isOpened()
        capture.release()
        if opened:
            return
    reason = "no such device" if capture is None else "cannot be opened as a camera (in use, not permitted, or none)"
    there = ", ".join(sorted(str(path) for path in folder.glob("video*"))) or f"none ({folder}/video*)"
    raise ConfigError(f"camera {device}: {reason}; there are: {there}")


def middle_of_exposure_ns(
    driver_ns: int, arrived_ns: int, exposure_ns: int, marks: Literal["start", "end"], oldest_ns: float = OLDEST_STAMP_NS
) -> tuple[int, bool]:
    """The middle of an exposure by the monotonic clock, and True if the driver's stamp could be used."""
    if not 0 < driver_ns <= arrived_ns <= driver_ns + oldest_ns:
        return arrived_ns - exposure_ns // 2, False
    return (driver_ns + exposure_ns // 2 if marks == "start" else driver_ns - exposure_ns // 2), True


def configure(capture: Capture, camera: Camera) -> list[str]:
    """Set size and rate first, as they restart the stream, then switch everything automatic off. Returns the settings that
    the camera did not accept.

    What OpenCV cannot set, as V4L2_CID_AUTOGAIN, `camera.controls` does.
    """
    capture.set(cv2.CAP_PROP_BUFFERSIZE, _BUFFERS)
    settings = [
        ("width", cv2.CAP_PROP_FRAME_WIDTH, camera.size_px[0]),
        ("height", cv2.CAP_PROP_FRAME_HEIGHT, camera.size_px[1]),
        ("frames per second", cv2.CAP_PROP_FPS, camera.rate_hz),
        ("exposure mode", cv2.CAP_PROP_AUTO_EXPOSURE, _MANUAL_EXPOSURE),
        ("exposure in 100 us", cv2.CAP_PROP_EXPOSURE, camera.exposure_s / EXPOSURE_UNIT_S),
    ]
    size_and_rate, exposure = settings[:3], settings[3:]
    _set_all(capture, size_and_rate)
    compressed = capture.get(cv2.CAP_PROP_FPS) < camera.rate_hz * (1.0 - _TOLERANCE)  # raw pictures do not fit through USB 2
    if compressed:
        _set_all(capture, [("format", cv2.CAP_PROP_FOURCC, _MJPG), *size_and_rate])
    for automatic in (cv2.CAP_PROP_AUTO_WB, cv2.CAP_PROP_AUTOFOCUS, cv2.CAP_PROP_BACKLIGHT):  # not every camera has them
        capture.set(automatic, 0)
    _set_all(capture, exposure)
    readings = [(name, value, capture.get(key)) for name, key, value in settings]
    refused = ["pictures compressed (MJPG) instead of raw: corners are found less well"] if compressed else []
    return refused + [
        f"{name} {got:g} instead of {value:g}" for name, value, got in readings if abs(got - value) > _TOLERANCE * value
    ]


def _set_all(capture: Capture, settings: Sequence[tuple[str, int, float]]) -> None:
    for _, key, value in settings:
        capture.set(key, value)


class V4l2Source:
    """A camera with everything automatic switched off. It survives unplugging and plugging in."""

    def __init__(
        self,
        device: str,
        camera: Camera,
        clock: Clock,
        open_device: Callable[[str], Capture] = open_capture,
        monotonic_ns: Callable[[], int] = time.monotonic_ns,
    ) -> None:
        self.trouble, self.silent_after_s = "", silent_after_s(camera.rate_hz)
        self._device, self._camera, self._clock = device, camera, clock
        self._open, self._monotonic_ns = open_device, monotonic_ns
        self._exposure_ns = round(camera.exposure_s * 1e9)
        self._oldest_ns: float = OLDEST_STAMP_NS
        self._newest: LatestValue[CapturedFrame] = LatestValue()
        self._closing = threading.Event()
        self._thread: threading.Thread | None = None
        if camera.exposure_s > LONGEST_EXPOSURE_S:
            log.warning("camera.exposure_s = %g: more than %g s smears moving robots", camera.exposure_s, LONGEST_EXPOSURE_S)

    def frames(self, stop: Stop) -> Iterator[CapturedFrame | None]:
        """See FrameSource."""
        # a daemon: `grab` on a camera that hangs returns late, and must not keep the process
        self._thread = guarded_thread(stop, "camera", self._keep_grabbing, daemon=True)
        self._thread.start()
        silent_since = time.monotonic()
        while not stop.requested:
            left_s = self.silent_after_s - (time.monotonic() - silent_since)
            captured = self._newest.take(min(max(left_s, 0.0), SLICE_S))
            if captured is not None:
                yield replace(captured, dropped=self._newest.overtaken)
            elif left_s > 0.0:
                continue
            elif not stop.requested:
                yield None
            silent_since = time.monotonic()

    def close(self) -> None:
        """Stop grabbing."""
        self._closing.set()
        if self._thread is not None:
            self._thread.join(JOIN_S)

    # --- the grabbing thread

    def _keep_grabbing(self) -> None:
        """Open the camera and grab frames, again after each failure, until the source is closed."""
        while not self._closing.is_set():
            try:
                self._attempt()
            except Exception as error:  # an unexpected error of a driver costs one attempt, not the camera
                self._report(f"failed: {type(error).__name__}: {error}")
            self._closing.wait(RETRY_S)

    def _attempt(self) -> None:
        """Open the device and take its frames until it fails, or is closed."""
        capture = self._open(self._device)
        self._oldest_ns = OLDEST_STAMP_NS  # it may be another camera
        try:
            if capture.isOpened():
                self._configure(capture)
                self._stream(capture)
            else:
                self._report("cannot be opened")
        finally:
            capture.release()

    def _stream(self, capture: Capture) -> None:
        """Deliver pictures of an open camera until it is closed or stops."""
        while not self._closing.is_set():
            if not capture.grab():
                self._report("stopped delivering")
                return
            arrived_ns = self._monotonic_ns()
            driver_ns = round(capture.get(cv2.CAP_PROP_POS_MSEC) * 1e6)
            good, picture = capture.retrieve()
            pixels = as_bayer(picture) if good else None
            if pixels is None:
                self._report("delivers what is no 8-bit picture")
                continue
            if self.trouble:
                self.trouble = ""
                log.info("camera %s delivers", self._device)
            self._newest.put(self._captured(pixels, driver_ns, arrived_ns))

    def _captured(self, pixels: Any, driver_ns: int, arrived_ns: int) -> CapturedFrame:
        """A frame stamped with the middle of its exposure, by the driver's clock where that is ours."""
        marks, oldest_ns = self._camera.stamp_marks, self._oldest_ns
        middle_ns, stamped = middle_of_exposure_ns(driver_ns, arrived_ns, self._exposure_ns, marks, oldest_ns)
        if stamped:
            self._oldest_ns = math.inf  # its clock is ours
        else:
            middle_ns -= round(1e9 * self._camera.readout_s)  # what arrives has been read out
        now_ns, now_monotonic_ns = self._clock.now_ns(), self._monotonic_ns()
        first_row_ns = now_ns - (now_monotonic_ns - middle_ns)
        instant_ns = min(first_row_ns + round(0.5e9 * self._camera.readout_s), now_ns)
        return CapturedFrame(pixels, instant_ns, instant_ns, now_ns - (now_monotonic_ns - arrived_ns), stamped=stamped)

    def _report(self, trouble: str) -> None:
        earlier_trouble, self.trouble = self.trouble, f"{self._device} {trouble}"
        if earlier_trouble != self.trouble and not self._closing.is_set():  # a closed device delivers no more: no trouble
            log.error("camera %s; trying again", self.trouble)

    def _configure(self, capture: Capture) -> None:
        """Set the camera as the experiment says, warn of what it refuses, and read the exposure that it has."""
        refused = configure(capture, self._camera)
        if refused:
            log.warning("camera %s does not do as told: %s", self._device, ", ".join(refused))
        for reason in set_all(V4l2Controls(self._device), dict(self._camera.controls)):
            log.warning("%s", reason)
        exposure = capture.get(cv2.CAP_PROP_EXPOSURE)  # what it really is; negative where the camera does not say
        self._exposure_ns = round((exposure * EXPOSURE_UNIT_S if exposure > 0 else self._camera.exposure_s) * 1e9)
