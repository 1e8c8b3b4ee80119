"""SHELL: an experiment's robots in their water, step by step, for learning: `reset` and `step` as gymnasium has them.

    env = Env("numeric")
    observation, info = env.reset(seed=1)
    observation, reward, terminated, truncated, info = env.step(np.zeros(env.action_shape))

No agent flies: an action is the wrench itself, and an observation is the truth. No file is written.
"""

from collections.abc import Mapping
from typing import Any

import numpy as np

from groundstation.planning.segment import sample
from robot_agent.vehicle.fixed_thrusters import make_allocator
from shoal.config.experiment import NO_CAMERA, load_experiment
from shoal.config.loader import toml_value
from shoal.frames import Array, pool_to_body, pose_error
from sim_bridge.fault_schedule import NUMERIC, require_kinds
from sim_bridge.in_process.fleet import NS, DirectPlant
from sim_bridge.in_process.run import plan

AXES = 4  # x, y, z, yaw


class Env:
    """The robots of an experiment along the trajectories that its station plans.

    An action (robots, 3; 4 with side thrust) is each robot's wrench as a share of its limits, -1 to 1. Its change in a step is
    limited as on a robot. An observation (robots, 12 + 3) has, on each robot's own level axes, its pose less the reference's,
    its velocity over ground, the reference's velocity, and then the wrench, as a share, that it has now.
    """

    def __init__(self, experiment: str = "numeric", settings: Mapping[str, Any] | None = None) -> None:
        """`settings` are keys of the experiment: {"sim.plant.current_mps": [0.05, 0, 0]}. Raises ConfigError."""
        lines = [f"{key}={toml_value(value)}" for key, value in (settings or {}).items()]
        self.experiment = load_experiment(experiment, [*lines, NO_CAMERA])
        require_kinds(self.experiment, NUMERIC, "in a numeric flight there is none")
        trajectories, starts = plan(self.experiment)
        self.trajectories = list(trajectories.values())
        self.starts = np.array([starts[robot] for robot in self.experiment.robot_ids])
        self._allocator = make_allocator(self.experiment.vehicle)
        self._limits = np.array(self.experiment.vehicle.limits.wrench)
        self._most_change = np.array(self.experiment.wrench_step) / self._limits
        self._period_ns = round(self.experiment.controller.period_s * NS)
        self._seed = self.experiment.seed
        self.action_shape = (len(self.starts), len(self._limits))
        self.observation_shape = (len(self.starts), 3 * AXES + len(self._limits))

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[Array, dict[str, Any]]:
        """Put the robots back to where they start. Without a seed, noise and thrusters are those of the next one."""
        other_reset = getattr(super(), "reset", None)  # of gymnasium.Env, where a class of a script has both as bases
        if other_reset is not None:
            other_reset(seed=seed, options=options)
        seed, self._seed = (self._seed, self._seed + 1) if seed is None else (seed, seed + 1)
        self._water = DirectPlant(self.experiment, seed, self.starts)
        self._shares = np.zeros(self.action_shape)
        return self._observe()[0], {"time_s": 0.0}

    def step(self, action: Array) -> tuple[Array, float, bool, bool, dict[str, Any]]:
        """Drive all robots for a control period. The episode is terminated where a robot touches another one or a wall, and
        truncated at the experiment's end."""
        wanted = np.clip(np.asarray(action, dtype=np.float64).reshape(self.action_shape), -1.0, 1.0)
        self._shares = self._shares + np.clip(wanted - self._shares, -self._most_change, self._most_change)
        self._water.put_out(np.array([self._allocator.allocate(wrench)[0] for wrench in self._shares * self._limits]))
        self._water.advance(self._water.now_ns + self._period_ns)
        observation, error = self._observe()
        is_over = self._time_s > self.experiment.duration_s - 1e-9
        return observation, self.reward(error), self._water.touches(), is_over, {"time_s": self._time_s}

    def reward(self, error: Array) -> float:
        """Minus the squared error (n, 4) of pose to reference, in m^2 and rad^2, the robots' mean."""
        return -float(np.mean(np.sum(error**2, axis=1)))

    @property
    def _time_s(self) -> float:
        return self._water.now_ns / NS

    def _observe(self) -> tuple[Array, Array]:
        """The observation (n, 12 + 3), and the error (n, 4) in the pool frame."""
        reference, velocity = self._reference()
        eta = self._water.eta
        error = pose_error(eta, reference)
        columns = [_on_axes(error, eta), self._water.nu, _on_axes(velocity, eta), self._shares]
        return np.hstack(columns).astype(np.float32), error

    def _reference(self) -> tuple[Array, Array]:
        """Poses and velocities (n, 4) on the trajectories now, pool frame."""
        motions = [sample(trajectory, np.array([self._time_s])) for trajectory in self.trajectories]
        return np.vstack([motion.eta for motion in motions]), np.vstack([motion.velocity for motion in motions])


def _on_axes(vectors: Array, eta: Array) -> Array:
    """Vectors (n, 4) of the pool frame on the level axes of robots at eta."""
    return np.hstack([pool_to_body(vectors[:, :2], eta[:, 3]), vectors[:, 2:]])
