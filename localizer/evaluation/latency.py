"""SHELL: `localizer latency`: age of published poses and regularity of frames, a self-test of camera and computer.

The localizer is measured as `run` runs it, with obstacles, previews and video, on a bus of this process alone. Left out are
Zenoh's transmission, the page of `--show`, and the robots' reports.

The offset of a driver's stamp from the light cannot be seen here. It is a constant of the camera, some milliseconds with
USB cameras; only a clock in the picture would show it.
"""

import json
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass, replace

import numpy as np

from localizer.detection.image_regions import Pixels
from localizer.node import LocalizerNode
from localizer.sources.base import CapturedFrame, FrameSource
from shoal.bus.bus import Bus
from shoal.bus.memory_transport import MemoryHub, MemoryTransport
from shoal.config.experiment import Experiment
from shoal.frames import Array
from shoal.messages import topics
from shoal.messages.codec import DecodeError, Header, decode
from shoal.messages.messages import CameraHealth, LocalizerStatus
from shoal.messages.topics import Topic
from shoal.runtime.runtime import Clock, Stop

WARM_UP = 5  # frames that are not counted: caches, exposure control, a backlog
_LARGEST_JITTER = 0.25  # of a period, p99; with more, the motion between frames differs from the Kalman filter's prediction
_LARGEST_AGE_PERIODS = 1.5  # periods, p99: one to expose, send and decode a frame, half of one to localize in it
_LARGEST_LOSS = 0.01  # share of frames
_LARGEST_DRIFT = 0.1  # of the period, median
_NO_PIXELS: Pixels = np.empty((0, 0), np.uint8)


@dataclass(frozen=True)
class Timing:
    """One frame: middle of the exposure, arrival, poses published, by the localizer's clock."""

    instant_ns: int
    arrived_ns: int
    ready_ns: int
    stamped: bool
    trouble: str = ""  # reason for a frame without poses


@dataclass(frozen=True)
class LatencyQuantiles:
    """Quantiles of a duration, ms."""

    p50: float
    p99: float
    max: float


@dataclass(frozen=True)
class Latency:
    """The result of `localizer latency`."""

    pictures: int
    dropped: int
    unstamped: int
    exposure_to_arrival_ms: LatencyQuantiles
    arrival_to_pose_ms: LatencyQuantiles
    exposure_to_pose_ms: LatencyQuantiles
    interval_ms: LatencyQuantiles
    warnings: tuple[str, ...]

    def to_json(self) -> str:
        return json.dumps(asdict(self), indent=1) + "\n"

    def to_text(self) -> str:
        """A table, then the warnings."""
        rows = {
            "exposure to arrival": self.exposure_to_arrival_ms,
            "arrival to pose": self.arrival_to_pose_ms,
            "exposure to pose": self.exposure_to_pose_ms,
            "between exposures": self.interval_ms,
        }
        lines = [f"{'ms':<20}{'median':>9}{'p99':>9}{'max':>9}"]
        lines += [f"{name:<20}{q.p50:9.2f}{q.p99:9.2f}{q.max:9.2f}" for name, q in rows.items()]
        lines += [f"{self.pictures} pictures, {self.dropped} dropped, {self.unstamped} without the camera's own stamp"]
        return "\n".join([*lines, *(f"warning: {text}" for text in self.warnings)])


OnLocalized = Callable[[int, str], None]  # called with a frame's stamp, and the reason if it has no poses


class _TimedSource:
    """A source that notes its frames, and ends after `seconds`."""

    def __init__(self, source: FrameSource, clock: Clock, seconds: float) -> None:
        self.pictures: list[CapturedFrame] = []
        self.done: dict[int, tuple[int, str]] = {}  # by stamp: time of publication, and the reason if there are no poses
        self._source, self._clock, self._seconds = source, clock, seconds

    @property
    def silent_after_s(self) -> float:
        return self._source.silent_after_s

    @property
    def trouble(self) -> str:
        return self._source.trouble

    def frames(self, stop: Stop) -> Iterator[CapturedFrame | None]:
        """The source's frames for the time of the measurement. Keeps each one's times, by our own clock."""
        end_ns = self._clock.now_ns() + round(self._seconds * 1e9)
        for captured in self._source.frames(stop):
            if captured is not None:  # by our own clock: a stamp of another would be carried over, and not be known again
                captured = replace(captured, stamp_ns=captured.instant_ns)
                self.pictures.append(replace(captured, pixels=_NO_PIXELS))  # a minute of them would fill the memory
            yield captured
            if self._clock.now_ns() >= end_ns:
                return

    def note(self, stamp_ns: int, trouble: str) -> None:
        self.done.setdefault(stamp_ns, (self._clock.now_ns(), trouble))

    def close(self) -> None:
        """Do nothing: the source is the caller's."""


def measure(
    source: FrameSource, localize: Callable[[FrameSource, OnLocalized], None], clock: Clock, seconds: float
) -> tuple[list[Timing], int]:
    """Localize for a while. Returns the frames after WARM_UP and the number that were dropped meanwhile.

    `localize` works through a source until it ends, and calls back when the poses of a frame are out, or that there are
    none.
    """
    watched = _TimedSource(source, clock, seconds)
    localize(watched, watched.note)
    before, counted = watched.pictures[:WARM_UP], watched.pictures[WARM_UP:]
    completions = [(captured, *watched.done[captured.stamp_ns]) for captured in counted if captured.stamp_ns in watched.done]
    timings = [
        Timing(captured.instant_ns, captured.arrived_ns, ready_ns, captured.stamped, why)
        for captured, ready_ns, why in completions
    ]
    return timings, counted[-1].dropped - before[-1].dropped if counted else 0


def localize_in_process(experiment: Experiment, clock: Clock, stop: Stop, source: FrameSource, report: OnLocalized) -> None:
    """Run the localizer on a source, with a bus of its own."""
    hub = MemoryHub()
    observer, own = Bus(MemoryTransport(hub)), Bus(MemoryTransport(hub))
    failed = 0  # pictures

    def hear(topic: Topic, key: str, header: Header, payload: bytes) -> None:
        nonlocal failed
        try:
            status = decode(LocalizerStatus, payload, "localizer", key)
        except DecodeError as error:  # times that cannot be
            report(header.stamp_ns, str(error))
            return
        localized = status.camera is CameraHealth.OK and status.failed == failed
        failed = status.failed
        report(header.stamp_ns, "" if localized else status.message)

    observer.subscribe(topics.LOCALIZER, None, hear)
    LocalizerNode(experiment, own, stop, clock, source).run()
    stop.raise_failure()


def assess(timings: Sequence[Timing], dropped: int, rate_hz: float) -> Latency | None:
    """The distributions, with warnings about deviations at `rate_hz`; None for fewer than two frames."""
    if len(timings) < 2:
        return None
    instants, arrivals, ready = (
        np.array([getattr(t, name) for t in timings], dtype=np.float64) * 1e-6
        for name in ("instant_ns", "arrived_ns", "ready_ns")
    )
    intervals, unstamped = np.diff(instants), sum(not t.stamped for t in timings)
    without = [t.trouble for t in timings if t.trouble]
    age, period = _quantiles(ready - instants), 1e3 / rate_hz
    jitter = float(np.quantile(np.abs(intervals - np.median(intervals)), 0.99))
    loss = dropped / (len(timings) + dropped)
    checks = (
        (bool(without), f"no poses of {len(without)} pictures ({without[-1]})" if without else ""),
        (unstamped > 0, f"{unstamped} pictures without a usable stamp of the camera: their age is a guess"),
        (jitter > _LARGEST_JITTER * period,
         f"exposures {jitter:.1f} ms off their rhythm (p99; limit {_LARGEST_JITTER * period:.1f})"),
        (abs(float(np.median(intervals)) - period) > _LARGEST_DRIFT * period,
         f"a picture every {np.median(intervals):.1f} ms, the experiment says {period:.1f}"),
        (age.p99 > _LARGEST_AGE_PERIODS * period,
         f"poses {age.p99:.0f} ms old (p99; limit {_LARGEST_AGE_PERIODS * period:.0f})"),
        (loss > _LARGEST_LOSS, f"{loss:.0%} of the pictures dropped (limit {_LARGEST_LOSS:.0%})"),
    )  # fmt: skip
    return Latency(
        pictures=len(timings), dropped=dropped, unstamped=unstamped,
        exposure_to_arrival_ms=_quantiles(arrivals - instants), arrival_to_pose_ms=_quantiles(ready - arrivals),
        exposure_to_pose_ms=age, interval_ms=_quantiles(intervals),
        warnings=tuple(text for wrong, text in checks if wrong),
    )  # fmt: skip


def _quantiles(values_ms: Array) -> LatencyQuantiles:
    return LatencyQuantiles(float(np.median(values_ms)), float(np.quantile(values_ms, 0.99)), float(np.max(values_ms)))
