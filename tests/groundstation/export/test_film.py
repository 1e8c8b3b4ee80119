"""The film of a run is an MP4 that players read: each picture at its time, the robots drawn where they said they were."""

from collections.abc import Sequence
from pathlib import Path

import av
import numpy as np
import pytest
from PIL import ImageDraw
from typer.testing import CliRunner

from groundstation.__main__ import cli
from groundstation.export.film import write_film
from groundstation.logs.recorder import Recorder
from localizer.view.video_encoder import packer
from shoal.config.experiment import dump_experiment, load_experiment
from shoal.errors import ConfigError
from shoal.messages import topics
from shoal.messages.camera_coverage import project
from shoal.messages.codec import Header, encode
from shoal.messages.messages import Control, Estimate, LocalizerStatus, Mode, RobotState, StationHeartbeat, StepTiming, Video

PICTURES, EVERY_NS = 12, 50_000_000


def test_a_film_has_every_picture_at_its_time_and_the_robot_in_it(tmp_path: Path) -> None:
    experiment = load_experiment("pool", ['recording.video="h264"'])
    camera = experiment.camera
    (tmp_path / "experiment.toml").write_text(dump_experiment(experiment))
    recorder = Recorder(tmp_path / "run.mcap", "", {})
    pack = packer(experiment.recording, camera.size_px)
    dark = np.full(camera.size_px[::-1], 60, dtype=np.uint8)
    eta = np.array([0.4, -0.3, 0.3, 0.0])
    for k in range(PICTURES):
        stamp_ns = 10**9 + k * EVERY_NS
        state = RobotState(
            mode=Mode.TRACKING,
            estimate=Estimate(eta=eta),
            control=Control(eta_reference=eta),
            timing=StepTiming(pose_age_ms=20.0),
        )
        for topic, key, message in (
            (topics.HEARTBEAT, "station/heartbeat", StationHeartbeat(mission="RUNNING", began_ns=10**9)),
            (topics.STATE, "robot/1/state", state),
            (topics.VIDEO, "camera/video", Video(pack(dark, stamp_ns))),
        ):
            recorder.put(topic, f"shoal/{key}", Header(7, k + 1, stamp_ns), encode(message, stamp_ns), stamp_ns)
    recorder.close()
    reports: list[tuple[int, int]] = []
    assert write_film(tmp_path, tmp_path / "pool.mp4", report=lambda written, of: reports.append((written, of))) == (
        PICTURES,
        0,
    )
    assert reports == [(k, PICTURES) for k in range(1, PICTURES + 1)]
    with av.open(str(tmp_path / "pool.mp4")) as film:
        frames = list(film.decode(video=0))
    assert [round(frame.time, 3) for frame in frames] == [round(k * 0.05, 3) for k in range(PICTURES)]
    pixels = frames[-1].to_ndarray(format="rgb24").astype(int)
    scale = np.array(pixels.shape[1::-1]) / np.array(camera.size_px)
    x, y = (project(camera, eta[None, :3])[0] * scale).round().astype(int)
    blue = (pixels[..., 2] - pixels[..., 0]) > 60  # the first robot's colour
    near = blue[y - 80 : y + 80, x - 80 : x + 80]
    assert near.sum() > 100 and blue.sum() == near.sum()


def test_a_log_without_pictures_says_so_and_leaves_no_file(tmp_path: Path) -> None:
    (tmp_path / "experiment.toml").write_text(dump_experiment(load_experiment("pool")))
    recorder = Recorder(tmp_path / "run.mcap", "", {})
    recorder.put(topics.STATE, "shoal/robot/1/state", Header(7, 1, 1), encode(RobotState()), 1)
    recorder.close()
    with pytest.raises(ConfigError, match="holds no pictures"):
        write_film(tmp_path, tmp_path / "pool.mp4")
    assert not (tmp_path / "pool.mp4").exists()


def _brightness(path: Path) -> list[tuple[float, int]]:
    """Time and brightness of each picture of a film of the log that `_filmed` writes, by picture number."""
    with av.open(str(path)) as film:
        return [(round(f.time, 2), round((f.to_ndarray(format="gray").mean() - 37) / 6)) for f in film.decode(video=0)]


def _filmed(tmp_path: Path, pictures: Sequence[tuple[int, int, bytes | None]]) -> Path:
    """A run with a picture each 50 ms: the camera's stamp, its session, other bytes in place of the true ones (b"": none)."""
    experiment = load_experiment("pool", ['recording.video="h264"'])
    (tmp_path / "experiment.toml").write_text(dump_experiment(experiment))
    recorder, sessions = Recorder(tmp_path / "run.mcap", "", {}), set[int]()
    for k, (stamp_ns, session, other) in enumerate(pictures):
        if session not in sessions:
            sessions.add(session)
            pack = packer(experiment.recording, experiment.camera.size_px)
        data = pack(np.full(experiment.camera.size_px[::-1], 40 + 6 * k, dtype=np.uint8), stamp_ns)
        now_ns = 10**11 + k * EVERY_NS
        heard_ns = now_ns + 30_000_000
        for topic, key, sender, message in (
            (topics.HEARTBEAT, "station/heartbeat", (7, now_ns), StationHeartbeat(mission="RUNNING", began_ns=10**11)),
            (topics.LOCALIZER, "localizer/status", (session, stamp_ns), LocalizerStatus(frame_age_ms=30.0)),
            (topics.VIDEO, "camera/video", (session, stamp_ns), Video(data if other is None else other)),
        ):
            if other != b"" or topic is not topics.VIDEO:
                arrival_ns = now_ns + 1 if topic is topics.HEARTBEAT else heard_ns
                recorder.put(
                    topic, f"shoal/{key}", Header(sender[0], 2 * k + 1, sender[1]), encode(message, sender[1]), arrival_ns
                )
    recorder.close()
    return tmp_path / "pool.mp4"


def test_a_picture_that_cannot_be_decoded_costs_no_other(tmp_path: Path) -> None:
    path = _filmed(tmp_path, [(10**11 + k * EVERY_NS, 9, b"\0\0\1\x65no picture" if k == 3 else None) for k in range(8)])
    assert write_film(tmp_path, path) == (7, 1)
    assert [time_s for time_s, _ in _brightness(path)] == [0.0, 0.05, 0.1, 0.2, 0.25, 0.3, 0.35]


def test_a_film_that_lacks_pictures_says_so_and_ends_with_code_1(tmp_path: Path) -> None:
    path = _filmed(tmp_path, [(10**11 + k * EVERY_NS, 9, b"\0\0\1\x65no picture" if k == 3 else None) for k in range(8)])
    done = CliRunner().invoke(cli, ["log", "export", str(tmp_path), "--video", str(path)])
    assert done.exit_code == 1 and "1 pictures of the log cannot be decoded, and are left out" in done.stderr
    log = tmp_path / "run.mcap"
    whole = log.read_bytes()
    log.write_bytes(whole[: whole.index(b"recorder") - 20])
    done = CliRunner().invoke(cli, ["log", "export", str(tmp_path), "--video", str(path)])
    assert done.exit_code == 1 and "Cut log: run.mcap ends before its run does" in done.stderr


def test_a_log_that_begins_between_two_key_pictures_is_filmed_from_the_next(tmp_path: Path) -> None:
    times = [10**11 + k * EVERY_NS for k in range(8)]
    path = _filmed(tmp_path, [(t, 9 if k < 5 else 10, b"" if k < 3 else None) for k, t in enumerate(times)])
    assert write_film(tmp_path, path) == (3, 2)
    assert _brightness(path) == [(0.0, 5), (0.05, 6), (0.1, 7)]


def test_times_are_the_runs_whatever_clocks_the_cameras_programs_have(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A localizer 20 s ahead of the station, started again with a clock 20 s behind it."""
    texts: list[str] = []
    monkeypatch.setattr(ImageDraw.ImageDraw, "text", lambda pen, at, text, **options: texts.append(text))
    second = 10**9
    path = _filmed(
        tmp_path, [(100 * second + k * EVERY_NS + (20 if k < 4 else -20) * second, 9 if k < 4 else 10, None) for k in range(8)]
    )
    assert write_film(tmp_path, path) == (8, 0)
    assert _brightness(path) == [(round(0.05 * k, 2), k) for k in range(8)]
    assert [text.split()[0] for text in texts] == [f"{0.05 * k:.2f}" for k in range(8)]
