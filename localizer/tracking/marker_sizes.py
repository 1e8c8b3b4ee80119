"""Sizes of the robots' markers as they are seen, against those that they should have at their reported depths. Pure.

A depth that is wrong by 10 cm makes a marker 2.5 % too large or too small under a camera 3 m above, and moves poses by
centimetres; so does a marker that was not printed at true scale. One reading tells the size to 0.3 %, but blur makes all
markers of a picture some 1 % smaller. So a robot is first held against the others.
"""

from collections.abc import Sequence

import numpy as np

_NEEDED = 40  # readings before a size is told, and in which it is averaged: 2 s at 20 Hz
_FLEET = 3  # robots from which on one can be told from the rest
_APART = 0.015  # from the median of the robots; theirs differ by 0.3 % when all is right
_WRONG = 0.04  # from the size that is expected; blur, and a focal length that is wrong by 1 %, stay below
_STRANGE_FRAMES = 20  # for which a marker of another size is told after it was read


class MarkerSizes:
    """Mean sizes of each robot's marker over those expected, by index."""

    def __init__(self, count: int) -> None:
        self._means, self._readings = np.ones(count), np.zeros(count, dtype=int)
        self._strange: dict[int, tuple[int, float]] = {}  # robot -> frame and size of a marker that was refused for its size

    def note(self, robot: int, size: float) -> None:
        """Take up a reading's size over the expected one."""
        self._readings[robot] += 1
        self._means[robot] += (size - self._means[robot]) / min(int(self._readings[robot]), _NEEDED)

    def note_strange(self, robot: int, size: float, frame: int) -> None:
        """Take up a marker that is too large or too small to be believed."""
        self._strange[robot] = frame, size

    def in_words(self, ids: Sequence[int], frame: int) -> list[str]:
        """Name the robots whose markers have a wrong size, for people."""
        is_known, notes = self._readings >= _NEEDED, list[str]()
        middle = np.median(self._means[is_known]) if np.sum(is_known) >= _FLEET else None
        for i, robot in enumerate(ids):
            off = float(self._means[i] - 1.0)
            if middle is not None and abs(off) <= _WRONG:
                off = float(self._means[i] - middle)
            if is_known[i] and abs(off) > (_WRONG if middle is None else _APART):
                notes.append(
                    f"{_percent(off)} for its depth: is the depth right, was its marker printed at 100 %: robot {robot}"
                )
            elif i in self._strange and frame - self._strange[i][0] <= _STRANGE_FRAMES:
                notes.append(f"{_percent(self._strange[i][1] - 1.0)}, and is not believed: robot {robot}")
        return [f"marker looks {text}" for text in notes]


def _percent(off: float) -> str:
    return f"{abs(off):.1%} too {'large' if off > 0 else 'small'}"
