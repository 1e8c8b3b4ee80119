"""Plans: the shipped pool scene is flyable, the article's scene A9 too, and what is not flyable is refused with a reason."""

import math
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from groundstation.planning.feasibility import PICTURE_MARGIN_M, PlanError, figures
from groundstation.planning.planner import description, plan, start_poses
from robot_agent.guidance.trajectory_check import unflyable
from shoal.config.experiment import EXPERIMENTS, NO_CAMERA, Experiment, load_experiment
from shoal.errors import ConfigError
from shoal.messages.codec import decode, encode
from shoal.messages.messages import Trajectory
from sim_bridge.camera.optics import project as exact

ARTICLE_POINTS = [[-4, 1.2], [-2, 0.6], [0, 0], [2, 1.5], [4, 3.8], [6, 5], [10, 3], [12, 2], [15, 2], [18, 1]]


def pool(**changes: Any) -> Experiment:
    """The shipped pool experiment with top-level tables replaced, and no camera in whose picture paths have to stay."""
    table = load_experiment("pool", [NO_CAMERA]).model_dump()
    table.update(changes)
    return Experiment.model_validate(table)


def article(dive_mps: float = 0.05, mode: str = "translate") -> Experiment:
    """The numeric scene: A9 and the triangle of section 4, in a basin deep enough for it."""
    waypoints = {"kind": "waypoints", "points_m": ARTICLE_POINTS, "speed_mps": 0.3, "start_index": 2}
    nodes = [(0.0, -2.0, -2 / 3), (0.0, 2.0, -2 / 3), (0.0, 0.0, 4 / 3)]
    return pool(
        duration_s=50.0,
        pool={"size_m": [60.0, 60.0, 60.0]},
        path={**waypoints, "depth_m": 2.0, "dive_mps": dive_mps},
        formation={"mode": mode},
        robots=[{"id": i, "node_m": node} for i, node in enumerate(nodes, start=1)],
    )


def test_pool_scene_covers_the_run_and_a_horizon_more() -> None:
    experiment = pool()
    trajectories = plan(experiment)
    assert sorted(trajectories) == [1, 2]
    for robot, side in ((1, 0.4), (2, -0.4)):
        trajectory = trajectories[robot]
        assert len(trajectory.eta) == 120 / 0.05 + 1 + experiment.controller.mpc.horizon
        angle = 2.0 * np.pi * 0.05 / 100.0 * np.arange(len(trajectory.eta))
        np.testing.assert_allclose(trajectory.eta[:, 0], side + 0.225 * np.cos(angle), atol=1e-12)
        np.testing.assert_allclose(trajectory.eta[:, 1], 0.225 * np.sin(angle), atol=1e-12)
        np.testing.assert_allclose(trajectory.eta[:, 3], angle + np.pi / 2, atol=1e-12)
    assert trajectories[1].id != trajectories[2].id
    assert trajectories[1].id == plan(experiment)[1].id


def test_trajectories_survive_the_wire() -> None:
    sent = plan(pool())[1]
    received = decode(Trajectory, encode(sent), "test", "trajectory")
    np.testing.assert_array_equal(received.eta, sent.eta)


def test_article_scene_is_flyable_and_keeps_its_triangle() -> None:
    trajectories = plan(article())
    eta = {robot: trajectory.eta[:, :3] for robot, trajectory in trajectories.items()}
    for (i, j), offset in {(1, 2): (0, -4, 0), (1, 3): (0, -2, -2), (2, 3): (0, 2, -2)}.items():
        np.testing.assert_allclose(eta[i] - eta[j], np.tile(offset, (len(eta[i]), 1)), atol=1e-12)
    np.testing.assert_allclose(eta[1][0], [0.0, -2.0, 2.0 - 2 / 3], atol=1e-12)
    np.testing.assert_allclose(eta[1][-1, 2] - eta[1][0, 2], 0.05 * 0.05 * (len(eta[1]) - 1))


def test_half_a_metre_of_depth_a_second_is_refused() -> None:
    """The article prints z_d = 0.5 t (ambiguity A12); the robot heaves 0.26 m/s at most."""
    with pytest.raises(PlanError, match=r"robot 1: heave 0\.500 m/s exceeds the limit 0\.26 by 0\.240 at t = 0\.00 s"):
        plan(article(dive_mps=0.5))


def test_turning_the_article_triangle_is_too_fast_for_the_outer_robots() -> None:
    """A10: with `rotate` an outer node must fly around the bend faster than the centre does."""
    with pytest.raises(PlanError, match=r"robot \d: speed .* exceeds the limit 0\.48"):
        plan(article(mode="rotate"))


def test_wall_names_robot_place_and_excess() -> None:
    with pytest.raises(PlanError) as refused:
        plan(pool(path={"kind": "circle", "diameter_m": 2.5, "lap_s": 100.0, "depth_m": 0.3}))
    # robot 1 reaches x = 0.4 + 1.25; its hull must stay within 1.75
    assert "robot 1: 0.050 m beyond the wall's clearance in x at t = 0.00 s, (1.65, 0.00, 0.30) m" in str(refused.value)
    assert "robot 2: 0.150 m beyond the wall's clearance in y at t = 25.00 s" in str(refused.value)


@pytest.mark.parametrize(("depth_m", "what"), [(0.9, "0.050 m beyond the floor"), (0.0, None)])
def test_floor_counts_the_hull_and_surface_the_centre(depth_m: float, what: str | None) -> None:
    experiment = pool(path={"kind": "circle", "diameter_m": 0.45, "lap_s": 100.0, "depth_m": depth_m})
    if what is None:
        plan(experiment)
    else:
        with pytest.raises(PlanError, match=what):
            plan(experiment)


def test_flying_out_of_the_water_is_refused() -> None:
    robots = [{"id": 1, "node_m": [0.0, 0.0, -0.31]}]
    with pytest.raises(PlanError, match=r"robot 1: 0\.010 m beyond the surface"):
        plan(pool(robots=robots))


def test_robots_too_close_are_named_with_their_distance() -> None:
    robots = [{"id": 4, "node_m": [0.25, 0.0, 0.0]}, {"id": 7, "node_m": [-0.25, 0.0, 0.0]}]
    with pytest.raises(PlanError, match=r"robots 4 and 7: 0\.500 m apart, 0\.100 less than 2 safety\.radius_m = 0\.6 at t"):
        plan(pool(robots=robots))


def test_exactly_two_radii_apart_is_allowed() -> None:
    robots = [{"id": 4, "node_m": [0.3, 0.0, 0.0]}, {"id": 7, "node_m": [-0.3, 0.0, 0.0]}]
    assert sorted(plan(pool(robots=robots))) == [4, 7]


def test_yaw_rate_is_checked() -> None:
    path = {"kind": "circle", "diameter_m": 0.1, "lap_s": 3.0, "depth_m": 0.3}
    with pytest.raises(PlanError, match=r"robot 2: yaw rate 2\.094 rad/s exceeds the limit 1\.9"):
        plan(pool(path=path))


def test_thrust_is_checked_and_a_bend_takes_some_of_it() -> None:
    """0.41 m/s on a radius of 0.5 m: drag 4.592 N ahead, 12 kg x 0.336 m/s^2 inwards. Straight ahead 0.47 m/s take 5.83 N."""
    path = {"kind": "circle", "diameter_m": 1.0, "lap_s": np.pi / 0.41, "depth_m": 0.3}
    with pytest.raises(PlanError, match=rf"robot 1: thrust {np.hypot(4.592, 12.0 * 0.41**2 / 0.5):.3f} N exceeds the limit 6"):
        plan(pool(path=path))
    straight = {"kind": "waypoints", "points_m": [[-15.0, 0.0], [15.0, 0.0]], "speed_mps": 0.47, "depth_m": 0.3}
    plan(pool(path=straight, pool={"size_m": [40.0, 4.0, 1.0]}, duration_s=60.0))


def test_open_water_has_no_walls() -> None:
    path = {"kind": "circle", "diameter_m": 40.0, "lap_s": 1000.0, "depth_m": 20.0}
    experiment = pool(path=path, pool={"size_m": [3.5, 2.5, 1.0], "walls": False})
    assert start_poses(experiment, plan(experiment))[1][0] == pytest.approx(20.49)
    with pytest.raises(PlanError, match="wall"):
        plan(pool(path=path))


def test_a_path_that_leads_out_of_the_pool_just_after_the_run_is_refused_as_robots_would_refuse_it() -> None:
    """They look ahead to the last sample of a trajectory; a run that ends earlier, and a path that stops, are flown."""
    path = {"kind": "waypoints", "points_m": [[-1.4, 0.0], [1.45, 0.0]], "speed_mps": 0.2, "depth_m": 0.3}
    changes = {"pool": {"size_m": [3.5, 2.5, 1.0]}, "robots": [{"id": 1, "node_m": [0.0, 0.0, 0.0]}], "duration_s": 14.2}
    with pytest.raises(PlanError, match=r"robot 1: leaves the pool at t = 15\.75 s.* after the end"):
        plan(pool(path=path, **changes))
    for experiment in (pool(path=path, **changes | {"duration_s": 12.0}), pool(path=path | {"stop": True}, **changes)):
        assert [unflyable(t, experiment.pool, experiment.vehicle) for t in plan(experiment).values()] == [""]


def test_path_shorter_than_the_run_is_refused() -> None:
    path = {"kind": "waypoints", "points_m": [[-0.5, 0.0], [0.5, 0.0]], "speed_mps": 0.1, "depth_m": 0.3}
    with pytest.raises(PlanError, match=r"duration_s = 120: the path ends after 10\.00 s"):
        plan(pool(path=path))


def test_a_path_that_is_over_too_soon_because_it_is_too_fast_says_so_first() -> None:
    path = {"kind": "waypoints", "points_m": [[-0.5, 0.0], [0.5, 0.0]], "speed_mps": 3.0, "depth_m": 0.3}
    with pytest.raises(PlanError) as caught:
        plan(pool(path=path))
    first, *_, last = str(caught.value).splitlines()
    assert first.startswith("robot 1: speed 3.000 m/s exceeds the limit") and "the path ends after 0.33 s" in last


# --- the camera's picture


LARGE = ("pool.size_m=[8,8,1]", "duration_s=60")


def test_a_path_out_of_the_picture_is_refused_with_robot_time_place_and_how_far() -> None:
    """The exact optics say where the picture's edge is: the place, less how far outside, and the hull and 5 cm."""
    settings = [*LARGE, 'path={kind="waypoints",points_m=[[0,0],[2,0]],speed_mps=0.05,depth_m=0.3,stop=true}']
    experiment = load_experiment("pool", settings)
    with pytest.raises(PlanError) as caught:
        plan(experiment)
    (line,) = str(caught.value).splitlines()
    pattern = r"robot 1: ([\d.]+) m beyond the camera's picture at t = ([\d.]+) s, \(([\d.]+), 0.00, 0.30\) m"
    match = re.fullmatch(pattern, line)
    assert match is not None, line
    excess_m, at_s, x_m = map(float, match.groups())
    edge_m = x_m - excess_m + experiment.vehicle.radius_m + PICTURE_MARGIN_M
    u, _ = exact(experiment.camera, np.array([[edge_m, 0.0, 0.3]]))[0]
    assert u == pytest.approx(experiment.camera.size_px[0] - 0.5, abs=8.0), "2 cm, at the scale that is there"
    assert at_s == pytest.approx((x_m - 0.4) / 0.05, abs=1.0)
    plan(load_experiment("pool", [*settings, NO_CAMERA]))


def test_a_start_beside_the_picture_is_refused() -> None:
    experiment = load_experiment("pool", [*LARGE, "robots.1.start=[0.0,1.6,0.3,0.0]"])
    with pytest.raises(PlanError, match=r"robot 2 starts at \(0.00, 1.60, 0.30\) m: 0\.\d+ m beyond the camera's picture"):
        start_poses(experiment, plan(experiment))


def test_a_formation_may_not_grow_out_of_the_picture() -> None:
    grown = [*LARGE, "formation.changes=[{at_s=10,over_s=40,scale=4.5}]"]
    with pytest.raises(PlanError, match=r"robot 2: 0\.\d+ m beyond the camera's picture at t = "):
        plan(load_experiment("pool", grown))


def test_trajectory_too_long_for_a_message_is_refused() -> None:
    with pytest.raises(PlanError, match="a trajectory message holds"):
        plan(pool(duration_s=36000.0))


def test_starts_are_offsets_from_the_reference_or_given_poses() -> None:
    experiment = load_experiment("pool")
    starts = start_poses(experiment, plan(experiment))
    np.testing.assert_allclose(starts[1], [0.625 + 0.09, 0.12, 0.3, np.pi / 2 + 0.3])
    robots = [{**robot.model_dump(), "start": (1.0 - 2 * i, 0.0, 0.3, 0.1)} for i, robot in enumerate(experiment.robots)]
    given = pool(robots=robots)
    np.testing.assert_array_equal(start_poses(given, plan(given))[2], [-1.0, 0.0, 0.3, 0.1])


def test_starts_in_a_wall_or_in_each_other_are_refused() -> None:
    robots = [
        {"id": 1, "node_m": [0.4, 0.0, 0.0], "start": [1.7, 0.0, 0.3, 0.0]},
        {"id": 2, "node_m": [-0.4, 0.0, 0.0], "start": [1.5, 0.0, 0.3, 0.0]},
    ]
    experiment = pool(robots=robots)
    with pytest.raises(PlanError, match=r"robot 1 starts at .* 0\.100 m beyond the wall(.|\n)*robots 1 and 2 start 0\.200 m"):
        start_poses(experiment, plan(experiment))


# --- routes around islands, and formations that change on the way

ISLANDS = load_experiment("islands")


def shores(experiment: Experiment, trajectories: dict[int, Trajectory]) -> float:
    """The least room between a hull and an island."""
    hull = experiment.vehicle.radius_m
    return min(
        float(np.hypot(*(t.eta[:, :2] - island.position_m).T).min()) - island.radius_m - hull
        for t in trajectories.values()
        for island in experiment.islands
    )


def test_a_turning_formation_finds_its_way_between_islands() -> None:
    trajectories = plan(ISLANDS)
    assert shores(ISLANDS, trajectories) >= 0.0
    first = trajectories[1]
    assert first.eta[0, :2] == pytest.approx([-5.7, -7.4], abs=1e-6)
    assert first.eta[-1, :2] == pytest.approx([5.7, 7.4], abs=1e-6)
    way_m = float(np.hypot(*np.diff(first.eta[:, :2], axis=0).T).sum())
    assert math.dist((-5.7, -7.4), (5.7, 7.4)) < way_m < 1.1 * 19.4  # asked for: 1.1 times the shortest known


@pytest.mark.parametrize("seed", range(30))
def test_in_random_waters_a_plan_touches_nothing_or_is_refused(seed: int) -> None:
    random = np.random.default_rng(seed)
    islands = [
        {"position_m": random.uniform(-5, 5, 2).tolist(), "radius_m": float(random.uniform(0.3, 1.2))} for _ in range(4)
    ]
    mode = "rotate" if seed % 2 else "translate"
    table = ISLANDS.model_dump() | {"islands": islands}
    table["formation"] |= {"mode": mode, "changes": [{"at_s": 40.0, "shape": "triangle"}] if seed % 3 == 0 else []}
    experiment = Experiment.model_validate(table)
    try:
        trajectories = plan(experiment)
    except PlanError as error:
        assert "island" in str(error) or "no way" in str(error) or "apart" in str(error)
        return
    assert shores(experiment, trajectories) >= -1e-6
    pairs = [(trajectories[a], trajectories[b]) for a, b in ((1, 2), (1, 3), (2, 3))]
    assert min(float(np.linalg.norm(a.eta[:, :3] - b.eta[:, :3], axis=1).min()) for a, b in pairs) >= 0.6 - 1e-6


def test_a_formation_changes_its_shape_on_the_way() -> None:
    settings = ['formation.changes=[{at_s=40, over_s=15, shape="triangle", spacing_m=1.2}]', "formation.mode=translate"]
    experiment = load_experiment("islands", [*settings, "islands=[]"])
    trajectories = plan(experiment)
    before, after = (np.array([t.eta[round(s / 0.05), :2] for t in trajectories.values()]) for s in (39.0, 56.0))
    apart = [sorted(math.dist(p[a], p[b]) for a, b in ((0, 1), (0, 2), (1, 2))) for p in (before, after)]
    assert apart[0] == pytest.approx([1.2, 1.2, 2.4]) and apart[1] == pytest.approx([1.2, 1.2, 1.2])


def test_a_route_that_cannot_be_is_refused_with_its_reason() -> None:
    with pytest.raises(PlanError, match=r"\(-5\.70, -7\.40\) m: there the formation is .* m too near an island"):
        plan(load_experiment("islands", ["islands=[{position_m=[-5.5,-7.0], radius_m=1.0}]"]))


def test_robots_without_a_node_take_one_of_the_shape(tmp_path: Path) -> None:
    text = (
        (EXPERIMENTS / "pool.toml")
        .read_text()
        .replace("node_m = [0.4, 0.0, 0.0]", "")
        .replace("node_m = [-0.4, 0.0, 0.0]", "")
    )
    path = tmp_path / "shaped.toml"
    path.write_text(text.replace('mode = "translate"', 'mode = "translate"\nshape = "line"\nspacing_m = 0.9'))
    experiment = load_experiment(str(path))
    assert [robot.node_m for robot in experiment.robots] == [(-0.45, 0.0, 0.0), (0.45, 0.0, 0.0)]
    path.write_text(text)
    with pytest.raises(ConfigError, match=r"robots\.0\.node_m"):
        load_experiment(str(path))


@pytest.mark.parametrize(
    ("settings", "reason"),
    [
        (['path.corner="stop"', 'formation.mode="rotate"'], "robot 2: it turns by 3.142 rad at once at t = 23.00 s"),
        (
            ["formation.changes=[{at_s=20.01,over_s=0.02,scale=2.0}]"],
            "robot 1: its place moves by 0.406 m at once at t = 20.00",
        ),
    ],
)
def test_a_pose_that_leaps_is_refused_though_no_velocity_shows_it(settings: list[str], reason: str) -> None:
    """Robots refuse such a trajectory: a page must not say that it can be flown."""
    path = '{kind="waypoints",points_m=[[-1.5,-1.5],[1.5,-1.5],[1.5,1.5]],speed_mps=0.15,depth_m=0.5,slow=true,stop=true}'
    room = ["pool.size_m=[9,8,1.5]", NO_CAMERA, f"path={path}", "duration_s=60", "article=[]"]
    with pytest.raises(PlanError, match=reason):
        plan(load_experiment("pool", [*room, *settings]))


@pytest.mark.parametrize(
    ("apart_m", "says"),
    [((0.45, 0.8), "between centres, as they lie now"), ((0.8, 0.45), "between centres"), ((0.8, 0.9), "between centres")],
)
def test_robots_that_lie_too_near_and_leave_are_told_from_a_plan_that_brings_them_together(
    apart_m: tuple[float, float], says: str
) -> None:
    still = np.zeros((50, 4))
    leaves = still + np.linspace(*apart_m, 50)[:, None] * [1.0, 0.0, 0.0, 0.0]
    plans = {r: Trajectory(f"t{r}", 0.05, eta, still, still) for r, eta in ((1, still), (2, leaves))}
    assert figures(pool(), plans, 50)[0].what == says


@pytest.mark.parametrize("name", ["swap", "crossing-2", "crossing-4", "overtake"])
def test_a_plan_that_can_be_flown_shows_no_figure_beyond_what_is_allowed(name: str) -> None:
    """Robots on paths of their own give way to each other: how near their paths come says nothing against the plan."""
    experiment = load_experiment(name)
    for figure in figures(experiment, plan(experiment), round(experiment.duration_s / experiment.controller.period_s) + 1):
        over = figure.limit - figure.value if figure.least else figure.value - figure.limit
        assert over < 1e-6, figure


@pytest.mark.parametrize(
    ("settings", "says"),
    [
        (["duration_s=30"], "path flown 75.00 % (at most 100.00)"),
        (["duration_s=30", "path.stop=true"], "path flown 75.00 % (at least 100.00)"),
        (["duration_s=30", "path.stop=true", "path.slow=true"], "path flown 75.00 % (at least 100.00)"),
        (["duration_s=60", "path.stop=true"], "path flown 100.00 % (at least 100.00)"),
        (["duration_s=30", 'path.corner="round"'], "path flown 75.00 % (at most 100.00)"),
        (["duration_s=30", 'path.corner="stop"'], "path flown 69.77 %"),  # 30 s of 43: from rest to rest
    ],
)
def test_a_plan_shows_how_much_of_its_path_the_duration_allows(settings: list[str], says: str) -> None:
    """4 m at 0.1 m/s. A path that was to stop at its end was flown for 120 s of 130 s, and its robots were disarmed on a side;
    that it can be flown was all that a person had been shown."""
    straight = '{kind="waypoints",points_m=[[-2,0],[2,0]],speed_mps=0.1,depth_m=0.5}'
    room = ["pool.size_m=[9,8,1.5]", NO_CAMERA, f"path={straight}", "article=[]"]
    lines = description(load_experiment("pool", [*room, *settings]))
    assert [line for line in lines if line.startswith(says)], lines


def test_a_path_without_an_end_shows_no_share_of_it() -> None:
    assert not [line for line in description(pool()) if "path" in line]
