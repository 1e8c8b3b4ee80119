"""The approach: a robot's flight from where it is onto its path, planned whole, and again at every step.

The heading of heading.py follows from the force that is needed now. A robot that begins off its path gains by more: turning,
pushing, braking and turning back in one. So from the beginning of a path until the robot is on it, an optimal-control problem
over 8 s (trajectory_optimisation.py) gives its thrust and its poses. The flight found first is the better one of two guesses,
ahead and astern. From then on each step goes on from the flight of the last one, at the present estimate.

Feedback. As quick as the first flight, feedback of surge swings where the vehicle is lighter than its file says. So what is
flown later pays CALM times more for a surge that changes otherwise than in the first flight; turning aims anew freely. Of
Gamma only the side force counts: over so long a time a wrong mass, while a robot pushes, would look like a force that lasts.

Where the robot leaves its path for others the approach is dropped, as it is where the flight would leave the pool. While its
places touch a half-space, the optimisation of mpc.py follows them. A flight that does not join the path in time is not begun.
"""

import math
from typing import NamedTuple

import numpy as np

from robot_agent.control.heading import HeadingReference
from robot_agent.control.mpc import WEIGHED_S
from robot_agent.control.trajectory_optimisation import GOALS, INPUTS, STATES, guess, optimise
from robot_agent.guidance.reference import Follow, ReferenceSampler
from robot_agent.vehicle.dynamics import Model
from robot_agent.vehicle.estimate import Estimate
from wire.config.controller import ControllerConfig
from wire.config.vehicle import Vehicle
from wire.frames import TURN, Array
from wire.kernels import kernel

LONGEST_STEP_S = 0.05  # of the model
NODE_S, NODES = 0.1, 80  # of the problem
FROM_M, TO_M = 0.05, 0.6  # off the path, where an approach begins; nearer, heading.py does as well
FIRST_ITERATIONS, ITERATIONS = 12, 2  # for each of the two guesses, and in each step from then on
FIRST_DAMPING = 10.0  # with 1 twelve iterations are 4 % dearer, in the worst tenth of random starts
LIVELY = 0.16  # of the weights `r` of (35). 0.64 makes whole runs of `pool` 5 % worse
CALM = 64.0  # with 16 `pool` with mass and drag 30 % too small swings by 30 mm in some flights, with 0 robots stopped
HEADING = (
    3e-4  # weight of 1 rad for a second, and of 1 rad/s, against that of 1 m: it is free while there is something to gain
)
END_S, END_RAD2 = 1.0, 0.02  # weights of errors at the end: of place and velocity; of heading and yaw rate
JOINED_M, JOINED_MPS, JOINED_RAD = 0.01, 0.01, 0.3  # a flight that stays as near to its goals has joined the path
LASTS_S = 12.0  # longest approach; ended after 9 s, robots lighter than their file swung on in some flights
AGAIN_S = 1.0  # until the next try, after a flight that did not join


@kernel("f8(f8[:,::1], f8[:,::1], c16, f8, f8[:,::1])")
def set_goals(eta: Array, velocity: Array, water: complex, near_rad: float, goals: Array) -> float:
    """Write the goals (nodes, 5) of poses and velocities (nodes, 4 each): headings without jumps, the first within half a turn
    of `near_rad`. Returns that heading."""
    yaw = near_rad
    for k in range(len(eta)):
        turned = eta[k, 3] - yaw
        yaw += turned - TURN * np.rint(turned / TURN)
        goals[k, 0], goals[k, 1], goals[k, 2] = eta[k, 0], eta[k, 1], yaw
        goals[k, 3], goals[k, 4] = velocity[k, 0] - water.real, velocity[k, 1] - water.imag
    return float(goals[0, 2])


@kernel("i8(f8[:,::1], f8[:,::1])")
def joins_at(states: Array, goals: Array) -> int:
    """First node from which on a flight is on the path; the number of nodes if it is not at the end."""
    for k in range(len(states) - 1, -1, -1):
        s, goal = states[k], goals[k]
        cos, sin = math.cos(s[2]), math.sin(s[2])
        slip_x, slip_y = cos * s[3] - sin * s[4] - goal[3], sin * s[3] + cos * s[4] - goal[4]
        near = math.hypot(s[0] - goal[0], s[1] - goal[1]) <= JOINED_M and math.hypot(slip_x, slip_y) <= JOINED_MPS
        if not (near and abs(s[2] - goal[2]) <= JOINED_RAD):
            return k + 1
    return 0


@kernel("f8(f8[:,::1], f8, f8)")
def farthest_out(places: Array, half_x: float, half_y: float) -> float:
    """Distance by which the places (nodes, 2 or more) at most lie outside a room; negative if all are inside."""
    out = -math.inf
    for k in range(len(places)):
        out = max(out, abs(places[k, 0]) - half_x, abs(places[k, 1]) - half_y)
    return out


@kernel("void(f8[:,::1], f8)")
def move_on(inputs: Array, steps: float) -> None:
    """Let so many nodes of a flight's inputs (nodes - 1, 2) be over, a part of one too; behind its end thrust stays."""
    last, whole = len(inputs), int(steps)
    share = steps - whole
    for k in range(last):
        for c in range(2):
            before = inputs[k + whole, c] if k + whole < last else 0.0
            after = inputs[k + whole + 1, c] if k + whole + 1 < last else 0.0
            inputs[k, c] = before + share * (after - before)


@kernel("void(f8[:,::1], f8[::1], f8, f8, f8, f8[:,::1])")
def sample_flight(states: Array, action: Array, later_s: float, h: float, period_s: float, rows: Array) -> None:
    """Write places and headings of a flight into the `rows` (horizon + 1, 4) of a path. They begin at the state `action`
    (11,), the flight `later_s` after it, and in between they go straight. Beyond its end the path's places stay, with its
    last heading."""
    last = len(states) - 1
    for k in range(len(rows)):
        row = (k * period_s - later_s) / h
        if row >= last:
            rows[k, 3] = states[last, 2]
        elif row >= 0.0:
            low = int(row)
            for c, column in enumerate((0, 1, 3)):
                rows[k, column] = states[low, c] + (row - low) * (states[low + 1, c] - states[low, c])
        else:
            share = k * period_s / later_s
            for c, column in enumerate((0, 1, 3)):
                rows[k, column] = action[column] + share * (states[0, c] - action[column])


class Approaching(NamedTuple):
    """A step of an approach."""

    command: Array  # (horizon + 2, 4) poses to be flown, now and at all nodes
    surge_n: float  # to be asked for now, before limits
    yaw_nm: float


class Approach:
    """One robot's approach, with its memory and workspaces."""

    def __init__(
        self, vehicle: Vehicle, model: Model, config: ControllerConfig, room_m: tuple[float, float] | None = None
    ) -> None:
        """`room_m`: length and width of the pool; None without walls."""
        self._model, self._period_s = model, config.period_s
        self._later_s = model.lag_s  # thrust that lags counts as thrust that comes later
        self._sampler = ReferenceSampler(vehicle.thruster.dead_time_s + self._later_s + NODE_S * np.arange(NODES + 1.0))
        half = np.array(room_m if room_m is not None else (math.inf, math.inf)) / 2.0 - vehicle.radius_m
        self._half_x, self._half_y = half.tolist()
        self._limit = np.array((vehicle.limits.wrench, vehicle.limits.wrench_rate_per_s))[:, [0, 2]].copy()
        self.goals = np.empty((NODES + 1, GOALS))
        self.states, self._inputs = np.zeros((NODES + 1, STATES)), np.zeros((NODES, INPUTS))
        self._other = np.zeros((NODES + 1, STATES)), np.zeros((NODES, INPUTS))
        self._first, self._damping = np.zeros(NODES), np.empty(1)  # surge's inputs of the flight found first
        self._work = (
            np.empty((3, STATES, STATES)), np.empty((NODES, INPUTS, STATES)), np.empty((NODES, INPUTS)),
            np.empty((NODES + 1, STATES)), np.empty((NODES, INPUTS)),
        )  # fmt: skip
        self._yaw = 0.0  # of the first goal, with its whole turns
        self.tune(config)
        self.drop()

    def tune(self, config: ControllerConfig) -> None:
        """Use other weights from now on."""
        x, y, _, _ = config.mpc.q
        surge, _, yaw = (LIVELY * WEIGHED_S**2 * weight for weight in config.mpc.r)
        place = 0.5 * (x + y)
        heading, end, end_heading = HEADING * place, END_S * place, END_RAD2 * place
        self.weight = np.array((x, y, heading, heading, surge, yaw, end, end_heading, end, end_heading, CALM * surge))
        self._free_weight = np.append(self.weight[:-1], 0.0)

    def begin(self) -> None:
        """Wait for the robot to be so near to its path that it can join it."""
        self.waits, self.flies = True, False
        self._begun_ns = self._again_ns = self._stepped_ns = 0

    def drop(self) -> None:
        """End the approach: the robot is on its path, or has to do something else."""
        self.waits = self.flies = False

    def step(
        self, goal: Follow, path: Array, estimate: Estimate, wrench: Array, heading: HeadingReference, now_ns: int
    ) -> Approaching | None:
        """Plan from the estimate and the `wrench` (3,) asked for last; None if there is no approach. `path` (horizon + 2, 4)
        is the goal's reference."""
        if self.waits:
            off_m = math.hypot(path[0, 0] - estimate.eta[0], path[0, 1] - estimate.eta[1])
            self.waits = off_m >= FROM_M
            if off_m > TO_M or now_ns < self._again_ns:
                return None
        if not (self.waits or self.flies):
            return None
        start = self._start(estimate, wrench)
        self._set_goals(goal, estimate, heading)
        finite = math.isfinite(self._find(start, estimate) if self.waits else self._go_on(start, estimate, now_ns))
        self._stepped_ns = now_ns
        if not finite or self._leaves_the_pool(start):
            self.drop()
            return None
        node = joins_at(self.states, self.goals)
        if self.waits:
            if node > NODES:
                self._again_ns = now_ns + round(AGAIN_S * 1e9)
                return None
            self.waits, self.flies, self._begun_ns = False, True, now_ns
        elif node == 0 or now_ns - self._begun_ns > LASTS_S * 1e9:
            self.drop()
            heading.reset(on_path=True)
            return None
        command = path.copy()
        sample_flight(self.states, estimate.action, self._later_s, NODE_S, self._period_s, command[1:])
        command[0] = command[1]
        surge_n, _, yaw_nm = wrench.tolist()
        surge_rate, yaw_rate = self._inputs[0].tolist()
        return Approaching(command, surge_n + self._period_s * surge_rate, yaw_nm + self._period_s * yaw_rate)

    def _start(self, estimate: Estimate, wrench: Array) -> Array:
        """State (8,) at which a wrench asked for now is there."""
        state = tuple(estimate.action.tolist())
        steps = math.ceil(self._later_s / LONGEST_STEP_S - 1e-9)
        for _ in range(steps):
            state = self._model.advance(state, estimate.disturbance.tolist(), wrench.tolist(), self._later_s / steps)
        x, y, _, yaw, u, v, _, r, *_ = state
        drift = estimate.current * self._later_s
        return np.array((x + drift.real, y + drift.imag, yaw, u, v, r, wrench[0], wrench[2]))

    def _set_goals(self, goal: Follow, estimate: Estimate, heading: HeadingReference) -> None:
        """Write the goals: the path, with the headings in which it is flown."""
        eta, velocity, acceleration = (rows[1:] for rows in self._sampler.sample(goal))
        heading.turn_along_path(eta, velocity, acceleration, estimate.disturbance, estimate.current)
        near_rad = float(estimate.eta[3]) if self.waits else self._yaw
        self._yaw = set_goals(eta, velocity, estimate.current, near_rad, self.goals)

    def _find(self, start: Array, estimate: Estimate) -> float:
        """Find a flight, and return its cost: the better of two, each to the whole turns that are nearest to its guess."""
        least, yaw = math.inf, self._yaw
        for ahead in (1.0, -1.0):
            states, inputs = self._other
            states[0], self._damping[0] = start, FIRST_DAMPING
            guess(*self._water(estimate), NODE_S, self.goals, self._limit, ahead, states, inputs)
            turned = TURN * np.rint((states[-1, 2] - self.goals[-1, 2]) / TURN)
            self.goals[:, 2] += turned
            cost = self._optimise(states, inputs, estimate, np.zeros(NODES), self._free_weight, FIRST_ITERATIONS)
            self.goals[:, 2] -= turned
            if cost < least:
                least, self._yaw = cost, yaw + turned
                self._other = self.states, self._inputs
                self.states, self._inputs = states, inputs
        self.goals[:, 2] += self._yaw - yaw
        self._first[:] = self._inputs[:, 0]
        return least

    def _go_on(self, start: Array, estimate: Estimate, now_ns: int) -> float:
        """Improve the last step's flight, from where the robot is by now, and return its cost."""
        move_on(self._inputs, (now_ns - self._stepped_ns) * 1e-9 / NODE_S)
        self.states[0] = start
        node, flown_s = np.arange(NODES, dtype=np.float64), (now_ns - self._begun_ns) * 1e-9
        planned = np.interp(node + flown_s / NODE_S, node, self._first, right=0.0)
        return self._optimise(self.states, self._inputs, estimate, planned, self.weight, ITERATIONS)

    def _optimise(
        self, states: Array, inputs: Array, estimate: Estimate, planned: Array, weight: Array, iterations: int
    ) -> float:
        return optimise(
            *self._water(estimate), NODE_S, self.goals, planned, weight, self._limit, iterations, states, inputs,
            self._damping, *self._work,
        )  # fmt: skip

    def _water(self, estimate: Estimate) -> tuple[Array, float, complex, Array]:
        """Model, its sway, the current, and Gamma (4,): the side force only."""
        return self._model.coefficients, self._model.sway, estimate.current, np.array((0.0, estimate.disturbance[1], 0.0, 0.0))

    def _leaves_the_pool(self, start: Array) -> bool:
        """True if the flight gets out of the pool farther than its start or its goals."""
        given = [farthest_out(places, self._half_x, self._half_y) for places in (start[None], self.goals)]
        return farthest_out(self.states, self._half_x, self._half_y) > max(*given, 0.0) + JOINED_M
