"""Admission of connections at the router's public port: which may wait, which go on to the router and when, which are closed.
Pure: time is an argument, in seconds of a monotonic clock.

The router's TLS listener pauses for 0.1 s after each handshake that fails (zenoh-link-tls 1.10: TLS_ACCEPT_THROTTLE_TIME), so
ten strangers a second keep every member out. Therefore the guard (guard.py) passes on only connections that have
sent a whole TLS ClientHello, and rations failed handshakes: a connection takes a token of its origin and one of its lane with
it, and gives both back when it has proven that its handshake succeeded. Origins that have proven so before have a lane, that
is a listener of the router, of their own. Within a lane origins take turns, so an origin never waits for the crowd of another.
"""

from collections import OrderedDict
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from enum import Enum
from ipaddress import ip_address, ip_network

HELLO_S = 2.0  # from accept to a whole ClientHello; a member's comes one round trip after the connection
TURN_S = 2.0  # from the ClientHello to the router; Zenoh's clients give up after 1 s (shoal/bus/endpoint.py, TRY_MS)
PROOF_S = 3.0  # from the router to a handshake that has succeeded; also the router's own limit (INNER_HANDSHAKE_MS)
YOUNG_S = 5.0  # the router closes no member's link sooner than this; a proof that is followed by that was none

MOST_WAITING = 512  # connections that are not passed on yet, of all origins
MOST_WAITING_EACH = 64  # and of one origin; then its oldest goes, which has been silent longest
MOST_TRYING = 32  # handshakes at a time, per lane
MOST_TRYING_EACH = 8  # and of one origin
MOST_ORIGINS = 4096  # remembered
MOST_KNOWN = 1024  # of these with a proof
MOST_LINKS_EACH = 512  # of one origin at the router: 49 robots behind one address take some 150

# Failed handshakes. 5 a second make the router pause for half of its time, 3 of one origin for a third. A burst is what a
# robot with the wrong keys tries in ten seconds: it shall hear the router's reason.
LANE_BURST, LANE_PER_S = 20.0, 5.0
ORIGIN_BURST, ORIGIN_PER_S = 10.0, 3.0

HANDSHAKE, CLIENT_HELLO, SERVER_HELLO = 22, 1, 2  # a TLS record's type; types of handshake messages
MOST_RECORDS = 16  # that a ClientHello comes in; everybody sends one
MOST_HELLO = 16 * 1024  # bytes of a ClientHello; with post-quantum key shares they have less than 2 kB
RECORD = 5  # bytes of a TLS record's header
RETRY = bytes.fromhex("cf21ad74e59a6111be1d8c021e65b891c2a211167abb8c5e079e09e2c8a8339c")  # RFC 8446, 4.1.3


class NotTls(Exception):
    """Bytes that no ClientHello begins with."""


def hello_is_whole(data: bytes) -> bool:
    """True if `data` holds a whole ClientHello; False while it may become one. Raises NotTls."""
    message, at, records = b"", 0, 0
    while at < len(data):
        records += 1
        head = data[at : at + RECORD]
        if head[0] != HANDSHAKE or head[1:2] not in (b"", b"\x03"):
            raise NotTls
        if len(head) < RECORD:
            return False
        size = int.from_bytes(head[3:5])
        if not 0 < size <= MOST_HELLO or records > MOST_RECORDS:
            raise NotTls
        message += data[at + RECORD : at + RECORD + size]
        at += RECORD + size
        if message[:1] not in (b"", bytes([CLIENT_HELLO])):
            raise NotTls
        if len(message) >= 4:
            whole = 4 + int.from_bytes(message[1:4])
            if whole > MOST_HELLO:
                raise NotTls
            if len(message) >= whole:
                return True
    return False


def asks_for_another_hello(answer: bytes) -> bool:
    """True if a router's first answer is a HelloRetryRequest. No member causes one, and what follows would be no proof."""
    return answer[:1] == bytes([HANDSHAKE]) and answer[RECORD : RECORD + 1] == bytes([SERVER_HELLO]) and answer[11:43] == RETRY


def origin_of(address: str) -> str:
    """The origin of a connection, counted as one peer: an IPv4 address, or the /64 network that one IPv6 host may own."""
    ip = ip_address(address.partition("%")[0])
    mapped = getattr(ip, "ipv4_mapped", None)
    if mapped is not None:
        return str(mapped)
    return str(ip) if ip.version == 4 else str(ip_network((int(ip), 64), strict=False).network_address) + "/64"


@dataclass
class Tokens:
    """A token bucket: `burst` tokens at first, `per_s` new ones a second. May be overdrawn by `burst`."""

    burst: float
    per_s: float
    level: float = field(init=False)
    at_s: float = float("-inf")

    def __post_init__(self) -> None:
        self.level = self.burst

    def refill(self, now_s: float) -> float:
        """Add the tokens since the last call, and return their number now."""
        if now_s > self.at_s:
            longest_s = 2.0 * self.burst / self.per_s  # fills even an overdrawn bucket; before the first call lies infinity
            self.level = min(self.burst, self.level + self.per_s * min(now_s - self.at_s, longest_s))
            self.at_s = now_s
        return self.level

    def add(self, count: float, now_s: float) -> None:
        """Give tokens back, or take some (negative)."""
        self.level = max(min(self.refill(now_s) + count, self.burst), -self.burst)

    def next_s(self, now_s: float) -> float:
        """The time of the next whole token, in s."""
        return now_s + max(1.0 - self.refill(now_s), 0.0) / self.per_s


@dataclass
class Origin:
    """One peer address, and its connections by number, oldest first."""

    silent: OrderedDict[int, float] = field(default_factory=OrderedDict)  # no whole ClientHello yet; since when, s
    ready: OrderedDict[int, float] = field(default_factory=OrderedDict)  # waiting for their turn; since when, s
    trying: int = 0
    links: int = 0  # at the router, those included
    tokens: Tokens = field(default_factory=lambda: Tokens(ORIGIN_BURST, ORIGIN_PER_S))


@dataclass
class Lane:
    """A listener of the router: how many handshakes are under way at it, and how many may still fail."""

    trying: int = 0
    tokens: Tokens = field(default_factory=lambda: Tokens(LANE_BURST, LANE_PER_S))


@dataclass
class HandshakeAttempt:
    """A connection that was passed on to the router."""

    origin: str
    lane: int
    since_s: float
    proven: bool = False
    expelled: bool = False


NEW, KNOWN = 0, 1  # lanes


def _oldest_s(since_s: OrderedDict[int, float]) -> float:
    """Since when the oldest of some connections waits; infinity if there are none."""
    return next(iter(since_s.values()), float("inf"))


class Admission:
    """The decisions about connections, which are numbers here."""

    def __init__(self, most_links: int) -> None:
        """`most_links`: connections at the router at a time, of members and others together."""
        self._most_links = most_links
        self._origins: OrderedDict[str, Origin] = OrderedDict()  # the longest unused first
        self._crowd: OrderedDict[str, Origin] = OrderedDict()  # origins with waiting connections, in the order of their turns
        self._proven_origins: OrderedDict[str, None] = OrderedDict()
        self._lanes = (Lane(), Lane())
        self._waits: dict[int, str] = {}  # origin of each connection that is not passed on yet
        self._tries: dict[int, HandshakeAttempt] = {}
        self._unproven: OrderedDict[int, float] = OrderedDict()  # since when, s

    def come(self, connection: int, address: str, now_s: float) -> tuple[int, ...]:
        """A connection has been accepted. Returns those that must go for it: silent ones first, the oldest first."""
        name = origin_of(address)
        origin = self._origins.setdefault(name, Origin())
        self._origins.move_to_end(name)
        origin.silent[connection] = now_s
        self._waits[connection] = name
        self._crowd[name] = origin
        self._forget()
        if len(origin.silent) + len(origin.ready) > MOST_WAITING_EACH:
            return (self._out(origin, connection),)
        if len(self._waits) > MOST_WAITING:
            return (self._out(max(self._crowd.values(), key=lambda one: len(one.silent) + len(one.ready)), connection),)
        return ()

    def _out(self, origin: Origin, newest: int) -> int:
        connection = next(c for c in (*origin.silent, *origin.ready, newest) if c != newest)
        self.gone(connection)
        return connection

    def _forget(self) -> None:
        """Drop the origins longest unused that have nothing under way; what they failed at is over by then."""
        if len(self._origins) > MOST_ORIGINS:
            idle = [name for name, one in self._origins.items() if not (one.silent or one.ready or one.links)]
            for name in idle[: len(self._origins) - MOST_ORIGINS]:
                del self._origins[name]

    def hello(self, connection: int, now_s: float) -> None:
        """A waiting connection has sent its whole ClientHello."""
        origin = self._origins[self._waits[connection]]
        del origin.silent[connection]
        origin.ready[connection] = now_s

    def gone(self, connection: int) -> None:
        """A waiting connection is no more."""
        self._leave(connection)

    def _leave(self, connection: int) -> str:
        """A connection waits no more. Returns its origin."""
        name = self._waits.pop(connection)
        origin = self._origins[name]
        origin.silent.pop(connection, None)
        origin.ready.pop(connection, None)
        if not origin.silent and not origin.ready:
            del self._crowd[name]
        return name

    def proven(self, connection: int, now_s: float) -> None:
        """A connection's handshake has succeeded: it belongs to a member."""
        attempt = self._tries[connection]
        if attempt.proven:
            return
        attempt.proven = True
        self._settle(connection, attempt)
        self._give(attempt, 1.0, now_s)
        self._proven_origins[attempt.origin] = None
        self._proven_origins.move_to_end(attempt.origin)
        if len(self._proven_origins) > MOST_KNOWN:
            self._proven_origins.popitem(last=False)

    def ended(self, connection: int, by_router: bool, now_s: float) -> bool:
        """Forget a connection to the router that has ended. Returns whether its handshake counts as failed."""
        attempt = self._tries.pop(connection)
        self._origins[attempt.origin].links -= 1
        if attempt.expelled:
            return False
        if not attempt.proven:
            self._settle(connection, attempt)
            return True
        if by_router and now_s - attempt.since_s < YOUNG_S:
            self._give(attempt, -1.0, now_s)
            return True
        return False

    def expel(self, connection: int, now_s: float) -> None:
        """Count a connection that the router's side has refused after its handshake as one that failed. Its origin is no
        longer known, unless it has another proven connection. The caller then closes it, and calls `ended`."""
        attempt = self._tries[connection]
        if attempt.proven:
            self._give(attempt, -1.0, now_s)
        else:
            self._settle(connection, attempt)
        attempt.expelled = True
        if not any(one.proven and not one.expelled for one in self._tries.values() if one.origin == attempt.origin):
            self._proven_origins.pop(attempt.origin, None)

    def _settle(self, connection: int, attempt: HandshakeAttempt) -> None:
        """Count a handshake as no longer under way."""
        del self._unproven[connection]
        self._lanes[attempt.lane].trying -= 1
        self._origins[attempt.origin].trying -= 1

    def _give(self, attempt: HandshakeAttempt, count: float, now_s: float) -> None:
        """Give tokens back to an attempt's lane and origin, or take some (negative)."""
        self._lanes[attempt.lane].tokens.add(count, now_s)
        if attempt.origin in self._origins:
            self._origins[attempt.origin].tokens.add(count, now_s)

    def overdue(self, now_s: float) -> tuple[int, ...]:
        """Connections to be closed now: silent, unserved or unproven for too long. The waiting ones are forgotten here; for
        the others `ended` is still to be called."""

        def late(since_s: Mapping[int, float], within_s: float) -> list[int]:
            return [connection for connection, began_s in since_s.items() if now_s - began_s >= within_s]

        silent = [connection for crowd in self._crowd.values() for connection in late(crowd.silent, HELLO_S)]
        unserved = [connection for crowd in self._crowd.values() for connection in late(crowd.ready, TURN_S)]
        for connection in (*silent, *unserved):
            self.gone(connection)
        return (*silent, *unserved, *late(self._unproven, PROOF_S))

    def turns(self, now_s: float) -> Iterator[tuple[int, int]]:
        """Connections whose turn it is to go to the router, with their lane: origin after origin."""
        moved = True
        while moved:
            moved = False
            for name, origin in list(self._crowd.items()):
                lane = KNOWN if name in self._proven_origins else NEW
                if origin.ready and self._may_begin_handshake(origin, self._lanes[lane], now_s):
                    yield self._begin_handshake(next(iter(origin.ready)), lane, now_s), lane
                    moved = True

    def _may_begin_handshake(self, origin: Origin, lane: Lane, now_s: float) -> bool:
        """True if another connection of this address may begin its handshake with the router: room in lane and address, and a
        token of each."""
        room = lane.trying < MOST_TRYING and origin.trying < MOST_TRYING_EACH
        room = room and origin.links < MOST_LINKS_EACH and len(self._tries) < self._most_links
        return room and lane.tokens.refill(now_s) >= 1.0 and origin.tokens.refill(now_s) >= 1.0

    def _begin_handshake(self, connection: int, lane: int, now_s: float) -> int:
        """Begin a handshake on a free lane."""
        name = self._leave(connection)
        if name in self._crowd:
            self._crowd.move_to_end(name)  # the others' turn comes first, now and the next time
        self._tries[connection] = attempt = HandshakeAttempt(name, lane, now_s)
        self._unproven[connection] = now_s
        self._lanes[lane].trying += 1
        self._origins[name].trying += 1
        self._origins[name].links += 1
        self._give(attempt, -1.0, now_s)
        return connection

    def next_s(self, now_s: float) -> float:
        """The time of the next look at `overdue` and `turns`, if nothing else happens; infinity if nothing waits."""
        due_s = [_oldest_s(self._unproven) + PROOF_S]
        for name, origin in self._crowd.items():
            due_s += [_oldest_s(origin.silent) + HELLO_S, _oldest_s(origin.ready) + TURN_S]
            if origin.ready:
                buckets = (origin.tokens, self._lanes[KNOWN if name in self._proven_origins else NEW].tokens)
                if min(tokens.refill(now_s) for tokens in buckets) < 1.0:  # else a slot is awaited, and that is an event
                    due_s.append(max(tokens.next_s(now_s) for tokens in buckets))
        return min(due_s)


SAY_AGAIN_S = 10.0  # how often one origin is named, for each reason
MOST_NAMED = 8  # origins that are named within that time; the others are counted


class RefusalReason(Enum):
    """The reason why a connection was closed; the value ends the sentence about it."""

    NO_TLS = "that does not begin as TLS does"
    CROWDED = "because too many wait, or are open"
    NO_CERTIFICATE = "without a valid certificate"


class Refusals:
    """Messages about refused connections: each origin and reason at most once in SAY_AGAIN_S, with the number since."""

    def __init__(self) -> None:
        self._counts: dict[tuple[str, RefusalReason], int] = {}
        self._said_s: OrderedDict[tuple[str, RefusalReason], float] = OrderedDict()

    def note(self, address: str, reason: RefusalReason) -> None:
        """Count one more refused connection."""
        key = origin_of(address), reason
        self._counts[key] = self._counts.get(key, 0) + 1

    def due_sentences(self, now_s: float) -> list[str]:
        """Sentences about refused connections that are due now."""
        while self._said_s and now_s - next(iter(self._said_s.values())) >= SAY_AGAIN_S:
            self._said_s.popitem(last=False)
        sentences = []
        for key in [key for key in self._counts if key not in self._said_s][: MOST_NAMED - len(self._said_s)]:
            self._said_s[key] = now_s
            count, (name, reason) = self._counts.pop(key), key
            more = f" ({count} of them since last told)" if count > 1 else ""
            sentences.append(f"refused a connection from {name} {reason.value}{more}")
        if len(self._counts) > MOST_ORIGINS:
            self._counts.clear()
        return sentences

    def next_s(self) -> float:
        """The time of the next message; infinity if none is kept back."""
        return next(iter(self._said_s.values()), float("-inf")) + SAY_AGAIN_S if self._counts else float("inf")
