"""Quadratic programs solved from the last active set: min 1/2 x'Px + q'x with lower <= Ax <= upper. Pure.

The primal-dual active set method (Hintermueller, Ito, Kunisch 2003): hold the rows that were active at their bounds, solve,
let go the rows whose multiplier has the wrong sign, hold those that are violated, and again. Where nothing changes x is the
exact solution. In flight the active set seldom changes, and is mostly empty, so one or two rounds do; but the method may
cycle. After ROUNDS of them the problem is a backend's (qp.py).

With P = LL', V = L^-1 A' over the held rows and z = -L^-1 q:    V'V mu = V'z - bound        L'x = z - V mu
"""

import math

import numpy as np
from numpy.typing import NDArray

from wire.frames import Array
from wire.kernels import kernel

Signs = NDArray[np.int64]  # (rows,) 1: held at the upper bound, -1: at the lower one, 0: not held

ROUNDS = 6  # of two robots too near to each other, 52 % of the steps with an active row take one, 84 % at most four
NO_BOUND = 1e30  # what all solvers take for infinity


@kernel("b1(f8[:,::1], i8, f8[:,::1])")
def factorise(p: Array, n: int, factor: Array) -> bool:
    """Cholesky's L, up to the diagonal of `factor` (n, n), of the upper triangle of P (n, n). False unless P is positive
    definite. Zeros above a column's first entry stay zero in L, and are passed over."""
    for i in range(n):
        first = 0
        while first < i and p[first, i] == 0.0:
            factor[i, first] = 0.0
            first += 1
        for j in range(first, i + 1):
            entry = p[j, i]
            for k in range(first, j):
                entry -= factor[i, k] * factor[j, k]
            if j < i:
                factor[i, j] = entry / factor[j, j]
            elif not 0.0 < entry < np.inf:
                return False
            else:
                factor[i, i] = math.sqrt(entry)
    return True


@kernel("void(f8[:,::1], i8, f8[::1])")
def forward(factor: Array, n: int, b: Array) -> None:
    """Solve Lx = b (n,), in place."""
    for i in range(n):
        for k in range(i):
            b[i] -= factor[i, k] * b[k]
        b[i] /= factor[i, i]


@kernel("void(f8[:,::1], i8, f8[::1])")
def backward(factor: Array, n: int, b: Array) -> None:
    """Solve L'x = b (n,), in place."""
    for i in range(n - 1, -1, -1):
        b[i] /= factor[i, i]
        for k in range(i):
            b[k] -= factor[i, k] * b[i]


@kernel("f8(f8[::1], f8[::1])", inline=True)
def dot(a: Array, b: Array) -> float:
    """Sum of products of two vectors."""
    total = 0.0
    for i in range(len(a)):
        total += a[i] * b[i]
    return total


@kernel("b1(f8[:,::1], f8[::1], f8[:,::1], f8[::1], f8[::1], i8[::1], f8[:,:,::1], f8[::1], f8[::1], f8[::1])")
def minimise_held(
    factor: Array, q: Array, a: Array, lower: Array, upper: Array, held: Signs, work: Array, mu: Array, x: Array, y: Array
) -> bool:
    """Minimum `x` (n,) with the rows `held` at their bounds, and multipliers `y` (rows,), zero for the others. False if the
    held rows depend on one another. `work` is (3, n, n), `mu` (n,)."""
    n, count = len(q), 0
    across, gram, gram_factor = work[0], work[1], work[2]
    for i in range(n):
        x[i] = -q[i]
    forward(factor, n, x)
    for row in range(len(held)):
        if held[row] == 0:
            continue
        if count == n:
            return False
        across[count] = a[row]
        forward(factor, n, across[count])
        mu[count] = dot(across[count], x) - (upper[row] if held[row] > 0 else lower[row])
        for j in range(count + 1):
            gram[j, count] = dot(across[count], across[j])
        count += 1
    if not factorise(gram, count, gram_factor):
        return False
    forward(gram_factor, count, mu)
    backward(gram_factor, count, mu)
    for j in range(count):
        for i in range(n):
            x[i] -= mu[j] * across[j, i]
    backward(factor, n, x)
    count = 0
    for row in range(len(held)):
        y[row] = 0.0
        if held[row] != 0:
            y[row] = mu[count]
            count += 1
    return True


@kernel("i8(f8[:,::1], f8[::1], f8[:,::1], f8[::1], f8[::1], i8[::1], f8[:,:,::1], f8[::1], f8[::1], f8[::1])")
def solve_from(
    p: Array, q: Array, a: Array, lower: Array, upper: Array, held: Signs, work: Array, mu: Array, x: Array, y: Array
) -> int:
    """Solution `x` (n,) with multipliers `y` (rows,), from the guess that the rows `held` are active; `held` becomes the
    active set. `work` is (4, n, n), `mu` (n,).

    Returns the rounds that it took; 0 if there is no solution after ROUNDS, P is not positive definite, bounds cross, or a
    number is not finite.
    """
    factor = work[3]
    for row in range(len(held)):
        if not lower[row] <= upper[row]:
            return 0
        if (upper[row] if held[row] > 0 else -lower[row]) >= NO_BOUND:
            held[row] = 0
    if not factorise(p, len(q), factor):
        return 0
    for taken in range(1, ROUNDS + 1):
        if not minimise_held(factor, q, a, lower, upper, held, work[:3], mu, x, y):
            return 0
        settled = True
        for row in range(len(held)):
            if held[row] != 0:
                right = y[row] * held[row] >= 0.0
                held[row] = held[row] if right else 0
            else:
                place = dot(a[row], x)
                right = lower[row] <= place <= upper[row]
                held[row] = 0 if right else 1 if place > upper[row] else -1
            settled &= right
        if settled:
            return taken if math.isfinite(dot(x, x)) else 0
    return 0
