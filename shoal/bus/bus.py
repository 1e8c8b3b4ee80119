"""SHELL: the fleet's bus: typed publishing, latest-wins inboxes, orders with an answer, presence.

    bus = Bus(ZenohTransport(Endpoint("tcp/127.0.0.1:7447")))
    poses = bus.inbox(topics.POSE, robot=1)
    bus.announce("agent-1")               # last: to others a process that is present has its subscriptions
    received = poses.newest()

Network threads only store bytes and wake the loop; decoding happens in the loop that asks.
"""

import contextlib
import logging
import secrets
import threading
import time
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field, replace
from typing import Any, Generic, NamedTuple, TypeVar

from shoal.bus.command_deduplication import ALWAYS_TAKEN, CommandDeduplicator
from shoal.bus.delay_estimator import WINDOWS, DelayEstimator, SenderDelays
from shoal.bus.transport import Answer, Await, Transport
from shoal.errors import ConfigError, Unreached
from shoal.messages import topics
from shoal.messages.codec import DecodeError, Header, decode, encode
from shoal.messages.messages import Command, CommandKind, Message, Reply
from shoal.messages.topics import Topic

log = logging.getLogger("shoal")

M = TypeVar("M")
Raw = Callable[[Topic, str, Header, bytes], None]  # topic, key, header, payload
Collected = Callable[[], Iterator[tuple[Topic, str, Header, bytes]]]
Handle = Callable[[Header, Command], Reply]
Encode = Callable[[Message, int], bytes]  # message, stamp_ns; as codec.encode
Decode = Callable[[type[Any], bytes, str, str], Any]  # type of the message, payload, peer, topic; as codec.decode

STOP_BYTES = 256  # a STOP has fewer; what is longer is not looked at before its turn
SAME_NAME_S = 12.0  # for the router to miss a process that was cut off: its lease is 1 s, on a busy machine it takes longer
TOLD_WITHIN_S = 0.25  # the router tells within ms that a name is taken; liveliness().get() misses 1 name of 20 under load
LOOK_AGAIN_S = 3.0  # a name that is taken: of a process that ends as it is looked for, Zenoh may keep a session's memory
STOPPED_WITHIN_S = 0.2  # between looks at whether this process is to end
SESSIONS = 4  # per inbox that are remembered: of a sender that was started again, the one before may still be on its way
TWO_SENDERS_S = 1.0  # after the last sign of a second sender; all topics that control come several times in that time
NOBODY = "nobody answers there"
HELD_UP = "was held up for so long that nobody waits for it any more: not done"
KEPT = 3  # per inbox: in lockstep a fast neighbour may already be one step ahead
REPLY_S = 0.25  # of the time that a request's sender waits: for the reply to come back


@dataclass(frozen=True)
class Received(Generic[M]):
    """A message with what is known of its way here."""

    message: M
    header: Header
    arrived_ns: int  # receiver's monotonic clock
    late_ns: int = 0  # how much longer it was on its way than the fastest of late

    def age_ns(self, now_ns: int) -> int:
        """Age of its content at an instant of the receiver's monotonic clock."""
        return now_ns - self.arrived_ns + self.header.age_ns + self.late_ns


@dataclass(slots=True, eq=False)
class _Kept(Generic[M]):
    """A message in an inbox, decoded when it is first read."""

    header: Header
    payload: bytes
    arrived_ns: int
    late_ns: int
    decoded: bool = False
    received: Received[M] | None = None


@dataclass(slots=True, eq=False)
class _Sender:
    """State of a session in an inbox."""

    sequence: int = -1  # of its newest message
    delay: DelayEstimator = field(default_factory=DelayEstimator)


class Inbox(Generic[M]):
    """The newest message of one topic. Never a queue: what is older than the newest is gone.

    Repeated and reordered messages of a session are dropped; a restarted sender (a new session) is taken up at once. What is
    still on its way from the session before is known as such: it is no restart, and as old as it is.
    """

    def __init__(self, bus: "Bus", topic: Topic, kind: type[M], robot: int | None, wakes: bool) -> None:
        """Make it for `Bus.inbox`, which has it filled."""
        self.dropped = 0  # repeated, reordered
        self.bad = 0  # not decodable
        self.last_error = ""
        self.name = topic.key(robot)
        self._bus, self._topic, self._kind, self._wakes = bus, topic, kind, wakes
        self._kept: tuple[_Kept[M], ...] = ()  # replaced, never changed: readers need no lock
        self._senders: dict[int, _Sender] = {}  # by session, the newest last
        self._session = 0  # of the newest message
        self._returned_ns: int | None = None  # when a session was last heard again after another one
        self._last_read: Received[M] | None = None

    def store(self, header: Header, payload: bytes) -> None:
        """A message has come."""
        with self._bus.arrival:
            sender = self._senders.get(header.session)
            if sender is None:
                sender = self._senders[header.session] = _Sender()
            if header.sequence <= sender.sequence:
                self.dropped += 1
                return
            if len(self._senders) > SESSIONS:
                del self._senders[next(iter(self._senders))]
            sender.sequence, arrived_ns, is_known = header.sequence, time.monotonic_ns(), sender.sequence >= 0
            if is_known and header.session != self._session:
                self._returned_ns = arrived_ns
            self._session = header.session
            late_ns = sender.delay.excess_ns(header.stamp_ns + header.age_ns, arrived_ns)
            self._kept = (*self._kept[1 - KEPT :], _Kept(header, payload, arrived_ns, late_ns))
            if self._wakes:
                self._bus.arrival.notify_all()

    def has_two_senders(self, within_s: float = TWO_SENDERS_S) -> bool:
        """True if two programs send this topic by turns: one was heard again after another, so long ago at most. The newest
        message is then one's or the other's."""
        returned_ns = self._returned_ns
        return returned_ns is not None and time.monotonic_ns() - returned_ns < within_s * 1e9

    def newest_header(self) -> Header | None:
        """Header of the newest message, decoded or not: cheap, for waiting."""
        kept = self._kept
        return kept[-1].header if kept else None

    def headers(self) -> tuple[Header, ...]:
        """Headers of the last few messages, oldest first."""
        return tuple(kept.header for kept in self._kept)

    def newest(self, up_to_ns: int | None = None) -> Received[M] | None:
        """The newest valid message; with `up_to_ns` the newest whose stamp is not later. None if there is none. While the bus
        is muted, the one that was returned last."""
        if not self._bus.muted or self._topic in topics.CLOCKS:
            self._last_read = self._newest(up_to_ns)
        return self._last_read

    def _newest(self, up_to_ns: int | None) -> Received[M] | None:
        """The newest message stamped at or before an instant that can be decoded."""
        for one in reversed(self._kept):
            if up_to_ns is not None and one.header.stamp_ns > up_to_ns:
                continue
            if not one.decoded:
                one.received, one.decoded = self._decode(one), True
            if one.received is not None:
                return one.received
        return None

    def _decode(self, kept: "_Kept[M]") -> Received[M] | None:
        """Decode a message; None for a bad one, which is counted."""
        try:
            message = self._bus.decode(self._kind, kept.payload, f"session {kept.header.session:x}", self._topic.name)
        except DecodeError as error:
            self.bad += 1
            self.last_error = str(error)
            return None
        return Received(message, kept.header, kept.arrived_ns, kept.late_ns)


def request_clock_ns() -> int:
    """Time of requests, by a clock that goes on while this machine sleeps. By one that stands then, all that a sender asks for
    after its sleep would look held up, and what came while the recipient slept as if it had just been sent."""
    return time.clock_gettime_ns(time.CLOCK_BOOTTIME) if hasattr(time, "CLOCK_BOOTTIME") else time.time_ns()


def _claim_of(key: str) -> tuple[str, int]:
    """State and session of a claim's key."""
    state, session = key.split("/")[-2:]
    return state, int(session, 16)


class _Recipient(NamedTuple):
    session: int
    took_s: tuple[float, ...]  # from each of the last commands to its reply


class _SentCommand(NamedTuple):
    sequence: int
    answer: Await  # waits for the reply


class Bus:
    """One process's access to the fleet. Thread-safe. Close it in a `finally`."""

    def __init__(self, transport: Transport, fleet: str = "shoal", decode: Decode = decode, encode: Encode = encode) -> None:
        self.decode, self._encode = decode, encode
        self.session = secrets.randbits(63) | 1
        self.arrival = threading.Condition()  # notified whenever something arrives
        self.rejected = 0  # messages without a readable header
        self.closed = False
        self.transport, self._fleet = transport, fleet
        self._publishers: dict[str, Callable[[bytes, bytes], None]] = {}
        self._sequences: dict[str, int] = {}
        self._present: set[str] = set()
        self._recipients: dict[str, _Recipient] = {}  # by key: the process that answers its commands
        self._turns: dict[str, threading.Lock] = {}  # by key: around a message's number and its sending
        self._served: dict[str, Answer] = {}  # by key: the answers to commands
        self.unreachable: frozenset[int] = frozenset()  # robots that no command reaches
        self.muted = False
        self._unsent: list[tuple[Topic, bytes, int, int | None]] = []  # of topics whose messages each count

    def _key(self, name: str) -> str:
        return f"{self._fleet}/{name}"

    def publish(
        self, topic: Topic, message: Message, stamp_ns: int, robot: int | None = None, age_ns: int = 0
    ) -> tuple[str, Header, bytes]:
        """Send a message about the instant `stamp_ns`, which was `age_ns` ago. Returns what went out, for a local log."""
        return self.forward(topic, self._encode(message, stamp_ns), stamp_ns, robot, age_ns)

    def mute(self, muted: bool) -> None:
        """Be without a radio, or with one again: while muted nothing goes out, and inboxes are read as they last were. What
        counts one by one goes out afterwards."""
        self.muted = muted
        while self._unsent and not muted:
            topic, payload, stamp_ns, robot = self._unsent.pop(0)
            self.forward(topic, payload, stamp_ns, robot)

    def forward(
        self, topic: Topic, payload: bytes, stamp_ns: int, robot: int | None = None, age_ns: int = 0
    ) -> tuple[str, Header, bytes]:
        """Publish an encoded message. Returns its key, header and payload.

        A muted bus sends nothing: numbers are given all the same, so that receivers count the messages as lost; events and the
        journal are kept, and sent later.
        """
        key = self._key(topic.key(robot))
        if self.muted:
            if topic.qos not in topics.RECOVERED:
                return key, self._next_header(key, stamp_ns, age_ns), payload
            self._unsent.append((topic, payload, stamp_ns, robot))
            return key, Header(self.session, 0, stamp_ns, age_ns), payload
        with self._turns.setdefault(key, threading.Lock()):  # numbered and sent in one order, also from several threads
            if key not in self._publishers:
                self._publishers[key] = self.transport.publisher(key, topic.qos, topic.cache_depth)
            header = self._next_header(key, stamp_ns, age_ns)
            self._publishers[key](payload, header.encode())
        return key, header, payload

    def _next_header(self, key: str, stamp_ns: int, age_ns: int = 0) -> Header:
        with self.arrival:
            self._sequences[key] = self._sequences.get(key, 0) + 1
            return Header(self.session, self._sequences[key], stamp_ns, age_ns)

    def inbox(self, topic: Topic, kind: type[M], robot: int | None = None) -> Inbox[M]:
        """The newest message of a topic, of one robot where the topic has robots. `kind` is the topic's type."""
        inbox = self._inbox(topic, kind, robot, wakes=True)
        self.subscribe(topic, robot, lambda topic, key, header, payload: inbox.store(header, payload))
        return inbox

    def inboxes(self, topic: Topic, kind: type[M], robots: Iterable[int], wakes: bool = True) -> dict[int, Inbox[M]]:
        """An inbox for each of these robots, filled by one subscription: Zenoh has a thread for each, and 19 that take turns
        at Python's lock cost more than what they bring. `wakes`: whether a message ends a `wait`."""
        inboxes = {robot: self._inbox(topic, kind, robot, wakes) for robot in robots}
        by_key = {self._key(inbox.name): inbox for inbox in inboxes.values()}

        def store(topic: Topic, key: str, header: Header, payload: bytes) -> None:
            inbox = by_key.get(key)
            if inbox is not None:
                inbox.store(header, payload)

        if inboxes:
            self.subscribe(topic, None, store)
        return inboxes

    def _inbox(self, topic: Topic, kind: type[M], robot: int | None, wakes: bool) -> Inbox[M]:
        if kind is not topic.type:
            raise TypeError(f"topic {topic.name} carries {topic.type.__name__}, not {kind.__name__}")
        return Inbox(self, topic, kind, robot, wakes)

    def subscribe(self, topic: Topic, robot: int | None, raw: Raw) -> None:
        """Receive a topic's messages as bytes (of all robots if none is named). Called from a network thread: be quick."""

        def deliver(key: str, payload: bytes, header: bytes) -> None:
            decoded = self._header(topic, header)
            if decoded is not None:
                raw(topic, key, decoded, payload)

        self.transport.subscribe(self._key(topic.key(robot)), topic.qos, deliver)

    def collect(self, topic: Topic) -> Collected:
        """Subscribe to a topic of all robots for messages that can wait. Call the result now and then, from one thread, for
        those that have come. This is cheaper than `subscribe`, and no network thread ever waits for the caller."""
        collect = self.transport.collect(self._key(topic.key()), topic.qos)

        def collected() -> Iterator[tuple[Topic, str, Header, bytes]]:
            for key, payload, header in collect():
                decoded = self._header(topic, header)
                if decoded is not None:
                    yield topic, key, decoded, payload

        return collected

    def _header(self, topic: Topic, header: bytes) -> Header | None:
        """Decode a message's header; None, and counted as rejected, if that fails."""
        try:
            return Header.decode(header, "unknown peer", topic.name)
        except DecodeError:
            self.rejected += 1
            return None

    def serve(self, robot: int, handle: Handle, expires: bool = False) -> None:
        """Answer the commands to a robot. `handle` runs in a network thread, and sees each command once
        (shoal/bus/command_deduplication.py). What cannot be read is refused, with the reason; so is what `handle` raises
        an exception at, which may be carried out by half and is not tried again. A STOP waits for no other command: `handle`
        may be called with it while another call is under way.

        `expires`: a command is handed over with what is left of its time to live; one that was held up for longer is refused.
        Its sender waits no longer. A STOP, a DISARM and a query are answered however late."""
        name, deduplicator = topics.COMMAND_KEY.format(robot=robot), CommandDeduplicator(self.session)
        turn, deduplicator_lock = threading.Lock(), threading.Lock()  # around a command; around deduplicator and delays
        delays = SenderDelays()

        def left(command: Command, since_ns: int) -> Command:
            """A command that was sent at `since_ns`, on our clock of requests, with what is left of its time to live."""
            if not expires:
                return command
            return replace(command, time_to_live_s=command.time_to_live_s - (request_clock_ns() - since_ns) * 1e-9)

        def handled(header: Header, command: Command) -> Reply:
            if command.time_to_live_s < 0.0 and command.order not in ALWAYS_TAKEN | {CommandKind.NONE}:
                return Reply(robot, False, f"{command.order.name} {HELD_UP}")
            try:
                return handle(header, command)
            except Exception as error:  # without an answer the sender would take the network for the cause
                log.error("%s failed: %s: %s", command.order.name, type(error).__name__, error, exc_info=error)
                return Reply(robot, False, f"{command.order.name} failed: {type(error).__name__}: {error}")

        def answer(payload: bytes, header: bytes) -> bytes:
            arrived_ns = request_clock_ns()
            try:
                decoded = Header.decode(header, "unknown peer", name)
                command = decode(Command, payload, f"session {decoded.session:x}", name)
            except DecodeError as error:
                self.rejected += 1
                return encode(Reply(robot, False, str(error)))
            since_ns = arrived_ns
            if expires:
                with deduplicator_lock:
                    since_ns -= delays.excess_ns(decoded, arrived_ns)
            with contextlib.nullcontext() if command.order is CommandKind.STOP else turn:
                with deduplicator_lock:
                    reply = deduplicator.known_reply(decoded, command)
                if reply is None:
                    reply = handled(decoded, left(command, since_ns))
                    with deduplicator_lock:
                        reply = deduplicator.record(decoded, reply)
            with self.arrival:
                self.arrival.notify_all()
            return encode(reply)

        def urgent(payload: bytes) -> bool:
            try:
                return len(payload) <= STOP_BYTES and decode(Command, payload, "unknown peer", name).order is CommandKind.STOP
            except DecodeError:
                return False

        self._served[self._key(name)] = answer
        self.transport.serve(self._key(name), answer, urgent)

    def answer(self, key: str, payload: bytes, header: bytes) -> bytes | None:
        """The reply to a command that came another way than over the network (own_door.py); None if nobody here
        serves its key. Thread-safe."""
        answer = self._served.get(key)
        return answer(payload, header) if answer is not None else None

    def command(self, command: Command, stamp_ns: int, timeout_s: float, to: int | None = None) -> Reply:
        """Send an order and wait for its answer. No answer, or one that cannot be read, is a refusal with the reason."""
        return self.send_command(command, stamp_ns, timeout_s, to)()

    def send_command(self, command: Command, stamp_ns: int, timeout_s: float, to: int | None = None) -> Callable[[], Reply]:
        """Send an order to its robot, or to another recipient `to` that is to see to it, and return what waits for its answer
        (`command`). Orders to one recipient reach it in the order of these calls: an order neither overtakes another nor waits
        until another is answered.

        The first order to a process asks, in effect, who it is; the second try names it. One to a process that has been
        started again is refused: what it was meant for is no more. So is a second try that would come after a later order.

        A request (`to`) lives no longer than its sender waits. The recipient measures how long it was held up beyond the
        fastest command of this sender of late, so what the fastest took is taken off."""
        if command.robot in self.unreachable:
            return lambda: self._read(command, "", None, f"no answer within {timeout_s:g} s")
        key = self._key(topics.COMMAND_KEY.format(robot=command.robot if to is None else to))
        met, asked_s = self._recipients.get(key), time.monotonic()

        def named(recipient: _Recipient) -> Command:
            lives_s = command.time_to_live_s if to is None else max(timeout_s - min(recipient.took_s) - REPLY_S, 0.0)
            return replace(command, recipient=recipient.session, time_to_live_s=lives_s)

        first = self._ask(key, command if met is None else named(met), stamp_ns, timeout_s)
        assert first is not None

        def read(answer: Await, asked_s: float) -> Reply:
            """Wait for a reply. A network knows at once where nobody serves the key, and waits only for one that does."""
            data = answer()
            is_late = time.monotonic() - asked_s >= timeout_s
            return self._read(command, key, data, f"no answer within {timeout_s:g} s" if is_late else NOBODY)

        def note(process: int, took_s: float) -> None:
            """Remember who has answered, and how fast of late: a first word that came late says nothing about the others."""
            before = self._recipients.get(key)
            if process and before is not None and process == before.session:
                if to is not None:
                    self._recipients[key] = _Recipient(process, (*before.took_s, took_s)[-WINDOWS:])
            elif process and (met is None or process != met.session):
                self._recipients[key] = _Recipient(process, (took_s,))

        def reply() -> Reply:
            """Wait for the answer. Where a process has answered with its identity alone, it gets the order again, by name."""
            first_reply, asked_again_s = read(first.answer, asked_s), time.monotonic()
            process, took_s = first_reply.session, asked_again_s - asked_s
            note(process, took_s)
            is_final = met is not None or not process or first_reply.accepted
            if is_final:
                return first_reply
            again_ns = stamp_ns if to is None else stamp_ns + round(took_s * 1e9)
            again = self._ask(key, named(self._recipients[key]), again_ns, timeout_s, only_after=first.sequence)
            if again is None:
                return Reply(command.robot, False, f"{command.order.name} was overtaken by a later order")
            last_reply = read(again.answer, asked_again_s)
            note(last_reply.session, time.monotonic() - asked_again_s)
            return last_reply

        return reply

    def _ask(
        self, key: str, command: Command, stamp_ns: int, timeout_s: float, only_after: int | None = None
    ) -> "_SentCommand | None":
        """Send a command with the next number of its key. With `only_after` nothing is sent, and None returned, if the last
        number that was given is another."""
        payload = encode(command)  # a trajectory takes its time: before the turn, so that no other order waits for it
        with self._turns.setdefault(key, threading.Lock()):
            if only_after is not None and self._sequences.get(key) != only_after:
                return None
            header = self._next_header(key, stamp_ns)
            return _SentCommand(header.sequence, self.transport.ask(key, payload, header.encode(), timeout_s))

    def _read(self, command: Command, key: str, answer: bytes | None, silence: str) -> Reply:
        """The reply in an answer; without an answer, one that gives `silence` as the reason."""
        if answer is None:
            return Reply(command.robot, False, silence, silent=True)
        try:
            return decode(Reply, answer, f"robot {command.robot}", key)
        except DecodeError as error:
            return Reply(command.robot, False, str(error))

    def claim(self, process: str, stopped: Callable[[], bool], patience_s: float = SAME_NAME_S) -> None:
        """Take a name in the fleet, once no other process has it. A process that has crashed loses its name after seconds.
        Raises ConfigError if the name is still taken after `patience_s`, and Unreached if this process is to stop before the
        name is free: it must not act on the other's board. Claim the name before anything else: two processes of one name
        would act by turns.

        Of several processes that claim it together, each announces its claim, looks again when the others must have heard of
        it, and the lowest session gets the name. Where two have it all the same, after a network was in two parts, both log an
        error."""
        held, namesakes = False, set[tuple[str, int]]()  # states and sessions of processes of this name

        def look(anew: bool) -> set[tuple[str, int]]:
            """The processes of this name, kept up to date; `anew`: by a new connection, which remembers no earlier ones."""
            processes = set[tuple[str, int]]()

            def note(key: str, there: bool) -> None:
                state, session = (topics.HOLDER, 0) if "/presence/" in key else _claim_of(key)
                with self.arrival:
                    (processes.add if there else processes.discard)((state, session))
                    self.arrival.notify_all()
                    other_holds = there and state == topics.HOLDER and session not in (0, self.session)
                    alarm = other_holds and held and processes is namesakes
                if alarm:  # a thread of its own: what is logged goes out as an event, and this is a thread of the network's
                    threading.Thread(target=accuse, args=(session,), name="claim", daemon=True).start()

            for key in (topics.PRESENCE_KEY, topics.CLAIM_KEY):
                self.transport.watch(self._key(key.format(process=process, state="*", session="*")), note, anew)
            return processes

        def accuse(session: int) -> None:
            """Log that another process has the name, if it is still there when it is looked for anew."""
            processes = look(anew=True)
            if self.wait(lambda: (topics.HOLDER, session) in processes, TOLD_WITHIN_S):
                log.error("%s: another process of this name is in the fleet, and the two act by turns: end one", process)

        def is_free() -> bool:
            others = [(state, session) for state, session in namesakes if session != self.session]
            return not any(state == topics.HOLDER or session < self.session for state, session in others)

        deadline_s, again_s = time.monotonic() + patience_s, time.monotonic() + LOOK_AGAIN_S
        namesakes = look(anew=False)
        self.transport.announce(self._claim_key(process, topics.CANDIDATE))
        if self.wait(lambda: not is_free(), TOLD_WITHIN_S):
            log.info("%s: another process of this name is in the fleet; waiting for it to be gone", process)
        while not stopped() and not self.wait(is_free, STOPPED_WITHIN_S):
            if time.monotonic() > deadline_s:
                raise ConfigError(
                    f"{process}: another process of this name is in fleet {self._fleet} (allowed: one): end it, or start this "
                    "one for another robot (--robot) or fleet (--fleet)"
                )
            if time.monotonic() > again_s:
                processes, again_s = look(anew=True), time.monotonic() + LOOK_AGAIN_S
                if self.wait(lambda processes=processes: (topics.CANDIDATE, self.session) in processes, TOLD_WITHIN_S):  # type: ignore[misc]
                    namesakes = processes  # it works: this process itself is told
                    self.wait(lambda: not is_free(), TOLD_WITHIN_S)
        if not is_free():
            raise Unreached(f"{process}: stopped while another process of this name is in fleet {self._fleet}")
        held = True
        self.transport.announce(self._claim_key(process, topics.HOLDER))

    def _claim_key(self, process: str, state: str) -> str:
        return self._key(topics.CLAIM_KEY.format(process=process, state=state, session=f"{self.session:x}"))

    def announce(self, process: str) -> None:
        """Make this process visible to the others. Do it last, when every subscription stands."""
        self.transport.announce(self._key(topics.PRESENCE_KEY.format(process=process)))

    def watch_presence(self) -> None:
        """Start to follow who is there; see `present`."""

        def presence(key: str, there: bool) -> None:
            process = key.rsplit("/", 1)[-1]
            with self.arrival:
                (self._present.add if there else self._present.discard)(process)
                self.arrival.notify_all()

        self.transport.watch(self._key(topics.PRESENCE_KEY.format(process="*")), presence)

    @property
    def present(self) -> frozenset[str]:
        """Names of the processes that are there (not necessarily well). Needs `watch_presence`."""
        with self.arrival:
            return frozenset(self._present)

    def wait(self, ready: Callable[[], bool], timeout_s: float) -> bool:
        """Sleep until `ready()` or the time is over; woken by every arrival. Returns the last `ready()`."""
        with self.arrival:
            return self.arrival.wait_for(ready, max(timeout_s, 0.0))

    def close(self) -> None:
        """Leave the fleet."""
        self.closed = True
        self.transport.close()

    def __enter__(self) -> "Bus":
        return self

    def __exit__(self, *exception: Any) -> None:
        self.close()
