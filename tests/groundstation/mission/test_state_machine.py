"""The mission's table against its page, and what no table of a mission may do."""

import re
from pathlib import Path

import pytest

from groundstation.mission.mission import STAGES
from groundstation.mission.state_machine import (
    IN_FLIGHT,
    TERMINAL,
    TRANSITIONS,
    MissionEvent,
    MissionState,
    markdown,
    next_state,
    rejection_reason,
    states_allowing,
)
from shoal.messages.messages import CommandKind

PAGE = (Path(__file__).parents[3] / "docs" / "reference" / "mission-states.md").read_text(encoding="utf-8")
CAUSES: tuple[CommandKind | MissionEvent, ...] = (*CommandKind, *MissionEvent)
WAITS = (
    frozenset(
        {
            MissionState.WAITING,
            MissionState.SWITCHING,
            MissionState.HALTING,
            MissionState.PAUSED,
            MissionState.STOPPED,
            MissionState.TESTING,
        }
    )
    | IN_FLIGHT
)


def groups() -> dict[str, set[MissionState]]:
    """Name -> states, read off the page's list of groups."""
    listed = dict(re.findall(r"^\* \*([a-z ]+)\*: (.+)$", PAGE, re.MULTILINE))
    state_groups: dict[str, set[MissionState]] = {}
    while len(state_groups) < len(listed):  # a group may name another
        for name, text in listed.items():
            words = text.split(", ")
            if all(word in MissionState.__members__ or word.strip("*") in state_groups for word in words):
                state_groups[name] = states_of(text, state_groups)
    return state_groups


def states_of(text: str, state_groups: dict[str, set[MissionState]]) -> set[MissionState]:
    """States that a cell names."""
    if text == "any":
        return set(MissionState)
    if text.startswith("any but "):
        return set(MissionState) - states_of(text.removeprefix("any but "), state_groups)
    states: set[MissionState] = set()
    for word in text.split(", "):
        states |= state_groups[word.strip("*")] if word.startswith("*") else {MissionState[word]}
    return states


def documented() -> dict[tuple[MissionState, str], MissionState]:
    """(state, what happens) -> state, read off the page."""
    transitions: dict[tuple[MissionState, str], MissionState] = {}
    state_groups = groups()
    for line in PAGE.splitlines():
        cells = [cell.strip() for cell in line.strip("|").split("|")]
        if len(cells) == 3 and cells[2] in MissionState.__members__:
            changes = [(cells[1], cells[2])]
        elif len(cells) == 2 and "→" in cells[1]:
            changes = [(when, to) for when, to in (change.split(" → ") for change in cells[1].split("; "))]
        else:
            continue
        for when, to in changes:
            for state in states_of(when, state_groups):
                assert (state, cells[0]) not in transitions, f"{cells[0]} from {state.name} leads to two places"
                transitions[state, cells[0]] = MissionState[to]
    return transitions


def test_the_page_is_the_table() -> None:
    assert markdown() in PAGE, "docs/reference/mission-states.md is old: run: make docs"


def test_every_pair_of_state_and_cause_leads_where_the_page_says() -> None:
    page = documented()
    for state in MissionState:
        for cause in CAUSES:
            name = cause.name if isinstance(cause, CommandKind) else cause.value
            assert next_state(state, cause) is page.get((state, name)), (state, cause)


def test_no_state_is_a_trap_and_every_state_is_reached() -> None:
    reached, new = {MissionState.WAITING}, {MissionState.WAITING}
    while new:
        new = {to for state in new for cause in CAUSES if (to := next_state(state, cause)) is not None} - reached
        reached |= new
    assert reached == set(MissionState)
    for state in MissionState:
        ways_out = {next_state(state, cause) for cause in CAUSES} - {None, state, MissionState.STOPPED, MissionState.ENDING}
        assert ways_out, state


def test_stop_counts_everywhere_and_only_a_person_clears_it() -> None:
    assert states_allowing(CommandKind.STOP) == set(MissionState)
    assert all(next_state(MissionState.STOPPED, event) is None for event in MissionEvent)
    assert {next_state(MissionState.STOPPED, order) for order in CommandKind} == {
        None,
        MissionState.STOPPED,
        MissionState.CLEARING,
    }


def test_no_event_restarts_a_finished_mission() -> None:
    for state in TERMINAL | {MissionState.CLEARING}:
        assert {next_state(state, event) for event in MissionEvent} <= {None, MissionState.WAITING, MissionState.ABORTING}


def test_every_state_is_driven() -> None:
    assert set(STAGES) | WAITS | TERMINAL == set(MissionState)
    for state in STAGES:
        assert next_state(state, MissionEvent.ALL_CONFIRMED) is not None
        assert next_state(state, MissionEvent.TIMEOUT) in (MissionState.ABORTING, MissionState.FAILED)
    assert len({(state, row.cause) for row in TRANSITIONS for state in row.states}) == sum(
        len(row.states) for row in TRANSITIONS
    )


def test_a_refusal_names_the_states_that_would_do() -> None:
    assert rejection_reason(CommandKind.HOLD, MissionState.RUNNING) == ""
    assert (
        rejection_reason(CommandKind.RESUME, MissionState.RUNNING) == "resume is not possible when RUNNING (only when PAUSED)"
    )
    assert "allowed: load" in rejection_reason(CommandKind.SWITCH, MissionState.RUNNING)


@pytest.mark.parametrize("state", [state for state in MissionState if state in IN_FLIGHT])
def test_flying_robots_can_be_held_and_disarmed(state: MissionState) -> None:
    assert next_state(state, CommandKind.HOLD) is MissionState.PAUSED
    assert next_state(state, CommandKind.DISARM) is MissionState.ENDING
