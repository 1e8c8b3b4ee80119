"""Robots, balls, plates, shadows and noise, pixel by pixel.

A picture is a raw mosaic (height, width) uint8, RGGB: the pixel at (row, column) sees channel row % 2 + column % 2 of red,
green, blue. Places are m in the pool frame, z down. A line of sight crosses the surface at (sx, sy) and is at
(sx, sy) + z (slope_x, slope_y) at depth z. Fields that change slowly are given at the middles of BLOCK x BLOCK pixels.
Colours are 0 to 255.
"""

import math
from typing import Annotated, NamedTuple

import numpy as np
from numpy.typing import NDArray

from shoal.kernels.decorator import kernel
from shoal.kernels.types import Cube, Floats, Table
from sim_bridge.camera.optics import Float

BLOCK = 8  # px, side of a block; the shortest ripple is some 60 px long
LANES = 4 * BLOCK  # px of a row that a body is drawn on at a time
# Fields of a block, and of a pixel between four of them: line of sight in water, light on a body, glare, line of sight in air.
SURFACE_X, SURFACE_Y, WATER_X, WATER_Y, LIGHT, GLARE, AIR_X, AIR_Y, FIELDS = range(9)
# What else is known of a pixel: the body's colour and coverage so far; of the plate and of the sphere the coverage, texel and
# colour there; of the sphere its normal, the light on its paint, and the highlight; between four texels the place and them.
COLOUR, COVER, PLATE_COVER, PLATE_COLUMN, PLATE_ROW, MARKING = range(FIELDS, FIELDS + 6)
SPHERE_COVER, SKIN_COLUMN, SKIN_ROW, PAINT, NORMAL_X, NORMAL_Y, UP, SHADE, HIGHLIGHT = range(FIELDS + 6, FIELDS + 15)
RIGHT, DOWN, TEXELS, LANE_ROWS = FIELDS + 15, FIELDS + 16, FIELDS + 17, FIELDS + 21
LAMP_X, LAMP_Y, LAMP_UP = -0.30, -0.22, 0.93  # direction to most of the light: pool x, y and up; shadows fall the other way
LOWEST = -0.999  # vertical part of a normal, beside the bottom, which is the skin's whole rim
AMBIENT, DIFFUSE = 0.50, 0.56  # shares of ambient and of directed light on a hull
GLOSS = 26.0  # grey levels of a wet hull's highlight, which falls with the 24th power of the light
SHADOW = 0.42  # share of the light that is missing in the middle of a shadow
PENUMBRA = 0.30  # width of a shadow's edge per metre between robot and floor, for long lamp tubes

Picture = Annotated[NDArray[np.uint8], 2]
Layers = Annotated[NDArray[np.uint8], 3]
Plane = Annotated[NDArray[np.float32], 2]
Line = Annotated[NDArray[np.float32], 1]  # values of a row
Blocks = Annotated[NDArray[np.float32], 3]
Noise = Annotated[NDArray[np.int8], 2]
Corners = Annotated[NDArray[np.int32], 2]
Block = Annotated[NDArray[np.float64], 4]


class ImageRect(NamedTuple):
    """A rectangle of the picture that begins on the Bayer pattern's first pixel, and the blocks that interpolate over it."""

    top: int
    bottom: int
    left: int
    right: int
    block_top: int
    block_bottom: int
    block_left: int
    block_right: int

    @property
    def blocks(self) -> tuple[slice, slice]:
        """Index of the blocks in a (block rows, block columns) array: one more on each side where there is one."""
        return slice(self.block_top, self.block_bottom), slice(self.block_left, self.block_right)


class RayBundle(NamedTuple):
    """Lines of sight as planes of one shape: their crossing of the surface, and sideways metres per metre of depth, in air
    and in water."""

    surface_x: Plane
    surface_y: Plane
    air_x: Plane
    air_y: Plane
    water_x: Plane
    water_y: Plane

    def deflected(self, slope_x: Float, slope_y: Float) -> "RayBundle":
        """The lines with these slopes added in water."""
        return self._replace(water_x=np.asarray(self.water_x + slope_x), water_y=np.asarray(self.water_y + slope_y))


class Shading(NamedTuple):
    """Darkening of the picture towards its corners: a pixel gets 1 - dimming r^2 of its light."""

    centre_x: float  # px, from where r is measured
    centre_y: float
    dimming: float  # per px^2


class BodyPaint(NamedTuple):
    """A sphere with its skin, and a plate at a height above its centre."""

    radius_m: float  # 0: no sphere
    height_m: float
    skin: Layers  # (3, size, size) red, green, blue
    has_plate: bool
    plate: Layers  # (2, size, size) brightness and coverage
    texels_per_m: float  # of the plate


class BodyLook(NamedTuple):
    """One body as it looks in the picture: its poses during the exposure, k of them."""

    poses: Table  # (k, 4) evenly spaced, symmetric in time; their mean picture stands for the exposure
    attitudes: Cube  # (k, 3, 3), rotations from body to pool: Rz(yaw) Ry(pitch) Rx(roll)
    water: Block  # (k, 2, 2, 3) share that passes and veil of the water over sphere and plate, in blue, green and red
    depth_m: float  # of its centre
    px_per_m: float  # around it, 0 above the lens
    path_m: float  # optical length from the lens: bodies that are farther are behind the others


class BodyScratch(NamedTuple):
    """Memory for a row of a body's pixels. Rows of the first two are named above."""

    edge: Table  # (FIELDS, block columns)
    lanes: Table  # (LANE_ROWS, LANES), zeros at first
    corners: Corners  # (2, LANES)


@kernel(inline=True, part=True)
def sample(texture: Layers, even: int, odd: int, lanes: Table, used: int, column: int, result: int, corners: Corners) -> None:
    """Bilinear samples of a texture, layer `even` for even lanes and `odd` for the others; beyond its edge it is repeated.

    The rows `column` and `column` + 1 of `lanes` are the places; the samples are written to the row `result`, and count only
    where the row `used` is above zero. Only the texels themselves are taken one after the other.
    """
    height, width = texture.shape[1:]
    for n in range(LANES):
        x = min(max(lanes[column, n], 0.0), width - 1.001)
        y = min(max(lanes[column + 1, n], 0.0), height - 1.001)
        j, i = np.int32(x), np.int32(y)
        corners[0, n], corners[1, n] = i, j
        lanes[RIGHT, n], lanes[DOWN, n] = x - j, y - i
    for n in range(LANES):
        if lanes[used, n] > 0.0:
            layer, i, j = odd if n % 2 else even, corners[0, n], corners[1, n]
            lanes[TEXELS, n], lanes[TEXELS + 1, n] = texture[layer, i, j], texture[layer, i, j + 1]
            lanes[TEXELS + 2, n], lanes[TEXELS + 3, n] = texture[layer, i + 1, j], texture[layer, i + 1, j + 1]
    for n in range(LANES):
        upper = lanes[TEXELS, n] + lanes[RIGHT, n] * (lanes[TEXELS + 1, n] - lanes[TEXELS, n])
        lower = lanes[TEXELS + 2, n] + lanes[RIGHT, n] * (lanes[TEXELS + 3, n] - lanes[TEXELS + 2, n])
        lanes[result, n] = upper + lanes[DOWN, n] * (lower - upper)


@kernel(inline=True, part=True)
def intersect_sphere(
    x: float, y: float, slope_x: float, slope_y: float, radius: float, px_per_m: float
) -> tuple[float, float, float, float]:
    """Unit normal (x, y, up) of a sphere where a line of sight meets it, and the share of the pixel that it covers.

    The line is at (x, y) from the centre at its depth, and moves by the slope per metre of depth:
    |(x, y, 0) + w (slope, 1)| = r, with w the depth below the centre: a w^2 + 2 b w + |x, y|^2 - r^2 = 0. A line that just
    misses gets the normal of the limb, so that a half-covered pixel at the edge has a colour.
    """
    per_a = 1.0 / (slope_x * slope_x + slope_y * slope_y + 1.0)
    b = x * slope_x + y * slope_y
    miss2 = x * x + y * y - b * b * per_a  # squared distance of the line from the centre
    cover = min(max((radius - math.sqrt(max(miss2, 0.0))) * px_per_m + 0.5, 0.0), 1.0)
    w = -(b * per_a + math.sqrt(max(radius * radius - miss2, 0.0) * per_a))
    per_m = 1.0 / radius
    return (x + w * slope_x) * per_m, (y + w * slope_y) * per_m, -w * per_m, cover


@kernel(inline=True, part=True)
def hull_look(
    attitudes: Cube, pose: int, half: float, normal_x: float, normal_y: float, up: float
) -> tuple[float, float, float, float]:
    """Texel (column, row) of a hull's skin at a unit normal, the light that its paint is multiplied by, and the grey levels of
    its highlight, in air. The skin, twice `half` texels wide, is Lambert's azimuthal projection of the sphere about its top
    (textures.hull_texture); the columns of `attitudes[pose]` are the body's axes: ahead, aside, down."""
    ahead = attitudes[pose, 0, 0] * normal_x + attitudes[pose, 1, 0] * normal_y - attitudes[pose, 2, 0] * up
    aside = attitudes[pose, 0, 1] * normal_x + attitudes[pose, 1, 1] * normal_y - attitudes[pose, 2, 1] * up
    above = attitudes[pose, 2, 2] * up - attitudes[pose, 0, 2] * normal_x - attitudes[pose, 1, 2] * normal_y
    flat = half / math.sqrt(2.0 * (1.0 + max(above, LOWEST)))
    lamp = max(normal_x * LAMP_X + normal_y * LAMP_Y + up * LAMP_UP, 0.0)
    lamp2 = lamp * lamp
    lamp8 = lamp2 * lamp2 * lamp2 * lamp2
    sky = 0.6 + 0.4 * up  # ambient light, which comes more from above
    shade = AMBIENT * sky + DIFFUSE * lamp
    return ahead * flat + half - 0.5, aside * flat + half - 0.5, shade, GLOSS * lamp8 * lamp8 * lamp8


@kernel(inline=True, part=True)
def meet_plate(
    lanes: Table, poses: Table, pose: int, attitudes: Cube, height_m: float, texels_per_m: float, middle: float
) -> int:
    """Write where the pixels' lines of sight meet the plane of a plate, in its texels, and PLATE_COVER, 1 on the plate.
    Returns how many meet the plate."""
    x, y, z = poses[pose, 0], poses[pose, 1], poses[pose, 2]
    ox, oy, oz = attitudes[pose, 0, 2], attitudes[pose, 1, 2], attitudes[pose, 2, 2]
    deep = z - height_m * oz
    slope = WATER_X if deep > 0.0 else AIR_X
    for n in range(LANES):
        slope_x, slope_y = lanes[slope, n], lanes[slope + 1, n]
        # from the middle of the plate; and (slope, 1) deeper per metre, to the plate's plane
        dx, dy = lanes[SURFACE_X, n] - (x - height_m * ox), lanes[SURFACE_Y, n] - (y - height_m * oy)
        down = (deep * oz - dx * ox - dy * oy) / (oz + slope_x * ox + slope_y * oy)
        dx += down * slope_x
        dy += down * slope_y
        dz = down - deep
        right_m = attitudes[pose, 0, 1] * dx + attitudes[pose, 1, 1] * dy + attitudes[pose, 2, 1] * dz
        ahead_m = attitudes[pose, 0, 0] * dx + attitudes[pose, 1, 0] * dy + attitudes[pose, 2, 0] * dz
        lanes[PLATE_COLUMN, n] = middle + texels_per_m * right_m
        lanes[PLATE_ROW, n] = middle - texels_per_m * ahead_m
    met = 0
    for n in range(LANES):
        is_on = max(abs(lanes[PLATE_COLUMN, n] - middle), abs(lanes[PLATE_ROW, n] - middle)) < middle
        lanes[PLATE_COVER, n] = 1.0 if is_on else 0.0
        met += 1 if is_on else 0
    return met


@kernel(inline=True, part=True)
def meet_sphere(lanes: Table, poses: Table, pose: int, radius: float, px_per_m: float) -> int:
    """Write where the pixels' lines of sight meet a sphere, as its unit normal there, and SPHERE_COVER. Returns how many
    pixels it covers. Of a sphere that breaks the surface the part above is seen straight."""
    x, y, z = poses[pose, 0], poses[pose, 1], poses[pose, 2]
    for n in range(LANES):
        slope_x, slope_y = lanes[WATER_X, n], lanes[WATER_Y, n]
        at_x, at_y = lanes[SURFACE_X, n] + z * slope_x - x, lanes[SURFACE_Y, n] + z * slope_y - y
        normal_x, normal_y, up, cover = intersect_sphere(at_x, at_y, slope_x, slope_y, radius, px_per_m)
        lanes[NORMAL_X, n], lanes[NORMAL_Y, n], lanes[UP, n], lanes[SPHERE_COVER, n] = normal_x, normal_y, up, cover
    if z < radius:
        for n in range(LANES):
            slope_x, slope_y = lanes[AIR_X, n], lanes[AIR_Y, n]
            at_x, at_y = lanes[SURFACE_X, n] + z * slope_x - x, lanes[SURFACE_Y, n] + z * slope_y - y
            normal_x, normal_y, up, cover = intersect_sphere(at_x, at_y, slope_x, slope_y, radius, px_per_m)
            if (lanes[UP, n] if z > 0.0 else up) * radius > z:
                lanes[NORMAL_X, n], lanes[NORMAL_Y, n], lanes[UP, n], lanes[SPHERE_COVER, n] = normal_x, normal_y, up, cover
    met = 0
    for n in range(LANES):
        met += 1 if lanes[SPHERE_COVER, n] > 0.0 else 0
    return met


@kernel(inline=True, part=True)
def between_blocks(pixel: int, blocks: int) -> tuple[int, float]:
    """The block before a pixel, and how far the pixel is on the way from its middle to the next one's: a share, which is
    negative or more than 1 beyond the outermost middles. `blocks` are as many as there are along this side."""
    first = min(max((pixel - BLOCK // 2) // BLOCK, 0), blocks - 2)
    return first, (pixel - first * BLOCK - (BLOCK - 1) / 2.0) / BLOCK


@kernel
def draw_body(
    raw: Picture, rect: ImageRect, fields: Cube, shading: Shading, body: BodyPaint, look: BodyLook, scratch: BodyScratch
) -> None:
    """Lay a body over a rectangle of the mosaic: the mean of its pictures in k poses, by their coverage. `fields` (FIELDS, the
    rectangle's block rows, its block columns) are interpolated between the middles of blocks.

    All but the texels is computed for LANES pixels of a row at a time, in vector registers; they begin at the middle of a
    block, and those outside the rectangle are not drawn.
    """
    top, bottom, left, right, block_top, _, block_left, _ = rect
    radius, height_m, skin, has_plate, plate, texels_per_m = body
    middle_x, middle_y, dimming = shading
    poses, attitudes, water, px_per_m = look.poses, look.attitudes, look.water, look.px_per_m
    edge, lanes, corners = scratch
    middle, half = plate.shape[1] / 2.0 - 0.5, skin.shape[1] / 2.0
    k = len(poses)
    block_rows, block_columns = fields.shape[1:]
    needed = AIR_X  # of the fields, if all is under water
    for pose in range(k):
        if poses[pose, 2] < radius or poses[pose, 2] <= height_m * attitudes[pose, 2, 2]:
            needed = FIELDS
    first = (left - BLOCK // 2) // BLOCK * BLOCK + BLOCK // 2  # the first pixel after a block's middle
    for row in range(top, bottom):
        even, odd = row % 2, row % 2 + 1  # channels
        above, share = between_blocks(row - block_top * BLOCK, block_rows)
        for field in range(needed):
            upper, lower, result = fields[field, above], fields[field, above + 1], edge[field]
            for b in range(block_columns):
                result[b] = upper[b] + share * (lower[b] - upper[b])
        for begin in range(first, right, LANES):
            for cell in range(0, LANES, BLOCK):
                b, share = between_blocks(begin + cell - block_left * BLOCK, block_columns)
                for field in range(needed):
                    value, step = edge[field, b], (edge[field, b + 1] - edge[field, b]) / BLOCK
                    value += share * BLOCK * step
                    for n in range(BLOCK):
                        lanes[field, cell + n] = value + n * step
            for n in range(LANES):
                lanes[COLOUR, n], lanes[COVER, n] = 0.0, 0.0
            for pose in range(k):
                on_plate = meet_plate(lanes, poses, pose, attitudes, height_m, texels_per_m, middle) if has_plate else 0
                on_sphere = meet_sphere(lanes, poses, pose, radius, px_per_m) if radius > 0.0 else 0
                if on_plate > 0:
                    sample(plate, 0, 0, lanes, PLATE_COVER, PLATE_COLUMN, MARKING, corners)
                    sample(plate, 1, 1, lanes, PLATE_COVER, PLATE_COLUMN, PAINT, corners)
                    for n in range(LANES):
                        passed = water[pose, 1, 0, 2 - odd] if n % 2 else water[pose, 1, 0, 2 - even]
                        veil = water[pose, 1, 1, 2 - odd] if n % 2 else water[pose, 1, 1, 2 - even]
                        cover = lanes[PAINT, n] / 255.0 if lanes[PLATE_COVER, n] > 0.0 else 0.0
                        lanes[SPHERE_COVER, n] *= 1.0 - cover
                        lanes[COVER, n] += cover
                        lanes[COLOUR, n] += cover * (lanes[MARKING, n] * lanes[LIGHT, n] * passed + veil)
                if on_sphere > 0:
                    for n in range(LANES):
                        paint = hull_look(attitudes, pose, half, lanes[NORMAL_X, n], lanes[NORMAL_Y, n], lanes[UP, n])
                        lanes[SKIN_COLUMN, n], lanes[SKIN_ROW, n], lanes[SHADE, n], lanes[HIGHLIGHT, n] = paint
                    sample(skin, even, odd, lanes, SPHERE_COVER, SKIN_COLUMN, PAINT, corners)
                    for n in range(LANES):
                        passed = water[pose, 0, 0, 2 - odd] if n % 2 else water[pose, 0, 0, 2 - even]
                        veil = water[pose, 0, 1, 2 - odd] if n % 2 else water[pose, 0, 1, 2 - even]
                        cover = lanes[SPHERE_COVER, n]
                        lanes[COVER, n] += cover
                        level = lanes[PAINT, n] * lanes[SHADE, n] * lanes[LIGHT, n] + lanes[HIGHLIGHT, n]
                        lanes[COLOUR, n] += cover * (level * passed + veil)
            for n in range(max(left - begin, 0), min(LANES, right - begin)):
                cover, column = lanes[COVER, n] / k, begin + n
                if cover > 0.0:
                    dim = 1.0 - dimming * ((column - middle_x) ** 2 + (row - middle_y) ** 2)
                    level = lanes[COLOUR, n] / k * dim + cover * lanes[GLARE, n]
                    raw[row, column] = int(min(max(raw[row, column] * (1.0 - cover) + level, 0.0), 255.0) + 0.5)


@kernel
def draw_shadow(
    raw: Picture,
    rect: ImageRect,
    lines: RayBundle,
    depth_m: Plane,
    place: Floats,
    radius_m: float,
    light: Table,
    left_over: Line,
) -> None:
    """Darken floor and walls in a rectangle of the mosaic by the shadow of a sphere at `place` x, y, z.

    `lines` are the lines of sight of all blocks of the picture, and `depth_m` the depths at which they end. `light` (the
    rectangle's block rows, block columns), the share of it that is left, and `left_over` (BLOCK (block columns + 1),), that
    of a row's pixels, are scratch.
    """
    top, bottom, left, right, block_top, _, block_left, _ = rect
    surface_x, surface_y, _, _, water_x, water_y = lines
    rows, columns = light.shape
    for a in range(rows):
        for b in range(columns):
            i, j = block_top + a, block_left + b
            deep = depth_m[i, j]
            below = deep - place[2]
            dx = surface_x[i, j] + deep * water_x[i, j] - place[0] + below * (LAMP_X / LAMP_UP)
            dy = surface_y[i, j] + deep * water_y[i, j] - place[1] + below * (LAMP_Y / LAMP_UP)
            softness = PENUMBRA * max(below, 0.02)
            inside = min(max((radius_m - math.sqrt(dx * dx + dy * dy)) / softness * 0.5 + 0.5, 0.0), 1.0)
            inside *= inside * (3.0 - 2.0 * inside)
            light[a, b] = 1.0 - SHADOW * inside if below > 0.0 else 1.0
    first = (left - BLOCK // 2) // BLOCK * BLOCK + BLOCK // 2  # the first pixel after a block's middle
    half, one = np.float32(0.5), np.float32(1.0)
    for row in range(top, bottom):
        above, down = between_blocks(row - block_top * BLOCK, rows)
        for begin in range(first, right, BLOCK):
            b, share = between_blocks(begin - block_left * BLOCK, columns)
            value = light[above, b] + down * (light[above + 1, b] - light[above, b])
            step = light[above, b + 1] + down * (light[above + 1, b + 1] - light[above, b + 1]) - value
            value += share * step
            step /= BLOCK
            for n in range(BLOCK):
                left_over[begin - first + n] = np.float32(value + n * step)
        levels, shares = raw[row, left:right], left_over[left - first :]
        for n in range(right - left):
            levels[n] = np.uint8(np.float32(levels[n]) * min(shares[n], one) + half)


@kernel
def add_noise(raw: Picture, field: Noise, top: int, left: int, read: float, shot: float, noisy: Picture) -> None:
    """level + sqrt(read + shot level) noise, rounded and clipped, with the cut-out of the noise `field` that begins at
    (top, left). All float32, so that the loop over a row runs several pixels at a time."""
    low, high, half = np.float32(0.0), np.float32(255.0), np.float32(0.5)
    fixed, share = np.float32(read), np.float32(shot)
    width = raw.shape[1]
    for row in range(raw.shape[0]):
        levels, noise, result = raw[row], field[top + row, left : left + width], noisy[row]
        for column in range(width):
            level = np.float32(levels[column])
            level += math.sqrt(fixed + share * level) * np.float32(noise[column])
            result[column] = np.uint8(min(max(level, low), high) + half)
