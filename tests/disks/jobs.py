"""Files of pages and boards, and recordings of frames, as commands, without the page, the board or the camera around them."""

import time
from pathlib import Path

import numpy as np

from groundstation.logs.recorder import Recorder, run_metadata
from groundstation.web import experiment_editor
from groundstation.web.protocol import Edit
from localizer.setup.experiment_file import ExperimentFile
from localizer.sources.recording import FrameRecorder, RecordedFrame
from shoal.config.experiment import dump_experiment, load_experiment
from shoal.errors import ConfigError
from shoal.mavlink.signing import Key
from shoal.messages import topics
from shoal.messages.codec import Header, encode
from shoal.messages.messages import Pose, Track
from shoal.runtime.runtime import Failed
from sim_bridge.thruster_board.board import NonvolatileState
from sim_bridge.thruster_board.nonvolatile import _write  # a board calls it when it is told to keep its parameters

FRAMES, SIZE_PX = 12, (160, 120)
ROBOTS, SAID_S, SAY_EVERY_S = 8, 1.3, 0.05  # of a run: two flushes of the recorder and its end


def setup() -> None:
    """Save what a setup of lab.toml's camera has found."""
    print(ExperimentFile(Path("lab.toml"), None).save({"focal_px": [401.0, 402.0]}))


def edit() -> None:
    """Save an edit of the page as experiments/mine.toml."""
    saved = experiment_editor.save(load_experiment("pool"), Edit(duration_s=12.0), "mine")
    if not saved["ok"]:
        raise ConfigError("\n".join(saved["problems"]))


def board() -> None:
    """Keep a board's parameters and its new key."""
    state = NonvolatileState({"LIMIT": 2.0}, 30, 40, Key(bytes(range(32))))
    _write(Path("robot-1.json"), Path("robot-1.key"), state)


def record_run() -> None:
    """Record a run little by little, as a station does."""
    experiment = load_experiment("pool")
    recorder = Recorder(Path("run.mcap"), dump_experiment(experiment), run_metadata(experiment, "numeric"))
    for k in range(round(SAID_S / SAY_EVERY_S)):
        pose = encode(Pose(0.1 * k, 0.0, 0.0, np.eye(3), Track.MARKER, True, 0.9, 0.3))
        for robot in range(1, ROBOTS + 1):
            recorder.put(
                topics.POSE, f"shoal/{topics.POSE.key(robot)}", Header(5, k + 1, 50_000_000 * k), pose, 50_000_000 * k
            )
        time.sleep(SAY_EVERY_S)
    recorder.close()
    if recorder.error:
        raise Failed(f"run.mcap: {recorder.error}")


def record_frames() -> None:
    """Record frames as `localizer run --record` does. Frame k is grey k."""
    experiment = load_experiment("pool", [f"camera.size_px={list(SIZE_PX)}", "recording.stop_video_below_gb=0"])
    recorder = FrameRecorder(Path("recording"), experiment, waits=True)
    for k in range(FRAMES):
        recorder.put(RecordedFrame(np.full(SIZE_PX[::-1], k, np.uint8), 50_000_000 * k, 50_000_000 * k))
    recorder.close()
    if recorder.failure:
        raise Failed(recorder.failure)
