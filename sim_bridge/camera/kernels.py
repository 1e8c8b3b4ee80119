"""Robots, balls, plates, shadows and noise, pixel by pixel.

A picture is a raw mosaic (height, width) uint8, RGGB: the pixel at (row, column) sees channel row % 2 + column % 2 of red,
green, blue. Places are m in the pool frame, z down. A line of sight crosses the surface at (sx, sy) and is at
(sx, sy) + z (slope_x, slope_y) at depth z. Fields that change slowly are given at the middles of BLOCK x BLOCK pixels.
Colours are 0 to 255.
"""

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sim_bridge.camera.optics import Bytes, Float
from wire.frames import Array
from wire.kernels import kernel

LANES = 32  # px of a row that a body is drawn on at a time
# Rows of what is known of these pixels: line of sight in water and air, the body's colour and coverage so far, texel of the
# plate, and of the sphere its normal, coverage, texel of the skin, light on its paint, and highlight.
SURFACE_X, SURFACE_Y, WATER_X, WATER_Y, AIR_X, AIR_Y, COLOUR, COVER, PLATE_COLUMN, PLATE_ROW = range(10)
NORMAL_X, NORMAL_Y, UP, SPHERE_COVER, SKIN_COLUMN, SKIN_ROW, SHADE, HIGHLIGHT, LANE_ROWS = range(10, 19)
BLOCK = 8  # px, side of a block; the shortest ripple is some 60 px long
LAMP_X, LAMP_Y, LAMP_UP = -0.30, -0.22, 0.93  # direction to most of the light: pool x, y and up; shadows fall the other way
AMBIENT, DIFFUSE = 0.50, 0.56  # shares of ambient and of directed light on a hull
GLOSS = 26.0  # grey levels of a wet hull's highlight, which falls with the 24th power of the light
SHADOW = 0.42  # share of the light that is missing in the middle of a shadow
PENUMBRA = 0.30  # width of a shadow's edge per metre between robot and floor, for long lamp tubes

PICTURE, PLANE, WINDOW, LAYERS = "u1[:,::1]", "f4[:,::1]", "f4[:,:]", "u1[:,:,::1]"
LINES = f"UniTuple({WINDOW}, 6)"
BODY = f"Tuple((f8, f8, {LAYERS}, b1, {LAYERS}, f8))"

Planes = tuple[Any, ...]


@kernel(f"f8({LAYERS}, i8, f8, f8)", inline=True)
def sample(texture: Bytes, layer: int, column: float, row: float) -> float:
    """Bilinear sample of a texture's layer; beyond its edge the edge is repeated."""
    x = min(max(column, 0.0), texture.shape[2] - 1.001)
    y = min(max(row, 0.0), texture.shape[1] - 1.001)
    j, i = int(x), int(y)
    u, v = x - j, y - i
    upper = (1.0 - u) * texture[layer, i, j] + u * texture[layer, i, j + 1]
    lower = (1.0 - u) * texture[layer, i + 1, j] + u * texture[layer, i + 1, j + 1]
    return float((1.0 - v) * upper + v * lower)


@kernel("UniTuple(f8, 4)(f8, f8, f8, f8, f8, f8)", inline=True)
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


@kernel("UniTuple(f8, 4)(f8[:,:,::1], i8, f8, f8, f8, f8)", inline=True)
def hull_look(
    attitudes: Array, pose: int, half: float, normal_x: float, normal_y: float, up: float
) -> tuple[float, float, float, float]:
    """Texel (column, row) of a hull's skin at a unit normal, the light that its paint is multiplied by, and the grey levels of
    its highlight, in air. The skin, twice `half` texels wide, is Lambert's azimuthal projection of the sphere about its top
    (textures.hull_texture); the columns of `attitudes[pose]` are the body's axes: ahead, aside, down."""
    ahead = attitudes[pose, 0, 0] * normal_x + attitudes[pose, 1, 0] * normal_y - attitudes[pose, 2, 0] * up
    aside = attitudes[pose, 0, 1] * normal_x + attitudes[pose, 1, 1] * normal_y - attitudes[pose, 2, 1] * up
    above = attitudes[pose, 2, 2] * up - attitudes[pose, 0, 2] * normal_x - attitudes[pose, 1, 2] * normal_y
    flat = half / math.sqrt(2.0 * (1.0 + max(above, -0.999)))
    lamp = max(normal_x * LAMP_X + normal_y * LAMP_Y + up * LAMP_UP, 0.0)
    lamp2 = lamp * lamp
    lamp8 = lamp2 * lamp2 * lamp2 * lamp2
    shade = AMBIENT * (0.6 + 0.4 * up) + DIFFUSE * lamp
    return ahead * flat + half - 0.5, aside * flat + half - 0.5, shade, GLOSS * lamp8 * lamp8 * lamp8


@kernel(f"void({PICTURE}, i8, i8, {LINES}, f4[:,:,:], {PLANE}, {BODY}, f8[:,::1], f8[:,:,::1], f8[:,:,:,::1], f8, f8[:,::1])")
def draw_body(
    raw: Bytes,
    top: int,
    left: int,
    lines: Planes,
    fields: Float,
    vignette: Float,
    body: Planes,
    places: Array,
    attitudes: Array,
    water: Array,
    px_per_m: float,
    lanes: Array,
) -> None:
    """Lay a body over a rectangle of the mosaic: the mean of its pictures in k poses, by their coverage.

    The rectangle begins at (top, left). `lines` are its lines of sight (planes surface x, y, air x, y, water x, y), `fields`
    (height, width, 4) the turn of the lines in the water along x and y, the light on the body, and the glare at the surface.
    The body is a sphere (radius 0: none) with its skin, and a plate at a height above its centre, (2, size, size) brightness
    and coverage, with texels per metre. In each of k poses its centre is at `places` (k, 3), its axes are the columns of
    `attitudes` (k, 3, 3), and `water` (k, 2, 2, 3) is the share and the veil of the water over the sphere and over the plate,
    in red, green and blue.

    All that needs no texture is computed for LANES pixels of a row at a time, in vector registers. Pixels beyond the rectangle
    repeat its last, and are not drawn. `lanes` (LANE_ROWS, LANES) is scratch; its rows are named above.
    """
    radius, height_m, skin, has_plate, plate, texels_per_m = body
    surface_x, surface_y, air_x, air_y, water_x, water_y = lines
    middle = plate.shape[1] / 2.0 - 0.5
    half = skin.shape[1] / 2.0
    height, width = surface_x.shape
    k = len(places)
    deep = True  # it is all under water: the lines in air, each row of which is another page of memory, are not needed
    for pose in range(k):
        z = places[pose, 2]
        deep = deep and z >= radius and z > height_m * attitudes[pose, 2, 2]
    for i in range(height):
        row = top + i
        for begin in range(0, width, LANES):
            for n in range(LANES):
                j = min(begin + n, width - 1)
                lanes[SURFACE_X, n], lanes[SURFACE_Y, n] = surface_x[i, j], surface_y[i, j]
                lanes[WATER_X, n], lanes[WATER_Y, n] = water_x[i, j] + fields[i, j, 0], water_y[i, j] + fields[i, j, 1]
                if not deep:
                    lanes[AIR_X, n], lanes[AIR_Y, n] = air_x[i, j], air_y[i, j]
                lanes[COLOUR, n], lanes[COVER, n] = 0.0, 0.0
            for pose in range(k):
                x, y, z = places[pose, 0], places[pose, 1], places[pose, 2]
                if has_plate:
                    ox, oy, oz = attitudes[pose, 0, 2], attitudes[pose, 1, 2], attitudes[pose, 2, 2]
                    above = z - height_m * oz
                    slope = WATER_X if above > 0.0 else AIR_X
                    for n in range(LANES):
                        slope_x, slope_y = lanes[slope, n], lanes[slope + 1, n]
                        # from the middle of the plate; and (slope, 1) deeper per metre, to the plate's plane
                        dx, dy = lanes[SURFACE_X, n] - (x - height_m * ox), lanes[SURFACE_Y, n] - (y - height_m * oy)
                        down = (above * oz - dx * ox - dy * oy) / (oz + slope_x * ox + slope_y * oy)
                        dx += down * slope_x
                        dy += down * slope_y
                        dz = down - above
                        right_m = attitudes[pose, 0, 1] * dx + attitudes[pose, 1, 1] * dy + attitudes[pose, 2, 1] * dz
                        ahead_m = attitudes[pose, 0, 0] * dx + attitudes[pose, 1, 0] * dy + attitudes[pose, 2, 0] * dz
                        lanes[PLATE_COLUMN, n] = middle + texels_per_m * right_m
                        lanes[PLATE_ROW, n] = middle - texels_per_m * ahead_m
                if radius > 0.0:
                    for n in range(LANES):
                        wx, wy = lanes[WATER_X, n], lanes[WATER_Y, n]
                        nx, ny, up, cover = intersect_sphere(
                            lanes[SURFACE_X, n] + z * wx - x, lanes[SURFACE_Y, n] + z * wy - y, wx, wy, radius, px_per_m
                        )
                        lanes[NORMAL_X, n], lanes[NORMAL_Y, n] = nx, ny
                        lanes[UP, n], lanes[SPHERE_COVER, n] = up, cover
                    if z < radius:  # it breaks the surface: the part above is seen straight
                        for n in range(LANES):
                            ax, ay = lanes[AIR_X, n], lanes[AIR_Y, n]
                            nx, ny, up, cover = intersect_sphere(
                                lanes[SURFACE_X, n] + z * ax - x, lanes[SURFACE_Y, n] + z * ay - y, ax, ay, radius, px_per_m
                            )
                            if (lanes[UP, n] if z > 0.0 else up) * radius > z:
                                lanes[NORMAL_X, n], lanes[NORMAL_Y, n], lanes[UP, n], lanes[SPHERE_COVER, n] = (
                                    nx,
                                    ny,
                                    up,
                                    cover,
                                )
                    for n in range(LANES):
                        look = hull_look(attitudes, pose, half, lanes[NORMAL_X, n], lanes[NORMAL_Y, n], lanes[UP, n])
                        lanes[SKIN_COLUMN, n], lanes[SKIN_ROW, n], lanes[SHADE, n], lanes[HIGHLIGHT, n] = look
                for n in range(min(LANES, width - begin)):
                    channel = row % 2 + (left + begin + n) % 2
                    light = fields[i, begin + n, 2]
                    marking, plate_cover, sphere, sphere_cover = 0.0, 0.0, 0.0, 0.0
                    if has_plate and max(abs(lanes[PLATE_COLUMN, n] - middle), abs(lanes[PLATE_ROW, n] - middle)) < middle:
                        plate_cover = sample(plate, 1, lanes[PLATE_COLUMN, n], lanes[PLATE_ROW, n]) / 255.0
                        marking = sample(plate, 0, lanes[PLATE_COLUMN, n], lanes[PLATE_ROW, n]) * light
                        marking = plate_cover * (marking * water[pose, 1, 0, channel] + water[pose, 1, 1, channel])
                    if radius > 0.0 and plate_cover < 1.0 and lanes[SPHERE_COVER, n] > 0.0:
                        sphere_cover = lanes[SPHERE_COVER, n]
                        sphere = sample(skin, channel, lanes[SKIN_COLUMN, n], lanes[SKIN_ROW, n]) * lanes[SHADE, n] * light
                        sphere += lanes[HIGHLIGHT, n]
                        sphere = sphere_cover * (sphere * water[pose, 0, 0, channel] + water[pose, 0, 1, channel])
                    lanes[COLOUR, n] += (sphere * (1.0 - plate_cover) + marking) / k
                    lanes[COVER, n] += (sphere_cover * (1.0 - plate_cover) + plate_cover) / k
            for n in range(min(LANES, width - begin)):
                cover = lanes[COVER, n]
                if cover > 0.0:
                    column = left + begin + n
                    seen = lanes[COLOUR, n] * vignette[row, column] + cover * fields[i, begin + n, 3]
                    raw[row, column] = int(min(max(raw[row, column] * (1.0 - cover) + seen, 0.0), 255.0) + 0.5)


@kernel(f"void({LINES}, {WINDOW}, f8, f8, f8, f8, {PLANE})")
def shadow(lines: Planes, depth_m: Float, x: float, y: float, z: float, radius_m: float, light: Float) -> None:
    """Share of the light that the shadow of a sphere at (x, y, z) leaves where `lines` meet the surface of their
    `depth_m`."""
    surface_x, surface_y, _, _, water_x, water_y = lines
    for i in range(light.shape[0]):
        for j in range(light.shape[1]):
            below = depth_m[i, j] - z
            dx = surface_x[i, j] + depth_m[i, j] * water_x[i, j] - x + below * (LAMP_X / LAMP_UP)
            dy = surface_y[i, j] + depth_m[i, j] * water_y[i, j] - y + below * (LAMP_Y / LAMP_UP)
            softness = PENUMBRA * max(below, 0.02)
            inside = min(max((radius_m - math.sqrt(dx * dx + dy * dy)) / softness * 0.5 + 0.5, 0.0), 1.0)
            inside *= inside * (3.0 - 2.0 * inside)
            light[i, j] = 1.0 - SHADOW * inside if below > 0.0 else 1.0


@kernel(f"void({PICTURE}, i8, i8, {PLANE})")
def darken(raw: Bytes, top: int, left: int, light: Float) -> None:
    """Multiply the rectangle of the mosaic that begins at (top, left) by its share of the light, rounded."""
    height, width = light.shape
    half = np.float32(0.5)
    for i in range(height):
        levels, share = raw[top + i, left : left + width], light[i]
        for j in range(width):
            levels[j] = np.uint8(np.float32(levels[j]) * share[j] + half)


@kernel(f"void({PICTURE}, i1[:,::1], i8, i8, f4, f4, {PICTURE})")
def add_noise(
    raw: Bytes, field: NDArray[np.int8], top: int, left: int, read: np.float32, shot: np.float32, noisy: Bytes
) -> None:
    """level + sqrt(read + shot level) noise, rounded and clipped, with the cut-out of the noise `field` that begins at
    (top, left). All float32, so that the loop over a row runs several pixels at a time."""
    low, high, half = np.float32(0.0), np.float32(255.0), np.float32(0.5)
    width = raw.shape[1]
    for row in range(raw.shape[0]):
        levels, noise, result = raw[row], field[top + row, left : left + width], noisy[row]
        for column in range(width):
            level = np.float32(levels[column])
            level += math.sqrt(read + shot * level) * np.float32(noise[column])
            result[column] = np.uint8(min(max(level, low), high) + half)
