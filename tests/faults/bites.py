"""Bytes as numbers and messages of any kind, so that a fuzzer can reach what lies behind the decoders."""

import dataclasses
import math
import struct
from enum import IntEnum
from typing import Any, get_origin, get_type_hints

import numpy as np

from shoal.messages.codec import LARGEST
from shoal.messages.schema import nested_message

NUMBERS = (0.0, -0.0, 1.0, math.nan, math.inf, -math.inf, 1e308, -1e308, 5e-324, LARGEST, -LARGEST, 1e4, math.pi, 0.3)


class Bites:
    """Values out of bytes; zeros when they are used up."""

    def __init__(self, data: bytes) -> None:
        self._data, self._at = data, 0

    @property
    def left(self) -> bool:
        """True while there are bytes left."""
        return self._at < len(self._data)

    def take(self, size: int) -> bytes:
        """The next bytes."""
        taken = self._data[self._at : self._at + size]
        self._at += size
        return taken.ljust(size, b"\0")

    def byte(self, below: int = 256) -> int:
        """A small number."""
        return self.take(1)[0] % below

    def number(self) -> float:
        """Usual, extreme, or any double at all."""
        kind = self.byte()
        if kind < 128:
            return (self.byte() - 128) / 64.0
        if kind < 200:
            return NUMBERS[kind % len(NUMBERS)]
        return float(struct.unpack("<d", self.take(8))[0])

    def message(self, cls: Any) -> Any:
        """Any message of a class."""
        hints, rows = get_type_hints(cls), self.byte(5)
        return cls(**{f.name: self._field(hints[f.name], f, rows) for f in dataclasses.fields(cls)})

    def _field(self, hint: Any, field: Any, rows: int) -> Any:
        if "shape" in field.metadata:
            shape = tuple(rows if n == -1 else n for n in field.metadata["shape"])
            return np.array([self.number() for _ in range(math.prod(shape))]).reshape(shape)
        if hint is float:
            return self.number()
        if hint is bool:
            return bool(self.byte(2))
        if hint is str:
            return self.take(self.byte(6)).decode("latin1")
        if nested_message(hint) is not None:
            return self.message(nested_message(hint)) if nested_message(hint) is hint or self.byte(2) else None
        if isinstance(hint, type) and issubclass(hint, IntEnum):
            members = tuple(hint)
            return members[self.byte(len(members))]
        if get_origin(hint) is tuple:
            return tuple(self.byte() for _ in range(rows))
        return self.byte()
