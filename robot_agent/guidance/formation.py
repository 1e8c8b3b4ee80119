"""Other robots by their plans: their places at our nodes, the formation's pull (35), distances to keep and half-spaces (36).

Distances are horizontal: robots pass beside one another, never above. Otherwise the camera would lose the lower one and the
upper one would break the surface (a controller that was free to use depth did both). Only a robot 2R deeper is out of the way.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from shoal.config.controller import Safety
from shoal.frames import TURN, Array
from shoal.kernels.decorator import kernel
from shoal.kernels.types import Complexes, ComplexTable, Floats, Table
from shoal.messages.messages import Plan

Places = NDArray[np.complex128]  # x + iy in the pool frame, m

NS = 1e9
NEAREST = 4  # robots that can be avoided at once: a sphere touches six in the plane, and meets no more than four first
NODES = 5  # of the horizon that keep their distance from each
TOUCHING_M = 1e-6
LEAST_WEIGHT = 1e-12  # keeps 0/0 out
WALL_M = 0.05  # between a hull and a wall
LEANS_M = 0.02  # a plan so near a half-space's border would be another one without it
SHORTEST_S, ABSURD = 1e-3, 1e4  # limits of what can be a plan: s; m and rad
MOST_TURNED_RAD = 1e8  # a heading counts its turns: days of laps
SILENT_S = 60.0  # of silence: a robot without a station is neutral after 3 s, and has drifted to rest long before
MEANT_S = 1.0  # over which a robot's velocity is taken from its planned reference
WAY_STEP_S, WAY_STEPS = 0.5, 16  # between the places of a way ahead, and how many there are: 8 s
SAME_ERROR_M = 0.02  # tracking errors closer than this give equal priority,
ERROR_RATE_MPS = 0.5  # plus this per second of the message's age: no robot moves faster


class PlanRows(NamedTuple):
    """The poses of a plan (rows, 4), and where they are meant to be."""

    eta: Table
    reference: Table
    period_s: float


@kernel
def are_poses(plan: PlanRows) -> bool:
    """True if the numbers of a plan and of its reference can be poses."""
    fine = len(plan.eta) == len(plan.reference) and len(plan.eta) > 0 and SHORTEST_S <= plan.period_s < ABSURD
    for k in range(len(plan.eta) if fine else 0):
        for c in range(4):
            fine &= (abs(plan.eta[k, c]) < MOST_TURNED_RAD) & (abs(plan.eta[k, c] - plan.reference[k, c]) < ABSURD)
    return fine


@kernel
def sample_plan(plan: PlanRows, at_s: Floats, most_m: float, pose: Table, deviation: Table) -> None:
    """Write the poses (instants, 4) of a plan at instants after its first row, and how far they are from where they are meant
    to be, without whole turns and `most_m` at most. Beyond its ends a plan stands."""
    last, turns = len(plan.eta) - 1, TURN * np.rint((plan.eta[0, 3] - plan.reference[0, 3]) / TURN)
    for k in range(len(at_s)):
        row = min(max(at_s[k] / plan.period_s, 0.0), float(last))
        low = min(int(row), max(last - 1, 0))
        high, share = min(low + 1, last), row - low
        for c in range(4):
            pose[k, c] = plan.eta[low, c] + share * (plan.eta[high, c] - plan.eta[low, c])
            deviation[k, c] = pose[k, c] - plan.reference[low, c] - share * (plan.reference[high, c] - plan.reference[low, c])
        deviation[k, 3] -= turns
        off_m = math.sqrt(deviation[k, 0] ** 2 + deviation[k, 1] ** 2 + deviation[k, 2] ** 2)
        if off_m > most_m:
            for c in range(3):
                deviation[k, c] *= most_m / off_m


@kernel
def present_motion(plan: PlanRows, age_s: float) -> tuple[complex, float, complex]:
    """Place (m) and depth (m) that a plan of an age has now, and its reference's velocity (m/s): the one that its robot
    intends, without what it does to avoid others."""
    last, eta, track = len(plan.eta) - 1, plan.eta, plan.reference
    now = int(min(max(np.rint(age_s / plan.period_s), 0.0), float(last)))
    then = min(now + int(max(np.rint(MEANT_S / plan.period_s), 1.0)), last)
    span_s = plan.period_s * max(then - now, 1)
    velocity = complex((track[then, 0] - track[now, 0]) / span_s, (track[then, 1] - track[now, 1]) / span_s)
    return complex(eta[now, 0], eta[now, 1]), eta[now, 2], velocity


@kernel
def write_intended_way(plan: PlanRows, age_s: float, way: Complexes) -> None:
    """Write the reference's `way` (steps,) from now on: its places WAY_STEP_S apart, less the present one, in m. Beyond the
    plan's end it goes straight on; for a plan that has ended already it rests."""
    track, last, now = plan.reference, len(plan.eta) - 1, max(age_s / plan.period_s, 0.0)
    here = 0j
    for i in range(-1, len(way)):
        row = now + (i + 1) * WAY_STEP_S / plan.period_s
        low = min(int(row), max(last - 1, 0))
        high, share = min(low + 1, last), row - low
        place = complex(
            track[low, 0] + share * (track[high, 0] - track[low, 0]), track[low, 1] + share * (track[high, 1] - track[low, 1])
        )
        if i < 0:
            here = place
        else:
            way[i] = place - here if now < last else 0j


def plan_rows(plan: Plan) -> PlanRows | None:
    """The poses of a plan; None if its numbers cannot be poses."""
    rows = PlanRows(np.array(plan.eta), np.array(plan.eta_reference), plan.period_s)
    return rows if are_poses(rows) else None


def rest_of_plan(plan: Plan, age_s: float, place: complex) -> Plan:
    """The rest of a plan of that age, moved to where its robot is seen: a robot that has fallen silent may still fly it, and
    in the end it rests where it is, not where it meant to."""
    if plan_rows(plan) is None or not abs(place) < ABSURD:
        return plan
    first = min(max(round(age_s / plan.period_s), 0), len(plan.eta) - 1)
    moved = np.array([place.real, place.imag, 0.0, 0.0])
    moved[:2] -= plan.eta[first, :2]
    return replace(plan, eta=plan.eta[first:] + moved, eta_reference=plan.eta_reference[first:] + moved)


def plan_at_rest(place: complex, depth_m: float) -> Plan:
    """The plan of a robot that is seen at a place, and of which nothing else is known: it rests."""
    eta = np.array([[place.real, place.imag, depth_m, 0.0]])
    return Plan(MEANT_S, eta, eta)


class Neighbour(NamedTuple):
    """Another robot's last plan. Fresh plans count for the formation; stale ones only keep a growing distance."""

    robot: int
    stamp_ns: int  # instant of the plan's node 0 on our clock, or of the sight of a silent robot
    plan: Plan
    fresh: bool
    formation: bool = True  # False: only stay clear of it
    hears_us: bool = False  # its plan says so

    @property
    def can_yield(self) -> bool:
        """True if the robot can be expected to give way to us: it has thrust, and each of us hears the other."""
        return self.fresh and self.hears_us and not self.plan.adrift


class Priority(NamedTuple):
    """Priority of a robot (article, section 3.3): urgent task first, then small tracking error. The article's third criterion,
    which robot hears others, comes before both here, and the other way round: see `Neighbour.can_yield`."""

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
    """Bounds normal[i] . (x, y) of node[i] >= offset[i] - slack (36). Nodes count from 1."""

    node: NDArray[np.intp]  # (rows,)
    normal: NDArray[np.complex128]  # (rows,) x + iy
    offset: Array  # (rows,)

    def binds(self, eta: Array) -> bool:
        """True if a plan (horizon + 1, 4) comes within LEANS_M of the border of a half-space, or crosses it."""
        if not len(self.node):
            return False
        along = eta[self.node, 0] * self.normal.real + eta[self.node, 1] * self.normal.imag
        return bool((along < self.offset + LEANS_M).any())


NOWHERE = HalfSpaces(np.zeros(0, np.intp), np.zeros(0, np.complex128), np.zeros(0))


class _NeighbourRows(NamedTuple):
    """Half-spaces of one neighbour at the near nodes, and how far it is beyond the distance to keep."""

    beyond_m: float
    normals: Places
    offsets: Array


class NeighbourPredictions(NamedTuple):
    """The plans of neighbours that can be used, at our instants."""

    neighbours: Sequence[Neighbour]
    pose: Array  # (neighbours, nodes, 4)
    deviation: Array  # (nodes, 4) of our formation's members from where they are meant to be, summed
    members: int
    place_now: Places  # (neighbours,) places as their plans have them now,
    depth_now: Array  # (neighbours,) and depths, m
    intended_velocity: Places  # (neighbours,) velocities x + iy that they mean to have, m/s
    intended_way: ComplexTable  # (neighbours, WAY_STEPS) ways that they mean to go, WAY_STEP_S apart, from where they are


class Formation:
    """Neighbours of one robot: what they mean for its plan."""

    def __init__(
        self,
        safety: Safety,
        nodes_s: Array,
        weight: tuple[float, float, float, float],
        has_leader: bool,
        most_m: float = math.inf,
    ) -> None:
        """`nodes_s` (nodes,) are the instants of our nodes from now, `weight` is Q_ij. A neighbour pulls as if it were
        `most_m` off its path at most: what a plan says beyond that is no motion of a formation."""
        self._safety, self._nodes_s, self._has_leader, self._most_m = safety, nodes_s, has_leader, most_m
        self._near = np.unique(np.linspace(0, len(nodes_s) - 1, NODES + 1)[1:].round().astype(np.intp))
        self.rows = NEAREST * len(self._near)  # half-spaces there can be
        self._nobody = NeighbourPredictions(
            neighbours=(),
            pose=np.zeros((0, len(nodes_s), 4)),
            deviation=np.zeros((len(nodes_s), 4)),
            members=0,
            place_now=np.zeros(0, np.complex128),
            depth_now=np.zeros(0),
            intended_velocity=np.zeros(0, np.complex128),
            intended_way=np.zeros((0, WAY_STEPS), np.complex128),
        )
        self.set_weight(weight)

    def set_weight(self, weight: tuple[float, float, float, float]) -> None:
        """Use another Q_ij from now on, the same for every neighbour."""
        self._weight = np.array(weight)

    def predict_neighbours(self, neighbours: Sequence[Neighbour], now_ns: int) -> NeighbourPredictions:
        """Sample all neighbours' plans at our nodes. A plan whose numbers cannot be poses is left out."""
        if not neighbours:
            return self._nobody
        used, plans = list[Neighbour](), list[PlanRows]()
        for neighbour in neighbours:
            rows = plan_rows(neighbour.plan)
            if rows is not None:
                used.append(neighbour)
                plans.append(rows)
        if not used:
            return self._nobody
        count, nodes = len(used), len(self._nodes_s)
        pose, deviation, total, members = np.empty((count, nodes, 4)), np.empty((nodes, 4)), np.zeros((nodes, 4)), 0
        place, velocity = np.empty(count, np.complex128), np.empty(count, np.complex128)
        depth, way = np.empty(count), np.empty((count, WAY_STEPS), np.complex128)
        for i, (neighbour, rows) in enumerate(zip(used, plans, strict=True)):
            age_s = (now_ns - neighbour.stamp_ns) / NS
            place[i], depth[i], velocity[i] = present_motion(rows, age_s)
            write_intended_way(rows, age_s, way[i])
            sample_plan(rows, self._nodes_s + age_s, self._most_m, pose[i], deviation)
            if neighbour.fresh and neighbour.formation:
                total += deviation
                members += 1
        return NeighbourPredictions(
            neighbours=used,
            pose=pose,
            deviation=total,
            members=members,
            place_now=place,
            depth_now=depth,
            intended_velocity=velocity,
            intended_way=way,
        )

    def pull(self, predictions: NeighbourPredictions, own: Array) -> tuple[Array, Array] | None:
        """The formation's pull on the reference (nodes, 4), and the weight of the errors that goes with it (4,), for the
        weight `own` Q (4,) of a robot by itself; None without other members:

        least of |eta - ref|^2_Q + sum |eta - ref - deviation_j|^2_Qij (35): at ref + (Q + sum Qij)^-1 sum Qij deviation_j.

        A robot with a leader follows its deviation whole, at weight Q."""
        if not predictions.members:
            return None
        if self._has_leader:
            return predictions.deviation, own
        weight = own + predictions.members * self._weight
        return predictions.deviation * (self._weight / np.maximum(weight, LEAST_WEIGHT)), weight

    def clearance_m(self, neighbour: Neighbour, now_ns: int) -> float:
        """Distance to keep from a neighbour: 2R, and more from one that is silent. What is more grows while it is not seen,
        up to a limit, and is gone again SILENT_S after the last word or sight: by then the robot has stopped, and only the
        station can say that it is out of the water."""
        keep, safety = 2.0 * self._safety.radius_m, self._safety
        if neighbour.fresh:
            return keep
        silent_s = max(0.0, (now_ns - neighbour.stamp_ns) / NS)
        return keep + min(safety.bubble_mps * min(silent_s, max(SILENT_S - silent_s, 0.0)), safety.bubble_max_m)

    def clearances_m(self, predictions: NeighbourPredictions, now_ns: int) -> Array:
        """Distances to keep from all neighbours, (neighbours,)."""
        return np.array([self.clearance_m(neighbour, now_ns) for neighbour in predictions.neighbours])

    def required_clearance_m(self, neighbour: Neighbour, own: Priority, now_ns: int) -> float | None:
        """Distance to keep from a neighbour, or None if that robot gives way."""
        plan, age_s = neighbour.plan, (now_ns - neighbour.stamp_ns) / NS
        if neighbour.can_yield and own.goes_before(Priority(plan.urgent, plan.tracking_error_m), age_s):
            return None
        return self.clearance_m(neighbour, now_ns)

    def half_spaces(self, predictions: NeighbourPredictions, own: Array, rank: Priority, now_ns: int) -> HalfSpaces:
        """Half-spaces across the lines from the predicted places of robots that come close to ours (A6), for a robot whose
        pose is `own` (4,): n = (own - place) / |own - place|, n . (x, y) >= n . place + distance to keep."""
        if not predictions.neighbours:
            return NOWHERE
        place, poses = complex(*own[:2].tolist()), predictions.pose[:, self._near]
        away = place - poses[:, :, 0] - 1j * poses[:, :, 1]
        apart_m = np.abs(away)
        chosen: list[_NeighbourRows] = []
        for i, nearest_m in enumerate(apart_m.min(axis=1).tolist()):
            keep_m = self.required_clearance_m(predictions.neighbours[i], rank, now_ns)
            if keep_m is None or nearest_m >= keep_m + self._safety.margin_m:
                continue
            is_near = apart_m[i] < keep_m + self._safety.margin_m
            is_as_deep = np.abs(own[2] - poses[i, :, 2]) < keep_m
            if not (is_near & is_as_deep).any():
                continue
            # on top of one another any direction leads out
            normals = np.where(apart_m[i] >= TOUCHING_M, away[i] / np.maximum(apart_m[i], TOUCHING_M), 1.0)
            offsets = (normals * (place - away[i]).conj()).real + keep_m
            chosen.append(_NeighbourRows(nearest_m - keep_m, normals, offsets))
        if not chosen:
            return NOWHERE
        if len(chosen) > NEAREST:  # their order is kept: the solver goes on from the rows that were active
            farthest_m = sorted(rows.beyond_m for rows in chosen)[NEAREST - 1]
            chosen = [rows for rows in chosen if rows.beyond_m <= farthest_m][:NEAREST]
        return HalfSpaces(
            np.tile(self._near, len(chosen)),
            np.concatenate([rows.normals for rows in chosen]),
            np.concatenate([rows.offsets for rows in chosen]),
        )
