"""The interface between the bus and a network: keys, bytes, callbacks. Pure.

ZenohTransport (zenoh_transport.py) is the real one. MemoryTransport (memory_transport.py) is its double within one process,
for tests and measurements. shoal/bus/bus.py gives the bytes their meaning.
"""

from collections.abc import Callable, Iterable
from typing import Protocol

from shoal.messages.topics import Qos

Deliver = Callable[[str, bytes, bytes], None]  # arguments: key, payload, header
Collect = Callable[[], Iterable[tuple[str, bytes, bytes]]]  # the messages since the last call, in order of arrival
Answer = Callable[[bytes, bytes], bytes]  # arguments: payload, header; returns the payload of the reply
Await = Callable[[], bytes | None]  # waits for the reply to a query that was sent; None if there is none in time
Urgent = Callable[[bytes], bool]  # argument: payload; True if it must wait for no other query's answer
Presence = Callable[[str, bool], None]  # arguments: key, present or not


class Transport(Protocol):
    """A network as the bus needs it. Callbacks come from other threads and must return at once."""

    def publisher(self, key: str, qos: Qos, cache_depth: int = 0) -> Callable[[bytes, bytes], None]: ...
    def subscribe(self, key: str, qos: Qos, deliver: Deliver) -> None: ...
    def collect(self, key: str, qos: Qos) -> Collect: ...
    def serve(self, key: str, answer: Answer, urgent: Urgent) -> None: ...
    def ask(self, key: str, payload: bytes, header: bytes, timeout_s: float) -> Await: ...
    def announce(self, key: str) -> None: ...
    def watch(self, key: str, presence: Presence, anew: bool = False) -> None: ...  # `anew`: without memory of before
    def close(self) -> None: ...
