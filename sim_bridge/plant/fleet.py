"""The plant: a fleet of robots in water, one or more steps at a time.

Deliberately richer than the controller's model, and written without it: the controller is judged by it. kernels.advance moves
the fleet; the classes of this package hold its constants.
"""

from dataclasses import dataclass

import numpy as np

from shoal.config.experiment import Experiment
from shoal.config.vehicle import OUTPUTS
from shoal.errors import ConfigError
from shoal.frames import Array
from shoal.messages.messages import Truth
from sim_bridge.fault_schedule import ActuatorFaults
from sim_bridge.plant import kernels
from sim_bridge.plant.actuators import ActuatorModel, ActuatorState
from sim_bridge.plant.battery import BatteryModel
from sim_bridge.plant.contact import ContactModel
from sim_bridge.plant.currents_waves import WaterFlow
from sim_bridge.plant.rigid_body import RigidBody

THRUSTERS_PUSH = (0, 2, 5, 1)  # surge, heave, yaw and sway of the thrusters' six forces and moments


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
        self._robots = experiment.robot_ids
        self._step_s = plant.step_s
        self._sway = plant.sway
        self._nominal = experiment.vehicle
        self._thrusters = ActuatorModel(experiment, seed)
        self._supply = BatteryModel(experiment)
        self._basin = ContactModel(experiment)
        self._flow = WaterFlow(experiment, seed).constants
        body = RigidBody(experiment)
        self._body = body.constants
        n = len(self._robots)
        self.no_faults = ActuatorFaults(np.ones((n, OUTPUTS)), np.zeros(n))
        self._axes = list(THRUSTERS_PUSH[: len(experiment.vehicle.limits.wrench)])
        memory = kernels.memory(n)
        kernels.to_fleet(body.wave_radps, memory, kernels.WAVE)
        # the robots' order along x, the memory, what contact takes and gives in rows, the water's motion, places in order, and
        # places at which nothing was near
        calm_m = np.full((len(memory), 3 * kernels.LANES), np.nan)
        self._work = np.arange(n), memory, np.empty((4, n, 3)), np.empty((n, 6)), np.empty((3, n)), calm_m

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
        history = self._thrusters.command_history(state.motors, pulses_us, steps)
        eta, nu, tilt, charge = state.eta.copy(), state.nu.copy(), state.tilt.copy(), state.charge.copy()
        motors = ActuatorState(state.motors.force_n.copy(), state.motors.ankle_rad.copy(), history)
        kernels.advance(
            eta, nu, tilt, motors.force_n, motors.ankle_rad, charge[:, None],
            state.motors.pulses_us, pulses_us, self._thrusters.gain * faults.thrust[:, : self._thrusters.count],
            faults.sag_v[:, None],
            state.steps, steps, self._step_s,
            self._thrusters.constants, self._supply.constants, self._flow, self._basin.constants, self._body, self._work,
        )  # fmt: skip
        return PlantState(state.steps + steps, eta, nu, motors, tilt, charge)

    def acceleration(self, state: PlantState) -> Array:
        """d nu / dt now, (n, 4). WRENCH in the fleet's memory is that of now, too."""
        acceleration = np.empty_like(state.nu)
        kernels.fleet_acceleration(
            state.eta, state.nu, state.tilt, self.time_s(state), state.motors.force_n, state.motors.ankle_rad,
            self._thrusters.constants, self._flow, self._basin.constants, self._body, self._work, acceleration,
        )  # fmt: skip
        return acceleration

    def stream(self, current_mps: Array) -> None:
        """Let the water stream at another current (3,) at the surface from now on."""
        self._flow = (False, np.array(current_mps, dtype=np.float64), *self._flow[2:])

    def water_mps(self, state: PlantState) -> Array:
        """The water's own velocity (n, 3) where the robots are, pool frame."""
        motion = np.empty((len(state.eta), 6))
        kernels.water_motion(np.ascontiguousarray(state.eta[:, :3]), self.time_s(state), self._flow, motion)
        return motion[:, :3].copy()

    def rest_v(self, state: PlantState, faults: ActuatorFaults | None = None) -> Array:
        """Voltage (n,) of the batteries without load."""
        return self._supply.rest_v(state.charge) - (faults or self.no_faults).sag_v

    def truth(self, state: PlantState) -> Truth:
        """The true state, wrench and lumped disturbance, for the log; no controller may read it."""
        n = len(self._robots)
        acceleration, six, expected = self.acceleration(state), np.empty((n, 6)), np.empty((n, 4))
        kernels.from_fleet(self._work[1], kernels.WRENCH, six)
        wrench = np.ascontiguousarray(six[:, self._axes])
        nominal = self._nominal
        kernels.nominal_acceleration(
            state.nu, wrench, nominal.inertia, nominal.drag_linear, nominal.drag_quadratic, self._sway, expected
        )
        return Truth(self._robots, state.eta.copy(), state.nu.copy(), wrench, acceleration - expected)
