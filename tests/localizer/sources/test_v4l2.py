"""A V4L2 camera gives each picture its instant, the newest first, and survives unplugging.

By a stand-in for OpenCV's capture, and a real camera where there is one.
"""

import os
import threading
import time
from collections.abc import Callable, Iterator
from itertools import pairwise
from pathlib import Path
from typing import Any

import cv2
import pytest

from localizer.sources import v4l2
from localizer.sources.v4l2 import V4l2Source, check_device, configure, middle_of_exposure_ns
from shoal.config.experiment import load_experiment
from shoal.errors import ConfigError
from shoal.runtime.runtime import Stop, WallClock
from tests.localizer.stand_ins import MS, HandClock, flat, level
from tests.waiting import eventually

CAMERA = load_experiment("pool").camera


class Plug:
    """The camera's cable, and its driver: releases pictures one by one."""

    def __init__(self) -> None:
        self.plugged = True
        self.opened = 0
        self.grabbed = 0
        self.stamp_ms: Callable[[], float] = lambda: time.monotonic_ns() / 1e6
        self.refuses: dict[int, float] = {}
        self.settings: dict[int, float] = {}
        self._ready = threading.Semaphore(0)

    def expose(self, count: int) -> None:
        for _ in range(count):
            self._ready.release()

    def unplug(self) -> None:
        self.plugged = False
        self._ready.release()

    def open(self, device: str) -> "StandIn":
        assert device == "/dev/video7"
        self.opened += 1
        return StandIn(self)

    def wait(self) -> bool:
        return self._ready.acquire(timeout=10.0) and self.plugged


class StandIn:
    """Does what cv2.VideoCapture does on V4L2."""

    def __init__(self, plug: Plug) -> None:
        self._plug, self._open = plug, plug.plugged

    def isOpened(self) -> bool:
        return self._open

    def set(self, propId: int, value: float, /) -> bool:
        self._plug.settings[propId] = self._plug.refuses.get(propId, value)
        return propId not in self._plug.refuses

    def get(self, propId: int, /) -> float:
        if propId == cv2.CAP_PROP_POS_MSEC:
            return self._plug.stamp_ms()
        return self._plug.settings.get(propId, -1.0)

    def grab(self) -> bool:
        self._open = self._open and self._plug.wait()
        self._plug.grabbed += self._open
        return self._open

    def retrieve(self) -> tuple[bool, Any]:
        return True, flat(self._plug.grabbed)

    def release(self) -> None:
        self._open = False


@pytest.fixture
def plug(monkeypatch: pytest.MonkeyPatch) -> Iterator[Plug]:
    monkeypatch.setattr(v4l2, "RETRY_S", 0.01)
    monkeypatch.setattr(v4l2, "silent_after_s", lambda rate_hz: 0.05)
    monkeypatch.setattr(v4l2, "SLICE_S", 0.01)
    monkeypatch.setattr(v4l2, "JOIN_S", 0.02)
    camera = Plug()
    yield camera
    camera.unplug()  # ends the grabbing thread


@pytest.mark.parametrize(
    ("driver_ms", "marks", "middle_ms", "stamped"),
    [
        (980, "end", 976, True),  # the exposure ended 20 ms ago, its middle lies 4 ms before that
        (980, "start", 984, True),
        (1000, "end", 996, True),
        (0, "end", 996, False),  # a driver without stamps: the arrival, less half the exposure
        (1001, "end", 996, False),  # in the future: of another clock
        (1_700_000_000_000, "end", 996, False),  # the wall clock
    ],
)
def test_the_middle_of_the_exposure(driver_ms: int, marks: Any, middle_ms: int, stamped: bool) -> None:
    assert middle_of_exposure_ns(driver_ms * MS, 1000 * MS, 8 * MS, marks) == (middle_ms * MS, stamped)


def test_a_stamp_older_than_a_second_is_of_another_clock() -> None:
    assert middle_of_exposure_ns(1 * MS, 5000 * MS, 8 * MS, "end") == (4996 * MS, False)


def test_the_drivers_stamp_becomes_an_instant_of_our_clock(plug: Plug) -> None:
    """Our clock and the monotonic one stand still, 7e12 ns apart; the driver says 20 ms ago, half the exposure is 4 ms."""
    ours, monotonic_ns = HandClock(), 3_000_000 * MS
    plug.stamp_ms = lambda: monotonic_ns / MS - 20.0
    source = V4l2Source("/dev/video7", CAMERA, ours, plug.open, lambda: monotonic_ns)
    plug.expose(1)
    captured = next(source.frames(Stop(install=False)))
    source.close()
    assert captured is not None and captured.stamped
    assert captured.instant_ns == captured.stamp_ns == ours.ns - 24 * MS
    assert captured.arrived_ns == ours.ns


@pytest.mark.parametrize("driver_ms", [-20.0, 1.0], ids=["stamp", "no stamp"])
def test_a_picture_is_of_its_middle_row_with_and_without_a_stamp(plug: Plug, driver_ms: float) -> None:
    """Half the exposure is 4 ms, and 20 ms go by from the first row to the last. A driver's stamp is of the first row's end;
    without one the picture is known to have been read out when it came."""
    ours, monotonic_ns = HandClock(), 3_000_000 * MS
    plug.stamp_ms = lambda: monotonic_ns / MS + driver_ms
    rolling = CAMERA.model_copy(update={"readout_s": 0.020})
    source = V4l2Source("/dev/video7", rolling, ours, plug.open, lambda: monotonic_ns)
    plug.expose(1)
    captured = next(source.frames(Stop(install=False)))
    source.close()
    assert captured is not None and captured.stamped is (driver_ms < 0.0)
    assert (ours.ns - captured.instant_ns) // MS == 14


def test_a_picture_from_before_a_standstill_is_not_new(plug: Plug) -> None:
    """The process sleeps for 30 s; the driver's buffer holds a picture from the beginning. Another device's stamps may be of
    another clock again."""
    ours, clock_ns, exposed_ms = HandClock(), [3_000_020 * MS], 3_000_000.0
    source = V4l2Source("/dev/video7", CAMERA, ours, plug.open, lambda: clock_ns[-1])
    plug.stamp_ms = lambda: exposed_ms
    shots, ages_ms = source.frames(Stop(install=False)), []
    for slept_ms in (0, 30_000):
        clock_ns.append(clock_ns[0] + slept_ms * MS)
        plug.expose(1)
        captured = next(shots)
        while captured is None:
            captured = next(shots)
        ages_ms.append((captured.stamped, (ours.ns - captured.instant_ns) // MS))
    assert ages_ms == [(True, 24), (True, 30_024)]
    plug.unplug()
    assert eventually(lambda: next(shots) is None and bool(source.trouble))
    plug.plugged = True
    plug.expose(1)
    while (captured := next(shots)) is None:
        pass
    source.close()
    assert not captured.stamped


def test_the_newest_picture_of_a_camera_wins_and_the_overtaken_are_counted(plug: Plug) -> None:
    source = V4l2Source("/dev/video7", CAMERA, WallClock(), plug.open)
    shots = source.frames(Stop(install=False))
    plug.expose(1)
    assert level(next(shots)) == 1
    plug.expose(20)  # while the localizer is busy
    # the count is public only with the next picture, and asking for that would end the wait
    assert eventually(lambda: source._newest.overtaken == 19)
    captured = next(shots)
    source.close()
    assert captured is not None and (level(captured), captured.dropped) == (21, 19)


def test_an_unplugged_camera_is_said_to_be_gone_and_taken_up_again(plug: Plug) -> None:
    source = V4l2Source("/dev/video7", CAMERA, WallClock(), plug.open)
    shots = source.frames(Stop(install=False))
    plug.expose(1)
    assert level(next(shots)) == 1
    plug.unplug()
    assert next(shots) is None
    assert eventually(lambda: plug.opened > 3), "it keeps trying"
    assert source.trouble == "/dev/video7 cannot be opened"
    plug.plugged = True
    plug.expose(1)
    while (captured := next(shots)) is None:
        pass
    source.close()
    assert level(captured) == 2
    assert source.trouble == ""


def test_a_camera_that_is_not_there_yet_is_waited_for(plug: Plug) -> None:
    plug.plugged = False
    source = V4l2Source("/dev/video7", CAMERA, WallClock(), plug.open)
    shots = source.frames(Stop(install=False))
    assert next(shots) is None
    plug.plugged = True
    plug.expose(1)
    while (captured := next(shots)) is None:
        pass
    source.close()
    assert level(captured) == 1


def test_a_drivers_error_costs_one_attempt_and_not_the_camera(plug: Plug) -> None:
    """The first opening raises what nobody expects; the second one works."""
    errors: list[Exception] = [OSError("bus error")]

    def open_device(device: str) -> StandIn:
        if errors:
            raise errors.pop()
        return plug.open(device)

    stop = Stop(install=False)
    source = V4l2Source("/dev/video7", CAMERA, WallClock(), open_device)
    plug.expose(1)
    shots = source.frames(stop)
    while (captured := next(shots)) is None:
        pass
    source.close()
    assert level(captured) == 1 and not stop.requested


def test_a_camera_that_is_not_there_is_refused_with_those_that_are(plug: Plug, tmp_path: Path) -> None:
    for name in ("video0", "video2", "vbi0"):
        (tmp_path / name).touch()
    here = f"{tmp_path}/video0, {tmp_path}/video2"
    with pytest.raises(ConfigError, match=f"camera {tmp_path}/video9: no such device; there are: {here}$"):
        check_device(f"{tmp_path}/video9", folder=tmp_path)
    with pytest.raises(ConfigError, match=r"video2: cannot be opened as a camera \(in use"):
        check_device(f"{tmp_path}/video2", folder=tmp_path)  # OpenCV itself: an empty file is no camera
    plug.plugged = True
    opened = StandIn(plug)
    check_device(f"{tmp_path}/video0", lambda device: opened, tmp_path)
    assert not opened.isOpened(), "let go of again"
    (tmp_path / "empty").mkdir()
    with pytest.raises(ConfigError, match="there are: none"):
        check_device("/dev/video9", folder=tmp_path / "empty")


def test_everything_automatic_is_off_and_the_exposure_is_the_experiments(plug: Plug) -> None:
    plug.settings[cv2.CAP_PROP_FOURCC] = 0
    assert configure(plug.open("/dev/video7"), CAMERA) == []
    wanted = {
        cv2.CAP_PROP_FRAME_WIDTH: 1280, cv2.CAP_PROP_FRAME_HEIGHT: 960, cv2.CAP_PROP_FPS: 20.0,
        cv2.CAP_PROP_AUTO_EXPOSURE: 1, cv2.CAP_PROP_EXPOSURE: 80.0, cv2.CAP_PROP_AUTO_WB: 0, cv2.CAP_PROP_AUTOFOCUS: 0,
        cv2.CAP_PROP_BACKLIGHT: 0, cv2.CAP_PROP_FOURCC: 0,
    }  # fmt: skip
    assert {key: plug.settings[key] for key in wanted} == wanted


def test_refused_camera_setting_is_told_and_a_slow_camera_is_asked_for_jpeg(plug: Plug) -> None:
    plug.refuses = {cv2.CAP_PROP_EXPOSURE: 156.0, cv2.CAP_PROP_FPS: 5.0}
    assert configure(plug.open("/dev/video7"), CAMERA) == [
        "pictures compressed (MJPG) instead of raw: corners are found less well",
        "frames per second 5 instead of 20",
        "exposure in 100 us 156 instead of 80",
    ]
    assert plug.settings[cv2.CAP_PROP_FOURCC] == cv2.VideoWriter.fourcc(*"MJPG")


def test_the_exposure_that_the_camera_really_uses_counts_for_the_instant(plug: Plug) -> None:
    ours, monotonic_ns = HandClock(), 3_000_000 * MS
    plug.stamp_ms = lambda: monotonic_ns / MS - 20.0
    plug.refuses = {cv2.CAP_PROP_EXPOSURE: 100.0}
    source = V4l2Source("/dev/video7", CAMERA, ours, plug.open, lambda: monotonic_ns)
    plug.expose(1)
    captured = next(source.frames(Stop(install=False)))
    source.close()
    assert captured is not None and captured.instant_ns == ours.ns - 25 * MS


REAL = os.environ.get("SHOAL_TEST_CAMERA", "/dev/video0")


@pytest.mark.skipif(not Path(REAL).exists(), reason=f"no camera at {REAL} (SHOAL_TEST_CAMERA names another)")
def test_a_real_camera_delivers_stamped_pictures() -> None:
    stop = Stop(install=False)
    source = V4l2Source(REAL, CAMERA, WallClock())
    frames = [captured for _, captured in zip(range(30), source.frames(stop), strict=False) if captured is not None]
    source.close()
    assert len(frames) > 5 and all(captured.stamped for captured in frames[2:])
    assert all(later.instant_ns > earlier.instant_ns for earlier, later in pairwise(frames))
