"""Thrusters and ankles of a fleet: from pulses to forces on the hull.

A pulse takes effect after its dead time. A thruster's force then follows the static curve, times the gain of this
thruster, as a first-order lag; an ankle turns to its angle at no more than its rate. Commands are constant within a step,
so both are known in closed form at every instant: nothing here is integrated numerically.
"""

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from shoal.config.experiment import Experiment
from shoal.config.vehicle import LEGS, OUTPUTS
from shoal.frames import Array
from shoal.kernels.decorator import kernel
from shoal.kernels.types import Cube, Floats, Table
from sim_bridge.plant.random_streams import Stream, generator
from sim_bridge.plant.vectors import NO_VECTOR, SixVector, Vector, add, cross, row_vector, scale


class Actuators(NamedTuple):
    """Constants of the actuators of every robot of an experiment."""

    curve_us: Floats
    curve_n: Floats
    ankle_us: Floats
    ankle_rad: Floats
    place_m: Table  # (thrusters, 3) on the body's axes
    thrust_axis: Table  # (thrusters, 3) of those that do not turn
    legs: int  # thrusters that turn, the first ones
    lag_s: float
    ankle_rate_radps: float
    thruster_delay: int  # steps of the plant
    ankle_delay: int


class ActuatorCommands(NamedTuple):
    """Commands to n robots, and the faults of their actuators, during some steps of the plant."""

    history_us: Cube  # (k, n, 8): those of the k steps before the first one, newest first
    pulses_us: Table  # (n, 8): from the first step on
    gain: Table  # (n, thrusters): force over that of the static curve
    lost_v: Floats  # (n,): voltage that each battery has lost


class Motors(NamedTuple):
    """Thrusters and ankles of n robots, and what they approach during a step."""

    force_n: Table  # (n, thrusters)
    ankle_rad: Table  # (n, 4)
    target_n: Table
    target_rad: Table


class Lapse(NamedTuple):
    """Progress of the actuators within a time."""

    left: float  # share of a thruster's way to its target that is still to go
    reach_rad: float  # angle by which an ankle can turn


@kernel(part=True)
def interpolate(x: float, knots: Floats, values: Floats) -> float:
    """The piecewise linear function through (knots, values), constant beyond its ends."""
    if x < knots[0]:
        return float(values[0])
    for k in range(len(knots) - 1):
        if x < knots[k + 1]:
            slope = (values[k + 1] - values[k]) / (knots[k + 1] - knots[k])
            return float(values[k] + slope * (x - knots[k]))
    return float(values[len(values) - 1])


@kernel(inline=True, part=True)
def acting_us(commands: ActuatorCommands, delay: int, step: int, i: int, output: int) -> float:
    """The pulse of one dead time ago on an output of robot i."""
    age = delay - step
    return float(commands.history_us[age - 1, i, output] if age > 0 else commands.pulses_us[i, output])


@kernel(part=True)
def set_targets(i: int, motors: Motors, actuators: Actuators, commands: ActuatorCommands, step: int, factor: float) -> None:
    """Write the forces and angles that the actuators of robot i approach during a step: those of the pulses of one dead time
    ago. `factor` is the battery's effect on thrust."""
    thrusters = len(actuators.place_m)
    for k in range(thrusters):
        static_n = interpolate(
            acting_us(commands, actuators.thruster_delay, step, i, k), actuators.curve_us, actuators.curve_n
        )
        motors.target_n[i, k] = factor * commands.gain[i, k] * static_n
    for leg in range(actuators.legs):
        pulse_us = acting_us(commands, actuators.ankle_delay, step, i, thrusters + leg)
        motors.target_rad[i, leg] = interpolate(pulse_us, actuators.ankle_us, actuators.ankle_rad)


@kernel(part=True)
def lapse_of(actuators: Actuators, seconds: float) -> Lapse:
    """Progress within a time that is shorter than a step: a first-order lag, and a limited rate."""
    left = math.exp(-seconds / actuators.lag_s) if actuators.lag_s > 0.0 else 0.0
    return Lapse(left, actuators.ankle_rate_radps * seconds)


@kernel(inline=True, part=True)
def force_after(i: int, thruster: int, motors: Motors, lapse: Lapse) -> float:
    """Force of a thruster of robot i so long after the step's start."""
    target_n = motors.target_n[i, thruster]
    return float(target_n + lapse.left * (motors.force_n[i, thruster] - target_n))


@kernel(inline=True, part=True)
def angle_after(i: int, leg: int, motors: Motors, lapse: Lapse) -> float:
    """Angle of an ankle of robot i so long after the step's start."""
    to_go = motors.target_rad[i, leg] - motors.ankle_rad[i, leg]
    return float(motors.ankle_rad[i, leg] + min(max(to_go, -lapse.reach_rad), lapse.reach_rad))


@kernel(part=True)
def thrusters_wrench(i: int, motors: Motors, actuators: Actuators, lapse: Lapse) -> SixVector:
    """Force and moment of robot i's thrusters on its axes, so long after the step's start: the sum of (F, r x F). A leg
    thrusts along (cos a, 0, sin a): an ankle at +90 degrees thrusts down."""
    force, moment = NO_VECTOR, NO_VECTOR
    for k in range(len(actuators.place_m)):
        axis = row_vector(actuators.thrust_axis, k, 0)
        if k < actuators.legs:
            angle = angle_after(i, k, motors, lapse)
            axis = Vector(math.cos(angle), 0.0, math.sin(angle))
        push = scale(force_after(i, k, motors, lapse), axis)
        force = add(force, push)
        moment = add(moment, cross(row_vector(actuators.place_m, k, 0), push))
    return SixVector(force, moment)


@kernel(part=True)
def move_actuators(i: int, motors: Motors, actuators: Actuators, lapse: Lapse) -> None:
    """Move the actuators of robot i on by a step."""
    for k in range(len(actuators.place_m)):
        motors.force_n[i, k] = force_after(i, k, motors, lapse)
    for leg in range(actuators.legs):
        motors.ankle_rad[i, leg] = angle_after(i, leg, motors, lapse)


@dataclass(frozen=True, eq=False)
class ActuatorState:
    """State of the thrusters and ankles of n robots."""

    force_n: Array  # (n, 4), and (n, 8) of thrusters that do not turn
    ankle_rad: Array  # (n, 4)
    pulses_us: Array  # (k, n, 8): the last k commands, newest first


class ActuatorModel:
    """The actuators of every robot of an experiment."""

    def __init__(self, experiment: Experiment, seed: int) -> None:
        """`seed`: of the thrusters' gains, which differ by up to plant.thruster_spread."""
        plant, vehicle, thruster = experiment.sim.plant, experiment.vehicle, experiment.vehicle.thruster
        legs = vehicle.legs
        lag_s = thruster.lag_s if plant.thruster_lag_s is None else plant.thruster_lag_s
        thruster_delay = round(thruster.dead_time_s / plant.step_s)
        ankle_delay = thruster_delay if legs is None else round(legs.ankle_dead_time_s / plant.step_s)
        self.dead_steps = min(thruster_delay, ankle_delay)  # steps before pulses that are sent now take effect
        self._history_steps = max(thruster_delay, ankle_delay) + 1  # commands that the state keeps
        self._neutral_us = np.full(OUTPUTS, float(thruster.neutral_us))
        ankle_us, reach_rad, rate_radps = (0.0, 1.0), 0.0, 0.0  # of ankles that are not there
        mounting = vehicle.thruster_table  # (thrusters, 6): place in m, direction of thrust; on the body's axes
        if legs is not None:
            ankle_us, reach_rad, rate_radps = legs.ankle_us, legs.ankle_range_rad, legs.ankle_rate_radps
            self._neutral_us[LEGS:] = np.mean(legs.ankle_us)
            mounting = np.zeros((LEGS, 6))  # a leg's direction turns
            mounting[:, :2], mounting[:, 2] = legs.position_m, plant.tilt.legs_below_m
        curve_us, curve_n = np.array(thruster.curve, dtype=np.float64).T.copy()
        self.count = len(mounting)  # of thrusters
        self.constants = Actuators(
            curve_us,
            curve_n,
            np.array(ankle_us, dtype=np.float64),
            np.array([-reach_rad, reach_rad]),
            mounting[:, :3].copy(),
            mounting[:, 3:].copy(),
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
        still, level = np.zeros((self._robots, self.count)), np.zeros((self._robots, LEGS))
        return ActuatorState(still, level, np.tile(self._neutral_us, (self._history_steps, self._robots, 1)))

    def command_history(self, motors: ActuatorState, pulses_us: Array, steps: int = 1) -> Array:
        """Command history (k, n, 8) after pulses (n, 8) have been on the outputs for some steps."""
        if pulses_us.shape != (self._robots, OUTPUTS) or not np.isfinite(pulses_us).all():
            raise ValueError(f"pulses_us: shape {pulses_us.shape}, must be ({self._robots}, {OUTPUTS}) and finite")
        history = np.empty_like(motors.pulses_us)
        history[:steps] = pulses_us
        history[steps:] = motors.pulses_us[:-steps]
        return history
