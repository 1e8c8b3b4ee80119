"""OSQP for the quadratic programs that the active set does not solve: min 1/2 x'Px + q'x with lower <= Ax <= upper.

active_set.py solves nearly all programs of a flight, exactly and within microseconds. It may run out of rounds among other
robots on all sides. OSQP's operator splitting has no such end: each of its iterations costs the same, and MOST_ITERATIONS
bound its time. It is set up anew for each program, since it is asked so seldom.
"""

import numpy as np
import osqp
from scipy import sparse

from robot_agent.control.active_set import ActiveSet, ConvexProgram

MOST_ITERATIONS = 2000  # 12 ms for 41 unknowns and 240 rows, on a core that takes 1 ms for a whole control step
ACTIVE = 1e-3  # of a multiplier, m^2 s per N or per m: less is rounding, and its row is not held at first next time
CLOSE = 2e-3  # N, N m or m by which a row may be violated: what is put out is limited once more
SETTINGS = {
    "verbose": False,
    "scaling": 0,  # with OSQP's own, weights of 0.0005 to 10000 side by side take ten times the iterations
    "rho": 0.1,
    "adaptive_rho_interval": 25,  # in iterations: the timed variant would make a flight depend on the machine
    "eps_abs": 1e-4,
    "eps_rel": 1e-4,
    "max_iter": MOST_ITERATIONS,
}


def solve_by_osqp(program: ConvexProgram, working: ActiveSet) -> int:
    """Write x, multipliers and the rows held into `working`. Returns the iterations; 0: rows are violated by more than
    CLOSE, a number is not finite, or bounds cross, which OSQP itself would not refuse."""
    p, q, a, lower, upper = program
    is_sound = all(np.isfinite(numbers).all() for numbers in (p, q, a)) and not np.isnan([*lower, *upper]).any()
    if not (is_sound and (lower <= upper).all()):
        return 0
    solver = osqp.OSQP()
    solver.setup(sparse.csc_matrix(np.triu(p)), q, sparse.csc_matrix(a), lower, upper, **SETTINGS)
    solution = solver.solve(raise_error=False)
    if not (np.isfinite(solution.x).all() and solution.info.prim_res <= CLOSE):
        return 0
    working.x[:], working.multiplier[:] = solution.x, solution.y
    working.held[:] = np.sign(solution.y) * (np.abs(solution.y) > ACTIVE)
    return int(solution.info.iter)
