"""Everything random in a simulation, each kind with numbers of its own from one seed: ONE table. Pure.

numpy pads what a generator is made from with zeros: (seed, 3) and (seed, 3, 0) are one sequence. So no two kinds have the same
number, and further numbers only tell members of one kind apart. A number that changes changes what a seed flies.
"""

from enum import IntEnum

import numpy as np


class Stream(IntEnum):
    """What is random."""

    THRUSTERS = 1  # their spread about the nominal curve
    SENSORS = 2  # of each robot: noise and biases of its board
    CAMERA = 3  # of each part of the picture: backdrop, sprites, noise, motion
    GUSTS = 5
    LINK = 6  # of each robot and direction
    SCATTER = 7  # of starts, in comparisons
    POSES = 8  # noise of those that stand for a localizer's
    DRAWS = 9  # of each flight of a campaign
    OBSTACLES = 43  # noise of those that stand for a localizer's


def generator(seed: int, stream: Stream, *member: int) -> np.random.Generator:
    """The random numbers of a kind, or of one member of it."""
    return np.random.default_rng([seed, stream, *member])
