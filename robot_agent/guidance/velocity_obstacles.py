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
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from robot_agent.guidance.formation import MEANT_S, WALL_M, NeighbourPredictions
from robot_agent.guidance.obstacles import Obstacle
from robot_agent.guidance.reference import Reference
from wire.config.vehicle import Vehicle
from wire.frames import Array, wrap

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

_STEPS_S = np.arange(1, round(LOOK_AHEAD_S / LOOK_STEP_S) + 1) * LOOK_STEP_S
_ANGLES = np.radians(np.arange(-150.0, 151.0, 7.5))
_PACES = np.array([1.0, 0.7, 0.4])
_TURNS = np.append(np.outer(_PACES, np.exp(1j * _ANGLES)), 0.0)
# Standing still is as bad as a turn by 115 degrees: if robots would rather wait than turn, four of them wait for one another.
# Of two ways equally long, the one to starboard.
_PRICE = np.append(2.0 * (1.0 - _PACES)[:, None] + np.abs(_ANGLES) + 1e-3 * (_ANGLES < 0.0), 2.0)


@dataclass(frozen=True, eq=False)
class Traffic:
    """Robots and obstacle points to be avoided, k in number, at this instant, as complex numbers x + iy."""

    place: NDArray[np.complex128]  # (k,) m
    velocity: NDArray[np.complex128]  # (k,) m/s, that they mean to have
    keep_m: Array  # (k,) distances to stay away
    sided: NDArray[np.bool_]  # (k,) robots, that keep to starboard too

    def only(self, which: NDArray[np.bool_]) -> "Traffic":
        """Return a selection of it."""
        return self if which.all() else Traffic(*(column[which] for column in self._columns))

    def joined(self, other: "Traffic") -> "Traffic":
        """Return both together."""
        return Traffic(*(np.concatenate(both) for both in zip(self._columns, other._columns, strict=True)))

    @property
    def _columns(self) -> tuple[NDArray[Any], ...]:
        return self.place, self.velocity, self.keep_m, self.sided


NOBODY = Traffic(np.zeros(0, np.complex128), np.zeros(0, np.complex128), np.zeros(0), np.zeros(0, bool))


def robot_traffic(predictions: NeighbourPredictions, keep_m: Array, depth_m: float, urgent: bool) -> Traffic:
    """The other robots from their plans, each at a distance (k,). Left out are robots as far below or above `depth_m`, and, if
    `urgent`, robots that must give way to us: without an urgent task, and hearing us."""
    others, there = predictions.neighbours, predictions.pose_now.view(np.complex128)
    count = np.abs(there[:, 1].real - depth_m) < keep_m
    if urgent:
        count &= [not (other.fresh and other.hears_us and not other.plan.urgent) for other in others]
    return Traffic(there[:, 0], predictions.intended_velocity, keep_m + ROOM_M, np.ones(len(others), bool)).only(count)


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
        self._steps_s = np.diff(times_s)
        self._steps = self._steps_s.tolist()
        half = np.array(room_m if room_m is not None else (math.inf, math.inf)) / 2.0
        self._room_x, self._room_y = (half - vehicle.radius_m - WALL_M).tolist()
        self._islands = [(island.centre, island.clearance_m + WALL_M) for island in islands]
        self._second = min(int(np.searchsorted(times_s, MEANT_S - 1e-9)), len(times_s) - 1)  # a horizon may be shorter
        self.reset()

    def reset(self) -> None:
        """Go back to the reference at once."""
        self._point: complex | None = None  # None: on the reference
        self._velocity = 0j
        self._turn = 0.0  # of the heading, away from the reference's
        self._met = 0  # consecutive steps with a conflict

    def avoidance_path(self, reference: Reference, place: complex, traffic: Traffic) -> Reference:
        """Return the reference to follow instead, for a robot at `place`; `reference` itself if it is free."""
        if self._point is None:
            self._met = self._met + 1 if self._conflicts(reference, place, traffic) else 0
            if self._met < self._sure_steps:
                return reference
        begin, speed = (
            complex(reference.eta[0, 0], reference.eta[0, 1]),
            complex(reference.velocity[0, 0], reference.velocity[0, 1]),
        )
        on_path = self._point is None
        if self._point is None:
            self._point, self._velocity, self._turn = begin, speed, 0.0
        wanted = self._towards(begin, speed, self._point)
        course = self._avoiding_velocity(reference, place, wanted, traffic)
        if on_path and course is None:  # the path itself bends away
            self.reset()
            return reference
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
        rows = reference.eta[:: self._second][:2, :2].tolist()
        velocity = complex(rows[1][0] - rows[0][0], rows[1][1] - rows[0][1]) / float(self._times_s[self._second])
        return abs(velocity) >= SLIGHTEST_MPS and _closes_in(place, velocity, traffic)

    def _towards(self, goal: complex, speed: complex, point: complex) -> complex:
        """Velocity that leads a point back to its goal, which moves at `speed`."""
        back = RETURN_PER_S * (goal - point)
        limit = max(CATCH_UP * abs(speed), CATCH_UP_MPS)
        velocity = speed + back * min(1.0, limit / max(abs(back), limit))
        return velocity * min(1.0, self._fastest_mps / max(abs(velocity), self._fastest_mps))

    def _avoiding_velocity(self, reference: Reference, place: complex, wanted: complex, traffic: Traffic) -> complex | None:
        """Velocity that avoids the traffic in the way; None if none is."""
        if abs(wanted) < SLIGHTEST_MPS or not len(traffic.place):
            return None
        heeded = traffic.only(~_overtakes(place, wanted, traffic))
        away, velocity = heeded.place - place, heeded.velocity
        keep = np.minimum(heeded.keep_m, PARTING * np.abs(away))
        shift = self._ahead(reference)[:, None] - velocity * _STEPS_S[:, None]
        meets = (np.abs(away - shift) < keep).any(axis=0)
        if not meets.any():
            return None
        return self._nearest_free(place, wanted, away, velocity, keep, meets & heeded.sided)

    def _ahead(self, reference: Reference) -> NDArray[np.complex128]:
        """Displacements of the point on its return to the reference, (steps,) LOOK_STEP_S apart."""
        assert self._point is not None
        last, times_s = self._times_s[-1], self._times_s
        beyond = np.maximum(_STEPS_S - last, 0.0)
        x, y = (np.interp(_STEPS_S, times_s, reference.eta[:, k]) + beyond * reference.velocity[-1, k] for k in (0, 1))
        goals = (x + 1j * y).tolist()
        point, before, ahead = self._point, complex(reference.eta[0, 0], reference.eta[0, 1]), []
        for goal in goals:
            point += LOOK_STEP_S * self._towards(before, (goal - before) / LOOK_STEP_S, point)
            before = goal
            ahead.append(point - self._point)
        return np.array(ahead)

    def _nearest_free(
        self,
        place: complex,
        wanted: complex,
        away: NDArray[np.complex128],
        velocity: NDArray[np.complex128],
        keep: Array,
        sided: NDArray[np.bool_],
    ) -> complex:
        """Of a fan of velocities the nearest to `wanted` that passes all traffic (k,) at its distance, and robots on the right
        side; if none does, the one that keeps farthest away."""
        now = self._velocity - velocity
        side = np.where(_across(now, away) > WELL_CLEAR * keep * np.abs(now), 1.0, -1.0)  # 1: leaves it to starboard
        ways = wanted * _TURNS
        closing = ways[:, None] - velocity
        towards = away.real * closing.real + away.imag * closing.imag
        time_s = np.clip(towards / np.maximum(np.abs(closing) ** 2, 1e-12), 0.0, LOOK_AHEAD_S)
        nearest = np.abs(away - closing * time_s)
        comes = towards > 0.0
        bad = np.where(comes & (nearest < keep), 1.0 - nearest / keep, 0.0)
        wrong = sided & (_across(closing, away) * side < 0.0)
        worst = np.maximum(np.where(wrong, 1.0, bad).max(axis=1), self._into_wall(place, ways))
        price = _PRICE + 0.3 * np.abs(ways - self._velocity) / abs(wanted)
        return complex(ways[np.argmin(100.0 * worst + price)])

    def _into_wall(self, place: complex, ways: NDArray[np.complex128]) -> Array:
        """1 for velocities that lead too close to a wall or an island, (ways,)."""
        ahead = place + ways * WALL_S
        x, y = max(self._room_x, abs(place.real)), max(self._room_y, abs(place.imag))
        bad = (np.abs(ahead.real) > x) | (np.abs(ahead.imag) > y)
        for middle, keep_m in self._islands:
            away = middle - place
            towards = np.clip((away * ways.conj()).real / np.maximum(np.abs(ways) ** 2, 1e-12), 0.0, WALL_S)
            bad |= np.abs(away - ways * towards) < min(keep_m, PARTING * abs(away))
        return np.asarray(bad, dtype=np.float64)

    # --- the path of the point

    def _led_reference(self, reference: Reference, course: complex | None, wanted: complex) -> Reference:
        """Return the point's reference over the horizon, and move the point by one step: with the velocity `course`, or back
        as `wanted`."""
        assert self._point is not None
        way, going = self._path_back(reference) if course is None else self._path_out(course)
        self._velocity = _changed(self._velocity, wanted if course is None else course, CHANGE_MPS2 * self._period_s)
        self._point += self._velocity * self._period_s
        self._steer(float(reference.eta[0, 3]))
        eta, rate, acceleration = reference.eta.copy(), reference.velocity.copy(), reference.acceleration.copy()
        eta.view(np.complex128)[:, 0], rate.view(np.complex128)[:, 0] = way, going
        eta[:, 3] += self._turn
        acceleration[:, :2] = 0.0
        return Reference(eta, rate, acceleration)

    def _path_out(self, course: complex) -> tuple[NDArray[np.complex128], NDArray[np.complex128]]:
        """Places and velocities (rows,) of a point that changes to a velocity."""
        assert self._point is not None
        change = course - self._velocity
        going = self._velocity + change * np.minimum(1.0, self._times_s * (CHANGE_MPS2 / max(abs(change), 1e-12)))
        way = np.empty_like(going)
        way[0] = 0.0
        np.add.accumulate(going[1:] * self._steps_s, out=way[1:])
        way += self._point
        return way, going

    def _path_back(self, reference: Reference) -> tuple[NDArray[np.complex128], NDArray[np.complex128]]:
        """Places and velocities (rows,) of a point that returns to the reference."""
        assert self._point is not None
        goals, speeds = reference.eta.view(np.complex128)[:, 0].tolist(), reference.velocity.view(np.complex128)[:, 0].tolist()
        point, velocity = self._point, self._velocity
        places, velocities = [point], [velocity]
        for goal, speed, step_s in zip(goals, speeds, self._steps, strict=False):
            velocity = _changed(velocity, self._towards(goal, speed, point), CHANGE_MPS2 * step_s)
            point += velocity * step_s
            places.append(point)
            velocities.append(velocity)
        return np.array(places), np.array(velocities)

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


def _closes_in(place: complex, velocity: complex, traffic: Traffic) -> bool:
    """True if straight lines at these velocities lead closer to any traffic than allowed."""
    apart, closing = traffic.place - place, velocity - traffic.velocity
    square = closing.real**2 + closing.imag**2
    towards = apart.real * closing.real + apart.imag * closing.imag
    comes = (square >= SLIGHTEST_MPS**2) & (towards > 0.0)
    if not comes.any():
        return False
    time_s = np.minimum(towards / np.maximum(square, SLIGHTEST_MPS**2), LOOK_AHEAD_S)
    near = np.abs(apart - closing * time_s) < np.minimum(traffic.keep_m, PARTING * np.abs(apart))
    return bool((comes & near).any())


def _overtakes(place: complex, velocity: complex, traffic: Traffic) -> NDArray[np.bool_]:
    """Select robots that come from behind, on their own way forward."""
    apart, back = traffic.place - place, velocity.conjugate()
    astern = (apart * back).real < ABAFT * np.abs(apart) * abs(velocity)
    return np.asarray(traffic.sided & astern & ((traffic.velocity * back).real > 0.0))


def _across(closing: NDArray[np.complex128], away: NDArray[np.complex128]) -> Array:
    """Positive where `away` lies to starboard of the direction `closing`; |closing| times the distance of passing."""
    return np.asarray(closing.real * away.imag - closing.imag * away.real)


def _changed(velocity: complex, to: complex, most: float) -> complex:
    """Velocity changed towards `to` by at most `most`."""
    difference = to - velocity
    return to if abs(difference) <= most else velocity + difference * (most / abs(difference))
