"""Calibration targets (chessboard, ChArUco), and their corners in a picture.

Pictures of a target in air determine the intrinsics. A corner's place on the target is exact (in m, z = 0); its pixel is
found to some 0.03 px in a sharp picture. Pixel (0, 0) is the CENTRE of the first pixel, as in OpenCV.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from localizer.detection.image_regions import Pixels
from shoal.errors import ConfigError
from shoal.frames import Array

EXAMPLES = "chessboard:9x6:0.03 (inner corners, side of a square in m), charuco:7x5:0.04:0.03:DICT_4X4_50 (squares, side of a \
square, side of a marker, dictionary; :legacy at the end for boards drawn by OpenCV before 4.6)"
FEWEST_CORNERS = 8  # of a partly hidden target; fewer hardly constrain more than its own pose
_LEAST_PX = 3.0  # px, width of the corners' cloud; narrower ones cannot be told from a line
_LARGEST_COUNT = 50
_REFINE_SHARE, _REFINE_PX = 0.4, (2, 11)  # half side of the refinement window over a square's side, and its limits in px
_REFINE_UNTIL = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 40, 1e-3)


@dataclass(frozen=True, eq=False)
class TargetView:
    """The target in one picture: corners on the target (n, 3) in m, and in the picture (n, 2) in px."""

    name: str
    board_m: Array
    pixels: Array


class CalibrationTarget(Protocol):
    """A flat target with corners at known places."""

    def find(self, grey: Pixels, name: str) -> TargetView | None:
        """The target in a grey picture (height, width), or None if it is not found."""
        ...


class Chessboard:
    """Black and white squares; all `columns` x `rows` inner corners must be visible."""

    def __init__(self, columns: int, rows: int, square_m: float) -> None:
        self._count = (columns, rows)
        across, down = np.meshgrid(np.arange(columns), np.arange(rows))
        places = np.column_stack([across.ravel(), down.ravel(), np.zeros(columns * rows)])
        self._corners_m: Array = np.asarray(square_m * places, dtype=np.float64)

    def find(self, grey: Pixels, name: str) -> TargetView | None:
        success, corners = cv2.findChessboardCornersSB(grey, self._count, flags=cv2.CALIB_CB_NORMALIZE_IMAGE)
        if not success:
            return None
        # The sector method finds boards that the older one misses. Refinement improves its corners from 0.09 px to 0.03 px (16
        # rendered boards with noise 2 of 255), and to 0.05 px when blurred by 2 px.
        rough = np.asarray(corners, dtype=np.float32).reshape(-1, 1, 2)
        reach = int(np.clip(_REFINE_SHARE * self._nearest_px(rough), *_REFINE_PX))
        pixels = cv2.cornerSubPix(grey, rough, (reach, reach), (-1, -1), _REFINE_UNTIL)
        return TargetView(name, self._corners_m, np.asarray(pixels, dtype=np.float64).reshape(-1, 2))

    def _nearest_px(self, corners: NDArray[np.float32]) -> float:
        """Shortest side of a square in the picture."""
        columns, rows = self._count
        grid = corners.reshape(rows, columns, 2)
        return float(min(np.linalg.norm(np.diff(grid, axis=axis), axis=2).min() for axis in (0, 1)))


class Charuco:
    """A chessboard with markers in its white squares. A part of it suffices, so it can reach the picture's edges."""

    def __init__(self, squares: tuple[int, int], square_m: float, marker_m: float, dictionary: int, legacy: bool) -> None:
        board = cv2.aruco.CharucoBoard(squares, square_m, marker_m, cv2.aruco.getPredefinedDictionary(dictionary))
        board.setLegacyPattern(legacy)
        self._corners_m = np.asarray(board.getChessboardCorners(), dtype=np.float64).reshape(-1, 3)
        self._detector = cv2.aruco.CharucoDetector(board)

    def find(self, grey: Pixels, name: str) -> TargetView | None:
        """The corners that are seen; None if they are few, or lie so near to one line that they constrain no lens."""
        corners, ids, _, _ = self._detector.detectBoard(grey)
        if ids is None or len(ids) < FEWEST_CORNERS:
            return None
        pixels = np.asarray(corners, dtype=np.float64).reshape(-1, 2)
        width_px = np.linalg.svd(pixels - pixels.mean(axis=0), compute_uv=False)[1] / np.sqrt(len(pixels))  # RMS
        if width_px < _LEAST_PX:
            return None
        return TargetView(name, self._corners_m[np.asarray(ids).ravel()], pixels)


def parse_target(text: str) -> CalibrationTarget:
    """The target that `--board` describes. Raises ConfigError naming the error."""
    kind, *parts = text.split(":")
    if kind == "chessboard" and len(parts) == 2:
        columns, rows = _counts(text, parts[0])
        return Chessboard(columns, rows, _side_m(text, parts[1]))
    if kind == "charuco" and len(parts) in (4, 5) and parts[4:] in ([], ["legacy"]):
        squares, square_m, marker_m = _counts(text, parts[0]), _side_m(text, parts[1]), _side_m(text, parts[2])
        if marker_m >= square_m:
            raise ConfigError(f"--board {text}: marker {marker_m:g} m must be smaller than its square {square_m:g} m")
        return Charuco(squares, square_m, marker_m, _dictionary(text, parts[3], squares), legacy=len(parts) == 5)
    raise ConfigError(f"--board {text}: not a board (allowed: {EXAMPLES})")


def _counts(board: str, text: str) -> tuple[int, int]:
    """Parse COLUMNSxROWS of a board. Raises ConfigError."""
    numbers = text.split("x")
    if len(numbers) == 2 and all(n.isdecimal() and 3 <= int(n) <= _LARGEST_COUNT for n in numbers):
        return int(numbers[0]), int(numbers[1])
    raise ConfigError(f"--board {board}: {text!r} must be COLUMNSxROWS, each 3 to {_LARGEST_COUNT}")


def _side_m(board: str, text: str) -> float:
    """A side in metres from a board's text. Raises ConfigError."""
    try:
        side_m = float(text)
    except ValueError:
        side_m = float("nan")
    if 0.001 <= side_m <= 2.0:
        return side_m
    raise ConfigError(f"--board {board}: {text!r} must be a side in metres (allowed: 0.001 to 2)")


def _dictionary(board: str, name: str, squares: tuple[int, int]) -> int:
    """Number of OpenCV's dictionary of markers, which must hold enough of them. Raises ConfigError."""
    names: Sequence[str] = [n for n in dir(cv2.aruco) if n.startswith("DICT_")]
    if name not in names:
        raise ConfigError(f"--board {board}: {name!r} is no dictionary (allowed: {', '.join(names)})")
    number = int(getattr(cv2.aruco, name))
    has, needs = len(cv2.aruco.getPredefinedDictionary(number).bytesList), squares[0] * squares[1] // 2
    if has < needs:
        raise ConfigError(f"--board {board}: {squares[0]}x{squares[1]} squares hold {needs} markers, {name} has only {has}")
    return number
