"""The plant agrees with equations written a second time, closed forms, conservation laws and symmetries.

The second form has vectors in the pool frame and another integrator.
"""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from shoal.config.experiment import Experiment, load_experiment
from shoal.errors import ConfigError
from shoal.frames import Array
from shoal.messages.messages import required
from sim_bridge.plant.fleet import Plant, PlantState
from tests.sim_bridge.plant.leg_forces import APART, LOPSIDED, NEUTRAL, leg_forces, run

pytestmark = pytest.mark.long

IDEAL = ("sim.plant.thruster_spread=0", "sim.plant.battery.capacity_wh=0")
LEVEL = ("sim.plant.tilt.enabled=false",)
OPEN = ("pool.walls=false", "sim.plant.buoyancy_n=0", *IDEAL, *LEVEL)
NO_DRAG = ("vehicle.drag.linear=[1e-12,1e-12,1e-12,1e-12]", "vehicle.drag.quadratic=[0,0,0,0]")


def plant(*settings: str, seed: int = 1) -> Plant:
    return Plant(load_experiment("pool", settings), seed)


def moving(state: PlantState, nu: list[list[float]]) -> PlantState:
    return replace(state, nu=np.array(nu))


# --- a second set of equations


def rotation(yaw: float) -> Array:
    c, s = np.cos(yaw), np.sin(yaw)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def legs_wrench(experiment: Experiment, pulses_us: Array, time_s: float) -> tuple[Array, float]:
    """Force vector (body) and yaw moment, `time_s` after these pulses came on at rest."""
    forces = leg_forces(experiment.vehicle, pulses_us, time_s)
    arms = np.column_stack([np.array(required(experiment.vehicle.legs).position_m), np.zeros(4)])
    return forces.sum(axis=0), float(np.cross(arms, forces).sum(axis=0)[2])


def second_equations(experiment: Experiment, robot: int, pulses_us: Array) -> Callable[[float, Array], Array]:
    """Impulse form (Kirchhoff): in the pool frame, P' = F and L' = N + P x V, with P = R M V the impulse of the motion
    relative to the water. State: position (3), yaw, impulse P (3, pool frame), yaw momentum."""
    settings, vehicle = experiment.sim.plant, experiment.vehicle
    inertia = vehicle.inertia * (1 + settings.mass_error)
    linear, quadratic = (d * (1 + settings.drag_error) for d in (vehicle.drag_linear, vehicle.drag_quadratic))
    current = np.array(settings.current_mps)
    hz = settings.disturbance_hz[robot] if isinstance(settings.disturbance_hz, tuple) else settings.disturbance_hz
    surge_n, heave_n, yaw_nm = settings.disturbance_wrench

    def rate(t: float, y: Array) -> Array:
        turn = rotation(y[3])
        flow = np.linalg.solve(turn @ np.diag(inertia[:3]), y[4:7])  # relative velocity, body frame
        spin = y[7] / inertia[3]
        speed = np.array([np.hypot(flow[0], flow[1])] * 2 + [abs(flow[2])])
        thrust, moment = legs_wrench(experiment, pulses_us, t)
        wave = np.sin(2 * np.pi * hz * t)
        force = thrust + wave * np.array([surge_n, 0, heave_n]) + [0, 0, settings.buoyancy_n]
        force -= linear[:3] * flow + quadratic[:3] * speed * flow
        moment += wave * yaw_nm - (linear[3] + quadratic[3] * abs(spin)) * spin
        impulse_body = turn.T @ y[4:7]
        moment += np.cross(impulse_body, flow)[2]
        return np.concatenate([turn @ flow + current, [spin], turn @ force, [moment]])

    return rate


@pytest.mark.parametrize(
    "extra",
    [
        (),
        LOPSIDED,
        ("sim.plant.mass_error=0.2", "sim.plant.drag_error=-0.3"),
        (*LOPSIDED, "sim.plant.current_mps=[0.05,-0.08,0.01]", "sim.plant.buoyancy_n=0.3"),
        ("sim.plant.disturbance_wrench=[3,1.5,0.25]", "sim.plant.disturbance_hz=[0.2,0.7]"),
    ],
)
def test_against_a_second_integrator(extra: tuple[str, ...]) -> None:
    settings = (*OPEN, *extra)
    experiment, simulated = load_experiment("pool", settings), plant(*settings)
    pulses = np.array([[1640, 1580, 1400, 1600, 1700, 1450, 1520, 1300], [1420, 1900, 1650, 1580, 1350, 1600, 1900, 1480.0]])
    eta = np.array([[-40.0, 1.0, 5.0, 0.4], [40.0, -2.0, 6.0, -2.0]])
    end = run(simulated, simulated.start(eta), 800, pulses)[-1]
    for robot in range(2):
        water = np.linalg.multi_dot([rotation(eta[robot, 3]).T, -np.array(experiment.sim.plant.current_mps)])
        inertia = experiment.vehicle.inertia * (1 + experiment.sim.plant.mass_error)
        impulse = rotation(eta[robot, 3]) @ (inertia[:3] * water)
        start = np.concatenate([eta[robot], impulse, [0.0]])
        rate = second_equations(experiment, robot, pulses[robot])
        exact = solve_ivp(rate, (0, 4), start, "DOP853", rtol=1e-10, atol=1e-12, max_step=0.05).y[:, -1]
        over_ground = rotation(exact[3]).T @ (rate(4.0, exact)[:3])
        assert end.eta[robot] == pytest.approx(exact[:4], abs=2e-6)
        assert end.nu[robot] == pytest.approx([*over_ground, rate(4.0, exact)[3]], abs=2e-6)


def test_the_error_falls_with_the_fourth_power_of_the_step() -> None:
    """Free motion with a sinusoidal force and linear drag, so that nothing has corners."""
    ends = []
    for step_s in (0.02, 0.01, 0.005, 0.00125):
        fleet = plant(
            *OPEN,
            *LOPSIDED,
            "vehicle.drag.quadratic=[0,0,0,0]",
            f"sim.plant.step_s={step_s}",
            "sim.plant.disturbance_wrench=[3,1.5,0.5]",
            "sim.plant.disturbance_hz=0.8",
        )
        state = moving(fleet.start(APART), [[0.5, -0.4, 0.2, 2.0], [0.2, 0.1, -0.1, -1.0]])
        end = run(fleet, state, round(2.5 / step_s))[-1]
        ends.append(np.concatenate([end.eta, end.nu], axis=1))
    errors = [float(np.abs(end - ends[-1]).max()) for end in ends[:-1]]
    assert errors[-1] < 1e-7
    assert 12 < errors[0] / errors[1] < 20
    assert 12 < errors[1] / errors[2] < 20


# --- closed forms


def test_terminal_speeds_balance_drag_and_thrust() -> None:
    """linear v + quadratic v^2 = thrust, solved by hand; both robots, ahead and astern."""
    fleet = plant(*OPEN)
    pulses = np.array([[1600.0] * 4 + [1500] * 4, [1400.0] * 4 + [1500] * 4])
    nu = run(fleet, fleet.start(APART), 5000, pulses)[-1].nu
    ahead = (-3.0 + np.sqrt(9.0 + 4 * 20.0 * 4 * 0.478)) / 40.0
    astern = -(-3.0 + np.sqrt(9.0 + 4 * 20.0 * 4 * 0.387)) / 40.0
    assert nu == pytest.approx(np.array([[ahead, 0, 0, 0], [astern, 0, 0, 0]]), abs=1e-9)


def test_full_thrust_gives_the_articles_speed() -> None:
    """6 N of surge: 0.48 m/s ("less than 0.5 m/s")."""
    fleet = plant(*OPEN)
    pulses = np.tile([1900.0, 1500, 1900, 1500, 1500, 1500, 1500, 1500], (2, 1))
    pulses[:, 1::2][:, :2] = 1500.0  # one side ahead: 6 N with 0.5 N m, so look at the thrust, not at the circle
    state = run(fleet, fleet.start(APART), 400, pulses)[-1]
    assert fleet.truth(state).wrench[0] == pytest.approx([6.0, 0.0, 6 * 0.0833], abs=1e-3)
    assert (-3.0 + np.sqrt(9.0 + 80.0 * 6.0)) / 40.0 == pytest.approx(0.48, abs=0.005)


def test_drift_in_a_current() -> None:
    fleet = plant(*OPEN, "sim.plant.current_mps=[0.1,-0.05,0.02]")
    states = run(fleet, moving(fleet.start(APART + np.array([0, 0, 0, 0.7])), [[0.03, -0.1, 0.0, 0.0]] * 2), 3000)
    speed = (states[-1].eta - states[-21].eta) / (20 * 0.005)
    assert speed == pytest.approx(np.tile([0.1, -0.05, 0.02, 0], (2, 1)), abs=2e-3)


def test_round_drag_points_against_the_flow() -> None:
    fleet = plant(*OPEN)
    velocity = np.array([0.3, 0.4])
    deceleration = fleet.acceleration(moving(fleet.start(APART), [[*velocity, 0, 0], [0.5, 0, 0, 0]]))
    assert deceleration[0, :2] == pytest.approx(-velocity / 0.5 * np.linalg.norm(deceleration[1, :2]))


# --- conservation and symmetry


def test_a_turning_robot_slides_straight_on() -> None:
    """Without drag and with equal masses, the velocity in the pool frame stays: the body slides outward as it turns."""
    fleet = plant(*OPEN, *NO_DRAG)
    states = run(fleet, moving(fleet.start(APART), [[0.3, 0.0, 0.0, 0.8], [0.2, -0.1, 0.05, -1.5]]), 1000)
    moved = states[-1].eta - states[0].eta
    expected = 5.0 * np.array([[0.3, 0.0, 0.0, 0.8], [0.2, -0.1, 0.05, -1.5]])
    assert moved == pytest.approx(expected, abs=1e-8)
    assert states[-1].nu[0, 1] == pytest.approx(-0.3 * np.sin(4.0), abs=1e-8)


def test_a_tethered_turn_slides_outward() -> None:
    """In the pool scene, at u = 0.014 m/s and r = 0.063 rad/s, about 3.5 mm/s against linear drag."""
    fleet = plant(*OPEN)
    state = moving(fleet.start(APART), [[0.014, -0.003, 0.0, 0.063], [0.0] * 4])
    for _ in range(2000):
        held = state.nu.copy()
        held[0, [0, 3]] = 0.014, 0.063
        state = fleet.step(moving(state, held.tolist()), NEUTRAL)
    v = state.nu[0, 1]
    resisting = (3.0 + 20.0 * np.hypot(0.014, v)) * -v
    assert resisting == pytest.approx(12.0 * 0.014 * 0.063, rel=0.01)
    assert v == pytest.approx(-0.0032, abs=0.0004)


def test_impulse_and_energy_of_a_lopsided_body() -> None:
    """Kirchhoff's integrals of free motion in ideal water, which fix the signs of every coupling term."""
    fleet = plant(*OPEN, *NO_DRAG, *LOPSIDED)
    inertia = load_experiment("pool", LOPSIDED).vehicle.inertia
    start = moving(fleet.start(APART), [[0.3, 0.2, 0.1, 0.7], [-0.2, 0.3, 0.0, -0.4]])

    def integrals(state: PlantState) -> Array:
        rows = []
        for eta, nu in zip(state.eta, state.nu, strict=True):
            impulse = rotation(eta[3]) @ (inertia[:3] * nu[:3])
            angular = inertia[3] * nu[3] + np.cross(eta[:3], impulse)[2]
            rows.append([*impulse, angular, 0.5 * inertia @ nu**2])
        return np.array(rows)

    before = integrals(start)
    for state in run(fleet, start, 4000)[::400]:
        assert integrals(state) == pytest.approx(before, abs=1e-6)


def test_a_current_only_carries() -> None:
    """Galileo: uniform current c is still water, seen from a frame that moves at -c."""
    c, pulses = np.array([0.07, -0.03, 0.02]), np.tile([1600.0, 1500, 1650, 1380, 1600, 1500, 1400, 1500], (2, 1))
    still = plant(*OPEN, *LOPSIDED)
    flowing = plant(*OPEN, *LOPSIDED, "sim.plant.current_mps=[0.07,-0.03,0.02]")
    for_flow = flowing.start(APART)
    carried = np.zeros((2, 4))
    carried[:, :3] = c
    a = run(still, still.start(APART), 1500, pulses)[-1]
    b = run(flowing, moving(for_flow, carried.tolist()), 1500, pulses)[-1]
    assert b.eta[:, :3] - a.eta[:, :3] == pytest.approx(np.tile(7.5 * c, (2, 1)), abs=1e-8)
    assert b.eta[:, 3] == pytest.approx(a.eta[:, 3], abs=1e-8)


def test_all_headings_are_alike() -> None:
    fleet = plant(*OPEN, *LOPSIDED)
    pulses = np.tile([1600.0, 1500, 1650, 1380, 1600, 1500, 1400, 1500], (2, 1))
    turned = APART.copy()
    turned[1] = [*(rotation(2.1) @ APART[0, :3]), 2.1]
    turned[0] = APART[0]
    end = run(fleet, fleet.start(turned), 1500, pulses)[-1]
    assert rotation(2.1) @ end.eta[0, :3] == pytest.approx(end.eta[1, :3], abs=1e-9)
    assert end.nu[0] == pytest.approx(end.nu[1], abs=1e-9)


@pytest.mark.parametrize("seed", range(5))
def test_energy_never_grows_without_thrust(seed: int) -> None:
    """Thrown at each other and at the walls: kinetic energy between contacts only falls."""
    fleet = plant("sim.plant.buoyancy_n=0", *(LOPSIDED if seed % 2 else ()))
    inertia = load_experiment("pool", LOPSIDED if seed % 2 else ()).vehicle.inertia
    random = np.random.default_rng(seed)
    eta = np.array([[-0.4, 0.1, 0.5, 0.0], [0.4, 0.0, 0.5, 2.0]])
    state = moving(fleet.start(eta), random.uniform(-0.8, 0.8, (2, 4)).tolist())
    top = float(np.sum(0.5 * inertia * state.nu**2))
    for later in run(fleet, state, 1500):
        energy = float(np.sum(0.5 * inertia * later.nu**2))
        assert energy <= top * (1 + 1e-9)
    assert energy < 0.2 * top


# --- walls, floor, surface, each other


def test_walls_and_floor_hold() -> None:
    """Full ahead into each wall and the floor: the hull stops there, dented by a millimetre."""
    for pose, pulses, axis, limit in (
        ([1.5, 0.0, 0.5, 0.0], [1900.0] * 4 + [1500] * 4, 0, 1.75 - 0.15),
        ([-1.5, 0.0, 0.5, np.pi], [1900.0] * 4 + [1500] * 4, 0, -(1.75 - 0.15)),
        ([0.0, 1.0, 0.5, np.pi / 2], [1900.0] * 4 + [1500] * 4, 1, 1.25 - 0.15),
        ([0.0, -1.0, 0.5, -np.pi / 2], [1900.0] * 4 + [1500] * 4, 1, -(1.25 - 0.15)),
        ([0.0, 0.0, 0.8, 0.0], [1900.0] * 4 + [2000] * 4, 2, 1.0 - 0.15),
    ):
        fleet = plant("sim.plant.buoyancy_n=0", "sim.plant.thruster_spread=0")
        other = [0.9 * np.sign(-pose[0] - 0.1), -0.6 * np.sign(pose[1] + 0.1), 0.5, 0.0]
        commands = np.array([pulses, NEUTRAL[0]])
        states = run(fleet, fleet.start(np.array([pose, other])), 1500, commands)
        beyond = max(np.sign(limit) * (state.eta[0, axis] - limit) for state in states)
        assert beyond < 0.03  # while bumping
        assert abs(states[-1].eta[0, axis] - limit) < 0.0015
        assert abs(states[-1].nu[0, 2 if axis == 2 else 0]) < 1e-3


def test_a_free_robot_feels_no_walls() -> None:
    near, far = plant("sim.plant.buoyancy_n=0"), plant("sim.plant.buoyancy_n=0", "pool.size_m=[50,50,50]")
    eta = np.array([[1.4, 0.9, 0.6, 1.0], [-1.0, -0.9, 0.7, 2.0]])
    assert (near.acceleration(near.start(eta)) == far.acceleration(far.start(eta))).all()


def test_robots_bump_and_keep_their_momentum() -> None:
    fleet = plant(*OPEN, *NO_DRAG)
    start = fleet.start(np.array([[-0.3, 0.02, 5.0, 0.3], [0.3, -0.02, 5.0, -1.0]]))
    pool_velocity = np.array([[0.2, 0.0, 0.0], [-0.1, 0.03, 0.0]])
    nu = [[*(rotation(eta[3]).T @ v), 0.1] for eta, v in zip(start.eta, pool_velocity, strict=True)]
    states = run(fleet, moving(start, nu), 1200)

    def velocity(state: PlantState) -> Array:
        return np.array([rotation(eta[3]) @ nu[:3] for eta, nu in zip(state.eta, state.nu, strict=True)])

    assert velocity(states[-1]).sum(axis=0) == pytest.approx(pool_velocity.sum(axis=0), abs=1e-7)
    gaps = [float(np.linalg.norm(state.eta[0, :3] - state.eta[1, :3])) for state in states]
    assert 0.28 < min(gaps) < 0.30  # they did touch, and did not pass through
    assert (velocity(states[-1])[0] - velocity(states[-1])[1])[0] < 0  # and part
    assert states[-1].nu[:, 3] == pytest.approx([0.1, 0.1], abs=1e-9)  # without friction, no spin


def test_floats_where_archimedes_says() -> None:
    """-0.2 N: the cap that stands out displaces 0.2 N less. Volume by numerical integration of discs."""
    fleet = plant("sim.plant.buoyancy_n=-0.2")
    state = run(fleet, fleet.start(np.array([[0.5, 0, 0.1434, 0], [-0.5, 0, 0.1434, 0]])), 2000)[-1]
    z = state.eta[0, 2]
    above = np.linspace(-0.15, -z, 100_001)
    volume = np.trapezoid(np.pi * (0.15**2 - above**2), above)
    assert volume * 998.0 * 9.81 == pytest.approx(0.2, rel=5e-3)
    assert abs(state.nu[0, 2]) < 1e-4


def test_starting_in_a_wall_or_in_another_robot_is_refused() -> None:
    fleet = plant()
    with pytest.raises(ConfigError, match="robot 2"):
        fleet.start(np.array([[0, 0, 0.3, 0], [1.7, 0, 0.3, 0]]))
    with pytest.raises(ConfigError, match="robot 1"):
        fleet.start(np.array([[0, 0, 0.3, 0], [0.2, 0, 0.3, 0]]))
    with pytest.raises(ValueError, match="eta"):
        fleet.start(np.zeros((3, 4)))


# --- the article's plant, truth, repeatability


def test_without_sway_the_robot_runs_on_rails() -> None:
    fleet = plant(*OPEN, *LOPSIDED, "sim.plant.sway=false", "sim.plant.current_mps=[0.1,0.1,0]")
    pulses = np.tile([1700.0, 1500, 1700, 1500, 1500, 1500, 1500, 1500], (2, 1))
    states = run(fleet, fleet.start(APART), 800, pulses)
    assert all((state.nu[:, 1] == 0.0).all() for state in states)
    assert states[-1].nu[0, 3] > 0.5


def test_without_sway_the_nominal_model_explains_everything() -> None:
    fleet = plant(*OPEN, "sim.plant.sway=false")
    pulses = np.tile([1700.0, 1500, 1700, 1500, 1700, 1500, 1400, 1500], (2, 1))
    for state in run(fleet, fleet.start(APART), 400, pulses)[::50]:
        assert fleet.truth(state).disturbance == pytest.approx(0.0, abs=1e-12)


def test_with_sway_the_nominal_model_explains_straight_and_slow_curves() -> None:
    fleet = plant(*OPEN)
    straight = moving(fleet.start(APART), [[0.3, 0.0, 0.1, 0.0], [0.0, -0.3, 0.0, 0.5]])
    assert fleet.truth(straight).disturbance == pytest.approx(0.0, abs=1e-12)
    crab = fleet.truth(moving(straight, [[0.3, 0.3, 0.0, 0.4]] * 2)).disturbance[0]
    extra = -20.0 * (np.sqrt(2) - 1) * 0.09 / 12.0  # the round hull's quadratic drag when it crabs
    assert crab == pytest.approx([extra, extra, 0, 0], abs=1e-12)


def test_disturbance_is_what_pushes() -> None:
    """A known force that the nominal model does not have: it is the truth's disturbance, at its own phase."""
    fleet = plant(*OPEN, "sim.plant.disturbance_wrench=[3,1.5,0.25]", "sim.plant.disturbance_hz=[0.005,0.02]")
    state = run(fleet, fleet.start(APART), 2000)[-1]
    disturbance = fleet.truth(moving(state, [[0.0] * 4] * 2)).disturbance
    expected = [np.sin(2 * np.pi * hz * 10.0) * np.array([3 / 12, 0, 1.5 / 16, 0.25 / 0.12]) for hz in (0.005, 0.02)]
    assert disturbance == pytest.approx(np.array(expected), abs=1e-12)


def test_acceleration_is_the_derivative_of_velocity() -> None:
    fleet = plant(*LOPSIDED, "sim.plant.current_mps=[0.05,0.02,0]")
    pulses = np.tile([1700.0, 1500, 1650, 1400, 1700, 1500, 1400, 1500], (2, 1))
    states = run(fleet, fleet.start(np.array([[0.5, 0, 0.4, 0.3], [-0.5, 0, 0.4, 2]])), 203, pulses)
    difference = (states[-1].nu - states[-3].nu) / (2 * 0.005)
    assert fleet.acceleration(states[-2]) == pytest.approx(difference, abs=2e-4)


def test_the_same_seed_gives_the_same_bits_and_states_are_not_changed() -> None:
    pulses = np.tile([1700.0, 1500, 1650, 1400, 1700, 1500, 1400, 1500], (2, 1))
    eta = np.array([[0.5, 0, 0.4, 0.3], [-0.5, 0, 0.4, 2]])
    ends = []
    for seed in (1, 1, 2):
        fleet = plant(seed=seed)
        start = fleet.start(eta)
        copies = start.eta.copy(), start.nu.copy(), start.motors.pulses_us.copy()
        ends.append(run(fleet, start, 200, pulses)[-1])
        assert all((a == b).all() for a, b in zip(copies, (start.eta, start.nu, start.motors.pulses_us), strict=True))
    assert (ends[0].eta == ends[1].eta).all()
    assert (ends[0].nu == ends[1].nu).all()
    assert (ends[0].eta != ends[2].eta).any()
