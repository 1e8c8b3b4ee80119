"""The approach: its parts against NumPy, and robots that begin off their paths, flown with and without it."""

import math
from collections.abc import Iterator

import numpy as np
import pytest
from numpy.typing import NDArray

from benchmarks.flights import SceneFlight
from robot_agent.control.approach import (
    FROM_M,
    JOINED_M,
    LASTS_S,
    Approach,
    farthest_out,
    joins_at,
    move_on,
    sample_flight,
    set_goals,
)
from robot_agent.control.controller import Controller, ControlOutput
from robot_agent.guidance.obstacles import Obstacle
from robot_agent.guidance.reference import Follow
from tests.closed_loop.numeric import flown
from tests.robot_agent.control.drawn_inputs import GOAL, POOL, STEP_NS, VEHICLE, at, check
from wire.config.experiment import load_experiment

CAMERA = ("sim.latency_s=0.04", "sim.numeric.pose_noise_m=0.0015", "sim.numeric.yaw_noise_rad=0.008")
WITHOUT = "controller.guidance.plan_start=false"
RANDOM = np.random.default_rng(8)


# --- parts


def test_goals_have_no_jumps_and_begin_near_the_heading_given() -> None:
    eta, velocity, goals = RANDOM.normal(size=(9, 4)), RANDOM.normal(size=(9, 4)), np.empty((9, 5))
    eta[:, 3] = (2.9 + 0.2 * np.arange(9) + math.pi) % (2 * math.pi) - math.pi
    first = set_goals(eta, velocity, 0.1 - 0.2j, 15.0, goals)
    assert first == goals[0, 2] and abs(first - 15.0) <= math.pi
    assert goals[:, 2] - first == pytest.approx(0.2 * np.arange(9))
    assert np.exp(1j * goals[:, 2]) == pytest.approx(np.exp(1j * eta[:, 3]))
    assert goals[:, :2] == pytest.approx(eta[:, :2])
    assert goals[:, 3:] == pytest.approx(velocity[:, :2] - [0.1, -0.2])


def test_a_flight_joins_at_the_first_node_after_the_last_one_that_is_off() -> None:
    goals, states = RANDOM.normal(size=(12, 5)), np.zeros((12, 8))
    states[:, :3] = goals[:, :3]
    going = (goals[:, 3] + 1j * goals[:, 4]) * np.exp(-1j * goals[:, 2])
    states[:, 3], states[:, 4] = going.real, going.imag
    assert joins_at(states, goals) == 0
    for column, by in ((0, 0.011), (1, -0.011), (2, 0.31), (3, 0.011), (4, -0.011)):
        for node in (0, 5, 11):
            moved = states.copy()
            moved[node, column] += by
            assert joins_at(moved, goals) == node + 1


def test_inputs_move_on_as_interpolated_ones_do() -> None:
    inputs, node = RANDOM.normal(size=(20, 2)), np.arange(20.0)
    for steps in (0.0, 0.5, 1.0, 3.25, 30.0):
        moved = inputs.copy()
        move_on(moved, steps)
        padded = np.vstack([inputs, [0.0, 0.0]])
        for c in range(2):
            assert moved[:, c] == pytest.approx(np.interp(node + steps, np.arange(21.0), padded[:, c], right=0.0))


def test_a_flight_is_sampled_from_the_action_on_and_leaves_places_beyond_its_end() -> None:
    states, action, rows = RANDOM.normal(size=(6, 8)), RANDOM.normal(size=11), RANDOM.normal(size=(16, 4))
    path = rows.copy()
    sample_flight(states, action, 0.1, 0.1, 0.05, rows)
    time_s = 0.05 * np.arange(16)
    known_s = np.append(0.0, 0.1 + 0.1 * np.arange(6))
    for column, state in ((0, 0), (1, 1), (3, 2)):
        there = np.interp(time_s, known_s, np.append(action[column], states[:, state]))
        there = there if column == 3 else np.where(time_s < 0.6 - 1e-9, there, path[:, column])
        assert rows[:, column] == pytest.approx(there)
    assert np.array_equal(rows[:, 2], path[:, 2])


def test_how_far_a_place_is_out_of_a_room() -> None:
    places = np.array([[0.0, 0.9], [-2.2, 0.3]])
    assert farthest_out(places, 2.0, 1.0) == pytest.approx(0.2)
    assert farthest_out(places, 3.0, 1.0) == pytest.approx(-0.1)


# --- flights


def reached_s(flight: SceneFlight, near_m: float) -> NDArray[np.float64]:
    """Time (robots,) from which on robots stay as near to their paths, of the first 12 s."""
    off = np.linalg.norm(flight.error[:240, :, :2], axis=2) > near_m
    seconds: NDArray[np.float64] = 0.05 * (240 - np.argmax(off[::-1], axis=0))
    return seconds


@pytest.mark.long
def test_robots_that_begin_off_their_paths_are_on_them_sooner_and_nearer() -> None:
    planned, unplanned = (flown("pool", "duration_s=14", *CAMERA, *settings) for settings in ((), (WITHOUT,)))
    assert np.all(reached_s(planned, 0.01) < 0.5 * reached_s(unplanned, 0.01))
    square = [np.sum(flight.error[..., :2] ** 2, axis=(0, 2)) for flight in (planned, unplanned)]
    assert np.all(np.sqrt(square[0] / square[1]) < 0.85)


@pytest.mark.long
def test_short_horizons_join_as_well() -> None:
    short = flown("pool", "duration_s=24", *CAMERA, "controller.mpc.horizon=10", "controller.mpc.blocks=[1,1,2,3]")
    assert np.sqrt(np.mean(short.error[400:, :, :2] ** 2, axis=0)).max() < 0.005


@pytest.mark.long
def test_a_robot_as_light_as_two_thirds_of_its_file_does_not_swing() -> None:
    light = flown("pool", "duration_s=24", *CAMERA, "sim.plant.mass_error=-0.3", "sim.plant.drag_error=-0.3")
    assert not any(state.fault for states in light.states for state in states)
    assert light.error[400:, :, :2].max() < 0.01


@pytest.mark.long
def test_a_start_repeats_to_the_bit() -> None:
    first, again = ([state.wrench for state in flown("pool", "duration_s=4", f"title='{n}'").states[0]] for n in ("a", "b"))
    assert np.array_equal(first, again)


# --- when there is none


def steps(controller: Controller, count: int, **beginning: float) -> Iterator[tuple[ControlOutput, bool]]:
    """Outputs of a robot that stands still, and whether it approaches."""
    for k in range(count):
        output = controller.step(at(k, **beginning), Follow(GOAL.trajectory, 0.05 * k), [], k * STEP_NS)
        check(output)
        yield output, approach(controller).flies


def approach(controller: Controller) -> Approach:
    assert controller.approach is not None
    return controller.approach


def of(*settings: str, **more: tuple[float, float]) -> Controller:
    experiment = load_experiment("pool", settings)
    return Controller(VEHICLE, experiment.controller, experiment.safety, **more)  # type: ignore[arg-type]


def test_a_robot_on_its_path_or_far_from_it_does_not_approach() -> None:
    for off_m in (0.8 * FROM_M, 0.7):
        controller = of()
        assert not any(flies for _, flies in steps(controller, 10, x=0.625 + off_m))
        assert approach(controller).waits == (off_m > FROM_M)  # it may come near


def test_a_robot_that_cannot_move_gives_up_in_time() -> None:
    flies = [flies for _, flies in steps(of(), round(LASTS_S / 0.05) + 20, x=0.775)]
    assert flies[0] and not flies[-1]
    assert flies.index(False) == pytest.approx(LASTS_S / 0.05, abs=2)


@pytest.mark.parametrize(
    "settings", [WITHOUT, "controller.guidance.enabled=false", "controller.estimator.sway=false", 'controller.law="pid"']
)
def test_there_is_none_where_it_is_off_or_cannot_be(settings: str) -> None:
    assert of(settings).approach is None


def test_a_flight_that_leads_farther_out_of_the_pool_than_its_start_is_not_begun() -> None:
    """A robot behind its place on the path, which leads along a wall, faces the wall and swings out before it turns."""
    start = {"x": 0.6, "y": -0.2, "yaw": 0.5}
    free = of()
    assert next(steps(free, 1, **start))[1]
    swings_to_m = float(approach(free).states[:, 0].max())
    assert swings_to_m > approach(free).goals[:, 0].max() + 4.0 * JOINED_M
    for room_m, begins in ((1e-6, True), (-1e-6, False)):
        wall_m = swings_to_m + VEHICLE.radius_m - JOINED_M + room_m
        assert next(steps(of(room_m=(2.0 * wall_m, 9.0)), 1, **start))[1] == begins


def test_a_robot_that_leaves_its_path_for_an_obstacle_approaches_no_more() -> None:
    controller, place = of(), 0.625 + 0.36j
    ahead = Obstacle(1, np.array([place]), POOL.safety.radius_m, 0j, 0, place, 0.0)
    assert all(flies for _, flies in steps(controller, 5, x=0.775))
    for k in range(5, 25):
        output = controller.step(at(k, x=0.775), Follow(GOAL.trajectory, 0.05 * k), [], k * STEP_NS, (ahead,))
        check(output)
    assert output.path_is_blocked and not approach(controller).flies and not approach(controller).waits
    assert not any(flies for _, flies in steps(controller, 5, x=0.775))


def test_tuning_changes_its_weights_alone() -> None:
    controller = of()
    assert next(steps(controller, 1, x=0.775))[1]
    before = approach(controller).weight
    tuned = load_experiment("pool", ["controller.mpc.r=[0.1,0.05,16.0]"]).controller
    controller.adopt_gains(controller.prepare_gains(tuned))
    after = approach(controller).weight
    assert after[[4, 5, 10]] == pytest.approx(2.0 * before[[4, 5, 10]]) and approach(controller).flies
    assert np.array_equal(np.delete(after, [4, 5, 10]), np.delete(before, [4, 5, 10]))
