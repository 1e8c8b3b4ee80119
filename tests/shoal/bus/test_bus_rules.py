"""The bus's own rules, at their edges and without a network: what it remembers, refuses, counts and lets wait."""

import time

import pytest

from shoal.bus.bus import KEPT, SESSIONS, STOP_BYTES, Bus, Inbox
from shoal.bus.command_deduplication import SENDERS, CommandDeduplicator
from shoal.bus.memory_transport import MemoryHub, MemoryTransport
from shoal.bus.transport import Answer, Await, Urgent
from shoal.messages import topics
from shoal.messages.codec import Header, decode, encode
from shoal.messages.messages import Command, CommandKind, Event, Plan, Reply, RobotState, StationHeartbeat


class _Wire(MemoryTransport):
    """A network whose queries can be looked at, and whose answers replaced."""

    def __init__(self, hub: MemoryHub) -> None:
        super().__init__(hub)
        self.urgent: Urgent = lambda payload: False
        self.served: Answer = lambda payload, header: b""
        self.replies: list[bytes | None] = []
        self.silent_s = 0.0  # for which a missing reply is waited for
        self.commands: list[Command] = []

    def serve(self, key: str, answer: Answer, urgent: Urgent) -> None:
        self.served, self.urgent = answer, urgent
        super().serve(key, answer, urgent)

    def ask(self, key: str, payload: bytes, header: bytes, timeout_s: float) -> Await:
        self.commands.append(decode(Command, payload, "", ""))
        if self.replies:
            reply = self.replies.pop(0)

            def answer() -> bytes | None:
                time.sleep(self.silent_s if reply is None else 0.0)
                return reply

            return answer
        return super().ask(key, payload, header, timeout_s)


def _bus(hub: MemoryHub | None = None) -> tuple[Bus, _Wire]:
    wire = _Wire(hub or MemoryHub())
    return Bus(wire), wire


def _inbox() -> tuple[Bus, Inbox[Plan]]:
    bus, _ = _bus()
    return bus, bus.inbox(topics.PLAN, Plan, 1)


def _store(inbox: Inbox[Plan], session: int, sequence: int, stamp_ns: int = 0, payload: bytes | None = None) -> None:
    inbox.store(Header(session, sequence, stamp_ns), encode(Plan(0.05)) if payload is None else payload)


def test_an_inbox_remembers_the_last_few_senders_and_takes_none_of_their_old_messages() -> None:
    _, inbox = _inbox()
    for session in range(1, SESSIONS + 1):
        _store(inbox, session, 5)
    for session in range(1, SESSIONS + 1):
        _store(inbox, session, 5)
        _store(inbox, session, 4)
    assert inbox.dropped == 2 * SESSIONS
    _store(inbox, 99, 1)  # one more: the first is forgotten, the second is not
    _store(inbox, 2, 5)
    assert inbox.dropped == 2 * SESSIONS + 1
    _store(inbox, 1, 5)
    assert inbox.dropped == 2 * SESSIONS + 1 and inbox.headers()[-1].session == 1


def test_an_inbox_keeps_the_last_few_messages_and_the_newest_that_can_be_read() -> None:
    _, inbox = _inbox()
    for stamp_ns in range(1, KEPT + 3):
        _store(inbox, 7, stamp_ns, stamp_ns)
    assert [header.stamp_ns for header in inbox.headers()] == list(range(3, KEPT + 3))
    newest, earlier, first = inbox.newest(), inbox.newest(up_to_ns=KEPT + 1), inbox.newest(up_to_ns=2)
    assert newest is not None and newest.header.stamp_ns == KEPT + 2
    assert earlier is not None and earlier.header.stamp_ns == KEPT + 1 and first is None
    _store(inbox, 7, 90, 90, b"\xff")
    again = inbox.newest()
    assert again is not None and again.header.stamp_ns == KEPT + 2
    assert inbox.newest() is again and inbox.bad == 1, "looked at once"
    header = inbox.newest_header()
    assert header is not None and header.stamp_ns == 90


def test_the_age_of_a_message_counts_its_way_and_what_it_had_before() -> None:
    _, inbox = _inbox()
    inbox.store(Header(7, 1, 1000, 30), encode(Plan(0.05)))
    received = inbox.newest()
    assert received is not None
    assert received.age_ns(received.arrived_ns + 5) == 35
    inbox.store(Header(7, 2, 1000 - 10**12, 30), encode(Plan(0.05)))  # sent a thousand seconds before, and came now
    late = inbox.newest()
    assert late is not None and late.age_ns(late.arrived_ns) == pytest.approx(10**12, abs=10**9)


def test_an_inbox_is_of_its_topics_type() -> None:
    bus, _ = _bus()
    with pytest.raises(TypeError, match="carries Plan, not RobotState"):
        bus.inbox(topics.PLAN, RobotState, 1)


def test_a_muted_process_skips_the_numbers_of_lost_states_and_sends_its_events_later() -> None:
    hub = MemoryHub()
    (sender, _), (receiver, _) = _bus(hub), _bus(hub)
    beats, events = list[int](), list[tuple[int, int]]()
    receiver.subscribe(topics.HEARTBEAT, None, lambda topic, key, header, payload: beats.append(header.sequence))
    receiver.subscribe(topics.EVENT, None, lambda topic, key, h, payload: events.append((h.sequence, h.stamp_ns)))
    for muted in (False, True, False):
        sender.mute(muted)
        sender.publish(topics.HEARTBEAT, StationHeartbeat(), 1)
        for stamp_ns in (1, 2):
            sender.publish(topics.EVENT, Event(2, "me", "said"), stamp_ns + 10 * muted)
    assert beats == [1, 3]
    assert events == [(1, 1), (2, 2), (3, 11), (4, 12), (5, 1), (6, 2)]


@pytest.mark.parametrize(
    ("payload", "header"), [(b"\xff", Header(1, 1, 0).encode()), (encode(Command(CommandKind.ARM, 1)), b"short")]
)
def test_a_command_that_cannot_be_read_is_refused_with_the_reason_and_counted(payload: bytes, header: bytes) -> None:
    bus, wire = _bus()
    bus.serve(1, lambda header, command: pytest.fail("it was handled"))
    reply = decode(Reply, wire.served(payload, header), "", "")
    assert not reply.accepted and "robot/1/command" in reply.reason
    assert bus.rejected == 1


def test_a_short_stop_alone_waits_for_no_other_command() -> None:
    bus, wire = _bus()
    bus.serve(1, lambda header, command: Reply(1, True))
    stop = encode(Command(CommandKind.STOP, 1))
    padding = STOP_BYTES - len(encode(Command(CommandKind.STOP, 1, text="")))
    longest = next(
        data
        for size in range(padding, 0, -1)
        if len(data := encode(Command(CommandKind.STOP, 1, text="x" * size))) == STOP_BYTES
    )
    longer = encode(Command(CommandKind.STOP, 1, text="x" * (padding + 1)))
    assert [wire.urgent(data) for data in (stop, longest)] == [True, True]
    assert [wire.urgent(data) for data in (longer, encode(Command(CommandKind.HOLD, 1)), b"\xff")] == [False] * 3


def test_an_answer_that_cannot_be_read_is_a_refusal_and_none_is_silence() -> None:
    bus, wire = _bus()
    wire.replies = [b"\xff", None]
    unread, silent = (bus.command(Command(CommandKind.ARM, 1), 0, 0.5) for _ in range(2))
    assert (unread.accepted, unread.silent) == (False, False) and "robot 1" in unread.reason
    assert (silent.accepted, silent.silent, silent.reason) == (False, True, "nobody answers there")


def test_a_silence_is_told_from_a_place_where_nobody_answers() -> None:
    """A network knows at once that nobody serves a key; one that serves it and says nothing takes all of the time."""
    hub = MemoryHub()
    (station, wire), (robot, _) = _bus(hub), _bus(hub)
    robot.serve(1, lambda header, command: Reply(1, False))
    wire.silent_s = 0.06
    wire.replies = [None]
    assert station.command(Command(CommandKind.ARM, 1), 0, 0.05).reason == "no answer within 0.05 s"
    wire.replies = [encode(Reply(1, False, session=robot.session)), None]  # the second try, which names it
    assert station.command(Command(CommandKind.ARM, 1), 0, 0.05).reason == "no answer within 0.05 s"
    wire.silent_s = 0.0
    assert station.command(Command(CommandKind.ARM, 2), 0, 60.0).reason == "nobody answers there"
    station.unreachable = frozenset({3})
    assert station.command(Command(CommandKind.ARM, 3), 0, 60.0).reason == "no answer within 60 s", "it has no radio"


def test_the_second_try_names_the_process_that_answered_the_first() -> None:
    hub = MemoryHub()
    (station, wire), (robot, _) = _bus(hub), _bus(hub)
    robot.serve(1, lambda header, command: Reply(1, command.order is CommandKind.ARM))
    assert station.command(Command(CommandKind.ARM, 1), 0, 0.5).accepted
    assert [command.recipient for command in wire.commands] == [0, robot.session]
    assert station.command(Command(CommandKind.ARM, 1), 0, 0.5).accepted
    assert not station.command(Command(CommandKind.LOAD, 1), 0, 0.5).accepted, "refused, and not asked twice"
    assert [command.recipient for command in wire.commands[2:]] == [robot.session] * 2
    assert station.command(Command(CommandKind.ARM, 2), 0, 0.5).silent
    assert station.answer("shoal/robot/1/command", b"", b"") is None
    assert robot.answer("shoal/robot/1/command", b"\xff", b"") is not None


class _HeldWire(_Wire):
    """A network on which queries can be held up: nobody hears of them before `deliver`."""

    def __init__(self, hub: MemoryHub, reaches: Bus) -> None:
        super().__init__(hub)
        self._reaches, self.holds, self.held = reaches, False, list[tuple[str, bytes, bytes]]()

    def ask(self, key: str, payload: bytes, header: bytes, timeout_s: float) -> Await:
        if not self.holds:
            return super().ask(key, payload, header, timeout_s)
        self.held.append((key, payload, header))
        return lambda: time.sleep(timeout_s)

    def deliver(self) -> list[Reply]:
        """Let what was held up reach the recipient, in its order."""
        held, self.held = self.held, []
        answers = [self._reaches.answer(*query) for query in held]
        return [decode(Reply, answer, "", "") for answer in answers if answer is not None]


def _held_station() -> tuple[Bus, _HeldWire, list[CommandKind]]:
    """A station whose requests expire, the network to it, and the orders that it has carried out."""
    hub, done = MemoryHub(), list[CommandKind]()
    station, _ = _bus(hub)

    def handle(header: Header, command: Command) -> Reply:
        done.append(command.order)
        return Reply(0, True)

    station.serve(0, handle, expires=True)
    return station, _HeldWire(hub, station), done


ON_THE_MOVE = ("START", "RESUME", "RETURN", "FORMATION", "TEST", "GO", "PATH", "ARM", "TUNE", "END", "HOLD")


@pytest.mark.parametrize("order", ON_THE_MOVE)
@pytest.mark.parametrize("is_met", [True, False])
def test_a_request_that_was_held_up_until_its_sender_gave_up_is_not_done(order: str, is_met: bool) -> None:
    """A station that stood still and goes on must not do what nobody waits for: that may start robots."""
    _, wire, done = _held_station()
    terminal, wanted = Bus(wire), CommandKind[order]

    def ask(kind: CommandKind, timeout_s: float) -> Reply:
        return terminal.command(Command(kind, 0), time.monotonic_ns(), timeout_s, to=0)

    if is_met:  # a script that has asked for something before
        assert ask(CommandKind.LOAD, 60.0).accepted
    wire.holds = True
    assert ask(wanted, 0.3).silent
    assert ask(CommandKind.STOP, 0.1).silent
    assert ask(CommandKind.NONE, 0.1).silent
    late, stop, query = wire.deliver()
    assert not late.accepted
    assert not is_met or "nobody waits for it any more" in late.reason
    assert stop.accepted, "it only takes power away"
    assert query.accepted is is_met
    assert wanted not in done
    wire.holds = False
    assert ask(wanted, 60.0).accepted, "asked for again"
    assert done[-1] is wanted


@pytest.mark.skipif(not hasattr(time, "CLOCK_BOOTTIME"), reason="the system has no clock that counts a machine's sleep")
def test_a_request_that_waited_while_the_stations_machine_slept_is_not_done(monkeypatch: pytest.MonkeyPatch) -> None:
    """Its monotonic clock stood meanwhile: by that the request has just been sent."""
    _, wire, done = _held_station()
    terminal = Bus(wire)
    assert terminal.command(Command(CommandKind.LOAD, 0), time.monotonic_ns(), 60.0, to=0).accepted
    wire.holds, sleeps_ns, awake_ns = True, time.monotonic_ns(), time.monotonic_ns
    assert terminal.command(Command(CommandKind.START, 0), time.monotonic_ns(), 0.5, to=0).silent
    slept_ns = awake_ns() - sleeps_ns
    monkeypatch.setattr(time, "monotonic_ns", lambda: awake_ns() - slept_ns)
    (late,) = wire.deliver()
    assert not late.accepted and "nobody waits for it any more" in late.reason
    assert done == [CommandKind.LOAD]


def test_a_request_of_a_terminal_whose_first_word_came_late_lives_no_longer_than_it_waits() -> None:
    """The recipient measures from the first word; the sender knows how long that took."""
    station, wire, done = _held_station()
    begun = time.monotonic_ns()

    def late_first_word(key: str, payload: bytes, header: bytes, timeout_s: float) -> Await:
        time.sleep(0.5)
        reply = station.answer(key, payload, header)
        wire.holds, wire.ask = True, held  # type: ignore[method-assign]
        return lambda: reply

    held, wire.ask = wire.ask, late_first_word  # type: ignore[method-assign]
    assert Bus(wire).command(Command(CommandKind.START, 0), begun, 0.9, to=0).silent
    assert not wire.deliver()[0].accepted
    assert done == []


def test_a_script_whose_first_word_came_late_is_heard_all_the_same_afterwards() -> None:
    """Only that word was late. Had it been taken for the usual way, each later request would count as held up."""
    _, wire, _ = _held_station()

    def late_first_word(key: str, payload: bytes, header: bytes, timeout_s: float) -> Await:
        time.sleep(2.0)
        wire.ask = usual  # type: ignore[method-assign]
        return usual(key, payload, header, timeout_s)

    usual, wire.ask = wire.ask, late_first_word  # type: ignore[method-assign]
    script = Bus(wire)
    replies = (script.command(Command(CommandKind.HOLD, 0), time.monotonic_ns(), 2.2, to=0) for _ in range(20))
    assert any(reply.accepted for reply in replies)


def _known(dedup: CommandDeduplicator, session: int, sequence: int) -> Reply | None:
    return dedup.known_reply(Header(session, sequence, 0), Command(CommandKind.ARM, 1, recipient=5))


def test_as_many_senders_are_remembered_as_a_fleet_can_have() -> None:
    dedup = CommandDeduplicator(5)
    for session in range(1, SENDERS + 1):
        dedup.record(Header(session, 3, 0), Reply(1, True))
    assert all(_known(dedup, session, 3) is not None for session in (1, 2, SENDERS))
    dedup.record(Header(1, 4, 0), Reply(1, True))  # the newest now
    dedup.record(Header(SENDERS + 1, 3, 0), Reply(1, True))
    assert [_known(dedup, session, 3) is None for session in (1, 2, 3)] == [False, True, False]


@pytest.mark.parametrize(
    ("pattern", "key", "matches"),
    [
        ("a/*/c", "a/b/c", True),
        ("a/*/c", "a/b/d", False),
        ("a/*", "a/b/c", False),
        ("a/*/c", "a/b", False),
        ("a/**", "a/b/c", True),
        ("b/**", "a/b/c", False),
    ],
)
def test_the_network_in_memory_knows_the_patterns_of_the_real_one(pattern: str, key: str, matches: bool) -> None:
    transport, came = MemoryTransport(MemoryHub()), list[str]()
    transport.subscribe(pattern, topics.Qos.STATE, lambda at, payload, header: came.append(at))
    transport.publisher(key, topics.Qos.STATE)(b"", b"")
    assert bool(came) is matches
