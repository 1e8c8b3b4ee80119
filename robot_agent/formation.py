"""The other robots in the cost and in the constraints: formation terms (35) and collision half-spaces (36).

Distances are horizontal: robots pass beside one another, never above, where the camera would lose the lower one and the
upper one would break the surface (a controller left free to use depth did both). Only a robot 2R deeper is out of the way.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from robot_agent.reference import interpolate
from wire.experiment import Mpc as MpcConfig
from wire.experiment import Safety
from wire.frames import Array, wrap_angle
from wire.messages import Plan

NS = 1e9
NEAREST = 4  # robots that can be avoided at once: a sphere's neighbours in the plane, without those it cannot run into first
NODES = 5  # of the horizon that keep their distance from each
TOUCHING_M = 1e-6
SHORTEST_S, ABSURD = 1e-3, 1e4  # limits of what can be a plan: s; m and rad
SAME_ERROR_M = 0.02  # tracking errors closer than this rank equal: the two robots see each other's figure a step late


@dataclass(frozen=True, eq=False)
class Neighbour:
    """Another robot's last plan. Fresh plans count for the formation; stale ones only keep a growing distance."""

    robot: int
    stamp_ns: int  # instant of the plan's node 0, on our clock
    plan: Plan
    fresh: bool
    formation: bool = True  # False: only stay clear of it


@dataclass(frozen=True)
class Rank:
    """What the article ranks robots by (section 3.3): urgent task, small tracking error, hears others. Higher goes first."""

    urgent: bool
    tracking_error_m: float
    heard: int

    def above(self, other: "Rank") -> bool:
        """True if the other must yield to this one."""
        if self.urgent != other.urgent:
            return self.urgent
        if abs(self.tracking_error_m - other.tracking_error_m) > SAME_ERROR_M:
            return self.tracking_error_m < other.tracking_error_m
        return (self.heard > 0) > (other.heard > 0)


@dataclass(frozen=True, eq=False)
class HalfSpaces:
    """normal[i] . [x, y] of node[i] >= offset[i] - slack. Nodes count from 1."""

    node: NDArray[np.intp]  # (rows,)
    normal: Array  # (rows, 2)
    offset: Array  # (rows,)


NOWHERE = HalfSpaces(np.zeros(0, np.intp), np.zeros((0, 2)), np.zeros(0))


@dataclass(frozen=True, eq=False)
class Company:
    """The neighbours as the controller needs them."""

    pull: Array  # (horizon + 1, 4) sum of Q_ij (eta_j - eta_j^ref): added to Q eta_ref it is the weighted reference
    weight: Array  # (4,) sum of Q_ij
    positions: Array  # (others, horizon + 1, 3) predicted
    distance_m: Array  # (others,) that must be kept
    heard: int


class Formation:
    """Workspaces for one robot."""

    def __init__(self, config: MpcConfig, safety: Safety, period_s: float) -> None:
        self._weight = np.array(config.q_formation)
        self._safety, self._horizon = safety, config.horizon
        self._offsets_s = period_s * np.arange(config.horizon + 1, dtype=np.float64)
        self._nodes = np.unique(np.linspace(0, config.horizon, NODES + 1)[1:].round().astype(np.intp))
        self.rows = NEAREST * len(self._nodes)  # half-spaces there can be

    def company(self, neighbours: Sequence[Neighbour], own: Rank, now_ns: int, action_ns: int) -> Company:
        """Neighbours' predictions on our horizon, whose node 0 is at `action_ns`."""
        pull, weight = np.zeros((self._horizon + 1, 4)), np.zeros(4)
        positions, distances, heard = [], [], 0
        for neighbour in neighbours:
            if not _sound(neighbour):
                continue
            eta, deviation = self._sample(neighbour, action_ns)
            if neighbour.fresh:
                heard += 1
                if neighbour.formation:
                    pull += self._weight * deviation
                    weight += self._weight
            distance = self._distance(neighbour, own, now_ns)
            if distance is not None:
                positions.append(eta[:, :3])
                distances.append(distance)
        stacked = np.array(positions) if positions else np.zeros((0, self._horizon + 1, 3))
        return Company(pull, weight, stacked, np.array(distances), heard)

    def _sample(self, neighbour: Neighbour, action_ns: int) -> tuple[Array, Array]:
        """Its predicted pose and its deviation from its reference at our nodes; beyond its plan's end, the end."""
        plan = neighbour.plan
        place = ((action_ns - neighbour.stamp_ns) / NS + self._offsets_s) / plan.period_s
        rows = interpolate(np.hstack([plan.eta, plan.eta - plan.eta_reference]), place)
        rows[:, 7] = wrap_angle(rows[:, 7])
        return rows[:, :4], rows[:, 4:]

    def _distance(self, neighbour: Neighbour, own: Rank, now_ns: int) -> float | None:
        """How far to stay away, or None if that robot yields. Nobody yields to what cannot be heard."""
        keep = 2.0 * self._safety.radius_m
        if neighbour.fresh:
            plan = neighbour.plan
            return None if own.above(Rank(plan.urgent, plan.tracking_error_m, plan.heard)) else keep
        silent_s = max(0.0, (now_ns - neighbour.stamp_ns) / NS)
        return keep + min(self._safety.bubble_mps * silent_s, self._safety.bubble_max_m)

    def half_spaces(self, company: Company, own: Array) -> HalfSpaces:
        """Half-spaces across the lines between predicted positions, where `own` (horizon + 1, 3) comes close (A6)."""
        if len(company.positions) == 0:
            return NOWHERE
        there = company.positions[:, self._nodes]  # (others, nodes, 3)
        apart = own[self._nodes] - there
        distance = np.hypot(apart[:, :, 0], apart[:, :, 1])
        beside = np.abs(apart[:, :, 2]) < company.distance_m[:, None]
        near = np.flatnonzero((beside & (distance < (company.distance_m + self._safety.margin_m)[:, None])).any(axis=1))
        if len(near) == 0:
            return NOWHERE
        near = near[np.argsort(distance[near].min(axis=1), kind="stable")][:NEAREST]
        away = apart[near, :, :2] / np.maximum(distance[near], TOUCHING_M)[:, :, None]
        away[distance[near] < TOUCHING_M] = (1.0, 0.0)  # on top of one another: any direction leads out
        offset = (away * there[near, :, :2]).sum(axis=2) + company.distance_m[near, None]
        return HalfSpaces(np.tile(self._nodes, len(near)), away.reshape(-1, 2), offset.ravel())


def _sound(neighbour: Neighbour) -> bool:
    """A plan that can be used: of a known length, and numbers that can be poses (false for NaN too)."""
    plan = neighbour.plan
    return (
        len(plan.eta) > 0
        and plan.eta.shape == plan.eta_reference.shape
        and SHORTEST_S <= plan.period_s < ABSURD
        and abs(plan.tracking_error_m) < ABSURD
        and bool(np.abs(plan.eta).max() < ABSURD and np.abs(plan.eta_reference).max() < ABSURD)
    )
