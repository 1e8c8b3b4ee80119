"""Moving water against what physics asks of it: a potential, a floor, a spectrum; and a robot that floats in it."""

import math
from dataclasses import replace

import numpy as np
import pytest

from shoal.config.experiment import load_experiment
from shoal.frames import Array
from sim_bridge.plant.currents_waves import WaterFlow, wave_number
from sim_bridge.plant.fleet import Plant

pytestmark = pytest.mark.long

DEEP = "pool.size_m=[100,100,50]"
FLOATING = ("pool.walls=false", "sim.plant.buoyancy_n=0", "sim.plant.tilt.enabled=false")
WAVES = ("sim.plant.waves.height_m=0.1", "sim.plant.waves.period_s=1.3", "sim.plant.waves.direction_rad=0.6")


def flow(*settings: str, seed: int = 1) -> WaterFlow:
    return WaterFlow(load_experiment("pool", settings), seed)


def at(water: WaterFlow, place: tuple[float, float, float], time_s: float) -> Array:
    return water.motion(np.array([place], dtype=np.float64), time_s)[0, :3]


def test_waves_flow_as_a_potential() -> None:
    """Free of divergence and of rotation, by differences; the floor lets nothing through."""
    water, step = flow(*WAVES), 1e-5
    place = np.array([0.3, -0.2, 0.4])
    gradient = np.array([(at(water, place + d, 0.7) - at(water, place - d, 0.7)) / (2 * step) for d in step * np.eye(3)])
    assert np.trace(gradient) == pytest.approx(0.0, abs=1e-8)
    assert gradient == pytest.approx(gradient.T, abs=1e-8)
    assert np.abs(gradient).max() > 0.1
    for time_s in np.linspace(0, 1.3, 7):
        assert at(water, (0.1, 0.2, 1.0), time_s)[2] == pytest.approx(0.0, abs=1e-12)


def test_a_wave_travels_with_its_dispersion() -> None:
    radps = 2 * np.pi / 1.3
    for depth_m in (0.05, 1.0, 50.0):
        k = wave_number(radps, depth_m)
        assert radps**2 == pytest.approx(9.81 * k * np.tanh(k * depth_m), rel=1e-12)
    k = wave_number(radps, 1.0)
    water, way = flow(*WAVES), np.array([np.cos(0.6), np.sin(0.6), 0.0])
    later = at(water, (0.1, 0.2, 0.3), 0.0)
    moved = at(water, tuple(np.array([0.1, 0.2, 0.3]) + way * radps / k * 0.4), 0.4)
    assert moved == pytest.approx(later, abs=1e-12)


def test_at_the_surface_water_goes_up_and_down_with_the_wave() -> None:
    speeds = [at(flow(*WAVES), (0.0, 0.0, 0.0), t)[2] for t in np.linspace(0, 1.3, 200)]
    assert max(speeds) == pytest.approx(0.05 * 2 * np.pi / 1.3, rel=1e-3)


def test_in_deep_water_motion_falls_by_e_in_a_wave_number_s_depth() -> None:
    water = flow(DEEP, *WAVES)
    k = wave_number(2 * np.pi / 1.3, 50.0)
    top, below = (np.linalg.norm(at(water, (0.0, 0.0, z), 0.2)) for z in (0.0, 1.0 / k))
    assert below == pytest.approx(top / math.e, rel=1e-9)


@pytest.mark.parametrize(
    "settings", [WAVES, ("sim.plant.gust_mps=0.1", "sim.plant.gust_s=2"), (*WAVES, "sim.plant.gust_mps=0.1")]
)
def test_acceleration_is_the_rate_of_change_at_a_place(settings: tuple[str, ...]) -> None:
    water, place = flow(*settings), (0.4, 0.1, 0.2)
    difference = (at(water, place, 3.0 + 1e-5) - at(water, place, 3.0 - 1e-5)) / 2e-5
    assert water.motion(np.array([place]), 3.0)[0, 3:] == pytest.approx(difference, abs=1e-7)


def test_gusts_have_their_strength_and_correlation() -> None:
    """Over many seeds: variance, and exp(-t/T) between two instants; x and y apart."""
    experiment = load_experiment("pool", ("sim.plant.gust_mps=0.05", "sim.plant.gust_s=4"))
    lags = (0.0, 1.0, 2.0, 4.0, 8.0)
    waters = [WaterFlow(experiment, seed) for seed in range(400)]
    speeds = np.array([[at(water, (0, 0, 0), 5.0 + lag)[:2] for lag in lags] for water in waters])
    correlation = (speeds[:, :1] * speeds).mean(axis=0) / 0.05**2
    assert correlation.mean(axis=1) == pytest.approx(np.exp(-np.array(lags) / 4.0), abs=0.12)
    assert abs((speeds[:, 0, 0] * speeds[:, 0, 1]).mean()) < 0.15 * 0.05**2


def test_the_same_seed_blows_the_same() -> None:
    settings = ("sim.plant.gust_mps=0.05",)
    assert (at(flow(*settings), (0, 0, 0), 2.0) == at(flow(*settings), (1, 1, 1), 2.0)).all()
    assert (at(flow(*settings), (0, 0, 0), 2.0) != at(flow(*settings, seed=2), (0, 0, 0), 2.0))[:2].all()


def test_a_floating_robot_drifts_with_the_shear_of_its_depth() -> None:
    settings = (
        *FLOATING,
        "pool.size_m=[100,100,10]",
        "sim.plant.current_mps=[0.1,0,0]",
        "sim.plant.current_shear_per_s=[-0.02,0.01]",
    )
    fleet = Plant(load_experiment("pool", settings), 1)
    state = fleet.start(np.array([[0.0, 0.0, 2.0, 0.5], [5.0, 0.0, 6.0, 0.5]]))
    for _ in range(12000):
        state = fleet.step(state, np.full((2, 8), 1500.0))
    c, s = np.cos(0.5), np.sin(0.5)
    moving = np.stack([c * state.nu[:, 0] - s * state.nu[:, 1], s * state.nu[:, 0] + c * state.nu[:, 1]], axis=1)
    assert moving == pytest.approx(np.array([[0.06, 0.02], [-0.02, 0.06]]), abs=2e-3)


def test_a_floating_robot_goes_round_with_the_water() -> None:
    """A neutrally buoyant body needs no force to follow: its orbit is the water's, e^(-k z) smaller at its depth.
    A low wave: what a steep one adds is left out."""
    settings = (*FLOATING, DEEP, "sim.plant.waves.height_m=0.004", "sim.plant.waves.period_s=2")
    fleet = Plant(load_experiment("pool", settings), 1)
    water = flow(*settings)
    eta = np.array([[0.0, 0.0, 0.5, 0.0], [3.0, 0.0, 1.0, 1.0]])
    start = fleet.start(eta)
    nu = np.zeros((2, 4))
    for i in range(2):
        u, v, w = at(water, tuple(eta[i, :3]), 0.0)
        nu[i, :3] = np.cos(eta[i, 3]) * u + np.sin(eta[i, 3]) * v, np.cos(eta[i, 3]) * v - np.sin(eta[i, 3]) * u, w
    state = replace(start, nu=nu)
    places = []
    for _ in range(400):
        state = fleet.step(state, np.full((2, 8), 1500.0))
        places.append(state.eta[:, :3])
    k = wave_number(np.pi, 50.0)
    for i, depth in enumerate((0.5, 1.0)):
        x, z = np.array(places)[:, i, 0], np.array(places)[:, i, 2]
        radius = 0.002 * np.exp(-k * depth)
        assert np.ptp(z) / 2 == pytest.approx(radius, rel=0.01)
        assert np.ptp(x) / 2 == pytest.approx(radius, rel=0.01)
