"""Commands that went out to a board, and what of them acts: after the thrusters' dead time, with their lag. Pure."""

import math
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from wire.config.vehicle import Thruster
from wire.frames import Array
from wire.kernels import kernel

NS = 1_000_000_000


class SentCommands:
    """The newest commands, each with its instant, in order."""

    def __init__(self, columns: int, kept: int, kind: Any = np.float64) -> None:
        """`kept` commands are remembered at most, and half of them at least; their numbers are of a `kind` (NumPy)."""
        self.at_ns, self.told = np.zeros(kept, np.int64), np.zeros((kept, columns), kind)
        self.count = 0

    def note(self, told: ArrayLike, at_ns: int) -> None:
        """Take note of a command (columns,). Of two at one instant the last counts."""
        if not self.count or self.at_ns[self.count - 1] != at_ns:
            if self.count == len(self.at_ns):
                self.count //= 2
                for column in (self.at_ns, self.told):
                    column[: self.count] = column[-self.count :]
            self.count += 1
        self.at_ns[self.count - 1], self.told[self.count - 1] = at_ns, told


@kernel("void(i8[::1], f8[:,::1], i8, f8, i8, i8, f8[::1], f8[::1])")
def follow_commands(
    acts_ns: NDArray[np.int64],
    told: Array,
    count: int,
    lag_s: float,
    from_ns: int,
    to_ns: int,
    acting: Array,
    impulse: Array,
) -> None:
    """Let the forces or moments `acting` (columns,) follow the first `count` of the commands `told` (n, columns), each from
    its instant `acts_ns` on and zero before the first, with the thrusters' lag. `impulse` (columns,) is their integral."""
    impulse[:] = 0.0
    for i in range(-1, count):
        begin_ns = max(acts_ns[i], from_ns) if i >= 0 else from_ns
        end_ns = min(acts_ns[i + 1], to_ns) if i + 1 < count else to_ns
        if end_ns > begin_ns:
            span_s = (end_ns - begin_ns) / NS
            left = math.exp(-span_s / lag_s) if lag_s > 0.0 else 0.0
            for column in range(len(acting)):
                wanted = told[i, column] if i >= 0 else 0.0
                behind = acting[column] - wanted
                impulse[column] += wanted * span_s + behind * lag_s * (1.0 - left)
                acting[column] = wanted + behind * left


class ActingThrust:
    """Forces or moments of commands that went out, as they act."""

    def __init__(self, columns: int, kept: int, thruster: Thruster) -> None:
        """`kept`: see `SentCommands`."""
        self._sent, self._lag_s = SentCommands(columns, kept), thruster.lag_s
        self._dead_ns = round(thruster.dead_time_s * NS)
        self._acting, self._impulse = np.zeros(columns), np.zeros(columns)

    def note(self, told: ArrayLike, now_ns: int) -> None:
        """Take note of what pulses that went out at `now_ns` should give, (columns,)."""
        self._sent.note(told, now_ns + self._dead_ns)

    def impulse(self, from_ns: int, to_ns: int) -> Array:
        """Integral (columns,) of what acted between two instants, N s or N m s; valid until the next call, which must go on
        from there."""
        sent = self._sent
        follow_commands(sent.at_ns, sent.told, sent.count, self._lag_s, from_ns, to_ns, self._acting, self._impulse)
        return self._impulse
