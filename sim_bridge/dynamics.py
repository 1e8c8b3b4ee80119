"""The plant: robots in water, as rigid bodies with added mass in surge, sway, heave and yaw.

Deliberately richer than the controller's model, and written without it: it is the oracle that the controller is judged by.
Equations (Fossen 2021, chapters 6 and 10) with m_u, m_v, m_w, m_r the inertia including added mass, and [u, v, w, r] the
velocity relative to water that streams steadily:

    m_u u' - m_v v r = X        m_w w' = Z
    m_v v' + m_u u r = Y        m_r r' - (m_u - m_v) u v = N

The water's own velocity turns in the turning body's frame: nu' = relative' + [r v_c, -r u_c, 0, 0].
With `plant.sway = false` it is the article's plant: v = 0, and nothing couples the axes.
"""

from dataclasses import dataclass

import numpy as np

from sim_bridge.thrusters import Motors, Thrusters
from sim_bridge.water import Basin, Water
from wire.experiment import Experiment
from wire.frames import Array, pool_to_body
from wire.messages import Truth
from wire.toml_file import ConfigError

WRENCH_AXES = [0, 2, 3]  # of nu: where the legs' [surge, heave, yaw] act
AT_ONCE_S = 1e-9  # a step begins just after its command: without lag the force jumps there, and RK4 must not see the old one


@dataclass(frozen=True, eq=False)
class PlantState:
    """The whole fleet at one instant. Yaw is not wrapped."""

    steps: int  # of plant.step_s since the start
    eta: Array  # (n, 4) pool frame
    nu: Array  # (n, 4) body frame, over ground
    motors: Motors


class Plant:
    """All robots of an experiment. Pure: a state goes in, the next one comes out."""

    def __init__(self, experiment: Experiment, seed: int) -> None:
        plant, vehicle = experiment.sim.plant, experiment.vehicle
        self._robots = experiment.robot_ids
        self._step_s = plant.step_s
        self._sway = plant.sway
        self._nominal = vehicle
        self._inertia = vehicle.inertia * (1.0 + plant.mass_error)
        self._thrusters = Thrusters(experiment, seed)
        self._water = Water(experiment)
        self._basin = Basin(experiment)

    def start(self, eta: Array) -> PlantState:
        """Robots at rest at poses (n, 4). Raises ConfigError if one of them starts in a wall or in another."""
        if eta.shape != (len(self._robots), 4) or not np.isfinite(eta).all():
            raise ValueError(f"eta: shape {eta.shape}, must be ({len(self._robots)}, 4) and finite")
        for i in self._basin.touches(eta[:, :3]):
            x, y, z = eta[i, :3]
            raise ConfigError(f"robot {self._robots[i]}: starts at ({x:g}, {y:g}, {z:g}), in a wall or in another robot")
        return PlantState(0, eta.copy(), np.zeros_like(eta), self._thrusters.start())

    def time_s(self, state: PlantState) -> float:
        """Simulated time since the start."""
        return state.steps * self._step_s

    def step(self, state: PlantState, pulses_us: Array) -> PlantState:
        """The fleet plant.step_s later, with pulses (n, 8) on the boards' outputs meanwhile. Classical Runge-Kutta (RK4)."""
        h, t = self._step_s, self.time_s(state)
        move = self._thrusters.command(state.motors, pulses_us)
        end = self._thrusters.at(move, h)
        wrench_start = self._thrusters.wrench(self._thrusters.at(move, AT_ONCE_S))
        wrench_middle = self._thrusters.wrench(self._thrusters.at(move, h / 2))
        wrench_end = self._thrusters.wrench(end)
        contact = self._basin.is_near(state.eta[:, :3])
        x = np.concatenate([state.eta, state.nu], axis=1)
        k1 = self._rate(x, wrench_start, t, contact)
        k2 = self._rate(x + h / 2 * k1, wrench_middle, t + h / 2, contact)
        k3 = self._rate(x + h / 2 * k2, wrench_middle, t + h / 2, contact)
        k4 = self._rate(x + h * k3, wrench_end, t + h, contact)
        x = x + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
        return PlantState(state.steps + 1, x[:, :4].copy(), x[:, 4:].copy(), end)

    def acceleration(self, state: PlantState) -> Array:
        """d nu / dt now, shape (n, 4)."""
        return self._acceleration(state, self._thrusters.wrench(state.motors))

    def truth(self, state: PlantState) -> Truth:
        """What nobody who controls may read."""
        wrench = self._thrusters.wrench(state.motors)
        disturbance = self._acceleration(state, wrench) - self._expected(state.nu, wrench)
        return Truth(self._robots, state.eta.copy(), state.nu.copy(), wrench, disturbance)

    def _acceleration(self, state: PlantState, wrench: Array) -> Array:
        x = np.concatenate([state.eta, state.nu], axis=1)
        return self._rate(x, wrench, self.time_s(state), self._basin.is_near(state.eta[:, :3]))[:, 4:]

    def _rate(self, x: Array, wrench: Array, time_s: float, contact: bool) -> Array:
        """d/dt of [eta, nu] (n, 8), with the legs' wrench (n, 3) given."""
        eta, nu = x[:, :4], x[:, 4:]
        c, s = np.cos(eta[:, 3]), np.sin(eta[:, 3])
        rate = np.empty_like(x)
        rate[:, 0] = c * nu[:, 0] - s * nu[:, 1]
        rate[:, 1] = s * nu[:, 0] + c * nu[:, 1]
        rate[:, 2:4] = nu[:, 2:]
        current = self._water.current(c, s)
        relative = nu - current
        force = self._water.drag(relative)
        force[:, WRENCH_AXES] += wrench + self._water.disturbance(time_s)
        force[:, 2] += self._water.lift(eta[:, 2])
        if contact:
            push = self._basin.push(eta[:, :3], rate[:, :3])
            force[:, :2] += pool_to_body(push[:, :2], eta[:, 3])
            force[:, 2] += push[:, 2]
        rate[:, 4:] = self._accelerate(force, relative, current)
        return rate

    def _accelerate(self, force: Array, relative: Array, current: Array) -> Array:
        """nu' (n, 4) from the forces on the hull, by the equations at the top of this file."""
        acceleration = force / self._inertia
        if not self._sway:
            acceleration[:, 1] = 0.0
            return acceleration
        m_u, m_v, _, m_r = self._inertia
        u, v, r = relative[:, 0], relative[:, 1], relative[:, 3]
        acceleration[:, 0] += (m_v / m_u * v + current[:, 1]) * r
        acceleration[:, 1] -= (m_u / m_v * u + current[:, 0]) * r
        acceleration[:, 3] += (m_u - m_v) / m_r * u * v
        return acceleration

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
