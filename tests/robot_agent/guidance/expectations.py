"""Plans of neighbours, and the limits by which they are judged."""

import numpy as np

from shoal.config.controller import MpcConfig, Safety
from shoal.frames import Array

PERIOD_S, NS = 0.05, 1_000_000_000
CONFIG, SAFETY = MpcConfig(), Safety()
STEPS = CONFIG.horizon + 1


def expecting(x: float, y: float = 0.0, z: float = 0.0) -> Array:
    """Predicted path of a robot that stays in place."""
    return np.tile([x, y, z, 0.0], (STEPS, 1))
