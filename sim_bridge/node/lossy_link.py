"""A link between a robot's computer and its board that loses, delays, doubles and reorders datagrams. Pure and seeded: one for
each direction, in the plant's time, so that a lockstep run repeats to the bit.
"""

import heapq
from typing import Generic, TypeVar

from sim_bridge.fault_schedule import LinkTrouble
from sim_bridge.plant.random_streams import Stream, generator

T = TypeVar("T")  # of what travels beside a datagram
OVERTAKEN_NS = 50_000_000  # longest that a datagram of a noisy link is held back: a control period, so that order changes


class LossyLink(Generic[T]):
    """Datagrams on their way in one direction."""

    def __init__(self, seed: int, robot: int, direction: int, none: T) -> None:
        """`none` comes out beside a datagram that was overtaken."""
        self._none = none
        self._random = generator(seed, Stream.LINK, robot, direction)
        self._queue: list[tuple[int, int, bytes, T]] = []  # due, order of arrival, datagram, tag
        self._count = self._newest = 0

    def push(self, data: bytes, now_ns: int, trouble: LinkTrouble, tag: T) -> None:
        """A datagram enters, with something that comes out beside it."""
        if trouble.cut:
            return
        due_ns = now_ns + round(trouble.delay_s * 1e9)
        if trouble.loss == 0.0:
            self._put(due_ns, data, tag)
            return
        lost, doubled, overtaken, by = self._random.random(4).tolist()
        if lost < trouble.loss:
            return
        self._put(due_ns + (round(by * OVERTAKEN_NS) if overtaken < trouble.loss else 0), data, tag)
        if doubled < trouble.loss:
            self._put(due_ns, data, tag)

    def _put(self, due_ns: int, data: bytes, tag: T) -> None:
        self._count += 1
        heapq.heappush(self._queue, (due_ns, self._count, data, tag))

    def pop(self, now_ns: int) -> list[tuple[bytes, T]]:
        """The datagrams that come out by now, with their tags; none for what was overtaken, which MAVLink takes for stale."""
        out: list[tuple[bytes, T]] = []
        while self._queue and self._queue[0][0] <= now_ns:
            _, order, data, tag = heapq.heappop(self._queue)
            out.append((data, tag if order > self._newest else self._none))
            self._newest = max(self._newest, order)
        return out
