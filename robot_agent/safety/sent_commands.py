"""Commands that went out to a board, and what of them acts: after the thrusters' dead time, with their lag. Pure.

An ankle turns at a limited rate. One that turns over, from down to up while its thruster reverses, is level on the way and
turns the hull with up to twice what was commanded: 0.4 s for the article's robot.
"""

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from shoal.config.vehicle import Thruster, Vehicle
from shoal.frames import Array
from shoal.kernels.decorator import kernel
from shoal.kernels.types import Floats, Ints, Table

NS = 1_000_000_000
FINE_NS = 10_000_000  # within which an ankle counts as turning straight: 0.05 rad at 300 degrees/s


class SentCommands:
    """The newest commands, each with its instant, in order."""

    def __init__(self, columns: int, kept: int, kind: Any = np.float64) -> None:
        """`kept` commands are remembered at most, and half of them at least; their numbers are of a `kind` (NumPy)."""
        self.at_ns, self.commands = np.zeros(kept, np.int64), np.zeros((kept, columns), kind)
        self.count = 0

    def note(self, command: ArrayLike, at_ns: int) -> None:
        """Take note of a command (columns,). Of two at one instant the last counts."""
        if not self.count or self.at_ns[self.count - 1] != at_ns:
            if self.count == len(self.at_ns):
                self.count //= 2
                for column in (self.at_ns, self.commands):
                    column[: self.count] = column[-self.count :]
            self.count += 1
        self.at_ns[self.count - 1], self.commands[self.count - 1] = at_ns, command


@kernel
def follow_commands(
    acts_ns: Ints, commands: Table, count: int, lag_s: float, from_ns: int, to_ns: int, acting: Floats, impulse: Floats
) -> None:
    """Let the forces or moments `acting` (columns,) follow the first `count` of the `commands` (n, columns), each from
    its instant `acts_ns` on and zero before the first, with the thrusters' lag. `impulse` (columns,) is their integral."""
    impulse[:] = 0.0
    for i in range(-1, count):
        begin_ns = max(acts_ns[i], from_ns) if i >= 0 else from_ns
        end_ns = min(acts_ns[i + 1], to_ns) if i + 1 < count else to_ns
        if end_ns > begin_ns:
            span_s = (end_ns - begin_ns) / NS
            factor = math.exp(-span_s / lag_s) if lag_s > 0.0 else 0.0
            for column in range(len(acting)):
                target = commands[i, column] if i >= 0 else 0.0
                behind = acting[column] - target
                impulse[column] += target * span_s + behind * lag_s * (1.0 - factor)
                acting[column] = target + behind * factor


class ActingThrust:
    """Forces or moments of commands that went out, as they act."""

    def __init__(self, columns: int, kept: int, thruster: Thruster) -> None:
        """`kept`: see `SentCommands`."""
        self._sent, self._lag_s = SentCommands(columns, kept), thruster.lag_s
        self._dead_ns = round(thruster.dead_time_s * NS)
        self._acting, self._impulse = np.zeros(columns), np.zeros(columns)

    def note(self, command: ArrayLike, now_ns: int) -> None:
        """Take note of what pulses that went out at `now_ns` should give, (columns,)."""
        self._sent.note(command, now_ns + self._dead_ns)

    def impulse(self, from_ns: int, to_ns: int) -> Array:
        """Integral (columns,) of what acted between two instants, N s or N m s; valid until the next call, which must go on
        from there."""
        sent = self._sent
        follow_commands(sent.at_ns, sent.commands, sent.count, self._lag_s, from_ns, to_ns, self._acting, self._impulse)
        return self._impulse


class CommandRows(NamedTuple):
    """The first `rows` of commands, from their instants on."""

    at_ns: Ints
    commands: Table
    rows: int


@kernel(part=True)
def turn_ankles(ankles: CommandRows, rate_radps: float, from_ns: int, to_ns: int, angle: Floats) -> None:
    """Let ankles turn from `angle` (legs,), rad, to what they are commanded; before the first command to level."""
    for i in range(-1, ankles.rows):
        begin_ns = max(ankles.at_ns[i], from_ns) if i >= 0 else from_ns
        end_ns = min(ankles.at_ns[i + 1], to_ns) if i + 1 < ankles.rows else to_ns
        if end_ns > begin_ns:
            reach_rad = rate_radps * (end_ns - begin_ns) / NS
            for leg in range(len(angle)):
                target_rad = ankles.commands[i, leg] if i >= 0 else 0.0
                angle[leg] += min(max(target_rad - angle[leg], -reach_rad), reach_rad)


@kernel
def follow_legs(
    thrust: CommandRows,
    ankles: CommandRows,
    lag_s: float,
    rate_radps: float,
    span_ns: tuple[int, int],
    work: Table,
    impulse: Floats,
) -> None:
    """Let what legs would give with their ankles level, `work[0]`, and their ankles, `work[1]`, follow their commands between
    the two instants of `span_ns`. `impulse` (legs,) is the integral of the product with the angle's cosine. `work` (4, legs)
    goes on from call to call."""
    acting, angle, level_impulse, cosine_before = work[0], work[1], work[2], work[3]
    impulse[:] = 0.0
    begin_ns, to_ns = span_ns
    while begin_ns < to_ns:
        end_ns = min(begin_ns + FINE_NS, to_ns)
        follow_commands(thrust.at_ns, thrust.commands, thrust.rows, lag_s, begin_ns, end_ns, acting, level_impulse)
        for leg in range(len(impulse)):
            cosine_before[leg] = math.cos(angle[leg])
        turn_ankles(ankles, rate_radps, begin_ns, end_ns, angle)
        for leg in range(len(impulse)):
            impulse[leg] += level_impulse[leg] * 0.5 * (cosine_before[leg] + math.cos(angle[leg]))
        begin_ns = end_ns


class ActingLegs:
    """Yaw moments of legs, or of thrusters without ankles, as they act."""

    def __init__(self, kept: int, vehicle: Vehicle) -> None:
        """`kept`: see `SentCommands`."""
        count, legs = vehicle.thruster_count, vehicle.legs
        self._level, self._ankles = SentCommands(count, kept), SentCommands(count, kept)
        self._lag_s, self._rate_radps = vehicle.thruster.lag_s, legs.ankle_rate_radps if legs is not None else 0.0
        self._dead_ns = round(vehicle.thruster.dead_time_s * NS)
        self._ankle_dead_ns = round(legs.ankle_dead_time_s * NS) if legs is not None else 0
        self._work, self._impulse = np.zeros((4, count)), np.zeros(count)

    def note(self, level_nm: ArrayLike, ankles_rad: ArrayLike, now_ns: int) -> None:
        """Take note of pulses that went out: what each leg should give with its ankle level, and its ankle's angle."""
        self._level.note(level_nm, now_ns + self._dead_ns)
        self._ankles.note(ankles_rad, now_ns + self._ankle_dead_ns)

    def impulse(self, from_ns: int, to_ns: int) -> Array:
        """Integral (legs,) of the moments between two instants, N m s; valid until the next call, which must go on from
        there."""
        level, ankles = (CommandRows(sent.at_ns, sent.commands, sent.count) for sent in (self._level, self._ankles))
        follow_legs(level, ankles, self._lag_s, self._rate_radps, (from_ns, to_ns), self._work, self._impulse)
        return self._impulse
