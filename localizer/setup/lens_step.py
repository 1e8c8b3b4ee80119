"""Collecting views of a calibration board while it is waved before the camera. Pure.

A view is kept when the board is still and shows something new: another place, size or tilt. The lens is found by the functions
of `localizer calibrate`.
"""

from dataclasses import dataclass

import cv2
import numpy as np

from localizer.calibration.intrinsics import CELLS, FEWEST_VIEWS, IntrinsicsFit, fit_intrinsics
from localizer.calibration.targets import TargetView, parse_target
from localizer.camera_model import Intrinsics
from localizer.detection.image_regions import Pixels
from shoal.frames import Array

_STILL_PX = 0.7  # px, largest mean motion of the corners between two pictures of a still board
_SAME_CORNERS = 0.5  # of the corners that both pictures have to show for that
_NEW_PLACE, _NEW_SIZE, _NEW_TILT_RAD = 0.12, 0.2, 0.15  # of the picture's width; of its logarithm; 9 deg
MOST_VIEWS = 60  # as many as `localizer calibrate` uses


@dataclass(frozen=True)
class BoardPosture:
    """A board in the picture: its middle over the picture's width (2,), the logarithm of its size, its tilts (2,) in rad."""

    middle: Array
    size: float
    tilt_rad: Array

    def is_like(self, other: "BoardPosture") -> bool:
        """True if a view of one adds nothing to a view of the other."""
        near = float(np.linalg.norm(self.middle - other.middle)) < _NEW_PLACE
        alike = abs(self.size - other.size) < _NEW_SIZE
        return near and alike and float(np.linalg.norm(self.tilt_rad - other.tilt_rad)) < _NEW_TILT_RAD


class LensStep:
    """The views of one board at one size of picture."""

    def __init__(self, board: str, lens: Intrinsics) -> None:
        """`lens`: an assumed lens, from which tilts are computed. Raises ConfigError if `board` describes no board."""
        self.board, self._target, self._lens = board, parse_target(board), lens
        self.views: list[TargetView] = []
        self.postures: list[BoardPosture] = []
        self.seen_px: Array = np.empty((0, 2))  # corners in the newest picture
        self.advice = "show the board"
        self._last: TargetView | None = None
        self._taken = 0

    def offer(self, grey: Pixels) -> bool:
        """Look for the board in a grey picture (height, width). Returns True if it was kept as a view."""
        view = self._target.find(grey, f"view {self._taken + 1}")
        last, self._last = self._last, view
        self.seen_px = np.empty((0, 2)) if view is None else view.pixels
        if view is None:
            self.advice = "no board in sight"
        elif len(self.views) >= MOST_VIEWS:
            self.advice = f"{MOST_VIEWS} views are kept: more add little"
        elif last is None or not _is_still(last, view):
            self.advice = "hold it still"
        else:
            posture = self._posture(view)
            if not any(posture.is_like(other) for other in self.postures):
                self.views.append(view)
                self.postures.append(posture)
                self._taken += 1
                self.advice = f"kept {view.name}"
                return True
            self.advice = "as in a view before: move or tilt it"
        return False

    def drop(self, name: str) -> None:
        """Forget a view."""
        kept = [i for i, view in enumerate(self.views) if view.name != name]
        self.views, self.postures = [self.views[i] for i in kept], [self.postures[i] for i in kept]

    @property
    def coverage(self) -> list[list[int]]:
        """Number of corners in each cell of the picture, rows of columns."""
        counts = np.zeros((CELLS[1], CELLS[0]), dtype=int)
        for view in self.views:
            cell = np.clip((view.pixels + 0.5) / self._lens.size_px * CELLS, 0, np.array(CELLS) - 1).astype(int)
            np.add.at(counts, (cell[:, 1], cell[:, 0]), 1)
        return [[int(count) for count in row] for row in counts]

    @property
    def missing(self) -> list[str]:
        """Kinds of views that are still wanted, in words."""
        counts, tilts = np.array(self.coverage), np.array([p.tilt_rad for p in self.postures]).reshape(-1, 2)
        corners = {"upper left": (0, 0), "upper right": (0, -1), "lower left": (-1, 0), "lower right": (-1, -1)}
        views = [f"a view in the {name} corner" for name, cell in corners.items() if counts[cell] == 0]
        sides = {"left edge towards you": -tilts[:, 1], "right edge towards you": tilts[:, 1]}
        sides |= {"upper edge towards you": tilts[:, 0], "lower edge towards you": -tilts[:, 0]}
        views += [f"a view tilted with its {name}" for name, along in sides.items() if not np.any(along > _NEW_TILT_RAD)]
        if len(self.views) < FEWEST_VIEWS:
            views.append(f"{FEWEST_VIEWS - len(self.views)} more views at least")
        return views

    def fit(self) -> IntrinsicsFit:
        """The lens. Raises ConfigError if the views do not tell it."""
        return fit_intrinsics(list(self.views), self._lens.size_px)

    def _posture(self, view: TargetView) -> BoardPosture:
        """Place, size and tilt of the board in a view, by the guessed lens."""
        width, _ = self._lens.size_px
        _, turn, _ = cv2.solvePnP(view.board_m, view.pixels[:, None], self._lens.matrix, np.array(self._lens.distortion))
        normal = np.asarray(cv2.Rodrigues(turn)[0])[:, 2]  # the board's, in the camera's frame: away from the camera
        normal = normal if normal[2] > 0 else -normal
        size = float(np.log(np.ptp(view.pixels, axis=0).max() / width))
        tilt = np.arctan2([normal[1], normal[0]], normal[2])
        return BoardPosture(view.pixels.mean(axis=0) / width, size, tilt)


def _is_still(before: TargetView, now: TargetView) -> bool:
    """True if the corners that both show have not moved."""
    places = {tuple(corner): pixel for corner, pixel in zip(before.board_m.tolist(), before.pixels, strict=True)}
    moved = [
        float(np.linalg.norm(pixel - places[tuple(corner)]))
        for corner, pixel in zip(now.board_m.tolist(), now.pixels, strict=True)
        if tuple(corner) in places
    ]
    return len(moved) > _SAME_CORNERS * len(now.pixels) and float(np.mean(moved)) < _STILL_PX
