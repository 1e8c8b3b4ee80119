"""Robots, balls and landmarks: shaded spheres and plates, traced pixel by pixel through lens and water.

Each pixel's line of sight is intersected with sphere and plate in closed form (kernels.draw_body), so edges and texture lie
where exact optics puts them. A ball is a sphere without a plate; a landmark is a plate without a sphere.
"""

import copy

import numpy as np

from sim_bridge.camera import kernels
from sim_bridge.camera.kernels import LAMP_UP, LAMP_X, LAMP_Y, LANE_ROWS, LANES, PENUMBRA
from sim_bridge.camera.optics import Bytes
from sim_bridge.camera.rays import ImageRect
from sim_bridge.camera.scene import WaterView, water_colour
from sim_bridge.camera.textures import HULL_PX, LENS_SOFTNESS_PX, RED, hull_texture, plate_texels_per_m, plate_texture
from wire.config.experiment import Experiment
from wire.config.perception import Landmark, MarkerFamily
from wire.config.scene import RobotConfig
from wire.frames import Array

BLUR_STEP_PX = 1.0  # px that a body may move between two parts of an exposure; the lens's blur hides that much
MAX_PARTS = 8  # of an exposure
CORNERS = np.array([[i, j, k] for i in (-1, 1) for j in (-1, 1) for k in (0, 1)], dtype=np.float64)  # of a box
NO_SKIN = np.zeros((2, 2, 3), np.uint8)
NO_PLATE = np.zeros((2, 2, 2), np.uint8)


class BodySprite:
    """One body: a sphere with its skin (HULL_PX, HULL_PX, 3), see textures.py, and a plate (n, n, 2) at `height_m` above its
    centre. With radius 0 there is the plate alone. Nothing changes after the start."""

    def __init__(
        self,
        radius_m: float,
        skin: Bytes = NO_SKIN,
        plate: Bytes = NO_PLATE,
        height_m: float = 0.0,
        texels_per_m: float = np.inf,
    ) -> None:
        self.radius_m, self.height_m = radius_m, height_m
        self._skin = np.ascontiguousarray(np.moveaxis(skin, -1, 0)[::-1])  # red, green, blue
        self._set_plate(plate, texels_per_m)

    def _set_plate(self, plate: Bytes, texels_per_m: float) -> None:
        layers = np.ascontiguousarray(np.moveaxis(plate, -1, 0))  # brightness and coverage
        self._half_m = float(np.sqrt(0.5) * plate.shape[0] / texels_per_m)  # from its middle to a corner, margin included
        self._constants = (self.radius_m, self.height_m, self._skin, self._half_m > 0.0, layers, float(texels_per_m))

    @classmethod
    def robot(cls, robot: RobotConfig, experiment: Experiment, random: np.random.Generator) -> "BodySprite":
        """A robot of the experiment with its own paint."""
        vehicle, px_per_m = experiment.vehicle, experiment.camera.px_per_m
        texels_per_px = HULL_PX / 4.0 / vehicle.radius_m / px_per_m
        marked = experiment.localizer.markers
        number = None if experiment.sim.picture.alike else robot.id
        skin = hull_texture(number, marked, LENS_SOFTNESS_PX * texels_per_px, random)
        family = experiment.localizer.marker_family
        plate = _plate(robot.marker, vehicle.marker.side_m, px_per_m, family) if marked else (NO_PLATE, np.inf)
        return cls(vehicle.radius_m, skin, plate[0], vehicle.marker.height_m, plate[1])

    @classmethod
    def ball(cls, radius_m: float) -> "BodySprite":
        """A plain red ball."""
        return cls(radius_m, np.full((HULL_PX, HULL_PX, 3), RED, np.uint8))

    @classmethod
    def landmark(cls, landmark: Landmark, px_per_m: float, family: MarkerFamily) -> "BodySprite":
        """A marker on its plate, fixed in the pool."""
        plate, texels_per_m = _plate(landmark.id, landmark.side_m, px_per_m, family)
        return cls(0.0, plate=plate, texels_per_m=texels_per_m)

    def unmarked(self) -> "BodySprite":
        """The same robot without its marker plate."""
        unmarked = copy.copy(self)
        unmarked._set_plate(NO_PLATE, np.inf)
        return unmarked

    def box(self, eta: Array, tilt_rad: float = 0.0) -> Array:
        """Corners (8, 3) of a box in the pool frame that holds the body at eta, tilted by `tilt_rad`."""
        lean = abs(float(np.sin(tilt_rad)))
        reach = max(self.radius_m, self._half_m + lean * self.height_m)
        top, bottom = max(self.radius_m, self.height_m + lean * self._half_m), self.radius_m
        return np.asarray(eta[:3] + (CORNERS * np.array([reach, reach, top + bottom]) - np.array([0.0, 0.0, top])))

    def draw(
        self, raw: Bytes, scene: WaterView, window: ImageRect, poses: Array, tilt: Array, px_per_m: float, time_s: float
    ) -> None:
        """Lay the mean of the body's pictures in poses (k, 4), with roll and pitch `tilt` (2,), over a rectangle of the raw
        mosaic, in place. There are `px_per_m` pixels per metre around the body."""
        fields = scene.fields(window, float(np.mean(poses[:, 2])), time_s)
        attitudes = np.stack([attitude(pose[3], *tilt) for pose in poses])
        depths = poses[:, 2, None] - [0.7 * self.radius_m, 0.0] - attitudes[:, 2, 2, None] * [0.0, self.height_m]
        water = np.stack(water_colour(2.0 * np.maximum(depths, 0.0)), axis=2)[..., ::-1]  # sphere and plate; red first
        kernels.draw_body(
            raw, window.top, window.left, scene.view.lines(window).planes, scene.view.spread(fields, window), scene.vignette,
            self._constants, np.ascontiguousarray(poses[:, :3]), attitudes, water.astype(np.float64), px_per_m,
            np.empty((LANE_ROWS, LANES)),
        )  # fmt: skip

    def draw_shadow(self, raw: Bytes, scene: WaterView, window: ImageRect, eta: Array) -> None:
        """Darken the floor and walls of a rectangle below the body at eta, in place. Blocks are fine enough, as a
        shadow's edge is wider than one."""
        lines, depth_m = scene.view.blocks[window.blocks], scene.block_z[window.blocks]
        light = np.empty(depth_m.shape, np.float32)
        kernels.shadow(lines.planes, depth_m, eta[0], eta[1], eta[2], self.radius_m, light)
        light = np.ascontiguousarray(scene.view.spread(light, window))
        kernels.darken(raw, window.top, window.left, light)


def _plate(marker_id: int, side_m: float, px_per_m: float, family: MarkerFamily) -> tuple[Bytes, float]:
    """A marker plate's texture, and its texels per metre."""
    texels_per_m = plate_texels_per_m(side_m, family)
    return plate_texture(marker_id, LENS_SOFTNESS_PX * texels_per_m / px_per_m, family), texels_per_m


def attitude(yaw_rad: float, roll_rad: float = 0.0, pitch_rad: float = 0.0) -> Array:
    """Rotation from body to pool, (3, 3): Rz(yaw) Ry(pitch) Rx(roll)."""
    (cy, cp, cr), (sy, sp, sr) = np.cos([yaw_rad, pitch_rad, roll_rad]), np.sin([yaw_rad, pitch_rad, roll_rad])
    return np.array([
        [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
        [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
        [-sp, cp * sr, cp * cr],
    ])  # fmt: skip


def exposure_poses(eta: Array, nu: Array, exposure_s: float, reach_m: float, px_per_m: float) -> Array:
    """Poses (k, 4) whose mean picture stands for the exposure around eta: evenly spaced, symmetric in time."""
    surge, sway, _, yaw_rate = nu
    moved_px = (np.hypot(surge, sway) + abs(yaw_rate) * reach_m) * exposure_s * px_per_m
    count = int(min(max(np.ceil(moved_px / BLUR_STEP_PX), 1), MAX_PARTS))
    return np.asarray(eta + pool_velocity(eta, nu) * exposure_s * ((np.arange(count)[:, None] + 0.5) / count - 0.5))


def pool_velocity(eta: Array, nu: Array) -> Array:
    """d eta / dt (4,) of a body at eta with velocity nu (4,) in its own axes."""
    surge, sway, heave, yaw_rate = nu
    cos, sin = np.cos(eta[3]), np.sin(eta[3])
    return np.array([cos * surge - sin * sway, sin * surge + cos * sway, heave, yaw_rate])


def shadow_box(eta: Array, floor_m: float, radius_m: float) -> Array:
    """Corners (4, 3) of a square on the floor that holds a robot's shadow."""
    below = max(floor_m - eta[2], 0.02)
    centre = eta[:2] - below * np.array([LAMP_X, LAMP_Y]) / LAMP_UP
    reach = radius_m + PENUMBRA * below
    return np.array([[centre[0] + i * reach, centre[1] + j * reach, floor_m] for i in (-1, 1) for j in (-1, 1)])
