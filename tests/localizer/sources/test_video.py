"""Real video files, whole and spoiled: each picture has the number and the stamp with which it was filmed."""

import struct
import time
from contextlib import closing
from fractions import Fraction
from pathlib import Path

import av
import cv2
import numpy as np
import pytest

from localizer.detection.image_regions import Pixels
from localizer.sources import video
from localizer.sources.files import VideoSource
from localizer.sources.video import VideoPicture, VideoReader
from shoal.errors import ConfigError
from shoal.runtime.runtime import Stop
from tests.localizer.stand_ins import MS, HandClock

COUNT = 40
SIZE_PX = (160, 120)


def _picture(number: int) -> Pixels:
    """A picture that shows its number, as the brightness of its upper left corner, and enough beside it to be large."""
    picture = np.random.default_rng(1).integers(0, 255, (*SIZE_PX[::-1], 3), dtype=np.uint8)
    picture[:40, :40] = 6 * number
    return np.asarray(picture, dtype=np.uint8)


def _shown_number(picture: VideoPicture) -> int:
    return round(float(picture.pixels[8:32, 8:32].mean()) / 6)


def _motion_jpeg(path: Path, rate_hz: float = 20.0) -> Path:
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), rate_hz, SIZE_PX)
    for number in range(COUNT):
        writer.write(_picture(number))
    writer.release()
    return path


def _h264(path: Path, stamps_ms: list[int] | None = None, key_every: int = 5) -> Path:
    with av.open(str(path), "w") as file:
        stream = file.add_stream("libx264", rate=20, options={"preset": "ultrafast", "crf": "12", "g": str(key_every)})
        stream.width, stream.height, stream.pix_fmt = *SIZE_PX, "yuv420p"
        if stamps_ms is not None:
            stream.time_base = stream.codec_context.time_base = Fraction(1, 1000)
        for number in range(COUNT):
            frame = av.VideoFrame.from_ndarray(_picture(number), format="bgr24")
            if stamps_ms is not None:
                frame.pts, frame.time_base = stamps_ms[number], Fraction(1, 1000)
            file.mux(stream.encode(frame))
        file.mux(stream.encode(None))
    return path


def _spoil(path: Path, start: float, share: float) -> Path:
    data = bytearray(path.read_bytes())
    first, count = round(start * len(data)), round(share * len(data))
    data[first : first + count] = bytes(count)
    path.write_bytes(data)
    return path


def _read(path: Path) -> tuple[list[VideoPicture], str]:
    with closing(VideoReader(path)) as video:
        return list(video.pictures()), video.damage()


@pytest.mark.parametrize("suffix", ["avi", "mkv", "mp4"])
def test_whole_video_has_all_its_pictures(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"film.{suffix}"
    pictures, damage = _read(_motion_jpeg(path) if suffix == "avi" else _h264(path))
    assert [(p.number, p.stamp_ns) for p in pictures] == [(number, number * 50 * MS) for number in range(COUNT)]
    assert max(abs(_shown_number(p) - p.number) for p in pictures) <= 1 and damage == ""


def test_stamps_are_by_the_files_own_rate(tmp_path: Path) -> None:
    pictures, _ = _read(_motion_jpeg(tmp_path / "film.avi", rate_hz=59.94))
    assert pictures[-1].stamp_ns == pytest.approx(39 / 59.94 * 1e9, abs=2 * MS)


def test_a_rate_that_varies_gives_the_stamps_that_were_filmed(tmp_path: Path) -> None:
    stamps_ms = np.cumsum([0, *([50, 50, 50, 50, 450] * 8)])[:COUNT].tolist()
    pictures, damage = _read(_h264(tmp_path / "film.mp4", stamps_ms))
    assert [(p.number, p.stamp_ns // MS) for p in pictures] == list(enumerate(stamps_ms)) and damage == ""


@pytest.mark.parametrize("suffix", ["avi", "mkv", "mp4"])
def test_pictures_after_a_damaged_part_keep_their_numbers(tmp_path: Path, suffix: str) -> None:
    """The headers of some packets are gone with them, and an AVI file has no stamps."""
    path = tmp_path / f"film.{suffix}"
    whole = _motion_jpeg(path) if suffix == "avi" else _h264(path, key_every=1)  # a decoder makes up what refers to lost ones
    pictures, damage = _read(_spoil(whole, 0.45, 0.08))
    numbers = [p.number for p in pictures]
    assert COUNT - 12 < len(pictures) < COUNT and numbers[0] == 0 and numbers[-1] == COUNT - 1
    assert max(abs(_shown_number(p) - p.number) for p in pictures) <= 1
    assert all(p.stamp_ns == p.number * 50 * MS for p in pictures)
    missing = sorted(set(range(COUNT)) - set(numbers))
    assert damage.endswith(f"{len(missing)} of {COUNT} pictures cannot be read: {missing[0]} to {missing[-1]}")


@pytest.mark.parametrize("suffix", ["avi", "mkv"])
def test_a_video_that_was_cut_off_says_so(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"film.{suffix}"
    whole = (_motion_jpeg(path) if suffix == "avi" else _h264(path)).read_bytes()
    path.write_bytes(whole[: len(whole) // 2])
    pictures, damage = _read(path)
    assert 10 < len(pictures) < 30 and f"{COUNT - len(pictures)} of {COUNT} pictures cannot be read" in damage
    assert "it was cut off there" in damage and damage.endswith("too low") is (suffix == "avi")


def test_a_limit_counts_numbers_and_damage_behind_it_does_not(tmp_path: Path) -> None:
    with closing(VideoReader(_spoil(_motion_jpeg(tmp_path / "film.avi"), 0.5, 0.08))) as video:
        assert [p.number for p in video.pictures(10)] == list(range(10)) and video.damage(10) == ""


def test_a_limit_within_a_damaged_part_is_one_too(tmp_path: Path) -> None:
    with closing(VideoReader(_spoil(_motion_jpeg(tmp_path / "film.avi"), 0.5, 0.08))) as video:
        damaged = sorted({*range(COUNT)} - {picture.number for picture in video.pictures()})
    for limit in range(damaged[0], damaged[-1] + 2):
        with closing(VideoReader(tmp_path / "film.avi")) as video:
            assert [p.number for p in video.pictures(limit)] == list(range(damaged[0]))
            assert bool(video.damage(limit)) is (limit > damaged[0])


def test_a_phones_turned_video_keeps_the_sensors_rows(tmp_path: Path) -> None:
    """As a picture with the same note does: a lens is calibrated for one of both."""
    path = _h264(tmp_path / "film.mp4")
    data = bytearray(path.read_bytes())
    matrix = data.find(b"tkhd") + 44
    data[matrix : matrix + 36] = struct.pack(">9i", 0, 1 << 16, 0, -(1 << 16), 0, 0, SIZE_PX[1] << 16, 0, 1 << 30)
    path.write_bytes(data)
    assert cv2.VideoCapture(str(path)).read()[1].shape == (160, 120, 3), "others turn it"
    assert {p.pixels.shape for p in _read(path)[0]} == {(120, 160, 3)}


def test_played_as_a_camera_a_varying_rate_comes_when_it_is_due(tmp_path: Path) -> None:
    stamps_ms = np.cumsum([0, *([50, 50, 50, 50, 450] * 8)])[:COUNT].tolist()
    clock = HandClock()
    source = VideoSource(_h264(tmp_path / "film.mp4", stamps_ms), None, clock, as_fast_as_possible=True)
    start_ns = clock.ns
    instants_ms = [(shot.instant_ns - start_ns) // MS for shot in source.frames(Stop(install=False)) if shot is not None]
    assert instants_ms == stamps_ms


def test_text_file_is_refused_as_a_video(tmp_path: Path) -> None:
    (tmp_path / "text.avi").write_text("no video")
    for name, complaint in (("text.avi", "cannot be read as a video"), ("nowhere.avi", "no such file")):
        with pytest.raises(ConfigError, match=f"{name}: {complaint}"):
            VideoReader(tmp_path / name)


def test_an_index_that_lists_billions_of_pictures_is_not_believed(tmp_path: Path) -> None:
    path = _motion_jpeg(tmp_path / "film.avi")
    data = bytearray(path.read_bytes())
    for name, offset in ((b"avih", 24), (b"strh", 40)):
        struct.pack_into("<I", data, data.index(name) + offset, 2**31 - 1)
    path.write_bytes(data)
    begin_s = time.monotonic()
    pictures, damage = _read(path)
    assert [picture.number for picture in pictures] == list(range(COUNT)) and damage == ""
    assert time.monotonic() - begin_s < 2.0


def test_many_missing_pictures_are_named_at_once() -> None:
    begin_s = time.monotonic()
    assert video.number_ranges(list(range(0, 100_000, 2))) == "0, 2, 4, 6, 8, ..."
    assert time.monotonic() - begin_s < 1.0
