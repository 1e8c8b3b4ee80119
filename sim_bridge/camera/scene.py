"""The pool without robots: the surfaces that lines of sight meet and their colours under still water, and the water's
light over them in one picture."""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from shoal.config.experiment import Experiment
from shoal.config.scene import PoolConfig
from shoal.frames import Array
from sim_bridge.camera.kernels import FIELDS, ImageRect, RayBundle, Shading
from sim_bridge.camera.optics import Bytes, Float
from sim_bridge.camera.rays import CameraRays
from sim_bridge.camera.textures import TILE_M, grain, texels_per_tile, tile_texture
from sim_bridge.camera.water_optics import LAMPS_M, BlockView, BlockWaves, WaterLight, block_fields, glare

# Absorption per metre of water: blue, green, red. Clear water absorbs red first (Pope and Fry 1997: 0.01, 0.06, 0.34 at 450,
# 550, 650 nm); a little is added for floating particles. Then colour and rate of the light that the water scatters back.
ABSORPTION_PER_M = np.array([0.06, 0.08, 0.30], np.float32)
VEIL = np.array([168.0, 142.0, 62.0], np.float32)
SCATTERING_PER_M = np.float32(0.11)
FLOOR, WALL, BAND, DECK = (170.0, 167.0, 152.0), (172.0, 169.0, 155.0), (140.0, 86.0, 36.0), (136.0, 143.0, 147.0)
BAND_M = 0.125  # one row of dark tiles at the waterline
COPING_M = 0.12  # pale stone around the basin
MARK_RADIUS_M = 0.09
MARK = np.array([26.0, 22.0, 226.0], np.float32)


def water_colour(path_m: ArrayLike) -> tuple[Float, Float]:
    """Effect of paths (...) through water on a colour, (..., 3) BGR: the share that passes, and the scattered light that is
    added, 0 to 255."""
    path = np.asarray(path_m, dtype=np.float32)[..., None]
    return np.exp(-ABSORPTION_PER_M * path), VEIL * (1.0 - np.exp(-SCATTERING_PER_M * path))


@dataclass(frozen=True)
class SurfacePoints:
    """Ends of lines of sight, planes of one shape: their place in the pool and the surface that they lie on."""

    x: Float
    y: Float
    z: Float
    on_x_wall: NDArray[np.bool_]
    on_y_wall: NDArray[np.bool_]
    on_deck: NDArray[np.bool_]


def trace_to_surfaces(lines: RayBundle, pool: PoolConfig) -> SurfacePoints:
    """Follow each line to floor, wall or, outside the basin, to the deck at z = 0."""
    half_x, half_y, depth = pool.size_m[0] / 2.0, pool.size_m[1] / 2.0, pool.size_m[2]
    deck = (np.abs(lines.surface_x) > half_x) | (np.abs(lines.surface_y) > half_y)

    def wall(surface: Float, slope: Float, half: float) -> Float:
        safe = np.where(np.abs(slope) < 1e-6, np.float32(1e-6), slope)
        return np.asarray((np.copysign(np.float32(half), safe) - surface) / safe, dtype=np.float32)

    z_x, z_y = wall(lines.surface_x, lines.water_x, half_x), wall(lines.surface_y, lines.water_y, half_y)
    z = np.where(deck, np.float32(0.0), np.minimum(np.minimum(z_x, z_y), np.float32(depth)))
    x = np.asarray(lines.surface_x + z * lines.water_x, dtype=np.float32)
    y = np.asarray(lines.surface_y + z * lines.water_y, dtype=np.float32)
    wet_wall = ~deck & (z < depth)
    return SurfacePoints(x, y, z, wet_wall & (z_x <= z_y), wet_wall & (z_y < z_x), deck)


def draw_still_pool(
    experiment: Experiment, hit: SurfacePoints, lean: Float, softness: float, random: np.random.Generator
) -> Bytes:
    """The pool under flat water without caustics and glare, BGR, in the shape of the planes of `hit`.

    `lean` is the length of the way to the camera in water over the depth, `softness` the lens's blur in elements of the
    planes.
    """
    length, width, depth = experiment.pool.size_m
    texel = 1.0 / experiment.camera.px_per_m
    texture_px_m = TILE_M / texels_per_tile(texel)

    def sample(texture: Bytes, along: Float, down: Float) -> Float:
        """The colours of a texture at places in m."""
        x = along / np.float32(texture_px_m) - np.float32(0.5)
        y = down / np.float32(texture_px_m) - np.float32(0.5)
        return np.asarray(cv2.remap(texture, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_WRAP), dtype=np.float32)

    # The floor, darker beside the walls, with its mark
    half_x, half_y = np.float32(length / 2.0), np.float32(width / 2.0)
    image = sample(tile_texture((length, width), texel, FLOOR, random), hit.x + half_x, hit.y + half_y)
    from_wall_m = np.maximum(np.minimum(half_x - np.abs(hit.x), half_y - np.abs(hit.y)), 0.0)
    image *= (1.0 - 0.25 * np.exp(-from_wall_m / np.float32(0.12)))[..., None]
    _draw_mark(image, hit, texel)
    # The walls, with a dark band at the waterline, darker above the floor
    longest = max(length, width)
    for mask, along in ((hit.on_x_wall, hit.y + half_y), (hit.on_y_wall, hit.x + half_x)):
        tiles = sample(tile_texture((longest, depth), texel, WALL, random), along, hit.z)
        band = sample(tile_texture((longest, BAND_M), texel, BAND, random), along, hit.z)
        wall = np.where((hit.z < BAND_M)[..., None], band, tiles)
        wall *= (0.86 - 0.22 * np.exp((hit.z - np.float32(depth)) / np.float32(0.15)))[..., None]
        image[mask] = wall[mask]
    # The water between them and the camera absorbs, and scatters light into the picture
    way_m = hit.z * (1.0 + lean)
    image *= np.exp(-way_m[..., None] * ABSORPTION_PER_M)
    image += VEIL * (1.0 - np.exp(-SCATTERING_PER_M * way_m))[..., None]
    image[hit.on_deck] = _deck(hit, half_x, half_y, random)
    image = np.asarray(cv2.GaussianBlur(image, (0, 0), softness), dtype=np.float32)
    return np.clip(np.rint(image), 0, 255).astype(np.uint8)


def _draw_mark(image: Float, hit: SurfacePoints, texel_m: float) -> None:
    """Draw the circular red mark below the origin (article, section 5.2), a little worn at its rim."""
    inside = np.clip((MARK_RADIUS_M - np.hypot(hit.x, hit.y)) / (2.0 * texel_m) + 0.5, 0.0, 1.0)
    inside *= 0.93 * (hit.z > 0)
    image *= 1.0 - inside[..., None]
    image += inside[..., None] * MARK


def _deck(hit: SurfacePoints, half_x: np.float32, half_y: np.float32, random: np.random.Generator) -> Float:
    """Concrete around the basin with a pale coping, for the pixels on deck."""
    outside = np.maximum(np.abs(hit.x) - half_x, np.abs(hit.y) - half_y)[hit.on_deck]
    rough = 1.0 + grain(hit.x.shape[0], hit.x.shape[1], ((1.5, 0.03), (9.0, 0.03), (90.0, 0.05)), random)[hit.on_deck]
    stone = np.where(outside < COPING_M, np.float32(1.25), np.float32(0.85)) * rough
    stone *= 1.0 - 0.5 * np.exp(-(((outside - COPING_M) / 0.006) ** 2))  # the joint
    return np.asarray(stone[:, None] * np.array(DECK), dtype=np.float32)


class WaterView:
    """The water's light from one point of view. `block_z` (block rows, columns) is the depth of floor, wall or deck."""

    def __init__(self, waters: WaterLight, view: CameraRays, block_z: Float) -> None:
        self.waters, self.view, self.block_z = waters, view, block_z
        self.shading = shading_of(view, waters.picture.vignetting)
        self.depth_m, self.bending = waters.depth_m, np.float32(waters.ripples.bending)
        self._weights: tuple[float, Float] | None = None  # of the ripples, at the last time that was asked for
        shape = view.blocks.surface_x.shape
        self._basis = waters.ripples.basis(view.blocks.surface_x, view.blocks.surface_y).reshape(-1, *shape)
        self._at_blocks = BlockView(
            view.blocks, self._basis, waters.caustics.half_m, np.array(view.camera.position_m), np.array(LAMPS_M),
            255.0 * waters.picture.glare, float(self.bending),
        )  # fmt: skip

    def slopes(self, loop_s: float) -> Float:
        """Slopes of the surface at all blocks, (2, block rows, block columns), at a time of the ripples' loop."""
        basis = self._basis.reshape(len(self._basis), -1)
        return self.waters.ripples.slopes(basis, loop_s).reshape(2, *self._basis.shape[1:])

    def glare(self, slopes: Float) -> Float:
        """Grey levels that mirrored lamps add at all blocks."""
        lines = self.view.blocks
        levels = glare(lines.surface_x, lines.surface_y, slopes, self.view.camera)
        return levels * np.float32(255.0 * self.waters.picture.glare)

    def fields(self, window: ImageRect, depth_m: float, time_s: float) -> Array:
        """Fields (FIELDS, block rows, block columns) of water_optics.block_fields at the rectangle's blocks, with the light at
        a depth."""
        waters = self.waters
        if self._weights is None or self._weights[0] != time_s:
            weights = waters.ripples.weights(waters.ripple_clock.loop_s(time_s))
            self._weights = time_s, np.ascontiguousarray(weights)
        reach = waters.picture.caustics * min(max(depth_m / self.depth_m, 0.0), 1.0)
        fields = np.empty((FIELDS, window.block_bottom - window.block_top, window.block_right - window.block_left))
        now = BlockWaves(self._weights[1], waters.patterns(time_s), waters.wave.at(time_s))
        block_fields(window, self._at_blocks, now, depth_m, reach, fields)
        return fields


def shading_of(view: CameraRays, strength: float) -> Shading:
    """The darkening by which the picture's farthest corner loses a share of its light."""
    centre_x, centre_y = view.camera.centre_px
    far_x, far_y = max(centre_x, view.width - 1 - centre_x), max(centre_y, view.height - 1 - centre_y)
    return Shading(centre_x, centre_y, strength / (far_x**2 + far_y**2))


def vignette(view: CameraRays, strength: float) -> Float:
    """Share of its light that each pixel gets, (height, width)."""
    centre_x, centre_y, dimming = shading_of(view, strength)
    column, row = (np.arange(view.width) - centre_x) ** 2, (np.arange(view.height) - centre_y) ** 2
    return np.asarray(1.0 - dimming * (column[None, :] + row[:, None]), dtype=np.float32)


def plan_coordinates(hit: SurfacePoints, pool: PoolConfig) -> tuple[Float, Float]:
    """Places on the plan of the basin: walls are unfolded outwards, and the deck follows at their upper edge."""
    half_x, half_y, depth = pool.size_m[0] / 2.0, pool.size_m[1] / 2.0, np.float32(pool.size_m[2])
    down = depth - hit.z
    out_x = hit.on_x_wall | (hit.on_deck & (np.abs(hit.x) > half_x))
    out_y = hit.on_y_wall | (hit.on_deck & (np.abs(hit.y) > half_y))
    x = hit.x + np.where(out_x, np.copysign(down, hit.x), np.float32(0.0))
    y = hit.y + np.where(out_y, np.copysign(down, hit.y), np.float32(0.0))
    return x, y
