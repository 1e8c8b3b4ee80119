"""Robots, balls and landmarks: shaded spheres and plates, traced pixel by pixel through lens and water.

Each pixel's line of sight, interpolated between those of four blocks, is intersected with sphere and plate in closed form
(kernels.draw_body), so edges and texture lie where exact optics puts them, to a hundredth of a pixel. A ball is a sphere
without a plate; a landmark is a plate without a sphere.
"""

import copy
import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from shoal.config.experiment import Experiment
from shoal.config.perception import Landmark, MarkerFamily
from shoal.config.scene import RobotConfig
from shoal.frames import Array
from shoal.kernels.decorator import kernel
from shoal.kernels.types import Cube, Floats, Ints, Table
from sim_bridge.camera import kernels
from sim_bridge.camera.kernels import (
    BLOCK,
    LAMP_UP,
    LAMP_X,
    LAMP_Y,
    LANE_ROWS,
    LANES,
    PENUMBRA,
    Block,
    BodyLook,
    BodyPaint,
    BodyScratch,
    ImageRect,
)
from sim_bridge.camera.optics import Bytes, Optics
from sim_bridge.camera.scene import WaterView, water_colour
from sim_bridge.camera.textures import HULL_PX, LENS_SOFTNESS_PX, RED, hull_texture, plate_texels_per_m, plate_texture

BLUR_STEP_PX = 1.0  # px that a body may move between two parts of an exposure; the lens's blur hides that much
MAX_PARTS = 8  # of an exposure
PROBE_M = 0.02  # m over which the local scale is measured
PROBES_M = PROBE_M * np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
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
        """Put a picture of a marker, (texels, texels, 2), on the body's top."""
        layers = np.ascontiguousarray(np.moveaxis(plate, -1, 0))  # brightness and coverage
        self._half_m = float(np.sqrt(0.5) * plate.shape[0] / texels_per_m)  # from its middle to a corner, margin included
        self._paint = BodyPaint(self.radius_m, self.height_m, self._skin, self._half_m > 0.0, layers, float(texels_per_m))
        self.shape_m = (self.radius_m, self.height_m, self._half_m)

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

    def draw(self, raw: Bytes, scene: WaterView, window: ImageRect, look: BodyLook, time_s: float) -> None:
        """Lay the body, as it looks, over a rectangle of the raw mosaic, in place."""
        fields = scene.fields(window, look.depth_m, time_s)
        scratch = BodyScratch(np.empty(fields.shape[::2]), np.zeros((LANE_ROWS, LANES)), np.empty((2, LANES), np.int32))
        kernels.draw_body(raw, window, fields, scene.shading, self._paint, look, scratch)

    def draw_shadow(self, raw: Bytes, scene: WaterView, window: ImageRect, eta: Array) -> None:
        """Darken the floor and walls of a rectangle below the body at eta, in place. Blocks are fine enough, as a
        shadow's edge is wider than one."""
        rows, columns = window.block_bottom - window.block_top, window.block_right - window.block_left
        kernels.draw_shadow(
            raw, window, scene.view.blocks, scene.block_z, eta, self.radius_m,
            np.empty((rows, columns)), np.empty((columns + 1) * BLOCK, np.float32),
        )  # fmt: skip


def _plate(marker_id: int, side_m: float, px_per_m: float, family: MarkerFamily) -> tuple[Bytes, float]:
    """A marker plate's texture, and its texels per metre."""
    texels_per_m = plate_texels_per_m(side_m, family)
    return plate_texture(marker_id, LENS_SOFTNESS_PX * texels_per_m / px_per_m, family), texels_per_m


class Bodies(NamedTuple):
    """Robots and balls, or landmarks, n of them, in the middle of an exposure."""

    sprites: Sequence[BodySprite]
    eta: Array  # (n, 4)
    nu: Array  # (n, 4)
    tilt: Array  # (n, 2), roll and pitch

    def later(self, seconds: Array) -> "Bodies":
        """Each of them so much later, (n,)."""
        cos, sin = np.cos(self.eta[:, 3]), np.sin(self.eta[:, 3])
        along, across = self.nu[:, 0], self.nu[:, 1]
        velocity = np.column_stack([cos * along - sin * across, sin * along + cos * across, self.nu[:, 2:]])
        return self._replace(eta=self.eta + seconds[:, None] * velocity)


def exposures(bodies: Bodies, optics: Optics, exposure_s: float, floor_m: float) -> tuple[list[BodyLook], Array, Array]:
    """The looks of n bodies in an exposure, corners (n, 16, 3) of boxes that hold them, and corners (n, 4, 3) of squares on
    the floor that hold their shadows."""
    n = len(bodies.sprites)
    probes = optics.see(bodies.eta[:, None, :3] + PROBES_M)
    shapes = np.array([sprite.shape_m for sprite in bodies.sprites])
    shutter = ExposureTables(
        np.empty(n, np.int64), np.empty(n), np.zeros((n, MAX_PARTS, 4)), np.zeros((n, MAX_PARTS, 3, 3)),
        np.zeros((n, MAX_PARTS, 2)), np.empty((n, 16, 3)), np.empty((n, 4, 3)),
    )  # fmt: skip
    motion = BodyMotions(*map(np.ascontiguousarray, (bodies.eta, bodies.nu, bodies.tilt, shapes)))
    expose(motion, probes.pixels.reshape(n, 3, 2), exposure_s, floor_m, shutter)
    parts, px_per_m, poses, attitudes, depths, boxes, shadows = shutter
    water = np.stack(water_colour(2.0 * depths), axis=3).astype(np.float64)  # from a lamp down and up to the camera
    numbers = zip(parts.tolist(), bodies.eta[:, 2].tolist(), px_per_m.tolist(), probes.path_m[::3].tolist(), strict=True)
    looks = [BodyLook(poses[i, :k], attitudes[i, :k], water[i, :k], *rest) for i, (k, *rest) in enumerate(numbers)]
    return looks, boxes, shadows


class BodyMotions(NamedTuple):
    """Motions and shapes of n bodies, in the middle of an exposure."""

    eta: Table  # (n, 4)
    nu: Table  # (n, 4) on level axes
    tilt: Table  # (n, 2) roll and pitch
    shapes: Table  # (n, 3) radius of the sphere, height of the plate above its centre, and reach from the plate's middle


class ExposureTables(NamedTuple):
    """The numbers of `exposures`, of n bodies in MAX_PARTS poses."""

    parts: Ints  # (n,) poses that are used: so many that a body moves by BLUR_STEP_PX at most from one to the next
    px_per_m: Floats
    poses: Cube  # (n, MAX_PARTS, 4)
    attitudes: Block  # (n, MAX_PARTS, 3, 3)
    depths: Cube  # (n, MAX_PARTS, 2) of what is seen of sphere and plate
    boxes: Cube  # (n, 16, 3)
    shadows: Cube  # (n, 4, 3)


@kernel
def expose(motions: BodyMotions, probes_px: Cube, exposure_s: float, floor_m: float, tables: ExposureTables) -> None:
    """Fill the tables with what a camera sees of each body during an exposure. `probes_px` (n, 3, 2) are the pixels of each
    body's centre and of points PROBE_M beside it along x and y."""
    eta, nu, tilt, shapes = motions
    parts, px_per_m, poses, attitudes, depths, boxes, shadows = tables
    for i in range(len(eta)):
        radius, height, half = shapes[i, 0], shapes[i, 1], shapes[i, 2]
        # How large it appears, and in how many poses it has to be drawn
        right = math.hypot(probes_px[i, 1, 0] - probes_px[i, 0, 0], probes_px[i, 1, 1] - probes_px[i, 0, 1])
        down = math.hypot(probes_px[i, 2, 0] - probes_px[i, 0, 0], probes_px[i, 2, 1] - probes_px[i, 0, 1])
        px_per_m[i] = 0.0 if math.isnan(right + down) else 0.5 * (right + down) / PROBE_M
        surge, sway, heave, yaw_rate = nu[i, 0], nu[i, 1], nu[i, 2], nu[i, 3]
        moved_px = (math.hypot(surge, sway) + abs(yaw_rate) * radius) * exposure_s * px_per_m[i]
        k = int(min(max(math.ceil(moved_px / BLUR_STEP_PX), 1), MAX_PARTS))
        parts[i] = k
        cos, sin = math.cos(eta[i, 3]), math.sin(eta[i, 3])
        cr, sr, cp, sp = math.cos(tilt[i, 0]), math.sin(tilt[i, 0]), math.cos(tilt[i, 1]), math.sin(tilt[i, 1])
        for part in range(k):  # the pose at the part's instant, its attitude, and how deep its sphere and plate are
            later_s = exposure_s * ((part + 0.5) / k - 0.5)
            pose, turn = poses[i, part], attitudes[i, part]
            pose[0] = eta[i, 0] + later_s * (cos * surge - sin * sway)
            pose[1] = eta[i, 1] + later_s * (sin * surge + cos * sway)
            pose[2] = eta[i, 2] + later_s * heave
            pose[3] = eta[i, 3] + later_s * yaw_rate
            cy, sy = math.cos(pose[3]), math.sin(pose[3])
            turn[0, 0], turn[0, 1], turn[0, 2] = cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr
            turn[1, 0], turn[1, 1], turn[1, 2] = sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr
            turn[2, 0], turn[2, 1], turn[2, 2] = -sp, cp * sr, cp * cr
            depths[i, part, 0] = max(pose[2] - 0.7 * radius, 0.0)
            depths[i, part, 1] = max(pose[2] - height * cp * cr, 0.0)
        # A box around it in its first and last pose, and the corners of the floor that its shadow can reach
        lean = abs(math.sin(math.hypot(tilt[i, 0], tilt[i, 1])))
        reach = max(radius, half + lean * height)
        rise = max(radius, height + lean * half)
        for corner in range(16):
            place, box = poses[i, 0 if corner < 8 else k - 1], boxes[i, corner]
            box[0] = place[0] + (reach if corner & 1 else -reach)
            box[1] = place[1] + (reach if corner & 2 else -reach)
            box[2] = place[2] + (radius if corner & 4 else -rise)
        below = max(floor_m - eta[i, 2], 0.02)
        reach = radius + PENUMBRA * below
        for corner in range(4):
            shadows[i, corner, 0] = eta[i, 0] - below * (LAMP_X / LAMP_UP) + (reach if corner & 1 else -reach)
            shadows[i, corner, 1] = eta[i, 1] - below * (LAMP_Y / LAMP_UP) + (reach if corner & 2 else -reach)
            shadows[i, corner, 2] = floor_m
