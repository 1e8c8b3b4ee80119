"""Mesh that lays the camera's picture under the map: pool points, and their places in the picture. Pure."""

import numpy as np

from wire.camera_coverage import project
from wire.config.experiment import Experiment
from wire.frames import Array

CELLS = 16  # along the longer side: straight edges between nodes are then within 1 mm of the lens's curves
MARGIN_M = 0.2  # beyond the walls


def mesh(experiment: Experiment) -> tuple[Array, Array]:
    """Grid points (rows + 1, columns + 1, 2) on the plane of the path's depth, pool frame, and the places (same shape) in the
    picture that show them, from 0 to 1 across its width and height."""
    length, width, _ = experiment.pool.size_m
    cell_m = max(length, width) / CELLS
    x = np.linspace(-length / 2 - MARGIN_M, length / 2 + MARGIN_M, max(2, round(length / cell_m)) + 1)
    y = np.linspace(-width / 2 - MARGIN_M, width / 2 + MARGIN_M, max(2, round(width / cell_m)) + 1)
    points = np.stack(np.meshgrid(x, y), axis=-1)
    flat = points.reshape(-1, 2)
    pixels = project(experiment.camera, np.column_stack([flat, np.full(len(flat), experiment.path.depth_m)]))
    return points, ((pixels + 0.5) / np.array(experiment.camera.size_px)).reshape(points.shape)
