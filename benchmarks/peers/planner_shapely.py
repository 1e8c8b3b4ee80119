"""The shortest way among discs as one would do it with Shapely and NetworkX: a visibility graph of polygons, and A* over it.

Standard input: worlds, each with discs (x, y, radius), start, goal, half (the basin's half sides). Discs become polygons as
ours do, with the same number of corners, so lengths are of the same ways.
"""

import importlib
import json
import math
import sys
import time
from typing import Any

from benchmarks.harness import Row

networkx: Any = importlib.import_module("networkx")
shapely: Any = importlib.import_module("shapely")

CORNERS = 24
SHRINK = 1e-6  # an edge along a polygon's side does not cross it


def shortest(world: dict[str, Any]) -> float | None:
    """Length of the shortest way in m; None if there is none."""
    half_x, half_y = world["half"]
    polygons, corners = [], []
    for x, y, radius in world["discs"]:
        rim = radius / math.cos(math.pi / CORNERS)
        angles = [2.0 * math.pi * k / CORNERS for k in range(CORNERS)]
        ring = [(x + rim * math.cos(a), y + rim * math.sin(a)) for a in angles]
        polygons.append(shapely.Polygon(ring))
        corners += [p for p in ring if abs(p[0]) <= half_x and abs(p[1]) <= half_y]
    solid = shapely.union_all(polygons).buffer(-SHRINK)
    shapely.prepare(solid)
    points = [tuple(world["start"]), tuple(world["goal"])]
    points += [p for p in corners if not shapely.contains_xy(solid, *p)]
    graph = networkx.Graph()
    pairs = [(i, k) for i in range(len(points)) for k in range(i)]
    lines = shapely.linestrings([[points[i], points[k]] for i, k in pairs])
    crosses = shapely.intersects(solid, lines)
    for (i, k), crossing in zip(pairs, crosses, strict=True):
        if not crossing:
            graph.add_edge(i, k, weight=math.dist(points[i], points[k]))
    try:
        return float(networkx.astar_path_length(graph, 0, 1, lambda i, k: math.dist(points[i], points[k])))
    except (networkx.NetworkXNoPath, networkx.NodeNotFound):
        return None


def main() -> None:
    """Rows: time of the first world, again and again; length of every world's way, in order, as rows of one sample."""
    worlds = json.load(sys.stdin)
    times_ms = []
    for _ in range(10):
        begin = time.perf_counter()
        shortest(worlds[0])
        times_ms.append((time.perf_counter() - begin) * 1e3)
    rows = [Row.of("planner", "way, islands", "Shapely + NetworkX", "ms", times_ms)]
    rows += [
        Row.of("planner", str(k), "length", "m", [length])
        for k, length in enumerate(map(shortest, worlds))
        if length is not None
    ]
    print(json.dumps([row.as_dict() for row in rows]))


if __name__ == "__main__":
    main()
