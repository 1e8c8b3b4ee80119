"""Backgrounds without robots for a camera under a hovering drone.

The basin is drawn once as a plan with its walls unfolded outwards. For each picture the lines of sight of all blocks are
traced through the wavy surface to the plan, and the pixels between blocks interpolated. Refraction and ripples are exact
at the blocks and to 0.1 px between them; only edges between floor, walls and deck are soft within a block.
"""

from collections.abc import Sequence

import cv2
import numpy as np

from shoal.config.experiment import Experiment
from shoal.config.perception import Camera
from shoal.config.scene import PoolConfig
from shoal.config.simulation import CameraMotion
from shoal.frames import Array
from sim_bridge.camera.kernels import BLOCK
from sim_bridge.camera.optics import Bytes, Float
from sim_bridge.camera.rays import BAYER, CameraRays
from sim_bridge.camera.scene import SurfacePoints, WaterView, draw_still_pool, plan_coordinates, trace_to_surfaces, vignette
from sim_bridge.camera.textures import LENS_SOFTNESS_PX
from sim_bridge.camera.water_optics import WaterLight

SWINGS = 3  # sines per axis; with three no instant repeats within minutes
DECK_M = 0.8  # m of deck around the basin that is drawn; farther out its edge is repeated
TEXELS_PER_PX = 0.8  # resolution of the plan over that of a pixel at the surface; on the floor a pixel is as large as a texel
LEAN = np.float32(1.03)  # length of a line of sight in water over the depth, on average over a picture


class CameraSway:
    """Smooth motion about a camera's pose: sways along all three axes, and turns about them. Bounded and repeatable."""

    def __init__(self, camera: Camera, motion: CameraMotion, random: np.random.Generator) -> None:
        self._camera = camera
        rates = 2.0 * np.pi / motion.period_s * np.array([1.0, 1.618, 2.618])
        self._rates = rates * random.uniform(0.9, 1.1, (6, SWINGS))
        self._phases = random.uniform(0.0, 2.0 * np.pi, (6, SWINGS))
        share = np.array([0.6, 0.27, 0.13])
        self._sizes = np.repeat([motion.sway_m, motion.tilt_rad], 3)[:, None] * share
        self._upright = np.asarray(cv2.Rodrigues(np.array(camera.rotation_rad))[0])

    def at(self, time_s: float) -> Camera:
        """The camera at a time."""
        away: Array = np.sum(self._sizes * np.sin(self._rates * time_s + self._phases), axis=1)
        turn = np.asarray(cv2.Rodrigues(away[3:])[0]) @ self._upright
        position, rotation = np.array(self._camera.position_m) + away[:3], np.asarray(cv2.Rodrigues(turn)[0]).ravel()
        return self._camera.model_copy(
            update={"position_m": tuple(position.tolist()), "rotation_rad": tuple(rotation.tolist())}
        )


class MovingBackground:
    """Backgrounds of a camera that moves."""

    def __init__(self, experiment: Experiment, motion: CameraSway, random: np.random.Generator) -> None:
        self._motion, self._pool = motion, experiment.pool
        self._view = CameraRays(experiment.camera)
        self._waters = WaterLight(experiment, random)
        self._vignette = np.ascontiguousarray(vignette(self._view, self._waters.picture.vignetting)[0::2, 0::2])
        # The still pool is drawn once, as a plan with walls and deck folded outwards; a frame takes its colours from there.
        px_m = 1.0 / experiment.camera.px_per_m
        self._texel_m = px_m / TEXELS_PER_PX
        length, width, depth = experiment.pool.size_m
        self._reach = np.array([length, width]) / 2.0 + depth + DECK_M
        columns, rows = (int(np.ceil(2.0 * reach / self._texel_m)) for reach in self._reach)
        plan_x, plan_y = np.meshgrid(self._metres(columns, 0), self._metres(rows, 1))
        hit = _unfolded(plan_x, plan_y, experiment.pool)
        softness = LENS_SOFTNESS_PX * px_m / self._texel_m
        still = draw_still_pool(experiment, hit, np.full_like(hit.z, LEAN), softness, random)
        self._planes = [np.ascontiguousarray(still[..., channel]) for channel in (2, 1, 0)]

    def prepare(self) -> None:
        """Draw the whole loop of caustics now, so that no frame waits for its part."""
        for phase in range(self._waters.caustic_clock.phases):
            self._waters.phase_pattern(phase)

    def at(self, time_s: float) -> tuple[WaterView, Bytes]:
        """The water's view at a time, and a new raw mosaic (height, width) of it."""
        view = self._view.moved(self._motion.at(time_s))
        scene = WaterView(self._waters, view, trace_to_surfaces(view.blocks, self._pool).z)
        slopes = scene.slopes(self._waters.ripple_clock.loop_s(time_s))
        hit = trace_to_surfaces(view.blocks.deflected(scene.bending * slopes[0], scene.bending * slopes[1]), self._pool)
        x, y = plan_coordinates(hit, self._pool)
        # Light on the surfaces, and glare of the water, one value for each 2 x 2 pixels
        caustic_column, caustic_row = (_halved(plane, view) for plane in self._waters.caustics.grid_coordinates(x, y))
        reach = _halved(self._waters.reach(hit.z), view)
        light = self._waters.light(caustic_column, caustic_row, reach, time_s) * self._vignette
        glare = np.rint(_halved(scene.glare(slopes), view)).astype(np.uint8)
        # The surfaces' colours: of the still pool, where each pixel's line of sight meets it
        half_x, half_y = self._reach.astype(np.float32)
        texel = np.float32(self._texel_m)
        column, row = (x + half_x) / texel - np.float32(0.5), (y + half_y) / texel - np.float32(0.5)

        column_slopes, row_slopes = np.gradient(column, BLOCK), np.gradient(row, BLOCK)  # down and right, per pixel

        def at_pixel(plane: Float, slopes: Sequence[Float], down: int, right: int) -> Float:
            """Values at one of the four pixels of each square."""
            by_down, by_right = slopes
            return _halved(plane + np.float32(down - 0.5) * by_down + np.float32(right - 0.5) * by_right, view)

        raw = np.empty((view.height, view.width), np.uint8)
        for down, right, channel in BAYER:
            columns = at_pixel(column, column_slopes, down, right)
            rows = at_pixel(row, row_slopes, down, right)
            colour = cv2.remap(self._planes[channel], columns, rows, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
            pixels = raw[down::2, right::2]  # of an odd picture's last square a part
            lit = cv2.add(cv2.multiply(colour, light, dtype=cv2.CV_8U), glare)
            pixels[:] = lit[: pixels.shape[0], : pixels.shape[1]]
        return scene, raw

    def _metres(self, count: int, axis: int) -> Float:
        return np.asarray((np.arange(count) + 0.5) * self._texel_m - self._reach[axis], dtype=np.float32)


def _unfolded(plan_x: Float, plan_y: Float, pool: PoolConfig) -> SurfacePoints:
    """The surface at each place of the plan: the inverse of `plan_coordinates`. In the corners between two walls, which no
    line of sight meets, it is the wall that is farther out."""
    length, width, depth_m = pool.size_m
    half_x, half_y, depth = np.float32(length / 2.0), np.float32(width / 2.0), np.float32(depth_m)
    out_x, out_y = np.abs(plan_x) - half_x, np.abs(plan_y) - half_y  # how far the plan lies beyond the floor's edges
    out = np.maximum(out_x, out_y)
    is_deck = out > depth  # beyond the walls, which are as wide in the plan as they are high
    is_wall = (out > 0) & ~is_deck

    def folded(plan: Float, half: np.float32, beyond: Float) -> Float:
        """A coordinate of the surface: that of the plan over the floor, the wall's, or beyond the wall."""
        behind_wall = np.where(is_deck, np.maximum(beyond - depth, 0.0), 0.0)
        return np.asarray(np.where(beyond > 0, np.copysign(half + behind_wall, plan), plan), dtype=np.float32)

    x, y = folded(plan_x, half_x, out_x), folded(plan_y, half_y, out_y)
    z = np.asarray(np.where(is_deck, np.float32(0.0), depth - np.maximum(out, 0.0)), dtype=np.float32)
    return SurfacePoints(x, y, z, is_wall & (out_x >= out_y), is_wall & (out_y > out_x), is_deck)


def _halved(blocks: Float, view: CameraRays) -> Float:
    """Interpolate values at the middles of all blocks to the middles of all 2 x 2 pixels."""
    rows, columns = blocks.shape
    fine = cv2.resize(blocks, (columns * BLOCK // 2, rows * BLOCK // 2), interpolation=cv2.INTER_LINEAR)
    return np.ascontiguousarray(fine[: (view.height + 1) // 2, : (view.width + 1) // 2], dtype=np.float32)
