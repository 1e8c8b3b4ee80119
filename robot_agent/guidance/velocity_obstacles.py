"""Right of way by velocity obstacles: the reference leaves the path where it would lead into a robot or an obstacle.

Half-spaces (36) keep robots apart but cannot part two that want to run through one another. Head on they stop 2R apart and
push for ever, and no plan shows a way out (to first order, a robot at rest does not move sideways by turning). So the robot
follows a point. The point is on the reference while that is free, and takes another velocity while it is not (sampled velocity
obstacles, Fiorini and Shiller 1998, with a side rule as in COLREG):

* A velocity is free if it passes every robot and obstacle by 2R + `room_m` within `look_ahead_s`, if they move on as told.
* The path is left if its straight line is not free, and its way, bends and stops included, meets another robot: on the way
  that it has told if that ends at rest, else straight on. (A robot that meets others gives up a way that only turns: with
  those counted too, robots of the scene `swap` went twice as far around.)
* Of two robots that cross, the one that has the other to starboard gives way, and the other counts on it for half of that
  time. A robot that is overtaken goes on as before; so does one with an urgent task, among robots without one.
* Two robots that meet leave one another to port (they keep to starboard), unless they are already well on the other side.
  The side is that of the relative motion, which both see alike whichever turns first. At obstacles the shorter way counts.
* A robot that cannot give way, without thrust for example, is an obstacle that moves.
* Of the free velocities the nearest to the wanted one is taken, changing steadily, without hurry.

Then the point returns to the reference, as fast as its `Agility` allows, braking before it: no overshoot. Robots in formation
have the same velocity, never meet, and get back the very reference they came with.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from robot_agent.guidance.formation import MEANT_S, WALL_M, WAY_STEP_S, WAY_STEPS, NeighbourPredictions
from robot_agent.guidance.obstacles import Obstacle
from robot_agent.guidance.reference import Reference
from shoal.config.vehicle import Vehicle
from shoal.frames import Array
from shoal.kernels.decorator import kernel
from shoal.kernels.types import Bools, Complexes, ComplexTable, Floats, Table

SURE_S = 0.2  # a conflict lasts so long before the reference is left,
SURE_STEPS = 2  # and so many steps at least: neighbours that start a step before their plan says so are no conflict
SLIGHTEST_MPS = 0.01  # a slower approach is no conflict: robots in formation sway that fast
PARTING = 0.999  # of the present distance: robots closer than allowed may take any velocity that leads no closer
WELL_CLEAR = 0.5  # of the distance to keep: a robot that passes so far on the other side stays on it
ABAFT = -0.38  # cosine of 112.5 degrees from ahead: a robot from there overtakes, and has to keep clear
HEAD_ON = -0.9  # cosine between courses that are so opposite that both give way; 0.9: so alike that one overtakes
STANDS_ON = 0.5  # of the time to look ahead, and of the room: for a robot that should have given way
CATCH_UP = 0.5  # of the reference's speed, on top of it, to return with, if `Agility.catch_up_mps` is less
UNHURRIED_MPS = 0.06  # likewise while something is in the way: a robot that hurries then takes a long way round
AT_END = 0.5  # of `Agility.fastest_mps`: likewise when the reference rests. At 6 cm/s two beside a third took a minute
FASTEST_SHARE = 0.8  # of the vehicle's speed: the rest is for what the robot has to correct
LEASH_M = 0.25  # the point waits for a robot that is held up
ARRIVED_M, ARRIVED_MPS = 0.02, 0.02  # the controller corrects as much by itself
WALL_S = 3.0  # a velocity is not taken if in this time it leads closer to a wall than WALL_M beyond the hull
STILL = 1e-12  # (m/s)^2: keeps 0/0 out


class Agility(NamedTuple):
    """Motion that is allowed to a point that a robot follows, and how far it looks ahead."""

    room_m: float  # beyond what the half-spaces keep, so that these need not act
    look_ahead_s: float  # with 8 s, two robots at 0.1 m/s begin to turn 1.6 m before they would touch
    fastest_mps: float
    change_mps2: float  # of its velocity
    return_per_s: float  # velocity towards the reference, per distance from it,
    catch_up_mps: float  # and the most of it, on top of the reference's own


@kernel(part=True)
def dot(a: complex, b: complex) -> float:
    """Scalar product of two vectors x + iy."""
    return a.real * b.real + a.imag * b.imag


@kernel(part=True)
def cross(a: complex, b: complex) -> float:
    """|a| times the distance of b to starboard of the direction a; negative to port."""
    return a.real * b.imag - a.imag * b.real


class Traffic(NamedTuple):
    """Robots and obstacle points to be avoided, k in number, at this instant, as complex numbers x + iy."""

    place: Complexes  # (k,) m
    velocity: Complexes  # (k,) m/s, that they mean to have
    keep_m: Floats  # (k,) distances to stay away; 0: it is not in the way
    yields: Bools  # (k,) robots that follow this rule too, and of which each hears the other
    way: ComplexTable  # (k, WAY_STEPS) ways that they mean to go, WAY_STEP_S apart, from where they are

    def joined(self, other: "Traffic") -> "Traffic":
        """Return both together."""
        return Traffic(*(np.concatenate(both) for both in zip(self, other, strict=True)))


def straight_ways(velocity: Complexes) -> ComplexTable:
    """Ways (k, WAY_STEPS) straight on at velocities (k,)."""
    return np.outer(velocity, WAY_STEP_S * np.arange(1, WAY_STEPS + 1)).astype(np.complex128)


NOBODY = Traffic(
    np.zeros(0, np.complex128), np.zeros(0, np.complex128), np.zeros(0), np.zeros(0, bool), straight_ways(np.zeros(0, complex))
)  # fmt: skip


@kernel
def set_horizons(
    place: complex, wanted: complex, agility: Agility, traffic: Traffic, within_s: Floats, keep_m: Floats
) -> None:
    """Write for how long ahead traffic (k,) counts for a robot that wants to go at a velocity, 0: not at all; and at what
    distance.

    A robot that comes from behind on its own way forward overtakes, and keeps clear of us. One that crosses from port gives
    way too. It counts only when it should have done so by now, and not if it passes as near as it means to, give or take half
    of the room. What is to be passed at no distance is not in the way.
    """
    for i in range(len(within_s)):
        away, going = traffic.place[i] - place, traffic.velocity[i]
        astern = dot(away, wanted) < ABAFT * abs(away) * abs(wanted)
        overtaken = -dot(away, going) < ABAFT * abs(away) * abs(going)
        head_on = dot(wanted, going) < HEAD_ON * abs(wanted) * abs(going)
        from_port = cross(wanted, going) > 0.0 and not head_on and not overtaken
        within_s[i], keep_m[i] = agility.look_ahead_s if traffic.keep_m[i] > 0.0 else 0.0, traffic.keep_m[i]
        if traffic.yields[i] and astern and dot(going, wanted) > 0.0:
            within_s[i] = 0.0
        elif traffic.yields[i] and from_port:
            within_s[i] *= STANDS_ON
            keep_m[i] -= (1.0 - STANDS_ON) * agility.room_m


@kernel(part=True)
def nearest_allowed_m(keep_m: float, apart_m: float) -> float:
    """Nearest distance allowed to something that is `apart_m` away now, and has to stay `keep_m` away."""
    return min(keep_m, PARTING * apart_m)


@kernel
def closes_in(place: complex, velocity: complex, traffic: Traffic, within_s: Floats) -> bool:
    """True if straight lines at these velocities lead nearer to any traffic (k,) than allowed, each within its time (k,)."""
    for i in range(len(within_s)):
        apart, closing = traffic.place[i] - place, velocity - traffic.velocity[i]
        square, towards = dot(closing, closing), dot(apart, closing)
        if within_s[i] > 0.0 and square >= SLIGHTEST_MPS**2 and towards > 0.0:
            time_s = min(towards / square, within_s[i])
            if abs(apart - closing * time_s) < nearest_allowed_m(traffic.keep_m[i], abs(apart)):
                return True
    return False


@kernel
def homing_velocity(goal: complex, speed: complex, point: complex, agility: Agility) -> complex:
    """Velocity that leads a point back to its goal, which moves at `speed`."""
    back = agility.return_per_s * (goal - point)
    limit = min(max(CATCH_UP * abs(speed), agility.catch_up_mps), math.sqrt(agility.change_mps2 * abs(goal - point)))
    velocity = speed + back * min(1.0, limit / max(abs(back), limit, STILL))
    return velocity * min(1.0, agility.fastest_mps / max(abs(velocity), agility.fastest_mps))


@kernel
def changed(velocity: complex, to: complex, most: float) -> complex:
    """Velocity changed towards `to` by at most `most`."""
    difference = to - velocity
    return to if abs(difference) <= most else velocity + difference * (most / abs(difference))


@kernel
def look_ahead(eta: Table, velocity: Table, times_s: Floats, point: complex, agility: Agility, ahead: Complexes) -> None:
    """Displacements of a point on its return to a reference, WAY_STEP_S apart, into `ahead`. The reference (rows, 4) at
    `times_s` (rows,) goes straight on after its end."""
    last, start, row = len(times_s) - 1, point, 0
    before = complex(eta[0, 0], eta[0, 1])
    for i in range(len(ahead)):
        time_s = (i + 1) * WAY_STEP_S
        while row < last and times_s[row + 1] <= time_s:
            row += 1
        beyond_s, share, after = time_s - times_s[row], 0.0, row
        if row < last:
            after = row + 1
            share, beyond_s = beyond_s / (times_s[after] - times_s[row]), 0.0
        goal = complex(
            eta[row, 0] + share * (eta[after, 0] - eta[row, 0]) + beyond_s * velocity[last, 0],
            eta[row, 1] + share * (eta[after, 1] - eta[row, 1]) + beyond_s * velocity[last, 1],
        )
        point += WAY_STEP_S * homing_velocity(before, (goal - before) / WAY_STEP_S, point, agility)
        before = goal
        ahead[i] = point - start


@kernel
def find_meetings(place: complex, ahead: Complexes, traffic: Traffic, within_s: Floats, meets: Bools) -> bool:
    """Find the traffic (k,) that the way `ahead` (steps,) `meets`, each within its time (k,). True if any."""
    any_meets = False
    for i in range(len(within_s)):
        away, meets[i] = traffic.place[i] - place, False
        nearest_m = nearest_allowed_m(traffic.keep_m[i], abs(away))
        for k in range(min(len(ahead), round(within_s[i] / WAY_STEP_S))):
            meets[i] |= abs(away + traffic.way[i, k] - ahead[k]) < nearest_m
        any_meets |= meets[i]
    return any_meets


class Basin(NamedTuple):
    """Walls and islands, for a robot's centre."""

    half_x_m: float
    half_y_m: float
    islands: Complexes  # (k,)
    keep_m: Floats  # (k,) distances to stay away from them


@kernel(part=True)
def leads_into_wall(place: complex, way: complex, basin: Basin) -> bool:
    """True if the velocity `way` leads within WALL_S beyond the walls, or too close to an island. A robot that is there
    already may go no further in."""
    ahead = place + way * WALL_S
    into = abs(ahead.real) > max(basin.half_x_m, abs(place.real)) or abs(ahead.imag) > max(basin.half_y_m, abs(place.imag))
    for i in range(len(basin.keep_m)):
        away = basin.islands[i] - place
        time_s = min(max(dot(away, way) / max(dot(way, way), STILL), 0.0), WALL_S)
        into |= abs(away - way * time_s) < nearest_allowed_m(basin.keep_m[i], abs(away))
    return into


class Fan(NamedTuple):
    """Velocities to choose from, as multiples of the wanted one, and the price of each."""

    turn: Complexes
    price: Floats


def make_fan() -> Fan:
    """Turns to both sides at three paces, and standing still. That is as bad as a turn by 115 degrees: if robots would rather
    wait than turn, four of them wait for one another. Of two ways equally long, the one to starboard."""
    angles, paces = np.radians(np.arange(-150.0, 151.0, 7.5)), np.array([1.0, 0.7, 0.4])
    price = 2.0 * (1.0 - paces)[:, None] + np.abs(angles) + 1e-3 * (angles < 0.0)
    return Fan(np.append(np.outer(paces, np.exp(1j * angles)), 0.0), np.append(price, 2.0))


class Motion(NamedTuple):
    """Place of a robot, the velocities that it wants and has, and that of its reference if it overtakes, else 0."""

    place: complex
    wanted: complex
    velocity: complex
    pace: complex


@kernel(part=True)
def worst_pass(motion: Motion, way: complex, traffic: Traffic, within_s: Floats, sided: Bools) -> float:
    """Badness of the velocity `way` among the traffic (k,): 0 if it passes all at their distances and `sided` robots on the
    right side, 1 through the middle of one, or on the wrong side."""
    worst = 0.0
    for i in range(len(within_s)):
        if within_s[i] == 0.0:
            continue
        going = traffic.velocity[i]
        away, closing, now = traffic.place[i] - motion.place, way - going, motion.velocity - going
        nearest_m = nearest_allowed_m(traffic.keep_m[i], abs(away))
        # a robot that is left well to starboard may stay there; all others are left to port
        starboard = cross(now, away) > WELL_CLEAR * nearest_m * abs(now)
        if sided[i] and (cross(closing, away) < 0.0 if starboard else cross(closing, away) > 0.0):
            worst = 1.0
        elif dot(away, closing) > 0.0:
            time_s = min(dot(away, closing) / max(dot(closing, closing), STILL), within_s[i])
            worst = max(worst, 1.0 - abs(away - closing * time_s) / nearest_m)
    return worst


@kernel
def nearest_free(motion: Motion, traffic: Traffic, within_s: Floats, sided: Bools, fan: Fan, basin: Basin) -> complex:
    """The cheapest velocity of a fan that passes all traffic; if none does, the one that keeps farthest away. A change from
    the present velocity costs. A robot that overtakes goes along its path no faster than its reference, or the wanted
    velocity: it would run ahead of it, and circle around the other robot on its way back."""
    least, best, along = np.inf, motion.wanted, motion.pace / max(abs(motion.pace), STILL)
    most = max(dot(motion.wanted, along), abs(motion.pace))
    for n in range(len(fan.price)):
        way = motion.wanted * fan.turn[n]
        way -= max(dot(way, along) - most, 0.0) * along
        worst = worst_pass(motion, way, traffic, within_s, sided)
        if leads_into_wall(motion.place, way, basin):
            worst = 1.0
        cost = 100.0 * worst + fan.price[n] + 0.3 * abs(way - motion.velocity) / abs(motion.wanted)
        if cost < least:
            least, best = cost, way
    return best


@kernel
def path_out(
    point: complex, velocity: complex, course: complex, change_mps2: float, times_s: Floats, eta: Table, rate: Table
) -> None:
    """Places into `eta` (rows, 4) and velocities into `rate` (rows, 4) of a point that changes to the velocity `course`."""
    for k in range(len(times_s)):
        going = changed(velocity, course, change_mps2 * times_s[k])
        if k > 0:
            point += going * (times_s[k] - times_s[k - 1])
        eta[k, 0], eta[k, 1], rate[k, 0], rate[k, 1] = point.real, point.imag, going.real, going.imag


@kernel
def path_back(point: complex, velocity: complex, agility: Agility, times_s: Floats, eta: Table, rate: Table) -> None:
    """The same of a point that returns to the reference, which `eta` and `rate` hold before."""
    for k in range(len(times_s)):
        goal, speed = complex(eta[k, 0], eta[k, 1]), complex(rate[k, 0], rate[k, 1])
        eta[k, 0], eta[k, 1], rate[k, 0], rate[k, 1] = point.real, point.imag, velocity.real, velocity.imag
        if k < len(times_s) - 1:
            step_s = times_s[k + 1] - times_s[k]
            velocity = changed(velocity, homing_velocity(goal, speed, point, agility), agility.change_mps2 * step_s)
            point += velocity * step_s


def robot_traffic(predictions: NeighbourPredictions, keep_m: Array, room_m: float, depth_m: float, urgent: bool) -> Traffic:
    """The other robots from their plans, each at a distance (k,) and room. Not in the way are robots as far below or above
    `depth_m`, and, if `urgent`, robots that must give way to us: those that can, and have no urgent task.

    A robot that cannot give way is an obstacle that moves: either side of it will do, and whoever it overtakes makes room."""
    yields = np.array([other.can_yield for other in predictions.neighbours], bool)
    is_urgent = np.array([other.plan.urgent for other in predictions.neighbours], bool)
    in_way = (np.abs(predictions.depth_now - depth_m) < keep_m) & ~(urgent & yields & ~is_urgent)
    distance_m = np.where(in_way, keep_m + room_m, 0.0)
    intended, rests_m = predictions.intended_way, SLIGHTEST_MPS * WAY_STEP_S
    rests = np.abs(intended[:, -1] - intended[:, -2]) < rests_m  # at its end
    way = np.where(rests[:, None], intended, straight_ways(predictions.intended_velocity))
    return Traffic(predictions.place_now, predictions.intended_velocity, distance_m, yields, way)


def obstacle_traffic(obstacle: Obstacle, place: complex, agility: Agility, now_ns: int) -> Traffic:
    """Edge points of an obstacle; none if it is too far away to be met."""
    moved, keep_m = obstacle.displacement(now_ns), obstacle.clearance_m + agility.room_m
    reach_m = obstacle.reach_m + keep_m + agility.look_ahead_s * (abs(obstacle.velocity) + agility.fastest_mps)
    if abs(obstacle.centre + moved - place) > reach_m:
        return NOBODY
    count = len(obstacle.edge_points)
    velocity = np.full(count, obstacle.velocity)
    return Traffic(
        obstacle.edge_points + moved, velocity, np.full(count, keep_m), np.zeros(count, bool), straight_ways(velocity)
    )  # fmt: skip


class GiveWay:
    """The point that one robot follows, with its memory."""

    def __init__(
        self,
        vehicle: Vehicle,
        times_s: Array,
        period_s: float,
        agility: Agility,
        room_m: tuple[float, float] | None = None,
        islands: Sequence[Obstacle] = (),
        urgent: bool = False,
    ) -> None:
        """`times_s` (rows,) are the instants of a reference's rows from now, `room_m` the pool's length and width. `urgent`:
        others give way to this robot."""
        self._times_s, self._period_s, self._urgent = times_s, period_s, urgent
        self._sure_steps = max(SURE_STEPS, round(SURE_S / period_s))
        self.agility = agility
        self._look_steps = round(self.agility.look_ahead_s / WAY_STEP_S)
        half = np.array(room_m if room_m is not None else (math.inf, math.inf)) / 2.0
        half_x_m, half_y_m = (half - vehicle.radius_m - WALL_M).tolist()
        self._basin = Basin(
            half_x_m,
            half_y_m,
            np.array([island.centre for island in islands], np.complex128),
            np.array([island.clearance_m + WALL_M for island in islands]),
        )
        self._fan = make_fan()
        self._second = min(int(np.searchsorted(times_s, MEANT_S - 1e-9)), len(times_s) - 1)  # a horizon may be shorter
        self._second_s = float(times_s[self._second])
        self.reset()

    def reset(self) -> None:
        """Go back to the reference at once."""
        self._point: complex | None = None  # None: on the reference
        self._velocity = 0j
        self._met = 0  # consecutive steps with a conflict
        self.path_is_blocked = False  # it avoids what it would meet on its path too
        self.avoids = False  # something is in its way; False on the way back

    def way_around(
        self,
        reference: Reference,
        eta: Array,
        predictions: NeighbourPredictions,
        keep_m: Array,
        obstacles: Sequence[Obstacle],
        now_ns: int,
    ) -> Reference:
        """Return the reference to follow instead, for a robot at `eta` (4,) among obstacles and the other robots, each at a
        distance (k,) to keep; `reference` itself if nothing is in its way."""
        x, y, depth_m, _ = eta.tolist()
        place, room_m, traffic = complex(x, y), self.agility.room_m, NOBODY
        if predictions.neighbours:
            traffic = robot_traffic(predictions, keep_m, room_m, depth_m, self._urgent)
        for obstacle in obstacles:
            traffic = traffic.joined(obstacle_traffic(obstacle, place, self.agility, now_ns))
        return self.avoidance_path(reference, place, traffic)

    def avoidance_path(self, reference: Reference, place: complex, traffic: Traffic) -> Reference:
        """Return the reference to follow instead, for a robot at `place`; `reference` itself if it is free."""
        self.path_is_blocked = self.avoids = False
        if self._point is None:
            self._met = self._met + 1 if self._conflicts(reference, place, traffic) else 0
            if self._met < self._sure_steps:
                return reference
        begin, speed = (
            complex(reference.eta[0, 0], reference.eta[0, 1]),
            complex(reference.velocity[0, 0], reference.velocity[0, 1]),
        )
        self.path_is_blocked = self._conflicts(reference, begin, traffic)
        on_path = self._point is None
        if self._point is None:
            self._point, self._velocity = begin, speed
        wanted = homing_velocity(begin, speed, self._point, self.agility)
        course = self._avoiding_velocity(reference, place, wanted, traffic)
        if on_path and course is None:  # the path itself bends away
            self.reset()
            return reference
        self.avoids = course is not None
        if course is not None:  # do not run away from a robot that cannot follow
            away = self._point - place
            self._point = place + away * min(1.0, LEASH_M / max(abs(away), LEASH_M))
        led = self._led_reference(reference, course, wanted)
        if course is None and self._is_back(reference):
            self.reset()
        return led

    # --- conflicts

    def _conflicts(self, reference: Reference, place: complex, traffic: Traffic) -> bool:
        """True if the straight line of the coming second, extended, leads too close to any traffic."""
        if not len(traffic.place):
            return False
        x_m, y_m = (reference.eta[self._second, :2] - reference.eta[0, :2]).tolist()
        velocity = complex(x_m, y_m) / self._second_s
        if abs(velocity) < SLIGHTEST_MPS:
            return False
        return bool(closes_in(place, velocity, *self._with_horizons(place, velocity, traffic)))

    def _with_horizons(self, place: complex, wanted: complex, traffic: Traffic) -> tuple[Traffic, Array]:
        """The traffic with the distances to keep, and the time ahead (k,), in s, within which each of it is avoided. A robot
        that has left its path keeps the full distances: at less, the other robot would give way too."""
        within_s, keep_m = np.empty((2, len(traffic.place)))
        set_horizons(place, wanted, self.agility, traffic, within_s, keep_m)
        return traffic._replace(keep_m=keep_m) if self._point is None else traffic, within_s

    def _avoiding_velocity(self, reference: Reference, place: complex, wanted: complex, traffic: Traffic) -> complex | None:
        """Velocity that avoids the traffic which the point would meet on its way; None if it would meet none. The way back is
        flown without hurry, and a robot that overtakes all that it meets keeps to its reference's pace."""
        if abs(wanted) < SLIGHTEST_MPS or not len(traffic.place):
            return None
        assert self._point is not None
        traffic, within_s = self._with_horizons(place, wanted, traffic)
        ahead, meets = np.empty(self._look_steps, np.complex128), np.empty(len(within_s), bool)
        look_ahead(reference.eta, reference.velocity, self._times_s, self._point, self.agility, ahead)
        if not find_meetings(place, ahead, traffic, within_s, meets):
            return None
        own = complex(*reference.velocity[0, :2].tolist())
        own_mps = abs(own)
        unhurried_mps = own_mps + max(CATCH_UP * own_mps, UNHURRIED_MPS)
        if own_mps < SLIGHTEST_MPS:
            unhurried_mps = AT_END * self.agility.fastest_mps
        wanted *= min(1.0, unhurried_mps / abs(wanted))
        theirs, theirs_mps = traffic.velocity[meets], np.abs(traffic.velocity[meets])
        overtakes = (theirs_mps < own_mps) & ((own.conjugate() * theirs).real > -HEAD_ON * own_mps * theirs_mps)
        motion = Motion(place, wanted, self._velocity, own if np.all(overtakes) else 0j)
        return complex(nearest_free(motion, traffic, within_s, meets & traffic.yields, self._fan, self._basin))

    # --- the path of the point

    def _led_reference(self, reference: Reference, course: complex | None, wanted: complex) -> Reference:
        """Return the point's reference over the horizon, and move the point by one step: with the velocity `course`, or back
        as `wanted`."""
        assert self._point is not None
        eta, rate, acceleration = reference.eta.copy(), reference.velocity.copy(), reference.acceleration.copy()
        change_mps2 = self.agility.change_mps2
        if course is None:
            path_back(self._point, self._velocity, self.agility, self._times_s, eta, rate)
        else:
            path_out(self._point, self._velocity, course, change_mps2, self._times_s, eta, rate)
        self._velocity = changed(self._velocity, wanted if course is None else course, change_mps2 * self._period_s)
        self._point += self._velocity * self._period_s
        acceleration[:, :2] = 0.0
        return Reference(eta, rate, acceleration)

    def _is_back(self, reference: Reference) -> bool:
        """True if the point, a period from now, has returned to the reference in place and velocity."""
        assert self._point is not None
        speed = complex(reference.velocity[0, 0], reference.velocity[0, 1])
        off = abs(self._point - complex(reference.eta[0, 0], reference.eta[0, 1]) - speed * self._period_s)
        return off < ARRIVED_M and abs(self._velocity - speed) < ARRIVED_MPS
