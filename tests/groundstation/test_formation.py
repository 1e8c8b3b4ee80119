"""The virtual structure against known geometry and finite differences."""

from typing import Literal

import numpy as np
import pytest

from groundstation.formation import node_motion, structure_rotation
from groundstation.spline import CirclePath, Path, SplinePath
from wire.experiment import Circle, Waypoints
from wire.frames import Array

CURVE = Waypoints(
    kind="waypoints", points_m=((0, 0), (2, 0.5), (3, 2), (2, 3.5), (0, 3), (-1, 1)), speed_mps=0.25, dive_mps=0.05
)
STEP_S = 1e-3
Mode = Literal["translate", "rotate"]


def sampled(path: Path, until_s: float) -> Array:
    return np.arange(0.0, until_s, STEP_S)


@pytest.mark.parametrize("mode", ["translate", "rotate"])
@pytest.mark.parametrize("node", [(0.0, 0.0, 0.0), (0.4, 0.0, 0.0), (-0.3, 0.5, 0.2)])
def test_derivatives_by_finite_differences(mode: Mode, node: tuple[float, float, float]) -> None:
    path = SplinePath(CURVE)
    motion = node_motion(path.at(sampled(path, path.end_s)), np.array(node), mode, STEP_S)
    velocity = (motion.eta[2:] - motion.eta[:-2]) / (2.0 * STEP_S)
    np.testing.assert_allclose(velocity[:, :3], motion.velocity[1:-1, :3], atol=2e-5)
    # The path's third derivative jumps at its four inner waypoints, and with it the acceleration of a turning structure
    # and the yaw rate of its nodes; difference quotients there see both sides.
    acceleration = (motion.velocity[2:] - motion.velocity[:-2]) / (2.0 * STEP_S)
    assert np.quantile(np.abs(velocity[:, 3] - motion.velocity[1:-1, 3]), 0.999) < 2e-5
    assert np.quantile(np.abs(acceleration - motion.acceleration[1:-1]), 0.999) < 1e-4


def test_rotation_is_that_of_equation_16() -> None:
    yaw, climb = np.array([0.3, -2.0]), np.array([0.2, -0.4])
    rot = structure_rotation(yaw, climb)
    for k in range(2):
        psi, theta = yaw[k] - np.pi / 2.0, climb[k]
        about_z = np.array([[np.cos(psi), -np.sin(psi), 0], [np.sin(psi), np.cos(psi), 0], [0, 0, 1]])
        about_x = np.array([[1, 0, 0], [0, np.cos(theta), -np.sin(theta)], [0, np.sin(theta), np.cos(theta)]])
        np.testing.assert_allclose(rot[k], about_z @ about_x, atol=1e-15)
        tangent = [np.cos(climb[k]) * np.cos(yaw[k]), np.cos(climb[k]) * np.sin(yaw[k]), np.sin(climb[k])]
        np.testing.assert_allclose(rot[k] @ [0, 1, 0], tangent, atol=1e-15)  # y_S is the path's tangent


def test_translate_keeps_the_offset_and_the_motion() -> None:
    path = CirclePath(Circle(kind="circle", diameter_m=0.45, lap_s=100.0, depth_m=0.3))
    centre = path.at(sampled(path, 10.0))
    motion = node_motion(centre, np.array([0.4, 0.0, 0.0]), "translate", STEP_S)
    offset = motion.eta[:, :3] - centre.position_m
    np.testing.assert_allclose(offset, np.tile([0.4, 0.0, 0.0], (len(offset), 1)), atol=1e-15)
    np.testing.assert_array_equal(motion.velocity[:, 3], centre.yaw_rate_radps)


def test_rotating_on_a_circle_every_node_flies_its_own_circle() -> None:
    """A node abeam to the outside of a circle of radius R flies radius R + a, at the same angular rate: closed form."""
    radius, arm, rate = 1.0, 0.4, 2.0 * np.pi / 60.0
    path = CirclePath(Circle(kind="circle", diameter_m=2.0 * radius, lap_s=60.0, depth_m=0.3))
    # y_S points along the path, x_S = y_S turned by -90 degrees: outwards on a circle whose heading grows
    motion = node_motion(path.at(sampled(path, 60.0)), np.array([arm, 0.0, 0.0]), "rotate", STEP_S)
    np.testing.assert_allclose(np.hypot(*motion.eta[:, :2].T), radius + arm)
    np.testing.assert_allclose(np.hypot(*motion.velocity[:, :2].T), rate * (radius + arm))
    np.testing.assert_allclose(np.hypot(*motion.acceleration[:, :2].T), rate**2 * (radius + arm))
    np.testing.assert_allclose(motion.velocity[:, 3], rate)


def test_rotating_nodes_stay_rigid_and_head_where_they_go() -> None:
    path = SplinePath(CURVE)
    centre = path.at(sampled(path, path.end_s))
    a = node_motion(centre, np.array([0.4, -0.2, 0.1]), "rotate", STEP_S)
    b = node_motion(centre, np.array([-0.4, 0.3, 0.0]), "rotate", STEP_S)
    np.testing.assert_allclose(np.linalg.norm(a.eta[:, :3] - b.eta[:, :3], axis=1), np.linalg.norm([0.8, -0.5, 0.1]))
    direction = np.column_stack([np.cos(a.eta[:, 3]), np.sin(a.eta[:, 3])])
    speed = np.hypot(*a.velocity[:, :2].T)
    np.testing.assert_allclose(np.sum(direction * a.velocity[:, :2], axis=1), speed, rtol=1e-12)
    assert np.max(np.abs(np.diff(a.eta[:, 3]))) < 0.01  # unwrapped


def test_a_node_at_the_pivot_keeps_the_centres_heading() -> None:
    """The node at the middle of the circle never moves; its heading must still be defined and steady."""
    path = CirclePath(Circle(kind="circle", diameter_m=0.8, lap_s=50.0, depth_m=0.3))
    centre = path.at(sampled(path, 5.0))
    motion = node_motion(centre, np.array([-0.4, 0.0, 0.0]), "rotate", STEP_S)
    np.testing.assert_allclose(motion.velocity[:, :2], 0.0, atol=1e-15)
    np.testing.assert_allclose(motion.eta[:, 3], centre.yaw_rad)
