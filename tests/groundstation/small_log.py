"""A short log of poses, written through the real recorder, and what mcap's own strict reader finds in one."""

from pathlib import Path

import numpy as np
from mcap.reader import make_reader
from mcap.stream_reader import StreamReader

from groundstation.logs.recorder import Recorder
from shoal.messages import topics
from shoal.messages.codec import Header, encode
from shoal.messages.messages import Pose, Track

SECOND = 1_000_000_000


def pose(k: int) -> Pose:
    return Pose(0.01 * k, -0.5, 0.1, np.eye(3), Track.MARKER, True, 0.9, 0.3)


def record_poses(path: Path, count: int, session: int = 7) -> None:
    recorder = Recorder(path, "name = 'pool'\n", {"mode": "lockstep", "seed": "3"})
    for k in range(count):
        header = Header(session, k + 1, k * SECOND // 20)
        recorder.put(topics.POSE, "shoal/robot/1/pose", header, encode(pose(k)), k * SECOND // 20 + 1000)
    recorder.close()
    assert recorder.error == ""
    assert recorder.dropped == 0


def sequences(path: Path) -> list[int]:
    """Sequence numbers in a file, read strictly by mcap's indexed reader, with every checksum checked."""
    with path.open("rb") as file:
        for _ in StreamReader(file, validate_crcs=True).records:
            pass
    with path.open("rb") as file:
        return [message.sequence for _, _, message in make_reader(file).iter_messages()]
