"""Which orders are taken at all, before anyone asks whether they fit the mode. Pure.

An order counts once, from the station that is heard now, while it is young, and for the experiment that this robot holds.
Recorded traffic played back fails on the session or on the age; a repeated order gets the same answer and no second effect.
"""

from dataclasses import dataclass

from wire.codec import Header
from wire.messages import Command, Mode, Order, Reply

FROM_THE_FUTURE_S = 0.5  # an order may look younger than the heartbeat it is judged by, by no more than this
ALWAYS_SAFE = frozenset({Order.STOP, Order.DISARM})  # whatever experiment they name: they only take power away


@dataclass(frozen=True)
class StationView:
    """The station as last heard: its session, what its clock says now, and how long ago it was heard."""

    session: int = 0
    clock_ns: int = 0
    age_s: float = float("inf")


class OrderGate:
    """Remembers what has been taken."""

    def __init__(self, robot: int, experiment_hash: str) -> None:
        self._robot, self._hash = robot, experiment_hash
        self._session = 0
        self._sequence = 0
        self._answered: Reply | None = None

    def repeated(self, header: Header) -> Reply | None:
        """The answer this very order got before, if it did."""
        same = (header.session, header.sequence) == (self._session, self._sequence)
        return self._answered if same else None

    def refusal(self, header: Header, command: Command, station: StationView) -> str:
        """Why the order is not taken; empty if it is."""
        if command.robot != self._robot:
            return f"is for robot {command.robot}, this is robot {self._robot}"
        if header.session != station.session:
            return "does not come from the station that is heard now"
        if header.session == self._session and header.sequence <= self._sequence:
            return f"is old: order {header.sequence} after {self._sequence}"
        age_s = (station.clock_ns - header.stamp_ns) * 1e-9
        if not -FROM_THE_FUTURE_S <= age_s <= command.time_to_live_s:
            return f"is {age_s:.3f} s old, lives {command.time_to_live_s:g} s"
        if command.order not in ALWAYS_SAFE and command.experiment_hash != self._hash:
            return f"is for experiment {command.experiment_hash[:8]}, this robot holds {self._hash[:8]}"
        return ""

    def take(self, header: Header, accepted: bool, reason: str, mode: Mode) -> Reply:
        """Note an order as dealt with, and form its answer."""
        self._session, self._sequence = header.session, header.sequence
        self._answered = Reply(self._robot, accepted, reason, mode)
        return self._answered
