"""A robot in the picture: a shaded sphere with a marker plate on top, traced pixel by pixel through lens and water. A ball
adrift is a sphere without one.

Each pixel's line of sight is met with the sphere in closed form, so edges and texture lie where exact optics puts them.
"""

import copy
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from sim_bridge.camera.marker_plate import LENS_SOFTNESS_PX, Plate, Sight
from sim_bridge.camera.rays import Lines, View, Window, seen_raw
from sim_bridge.camera.scenery import through_water
from sim_bridge.camera.textures import RED, SHELL_PX, Bytes, Float, shell
from wire.config.experiment import Experiment
from wire.config.scene import RobotConfig
from wire.frames import Array

LAMP = np.array([-0.30, -0.22, 0.93])  # where most light comes from: pool x, y and up; the shadow falls the other way
AMBIENT, DIFFUSE = 0.50, 0.56
GLOSS, GLOSS_POWER = 26.0, 24  # grey levels of a wet shell's highlight, and how small it is
SHADOW = 0.42  # how dark the middle of a shadow is
PENUMBRA = 0.30  # its soft edge per metre between robot and floor: the lamps are long tubes
BLUR_STEP_PX = 1.0  # an exposure is split until nothing moves further than this between its parts: the lens hides the rest
MAX_PARTS = 8


@dataclass(frozen=True)
class Pose:
    """A robot at one instant of the exposure, and the pixels per metre around it."""

    x_m: float
    y_m: float
    z_m: float
    attitude: Array  # (3, 3), body to pool
    px_per_m: float


class Sprite:
    """Draws one body: its skin (SHELL_PX, SHELL_PX, 3), see textures.py, and its plate at `height_m` above the centre.
    `layer` is pure: it only reads what was drawn at the start."""

    def __init__(self, radius_m: float, skin: Bytes, plate: Plate | None = None, height_m: float = 0.0) -> None:
        self.radius_m, self.height_m = radius_m, height_m
        self._skin = [np.ascontiguousarray(skin[..., channel]) for channel in (2, 1, 0)]  # red, green, blue
        self._plate = plate
        self._half_m = 0.0 if plate is None else float(np.sqrt(2.0) * plate.half_m)

    @classmethod
    def robot(cls, robot: RobotConfig, experiment: Experiment, random: np.random.Generator) -> "Sprite":
        """A robot of the experiment in a paint of its own."""
        vehicle, px_per_m = experiment.vehicle, experiment.camera.px_per_m
        texels_per_px = SHELL_PX / 4.0 / vehicle.radius_m / px_per_m
        marked = experiment.localizer.markers
        number = None if experiment.sim.picture.alike else robot.id
        skin = shell(number, marked, LENS_SOFTNESS_PX * texels_per_px, random)
        plate = Plate(robot.marker, vehicle.marker.side_m, px_per_m) if marked else None
        return cls(vehicle.radius_m, skin, plate, vehicle.marker.height_m)

    @classmethod
    def ball(cls, radius_m: float) -> "Sprite":
        """A plain red ball."""
        return cls(radius_m, np.full((SHELL_PX, SHELL_PX, 3), RED, np.uint8))

    def unmarked(self) -> "Sprite":
        """The same robot, its marker plate lost."""
        bare = copy.copy(self)
        bare._plate = None
        return bare

    def box(self, eta: Array, tilt_rad: float = 0.0) -> Array:
        """Corners (8, 3) of a box in the pool frame that holds the body at eta, tilted by so much."""
        corner = np.array([[i, j, k] for i in (-1, 1) for j in (-1, 1) for k in (0, 1)], dtype=np.float64)
        lean = abs(float(np.sin(tilt_rad)))
        reach = max(self.radius_m, self._half_m + lean * self.height_m)
        top, bottom = max(self.radius_m, self.height_m + lean * self._half_m), self.radius_m
        corner = corner * [reach, reach, top + bottom] - [0.0, 0.0, top]
        return np.asarray(eta[:3] + corner)

    def layer(self, sight: Sight, pose: Pose) -> tuple[Float, Float]:
        """Raw mosaic of the body weighted with its coverage, and the coverage (0 to 1), in the window's shape."""
        colour, cover = self._sphere(sight, pose)
        if self._plate is None:
            return colour, cover
        top = np.array([pose.x_m, pose.y_m, pose.z_m]) - self.height_m * pose.attitude[:, 2]
        plate_colour, plate_cover = self._plate.layer(sight, top, pose.attitude)
        rest = 1.0 - plate_cover
        return colour * rest + plate_colour, cover * rest + plate_cover

    def _sphere(self, sight: Sight, pose: Pose) -> tuple[Float, Float]:
        normal_x, normal_y, up, cover = _hit(sight.lines, sight.lines.water_x, sight.lines.water_y, pose, self.radius_m)
        if pose.z_m < self.radius_m:  # it breaks the surface: what is above is seen straight
            dry = _hit(sight.lines, sight.lines.air_x, sight.lines.air_y, pose, self.radius_m)
            emerged = (up if pose.z_m > 0 else dry[2]) * self.radius_m > pose.z_m
            normal_x, normal_y, up, cover = (
                np.where(emerged, d, w) for d, w in zip(dry, (normal_x, normal_y, up, cover), strict=True)
            )
        ahead, aside, down = pose.attitude.T.astype(np.float32)
        above = down[2] * up - down[0] * normal_x - down[1] * normal_y  # along the body's own axes
        flat = np.float32(SHELL_PX / 2.0) / np.sqrt(2.0 * (1.0 + np.maximum(above, np.float32(-0.999))))
        column = (ahead[0] * normal_x + ahead[1] * normal_y - ahead[2] * up) * flat + np.float32(SHELL_PX / 2.0 - 0.5)
        row = (aside[0] * normal_x + aside[1] * normal_y - aside[2] * up) * flat + np.float32(SHELL_PX / 2.0 - 0.5)
        skin = seen_raw(self._skin, column, row)
        lamp_x, lamp_y, lamp_up = LAMP.astype(np.float32)
        lamp = np.maximum(normal_x * lamp_x + normal_y * lamp_y + up * lamp_up, np.float32(0.0))
        colour = skin * ((AMBIENT * (0.6 + 0.4 * up) + DIFFUSE * lamp) * sight.light) + GLOSS * _power(lamp, GLOSS_POWER)
        return through_water(colour, 2.0 * max(pose.z_m - 0.7 * self.radius_m, 0.0)) * cover, cover


def attitude(yaw_rad: float, roll_rad: float = 0.0, pitch_rad: float = 0.0) -> Array:
    """Body to pool (3, 3): Rz(yaw) Ry(pitch) Rx(roll)."""
    (cy, cp, cr), (sy, sp, sr) = np.cos([yaw_rad, pitch_rad, roll_rad]), np.sin([yaw_rad, pitch_rad, roll_rad])
    return np.array([
        [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
        [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
        [-sp, cp * sr, cp * cr],
    ])  # fmt: skip


def parts(eta: Array, nu: Array, exposure_s: float, reach_m: float, px_per_m: float) -> list[Array]:
    """Poses (4,) whose mean picture stands for the exposure around eta: evenly spaced, symmetric in time."""
    surge, sway, heave, yaw_rate = nu
    moved_px = (np.hypot(surge, sway) + abs(yaw_rate) * reach_m) * exposure_s * px_per_m
    count = int(min(max(np.ceil(moved_px / BLUR_STEP_PX), 1), MAX_PARTS))
    cos, sin = np.cos(eta[3]), np.sin(eta[3])
    velocity = np.array([cos * surge - sin * sway, sin * surge + cos * sway, heave, yaw_rate])
    return [eta + velocity * exposure_s * ((k + 0.5) / count - 0.5) for k in range(count)]


def shade(raw: Bytes, block_z: Float, view: View, window: Window, eta: Array, radius_m: float) -> None:
    """Darken the floor (and walls) of a window below a robot, in place. `block_z` is how deep each block's scene lies:
    a shadow's edge is wider than a block."""
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


def _hit(lines: Lines, slope_x: Float, slope_y: Float, pose: Pose, radius_m: float) -> tuple[Float, Float, Float, Float]:
    """Where lines of sight meet the sphere: unit normal (x, y, up) and coverage of the pixel. Lines that just miss get the
    normal of the limb, so that a half-covered pixel at the edge has a colour."""
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
    """float32, without a copy when it is so already."""
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
