"""Planning: the `islands` scene from nothing and again under way, and ways in random worlds beside Shapely and NetworkX.

What is compared in random worlds is the way that is flown, smooth and checked, against the shortest polygonal way that the
peer finds among the same polygons. Collisions are counted on the flown spline, every few millimetres.
"""

from collections.abc import Iterator
from typing import Any

import numpy as np
from scipy.interpolate import CubicSpline

from benchmarks.harness import Row, run_peer, time_us
from groundstation.planning.feasibility import PlanError
from groundstation.planning.replanning import replan
from groundstation.planning.route_planner import NoRoute, find_route
from groundstation.planning.segment import first_segment
from shoal.config.experiment import load_experiment
from shoal.frames import Array

WORLDS = 1000
COMPARED = 60  # of them are given to the peer, which takes about a second for each
AGAIN = 30
HALF_M = (8.0, 8.0)
ENDS = ((-7.0, -7.0), (7.0, 7.0))
REQUIREMENTS = ("shapely==2.1.2", "networkx==3.6.1")


def world(seed: int) -> Array:
    """Discs (k, 3) of up to six islands, each as three robots in a line see it."""
    random = np.random.default_rng([seed, 5])
    count = int(random.integers(1, 7))
    islands = np.column_stack([random.uniform(-6, 6, (count, 2)), random.uniform(0.3, 1.5, count)])
    return np.concatenate([islands + np.array([0.0, -y, 0.3]) for y in (-0.8, 0.0, 0.8)])


def flown(points: Array) -> Array:
    """The spline through waypoints, (n, 2)."""
    knots = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(points, axis=0).T))])
    return np.asarray(CubicSpline(knots, points, bc_type="natural")(np.linspace(0.0, knots[-1], 4000)))


def _islands() -> Iterator[Row]:
    """The whole plan, and a detour in it, with all checks, in ms."""
    experiment = load_experiment("islands")
    segment = first_segment(experiment)
    thing = np.array([[*segment.centre.eta[1000, :2], 0.1]])  # where the centre comes by after 50 s
    plan = time_us(lambda: first_segment(experiment), AGAIN)
    again = time_us(lambda: replan(experiment, segment, 20.0, thing), AGAIN)
    yield Row.of("planner", "plan, islands", "ours", "ms", [t * 1e-3 for t in plan])
    yield Row.of("planner", "replan under way, islands", "ours", "ms", [t * 1e-3 for t in again])


def _task() -> list[dict[str, Any]]:
    """Worlds for the peer: first the islands as a point sees them, then random ones."""
    experiment = load_experiment("islands")
    discs = [(*island.position_m, island.radius_m + 0.45) for island in experiment.islands]
    first = {"discs": discs, "start": (-5.7, -7.4), "goal": (5.7, 7.4), "half": (9.5, 14.5)}
    others = [{"discs": world(k).tolist(), "start": ENDS[0], "goal": ENDS[1], "half": HALF_M} for k in range(COMPARED)]
    return [first, *others]


def run() -> Iterator[Row]:
    """See the module's docstring."""
    yield from _islands()
    task = _task()
    first = task[0]
    ends, discs, half_m = [first["start"], first["goal"]], np.array(first["discs"]), first["half"]
    way = time_us(lambda: find_route(ends, discs, half_m), AGAIN)
    yield Row.of("planner", "way, islands", "ours, smooth and checked", "ms", [t * 1e-3 for t in way])
    lengths: dict[int, float] = {}
    collisions = refused = 0
    for k in range(WORLDS):
        discs = world(k)
        try:
            curve = flown(find_route(ENDS, discs, HALF_M))
        except (NoRoute, PlanError):
            refused += 1
            continue
        apart = np.hypot(*(curve[:, None] - discs[:, :2]).transpose(2, 0, 1)) - discs[:, 2]
        collisions += bool(apart.min() < -1e-6 or np.abs(curve).max() > HALF_M[0] + 1e-9)
        lengths[k] = float(np.hypot(*np.diff(curve, axis=0).T).sum())
    yield Row.of("planner", f"{WORLDS} random worlds", "ours: ways that touch something", "worlds", [float(collisions)])
    yield Row.of("planner", f"{WORLDS} random worlds", "ours: refused, no way or an end not free", "worlds", [float(refused)])
    rows = run_peer("planner_shapely", REQUIREMENTS, task)
    yield from rows[:1]
    lengths_m = {int(row.case) - 1: row.p50 for row in rows[1:]}
    ratios = [lengths[k] / lengths_m[k] for k in sorted(lengths.keys() & lengths_m.keys())]
    if ratios:
        yield Row.of("planner", "length of the flown way", "ours / Shapely + NetworkX", "", ratios)
        missed = float(len(lengths_m.keys() - {-1} - lengths.keys()))
        yield Row.of("planner", f"{COMPARED} random worlds", "the peer has a way, we refuse", "worlds", [missed])
