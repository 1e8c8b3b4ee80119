"""Driving by a person: the goal that follows the velocity asked, slowed so that the robot stops short of everything. Pure.

A velocity towards a wall, an island, an obstacle or a robot is limited by the distance h that is left and by the other's own
velocity, so that h falls no faster than exponentially (control barrier function, Ames et al. 2019, first order):

    dh/dt >= -h / STOP_S

Only the person turns the robot: it stops short of what is in the way and never goes around it. The controller's half-spaces
(36) stay in force below this, for what comes towards the robot.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from robot_agent.guidance.formation import Formation, Neighbour, plan_rows
from robot_agent.guidance.obstacles import Obstacle
from robot_agent.guidance.reference import Drive
from shoal.config.experiment import Experiment
from shoal.frames import Array, wrap
from shoal.messages.messages import DriveVelocity

STOP_S = 2.0  # time constant of the approach: at 0.2 m from a wall at most 0.1 m/s
SHORT_M = 0.1  # stops this far before the distance to keep: a hull overshoots its reference by some centimetres
LEAD_M = 0.5  # reference ahead of the robot, at most: a robot follows some 1 s behind, and what is held back must not wind up
LEAD_RAD = 0.5
FOLLOWS_S = 1.0  # so far a robot is behind its reference


@dataclass(frozen=True)
class Body:
    """A thing to stop short of: x + iy in m, velocity, distance to keep from it. Without a depth it reaches from the floor to
    the surface."""

    place: complex
    velocity_mps: complex
    keep_m: float
    depth_m: float | None = None
    heave_mps: float = 0.0


def objection(velocity: DriveVelocity | None) -> str:
    """Return the reason against a velocity asked for; empty if there is none. One beyond the limits is limited."""
    if velocity is None:
        return "carries no velocity"
    wrong = [f"drive.{name} = {value}: must be a number" for name, value in vars(velocity).items() if not math.isfinite(value)]
    return wrong[0] if wrong else ""


def off_depth_m(reference_m: float, depth_m: float, heave_mps: float) -> float:
    """Depth of a driven robot's reference below where the robot will be at some time within FOLLOWS_S; 0 if it passes it."""
    below_m, goes_m = reference_m - depth_m, FOLLOWS_S * heave_mps
    return below_m - min(max(below_m, min(goes_m, 0.0)), max(goes_m, 0.0))


class Driver:
    """Reference of one driven robot, from step to step."""

    def __init__(self, experiment: Experiment) -> None:
        vehicle = experiment.vehicle
        self._limits, self._hull_m, self._pool = vehicle.limits, vehicle.radius_m, experiment.pool
        self._islands = [
            Body(complex(*island.position_m), 0j, island.radius_m + vehicle.radius_m + SHORT_M)
            for island in experiment.islands
        ]
        self._period_s = experiment.controller.period_s
        self._depth_lead_m = 0.5 * experiment.safety.off_depth_m
        self._eta: Array | None = None

    def reset(self) -> None:
        """Begin anew at the robot's own place."""
        self._eta = None

    def goal(
        self, velocity: DriveVelocity, lasts_s: float, eta: Array, around: Sequence[Body], heave_mps: float = 0.0
    ) -> Drive:
        """Return the goal of one step: `velocity` within limits and slowed, from a reference near the estimate `eta` (4,) of a
        robot that goes down with `heave_mps`."""
        limits, ahead = self._limits, complex(math.cos(eta[3]), math.sin(eta[3]))
        surge, heave = _within(velocity.surge_mps, limits.speed_mps), _within(velocity.heave_mps, limits.heave_mps)
        turn = _within(velocity.yaw_rate_radps, limits.yaw_rate_radps)
        x_m, y_m, depth_m, yaw_rad = eta.tolist()
        led_x_m, led_y_m, led_depth_m, led_yaw_rad = (eta if self._eta is None else self._eta).tolist()
        # There is no side thruster: sideways the reference goes with the robot.
        led_m = _within((ahead.conjugate() * complex(led_x_m - x_m, led_y_m - y_m)).real, LEAD_M)
        place = complex(x_m, y_m) + led_m * ahead
        depth_m += _within(led_depth_m - depth_m, LEAD_M)
        yaw_rad += _within(wrap(led_yaw_rad - yaw_rad), LEAD_RAD)
        # Surge and turn can take all of the thrust: off its depth a robot goes without them, and its reference waits
        off_m = off_depth_m(depth_m, eta.item(2), heave_mps)
        rest = min(max(2.0 - abs(off_m) / self._depth_lead_m, 0.0), 1.0)
        surge, turn = rest * surge, rest * turn
        for body in (*around, *self._islands):
            surge, heave = _slowed(surge, heave, ahead, place, depth_m, body)
        surge, heave = self._inside(surge, heave, ahead, place, depth_m)
        place += self._period_s * surge * ahead
        if math.copysign(1.0, heave) * off_m < self._depth_lead_m:
            depth_m += self._period_s * heave
        self._eta = np.array([place.real, place.imag, depth_m, yaw_rad + self._period_s * turn])
        return Drive(self._eta, surge, heave, turn, lasts_s)

    def _inside(self, surge: float, heave: float, ahead: complex, place: complex, depth_m: float) -> tuple[float, float]:
        """Surge and heave that end before the walls and the floor, and where the hull touches the surface: no thrust lifts it
        out. A basin without walls ends where paths do."""
        length_m, width_m, deepest_m = self._pool.size_m
        room_m = self._hull_m + SHORT_M if self._pool.walls else 0.0
        for at_m, along, size_m in ((place.real, ahead.real, length_m), (place.imag, ahead.imag, width_m)):
            left_m = 0.5 * size_m - room_m - math.copysign(at_m, at_m * along * surge)
            surge *= _share(abs(surge * along), left_m / STOP_S)
        highest_m = self._hull_m if self._pool.walls else -deepest_m
        left_m = deepest_m - room_m - depth_m if heave > 0.0 else depth_m - highest_m
        return surge, heave * _share(abs(heave), left_m / STOP_S)


def _slowed(surge: float, heave: float, ahead: complex, place: complex, depth_m: float, body: Body) -> tuple[float, float]:
    """Surge and heave that a body leaves. What keeps them apart counts: level with it surge, above or below it heave."""
    away, below_m = body.place - place, 0.0 if body.depth_m is None else body.depth_m - depth_m
    if abs(below_m) > abs(away):
        if abs(away) >= body.keep_m:
            return surge, heave
        down = math.copysign(1.0, below_m)
        return surge, heave * _share(down * heave, (abs(below_m) - body.keep_m) / STOP_S + down * body.heave_mps)
    if abs(below_m) >= body.keep_m:
        return surge, heave
    towards = away / abs(away) if away else ahead
    allowed = (abs(away) - body.keep_m) / STOP_S + (body.velocity_mps * towards.conjugate()).real
    return surge * _share((surge * ahead * towards.conjugate()).real, allowed), heave


def _share(speed: float, allowed: float) -> float:
    """Factor that brings a speed down to the one allowed; neither negative nor above 1."""
    return 1.0 if speed <= max(allowed, 0.0) else max(allowed, 0.0) / speed


def _within(value: float, limit: float) -> float:
    return min(max(value, -limit), limit)


def bodies(neighbours: Sequence[Neighbour], obstacles: Sequence[Obstacle], formation: Formation, now_ns: int) -> list[Body]:
    """Robots, by their plans, and obstacles as a driven robot has to stop short of them now. At the end of its plan, which may
    have one row left (`rest_of_plan`), a robot rests."""
    obstacles_now = []
    for neighbour in neighbours:
        plan = plan_rows(neighbour.plan)
        if plan is None:
            continue
        last = len(plan.eta) - 1
        row = max((now_ns - neighbour.stamp_ns) * 1e-9 / plan.period_s, 0.0)
        low = min(int(min(row, last)), max(last - 1, 0))
        step = plan.eta[min(low + 1, last)] - plan.eta[low]
        x_m, y_m, depth_m, _ = (plan.eta[low] + (min(row, last) - low) * step).tolist()
        x_mps, y_mps, heave_mps, _ = (step / plan.period_s).tolist() if row < last else (0.0, 0.0, 0.0, 0.0)
        keep_m = formation.clearance_m(neighbour, now_ns) + SHORT_M
        obstacles_now.append(Body(complex(x_m, y_m), complex(x_mps, y_mps), keep_m, depth_m, heave_mps))
    for obstacle in obstacles:
        points = (obstacle.edge_points + obstacle.displacement(now_ns)).tolist()
        obstacles_now += [Body(point, obstacle.velocity, obstacle.clearance_m + SHORT_M) for point in points]
    return obstacles_now
