"""Waves in the picture and in the pressure, and a camera that is not as its calibration says."""

import math

import numpy as np
import pytest
from scipy.optimize import brentq

from shoal.config.experiment import load_experiment
from shoal.errors import ConfigError
from shoal.frames import Array
from sim_bridge.camera.kernels import SURFACE_X, SURFACE_Y, WATER_X, WATER_Y, ImageRect
from sim_bridge.camera.rays import CameraRays
from sim_bridge.camera.renderer import Renderer
from sim_bridge.camera.scene import WaterView
from sim_bridge.camera.water_optics import WaterLight
from sim_bridge.plant.currents_waves import SurfaceWave, WaterFlow
from sim_bridge.plant.sensors import BoardSensors

WAVES = "sim.plant.waves={height_m=0.04, period_s=1.2, direction_rad=0.5}"
SMALL = ("camera.size_px=[320, 240]", "camera.focal_px=[251.25, 251.25]", "camera.centre_px=[159.5, 119.5]")
STILL = np.zeros(4)


def refracted(start: Array, direction: Array, wave: SurfaceWave, time_s: float, index: float, depth_m: float) -> Array:
    """The end of a line of sight at a depth: met with the surface by a root, and bent by Snell's law in vectors. z is down."""
    amplitude, kx, ky, turned = wave.at(time_s)

    def phase(way: float) -> float:
        at = start + way * direction
        return float(kx * at[0] + ky * at[1] - turned)

    way = brentq(lambda w: start[2] + w * direction[2] + amplitude * math.cos(phase(w)), 0.0, 20.0)
    slope = -amplitude * np.array([kx, ky]) * math.sin(phase(way))
    normal = np.array([*slope, 1.0]) / math.hypot(1.0, *slope)
    unit = direction / np.linalg.norm(direction)
    cosine = float(normal @ unit)
    bent = unit / index + (math.sqrt(1.0 - (1.0 - cosine**2) / index**2) - cosine / index) * normal
    met = start + way * direction
    return np.asarray(met + (depth_m - met[2]) / bent[2] * bent)


def test_lines_of_sight_are_bent_by_the_wave_as_snells_law_says() -> None:
    experiment = load_experiment("pool", [WAVES, "sim.picture.ripples_m=0", *SMALL])
    view, waters = CameraRays(experiment.camera), WaterLight(experiment, np.random.default_rng(5))
    scene, wave, depth_m = WaterView(waters, view, np.ones_like(view.blocks.surface_x)), SurfaceWave(experiment), 0.4
    lens, largest = np.array(experiment.camera.position_m), 0.0
    for time_s in (0.0, 0.4, 0.7):
        fields = scene.fields(ImageRect(0, 240, 0, 320, 0, 30, 0, 40), depth_m, time_s)
        for i, j in ((15, 20), (5, 8), (25, 35), (2, 20)):
            air = np.array([view.blocks.air_x[i, j], view.blocks.air_y[i, j], 1.0], dtype=float)
            exact = refracted(lens, air, wave, time_s, experiment.camera.water_index, depth_m)
            flat = refracted(lens, air, SurfaceWave(load_experiment("pool")), time_s, experiment.camera.water_index, depth_m)
            place = fields[[SURFACE_X, SURFACE_Y], i, j] + depth_m * fields[[WATER_X, WATER_Y], i, j]
            assert place == pytest.approx(exact[:2], abs=1e-4)
            largest = max(largest, float(np.linalg.norm(exact - flat)))
    assert largest > 0.008


@pytest.mark.long
def test_a_wave_moves_a_robot_in_the_picture_and_nothing_else_does() -> None:
    eta = np.array([[0.4, 0.0, 0.3, 0.0], [-0.4, 0.0, 0.3, 0.0]])
    calm, rough = Renderer(load_experiment("pool"), 1), Renderer(load_experiment("pool", [WAVES]), 1)
    pictures = [each.render(eta, np.zeros((2, 4)), 0.4, 1).astype(int) for each in (calm, rough)]
    changed = np.abs(pictures[0] - pictures[1]) > 40
    assert changed.sum() > 200


def test_pressure_below_a_wave_is_what_moves_the_water() -> None:
    """Euler's equation, with the acceleration of the plant's own water: grad p = rho (g - a)."""
    experiment = load_experiment("pool", [WAVES, "sim.plant.gust_mps=0"])
    wave, flow, step_m = SurfaceWave(experiment), WaterFlow(experiment, 1), 1e-4
    for time_s in (0.0, 0.3, 0.9):
        for place in np.random.default_rng(1).uniform([-2, -1, 0.1], [2, 1, 0.9], (10, 3)):
            acceleration = flow.motion(place[None], time_s)[0, 3:]
            for axis in range(3):
                along = step_m * np.eye(3)[axis]
                ends = [wave.pressure_m(x, y, z, time_s) for x, y, z in (place + along, place - along)]
                assert (ends[0] - ends[1]) / (2 * step_m) == pytest.approx(-acceleration[axis] / 9.81, abs=1e-5)


def test_a_pressure_sensor_measures_the_wave() -> None:
    quiet = [f"sim.sensors.{name}=0" for name in ("pressure_noise_m", "pressure_bias_m")]
    sensors, wave = [BoardSensors(load_experiment("pool", [*quiet, *more]), 1, 1) for more in ((), (WAVES,))], 0.02
    depths = [
        [each.read(np.array([0.0, 0.0, 0.0, 0.0]), STILL, STILL, time_s=t).depth_m for t in (0.0, 0.6)] for each in sensors
    ]
    assert depths[0] == [0.0, 0.0]
    assert depths[1] == pytest.approx([wave, -wave])


@pytest.mark.long
def test_errors_of_the_calibration_are_a_camera_that_is_elsewhere() -> None:
    """Bit by bit the picture of an experiment whose own keys have these values."""
    eta, plain = np.array([[0.4, 0.0, 0.3, 0.0], [-0.4, 0.0, 0.3, 0.0]]), load_experiment("pool")
    x, y, z = plain.camera.position_m
    errors = [
        "sim.camera.focal_error=0.02",
        "sim.camera.position_error_m=[0.01, -0.02, 0.03]",
        "sim.camera.rotation_error_rad=[0, 0.01, 0]",
        "sim.camera.plate_error_m=0.01",
    ]
    truth = [
        f"camera.focal_px={[focal * 1.02 for focal in plain.camera.focal_px]}",
        f"camera.position_m=[{x + 0.01}, {y - 0.02}, {z + 0.03}]",
        "camera.rotation_rad=[0, 0.01, 0]",
        f"vehicle.marker.height_m={plain.vehicle.marker.height_m + 0.01}",
    ]
    assert plain.camera.rotation_rad == (0.0, 0.0, 0.0)
    wrong, elsewhere = (Renderer(load_experiment("pool", k), 1).render(eta, np.zeros((2, 4)), 0.4, 1) for k in (errors, truth))
    assert np.array_equal(wrong, elsewhere)
    near = ["camera.position_m=[0, 0, -0.8]", "sim.camera.position_error_m=[0, 0, 0.9]"]
    with pytest.raises(ConfigError, match=r"sim\.camera\.position_error_m\.2 = 0\.9: .* would hang in the water"):
        Renderer(load_experiment("pool", near), 1)
