"""The tilting hull agrees with equations written a second time, small oscillations, energy, and the level hull.

The second form has rotation matrices, and impulses in the pool frame.
"""

import itertools
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from shoal.config.experiment import Experiment, load_experiment
from shoal.errors import ConfigError
from shoal.frames import Array
from shoal.messages.messages import required
from sim_bridge.plant.currents_waves import WaterFlow
from sim_bridge.plant.fleet import Plant, PlantState
from tests.sim_bridge.plant.leg_forces import APART, LOPSIDED, leg_forces, run

pytestmark = pytest.mark.long

OPEN = (
    "pool.walls=false",
    "sim.plant.buoyancy_n=0",
    "sim.plant.thruster_spread=0",
    "sim.plant.battery.capacity_wh=0",
    "pool.size_m=[100,100,10]",
)
NO_DRAG = (
    "vehicle.drag.linear=[1e-12,1e-12,1e-12,1e-12]",
    "vehicle.drag.quadratic=[0,0,0,0]",
    "sim.plant.tilt.drag_linear=1e-12",
    "sim.plant.tilt.drag_quadratic=0",
)


def plant(*settings: str) -> Plant:
    return Plant(load_experiment("pool", (*OPEN, *settings)), 1)


def moving(state: PlantState, nu: list[list[float]], tilt: list[list[float]]) -> PlantState:
    return replace(state, nu=np.array(nu), tilt=np.array(tilt))


def skew(v: Array) -> Array:
    return np.cross(np.eye(3), v)


def attitude(roll: float, pitch: float, yaw: float) -> Array:
    """Body to pool, as a product of three turns about z, y, x."""

    def about(axis: int, angle: float) -> Array:
        turn = np.eye(3)
        i, j = [k for k in range(3) if k != axis]
        turn[i, i] = turn[j, j] = np.cos(angle)
        turn[i, j], turn[j, i] = (-1) ** (axis != 1) * np.sin(angle), (-1) ** (axis == 1) * np.sin(angle)
        return turn

    return about(2, yaw) @ about(1, pitch) @ about(0, roll)


def inertia_of(experiment: Experiment) -> Array:
    """A rigid body whose mass point hangs below the origin, plus the rest of the vehicle file's inertia on the diagonal."""
    tilt = experiment.sim.plant.tilt
    moment = np.array([0.0, 0.0, tilt.righting_nm / 9.81])
    surge, sway, heave, yaw = experiment.vehicle.inertia
    whole = np.diag([surge, sway, heave, tilt.inertia_kg_m2, tilt.inertia_kg_m2, yaw])
    whole[:3, 3:], whole[3:, :3] = -skew(moment), skew(moment)
    return whole


def legs(experiment: Experiment, pulses_us: Array, time_s: float) -> tuple[Array, Array]:
    """Force and moment vectors in the body, `time_s` after these pulses came on at rest."""
    forces = leg_forces(experiment.vehicle, pulses_us, time_s)
    below = np.full(4, experiment.sim.plant.tilt.legs_below_m)
    arms = np.column_stack([np.array(required(experiment.vehicle.legs).position_m), below])
    return forces.sum(axis=0), np.cross(arms, forces).sum(axis=0)


def second_equations(
    experiment: Experiment, pulses_us: Array, water: Callable[[float], Array]
) -> Callable[[float, Array], Array]:
    """State: place (3), attitude (9), linear and angular impulse of the motion relative to the water, in the pool frame.
    P' = F, L' = N - V x P."""
    plant, vehicle = experiment.sim.plant, experiment.vehicle
    inertia = np.linalg.inv(inertia_of(experiment))
    linear = np.array([*vehicle.drag_linear[:3], plant.tilt.drag_linear, plant.tilt.drag_linear, vehicle.drag_linear[3]])
    quadratic = np.array(
        [*vehicle.drag_quadratic[:3], plant.tilt.drag_quadratic, plant.tilt.drag_quadratic, vehicle.drag_quadratic[3]]
    )

    def rate(t: float, y: Array) -> Array:
        turn = y[3:12].reshape(3, 3)
        both = np.kron(np.eye(2), turn)
        nu = inertia @ both.T @ y[12:]
        speed = np.abs(nu)
        speed[:2] = np.hypot(nu[0], nu[1])
        thrust, moment = legs(experiment, pulses_us, t)
        force = np.concatenate([thrust, moment]) - (linear + quadratic * speed) * nu
        up = turn.T @ [0.0, 0.0, -1.0]
        force[3:] += np.cross(np.array([0.0, 0.0, plant.tilt.righting_nm]), -up)
        force[:3] -= plant.buoyancy_n * up
        pool = both @ force
        velocity = turn @ nu[:3]
        spin = turn @ skew(nu[3:])
        return np.concatenate([velocity + water(t), spin.ravel(), pool[:3], pool[3:] - np.cross(velocity, y[12:15])])

    return rate


@pytest.mark.parametrize(
    "extra",
    [
        (),
        (*LOPSIDED, "sim.plant.buoyancy_n=0.3", "sim.plant.tilt.legs_below_m=0.12"),
        (*LOPSIDED, "sim.plant.current_mps=[0.05,-0.08,0.01]", "sim.plant.gust_mps=0.03", "sim.plant.gust_s=3"),
    ],
)
def test_against_a_second_integrator(extra: tuple[str, ...]) -> None:
    experiment = load_experiment("pool", (*OPEN, *extra))
    simulated = plant(*extra)
    pulses = np.array([[1640, 1580, 1400, 1600, 1700, 1450, 1520, 1300], [1420, 1900, 1650, 1580, 1350, 1600, 1900, 1480.0]])
    flow = WaterFlow(experiment, 1)
    start = simulated.start(APART + np.array([0.0, 0.0, 0.0, 0.7]))
    tilt = np.array([[0.3, -0.2, 0.0, 0.0], [-0.5, 0.4, 0.0, 0.0]])
    end = run(simulated, replace(start, tilt=tilt), 800, pulses)[-1]
    for robot in range(2):

        def water(t: float) -> Array:
            return flow.motion(np.zeros((1, 3)), t)[0, :3]

        turn = attitude(tilt[robot, 0], tilt[robot, 1], 0.7)
        impulse = np.kron(np.eye(2), turn) @ inertia_of(experiment) @ np.concatenate([-turn.T @ water(0.0), np.zeros(3)])
        y = np.concatenate([start.eta[robot, :3], turn.ravel(), impulse])
        rate = second_equations(experiment, pulses[robot], water)
        exact = solve_ivp(rate, (0, 4), y, "DOP853", rtol=1e-10, atol=1e-12, max_step=0.05).y[:, -1]
        assert end.eta[robot, :3] == pytest.approx(exact[:3], abs=5e-6)
        reached = attitude(end.tilt[robot, 0], end.tilt[robot, 1], end.eta[robot, 3])
        assert reached == pytest.approx(exact[3:12].reshape(3, 3), abs=2e-5)
        c, s = np.cos(end.eta[robot, 3]), np.sin(end.eta[robot, 3])
        u, v, w, _ = end.nu[robot]
        assert [c * u - s * v, s * u + c * v, w] == pytest.approx(rate(4.0, exact)[:3], abs=2e-5)


def test_a_small_roll_swings_and_dies_as_a_linear_oscillator() -> None:
    """Roll and sway, coupled by the mass below the centre: eigenvalues of the linear equations."""
    settings = ("vehicle.drag.quadratic=[0,0,0,0]", "sim.plant.tilt.drag_quadratic=0")
    swinging = plant(*settings)
    tilt = load_experiment("pool", settings).sim.plant.tilt
    h = tilt.righting_nm / 9.81
    mass = np.linalg.inv([[12.0, -h], [-h, tilt.inertia_kg_m2]])
    system = np.zeros((3, 3))  # v, p, roll
    system[:2, :2] = mass @ np.diag([-3.0, -tilt.drag_linear])
    system[:2, 2] = mass @ [0.0, -tilt.righting_nm]
    system[2, 1] = 1.0
    fast = max(np.linalg.eigvals(system), key=lambda value: value.imag)
    states = run(swinging, moving(swinging.start(APART), [[0.0] * 4] * 2, [[0.01, 0, 0, 0], [0, 0, 0, 0]]), 3000)
    roll = np.array([state.tilt[0, 0] for state in states])
    crossings = np.flatnonzero((roll[:-1] > 0) & (roll[1:] <= 0))
    at = crossings + roll[crossings] / (roll[crossings] - roll[crossings + 1])
    assert 2 * np.pi / (np.diff(at).mean() * 0.005) == pytest.approx(fast.imag, rel=2e-3)
    peaks = np.array([roll[a:b].max() for a, b in itertools.pairwise(crossings)])
    decay = -np.log(peaks[6] / peaks[1]) / (5 * np.diff(at).mean() * 0.005)
    assert decay == pytest.approx(-fast.real, rel=0.01)
    assert 1.4 < 2 * np.pi / fast.imag < 1.8  # the swing that the key's description promises


def test_energy_of_free_motion_stays() -> None:
    free = plant(*NO_DRAG, *LOPSIDED)
    experiment = load_experiment("pool", (*OPEN, *LOPSIDED))
    inertia, righting = inertia_of(experiment), experiment.sim.plant.tilt.righting_nm

    def energy(state: PlantState) -> Array:
        energies = []
        for eta, nu, tilt in zip(state.eta, state.nu, state.tilt, strict=True):
            turn = attitude(tilt[0], tilt[1], 0.0)
            linear = turn.T @ nu[:3]
            # spin from the rates of the three angles, each about its own axis
            spin = (
                tilt[2] * np.eye(3)[0] + attitude(tilt[0], 0, 0).T @ (tilt[3] * np.eye(3)[1]) + turn.T @ (nu[3] * np.eye(3)[2])
            )
            both = np.concatenate([linear, spin])
            energies.append(0.5 * both @ inertia @ both + righting * (1.0 - np.cos(tilt[0]) * np.cos(tilt[1])))
            assert np.isfinite(eta).all()
        return np.array(energies)

    start = moving(free.start(APART), [[0.3, 0.2, 0.1, 0.7], [-0.2, 0.3, 0.0, -0.4]], [[0.6, -0.3, 1.0, 0.5], [0, 0.8, 0, 0]])
    before = energy(start)
    for state in run(free, start, 4000)[::400]:
        assert energy(state) == pytest.approx(before, rel=1e-5)


def test_at_rest_it_stays_level_and_still() -> None:
    still = plant()
    state = run(still, still.start(APART), 200)[-1]
    assert (state.eta == APART).all() and not state.nu.any() and not state.tilt.any()


def test_thrust_ahead_lifts_the_bow() -> None:
    """Against a wall that holds it, the pitch is where the righting moment balances the thrusters' lever."""
    held = plant("pool.walls=true", "pool.size_m=[3.5,2.5,2]", "vehicle.drag.linear=[3,3,4,0.08]")
    pulses = np.tile([1700.0] * 4 + [1500.0] * 4, (2, 1))
    state = run(held, held.start(np.array([[1.55, -0.5, 1.0, 0.0], [1.55, 0.5, 1.0, 0.0]])), 3000, pulses)[-1]
    assert state.tilt[0, 1] == pytest.approx(np.arcsin(4 * 1.22 * 0.05 / 1.9), rel=0.02)


def test_stiffly_righted_it_moves_as_the_level_hull() -> None:
    """The more it rights itself, the less tilts; the level hull is the limit."""
    pulses = np.tile([1640.0, 1580, 1400, 1600, 1500, 1500, 1500, 1500], (2, 1))
    ends = []
    for settings in (
        ("sim.plant.tilt.enabled=false",),
        ("sim.plant.tilt.legs_below_m=0", "sim.plant.tilt.inertia_kg_m2=2", "sim.plant.tilt.righting_nm=40"),
    ):
        fleet = plant(*settings, *LOPSIDED)
        ends.append(run(fleet, fleet.start(APART), 1000, pulses)[-1])
    assert ends[1].eta == pytest.approx(ends[0].eta, abs=0.01)
    assert np.abs(ends[1].tilt[:, :2]).max() < 0.02


def test_acceleration_is_the_derivative_of_the_velocity() -> None:
    fleet = plant("sim.plant.current_mps=[0.1,0,0]", "sim.plant.waves.height_m=0.1", "sim.plant.step_s=0.0005")
    start = moving(fleet.start(APART), [[0.3, 0.2, 0.1, 0.7], [-0.2, 0.3, 0.0, -0.4]], [[0.6, -0.3, 1.0, 0.5], [0, 0.4, 0, 0]])
    a, b, c = run(fleet, start, 2)
    assert fleet.acceleration(b) == pytest.approx((c.nu - a.nu) / 0.001, abs=1e-4)


def test_a_body_that_cannot_be_is_refused() -> None:
    with pytest.raises(ConfigError, match=r"sim.plant.tilt.righting_nm = 50: .*allowed: up to 11.8"):
        plant("sim.plant.tilt.righting_nm=50")
