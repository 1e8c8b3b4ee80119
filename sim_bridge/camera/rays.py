"""Lines of sight of the simulated camera's pixels, by rectangle.

Fields that change slowly across the picture (ripples, caustics on robots, glare) are computed once per BLOCK x BLOCK
pixels and interpolated.
"""

from collections.abc import Sequence

import cv2
import numpy as np

from shoal.config.perception import Camera
from shoal.frames import Array
from sim_bridge.camera.kernels import BLOCK, ImageRect, RayBundle
from sim_bridge.camera.optics import GRAZING, Bytes, Float, Optics, camera_slopes

BAYER = ((0, 0, 0), (0, 1, 1), (1, 0, 1), (1, 1, 2))  # row and column of each pixel of a square, and its colour: R, G, G, B


class CameraRays:
    """Lines of sight of a camera in its pose, at the middles of all blocks, and where it sees points of the pool.

    Lines of the pixels between are interpolated. That is off by an eighth of BLOCK^2 times the lens's second derivative: 0.002
    px in the pictures of the shipped cameras, and 0.004 px at their edges.
    """

    def __init__(self, camera: Camera, slopes: Float | None = None) -> None:
        """`slopes` are those of the same camera in another pose."""
        self.camera, self.optics = camera, Optics(camera)
        self.width, self.height = camera.size_px
        self._slopes = _block_slopes(camera) if slopes is None else slopes
        self.blocks = _lines(camera, self._slopes)

    def moved(self, camera: Camera) -> "CameraRays":
        """The same camera in another pose."""
        return CameraRays(camera, self._slopes)

    def pixel_lines(self) -> RayBundle:
        """The lines of all pixels: 30 MB and 0.3 s, for what is drawn once."""
        column, row = np.meshgrid(np.arange(self.width, dtype=np.float64), np.arange(self.height, dtype=np.float64))
        return _lines(self.camera, _slopes(self.camera, column, row))

    def windows(self, points_pool: Array, margin_px: float) -> list[ImageRect | None]:
        """For each of k bodies the rectangle that holds the projections of its points, (k, m, 3); None if it lies outside
        the picture."""
        pixels = self.optics.see(points_pool).pixels.reshape(*points_pool.shape[:2], 2)
        low, high = pixels.min(axis=1) - margin_px, pixels.max(axis=1) + margin_px
        return [self._window(*sides) for sides in np.concatenate([low, high], axis=1).tolist()]

    def _window(self, low_x: float, low_y: float, high_x: float, high_y: float) -> ImageRect | None:
        """The rectangle of whole Bayer squares that holds a part of the picture (px), with the blocks around it; None outside
        the picture."""
        if not (high_x >= 0 and high_y >= 0 and low_x <= self.width - 1 and low_y <= self.height - 1):  # NaN is nowhere
            return None
        rows, columns = self.blocks.surface_x.shape
        left, right = max(int(low_x) // 2 * 2, 0), min(int(high_x) // 2 * 2 + 2, self.width)
        top, bottom = max(int(low_y) // 2 * 2, 0), min(int(high_y) // 2 * 2 + 2, self.height)
        return ImageRect(
            top, bottom, left, right,
            max(top // BLOCK - 1, 0), min(-(-bottom // BLOCK) + 1, rows),
            max(left // BLOCK - 1, 0), min(-(-right // BLOCK) + 1, columns),
        )  # fmt: skip

    def spread(self, blocks: Float) -> Float:
        """Interpolate values at the middles of all blocks to all pixels."""
        rows, columns = blocks.shape
        fine = cv2.resize(blocks, (columns * BLOCK, rows * BLOCK), interpolation=cv2.INTER_LINEAR)
        return np.asarray(fine[: self.height, : self.width], dtype=np.float32)


def sample_mosaic(planes: Sequence[Bytes], column: Float, row: Float) -> Bytes:
    """Sample a picture, given as red, green and blue planes, at places (column, row) as an RGGB sensor does: a mosaic in
    their shape."""
    raw = np.empty(column.shape, np.uint8)
    for i, j, plane in BAYER:
        x, y = np.ascontiguousarray(column[i::2, j::2]), np.ascontiguousarray(row[i::2, j::2])
        raw[i::2, j::2] = cv2.remap(planes[plane], x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return raw


def _lines(camera: Camera, slopes: Float) -> RayBundle:
    """Lines of sight in the pool, from slopes (3, height, width) in the camera's frame; float32 version of `optics.rays`."""
    turn = np.asarray(cv2.Rodrigues(np.array(camera.rotation_rad))[0]).astype(np.float32)
    x, y, down = np.tensordot(turn.T, slopes, axes=1)
    length2 = x * x + y * y + down * down
    down = np.maximum(down, np.float32(GRAZING) * np.sqrt(length2))
    lens_x, lens_y, lens_z = (np.float32(value) for value in camera.position_m)
    air_x, air_y = x / down, y / down
    root = np.sqrt(np.float32(camera.water_index**2) * length2 - x * x - y * y)
    return RayBundle(lens_x - lens_z * air_x, lens_y - lens_z * air_y, air_x, air_y, x / root, y / root)


def _block_slopes(camera: Camera) -> Float:
    """Directions of all blocks in the camera's frame: planes (3, block rows, block columns) of slopes right and down, and of
    ones."""
    rows, columns = -(-camera.size_px[1] // BLOCK), -(-camera.size_px[0] // BLOCK)
    middle = (BLOCK - 1) / 2.0
    column, row = np.meshgrid(np.arange(columns) * BLOCK + middle, np.arange(rows) * BLOCK + middle)
    return _slopes(camera, column, row)


def _slopes(camera: Camera, column: Array, row: Array) -> Float:
    return np.ascontiguousarray(np.moveaxis(camera_slopes(camera, np.stack([column, row], axis=-1)), -1, 0), dtype=np.float32)
