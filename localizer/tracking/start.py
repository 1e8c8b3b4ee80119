"""Where the experiment expects its robots before anything was seen. Only a fleet without markers depends on it."""

import numpy as np
from scipy.interpolate import CubicSpline

from wire.config.experiment import Experiment
from wire.config.scene import Circle, PathSpec, Route
from wire.frames import Array


def start_poses(experiment: Experiment) -> Array:
    """Expected [x, y, z, yaw] of each robot at the start, shape (robots, 4), pool frame.

    The path's first point and tangent (equations 12, 13), the formation's node (14-16), then the robot's own offset; an
    explicit `start` replaces all of that.
    """
    poses = []
    for robot, node in zip(experiment.robots, experiment.nodes_m(), strict=True):
        centre, tangent_rad = _path_start(experiment.path_of(robot))
        turn = tangent_rad - np.pi / 2 if experiment.formation.mode == "rotate" else 0.0
        c, s = np.cos(turn), np.sin(turn)
        rotation = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
        reference = np.append(centre + rotation @ node, tangent_rad)
        poses.append(np.array(robot.start) if robot.start is not None else reference + np.array(robot.start_offset))
    return np.array(poses)


def _path_start(path: PathSpec) -> tuple[Array, float]:
    """First point (3,) of a path, and the heading of its tangent."""
    if isinstance(path, Circle):
        return np.array([path.diameter_m / 2.0, 0.0, path.depth_m]), np.pi / 2
    if isinstance(path, Route):  # the planner may set out another way, around something; the place is right
        (x, y), (next_x, next_y) = path.via_m[:2]
        return np.array([x, y, path.depth_m]), float(np.arctan2(next_y - y, next_x - x))
    points = np.array(path.points_m)
    along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))])
    spline = CubicSpline(along, points, bc_type="natural")
    tangent = spline(along[path.start_index], 1)
    return np.append(points[path.start_index], path.depth_m), float(np.arctan2(tangent[1], tangent[0]))
