"""Wrench -> 4 thrusters and 4 ankles -> pulse widths, and back.

    X = sum F_i cos a_i    Z = sum F_i sin a_i    N = -sum y_i F_i cos a_i

for legs in an "H" whose ankles turn in the vertical x-z plane. Per side, front and rear leg carry the same horizontal force
h plus and minus a bias b that cancels out: it keeps small forces clear of the dead zone, and gives the ankles something to
tilt when only heave is asked for. All ankles share one tangent, tan a_i = t g(h_i) with g = -1..1 following the thruster's
sign, so an ankle never turns over when surge reverses. What does not fit gives way in this order: heave, then yaw, then surge.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from shoal.config.vehicle import Vehicle
from shoal.frames import Array
from shoal.kernels.decorator import kernel
from shoal.kernels.types import Floats, Ints, Table

STEEPEST_RAD = math.radians(60.0)  # beyond, most of a thruster's force is spent on cancelling its neighbour
CROSSING_N = 0.03  # g goes from -1 to 1 over +- this horizontal force: an ankle passes level while its thruster reverses


class ThrusterLegs(NamedTuple):
    """Legs of a vehicle: their places, and the limits of their thrusters and ankles."""

    place: Table  # (4, 2): 1 fore or -1 aft, distance to starboard in m
    idle_n: float  # bias of a side that does not push
    ahead_n: float  # greatest force of a thruster ahead,
    astern_n: float  # and in reverse, > 0
    steepest_tan: float  # tangent of the greatest ankle angle


class PulseCurve(NamedTuple):
    """Thrust and ankle angle of each pulse."""

    thrust_n: Floats  # (pulses,), from `slowest_us` on
    between_n: Floats  # (pulses - 1,): halfway between two pulses
    slowest_us: int
    neutral_us: int  # no thrust
    level_us: float  # ankle level
    us_per_rad: float


@kernel(part=True)
def side_bias(legs: ThrusterLegs, lift_n: float, side_n: float) -> float:
    """Bias (N) of a side with the horizontal force `side_n`: what heave needs, `lift_n`, or idle thrust if that is more;
    within the thrust that is left.

    Idle thrust is full while the side pushes less than that itself, and fades to none where it pushes three times as hard.
    """
    idle_n = legs.idle_n
    faded = idle_n * min(1.0, max(0.0, 1.5 - 0.5 * abs(side_n) / idle_n)) if idle_n > 0.0 else 0.0
    room = min(legs.ahead_n - abs(side_n), legs.astern_n - abs(side_n))
    return max(0.0, min(max(lift_n, faded), room))


@kernel(part=True)
def lifting_bias(port: float, starboard: float, heave_n: float, steepest_tan: float) -> float:
    """Bias that both sides need for a heave force at the steepest ankle angle; 0 where surge and yaw are enough.

    A side with force h and bias b gives 2 max(|h|, b) of lever in all, less CROSSING_N / 2 at most for passing level.
    """
    low, high = min(abs(port), abs(starboard)), max(abs(port), abs(starboard))
    need = 0.5 * (heave_n / steepest_tan + CROSSING_N) if heave_n > 0.0 else 0.0
    if need <= low + high:
        return 0.0
    return max(0.0, need - high) if need < 2.0 * high else 0.5 * need


@kernel
def allocate(wrench: Floats, legs: ThrusterLegs, force: Floats, angle: Floats) -> None:
    """Thruster forces (4,) in N and ankle angles (4,) in rad for a wrench (3,): surge first, then yaw, then heave.

    A thruster's level force h is its side's (a quarter of surge, and of yaw over the lever arm), plus a bias that the fore and
    the aft thruster of a side have against one another. Ankles then turn the forces up or down by a common tangent t, with
    a sign and share g = h / CROSSING_N within 1:  heave = t sum(h g),  angle = atan(t g),  force = h sqrt(1 + (t g)^2).
    """
    surge, heave, yaw = wrench[0], wrench[1], wrench[2]
    mean = min(max(0.25 * surge, -legs.astern_n), legs.ahead_n)
    room = min(legs.ahead_n - mean, legs.astern_n + mean)
    turn = min(max(0.25 * yaw / abs(legs.place[0, 1]), -room), room)
    port, starboard = mean + turn, mean - turn
    lift = lifting_bias(port, starboard, abs(heave), legs.steepest_tan)
    bias_port, bias_starboard = side_bias(legs, lift, port), side_bias(legs, lift, starboard)
    lifting_n, spare = 0.0, math.inf
    for i in range(4):
        fore = legs.place[i, 0]
        h = port + bias_port * fore if legs.place[i, 1] < 0.0 else starboard + bias_starboard * fore
        g = min(max(h / CROSSING_N, -1.0), 1.0)
        force[i], angle[i] = h, g
        lifting_n += h * g
        spare = min(spare, (legs.ahead_n if h >= 0.0 else legs.astern_n) / max(abs(h), 1e-9))
    # Heave gives way: the steepest common tangent at which no thruster is asked for more than it has.
    steepest = min(math.sqrt(max(spare * spare - 1.0, 0.0)), legs.steepest_tan)
    t = min(max(heave / lifting_n, -steepest), steepest) if lifting_n > 0.0 else 0.0
    for i in range(4):
        force[i] *= math.sqrt(1.0 + (t * angle[i]) ** 2)
        angle[i] = math.atan(t * angle[i])


@kernel(part=True)
def nearest_pulses(force: Floats, curve: PulseCurve, pulse: Ints) -> None:
    """Pulses in us with the nearest thrust of the curve, one for each force. The smallest thrust lies just outside the dead
    zone; zero force is neutral."""
    for i in range(len(force)):
        pulse[i] = curve.neutral_us
        if force[i] != 0.0:
            pulse[i] = curve.slowest_us + np.searchsorted(curve.between_n, force[i], "right")


@kernel(part=True)
def to_pulses(force: Floats, angle: Floats, curve: PulseCurve, pulse: Ints) -> None:
    """Pulses (8,) in us for four forces and ankle angles: those with the nearest thrust of the curve and the nearest angle."""
    nearest_pulses(force, curve, pulse)
    for i in range(4):
        pulse[4 + i] = int(np.rint(curve.level_us + curve.us_per_rad * angle[i]))


@kernel
def deliver(pulse: Ints, legs: ThrusterLegs, curve: PulseCurve, wrench: Floats, moment: Floats) -> None:
    """Write what pulses (8,) in us give by the module's equations: `wrench` (3,), and each leg's yaw `moment` (4,) in N m."""
    wrench[:] = 0.0
    for i in range(4):
        force = curve.thrust_n[pulse[i] - curve.slowest_us]
        angle = (pulse[4 + i] - curve.level_us) / curve.us_per_rad
        level = force * math.cos(angle)
        moment[i] = -legs.place[i, 1] * level
        wrench[0] += level
        wrench[1] += force * math.sin(angle)
        wrench[2] += moment[i]


@kernel
def allocate_and_deliver(
    wrench: Floats, legs: ThrusterLegs, curve: PulseCurve, work: Table, pulse: Ints, delivered: Floats
) -> None:
    """Write the pulses (8,) in us for a demanded `wrench` (3,), and the wrench that they give, `delivered` (3,). `work` (3, 4)
    is memory."""
    allocate(wrench, legs, work[0], work[1])
    to_pulses(work[0], work[1], curve, pulse)
    deliver(pulse, legs, curve, delivered, work[2])


def pulse_curve(vehicle: Vehicle, level_us: float, us_per_rad: float) -> PulseCurve:
    """Tabulate a vehicle's thrust curve at every whole microsecond, and halfway between two, where the nearest pulse to a
    force changes."""
    curve = vehicle.thruster.curve
    slowest_us = int(curve[0][0])
    pulses_us = np.arange(slowest_us, int(curve[-1][0]) + 1, dtype=np.float64)
    return PulseCurve(
        thrust_n=np.asarray(vehicle.thruster.force_n(pulses_us)),
        between_n=np.asarray(vehicle.thruster.force_n(pulses_us[:-1] + 0.5)),
        slowest_us=slowest_us,
        neutral_us=vehicle.thruster.neutral_us,
        level_us=level_us,
        us_per_rad=us_per_rad,
    )


class Allocator:
    """Allocation for one vehicle with legs. Wrenches are [surge N, heave N, yaw N m]; pulses: 4 thrusters, then 4 ankles."""

    def __init__(self, vehicle: Vehicle) -> None:
        legs, curve = vehicle.legs, vehicle.thruster.curve
        assert legs is not None
        low, high = legs.ankle_us
        level_us = 0.5 * (low + high)
        self.neutral_us = vehicle.neutral_us
        self._legs = ThrusterLegs(
            place=np.array([(1.0 if along > 0.0 else -1.0, across) for along, across in legs.position_m]),
            idle_n=legs.idle_thrust_n,
            ahead_n=min(vehicle.thruster.max_thrust_n, curve[-1][1]),
            astern_n=min(vehicle.thruster.max_thrust_n, -curve[0][1]),
            steepest_tan=math.tan(min(STEEPEST_RAD, legs.ankle_range_rad)),
        )
        self._curve = pulse_curve(vehicle, level_us, 0.5 * (high - low) / legs.ankle_range_rad)
        self._work, self._pulse = np.empty((3, 4)), np.empty(8, np.int64)

    def pulses(self, wrench: Array) -> tuple[int, ...]:
        """Pulse widths (us) for a wrench (3,), as far as the thrusters can deliver it; neutral if it is not finite."""
        return self.allocate(wrench)[0]

    def allocate(self, wrench: Array) -> tuple[tuple[int, ...], Array]:
        """Pulse widths (us) for a wrench (3,), and the part of it (3,) that they give by the nominal thrust curve; neutral if
        it is not finite."""
        if not math.isfinite(sum(wrench.tolist())):
            return self.neutral()
        delivered = np.empty(3)
        allocate_and_deliver(wrench, self._legs, self._curve, self._work, self._pulse, delivered)
        return tuple(self._pulse.tolist()), delivered

    def neutral(self) -> tuple[tuple[int, ...], Array]:
        """Pulse widths with which no thruster turns, and the wrench (3,) that they give."""
        return self.neutral_us, self.delivered(self.neutral_us)[0]

    def delivered(self, pulse_us: tuple[int, ...]) -> tuple[Array, Array]:
        """Wrench (3,) of eight pulse widths by the nominal thrust curve, and the yaw moment of each leg (4,), N m."""
        wrench, moment = np.empty(3), np.empty(4)
        deliver(np.array(pulse_us), self._legs, self._curve, wrench, moment)
        return wrench, moment

    def level_moments(self, pulse_us: tuple[int, ...]) -> tuple[Array, Array]:
        """Yaw moment (4,) that each leg gives with its ankle level, N m, and its ankle's angle (4,), rad, of eight pulse
        widths."""
        pulse, curve = np.array(pulse_us), self._curve
        moment = -self._legs.place[:, 1] * curve.thrust_n[pulse[:4] - curve.slowest_us]
        return moment, (pulse[4:] - curve.level_us) / curve.us_per_rad

    def forces(self, wrench: Sequence[float] | Array) -> tuple[Array, Array]:
        """Four thruster forces in N and ankle angles in rad for a wrench."""
        force, angle, demand = np.empty(4), np.empty(4), np.asarray(wrench, dtype=np.float64)
        allocate(demand, self._legs, force, angle)
        return force, angle
