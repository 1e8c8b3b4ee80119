"""Random streams of the simulation: each kind of random number has its own stream from one seed, in ONE table. Pure.

numpy pads the seed sequence with zeros: (seed, 3) and (seed, 3, 0) are one sequence. So no two kinds have the same number,
and further numbers only distinguish members of one kind. Changing a number changes what a seed flies.
"""

from enum import IntEnum

import numpy as np


class Stream(IntEnum):
    """Kinds of random numbers."""

    THRUSTERS = 1  # spread about the nominal curve
    SENSORS = 2  # noise and biases of a board, per robot
    CAMERA = 3  # per part of the picture: background, sprites, noise, sway
    GUSTS = 5
    LINK = 6  # per robot and direction
    SCATTER = 7  # of starts, in comparisons
    POSES = 8  # noise of the ideal localizer's poses
    DRAWS = 9  # per seed of a campaign
    OBSTACLES = 43  # noise of the ideal localizer's obstacles


def generator(seed: int, stream: Stream, *member: int) -> np.random.Generator:
    """The generator of a kind of random numbers, or of one member of it."""
    return np.random.default_rng([seed, stream, *member])
