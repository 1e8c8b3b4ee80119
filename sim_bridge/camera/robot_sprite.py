"""Layers of robots, balls and marker plates: shaded spheres and plates, traced pixel by pixel through lens and water.

Each pixel's line of sight is intersected with sphere and plate in closed form, so edges and texture lie where exact optics
puts them. A ball is a sphere without a plate; a landmark is a plate without a sphere.
"""

import copy
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import ArrayLike

from sim_bridge.camera.optics import Bytes, Float
from sim_bridge.camera.rays import CameraRays, ImageRect, RayBundle, sample_mosaic
from sim_bridge.camera.scene import through_water
from sim_bridge.camera.textures import HULL_PX, LENS_SOFTNESS_PX, RED, hull_texture, plate_texels_per_m, plate_texture
from wire.config.experiment import Experiment
from wire.config.scene import RobotConfig
from wire.frames import Array

LAMP = np.array([-0.30, -0.22, 0.93])  # direction to most of the light: pool x, y and up; shadows fall the other way
AMBIENT, DIFFUSE = 0.50, 0.56  # shares of ambient and of directed light on a hull
GLOSS, GLOSS_POWER = 26.0, 24  # grey levels of a wet hull's highlight, and the exponent that sets its size
SHADOW = 0.42  # share of the light that is missing in the middle of a shadow
PENUMBRA = 0.30  # width of a shadow's edge per metre between robot and floor, for long lamp tubes
BLUR_STEP_PX = 1.0  # px that a body may move between two parts of an exposure; the lens's blur hides that much
MAX_PARTS = 8  # of an exposure


@dataclass(frozen=True)
class PixelRays:
    """Lines of sight of a rectangle's pixels, ripples included, and the relative light on the body that is drawn there."""

    lines: RayBundle
    light: Float


class MarkerPlate:
    """One marker on its white plate. `layer` is pure: it only reads what was drawn at the start."""

    def __init__(self, marker_id: int, side_m: float, px_per_m: float) -> None:
        self._texels_per_m = plate_texels_per_m(side_m)
        self._texture = plate_texture(marker_id, LENS_SOFTNESS_PX * self._texels_per_m / px_per_m)
        self.half_m = self._texture.shape[0] / 2.0 / self._texels_per_m  # transparent margin included

    def corners(self, place_m: Array) -> Array:
        """A square (4, 3) in the pool frame that holds the plate at `place_m` (3,) in any heading."""
        reach = np.sqrt(2.0) * self.half_m
        return np.asarray(place_m + reach * np.array([[1, 1, 0], [1, -1, 0], [-1, -1, 0], [-1, 1, 0]]))

    def layer(self, rays: PixelRays, place_m: Array, attitude: Array) -> tuple[Float, Float]:
        """Raw mosaic of the plate at `place_m` (3,) weighted with its coverage, and the coverage (0 to 1).

        The columns of `attitude` (3, 3) are the plate's axes in the pool: up in its picture, right in it, and away from
        the camera.
        """
        lines, (x0, y0, z0) = rays.lines, (np.float32(value) for value in place_m)
        slope_x, slope_y = (lines.water_x, lines.water_y) if z0 > 0 else (lines.air_x, lines.air_y)
        along, across, normal = attitude.T.astype(np.float32)
        x, y = lines.surface_x - x0, lines.surface_y - y0  # and (slope, 1) deeper per metre, to the plate's plane
        if normal[0] or normal[1]:
            deep = (z0 * normal[2] - x * normal[0] - y * normal[1]) / (normal[2] + slope_x * normal[0] + slope_y * normal[1])
        else:
            deep = z0
        x, y, below = x + deep * slope_x, y + deep * slope_y, deep - z0
        scale, middle = np.float32(self._texels_per_m), np.float32(self._texture.shape[0] / 2.0 - 0.5)
        column = scale * (across[0] * x + across[1] * y + across[2] * below) + middle
        row = middle - scale * (along[0] * x + along[1] * y + along[2] * below)
        found = cv2.remap(self._texture, column, row, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT)
        cover = np.asarray(found[..., 1] * np.float32(1.0 / 255.0), dtype=np.float32)
        colour = through_water(np.asarray(found[..., 0] * rays.light, dtype=np.float32), 2.0 * max(float(z0), 0.0))
        return np.asarray(colour * cover, dtype=np.float32), cover


@dataclass(frozen=True)
class BodyPose:
    """A body at one instant of the exposure, and the pixels per metre around it."""

    x_m: float
    y_m: float
    z_m: float
    attitude: Array  # (3, 3), body to pool
    px_per_m: float


class BodySprite:
    """One body: its skin (HULL_PX, HULL_PX, 3), see textures.py, and its plate at `height_m` above the centre. `layer` is
    pure: it only reads what was drawn at the start."""

    def __init__(self, radius_m: float, skin: Bytes, plate: MarkerPlate | None = None, height_m: float = 0.0) -> None:
        self.radius_m, self.height_m = radius_m, height_m
        self._skin = [np.ascontiguousarray(skin[..., channel]) for channel in (2, 1, 0)]  # red, green, blue
        self._plate = plate
        self._half_m = 0.0 if plate is None else float(np.sqrt(2.0) * plate.half_m)

    @classmethod
    def robot(cls, robot: RobotConfig, experiment: Experiment, random: np.random.Generator) -> "BodySprite":
        """A robot of the experiment with its own paint."""
        vehicle, px_per_m = experiment.vehicle, experiment.camera.px_per_m
        texels_per_px = HULL_PX / 4.0 / vehicle.radius_m / px_per_m
        marked = experiment.localizer.markers
        number = None if experiment.sim.picture.alike else robot.id
        skin = hull_texture(number, marked, LENS_SOFTNESS_PX * texels_per_px, random)
        plate = MarkerPlate(robot.marker, vehicle.marker.side_m, px_per_m) if marked else None
        return cls(vehicle.radius_m, skin, plate, vehicle.marker.height_m)

    @classmethod
    def ball(cls, radius_m: float) -> "BodySprite":
        """A plain red ball."""
        return cls(radius_m, np.full((HULL_PX, HULL_PX, 3), RED, np.uint8))

    def unmarked(self) -> "BodySprite":
        """The same robot without its marker plate."""
        unmarked = copy.copy(self)
        unmarked._plate = None
        return unmarked

    def box(self, eta: Array, tilt_rad: float = 0.0) -> Array:
        """Corners (8, 3) of a box in the pool frame that holds the body at eta, tilted by `tilt_rad`."""
        corner = np.array([[i, j, k] for i in (-1, 1) for j in (-1, 1) for k in (0, 1)], dtype=np.float64)
        lean = abs(float(np.sin(tilt_rad)))
        reach = max(self.radius_m, self._half_m + lean * self.height_m)
        top, bottom = max(self.radius_m, self.height_m + lean * self._half_m), self.radius_m
        corner = corner * [reach, reach, top + bottom] - [0.0, 0.0, top]
        return np.asarray(eta[:3] + corner)

    def layer(self, rays: PixelRays, pose: BodyPose) -> tuple[Float, Float]:
        """Raw mosaic of the body weighted with its coverage, and the coverage (0 to 1), in the rectangle's shape."""
        colour, cover = self._sphere(rays, pose)
        if self._plate is None:
            return colour, cover
        top = np.array([pose.x_m, pose.y_m, pose.z_m]) - self.height_m * pose.attitude[:, 2]
        plate_colour, plate_cover = self._plate.layer(rays, top, pose.attitude)
        rest = 1.0 - plate_cover
        return colour * rest + plate_colour, cover * rest + plate_cover

    def _sphere(self, rays: PixelRays, pose: BodyPose) -> tuple[Float, Float]:
        normal_x, normal_y, up, cover = _intersect_sphere(
            rays.lines, rays.lines.water_x, rays.lines.water_y, pose, self.radius_m
        )
        if pose.z_m < self.radius_m:  # it breaks the surface: what is above is seen straight
            dry = _intersect_sphere(rays.lines, rays.lines.air_x, rays.lines.air_y, pose, self.radius_m)
            emerged = (up if pose.z_m > 0 else dry[2]) * self.radius_m > pose.z_m
            normal_x, normal_y, up, cover = (
                np.where(emerged, d, w) for d, w in zip(dry, (normal_x, normal_y, up, cover), strict=True)
            )
        ahead, aside, down = pose.attitude.T.astype(np.float32)
        above = down[2] * up - down[0] * normal_x - down[1] * normal_y  # along the body's own axes
        flat = np.float32(HULL_PX / 2.0) / np.sqrt(2.0 * (1.0 + np.maximum(above, np.float32(-0.999))))
        column = (ahead[0] * normal_x + ahead[1] * normal_y - ahead[2] * up) * flat + np.float32(HULL_PX / 2.0 - 0.5)
        row = (aside[0] * normal_x + aside[1] * normal_y - aside[2] * up) * flat + np.float32(HULL_PX / 2.0 - 0.5)
        skin = sample_mosaic(self._skin, column, row)
        lamp_x, lamp_y, lamp_up = LAMP.astype(np.float32)
        lamp = np.maximum(normal_x * lamp_x + normal_y * lamp_y + up * lamp_up, np.float32(0.0))
        colour = skin * ((AMBIENT * (0.6 + 0.4 * up) + DIFFUSE * lamp) * rays.light) + GLOSS * _power(lamp, GLOSS_POWER)
        return through_water(colour, 2.0 * max(pose.z_m - 0.7 * self.radius_m, 0.0)) * cover, cover


def attitude(yaw_rad: float, roll_rad: float = 0.0, pitch_rad: float = 0.0) -> Array:
    """Rotation from body to pool, (3, 3): Rz(yaw) Ry(pitch) Rx(roll)."""
    (cy, cp, cr), (sy, sp, sr) = np.cos([yaw_rad, pitch_rad, roll_rad]), np.sin([yaw_rad, pitch_rad, roll_rad])
    return np.array([
        [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
        [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
        [-sp, cp * sr, cp * cr],
    ])  # fmt: skip


def exposure_poses(eta: Array, nu: Array, exposure_s: float, reach_m: float, px_per_m: float) -> list[Array]:
    """Poses (4,) whose mean picture stands for the exposure around eta: evenly spaced, symmetric in time."""
    surge, sway, heave, yaw_rate = nu
    moved_px = (np.hypot(surge, sway) + abs(yaw_rate) * reach_m) * exposure_s * px_per_m
    count = int(min(max(np.ceil(moved_px / BLUR_STEP_PX), 1), MAX_PARTS))
    cos, sin = np.cos(eta[3]), np.sin(eta[3])
    velocity = np.array([cos * surge - sin * sway, sin * surge + cos * sway, heave, yaw_rate])
    return [eta + velocity * exposure_s * ((k + 0.5) / count - 0.5) for k in range(count)]


def draw_shadow(raw: Bytes, block_z: Float, view: CameraRays, window: ImageRect, eta: Array, radius_m: float) -> None:
    """Darken the floor and walls of a rectangle below a robot, in place.

    `block_z` is the depth of each block's surface. Blocks are fine enough, as a shadow's edge is wider than one.
    """
    lines, z = view.blocks[window.blocks], block_z[window.blocks]
    below = z - np.float32(eta[2])
    x = lines.surface_x + z * lines.water_x - np.float32(eta[0])
    y = lines.surface_y + z * lines.water_y - np.float32(eta[1])
    x += below * np.float32(LAMP[0] / LAMP[2])
    y += below * np.float32(LAMP[1] / LAMP[2])
    softness = np.float32(PENUMBRA) * np.maximum(below, np.float32(0.02))
    inside = np.clip((np.float32(radius_m) - np.sqrt(x * x + y * y)) / softness * np.float32(0.5) + np.float32(0.5), 0.0, 1.0)
    inside *= inside * (3.0 - 2.0 * inside) * (below > 0)
    spot = raw[window.pixels]
    left_over = view.spread(_float(1.0 - np.float32(SHADOW) * inside), window)
    np.rint(spot * left_over, out=left_over)
    spot[:] = left_over


def shadow_box(eta: Array, floor_m: float, radius_m: float) -> Array:
    """Corners (4, 3) of a square on the floor that holds a robot's shadow."""
    below = max(floor_m - eta[2], 0.02)
    centre = eta[:2] - below * LAMP[:2] / LAMP[2]
    reach = radius_m + PENUMBRA * below
    return np.array([[centre[0] + i * reach, centre[1] + j * reach, floor_m] for i in (-1, 1) for j in (-1, 1)])


def _intersect_sphere(
    lines: RayBundle, slope_x: Float, slope_y: Float, pose: BodyPose, radius_m: float
) -> tuple[Float, Float, Float, Float]:
    """Intersect lines of sight with the sphere: unit normal (x, y, up) and coverage of the pixel. A line that just misses
    gets the normal of the limb, so that a half-covered pixel at the edge has a colour."""
    x = lines.surface_x + np.float32(pose.z_m) * slope_x - np.float32(pose.x_m)
    y = lines.surface_y + np.float32(pose.z_m) * slope_y - np.float32(pose.y_m)
    # |(x, y, 0) + w (slope, 1)| = radius, with w the depth below the centre: a w^2 + 2 b w + |x, y|^2 - radius^2 = 0
    a = slope_x * slope_x + slope_y * slope_y + np.float32(1.0)
    b = x * slope_x + y * slope_y
    miss2 = x * x + y * y - b * b / a  # squared distance of the line from the centre
    radius = np.float32(radius_m)
    cover = np.clip((radius - np.sqrt(np.maximum(miss2, 0.0))) * np.float32(pose.px_per_m) + np.float32(0.5), 0.0, 1.0)
    w = -(b + np.sqrt(np.maximum(radius * radius - miss2, 0.0) * a)) / a
    normal_x, normal_y, up = (x + w * slope_x) / radius, (y + w * slope_y) / radius, -w / radius
    return _float(normal_x), _float(normal_y), _float(up), _float(cover)


def _float(values: ArrayLike) -> Float:
    """Values as float32, without a copy when they are so already."""
    return np.asarray(values, dtype=np.float32)


def _power(base: Float, exponent: int) -> Float:
    """base ** exponent by squaring: numpy's power of floats is ten times slower."""
    result, square = None, base
    while exponent:
        if exponent & 1:
            result = square if result is None else result * square
        square, exponent = square * square, exponent >> 1
    assert result is not None
    return result
