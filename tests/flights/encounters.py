"""Encounters: scenes in which robots are in one another's way, from starts that a seed draws.

Each seed draws where, in which direction and how late each robot starts, its sensors' noise and biases, the strength of its
thrusters, and where and how fast obstacles drift. Controllers and plant run in one process; separation is measured on the
plant's truth.
"""

import dataclasses
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from groundstation.planning import planner
from shoal.config.experiment import Experiment
from shoal.frames import Array
from shoal.messages.messages import Trajectory
from sim_bridge.in_process.fleet import AgentFleet, DirectPlant

SCENES = ("swap", "crossing-2", "crossing-4", "overtake", "drifting-obstacle")
PLACE_M, YAW_RAD, LATE_S = 0.15, 0.8, 2.0  # how far off, turned away and late a robot starts at most
ADRIFT_M, ADRIFT = 0.15, 0.3  # how far off and how much faster or slower an obstacle
THERE_M = 0.1  # a robot this near its goal has arrived
SETTLED_S = 3.0  # a flight ends when everyone has been there for so long
STREAM = 41  # keeps this use of the seed apart from the others


@dataclass(frozen=True, eq=False)
class Encounter:
    """The outcome of one encounter."""

    seed: int
    nearest_m: float  # centres of any two robots; infinite if there is one only
    clear_m: float  # from a robot's centre to the edge of anything; infinite if there is nothing
    slack_m: float  # most that a plan entered the space of another
    arrived_s: tuple[float, ...]  # each robot, to stay; infinite if it did not
    track: Array  # (steps, robots, 4) true poses

    @property
    def deadlock(self) -> bool:
        """True if a robot did not get to its end."""
        return max(self.arrived_s) == float("inf")


def meet(experiment: Experiment, seed: int) -> Encounter:
    """Fly a scene from starts that a seed draws."""
    random = np.random.default_rng([seed, STREAM])
    experiment = _stirred(experiment, random)
    trajectories = planner.plan(experiment)
    planned = planner.start_poses(experiment, trajectories)
    starts = np.array([planned[robot] for robot in experiment.robot_ids])
    starts += random.uniform(-1.0, 1.0, starts.shape) * [PLACE_M, PLACE_M, 0.0, YAW_RAD]
    late = {robot: _late(trajectory, random.uniform(0.0, LATE_S)) for robot, trajectory in trajectories.items()}
    water = DirectPlant(experiment, seed, starts)
    fleet = AgentFleet(experiment, late, water, seed)
    fleet.start()
    held = len(fleet.truth) - 1
    goals = np.array([late[robot].eta[-1] for robot in experiment.robot_ids])
    there_s = 0.0
    while fleet.time_s < experiment.duration_s - 1e-9 and there_s < SETTLED_S:
        fleet.step()
        there = np.hypot(*(fleet.truth[-1] - goals)[:, :2].T).max() < THERE_M
        there_s = there_s + experiment.controller.period_s if there else 0.0
    track = np.array(fleet.truth[held:])
    away = np.hypot(*(track - goals)[:, :, :2].T)
    return Encounter(
        seed,
        min((_apart(track, a, b) for a, b in combinations(range(len(starts)), 2)), default=float("inf")),
        _clearance(experiment, track),
        max((s.control.slack_m for robot in fleet.robots for s in robot.states if s.control is not None), default=0.0),
        tuple(_arrival(each, experiment.controller.period_s) for each in away),
        track,
    )


def _stirred(experiment: Experiment, random: np.random.Generator) -> Experiment:
    """The same with its obstacles elsewhere, at another speed."""
    drifters = []
    for ball in experiment.sim.drifters:
        x, y, z = ball.start_m
        aside_m, along_m = random.uniform(-ADRIFT_M, ADRIFT_M, 2)
        u, v, w = np.array(ball.velocity_mps) * random.uniform(1.0 - ADRIFT, 1.0 + ADRIFT)
        drifters.append(ball.model_copy(update={"start_m": (x + aside_m, y + along_m, z), "velocity_mps": (u, v, w)}))
    return experiment.model_copy(update={"sim": experiment.sim.model_copy(update={"drifters": tuple(drifters)})})


def _clearance(experiment: Experiment, track: Array) -> float:
    """The distance from a robot's centre to the edge of an island or a ball."""
    time_s = experiment.controller.period_s * np.arange(len(track))
    edges = [np.hypot(*(track[:, :, :2] - island.position_m).T).min() - island.radius_m for island in experiment.islands]
    for ball in experiment.sim.drifters:
        places = [place for t in time_s if (place := ball.place_m(float(t))) is not None]
        flown_part = track[len(track) - len(places) :]
        edges.append(np.hypot(*(flown_part[:, :, :2] - np.array(places)[:, None, :2]).T).min() - ball.radius_m)
    return float(min(edges, default=float("inf")))


def _late(trajectory: Trajectory, delay_s: float) -> Trajectory:
    """The same, after a wait at its start."""
    wait = round(delay_s / trajectory.period_s)
    rows = np.maximum(np.arange(len(trajectory.eta)) - wait, 0)
    moves = (np.arange(len(rows)) >= wait)[:, None]
    velocity, acceleration = trajectory.velocity[rows] * moves, trajectory.acceleration[rows] * moves
    return dataclasses.replace(trajectory, eta=trajectory.eta[rows], velocity=velocity, acceleration=acceleration)


def _apart(track: Array, a: int, b: int) -> float:
    return float(np.hypot(*(track[:, a, :2] - track[:, b, :2]).T).min())


def _arrival(away_m: Array, period_s: float) -> float:
    outside = np.flatnonzero(away_m > THERE_M)
    last = int(outside[-1]) if len(outside) else -1
    return (last + 1) * period_s if last + 1 < len(away_m) else float("inf")
