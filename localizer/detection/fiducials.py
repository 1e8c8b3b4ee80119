"""ArUco markers (DICT_4X4_50) on the robots' backs: identity, place and heading, from a region or the whole picture.

Settings are for markers of 24 px and more, seen from straight above: one threshold pass instead of OpenCV's three, no error
correction (4x4_50 differs in only 4 bits, so a corrected reading may be a neighbour's), corners to sub-pixel.
"""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from localizer.camera_model import PoolView
from localizer.detection.image_regions import Region
from wire.frames import Array

_MAX_MISFIT = 0.12  # of the side: more is another depth (20 % of size), a reflection or no marker at all
_SHORTEST_SIDE_PX = 14.0  # below this the 6 cells of a side are too few pixels each to be read
_LONGEST_RATE = 3.99  # OpenCV's upper bound of a marker's perimeter over the picture's longer side


@dataclass(frozen=True)
class MarkerImage:
    """One marker as found in the picture: corners (4, 2) px in ArUco's order, from upper left clockwise."""

    id: int
    corners_px: Array


@dataclass(frozen=True)
class MarkerPose:
    """A marker in the pool frame: [x, y, yaw], its upper edge ahead, and by how much it is no square of the right size:
    the corners' distance from one, relative to its side."""

    pose: Array
    misfit: float


def find_markers(detector: cv2.aruco.ArucoDetector, region: Region) -> list[MarkerImage]:
    """Markers in a region, corners in pixels of the whole picture; sorted by id and place."""
    grey = region.grey()
    settings = detector.getDetectorParameters()
    settings.minMarkerPerimeterRate = min(4.0 * _SHORTEST_SIDE_PX / max(grey.shape), _LONGEST_RATE / 2.0)
    detector.setDetectorParameters(settings)
    corners, ids, _ = detector.detectMarkers(grey)
    if ids is None:
        return []
    shift = np.array([region.left_px, region.top_px], dtype=np.float64)
    pairs = zip(np.ravel(ids), corners, strict=True)
    found = [MarkerImage(int(i), np.asarray(quad, dtype=np.float64).reshape(4, 2) + shift) for i, quad in pairs]
    return sorted(found, key=lambda marker: (marker.id, *marker.corners_px[0]))


def marker_detector() -> cv2.aruco.ArucoDetector:
    """OpenCV's detector with the settings of this page."""
    settings = cv2.aruco.DetectorParameters()
    settings.adaptiveThreshWinSizeMin = settings.adaptiveThreshWinSizeMax = 23  # px: 4 cells, so that no cell goes hollow
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
    return cv2.aruco.ArucoDetector(cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50), settings)


def square(side_m: float) -> Array:
    """Corners (4, 2) of a marker in its own frame, in ArUco's order: upper edge ahead, y to starboard."""
    half = side_m / 2.0
    return np.array([[half, -half], [half, half], [-half, half], [-half, -half]])


def marker_pose(image: MarkerImage, view: PoolView, depth_m: float, side_m: float) -> MarkerPose:
    """Where a marker lies, its plate at `depth_m`: a square fitted to the four corners by least squares in the POOL frame.
    An angle between pixels is no heading once lens and water have bent the picture (up to 1.5 deg in the pool's corners)."""
    flat = square(side_m)
    corners = view.pool(image.corners_px, depth_m)
    centre = corners.mean(axis=0)
    seen = corners - centre
    yaw = np.arctan2(np.sum(flat[:, 0] * seen[:, 1] - flat[:, 1] * seen[:, 0]), np.sum(flat * seen))
    c, s = np.cos(yaw), np.sin(yaw)
    misfit = np.max(np.abs(seen - flat @ np.array([[c, s], [-s, c]]))) / side_m
    return MarkerPose(np.append(centre, yaw), float(misfit))


class MarkerReader:
    """Reads the fleet's markers into poses."""

    def __init__(self, side_m: float, robot_of_marker: Mapping[int, int]) -> None:
        self._side_m, self._robot_of_marker = side_m, dict(robot_of_marker)
        self.strangers: frozenset[int] = (
            frozenset()
        )  # ids in the last regions that are no robot's, though squares of their size
        self._detector = marker_detector()

    def read(self, view: PoolView, regions: Iterable[Region], plates_m: NDArray[np.float64]) -> dict[int, MarkerPose]:
        """Poses by robot (index), from regions that may overlap; `plates_m` (robots,) are the depths of their plates.
        Of two markers alike (a reflection) the better square counts."""
        best: dict[int, MarkerPose] = {}
        strangers = set()
        for image in (image for region in regions for image in find_markers(self._detector, region)):
            robot = self._robot_of_marker.get(image.id)
            depth_m = float(plates_m.mean() if robot is None else plates_m[robot])
            reading = marker_pose(image, view, depth_m, self._side_m)
            if robot is None:
                strangers.update({image.id} if reading.misfit < _MAX_MISFIT else set())
            elif reading.misfit < (best[robot].misfit if robot in best else _MAX_MISFIT):
                best[robot] = reading
        self.strangers = frozenset(strangers)
        return best
