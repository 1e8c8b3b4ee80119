"""The pipe: what goes in comes out, and a pipe that breaks off is told apart from one that ends."""

import io
from collections.abc import Iterator

import numpy as np
import pytest

from shoal.messages import topics
from shoal.messages.codec import MAX_MESSAGE_BYTES, DecodeError, Header, decode
from shoal.messages.messages import Event, Pose, Track, Truth
from shoal.messages.pipe import PipeWriter, read_pipe
from shoal.messages.topics import Topic

Read = tuple[Topic, int | None, Header, bytes]


def truth(k: int) -> Truth:
    return Truth((1,), np.full((1, 4), k), np.zeros((1, 4)), np.zeros((1, 3)), np.zeros((1, 4)))


def written() -> bytes:
    stream = io.BytesIO()
    pipe = PipeWriter(stream, session=7)
    for k in range(3):
        pipe.publish(topics.TRUTH, truth(k), 10 * k)
        for robot in (1, 2):
            pipe.publish(topics.POSE, Pose(0.1 * k, robot, 0.0, np.eye(3), Track.MARKER, True, 0.9, 0.3), 10 * k - 1, robot)
    pipe.publish(topics.EVENT, Event(2, "test", "done"), 31)
    return stream.getvalue()


def read(data: bytes) -> Iterator[Read]:
    return read_pipe(io.BytesIO(data))


def test_messages_come_out_as_they_went_in() -> None:
    found = list(read(written()))
    assert [(topic.name, robot) for topic, robot, _, _ in found[:4]] == [
        ("sim/truth", None),
        ("robot/{robot}/pose", 1),
        ("robot/{robot}/pose", 2),
        ("sim/truth", None),
    ]
    poses = [(h, decode(Pose, payload, "t", "t")) for topic, robot, h, payload in found if robot == 2]
    assert [(h.session, h.sequence, h.stamp_ns) for h, _ in poses] == [(7, 1, -1), (7, 2, 9), (7, 3, 19)]
    assert [(p.x_m, p.y_m) for _, p in poses] == [(0.0, 2.0), (0.1, 2.0), (0.2, 2.0)]
    truths = [decode(Truth, payload, "t", "t").eta[0, 0] for topic, _, _, payload in found if topic is topics.TRUTH]
    assert truths == [0.0, 1.0, 2.0]


def test_a_cut_between_messages_is_an_end_and_any_other_cut_is_an_error() -> None:
    data = written()
    whole = list(read(data))
    ends = {0}
    for _, _, _, payload in whole:
        ends.add(max(ends) + 6 + 28 + len(payload))
    assert max(ends) == len(data)
    for cut in range(len(data)):
        messages = read(data[:cut])
        for expected in whole[: sum(end <= cut for end in ends) - 1]:
            assert next(messages) == expected
        if cut in ends:
            assert next(messages, None) is None
        else:
            with pytest.raises(DecodeError, match="ends after"):
                next(messages)


@pytest.mark.parametrize(
    "frame", [b"\xff\x00\x04\x00\x00\x00", b"\x00\x00" + (MAX_MESSAGE_BYTES + 1).to_bytes(4, "little"), b"\xff" * 6]
)
def test_a_pipe_frame_of_an_unknown_form_is_refused_at_once(frame: bytes) -> None:
    with pytest.raises(DecodeError, match="not written by this version"):
        list(read(frame + bytes(1000)))
