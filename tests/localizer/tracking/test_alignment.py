"""The alignment of a learnt patch with the one that is seen, of textures that are known as functions of the place."""

import numpy as np
import pytest
from numpy.typing import NDArray

from localizer.tracking.alignment import align, invert
from shoal.frames import Array

SIDE, CHANNELS, BORDER = 40, 2, 3
WAVES = np.random.default_rng(1).uniform(-0.35, 0.35, (CHANNELS, 6, 2))  # rad a sample
LEAST_VARIANCE = 4.0  # of a pixel: 2 grey levels of sensor noise


def texture(places: Array, channel: int) -> Array:
    """Grey levels (...) at places (..., 2) from the patch's middle."""
    return np.asarray(128.0 + 15.0 * np.sin(places @ WAVES[channel].T + np.arange(6)).sum(axis=-1))


def moved(places: Array, move: Array, channel: int) -> Array:
    """Grey levels seen at some places of a texture after a move [ahead, to starboard, rad, gain]."""
    c, s = np.cos(move[2]), np.sin(move[2])
    return float(move[3]) * texture((places - move[:2]) @ np.array([[c, -s], [s, c]]), channel)


def patch(places: Array, move: Array) -> NDArray[np.float32]:
    return np.array([moved(places, move, k) for k in range(CHANNELS)], np.float32)


def grid() -> Array:
    """Places (SIDE, SIDE, 2) of the samples."""
    row, column = np.mgrid[:SIDE, :SIDE] - SIDE // 2
    return np.stack([column, row], axis=-1).astype(float)


def test_a_matrix_is_inverted() -> None:
    root = np.random.default_rng(2).normal(size=(9, 9))
    matrix = root @ root.T + np.eye(9)
    inverse = matrix.copy()
    invert(inverse)
    assert inverse == pytest.approx(np.linalg.inv(matrix), abs=1e-9)


@pytest.mark.parametrize("true", [(0.0, 0.0, 0.0, 1.0), (0.9, -0.6, 0.06, 0.8), (-0.7, 0.8, -0.05, 1.3)], ids=str)
def test_a_patch_that_has_moved_is_found_as_well_as_least_squares_could(true: tuple[float, float, float, float]) -> None:
    """The covariance is that of all unknowns together: shift, rotation, slopes of the gain, each channel's gain and offset."""
    move, covariance = np.zeros(4), np.empty((3, 3))
    places, weights = grid(), np.ones((SIDE, SIDE), np.float32)
    share = align(patch(places, np.array([0.0, 0.0, 0.0, 1.0])), patch(places, np.array(true)), weights, move, covariance)
    assert share == 1.0
    assert move == pytest.approx(true, abs=0.01)

    inner = places[BORDER:-BORDER, BORDER:-BORDER]
    used = inner[(inner.sum(axis=-1) % 2 == 0)]
    rows = []
    for k in range(CHANNELS):
        level, (c, s) = texture(used, k), (np.cos(true[2]), np.sin(true[2]))
        at = used @ np.array([[c, s], [-s, c]]) + true[:2]
        row = np.zeros((len(used), 5 + 2 * CHANNELS))
        for i, step in enumerate(1e-4 * np.eye(3)):  # central differences
            turned = [moved(at, np.array([*(true[:3] + sign * step), true[3]]), k) for sign in (-1.0, 1.0)]
            row[:, i] = (turned[1] - turned[0]) / 2e-4
        row[:, 3:5] = level[:, None] * used / (SIDE // 2)
        row[:, 5 + k], row[:, 5 + CHANNELS + k] = level, 1.0
        rows.append(row)
    slopes = np.concatenate(rows)
    assert covariance == pytest.approx(LEAST_VARIANCE * np.linalg.inv(slopes.T @ slopes)[:3, :3], rel=0.05, abs=1e-6)


def test_another_texture_is_not_taken_for_the_learnt_one() -> None:
    places, move, covariance = grid(), np.zeros(4), np.empty((3, 3))
    learnt = patch(places, np.array([0.0, 0.0, 0.0, 1.0]))
    other = np.ascontiguousarray(learnt[::-1, ::-1, :])
    share = align(learnt, other, np.ones((SIDE, SIDE), np.float32), move, covariance)
    assert share < 0.4
