"""Comparison by `groundstation log rerun` of a robot's steps: the log's beside the program's."""

from groundstation.replay.step_diff import StepOutputs, compare
from wire.messages import topics
from wire.messages.codec import encode
from wire.messages.messages import Event, RobotState


def told(stamps: range, gap: str = "") -> StepOutputs:
    found = StepOutputs()
    for stamp_ns in stamps:
        found.add(topics.STATE, stamp_ns, encode(RobotState(trajectory_s=0.05)))
    if gap:
        found.add(topics.EVENT, 0, encode(Event(3, "agent-1", gap)))
    return found


def test_the_same_steps_of_a_whole_log_are_exact() -> None:
    assert compare(1, told(range(5)), told(range(5)), same_experiment=True).exact


def test_steps_that_come_out_the_same_round_a_gap_of_the_log_are_not_exact() -> None:
    gap = "steps 2 to 3 are not in the log"
    again = compare(1, told(range(5)), told(range(4), gap), same_experiment=True)
    assert (again.compared, again.differing, again.left_out) == (4, 0, (gap,))
    assert not again.exact
