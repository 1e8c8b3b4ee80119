"""The timeline holds each event once; numbers for people have three digits."""

import pytest

from groundstation.analysis.series import TimelineEvent
from groundstation.analysis.statistics import three
from groundstation.analysis.timeline import faults, once


def event(time_s: float, source: str, text: str, fault: bool = False) -> TimelineEvent:
    return TimelineEvent(time_s, source, text, fault)


def test_a_mode_told_by_state_agent_and_reply_is_one_event() -> None:
    events = once(
        [
            event(0.00, "agent-1", "ARM: accepted"),
            event(0.05, "robot 1", "armed"),
            event(0.06, "agent-1", "armed"),
            event(0.07, "agent-2", "ARM: refused: no battery"),
            event(0.08, "agent-2", "LOAD: accepted"),
        ]
    )
    assert [(e.source, e.text) for e in events] == [
        ("robot 1", "armed"),
        ("robot 2", "ARM: refused: no battery"),
        ("robot 2", "LOAD: accepted"),
    ]


def test_a_mode_entered_again_is_a_second_event() -> None:
    events = once(
        [event(1.0, "robot 1", "holding: pose late"), event(3.0, "robot 1", "tracking"), event(9.0, "robot 1", "tracking")]
    )
    assert [e.time_s for e in events] == [1.0, 3.0, 9.0]


def test_a_line_that_repeats_is_one_event_with_its_number_and_end() -> None:
    (late, again) = once([event(t, "sim-bridge", "simulation was late", True) for t in (1.0, 1.5, 2.0, 40.0)])
    assert (late.times, late.time_s, late.last_s) == (3, 1.0, 2.0)
    assert (again.times, again.last_s) == (1, 40.0)


def test_the_stations_words_about_a_robots_fault_are_no_second_fault() -> None:
    abort = event(2.1, "groundstation", "mission: aborting: robot 2: fault (no pose)", fault=True)
    fault = event(2.0, "robot 2", "fault: no pose", fault=True)
    assert faults([fault, abort]) == (fault,)
    assert faults([abort]) == (abort,)


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (0.0, "0"),
        (0.012345, "0.0123"),
        (9.999, "10.0"),
        (99.96, "100"),
        (-123456.0, "-123456"),
        (float("nan"), "–"),
        (None, "–"),
    ],
)
def test_a_number_for_people_has_three_digits_and_no_power_of_ten(value: float | None, text: str) -> None:
    assert three(value) == text
