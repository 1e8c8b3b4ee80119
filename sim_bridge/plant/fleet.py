"""The plant: a fleet of robots in water, one step at a time.

Deliberately richer than the controller's model, and written without it: the controller is judged by it.

    pulses -> actuators.py, battery.py -> forces -> rigid_body.py (bodies) + hydrodynamics.py, currents_waves.py, contact.py
    (forces of the surroundings)
"""

from dataclasses import dataclass, replace

import numpy as np

from sim_bridge.plant.actuators import THRUSTERS, ActuatorModel, ActuatorState
from sim_bridge.plant.battery import BatteryModel
from sim_bridge.plant.contact import ContactModel
from sim_bridge.plant.currents_waves import WaterFlow
from sim_bridge.plant.rigid_body import FourDofBody, SixDofBody
from wire.config.experiment import Experiment
from wire.frames import Array
from wire.messages.messages import Truth
from wire.toml_loader import ConfigError

WRENCH_AXES = [0, 2, 3]  # axes of nu on which the legs' [surge, heave, yaw] act
AT_ONCE_S = 1e-9  # s after its start at which a step is first evaluated: without lag the force jumps at the start itself


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


@dataclass(frozen=True, eq=False)
class ActuatorFaults:
    """Effects of the faults on thrusters and batteries."""

    thrust: Array  # (n, 4): each thruster's force as a fraction of the healthy one's
    sag_v: Array  # (n,): voltage that each battery has lost


class Plant:
    """All robots of an experiment. Pure: a state goes in, the next one comes out."""

    def __init__(self, experiment: Experiment, seed: int) -> None:
        plant, vehicle = experiment.sim.plant, experiment.vehicle
        self._robots = experiment.robot_ids
        self._step_s = plant.step_s
        self._instants_s = np.array([AT_ONCE_S, plant.step_s / 2, plant.step_s])
        self._sway = plant.sway
        self._nominal = vehicle
        self._thrusters = ActuatorModel(experiment, seed)
        self._supply = BatteryModel(experiment)
        self._basin = ContactModel(experiment)
        tilts = plant.sway and plant.tilt.enabled
        self._hull = (SixDofBody if tilts else FourDofBody)(experiment, WaterFlow(experiment, seed), self._basin)
        n = len(self._robots)
        self.no_faults = ActuatorFaults(np.ones((n, THRUSTERS)), np.zeros(n))

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
        return PlantState(0, eta.copy(), still, self._thrusters.start(), still, self._supply.start(n))

    @property
    def dead_steps(self) -> int:
        """Number of steps in which pulses that come now have no effect."""
        return self._thrusters.dead_steps

    def time_s(self, state: PlantState) -> float:
        """Simulated time since the start."""
        return state.steps * self._step_s

    def step(self, state: PlantState, pulses_us: Array, faults: ActuatorFaults | None = None) -> PlantState:
        """The fleet plant.step_s later, with pulses (n, 8) on the boards' outputs meanwhile. Classical Runge-Kutta (RK4)."""
        h, t = self._step_s, self.time_s(state)
        faults = faults or self.no_faults
        power = self._supply.thrust_factor(state.charge, state.motors.force_n, faults.sag_v)
        move = self._thrusters.command(state.motors, pulses_us, faults.thrust * power[:, None])
        motors = self._thrusters.at(move, self._instants_s)
        start, middle, last = self._thrusters.legs(motors)
        end = ActuatorState(motors.force_n[2], motors.ankle_rad[2], motors.pulses_us)
        contact = self._basin.is_near(state.eta[:, :3])
        x, rate = self._hull.pack(state.eta, state.nu, state.tilt), self._hull.rate
        k1 = rate(x, start, t, contact)
        k2 = rate(x + h / 2 * k1, middle, t + h / 2, contact)
        k3 = rate(x + h / 2 * k2, middle, t + h / 2, contact)
        k4 = rate(x + h * k3, last, t + h, contact)
        eta, nu, tilt = self._hull.unpack(x + h / 6 * (k1 + 2 * (k2 + k3) + k4))
        charge = self._supply.drained(state.charge, end.force_n, h)
        return PlantState(state.steps + 1, eta, nu, end, tilt, charge)

    def with_command_history(self, ahead: PlantState, before: PlantState, pulses_us: Array) -> PlantState:
        """The state `ahead`, one step after `before`, with other pulses (n, 8) on the outputs in that step.

        Within `dead_steps` pulses change only the command history: forces and motion of `ahead` remain.
        """
        return replace(ahead, motors=self._thrusters.with_command_history(ahead.motors, before.motors, pulses_us))

    def acceleration(self, state: PlantState) -> Array:
        """d nu / dt now, (n, 4)."""
        x = self._hull.pack(state.eta, state.nu, state.tilt)
        contact = self._basin.is_near(state.eta[:, :3])
        rate = self._hull.rate(x, self._thrusters.legs(state.motors), self.time_s(state), contact)
        return self._hull.acceleration(x, rate)

    def rest_v(self, state: PlantState, faults: ActuatorFaults | None = None) -> Array:
        """Voltage (n,) of the batteries without load."""
        return self._supply.rest_v(state.charge) - (faults or self.no_faults).sag_v

    def truth(self, state: PlantState) -> Truth:
        """The true state, wrench and lumped disturbance, for the log; no controller may read it."""
        wrench = self._thrusters.wrench(state.motors)
        disturbance = self.acceleration(state) - self._expected(state.nu, wrench)
        return Truth(self._robots, state.eta.copy(), state.nu.copy(), wrench, disturbance)

    def _expected(self, nu: Array, wrench: Array) -> Array:
        """nu' (n, 4) by the nominal model: the vehicle file's numbers, each axis's own drag, still water."""
        inertia = self._nominal.inertia
        force = -(self._nominal.drag_linear + self._nominal.drag_quadratic * np.abs(nu)) * nu
        force[:, WRENCH_AXES] += wrench
        if not self._sway:
            force[:, 1] = 0.0
            return np.asarray(force / inertia)
        force[:, 0] += inertia[1] * nu[:, 1] * nu[:, 3]
        force[:, 1] -= inertia[0] * nu[:, 0] * nu[:, 3]
        return np.asarray(force / inertia)
