"""A control loop to time: robots side by side on circles, the controller's own model with its dead time as their water, noisy
poses 40 ms old that report their noise.

Peers run this too, in environments of their own, with another solver in the controller's place: so every figure is of one
complete control step (estimate, linearise, assemble, update, solve, allocate), closed loop, on the same scene.
"""

import gc
import math
import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from benchmarks.harness import Row
from robot_agent.control.any_controller import make_controller
from robot_agent.control.controller import Controller, Setting
from robot_agent.guidance.formation import Neighbour
from robot_agent.guidance.reference import Follow
from robot_agent.vehicle.dynamics import Model, State
from robot_agent.vehicle.estimate import PoseMeasurement, StateMeasurement
from shoal.config.experiment import Experiment, load_experiment
from shoal.frames import Array, wrap
from shoal.messages.messages import Plan, Solve, Trajectory, required

STEP_NS, STEP_S = 50_000_000, 0.05
WARM_UP = 200  # steps, 10 s: from rest to its path
BEYOND_S = 15.0  # of the path after the flight: longer than a horizon
RADIUS_M, SPEED_MPS, DEPTH_M = 0.5, 0.1, 0.3
APART_M, TOO_NEAR_M = 1.2, 0.58  # 2R is 0.6
POSE_AGE_S = 0.04
NOISE = (0.0015, 0.0015, 0.009, 0.002, 0.003)  # x, y, yaw, depth, yaw rate: what localizer and board have
DISTURBANCE = (0.01, 0.0, 0.0, 0.0)  # m/s^2, a force of the robot: unlike thrusters

SETTINGS = {"default": (), "article's": ("controller.law=eso-mpc-article",)}

Tamper = Callable[[Controller, Experiment], None]


@dataclass(frozen=True)
class Case:
    """A flight of the benchmark. `beside` robots are too near to each other, so that half-spaces bind."""

    setting: str
    neighbours: int
    beside: bool = False
    more: tuple[str, ...] = ()

    def __str__(self) -> str:
        company = "alone" if not self.neighbours else f"{self.neighbours} neighbours" + (", too near" if self.beside else "")
        return f"{self.setting} setting, {company}"

    def experiment(self) -> Experiment:
        """The pool's robot with these settings."""
        return load_experiment("pool", [*SETTINGS[self.setting], *self.more])


@dataclass(frozen=True, eq=False)
class Flown:
    """The first robot's control steps."""

    step_us: list[float]
    error_m: list[float]  # distance from the reference
    change: Array  # (steps, 3) of the wrench, as a share of the largest allowed
    unsolved: int

    def rows(self, benchmark: str, case: str, subject: str) -> list[Row]:
        """Time, and what it bought: errors and smoothness are means over the flight."""
        n = len(self.step_us)
        rms_mm = 1e3 * float(np.sqrt(np.mean(np.square(self.error_m))))
        change = 100.0 * float(np.sqrt(np.mean(self.change**2)))
        return [
            Row.of(benchmark, case, subject, "us", self.step_us),
            Row(benchmark, case, subject, "mm RMS off the path", rms_mm, rms_mm, 1e3 * max(self.error_m), n),
            Row(
                benchmark,
                case,
                subject,
                "% of the largest input change, RMS",
                change,
                change,
                100.0 * float(np.abs(self.change).max()),
                n,
            ),
        ]


class Water:
    """A robot in the water: its true state, and the commands that do not act yet."""

    def __init__(self, model: Model, state: State, dead_steps: int) -> None:
        self._model, self.state = model, state
        self._past_state = state  # POSE_AGE_S ago
        self._commands = [[0.0, 0.0, 0.0]] * dead_steps

    def advance(self, wrench: list[float]) -> None:
        """Go on for one control step, at whose beginning `wrench` is sent."""
        self._commands.append(wrench)
        acting = self._commands.pop(0)
        self._past_state = self._model.advance(self.state, DISTURBANCE, acting, STEP_S - POSE_AGE_S)
        self.state = self._model.advance(self.state, DISTURBANCE, acting, STEP_S)

    def measurement(self, now_ns: int, noise: Array) -> StateMeasurement:
        """Pose of POSE_AGE_S ago, depth and yaw rate of now."""
        x, y, _, yaw, *_ = self._past_state
        x, y, yaw, depth, yaw_rate = (np.array([x, y, yaw, self.state[2], self.state[7]]) + noise).tolist()
        stamp_ns = now_ns - round(POSE_AGE_S * 1e9)
        return StateMeasurement(PoseMeasurement(stamp_ns, x, y, wrap(yaw), NOISE[0] ** 2, NOISE[2] ** 2), depth, yaw_rate)


def places(count: int, beside: bool) -> list[tuple[float, float]]:
    """Circle centres: the first robot in the middle, others in rings around it."""
    distance = TOO_NEAR_M if beside else APART_M
    spots = [(0.0, 0.0)]
    for i in range(count - 1):
        ring, angle = 1 + i // 6, (i % 6) * np.pi / 3 if not beside else i * np.pi
        spots.append((distance * ring * float(np.cos(angle)), distance * ring * float(np.sin(angle))))
    return spots


def circle(centre: tuple[float, float], seconds: float) -> Trajectory:
    """Once or more around a centre."""
    rate = SPEED_MPS / RADIUS_M
    t = np.arange(0.0, seconds, STEP_S)
    c, s, zero = np.cos(rate * t), np.sin(rate * t), np.zeros_like(t)
    eta = np.stack([centre[0] + RADIUS_M * c, centre[1] + RADIUS_M * s, zero + DEPTH_M, rate * t + np.pi / 2], axis=1)
    velocity = np.stack([-SPEED_MPS * s, SPEED_MPS * c, zero, zero + rate], axis=1)
    return Trajectory(
        "circle", STEP_S, eta, velocity, np.stack([-SPEED_MPS * rate * c, -SPEED_MPS * rate * s, zero, zero], axis=1)
    )


def fly(case: Case, steps: int, tamper: Tamper | None = None, clock: Callable[[], int] = time.perf_counter_ns) -> Flown:
    """Fly a case and time its first robot. `tamper` may change that robot's controller first."""
    experiment = case.experiment()
    vehicle, count = experiment.vehicle, case.neighbours + 1
    model = Model(vehicle, experiment.controller.estimator.sway, experiment.controller.law == "nmpc")
    dead_steps = round(vehicle.thruster.dead_time_s / STEP_S)
    paths = [circle(place, (WARM_UP + steps) * STEP_S + BEYOND_S) for place in places(count, case.beside)]
    robots = [make_controller(Setting(vehicle, experiment.controller, experiment.safety)) for _ in range(count)]
    if tamper is not None:
        tamper(robots[0], experiment)
    waters = [Water(model, (*map(float, path.eta[0]), *(0.0,) * 7), dead_steps) for path in paths]
    plans: list[Plan | None] = [None] * count
    random = np.random.default_rng(1)
    took, errors, changes, unsolved = [], [], [], 0
    gc.collect()
    gc.disable()
    try:
        for k in range(-WARM_UP, steps):
            now_ns, delayed_plans = (k + WARM_UP) * STEP_NS, list(plans)
            for i, robot in enumerate(robots):
                measurement = waters[i].measurement(now_ns, random.normal(size=5) * NOISE)
                others = [
                    Neighbour(j, now_ns - STEP_NS, p, True, hears_us=True)
                    for j, p in enumerate(delayed_plans)
                    if j != i and p is not None
                ]
                goal = Follow(paths[i], (k + WARM_UP) * STEP_S)
                begin_ns = clock()
                output = robot.step(measurement, goal, others, now_ns)
                if i == 0 and k >= 0:
                    took.append((clock() - begin_ns) * 1e-3)
                    errors.append(math.dist(waters[0].state[:2], paths[0].eta[k + WARM_UP, :2]))
                    changes.append(required(output.control).wrench_step / experiment.wrench_step)
                    unsolved += output.solve is not Solve.SOLVED
                plans[i] = Plan(robot.plan_period_s, output.plan_eta, output.plan_reference, output.tracking_error_m, False)
                waters[i].advance(required(output.control).wrench_delivered.tolist())
    finally:
        gc.enable()
    return Flown(took, errors, np.array(changes), unsolved)
