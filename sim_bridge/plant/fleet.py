"""The plant: a fleet of robots in water, one or more steps at a time.

Deliberately richer than the controller's model, and written without it: the controller is judged by it. motion.advance moves
the fleet.
"""

from dataclasses import dataclass, replace

import numpy as np

from shoal.config.experiment import Experiment
from shoal.config.vehicle import OUTPUTS, Vehicle
from shoal.errors import ConfigError
from shoal.frames import Array
from shoal.messages.messages import Truth
from sim_bridge.fault_schedule import ActuatorFaults
from sim_bridge.plant.actuators import ActuatorCommands, ActuatorModel, ActuatorState, Motors
from sim_bridge.plant.battery import BatteryModel
from sim_bridge.plant.contact import ContactModel
from sim_bridge.plant.currents_waves import WaterFlow
from sim_bridge.plant.motion import FleetVariables, Parts, Span, StateTables, accelerations, advance
from sim_bridge.plant.rigid_body import hull_of
from sim_bridge.plant.robot_state import HEAVE, STATES, SURGE, SWAY, TURN, LevelMotion

WRENCH_IN_SIX = (0, 2, 5, 1)  # indices of a wrench's surge, heave, yaw and sway in (Fx, Fy, Fz, Mx, My, Mz)
WRENCH_AXES = (SURGE, HEAVE, TURN, SWAY)  # indices of a wrench's axes in nu


@dataclass(frozen=True, eq=False)
class PlantState:
    """The whole fleet at one instant. Yaw is not wrapped. Velocities are over ground, on level axes that turn with the
    heading: eta' = J(yaw) nu holds for any tilt."""

    steps: int  # of plant.step_s since the start
    eta: Array  # (n, 4) pool frame
    nu: Array  # (n, 4)
    motors: ActuatorState
    tilt: Array  # (n, 4): roll, pitch, and d/dt of them
    charge: Array  # (n,) of the batteries, 0 to 1


class Plant:
    """All robots of an experiment: a state goes in, the next one comes out. One thread at a time may use it."""

    def __init__(self, experiment: Experiment, seed: int) -> None:
        plant = experiment.sim.plant
        n = len(experiment.robots)
        self._robots = experiment.robot_ids
        self._step_s = plant.step_s
        self._sway = plant.sway
        self._nominal = experiment.vehicle
        self._thrusters = ActuatorModel(experiment, seed)
        self._supply = BatteryModel(experiment)
        self._basin = ContactModel(experiment)
        self._flow = WaterFlow(experiment, seed)
        self._hull = hull_of(experiment)
        self._parts = self._constants()
        self.no_faults = ActuatorFaults(np.ones((n, OUTPUTS)), np.zeros(n))
        self._tables = StateTables(*np.zeros((4, n, STATES)))

    def _constants(self) -> Parts:
        thrusters, supply, flow, basin = self._thrusters, self._supply, self._flow, self._basin
        return Parts(thrusters.constants, supply.constants, flow.constants, basin.constants, self._hull)

    def start(self, eta: Array) -> PlantState:
        """Robots at rest at poses (n, 4). Raises ConfigError if one of them starts in a wall, an island or another robot."""
        n = len(self._robots)
        if eta.shape != (n, 4) or not np.isfinite(eta).all():
            raise ValueError(f"eta: shape {eta.shape}, must be ({n}, 4) and finite")
        for i in self._basin.touching(eta[:, :3]):
            x, y, z = eta[i, :3]
            where = "in a wall, an island or another robot"
            raise ConfigError(f"robot {self._robots[i]}: starts at ({x:g}, {y:g}, {z:g}), {where}")
        still = np.zeros((n, 4))
        return PlantState(0, np.array(eta, dtype=np.float64), still, self._thrusters.start(), still, self._supply.start(n))

    @property
    def dead_steps(self) -> int:
        """Number of steps in which pulses that come now have no effect."""
        return self._thrusters.dead_steps

    def time_s(self, state: PlantState) -> float:
        """Simulated time since the start."""
        return state.steps * self._step_s

    def step(self, state: PlantState, pulses_us: Array, faults: ActuatorFaults | None = None, steps: int = 1) -> PlantState:
        """The fleet `steps` steps of plant.step_s later, with pulses (n, 8) on the boards' outputs meanwhile."""
        faults = faults or self.no_faults
        pulses_us = np.ascontiguousarray(pulses_us, dtype=np.float64)
        before, gain = state.motors, self._thrusters.gain * faults.thrust[:, : self._thrusters.count]
        history = self._thrusters.command_history(before, pulses_us, steps)
        motion = LevelMotion(state.eta.copy(), state.nu.copy(), state.tilt.copy())
        force_n, ankle_rad = before.force_n.copy(), before.ankle_rad.copy()
        motors = Motors(force_n, ankle_rad, np.empty_like(force_n), np.empty_like(ankle_rad))
        fleet = FleetVariables(motion, motors, state.charge.copy())
        commands = ActuatorCommands(before.pulses_us, pulses_us, gain, faults.sag_v)
        advance(fleet, commands, Span(state.steps, steps, self._step_s), self._parts, self._tables)
        return PlantState(
            state.steps + steps, motion.eta, motion.nu, ActuatorState(force_n, ankle_rad, history), motion.tilt, fleet.charge
        )

    def with_past_pulses(self, state: PlantState, i: int, pulses_us: Array, steps: int) -> PlantState:
        """The state as if pulses (8,) had been on the i-th board's outputs for the last `steps` already. Forces stay: only
        what is still within the thrusters' dead time changes."""
        history = state.motors.pulses_us.copy()
        history[:steps, i] = pulses_us
        return replace(state, motors=replace(state.motors, pulses_us=history))

    def _accelerations(self, state: PlantState) -> tuple[Array, Array]:
        """d nu / dt now, (n, 4), and the thrusters' forces and moments (n, 6) in N and N m, on body axes."""
        force_n, ankle_rad = state.motors.force_n, state.motors.ankle_rad
        motors = Motors(force_n, ankle_rad, force_n, ankle_rad)  # they stay where they are
        fleet = FleetVariables(LevelMotion(state.eta, state.nu, state.tilt), motors, state.charge)
        acceleration, forces_moments = np.empty_like(state.nu), np.empty((len(state.nu), 6))
        accelerations(fleet, self.time_s(state), self._parts, self._tables, acceleration, forces_moments)
        return acceleration, forces_moments

    def acceleration(self, state: PlantState) -> Array:
        """d nu / dt now, (n, 4)."""
        return self._accelerations(state)[0]

    def set_current(self, current_mps: Array) -> None:
        """Change the current (3,) at the surface from now on."""
        self._flow.set_current(current_mps)
        self._parts = self._constants()

    def touching(self, state: PlantState) -> list[int]:
        """Indices of the robots that touch a wall, the floor, an island or another robot."""
        return self._basin.touching(state.eta[:, :3])

    def water_mps(self, state: PlantState) -> Array:
        """The water's own velocity (n, 3) where the robots are, pool frame."""
        return self._flow.motion(state.eta[:, :3], self.time_s(state))[:, :3].copy()

    def rest_v(self, state: PlantState, faults: ActuatorFaults | None = None) -> Array:
        """Voltage (n,) of the batteries without load."""
        return self._supply.rest_v(state.charge) - (faults or self.no_faults).sag_v

    def truth(self, state: PlantState) -> Truth:
        """The true state, wrench (n, 3) or (n, 4), and lumped disturbance (n, 4): the acceleration that the vehicle file's
        model does not explain. For the log; no controller may read it."""
        acceleration, forces_moments = self._accelerations(state)
        wrench = forces_moments[:, WRENCH_IN_SIX[: len(self._nominal.limits.wrench)]]
        expected = nominal_acceleration(self._nominal, state.nu, wrench, self._sway)
        return Truth(self._robots, state.eta.copy(), state.nu.copy(), wrench, acceleration - expected)


class PlantRun:
    """A plant and the state that it has reached."""

    def __init__(self, experiment: Experiment, seed: int, starts: Array) -> None:
        """Put the robots in at `starts`, poses (n, 4) in the pool frame."""
        self._plant = Plant(experiment, seed)
        self._state = self._plant.start(starts)
        self._step_ns = round(experiment.sim.plant.step_s * 1e9)
        self._current_mps, self._gust_mps = np.array(experiment.sim.plant.current_mps, dtype=np.float64), 0.0

    @property
    def now_ns(self) -> int:
        """Plant time since the start."""
        return self._state.steps * self._step_ns

    @property
    def eta(self) -> Array:
        """Poses now, (n, 4)."""
        return self._state.eta

    @property
    def nu(self) -> Array:
        """Velocities now, (n, 4)."""
        return self._state.nu

    @property
    def tilt(self) -> Array:
        """Roll, pitch and their rates now, (n, 4)."""
        return self._state.tilt

    def truth(self) -> Truth:
        """The state now, for the log; no controller may read it."""
        return self._plant.truth(self._state)

    def touches(self) -> bool:
        """True if a robot touches a wall, the floor, an island or another robot."""
        return bool(self._plant.touching(self._state))

    def _set_gust(self, gust_mps: float) -> None:
        """Add a gust along x to the experiment's current, in place of the last gust, from now on."""
        if gust_mps != self._gust_mps:
            self._gust_mps = gust_mps
            self._plant.set_current(self._current_mps + np.array([gust_mps, 0.0, 0.0]))


def nominal_acceleration(vehicle: Vehicle, nu: Array, wrench: Array, sway: bool) -> Array:
    """d/dt (n, 4) of the velocities nu by the vehicle file's numbers, in still water: each axis has its own drag, and of
    Coriolis terms m_v v r on surge and -m_u u r on sway. `wrench` (n, 3) is surge, heave, yaw; (n, 4) with sway."""
    force = -(vehicle.drag_linear + vehicle.drag_quadratic * np.abs(nu)) * nu
    force[:, WRENCH_AXES[: wrench.shape[1]]] += wrench
    if sway:
        force[:, SURGE] += vehicle.inertia[SWAY] * nu[:, SWAY] * nu[:, TURN]
        force[:, SWAY] -= vehicle.inertia[SURGE] * nu[:, SURGE] * nu[:, TURN]
    else:
        force[:, SWAY] = 0.0
    return force / vehicle.inertia
