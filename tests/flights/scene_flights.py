"""Numeric flights whole: planned, put into the water, flown, and held against their references."""

from dataclasses import dataclass
from functools import cache
from itertools import combinations

import numpy as np

from groundstation.planning import planner
from shoal.config.experiment import Experiment, load_experiment
from shoal.frames import Array, pose_error
from shoal.messages.messages import RobotState
from sim_bridge.in_process.fleet import AgentFleet, DirectPlant, fly

SETTLED_S = 20.0


@dataclass(frozen=True, eq=False)
class SceneFlight:
    """A scene that was flown. Row k is the control step at time k times the period."""

    experiment: Experiment
    fleet: AgentFleet
    truth: Array  # (steps, n, 4)
    error: Array  # (steps, n, 4) truth minus trajectory, yaw to the path's tangent
    states: list[list[RobotState]]  # per robot

    @property
    def settled(self) -> int:
        """The first row after 20 s."""
        return round(SETTLED_S / self.experiment.controller.period_s)

    def subjects(self) -> dict[str, Array]:
        """Tracking error of each robot and formation error of each pair, (steps, 4)."""
        n = len(self.experiment.robots)
        pairs = {f"{a + 1}-{b + 1}": pose_error(self.error[:, a], self.error[:, b]) for a, b in combinations(range(n), 2)}
        return {**{str(i + 1): self.error[:, i] for i in range(n)}, **pairs}

    def settled_rms(self) -> tuple[float, float]:
        """Largest RMS after 20 s of any robot and pair: per axis in m, and yaw in rad."""
        rms = np.array([np.sqrt(np.mean(error[self.settled :] ** 2, axis=0)) for error in self.subjects().values()])
        return float(rms[:, :3].max()), float(rms[:, 3].max())


def prepared(experiment: Experiment) -> tuple[AgentFleet, DirectPlant]:
    """Robots where the experiment puts them, with the trajectories that the station plans, and the water they are in."""
    trajectories = planner.plan(experiment)
    starts = planner.start_poses(experiment, trajectories)
    water = DirectPlant(experiment, experiment.seed, np.array([starts[r] for r in experiment.robot_ids]))
    return AgentFleet(experiment, trajectories, water, experiment.seed), water


def flew(experiment: Experiment) -> AgentFleet:
    """The fleet when the whole experiment is over."""
    fleet, water = prepared(experiment)
    fleet.start()
    for _ in fly(fleet, water):
        pass
    return fleet


def rough_water(random: np.random.Generator) -> tuple[str, ...]:
    """Settings: gusts and waves, and a mass that is off by up to 30 %."""
    return (
        f"sim.plant.mass_error={random.uniform(-0.3, 0.3):.2f}",
        f"sim.plant.gust_mps={random.uniform(0, 0.03):.3f}",
        f"sim.plant.waves.height_m={random.uniform(0, 0.05):.3f}",
    )


def flown(experiment: Experiment) -> SceneFlight:
    """The whole experiment, held against its references."""
    fleet, water = prepared(experiment)
    fleet.start()
    held = len(fleet.truth) - 1
    for _ in fly(fleet, water):
        pass
    truth = np.array(fleet.truth[held:])
    reference = np.array([t.eta[: len(truth)] for t in fleet.trajectories.values()]).transpose(1, 0, 2)
    return SceneFlight(experiment, fleet, truth, pose_error(truth, reference), [robot.states[held:] for robot in fleet.robots])


@cache
def flown_once(name: str, *settings: str) -> SceneFlight:
    """A flight that several tests of a process look at."""
    return flown(load_experiment(name, settings))
