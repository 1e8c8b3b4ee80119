"""State that stand-ins for robots report: the one place of the tests of missions that makes a RobotState."""

from typing import Any

import numpy as np
import numpy.typing as npt

from shoal.config.experiment import Experiment
from shoal.messages.messages import BoardReading, Estimate, Mode, RobotState, StepTiming


def reported_state(
    experiment: Experiment,
    mode: Mode,
    eta: npt.ArrayLike,
    surge_mps: float,
    battery_v: float = 12.0,
    board_age_ms: float = 20.0,
    **others: Any,
) -> RobotState:
    """State of a robot that knows its pose (4,) and hears its board; `others`: fields of RobotState."""
    pose = np.array(eta, dtype=np.float64)
    return RobotState(
        mode=mode,
        experiment_hash=experiment.hash,
        estimate=Estimate(eta=pose, nu=np.array([surge_mps, 0.0, 0.0, 0.0])),
        board=BoardReading(battery_v=battery_v, depth_m=float(pose[2])),
        timing=StepTiming(board_age_ms=board_age_ms),
        **others,
    )
