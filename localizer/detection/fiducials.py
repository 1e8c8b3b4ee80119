"""Markers (ArUco 4x4_50 or AprilTag 36h11): identity, position and heading, from a region or the whole picture.

Settings are for markers of 24 px and more, seen from straight above: one threshold pass instead of OpenCV's three, no
error correction (4x4_50 differs in only 4 bits, so a corrected reading may be a neighbour's), corners to sub-pixel.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from localizer import kernels
from localizer.camera_model import RefractiveCamera
from localizer.detection.image_regions import ImageRegion, Pixels
from shoal.config.perception import MarkerFamily
from shoal.frames import Array

_MAX_MISFIT = 0.12  # of the side; more is a marker at another depth (20 % in size), a reflection, or no marker
_SQUARE_SHARE = 0.03  # of the side; corners nearer to a square of any size make one
_STRANGEST = 0.6  # of the side; a marker that is told as one of the wrong size is not farther off
_SHORTEST_SIDE_PX = 14.0  # px; below this the 6 cells of a side are too small to be read
_ALL_WINDOWS_PX = (3, 23)  # OpenCV's default: three passes, for markers whose size is not known
_LONGEST_RATE = 3.99  # OpenCV's upper bound of a marker's perimeter over the picture's longer side


@dataclass(frozen=True)
class MarkerImage:
    """One marker as found in the picture: corners (4, 2) px in ArUco's order, from upper left clockwise."""

    id: int
    corners_px: Array


@dataclass(frozen=True)
class MarkerPose:
    """A marker in the pool frame: [x, y, yaw], its upper edge ahead, and its misfit: the largest distance of a corner from
    the fitted square, relative to the side. `residual_m` is the standard deviation of a corner's coordinates about a square
    of any size. `size`: mean of its sides over that of the square."""

    pose: Array
    misfit: float
    residual_m: float
    size: float = 1.0


def marker_dictionary(family: MarkerFamily) -> cv2.aruco.Dictionary:
    """OpenCV's dictionary of a family."""
    return cv2.aruco.getPredefinedDictionary(int(getattr(cv2.aruco, f"DICT_{family}".upper())))


def marker_detector(
    family: MarkerFamily = "4x4_50", threshold_windows_px: tuple[int, int] = (23, 23)
) -> cv2.aruco.ArucoDetector:
    """OpenCV's detector of a family, with the settings of this module.

    `threshold_windows_px`: the smallest and the largest window of the adaptive threshold, 10 px apart. 23 px are 4 cells of a
    robot's marker, so that no cell goes hollow; every further window costs one more pass over the picture.
    """
    settings = cv2.aruco.DetectorParameters()
    settings.adaptiveThreshWinSizeMin, settings.adaptiveThreshWinSizeMax = threshold_windows_px
    settings.maxMarkerPerimeterRate = _LONGEST_RATE
    settings.minDistanceToBorder = 1
    settings.perspectiveRemovePixelPerCell = 6
    settings.errorCorrectionRate = 0.0
    settings.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
    # 3 px of a 5.7 px cell halve the error of OpenCV's own 0.3 cells; 4 px and more take in the next cell's corner.
    settings.cornerRefinementWinSize = 3
    settings.relativeCornerRefinmentWinSize = 0.55
    settings.cornerRefinementMaxIterations = 20
    settings.cornerRefinementMinAccuracy = 0.01  # px: 0.03 mm in the pool, far below the noise
    return cv2.aruco.ArucoDetector(marker_dictionary(family), settings)


def find_markers(detector: cv2.aruco.ArucoDetector, region: ImageRegion) -> list[MarkerImage]:
    """Markers in a region, corners in pixels of the whole picture; sorted by id and place."""
    markers = _find_in_grey(detector, region.grey(), np.array([region.left_px, region.top_px], dtype=np.float64))
    return sorted(markers, key=lambda marker: (marker.id, *marker.corners_px[0].tolist()))


def _find_in_grey(detector: cv2.aruco.ArucoDetector, grey: Pixels, corner_px: Array) -> list[MarkerImage]:
    """Markers in `grey`, whose first pixel is pixel `corner_px` (2,) of the whole picture."""
    settings = detector.getDetectorParameters()
    settings.minMarkerPerimeterRate = min(4.0 * _SHORTEST_SIDE_PX / max(grey.shape), _LONGEST_RATE / 2.0)
    detector.setDetectorParameters(settings)
    corners, ids, _ = detector.detectMarkers(grey)
    pairs = zip(() if ids is None else np.ravel(ids), corners, strict=True)
    return [MarkerImage(int(i), quad.reshape(4, 2) + corner_px) for i, quad in pairs]


def marker_centres(grey: Pixels, family: MarkerFamily = "4x4_50") -> dict[int, list[Array]]:
    """Centres (2,) px of the markers of any size in a grey picture (height, width), by id: the crossing of the diagonals,
    which tilt does not move."""
    centres: dict[int, list[Array]] = {}
    for marker in _find_in_grey(marker_detector(family, _ALL_WINDOWS_PX), grey, np.zeros(2)):
        a, b, c, d = marker.corners_px
        along, _ = np.linalg.solve(np.column_stack([c - a, b - d]), b - a)
        centres.setdefault(marker.id, []).append(a + along * (c - a))
    return centres


def square(side_m: float) -> Array:
    """Corners (4, 2) of a marker in its own frame, in ArUco's order: upper edge ahead, y to starboard."""
    half = side_m / 2.0
    return np.array([[half, -half], [half, half], [-half, half], [-half, -half]])


def marker_poses(
    images: Sequence[MarkerImage], view: RefractiveCamera, depths_m: Array, tilts_rad: Array, side_m: float
) -> list[MarkerPose]:
    """Fit a square to each marker's four corners by least squares in the POOL frame, its plate at `depths_m` (n,) with roll
    and pitch `tilts_rad` (n, 2).

    An angle between pixels is no heading, because lens and water bend the picture (up to 1.5 deg in the pool's corners).
    """
    corners_px = np.array([image.corners_px for image in images]).reshape(-1, 4, 2)
    poses, misfits = np.empty((len(images), 3)), np.empty((len(images), 2))
    kernels.marker_poses(view.numbers, corners_px, depths_m, tilts_rad, side_m, poses, misfits)
    corners = view.pixel_to_pool(corners_px, np.broadcast_to(depths_m[:, None], corners_px.shape[:2]))
    sizes = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).mean(axis=1) / side_m
    rows = zip(poses, misfits.tolist(), sizes.tolist(), strict=True)
    return [MarkerPose(pose, misfit, residual_m, size) for pose, (misfit, residual_m), size in rows]


class MarkerReader:
    """Reader of the fleet's markers: from regions to poses by robot."""

    def __init__(self, side_m: float, robot_of_marker: Mapping[int, int], family: MarkerFamily = "4x4_50") -> None:
        self._side_m, self._robot_of_marker = side_m, dict(robot_of_marker)
        self.foreign_ids: frozenset[int] = frozenset()  # markers in the last regions, of a robot's size, that are no robot's
        self.strange_sizes: dict[int, float] = {}  # of robots' markers in the last regions that are squares of another size
        self._detector = marker_detector(family)

    def read(
        self, view: RefractiveCamera, regions: Iterable[ImageRegion], plates_m: NDArray[np.float64], tilts_rad: Array
    ) -> dict[int, list[MarkerPose]]:
        """All good readings by robot (index), from regions that may overlap; `plates_m` (robots,) are the depths of their
        plates, and `tilts_rad` (robots, 2) their roll and pitch."""
        good: dict[int, list[MarkerPose]] = {}
        self.strange_sizes = {}
        foreign_ids = set()
        images = [image for region in regions for image in find_markers(self._detector, region)]
        robots = [self._robot_of_marker.get(image.id) for image in images]
        depths_m = np.array([plates_m.mean() if robot is None else plates_m[robot] for robot in robots], dtype=np.float64)
        tilts = np.array([np.zeros(2) if robot is None else tilts_rad[robot] for robot in robots]).reshape(-1, 2)
        readings = marker_poses(images, view, depths_m, tilts, self._side_m)
        for image, robot, reading in zip(images, robots, readings, strict=True):
            if robot is None:
                foreign_ids.update({image.id} if reading.misfit < _MAX_MISFIT else set())
            elif reading.misfit < _MAX_MISFIT:
                good.setdefault(robot, []).append(reading)
            elif reading.residual_m < _SQUARE_SHARE * self._side_m and abs(reading.size - 1.0) < _STRANGEST:
                self.strange_sizes[robot] = reading.size
        self.foreign_ids = frozenset(foreign_ids)
        return good
