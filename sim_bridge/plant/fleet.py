"""The plant: a fleet of robots in water, one step at a time.

Deliberately richer than the controller's model, and written without it: it is the oracle that the controller is judged by.

    pulses -> actuators.py, battery.py -> forces -> rigid_body.py (bodies) + hydrodynamics.py, currents_waves.py, contact.py
    (what surrounds them)
"""

from dataclasses import dataclass, replace

import numpy as np

from sim_bridge.plant.actuators import THRUSTERS, Motors, Thrusters
from sim_bridge.plant.battery import Supply
from sim_bridge.plant.contact import Basin
from sim_bridge.plant.currents_waves import Flow
from sim_bridge.plant.rigid_body import LevelHull, TiltingHull
from wire.config.experiment import Experiment
from wire.frames import Array
from wire.messages.messages import Truth
from wire.toml_loader import ConfigError

WRENCH_AXES = [0, 2, 3]  # of nu: where the legs' [surge, heave, yaw] act
AT_ONCE_S = 1e-9  # a step begins just after its command: without lag the force jumps there, and RK4 must not see the old one


@dataclass(frozen=True, eq=False)
class PlantState:
    """The whole fleet at one instant. Yaw is not wrapped. Velocities are over ground, on level axes that turn with the
    heading: eta' = J(yaw) nu holds however the robot tilts."""

    steps: int  # of plant.step_s since the start
    eta: Array  # (n, 4) pool frame
    nu: Array  # (n, 4)
    motors: Motors
    tilt: Array  # (n, 4): roll, pitch, and d/dt of them
    charge: Array  # (n,) of the batteries, 0 to 1


@dataclass(frozen=True, eq=False)
class Harm:
    """What is broken at the moment."""

    thrust: Array  # (n, 4): each thruster's force as a fraction of what it should be
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
        self._thrusters = Thrusters(experiment, seed)
        self._supply = Supply(experiment)
        self._basin = Basin(experiment)
        tilts = plant.sway and plant.tilt.enabled
        self._hull = (TiltingHull if tilts else LevelHull)(experiment, Flow(experiment, seed), self._basin)
        n = len(self._robots)
        self.unharmed = Harm(np.ones((n, THRUSTERS)), np.zeros(n))

    def start(self, eta: Array) -> PlantState:
        """Robots at rest at poses (n, 4). Raises ConfigError if one of them starts in something solid."""
        n = len(self._robots)
        if eta.shape != (n, 4) or not np.isfinite(eta).all():
            raise ValueError(f"eta: shape {eta.shape}, must be ({n}, 4) and finite")
        for i in self._basin.touches(eta[:, :3]):
            x, y, z = eta[i, :3]
            where = "in a wall, an island or another robot"
            raise ConfigError(f"robot {self._robots[i]}: starts at ({x:g}, {y:g}, {z:g}), {where}")
        still = np.zeros((n, 4))
        return PlantState(0, eta.copy(), still, self._thrusters.start(), still, self._supply.start(n))

    @property
    def dead_steps(self) -> int:
        """For how many steps pulses that come now change nothing."""
        return self._thrusters.dead_steps

    def time_s(self, state: PlantState) -> float:
        """Simulated time since the start."""
        return state.steps * self._step_s

    def step(self, state: PlantState, pulses_us: Array, harm: Harm | None = None) -> PlantState:
        """The fleet plant.step_s later, with pulses (n, 8) on the boards' outputs meanwhile. Classical Runge-Kutta (RK4)."""
        h, t = self._step_s, self.time_s(state)
        harm = harm or self.unharmed
        power = self._supply.thrust_factor(state.charge, state.motors.force_n, harm.sag_v)
        move = self._thrusters.command(state.motors, pulses_us, harm.thrust * power[:, None])
        motors = self._thrusters.at(move, self._instants_s)
        start, middle, last = self._thrusters.legs(motors)
        end = Motors(motors.force_n[2], motors.ankle_rad[2], motors.pulses_us)
        contact = self._basin.is_near(state.eta[:, :3])
        x, rate = self._hull.pack(state.eta, state.nu, state.tilt), self._hull.rate
        k1 = rate(x, start, t, contact)
        k2 = rate(x + h / 2 * k1, middle, t + h / 2, contact)
        k3 = rate(x + h / 2 * k2, middle, t + h / 2, contact)
        k4 = rate(x + h * k3, last, t + h, contact)
        eta, nu, tilt = self._hull.unpack(x + h / 6 * (k1 + 2 * (k2 + k3) + k4))
        charge = self._supply.drained(state.charge, end.force_n, h)
        return PlantState(state.steps + 1, eta, nu, end, tilt, charge)

    def retold(self, ahead: PlantState, before: PlantState, pulses_us: Array) -> PlantState:
        """`ahead`, a step after `before`, had these pulses (n, 8) been on the outputs: for `dead_steps` all that they change
        is what thrusters and ankles will do later."""
        return replace(ahead, motors=self._thrusters.retold(ahead.motors, before.motors, pulses_us))

    def acceleration(self, state: PlantState) -> Array:
        """d nu / dt now, shape (n, 4)."""
        x = self._hull.pack(state.eta, state.nu, state.tilt)
        contact = self._basin.is_near(state.eta[:, :3])
        rate = self._hull.rate(x, self._thrusters.legs(state.motors), self.time_s(state), contact)
        return self._hull.acceleration(x, rate)

    def rest_v(self, state: PlantState, harm: Harm | None = None) -> Array:
        """Voltage (n,) of the batteries without load."""
        return self._supply.rest_v(state.charge) - (harm or self.unharmed).sag_v

    def truth(self, state: PlantState) -> Truth:
        """What nobody who controls may read."""
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
