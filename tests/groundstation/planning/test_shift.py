"""Shifted plans: another form on any common path, and past an obstacle on every lap, each as smooth as what it replaces."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from groundstation.planning.feasibility import PlanError
from groundstation.planning.replanning import replan
from groundstation.planning.segment import PlanSegment, first_segment, sample
from groundstation.planning.shift import in_form, reshape
from robot_agent.guidance.reference import splice_objection
from shoal.config.experiment import Experiment, load_experiment
from shoal.config.formation_shapes import shape_nodes
from shoal.config.scene import read_form
from shoal.frames import Array
from shoal.messages.messages import Trajectory
from tests.groundstation.planning.smoothness import check_smooth

PERIOD_S = 0.05
AT_S = 15.0
SQUARE = 'path={kind="waypoints",points_m=[[-2,-1.5],[2,-1.5],[2,1.5],[-2,1.5]],laps=2,speed_mps=0.15,depth_m=0.5,slow=true}'
WIDE = ["pool.size_m=[12,9,1.5]", "duration_s=100", "localizer.uses_camera=false", SQUARE]


@pytest.fixture(scope="module")
def laps() -> Experiment:
    return load_experiment("numeric", WIDE)


def apart_m(segment: PlanSegment, at_s: float) -> Array:
    """Distances of the robots from their mean, in the order of their ids."""
    places = np.array([sample(t, np.array([at_s])).eta[0, :2] for _, t in sorted(segment.trajectories.items())])
    return np.asarray(places - places.mean(axis=0))


@pytest.mark.parametrize("mode", ["translate", "rotate"])
def test_the_formation_takes_the_shape_that_was_asked_for_and_joins_its_plan_without_a_jump(mode: str) -> None:
    experiment = load_experiment("numeric", [*WIDE, f"formation.mode={mode}"])
    before = first_segment(experiment)
    after = reshape(experiment, before, AT_S, read_form("line 1.0", AT_S))
    for slot, trajectory in after.trajectories.items():
        assert splice_objection(before.trajectories[slot], trajectory) == ""
        check_smooth(trajectory, to_row=round((after.end_s - AT_S) / PERIOD_S))
    places_m, line = apart_m(after, AT_S + 70.0), shape_nodes("line", len(after.trajectories), 1.0)[:, :2]
    gaps = np.sort(np.linalg.norm(places_m[:, None] - places_m[None], axis=2), axis=None)
    assert np.allclose(gaps, np.sort(np.linalg.norm(line[:, None] - line[None], axis=2), axis=None), atol=0.02)
    if mode == "translate":
        assert abs(np.ptp(places_m[:, 1])) < 1e-6  # the line lies along x, as the shape says


def test_a_second_form_replaces_the_first_one_and_a_detour_keeps_it(laps: Experiment) -> None:
    line = reshape(laps, first_segment(laps), AT_S, read_form("line 1.0", AT_S))
    column = reshape(laps, line, 40.0, read_form("column 1.0", 40.0))
    assert np.ptp(apart_m(column, 90.0)[:, 0]) < 1e-6 < 1.0 < np.ptp(apart_m(column, 90.0)[:, 1])
    x, y = sample(line.centre, np.array([70.0])).eta[0, :2]
    detour = replan(laps, line, 40.0, np.array([[x, y, 0.1]]))
    assert np.ptp(apart_m(detour, 70.0)[:, 1]) < 1e-6
    assert np.ptp(apart_m(in_form(laps, line, 40.0, read_form("column 1.0", 0.0)[0]), 40.0)[:, 0]) < 1e-6


@pytest.mark.parametrize("takes", [in_form, reshape])
def test_a_robot_at_rest_at_the_end_keeps_the_heading_that_its_form_gives_it(takes: Callable[..., PlanSegment]) -> None:
    """Behind its end a trajectory is at rest, and plans from rest may hold a sample of that."""
    circle = ['path={kind="circle",lap_s=40,diameter_m=0.8,depth_m=0.5}', "duration_s=60", "pool.size_m=[9,9,1.5]"]
    experiment = load_experiment("numeric", ["formation.mode=rotate", "localizer.uses_camera=false", *circle])
    whole = first_segment(experiment)
    rests = {slot: _at_rest_from(trajectory, -1) for slot, trajectory in whole.trajectories.items()}
    before = replace(whole, trajectories=rests, centre=_at_rest_from(whole.centre, -1))
    changes = read_form("turn 30", AT_S)
    after = takes(experiment, before, AT_S, changes[0] if takes is in_form else changes)
    for trajectory in after.trajectories.values():
        assert np.abs(np.diff(trajectory.eta[-20:, 3])).max() < 0.02


def _at_rest_from(trajectory: Trajectory, row: int) -> Trajectory:
    velocity, acceleration = trajectory.velocity.copy(), trajectory.acceleration.copy()
    velocity[row:], acceleration[row:] = 0.0, 0.0
    return replace(trajectory, velocity=velocity, acceleration=acceleration)


def test_an_obstacle_on_a_lapped_path_is_passed_on_every_lap(laps: Experiment) -> None:
    before = first_segment(laps)
    ball = np.array([[2.2, 0.5, 0.15]])
    after = replan(laps, before, 2.0, ball)

    def passages(segment: PlanSegment) -> int:
        time_s = np.arange(2.0, segment.end_s, PERIOD_S)
        near = np.zeros(len(time_s), dtype=bool)
        for trajectory in segment.trajectories.values():
            near |= np.hypot(*(sample(trajectory, time_s).eta[:, :2] - ball[0, :2]).T) < 0.15 + laps.safety.radius_m
        return int(np.count_nonzero(np.diff(near.astype(int)) > 0))

    assert passages(before) >= 2
    assert passages(after) == 0
    assert after.end_s == before.end_s
    for trajectory in after.trajectories.values():
        p, v, a = (
            each[: round((after.end_s - 2.0) / PERIOD_S), :3]
            for each in (trajectory.eta, trajectory.velocity, trajectory.acceleration)
        )
        assert np.abs(np.diff(p, axis=0) / PERIOD_S - 0.5 * (v[1:] + v[:-1])).max() < 2e-3
        assert np.abs(np.diff(v, axis=0) / PERIOD_S - 0.5 * (a[1:] + a[:-1])).max() < 5e-3


def test_no_way_past_is_one_sentence_that_names_the_obstacle() -> None:
    pool = load_experiment("pool")  # a circle of half a metre, all of it beside the ball
    x, y = first_segment(pool).centre.eta[800, :2]
    with pytest.raises(PlanError) as refused:
        replan(pool, first_segment(pool), 20.0, np.array([[x, y, 0.1]]))
    assert str(refused.value).startswith(f"beside the obstacle at ({x:.2f}, {y:.2f}) m: ")
    assert "\n" not in str(refused.value) and "island" not in str(refused.value)


@pytest.mark.parametrize(
    ("text", "why"),
    [
        ("", "which form"),
        ("over 20", "which form"),
        ("trinagle 1", "'trinagle': must read"),
        ("line x", "spacing x: must be a number"),
        ("line 0.8 0.9", "'0.9': must read"),
        ("line 0.8 turn", "turn : must be a number"),
        ("turn nan", "turn nan: must be a number"),
        ("spacing 0.8", "'spacing': must read"),
    ],
)
def test_a_form_that_is_none_is_refused_with_what_is_allowed(text: str, why: str) -> None:
    with pytest.raises(ValueError, match=why.replace("(", r"\(")):
        read_form(text, 0.0)


def test_a_form_is_read_with_its_spacing_turn_and_pace() -> None:
    (change,) = read_form("diamond 0.9 turn 90 over 12", 3.0)
    assert (change.shape, change.spacing_m, change.over_s, change.at_s) == ("diamond", 0.9, 12.0, 3.0)
    assert change.turn_rad == pytest.approx(np.pi / 2)
    assert [each.over_s for each in read_form("turn 45", 0.0)] == [8.0, 14.0, 25.0, 45.0]
