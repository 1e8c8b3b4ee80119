"""The latency test: its arithmetic on made-up times, and the whole command on a video."""

import json
import weakref
from collections.abc import Iterator, Mapping
from functools import partial
from pathlib import Path

import cv2
import numpy as np
import pytest
from typer.testing import CliRunner

from localizer.__main__ import cli
from localizer.detection.image_regions import Pixels
from localizer.detection.obstacles import ObstacleDetector
from localizer.evaluation.latency import WARM_UP, Latency, OnLocalized, Timing, assess, localize_in_process, measure
from localizer.sources.base import CapturedFrame, FrameSource
from localizer.tracking.fleet_localizer import FleetLocalizer, LocalizationResult
from localizer.tracking.tilt import Attitude
from shoal.config.experiment import load_experiment
from shoal.frames import Array
from shoal.messages.messages import Obstacles
from shoal.runtime.runtime import Stop, WallClock
from tests.localizer.stand_ins import MS, HandClock


class GeneratedCamera:
    """A frame source of given frames."""

    trouble, silent_after_s = "", 0.25

    def __init__(self, frames: Iterator[CapturedFrame | None]) -> None:
        self._frames = frames

    def frames(self, stop: Stop) -> Iterator[CapturedFrame | None]:
        return self._frames

    def close(self) -> None:
        """Nothing to do."""


def timings(count: int = 101, period_ms: float = 50.0, transfer_ms: float = 12.0, work_ms: float = 5.0) -> list[Timing]:
    def at(milliseconds: float) -> int:
        return round(milliseconds * MS)

    return [
        Timing(at(k * period_ms), at(k * period_ms + transfer_ms), at(k * period_ms + transfer_ms + work_ms), True)
        for k in range(count)
    ]


def judged(frames: list[Timing], dropped: int = 0) -> Latency:
    result = assess(frames, dropped, 20.0)
    assert result is not None
    return result


def test_the_parts_of_a_poses_age() -> None:
    frames = timings()
    slow = frames[50]
    frames[50] = Timing(slow.instant_ns, slow.arrived_ns + 20 * MS, slow.ready_ns + 23 * MS, True)
    result = judged(frames)
    assert result.exposure_to_arrival_ms.p50 == pytest.approx(12.0) and result.exposure_to_arrival_ms.max == pytest.approx(
        32.0
    )
    assert result.arrival_to_pose_ms.p50 == pytest.approx(5.0) and result.arrival_to_pose_ms.max == pytest.approx(8.0)
    assert result.exposure_to_pose_ms.p50 == pytest.approx(17.0) and result.exposure_to_pose_ms.max == pytest.approx(40.0)
    assert result.interval_ms.p50 == pytest.approx(50.0) == result.interval_ms.max
    assert (result.pictures, result.dropped, result.unstamped, result.warnings) == (101, 0, 0, ())


def test_each_ill_is_warned_of_by_itself() -> None:
    jumpy = [
        Timing(t.instant_ns + k % 2 * 15 * MS, t.arrived_ns + k % 2 * 15 * MS, t.ready_ns + k % 2 * 15 * MS, True)
        for k, t in enumerate(timings())
    ]
    guessed = [Timing(t.instant_ns, t.arrived_ns, t.ready_ns, k > 2) for k, t in enumerate(timings())]
    cases = {
        "without a usable stamp": judged(guessed),
        "off their rhythm": judged(jumpy),
        "the experiment says 50.0": judged(timings(period_ms=66.7)),
        "ms old": judged(timings(work_ms=70.0)),
        "dropped": judged(timings(), dropped=3),
    }
    for text, result in cases.items():
        assert len(result.warnings) == 1 and text in result.warnings[0], (text, result.warnings)
    assert cases["without a usable stamp"].unstamped == 3


def test_one_picture_is_no_measurement() -> None:
    assert assess(timings(1), 0, 20.0) is None
    assert assess([], 0, 20.0) is None


def test_the_first_pictures_and_what_was_lost_among_them_do_not_count() -> None:
    """And no picture is kept: an hour of them is 86 GB."""
    clock, stop, kept = HandClock(), Stop(install=False), list[weakref.ref[Pixels]]()

    def frames() -> Iterator[CapturedFrame | None]:
        for k in range(100):
            clock.sleep(0.05)
            pixels = np.zeros((4, 4), np.uint8)
            kept.append(weakref.ref(pixels))
            yield None if k == 7 else CapturedFrame(pixels, k, clock.ns - 9 * MS, clock.ns, 10 + k)

    def localize(source: FrameSource, note: OnLocalized) -> None:
        """Poses are out after 2 ms, previews after 3 more."""
        for captured in source.frames(stop):
            clock.sleep(0.002)
            if captured is not None:
                note(captured.stamp_ns, "")
                clock.sleep(0.003)
                assert sum(pixels() is not None for pixels in kept) <= 2

    samples, dropped = measure(GeneratedCamera(frames()), localize, clock, 1.0)
    assert len(samples) == 19 - WARM_UP - 1
    assert dropped == 10 + 18 - (10 + WARM_UP - 1)
    assert {(t.arrived_ns - t.instant_ns, t.ready_ns - t.arrived_ns) for t in samples} == {(9 * MS, 2 * MS)}


def test_latency_is_measured_through_the_whole_localizer(monkeypatch: pytest.MonkeyPatch) -> None:
    """Each picture is told of once, before the obstacles of the picture are looked for."""
    order: list[str] = []

    def look(watch: ObstacleDetector, frame: Pixels, stamp_ns: int, robots_m: Array) -> Obstacles | None:
        order.append(f"obstacles {stamp_ns}")
        return None

    monkeypatch.setattr(ObstacleDetector, "step", look)

    def frames() -> Iterator[CapturedFrame | None]:
        random = np.random.default_rng(1)
        for k in (1, 2, 3):
            yield CapturedFrame(random.integers(60, 120, (960, 1280), np.uint8), k, k, k)

    def told(stamp_ns: int, trouble: str) -> None:
        order.append(f"told {stamp_ns}{trouble}")

    localize_in_process(load_experiment("pool"), HandClock(), Stop(install=False), GeneratedCamera(frames()), told)
    assert order == ["told 1", "obstacles 1", "told 2", "obstacles 2", "told 3", "obstacles 3"]


def test_pictures_that_no_pose_comes_of_are_no_good_measurement(monkeypatch: pytest.MonkeyPatch) -> None:
    """A covered lens is quickly looked at, and so is a picture that an error costs: their times are not those of poses."""
    random, clock, locate = np.random.default_rng(1), WallClock(), FleetLocalizer.locate
    begin_ns = clock.now_ns()

    def fail_once(
        locator: FleetLocalizer,
        frame: Pixels,
        stamp_ns: int,
        depths_m: Mapping[int, float],
        attitudes: Mapping[int, Attitude],
    ) -> LocalizationResult:
        if frame[0, 0] == 99:
            raise ValueError("no solution")
        return locate(locator, frame, stamp_ns, depths_m, attitudes)

    monkeypatch.setattr(FleetLocalizer, "locate", fail_once)

    def frames() -> Iterator[CapturedFrame | None]:
        for k, (low, high) in enumerate(((60, 90),) * WARM_UP + ((60, 90), (99, 100), (60, 90), (0, 4), (60, 90)), start=1):
            yield CapturedFrame(
                random.integers(low, high, (960, 1280), np.uint8), k * 50 * MS, begin_ns + k * 50 * MS, begin_ns + k * 50 * MS
            )

    samples, _ = measure(
        GeneratedCamera(frames()),
        partial(localize_in_process, load_experiment("pool"), clock, Stop(install=False)),
        clock,
        60.0,
    )
    assert [t.trouble for t in samples] == ["", "picture skipped: ValueError: no solution", "", "camera black", ""]
    assert "no poses of 2 pictures (camera black)" in judged(samples).warnings


def test_the_command_measures_a_source_and_says_what_is_wrong(tmp_path: Path) -> None:
    """A video at 20 Hz where the experiment has 100: that must be noticed, however busy this machine is: each picture
    comes, with a stamp 50 ms after the last."""
    writer = cv2.VideoWriter(str(tmp_path / "v.avi"), cv2.VideoWriter.fourcc(*"MJPG"), 20.0, (1280, 960))
    random = np.random.default_rng(1)
    for _ in range(20):
        writer.write(np.repeat(np.repeat(random.integers(60, 120, (60, 80, 3), dtype=np.uint8), 16, axis=0), 16, axis=1))
    writer.release()
    out = tmp_path / "latency.json"
    command = ["latency", "pool", "--source", f"video:{tmp_path / 'v.avi'}:max", "--seconds", "60", "--json", str(out)]
    done = CliRunner().invoke(cli, [*command, "--set", "camera.rate_hz=100"])
    assert done.exit_code == 1
    assert "exposure to pose" in done.output and "the experiment says 10.0" in done.output
    figures = json.loads(out.read_text())
    assert figures["unstamped"] == 0
    assert figures["pictures"] == 20 - WARM_UP
    assert figures["exposure_to_pose_ms"]["p50"] >= figures["exposure_to_arrival_ms"]["p50"]


def test_a_source_without_pictures_is_a_failure(tmp_path: Path) -> None:
    done = CliRunner().invoke(cli, ["latency", "pool", "--source", f"folder:{tmp_path}", "--seconds", "0.6"])
    assert done.exit_code == 1 and "no pictures within 0.6 s: nothing new in" in done.output
