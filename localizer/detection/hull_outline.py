"""Outline of a spherical hull in the picture: where the robot's centre is, whatever its lean.

    expected outline -> change of colour across it, ray by ray -> strongest circle near it -> robust least squares, twice

The plate lies on top of the hull and moves with its lean; the outline of a sphere does not. Seen from D (apparent distance) it
is the circle of radius r sqrt(1 - r^2 / D^2), r^2 / D nearer to the camera than the centre, across the line of sight; its
points are projected through the water one by one. A hull of another size, half hidden, or hardly to be told from what is
behind it, gives no centre. A disc does, and a wrong one: it looks as round at another depth.
"""

from dataclasses import dataclass

import numpy as np

from localizer.camera_model import RefractiveCamera
from localizer.detection.image_regions import DemosaicedRegion
from shoal.frames import Array
from shoal.kernels.decorator import kernel
from shoal.kernels.types import Floats, Image, Table

_RAYS = 48
_ANGLES = 2.0 * np.pi * np.arange(_RAYS) / _RAYS
_AROUND = np.column_stack([np.cos(_ANGLES), np.sin(_ANGLES)])  # (rays, 2)
_COARSE = 2  # px, step of the first search; edges are 3 px wide
_MORE_RADIUS = 3  # px by which the radius may be another in the first search
_WINDOWS_PX = (4.0, 2.5)  # px around the circle found last in which edges are looked for
_LEAST_EDGE = 3.0  # grey levels over 2 px: the sensor's noise makes 1
_FLOOR = 0.25  # of the rays' median edge: weaker ones do not count
_CAP = 1.5  # of it: no single edge, of the plate or a tile, counts more
_INSIDE_PX = 0.75  # px from the circle, of an edge that belongs to it
_LEAST_SHARE = 0.7  # of rays with such an edge; chance gives 0.3
_MOST_OTHER = 0.04  # of the radius
_GROWN = 1.02  # a little larger outline, from which directions across it are had
_HIGHER_M = 0.01  # between two points of a line of sight
_ROUNDS = 5  # of robust least squares; weights settle in three


@dataclass(frozen=True, eq=False)
class HullCentre:
    """Place x, y of a hull's centre (2,) [m] and its standard deviation in the picture [px], from the scatter of edges."""

    position_m: Array
    sigma_px: float


def find_hull(
    view: RefractiveCamera, region: DemosaicedRegion, expected_m: Array, radius_m: float, reach_px: int
) -> HullCentre | None:
    """The centre of a hull of `radius_m` expected at (3,), as far off as `reach_px` in the whole picture's pixels."""
    centre, radius = np.array(expected_m), radius_m
    circle = np.empty(5)
    for window_px in (None, *_WINDOWS_PX):
        across = _across(view, centre)
        rims = [_silhouette(view, centre, across, metres) for metres in (radius, _GROWN * radius)]
        pixels = view.pool_to_pixel(np.concatenate(rims))
        if not np.all(np.isfinite(pixels)):
            return None
        inner, outer = pixels[:_RAYS], pixels[_RAYS:]
        growth = np.linalg.norm(outer - inner, axis=1)
        px_per_m = float(np.median(growth)) / ((_GROWN - 1.0) * radius)
        k = reach_px + _MORE_RADIUS if window_px is None else int(np.ceil(_WINDOWS_PX[0])) + 1
        edges = np.empty((_RAYS, 2 * k + 1))
        normals = (outer - inner) / growth[:, None] / region.shrink
        outline_edges(region.bgr, np.ascontiguousarray(region.place(inner)), normals, edges)
        typical = float(np.median(edges.max(axis=1)))
        if typical < _LEAST_EDGE:
            return None
        np.minimum(edges, _CAP * typical, out=edges)
        if window_px is None:
            strongest_circle(edges, _AROUND, reach_px, circle)
        else:
            fit_circle(edges, _AROUND, window_px, _FLOOR * typical, circle)
        centre[:2] += np.linalg.solve(across[:, :2], circle[:2] / px_per_m)
        radius += circle[2] / px_per_m
        if abs(radius / radius_m - 1.0) > 3.0 * _MOST_OTHER:
            return None
    if circle[3] < _LEAST_SHARE or abs(radius / radius_m - 1.0) > _MOST_OTHER:
        return None
    return HullCentre(centre[:2], float(circle[4]) * float(np.sqrt(2.0 / (_RAYS * circle[3]))))


def _across(view: RefractiveCamera, centre: Array) -> Array:
    """Two directions (2, 3) across the line of sight in the water at a point (3,), the first one without y."""
    pixel = view.pool_to_pixel(centre[None])
    (here,) = view.pixel_to_pool(pixel, centre[2])
    (above,) = view.pixel_to_pool(pixel, centre[2] - _HIGHER_M)  # on the same line of sight
    sight = np.array([*(here - above), _HIGHER_M])
    sight /= np.linalg.norm(sight)
    sight_x, _, sight_z = sight
    without_y = np.array([sight_z, 0.0, -sight_x]) / np.hypot(sight_x, sight_z)
    return np.array([without_y, _cross(sight, without_y)])


def _cross(a: Array, b: Array) -> Array:
    """The cross product of two vectors (3,), in a fifth of `np.cross`'s time."""
    (ax, ay, az), (bx, by, bz) = a.tolist(), b.tolist()
    return np.array([ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx])


def _silhouette(view: RefractiveCamera, centre: Array, across: Array, radius: float) -> Array:
    """Points (rays, 3) of a sphere where lines of sight touch it, with the two directions across them."""
    down = _cross(across[0], across[1])
    away_m = view.apparent_m(centre)
    return np.asarray(centre - radius**2 / away_m * down + radius * np.sqrt(1.0 - (radius / away_m) ** 2) * (_AROUND @ across))


@kernel
def outline_edges(picture: Image, points: Table, normals: Table, edges: Table) -> None:
    """`edges` (n, 2 k + 1): the change of colour between points + (j - 1) normals and points + (j + 1) normals (n, 2) of a
    `picture` (height, width, 3), bilinear, for j = -k ... k. 0 where one of them is not in it."""
    height, width = picture.shape[0], picture.shape[1]
    steps = edges.shape[1] + 2
    colours = np.empty((steps, 3))
    for i in range(points.shape[0]):
        for m in range(steps):
            j = m - steps // 2
            x = points[i, 0] + j * normals[i, 0]
            y = points[i, 1] + j * normals[i, 1]
            if x < 0.0 or y < 0.0 or x > width - 1.0 or y > height - 1.0:
                for c in range(3):
                    colours[m, c] = np.nan
                continue
            column = min(int(x), width - 2)
            row = min(int(y), height - 2)
            along = x - column
            below = y - row
            for c in range(3):
                upper = picture[row, column, c] * (1.0 - along) + picture[row, column + 1, c] * along
                lower = picture[row + 1, column, c] * (1.0 - along) + picture[row + 1, column + 1, c] * along
                colours[m, c] = upper * (1.0 - below) + lower * below
        for m in range(edges.shape[1]):
            change = 0.0
            for c in range(3):
                difference = colours[m + 2, c] - colours[m, c]
                change += difference * difference
            edges[i, m] = np.sqrt(change) if change >= 0.0 else 0.0  # 0 for NaN


@kernel
def strongest_circle(edges: Table, around: Table, reach: int, circle: Floats) -> None:
    """Shift and growth (dx, dy, dr) of the circle with the strongest edges, in steps of them: an edge of ray i lies at
    dx around[i, 0] + dy around[i, 1] + dr from the middle of its row. Into found[:3]."""
    middle = edges.shape[1] // 2
    best = -1.0
    for a in range(-reach, reach + 1, _COARSE):
        for b in range(-reach, reach + 1, _COARSE):
            if a * a + b * b > reach * reach:
                continue
            for c in range(-_MORE_RADIUS, _MORE_RADIUS + 1):
                total = 0.0
                for i in range(edges.shape[0]):
                    total += edges[i, int(np.rint(a * around[i, 0] + b * around[i, 1])) + c + middle]
                if total > best:
                    best = total
                    circle[0], circle[1], circle[2] = a, b, c


@kernel
def fit_circle(edges: Table, around: Table, window: float, least: float, circle: Floats) -> None:
    """The same circle by robust least squares (Cauchy) through each row's strongest edge within `window` of its middle, to a
    fraction of a step, if it is `least` at least. `circle` (5,): dx, dy, dr, the share of rays whose edge lies on the circle,
    and the RMS distance of these edges from it."""
    rays, middle = edges.shape[0], edges.shape[1] // 2
    at = np.zeros(rays)
    counts = np.zeros(rays)
    for i in range(rays):
        top = middle
        for m in range(1, edges.shape[1] - 1):
            if abs(m - middle) <= window and edges[i, m] > edges[i, top]:
                top = m
        before, here, after = edges[i, top - 1], edges[i, top], edges[i, top + 1]
        bend = before - 2.0 * here + after
        part = 0.5 * (before - after) / bend if bend < 0.0 else 0.0
        at[i] = top - middle + min(max(part, -1.0), 1.0)
        counts[i] = 1.0 if here >= least else 0.0
    circle[:] = 0.0
    for _ in range(_ROUNDS):
        normal = np.zeros((3, 4))
        for i in range(rays):
            off = at[i] - circle[0] * around[i, 0] - circle[1] * around[i, 1] - circle[2]
            weight = counts[i] / (1.0 + (off / _INSIDE_PX) ** 2)
            row = (around[i, 0], around[i, 1], 1.0, off)
            for j in range(3):
                for c in range(4):
                    normal[j, c] += weight * row[j] * row[c]
        for j in range(3):  # by elimination; a tenth of a ray of each direction keeps it regular
            normal[j, j] += 0.1
        for j in range(3):
            for r in range(3):
                if r != j:
                    share = normal[r, j] / normal[j, j]
                    for c in range(4):
                        normal[r, c] -= share * normal[j, c]
        for j in range(3):
            circle[j] += normal[j, 3] / normal[j, j]
    on = 0
    squares = 0.0
    for i in range(rays):
        off = at[i] - circle[0] * around[i, 0] - circle[1] * around[i, 1] - circle[2]
        if counts[i] > 0.0 and abs(off) <= _INSIDE_PX:
            on += 1
            squares += off * off
    circle[3] = on / rays
    circle[4] = np.sqrt(squares / on) if on > 0 else np.inf
