"""The mission's table against its page, and what no table of a mission may do."""

from pathlib import Path

import pytest

from groundstation.mission.stages import STAGES
from groundstation.mission.state_machine import FLYING, OVER, TABLE, Event, Phase, after, allowed, markdown, refusal
from wire.messages.messages import Order

PAGE = (Path(__file__).parents[3] / "docs" / "missions.md").read_text(encoding="utf-8")
CAUSES: tuple[Order | Event, ...] = (*Order, *Event)
WAITS = frozenset({Phase.WAITING, Phase.SWITCHING, Phase.HALTING, Phase.PAUSED, Phase.STOPPED, Phase.TESTING}) | FLYING


def documented() -> dict[tuple[Phase, str], Phase]:
    """(phase, what happens) -> phase, read off the page."""
    found: dict[tuple[Phase, str], Phase] = {}
    for line in PAGE.splitlines():
        cells = [cell.strip() for cell in line.strip("|").split("|")]
        if len(cells) != 3 or cells[2] not in Phase.__members__:
            continue
        what, when, to = cells
        names = when.removeprefix("always but ").split(", ")
        listed = {Phase[name] for name in names if name in Phase.__members__}
        phases = set(Phase) - listed if when.startswith("always") else listed
        for phase in phases:
            assert (phase, what) not in found, f"{what} from {phase.name} leads to two places"
            found[phase, what] = Phase[to]
    return found


def test_the_page_is_the_table() -> None:
    assert markdown() in PAGE, "docs/missions.md is old: groundstation phases shows the table as it is"


def test_every_pair_of_state_and_cause_leads_where_the_page_says() -> None:
    page = documented()
    for phase in Phase:
        for cause in CAUSES:
            name = cause.name if isinstance(cause, Order) else cause.value
            assert after(phase, cause) is page.get((phase, name)), (phase, cause)


def test_no_state_is_a_trap_and_every_state_is_reached() -> None:
    reached, new = {Phase.WAITING}, {Phase.WAITING}
    while new:
        new = {to for phase in new for cause in CAUSES if (to := after(phase, cause)) is not None} - reached
        reached |= new
    assert reached == set(Phase)
    for phase in Phase:
        ways_out = {after(phase, cause) for cause in CAUSES} - {None, phase, Phase.STOPPED, Phase.ENDING}
        assert ways_out, phase


def test_stop_counts_everywhere_and_only_a_person_clears_it() -> None:
    assert allowed(Order.STOP) == set(Phase)
    assert all(after(Phase.STOPPED, event) is None for event in Event)
    assert {after(Phase.STOPPED, order) for order in Order} == {None, Phase.STOPPED, Phase.CLEARING}


def test_what_is_over_starts_again_only_when_a_person_says_so() -> None:
    for phase in OVER | {Phase.CLEARING}:
        assert {after(phase, event) for event in Event} <= {None, Phase.WAITING, Phase.ABORTING}


def test_every_state_is_driven() -> None:
    assert set(STAGES) | WAITS | OVER == set(Phase)
    for phase in STAGES:
        assert after(phase, Event.OBEYED) is not None
        assert after(phase, Event.UNHEEDED) in (Phase.ABORTING, Phase.FAILED)
    assert len({(phase, row.cause) for row in TABLE for phase in row.phases}) == sum(len(row.phases) for row in TABLE)


def test_a_refusal_names_the_states_that_would_do() -> None:
    assert refusal(Order.HOLD, Phase.RUNNING) == ""
    assert refusal(Order.RESUME, Phase.RUNNING) == "RESUME is not possible when RUNNING (only when PAUSED)"
    assert "allowed: LOAD" in refusal(Order.SWITCH, Phase.RUNNING)


@pytest.mark.parametrize("phase", [phase for phase in Phase if phase in FLYING])
def test_whoever_flies_can_be_held_and_disarmed(phase: Phase) -> None:
    assert after(phase, Order.HOLD) is Phase.PAUSED
    assert after(phase, Order.DISARM) is Phase.ENDING
