"""Other robots in the cost and in the constraints: formation terms (35) and collision half-spaces (36).

Distances are horizontal: robots pass beside one another, never above. Otherwise the camera would lose the lower one and the
upper one would break the surface (a controller that was free to use depth did both). Only a robot 2R deeper is out of the way.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from robot_agent.guidance.obstacles import Obstacle, nearest_border
from robot_agent.guidance.reference import interpolate
from wire.config.controller import MpcConfig, Safety
from wire.frames import TURN, Array
from wire.messages.messages import Plan

NS = 1e9
NEAREST = 4  # bodies that can be avoided at once: a sphere touches six in the plane, and meets no more than four first
LONGEST_PLAN = 1000  # rows of a plan that is resampled
NODES = 5  # of the horizon that keep their distance from each
TOUCHING_M = 1e-6
WALL_M = 0.05  # between a hull and a wall
WALL_GIVES = 0.1  # of what a robot's lines give: 2R hold room enough that hulls do not touch, a wall holds none
LEANS_M = 0.02  # a plan so near a half-space's border would be another one without it
SHORTEST_S, ABSURD = 1e-3, 1e4  # limits of what can be a plan: s; m and rad
MOST_TURNED_RAD = 1e8  # a heading counts its turns: days of laps
MEANT_S = 1.0  # over which a robot's velocity is taken from its planned reference
SAME_ERROR_M = 0.02  # tracking errors closer than this give equal priority,
ERROR_RATE_MPS = 0.5  # plus this per second of the message's age: no robot moves faster


@dataclass(frozen=True, eq=False)
class Neighbour:
    """Another robot's last plan. Fresh plans count for the formation; stale ones only keep a growing distance."""

    robot: int
    stamp_ns: int  # instant of the plan's node 0, on our clock
    plan: Plan
    fresh: bool
    formation: bool = True  # False: only stay clear of it
    hears_us: bool = False  # its plan says so; a robot that does not hear us cannot give way to us


@dataclass(frozen=True)
class Priority:
    """Priority of a robot (article, section 3.3): urgent task first, then small tracking error. The article's third criterion,
    which robot hears others, comes before both here, and the other way round: see `Neighbour.hears_us`."""

    urgent: bool
    tracking_error_m: float

    def goes_before(self, other: "Priority", age_s: float = 0.0) -> bool:
        """True if the other, whose priority is `age_s` old, must give way to this one. It is never true for both of two
        robots, however late they hear of each other: a difference that may have changed meanwhile does not count."""
        if self.urgent != other.urgent:
            return self.urgent
        return other.tracking_error_m - self.tracking_error_m > SAME_ERROR_M + ERROR_RATE_MPS * max(age_s, 0.0)


@dataclass(frozen=True, eq=False)
class HalfSpaces:
    """Bounds normal[i] . (x, y) of node[i] >= offset[i] - give[i] slack (36). Nodes count from 1."""

    node: NDArray[np.intp]  # (rows,)
    normal: NDArray[np.complex128]  # (rows,) x + iy
    offset: Array  # (rows,)
    give: Array | None = None  # (rows,); None: 1 in all

    def binds(self, eta: Array) -> bool:
        """True if a plan (horizon + 1, 4) lies against any of the bounds."""
        if not len(self.node):
            return False
        places = eta[self.node, 0] + 1j * eta[self.node, 1]
        return bool(((places * self.normal.conj()).real < self.offset + LEANS_M).any())


# What is to be kept clear of: places and directions away from it, how far beyond the distance to keep we are, all (nodes,),
# that distance, and how much its lines give when not all can be kept
Body = tuple[NDArray[np.complex128], NDArray[np.complex128], Array, float, float]

NOWHERE = HalfSpaces(np.zeros(0, np.intp), np.zeros(0, np.complex128), np.zeros(0))


@dataclass(frozen=True, eq=False)
class NeighbourPredictions:
    """Neighbours' plans at our instants, as the controller needs them."""

    weighted_deviation: Array  # (horizon + 1, 4) sum of Q_ij (eta_j - eta_j^ref), to be added to Q eta_ref
    weight: Array  # (4,) sum of Q_ij
    fresh_count: int
    neighbours: Sequence[Neighbour]  # whose plans can be used
    position: NDArray[np.complex128]  # (neighbours, nodes) predicted x + iy, at the nodes where distance is kept
    depth: Array  # (others, nodes)
    pose_now: Array  # (neighbours, 4) poses as their plans have them now
    intended_velocity: NDArray[np.complex128]  # (neighbours,) velocities x + iy that they mean to have


class Formation:
    """Formation terms and half-spaces of one robot, with their workspaces."""

    def __init__(
        self,
        config: MpcConfig,
        safety: Safety,
        period_s: float,
        dead_s: float = 0.0,
        room_m: tuple[float, float] | None = None,
        hull_m: float = 0.0,
    ) -> None:
        """The horizon's node 0 lies `dead_s` ahead of now. A hull of radius `hull_m` keeps off the walls of a pool of length
        and width `room_m`; None: there are no walls."""
        self._safety, self._period_s, self._horizon = safety, period_s, config.horizon
        self.set_weight(config.q_formation)
        self._ahead = np.arange(config.horizon + 2)
        self._nodes = np.unique(np.linspace(0, config.horizon, NODES + 1)[1:].round().astype(np.intp))
        self._nodes_ns = np.rint(NS * (dead_s + period_s * self._nodes)).astype(np.int64).tolist()
        self._around_nodes = np.concatenate([self._nodes, self._nodes + 1])
        self.rows = NEAREST * len(self._nodes)  # half-spaces there can be
        self._wall_m = hull_m + WALL_M
        self._walls = [] if room_m is None else [(-way, 0.5 * size) for way, size in zip((1, 1j), room_m, strict=True)]
        self._walls += [(-inwards, half_m) for inwards, half_m in self._walls]
        self._near_m = 2.0 * safety.radius_m + safety.margin_m
        self._dead_steps, self._meant = dead_s / period_s, max(round(MEANT_S / period_s), 1)
        none, nobody = np.zeros((0, len(self._nodes))), np.zeros((0, 4))
        pull = np.zeros((config.horizon + 1, 4))
        self._no_neighbours = NeighbourPredictions(
            pull, np.zeros(4), 0, (), none.astype(np.complex128), none, nobody, np.zeros(0, np.complex128)
        )

    def set_weight(self, q: tuple[float, float, float, float]) -> None:
        """Use another Q_ij from now on, the same for every neighbour."""
        self._weight = np.array(q)
        self._weights = np.tile(self._weight, self._horizon + 1)

    def predict_neighbours(self, neighbours: Sequence[Neighbour], now_ns: int) -> NeighbourPredictions:
        """Sample all neighbours' plans on our horizon, together."""
        others = [usable for neighbour in neighbours if (usable := self._in_step(neighbour)) is not None]
        if not others:
            return self._no_neighbours
        eta, deviation = _stacked(others)
        if not _plausible(eta, deviation):
            others = [neighbour for neighbour in others if _plausible(*_stacked([neighbour]))]
            if not others:
                return self._no_neighbours
            eta, deviation = _stacked(others)
        steps, first, last = self._steps(others, now_ns)
        ahead = steps + self._dead_steps
        whole = np.floor(ahead)
        rows = np.minimum(np.maximum((first + whole.astype(np.intp))[:, None] + self._ahead, first[:, None]), last[:, None])
        share = ahead - whole
        pull, weight = self._pull(others, deviation.take(rows, axis=0), share)
        around = eta.view(np.complex128).take(rows[:, self._around_nodes], axis=0)  # x + iy, z + i yaw
        there, after = around[:, : len(self._nodes)], around[:, len(self._nodes) :]
        there += share[:, None, None] * (after - there)
        now = np.minimum(np.maximum(first + np.rint(steps).astype(np.intp), first), last)
        then = np.minimum(now + self._meant, last)
        reference = (eta.take((now, then), axis=0) - deviation.take((now, then), axis=0)).view(np.complex128)[:, :, 0]
        meant = (reference[1] - reference[0]) / (self._period_s * np.maximum(then - now, 1))
        place, depth, heard = there[:, :, 0], there[:, :, 1].real, sum(n.fresh for n in others)
        return NeighbourPredictions(pull, weight, heard, others, place, depth, eta.take(now, axis=0), meant)

    def _in_step(self, neighbour: Neighbour) -> Neighbour | None:
        """Return a neighbour with its plan at our period; None without a usable plan."""
        plan, period_s = neighbour.plan, self._period_s
        if not _readable(plan):
            return None
        if plan.period_s == period_s:
            return neighbour
        if not _plausible(*_stacked([neighbour])):
            return None
        count = min(math.ceil((len(plan.eta) - 1) * plan.period_s / period_s), LONGEST_PLAN) + 1
        place = np.arange(count, dtype=np.float64) * (period_s / plan.period_s)
        eta, reference = (interpolate(np.array(rows), place) for rows in (plan.eta, plan.eta_reference))
        return replace(neighbour, plan=replace(plan, period_s=period_s, eta=eta, eta_reference=reference))

    def _steps(self, others: Sequence[Neighbour], now_ns: int) -> tuple[Array, NDArray[np.intp], NDArray[np.intp]]:
        """Of plans stacked in one array: steps since each began, its first row and its last row; (neighbours,)."""
        lengths = np.array([len(neighbour.plan.eta) for neighbour in others])
        since_ns = np.array([now_ns - neighbour.stamp_ns for neighbour in others])
        end = np.add.accumulate(lengths)
        return since_ns / (NS * self._period_s), end - lengths, end - 1

    def _pull(self, others: Sequence[Neighbour], deviation: Array, share: Array) -> tuple[Array, Array]:
        """Return Q_ij times the deviations (neighbours, horizon + 2, 4), interpolated between rows and summed over the
        formation's members, and the sum of their Q_ij."""
        member = np.array([1.0 if neighbour.fresh and neighbour.formation else 0.0 for neighbour in others])
        members = float(np.add.reduce(member))
        if not members:
            return self._no_neighbours.weighted_deviation, self._no_neighbours.weight
        after = member * share
        before, behind = np.array((member - after, after)) @ deviation.reshape(len(others), -1)
        pull = before[:-4] + behind[4:]
        pull *= self._weights
        return pull.reshape(-1, 4), members * self._weight

    def clearance_m(self, neighbour: Neighbour, now_ns: int) -> float:
        """Distance to keep from a neighbour: it grows with the neighbour's silence."""
        keep = 2.0 * self._safety.radius_m
        if neighbour.fresh:
            return keep
        silent_s = max(0.0, (now_ns - neighbour.stamp_ns) / NS)
        return keep + min(self._safety.bubble_mps * silent_s, self._safety.bubble_max_m)

    def clearances_m(self, predictions: NeighbourPredictions, now_ns: int) -> Array:
        """Distances to keep from all neighbours, (neighbours,)."""
        if predictions.fresh_count == len(predictions.neighbours):
            return np.full(predictions.fresh_count, 2.0 * self._safety.radius_m)
        return np.array([self.clearance_m(neighbour, now_ns) for neighbour in predictions.neighbours])

    def required_clearance_m(self, neighbour: Neighbour, own: Priority, now_ns: int) -> float | None:
        """Distance to keep from a neighbour, or None if that robot gives way. Only a robot that we hear and that hears us is
        expected to give way."""
        plan, age_s = neighbour.plan, (now_ns - neighbour.stamp_ns) / NS
        heard_both_ways = neighbour.fresh and neighbour.hears_us
        if heard_both_ways and own.goes_before(Priority(plan.urgent, plan.tracking_error_m), age_s):
            return None
        return self.clearance_m(neighbour, now_ns)

    def half_spaces(
        self, predictions: NeighbourPredictions, own: Array, rank: Priority, now_ns: int, obstacles: Sequence[Obstacle] = ()
    ) -> HalfSpaces:
        """Half-spaces across the lines between predicted positions (A6), to robots and obstacles that come close. `own`
        (horizon + 1, 4) is our predicted path."""
        if not predictions.neighbours and not obstacles:
            return NOWHERE
        here = own.view(np.complex128)[self._nodes, 0]
        bodies = self._robots_near(predictions, own, here, rank, now_ns) if predictions.neighbours else []
        for obstacle in obstacles:
            there, away, apart_m = nearest_border(obstacle, here, [now_ns + ns for ns in self._nodes_ns])
            if apart_m.min() < obstacle.clearance_m + self._safety.margin_m:
                bodies.append((there, away, apart_m - obstacle.clearance_m, obstacle.clearance_m, 1.0))
        return self._across(bodies + self._walls_near(here)) if bodies else NOWHERE

    def _walls_near(self, here: NDArray[np.complex128]) -> list[Body]:
        """Walls, while something else is to be avoided: its half-spaces must not lead into a wall. A robot with nothing to
        avoid needs none, because paths lie within the pool."""
        found: list[Body] = []
        for inwards, half_m in self._walls:
            out = -(here * inwards.conjugate()).real  # towards the wall, from the pool's middle
            if (half_m - out).min() < self._wall_m + self._safety.margin_m:
                there = here + inwards * (out - half_m)
                away = np.full(len(here), inwards, np.complex128)
                found.append((there, away, half_m - out - self._wall_m, self._wall_m, WALL_GIVES))
        return found

    def _robots_near(
        self, predictions: NeighbourPredictions, own: Array, here: NDArray[np.complex128], rank: Priority, now_ns: int
    ) -> list[Body]:
        """Robots to be avoided."""
        apart = here - predictions.position
        distance = np.abs(apart)
        nearest = np.minimum.reduce(distance, axis=1).tolist()
        near_m = (
            self._near_m
            if predictions.fresh_count == len(predictions.neighbours)
            else self._near_m + self._safety.bubble_max_m
        )
        kept = []
        for i, there_m in enumerate(nearest):
            if there_m < near_m:
                keep_m = self.required_clearance_m(predictions.neighbours[i], rank, now_ns)
                if keep_m is not None:
                    level = np.abs(own[self._nodes, 2] - predictions.depth[i]) < keep_m
                    if (level & (distance[i] < keep_m + self._safety.margin_m)).any():
                        away = apart[i] / np.maximum(distance[i], TOUCHING_M)
                        away[distance[i] < TOUCHING_M] = 1.0  # on top of one another: any direction leads out
                        kept.append((predictions.position[i], away, distance[i] - keep_m, keep_m, 1.0))
        return kept

    def _across(self, bodies: list[Body]) -> HalfSpaces:
        """Half-spaces from the nearest bodies."""
        bodies = sorted(bodies, key=lambda body: float(body[2].min()))[:NEAREST]
        there, away = np.concatenate([body[0] for body in bodies]), np.concatenate([body[1] for body in bodies])
        keep, give = np.repeat([body[3:] for body in bodies], len(self._nodes), axis=0).T
        offset = away.real * there.real + away.imag * there.imag + keep
        return HalfSpaces(np.tile(self._nodes, len(bodies)), away, offset, give)


def _readable(plan: Plan) -> bool:
    """True for a plan of plausible length and period."""
    return len(plan.eta) > 0 and plan.eta.shape == plan.eta_reference.shape and SHORTEST_S <= plan.period_s < ABSURD


def _stacked(others: Sequence[Neighbour]) -> tuple[Array, Array]:
    """Poses of all plans in one array, and their deviations from their references without whole turns, (rows, 4) each."""
    eta = np.concatenate([neighbour.plan.eta for neighbour in others])
    with np.errstate(invalid="ignore"):  # infinities that cancel out are found afterwards
        deviation = eta - np.concatenate([neighbour.plan.eta_reference for neighbour in others])
    yaw = deviation[:, 3]
    if not np.abs(yaw).max() <= math.pi:
        ends = np.cumsum([len(neighbour.plan.eta) for neighbour in others])
        for part in np.split(yaw, ends[:-1]):
            part -= TURN * np.rint(part[0] / TURN)
    return eta, deviation


def _plausible(eta: Array, deviation: Array) -> bool:
    """True for numbers that can be poses; false for NaN."""
    return float(np.vdot(eta, eta)) < MOST_TURNED_RAD**2 and float(np.vdot(deviation, deviation)) < ABSURD**2
