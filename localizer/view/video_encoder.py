"""SHELL: the log's video, as `recording.video` says, encoded in a thread of low priority.

No other part waits for it: of frames that come faster than they can be encoded the newest counts. Where simulated time waits
for the localizer it waits for the film as well, and every picture counts.
"""

import importlib
import os
import threading
from collections.abc import Callable
from fractions import Fraction
from typing import Any

import cv2
import numpy as np

from localizer.detection.image_regions import BAYER_TO_BGR, Pixels
from localizer.sources.base import CapturedFrame
from localizer.view.preview import RateLimiter
from localizer.view.worker import LatestItemWorker
from shoal.bus.bus import Bus
from shoal.config.experiment import Experiment
from shoal.config.recording import Recording
from shoal.errors import ConfigError
from shoal.messages import topics
from shoal.messages.messages import Picture, Video
from shoal.runtime.runtime import Stop, log

NICENESS = 15
KEY_EVERY_S = 1.0  # s between key pictures, at which a viewer that jumps can begin
WHOLE = 0.9  # share of the pictures from which on nobody misses the others
CLOCK_HZ = 1000  # Hz of the video's own time stamps


class VideoEncoder:
    """The thread, ended by `close`. A frame that cannot be encoded is left out, and the encoder is made anew."""

    def __init__(self, experiment: Experiment, bus: Bus, stop: Stop, camera: str = "", waited_for: bool = False) -> None:
        """For one of several cameras, or the only one (""). `waited_for`: encode each picture before `offer` returns. Raises
        ConfigError if the needed package is not installed."""
        self._recording, self._size_px = experiment.recording, experiment.camera.size_px
        self._pack = packer(self._recording, self._size_px)
        self._due, self._bus = RateLimiter(experiment.recording.video_rate_hz), bus
        self._film = topics.VIDEO if experiment.recording.video == "h264" else topics.PICTURE
        self._topic = self._film.of_camera(camera)
        self._offered, self._encoded, self._waited_for = 0, 0, waited_for
        self._worker: LatestItemWorker[CapturedFrame] = LatestItemWorker("video", self._send, stop, _give_way)

    def offer(self, captured: CapturedFrame) -> None:
        """Offer a frame. Waits only if the film is waited for."""
        if self._due.due(captured.stamp_ns):
            self._offered += 1
            (self._worker.work if self._waited_for else self._worker.offer)(captured)

    def close(self) -> None:
        """Finish the last one, and say whether the film is a part of what was asked for."""
        self._worker.close()
        if self._encoded < WHOLE * self._offered:
            log.warning("the video holds %d of %d pictures: the machine is too busy for more", self._encoded, self._offered)

    def _send(self, captured: CapturedFrame) -> None:
        """Encode a picture and publish it. After an error the encoder is made anew."""
        try:
            packed = self._pack(captured.pixels, captured.stamp_ns)
            self._encoded += 1
        except Exception:
            self._pack = packer(self._recording, self._size_px)  # a codec that has failed is in no known state
            raise
        if packed:
            message = Video(packed) if self._film is topics.VIDEO else Picture(packed)
            self._bus.publish(self._topic, message, captured.stamp_ns)


def _give_way() -> None:
    if hasattr(os, "setpriority"):
        os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), NICENESS)  # of this thread alone (Linux)


Pack = Callable[[Pixels, int], bytes]


def packer(recording: Recording, size_px: tuple[int, int]) -> Pack:
    """An encoder: a function from a Bayer picture (height, width) and its stamp to bytes."""
    width, height = (max(2, round(n * recording.video_scale / 2) * 2) for n in size_px)  # even: colours come by the square

    def coloured(pixels: Pixels) -> Pixels:
        bgr = cv2.cvtColor(pixels, BAYER_TO_BGR)
        if (bgr.shape[1], bgr.shape[0]) != (width, height):
            bgr = cv2.resize(bgr, (width, height), interpolation=cv2.INTER_AREA)
        return np.asarray(bgr, dtype=np.uint8)

    if recording.video == "h264":
        return _film(recording, width, height, coloured)

    def still(pixels: Pixels, _: int) -> bytes:
        return cv2.imencode(".jpg", coloured(pixels), [cv2.IMWRITE_JPEG_QUALITY, recording.jpeg_quality])[1].tobytes()

    return still


def _film(recording: Recording, width: int, height: int, coloured: Callable[[Pixels], Pixels]) -> Pack:
    """An H.264 encoder as viewers need it: Annex B, parameters with each key picture, no look-ahead."""
    try:
        av: Any = importlib.import_module("av")
    except ModuleNotFoundError:
        raise ConfigError(
            'recording.video = "h264": not installed here (pip install \'shoal[video]\', or take "jpeg")'
        ) from None
    codec = av.CodecContext.create("libx264", "w")
    codec.width, codec.height, codec.pix_fmt = width, height, "yuv420p"
    codec.bit_rate = round(recording.video_mbps * 1e6)
    codec.framerate = Fraction(recording.video_rate_hz).limit_denominator(1000)
    codec.time_base, codec.thread_count, codec.max_b_frames = Fraction(1, CLOCK_HZ), 1, 0
    key_every = max(1, round(recording.video_rate_hz * KEY_EVERY_S))
    codec.options = {
        "preset": "ultrafast",
        "tune": "zerolatency",
        "x264-params": f"keyint={key_every}:min-keyint={key_every}:scenecut=0:repeat-headers=1:annexb=1:threads=1",
    }
    first_ns: list[int] = []

    def pack(pixels: Pixels, stamp_ns: int) -> bytes:
        frame = av.VideoFrame.from_ndarray(coloured(pixels), format="bgr24")
        first_ns[:] = first_ns or [stamp_ns]
        frame.pts = (stamp_ns - first_ns[0]) * CLOCK_HZ // 10**9
        return b"".join(bytes(packet) for packet in codec.encode(frame))

    return pack
