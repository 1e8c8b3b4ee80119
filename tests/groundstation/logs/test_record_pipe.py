"""A run handed over through a pipe becomes the same log as one heard on the bus, also when the pipe breaks off."""

import io
from pathlib import Path

import numpy as np

from groundstation.logs.reader import read_log
from groundstation.logs.recorder import record_pipe
from shoal.config.experiment import load_experiment
from shoal.messages import topics
from shoal.messages.messages import Pose, Track
from shoal.messages.pipe import PipeWriter

MS = 1_000_000


def poses(count: int) -> bytes:
    stream = io.BytesIO()
    pipe = PipeWriter(stream, session=5)
    for k in range(count):
        pipe.publish(topics.POSE, Pose(0.1 * k, 0.0, 0.0, np.eye(3), Track.MARKER, True, 0.9, 0.3), 50 * MS * k, 2)
    return stream.getvalue()


def test_messages_from_a_pipe_are_recorded(tmp_path: Path) -> None:
    experiment = load_experiment("pool")
    assert record_pipe(experiment, tmp_path, "numeric", io.BytesIO(poses(40))) == ""
    log = read_log(tmp_path / "run.mcap")
    found = log.of(topics.POSE, Pose, 2)
    assert [(e.stamp_ns, e.arrived_ns, e.sequence) for e in found] == [(50 * MS * k, 50 * MS * k, k + 1) for k in range(40)]
    assert [e.message.x_m for e in found] == [0.1 * k for k in range(40)]
    assert log.complete
    assert log.metadata["mode"] == "numeric"
    assert log.metadata["experiment_hash"] == experiment.hash
    assert 'name = "pool"' in log.experiment_toml


def test_a_broken_pipe_leaves_a_readable_log(tmp_path: Path) -> None:
    problem = record_pipe(load_experiment("pool"), tmp_path, "numeric", io.BytesIO(poses(40)[:-10]))
    assert "ends after" in problem
    log = read_log(tmp_path / "run.mcap")
    assert log.complete
    assert len(log.of(topics.POSE, Pose, 2)) == 39
