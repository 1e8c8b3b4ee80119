"""Each order once, in order, and only for the life of the process that it was meant for."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from shoal.bus.command_deduplication import SENDERS, CommandDeduplicator
from shoal.messages.codec import Header
from shoal.messages.messages import Command, CommandKind, Mode, Reply

ME = 77
ORDERS = st.lists(st.tuples(st.integers(1, 3), st.integers(1, 20), st.sampled_from([ME, ME - 1, 0])), max_size=60)


def command(recipient: int = ME, order: CommandKind = CommandKind.ARM) -> Command:
    return Command(order, 1, recipient=recipient)


def test_a_repeated_order_gets_the_same_answer_and_an_older_one_a_refusal() -> None:
    deduplicator, head = CommandDeduplicator(ME), Header(7, 5, 0)
    assert deduplicator.known_reply(head, command()) is None
    answer = deduplicator.record(head, Reply(1, True, "", Mode.ARMED))
    assert (answer.accepted, answer.mode, answer.session) == (True, Mode.ARMED, ME)
    assert deduplicator.known_reply(head, command()) is answer
    older = deduplicator.known_reply(Header(7, 4, 0), command())
    assert older is not None
    assert (older.accepted, older.reason) == (False, "ARM is old: order 4 after 5")
    assert deduplicator.known_reply(Header(7, 6, 0), command()) is None


def test_a_command_for_an_earlier_session_is_refused_with_the_present_session() -> None:
    for recipient in (0, ME + 1):
        reply = CommandDeduplicator(ME).known_reply(Header(7, 1, 0), command(recipient))
        assert reply is not None
        assert (reply.accepted, reply.session) == (False, ME)
        assert "not for this life" in reply.reason


@given(ORDERS)
def test_however_orders_are_repeated_mixed_and_reordered_each_is_taken_at_most_once(
    orders: list[tuple[int, int, int]],
) -> None:
    deduplicator, taken = CommandDeduplicator(ME), []
    for session, sequence, recipient in orders:
        head = Header(session, sequence, 0)
        if deduplicator.known_reply(head, command(recipient)) is None:
            deduplicator.record(head, Reply(1, True))
            taken.append((session, sequence))
            assert recipient == ME
    for session in (1, 2, 3):
        own = [sequence for by, sequence in taken if by == session]
        assert own == sorted(set(own))


def test_the_number_of_remembered_senders_is_bounded_and_the_newest_are_kept() -> None:
    deduplicator = CommandDeduplicator(ME)
    for session in range(1, SENDERS + 3):
        deduplicator.record(Header(session, 1, 0), Reply(1, True))
    assert deduplicator.known_reply(Header(SENDERS + 2, 1, 0), command()) is not None
    assert deduplicator.known_reply(Header(3, 1, 0), command()) is not None
    # how many senders are remembered is told to nobody
    assert len(deduplicator._answered) == SENDERS


@pytest.mark.parametrize("order", [CommandKind.STOP, CommandKind.DISARM])
def test_power_is_taken_away_however_late_and_often_and_for_whichever_life(order: CommandKind) -> None:
    deduplicator = CommandDeduplicator(ME)
    for sequence, recipient in ((5, ME), (5, ME), (3, ME), (6, ME + 1), (1, 0)):
        head = Header(7, sequence, 0)
        assert deduplicator.known_reply(head, command(recipient, order)) is None
        assert deduplicator.record(head, Reply(1, True)).session == ME


def test_a_late_stop_makes_no_other_order_new_again() -> None:
    deduplicator, head = CommandDeduplicator(ME), Header(7, 5, 0)
    armed = deduplicator.record(head, Reply(1, True, "", Mode.ARMED))
    deduplicator.record(Header(7, 2, 0), Reply(1, True, "", Mode.STOPPED))
    assert deduplicator.known_reply(head, command()) is armed
    refused = deduplicator.known_reply(Header(7, 4, 0), command())
    assert refused is not None and refused.reason == "ARM is old: order 4 after 5"


def test_a_sender_that_keeps_speaking_is_remembered_however_many_others_come() -> None:
    """Otherwise a replay of its last command would be obeyed again once enough strangers had spoken."""
    deduplicator = CommandDeduplicator(ME)
    for session in range(2, 2 * SENDERS):
        deduplicator.record(Header(1, session, 0), Reply(1, True))
        deduplicator.record(Header(session, 1, 0), Reply(1, True))
        assert deduplicator.known_reply(Header(1, session, 0), command()) is not None
