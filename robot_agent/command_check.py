"""Which orders are taken at all, before anyone asks whether they fit the mode. Pure.

An order counts from the station that is heard now, while it is young, and for the experiment that this robot holds. That it
counts once, and only in the life of this process that it was meant for, is the bus's affair
(wire/transport/command_deduplication.py). STOP and DISARM count always: whoever may command at all (docs/security.md) may take
the power away, at any time.
"""

from dataclasses import dataclass

from wire.messages.codec import Header
from wire.messages.messages import Command
from wire.transport.command_deduplication import ALWAYS_TAKEN

FROM_THE_FUTURE_S = 0.5  # an order may look younger than the heartbeat it is judged by, by no more than this
LONGEST_LIFE_S = 5.0  # whatever time to live its sender gives it: what was meant for then moves nobody now


@dataclass(frozen=True)
class StationView:
    """The station as last heard: its session, what its clock says now, how long ago it was heard, and the formation's pace as
    it was then (wire.messages.messages.StationHeartbeat)."""

    session: int = 0
    clock_ns: int = 0
    age_s: float = float("inf")
    lag_s: float = 0.0
    slowing: float = 0.0


def begins_ns(header: Header, command: Command) -> int:
    """When a START or RESUME counts, on the station's clock: the instant that it names, the same however late it comes."""
    return command.start_ns or header.stamp_ns + round(command.start_in_s * 1e9)


def unacceptable(robot: int, experiment_hash: str, header: Header, command: Command, station: StationView) -> str:
    """Why an order to that robot, which holds that experiment, is not taken; empty if it is."""
    if command.robot != robot:
        return f"is for robot {command.robot}, this is robot {robot}"
    if command.order in ALWAYS_TAKEN:
        return ""
    if header.session != station.session:
        return "does not come from the station that is heard now"
    age_s = (station.clock_ns - header.stamp_ns) * 1e-9
    lives_s = min(command.time_to_live_s, LONGEST_LIFE_S)
    if not -FROM_THE_FUTURE_S <= age_s <= lives_s:
        return f"is {age_s:.3f} s old, lives {lives_s:g} s"
    if command.experiment_hash != experiment_hash:
        return f"is for experiment {command.experiment_hash[:8]}, this robot holds {experiment_hash[:8]}"
    return ""
