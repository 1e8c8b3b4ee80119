"""Attitudes that robots' boards report, held against the lean that their hulls show. Pure.

A board that is mounted askew, or with the signs or axes of roll and pitch confused, moves its robot's poses by centimetres,
with a claim of millimetres. One reading of an outline is good to half a degree; what lasts is the board.
"""

import math
from collections.abc import Sequence

import numpy as np

from localizer.tracking.tilt import Attitude

_NEEDED = 15  # readings before a board is blamed, and over which differences are averaged
_LEAST_RAD = math.radians(2.0)  # RMS difference of roll and pitch together; readings of a right board leave 0.5 deg


class AttitudeCheck:
    """Mean square differences of each robot's attitude, by index."""

    def __init__(self, count: int) -> None:
        self._squares_rad2, self._readings = np.zeros(count), np.zeros(count, dtype=int)

    def note(self, robot: int, reported: Attitude, lean: Attitude) -> None:
        """Take up what a robot's board reports and its hull shows in one picture."""
        apart = math.hypot(reported.roll_rad - lean.roll_rad, reported.pitch_rad - lean.pitch_rad)
        self._readings[robot] += 1
        self._squares_rad2[robot] += (apart**2 - self._squares_rad2[robot]) / min(int(self._readings[robot]), _NEEDED)

    def in_words(self, ids: Sequence[int]) -> list[str]:
        """Name the boards that are wrong, and by how much, for people."""
        apart_rad = np.sqrt(self._squares_rad2)
        wrong = [i for i in range(len(ids)) if self._readings[i] >= _NEEDED and apart_rad[i] > _LEAST_RAD]
        return [
            f"board reports roll and pitch {np.degrees(apart_rad[i]):.1f} deg from what the hull shows (is it level, and "
            f"turned as the vehicle's file says?): robot {ids[i]}"
            for i in wrong
        ]
