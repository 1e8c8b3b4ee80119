"""A formation's way around islands: how wide it is, and paths to try, narrow ones first. Pure."""

import math
from collections.abc import Iterator, Sequence

import numpy as np

from groundstation.planning.formation import SlotOffset
from groundstation.planning.route_planner import NoRoute, route
from wire.config.experiment import Experiment
from wire.config.scene import Route, Waypoints
from wire.frames import Array

WIDTHS = 6  # from what a turning formation is across, as if the path were straight, to a disc that holds all of it


def ways(experiment: Experiment, given: Route, nodes: Sequence[SlotOffset]) -> Iterator[Waypoints]:
    """Waypoints of a spline. A formation that keeps its form and orientation has one way; one that turns or changes is taken
    for discs wider and wider, as nodes swing outside the path in bends: whoever asks takes the first that is clear.

    Raises NoRoute if there is no (further) way.
    """
    room_m = experiment.vehicle.radius_m + given.clearance_m
    places = np.concatenate([node.place_m[:, :2] for node in nodes])
    if experiment.formation.mode == "translate" and not experiment.formation.changes:
        yield _waypoints(experiment, given, room_m, np.array([node.place_m[0, :2] for node in nodes]), 0.0)
        return
    whole_m = float(np.hypot(*places.T).max())
    across_m = float(np.abs(places[:, 0]).max()) if experiment.formation.mode == "rotate" else whole_m
    found = False
    for wide_m in np.unique(np.linspace(across_m, whole_m, WIDTHS)).tolist():
        try:
            yield _waypoints(experiment, given, room_m, np.zeros((1, 2)), wide_m)
        except NoRoute as error:
            if found:
                raise NoRoute(
                    "in the bends of this way nodes would touch an island or a wall; wider gaps are needed"
                ) from None
            raise error
        found = True


def _waypoints(experiment: Experiment, given: Route, room_m: float, at_m: Array, wide_m: float) -> Waypoints:
    """For nodes `at_m` (n, 2) around the centre, each a disc of `wide_m` more than hull and clearance."""
    islands = [(np.array(island.position_m), island.radius_m + room_m + wide_m) for island in experiment.islands]
    discs = np.array([(*(place - at), radius) for place, radius in islands for at in at_m]).reshape(-1, 3)
    length, width, _ = experiment.pool.size_m
    reach = np.abs(at_m).max(axis=0) + room_m + wide_m
    walls = experiment.pool.walls
    half_m = (length / 2.0 - float(reach[0]), width / 2.0 - float(reach[1])) if walls else (math.inf, math.inf)
    points = route(given.via_m, discs, half_m, given.smooth_m)
    return Waypoints(
        kind="waypoints",
        points_m=tuple((x, y) for x, y in points.tolist()),
        speed_mps=given.speed_mps,
        depth_m=given.depth_m,
        slow=given.slow,
        stop=given.stop,
    )
