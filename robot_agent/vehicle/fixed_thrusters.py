"""Wrench -> thrusters that do not turn -> pulse widths, and back.

    wrench = B force        force = B^+ wrench        B (4, 8): place and direction of the thruster on each output

The pseudo-inverse B^+ gives the forces with the least sum of squares. If one of them is more than its thruster has, all of
them shrink alike: the wrench keeps its direction, so that a robot at its limits still goes where it wants to.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from robot_agent.vehicle.allocation import Allocator, PulseCurve, nearest_pulses, pulse_curve
from shoal.config.vehicle import AXES, OUTPUTS, Vehicle
from shoal.frames import Array
from shoal.kernels.decorator import kernel
from shoal.kernels.types import Floats, Ints, Table

ROUNDED = 1e-12  # of a newton: less is none, and leaves a thruster at neutral


class FixedThrusters(NamedTuple):
    """Thrusters of a vehicle: their directions, and their greatest forces."""

    mixing: Table  # B (4, 8)
    inverse: Table  # B^+ (8, 4)
    ahead_n: float  # greatest force of a thruster ahead,
    astern_n: float  # and in reverse, > 0


@kernel(part=True)
def allocate(wrench: Floats, thrusters: FixedThrusters, force: Floats) -> None:
    """Write to `force` (8,), in N, the thrusters' forces for a wrench (4,). All are scaled down alike where one would
    saturate, so that the wrench keeps its direction."""
    share = 1.0
    for i in range(len(force)):
        force[i] = 0.0
        for k in range(len(wrench)):
            force[i] += thrusters.inverse[i, k] * wrench[k]
        most_n = thrusters.ahead_n if force[i] >= 0.0 else thrusters.astern_n
        share = min(share, most_n / max(abs(force[i]), 1e-9))
    for i in range(len(force)):
        force[i] *= share


@kernel
def deliver(pulse: Ints, thrusters: FixedThrusters, curve: PulseCurve, wrench: Floats, moment: Floats) -> None:
    """Write what pulses (8,) in us give by the thrust curve: `wrench` (4,), and each thruster's yaw `moment` (8,) in N m."""
    wrench[:] = 0.0
    for i in range(len(pulse)):
        force = curve.thrust_n[pulse[i] - curve.slowest_us]
        moment[i] = thrusters.mixing[2, i] * force
        for k in range(len(wrench)):
            wrench[k] += thrusters.mixing[k, i] * force


@kernel
def allocate_and_deliver(
    wrench: Floats, thrusters: FixedThrusters, curve: PulseCurve, work: Table, pulse: Ints, delivered: Floats
) -> None:
    """Write the pulses (8,) in us for a demanded `wrench` (4,), and the wrench that they give, `delivered` (4,). `work` (2, 8)
    is memory."""
    allocate(wrench, thrusters, work[0])
    nearest_pulses(work[0], curve, pulse)
    deliver(pulse, thrusters, curve, delivered, work[1])


class FixedAllocator(Allocator):
    """Allocation for one vehicle with fixed thrusters. Pulses are those of the eight outputs."""

    def __init__(self, vehicle: Vehicle) -> None:
        curve, inverse = vehicle.thruster.curve, np.linalg.pinv(vehicle.mixing)
        self.neutral_us = vehicle.neutral_us
        self._axes = len(vehicle.limits.wrench)
        self._thrusters = FixedThrusters(
            mixing=np.ascontiguousarray(vehicle.mixing),
            inverse=np.ascontiguousarray(np.where(np.abs(inverse) > ROUNDED, inverse, 0.0)),
            ahead_n=min(vehicle.thruster.max_thrust_n, curve[-1][1]),
            astern_n=min(vehicle.thruster.max_thrust_n, -curve[0][1]),
        )
        self._curve = pulse_curve(vehicle, level_us=0.0, us_per_rad=1.0)  # no output is an ankle's
        self._work, self._pulse = np.empty((2, OUTPUTS)), np.empty(OUTPUTS, np.int64)

    def allocate(self, wrench: Array) -> tuple[tuple[int, ...], Array]:
        """See `Allocator`. The wrench is (3,), or (4,) for a vehicle with sway."""
        if not math.isfinite(sum(wrench.tolist())):
            return self.neutral()
        demand, delivered = np.zeros(len(AXES)), np.empty(len(AXES))
        demand[: self._axes] = wrench
        allocate_and_deliver(demand, self._thrusters, self._curve, self._work, self._pulse, delivered)
        return tuple(self._pulse.tolist()), delivered[: self._axes].copy()

    def delivered(self, pulse_us: tuple[int, ...]) -> tuple[Array, Array]:
        """Wrench of eight pulse widths by the nominal thrust curve, and the yaw moment of each thruster (8,), N m."""
        wrench, moment = np.empty(len(AXES)), np.empty(OUTPUTS)
        deliver(np.array(pulse_us), self._thrusters, self._curve, wrench, moment)
        return wrench[: self._axes].copy(), moment

    def level_moments(self, pulse_us: tuple[int, ...]) -> tuple[Array, Array]:
        """Yaw moment of each thruster (8,), N m; no thruster has an ankle that turns."""
        return self.delivered(pulse_us)[1], np.zeros(OUTPUTS)

    def forces(self, wrench: Sequence[float] | Array) -> tuple[Array, Array]:
        """Eight thruster forces in N for a wrench, and an empty array: there are no ankles."""
        self.allocate(np.asarray(wrench, dtype=np.float64))
        return self._work[0].copy(), np.zeros(0)


def make_allocator(vehicle: Vehicle) -> Allocator:
    """The allocation of a vehicle's thrusters."""
    return Allocator(vehicle) if vehicle.legs is not None else FixedAllocator(vehicle)
