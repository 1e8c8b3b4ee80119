"""The film of a run is an MP4 that players read: each picture at its time, the robots drawn where they said they were."""

from pathlib import Path

import av
import numpy as np
import pytest

from groundstation.export.film import write_film
from groundstation.logs.recorder import Recorder
from localizer.view.video_encoder import packer
from shoal.config.experiment import dump_experiment, load_experiment
from shoal.errors import ConfigError
from shoal.messages import topics
from shoal.messages.camera_coverage import project
from shoal.messages.codec import Header, encode
from shoal.messages.messages import Control, Estimate, Mode, RobotState, StationHeartbeat, StepTiming, Video

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
    assert write_film(tmp_path, tmp_path / "pool.mp4") == PICTURES
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
