"""SHELL: the ground station in lockstep: a cycle a tick, when all messages of that tick have come."""

from collections.abc import Iterator

from groundstation.station.process import TimeOwner
from groundstation.station.station import Station
from shoal.bus.bus import Bus
from shoal.runtime.runtime import Stop
from sim_bridge.lockstep.clock import Lockstep, LockstepClock


def simulated_time(bus: Bus, stop: Stop) -> TimeOwner:
    """The simulator's time, for `process.cycles`."""
    clock = LockstepClock()
    return TimeOwner(clock, lambda station: StationPace(station, Lockstep(bus, stop, clock)))


class StationPace:
    """The instants of the station's cycles."""

    def __init__(self, station: Station, lockstep: Lockstep) -> None:
        self._station, self._lockstep = station, lockstep

    def __iter__(self) -> Iterator[int]:
        """Times of the station's cycles: one for each tick, once the messages of the step before have arrived."""
        station, lockstep, inboxes = self._station, self._lockstep, self._station.inboxes
        while (tick := lockstep.next()) is not None:
            station.bus.unreachable = frozenset(tick.no_radio)
            # What the robots found in the step before, and where the picture shows them.
            up_to_ns = lockstep.await_sight(tick, inboxes.localizer, inboxes.poses, inboxes.obstacles)
            if up_to_ns is None or not lockstep.await_all([(inboxes.states[r], tick.previous_ns) for r in tick.heard_robots]):
                return
            station.recorder.whole_until_ns = tick.previous_ns  # whenever it ends: no step of which some robots are missing
            station.obstacles_up_to_ns = up_to_ns
            yield tick.now_ns
