"""Calibration boards and pool marks with known truth, through the simulator's optics, which the localizer does not share.

A camera without water whose axes are the pool's stands in for the bench: what lies above "its water" is seen straight, so
camera coordinates are pool coordinates less the camera's place.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import RectBivariateSpline

from localizer.calibration.targets import TargetView
from shoal.config.perception import Camera
from shoal.frames import Array
from sim_bridge.camera.optics import Rays, project, rays

Pixels = NDArray[np.uint8]
Float = NDArray[np.float32]

_OVERSAMPLE = 2
_TEXTURE_PX_PER_M = 2000.0
_PLACE_M = np.array([0.0, 0.0, -5.0])  # high enough for every board to be above the water


@dataclass(frozen=True, eq=False)
class CameraBench:
    """A camera before it is hung up."""

    camera: Camera

    @cached_property
    def dry(self) -> Camera:
        """The camera with the pool's axes, in air only."""
        return self.camera.model_copy(
            update={"rotation_rad": (0.0, 0.0, 0.0), "position_m": tuple(_PLACE_M.tolist()), "water_index": 1.0}
        )

    def see(self, points_camera: Array) -> Array:
        """Pixels (n, 2) of points (n, 3) in camera coordinates."""
        return project(self.dry, points_camera + _PLACE_M)

    def poses(self, count: int, board_m: Array, seed: int, margin_px: float = 2.0) -> list[tuple[Array, Array]]:
        """Turns (3, 3) and moves (3,) that bring all of a board's points (n, 3) into the picture, tilted up to 35 degrees
        each way, its middle somewhere in the picture and near enough to fill a third of it."""
        random = np.random.default_rng(seed)
        width, height = self.camera.size_px
        reach_m = float(np.ptp(board_m[:, 0]))
        poses: list[tuple[Array, Array]] = []
        while len(poses) < count:
            turn = np.asarray(cv2.Rodrigues(random.uniform(-0.6, 0.6, 3))[0], dtype=np.float64)
            distance = reach_m * self.camera.focal_px[0] / width * random.uniform(1.1, 2.6)
            aim = (random.uniform(0.0, 1.0, 2) * [width, height] - self.camera.centre_px) / self.camera.focal_px
            move = distance * np.append(aim, 1.0) - turn @ board_m.mean(axis=0)
            pixels = self.see(board_m @ turn.T + move)
            if np.all((pixels >= margin_px) & (pixels <= np.array([width, height]) - 1.0 - margin_px)):
                poses.append((turn, move))
        return poses

    def views(self, count: int, board_m: Array, seed: int, noise_px: float) -> list[TargetView]:
        """Views of a board without the trouble of pictures."""
        random = np.random.default_rng(seed + 1000)
        return [
            TargetView(
                f"view-{i}", board_m, self.see(board_m @ turn.T + move) + noise_px * random.normal(size=(len(board_m), 2))
            )
            for i, (turn, move) in enumerate(self.poses(count, board_m, seed))
        ]

    @cached_property
    def _sight(self) -> Rays:
        return _fine_rays(self.camera)

    def picture(self, texture: Pixels, corner_m: Array, turn: Array, move: Array, noise: float = 2.0) -> Pixels:
        """A grey picture of a flat thing that carries `texture`, whose first pixel lies at `corner_m` (2,) on it, with
        sensor noise."""
        x, y = self._flat_sight
        normal, foot = turn[:, 2], move @ turn
        scale = np.float32(normal @ move) / (x * np.float32(normal[0]) + y * np.float32(normal[1]) + np.float32(normal[2]))
        across, down = (
            (x * np.float32(turn[0, k]) + y * np.float32(turn[1, k]) + np.float32(turn[2, k])) * scale
            - np.float32(foot[k] + corner_m[k])
            for k in (0, 1)
        )
        return _expose(_sample(texture, across, down, 120.0), noise)

    @cached_property
    def _flat_sight(self) -> tuple[Float, Float]:
        air = _fine_rays(self.dry).air.astype(np.float32)  # 1e-7: a ten thousandth of a pixel
        return np.ascontiguousarray(air[..., 0]), np.ascontiguousarray(air[..., 1])

    def pool(self, planes: list[tuple[float, Callable[[Array], Array]]], noise: float = 2.0) -> Pixels:
        """A grey picture of the pool: each plane is (depth, colour of points (h, w, 2): NaN where it holds nothing), the
        farthest first."""
        sight = self._sight
        picture = np.full(sight.air.shape[:2], 90.0)
        for depth_m, colour in planes:
            colours = colour(sight.surface_m + depth_m * (sight.water if depth_m > 0 else sight.air))
            picture = np.where(np.isnan(colours), picture, colours)
        return _expose(picture.astype(np.float32), noise)


def chessboard(columns: int, rows: int, square_m: float) -> tuple[Pixels, Array, Array]:
    """Texture, place of its first pixel (2,), and inner corners (n, 3) of a board with a white rim."""
    squares = np.add.outer(np.arange(rows + 1), np.arange(columns + 1)) % 2
    paint = np.where(squares == 0, 25, 225).astype(np.uint8)
    paint = np.pad(paint, 1, constant_values=225)
    across, down = np.meshgrid(np.arange(columns), np.arange(rows))
    corners: Array = np.asarray(square_m * np.column_stack([across.ravel(), down.ravel(), np.zeros(columns * rows)]))
    cell = round(square_m * _TEXTURE_PX_PER_M)
    assert cell == square_m * _TEXTURE_PX_PER_M, "squares must be whole texture pixels"
    return np.asarray(np.kron(paint, np.ones((cell, cell))), dtype=np.uint8), np.full(2, -2 * square_m), corners


def charuco(squares: tuple[int, int], square_m: float, marker_m: float) -> Pixels:
    """Texture of a board of DICT_4X4_50, its first pixel at the board's corner."""
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50)
    board = cv2.aruco.CharucoBoard(squares, square_m, marker_m, dictionary)
    size = (round(squares[0] * square_m * _TEXTURE_PX_PER_M), round(squares[1] * square_m * _TEXTURE_PX_PER_M))
    return np.asarray(board.generateImage(size), dtype=np.uint8)


def marks(places: dict[int, tuple[float, float]], side_m: float) -> Callable[[Array], Array]:
    """Colour of a plane with markers (id: centre) of DICT_4X4_50 on white plates, nothing elsewhere."""
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50)

    def colour(points: Array) -> Array:
        shade = np.full(points.shape[:2], np.nan)
        for number, centre in places.items():
            cells = np.asarray(cv2.aruco.generateImageMarker(dictionary, number, 6), dtype=np.float64)
            index = np.floor(((points - centre) / side_m + 0.5) * 6).astype(int)
            on_plate = np.all((index >= -1) & (index <= 6), axis=2)
            printed = np.all((index >= 0) & (index <= 5), axis=2)
            inside = index.clip(0, 5)
            shade = np.where(on_plate, np.where(printed, 30.0 + 0.75 * cells[inside[..., 1], inside[..., 0]], 222.0), shade)
        return shade

    return colour


def _fine_rays(camera: Camera) -> Rays:
    """Rays of all samples of all pixels: cubic splines through every eighth pixel, true to 1e-6."""
    n = _OVERSAMPLE
    fine = [(np.arange(size * n) + 0.5) / n - 0.5 for size in camera.size_px]
    coarse = [np.arange(-8.0, size + 16.0, 8.0) for size in camera.size_px]
    sparse = rays(camera, np.stack(np.meshgrid(*coarse), axis=-1))

    def spread(pairs: Array) -> Array:
        planes = [RectBivariateSpline(coarse[1], coarse[0], pairs[..., i])(fine[1], fine[0]) for i in (0, 1)]
        return np.stack(planes, axis=-1)

    return Rays(spread(sparse.surface_m), spread(sparse.air), spread(sparse.water))


def _sample(texture: Pixels, across_m: Float, down_m: Float, background: float) -> Float:
    u, v = ((place * np.float32(_TEXTURE_PX_PER_M) - np.float32(0.5)) for place in (across_m, down_m))
    sample = cv2.remap(texture.astype(np.float32), u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=-1e6)
    return np.asarray(np.where(sample < 0, background, sample), dtype=np.float32)


def _expose(fine: Float, noise: float) -> Pixels:
    height, width = fine.shape[0] // _OVERSAMPLE, fine.shape[1] // _OVERSAMPLE
    grey = fine.reshape(height, _OVERSAMPLE, width, _OVERSAMPLE).mean(axis=(1, 3))
    grey = grey + noise * np.random.default_rng(7).normal(size=grey.shape)
    return np.asarray(np.clip(np.rint(grey), 0, 255), dtype=np.uint8)
