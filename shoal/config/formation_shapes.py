"""Formations by name: where the nodes are. Pure.

x runs across the path and y along it where a formation turns with its path; where it keeps its orientation they are the
pool's. The first robot leads.
"""

from typing import Literal, get_args

import numpy as np

from shoal.frames import Array

Shape = Literal["line", "column", "triangle", "diamond", "circle"]
SHAPES: tuple[Shape, ...] = get_args(Shape)
NODE_DECIMALS = 9  # of a node in m
FORM_USAGE = "[SHAPE [SPACING_M]] [turn DEGREES] [scale FACTOR] [order ID,ID,...] [over SECONDS]"


def shape_nodes(shape: Shape, count: int, spacing_m: float) -> Array:
    """Nodes (count, 3) in m around their mean, the nearest two of them `spacing_m` apart."""
    if count <= 1:
        return np.zeros((count, 3))
    match shape:
        case "line":
            nodes = np.arange(count) + 0j
        case "column":
            nodes = -1j * np.arange(count)
        case "triangle":
            nodes = _rows(count)
        case "diamond":
            nodes = _around_diamond(count)
        case "circle":
            nodes = 1j * np.exp(-2j * np.pi / count * np.arange(count))
    apart = np.abs(nodes[:, None] - nodes) + np.where(np.eye(count) > 0, np.inf, 0.0)
    nodes = (nodes - nodes.mean()) * (spacing_m / apart.min())
    # Sines differ in the last bit from processor to processor, and nodes are part of the experiment's hash; + 0.0: no -0.0
    return np.stack([nodes.real, nodes.imag, np.zeros(count)], axis=1).round(NODE_DECIMALS) + 0.0


def _rows(count: int) -> np.ndarray[tuple[int], np.dtype[np.complex128]]:
    """A filled triangle of equal distances, point first: rows of one, two, three ..., the last one centred."""
    nodes: list[complex] = []
    row = 0
    while len(nodes) < count:
        members = min(row + 1, count - len(nodes))
        nodes += [k - (members - 1) / 2.0 - 1j * row * np.sqrt(0.75) for k in range(members)]
        row += 1
    return np.array(nodes)


def _around_diamond(count: int) -> np.ndarray[tuple[int], np.dtype[np.complex128]]:
    """Evenly along the sides of a square that stands on its corner, from the front corner on."""
    place = 4.0 * np.arange(count) / count
    side = place.astype(np.intp)
    corners = np.array([1j, 1.0, -1j, -1.0, 1j])
    return np.asarray(corners[side] + (place - side) * (corners[side + 1] - corners[side]))
