"""The pool without robots and under still water: what each pixel's line of sight ends on, and what colour it has there."""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from sim_bridge.camera.rays import Lines
from sim_bridge.camera.textures import TILE_M, Bytes, Float, grain, texels_per_tile, tiles
from wire.config.experiment import Experiment
from wire.config.scene import PoolConfig

# Per metre of water, blue, green, red: clear tap water swallows red first (Pope and Fry 1997: 0.01, 0.06, 0.34 at 450, 550,
# 650 nm); a little more everywhere for what floats in it. Then what the water itself sends back.
ABSORPTION_PER_M = np.array([0.06, 0.08, 0.30], np.float32)
VEIL = np.array([168.0, 142.0, 62.0], np.float32)
SCATTERING_PER_M = np.float32(0.11)
FLOOR, WALL, BAND, DECK = (170.0, 167.0, 152.0), (172.0, 169.0, 155.0), (140.0, 86.0, 36.0), (136.0, 143.0, 147.0)
BAND_M = 0.125  # one row of dark tiles at the waterline
COPING_M = 0.12  # pale stone around the basin
MARK_RADIUS_M = 0.09
MARK = np.array([26.0, 22.0, 226.0], np.float32)
MOSAIC = np.array([[2, 1], [1, 0]])  # which of blue, green, red a pixel of a raw picture sees


def water_colour(path_m: float) -> tuple[Float, Float]:
    """What `path_m` of water does to a colour (BGR): the share it lets through, and what it adds, 0 to 255."""
    return np.exp(-ABSORPTION_PER_M * np.float32(path_m)), VEIL * (1.0 - np.exp(-SCATTERING_PER_M * np.float32(path_m)))


def through_water(raw: Float, path_m: float) -> Float:
    """A mosaic seen through water, changed in place: each colour's share gets through, and the water adds its own."""
    water = np.array(water_colour(path_m))[:, MOSAIC]  # share and veil, of even and odd rows, in even and odd columns
    rows = np.empty((2, 2, raw.shape[1]), np.float32)
    rows[..., 0::2], rows[..., 1::2] = water[..., :1], water[..., 1:]
    for i, (share, veil) in enumerate(rows.swapaxes(0, 1)):
        raw[i::2] *= share
        raw[i::2] += veil
    return raw


@dataclass(frozen=True)
class Hit:
    """What lines of sight end on, planes of one shape: place in the pool and along the surface it is on."""

    x: Float
    y: Float
    z: Float
    on_x_wall: NDArray[np.bool_]
    on_y_wall: NDArray[np.bool_]
    on_deck: NDArray[np.bool_]


def trace(lines: Lines, pool: PoolConfig) -> Hit:
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
    return Hit(x, y, z, wet_wall & (z_x <= z_y), wet_wall & (z_y < z_x), deck)


def still_scene(experiment: Experiment, hit: Hit, lean: Float, softness: float, random: np.random.Generator) -> Bytes:
    """The scene under flat water without caustics and glare, BGR, in the shape of the planes of `hit`. `lean` is how much
    longer than straight up the way to the camera is, `softness` the lens's blur in elements of the planes."""
    length, width, depth = experiment.pool.size_m
    texel = 1.0 / experiment.camera.px_per_m
    grid = TILE_M / texels_per_tile(texel)

    def look(texture: Bytes, along: Float, down: Float) -> Float:
        x, y = (along / np.float32(grid) - np.float32(0.5), down / np.float32(grid) - np.float32(0.5))
        return np.asarray(cv2.remap(texture, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_WRAP), dtype=np.float32)

    half_x, half_y = np.float32(length / 2.0), np.float32(width / 2.0)
    image = look(tiles((length, width), texel, FLOOR, random), hit.x + half_x, hit.y + half_y)
    near_wall = np.minimum(half_x - np.abs(hit.x), half_y - np.abs(hit.y))
    image *= (1.0 - 0.25 * np.exp(-np.maximum(near_wall, 0.0) / np.float32(0.12)))[..., None]
    _draw_mark(image, hit, texel)
    for mask, along in ((hit.on_x_wall, hit.y + half_y), (hit.on_y_wall, hit.x + half_x)):
        side = look(tiles((max(length, width), depth), texel, WALL, random), along, hit.z)
        dark = look(tiles((max(length, width), BAND_M), texel, BAND, random), along, hit.z)
        side = np.where((hit.z < BAND_M)[..., None], dark, side)
        side *= (0.86 - 0.22 * np.exp((hit.z - np.float32(depth)) / np.float32(0.15)))[..., None]
        image[mask] = side[mask]
    path = hit.z * (1.0 + lean)
    image *= np.exp(-path[..., None] * ABSORPTION_PER_M)
    image += VEIL * (1.0 - np.exp(-SCATTERING_PER_M * path))[..., None]
    image[hit.on_deck] = _deck(hit, half_x, half_y, random)
    image = np.asarray(cv2.GaussianBlur(image, (0, 0), softness), dtype=np.float32)
    return np.clip(np.rint(image), 0, 255).astype(np.uint8)


def _draw_mark(image: Float, hit: Hit, texel_m: float) -> None:
    """The circular red mark below the origin (article, section 5.2), a little worn at its rim."""
    inside = np.clip((MARK_RADIUS_M - np.hypot(hit.x, hit.y)) / (2.0 * texel_m) + 0.5, 0.0, 1.0)
    inside *= 0.93 * (hit.z > 0)
    image *= 1.0 - inside[..., None]
    image += inside[..., None] * MARK


def _deck(hit: Hit, half_x: np.float32, half_y: np.float32, random: np.random.Generator) -> Float:
    """Concrete around the basin with a pale coping, for the pixels on deck."""
    outside = np.maximum(np.abs(hit.x) - half_x, np.abs(hit.y) - half_y)[hit.on_deck]
    rough = 1.0 + grain(hit.x.shape[0], hit.x.shape[1], ((1.5, 0.03), (9.0, 0.03), (90.0, 0.05)), random)[hit.on_deck]
    stone = np.where(outside < COPING_M, np.float32(1.25), np.float32(0.85)) * rough
    stone *= 1.0 - 0.5 * np.exp(-(((outside - COPING_M) / 0.006) ** 2))  # the joint
    return np.asarray(stone[:, None] * np.array(DECK), dtype=np.float32)
