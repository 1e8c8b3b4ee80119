"""Thrusters and ankles of a whole fleet: from pulses to forces on the hull.

A pulse takes effect after its dead time. A thruster's force then follows the static curve, times the gain of this
thruster, as a first-order lag; an ankle turns to its angle at no more than its rate. Commands are constant within a step,
so both are known in closed form at every instant: nothing here is integrated numerically.
"""

from dataclasses import dataclass

import numpy as np

from shoal.config.experiment import Experiment
from shoal.config.vehicle import LEGS, OUTPUTS
from shoal.frames import Array
from sim_bridge.plant.kernels import ANKLES
from sim_bridge.plant.random_streams import Stream, generator


@dataclass(frozen=True, eq=False)
class ActuatorState:
    """State of the thrusters and ankles of n robots."""

    force_n: Array  # (n, 4), and (n, 8) of thrusters that do not turn
    ankle_rad: Array  # (n, 4)
    pulses_us: Array  # (k, n, 8): the last k commands, newest first


class ActuatorModel:
    """The actuators of every robot of an experiment."""

    def __init__(self, experiment: Experiment, seed: int) -> None:
        plant, vehicle, thruster = experiment.sim.plant, experiment.vehicle, experiment.vehicle.thruster
        legs = vehicle.legs
        lag_s = thruster.lag_s if plant.thruster_lag_s is None else plant.thruster_lag_s
        thruster_delay = round(thruster.dead_time_s / plant.step_s)
        ankle_delay = thruster_delay if legs is None else round(legs.ankle_dead_time_s / plant.step_s)
        self.dead_steps = min(thruster_delay, ankle_delay)  # steps before pulses that are sent now take effect
        self._depth = max(thruster_delay, ankle_delay) + 1
        self._neutral_us = np.full(OUTPUTS, float(thruster.neutral_us))
        ankle_us, reach_rad, rate_radps = (0.0, 1.0), 0.0, 0.0  # of ankles that are not there
        place = vehicle.thruster_table
        if legs is not None:
            ankle_us, reach_rad, rate_radps = legs.ankle_us, legs.ankle_range_rad, legs.ankle_rate_radps
            self._neutral_us[LEGS:] = np.mean(legs.ankle_us)
            place = np.zeros((LEGS, 6))
            place[:, :2], place[:, 2] = legs.position_m, plant.tilt.legs_below_m
        curve_us, curve_n = np.array(thruster.curve, dtype=np.float64).T.copy()
        self.count = len(place)  # of thrusters
        self.constants = (
            curve_us,
            curve_n,
            np.array(ankle_us, dtype=np.float64),
            np.array([-reach_rad, reach_rad]),
            place,
            0 if legs is None else LEGS,
            lag_s,
            rate_radps,
            thruster_delay,
            ankle_delay,
        )
        self._robots = len(experiment.robots)
        spread = plant.thruster_spread
        random = generator(seed, Stream.THRUSTERS)
        self.gain = random.uniform(1.0 - spread, 1.0 + spread, (self._robots, self.count))

    def start(self) -> ActuatorState:
        """State at rest: neutral pulses for as long as the dead times reach back, ankles level."""
        still, level = np.zeros((self._robots, self.count)), np.zeros((self._robots, ANKLES))
        return ActuatorState(still, level, np.tile(self._neutral_us, (self._depth, self._robots, 1)))

    def command_history(self, motors: ActuatorState, pulses_us: Array, steps: int = 1) -> Array:
        """Command history (k, n, 8) after pulses (n, 8) have been on the outputs for some steps."""
        if pulses_us.shape != (self._robots, OUTPUTS) or not np.isfinite(pulses_us).all():
            raise ValueError(f"pulses_us: shape {pulses_us.shape}, must be ({self._robots}, {OUTPUTS}) and finite")
        history = np.empty_like(motors.pulses_us)
        history[:steps] = pulses_us
        history[steps:] = motors.pulses_us[:-steps]
        return history
