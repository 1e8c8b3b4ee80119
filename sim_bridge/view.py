"""What each pixel of the simulated camera looks along, kept for the whole picture and handed out by the rectangle.

Fields that change slowly across the picture (ripples, caustics on robots, glare) are computed once per BLOCK x BLOCK pixels
and interpolated.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from sim_bridge.optics import project, rays
from wire.experiment import Camera
from wire.frames import Array

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


class View:
    """Per-pixel rays as float32 planes (height, width): crossing of the surface, and slopes in air and in water."""

    def __init__(self, camera: Camera) -> None:
        self.camera = camera
        self.width, self.height = camera.size_px
        column, row = np.meshgrid(np.arange(self.width, dtype=np.float64), np.arange(self.height, dtype=np.float64))
        lines = rays(camera, np.stack([column, row], axis=-1))
        self.surface_x, self.surface_y = _planes(lines.surface_m)
        self.air_x, self.air_y = _planes(lines.air)
        self.water_x, self.water_y = _planes(lines.water)
        rows, columns = -(-self.height // BLOCK), -(-self.width // BLOCK)
        middle = (BLOCK - 1) / 2.0
        column, row = np.meshgrid(np.arange(columns) * BLOCK + middle, np.arange(rows) * BLOCK + middle)
        lines = rays(camera, np.stack([column, row], axis=-1))
        self.block_surface_x, self.block_surface_y = _planes(lines.surface_m)
        self.block_water_x, self.block_water_y = _planes(lines.water)

    @property
    def whole(self) -> Window:
        """The whole picture."""
        rows, columns = self.block_surface_x.shape
        return Window(0, self.height, 0, self.width, 0, rows, 0, columns)

    def window(self, points_pool: Array, margin_px: float) -> Window | None:
        """The rectangle that holds the pictures of all points (m, 3), or None if it lies outside the picture."""
        pixels = project(self.camera, points_pool)
        if not np.all(np.isfinite(pixels)):
            return None
        low, high = pixels.min(axis=0) - margin_px, pixels.max(axis=0) + margin_px
        if high[0] < 0 or high[1] < 0 or low[0] > self.width - 1 or low[1] > self.height - 1:
            return None
        rows, columns = self.block_surface_x.shape
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


def _planes(pairs: Array) -> tuple[Float, Float]:
    return np.ascontiguousarray(pairs[..., 0], dtype=np.float32), np.ascontiguousarray(pairs[..., 1], dtype=np.float32)
