"""Computers whose clocks differ, drift and are set, on a network that repeats and reorders. True time is the test's."""

import contextlib
import heapq
import itertools
import random
import time
from collections.abc import Callable, Iterator
from contextvars import ContextVar
from dataclasses import dataclass, field

import pytest

from shoal.bus.memory_transport import MemoryHub, MemoryTransport
from shoal.bus.transport import Deliver
from shoal.messages.codec import Header
from shoal.messages.topics import Qos

MS = 1_000_000
S = 1_000_000_000
UNIX_NS = 1_800_000_000 * S

Name = tuple[str, int, int]  # key, session and sequence of a message


@dataclass
class ClockedComputer:
    """Clocks of one computer: the wall clock is `ahead_s` of true time, both of its clocks go wrong by `drift`."""

    ahead_s: float
    drift: float
    boot_ns: int
    set_ns: int = 0  # how much the wall clock was set by since
    newest: dict[str, Header] = field(default_factory=dict)  # by key: of what has come in
    highest: dict[tuple[str, int], int] = field(default_factory=dict)  # by key and session: sequence

    def monotonic_ns(self, true_ns: int) -> int:
        return self.boot_ns + true_ns + round(true_ns * self.drift)

    def wall_ns(self, true_ns: int) -> int:
        return UNIX_NS + round(self.ahead_s * 1e9) + self.set_ns + self.monotonic_ns(true_ns) - self.boot_ns

    def true_ns(self, wall_ns: int, started_set_ns: int = 0) -> float:
        """True time at which a process that was started with the clock set by so much showed `wall_ns`."""
        return (wall_ns - UNIX_NS - round(self.ahead_s * 1e9) - started_set_ns) / (1.0 + self.drift)


class TimedWorld:
    """True time, the computers, and the messages under way."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, seed: int = 1) -> None:
        self.true_ns, self.computers, self.hub = 0, dict[str, ClockedComputer](), MemoryHub()
        self.truth: dict[Name, int] = {}  # by message: the true instant that it is about
        self.about_ns: int | None = None  # the instant that what is published now is about; None: now
        self.obstacles_ns: int | None = None  # the same of obstacles, where they are about another one
        self.random = random.Random(seed)
        self.held: dict[str, int] = {}  # by computer: until when nothing reaches it
        self.slow: dict[str, int] = {}  # by computer: how much longer everything takes to it, ns
        self._here: ContextVar[ClockedComputer | None] = ContextVar("computer", default=None)
        self._under_way: list[tuple[int, int, ClockedComputer, Deliver, tuple[str, bytes, bytes]]] = []
        self._due: dict[tuple[str, str, bytes], list[int]] = {}  # by computer, key and header: when a message is there
        self._count = itertools.count()
        for name, read in (
            ("monotonic_ns", ClockedComputer.monotonic_ns),
            ("perf_counter_ns", ClockedComputer.monotonic_ns),
            ("time_ns", ClockedComputer.wall_ns),
        ):
            shown = self._clock(getattr(time, name), read)
            monkeypatch.setattr(time, name, shown)
            monkeypatch.setattr(time, name.removesuffix("_ns"), lambda shown=shown: shown() * 1e-9)

    def _clock(self, real: Callable[[], int], read: Callable[[ClockedComputer, int], int]) -> Callable[[], int]:
        def now_ns() -> int:
            here = self._here.get()
            return real() if here is None else read(here, self.true_ns)

        return now_ns

    @contextlib.contextmanager
    def on(self, name: str) -> Iterator[ClockedComputer]:
        """Run what is inside on a computer, by its clocks."""
        token = self._here.set(self.computers[name])
        try:
            yield self.computers[name]
        finally:
            self._here.reset(token)

    def send(self, to: str, deliver: Deliver, message: tuple[str, bytes, bytes]) -> None:
        """Put a message on its way: 0.3 to 1 ms, or until `to` is reached again. One of 20 comes twice, at some time."""
        name = to, message[0], message[2]
        if name not in self._due:  # one message to a computer, whatever there listens to it
            delays_ns = [300_000 + self.random.randrange(700_000)]
            if self.random.random() < 0.05:
                delays_ns.append(self.random.randrange(300 * MS))
            due = [self.true_ns + self.slow.get(to, 0) + delay_ns for delay_ns in delays_ns]
            back_ns = self.held.get(to, 0)
            self._due[name] = [ns if ns > back_ns else back_ns + self.random.randrange(3 * MS) for ns in due]  # in any order
        for due_ns in self._due[name]:
            heapq.heappush(self._under_way, (due_ns, next(self._count), self.computers[to], deliver, message))

    def run_until(self, true_ns: int) -> None:
        """Let true time go on, and deliver what is due."""
        while self._under_way and self._under_way[0][0] <= true_ns:
            self.true_ns, _, computer, deliver, message = heapq.heappop(self._under_way)
            header = Header.decode(message[2], "", "")
            if header.sequence > computer.highest.get((message[0], header.session), 0):
                computer.newest[message[0]] = header
                computer.highest[message[0], header.session] = header.sequence
            token = self._here.set(computer)
            deliver(*message)
            self._here.reset(token)
        self.true_ns = true_ns

    def truth_of(self, key: str, header: Header) -> int:
        return self.truth[key, header.session, header.sequence]


class NetworkLine(MemoryTransport):
    """A process's line to the network, on one computer."""

    def __init__(self, world: TimedWorld, computer: str) -> None:
        super().__init__(world.hub)
        self._world, self._computer = world, computer

    def publisher(self, key: str, qos: Qos, cache_depth: int = 0) -> Callable[[bytes, bytes], None]:
        put = super().publisher(key, qos, cache_depth)

        def send(payload: bytes, header: bytes) -> None:
            own_header, world = Header.decode(header, "", ""), self._world
            about_ns = world.obstacles_ns if key.endswith("/obstacles") and world.obstacles_ns is not None else world.about_ns
            about_ns = world.true_ns if about_ns is None else about_ns
            world.truth[key, own_header.session, own_header.sequence] = about_ns
            put(payload, header)

        return send

    def subscribe(self, key: str, qos: Qos, deliver: Deliver) -> None:
        super().subscribe(key, qos, lambda *message: self._world.send(self._computer, deliver, message))
