"""The path watch in numeric flights: what a robot cannot do stops it with its cause, and nothing else does."""

import re
from dataclasses import replace

import numpy as np
import pytest

from robot_agent.safety.path_deviation import AT_ONCE_MPS
from shoal.messages.messages import Guidance, Mode, required
from tests.flights import cells
from tests.flights.figures import CAUSES
from tests.flights.grid_flights import STOPPED, FlightLog, fly

pytestmark = pytest.mark.long

NEW_LAW = ("controller.law=nmpc", "controller.estimator.kind=kalman")


def flown(monkeypatch: pytest.MonkeyPatch, cell: str, number: int, path_s: float) -> FlightLog:
    """A flight of the grid (tests/flights/cells.py), cut to `path_s`."""
    monkeypatch.setitem(cells.CELLS, cell, replace(cells.CELLS[cell], path_s=path_s, holds=False))
    return fly(cells.draw(cell, number, NEW_LAW), 20.0)


SLOW = pytest.mark.slow
TRAPS = [
    ("held-start", 2, 3.0, 6.0), ("held-start", 1, 3.0, 6.0), ("turned-57", 0, 3.0, 6.0), ("turned-180", 1, 3.0, 6.0),
    ("turned-180", 5, 3.0, 6.0), ("turned-90", 5, 3.0, 6.0),
    pytest.param("held-path", 0, 3.0, 20.0, marks=SLOW), pytest.param("swept", 0, 3.0, 18.0, marks=SLOW),
    pytest.param("held-meet", 1, 3.0, 20.0, marks=SLOW), pytest.param("turned-20", 2, 7.0, 12.0, marks=SLOW),
]  # fmt: skip


@pytest.mark.parametrize(("cell", "number", "within_s", "path_s"), TRAPS)
def test_trap_stops_the_robot_and_names_the_cause(
    monkeypatch: pytest.MonkeyPatch, cell: str, number: int, within_s: float, path_s: float
) -> None:
    log = flown(monkeypatch, cell, number, path_s)
    assert log.trouble_row is not None
    stopped = next(k for k, s in enumerate(log.states[0][log.trouble_row :]) if s.mode in STOPPED)
    assert (stopped + 1) * log.period_s <= within_s
    assert re.search(CAUSES[log.plan.of.trouble], log.states[0][-1].fault), log.states[0][-1].fault
    assert log.states[0][-1].guidance is Guidance.NONE


FREE = [
    ("start-current-0.8", 1, 8.0), ("start-model+100", 0, 8.0), ("model-50", 0, 6.0), ("model-50", 1, 6.0),
    ("start-model-50", 4, 7.0), ("start-model-50", 16, 9.0), ("mixed", 3, 7.0),
    ("mixed", 4, 4.0), ("mixed", 22, 5.0),  # hulls that swim near the speed at which the water pitches them over
    ("mixed", 26, 30.0),  # comes nearer by 5 cm a second, against a current that the observer takes for weaker
    pytest.param("current-0.8", 0, 30.0, marks=SLOW), pytest.param("waves", 1, 30.0, marks=SLOW),
    pytest.param("gusts", 0, 30.0, marks=SLOW), pytest.param("mixed", 0, 30.0, marks=SLOW),
]  # fmt: skip


@pytest.mark.parametrize(("cell", "number", "path_s"), FREE)
def test_robot_that_can_do_what_is_asked_is_not_stopped(
    monkeypatch: pytest.MonkeyPatch, cell: str, number: int, path_s: float
) -> None:
    log = flown(monkeypatch, cell, number, path_s)
    assert {(s.mode, s.fault) for s in log.states[0][1:]} == {(Mode.TRACKING, "")}
    assert {s.guidance for s in log.states[0][1:]} <= {Guidance.JOINING, Guidance.ON_PATH}


MEETINGS = [
    ("meet-2", 1, 40.0), ("meet-4", 2, 12.0), ("meet-4", 0, 25.0), ("meet-overtake", 1, 30.0),
    *(
        pytest.param(cell, number, 90.0, marks=SLOW)
        for cell in ("meet-2", "meet-4", "meet-8", "meet-overtake", "meet-circle") for number in range(3)
    ),
]  # fmt: skip
A_HANDFUL = 6  # joining, on the path, giving way, returning, on the path; a slow overtaking may push a robot aside twice


@pytest.mark.parametrize(("cell", "number", "path_s"), MEETINGS)
def test_guidance_state_of_an_encounter_is_steady(
    monkeypatch: pytest.MonkeyPatch, cell: str, number: int, path_s: float
) -> None:
    """The numbers 0, 1, 2 are flights at 10, 20, 50 Hz. At a path's end its velocity leaps to nothing: whoever is not quite
    back by then joins its path anew, and soon is on it, which is not the encounter's doing."""
    log = flown(monkeypatch, cell, number, path_s)
    for i, states in enumerate(log.states):
        changes = [
            (k * log.period_s, s.guidance) for k, s in enumerate(states) if k == 0 or s.guidance is not states[k - 1].guidance
        ]
        velocity_mps = np.diff(log.path[:, i, :2], axis=0) / log.period_s
        leaps_s = log.period_s * np.flatnonzero(np.hypot(*np.diff(velocity_mps, axis=0).T) > AT_ONCE_MPS)
        anew = [
            n for n, (at_s, state) in enumerate(changes)
            if state is Guidance.JOINING and (np.abs(at_s - leaps_s) < 5.0 * log.period_s).any()
        ]  # fmt: skip
        for n in reversed(anew):
            del changes[n : n + 2]
        assert len(changes) <= A_HANDFUL, changes
        for before, (begun_s, _), (ended_s, after) in zip(changes, changes[1:], changes[2:], strict=False):
            assert before[1] is not after or ended_s - begun_s > 0.99, changes


@pytest.mark.slow
def test_all_that_meet_give_way_and_are_on_their_paths_in_the_end(monkeypatch: pytest.MonkeyPatch) -> None:
    log = flown(monkeypatch, "meet-4", 1, 60.0)
    for states in log.states:
        changes = [s.guidance for k, s in enumerate(states[1:]) if s.guidance is not states[k].guidance]
        assert Guidance.GIVING_WAY in changes and changes[-1] is Guidance.ON_PATH


@pytest.mark.slow
@pytest.mark.parametrize("number", [1, 2, 5])
def test_of_two_that_cross_only_the_one_with_the_other_to_starboard_gives_way(
    monkeypatch: pytest.MonkeyPatch, number: int
) -> None:
    log = flown(monkeypatch, "meet-2", number, 60.0)
    ways = [complex(*(required(states[-1].estimate).eta - required(states[0].estimate).eta)[:2]) for states in log.states]
    for way, other, states in zip(ways, ways[::-1], log.states, strict=True):
        states_met = [s.guidance for s in states[1:]]
        # y points to starboard: who comes from there goes to port
        has_it_to_starboard = (way.conjugate() * other).imag < 0.0
        assert (Guidance.GIVING_WAY in states_met) is has_it_to_starboard
        assert states_met[-1] is Guidance.ON_PATH
