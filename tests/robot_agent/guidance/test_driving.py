"""Driving by a person: the robot stops short of other robots, also of silent ones."""

import numpy as np
import pytest

from robot_agent.guidance import driving
from robot_agent.guidance.formation import Formation, Neighbour, rest_of_plan
from shoal.config.experiment import load_experiment
from shoal.messages.messages import DriveVelocity, Plan

WATER, POOL = load_experiment("open-water"), load_experiment("pool")
PERIOD_S, PLAN_PERIOD_S, ROWS = WATER.controller.period_s, 0.2, 36
NS = 1_000_000_000


def plan_ahead(speed_mps: float) -> Plan:
    """A plan that begins 1 m ahead and leads straight away."""
    eta = np.tile([1.0, 0.0, 0.3, 0.0], (ROWS, 1))
    eta[:, 0] += speed_mps * PLAN_PERIOD_S * np.arange(ROWS)
    return Plan(PLAN_PERIOD_S, eta, eta)


@pytest.mark.parametrize("speed_mps", [0.0, 0.2, 0.5])
@pytest.mark.parametrize("is_seen", [False, True])
def test_a_driven_robot_stops_short_of_a_silent_robot_whose_plan_has_ended(speed_mps: float, is_seen: bool) -> None:
    """It rests at its plan's end, or where the camera sees it."""
    plan, place, ended_s = plan_ahead(speed_mps), 1.4 + 0.0j, PLAN_PERIOD_S * ROWS
    silent = Neighbour(2, 0, rest_of_plan(plan, ended_s, place) if is_seen else plan, fresh=False)
    rests_m = place.real if is_seen else float(plan.eta[-1, 0])
    nodes_s = 0.3 * np.arange(1, 20, dtype=np.float64)
    driver, formation = driving.Driver(WATER), Formation(WATER.safety, nodes_s, (1.0, 1.0, 1.0, 1.0), has_leader=False)
    eta, now_ns = np.array([0.0, 0.0, 0.3, 0.0]), round(2.0 * ended_s * NS)
    for _ in range(round(40.0 / PERIOD_S)):
        bodies = driving.bodies([silent], [], formation, now_ns)
        goal = driver.goal(DriveVelocity(surge_mps=0.2), 0.5, eta, bodies)
        eta[0] += goal.surge_mps * PERIOD_S
        now_ns += round(PERIOD_S * NS)
    apart_m, keep_m = rests_m - float(eta[0]), 2.0 * WATER.safety.radius_m
    assert keep_m < apart_m < keep_m + 1.0


@pytest.mark.parametrize("period_s", [1e-300, 1e-6, 1e11])
def test_a_plan_whose_numbers_cannot_be_poses_moves_no_driven_robot(period_s: float) -> None:
    """Of another robot's program that is broken; the controller leaves it out too."""
    wild = Neighbour(2, 0, Plan(period_s, plan_ahead(0.2).eta, plan_ahead(0.2).eta), fresh=True)
    nodes_s = 0.3 * np.arange(1, 20, dtype=np.float64)
    formation = Formation(WATER.safety, nodes_s, (1.0, 1.0, 1.0, 1.0), has_leader=False)
    eta = np.array([0.0, 0.0, 0.3, 0.0])
    goal = driving.Driver(WATER).goal(DriveVelocity(surge_mps=0.2), 0.5, eta, driving.bodies([wild], [], formation, 0))
    assert goal.surge_mps == 0.2 and formation.predict_neighbours([wild], 0).neighbours == ()


def test_a_driven_robot_rises_until_its_hull_touches_the_surface() -> None:
    """No thrust lifts it out: a reference above would leave it behind, off its depth."""
    driver, eta = driving.Driver(POOL), np.array([0.0, 0.0, 0.5, 0.0])
    for _ in range(round(20.0 / POOL.controller.period_s)):
        eta[2] = driver.goal(DriveVelocity(heave_mps=-1.0), 0.5, eta, ()).eta[2]
    assert eta[2] == pytest.approx(POOL.vehicle.radius_m, abs=1e-3)
    eta[2] = 0.5 * POOL.vehicle.radius_m  # it floats
    driver.reset()
    assert driver.goal(DriveVelocity(heave_mps=-1.0), 0.5, eta, ()).eta[2] == eta[2]


@pytest.mark.parametrize("heave_mps", [-0.2, 0.2])
def test_a_driven_robot_whose_thrust_goes_into_surge_and_turn_keeps_to_its_depth(heave_mps: float) -> None:
    """Its depth's reference waits for it, and the robot goes more slowly until it has come there."""
    driver, eta, limit_m = driving.Driver(WATER), np.array([0.0, 0.0, 1.0, 0.0]), WATER.safety.off_depth_m
    velocity = DriveVelocity(0.2, heave_mps, 1.0)
    for _ in range(round(3.0 / WATER.controller.period_s)):
        goal = driver.goal(velocity, 0.5, eta, ())
    assert 0.0 < abs(goal.eta[2] - eta[2]) < 0.6 * limit_m
    eta[2] -= np.copysign(0.25 * limit_m, heave_mps)  # the water carries it farther off
    slower = driver.goal(velocity, 0.5, eta, ())
    assert 0.0 < slower.surge_mps < 0.8 * velocity.surge_mps and 0.0 < slower.yaw_rate_radps < 0.8 * velocity.yaw_rate_radps
    assert slower.heave_mps == pytest.approx(heave_mps)
    assert driver.goal(velocity, 0.5, eta, (), heave_mps).surge_mps == velocity.surge_mps  # it goes there
