"""What each pixel of the simulated camera looks along, handed out by the rectangle.

Fields that change slowly across the picture (ripples, caustics on robots, glare) are computed once per BLOCK x BLOCK pixels
and interpolated.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from sim_bridge.optics import GRAZING, camera_slopes, project
from wire.frames import Array
from wire.sight import Camera

Float = NDArray[np.float32]

BLOCK = 8  # pixels; the shortest ripple is some 60 pixels long. Even, so that rectangles keep the Bayer pattern


@dataclass(frozen=True)
class Window:
    """A rectangle of the picture, aligned to blocks except where the picture ends, and the blocks that interpolate over it."""

    top: int
    bottom: int
    left: int
    right: int
    block_top: int
    block_bottom: int
    block_left: int
    block_right: int

    @property
    def pixels(self) -> tuple[slice, slice]:
        """Index of the rectangle in a (height, width) array."""
        return slice(self.top, self.bottom), slice(self.left, self.right)

    @property
    def blocks(self) -> tuple[slice, slice]:
        """Index of the blocks in a (block rows, block columns) array: one more on each side where there is one."""
        return slice(self.block_top, self.block_bottom), slice(self.block_left, self.block_right)


@dataclass(frozen=True)
class Lines:
    """Lines of sight, planes of one shape: where they cross the surface, and how far they go sideways per metre down, in air
    and in water."""

    surface_x: Float
    surface_y: Float
    air_x: Float
    air_y: Float
    water_x: Float
    water_y: Float

    def __getitem__(self, where: tuple[slice, slice]) -> "Lines":
        """Those of a rectangle."""
        planes = (self.surface_x, self.surface_y, self.air_x, self.air_y, self.water_x, self.water_y)
        return Lines(*(plane[where] for plane in planes))

    def bent(self, slope_x: Float, slope_y: Float) -> "Lines":
        """In water, turned by these much."""
        water_x, water_y = np.asarray(self.water_x + slope_x), np.asarray(self.water_y + slope_y)
        return Lines(self.surface_x, self.surface_y, self.air_x, self.air_y, water_x, water_y)


class Lens:
    """Where each pixel and each block looks from the camera, whatever its pose: planes (3, height, width) of slopes right and
    down, and of ones. Finding them takes a second, so a camera that moves keeps them."""

    def __init__(self, camera: Camera) -> None:
        self.width, self.height = camera.size_px
        column, row = np.meshgrid(np.arange(self.width, dtype=np.float64), np.arange(self.height, dtype=np.float64))
        self.pixels = _slopes(camera, column, row)
        rows, columns = -(-self.height // BLOCK), -(-self.width // BLOCK)
        middle = (BLOCK - 1) / 2.0
        column, row = np.meshgrid(np.arange(columns) * BLOCK + middle, np.arange(rows) * BLOCK + middle)
        self.blocks = _slopes(camera, column, row)


class View:
    """Lines of sight of a camera in its pose: of all blocks at once, of pixels by the rectangle."""

    def __init__(self, camera: Camera, lens: Lens | None = None) -> None:
        self.camera, self.lens = camera, lens or Lens(camera)
        self.width, self.height = camera.size_px
        self.blocks = _lines(camera, self.lens.blocks)
        self._pixels = None if lens else _lines(camera, self.lens.pixels)  # for one picture only, rectangles are cheaper

    def moved(self, camera: Camera) -> "View":
        """The same camera in another pose."""
        return View(camera, self.lens)

    def lines(self, window: Window) -> Lines:
        """Those of a window's pixels."""
        if self._pixels is not None:
            return self._pixels[window.pixels]
        return _lines(self.camera, self.lens.pixels[:, *window.pixels])

    @property
    def whole(self) -> Window:
        """The whole picture."""
        rows, columns = self.blocks.surface_x.shape
        return Window(0, self.height, 0, self.width, 0, rows, 0, columns)

    def window(self, points_pool: Array, margin_px: float) -> Window | None:
        """The rectangle that holds the pictures of all points (m, 3), or None if it lies outside the picture."""
        pixels = project(self.camera, points_pool)
        if not np.all(np.isfinite(pixels)):
            return None
        low, high = pixels.min(axis=0) - margin_px, pixels.max(axis=0) + margin_px
        if high[0] < 0 or high[1] < 0 or low[0] > self.width - 1 or low[1] > self.height - 1:
            return None
        rows, columns = self.blocks.surface_x.shape
        left, right = max(int(low[0]) // BLOCK, 0), min(int(high[0]) // BLOCK + 1, columns)
        top, bottom = max(int(low[1]) // BLOCK, 0), min(int(high[1]) // BLOCK + 1, rows)
        return Window(
            top * BLOCK, min(bottom * BLOCK, self.height), left * BLOCK, min(right * BLOCK, self.width),
            max(top - 1, 0), min(bottom + 1, rows), max(left - 1, 0), min(right + 1, columns),
        )  # fmt: skip

    def spread(self, blocks: Float, window: Window) -> Float:
        """Values at the middles of `window.blocks`, interpolated to the pixels of the window."""
        rows, columns = blocks.shape
        fine = cv2.resize(blocks, (columns * BLOCK, rows * BLOCK), interpolation=cv2.INTER_LINEAR)
        top, left = window.top - window.block_top * BLOCK, window.left - window.block_left * BLOCK
        height, width = window.bottom - window.top, window.right - window.left
        return np.asarray(fine[top : top + height, left : left + width], dtype=np.float32)


def mosaic(bgr: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """What an RGGB sensor keeps of a picture (height, width, 3) in OpenCV's channel order: (height, width)."""
    raw = np.ascontiguousarray(bgr[..., 1])
    raw[0::2, 0::2] = bgr[0::2, 0::2, 2]
    raw[1::2, 1::2] = bgr[1::2, 1::2, 0]
    return raw


def _lines(camera: Camera, slopes: Float) -> Lines:
    """Lines of sight in the pool, from slopes (3, height, width) in the camera's own frame; see sim_bridge/optics.py."""
    turn = np.asarray(cv2.Rodrigues(np.array(camera.rotation_rad))[0]).astype(np.float32)
    x, y, down = np.tensordot(turn.T, slopes, axes=1)
    length2 = x * x + y * y + down * down
    down = np.maximum(down, np.float32(GRAZING) * np.sqrt(length2))
    lens_x, lens_y, lens_z = (np.float32(value) for value in camera.position_m)
    air_x, air_y = x / down, y / down
    root = np.sqrt(np.float32(camera.water_index**2) * length2 - x * x - y * y)
    return Lines(lens_x - lens_z * air_x, lens_y - lens_z * air_y, air_x, air_y, x / root, y / root)


def _slopes(camera: Camera, column: Array, row: Array) -> Float:
    return np.ascontiguousarray(np.moveaxis(camera_slopes(camera, np.stack([column, row], axis=-1)), -1, 0), dtype=np.float32)
