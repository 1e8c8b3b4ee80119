"""SHELL: the in-memory double of the transport: several buses in one process (sim_bridge/in_process/executor.py, tests)."""

import threading
from collections import deque
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from itertools import chain
from typing import NamedTuple

from shoal.bus.transport import Answer, Await, Collect, Deliver, Presence, Urgent
from shoal.messages.topics import Qos


class _Subscriber(NamedTuple):
    pattern: str
    deliver: Deliver
    owner: "MemoryTransport"


class _Watcher(NamedTuple):
    pattern: str
    presence: Presence
    owner: "MemoryTransport"


class _Queryable(NamedTuple):
    answer: Answer
    owner: "MemoryTransport"


@dataclass
class MemoryHub:
    """A network within one process: everyone on it hears everyone, at once and in order."""

    subscribers: list[_Subscriber] = field(default_factory=list)
    queryables: dict[str, _Queryable] = field(default_factory=dict)  # by key
    tokens: dict[str, "MemoryTransport"] = field(default_factory=dict)  # what is present, each with its owner
    watchers: list[_Watcher] = field(default_factory=list)
    cache: dict[str, deque[tuple[str, bytes, bytes]]] = field(default_factory=dict)  # by key
    routes: dict[str, list[Deliver]] = field(default_factory=dict)  # by key: its subscribers, until these change
    lock: threading.RLock = field(default_factory=threading.RLock)

    def listeners(self, key: str) -> list[Deliver]:
        """Subscribers of a key. Call it with the lock held."""
        if key not in self.routes:
            self.routes[key] = [entry.deliver for entry in self.subscribers if _matches(entry.pattern, key)]
        return self.routes[key]


def _matches(pattern: str, key: str) -> bool:
    """Zenoh's key expressions, as far as the fleet uses them: `*` is one part, a closing `**` any number."""
    want, have = pattern.split("/"), key.split("/")
    if want[-1] == "**":
        want, have = want[:-1], have[: len(want) - 1]
    return len(want) == len(have) and all(w in ("*", h) for w, h in zip(want, have, strict=True))


class MemoryTransport:
    """One process's place on a MemoryHub."""

    def __init__(self, hub: MemoryHub) -> None:
        self._hub = hub

    def publisher(self, key: str, qos: Qos, cache_depth: int = 0) -> Callable[[bytes, bytes], None]:
        """The function that delivers a message to all that subscribe, at once. The last ones are kept for later
        subscribers."""
        with self._hub.lock:
            cached = self._hub.cache.setdefault(key, deque(maxlen=cache_depth))

        def put(payload: bytes, header: bytes) -> None:
            with self._hub.lock:
                cached.append((key, payload, header))
                listeners = self._hub.listeners(key)
            for deliver in listeners:
                deliver(key, payload, header)

        return put

    def subscribe(self, key: str, qos: Qos, deliver: Deliver) -> None:
        """Deliver messages from now on, and for events also those that are kept."""
        with self._hub.lock:
            self._hub.subscribers.append(_Subscriber(key, deliver, self))
            self._hub.routes.clear()
            kept = [entries for cached, entries in self._hub.cache.items() if _matches(key, cached)]
            missed = list(chain.from_iterable(kept)) if qos is Qos.EVENT else []
        for entry in missed:
            deliver(*entry)

    def collect(self, key: str, qos: Qos) -> Collect:
        """The function that returns the messages since its last call."""
        waiting: deque[tuple[str, bytes, bytes]] = deque()
        self.subscribe(key, qos, lambda *message: waiting.append(message))

        def collected() -> Iterable[tuple[str, bytes, bytes]]:
            while waiting:
                yield waiting.popleft()

        return collected

    def serve(self, key: str, answer: Answer, urgent: Urgent) -> None:
        with self._hub.lock:
            self._hub.queryables[key] = _Queryable(answer, self)

    def ask(self, key: str, payload: bytes, header: bytes, timeout_s: float) -> Await:
        """Ask and have the answer at once, in order: it is made in the thread that asks."""
        with self._hub.lock:
            queryable = self._hub.queryables.get(key)
        reply = queryable.answer(payload, header) if queryable else None
        return lambda: reply

    def announce(self, key: str) -> None:
        with self._hub.lock:
            self._hub.tokens[key] = self
        self._tell(key, True)

    def watch(self, key: str, presence: Presence, anew: bool = False) -> None:
        with self._hub.lock:
            self._hub.watchers.append(_Watcher(key, presence, self))
            there = [token for token in self._hub.tokens if _matches(key, token)]
        for token in there:
            presence(token, True)

    def _tell(self, key: str, there: bool) -> None:
        """Report the presence or absence of `key` to its watchers."""
        with self._hub.lock:
            watchers = [entry for entry in self._hub.watchers if _matches(entry.pattern, key)]
        for entry in watchers:
            entry.presence(key, there)

    def close(self) -> None:
        """Leave the hub: nothing of this process is delivered, answered or present any more."""
        with self._hub.lock:
            self._hub.subscribers = [entry for entry in self._hub.subscribers if entry.owner is not self]
            self._hub.routes.clear()
            self._hub.watchers = [entry for entry in self._hub.watchers if entry.owner is not self]
            self._hub.queryables = {key: entry for key, entry in self._hub.queryables.items() if entry.owner is not self}
            own_tokens = [token for token, owner in self._hub.tokens.items() if owner is self]
            for token in own_tokens:
                del self._hub.tokens[token]
        for token in own_tokens:
            self._tell(token, False)
