"""The virtual structure against known geometry and finite differences."""

import itertools
from typing import Literal

import numpy as np
import pytest

from groundstation.planning.formation import NodeMotion, node_motion, slot_offsets, structure_rotation
from groundstation.planning.paths import CirclePath, Path, PathState, SplinePath
from shoal.config.formation_shapes import SHAPES, Shape, shape_nodes
from shoal.config.scene import Change, Circle, Waypoints
from shoal.frames import Array

CURVE = Waypoints(
    kind="waypoints", points_m=((0, 0), (2, 0.5), (3, 2), (2, 3.5), (0, 3), (-1, 1)), speed_mps=0.25, dive_mps=0.05
)
STEP_S = 1e-3
Mode = Literal["translate", "rotate"]


def kept(centre: PathState, node: tuple[float, float, float], mode: Mode) -> NodeMotion:
    """The motion of a node that stays where it is in the structure."""
    return node_motion(centre, slot_offsets(np.array([node]), (), np.zeros(len(centre.yaw_rad)))[0], mode, STEP_S)


def sampled(path: Path, until_s: float) -> Array:
    return np.arange(0.0, until_s, STEP_S)


@pytest.mark.parametrize("mode", ["translate", "rotate"])
@pytest.mark.parametrize("node", [(0.0, 0.0, 0.0), (0.4, 0.0, 0.0), (-0.3, 0.5, 0.2)])
def test_derivatives_by_finite_differences(mode: Mode, node: tuple[float, float, float]) -> None:
    path = SplinePath(CURVE)
    motion = kept(path.at(sampled(path, path.end_s)), node, mode)
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
    motion = kept(centre, (0.4, 0.0, 0.0), "translate")
    offset = motion.eta[:, :3] - centre.position_m
    np.testing.assert_allclose(offset, np.tile([0.4, 0.0, 0.0], (len(offset), 1)), atol=1e-15)
    np.testing.assert_array_equal(motion.velocity[:, 3], centre.yaw_rate_radps)


def test_rotating_on_a_circle_every_node_flies_its_own_circle() -> None:
    """A node abeam to the outside of a circle of radius R flies radius R + a, at the same angular rate: closed form."""
    radius, arm, rate = 1.0, 0.4, 2.0 * np.pi / 60.0
    path = CirclePath(Circle(kind="circle", diameter_m=2.0 * radius, lap_s=60.0, depth_m=0.3))
    # y_S points along the path, x_S = y_S turned by -90 degrees: outwards on a circle whose heading grows
    motion = kept(path.at(sampled(path, 60.0)), (arm, 0.0, 0.0), "rotate")
    np.testing.assert_allclose(np.hypot(*motion.eta[:, :2].T), radius + arm)
    np.testing.assert_allclose(np.hypot(*motion.velocity[:, :2].T), rate * (radius + arm))
    np.testing.assert_allclose(np.hypot(*motion.acceleration[:, :2].T), rate**2 * (radius + arm))
    np.testing.assert_allclose(motion.velocity[:, 3], rate)


def test_rotating_nodes_stay_rigid_and_head_where_they_go() -> None:
    path = SplinePath(CURVE)
    centre = path.at(sampled(path, path.end_s))
    a = kept(centre, (0.4, -0.2, 0.1), "rotate")
    b = kept(centre, (-0.4, 0.3, 0.0), "rotate")
    np.testing.assert_allclose(np.linalg.norm(a.eta[:, :3] - b.eta[:, :3], axis=1), np.linalg.norm([0.8, -0.5, 0.1]))
    direction = np.column_stack([np.cos(a.eta[:, 3]), np.sin(a.eta[:, 3])])
    speed = np.hypot(*a.velocity[:, :2].T)
    np.testing.assert_allclose(np.sum(direction * a.velocity[:, :2], axis=1), speed, rtol=1e-12)
    assert np.max(np.abs(np.diff(a.eta[:, 3]))) < 0.01  # unwrapped


def test_a_node_at_the_pivot_keeps_the_centres_heading() -> None:
    """The node at the middle of the circle never moves; its heading must still be defined and steady."""
    path = CirclePath(Circle(kind="circle", diameter_m=0.8, lap_s=50.0, depth_m=0.3))
    centre = path.at(sampled(path, 5.0))
    motion = kept(centre, (-0.4, 0.0, 0.0), "rotate")
    np.testing.assert_allclose(motion.velocity[:, :2], 0.0, atol=1e-15)
    np.testing.assert_allclose(motion.eta[:, 3], centre.yaw_rad)


# --- other forms on the way

DIAMOND = shape_nodes("diamond", 4, 0.8)
CHANGES = (
    Change(at_s=2.0, over_s=4.0, shape="line", spacing_m=0.7),
    Change(at_s=7.0, over_s=3.0, scale=1.5, turn_rad=0.9),
    Change(at_s=11.0, over_s=4.0, shape="circle", spacing_m=0.9, turn_rad=-0.4),
)


@pytest.mark.parametrize("robot", range(4))
@pytest.mark.parametrize("mode", ["translate", "rotate"])
def test_derivatives_of_a_changing_form_by_finite_differences(mode: Mode, robot: int) -> None:
    path = CirclePath(Circle(kind="circle", diameter_m=3.0, lap_s=60.0, depth_m=0.3))
    time = sampled(path, 16.0)
    offset = slot_offsets(DIAMOND + np.arange(4)[:, None] * [0.0, 0.0, 0.05], CHANGES, time)[robot]
    motion = node_motion(path.at(time), offset, mode, STEP_S)
    velocity = (motion.eta[2:] - motion.eta[:-2]) / (2.0 * STEP_S)
    acceleration = (motion.velocity[2:] - motion.velocity[:-2]) / (2.0 * STEP_S)
    np.testing.assert_allclose(velocity[:, :3], motion.velocity[1:-1, :3], atol=2e-6)
    # A change begins and ends with a jump in the third derivative: difference quotients there see both sides.
    assert np.quantile(np.abs(acceleration - motion.acceleration[1:-1])[:, :3], 0.999) < 2e-5
    np.testing.assert_allclose(acceleration[:, :3], motion.acceleration[1:-1, :3], atol=1e-3)
    speed = np.hypot(*motion.velocity[:, :2].T)
    heading = np.stack([np.cos(motion.eta[:, 3]), np.sin(motion.eta[:, 3])], axis=1)
    np.testing.assert_allclose(np.sum(heading * motion.velocity[:, :2], axis=1), speed, atol=1e-9)


def ended(nodes: Array, *changes: Change) -> Array:
    """Nodes after all changes."""
    return np.array([offset.place_m[-1] for offset in slot_offsets(nodes, changes, np.array([0.0, 1e4]))])


def test_a_change_ends_in_the_form_that_was_asked_for() -> None:
    line = ended(DIAMOND, Change(at_s=1.0, shape="line", spacing_m=0.7))
    assert sorted(line[:, 0]) == pytest.approx([-1.05, -0.35, 0.35, 1.05]) and np.abs(line[:, 1:]).max() < 1e-12
    twice = ended(DIAMOND, Change(at_s=1.0, scale=2.0, turn_rad=np.pi / 2))
    assert twice[:, 0] == pytest.approx(-2.0 * DIAMOND[:, 1]) and twice[:, 1] == pytest.approx(2.0 * DIAMOND[:, 0])


@pytest.mark.parametrize("seed", range(20))
def test_robots_take_the_nodes_that_cost_least_and_stay_apart(seed: int) -> None:
    """Against all permutations; and, as they are far apart to begin with, never closer than 1/sqrt(2) of that."""
    random = np.random.default_rng(seed)
    count, before, after = int(random.integers(2, 6)), *random.choice(SHAPES, 2)
    nodes = shape_nodes(before, count, 1.0)[random.permutation(count)]
    change = Change(at_s=0.0, over_s=10.0, shape=after, spacing_m=1.0, turn_rad=float(random.uniform(-3.0, 3.0)))
    places = np.array([c.place_m for c in slot_offsets(nodes, (change,), np.linspace(0.0, 10.0, 200))])
    cost = np.sum((places[:, -1] - nodes) ** 2)
    others = (np.sum((places[list(order), -1] - nodes) ** 2) for order in itertools.permutations(range(count)))
    assert cost <= min(others) + 1e-9
    apart = [np.linalg.norm(places[a] - places[b], axis=1).min() for a, b in itertools.combinations(range(count), 2)]
    assert min(apart) > 1.0 / np.sqrt(2.0) - 1e-9


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("count", [1, 2, 3, 4, 5, 6, 10, 20])
def test_shapes_keep_their_spacing(shape: Shape, count: int) -> None:
    nodes = shape_nodes(shape, count, 0.8)
    assert nodes.shape == (count, 3) and np.abs(nodes.mean(axis=0)).max() < 1e-9
    apart = [np.linalg.norm(a - b) for a, b in itertools.combinations(nodes, 2)]
    assert min(apart, default=0.8) == pytest.approx(0.8)
    assert nodes[0, 1] == pytest.approx(nodes[:, 1].max())  # the first robot leads
    assert np.unique(nodes.round(6), axis=0).shape[0] == count
