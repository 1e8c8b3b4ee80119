"""Flights of the nonlinear MPC on its own model: paths, stops, driving, neighbours, and inputs that are none."""

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from robot_agent.control.controller import ControlOutput, Setting
from robot_agent.control.nonlinear.nonlinear_controller import REPORT_S, NonlinearController, clear_place
from robot_agent.control.nonlinear.obstacle_rows import NO_BODIES, Surrounds, outlines_of
from robot_agent.guidance.driving import Driver
from robot_agent.guidance.formation import Neighbour
from robot_agent.guidance.obstacles import Obstacle, obstacles_from_message
from robot_agent.guidance.reference import Follow, Goal, Hold
from robot_agent.vehicle.dynamics import Model
from robot_agent.vehicle.estimate import PoseMeasurement, StateMeasurement
from shoal.config.experiment import load_experiment
from shoal.config.vehicle import Vehicle, load_vehicle
from shoal.frames import Array
from shoal.messages.live_gains import tunable_parameters, tuned
from shoal.messages.messages import DriveVelocity, Obstacles, Plan, Solve, Trajectory, required
from tests.flights.scene_flights import flown
from tests.robot_agent.control.drawn_inputs import (
    GOAL,
    POOL,
    STEP_NS,
    VEHICLE,
    check,
    goals,
    measurements,
    neighbours,
)
from tests.robot_agent.control.drawn_inputs import at as pose_at

pytestmark = pytest.mark.long

NMPC = load_experiment("pool", ["controller.law=nmpc"])
DEAD_STEPS = round(VEHICLE.thruster.dead_time_s / 0.05)


class Swimmer:
    """A robot that is just as its model says, in water at rest or in a current, seen without noise."""

    def __init__(
        self, pose: Sequence[float], surge_mps: float = 0.0, current: complex = 0j, vehicle: Vehicle = VEHICLE, **more: Any
    ) -> None:
        self.controller = NonlinearController(Setting(vehicle, NMPC.controller, NMPC.safety, **more))
        axes = len(vehicle.limits.wrench)
        self.vehicle, self.model, self.current, self.k = vehicle, Model(vehicle), current, 0
        self.state = (*pose, surge_mps, 0.0, 0.0, 0.0, *[0.0] * axes)
        self.wrenches = [np.zeros(axes)] * (DEAD_STEPS + 1)
        self.track = [np.array(self.state)]

    def step(self, goal: Goal | None, others: Sequence[Neighbour] = (), obstacles: Sequence[Obstacle] = ()) -> ControlOutput:
        x, y, z, yaw, _, _, _, r, *_ = self.state
        measurement = StateMeasurement(PoseMeasurement(self.k * STEP_NS, x, y, yaw), z, r)
        output = self.controller.step(measurement, goal, others, self.k * STEP_NS, obstacles)
        check(output, self.vehicle)
        still = np.zeros(len(self.vehicle.limits.wrench))
        self.wrenches.append(still if output.control is None else output.control.wrench_delivered)
        wrench = self.wrenches[-1 - DEAD_STEPS]
        for _ in range(5):
            state = self.model.advance(self.state, (0.0,) * 4, tuple(wrench), 0.01)
            self.state = (state[0] + 0.01 * self.current.real, state[1] + 0.01 * self.current.imag, *state[2:])
        self.track.append(np.array(self.state))
        self.k += 1
        return output

    @property
    def places(self) -> Array:
        return np.array(self.track)[:, :2]


def test_a_robot_that_starts_beside_its_path_facing_away_comes_onto_it() -> None:
    robot = Swimmer((0.95, 0.2, 0.3, -math.pi / 2))
    path = GOAL.trajectory
    for k in range(400):
        output = robot.step(Follow(path, 0.05 * k))
        assert output.solve is Solve.SOLVED
        if k >= 240:
            assert output.tracking_error_m < 0.02


def straight(speed_mps: float) -> Trajectory:
    """A line along x from the origin on."""
    eta, velocity = np.zeros((400, 4)), np.zeros((400, 4))
    eta[:, 0], eta[:, 2], velocity[:, 0] = 0.05 * speed_mps * np.arange(400), 0.3, speed_mps
    return Trajectory("straight", 0.05, eta, velocity, np.zeros((400, 4)))


def on_the_move(speed_mps: float, ends_at_m: float, **more: Any) -> Swimmer:
    """A robot that flies along x, and is at its speed."""
    robot = Swimmer((-8.0 * speed_mps + ends_at_m, 0.0, 0.3, 0.0), speed_mps, **more)
    path = straight(speed_mps)
    path = replace(path, eta=path.eta + np.array([-8.0 * speed_mps + ends_at_m, 0.0, 0.0, 0.0]))
    for k in range(160):
        robot.step(Follow(path, 0.05 * k))
    return robot


def shortest_stop(surge_mps: float) -> float:
    """Distance in which full reverse brings the robot to rest, as its limits allow: found by trying."""
    model, wrench = Model(VEHICLE), 0.0
    state: tuple[float, ...] = (*[0.0] * 4, surge_mps, *[0.0] * 6)
    wrenches = [0.0] * (5 * DEAD_STEPS)
    while state[4] > 0.0:
        wrench = max(wrench - 0.01 * VEHICLE.limits.wrench_rate_per_s[0], -VEHICLE.limits.wrench[0])
        wrenches.append(wrench)
        state = model.advance(state, (0.0,) * 4, (wrenches[-1 - 5 * DEAD_STEPS], 0.0, 0.0), 0.01)
    return state[0]


@pytest.mark.parametrize("speed_mps", [0.05, 0.2, 0.35])
def test_hold_rests_where_the_robot_can_stop_without_overshoot(speed_mps: float) -> None:
    robot = on_the_move(speed_mps, 0.0)
    begin, speed = robot.state[0], robot.state[4]
    assert speed == pytest.approx(speed_mps, rel=0.1)
    goal = Hold(np.array([begin, 0.0, 0.3, 0.0]))
    place = required(robot.step(goal).control).eta_reference[0]
    least = shortest_stop(speed)
    assert least - 0.02 <= place - begin <= 2.0 * least + 0.10
    for _ in range(300):
        robot.step(goal)
    assert robot.places[:, 0].max() - place < 0.025  # 12 mm from 0.2 m/s, 23 mm from 0.35 m/s: drag is learned meanwhile
    assert np.hypot(robot.places[-150:, 0] - place, robot.places[-150:, 1]).max() < 0.01


def test_hold_rests_inside_the_walls_and_clear_of_an_island() -> None:
    robot = on_the_move(0.3, 1.1, room_m=(3.0, 9.0))
    goal = Hold(robot.track[-1][:4])
    place = [required(robot.step(goal).control).eta_reference for _ in range(200)][-1]
    assert place[0] <= 1.5 - VEHICLE.radius_m - 0.06
    assert robot.places[:, 0].max() < 1.5 - VEHICLE.radius_m

    island = Obstacle(0, np.array([0.5 + 0.0j]), 0.3, 0j, 0, 0.5 + 0j, 0.0)
    robot = on_the_move(0.3, 0.1, islands=(island,))
    goal = Hold(robot.track[-1][:4])
    place = [required(robot.step(goal).control).eta_reference for _ in range(200)][-1]
    assert np.hypot(place[0] - 0.5, place[1]) >= 0.3
    assert np.hypot(*(robot.places[-1] - place[:2])) < 0.02


def test_a_driven_robot_has_the_speed_and_the_heading_asked_and_turns_on_the_spot() -> None:
    for surge, turn in ((0.2, 0.3), (-0.15, 0.0), (0.0, 0.8)):
        robot, driver, led = Swimmer((0.0, 0.0, 0.3, 0.0)), Driver(NMPC), 0.0
        for _ in range(120):
            eta = np.array(robot.state[:4])
            robot.step(driver.goal(DriveVelocity(surge, 0.0, turn), 0.5, eta, ()))
            led += 0.05 * turn
        _, _, _, yaw, u, _, _, r, *_ = robot.state
        assert u == pytest.approx(surge, abs=0.05) and r == pytest.approx(turn, abs=0.03)
        assert abs(yaw - led) < 0.05


def test_the_plan_that_is_told_is_the_one_that_is_flown() -> None:
    """A start with a turn: after two seconds the robot is where it has told that it would be."""
    robot = Swimmer((0.7, 0.1, 0.3, 0.0))
    plans = [robot.step(Follow(GOAL.trajectory, 0.05 * k)).plan_eta for k in range(160)]
    ahead = round(2.0 / REPORT_S)
    errors = [np.hypot(*(plans[k][ahead, :2] - robot.places[k + 40])) for k in range(20, 120)]
    assert max(errors) < 0.05 and np.median(errors) < 0.015
    assert np.allclose(plans[30][0, :2], robot.places[30], atol=0.01)


def test_a_robot_without_thrust_tells_its_drift() -> None:
    robot = Swimmer((0.0, 0.0, 0.3, 0.0), 0.3)
    outputs = [robot.step(None) for _ in range(50)]
    plan = outputs[30].plan_eta  # by then the observer knows how fast it is
    assert outputs[30].control is None and set(outputs[30].pulse_us[:4]) == {1500}
    assert plan[5, 0] == pytest.approx(robot.places[50, 0], abs=0.02) and robot.places[50, 0] - robot.places[30, 0] > 0.08


def test_a_robot_in_the_way_is_kept_at_its_distance() -> None:
    robot, near = Swimmer((0.625, 0.0, 0.3, math.pi / 2)), []
    stay = np.tile([0.0, 0.62, 0.3, 0.0], (40, 1))  # the circle leads to within 0.4 m of it
    for k in range(500):
        other = Neighbour(2, k * STEP_NS, Plan(REPORT_S, stay, stay), True)
        robot.step(Follow(GOAL.trajectory, 0.05 * k), [other])
        near.append(np.hypot(robot.places[-1, 0], robot.places[-1, 1] - 0.62))
    assert min(near) > 0.6


def test_the_formation_moves_the_course_by_its_share() -> None:
    """A neighbour that is 0.1 m off makes a robot of weight q move by q / (1 + q) of that; one with a leader moves by all."""
    for has_leader, share in ((False, 0.15 / 1.15), (True, 1.0)):
        robot = Swimmer((0.625, 0.0, 0.3, math.pi / 2), has_leader=has_leader)
        path = np.tile([3.0, 3.0, 0.3, 0.0], (40, 1))
        for k in range(300):
            other = Neighbour(2, k * STEP_NS, Plan(REPORT_S, path + np.array([0.0, 0.1, 0.0, 0.0]), path), True, True, True)
            robot.step(Follow(GOAL.trajectory, 0.0, 0.0), [other])
        assert robot.places[-1, 1] == pytest.approx(0.1 * share, abs=0.006)


@pytest.mark.parametrize("has_leader", [False, True])
def test_a_plan_that_says_its_robot_is_far_off_takes_no_other_far_along(has_leader: bool) -> None:
    """A wrong plan: 100 m off what it says is its path. Within 8 s a robot went 2.2 m after it."""
    robot = Swimmer((0.625, 0.0, 0.3, math.pi / 2), room_m=(6.0, 4.0), has_leader=has_leader)
    path = np.tile([-2.5, -1.5, 0.3, 0.0], (40, 1))
    for k in range(160):
        other = Neighbour(2, k * STEP_NS, Plan(REPORT_S, path + np.array([100.0, 0.0, 0.0, 0.0]), path), True, True, True)
        output = robot.step(Follow(GOAL.trajectory, 0.05 * k), [other])
        assert output.solve is Solve.SOLVED
        assert math.dist(robot.state[:2], required(output.control).eta_reference[:2]) < 1.25


@pytest.mark.parametrize("robots", [2, 4])
def test_a_robot_among_others_that_are_too_near_still_finds_a_plan(robots: int) -> None:
    """Currents and hands push robots together. One that finds no plan then gives up its thrust amid the others."""
    places = [0.55 * np.exp(1j * (2.0 * math.pi * i / robots + 0.3)) for i in range(robots)]
    stay = [np.tile([place.real, place.imag, 0.3, 0.0], (40, 1)) for place in places]
    for goal in (Hold(np.array([0.0, 0.0, 0.3, 0.0])), None):
        robot = Swimmer((0.0, 0.0, 0.3, 0.0))
        for k in range(40):
            others = [
                Neighbour(2 + i, k * STEP_NS, Plan(REPORT_S, eta, eta, heard=(1,)), True, False, True)
                for i, eta in enumerate(stay)
            ]
            assert robot.step(goal or Follow(GOAL.trajectory, 0.05 * k), others).solve is Solve.SOLVED


def test_a_robot_in_a_crowd_still_finds_a_plan_where_the_active_set_runs_out_of_rounds() -> None:
    """Eight others, drawn by chance; OSQP solves the program of step 28."""
    random = np.random.default_rng(26)
    places = [random.uniform(0.2, 0.6) * np.exp(2j * math.pi * random.uniform()) for _ in range(int(random.integers(3, 9)))]
    stay = [np.tile([place.real, place.imag, 0.3, 0.0], (40, 1)) for place in places]
    robot = Swimmer((0.0, 0.0, 0.3, random.uniform(-3, 3)))
    for k in range(29):
        others = [
            Neighbour(2 + i, k * STEP_NS, Plan(REPORT_S, eta, eta, heard=(1,)), True, False, True)
            for i, eta in enumerate(stay)
        ]
        assert robot.step(Follow(GOAL.trajectory, 0.05 * k), others).solve is Solve.SOLVED


def test_a_place_to_rest_inside_an_obstacle_is_moved_out_by_the_shortest_way() -> None:
    """A robot brakes too late for a raft 1.2 m wide, which begins 0.18 m before the place where it could stop."""
    raft = np.array([[[0.12, -0.6], [1.3, -0.6], [1.3, 0.6], [0.12, 0.6]]])
    (obstacle,) = obstacles_from_message(Obstacles((1,), raft, np.zeros((1, 2)), unseen_s=np.zeros(1)), 0, 0.3)
    around = Surrounds(NO_BODIES, outlines_of((obstacle,), 0, 0j), np.array([3.0, 2.0]))
    for inside in (0.3 + 0.01j, 0.13 + 0.01j):
        x, y = clear_place(np.array([inside.real, inside.imag, 0.3, 0.0]), around, 0.05)[:2]
        assert x < 0.12 - 0.3 and abs(y) < 0.3  # straight out, within the spacing of the points along the edge
    assert clear_place(np.array([1.25, 0.0, 0.3, 0.0]), around, 0.05)[0] > 1.3 + 0.3


@pytest.mark.parametrize("gaps_m", [(0.8, -0.8), (0.5,)])
def test_a_column_that_holds_rests_where_it_stops(gaps_m: tuple[float, ...]) -> None:
    """Robots behind and ahead hold too, one step later: until then their plans end more than a metre on, one of them in our
    place. Only a robot that rests nearer than 2R moves a place."""
    robot, eta, velocity = Swimmer((0.0, 0.0, 0.3, 0.0), surge_mps=0.2), np.zeros((600, 4)), np.zeros((600, 4))
    eta[:, 0], eta[:, 2], velocity[:, 0] = 0.05 * 0.2 * np.arange(600), 0.3, 0.2
    path = Trajectory("ahead", 0.05, eta, velocity, np.zeros((600, 4)))
    at_s, hold, places = REPORT_S * np.arange(36), Hold(np.array([1.2, 0.0, 0.3, 0.0])), []
    for k in range(300):
        others, along = [], 0.2 * (0.05 * k + at_s) if k <= 120 else np.full(36, 1.42)
        for i, gap_m in enumerate(gaps_m):
            plan = np.column_stack([along + gap_m, 0.0 * at_s, 0.3 + 0.0 * at_s, 0.0 * at_s])
            others.append(Neighbour(2 + i, k * STEP_NS, Plan(REPORT_S, plan, plan, heard=(1,)), True, False, True))
        output = robot.step(hold if k >= 120 else Follow(path, 0.05 * k), others)
        if k >= 120:
            places.append(complex(*required(output.control).eta_reference[:2]))
    assert abs(places[0] - complex(*robot.track[120][:2])) < 0.35  # its own way to stop
    assert abs(complex(*robot.state[:2]) - places[-1]) < 0.01
    if len(gaps_m) == 1:
        assert abs(places[-1] - (1.42 + gaps_m[0])) > 2.0 * NMPC.safety.radius_m + NMPC.safety.margin_m
    else:
        assert places[-1] == places[0]


def test_gains_change_in_flight_without_a_leap() -> None:
    robot = Swimmer((0.625, 0.0, 0.3, math.pi / 2))
    keys = {p.key: p.value for p in tunable_parameters(NMPC.controller)}
    assert "controller.nmpc.heading_m" in keys and "controller.mpc.q.0" not in keys
    other = tuned(NMPC.controller, {"controller.nmpc.turning_m": 0.3, "controller.mpc.q_formation.0": 0.5})
    before = None
    for k in range(80):
        if k == 40:
            robot.controller.adopt_gains(other)
        output = robot.step(Follow(GOAL.trajectory, 0.05 * k))
        if before is not None and k == 40:
            assert np.abs(required(output.control).wrench - before).max() < 0.2
        before = required(output.control).wrench


@settings(max_examples=25, deadline=None)
@given(st.lists(st.tuples(measurements, goals, neighbours, st.integers(0, 3)), min_size=1, max_size=12))
def test_no_input_makes_it_put_out_nonsense(rows: list[tuple[StateMeasurement, Goal | None, list[Neighbour], int]]) -> None:
    """NaN, gaps, duplicates, reordering, plans of other sizes: finite, within limits, neutral when not solved."""
    one, k = NonlinearController(Setting(VEHICLE, NMPC.controller, POOL.safety)), 0
    for measurement, goal, others, gap in rows:
        k += gap
        check(one.step(measurement, goal, others, k * STEP_NS))
        check(one.step(pose_at(k), goal, others, k * STEP_NS + 1))


def test_two_flights_are_the_same_bit_for_bit() -> None:
    first, again = (Swimmer((0.9, 0.2, 0.3, -1.0)) for _ in range(2))
    for k in range(60):
        goal = Follow(GOAL.trajectory, 0.05 * k)
        assert np.array_equal(first.step(goal).plan_eta, again.step(goal).plan_eta)


def test_a_robot_with_side_thrust_goes_sideways_and_holds_without_turning() -> None:
    """The path's heading stays 0 while the path goes to starboard; HOLD then rests ahead of where it was, at that heading."""
    robot = Swimmer((0.0, 0.1, 0.3, 0.4), vehicle=load_vehicle("vectored"))
    eta, velocity = np.zeros((400, 4)), np.zeros((400, 4))
    eta[:, 1], eta[:, 2], velocity[:, 1] = 0.05 * 0.15 * np.arange(400), 0.3, 0.15
    path = Trajectory("aside", 0.05, eta, velocity, np.zeros((400, 4)))
    for k in range(240):
        output = robot.step(Follow(path, 0.05 * k))
        if k >= 120:
            assert output.tracking_error_m < 0.02 and abs(robot.state[3]) < 0.05
    assert robot.state[5] == pytest.approx(0.15, abs=0.02) and abs(required(output.control).wrench[3]) > 0.5
    begin, goal = complex(*robot.state[:2]), Hold(np.array([*robot.state[:4]]))
    place = complex(*required(robot.step(goal).control).eta_reference[:2])
    assert 0.0 < (place - begin).imag < 0.5 and abs((place - begin).real) < 0.03
    for _ in range(300):
        robot.step(goal)
        assert abs(robot.state[3]) < 0.06
    assert abs(complex(*robot.state[:2]) - place) < 0.005


@pytest.mark.parametrize("rate_hz", [10, 20, 50])
def test_a_hull_pitched_by_its_thrust_keeps_its_depth(rate_hz: int) -> None:
    """At full thrust the plant's hull pitches by 0.35 rad. 80 mm without the board's attitude."""
    fast = ("path.speed_mps=0.4", "duration_s=8", "sim.plant.current_mps=[0.0,0.0,0.0]")
    flight = flown(load_experiment("straight", [*fast, "controller.law=nmpc", f"controller.period_s={1.0 / rate_hz}"]))
    assert max(required(state.board).tilt[1] for state in flight.states[0]) > 0.3
    assert np.abs(flight.error[:, 0, 2]).max() < 0.06


@pytest.mark.parametrize("name", ["numeric", "numeric-disturbed"])
def test_a_robot_that_came_back_astern_goes_on_bow_first(name: str) -> None:
    """A robot that begins half a metre ahead of its place may come back stern first; it then turns round."""
    flight = flown(load_experiment(name, ["controller.law=nmpc", "duration_s=12"]))
    assert np.abs(flight.error[round(8.0 / 0.05) :, :, 3]).max() < 0.1
