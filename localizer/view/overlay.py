"""The preview picture: the camera's frame at half scale, with the localizer's results drawn over it."""

from collections.abc import Callable

import cv2
import numpy as np

from localizer.camera_model import RefractiveCamera
from localizer.detection.image_regions import BAYER_TO_BGR, Pixels
from localizer.tracking.fleet_localizer import FleetLocalizer, LocalizationResult
from localizer.view.drawing import polyline, write
from shoal.frames import Array, body_to_pool
from shoal.messages.messages import Obstacles, Pose, Track

ToPx = Callable[[Array], Array]

_SIZE_PX = (640, 480)
_COLOURS = {  # BGR
    Track.LOST: (60, 60, 220),
    Track.COAST: (40, 160, 250),
    Track.KCF: (230, 200, 60),
    Track.MARKER: (90, 220, 90),
}
_OBSTACLE = (200, 60, 230)
_AHEAD_S = 1.0  # s of an obstacle's motion that its arrow shows
_ELLIPSE_SIGMAS = 3.0
_ELLIPSE_POINTS = 24


def draw(
    locator: FleetLocalizer, frame: Pixels, result: LocalizationResult, obstacles: Obstacles, labels: bool = True
) -> Pixels:
    """Draw a BGR picture (480, 640, 3) of a Bayer `frame` (height, width) uint8 of any size.

    It shows each robot's outline, heading, three-sigma ellipse, id and correlation peak, and each obstacle's outline,
    number and motion in a second. A question mark is an unverified identity; the status message is a line at the top. Without
    `labels` robots have no id and peak: the operator's page writes its own beside them.
    """
    height, width = frame.shape[:2]
    colour = cv2.cvtColor(frame, BAYER_TO_BGR)
    picture = np.asarray(cv2.resize(colour, _SIZE_PX, interpolation=cv2.INTER_AREA), dtype=np.uint8)
    scale = np.array(_SIZE_PX) / (width, height)
    for robot, pose in result.poses:
        corner = _draw_robot(picture, locator, result.view, pose, scale)
        if labels:
            label = f"{robot}{'' if pose.identity_verified else '?'} {pose.track.name.lower()} {pose.peak:.2f}"
            write(picture, label, corner, _COLOURS[pose.track])
    for number, outline, velocity in zip(obstacles.ids, obstacles.outline, obstacles.velocity, strict=True):
        _draw_obstacle(picture, _at(result.view, obstacles.depth_m, scale), number, outline, velocity)
    write(picture, result.status.message, np.array([8, 18]), (60, 60, 220))
    return picture


def _draw_robot(picture: Pixels, locator: FleetLocalizer, view: RefractiveCamera, pose: Pose, scale: Array) -> Array:
    """Returns the pixel (2,) at which a label fits."""
    plate_m = pose.depth_m - locator.marker_height_m
    place = np.array([pose.x_m, pose.y_m])
    to_px = _at(view, plate_m, scale)
    colour = _COLOURS[pose.track]
    turn = np.linspace(0.0, 2.0 * np.pi, _ELLIPSE_POINTS, endpoint=False)
    circle = np.column_stack([np.cos(turn), np.sin(turn)])
    radius_m = locator.radius_m
    box = radius_m * np.array([[1.0, -1.0], [1.0, 1.0], [-1.0, 1.0], [-1.0, -1.0]])
    polyline(picture, to_px(place + body_to_pool(box, pose.yaw_rad)), colour, closed=True)
    values, axes = np.linalg.eigh(pose.covariance[:2, :2])
    ellipse = _ELLIPSE_SIGMAS * (circle * np.sqrt(np.maximum(values, 0.0))) @ axes.T
    polyline(picture, to_px(place + ellipse), colour, closed=True)
    polyline(picture, to_px(place + body_to_pool(np.array([[0.0, 0.0], [1.3 * radius_m, 0.0]]), pose.yaw_rad)), colour, 2)
    return np.asarray(to_px((place + np.array([-radius_m, -1.2 * radius_m]))[None])[0])


def _draw_obstacle(picture: Pixels, to_px: ToPx, number: int, outline_m: Array, velocity_mps: Array) -> None:
    middle = outline_m.mean(axis=0)
    corners = to_px(outline_m)
    polyline(picture, corners, _OBSTACLE, closed=True)
    polyline(picture, to_px(np.stack([middle, middle + _AHEAD_S * velocity_mps])), _OBSTACLE, 2)
    write(picture, f"obstacle {number}", corners.min(axis=0) - np.array([0.0, 4.0]), _OBSTACLE)


def _at(view: RefractiveCamera, depth_m: float, scale: Array) -> ToPx:
    """The mapping from points (n, 2) of the pool at one depth to the preview's pixels (n, 2)."""

    def nearby_px(points_m: Array) -> Array:
        pixels = view.pool_to_pixel(np.column_stack([points_m, np.full(len(points_m), depth_m)]))
        return (pixels + 0.5) * scale - 0.5  # pixel centres, not corners

    return nearby_px
