"""Robust alignment of a patch with the learnt one: refines a correlation's match, and tells what it is worth.

A correlation has a peak in any picture. Whether the peak is the robot shows in the pixels: of the learnt texture, the share
that is seen again. The alignment is a Gauss-Newton iteration over shift, rotation, gain and offset of brightness (Baker and
Matthews, IJCV 56(3), 2004) with redescending weights (Geman and McClure): a card, a reflection or a cable over the robot is an
outlier and moves nothing, and what is left of the texture gives the covariance.
"""

import math
from typing import NamedTuple

import numpy as np

from shoal.kernels.decorator import kernel
from shoal.kernels.types import Floats, Ints, SingleCube, SingleTable, Table

_ROUNDS = 7  # Gauss-Newton iterations; a correlation is off by less than a sample, and the last two move a tenth of one
_BORDER = 3  # samples at the patch's edge that are left out: a shift may move that far
_LEAST_SCALE = 2.0  # grey levels: sensor noise after demosaicing
_MOST_SCALE = 12.0  # grey levels: ripples and caustics on a robot; with a larger one a wrong pattern fits everything
_FIRST_SCALE = 48.0  # grey levels, halved from round to round: light that fell since it was learnt must not reject all
_TO_SIGMA = 1.4826  # standard deviation of a normal distribution over its median absolute deviation
_REJECTS_AT = 2.0  # scales: a residual of that size has a quarter of the weight
_EDGE_ERROR = 0.15  # samples that an edge may lie off, by ripples and resampling, without being another one
_BLOCKS = 6  # each way: 45 mm of a robot 0.3 m across, two or three cells of its marker
_BLOCK_SHARE = 0.5  # of the texture of a block; of a block with another pattern less is seen again, of a covered one nothing
_SHARED = 5  # unknowns of all channels: shift ahead, shift to starboard, rotation, slopes of brightness ahead and to starboard


@kernel(part=True)
def invert(matrix: Table) -> None:
    """Invert a symmetric positive definite matrix (n, n) in place, by Gauss-Jordan elimination on its diagonal."""
    n = matrix.shape[0]
    for k in range(n):
        pivot = 1.0 / matrix[k, k]
        matrix[k, k] = 1.0
        for j in range(n):
            matrix[k, j] *= pivot
        for i in range(n):
            if i != k:
                factor = matrix[i, k]
                matrix[i, k] = 0.0
                for j in range(n):
                    matrix[i, j] -= factor * matrix[k, j]


class _Sums(NamedTuple):
    """Sums over the points of one iteration."""

    normal: Table  # (unknowns, unknowns) J^T W J, below its diagonal
    right: Floats  # (unknowns,) -J^T W r
    histogram: Floats  # (256,) points by their absolute residual in grey levels
    texture: Floats  # (blocks,) sum v g^2
    recognised: Floats  # (blocks,) sum v w g^2


class _Totals(NamedTuple):
    """Totals of one iteration: points, their weights v w, and v w r^2."""

    points: float
    weight: float
    squares: float


@kernel(inline=True, part=True)
def _between_samples(channel: SingleTable, left: int, top: int, u: float, v: float) -> float:
    """Bilinear value of a channel at the shares u and v of the way from the sample (left, top) to the next ones."""
    above = channel[top, left] * (1.0 - u) + channel[top, left + 1] * u
    below = channel[top + 1, left] * (1.0 - u) + channel[top + 1, left + 1] * u
    return float(above * (1.0 - v) + below * v)


@kernel(inline=True, part=True)
def _add_residual(sums: _Sums, slope: Floats, unknown: Ints, weight: float, residual: float) -> None:
    """Add a residual to the normal equations: its derivative `slope` by each `unknown` that it depends on, in order."""
    for i in range(len(slope)):
        scaled = weight * slope[i]
        sums.right[unknown[i]] -= scaled * residual
        for j in range(i + 1):
            sums.normal[unknown[i], unknown[j]] += scaled * slope[j]


@kernel(part=True)
def _linearise(
    learnt: SingleCube, patch: SingleCube, weights: SingleTable, solution: Floats, scale: float, sums: _Sums
) -> _Totals:
    """Set `sums` to those of all points p at a solution, with residuals weighted by a scale s in grey levels.

    Unknowns: shift ahead, shift to starboard, rotation, slopes of brightness; then each channel's gain, each one's offset.

        r = patch(R p + t) - (gain + slope p) learnt(p) - offset        w = 1 / (1 + r^2 / 4 (s^2 + (0.15 g)^2))^2
        dr/dt = gain R g        dr/drotation = dr/dt x R p        g: gradient of learnt at p
    """
    channels, n = learnt.shape[0], learnt.shape[1]
    middle = n // 2
    size = (n + _BLOCKS - 1) // _BLOCKS
    slope = np.empty(_SHARED + 2)  # of a point's residual, by the unknowns that it depends on
    unknown = np.arange(_SHARED + 2)  # those unknowns; the last two, gain and offset, change with the channel
    sums.normal[:, :] = 0.0
    sums.right[:] = 0.0
    sums.histogram[:] = 0.0
    sums.texture[:] = 0.0
    sums.recognised[:] = 0.0
    points = 0.0
    total_weight = 0.0
    squares = 0.0
    cos = math.cos(solution[2])
    sin = math.sin(solution[2])
    for row in range(_BORDER, n - _BORDER):
        for column in range(_BORDER + (row + _BORDER) % 2, n - _BORDER, 2):
            template_weight = min(
                weights[row, column], weights[row - 1, column], weights[row + 1, column], weights[row, column - 1],
                weights[row, column + 1],
            )  # fmt: skip
            ahead = float(column - middle)  # p
            side = float(row - middle)
            u = middle + solution[0] + cos * ahead - sin * side  # R p + t
            v = middle + solution[1] + sin * ahead + cos * side
            left = math.floor(u)
            top = math.floor(v)
            if template_weight <= 0.0 or left < 0 or top < 0 or left > n - 2 or top > n - 2:
                continue
            block = row // size * _BLOCKS + column // size
            for k in range(channels):
                gx = 0.5 * (learnt[k, row, column + 1] - learnt[k, row, column - 1])
                gy = 0.5 * (learnt[k, row + 1, column] - learnt[k, row - 1, column])
                texture = gx * gx + gy * gy
                level = float(learnt[k, row, column])
                gain = solution[_SHARED + k] + (solution[3] * ahead + solution[4] * side) / middle
                offset = solution[_SHARED + channels + k]
                residual = _between_samples(patch[k], left, top, u - left, v - top) - gain * level - offset
                edge = _EDGE_ERROR * _EDGE_ERROR * texture
                root = 1.0 / (1.0 + residual * residual / (_REJECTS_AT * _REJECTS_AT * (scale * scale + edge)))
                weight = template_weight * root * root
                points += 1.0
                total_weight += weight
                squares += weight * residual * residual
                sums.histogram[min(int(abs(residual)), 255)] += 1.0
                sums.texture[block] += template_weight * texture
                sums.recognised[block] += weight * texture
                slope[0] = gain * (cos * gx - sin * gy)
                slope[1] = gain * (sin * gx + cos * gy)
                slope[2] = slope[0] * (middle + solution[1] - v) + slope[1] * (u - middle - solution[0])
                slope[3] = -level * ahead / middle
                slope[4] = -level * side / middle
                slope[5] = -level
                slope[6] = -1.0
                unknown[5] = _SHARED + k
                unknown[6] = _SHARED + channels + k
                _add_residual(sums, slope, unknown, weight, residual)
    return _Totals(points, total_weight, squares)


@kernel(part=True)
def _recognised_share(sums: _Sums) -> float:
    """Share of the texture in blocks whose own is seen again for the most part; -1 if there is no texture."""
    total = 0.0
    share = 0.0
    for block in range(len(sums.texture)):
        total += sums.texture[block]
        if sums.recognised[block] > _BLOCK_SHARE * sums.texture[block]:
            share += sums.texture[block]
    return share / total if total > 0.0 else -1.0


@kernel(part=True)
def _median(histogram: Floats, points: float) -> int:
    """Median of the absolute residuals, rounded up to a whole grey level."""
    passed = 0.0
    level = 0
    while passed < 0.5 * points and level < 255:
        passed += histogram[level]
        level += 1
    return level


@kernel
def align(learnt: SingleCube, patch: SingleCube, weights: SingleTable, move: Floats, covariance: Table) -> float:
    """Find the `move` (4,) [samples ahead (columns), samples to starboard (rows), rad, gain of brightness] of the `learnt`
    samples (channels, n, n) in a later `patch`, and the `covariance` (3, 3) of the first three. Returns the share of learnt
    texture that is seen again, 0 to 1.

    Minimises sum v rho(patch(R p + t) - (gain + slope p) learnt(p) - offset) over a chessboard of the points p with `weights`
    v (n, n) above 0, gain and offset of each channel, with rho'(r) = r w and w = 1 / (1 + r^2 / 4 (s^2 + (0.15 g)^2))^2, g the
    gradient of the learnt patch. Share: of sum v g^2, the part in blocks with sum v w g^2 > 0.5 sum v g^2. Covariance:
    s^2 (J^T W J)^-1 of the first three unknowns.
    """
    channels = learnt.shape[0]
    unknowns = _SHARED + 2 * channels
    blocks = _BLOCKS * _BLOCKS
    sums = _Sums(np.empty((unknowns, unknowns)), np.empty(unknowns), np.empty(256), np.empty(blocks), np.empty(blocks))
    solution = np.zeros(unknowns)
    solution[_SHARED : _SHARED + channels] = 1.0
    widest = _FIRST_SCALE
    scale = widest
    share = 0.0
    covariance[:, :] = 0.0
    for iteration in range(_ROUNDS):
        totals = _linearise(learnt, patch, weights, solution, scale, sums)
        share = _recognised_share(sums)
        if share < 0.0 or totals.weight <= 0.0:
            return 0.0
        for i in range(unknowns):
            sums.normal[i, i] = sums.normal[i, i] * (1.0 + 1e-9) + 1e-9
            for j in range(i):
                sums.normal[j, i] = sums.normal[i, j]
        invert(sums.normal)
        variance = max(totals.squares / totals.weight, _LEAST_SCALE * _LEAST_SCALE)
        for i in range(3):
            for j in range(3):
                covariance[i, j] = variance * sums.normal[i, j]
        if iteration == _ROUNDS - 1:
            break
        for i in range(unknowns):
            for j in range(unknowns):
                solution[i] += sums.normal[i, j] * sums.right[j]
        widest = max(0.5 * widest, _MOST_SCALE)
        scale = min(max(_TO_SIGMA * (_median(sums.histogram, totals.points) - 0.5), 0.25 * widest, _LEAST_SCALE), widest)
    for i in range(3):
        move[i] = solution[i]
    move[3] = np.mean(solution[_SHARED : _SHARED + channels])
    return share
