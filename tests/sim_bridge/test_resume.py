"""A flight from a moment of a run counts its faults from the formation's start."""

import numpy as np

from robot_agent.agent import Agent
from shoal.config.experiment import load_experiment
from shoal.messages.messages import ALONE, Estimate, Mode, RobotState
from sim_bridge.in_process.resume import RobotHistory, resume


def test_the_moment_is_the_formations_and_not_that_of_a_robot_sent_elsewhere_alone() -> None:
    """Faults that come later count from the formation's start."""
    experiment = load_experiment("pool")
    states = [
        RobotState(
            Mode.TRACKING, trajectory_id=name, trajectory_s=flown_s, estimate=Estimate(eta=np.array([x_m, 0.0, 0.5, 0.0]))
        )
        for name, flown_s, x_m in (("p1", 3.0, 0.5), (f"{ALONE}x", 20.0, -0.5))
    ]
    memories = [
        RobotHistory(Agent(experiment, robot), states=[(10**12, state)])
        for robot, state in zip(experiment.robot_ids, states, strict=True)
    ]
    fleet, _ = resume(experiment, memories, 1)
    assert fleet.now_ns == 3_000_000_000
