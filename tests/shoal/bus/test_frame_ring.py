"""Frames in shared memory: whole, or refused with the reason; nothing is left of the ring, whatever is killed."""

import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from shoal.bus import frame_ring
from shoal.bus.bus import Bus
from shoal.bus.frame_ring import SLOTS, FrameRing, codec_of
from shoal.bus.memory_transport import MemoryHub, MemoryTransport
from shoal.errors import ConfigError
from shoal.messages import codec, topics
from shoal.messages.codec import SHARED, DecodeError, encode
from shoal.messages.messages import Frame, LocalizerStatus
from tests.waiting import eventually

pytestmark = pytest.mark.skipif(not hasattr(os, "memfd_create"), reason="no anonymous files here")
SIZE_PX = (64, 48)
FROM = ("camera", "camera/frame")

# Writes frames of one grey level each, as fast as it can, and says that it has begun; or reads one reference a line.
WRITER = """
import sys, numpy as np
from shoal.messages.messages import Frame
from shoal.bus.frame_ring import FrameRing
ring, number = FrameRing(int(sys.argv[1])), 0
while True:
    number += 1
    ring.encode(Frame(np.full((960, 1280), number % 251, np.uint8)))
    number == 1 and print(flush=True)
"""
READER = """
import sys
from shoal.messages.messages import Frame
from shoal.bus.frame_ring import FrameRing
ring = FrameRing(int(sys.argv[1]))
for line in sys.stdin:
    print(ring.decode(Frame, bytes.fromhex(line), "camera", "camera/frame").pixels[0, 0], flush=True)
"""


@pytest.fixture
def descriptor() -> Iterator[int]:
    made = frame_ring.create([SIZE_PX])
    assert made is not None
    yield made
    os.close(made)


def _frame(level: int, size_px: tuple[int, int] = SIZE_PX) -> Frame:
    return Frame(np.full(size_px[::-1], level, np.uint8))


def test_a_frame_goes_through_the_ring_and_the_bus_carries_its_place_alone(descriptor: int) -> None:
    hub = MemoryHub()
    camera = Bus(MemoryTransport(hub), "shoal", *codec_of(descriptor))
    inbox = Bus(MemoryTransport(hub), "shoal", *codec_of(descriptor)).inbox(topics.FRAME, Frame)
    pixels = np.random.default_rng(1).integers(0, 256, SIZE_PX[::-1], dtype=np.uint8)
    _, _, payload = camera.publish(topics.FRAME, Frame(pixels), 5)
    assert len(payload) < 100
    received = inbox.newest()
    assert received is not None and received.header.stamp_ns == 5
    assert np.array_equal(received.message.pixels, pixels)
    assert not received.message.pixels.flags.writeable


def test_a_frame_larger_than_a_slot_and_other_messages_are_encoded_as_ever(descriptor: int) -> None:
    ring, large = FrameRing(descriptor), _frame(3, (65, 48))
    assert ring.encode(large, 7) == encode(large, 7)
    assert np.array_equal(ring.decode(Frame, encode(large), *FROM).pixels, large.pixels)
    tiny = _frame(9, (2, 2))
    assert np.array_equal(ring.decode(Frame, encode(tiny), *FROM).pixels, tiny.pixels)
    status = encode(LocalizerStatus(frames=4))
    assert encode(ring.decode(LocalizerStatus, status, *FROM)) == ring.encode(LocalizerStatus(frames=4)) == status


def test_a_reader_that_is_too_slow_loses_the_frame_and_not_the_next(descriptor: int) -> None:
    writer, reader = FrameRing(descriptor), FrameRing(descriptor)
    references = [writer.encode(_frame(level)) for level in range(1, SLOTS + 2)]
    with pytest.raises(DecodeError, match=r"from camera, topic camera/frame, field data: frame 1 was written over before"):
        reader.decode(Frame, references[0], *FROM)
    assert [int(reader.decode(Frame, r, *FROM).pixels[0, 0]) for r in references[1:]] == list(range(2, SLOTS + 2))


def test_a_writer_that_is_started_again_reuses_no_number(descriptor: int) -> None:
    old = FrameRing(descriptor).encode(_frame(1))
    for level in range(2, SLOTS + 2):
        FrameRing(descriptor).encode(_frame(level))
    with pytest.raises(DecodeError, match="frame 1 was written over"):
        FrameRing(descriptor).decode(Frame, old, *FROM)


def test_a_reader_without_the_ring_refuses_the_frame_and_says_who_has_it(descriptor: int) -> None:
    reference = FrameRing(descriptor).encode(_frame(1))
    with pytest.raises(DecodeError, match="field encoding: the pixels are in memory that `sim-bridge sil` shares with"):
        codec.decode(Frame, reference, *FROM)


@pytest.mark.parametrize("wrong", ["closed", "empty"])
def test_a_descriptor_of_no_ring_is_refused(wrong: str, tmp_path: Path) -> None:
    with (tmp_path / "file").open("w+b") as file:
        descriptor = 999 if wrong == "closed" else file.fileno()
        with pytest.raises(ConfigError, match=rf"--frame-ring {descriptor}: no ring of frames \(.*`sim-bridge sil` makes one"):
            FrameRing(descriptor)


@given(
    st.binary(max_size=16) | st.builds(lambda slot, number: frame_ring.REFERENCE.pack(slot, number),
                                       st.integers(0, 2**32 - 1) | st.integers(0, SLOTS), st.integers(0, 2**64 - 1)),
    st.integers(0, 2**32 - 1) | st.integers(0, 64), st.integers(0, 64),
)  # fmt: skip
def test_a_reference_to_nothing_is_refused_and_nothing_else(data: bytes, width: int, height: int) -> None:
    made = frame_ring.create([SIZE_PX])
    assert made is not None
    try:
        ring = FrameRing(made)
        image = codec.protobuf_class(Frame)(width=width, height=height, step=width, encoding=SHARED, data=data)
        with pytest.raises(DecodeError):
            ring.decode(Frame, image.SerializeToString(), *FROM)
        with pytest.raises(DecodeError):
            ring.decode(Frame, data + b"\xff", *FROM)
    finally:
        os.close(made)


def _start(program: str, descriptor: int) -> "subprocess.Popen[str]":
    return subprocess.Popen(
        [sys.executable, "-c", program, str(descriptor)], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True,
        pass_fds=(descriptor,),
    )  # fmt: skip


def _listed() -> set[str]:
    """Memory that has a name; semaphores are those of other tests, which run meanwhile."""
    folder = Path("/dev/shm")
    return {str(file) for file in folder.iterdir() if not file.name.startswith("sem.")} if folder.is_dir() else set()


@pytest.mark.real_time
@pytest.mark.parametrize("killed_first", ["writer", "reader"])
def test_killed_processes_leave_nothing_and_hold_up_nobody(killed_first: str) -> None:
    """Writer and reader are killed in turn. The one that is left goes on, and the memory goes with the last of them."""
    before, made = _listed(), frame_ring.create([(1280, 960)])
    assert made is not None
    writer, reader = _start(WRITER, made), _start(READER, made)
    try:
        assert writer.stdout is not None and reader.stdout is not None and reader.stdin is not None
        writer.stdout.readline()
        last = FrameRing(made)
        if killed_first == "writer":
            writer.send_signal(signal.SIGKILL)
            writer.wait()
            reader.stdin.write(f"{last.encode(_frame(77)).hex()}\n")
            reader.stdin.flush()
            assert reader.stdout.readline() == "77\n"
        reader.send_signal(signal.SIGKILL)
        reader.wait()
        if killed_first == "reader":
            reached = last.newest
            assert eventually(lambda: last.newest > reached + SLOTS)
    finally:
        for process in (writer, reader):
            process.kill()
            process.communicate()
        os.close(made)
    assert _listed() <= before


@pytest.mark.real_time
def test_no_frame_is_torn_while_its_slot_is_written() -> None:
    """The writer goes round the ring as fast as it can; the reader asks for the frames that are about to be written over."""
    made = frame_ring.create([(1280, 960)])
    assert made is not None
    writer, ring = _start(WRITER, made), FrameRing(made)
    read = refused = 0
    try:
        assert writer.stdout is not None
        writer.stdout.readline()
        until_s = time.monotonic() + 20.0
        while (read < 50 or refused < 50) and time.monotonic() < until_s:
            number = ring.newest - read % SLOTS
            if number <= 0:
                continue
            slot = frame_ring.REFERENCE.pack(number % SLOTS, number)
            reference = codec.encode_frame((960, 1280), SHARED, slot, 0)
            try:
                pixels = ring.decode(Frame, reference, *FROM).pixels
            except DecodeError:
                refused += 1
                continue
            read += 1
            assert np.all(pixels == number % 251)
    finally:
        writer.kill()
        writer.communicate()
        os.close(made)
    assert read >= 50 and refused >= 50
