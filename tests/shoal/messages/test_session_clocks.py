"""A sender's clock against the recorder's: which messages count for it, and by how much stamps are shifted."""

import numpy as np
import pytest

from shoal.messages import topics
from shoal.messages.messages import Event, LocalizerStatus, Obstacles, Plan, Pose, Preview, RobotState, StepTiming, Track
from shoal.messages.session_clocks import ALIKE_NS, OLD_LINE_NS, WINDOW_NS, SessionClocks, age_when_published_ns, is_old_line
from shoal.messages.topics import Topic

MS = 1_000_000
STATE, EVENT, LOCALIZER = topics.STATE, topics.EVENT, topics.LOCALIZER
POSE = Pose(0.0, 0.0, 0.3, np.eye(3), Track.MARKER, True, 1.0, 0.0)
LINE = Event(2, "agent-1", "said")


def _clocks(*messages: tuple[Topic, object, int, int], session: int = 7) -> SessionClocks:
    clocks = SessionClocks()
    for topic, message, stamp_ns, arrived_ns in messages:
        clocks.note(topic, session, stamp_ns, arrived_ns, message)
    return clocks


@pytest.mark.parametrize(
    ("topic", "message", "held"),
    [
        (STATE, RobotState(timing=StepTiming(step_us=1500.0)), 1_500_000),
        (LOCALIZER, LocalizerStatus(frame_age_ms=12.5), 12_500_000),
        (topics.PLAN, Plan(0.05), 0),
        (EVENT, LINE, 0),
        (topics.POSE, POSE, None),
        (topics.OBSTACLES, Obstacles(), None),
        (topics.PREVIEW, Preview(b""), None),
    ],
)
def test_a_message_counts_if_it_says_how_old_it_was(topic: Topic, message: object, held: int | None) -> None:
    assert age_when_published_ns(topic, message) == held
    ahead_ns = _clocks((topic, message, 0, 90 * MS)).shift_ns(topic.name, 7, 0)
    assert ahead_ns == (0 if held is None else 90 * MS - held)


def test_a_line_older_than_a_second_was_kept() -> None:
    assert [is_old_line(5, 5 + OLD_LINE_NS + more) for more in (0, 1)] == [False, True]


def test_the_quickest_message_near_by_counts_and_far_from_all_the_median() -> None:
    quick = {0: 300, 1: 200, 2: 250, 9: 500}  # ms, by window
    clocks = _clocks(*((STATE, RobotState(), k * WINDOW_NS, k * WINDOW_NS + ahead * MS) for k, ahead in quick.items()))
    clocks.note(STATE, 7, WINDOW_NS, WINDOW_NS + 900 * MS, RobotState())  # a slow one changes nothing
    shifts = [clocks.shift_ns("robot/1/state", 7, k * WINDOW_NS + WINDOW_NS - 1) // MS for k in (0, 1, 2, 3, 5, 8, 10)]
    assert shifts == [200, 200, 200, 250, 275, 500, 500]
    assert clocks.shift_ns("robot/1/state", 8, 0) == 0, "another session, of which nothing is known"


@pytest.mark.parametrize("sign", [1, -1])
def test_clocks_that_are_nearer_than_the_recorder_is_late_are_one(sign: int) -> None:
    for ahead_ns, shift_ns in ((ALIKE_NS, 0), (ALIKE_NS + 1, ALIKE_NS + 1)):
        clocks = _clocks((STATE, RobotState(), WINDOW_NS, WINDOW_NS + sign * ahead_ns))
        assert clocks.shift_ns("robot/1/state", 7, WINDOW_NS) == sign * shift_ns


def test_in_lockstep_stamps_stay_as_they_are() -> None:
    assert _clocks((STATE, RobotState(), 5, 5)).shift_ns("robot/1/state", 7, 5) == 0


def test_lines_of_a_log_go_by_what_else_their_sender_says_but_for_a_localizers() -> None:
    late = (EVENT, LINE, 0, 5_000 * MS)  # from a cache
    robot = _clocks(late, (STATE, RobotState(), 0, 100 * MS))
    assert [robot.shift_ns(topic.name, 7, 0) // MS for topic in (EVENT, STATE)] == [100, 100]
    assert _clocks(late).shift_ns(EVENT.name, 7, 0) == 5_000 * MS, "it says nothing else"
    camera = _clocks((EVENT, LINE, 0, 100 * MS), (LOCALIZER, LocalizerStatus(), 0, 9_000 * MS))
    assert [camera.shift_ns(topic.name, 7, 0) // MS for topic in (EVENT, LOCALIZER)] == [100, 9_000]
    alike = _clocks(late, (LOCALIZER, LocalizerStatus(), 0, 10 * MS))
    assert alike.shift_ns(EVENT.name, 7, 0) == 0, "a camera on the recorder's clock"
