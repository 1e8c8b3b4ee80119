"""Thrusters and ankles of a whole fleet: from pulses to forces on the hull.

A pulse takes effect after its dead time. A thruster's force then follows the static curve, times the gain of this
thruster, as a first-order lag; an ankle turns to its angle at no more than its rate. Commands are constant within a step,
so both are known in closed form at every instant: nothing here is integrated numerically.
"""

from dataclasses import dataclass, replace

import numpy as np

from sim_bridge.plant.random_streams import Stream, generator
from wire.config.experiment import Experiment
from wire.frames import Array

THRUSTERS = 4


@dataclass(frozen=True, eq=False)
class ActuatorState:
    """State of the thrusters and ankles of n robots."""

    force_n: Array  # (n, 4)
    ankle_rad: Array  # (n, 4)
    pulses_us: Array  # (k, n, 8): the last k commands, newest first


@dataclass(frozen=True, eq=False)
class ActuatorStep:
    """Targets of thrusters and ankles during one step, and their state at its start."""

    start: ActuatorState
    target_n: Array  # (n, 4)
    target_rad: Array  # (n, 4)


class ActuatorModel:
    """The actuators of every robot of an experiment."""

    def __init__(self, experiment: Experiment, seed: int) -> None:
        plant, vehicle = experiment.sim.plant, experiment.vehicle
        self._curve, self._legs = vehicle.thruster, vehicle.legs
        self._lag_s = vehicle.thruster.lag_s if plant.thruster_lag_s is None else plant.thruster_lag_s
        self._thruster_delay = round(vehicle.thruster.dead_time_s / plant.step_s)
        self._ankle_delay = round(vehicle.legs.ankle_dead_time_s / plant.step_s)
        self.dead_steps = min(self._thruster_delay, self._ankle_delay)  # steps before pulses that are sent now take effect
        ahead_m, side_m = np.array(vehicle.legs.position_m).T
        below_m = np.full(THRUSTERS, plant.tilt.legs_below_m)
        one, none = np.ones(THRUSTERS), np.zeros(THRUSTERS)
        # from forces ahead and down to surge, sway, heave, roll, pitch, yaw: r x F of a force (X, 0, Z) at (x, y, z)
        self._mixing = np.block([
            [one, none], [none, none], [none, one],
            [none, side_m], [below_m, -ahead_m], [-side_m, none],
        ])  # fmt: skip
        self._robots = len(experiment.robots)
        spread = plant.thruster_spread
        random = generator(seed, Stream.THRUSTERS)
        self.gain = random.uniform(1.0 - spread, 1.0 + spread, (self._robots, THRUSTERS))

    def start(self) -> ActuatorState:
        """State at rest: neutral pulses for as long as the dead times reach back, ankles level."""
        level_us = float(np.mean(self._legs.ankle_us))
        neutral = np.repeat([float(self._curve.neutral_us), level_us], THRUSTERS)
        depth = max(self._thruster_delay, self._ankle_delay) + 1
        still = np.zeros((self._robots, THRUSTERS))
        return ActuatorState(still, still, np.tile(neutral, (depth, self._robots, 1)))

    def command(self, motors: ActuatorState, pulses_us: Array, factor: Array | float = 1.0) -> ActuatorStep:
        """Put pulses (n, 8) on the outputs for one step; the pulses of one dead time ago act in it. `factor` (n, 4) scales
        each thruster's force, for voltage and faults."""
        history = self._history(motors, pulses_us)
        target_n = factor * self.gain * self._curve.force_n(history[self._thruster_delay, :, :THRUSTERS])
        reach = self._legs.ankle_range_rad
        target_rad = np.interp(history[self._ankle_delay, :, THRUSTERS:], self._legs.ankle_us, (-reach, reach))
        return ActuatorStep(ActuatorState(motors.force_n, motors.ankle_rad, history), target_n, target_rad)

    def with_command_history(self, motors: ActuatorState, before: ActuatorState, pulses_us: Array) -> ActuatorState:
        """`motors` with the command history of `before` and these pulses (n, 8), which come too late to change its forces
        and angles."""
        return replace(motors, pulses_us=self._history(before, pulses_us))

    def _history(self, motors: ActuatorState, pulses_us: Array) -> Array:
        if pulses_us.shape != (self._robots, 2 * THRUSTERS) or not np.isfinite(pulses_us).all():
            raise ValueError(f"pulses_us: shape {pulses_us.shape}, must be ({self._robots}, {2 * THRUSTERS}) and finite")
        return np.concatenate([pulses_us[None], motors.pulses_us[:-1]])

    def at(self, move: ActuatorStep, since_s: Array | float) -> ActuatorState:
        """Forces and angles `since_s` after the start of a step; those of several instants (k,) are (k, n, 4)."""
        since = np.asarray(since_s)[..., None, None]
        left = np.exp(-since / self._lag_s) if self._lag_s > 0 else np.zeros_like(since)
        turn_rad = self._legs.ankle_rate_radps * since
        to_go = move.target_rad - move.start.ankle_rad
        ankle_rad = move.start.ankle_rad + np.minimum(np.maximum(to_go, -turn_rad), turn_rad)
        return ActuatorState(move.target_n + left * (move.start.force_n - move.target_n), ankle_rad, move.start.pulses_us)

    def legs(self, motors: ActuatorState) -> Array:
        """Forces on each hull, rows (6, n): surge, sway and heave N, roll, pitch and yaw N m; (k, 6, n) for k instants. An
        ankle at +90 degrees thrusts straight down."""
        ahead, down = motors.force_n * np.cos(motors.ankle_rad), motors.force_n * np.sin(motors.ankle_rad)
        return np.asarray(self._mixing @ np.concatenate([ahead, down], axis=-1).swapaxes(-1, -2))

    def wrench(self, motors: ActuatorState) -> Array:
        """[surge N, heave N, yaw N m] on each hull, (n, 3)."""
        return self.legs(motors)[[0, 2, 5]].T.copy()
