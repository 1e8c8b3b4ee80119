"""SHELL: camera frames in shared memory of one host: a ring of slots, made by a launcher and inherited by its processes.

    writer    mark the slot, copy the pixels in, number the slot; publish slot and number as `camera/frame`
    reader    if the slot has that number: copy the pixels out; if it has it still: a frame, else it was written over

The ring is an anonymous file (Linux: memfd), known by its descriptor alone. It has no name, so that nothing is left of it
when the last of its processes ends or is killed. Zenoh's own shared memory leaves named files behind then.
"""

import mmap
import os
import struct
from collections.abc import Sequence
from typing import Any

import numpy as np
from google.protobuf.message import DecodeError as ProtobufError

from shoal.bus.bus import Decode, Encode
from shoal.errors import ConfigError
from shoal.messages import codec
from shoal.messages.codec import SHARED, DecodeError
from shoal.messages.messages import Frame, Message

SLOTS = 4  # frames of each camera; a reader has the time of three to copy one: 0.15 s at 20 Hz, where a copy takes 1 ms
_HEAD_BYTES = mmap.PAGESIZE  # how many slots there are, and their numbers; then their pixels
_COUNT = struct.Struct("<Q")
REFERENCE = struct.Struct("<IQ")  # slot, number
_LONGEST_REFERENCE = 128  # bytes of an encoded reference with its other fields; a frame with its pixels is longer


def create(sizes_px: Sequence[tuple[int, int]]) -> int | None:
    """Descriptor of a new ring for the frames of cameras of these widths and heights; None where the system has no anonymous
    files."""
    if not hasattr(os, "memfd_create"):
        return None
    descriptor = os.memfd_create("shoal-frames")
    slots = SLOTS * len(sizes_px)
    os.ftruncate(descriptor, _HEAD_BYTES + slots * max(width * height for width, height in sizes_px))
    os.pwrite(descriptor, _COUNT.pack(slots), 0)
    return descriptor


def codec_of(descriptor: int | None) -> tuple[Decode, Encode]:
    """The decoder and encoder of a bus, in a process that was given this ring, or none."""
    if descriptor is None:
        return codec.decode, codec.encode
    ring = FrameRing(descriptor)
    return ring.decode, ring.encode


class FrameRing:
    """One process's view of a ring, as the two functions that a bus encodes and decodes with. One process writes."""

    def __init__(self, descriptor: int) -> None:
        """Raises ConfigError if the descriptor is no ring's."""
        try:
            size = os.fstat(descriptor).st_size
            memory = mmap.mmap(descriptor, size)
            self._slots = _COUNT.unpack_from(memory)[0]
            self._numbers = np.frombuffer(memory, np.uint64, self._slots, _COUNT.size)  # 0: not written, or being written
            self._pixels = np.frombuffer(memory, np.uint8, offset=_HEAD_BYTES).reshape(self._slots, -1)
        except (OSError, ValueError, struct.error) as error:
            raise ConfigError(f"--frame-ring {descriptor}: no ring of frames ({error}); `sim-bridge sil` makes one") from None
        self._last = self.newest

    @property
    def newest(self) -> int:
        """Number of the newest whole frame in the ring, counted from 1; 0 without one."""
        return int(self._numbers.max())

    def encode(self, message: Message, stamp_ns: int = 0) -> bytes:
        """Encode as codec.encode does, but of a frame that fits the ring only where its pixels are."""
        if not isinstance(message, Frame) or message.pixels.size > self._pixels.shape[1]:
            return codec.encode(message, stamp_ns)
        self._last += 1
        slot = self._last % self._slots
        self._numbers[slot] = 0
        self._pixels[slot, : message.pixels.size].reshape(message.pixels.shape)[:] = message.pixels
        self._numbers[slot] = self._last
        return codec.encode_frame(message.pixels.shape, SHARED, REFERENCE.pack(slot, self._last), stamp_ns)

    def decode(self, cls: type[Any], data: bytes, peer: str, topic: str) -> Any:
        """Decode as codec.decode does; a frame's pixels may be in the ring. Raises DecodeError if they were written over."""
        if cls is not Frame or len(data) > _LONGEST_REFERENCE:
            return codec.decode(cls, data, peer, topic)
        image = codec.protobuf_class(Frame)()
        try:
            image.ParseFromString(data)
        except ProtobufError:
            return codec.decode(cls, data, peer, topic)
        if image.encoding != SHARED:
            return codec.decode(cls, data, peer, topic)
        size = image.width * image.height
        if len(image.data) != REFERENCE.size or not 0 < size <= self._pixels.shape[1]:
            raise DecodeError(peer, topic, "data", f"{image.width} x {image.height} pixels are in no slot of this ring")
        slot, number = REFERENCE.unpack(image.data)
        pixels = self._read_slot(slot, number, size)
        if pixels is None:
            raise DecodeError(peer, topic, "data", f"frame {number} was written over before it was read")
        return Frame(pixels.reshape(image.height, image.width))

    def _read_slot(self, slot: int, number: int, size: int) -> np.ndarray[Any, np.dtype[np.uint8]] | None:
        """A copy of the first `size` pixels of a slot; None unless it holds the frame of this number before and after."""
        if slot >= self._slots or number == 0 or self._numbers[slot] != number:
            return None
        pixels = self._pixels[slot, :size].copy()
        pixels.setflags(write=False)
        return pixels if self._numbers[slot] == number else None
