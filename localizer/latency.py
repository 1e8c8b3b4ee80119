"""SHELL: how old a pose is when it is ready, and how even the pictures come: a self-test of camera and computer.

What it cannot see is how far a driver's stamp is from the light: a constant of the camera, some milliseconds with USB
cameras, that only a clock in the picture would show.
"""

import json
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass

import numpy as np

from localizer.locate import Located
from localizer.patch import Pixels
from localizer.shot import Shot, Source
from wire.frames import Array
from wire.runtime import Clock, Stop

WARM_UP = 5  # pictures: caches, exposure control, a backlog from before
_LARGEST_JITTER = 0.25  # of a period, p99: more, and the motion between pictures is no longer what the filter thinks
_LARGEST_AGE_PERIODS = 1.5  # p99: one to expose, send and decode a picture, half of one to look at it
_LARGEST_LOSS = 0.01
_LARGEST_DRIFT = 0.1  # of the period, median


@dataclass(frozen=True)
class Timing:
    """One picture: middle of the exposure, arrival, poses ready, by the localizer's clock."""

    instant_ns: int
    arrived_ns: int
    ready_ns: int
    stamped: bool


@dataclass(frozen=True)
class Quantiles:
    """Of a duration, in ms."""

    p50: float
    p99: float
    max: float


@dataclass(frozen=True)
class Latency:
    """The result."""

    pictures: int
    dropped: int
    unstamped: int
    exposure_to_arrival_ms: Quantiles
    arrival_to_pose_ms: Quantiles
    exposure_to_pose_ms: Quantiles
    interval_ms: Quantiles
    warnings: tuple[str, ...]

    def to_json(self) -> str:
        """All of it."""
        return json.dumps(asdict(self), indent=1) + "\n"

    def to_text(self) -> str:
        """A table for people, then the warnings."""
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


def measure(
    source: Source, step: Callable[[Pixels, int], Located], clock: Clock, stop: Stop, seconds: float
) -> tuple[list[Timing], int]:
    """Localize for a while. Returns the pictures after WARM_UP and how many were dropped meanwhile."""
    timings: list[Timing] = []
    dropped, dropped_before, seen = 0, 0, 0
    end_ns = clock.now_ns() + round(seconds * 1e9)
    for shot in source.shots(stop):
        if shot is not None:
            seen += 1
            dropped, dropped_before = shot.dropped, shot.dropped if seen <= WARM_UP else dropped_before
            timing = _time(shot, step, clock)
            timings += [timing] if seen > WARM_UP else []
        if clock.now_ns() >= end_ns:
            break
    return timings, dropped - dropped_before


def _time(shot: Shot, step: Callable[[Pixels, int], Located], clock: Clock) -> Timing:
    step(shot.pixels, shot.instant_ns)
    return Timing(shot.instant_ns, shot.arrived_ns, clock.now_ns(), shot.stamped)


def judge(timings: Sequence[Timing], dropped: int, rate_hz: float) -> Latency | None:
    """The distributions, and what is not as it should be at `rate_hz`; None if there were not even two pictures."""
    if len(timings) < 2:
        return None
    instants, arrivals, ready = (
        np.array([getattr(t, name) for t in timings], dtype=np.float64) * 1e-6
        for name in ("instant_ns", "arrived_ns", "ready_ns")
    )
    intervals, unstamped = np.diff(instants), sum(not t.stamped for t in timings)
    age, period = _quantiles(ready - instants), 1e3 / rate_hz
    jitter = float(np.quantile(np.abs(intervals - np.median(intervals)), 0.99))
    loss = dropped / (len(timings) + dropped)
    found = (
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
        warnings=tuple(text for wrong, text in found if wrong),
    )  # fmt: skip


def _quantiles(values_ms: Array) -> Quantiles:
    return Quantiles(float(np.median(values_ms)), float(np.quantile(values_ms, 0.99)), float(np.max(values_ms)))
