"""Comparison by `sim-bridge rerun` of a robot's steps: the log's beside the program's."""

from pathlib import Path

import numpy as np
import pytest

from groundstation.logs.reader import metadata_of
from groundstation.logs.recorder import Recorder, run_metadata
from shoal.config.experiment import load_experiment
from shoal.messages import topics
from shoal.messages.codec import encode
from shoal.messages.messages import Estimate, Event, Plan, RobotState
from shoal.runtime.version import UNKNOWN, Code
from sim_bridge.replay.step_diff import StepOutputs, compare
from sim_bridge.replay.step_replay import recorded_by_other_code


def told(stamps: range, gap: str = "") -> StepOutputs:
    outputs = StepOutputs()
    for stamp_ns in stamps:
        outputs.add(topics.STATE, stamp_ns, encode(RobotState(trajectory_s=0.05)))
    if gap:
        outputs.add(topics.EVENT, 0, encode(Event(3, "agent-1", gap)))
    return outputs


def test_the_same_steps_of_a_whole_log_are_exact() -> None:
    assert compare(1, told(range(5)), told(range(5)), same_experiment=True).exact


def test_steps_that_come_out_the_same_round_a_gap_of_the_log_are_not_exact() -> None:
    gap = "steps 2 to 3 are not in the log"
    again = compare(1, told(range(5)), told(range(4), gap), same_experiment=True)
    assert (again.compared, again.differing, again.left_out) == (4, 0, (gap,))
    assert not again.exact


def test_states_that_the_log_lacks_are_counted_in_words() -> None:
    """As of a robot without a radio: else the exit code 1 would have no reason."""
    again = compare(2, told(range(3)), told(range(5)), same_experiment=True)
    assert not again.exact
    assert again.left_out == ("2 states of robot 2 are not in the log: it had no radio, or they were lost",)


def test_a_plan_that_the_log_lost_is_named_and_is_no_difference() -> None:
    lost_ns = 3
    before, after = StepOutputs(), StepOutputs()
    for stamp_ns in range(6):
        for outputs in (before, after):
            outputs.add(topics.STATE, stamp_ns, encode(RobotState(trajectory_s=0.05, estimate=Estimate())))
            if outputs is after or stamp_ns != lost_ns:
                outputs.add(topics.PLAN, stamp_ns, encode(Plan(0.05, np.zeros((2, 4)), np.zeros((2, 4)))))
    again = compare(1, before, after, same_experiment=True)
    assert (again.compared, again.differing) == (6, 0)
    assert again.left_out == ("the plan of robot 1 at 0.05 s is not in the log",)
    assert not again.exact


def test_a_log_of_other_code_is_told_of(tmp_path: Path) -> None:
    Recorder(tmp_path / "run.mcap", "", run_metadata(load_experiment("pool"), "lockstep")).close()
    assert recorded_by_other_code(metadata_of(tmp_path / "run.mcap")) == ""
    warning = recorded_by_other_code({"version": "0.1.0", "commit": 5 * "8289d898" + "+changed.01234567"})
    assert warning.startswith("the run was recorded by 0.1.0 8289d898+changed.01234567, this is ")
    assert recorded_by_other_code({}).startswith("the run was recorded by unknown unknown, ")


def test_two_unknown_commits_are_not_taken_for_the_same_code(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sim_bridge.replay.step_replay.code", lambda: Code("1.0", UNKNOWN))
    assert recorded_by_other_code({"version": "1.0", "commit": UNKNOWN})


def test_time_0_is_the_formations_start_and_not_that_of_a_flight_alone() -> None:
    outputs = StepOutputs()
    for k, (trajectory, clock_s) in enumerate((("alone-x", 1.0), ("alone-x", 2.0), ("p1", 0.0), ("p1", 0.5), ("p1", 1.5))):
        outputs.add(topics.STATE, k * 1_000_000_000, encode(RobotState(trajectory_id=trajectory, trajectory_s=clock_s)))
    assert compare(1, outputs, outputs, same_experiment=True).time_s.tolist() == [-2.5, -1.5, -0.5, 0.5, 1.5]
