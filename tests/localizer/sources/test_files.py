"""Pictures from a bus, a video and a folder: right colours, right instants, the newest wins, drops are counted."""

import itertools
import os
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from localizer.detection.image_regions import BAYER_TO_BGR, Pixels
from localizer.sources import files
from localizer.sources.base import CapturedFrame, as_bayer
from localizer.sources.bus import BusSource
from localizer.sources.factory import open_own
from localizer.sources.files import FolderSource, VideoSource
from localizer.sources.v4l2 import V4l2Source
from shoal.bus import frame_ring
from shoal.bus.bus import Bus
from shoal.bus.memory_transport import MemoryHub, MemoryTransport
from shoal.config.experiment import load_experiment
from shoal.config.perception import Camera
from shoal.errors import ConfigError
from shoal.messages import topics
from shoal.messages.codec import Header
from shoal.messages.messages import Frame
from shoal.runtime.runtime import Stop, WallClock
from tests.localizer.stand_ins import MS, HandClock, flat, level

PERIOD_MS, RATE_HZ = 50, 20.0
CAMERA = load_experiment("pool").camera


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> HandClock:
    """For sources that sleep: their sleeping moves the clock, and nobody waits."""
    hand = HandClock()
    patched = SimpleNamespace(sleep=hand.sleep, time_ns=time.time_ns, monotonic=lambda: hand.ns * 1e-9)
    monkeypatch.setattr(files, "time", patched)
    return hand


# --- colours


def test_a_mosaic_gives_back_the_colours_it_was_made_of() -> None:
    """Blue, green, red quarters; where a colour is flat, demosaicing must return it exactly."""
    picture = np.zeros((64, 64, 3), np.uint8)
    colours = {(0, 0): (250, 10, 20), (0, 1): (10, 240, 30), (1, 0): (15, 25, 230), (1, 1): (90, 120, 150)}
    for (row, column), colour in colours.items():
        picture[32 * row : 32 * row + 32, 32 * column : 32 * column + 32] = colour
    mosaic = as_bayer(picture)
    assert mosaic is not None and mosaic.shape == (64, 64)
    back = cv2.cvtColor(mosaic, BAYER_TO_BGR)
    for (row, column), colour in colours.items():
        assert np.all(back[32 * row + 4 : 32 * row + 28, 32 * column + 4 : 32 * column + 28] == colour)


def test_the_first_pixel_is_red_and_an_odd_size_keeps_its_edge() -> None:
    picture = np.zeros((5, 7, 3), np.uint8)
    picture[..., 2] = 200
    mosaic = as_bayer(picture)
    assert mosaic is not None
    assert mosaic.shape == (5, 7) and mosaic[0, 0] == 200 and mosaic[4, 6] == 200 and mosaic[0, 1] == mosaic[1, 1] == 0


def test_raw_pictures_pass_alpha_is_dropped_and_other_depths_are_refused() -> None:
    raw = np.arange(48, dtype=np.uint8).reshape(6, 8)
    assert np.array_equal(as_bayer(raw), raw)  # type: ignore[arg-type]
    colour = np.random.default_rng(1).integers(0, 255, (6, 8, 3), dtype=np.uint8)
    with_alpha = np.dstack([colour, np.full((6, 8), 7, np.uint8)])
    assert np.array_equal(as_bayer(with_alpha), as_bayer(colour))  # type: ignore[arg-type]
    assert as_bayer(raw.astype(np.uint16)) is None
    assert as_bayer(np.zeros((6, 8, 2), np.uint8)) is None


# --- the bus


def test_the_newest_frame_wins_and_the_ones_it_overtook_are_counted() -> None:
    hub, stop = MemoryHub(), Stop(install=False)
    camera, mine = Bus(MemoryTransport(hub)), Bus(MemoryTransport(hub))
    shots = BusSource(mine, WallClock(), RATE_HZ).frames(stop)

    def publish(*values: int) -> None:
        for value in values:
            camera.publish(topics.FRAME, Frame(flat(value)[..., 0]), value, age_ns=3 * MS)

    def later(*values: int) -> CapturedFrame:
        thread = threading.Timer(0.05, publish, values)
        thread.start()
        captured = next(shots)
        thread.join()
        assert captured is not None
        return captured

    first = later(1)
    assert (level(first), first.dropped, first.stamp_ns) == (1, 0, 1)
    publish(2, 3, 4)
    second = next(shots)
    assert second is not None and (level(second), second.dropped) == (4, 2)
    camera.close()  # a camera that is started again counts from 1: that is no loss
    camera = Bus(MemoryTransport(hub))
    third = later(9)
    assert (level(third), third.dropped) == (9, 2)


@pytest.mark.skipif(not hasattr(os, "memfd_create"), reason="no anonymous files here")
def test_a_frame_whose_slot_was_written_again_is_dropped_and_counted() -> None:
    """The reader was too slow: the ring has gone round before it looked. The next frame is taken up."""
    hub, stop, descriptor = MemoryHub(), Stop(install=False), frame_ring.create([(8, 6)])
    assert descriptor is not None
    ring = frame_ring.FrameRing(descriptor)
    camera = Bus(MemoryTransport(hub), "shoal", ring.decode, ring.encode)
    mine = Bus(MemoryTransport(hub), "shoal", *frame_ring.codec_of(descriptor))
    os.close(descriptor)
    shots = BusSource(mine, WallClock(), RATE_HZ).frames(stop)

    def publish(grey: int, overwritten: bool = False) -> None:
        camera.publish(topics.FRAME, Frame(np.full((6, 8), grey, np.uint8)), grey)
        for _ in range(frame_ring.SLOTS if overwritten else 0):
            ring.encode(Frame(np.zeros((6, 8), np.uint8)))  # frames whose places the network has not brought yet

    assert next(shots) is None  # from now on it listens
    captured = []
    for grey, overwritten in ((1, False), (2, True), (3, False)):
        later = threading.Timer(0.02, publish, (grey, overwritten))
        later.start()
        captured += [next(shot for shot in shots if shot is not None)] if not overwritten else []
        later.join()
    assert [(int(shot.pixels[0, 0]), shot.dropped) for shot in captured] == [(1, 0), (3, 1)]


def test_two_cameras_at_once_are_none_until_one_is_gone() -> None:
    """A simulator that was left running beside the camera: its pictures in turn with the camera's show robots at two places.
    A camera that is started again is taken up at once, as ever."""
    hub, stop = MemoryHub(), Stop(install=False)
    cameras, mine = [Bus(MemoryTransport(hub)) for _ in range(2)], Bus(MemoryTransport(hub))
    source = BusSource(mine, WallClock(), RATE_HZ)
    shots, ending, number = source.frames(stop), threading.Event(), itertools.count(1)

    def film(both: threading.Event) -> None:
        while not ending.wait(0.01):
            for value, camera in enumerate(cameras if both.is_set() else cameras[1:], start=1):
                camera.publish(topics.FRAME, Frame(flat(value + (not both.is_set()))[..., 0]), next(number))
                time.sleep(0.01)

    both = threading.Event()
    both.set()
    filming = threading.Thread(target=film, args=(both,))
    filming.start()
    try:
        assert None in itertools.islice(shots, 50)
        assert next(shots) is None and source.trouble == "two cameras publish frames: end one of them"
        both.clear()
        assert {
            level(captured) for captured in itertools.islice((captured for captured in shots if captured is not None), 3)
        } == {2}
    finally:
        ending.set()
        filming.join()


def test_instants_are_by_our_clock_and_the_stated_age_whatever_the_cameras_clock_says() -> None:
    hub, stop, ours = MemoryHub(), Stop(install=False), WallClock()
    camera, mine = Bus(MemoryTransport(hub)), Bus(MemoryTransport(hub))
    shots = BusSource(mine, ours, RATE_HZ).frames(stop)
    before_ns = ours.now_ns()
    stamp_ns = before_ns + 3600 * 1_000_000_000  # an hour ahead
    thread = threading.Timer(0.05, camera.publish, (topics.FRAME, Frame(flat(1)[..., 0]), stamp_ns), {"age_ns": 40 * MS})
    thread.start()
    captured = next(shots)
    thread.join()
    assert captured is not None and captured.stamp_ns == stamp_ns
    assert before_ns < captured.arrived_ns < ours.now_ns()
    assert captured.instant_ns == captured.arrived_ns - 40 * MS


def test_unreadable_file_is_no_picture_and_repeats_none() -> None:
    hub, stop = MemoryHub(), Stop(install=False)
    transport, mine = MemoryTransport(hub), Bus(MemoryTransport(hub))
    camera = Bus(transport)
    raw = transport.publisher(f"shoal/{topics.FRAME.name}", topics.FRAME.qos)
    source = BusSource(mine, WallClock(), RATE_HZ)
    shots = source.frames(stop)
    thread = threading.Timer(0.02, camera.publish, (topics.FRAME, Frame(flat(1)[..., 0]), 1))
    thread.start()
    assert level(next(shots)) == 1
    thread.join()
    ending = threading.Event()

    def flood() -> None:
        for number in range(2, 100_000):
            raw(b"garbage", Header(camera.session, number, number).encode())
            if ending.wait(0.001):
                return

    flooding = threading.Thread(target=flood)
    flooding.start()
    try:
        assert [next(shots), next(shots)] == [None, None]
        assert "topic camera/frame" in source.trouble
    finally:
        ending.set()
        flooding.join()
    restarted = Bus(MemoryTransport(hub))
    thread = threading.Timer(0.02, restarted.publish, (topics.FRAME, Frame(flat(9)[..., 0]), 1))
    thread.start()
    assert level(next(captured for captured in shots if captured is not None)) == 9
    thread.join()


@pytest.mark.parametrize(("rate_hz", "silent_s"), [(20.0, 0.25), (1.0, 5.0), (240.0, 0.1)])
def test_a_camera_is_absent_after_five_frames(rate_hz: float, silent_s: float, tmp_path: Path) -> None:
    clock, camera = WallClock(), load_experiment("pool", [f"camera.rate_hz={rate_hz}"]).camera
    bus = Bus(MemoryTransport(MemoryHub()))
    for source in (
        BusSource(bus, clock, rate_hz),
        FolderSource(tmp_path, rate_hz, clock),
        V4l2Source("/dev/video7", camera, clock),
    ):
        assert source.silent_after_s == pytest.approx(silent_s)


def test_a_bus_without_frames_says_so_again_and_again() -> None:
    stop = Stop(install=False)
    shots = BusSource(Bus(MemoryTransport(MemoryHub())), WallClock(), RATE_HZ).frames(stop)
    assert [next(shots), next(shots)] == [None, None]
    stop.request()
    assert list(shots) == []


# --- a video file


def write_video(path: Path, levels: list[int], rate_hz: float = 20.0) -> Path:
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"HFYU"), rate_hz, (64, 48))
    for value in levels:
        writer.write(flat(value))
    writer.release()
    return path


def test_as_fast_as_possible_every_picture_comes_one_period_apart(tmp_path: Path, clock: HandClock) -> None:
    levels = list(range(10, 130, 10))
    source = VideoSource(write_video(tmp_path / "v.avi", levels), None, clock, as_fast_as_possible=True)
    frames = []
    for captured in source.frames(Stop(install=False)):
        assert captured is not None
        frames.append(captured)
        clock.sleep(0.3)  # however slow the localizer is
    assert [level(s) for s in frames] == levels
    assert set(np.diff([s.instant_ns for s in frames])) == {PERIOD_MS * MS}
    assert frames[-1].dropped == 0


def test_played_in_real_time_a_slow_localizer_gets_the_newest(tmp_path: Path, clock: HandClock) -> None:
    """20 Hz, and after each picture 170 ms of work: three of four are overtaken."""
    levels = list(range(10, 150, 10))
    start_ns = clock.ns
    source = VideoSource(write_video(tmp_path / "v.avi", levels), None, clock)
    frames = []
    for captured in source.frames(Stop(install=False)):
        assert captured is not None
        frames.append((level(captured), (captured.instant_ns - start_ns) // MS, (clock.ns - start_ns) // MS, captured.dropped))
        clock.sleep(0.17)
    assert frames[:4] == [(10, 0, 0, 0), (40, 150, 170, 2), (70, 300, 340, 4), (110, 500, 510, 7)]


def test_played_in_real_time_a_quick_localizer_waits_for_each(tmp_path: Path, clock: HandClock) -> None:
    start_ns = clock.ns
    source = VideoSource(write_video(tmp_path / "v.avi", [10, 20, 30]), 10.0, clock)  # not the file's 20 Hz
    assert [(level(s), (clock.ns - start_ns) // MS) for s in source.frames(Stop(install=False))] == [
        (10, 0),
        (20, 100),
        (30, 200),
    ]


# --- a folder


def put(folder: Path, name: str, picture: Pixels) -> None:
    """As a camera's recorder should: complete before it has its name."""
    part = folder / f"{name}.part"
    good, data = cv2.imencode(Path(name).suffix, picture)
    assert good
    part.write_bytes(data.tobytes())
    part.rename(folder / name)


def take(shots: Iterator[CapturedFrame | None], count: int) -> list[int]:
    return [level(next(shots)) for _ in range(count)]


def test_a_folder_is_played_in_the_order_of_its_numbers_and_then_followed(tmp_path: Path, clock: HandClock) -> None:
    for number in (2, 10, 1):
        put(tmp_path, f"frame{number}.png", flat(number))
    (tmp_path / "notes.txt").write_text("no picture")
    source = FolderSource(tmp_path, 20.0, clock)
    shots = source.frames(Stop(install=False))
    assert take(shots, 3) == [1, 2, 10]
    assert next(shots) is None and "nothing new" in source.trouble
    put(tmp_path, "frame11.png", flat(11))
    assert take(shots, 1) == [11]
    put(tmp_path, "frame1.png", flat(77))  # the same name, written anew
    assert take(shots, 1) == [77]


def test_newest_picture_counts_in_a_folder_that_grows_faster_than_it_is_read(tmp_path: Path, clock: HandClock) -> None:
    for number in range(10, 30):
        put(tmp_path, f"{number}.png", flat(number))
    shots = FolderSource(tmp_path, 20.0, clock).frames(Stop(install=False))
    first = next(shots)
    clock.sleep(0.33)
    second = next(shots)
    assert first is not None and second is not None
    assert (level(first), level(second), second.dropped) == (10, 16, 5)
    assert second.instant_ns - first.instant_ns == 6 * PERIOD_MS * MS
    clock.sleep(60.0)  # far beyond the last one: that is what is shown, then there is nothing
    assert (take(shots, 1), next(shots)) == ([29], None)


def test_a_broken_image_is_left_out_and_a_folder_may_come_back(tmp_path: Path, clock: HandClock) -> None:
    folder = tmp_path / "camera"
    folder.mkdir()
    put(folder, "1.png", flat(1))
    (folder / "2.png").write_bytes(b"not a picture")
    cv2.imwrite(str(folder / "3.png"), np.full((48, 64), 5000, np.uint16))
    put(folder, "4.png", flat(4))
    source = FolderSource(folder, 20.0, clock)
    shots = source.frames(Stop(install=False))
    assert take(shots, 2) == [1, 4]
    folder.rename(tmp_path / "gone")
    assert next(shots) is None and "No such file" in source.trouble
    (tmp_path / "gone").rename(folder)
    put(folder, "5.png", flat(5))
    assert take(shots, 1) == [5]


def test_a_grey_image_is_taken_as_raw(tmp_path: Path, clock: HandClock) -> None:
    raw = np.random.default_rng(2).integers(0, 255, (48, 64), dtype=np.uint8)
    put(tmp_path, "raw.png", raw)
    captured = next(FolderSource(tmp_path, 20.0, clock).frames(Stop(install=False)))
    assert captured is not None and np.array_equal(captured.pixels, raw)


# --- names of sources


@pytest.mark.parametrize(
    ("name", "complaint"),
    [
        ("webcam", "allowed: bus, v4l2:/dev/video0, video:FILE"),
        ("v4l2:", "allowed: bus"),
        ("rtsp:10.0.0.1", "allowed: bus"),
        ("video:/nowhere.mp4", "no such file"),
        ("video:/nowhere.mp4:25", "/nowhere.mp4: no such file"),
        ("folder:/nowhere", "no such folder"),
        ("folder:/tmp:0", "frame rate of 0"),
        ("folder:/tmp:-3", "frame rate of -3"),
    ],
)
def test_a_source_that_cannot_be_is_explained(name: str, complaint: str) -> None:
    with pytest.raises(ConfigError, match=complaint):
        open_own(name, CAMERA, WallClock(), "--camera")


def test_a_file_that_is_no_video_is_explained(tmp_path: Path) -> None:
    (tmp_path / "v.avi").write_bytes(b"nothing")
    with pytest.raises(ConfigError, match="cannot be read as a video"):
        open_own(f"video:{tmp_path / 'v.avi'}", CAMERA, WallClock())


def test_a_rate_behind_the_name_and_a_colon_in_it(tmp_path: Path, clock: HandClock) -> None:
    folder = tmp_path / "a:b"
    folder.mkdir()
    for number in (1, 2):
        put(folder, f"{number}.png", flat(number))
    camera: Camera = CAMERA
    for name, period_ms in ((f"folder:{folder}", 50), (f"folder:{folder}:8", 125), (f"folder:{folder}:max", 50)):
        shots = open_own(name, camera, clock).frames(Stop(install=False))
        first, second = next(shots), next(shots)
        assert first is not None and second is not None
        assert second.instant_ns - first.instant_ns == period_ms * MS
