"""A control loop to time: robots side by side on circles, the controller's own model as their water, noisy poses 40 ms old.

Peers run this too, in environments of their own, with another solver in the controller's place: so every figure is of one
complete control step (estimate, linearise, assemble, update, solve, allocate), closed loop, on the same scene.
"""

import gc
import time
from collections.abc import Callable, Sequence
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
WARM_UP = 60  # steps, 3 s: from rest to speed
RADIUS_M, SPEED_MPS, DEPTH_M = 0.5, 0.1, 0.3
APART_M, TOO_NEAR_M = 1.2, 0.58  # 2R is 0.6
NOISE = (0.0015, 0.0015, 0.009, 0.002, 0.003)  # x, y, yaw, depth, yaw rate: what localizer and board have

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
    t = np.arange(0.0, seconds + 5.0, STEP_S)
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
    paths = [circle(place, steps * STEP_S) for place in places(count, case.beside)]
    robots = [make_controller(Setting(vehicle, experiment.controller, experiment.safety)) for _ in range(count)]
    if tamper is not None:
        tamper(robots[0], experiment)
    states: list[State] = [(*map(float, path.eta[0]), *(0.0,) * 7) for path in paths]
    plans: list[Plan | None] = [None] * count
    random = np.random.default_rng(1)
    took, errors, changes, unsolved = [], [], [], 0
    gc.collect()
    gc.disable()
    try:
        for k in range(-WARM_UP, steps):
            now_ns, delayed_plans = (k + WARM_UP) * STEP_NS, list(plans)
            for i, robot in enumerate(robots):
                measurement = _seen(states[i], now_ns, random.normal(size=5) * NOISE)
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
                    errors.append(float(np.hypot(*(np.array(states[0][:2]) - paths[0].eta[k + WARM_UP, :2]))))
                    changes.append(required(output.control).wrench_step / experiment.wrench_step)
                    unsolved += output.solve is not Solve.SOLVED
                plans[i] = Plan(robot.plan_period_s, output.plan_eta, output.plan_reference, output.tracking_error_m, False)
                states[i] = model.advance(
                    states[i], (0.01, 0.0, 0.0, 0.0), required(output.control).wrench_delivered.tolist(), STEP_S
                )
    finally:
        gc.enable()
    return Flown(took, errors, np.array(changes), unsolved)


def _seen(state: State, now_ns: int, noise: Sequence[float] | Array) -> StateMeasurement:
    """As if it had taken 40 ms; the robot is where it was then to a millimetre or two, which counts as noise here."""
    x, y, z, yaw = state[:4]
    age_s = 0.04
    back_x, back_y = (
        (np.cos(yaw) * state[4] - np.sin(yaw) * state[5]) * age_s,
        (np.sin(yaw) * state[4] + np.cos(yaw) * state[5]) * age_s,
    )
    sighting = PoseMeasurement(
        now_ns - round(age_s * 1e9), x - back_x + noise[0], y - back_y + noise[1], wrap(yaw - state[7] * age_s + noise[2])
    )
    return StateMeasurement(sighting, z + noise[3], state[7] + noise[4])
