"""Textures of tiles, robot hulls and marker plates, all drawn from numbers, none from files.

Colours are BGR, 0 to 255, in daylight out of the water.
"""

import cv2
import numpy as np
from numpy.typing import NDArray

from shoal.config.perception import MarkerFamily
from sim_bridge.camera.optics import Bytes, Float

Plane = NDArray[np.float64]
Colour = tuple[float, float, float]

TILE_M = 0.125
GROUT_M = 0.005
LONGEST_M = 4.0  # m of tiles that are drawn; larger planes repeat them
FINEST_M = 0.002  # m, smallest texel

HULL_PX = 320  # the whole sphere in one disc, see `shell`
LENS_SOFTNESS_PX = 0.5  # standard deviation of the lens's blur
CELL_PX = 16  # texels per marker cell
QUIET_CELLS = 1  # white cells around the marker, which ArUco needs to find its border
EDGE = 0.016  # radii of the hull over which paint fades
MARGIN_PX = 8  # transparent texels around the plate, for a smooth edge
WHITE, BLACK = 232.0, 24.0

YELLOW, ORANGE = np.array([38.0, 186.0, 240.0]), np.array([30.0, 150.0, 242.0])
DARK, GREY, GLASS = np.array([52.0, 50.0, 48.0]), np.array([150.0, 152.0, 150.0]), np.array([88.0, 52.0, 30.0])
RED, GREEN, PALE = np.array([40.0, 38.0, 205.0]), np.array([86.0, 150.0, 40.0]), np.array([205.0, 226.0, 236.0])


def grain(height: int, width: int, octaves: tuple[tuple[float, float], ...], random: np.random.Generator) -> Float:
    """Smooth noise (height, width): a sum of (feature size in texels, standard deviation)."""
    total = np.zeros((height, width), np.float32)
    for size, deviation in octaves:
        coarse = random.normal(0.0, deviation, (max(round(height / size), 2), max(round(width / size), 2))).astype(np.float32)
        total += cv2.resize(coarse, (width, height), interpolation=cv2.INTER_CUBIC)
    return total


def texels_per_tile(texel_m: float) -> int:
    """Texels of about this size along a tile: a whole number."""
    return max(round(TILE_M / max(texel_m, FINEST_M)), 4)


def tile_texture(size_m: tuple[float, float], texel_m: float, colour: Colour, random: np.random.Generator) -> Bytes:
    """A tiled plane (rows along size_m[1], columns along size_m[0], 3), a whole number of tiles, at most LONGEST_M."""
    per_tile = texels_per_tile(texel_m)
    across, down = (int(np.ceil(min(size, LONGEST_M) / TILE_M - 1e-9)) for size in size_m)
    each = random.normal(0.0, 0.035, (down, across))
    shade = np.repeat(np.repeat(each, per_tile, axis=0), per_tile, axis=1).astype(np.float32)
    height, width = shade.shape
    shade += np.float32(1.0) + grain(height, width, ((1.2, 0.025), (6.0, 0.02), (40.0, 0.03), (220.0, 0.05)), random)
    edge_x, edge_y = (np.abs((np.arange(n) + 0.5) % per_tile / per_tile - 0.5) * TILE_M for n in (width, height))
    to_edge_m = TILE_M / 2.0 - np.maximum(edge_x[None, :], edge_y[:, None])
    texel = TILE_M / per_tile
    grout = np.clip((GROUT_M / 2.0 - to_edge_m) / texel + 0.5, 0.0, 1.0).astype(np.float32)
    shade *= np.float32(1.0) - np.float32(0.30) * grout
    return np.clip(shade[..., None] * np.array(colour, np.float32), 0, 255).astype(np.uint8)


def hull_texture(number: int | None, marked: bool, softness_px: float, random: np.random.Generator) -> Bytes:
    """A robot's hull (HULL_PX, HULL_PX, 3): column along body x, row along body y.

    The sphere's point with unit normal n lies at n_xy / sqrt(2 (1 + n_up)) of the half size (Lambert's azimuthal
    projection), so the bottom is the rim. No pattern repeats under rotation: window ahead, hatch with the number behind,
    red to port, green to starboard.
    """
    axis = (np.arange(HULL_PX) + 0.5) / HULL_PX * 2.0 - 1.0
    u, v = np.meshgrid(axis, axis)
    rho2 = np.minimum(u**2 + v**2, 1.0)
    x, y, up = 2.0 * u * np.sqrt(1.0 - rho2), 2.0 * v * np.sqrt(1.0 - rho2), 1.0 - 2.0 * rho2
    paintwork = (YELLOW + (ORANGE - YELLOW) * random.uniform(0.0, 0.8)) * random.uniform(0.92, 1.05)
    image = paintwork * np.ones((HULL_PX, HULL_PX, 1))

    def paint(distance: Plane, colour: Plane, opacity: float = 1.0) -> None:
        """Paint where `distance` is negative: that to a shape's edge, in radii, over EDGE of which the colour fades."""
        cover = opacity * np.clip(0.5 - distance / EDGE, 0.0, 1.0)[..., None]
        image[:] = image * (1.0 - cover) + colour * cover

    paint(up - 0.02, GREY)  # the lower half
    paint(np.abs(up - 0.07) - 0.19, DARK)  # the mid-plate between the hemispheres, with its flange
    paint(np.abs(x + 0.06) - 0.010, DARK, 0.7)  # seam between water store and sealed compartment
    for angle in (0.72, 2.42, 3.86, 5.56):  # flooding holes of the water store, and the legs' brackets below them
        paint(_ball(x, y, up, angle, 0.62) - 0.075, DARK)
        paint(np.maximum(np.abs(_turned(x, y, angle)) - 0.085, np.abs(up - 0.25) - 0.17), DARK, 0.8)
    paint(_ball(x, y, up, 0.0, 0.58) - 0.23, PALE)  # the window's frame
    paint(_ball(x, y, up, 0.0, 0.58) - 0.18, GLASS)
    paint(np.maximum(np.abs(y) - 0.22, np.abs(x + 0.76) - 0.13), DARK, 0.75)  # the hatch
    paint(_ball(x, y, up, -np.pi / 2, 0.62) - 0.12, RED)  # to port
    paint(_ball(x, y, up, np.pi / 2, 0.62) - 0.12, GREEN)
    if not marked:
        paint(np.maximum(np.abs(y) - 0.06, np.abs(x - 0.22) - 0.30), DARK)  # a stripe from the crown ahead
    image *= 1.0 + grain(HULL_PX, HULL_PX, ((2.0, 0.02), (12.0, 0.03), (60.0, 0.05)), random)[..., None]
    if marked:  # under the plate's edge light is scarce
        reach = np.maximum(np.abs(x), np.abs(y))
        image *= np.where(up > 0, 1.0 - 0.35 * np.clip((0.56 - reach) / 0.12, 0.0, 1.0), 1.0)[..., None]
    picture = np.clip(image, 0, 255).astype(np.uint8)
    if number is not None:
        _write_number(picture, number)
    return np.asarray(cv2.GaussianBlur(picture, (0, 0), max(softness_px, 0.4)), dtype=np.uint8)


def _ball(x: Plane, y: Plane, up: Plane, angle: float, height: float) -> Plane:
    """Distance on the unit sphere (chord) from the point at an azimuth and height."""
    flat = np.sqrt(1.0 - height**2)
    return np.asarray(np.sqrt((x - flat * np.cos(angle)) ** 2 + (y - flat * np.sin(angle)) ** 2 + (up - height) ** 2))


def _turned(x: Plane, y: Plane, angle: float) -> Plane:
    """Distance sideways of the meridian at an azimuth; large on the sphere's other side."""
    ahead = x * np.cos(angle) + y * np.sin(angle)
    return np.asarray(np.where(ahead > 0, y * np.cos(angle) - x * np.sin(angle), 9.0))


def _write_number(picture: Bytes, number: int) -> None:
    """Write the robot's number on the hatch behind, readable from behind the robot."""
    label = np.zeros((28, 44, 3), np.uint8)
    left = 4 if number > 9 else 13
    cv2.putText(label, str(number), (left, 23), cv2.FONT_HERSHEY_SIMPLEX, 0.85, (220, 235, 240), 3, cv2.LINE_AA)
    turned = cv2.rotate(label, cv2.ROTATE_90_CLOCKWISE)
    height, width = turned.shape[:2]
    row, column = HULL_PX // 2 - height // 2, round(HULL_PX * 0.5 * (1.0 - 0.42)) - width // 2
    spot = picture[row : row + height, column : column + width]
    np.maximum(spot, turned, out=spot)


def plate_texture(marker_id: int, softness_px: float, family: MarkerFamily) -> Bytes:
    """A marker on its white plate, (n, n, 2) brightness and coverage: row 0 ahead, column 0 to port, MARGIN_PX around it.

    The black-bordered cells are the marker's side. Softening stands for the lens: bilinear sampling of unsoftened texels
    would move edges by a fraction of a pixel, differently at each heading.
    """
    dictionary = _dictionary(family)
    cells = cv2.aruco.generateImageMarker(dictionary, marker_id, _cells(dictionary) * CELL_PX, borderBits=1)
    grey = np.pad(np.where(cells > 127, WHITE, BLACK), QUIET_CELLS * CELL_PX + MARGIN_PX, constant_values=WHITE)
    cover = np.pad(np.full((grey.shape[0] - 2 * MARGIN_PX,) * 2, 255.0), MARGIN_PX)
    soft = [cv2.GaussianBlur(layer.astype(np.float32), (0, 0), max(softness_px, 0.3)) for layer in (grey, cover)]
    return np.clip(np.rint(np.stack(soft, axis=-1)), 0, 255).astype(np.uint8)


def plate_texels_per_m(side_m: float, family: MarkerFamily) -> float:
    """Texels per metre of `plate_texture` for a marker of this side."""
    return _cells(_dictionary(family)) * CELL_PX / side_m


def _dictionary(family: MarkerFamily) -> cv2.aruco.Dictionary:
    return cv2.aruco.getPredefinedDictionary(int(getattr(cv2.aruco, f"DICT_{family}".upper())))


def _cells(dictionary: cv2.aruco.Dictionary) -> int:
    """Cells of a marker's side, its black border included."""
    return int(dictionary.markerSize) + 2
