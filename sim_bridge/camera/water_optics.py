"""The water's surface and light: ripples that bend every line of sight, caustics, and lamps mirrored at the surface.

Ripples and caustics are loops, so that backgrounds can be drawn once. Each is run through by a clock of its own whose rate
wanders, so that the water never repeats. All fields are functions of position and time alone.
"""

import math
from typing import NamedTuple

import cv2
import numpy as np

from shoal.config.experiment import Experiment
from shoal.config.perception import Camera
from shoal.config.scene import PoolConfig
from shoal.config.simulation import PictureConfig
from shoal.frames import Array
from shoal.kernels.decorator import kernel
from shoal.kernels.types import Cube, Floats, Table
from sim_bridge.camera.kernels import (
    AIR_X,
    AIR_Y,
    GLARE,
    LIGHT,
    SURFACE_X,
    SURFACE_Y,
    WATER_X,
    WATER_Y,
    Blocks,
    ImageRect,
    Line,
    Picture,
    Plane,
    RayBundle,
)
from sim_bridge.camera.optics import Bytes, Float
from sim_bridge.plant.currents_waves import SurfaceWave

RIPPLE_LOOP_S, CAUSTIC_LOOP_S = 2.4, 3.0  # s; longer than the slowest wave's period
PHASE_S = 0.05  # s between the pictures of a loop
# The clocks' rates wander by three sines each: periods that share no multiple, and the largest parts of the rate.
WANDER_PERIODS_S = ((19.0, 31.0, 47.0), (17.0, 29.0, 53.0))
WANDER_RATES = (0.06, 0.05, 0.04)
GRAVITY_MPS2 = 9.81
RIPPLE_WAVES = 7
RIPPLE_LENGTH_M = (0.18, 0.60)  # m, wavelengths that fans, pumps and robots cause in a small indoor basin
CAUSTIC_WAVES = 14
CAUSTIC_LENGTH_M = (0.14, 0.42)
CAUSTIC_SLOPE = 0.09  # RMS slope of the waves that focus the light, at a depth of about one metre
CAUSTIC_GRID_M = 0.01
CAUSTIC_PLAN_M = 4.0  # m; a larger basin repeats the pattern, mirrored
CAUSTIC_BRIGHTEST = 4.0  # times the mean light; a lamp is no point source, so foci stay finite
LAMP_HEIGHT_M = 4.0  # above the water
# Fluorescent tubes on the ceiling: centre x, y and half length, half width, m. Mirrored they lie near the basin's ends.
LAMPS_M = ((-3.1, -1.9, 0.85, 0.07), (2.6, -2.3, 0.85, 0.07), (3.3, 1.7, 0.85, 0.07))
_LAMPS_M = np.array(LAMPS_M, np.float32).T[..., None, None]  # each value a plane for all lamps: (4, lamps, 1, 1)
LAMP_EDGE_M = 0.12
CAUSTIC_UNIT = 50.0  # grey levels per mean light in the stored patterns


class LoopClock:
    """The place in a loop of pictures at any time. Its rate stays within 15 % of 1."""

    def __init__(self, loop_s: float, periods_s: tuple[float, ...], moving: bool, random: np.random.Generator) -> None:
        self.phases = round(loop_s / PHASE_S) if moving else 1
        self._rates = 2.0 * np.pi / np.array(periods_s)
        self._sizes = np.array(WANDER_RATES) / self._rates
        self._starts = random.uniform(0.0, 2.0 * np.pi, len(periods_s))

    def loop_s(self, time_s: float) -> float:
        """The loop's own time."""
        return time_s + float(self._sizes @ np.sin(self._rates * time_s + self._starts))

    def phase(self, time_s: float) -> tuple[int, int, float]:
        """The two pictures of the loop between which a time lies, and the second one's share."""
        place = self.loop_s(time_s) / PHASE_S
        first = math.floor(place)
        return first % self.phases, (first + 1) % self.phases, place - first


class PlaneWaves:
    """A sum of plane waves with deep-water dispersion, their periods fitted into a loop."""

    def __init__(self, count: int, length_m: tuple[float, float], loop_s: float, random: np.random.Generator) -> None:
        length = np.geomspace(*length_m, count) * random.uniform(0.9, 1.1, count)
        heading = 2.0 * np.pi * (np.arange(count) * 0.382 + random.uniform(-0.05, 0.05, count))  # golden angle: no pattern
        number = 2.0 * np.pi / length
        self.number = number[:, None] * np.column_stack([np.cos(heading), np.sin(heading)])  # (count, 2) rad/m
        cycles = np.maximum(np.round(np.sqrt(GRAVITY_MPS2 * number) * loop_s / (2.0 * np.pi)), 1.0)
        self.frequency = 2.0 * np.pi * cycles / loop_s
        self.phase = random.uniform(0.0, 2.0 * np.pi, count)

    def slope_basis(self, x_m: Float, y_m: Float) -> Float:
        """cos and sin of every wave's k.x + phase, (2 count, n); any field of the waves is a small matrix times this."""
        angle = self.number.astype(np.float32) @ np.stack([x_m.ravel(), y_m.ravel()]) + self.phase[:, None].astype(np.float32)
        return np.concatenate([np.cos(angle), np.sin(angle)])

    def gradient_weights(self, time_s: float, amplitude: Array) -> Float:
        """Weights (2, 2 count) of the basis in d/dx and d/dy of sum_i amplitude_i cos(k_i.x + phase_i - w_i t)."""
        c, s = np.cos(self.frequency * time_s), np.sin(self.frequency * time_s)
        weight = -(amplitude * self.number.T)  # of sin(a - wt) = sin(a) cos(wt) - cos(a) sin(wt)
        return np.concatenate([-weight * s, weight * c], axis=1).astype(np.float32)

    def gradient(self, basis: Float, time_s: float, amplitude: Array) -> Float:
        """d/dx and d/dy, (2, n), from the basis at n points."""
        return self.gradient_weights(time_s, amplitude) @ basis


class Ripples:
    """Slopes of the surface. `ripples_m` is the significant height: four standard deviations of the elevation."""

    def __init__(self, picture: PictureConfig, camera: Camera, random: np.random.Generator) -> None:
        self._waves = PlaneWaves(RIPPLE_WAVES, RIPPLE_LENGTH_M, RIPPLE_LOOP_S, random)
        length = 1.0 / np.linalg.norm(self._waves.number, axis=1)
        share = length / np.linalg.norm(length)  # elevation falls with wave number: slopes are equal
        self._amplitude = np.sqrt(2.0) * picture.ripples_m / 4.0 * share
        self.bending = 1.0 - 1.0 / camera.water_index  # turn of the ray below the surface over the slope, near the vertical

    def basis(self, x_m: Float, y_m: Float) -> Float:
        """Basis of `slopes` at some points, independent of time."""
        return self._waves.slope_basis(x_m, y_m)

    def slopes(self, basis: Float, time_s: float) -> Float:
        """Slope of the surface (d height / dx, d height / dy), (2, n)."""
        return self._waves.gradient(basis, time_s, self._amplitude)

    def weights(self, time_s: float) -> Float:
        """Weights (2, waves) of the basis in the slopes."""
        return self._waves.gradient_weights(time_s, self._amplitude)


class Caustics:
    """Light on the floor: a regular bundle of rays sent down through a wavy surface and collected on a grid."""

    def __init__(self, pool: PoolConfig, random: np.random.Generator) -> None:
        """Draw the waves of a pool's surface, and lay the pattern's grid over its floor."""
        length_m, width_m, depth_m = pool.size_m
        self._waves = PlaneWaves(CAUSTIC_WAVES, CAUSTIC_LENGTH_M, CAUSTIC_LOOP_S, random)
        rad_per_m = np.linalg.norm(self._waves.number, axis=1)
        self._amplitude = CAUSTIC_SLOPE / rad_per_m * np.sqrt(2.0 / CAUSTIC_WAVES)  # all waves are as steep
        self._throw_m = 0.25 * depth_m  # a ray's shift on the floor by the surface's slope: 1 - 1/n of it, by Snell
        self._width, self._height = (round(min(size, CAUSTIC_PLAN_M) / CAUSTIC_GRID_M) + 1 for size in (length_m, width_m))
        column, row = np.meshgrid(np.arange(self._width, dtype=np.float32), np.arange(self._height, dtype=np.float32))
        self._column, self._row = column.ravel(), row.ravel()
        grid = np.float32(CAUSTIC_GRID_M)
        self._basis = self._waves.slope_basis(self._column * grid, self._row * grid)
        self.half_m = np.array([length_m, width_m]) / 2.0  # place of the pattern's first corner: minus this

    def pattern(self, time_s: float) -> Float:
        """Light over its mean on the pool's plan, (height, width), CAUSTIC_GRID_M apart, from 0 to CAUSTIC_BRIGHTEST."""
        shift = self._waves.gradient(self._basis, time_s, self._amplitude) * np.float32(self._throw_m / CAUSTIC_GRID_M)
        # The bundle is mirrored at the walls by folding, which keeps the light that leaves the grid.
        x = _fold(self._column + shift[0], self._width)
        y = _fold(self._row + shift[1], self._height)
        left, top = x.astype(np.intp), y.astype(np.intp)
        u, v = x - left, y - top
        corner = top * self._width + left
        light = np.zeros(self._width * self._height + self._width + 1)
        for step, weight in ((0, (1 - u) * (1 - v)), (1, u * (1 - v)), (self._width, (1 - u) * v), (self._width + 1, u * v)):
            light += np.bincount(corner + step, weight, light.size)
        grid = light[: self._width * self._height].reshape(self._height, self._width).astype(np.float32)
        return np.minimum(cv2.GaussianBlur(grid, (0, 0), 0.9), CAUSTIC_BRIGHTEST).astype(np.float32)

    def grid_coordinates(self, x_m: Float, y_m: Float) -> tuple[Float, Float]:
        """Column and row in `pattern` of places on the plan."""
        column = (x_m + self.half_m[0]) / CAUSTIC_GRID_M
        row = (y_m + self.half_m[1]) / CAUSTIC_GRID_M
        return column.astype(np.float32), row.astype(np.float32)


def _fold(value: Float, size: int) -> Float:
    """Mirror values into 0 .. size - 1, repeatedly: in a deep basin light wanders farther than the pattern is wide."""
    last, away = np.float32(size - 1.001), np.abs(value)
    if away.max() > 2 * last:
        away = np.mod(away, 2 * last)
    folded: Float = last - np.abs(last - away)
    return folded


@kernel(inline=True, part=True)
def mirror(value: float, size: int) -> float:
    """Mirror a value into 0 .. size - 1, repeatedly."""
    last = size - 1.0
    away = abs(value) % (2.0 * last)
    return last - abs(last - away)


@kernel(inline=True, part=True)
def grid_value(grid: Picture, left: int, top: int, u: float, v: float) -> float:
    """Bilinear value of a grid between four of its points, at the shares u and v of the way from (left, top)."""
    upper = (1.0 - u) * grid[top, left] + u * grid[top, left + 1]
    lower = (1.0 - u) * grid[top + 1, left] + u * grid[top + 1, left + 1]
    return float((1.0 - v) * upper + v * lower)


class Blend(NamedTuple):
    """Two pictures of a loop, and the second one's share in what lies between them."""

    first: Picture
    second: Picture
    share: float


class BlockView(NamedTuple):
    """The water's surface and light from one point of view: what does not change with time, at all blocks."""

    lines: RayBundle
    basis: Blocks  # of the ripples' slopes (PlaneWaves)
    half_m: Floats  # the caustics' pattern begins at minus this
    lens: Floats
    lamps_m: Table  # (lamps, 4) centre x, y, half length and half width
    glare_levels: float  # grey levels of a mirrored lamp
    bending: float  # Ripples.bending


class BlockWaves(NamedTuple):
    weights: Plane  # of the basis
    pattern: Blend  # of the caustics
    wave: Floats  # SurfaceWave.at


@kernel(part=True)
def meet_wave(wave: Floats, slope_x: float, slope_y: float, index: float, fields: Cube, a: int, b: int) -> None:
    """Change a block's line of sight, in `fields`, to that through a wave (SurfaceWave.at) with ripples of a slope on it.

    A wave is steep and high enough for lines that slant to need the whole of Snell's law, and the place where they meet the
    crest; for ripples the first order does. `index` is 1 over the water's. For unit vectors along the line and the normal:

        water = index line - (sqrt(1 - index^2 sin^2) - index cos) normal        cos: of the angle between -line and normal
    """
    air_x, air_y = fields[AIR_X, a, b], fields[AIR_Y, a, b]
    x, y, height_m, phase = fields[SURFACE_X, a, b], fields[SURFACE_Y, a, b], 0.0, 0.0
    for _ in range(3):  # each is better by the wave's slope times the line's
        phase = wave[1] * (x - height_m * air_x) + wave[2] * (y - height_m * air_y) - wave[3]
        height_m = wave[0] * math.cos(phase)
    slope_x -= wave[0] * wave[1] * math.sin(phase)
    slope_y -= wave[0] * wave[2] * math.sin(phase)
    line_length = math.sqrt(1.0 + air_x * air_x + air_y * air_y)  # of (air_x, air_y, 1)
    normal_length = math.sqrt(1.0 + slope_x * slope_x + slope_y * slope_y)
    cosine = (1.0 + air_x * slope_x + air_y * slope_y) / (line_length * normal_length)
    along_normal = math.sqrt(1.0 - index * index * (1.0 - cosine * cosine)) - index * cosine
    down = index / line_length + along_normal / normal_length
    water_x, water_y = (
        (index * air_x / line_length + along_normal * slope_x / normal_length) / down,
        (index * air_y / line_length + along_normal * slope_y / normal_length) / down,
    )
    fields[SURFACE_X, a, b], fields[SURFACE_Y, a, b] = x + height_m * (water_x - air_x), y + height_m * (water_y - air_y)
    fields[WATER_X, a, b], fields[WATER_Y, a, b] = water_x, water_y


@kernel(inline=True, part=True)
def caustic_level(pattern: Blend, x_m: float, y_m: float) -> float:
    """Level of the caustics, CAUSTIC_UNIT in the mean, at a place on the plan, measured from the pattern's corner."""
    rows, columns = pattern.first.shape
    column, row = mirror(x_m / CAUSTIC_GRID_M, columns), mirror(y_m / CAUSTIC_GRID_M, rows)
    left, top = min(int(column), columns - 2), min(int(row), rows - 2)
    u, v = column - left, row - top
    first = grid_value(pattern.first, left, top, u, v)
    return first + pattern.share * (grid_value(pattern.second, left, top, u, v) - first)


@kernel(inline=True, part=True)
def mirrored_lamps(lamps_m: Table, x_m: float, y_m: float) -> float:
    """Share of a lamp that a mirrored line of sight meets at a place of the ceiling; 0 to 1 for each lamp."""
    share = 0.0
    for k in range(len(lamps_m)):
        along = (lamps_m[k, 2] - abs(x_m - lamps_m[k, 0])) / (2.0 * LAMP_EDGE_M) + 0.5
        across = (lamps_m[k, 3] - abs(y_m - lamps_m[k, 1])) / (2.0 * LAMP_EDGE_M) + 0.5
        share += min(max(along, 0.0), 1.0) * min(max(across, 0.0), 1.0)
    return share


@kernel
def block_fields(rect: ImageRect, view: BlockView, now: BlockWaves, depth_m: float, reach: float, fields: Cube) -> None:
    """Fields (FIELDS, block rows, block columns) of a rectangle's blocks: their lines of sight, bent by ripples and the wave,
    the light at a depth where caustics have the strength `reach`, and the grey levels of mirrored lamps. The same as
    Ripples.slopes, WaterLight.light and `glare`, for a part of the picture."""
    _, _, _, _, block_top, _, block_left, _ = rect
    surface_x, surface_y, air_x, air_y, water_x, water_y = view.lines
    basis, half_m, lens, bending, weights = view.basis, view.half_m, view.lens, view.bending, now.weights
    to_ceiling = 1.0 - LAMP_HEIGHT_M / lens[2]  # of a line mirrored at a level surface: its way on, over that from the lens
    for a in range(fields.shape[1]):
        for b in range(fields.shape[2]):
            i, j = block_top + a, block_left + b
            slope_x, slope_y = 0.0, 0.0
            for k in range(len(basis)):
                slope_x += weights[0, k] * basis[k, i, j]
                slope_y += weights[1, k] * basis[k, i, j]
            x_m, y_m = surface_x[i, j], surface_y[i, j]
            level = caustic_level(
                now.pattern, x_m + depth_m * water_x[i, j] + half_m[0], y_m + depth_m * water_y[i, j] + half_m[1]
            )
            ceiling_x_m = lens[0] + (x_m - lens[0]) * to_ceiling - slope_x * (2.0 * LAMP_HEIGHT_M)
            ceiling_y_m = lens[1] + (y_m - lens[1]) * to_ceiling - slope_y * (2.0 * LAMP_HEIGHT_M)
            fields[SURFACE_X, a, b], fields[SURFACE_Y, a, b] = x_m, y_m
            fields[AIR_X, a, b], fields[AIR_Y, a, b] = air_x[i, j], air_y[i, j]
            fields[WATER_X, a, b] = water_x[i, j] + bending * slope_x
            fields[WATER_Y, a, b] = water_y[i, j] + bending * slope_y
            if now.wave[0] > 0.0:
                meet_wave(now.wave, slope_x, slope_y, 1.0 - bending, fields, a, b)
            fields[LIGHT, a, b] = 1.0 + reach * (level / CAUSTIC_UNIT - 1.0)
            fields[GLARE, a, b] = view.glare_levels * mirrored_lamps(view.lamps_m, ceiling_x_m, ceiling_y_m)


def glare(surface_x: Float, surface_y: Float, slopes: Float, camera: Camera) -> Float:
    """Share of a lamp (0 to 1) that each line of sight meets when mirrored at the surface, in the shape of `surface_x`.

    A slope turns the mirrored ray by twice itself, which is a long way at the ceiling: lamps break up into streaks.
    """
    lens = camera.position_m
    further = 1.0 - LAMP_HEIGHT_M / lens[2]
    slope_x, slope_y = slopes.reshape(2, *surface_x.shape)
    x = lens[0] + (surface_x - lens[0]) * np.float32(further) - slope_x * np.float32(2.0 * LAMP_HEIGHT_M)
    y = lens[1] + (surface_y - lens[1]) * np.float32(further) - slope_y * np.float32(2.0 * LAMP_HEIGHT_M)
    centre_x, centre_y, half_length, half_width = _LAMPS_M
    along = np.clip((half_length - np.abs(x - centre_x)) / np.float32(2 * LAMP_EDGE_M) + np.float32(0.5), 0.0, 1.0)
    across = np.clip((half_width - np.abs(y - centre_y)) / np.float32(2 * LAMP_EDGE_M) + np.float32(0.5), 0.0, 1.0)
    return np.asarray(np.add.reduce(along * across, axis=0), dtype=np.float32)


class WaterLight:
    """The water and its light, for any point of view: ripples, and a loop of caustic patterns."""

    def __init__(self, experiment: Experiment, random: np.random.Generator) -> None:
        self.picture, self.depth_m = experiment.sim.picture, experiment.pool.size_m[2]
        self.ripples = Ripples(self.picture, experiment.camera, random)
        self.caustics = Caustics(experiment.pool, random)
        self.wave = SurfaceWave(experiment)
        self.ripple_clock, self.caustic_clock = (
            LoopClock(loop_s, periods_s, strength > 0.0, random)
            for loop_s, periods_s, strength in zip(
                (RIPPLE_LOOP_S, CAUSTIC_LOOP_S),
                WANDER_PERIODS_S,
                (self.picture.ripples_m, self.picture.caustics),
                strict=True,
            )
        )
        self._patterns: dict[int, Bytes] = {}  # by phase, once it was asked for

    def phase_pattern(self, phase: int) -> Bytes:
        """A picture of the loop of caustics, CAUSTIC_UNIT for the mean light."""
        if phase not in self._patterns:
            light = self.caustics.pattern(phase * PHASE_S) * CAUSTIC_UNIT
            self._patterns[phase] = np.clip(light, 0, 255).astype(np.uint8)
        return self._patterns[phase]

    def patterns(self, time_s: float) -> Blend:
        """The pictures of the loop of caustics before and after a time."""
        first, second, share = self.caustic_clock.phase(time_s)
        return Blend(self.phase_pattern(first), self.phase_pattern(second), share)

    def light(self, column: Float, row: Float, reach: Float | np.float32, time_s: float) -> Float:
        """Caustic light relative to its mean at places of the caustics' grid, weighted with `reach` (0 to 1)."""
        before, after, share = self.patterns(time_s)
        pattern = np.asarray(cv2.addWeighted(before, 1.0 - share, after, share, 0.0), dtype=np.uint8)
        levels = caustic_levels(pattern, column, row)
        return np.asarray(1.0 + reach * (levels.astype(np.float32) / np.float32(CAUSTIC_UNIT) - 1.0), dtype=np.float32)

    def reach(self, depth_m: Float | float) -> Float:
        """Strength of the caustics at a depth: they gather on the way down."""
        share = np.float32(self.picture.caustics) * np.clip(np.asarray(depth_m) / self.depth_m, 0.0, 1.0)
        return np.asarray(share, dtype=np.float32)


def caustic_levels(pattern: Bytes, column: Float, row: Float) -> Bytes:
    """A pattern's values at places of its grid; beyond its edge it is mirrored."""
    return np.asarray(cv2.remap(pattern, column, row, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT_101), dtype=np.uint8)


class RowLight(NamedTuple):
    """Memory for a row of a picture. Each is an array of its own, so that all loops run several pixels at a time."""

    square_light: Line  # of its Bayer squares (n,): factor
    square_glare: Line  # grey levels to add
    light: Line  # the same of its pixels (2 n,)
    glare: Line


@kernel
def blend_lit_view(views: Blend, glares: Blend, levels: Blend, caustics: Plane, scratch: RowLight, raw: Picture) -> None:
    """Write the mosaic `raw` (height, width) of one instant: view x light + glare, each between two pictures of its loop.

    `views` are mosaics, the others have a value for each Bayer square: glares in grey levels, the caustic patterns' levels in
    CAUSTIC_UNIT for the mean light, and the strength `caustics` (0 to 1) with which a pattern counts. All in float32.
    """
    view, next_view, _ = views
    view_share, levels_share = np.float32(views.share), np.float32(levels.share)
    half, one, most = np.float32(0.5), np.float32(1.0), np.float32(255.0)
    per_unit = np.float32(1.0 / CAUSTIC_UNIT)
    height, width = raw.shape
    square_light, square_glare, light, glare = scratch
    for i in range(height):
        if i % 2 == 0:
            level, next_level, strength = levels.first[i // 2], levels.second[i // 2], caustics[i // 2]
            first_glare, next_glare = glares.first[i // 2], glares.second[i // 2]
            for j in range(caustics.shape[1]):
                blended = np.float32(level[j]) + levels_share * (np.float32(next_level[j]) - np.float32(level[j]))
                square_light[j] = one + strength[j] * (blended * per_unit - one)
                glare_step = np.float32(next_glare[j]) - np.float32(first_glare[j])
                square_glare[j] = np.float32(first_glare[j]) + view_share * glare_step
            for j in range(caustics.shape[1]):
                light[2 * j] = square_light[j]
                light[2 * j + 1] = square_light[j]
            for j in range(caustics.shape[1]):
                glare[2 * j] = square_glare[j]
                glare[2 * j + 1] = square_glare[j]
        first, second, result = view[i], next_view[i], raw[i]
        for j in range(width):
            value = np.float32(first[j]) + view_share * (np.float32(second[j]) - np.float32(first[j]))
            result[j] = np.uint8(min(value * light[j] + glare[j], most) + half)
