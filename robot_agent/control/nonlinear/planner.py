"""The plan of one robot from step to step: one iteration on it, and now and then a rival from another first guess.

A rival is a pilot's flight (first_guess.py) that gets one iteration a step beside the plan. After RIVAL_STEPS it takes the
plan's place if it is clearly cheaper. So no step has more than two iterations. At a beginning the cheaper pilot is the plan,
and the other one its first rival.
"""

import math

import numpy as np

from robot_agent.control.nonlinear.first_guess import PilotStyle, guess
from robot_agent.control.nonlinear.prediction import Dynamics, Grid, PlannedFlight, Start
from robot_agent.control.nonlinear.program import (
    Course,
    Iteration,
    Memory,
    PlanProblem,
    appraise,
    make_memory,
    open_program,
    step_plan,
    take_change,
)
from robot_agent.control.nonlinear.tuning import RETURN_SHARE, SWAY, WRENCH_AXIS, Bandwidths
from robot_agent.control.osqp_fallback import solve_by_osqp
from shoal.frames import Array

RIVAL_STEPS = 4  # iterations of a rival: more bring less than 1 % of its cost
CHEAPER = 0.9  # a rival must be so much cheaper: plans of like cost would take turns
REVIEW_S, URGENT_S = 0.4, 0.1  # between two rivals, and between them in a conflict
ENTRY_M = 0.01  # deeper in a half-space, a plan is in conflict

AHEAD, ASTERN = (1.0, 0.0), (-1.0, 0.0)  # bow or stern first; how far to port of the course, in distances to keep
FREE = (AHEAD, ASTERN)
AT_HEADING = (0.0, 0.0)  # at the course's heading: with side thrust there is no bow to turn
FREE_WITH_SWAY = (AT_HEADING,)
BLOCKED_WITH_SWAY = (AT_HEADING, (0.0, 1.0), (0.0, -1.0), (0.0, 2.0), (0.0, -2.0))
BLOCKED = (AHEAD, ASTERN, (1.0, 1.0), (1.0, -1.0), (1.0, 2.0), (1.0, -2.0))


class Planner:
    """Plan of the place and heading, its rival, and what they learn from step to step."""

    def __init__(self, grid: Grid, period_s: float, aside_m: float, fastest_mps: float) -> None:
        """`aside_m` is the distance to keep from other robots."""
        self._grid, self._period_s, self._aside_m, self._fastest_mps = grid, period_s, aside_m, fastest_mps
        self._plan, self._rival = make_memory(len(grid.axes)), make_memory(len(grid.axes))
        has_sway = SWAY in grid.axes
        self._free: tuple[tuple[float, float], ...] = FREE_WITH_SWAY if has_sway else FREE
        self._blocked: tuple[tuple[float, float], ...] = BLOCKED_WITH_SWAY if has_sway else BLOCKED
        self.forget()

    def forget(self) -> None:
        """Begin anew at the next step."""
        self.is_fresh = True
        self._rival_steps = 0  # iterations of the rival; 0: there is none
        self._next = 0  # of the first guesses
        self._since_s = 0.0  # the last rival

    @property
    def flight(self) -> PlannedFlight:
        return self._plan.flight

    def step(self, dynamics: Dynamics, problem: PlanProblem, tuning: Bandwidths, tolerance_m: float) -> Iteration:
        """Improve the plan, and look for a better one while its mean error is more than `tolerance_m`."""
        if self.is_fresh:
            self._begin(dynamics, problem, tuning)
            iteration = self._improve(self._plan, dynamics, problem, 0.0)
        else:
            iteration = self._improve(self._plan, dynamics, problem, self._period_s)
        if not (iteration.rounds and math.isfinite(iteration.after)):
            self.forget()
            return iteration._replace(rounds=0)
        self._since_s += self._period_s
        if self._rival_steps:
            return self._compare(dynamics, problem, iteration)
        whole_s = float(self._grid.time_s[-1]) + problem.weights.end_s
        is_blocked = iteration.entry_m > ENTRY_M
        is_due = self._since_s > (URGENT_S if is_blocked else REVIEW_S) - 1e-9
        if is_due and (is_blocked or iteration.after > whole_s * tolerance_m**2):
            guesses = self._blocked if is_blocked else self._free
            self._guess(self._rival, dynamics, problem, tuning, guesses[self._next % len(guesses)])
            self._next, self._rival_steps, self._since_s = self._next + 1, 1, 0.0
        return iteration

    def _improve(self, memory: Memory, dynamics: Dynamics, problem: PlanProblem, by_s: float) -> Iteration:
        """One iteration on a flight of `by_s` ago. OSQP solves the program where the active set does not."""
        iteration = step_plan(dynamics, self._grid, problem, memory, by_s)
        if iteration.rounds == 0 and math.isfinite(iteration.before):
            rounds = solve_by_osqp(*open_program(memory))
            if rounds:
                return take_change(dynamics, self._grid, problem, memory, iteration.before, rounds)
        return iteration

    def _begin(self, dynamics: Dynamics, problem: PlanProblem, tuning: Bandwidths) -> None:
        """The cheaper of the pilot's two flights is the plan, the other one its rival. With side thrust there is one."""
        costs = []
        for memory, way in zip((self._plan, self._rival), self._free, strict=False):
            self._guess(memory, dynamics, problem, tuning, way)
            costs.append(appraise(dynamics, self._grid, problem, memory))
        if costs[-1] < costs[0]:
            self._plan, self._rival = self._rival, self._plan
        self.is_fresh, self._rival_steps = False, len(costs) - 1

    def _guess(
        self, memory: Memory, dynamics: Dynamics, problem: PlanProblem, tuning: Bandwidths, way: tuple[float, float]
    ) -> None:
        """Write a pilot's flight."""
        ahead, aside = way
        memory.program.held[:] = 0
        pilot = PilotStyle(
            ahead, aside * self._aside_m, RETURN_SHARE * tuning.quickness, tuning.quickness, tuning.turning, self._fastest_mps
        )
        guess(dynamics, self._grid, problem.start, problem.course, problem.limits, pilot, memory.flight)

    def _compare(self, dynamics: Dynamics, problem: PlanProblem, iteration: Iteration) -> Iteration:
        """Improve the rival, and let it take the plan's place if it is cheaper in the end."""
        rival = self._improve(self._rival, dynamics, problem, self._period_s if self._rival_steps > 1 else 0.0)
        self._rival_steps = self._rival_steps + 1 if rival.rounds and self._rival_steps < RIVAL_STEPS else 0
        if self._rival_steps == 0 and rival.rounds and rival.after < CHEAPER * iteration.after:
            self._plan, self._rival = self._rival, self._plan
            return rival
        return iteration


def resting_place(
    dynamics: Dynamics, grid: Grid, problem: PlanProblem, tuning: Bandwidths, fastest_mps: float, flight: PlannedFlight
) -> tuple[complex, float]:
    """Place at which a pilot who only stops comes to rest, and the speed that is left at the flight's end: bow or stern
    into the current, whichever ends nearer."""
    start = problem.start
    here = complex(start.state[0], start.state[1])
    still = Course(*(np.zeros_like(part) for part in problem.course))
    best: tuple[float, complex, float] | None = None
    for ahead in (0.0,) if SWAY in grid.axes else (1.0, -1.0):
        pilot = PilotStyle(ahead, 0.0, 0.0, tuning.calm_quickness, tuning.turning, fastest_mps)
        guess(dynamics, grid, start, still, problem.limits, pilot, flight)
        place, speed = _end_of(flight.state[-1], dynamics)
        away = abs(place - here) + speed * float(grid.time_s[-1])
        if best is None or away < best[0]:
            best = away, place, speed
    assert best is not None
    return best[1], best[2]


def _end_of(state: Array, dynamics: Dynamics) -> tuple[complex, float]:
    """Place at which a flight's last state glides to rest, and its speed over ground."""
    hull, water = dynamics.hull, dynamics.water
    x, y, yaw, u, v = state[:5].tolist()
    turn = complex(math.cos(yaw), math.sin(yaw))
    sideways = 1j * turn * v  # nothing stops it but drag
    over_ground = turn * u + sideways + complex(water.current_x_mps, water.current_y_mps)
    is_still = water.current_x_mps == water.current_y_mps == 0.0
    glide = sideways * (hull.mass_v / hull.linear_v) if is_still else 0j
    return complex(x, y) + glide, abs(over_ground)


def make_start(action: Array, wrench: Array, axes: tuple[int, ...]) -> Start:
    """Start of the plan: the observer's state (12,) at the instant of action, and the `wrench` asked for last."""
    x, y, _, yaw, u, v, _, r, surge, _, moment, sway = action.tolist()
    state = np.array([x, y, yaw, u, v, r, surge, sway, moment])
    return Start(state, np.array([wrench.item(WRENCH_AXIS[axis]) for axis in axes]))


def make_depth_start(action: Array, heave_n: float) -> Start:
    """The same of depth, as motion along x."""
    state = np.zeros(9)
    state[0], state[3], state[6] = action[2], action[6], action[9]
    return Start(state, np.array([heave_n]))
