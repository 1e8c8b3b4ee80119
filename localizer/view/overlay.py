"""The preview picture for people: what the camera sees at half scale, and what the localizer makes of it."""

from collections.abc import Callable

import cv2
import numpy as np

from localizer.camera_model import PoolView
from localizer.detection.image_regions import BAYER_TO_BGR, Pixels
from localizer.tracking.fleet_localizer import Located, Locator
from wire.frames import Array, body_to_pool
from wire.messages.messages import Obstacles, Pose, Track

ToPx = Callable[[Array], Array]

_SIZE_PX = (640, 480)
_COLOURS = {  # BGR
    Track.LOST: (60, 60, 220),
    Track.COAST: (40, 160, 250),
    Track.KCF: (230, 200, 60),
    Track.MARKER: (90, 220, 90),
}
_OBSTACLE = (200, 60, 230)
_AHEAD_S = 1.0  # of an obstacle's way that is shown
_ELLIPSE_SIGMAS = 3.0
_ELLIPSE_POINTS = 24
_FRACTION_BITS = 4  # OpenCV draws in 16ths of a pixel


def draw(locator: Locator, frame: Pixels, located: Located, obstacles: Obstacles) -> Pixels:
    """A BGR picture (480, 640, 3) of a Bayer `frame` (height, width) uint8 of any size: each robot's outline, heading,
    three-sigma ellipse, id and correlation peak; each obstacle's outline, number and way in a second. A doubted identity is a
    question mark; trouble is a line at the top."""
    height, width = frame.shape[:2]
    colour = cv2.cvtColor(frame, BAYER_TO_BGR)
    picture = np.asarray(cv2.resize(colour, _SIZE_PX, interpolation=cv2.INTER_AREA), dtype=np.uint8)
    scale = np.array(_SIZE_PX) / (width, height)
    for robot, pose in located.poses:
        _draw_robot(picture, locator, located.view, robot, pose, scale)
    for number, outline, velocity in zip(obstacles.ids, obstacles.outline, obstacles.velocity, strict=True):
        _draw_obstacle(picture, _at(located.view, obstacles.depth_m, scale), number, outline, velocity)
    _write(picture, located.status.message, (8, 18), (60, 60, 220))
    return picture


def _draw_robot(picture: Pixels, locator: Locator, view: PoolView, robot: int, pose: Pose, scale: Array) -> None:
    plate_m = pose.depth_m - locator.marker_height_m
    place = np.array([pose.x_m, pose.y_m])
    to_px = _at(view, plate_m, scale)
    colour = _COLOURS[pose.track]
    turn = np.linspace(0.0, 2.0 * np.pi, _ELLIPSE_POINTS, endpoint=False)
    circle = np.column_stack([np.cos(turn), np.sin(turn)])
    radius_m = locator.radius_m
    box = radius_m * np.array([[1.0, -1.0], [1.0, 1.0], [-1.0, 1.0], [-1.0, -1.0]])
    _polygon(picture, to_px(place + body_to_pool(box, pose.yaw_rad)), colour)
    values, axes = np.linalg.eigh(pose.covariance[:2, :2])
    ellipse = _ELLIPSE_SIGMAS * (circle * np.sqrt(np.maximum(values, 0.0))) @ axes.T
    _polygon(picture, to_px(place + ellipse), colour)
    tail, tip = _fixed(to_px(place + body_to_pool(np.array([[0.0, 0.0], [1.3 * radius_m, 0.0]]), pose.yaw_rad)))
    cv2.line(picture, tail, tip, colour, 2, cv2.LINE_AA, _FRACTION_BITS)
    corner = to_px((place + np.array([-radius_m, -1.2 * radius_m]))[None])[0]
    label = f"{robot}{'' if pose.identity_verified else '?'} {pose.track.name.lower()} {pose.peak:.2f}"
    _write(picture, label, (round(corner[0]), round(corner[1])), colour)


def _draw_obstacle(picture: Pixels, to_px: ToPx, number: int, outline_m: Array, velocity_mps: Array) -> None:
    middle = outline_m.mean(axis=0)
    corners = to_px(outline_m)
    _polygon(picture, corners, _OBSTACLE)
    tail, tip = _fixed(to_px(np.stack([middle, middle + _AHEAD_S * velocity_mps])))
    cv2.line(picture, tail, tip, _OBSTACLE, 2, cv2.LINE_AA, _FRACTION_BITS)
    left, top = corners.min(axis=0)
    _write(picture, f"obstacle {number}", (round(left), round(top) - 4), _OBSTACLE)


def _at(view: PoolView, depth_m: float, scale: Array) -> ToPx:
    """From points (n, 2) of the pool, all as deep, to the preview's pixels (n, 2)."""

    def to_px(points_m: Array) -> Array:
        pixels = view.pixel(np.column_stack([points_m, np.full(len(points_m), depth_m)]))
        return (pixels + 0.5) * scale - 0.5  # pixel centres, not corners

    return to_px


def _fixed(points_px: Array) -> list[tuple[int, int]]:
    fixed = np.round(np.clip(points_px, -1e4, 1e4) * 2**_FRACTION_BITS).astype(int)
    return [(int(x), int(y)) for x, y in fixed]


def _polygon(picture: Pixels, points_px: Array, colour: tuple[int, int, int]) -> None:
    cv2.polylines(picture, [np.array(_fixed(points_px), dtype=np.int32)], True, colour, 1, cv2.LINE_AA, _FRACTION_BITS)


def _write(picture: Pixels, text: str, at: tuple[int, int], colour: tuple[int, int, int]) -> None:
    for ink, (dx, dy) in (((0, 0, 0), (1, 1)), (colour, (0, 0))):  # a shadow keeps it readable over caustics
        cv2.putText(picture, text, (at[0] + dx, at[1] + dy), cv2.FONT_HERSHEY_SIMPLEX, 0.45, ink, 1, cv2.LINE_AA)
