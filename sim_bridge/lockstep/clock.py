"""SHELL: lockstep: the simulator's clock drives every process, and a step begins when all of its inputs are here."""

import logging
import time
from collections.abc import Callable, Iterable, Mapping
from typing import Any

from shoal.bus.bus import Bus, Inbox, Received
from shoal.messages import topics
from shoal.messages.messages import LocalizerStatus, Obstacles, Pose, Tick
from shoal.messages.topics import Topic
from shoal.runtime.runtime import SLICE_S, Stop, wait

log = logging.getLogger("shoal")

LOCKSTEP_SAYS_S = 60.0  # how often a process says what it waits for: to go on without would be another run


class LockstepClock:
    """The simulator's time. All processes share it, so a stamp is an instant."""

    waits = True

    def __init__(self) -> None:
        self.tick_ns = 0

    def now_ns(self) -> int:
        return self.tick_ns

    def instant_ns(self, received: Received[Any]) -> int:
        return received.header.stamp_ns

    def arrival_ns(self, stamp_ns: int) -> int:
        return stamp_ns


class Reminder:
    """Timer of the messages of a process that waits."""

    def __init__(self) -> None:
        self._said_s = time.monotonic()

    def due(self) -> bool:
        """True once every LOCKSTEP_SAYS_S, from the beginning on."""
        now_s = time.monotonic()
        if now_s - self._said_s <= LOCKSTEP_SAYS_S:
            return False
        self._said_s = now_s
        return True


class Lockstep:
    """One process's side of the simulator's clock. Make it before the process is announced: the first tick comes but once."""

    def __init__(self, bus: Bus, stop: Stop, clock: LockstepClock, ticks: Topic = topics.TICK) -> None:
        self._bus, self._stop, self._clock = bus, stop, clock
        self._ticks = bus.inbox(ticks, Tick)
        self._last_ns = self._seen_ns = -1  # of the last tick, and of the newest that came, which may be unreadable

    def next(self, meanwhile: Callable[[], None] = lambda: None) -> Tick | None:
        """Wait for the next tick and set the clock to it, calling `meanwhile` now and then. None if the process has to
        stop."""
        while not self._stop.requested:
            if wait(self._bus, self._stop, self._fresh, SLICE_S):
                header, received = self._ticks.newest_header(), self._ticks.newest()
                self._seen_ns = self._seen_ns if header is None else header.stamp_ns
                if received is None or received.message.now_ns <= self._last_ns:
                    log.error("lockstep: a tick is no new one: %s", self._ticks.last_error or "its time is not later")
                    continue
                self._last_ns = self._clock.tick_ns = received.message.now_ns
                return received.message
            meanwhile()
        return None

    def _fresh(self) -> bool:
        header = self._ticks.newest_header()
        return header is not None and header.stamp_ns > self._seen_ns

    def await_all(self, inputs: Iterable[tuple[Inbox[Any], int]]) -> bool:
        """Wait until each inbox holds a message with at least the given stamp. A negative stamp requires nothing: no step came
        before the first. Returns False if the process has to stop."""
        required = [(inbox, stamp_ns) for inbox, stamp_ns in inputs if stamp_ns >= 0]

        def missing() -> list[str]:
            headers = [(inbox.name, inbox.newest_header(), stamp_ns) for inbox, stamp_ns in required]
            return [name for name, header, stamp_ns in headers if header is None or header.stamp_ns < stamp_ns]

        while not wait(self._bus, self._stop, lambda: not missing(), LOCKSTEP_SAYS_S):
            if self._stop.requested:
                return False
            log.warning("lockstep: at %.3f s waiting for %s", self._clock.tick_ns * 1e-9, ", ".join(missing()))
        return True

    def await_sight(
        self, tick: Tick, localizer: Inbox[LocalizerStatus], poses: Mapping[int, Inbox[Pose]], obstacles: Inbox[Obstacles]
    ) -> int | None:
        """Wait for the localizer's messages about the picture that counts at a tick: its status names the poses that belong to
        it, and the obstacles published before them. Returns the stamp up to which obstacles count at this tick; None if the
        process has to stop."""
        if not self.await_all([(localizer, tick.frame_ns)]):
            return None
        status = localizer.newest()
        assert status is not None, localizer.last_error
        robots, up_to_ns = status.message.robots, status.message.obstacles_ns
        inputs = [(inbox, tick.frame_ns) for robot, inbox in poses.items() if robot in robots]
        return up_to_ns if self.await_all([*inputs, (obstacles, up_to_ns)]) else None
