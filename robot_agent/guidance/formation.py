"""Other robots in the cost and in the constraints: formation terms (35) and collision half-spaces (36).

Distances are horizontal: robots pass beside one another, never above. Otherwise the camera would lose the lower one and the
upper one would break the surface (a controller that was free to use depth did both). Only a robot 2R deeper is out of the way.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from robot_agent.guidance.obstacles import Obstacle, nearest_border
from shoal.config.controller import MpcConfig, Safety
from shoal.frames import TURN, Array
from shoal.kernels.decorator import kernel
from shoal.messages.messages import Plan

Places = NDArray[np.complex128]  # x + iy in the pool frame, m

NS = 1e9
NEAREST = 4  # bodies that can be avoided at once: a sphere touches six in the plane, and meets no more than four first
MOST_FRESH = 64  # neighbours: more than there are markers
NODES = 5  # of the horizon that keep their distance from each
TOUCHING_M = 1e-6
LEAST_WEIGHT = 1e-12  # keeps 0/0 out
WALL_M = 0.05  # between a hull and a wall
WALL_GIVES = 0.1  # of what a robot's lines give: 2R hold room enough that hulls do not touch, a wall holds none
LEANS_M = 0.02  # a plan so near a half-space's border would be another one without it
SHORTEST_S, ABSURD = 1e-3, 1e4  # limits of what can be a plan: s; m and rad
MOST_TURNED_RAD = 1e8  # a heading counts its turns: days of laps
SILENT_S = 60.0  # of silence: a robot without a station is neutral after 3 s, and has drifted to rest long before
MEANT_S = 1.0  # over which a robot's velocity is taken from its planned reference
SAME_ERROR_M = 0.02  # tracking errors closer than this give equal priority,
ERROR_RATE_MPS = 0.5  # plus this per second of the message's age: no robot moves faster


@kernel("b1(f8[::1], f8[::1])", part=True)
def are_poses(poses: Array, references: Array) -> bool:
    """True if the numbers of a plan and of its reference, row by row (4 rows,), can be poses."""
    fine = 0
    for i in range(len(poses)):
        fine += (abs(poses[i]) < MOST_TURNED_RAD) & (abs(poses[i] - references[i]) < ABSURD)
    return fine == len(poses)


@kernel("void(f8[:,::1], f8[:,::1], f8, f8, f8, f8[:,::1])", part=True)
def add_deviation(plan: Array, meant: Array, ahead_s: float, period_s: float, told_period_s: float, total: Array) -> None:
    """Add the deviation plan - meant, without whole turns, at ahead_s + k period_s to row k of `total` (nodes, 4)."""
    last, first, between = len(plan) - 1, ahead_s / told_period_s, 0
    if told_period_s == period_s and 0.0 <= first < last:  # in step with ours: one loop over all numbers, in vector registers
        low = int(first)
        between, share = min(last - low, len(total)), first - low
        poses, references, sums = np.ravel(plan), np.ravel(meant), np.ravel(total)
        begin, end = 4 * low, 4 * (low + between)
        pose, reference, next_pose, next_reference = (
            poses[begin:end], references[begin:end], poses[begin + 4 : end + 4], references[begin + 4 : end + 4]
        )  # fmt: skip
        for i in range(end - begin):
            before = pose[i] - reference[i]
            sums[i] += before + share * (next_pose[i] - next_reference[i] - before)
    for k in range(between, len(total)):
        place = min(max(first + k * period_s / told_period_s, 0.0), float(last))
        low = int(place)
        high, share = min(low + 1, last), place - low
        for c in range(4):
            before, after = plan[low, c] - meant[low, c], plan[high, c] - meant[high, c]
            total[k, c] += before + share * (after - before)
    turns = TURN * np.rint((plan[0, 3] - meant[0, 3]) / TURN)
    if turns != 0.0:
        for k in range(len(total)):
            total[k, 3] -= turns


@kernel(
    "i8(f8[:,::1], f8[::1], f8[:,::1], f8, f8, i8[::1], f8[::1],"
    " b1[::1], f8[:,::1], f8[::1], c16[:,::1], f8[:,::1], c16[::1], f8[::1], c16[::1])"
)
def sample_plans(
    rows: Array,
    numbers: Array,
    told: Array,
    dead_s: float,
    period_s: float,
    node: NDArray[np.int64],
    weight: Array,
    usable: NDArray[np.bool_],
    pull: Array,
    pull_weight: Array,
    position: Places,
    depth: Array,
    place_now: Places,
    depth_now: Array,
    velocity: Places,
) -> int:
    """Sample the neighbours' plans at our own instants. Each plan's poses and then its references stand below one another in
    `rows` (all rows, 4); `numbers` (4 all rows,) is the same memory, row by row. `told` (robots, 5) has for each plan how many
    it has of both, its age in ns, its period in s, and 1 for a member.

    Row k of a horizon lies dead_s + k period_s ahead. `pull` (nodes, 4) is the sum over the members of `weight` (4,) times
    their deviation eta - reference, without whole turns, and `pull_weight` (4,) that of the weights. `position` and `depth`
    (robots, len(node)) are those at `node`; `place_now` and `depth_now` (robots,) are those now, `velocity` is the reference's
    mean one over MEANT_S from now on. Beyond its ends a plan stands. A plan that is not `usable` (robots,) holds numbers that
    can be no poses. Returns how many are not.
    """
    first, unusable, members = 0, 0, 0
    pull[:] = 0.0
    for i in range(len(told)):
        poses, references, age_s, period = int(told[i, 0]), int(told[i, 1]), told[i, 2] / NS, told[i, 3]
        plan, meant, last = rows[first : first + poses], rows[first + poses : first + poses + references], poses - 1
        begin, end, next_plan = 4 * first, 4 * (first + poses), 4 * (first + poses + references)
        first += poses + references
        fine = poses == references and last >= 0 and SHORTEST_S <= period < ABSURD
        fine = fine and are_poses(numbers[begin:end], numbers[end:next_plan])
        usable[i] = fine
        if not fine:
            unusable += 1
            continue
        if told[i, 4] != 0.0:
            members += 1
            add_deviation(plan, meant, age_s + dead_s, period_s, period, pull)
        for j in range(len(node)):
            place = min(max((age_s + dead_s + node[j] * period_s) / period, 0.0), float(last))
            low = int(place)
            high, share = min(low + 1, last), place - low
            position[i, j] = complex(
                plan[low, 0] + share * (plan[high, 0] - plan[low, 0]), plan[low, 1] + share * (plan[high, 1] - plan[low, 1])
            )
            depth[i, j] = plan[low, 2] + share * (plan[high, 2] - plan[low, 2])
        now = int(min(max(np.rint(age_s / period), 0.0), float(last)))
        then = min(now + max(int(np.rint(MEANT_S / period)), 1), last)
        span_s = period * max(then - now, 1)
        place_now[i], depth_now[i] = complex(plan[now, 0], plan[now, 1]), plan[now, 2]
        velocity[i] = complex((meant[then, 0] - meant[now, 0]) / span_s, (meant[then, 1] - meant[now, 1]) / span_s)
    for c in range(4):
        pull_weight[c] = members * weight[c]
        for k in range(len(pull)):
            pull[k, c] *= weight[c]
    return unusable


@kernel("void(c16[:,::1], f8[:,::1], i8[::1], f8[::1])")
def nearest(position: Places, own: Array, node: NDArray[np.int64], apart_m: Array) -> None:
    """Least distance (robots,) between the places of `own` (horizon + 1, 4) at `node` and `position` (robots, len(node))."""
    for i in range(len(position)):
        apart_m[i] = np.inf
        for j in range(len(node)):
            x, y = own[node[j], 0] - position[i, j].real, own[node[j], 1] - position[i, j].imag
            apart_m[i] = min(apart_m[i], math.sqrt(x * x + y * y))


@kernel("f8(c16[::1], f8[::1], f8[:,::1], i8[::1], f8, f8, c16[::1], f8[::1])")
def tangents(
    position: Places,
    depth: Array,
    own: Array,
    node: NDArray[np.int64],
    keep_m: float,
    margin_m: float,
    normal: Places,
    offset: Array,
) -> float:
    """Half-spaces (36) across the lines from a robot's predicted `position` (nodes,) to ours, at the distance `keep_m`:
    n = (own - position) / |own - position|, n . (x, y) >= n . position + keep_m.

    Returns by how much more than `keep_m` the nearest is away; infinity if no node is both level with us and nearer than
    keep_m + margin_m.
    """  # fmt: skip
    least_m, counts = np.inf, False
    for j in range(len(node)):
        x, y = own[node[j], 0] - position[j].real, own[node[j], 1] - position[j].imag
        apart_m = math.sqrt(x * x + y * y)
        # on top of one another any direction leads out
        normal[j] = complex(x / apart_m, y / apart_m) if apart_m >= TOUCHING_M else complex(1.0, 0.0)
        offset[j] = normal[j].real * position[j].real + normal[j].imag * position[j].imag + keep_m
        least_m = min(least_m, apart_m - keep_m)
        counts |= abs(own[node[j], 2] - depth[j]) < keep_m and apart_m < keep_m + margin_m
    return least_m if counts else np.inf


@kernel("b1(f8[:,::1], i8[::1], c16[::1], f8[::1])")
def leans(eta: Array, node: NDArray[np.int64], normal: Places, offset: Array) -> bool:
    """True if a plan (horizon + 1, 4) comes within LEANS_M of the border of a half-space, or crosses it."""
    for i in range(len(node)):
        if eta[node[i], 0] * normal[i].real + eta[node[i], 1] * normal[i].imag < offset[i] + LEANS_M:
            return True
    return False


@kernel("void(f8[:,::1], f8[:,::1], f8[::1], f8[::1], b1, f8[:,::1], f8[::1])")
def formation_reference(
    reference: Array, deviation: Array, q: Array, q_sum: Array, has_leader: bool, moved: Array, weight: Array
) -> None:
    """Least of |eta - reference|^2_Q + sum |eta - reference - deviation_j|^2_Qij (35): where the formation moves the
    reference, and its `weight` (4,):

        moved = reference + (Q + sum Qij)^-1 sum Qij deviation_j      weight = Q + sum Qij

    `deviation` (nodes, 4) is sum Qij deviation_j, `q` is Q and `q_sum` is sum Qij, diagonals (4,). `reference` and `moved`
    (nodes + 1, 4) have a row for now before the nodes. A robot with a leader follows its deviation whole, at weight Q.
    """
    for c in range(4):
        weight[c] = q[c] if has_leader else q[c] + q_sum[c]
        per = q_sum[c] if has_leader else max(weight[c], LEAST_WEIGHT)
        for k in range(len(reference)):
            moved[k, c] = reference[k, c] + deviation[max(k - 1, 0), c] / per


class Neighbour(NamedTuple):
    """Another robot's last plan. Fresh plans count for the formation; stale ones only keep a growing distance."""

    robot: int
    stamp_ns: int  # instant of the plan's node 0, on our clock
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
    """Bounds normal[i] . (x, y) of node[i] >= offset[i] - give[i] slack (36). Nodes count from 1."""

    node: NDArray[np.intp]  # (rows,)
    normal: NDArray[np.complex128]  # (rows,) x + iy
    offset: Array  # (rows,)
    give: Array | None = None  # (rows,); None: 1 in all

    def binds(self, eta: Array) -> bool:
        """True if a plan (horizon + 1, 4) lies against any of the bounds."""
        return bool(len(self.node)) and leans(eta, self.node, self.normal, self.offset)


# What is to be kept clear of: how far beyond the distance to keep the nearest node is, m; normals and offsets of its
# half-spaces, (nodes,) each; and how much they give when not all can be kept.
Body = tuple[float, Places, Array, float]

NOWHERE = HalfSpaces(np.zeros(0, np.intp), np.zeros(0, np.complex128), np.zeros(0))


class NeighbourPredictions(NamedTuple):
    """Neighbours' plans at our instants, as the controller needs them. Valid until the next are made."""

    weighted_deviation: Array  # (horizon + 1, 4) sum of Q_ij (eta_j - eta_j^ref), to be added to Q eta_ref
    weight: Array  # (4,) sum of Q_ij
    has_members: bool  # some of them belong to our formation
    fresh_count: int
    neighbours: Sequence[Neighbour]  # whose plans can be used
    position: NDArray[np.complex128]  # (neighbours, nodes) predicted x + iy, at the nodes where distance is kept
    depth: Array  # (neighbours, nodes)
    place_now: Places  # (neighbours,) places as their plans have them now,
    depth_now: Array  # (neighbours,) and depths, m
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
        self._safety, self._period_s, self._dead_s = safety, period_s, dead_s
        self.set_weight(config.q_formation)
        self._nodes = np.unique(np.linspace(0, config.horizon, NODES + 1)[1:].round().astype(np.int64))
        self._nodes_ns = np.rint(NS * (dead_s + period_s * self._nodes)).astype(np.int64).tolist()
        self.rows = NEAREST * len(self._nodes)  # half-spaces there can be
        self._wall_m = hull_m + WALL_M
        self._walls = [] if room_m is None else [(-way, 0.5 * size) for way, size in zip((1, 1j), room_m, strict=True)]
        self._walls += [(-inwards, half_m) for inwards, half_m in self._walls]
        self._near_m = 2.0 * safety.radius_m + safety.margin_m
        self._horizon = config.horizon
        self._memory: dict[int, tuple[NDArray[Any], ...]] = {}  # by the number of neighbours
        self._no_neighbours = NeighbourPredictions(
            np.zeros((config.horizon + 1, 4)), np.zeros(4), False, 0, (), *self._room(0)
        )
        self._clearance_m = np.full(MOST_FRESH, 2.0 * safety.radius_m)
        self._node_rows, self._all_gives = np.tile(self._nodes, NEAREST), np.ones(self.rows)

    def _room(self, count: int) -> tuple[NDArray[Any], ...]:
        """Memory for the positions, depths, places and depths now, and velocities of so many neighbours."""
        if count not in self._memory:
            kept = len(self._nodes)
            self._memory[count] = (
                np.empty((count, kept), np.complex128), np.empty((count, kept)), np.empty(count, np.complex128),
                np.empty(count), np.empty(count, np.complex128),
            )  # fmt: skip
        return self._memory[count]

    def set_weight(self, q: tuple[float, float, float, float]) -> None:
        """Use another Q_ij from now on, the same for every neighbour."""
        self._weight = np.array(q)

    def predict_neighbours(self, neighbours: Sequence[Neighbour], now_ns: int) -> NeighbourPredictions:
        """Sample all neighbours' plans on our horizon, together."""
        if not neighbours:
            return self._no_neighbours
        rows: list[Array] = []
        told: list[float] = []
        fresh_count = 0
        for _, stamp_ns, plan, fresh, formation, _ in neighbours:
            rows += plan.eta, plan.eta_reference
            told += len(plan.eta), len(plan.eta_reference), now_ns - stamp_ns, plan.period_s, fresh and formation
            fresh_count += fresh
        usable, sampled = np.empty(len(neighbours), bool), self._room(len(neighbours))
        deviation, weight, together = np.empty((self._horizon + 1, 4)), np.empty(4), np.concatenate(rows)
        unusable = sample_plans(
            together, together.reshape(-1), np.array(told, np.float64).reshape(-1, 5), self._dead_s, self._period_s,
            self._nodes, self._weight, usable, deviation, weight, *sampled,
        )  # fmt: skip
        if unusable:
            return self.predict_neighbours([n for n, is_usable in zip(neighbours, usable, strict=True) if is_usable], now_ns)
        return NeighbourPredictions(deviation, weight, any(told[4::5]), fresh_count, neighbours, *sampled)

    def clearance_m(self, neighbour: Neighbour, now_ns: int) -> float:
        """Distance to keep from a neighbour: 2R, and more from one that is silent. What is more grows with the silence, up to
        a limit, and is gone again SILENT_S after the last word: by then the robot has stopped, and only the station can say
        that it is out of the water."""
        keep, safety = 2.0 * self._safety.radius_m, self._safety
        if neighbour.fresh:
            return keep
        silent_s = max(0.0, (now_ns - neighbour.stamp_ns) / NS)
        return keep + min(safety.bubble_mps * min(silent_s, max(SILENT_S - silent_s, 0.0)), safety.bubble_max_m)

    def clearances_m(self, predictions: NeighbourPredictions, now_ns: int) -> Array:
        """Distances to keep from all neighbours, (neighbours,)."""
        count = len(predictions.neighbours)
        if predictions.fresh_count == count <= MOST_FRESH:
            return self._clearance_m[:count]
        return np.array([self.clearance_m(neighbour, now_ns) for neighbour in predictions.neighbours])

    def required_clearance_m(self, neighbour: Neighbour, own: Priority, now_ns: int) -> float | None:
        """Distance to keep from a neighbour, or None if that robot gives way."""
        plan, age_s = neighbour.plan, (now_ns - neighbour.stamp_ns) / NS
        if neighbour.can_yield and own.goes_before(Priority(plan.urgent, plan.tracking_error_m), age_s):
            return None
        return self.clearance_m(neighbour, now_ns)

    def half_spaces(
        self, predictions: NeighbourPredictions, own: Array, rank: Priority, now_ns: int, obstacles: Sequence[Obstacle] = ()
    ) -> HalfSpaces:
        """Half-spaces across the lines between predicted positions (A6), to robots and obstacles that come close. `own`
        (horizon + 1, 4) is our predicted path."""
        if not predictions.neighbours and not obstacles:
            return NOWHERE
        bodies = self._robots_near(predictions, own, rank, now_ns) if predictions.neighbours else []
        if not bodies and not obstacles:
            return NOWHERE
        if obstacles or self._walls:
            here = own.view(np.complex128)[self._nodes, 0]
            bodies += self._obstacles_near(obstacles, here, now_ns)
            bodies += self._walls_near(here) if bodies else []
        return self._combined(bodies) if bodies else NOWHERE

    def _obstacles_near(self, obstacles: Sequence[Obstacle], here: Places, now_ns: int) -> list[Body]:
        """Obstacles to be avoided from places (nodes,)."""
        found: list[Body] = []
        for obstacle in obstacles:
            there, away, apart_m = nearest_border(obstacle, here, [now_ns + ns for ns in self._nodes_ns])
            beyond_m = float(apart_m.min()) - obstacle.clearance_m
            if beyond_m < self._safety.margin_m:
                found.append((beyond_m, away, (there * away.conj()).real + obstacle.clearance_m, 1.0))
        return found

    def _walls_near(self, here: Places) -> list[Body]:
        """Walls, while something else is to be avoided: its half-spaces must not lead into a wall. A robot with nothing to
        avoid needs none, because paths lie within the pool."""
        found: list[Body] = []
        for inwards, half_m in self._walls:
            keep_m = self._wall_m - half_m  # from the pool's middle
            beyond_m = float((here * inwards.conjugate()).real.min()) - keep_m
            if beyond_m < self._safety.margin_m:
                found.append((beyond_m, np.full(len(here), inwards, np.complex128), np.full(len(here), keep_m), WALL_GIVES))
        return found

    def _robots_near(self, predictions: NeighbourPredictions, own: Array, rank: Priority, now_ns: int) -> list[Body]:
        """Robots to be avoided."""
        count, all_fresh = len(predictions.neighbours), predictions.fresh_count == len(predictions.neighbours)
        apart_m = np.empty(count)
        nearest(predictions.position, own, self._nodes, apart_m)
        near_m = self._near_m if all_fresh else self._near_m + self._safety.bubble_max_m
        found: list[Body] = []
        for i in [i for i, there_m in enumerate(apart_m.tolist()) if there_m < near_m]:
            keep_m = self.required_clearance_m(predictions.neighbours[i], rank, now_ns)
            if keep_m is not None:
                normal, offset = np.empty(len(self._nodes), np.complex128), np.empty(len(self._nodes))
                beyond_m = tangents(
                    predictions.position[i], predictions.depth[i], own, self._nodes, keep_m, self._safety.margin_m, normal,
                    offset,
                )  # fmt: skip
                if beyond_m < math.inf:
                    found.append((beyond_m, normal, offset, 1.0))
        return found

    def _combined(self, bodies: list[Body]) -> HalfSpaces:
        """Half-spaces from the nearest bodies. Their order is kept: the solver goes on from each row's last multiplier."""
        if len(bodies) > NEAREST:
            farthest_m = sorted(beyond_m for beyond_m, *_ in bodies)[NEAREST - 1]
            bodies = [body for body in bodies if body[0] <= farthest_m][:NEAREST]
        _, normals, offsets, gives = zip(*bodies, strict=True)
        rows = len(bodies) * len(self._nodes)
        give = self._all_gives[:rows] if min(gives) == 1.0 else np.repeat(gives, len(self._nodes))
        return HalfSpaces(self._node_rows[:rows], _joined(normals), _joined(offsets), give)


def _joined(parts: tuple[NDArray[Any], ...]) -> NDArray[Any]:
    return np.concatenate(parts) if len(parts) > 1 else parts[0]
