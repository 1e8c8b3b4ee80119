"""Giving way by velocity obstacles: the reference leaves the path where it would lead into a robot or an obstacle.

Half-spaces (36) keep robots apart but cannot part two that want to run through one another. Head on they stop 2R apart and
push for ever, and no plan shows a way out (to first order, a robot at rest does not move sideways by turning). So the robot
follows a point. The point is on the reference while that is free, and takes another velocity while it is not (sampled velocity
obstacles, Fiorini and Shiller 1998, with a side rule as in COLREG):

* A velocity is free if it passes every robot and obstacle by 2R + ROOM_M within LOOK_AHEAD_S, if they move on as told.
* Two robots that meet leave one another to port (they keep to starboard), unless they are already well on the other side.
  The side is that of the relative motion, which both see alike whichever turns first. At obstacles the shorter way counts.
* A robot that is overtaken goes on as before; so does one with an urgent task, among robots without one.
* Of the free velocities the nearest to the wanted one is taken, changing steadily.

Then the point returns to the reference, at a rate that falls with the distance: no overshoot. Robots in formation have the
same velocity, never meet, and get back the very reference they came with.
"""

import cmath
import math
from collections.abc import Sequence
from functools import cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from robot_agent.guidance.formation import MEANT_S, WALL_M, NeighbourPredictions, Places
from robot_agent.guidance.obstacles import Obstacle
from robot_agent.guidance.reference import Reference
from wire.config.vehicle import Vehicle
from wire.frames import Array, wrap
from wire.kernels import kernel

LOOK_AHEAD_S = 8.0  # two robots at 0.1 m/s begin to turn 1.6 m before they would touch
LOOK_STEP_S = 0.5
SURE_S = 0.2  # a conflict lasts so long before the reference is left,
SURE_STEPS = 2  # and so many steps at least: neighbours that start a step before their plan says so are no conflict
ROOM_M = 0.15  # beyond what the half-spaces keep, so that these need not act: four robots in a bend lose 13 cm on each other
SLIGHTEST_MPS = 0.01  # a slower approach is no conflict: robots in formation sway that fast
PARTING = 0.999  # of the present distance: robots closer than allowed may take any velocity that leads no closer
WELL_CLEAR = 0.5  # of the distance to keep: a robot that passes so far on the other side stays on it
ABAFT = -0.38  # cosine of 112.5 degrees from ahead: a robot from there overtakes, and has to keep clear
RETURN_PER_S = 0.3
CATCH_UP = 0.5  # of the reference's speed, on top of it, to return with; at least
CATCH_UP_MPS = 0.06
CHANGE_MPS2 = 0.1  # of the point's velocity: a robot at 0.1 m/s turns by 60 degrees in a second
LEASH_M = 0.25  # the point waits for a robot that is held up
HOLD_COURSE_MPS = 0.02  # slower, a direction of motion means nothing
TURN_RADPS = 0.8
ARRIVED_M, ARRIVED_MPS, ARRIVED_RAD = 0.002, 0.004, 0.02
WALL_S = 3.0  # a velocity is not taken if in this time it leads closer to a wall than WALL_M beyond the hull
STILL = 1e-12  # (m/s)^2: keeps 0/0 out

LOOK_STEPS = round(LOOK_AHEAD_S / LOOK_STEP_S)
_ANGLES = np.radians(np.arange(-150.0, 151.0, 7.5))
_PACES = np.array([1.0, 0.7, 0.4])
# The fan of velocities to choose from, as multiples of the wanted one, and the price of each. Standing still is as bad as a
# turn by 115 degrees: if robots would rather wait than turn, four of them wait for one another. Of two ways equally long, the
# one to starboard.
FAN = np.append(np.outer(_PACES, np.exp(1j * _ANGLES)), 0.0)
FAN_PRICE = np.append(2.0 * (1.0 - _PACES)[:, None] + np.abs(_ANGLES) + 1e-3 * (_ANGLES < 0.0), 2.0)


@kernel("f8(c16, c16)", part=True)
def dot(a: complex, b: complex) -> float:
    """Scalar product of two vectors x + iy."""
    return a.real * b.real + a.imag * b.imag


@kernel("f8(c16, c16)", part=True)
def cross(a: complex, b: complex) -> float:
    """|a| times the distance of b to starboard of the direction a; negative to port."""
    return a.real * b.imag - a.imag * b.real


@kernel("b1(c16, c16, c16[::1], c16[::1], f8[::1])", part=True)
def closes_in(place: complex, velocity: complex, there: Places, going: Places, keep_m: Array) -> bool:
    """True if straight lines at these velocities lead nearer to any traffic (k,) than allowed within LOOK_AHEAD_S."""
    for i in range(len(there)):
        apart, closing = there[i] - place, velocity - going[i]
        square, towards = dot(closing, closing), dot(apart, closing)
        if square >= SLIGHTEST_MPS**2 and towards > 0.0:
            time_s = min(towards / square, LOOK_AHEAD_S)
            if abs(apart - closing * time_s) < min(keep_m[i], PARTING * abs(apart)):
                return True
    return False


@kernel("b1(f8[:,::1], i8, f8, c16, c16[::1], c16[::1], f8[::1])")
def leads_too_close(eta: Array, row: int, row_s: float, place: complex, there: Places, going: Places, keep_m: Array) -> bool:
    """True if the straight line of a reference (rows, 4) to its `row`, `row_s` from now, closes in on any traffic."""
    velocity = complex((eta[row, 0] - eta[0, 0]) / row_s, (eta[row, 1] - eta[0, 1]) / row_s)
    return abs(velocity) >= SLIGHTEST_MPS and closes_in(place, velocity, there, going, keep_m)


@kernel("void(f8[::1], f8[::1], f8, f8[::1])")
def distances_when_level(depth: Array, keep_m: Array, depth_m: float, level_m: Array) -> None:
    """Distances to keep from robots (k,), ROOM_M beyond `keep_m`; 0 from those as far below or above `depth_m`."""
    for i in range(len(depth)):
        level_m[i] = keep_m[i] + ROOM_M if abs(depth[i] - depth_m) < keep_m[i] else 0.0


@kernel("c16(c16, c16, c16, f8)")
def homing_velocity(goal: complex, speed: complex, point: complex, fastest_mps: float) -> complex:
    """Velocity that leads a point back to its goal, which moves at `speed`."""
    back = RETURN_PER_S * (goal - point)
    limit = max(CATCH_UP * abs(speed), CATCH_UP_MPS)
    velocity = speed + back * min(1.0, limit / max(abs(back), limit))
    return velocity * min(1.0, fastest_mps / max(abs(velocity), fastest_mps))


@kernel("c16(c16, c16, f8)")
def changed(velocity: complex, to: complex, most: float) -> complex:
    """Velocity changed towards `to` by at most `most`."""
    difference = to - velocity
    return to if abs(difference) <= most else velocity + difference * (most / abs(difference))


@kernel("void(f8[:,::1], f8[:,::1], f8[::1], c16, f8, c16[::1])")
def look_ahead(eta: Array, velocity: Array, times_s: Array, point: complex, fastest_mps: float, ahead: Places) -> None:
    """Displacements of a point on its return to a reference, LOOK_STEP_S apart, into `ahead`. The reference (rows, 4) at
    `times_s` (rows,) goes straight on after its end."""
    last, start, row = len(times_s) - 1, point, 0
    before = complex(eta[0, 0], eta[0, 1])
    for i in range(len(ahead)):
        time_s = (i + 1) * LOOK_STEP_S
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
        point += LOOK_STEP_S * homing_velocity(before, (goal - before) / LOOK_STEP_S, point, fastest_mps)
        before = goal
        ahead[i] = point - start


@kernel("b1(c16, c16, c16[::1], c16[::1], c16[::1], f8[::1], b1[::1], b1[::1], b1[::1])")
def find_meetings(
    place: complex,
    wanted: complex,
    ahead: Places,
    there: Places,
    going: Places,
    keep_m: Array,
    sided: NDArray[np.bool_],
    heeded: NDArray[np.bool_],
    meets: NDArray[np.bool_],
) -> bool:
    """Find the traffic (k,) that is to be `heeded`, and the part of it that the way `ahead` (steps,) `meets`. True if any.

    Robots that come from behind on their own way forward overtake: they keep clear of us. What is to be passed at no distance
    is not in the way.
    """
    found = False
    for i in range(len(there)):
        away = there[i] - place
        astern = dot(away, wanted) < ABAFT * abs(away) * abs(wanted)
        heeded[i] = keep_m[i] > 0.0 and not (sided[i] and astern and dot(going[i], wanted) > 0.0)
        meets[i] = False
        nearest_m = min(keep_m[i], PARTING * abs(away))
        for k in range(len(ahead) if heeded[i] else 0):
            meets[i] |= abs(away + going[i] * ((k + 1) * LOOK_STEP_S) - ahead[k]) < nearest_m
        found |= meets[i]
    return found


@kernel("b1(c16, c16, f8, f8, c16[::1], f8[::1])", part=True)
def leads_into_wall(place: complex, way: complex, room_x_m: float, room_y_m: float, islands: Places, keep_m: Array) -> bool:
    """True if the velocity `way` leads within WALL_S beyond the room (half its sides), or too close to an island (k,). A robot
    that is there already may go no further in."""
    ahead = place + way * WALL_S
    into = abs(ahead.real) > max(room_x_m, abs(place.real)) or abs(ahead.imag) > max(room_y_m, abs(place.imag))
    for i in range(len(islands)):
        away = islands[i] - place
        time_s = min(max(dot(away, way) / max(dot(way, way), STILL), 0.0), WALL_S)
        into |= abs(away - way * time_s) < min(keep_m[i], PARTING * abs(away))
    return into


@kernel("c16(c16, c16, c16, c16[::1], c16[::1], f8[::1], b1[::1], b1[::1], c16[::1], f8[::1], f8, f8, c16[::1], f8[::1])")
def nearest_free(
    place: complex,
    wanted: complex,
    velocity: complex,
    there: Places,
    going: Places,
    keep_m: Array,
    heeded: NDArray[np.bool_],
    sided: NDArray[np.bool_],
    turns: Places,
    price: Array,
    room_x_m: float,
    room_y_m: float,
    islands: Places,
    islands_keep_m: Array,
) -> complex:
    """The cheapest of the velocities wanted x turns (n,) that passes all traffic (k,) at its distance, and `sided` robots on
    the right side; if none does, the one that keeps farthest away. `velocity` is the present one: a change from it costs."""
    least, best = np.inf, wanted
    for n in range(len(turns)):
        way, worst = wanted * turns[n], 0.0
        for i in range(len(there)):
            if not heeded[i]:
                continue
            away, closing, now = there[i] - place, way - going[i], velocity - going[i]
            nearest_m = min(keep_m[i], PARTING * abs(away))
            # a robot that is left well to starboard may stay there; all others are left to port
            starboard = cross(now, away) > WELL_CLEAR * nearest_m * abs(now)
            if sided[i] and (cross(closing, away) < 0.0 if starboard else cross(closing, away) > 0.0):
                worst = 1.0
            elif dot(away, closing) > 0.0:
                time_s = min(dot(away, closing) / max(dot(closing, closing), STILL), LOOK_AHEAD_S)
                worst = max(worst, 1.0 - abs(away - closing * time_s) / nearest_m)
        if leads_into_wall(place, way, room_x_m, room_y_m, islands, islands_keep_m):
            worst = 1.0
        cost = 100.0 * worst + price[n] + 0.3 * abs(way - velocity) / abs(wanted)
        if cost < least:
            least, best = cost, way
    return best


@kernel("void(c16, c16, c16, f8[::1], f8[:,::1], f8[:,::1])")
def path_out(point: complex, velocity: complex, course: complex, times_s: Array, eta: Array, rate: Array) -> None:
    """Places into `eta` (rows, 4) and velocities into `rate` (rows, 4) of a point that changes to the velocity `course`."""
    for k in range(len(times_s)):
        going = changed(velocity, course, CHANGE_MPS2 * times_s[k])
        if k > 0:
            point += going * (times_s[k] - times_s[k - 1])
        eta[k, 0], eta[k, 1], rate[k, 0], rate[k, 1] = point.real, point.imag, going.real, going.imag


@kernel("void(c16, c16, f8, f8[::1], f8[:,::1], f8[:,::1])")
def path_back(point: complex, velocity: complex, fastest_mps: float, times_s: Array, eta: Array, rate: Array) -> None:
    """The same of a point that returns to the reference, which `eta` and `rate` hold before."""
    for k in range(len(times_s)):
        goal, speed = complex(eta[k, 0], eta[k, 1]), complex(rate[k, 0], rate[k, 1])
        eta[k, 0], eta[k, 1], rate[k, 0], rate[k, 1] = point.real, point.imag, velocity.real, velocity.imag
        if k < len(times_s) - 1:
            step_s = times_s[k + 1] - times_s[k]
            velocity = changed(velocity, homing_velocity(goal, speed, point, fastest_mps), CHANGE_MPS2 * step_s)
            point += velocity * step_s


class Traffic(NamedTuple):
    """Robots and obstacle points to be avoided, k in number, at this instant, as complex numbers x + iy."""

    place: NDArray[np.complex128]  # (k,) m
    velocity: NDArray[np.complex128]  # (k,) m/s, that they mean to have
    keep_m: Array  # (k,) distances to stay away; 0: it is not in the way
    sided: NDArray[np.bool_]  # (k,) robots, that keep to starboard too

    def joined(self, other: "Traffic") -> "Traffic":
        """Return both together."""
        return Traffic(*(np.concatenate(both) for both in zip(self, other, strict=True)))


NOBODY = Traffic(np.zeros(0, np.complex128), np.zeros(0, np.complex128), np.zeros(0), np.zeros(0, bool))


def robot_traffic(predictions: NeighbourPredictions, keep_m: Array, depth_m: float, urgent: bool) -> Traffic:
    """The other robots from their plans, each at a distance (k,). Not in the way are robots as far below or above `depth_m`,
    and, if `urgent`, robots that must give way to us: without an urgent task, and hearing us."""
    if urgent:
        gives_way = [other.fresh and other.hears_us and not other.plan.urgent for other in predictions.neighbours]
        keep_m = np.where(gives_way, 0.0, keep_m)
    level_m = np.empty(len(keep_m))
    distances_when_level(predictions.depth_now, keep_m, depth_m, level_m)
    return Traffic(predictions.place_now, predictions.intended_velocity, level_m, _all_sided(len(keep_m)))


@cache
def _all_sided(count: int) -> NDArray[np.bool_]:
    return np.ones(count, bool)


def obstacle_traffic(obstacle: Obstacle, place: complex, speed_mps: float, now_ns: int) -> Traffic:
    """Edge points of an obstacle; none if it is too far away to be met by a robot at that speed."""
    moved, keep_m = obstacle.displacement(now_ns), obstacle.clearance_m + ROOM_M
    reach_m = obstacle.reach_m + keep_m + LOOK_AHEAD_S * (abs(obstacle.velocity) + speed_mps)
    if abs(obstacle.centre + moved - place) > reach_m:
        return NOBODY
    count = len(obstacle.edge_points)
    return Traffic(
        obstacle.edge_points + moved, np.full(count, obstacle.velocity), np.full(count, keep_m), np.zeros(count, bool)
    )


def traffic_near(
    eta: Array,
    reference: Reference,
    predictions: NeighbourPredictions,
    keep_m: Array,
    obstacles: Sequence[Obstacle],
    urgent: bool,
    now_ns: int,
) -> Traffic:
    """All that a robot at `eta` (4,) may meet: the other robots, at distances (k,), and obstacles."""
    x, y, depth_m, _ = eta.tolist()
    traffic = robot_traffic(predictions, keep_m, depth_m, urgent) if predictions.neighbours else NOBODY
    for obstacle in obstacles:
        speed_mps = math.hypot(*reference.velocity[0, :2].tolist()) + CATCH_UP_MPS
        traffic = traffic.joined(obstacle_traffic(obstacle, complex(x, y), speed_mps, now_ns))
    return traffic


class GiveWay:
    """The point that one robot follows, with its memory."""

    def __init__(
        self,
        vehicle: Vehicle,
        times_s: Array,
        period_s: float,
        room_m: tuple[float, float] | None = None,
        islands: Sequence[Obstacle] = (),
    ) -> None:
        """`times_s` (rows,) are the instants of a reference's rows from now, `room_m` the pool's length and width."""
        self._times_s, self._period_s = times_s, period_s
        self._sure_steps = max(SURE_STEPS, round(SURE_S / period_s))
        self._fastest_mps = 0.8 * vehicle.limits.speed_mps
        half = np.array(room_m if room_m is not None else (math.inf, math.inf)) / 2.0
        self._room_x, self._room_y = (half - vehicle.radius_m - WALL_M).tolist()
        self._islands = np.array([island.centre for island in islands], np.complex128)
        self._islands_keep_m = np.array([island.clearance_m + WALL_M for island in islands])
        self._second = min(int(np.searchsorted(times_s, MEANT_S - 1e-9)), len(times_s) - 1)  # a horizon may be shorter
        self._second_s = float(times_s[self._second])
        self.reset()

    def reset(self) -> None:
        """Go back to the reference at once."""
        self._point: complex | None = None  # None: on the reference
        self._velocity = 0j
        self._turn = 0.0  # of the heading, away from the reference's
        self._met = 0  # consecutive steps with a conflict
        self.path_is_blocked = False  # it avoids what it would meet on its path too
        self.avoids = False  # something is in its way; False on the way back

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
            self._point, self._velocity, self._turn = begin, speed, 0.0
        wanted = homing_velocity(begin, speed, self._point, self._fastest_mps)
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
        return leads_too_close(
            reference.eta, self._second, self._second_s, place, traffic.place, traffic.velocity, traffic.keep_m
        )

    def _avoiding_velocity(self, reference: Reference, place: complex, wanted: complex, traffic: Traffic) -> complex | None:
        """Velocity that avoids the traffic in the way; None if none is."""
        if abs(wanted) < SLIGHTEST_MPS or not len(traffic.place):
            return None
        assert self._point is not None
        there, going, keep_m, sided = traffic.place, traffic.velocity, traffic.keep_m, traffic.sided
        ahead, heeded, meets = np.empty(LOOK_STEPS, np.complex128), np.empty(len(there), bool), np.empty(len(there), bool)
        look_ahead(reference.eta, reference.velocity, self._times_s, self._point, self._fastest_mps, ahead)
        if not find_meetings(place, wanted, ahead, there, going, keep_m, sided, heeded, meets):
            return None
        return complex(
            nearest_free(
                place, wanted, self._velocity, there, going, keep_m, heeded, meets & sided, FAN, FAN_PRICE, self._room_x,
                self._room_y, self._islands, self._islands_keep_m,
            )
        )  # fmt: skip

    # --- the path of the point

    def _led_reference(self, reference: Reference, course: complex | None, wanted: complex) -> Reference:
        """Return the point's reference over the horizon, and move the point by one step: with the velocity `course`, or back
        as `wanted`."""
        assert self._point is not None
        eta, rate, acceleration = reference.eta.copy(), reference.velocity.copy(), reference.acceleration.copy()
        if course is None:
            path_back(self._point, self._velocity, self._fastest_mps, self._times_s, eta, rate)
        else:
            path_out(self._point, self._velocity, course, self._times_s, eta, rate)
        self._velocity = changed(self._velocity, wanted if course is None else course, CHANGE_MPS2 * self._period_s)
        self._point += self._velocity * self._period_s
        self._steer(float(reference.eta[0, 3]))
        eta[:, 3] += self._turn
        acceleration[:, :2] = 0.0
        return Reference(eta, rate, acceleration)

    def _steer(self, yaw_rad: float) -> None:
        """Turn the heading towards the direction of motion, ahead or astern: a robot that comes back to its place does not
        turn round for it."""
        turn = 0.0
        if abs(self._velocity) > HOLD_COURSE_MPS:
            turn = self._turn + 0.5 * wrap(2.0 * (cmath.phase(self._velocity) - yaw_rad - self._turn))
        most = TURN_RADPS * self._period_s
        self._turn += min(max(turn - self._turn, -most), most)

    def _is_back(self, reference: Reference) -> bool:
        """True if the point has returned to the reference in place, velocity and heading."""
        assert self._point is not None
        off = abs(self._point - complex(reference.eta[1, 0], reference.eta[1, 1]))
        drift = abs(self._velocity - complex(reference.velocity[1, 0], reference.velocity[1, 1]))
        return off < ARRIVED_M + drift * self._period_s and drift < ARRIVED_MPS and abs(self._turn) < ARRIVED_RAD
