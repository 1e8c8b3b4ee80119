"""The response to thrust, on a hull that these tests integrate themselves."""

import math

import numpy as np
import pytest

from robot_agent.safety.thrust_response import Axis, Standstill, ThrustResponse
from shoal.config.vehicle import load_vehicle

VEHICLE = load_vehicle("spherical")
POSE_M, YAW_RAD = 0.0015, 0.008
FINE_S = 0.01


def fly(
    marker_deg: float = 0.0,
    held_s: float = math.inf,
    mass: float = 1.0,
    current: complex = 0j,
    waves_mps: float = 0.0,
    rate_hz: int = 20,
    seed: int = 1,
) -> tuple[float | None, float | None, float]:
    """A robot that steers a course of its own accord: the instants at which it is found to be held, and its marker to be
    turned, and by how much."""
    random, response = np.random.default_rng(seed), ThrustResponse(VEHICLE)
    place, velocity, yaw, acting_n, held, turned, angle = 0j, current, 0.3, 0.0, None, None, 0.0
    sent_n: list[float] = []
    for k in range(round(12.0 / FINE_S)):
        time_s = k * FINE_S
        if k % round(1.0 / (rate_hz * FINE_S)) == 0:
            measured_place = place + POSE_M * complex(*random.normal(size=2))
            read_rad = yaw + math.radians(marker_deg) + YAW_RAD * random.normal()
            response.note_pose(round(time_s * 1e9), measured_place, read_rad, POSE_M**2)
            surge_n = 5.0 * math.sin(0.9 * time_s) if time_s > 1.0 else 0.0
            response.note_thrust(surge_n, 0.0, round(time_s * 1e9))
            if held is None and response.held_fast:
                held = time_s
            if turned is None and response.marker_turned_rad:
                turned, angle = time_s, math.degrees(response.marker_turned_rad)
        sent_n.append(surge_n)
        late = sent_n[-1 - round(VEHICLE.thruster.dead_time_s / FINE_S)] if len(sent_n) > 6 else 0.0
        acting_n += (late - acting_n) * FINE_S / VEHICLE.thruster.lag_s
        water = current + waves_mps * math.sin(math.pi * time_s)
        through = velocity - water
        drag = (VEHICLE.drag.linear[0] + VEHICLE.drag.quadratic[0] * abs(through)) * through
        push = acting_n * complex(math.cos(yaw), math.sin(yaw))
        velocity += FINE_S * (push - drag) / (mass * VEHICLE.mass.surge_kg)
        yaw += 0.2 * math.cos(0.5 * time_s) * FINE_S
        if time_s >= held_s:
            velocity = 0j
        place += velocity * FINE_S
    return held, turned, angle


def test_thrust_that_lasts_may_be_balanced_and_is_no_evidence_any_more() -> None:
    """A robot that stands in a current that has grown: what it gave at first is forgotten."""
    standstill, pushed_m = Standstill(Axis(1.0, 4.0, 0.002)), list[float]()
    for k in range(400):
        standstill.step(0j, 0.0, 0.01 + 0j if k else 0j, 0.05)
        pushed_m.append(standstill.pushed)
    assert max(pushed_m) > 1e-3 and pushed_m[-1] < 0.01 * max(pushed_m)


@pytest.mark.parametrize(("marker_deg", "rate_hz"), [(20.0, 20), (-57.0, 10), (90.0, 20), (180.0, 50)])
def test_marker_that_is_turned_is_found_with_its_angle(marker_deg: float, rate_hz: int) -> None:
    held, turned, angle = fly(marker_deg, rate_hz=rate_hz, mass=1.3)
    assert held is None and turned is not None and turned < (4.0 if abs(marker_deg) > 50.0 else 8.0)
    assert abs((angle - marker_deg + 180.0) % 360.0 - 180.0) < 10.0


@pytest.mark.parametrize("rate_hz", [10, 20, 50])
def test_robot_that_is_held_is_found_at_the_start_and_in_flight(rate_hz: int) -> None:
    at_once, turned, _ = fly(held_s=0.0, rate_hz=rate_hz)
    assert at_once is not None and at_once < 3.0 and turned is None
    later, turned, _ = fly(held_s=6.0, rate_hz=rate_hz)
    assert later is not None and 6.0 < later < 8.0 and turned is None


@pytest.mark.parametrize("mass", [0.5, 1.0, 2.0])
@pytest.mark.parametrize(("current", "waves_mps"), [(0j, 0.0), (0.2 + 0.3j, 0.0), (0.1j, 0.1)])
def test_wrong_mass_currents_and_waves_are_neither(mass: float, current: complex, waves_mps: float) -> None:
    for seed in range(3):
        assert fly(mass=mass, current=current, waves_mps=waves_mps, seed=seed) == (None, None, 0.0)


def test_after_a_gap_or_a_reset_it_begins_anew_and_what_came_before_is_ignored() -> None:
    response = ThrustResponse(VEHICLE)
    for k in range(40):
        response.note_pose(k * 50_000_000, 0j, 0.0, POSE_M**2)
        response.note_thrust(6.0, 0.0, k * 50_000_000)
    assert response.held_fast
    response.note_pose(10_000_000_000, 3.0 + 0j, 0.0, POSE_M**2)
    assert not response.held_fast and response.response.gain == 1.0
    response.note_pose(9_000_000_000, 5.0 + 0j, 0.0, POSE_M**2)
    assert response.place.stands_s == 0.0


@pytest.mark.parametrize("rate_hz", [10, 20, 50])
@pytest.mark.parametrize("inertia", [0.5, 1.0, 2.0])
def test_robot_that_only_turns_at_first_is_found_if_it_is_held_and_not_if_it_turns(inertia: float, rate_hz: int) -> None:
    """A robot that faces away from its path gives no other thrust."""
    for is_held in (False, True):
        random, response, found_s = np.random.default_rng(1), ThrustResponse(VEHICLE), None
        yaw, rate_radps, acting_nm = 2.0, 0.0, 0.0
        for k in range(3 * rate_hz):
            period_s, moment_nm = 1.0 / rate_hz, 0.5 if (k / rate_hz) % 2.0 < 1.0 else -0.5
            place = POSE_M * complex(*random.normal(size=2))
            response.note_pose(round(k * period_s * 1e9), place, yaw + YAW_RAD * random.normal(), POSE_M**2)
            response.note_thrust(0.0, moment_nm, round(k * period_s * 1e9))
            if found_s is None and response.held_fast:
                found_s = k * period_s
            acting_nm += (moment_nm - acting_nm) * min(period_s / VEHICLE.thruster.lag_s, 1.0)
            drag_nm = (VEHICLE.drag.linear[3] + VEHICLE.drag.quadratic[3] * abs(rate_radps)) * rate_radps
            rate_radps += 0.0 if is_held else period_s * (acting_nm - drag_nm) / (inertia * VEHICLE.mass.yaw_kg_m2)
            yaw += rate_radps * period_s
        assert (found_s is not None and found_s < 1.5) if is_held else found_s is None
