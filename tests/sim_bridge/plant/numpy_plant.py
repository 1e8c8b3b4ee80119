"""The plant in NumPy, one row of arrays for each quantity and one column for each robot: an oracle for the compiled one.

It shares no equation with sim_bridge/plant/kernels.py. The body that stays level has equations of its own here.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from shoal.config.experiment import Experiment
from shoal.errors import ConfigError
from shoal.frames import Array
from sim_bridge.fault_schedule import ActuatorFaults
from sim_bridge.plant.actuators import ActuatorState
from sim_bridge.plant.fleet import PlantState
from sim_bridge.plant.random_streams import Stream, generator

AT_ONCE_S = 1e-9  # s after its start at which a step is first evaluated

THRUSTERS = 4


@dataclass(frozen=True, eq=False)
class ActuatorStep:
    """Targets of thrusters and ankles during one step, and their state at its start."""

    start: ActuatorState
    target_n: Array  # (n, 4)
    target_rad: Array  # (n, 4)


class NumpyActuators:
    """The actuators of every robot of an experiment."""

    def __init__(self, experiment: Experiment, seed: int) -> None:
        plant, vehicle = experiment.sim.plant, experiment.vehicle
        self._curve, self._legs = vehicle.thruster, vehicle.four_legs
        self._lag_s = vehicle.thruster.lag_s if plant.thruster_lag_s is None else plant.thruster_lag_s
        self._thruster_delay = round(vehicle.thruster.dead_time_s / plant.step_s)
        self._ankle_delay = round(vehicle.four_legs.ankle_dead_time_s / plant.step_s)
        self.dead_steps = min(self._thruster_delay, self._ankle_delay)  # steps before pulses that are sent now take effect
        ahead_m, side_m = np.array(vehicle.four_legs.position_m).T
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


# Open-circuit voltage of a lithium-polymer cell against its charge (typical discharge curve at a tenth of capacity per hour).
CHARGE = np.array([0.0, 0.05, 0.1, 0.2, 0.4, 0.6, 0.8, 1.0])
CELL_V = np.array([3.0, 3.45, 3.65, 3.73, 3.80, 3.90, 4.04, 4.20])
THRUST_EXPONENT = 1.2  # of thrust over voltage (OpenThruster's A2212 data at 10 to 12.6 V)
POWER_EXPONENT = 1.5  # of a propeller's power over thrust (momentum theory)
J_PER_WH = 3600.0


class NumpyBatteries:
    """The batteries of every robot of an experiment."""

    def __init__(self, experiment: Experiment) -> None:
        battery, vehicle = experiment.sim.plant.battery, experiment.vehicle
        self.ideal = battery.capacity_wh == 0
        self._capacity_j = battery.capacity_wh * J_PER_WH
        self._thruster_w, self._electronics_w = battery.thruster_w, battery.electronics_w
        self._curve_v, self._cells = battery.curve_v, vehicle.battery.cells
        self._start_v = experiment.sim.sensors.battery_v
        # offset of a start voltage that the experiment asks for beyond the ends of the curve
        self._beyond_v = self._start_v - float(np.interp(self._start_v / self._cells, CELL_V, CELL_V)) * self._cells
        self._sag_v = experiment.sim.sensors.battery_sag_v
        self._max_thrust_n = vehicle.thruster.max_thrust_n

    def start(self, robots: int) -> Array:
        """Charge, 0 to 1, of batteries that have the experiment's voltage at rest."""
        return np.full(robots, np.interp(self._start_v / self._cells, CELL_V, CHARGE))

    def rest_v(self, charge: Array) -> Array:
        """Voltage without load."""
        if self.ideal:
            return np.full(charge.shape, self._start_v)
        return np.asarray(np.interp(charge, CHARGE, CELL_V) * self._cells + self._beyond_v)

    def thrust_factor(self, charge: Array, force_n: Array, sag_v: Array) -> Array:
        """Thrust as a fraction of the curve's, with thrusters at these forces (n, 4) and `sag_v` lost besides."""
        if self.ideal:
            return np.maximum(1.0 - sag_v / self._curve_v, 0.0) ** THRUST_EXPONENT
        load = np.abs(force_n).mean(axis=1) / self._max_thrust_n
        voltage = self.rest_v(charge) - self._sag_v * load - sag_v
        return np.asarray(np.maximum(voltage / self._curve_v, 0.0) ** THRUST_EXPONENT)

    def drained(self, charge: Array, force_n: Array, seconds: float) -> Array:
        """Charge left after thrusters have worked at these forces (n, 4) for this long."""
        if self.ideal:
            return charge
        thrusters_w = self._thruster_w * ((np.abs(force_n) / self._max_thrust_n) ** POWER_EXPONENT).sum(axis=1)
        return np.asarray(np.maximum(charge - (thrusters_w + self._electronics_w) * seconds / self._capacity_j, 0.0))


Indices = NDArray[np.intp]

# Contact is a spring on which one robot's mass swings at this rate: 0.5 m/s penetrates 8 mm, which steps of 5 ms resolve.
CONTACT_RADPS = 30.0
# Hunt and Crossley (1975): damping that grows with the penetration, so that the force starts from zero and never pulls. At
# this value 0.6 of the speed is left after a bump at 0.1 m/s, 0.2 at 0.5 m/s.
CONTACT_DAMPING_S_PER_M = 10.0
NEAR_M = 0.1  # m, distance from which contact is computed; no robot moves farther in one step
MANY = 40  # robots; from this number a tree finds pairs faster than a table of all


class NumpyContacts:
    """Walls, floor, islands and other robots."""

    def __init__(self, experiment: Experiment) -> None:
        length, width, depth = experiment.pool.size_m
        self._radius_m = experiment.vehicle.radius_m
        has_walls = experiment.pool.walls
        reach = np.array([length / 2, width / 2, depth]) if has_walls else np.full(3, np.inf)
        self._inside_m = reach - self._radius_m  # limits of centres; in z a floor only, hydrodynamics.py has the surface
        self._clear_to_m = self._inside_m - NEAR_M
        self._clear_from_m = np.array([*-self._clear_to_m[:2], -np.inf])
        self._islands_m = np.array([[*island.position_m, island.radius_m] for island in experiment.islands]).reshape(-1, 3)
        self._stiffness_npm = float(experiment.vehicle.mass.surge_kg) * CONTACT_RADPS**2

    def is_near(self, position_m: Array) -> bool:
        """True if any hull at (n, 3) is about to touch something."""
        if ((position_m > self._clear_to_m) | (position_m < self._clear_from_m)).any():
            return True
        if len(self._islands_m) and (self._island_penetrations(position_m)[0] > -NEAR_M).any():
            return True
        within_m = 2.0 * self._radius_m + NEAR_M
        if len(position_m) >= MANY:
            return len(self._pairs(position_m, within_m)[0]) > 0
        near = np.count_nonzero(_squared_distances(position_m) < within_m**2)
        return bool(near > len(position_m))  # each is near itself

    def contact_force(self, position_m: Array, velocity_mps: Array) -> Array:
        """Contact forces (n, 3) on hulls at (n, 3) that move at (n, 3)."""
        penetration, outward = self._wall_penetrations(position_m)
        force = -outward * self._normal_force(penetration, outward * velocity_mps)
        if len(self._islands_m):
            penetration, away = self._island_penetrations(position_m)
            closing = -np.sum(velocity_mps[:, None, :2] * away, axis=2)
            force[:, :2] += np.sum(self._normal_force(penetration, closing)[..., None] * away, axis=1)
        first, second = self._pairs(position_m, 2.0 * self._radius_m)
        if len(first):
            apart = position_m[first] - position_m[second]
            distance = np.maximum(np.sqrt(np.sum(apart**2, axis=1)), 1e-9)[:, None]
            away = apart / distance
            closing = -np.sum((velocity_mps[first] - velocity_mps[second]) * away, axis=1)
            normal = self._normal_force(2.0 * self._radius_m - distance[:, 0], closing)[:, None] * away
            np.add.at(force, first, normal)
            np.add.at(force, second, -normal)
        return np.asarray(force)

    def _wall_penetrations(self, position_m: Array) -> tuple[Array, Array]:
        """Penetration of each hull into a wall per axis (n, 3), negative when clear, and the side of that wall (+-1)."""
        outward = np.where(position_m < 0.0, -1.0, 1.0)
        outward[:, 2] = 1.0
        return outward * position_m - self._inside_m, outward

    def _island_penetrations(self, position_m: Array) -> tuple[Array, Array]:
        """Penetration of hulls into islands (n, islands), negative when clear, and unit vectors (n, islands, 2) out of
        them."""
        apart = position_m[:, None, :2] - self._islands_m[:, :2]
        distance = np.sqrt(np.sum(apart**2, axis=2))
        return self._islands_m[:, 2] + self._radius_m - distance, apart / np.maximum(distance, 1e-9)[..., None]

    def _pairs(self, position_m: Array, within_m: float) -> tuple[Indices, Indices]:
        """Indices (pairs,) of the hulls whose centres are nearer than `within_m`, the lower first, in order."""
        if len(position_m) >= MANY:
            pairs = cKDTree(position_m).query_pairs(within_m, output_type="ndarray")
            pairs = pairs[np.lexsort((pairs[:, 1], pairs[:, 0]))]
            return pairs[:, 0], pairs[:, 1]
        first, second = np.nonzero(_squared_distances(position_m) < within_m**2)
        upper = first < second
        return first[upper], second[upper]

    def _normal_force(self, penetration_m: Array, penetration_rate_mps: Array) -> Array:
        damping = np.maximum(1.0 + CONTACT_DAMPING_S_PER_M * penetration_rate_mps, 0.0)
        return self._stiffness_npm * np.maximum(penetration_m, 0.0) * damping


def _squared_distances(position_m: Array) -> Array:
    """Squared distances (n, n) between all hulls at (n, 3)."""
    apart = position_m[:, None] - position_m
    return np.asarray(np.add.reduce(apart * apart, axis=2))


GRAVITY_MPS2 = 9.81
GUST_WAVES = 32  # cosines per axis; with 32 the correlation follows exp(-t / T) to 0.03


class NumpyFlow:
    """The water's own velocity, and its rate of change at a fixed place."""

    def __init__(self, experiment: Experiment, seed: int) -> None:
        plant = experiment.sim.plant
        self._current = np.array(plant.current_mps)[:, None]
        self._shear = np.array([*plant.current_shear_per_s, 0.0])[:, None]
        self._gust_radps, self._gust_phase = _gusts(plant.gust_s, generator(seed, Stream.GUSTS))
        self._gust = plant.gust_mps * np.sqrt(2.0 / GUST_WAVES)
        waves = plant.waves
        self._depth_m = experiment.pool.size_m[2]
        self._wave_radps = 2.0 * np.pi / waves.period_s
        self._wave_per_m = wave_number(self._wave_radps, self._depth_m)
        self._wave_mps = 0.5 * waves.height_m * self._wave_radps
        self._wave_way = np.array([np.cos(waves.direction_rad), np.sin(waves.direction_rad)])[:, None]
        self.steady = self._gust == 0.0 and self._wave_mps == 0.0
        self.still = self.steady and not self._current.any() and not self._shear.any()

    def velocity(self, place_m: Array, time_s: float) -> Array:
        """Velocity of the water at places (3, n), m/s."""
        flow: Array = self._current + self._shear * place_m[2]
        if self._gust:
            flow[:2] += self._gust * np.cos(self._gust_radps * time_s + self._gust_phase).sum(axis=1)[:, None]
        if self._wave_mps:
            flow += self._orbit(place_m, time_s, self._wave_mps)
        return flow

    def acceleration(self, place_m: Array, time_s: float) -> Array:
        """Acceleration of the water at fixed places (3, n), m/s^2. The part of a steady flow along a robot's way is of
        second order and left out, as in linear wave theory."""
        rate = np.zeros(place_m.shape)
        if self._gust:
            turning = self._gust_radps * np.sin(self._gust_radps * time_s + self._gust_phase)
            rate[:2] -= self._gust * turning.sum(axis=1)[:, None]
        if self._wave_mps:
            a_quarter_later = time_s + 0.5 * np.pi / self._wave_radps
            rate += self._orbit(place_m, a_quarter_later, self._wave_mps * self._wave_radps)
        return rate

    def _orbit(self, place_m: Array, time_s: float, amplitude: float) -> Array:
        """Wave velocity or acceleration: circles at the surface, flatter and smaller towards the floor; the crest moves
        with the wave."""
        k, down = self._wave_per_m, np.clip(place_m[2], 0.0, self._depth_m)
        falling = np.exp(-k * down)
        rising = np.exp(-k * (2.0 * self._depth_m - down))  # what the floor gives back
        scale = amplitude / -np.expm1(-2.0 * k * self._depth_m)
        phase = k * (self._wave_way * place_m[:2]).sum(axis=0) - self._wave_radps * time_s
        along = scale * (falling + rising) * np.cos(phase)
        return np.concatenate([self._wave_way * along, -scale * (falling - rising) * np.sin(phase)[None]])


def wave_number(radps: float, depth_m: float) -> float:
    """k in rad/m of the dispersion omega^2 = g k tanh(k depth), by Newton's method from deep water."""
    wanted = radps**2 * depth_m / GRAVITY_MPS2
    kh = max(wanted, np.sqrt(wanted))
    for _ in range(30):
        tanh = np.tanh(kh)
        kh -= (kh * tanh - wanted) / (tanh + kh * (1.0 - tanh**2))
    return float(kh / depth_m)


def _gusts(correlation_s: float, random: np.random.Generator) -> tuple[Array, Array]:
    """Frequencies and phases (2, GUST_WAVES): one of each stratum of equal energy, for x and for y."""
    share = (np.arange(GUST_WAVES) + random.uniform(0.0, 1.0, (2, GUST_WAVES))) / GUST_WAVES
    top = 1.0 - 0.5 / GUST_WAVES  # cuts off the endless tail of the spectrum, which would only shake
    return np.tan(0.5 * np.pi * np.minimum(share, top)) / correlation_s, random.uniform(0.0, 2.0 * np.pi, (2, GUST_WAVES))


DENSITY_KGPM3 = 998.0  # fresh water at 20 degrees


class Hydrodynamics:
    """Drag, buoyancy and the disturbance of an experiment."""

    def __init__(self, experiment: Experiment, tilts: bool) -> None:
        plant, vehicle = experiment.sim.plant, experiment.vehicle
        linear, quadratic = vehicle.drag_linear, vehicle.drag_quadratic
        if tilts:
            linear = np.insert(linear, 3, [plant.tilt.drag_linear] * 2)
            quadratic = np.insert(quadratic, 3, [plant.tilt.drag_quadratic] * 2)
        self._linear = linear[:, None] * (1.0 + plant.drag_error)
        self._quadratic = quadratic[:, None] * (1.0 + plant.drag_error)
        self._is_round = plant.sway
        self._buoyancy_n = plant.buoyancy_n
        self._radius_m = vehicle.radius_m
        self._has_surface = experiment.pool.walls
        self._amplitude = np.array(plant.disturbance_wrench)[:, None]
        self._radps = 2.0 * np.pi * np.broadcast_to(np.array(plant.disturbance_hz), len(experiment.robots))
        self.disturbs = bool(self._amplitude.any())

    def drag(self, relative: Array) -> Array:
        """Drag (axes, n) at a velocity relative to the water (axes, n).

        The nominal model takes each axis by itself: (d + q |v|) v. On a round hull the horizontal drag points against the
        flow, so its quadratic part takes the horizontal speed instead of |u| and |v|: the same when the robot moves along
        one axis, up to 1.4 times more when it moves diagonally. Without sway it is the article's model.
        """
        speed = np.abs(relative)
        if self._is_round:
            speed[:2] = np.hypot(relative[0], relative[1])
        force: Array = -(self._linear + self._quadratic * speed) * relative
        return force

    def lift(self, z_m: Array) -> Array | float:
        """Vertical force on hulls at depths (n,), down positive: residual buoyancy, and above water the missing
        displacement of the cap that stands out. One number if it is the same for all."""
        down: Array | float = self._buoyancy_n
        if self._has_surface and z_m.min() < self._radius_m:
            height = np.clip(self._radius_m - z_m, 0.0, 2.0 * self._radius_m)
            down = down + DENSITY_KGPM3 * GRAVITY_MPS2 * np.pi / 3.0 * height**2 * (3.0 * self._radius_m - height)
        return down

    def disturbance(self, time_s: float) -> Array:
        """[surge N, heave N, yaw N m] of the article's waves on each hull, (3, n) (ambiguity A13)."""
        return np.asarray(self._amplitude * np.sin(self._radps * time_s))


class FourDofBody:
    """Surge, sway, heave, yaw. State: x, y, z, yaw, u, v, w, r.

        m_u u' - m_v v r = X        m_w w' = Z
        m_v v' + m_u u r = Y        m_r r' - (m_u - m_v) u v = N

    With `sim.plant.sway = false` it is the article's plant: v = 0, and no axis couples with another.
    """

    def __init__(self, experiment: Experiment, flow: NumpyFlow, basin: NumpyContacts) -> None:
        plant = experiment.sim.plant
        self._sway, self._flow, self._basin = plant.sway, flow, basin
        self._water = Hydrodynamics(experiment, tilts=False)
        self._inertia = (experiment.vehicle.inertia * (1.0 + plant.mass_error))[:, None]

    def pack(self, eta: Array, nu: Array, tilt: Array) -> Array:
        """State rows of poses, velocities and tilts (n, 4)."""
        return np.concatenate([eta.T, nu.T])

    def unpack(self, x: Array) -> tuple[Array, Array, Array]:
        """Poses, velocities and tilts (n, 4) of state rows: the inverse of `pack`."""
        return x[:4].T.copy(), x[4:].T.copy(), np.zeros((x.shape[1], 4))

    def acceleration(self, x: Array, rate: Array) -> Array:
        """d nu / dt (n, 4), from a state and its rate."""
        return rate[4:].T.copy()

    def rate(self, x: Array, legs: Array, time_s: float, contact: bool) -> Array:
        """d/dt of the state, with the legs' forces (6, n) on surge, sway, heave, roll, pitch, yaw given."""
        nu = x[4:]
        c, s = np.cos(x[3]), np.sin(x[3])
        rate = np.empty_like(x)
        rate[0] = c * nu[0] - s * nu[1]
        rate[1] = s * nu[0] + c * nu[1]
        rate[2:4] = nu[2:]
        relative = nu if self._flow.still else nu - self._level(self._flow.velocity(x[:3], time_s), c, s)
        force = self._water.drag(relative)
        force[0] += legs[0]
        force[2:4] += legs[2::3]
        force[2] += self._water.lift(x[2])
        if self._water.disturbs:
            force[[0, 2, 3]] += self._water.disturbance(time_s)
        if contact:
            force += self._level(self._basin.contact_force(x[:3].T, rate[:3].T).T, c, s)
        acceleration = force / self._inertia
        if self._sway:
            m_u, m_v, _, m_r = self._inertia
            u, v, r = relative[0], relative[1], relative[3]
            acceleration[0] += m_v / m_u * v * r
            acceleration[1] -= m_u / m_v * u * r
            acceleration[3] += (m_u - m_v) / m_r * u * v
            if not self._flow.still:  # the water's velocity turns in the turning body's frame
                acceleration[0] += (nu[1] - v) * r
                acceleration[1] -= (nu[0] - u) * r
        if not self._flow.steady:
            acceleration += self._level(self._flow.acceleration(x[:3], time_s), c, s)
        if not self._sway:
            acceleration[1] = 0.0
        rate[4:] = acceleration
        return rate

    def _level(self, vectors: Array, c: Array, s: Array) -> Array:
        """Pool vectors (3, n) on the body's axes (4, n)."""
        x, y, z = vectors
        return np.array([c * x + s * y, c * y - s * x, z, np.zeros_like(z)])


class SixDofBody:
    """All six axes. State: x, y, z, roll, pitch, yaw (R = Rz Ry Rx), u, v, w, p, q, r.

    M nu_r' + C(nu_r) nu_r = force, with C from the impulses P, L of M nu_r (Kirchhoff): [omega x P; omega x L + v x P]. That
    is quadratic in nu_r, so one product of a fixed matrix with all pairs nu_j nu_k gives it for the whole fleet.

    The centre of mass lies below the centre of buoyancy: m z_g = righting moment / g couples surge with pitch and sway
    with roll in M, and rights the hull. Pitch must stay below 90 degrees, where yaw is undefined; the righting moment
    keeps it there.
    """

    def __init__(self, experiment: Experiment, flow: NumpyFlow, basin: NumpyContacts) -> None:
        plant, tilt = experiment.sim.plant, experiment.sim.plant.tilt
        self._flow, self._basin = flow, basin
        self._water = Hydrodynamics(experiment, tilts=True)
        self._righting = tilt.righting_nm * np.array([[-1.0], [1.0]])  # N m about roll and pitch, per R[2, 1] and R[2, 0]
        surge, sway, heave, yaw = experiment.vehicle.inertia
        inertia = np.diag([surge, sway, heave, tilt.inertia_kg_m2, tilt.inertia_kg_m2, yaw])
        first_moment = tilt.righting_nm / GRAVITY_MPS2
        inertia[0, 4] = inertia[4, 0] = first_moment
        inertia[1, 3] = inertia[3, 1] = -first_moment
        inertia *= 1.0 + plant.mass_error
        if np.linalg.eigvalsh(inertia)[0] <= 0:
            raise ConfigError(
                f"sim.plant.tilt.righting_nm = {tilt.righting_nm:g}: more than a body of this inertia can have "
                f"(allowed: up to {GRAVITY_MPS2 * np.sqrt(min(surge, sway) * tilt.inertia_kg_m2):.3g})"
            )
        self._inverse = np.linalg.inv(inertia)
        self._coupling = -self._inverse @ _coriolis(inertia)  # (6, 36)

    def pack(self, eta: Array, nu: Array, tilt: Array) -> Array:
        """State rows of poses and level velocities (n, 4), and tilts [roll, pitch, and their rates] (n, 4)."""
        roll, pitch, roll_rate, pitch_rate = tilt.T
        (cr, cp), (sr, sp) = np.cos(tilt.T[:2]), np.sin(tilt.T[:2])
        u, v, w, yaw_rate = nu.T
        ahead, down = cp * u - sp * w, sp * u + cp * w
        return np.array([
            *eta[:, :3].T, roll, pitch, eta[:, 3],
            ahead, cr * v + sr * down, cr * down - sr * v,
            roll_rate - sp * yaw_rate, cr * pitch_rate + sr * cp * yaw_rate, cr * cp * yaw_rate - sr * pitch_rate,
        ])  # fmt: skip

    def unpack(self, x: Array) -> tuple[Array, Array, Array]:
        """Poses, velocities on level axes that turn with the heading, and tilts, (n, 4) each: the inverse of `pack`."""
        (cr, cp), (sr, sp) = np.cos(x[3:5]), np.sin(x[3:5])
        u, v, w, p, q, r = x[6:]
        down, turn = sr * v + cr * w, sr * q + cr * r
        nu = np.array([cp * u + sp * down, cr * v - sr * w, cp * down - sp * u, turn / cp]).T.copy()
        tilt = np.array([x[3], x[4], p + turn * sp / cp, cr * q - sr * r]).T.copy()
        return x[[0, 1, 2, 5]].T.copy(), nu, tilt

    def acceleration(self, x: Array, rate: Array) -> Array:
        """d nu / dt (n, 4) of the level velocities, from a state and its rate, by differences: exact to 1e-9."""
        step_s, n = 1e-4, x.shape[1]
        _, nu, _ = self.unpack(np.concatenate([x + step_s * rate, x - step_s * rate], axis=1))
        return np.asarray((nu[:n] - nu[n:]) / (2.0 * step_s))

    def rate(self, x: Array, legs: Array, time_s: float, contact: bool) -> Array:
        """d/dt of the state, with the legs' forces (6, n) on surge, sway, heave, roll, pitch, yaw given."""
        (cr, cp, cy), (sr, sp, sy) = np.cos(x[3:6]), np.sin(x[3:6])
        turn = np.array([
            [cp * cy, sr * sp * cy - cr * sy, cr * sp * cy + sr * sy],
            [cp * sy, sr * sp * sy + cr * cy, cr * sp * sy - sr * cy],
            [-sp, sr * cp, cr * cp],
        ])  # body to pool, (3, 3, n)  # fmt: skip
        nu = x[6:]
        p, q, r = nu[3:]
        rate = np.empty_like(x)
        np.add.reduce(turn * nu[:3], axis=1, out=rate[:3])
        yaw_rate = (sr * q + cr * r) / cp
        rate[3] = p + sp * yaw_rate
        rate[4] = cr * q - sr * r
        rate[5] = yaw_rate
        relative = nu
        if not self._flow.still:
            stream = _turned(self._flow.velocity(x[:3], time_s), turn)
            relative = nu.copy()
            relative[:3] -= stream
        force = self._water.drag(relative)
        force[:3] += turn[2] * self._water.lift(x[2])
        push = legs.copy()
        push[3:5] += self._righting * turn[2, 1::-1]
        force += push
        if self._water.disturbs:
            force[[0, 2, 5]] += self._water.disturbance(time_s)
        if contact:
            force[:3] += _turned(self._basin.contact_force(x[:3].T, rate[:3].T).T, turn)
        np.add(self._inverse @ force, self._coupling @ (relative[:, None] * relative).reshape(36, -1), out=rate[6:])
        if not self._flow.still:  # the water's velocity turns in the turning body's frame
            a, b, c = stream
            rate[6:9] += np.array([b * r - c * q, c * p - a * r, a * q - b * p])
        if not self._flow.steady:
            rate[6:9] += _turned(self._flow.acceleration(x[:3], time_s), turn)
        return rate


def _turned(vectors: Array, turn: Array) -> Array:
    """Pool vectors (3, n) on the bodies' axes, `turn` (3, 3, n) being their attitudes."""
    return np.asarray(np.add.reduce(turn * vectors[:, None], axis=0))


def _coriolis(inertia: Array) -> Array:
    """Matrix (6, 36) that takes all products nu_j nu_k to C(nu) nu."""
    products = np.zeros((6, 6, 6))
    for j in range(6):
        velocity, spin = np.split(np.eye(6)[j], 2)
        for k in range(6):
            impulse, angular = np.split(inertia[:, k], 2)
            products[:, j, k] = [*np.cross(spin, impulse), *(np.cross(spin, angular) + np.cross(velocity, impulse))]
    return products.reshape(6, 36)


class NumpyPlant:
    """All robots of an experiment. Pure: a state goes in, the next one comes out."""

    def __init__(self, experiment: Experiment, seed: int) -> None:
        plant, vehicle = experiment.sim.plant, experiment.vehicle
        self._robots = experiment.robot_ids
        self._step_s = plant.step_s
        self._instants_s = np.array([AT_ONCE_S, plant.step_s / 2, plant.step_s])
        self._sway = plant.sway
        self._nominal = vehicle
        self._thrusters = NumpyActuators(experiment, seed)
        self._supply = NumpyBatteries(experiment)
        self._basin = NumpyContacts(experiment)
        tilts = plant.sway and plant.tilt.enabled
        self._hull = (SixDofBody if tilts else FourDofBody)(experiment, NumpyFlow(experiment, seed), self._basin)
        n = len(self._robots)
        self.no_faults = ActuatorFaults(np.ones((n, THRUSTERS)), np.zeros(n))

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

    def acceleration(self, state: PlantState) -> Array:
        """d nu / dt now, (n, 4)."""
        x = self._hull.pack(state.eta, state.nu, state.tilt)
        contact = self._basin.is_near(state.eta[:, :3])
        rate = self._hull.rate(x, self._thrusters.legs(state.motors), self.time_s(state), contact)
        return self._hull.acceleration(x, rate)
