"""A body in the picture against the same in NumPy: an exact line of sight for each pixel, vectors and angles in float64."""

from functools import cache

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates
from scipy.spatial.transform import Rotation

from shoal.config.experiment import load_experiment
from shoal.config.perception import Camera
from shoal.frames import Array
from sim_bridge.camera.kernels import AMBIENT, DIFFUSE, GLOSS, LAMP_UP, LAMP_X, LAMP_Y, ImageRect
from sim_bridge.camera.optics import project, rays
from sim_bridge.camera.renderer import Renderer
from sim_bridge.camera.robot_sprite import Bodies, BodySprite, exposures
from sim_bridge.camera.scene import water_colour
from sim_bridge.camera.textures import HULL_PX

pytestmark = pytest.mark.long

STILL = tuple(f"sim.picture.{key}=0" for key in ("noise", "ripples_m", "caustics", "glare"))
UPRIGHT, TURNED = (0.0, 0.0, 0.0), (0.1, -0.12, 0.5)  # rotations of the camera
RADIUS_M, HEIGHT_M, TEXELS_PER_M, VIGNETTING = 0.15, 0.17, 800.0, 0.4


def texture(size: int, layers: int, seed: int) -> NDArray[np.uint8]:
    """Blots three texels wide, (size, size, layers)."""
    spots = np.random.default_rng(seed).normal(0.0, 1.0, (size, size, layers))
    return np.asarray(np.clip(128.0 + 600.0 * cv2.GaussianBlur(spots, (0, 0), 3.0), 0, 255), dtype=np.uint8)


def plate() -> NDArray[np.uint8]:
    """Brightness, and a square that is covered, with soft edges."""
    covered = np.zeros((120, 120))
    covered[10:-10, 10:-10] = 255.0
    brightness = texture(120, 2, 2)[..., 0]
    return np.stack([brightness, np.rint(cv2.GaussianBlur(covered, (0, 0), 2.0)).astype(np.uint8)], axis=-1)


def looked_up(layer: NDArray[np.uint8], column: Array, row: Array) -> Array:
    return np.asarray(map_coordinates(layer.astype(float), [row, column], order=1, mode="nearest"))


class PlatedSphere:
    """A sphere with a plate on it as a camera sees it in a rectangle of its picture, all pixels (rows, columns) at once."""

    def __init__(self, camera: Camera, window: ImageRect, eta: Array, tilt: Array) -> None:
        rows, columns = np.mgrid[window.top : window.bottom, window.left : window.right]
        self.lines, self.centre = rays(camera, np.stack([columns, rows], axis=-1).astype(float)), eta[:3]
        probes = project(camera, eta[:3] + 0.02 * np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]]))
        self.scale = np.linalg.norm(probes[1:] - probes[0], axis=1).mean() / 0.02
        self.turn = Rotation.from_euler("ZYX", [eta[3], tilt[1], tilt[0]]).as_matrix()
        self.channel = rows % 2 + columns % 2  # of red, green, blue
        centre_x, centre_y = camera.centre_px
        self.vignette = 1.0 - VIGNETTING * ((columns - centre_x) ** 2 + (rows - centre_y) ** 2) / (centre_x**2 + centre_y**2)

    def point(self, slope: Array, depth: Array) -> Array:
        """The lines' points at depths, relative to the sphere's centre."""
        sideways = self.lines.surface_m + depth[..., None] * slope
        return np.concatenate([sideways, depth[..., None]], axis=-1) - self.centre

    def met(self, slope: Array) -> tuple[Array, Array]:
        """Unit normals (rows, columns, 3) of the sphere where lines of these slopes meet it first, and its coverage."""
        way = np.concatenate([slope, np.ones((*slope.shape[:2], 1))], axis=-1)
        start = self.point(slope, np.zeros(slope.shape[:2]))
        nearest = -(start * way).sum(axis=-1) / (way * way).sum(axis=-1)
        miss_m = np.linalg.norm(start + nearest[..., None] * way, axis=-1)
        half_chord = np.sqrt(np.maximum(RADIUS_M**2 - miss_m**2, 0.0)) / np.linalg.norm(way, axis=-1)
        normal = (start + (nearest - half_chord)[..., None] * way) / RADIUS_M
        return normal, np.clip((RADIUS_M - miss_m) * self.scale + 0.5, 0.0, 1.0)

    def through_water(self, colour: Array, depth_m: float) -> Array:
        passed, veil = (part[self.channel] for part in (each[::-1] for each in water_colour(2.0 * max(depth_m, 0.0))))
        return np.asarray(colour * passed + veil)

    def sphere(self, skin: NDArray[np.uint8]) -> tuple[Array, Array]:
        normal, cover = self.met(self.lines.water)
        z = self.centre[2]
        if z < RADIUS_M:
            air_normal, air_cover = self.met(self.lines.air)
            above = -(normal if z > 0.0 else air_normal)[..., 2] * RADIUS_M > z
            normal, cover = np.where(above[..., None], air_normal, normal), np.where(above, air_cover, cover)
        body = normal @ self.turn
        angle, way = np.arccos(np.clip(-body[..., 2], -1.0, 1.0)), np.arctan2(body[..., 1], body[..., 0])
        column, row = (HULL_PX / 2.0 * (1.0 + np.sin(angle / 2.0) * f(way)) - 0.5 for f in (np.cos, np.sin))
        paint = np.choose(self.channel, [looked_up(skin[..., 2 - k], column, row) for k in range(3)])
        lamp = np.maximum(normal @ [LAMP_X, LAMP_Y, -LAMP_UP], 0.0)
        lit = paint * (AMBIENT * (0.6 - 0.4 * normal[..., 2]) + DIFFUSE * lamp) + GLOSS * lamp**24
        return self.through_water(lit, z - 0.7 * RADIUS_M), cover

    def on_plate(self, plate: NDArray[np.uint8]) -> tuple[Array, Array]:
        middle = -HEIGHT_M * self.turn[:, 2]
        deep = self.centre[2] + middle[2]
        slope = self.lines.water if deep > 0.0 else self.lines.air
        way = np.concatenate([slope, np.ones((*slope.shape[:2], 1))], axis=-1)
        start = self.point(slope, np.zeros(slope.shape[:2])) - middle
        depth = -(start @ self.turn[:, 2]) / (way @ self.turn[:, 2])
        ahead, right, _ = np.moveaxis((start + depth[..., None] * way) @ self.turn, -1, 0) * TEXELS_PER_M
        half = plate.shape[0] / 2.0 - 0.5
        column, row = half + right, half - ahead
        inside = np.maximum(abs(column - half), abs(row - half)) < half
        bright, cover = (looked_up(plate[..., k], column, row) for k in range(2))
        return self.through_water(bright, deep), np.where(inside, cover / 255.0, 0.0)

    def over(self, raw: NDArray[np.uint8], skin: NDArray[np.uint8], plate: NDArray[np.uint8]) -> Array:
        """The picture with sphere and plate, not rounded."""
        (sphere, sphere_cover), (marking, plate_cover) = self.sphere(skin), self.on_plate(plate)
        cover = sphere_cover * (1.0 - plate_cover) + plate_cover
        colour = sphere * sphere_cover * (1.0 - plate_cover) + marking * plate_cover
        return np.asarray(raw * (1.0 - cover) + colour * self.vignette)


@cache
def renderer(*rotation_rad: float) -> Renderer:
    settings = [*STILL, f"sim.picture.vignetting={VIGNETTING}", f"camera.rotation_rad={list(rotation_rad)}"]
    return Renderer(load_experiment("pool", settings), 1)


@pytest.mark.parametrize(
    "eta, rotation_rad",
    [
        pytest.param((0.0, 0.0, 0.4, 0.3), UPRIGHT, id="in the middle"),
        pytest.param((1.9, 1.4, 0.3, 2.0), UPRIGHT, id="at the picture's corner"),
        pytest.param((-1.3, 0.2, 0.7, -1.0), TURNED, id="aslant"),
        pytest.param((0.4, -0.5, 0.05, 0.9), TURNED, id="through the surface"),
        pytest.param((0.3, 0.2, -0.04, 0.0), UPRIGHT, id="more above than below"),
    ],
)
def test_each_pixel_is_that_of_its_exact_line_of_sight(eta: tuple[float, ...], rotation_rad: tuple[float, ...]) -> None:
    """The picture takes lines of sight between those of blocks, so it may be off by what a texture changes in some thousandths
    of a pixel."""
    place, tilt = np.array([eta]), np.array([[0.2, -0.1]])
    skin, square = texture(HULL_PX, 3, 1), plate()
    sprite = BodySprite(RADIUS_M, skin, square, HEIGHT_M, TEXELS_PER_M)
    scene, raw = renderer(*rotation_rad).backdrop.at(0.0)
    [look], boxes, _ = exposures(Bodies([sprite], place, np.zeros((1, 4)), tilt), scene.view.optics, 0.008, 1.0)
    [window] = scene.view.windows(boxes, 4.0)
    assert window is not None
    before = raw.copy()
    sprite.draw(raw, scene, window, look, 0.0)
    spot = np.s_[window.top : window.bottom, window.left : window.right]
    exact = PlatedSphere(scene.view.camera, window, place[0], tilt[0]).over(before[spot], skin, square)
    off = np.abs(raw[spot] - np.clip(exact, 0.0, 255.0))
    drawn = np.count_nonzero(raw != before)
    assert drawn == np.count_nonzero(raw[spot] != before[spot]) > 1000
    assert np.count_nonzero(off > 1.0) <= 0.004 * drawn and off.max() < 4.0
