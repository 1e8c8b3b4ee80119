"""Quadratic programs solved from the last active set: min 1/2 x'Px + q'x with lower <= Ax <= upper. Pure.

The primal-dual active set method (Hintermueller, Ito, Kunisch 2003): hold the rows that were active at their bounds, solve,
let go the rows whose multiplier has the wrong sign, hold those that are violated, and again. Where nothing changes x is the
exact solution. In flight the active set seldom changes, and is mostly empty, so one or two rounds do; but the method may
cycle, and may hold rows that depend on one another. Then, or after ROUNDS, rows are taken up one by one, from none on, by the
dual active set method (Goldfarb, Idnani 1983): it needs more time and always ends.

With P = LL', V = L^-1 A' over the held rows and z = -L^-1 q:    V'V mu = V'z - bound        L'x = z - V mu
"""

import math
from typing import NamedTuple

import numpy as np

from shoal.kernels.decorator import kernel
from shoal.kernels.types import Cube, Floats, Ints, Table

ROUNDS = 6  # of two robots too near to each other, 52 % of the steps with an active row take one, 84 % at most four
# Rows taken up one by one, some more than once: of two robots too near to each other 8 at most under the linear law. Under the
# nonlinear one, with two to eight robots within 2R on all sides, 150 in the median; 2 of 2,000 steps need more (4 ms per 100).
MOST_ADDED = 400
BEYOND = 1e-9  # N, N m or m: so much beyond its bound a row may be by rounding
DEPENDENT = 1e-9  # of a row's length that is new beside the held ones: less is rounding
NO_BOUND = 1e30  # what all solvers take for infinity


class ConvexProgram(NamedTuple):
    """The program min 1/2 x'Px + q'x with lower <= Ax <= upper."""

    p: Table  # (n, n)
    q: Floats
    a: Table  # (rows, n)
    lower: Floats
    upper: Floats


class ActiveSet(NamedTuple):
    """Solution of a program, and what the next one begins with."""

    x: Floats
    multiplier: Floats  # (rows,) positive at the upper bound
    held: Ints  # (rows,) 1: held at the upper bound, -1: at the lower one, 0: not held
    work: Cube  # (4, n, n), overwritten
    mu: Floats  # (n,), overwritten


def make_active_set(n: int, rows: int) -> ActiveSet:
    """Memory for so many unknowns and rows."""
    return ActiveSet(np.zeros(n), np.zeros(rows), np.zeros(rows, np.int64), np.zeros((4, n, n)), np.zeros(n))


@kernel(part=True)
def factorise(p: Table, n: int, factor: Table) -> bool:
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


@kernel(part=True)
def forward(factor: Table, n: int, b: Floats) -> None:
    """Solve Lx = b (n,), in place."""
    for i in range(n):
        for k in range(i):
            b[i] -= factor[i, k] * b[k]
        b[i] /= factor[i, i]


@kernel(part=True)
def backward(factor: Table, n: int, b: Floats) -> None:
    """Solve L'x = b (n,), in place."""
    for i in range(n - 1, -1, -1):
        b[i] /= factor[i, i]
        for k in range(i):
            b[k] -= factor[i, k] * b[i]


@kernel(inline=True, part=True)
def dot(a: Floats, b: Floats) -> float:
    """Sum of products of two vectors."""
    total = 0.0
    for i in range(len(a)):
        total += a[i] * b[i]
    return total


@kernel(part=True)
def factorise_held(a: Table, working: ActiveSet) -> int:
    """Number of the held rows. Writes V' (held, n) into `working.work[0]`, then V'V, then its factor. -1 if the held rows
    depend on one another."""
    n, count = len(working.x), 0
    across, gram, factor = working.work[0], working.work[1], working.work[3]
    for row in range(len(working.held)):
        if working.held[row] == 0:
            continue
        if count == n:
            return -1
        across[count] = a[row]
        forward(factor, n, across[count])
        for j in range(count + 1):
            gram[j, count] = dot(across[count], across[j])
        count += 1
    return count if factorise(gram, count, working.work[2]) else -1


@kernel(part=True)
def minimise_held(program: ConvexProgram, working: ActiveSet) -> bool:
    """Write the minimum with the held rows at their bounds, and its multipliers, zero for the others. False if the held rows
    depend on one another.

    With P = L L' and V = inv(L) A', A the held rows:  V'V mu = V'c - bounds    L'x = c - V mu    where c = -inv(L) q.
    """
    q, lower, upper = program.q, program.lower, program.upper
    x, y, held, mu = working.x, working.multiplier, working.held, working.mu
    n, across, gram_factor, factor = len(q), working.work[0], working.work[2], working.work[3]
    for i in range(n):
        x[i] = -q[i]
    forward(factor, n, x)  # c
    count = factorise_held(program.a, working)
    if count < 0:
        return False
    place = 0  # of a row among the held ones
    for row in range(len(held)):
        if held[row] != 0:
            bound = upper[row] if held[row] > 0 else lower[row]
            mu[place] = dot(across[place], x) - bound
            place += 1
    forward(gram_factor, count, mu)
    backward(gram_factor, count, mu)
    for j in range(count):
        for i in range(n):
            x[i] -= mu[j] * across[j, i]
    backward(factor, n, x)
    place = 0
    for row in range(len(held)):
        y[row] = 0.0
        if held[row] != 0:
            y[row] = mu[place]
            place += 1
    return True


@kernel(part=True)
def take_up(a: Table, working: ActiveSet, row: int, sign: int, beyond: float) -> bool:
    """Bring a `row` that is `beyond` its bound, the upper one for `sign` 1, to that bound, and hold it. False if none can.

    Its multiplier grows by t: x += -t L'^-1 w, multipliers of the held rows += -t r with r = (V'V)^-1 V'v and w = v - V r,
    v = L^-1 a. A held row whose multiplier comes to zero before is let go.
    """
    x, y, held, mu = working.x, working.multiplier, working.held, working.mu
    n, across, gram_factor, factor = len(x), working.work[0], working.work[2], working.work[3]
    aside = np.empty(n)  # w
    while True:
        for i in range(n):
            aside[i] = sign * a[row, i]
        forward(factor, n, aside)
        length2, count = dot(aside, aside), factorise_held(a, working)
        if count < 0:
            return False
        for j in range(count):
            mu[j] = dot(across[j], aside)
        forward(gram_factor, count, mu)
        backward(gram_factor, count, mu)
        for j in range(count):
            for i in range(n):
                aside[i] -= mu[j] * across[j, i]
        new2 = dot(aside, aside)
        is_new = count < n and new2 > DEPENDENT**2 * length2
        # t: the row comes to its bound, unless the multiplier of a held row comes to zero before
        step, leaves, place = beyond / new2 if is_new else np.inf, -1, 0
        for other in range(len(held)):
            if held[other] != 0:
                fades = held[other] * mu[place]
                if fades > 0.0 and abs(y[other]) < step * fades:
                    step, leaves = abs(y[other]) / fades, other
                place += 1
        if not step < np.inf:
            return False
        place = 0
        for other in range(len(held)):
            if held[other] != 0:
                y[other] -= step * mu[place]
                place += 1
        y[row] += step * sign
        if is_new:
            beyond -= step * new2
            backward(factor, n, aside)
            for i in range(n):
                x[i] -= step * aside[i]
        if leaves < 0:
            held[row] = sign
            return True
        held[leaves], y[leaves] = 0, 0.0


@kernel(part=True)
def solve_one_by_one(program: ConvexProgram, working: ActiveSet) -> bool:
    """Solve from the minimum without rows on: the row that is farthest beyond its bound is taken up, until none is. False if
    there is no solution."""
    q, a, lower, upper = program.q, program.a, program.lower, program.upper
    x, y, held, factor = working.x, working.multiplier, working.held, working.work[3]
    n = len(q)
    for row in range(len(held)):
        held[row], y[row] = 0, 0.0
    for i in range(n):
        x[i] = -q[i]
    forward(factor, n, x)
    backward(factor, n, x)
    for _ in range(MOST_ADDED):
        farthest, sign, beyond = -1, 0, BEYOND
        for row in range(len(held)):
            if held[row] == 0:
                place = dot(a[row], x)
                if math.isnan(place):
                    return False
                if place - upper[row] > beyond:
                    farthest, sign, beyond = row, 1, place - upper[row]
                elif lower[row] - place > beyond:
                    farthest, sign, beyond = row, -1, lower[row] - place
        if farthest < 0:
            return True
        if not take_up(a, working, farthest, sign, beyond):
            return False
    return False


@kernel
def solve_from(program: ConvexProgram, working: ActiveSet) -> int:
    """Solve from the guess that the rows `working.held` are active; they become the active set.

    Returns the rounds that it took, ROUNDS + 1 if rows were taken up one by one; 0 if there is no solution, P is not positive
    definite, bounds cross, or a number is not finite.
    """
    q, a, lower, upper = program.q, program.a, program.lower, program.upper
    x, y, held, factor = working.x, working.multiplier, working.held, working.work[3]
    for row in range(len(held)):
        if not lower[row] <= upper[row]:
            return 0
        if (upper[row] if held[row] > 0 else -lower[row]) >= NO_BOUND:
            held[row] = 0
    if not factorise(program.p, len(q), factor):
        return 0
    for taken in range(1, ROUNDS + 1):
        if not minimise_held(program, working):
            break
        is_settled = True
        for row in range(len(held)):
            if held[row] != 0:
                if not y[row] * held[row] >= 0.0:  # it would pull: let it go
                    held[row] = 0
                    is_settled = False
            else:
                place = dot(a[row], x)
                if not lower[row] <= place <= upper[row]:
                    held[row] = 1 if place > upper[row] else -1
                    is_settled = False
        if is_settled:
            return taken if math.isfinite(dot(x, x)) else 0
    solved = solve_one_by_one(program, working) and math.isfinite(dot(x, x))
    return ROUNDS + 1 if solved else 0
