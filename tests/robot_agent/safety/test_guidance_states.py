"""The tables of guidance states: complete, with a way out of every state, and as documented."""

import itertools
import math

from robot_agent.safety.guidance_states import ALONG_PATH, STATES, TRANSITIONS, GuidanceFacts, StayLimits, next_state, table
from robot_agent.safety.modes import POWERED, REACTIONS
from shoal.messages.messages import Guidance, Mode

FACTS = [GuidanceFacts(*facts) for facts in itertools.product(Mode, (False, True), (False, True), (False, True))]
FLOWN = [state for state in Guidance if state is not Guidance.NONE]


def test_every_state_has_a_way_out_a_longest_stay_and_what_happens_then() -> None:
    assert set(STATES) == set(Guidance)
    reactions = {(reaction.to.name, reaction.reason) for reaction in REACTIONS}
    for state in FLOWN:
        assert {next_state(state, facts) for facts in FACTS} - {state}, state
        described = STATES[state]
        assert described.flown and described.bounds and described.longest
        if state is not Guidance.ON_PATH:  # it ends with its path
            assert tuple(described.then.split(": ")) in reactions, state
    limited = {state for state in FLOWN if math.isfinite(STATES[state].longest_s(StayLimits(join_s=9.0, path_s=60.0)))}
    assert limited == set(FLOWN) - {Guidance.HOLDING}  # which a person ends, or the loss of the station


def test_the_state_follows_from_the_facts_alone_within_a_step() -> None:
    for state, facts in itertools.product(Guidance, FACTS):
        follower = next_state(state, facts)
        assert next_state(follower, facts) is follower
        assert (follower is Guidance.NONE) is (facts.mode not in POWERED)
        assert (follower in (Guidance.HOLDING, Guidance.DRIVEN)) is (facts.mode in (Mode.HOLDING, Mode.DRIVEN))


def test_an_encounter_is_joined_left_and_returned_from() -> None:
    tracking = Mode.TRACKING
    facts = [
        (Mode.ARMED, False, False), (tracking, False, False), (tracking, False, True), (tracking, True, False),
        (tracking, False, False), (tracking, True, False), (tracking, False, False), (tracking, False, True),
        (tracking, False, False), (Mode.HOLDING, True, True), (tracking, False, False), (Mode.FAULT, False, True),
    ]  # fmt: skip
    state, names = Guidance.NONE, []
    for fact in facts:
        state = next_state(state, GuidanceFacts(*fact, is_steady=True))
        names.append(state.name)
    assert names == [
        "NONE", "JOINING", "ON_PATH", "GIVING_WAY", "RETURNING", "GIVING_WAY", "RETURNING", "ON_PATH", "JOINING", "HOLDING",
        "JOINING", "NONE",
    ]  # fmt: skip


def test_a_state_along_the_path_that_has_just_begun_is_left_for_a_leap_of_the_path_only() -> None:
    for state, facts in itertools.product(ALONG_PATH, FACTS):
        after = next_state(state, facts)
        if facts.mode is Mode.TRACKING and not facts.is_steady:
            assert after in (state, Guidance.JOINING)
        else:
            assert after is next_state(state, facts._replace(is_steady=True))


def test_every_transition_is_in_the_table_of_the_docs() -> None:
    assert all(transition.condition in table() for transition in TRANSITIONS)
