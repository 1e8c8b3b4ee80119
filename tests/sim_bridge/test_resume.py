"""A flight from a moment of a run: what the log's reader says, however much that is."""

import sys
from pathlib import Path

import numpy as np
import pytest

from robot_agent.agent import Agent
from shoal.config.experiment import load_experiment
from shoal.errors import ConfigError
from shoal.messages.messages import ALONE, Mode, RobotState
from shoal.system import programs
from sim_bridge.in_process.resume import RobotHistory, prepared, resume

SAYS_MUCH = "import sys; sys.stderr.write('damaged\\n' * 30_000); sys.stdout.write(''); sys.exit(1)"


@pytest.mark.timeout(30)
def test_a_reader_that_complains_at_length_is_heard_to_its_end(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """More than a pipe holds, before a byte on the other stream."""
    monkeypatch.setattr(programs, "command", lambda *_: [sys.executable, "-c", SAYS_MUCH])
    with pytest.raises(ConfigError) as refused:
        prepared(load_experiment("numeric"), tmp_path, 1.0)
    assert str(refused.value).count("damaged") == 30_000


def test_the_moment_is_the_formations_and_not_that_of_a_robot_sent_elsewhere_alone() -> None:
    """Faults that come later count from the formation's start."""
    experiment = load_experiment("pool")
    states = [
        RobotState(Mode.TRACKING, trajectory_id=name, trajectory_s=flown_s, eta=np.array([x_m, 0.0, 0.5, 0.0]))
        for name, flown_s, x_m in (("p1", 3.0, 0.5), (f"{ALONE}x", 20.0, -0.5))
    ]
    memories = [
        RobotHistory(Agent(experiment, robot), states=[(10**12, state)])
        for robot, state in zip(experiment.robot_ids, states, strict=True)
    ]
    fleet, _ = resume(experiment, memories, 1)
    assert fleet.now_ns == 3_000_000_000
