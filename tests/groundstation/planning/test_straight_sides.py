"""Paths with straight sides are straight, turn where they should, and have the derivatives that differences give."""

import resource
import time

import numpy as np
import pytest

from groundstation.planning.feasibility import PlanError
from groundstation.planning.paths import PathState
from groundstation.planning.segment import first_segment
from groundstation.planning.straight_sides import make_path
from shoal.config.experiment import load_experiment
from shoal.config.scene import Waypoints
from shoal.errors import ConfigError
from shoal.frames import Array

SQUARE = ((-0.6, -0.6), (0.6, -0.6), (0.6, 0.6), (-0.6, 0.6))
STEP_S = 0.005


def flown(corner: str, **more: object) -> tuple[Array, PathState, float]:
    table = {"kind": "waypoints", "points_m": SQUARE, "speed_mps": 0.12, "laps": 2, "corner": corner, "corner_m": 0.3, **more}
    path = make_path(Waypoints.model_validate(table))
    time_s = np.arange(0.0, min(path.end_s, 150.0), STEP_S)
    return time_s, path.at(time_s), path.end_s


def off_square_m(position_m: Array) -> Array:
    """Distance from the square's outline."""
    return np.asarray(np.abs(np.abs(position_m[:, :2]).max(axis=1) - 0.6))


@pytest.mark.parametrize("corner", ["round", "stop"])
def test_derivatives_are_those_of_differences(corner: str) -> None:
    _, state, _ = flown(corner)
    for value, rate, most in (
        (state.position_m, state.velocity_mps, 1e-4),
        (state.velocity_mps, state.acceleration_mps2, 1e-3),
        (state.yaw_rad, state.yaw_rate_radps, 5e-3),
    ):
        assert np.abs(np.gradient(value, STEP_S, axis=0) - rate)[2:-2].max() < most


@pytest.mark.parametrize("corner", ["round", "stop"])
def test_sides_are_straight_and_laps_close(corner: str) -> None:
    _, state, _ = flown(corner)
    aside = np.abs(state.position_m[:, :2]).min(axis=1) < 0.29  # of the middle of a side, beyond the corners' reach
    assert off_square_m(state.position_m[aside]).max() < 1e-4
    assert np.allclose(state.position_m[0, :2], SQUARE[0])
    assert np.allclose(state.position_m[-1, :2], SQUARE[0], atol=1e-3)
    assert np.isclose(state.yaw_rad[-1] - state.yaw_rad[0], 4.0 * np.pi - np.pi / 2.0, atol=1e-3)


def test_round_corners_are_flown_at_constant_speed_inside_the_square() -> None:
    _, state, end_s = flown("round")
    assert np.allclose(np.hypot(*state.velocity_mps[:, :2].T), 0.12)
    assert np.abs(state.position_m[:, :2]).max() < 0.6 + 1e-3
    assert end_s < 2 * 4 * 1.2 / 0.12
    under_way = state.position_m[200:-200, :2]  # it begins and ends at a corner
    cut_m = np.hypot(*(np.abs(under_way) - 0.6).T).min()
    assert 0.03 < cut_m < 0.3


def test_a_stop_reaches_each_corner_at_rest_and_turns_there() -> None:
    _, state, _ = flown("stop")
    for x, y in SQUARE:
        there = np.flatnonzero(np.hypot(*(state.position_m[:, :2] - (x, y)).T) < 1e-6)
        assert len(there)
        assert np.allclose(state.velocity_mps[there], 0.0, atol=1e-3)
    moves = np.hypot(*state.velocity_mps[:, :2].T) > 1e-9
    assert not np.any(moves & (np.abs(state.yaw_rate_radps) > 1e-9))
    assert np.abs(state.yaw_rate_radps).max() < 0.81


@pytest.mark.parametrize("corner", ["round", "stop"])
def test_the_flight_begins_at_the_chosen_waypoint_and_may_stop_at_the_last(corner: str) -> None:
    _, state, end_s = flown(corner, start_index=2, laps=1, stop=True, points_m=(*SQUARE, (-0.6, -0.4)))
    assert np.hypot(*(state.position_m[0, :2] - SQUARE[2])) < 0.25
    assert end_s == float("inf")
    assert np.allclose(state.position_m[-1, :2], (-0.6, -0.4), atol=1e-6) and not state.velocity_mps[-1].any()


def test_a_path_without_a_corner_to_stop_at_is_refused() -> None:
    with pytest.raises(ValueError, match="points 1 and 2 are the same place"):
        make_path(Waypoints(kind="waypoints", points_m=((0, 0), (1, 0), (1, 0)), speed_mps=0.1, corner="stop"))
    with pytest.raises(ConfigError, match="a path that stops at its corners is level"):
        path = 'path={kind="waypoints",points_m=[[0,0],[1,0]],speed_mps=0.1,dive_mps=0.01,corner="stop"}'
        load_experiment("pool", [path])


@pytest.mark.parametrize("corner", ["round", "stop"])
def test_a_formation_flies_a_square_with_straight_sides(corner: str) -> None:
    """One that turns with the path does not: where it turns faster than it moves, its inner robot would have to turn round."""
    points = [list(point) for point in SQUARE]
    path = f'path={{kind="waypoints",points_m={points},speed_mps=0.1,laps=2,depth_m=0.3,corner="{corner}"}}'
    segment = first_segment(load_experiment("pool", [path, "duration_s=80"]))
    assert off_square_m(segment.centre.eta[np.abs(segment.centre.eta[:, :2]).min(axis=1) < 0.05]).max() < 1e-3
    with pytest.raises(PlanError, match=r"robot 2: it turns by 3\.1\d+ rad at once"):
        first_segment(load_experiment("pool", [path, "duration_s=80", "formation.mode=rotate"]))


FAR = tuple((1e4 if k % 2 else -1e4, 1e4 if k % 3 else -1e4) for k in range(200))  # as far as a page may ask
AROUND = tuple((2.0 * np.cos(a), 1.5 * np.sin(a)) for a in np.linspace(0.0, 2.0 * np.pi, 200, endpoint=False))


@pytest.mark.parametrize(
    ("path", "why"),
    [
        ({"kind": "waypoints", "points_m": FAR, "corner": "round"}, "too many or too long"),
        ({"kind": "waypoints", "points_m": AROUND, "laps": 150, "corner": "round", "corner_m": 0.01}, "too many or too long"),
        ({"kind": "route", "via_m": FAR}, "m long"),
    ],
    ids=["far places", "many laps", "a route"],
)
def test_a_path_that_would_fill_the_memory_is_refused_at_once(path: dict[str, object], why: str) -> None:
    """Points of a path that is made dense grow with its length, not with the number of its waypoints."""
    experiment = load_experiment("straight")
    flown = type(experiment).model_validate(experiment.model_dump() | {"path": path | {"speed_mps": 0.1}})
    limits, begun_s = resource.getrlimit(resource.RLIMIT_AS), time.process_time()
    resource.setrlimit(resource.RLIMIT_AS, (2 << 30, limits[1]))
    try:
        with pytest.raises(ConfigError, match=why):
            first_segment(flown)
    finally:
        resource.setrlimit(resource.RLIMIT_AS, limits)
    assert time.process_time() - begun_s < 5.0
