"""SHELL: the fleet's own time as a program beside it sees it: the wall clock's, or simulated time, which a busy laptop slows.

A station in lockstep stamps its heartbeats with simulated time. A wait of 60 s for such a fleet is over when 60 s have gone by
on both clocks: a machine that simulates half a second a second has then had its 120 s.
"""

import time
from collections import deque
from collections.abc import Callable
from typing import Any, NamedTuple

from shoal.bus.bus import Inbox, Received
from shoal.messages.messages import StationHeartbeat

SIMULATED_BELOW_NS = 10**16  # smaller stamps are simulated time, which begins at 0, not in 1970
STANDING_S = 30.0  # s of the wall clock without a heartbeat: simulated time stands; a step that plans takes some of them
AHEAD_S = 1.0  # of the newest heartbeat that came: no message is further in a time that goes on
WINDOW_S = 5.0  # s of the wall clock over which the pace is measured: a step that plans takes one of them
SETTLED_S = 1.0  # s of the wall clock before a pace counts
BUSY_BELOW = 0.95  # of the pace that is wanted; nearer, nobody would notice


class FleetTime:
    """The fleet's time, by its station's heartbeats. Not thread-safe where `pace` is called."""

    def __init__(self, heartbeats: Inbox[StationHeartbeat]) -> None:
        self._heartbeats = heartbeats
        self._meter = PaceMeter()

    def simulated_s(self) -> float | None:
        """Simulated time (s) of the newest heartbeat; None for a fleet that lives by the wall clock, or where time stands."""
        heartbeat = self._heartbeats.newest()
        if heartbeat is None or heartbeat.header.stamp_ns >= SIMULATED_BELOW_NS or _since_s(heartbeat) > STANDING_S:
            return None
        return heartbeat.header.stamp_ns * 1e-9

    def age_s(self, received: Received[Any]) -> float:
        """Age of a message's content, in the fleet's time. Where simulated time stands, by the wall clock: nothing that has
        stopped coming looks alive."""
        now_s = self.simulated_s()
        if received.header.stamp_ns >= SIMULATED_BELOW_NS:
            return received.age_ns(time.monotonic_ns()) * 1e-9
        since_s = _since_s(received)
        if now_s is None or received.header.stamp_ns * 1e-9 > now_s + AHEAD_S:  # of a time that is over: it began anew
            return since_s
        return min(since_s, max(now_s - received.header.stamp_ns * 1e-9, 0.0))

    def limit(self, limit_s: float) -> Callable[[], bool]:
        """A function that returns True once a number of seconds have gone by, both by the fleet's time and by the wall
        clock."""
        began_s, simulated_began_s = time.monotonic(), self.simulated_s()

        def over() -> bool:
            nonlocal simulated_began_s
            now_s = self.simulated_s()
            if now_s is not None and (simulated_began_s is None or now_s < simulated_began_s):  # also when it began anew
                simulated_began_s = now_s
            if time.monotonic() - began_s < limit_s:
                return False
            return now_s is None or simulated_began_s is None or now_s - simulated_began_s >= limit_s

        return over

    def pace(self) -> float | None:
        """Simulated seconds per second, lately. None for the wall clock, and before it is known. To be called often."""
        simulated_s = self.simulated_s()
        return None if simulated_s is None else self._meter.add(simulated_s, time.monotonic())


class _ClockReading(NamedTuple):
    simulated_s: float
    wall_s: float


class PaceMeter:
    """Measures how fast simulated time goes."""

    def __init__(self) -> None:
        self._readings: deque[_ClockReading] = deque()  # of the last WINDOW_S

    def add(self, simulated_s: float, now_s: float) -> float | None:
        """Add a reading of both clocks. Returns simulated seconds per second over the last WINDOW_S; None before that is
        known."""
        readings = self._readings
        readings.append(_ClockReading(simulated_s, now_s))
        while len(readings) > 2 and readings[1].wall_s <= now_s - WINDOW_S:
            readings.popleft()
        took_s = now_s - readings[0].wall_s
        return (simulated_s - readings[0].simulated_s) / took_s if took_s >= SETTLED_S else None


def pace_in_words(pace: float, share: float | None) -> str:
    """A pace for people, with the reason where it is less than `share` of real time (None: as fast as the machine can)."""
    busy = share is not None and pace < BUSY_BELOW * share
    return f"{pace:.1f} x real time{', the machine is busy' if busy else ''}"


def _since_s(received: Received[Any]) -> float:
    return (time.monotonic_ns() - received.arrived_ns) * 1e-9
