"""Variants of an experiment on the same seeds: who flies, where from, and what a flight comes to in numbers. Pure."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from itertools import combinations
from typing import get_args

import numpy as np

from sim_bridge.in_process.fleet import AgentFleet, BareWater
from sim_bridge.plant.random_streams import Stream, generator
from wire.config.baseline_controllers import LawName
from wire.config.controller_benchmark import SETTLED_S, FlightMetrics, FlightRecord, Traces
from wire.config.experiment import Experiment
from wire.frames import Array, pose_error
from wire.messages.messages import Mode, RobotState, Trajectory
from wire.toml_loader import ConfigError

ERROR_STRIDE = 10  # of control steps, in what is kept to look at
SHOWN_S = 20.0  # of the inputs
MOST_DRAWS = 1000  # of starts that keep robots apart

ARTICLE = (  # as printed: one working point, no sway, no lag, heading along the path
    "controller.estimator.sway=false",
    "controller.guidance.enabled=false",
    "controller.mpc.horizon=25",
    "controller.mpc.blocks=[1,1,1,1,1,1,1,1,1,1,1,1,1,1,1]",
    "controller.mpc.linearise=point",
    "controller.mpc.model_lag=false",
)
VARIANTS: dict[str, tuple[str, ...]] = {
    **{law: (f"controller.law={law}",) for law in get_args(LawName)},
    "backstepping-without-eso": ("controller.law=backstepping", "controller.estimator.enabled=false"),
    "mpc-without-eso": ("controller.estimator.enabled=false",),
    "mpc-without-sway": ("controller.estimator.sway=false",),
    "mpc-leader-follower": ("formation.kind=leader-follower",),
    "mpc-as-printed": ARTICLE,
}


@dataclass(frozen=True, eq=False)
class Task:
    """One flight to fly."""

    experiment: Experiment
    trajectories: Mapping[int, Trajectory]
    starts: Array  # (n, 4)
    seed: int
    look: bool  # keep traces


def scattered(starts: Array, scatter: float, seed: int, apart_m: float = 0.0) -> Array:
    """Starts (n, 4) moved by up to `scatter` m and rad in each coordinate; the same for every variant of a seed. Drawn again
    while two are nearer than `apart_m`, side by side and in depth. Raises ConfigError if that does not come about."""
    random = generator(seed, Stream.SCATTER)
    for _ in range(MOST_DRAWS):
        moved = starts + scatter * random.uniform(-1.0, 1.0, starts.shape)
        gaps = [moved[a] - moved[b] for a, b in combinations(range(len(moved)), 2)]
        if all(math.hypot(gap[0], gap[1]) >= apart_m or abs(gap[2]) >= apart_m for gap in gaps):
            return moved
    raise ConfigError(f"--scatter {scatter:g}: no starts of seed {seed} keep the robots {apart_m:g} m apart")


def fly(task: Task) -> FlightRecord:
    """Fly one variant on one seed. Raises ConfigError if the robots cannot start there."""
    water = BareWater(task.experiment, task.seed, task.starts)
    fleet = AgentFleet(task.experiment, task.trajectories, water, task.seed)
    fleet.start()
    while fleet.time_s < task.experiment.duration_s - 1e-9:
        fleet.step()
    states, truth = [robot.states[fleet.begin :] for robot in fleet.robots], np.array(fleet.truth[fleet.begin :])
    error = fleet.errors()
    traces = _traces(task, states, error) if task.look else None
    return FlightRecord(task.seed, _figures(task.experiment, states, truth, error), traces)


def _figures(experiment: Experiment, states: list[list[RobotState]], truth: Array, error: Array) -> FlightMetrics:
    """`truth` and `error` (steps, n, 4); `states` per robot and step."""
    limits, settled = experiment.vehicle.limits, round(SETTLED_S / experiment.controller.period_s)
    distance = np.linalg.norm(error[:, :, :3], axis=2)
    formation, separation = _pairs(truth, error)
    wanted = _rows(states, "wrench_wanted") / np.array(limits.wrench)
    quick = np.diff(wanted, axis=1) * np.array(limits.wrench) / experiment.wrench_step
    large = (np.abs(wanted) > 1.0 + 1e-9).any(axis=2)[:, 1:]
    fast = (np.abs(quick) > 1.0 + 1e-9).any(axis=2)
    steps = _rows(states, "wrench_step") / experiment.wrench_step
    return FlightMetrics(
        rms_m=_rms(distance),
        rms_after_20s_m=_rms(distance[settled:]),
        max_after_20s_m=float(distance[settled:].max()),
        rms_yaw_rad=_rms(error[:, :, 3]),
        rms_yaw_after_20s_rad=_rms(error[settled:, :, 3]),
        formation_rms_m=_rms(formation),
        formation_after_20s_m=_rms(formation[settled:]),
        min_separation_m=separation,
        input_step_rms=float(np.sqrt(np.mean(steps**2, axis=1)).max()),
        wanted_too_large=float(large.mean()),
        wanted_too_fast=float(fast.mean()),
        wanted_beyond=float((large | fast).mean()),
        wanted_most=float(np.abs(wanted).max()),
        under_way=float(np.mean([[state.mode is Mode.TRACKING for state in each] for each in states])),
    )


def _pairs(truth: Array, error: Array) -> tuple[Array, float | None]:
    """Formation errors (steps, pairs) in m, and the least distance of two robots."""
    pairs = list(combinations(range(error.shape[1]), 2))
    if not pairs:
        return np.zeros((len(error), 1)), None
    apart = [np.linalg.norm(pose_error(error[:, a], error[:, b])[:, :3], axis=1) for a, b in pairs]
    return np.array(apart).T, min(float(np.linalg.norm((truth[:, a] - truth[:, b])[:, :3], axis=1).min()) for a, b in pairs)


def _traces(task: Task, states: list[list[RobotState]], error: Array) -> Traces:
    period_s = task.experiment.controller.period_s
    shown = round(SHOWN_S / period_s)
    root = np.sqrt(np.mean(np.sum(error[::ERROR_STRIDE, :, :3] ** 2, axis=2), axis=1))
    return Traces(
        error_period_s=round(ERROR_STRIDE * period_s, 9),
        error_m=[round(value, 6) for value in root.tolist()],
        input_period_s=round(period_s, 9),
        wanted_n=np.round(_rows(states, "wrench_wanted")[:, :shown, 0], 4).tolist(),
        applied_n=np.round(_rows(states, "wrench")[:, :shown, 0], 4).tolist(),
    )


def _rows(states: list[list[RobotState]], key: str) -> Array:
    """(n, steps, 3)"""
    return np.array([[getattr(state, key) for state in each] for each in states])


def _rms(values: Array) -> float:
    return float(np.sqrt(np.mean(values**2)))
