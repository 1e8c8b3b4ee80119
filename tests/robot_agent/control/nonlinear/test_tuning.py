"""Bandwidths and limits of vehicles that nobody tuned for, and the table in the docs."""

import math
from pathlib import Path

import numpy as np
import pytest

from robot_agent.control.nonlinear.tuning import (
    TILT_RAD,
    Manner,
    derive,
    fastest_mps,
    formulas,
    horizon_s,
    planar_limits,
    planar_weights,
    step_s,
)
from robot_agent.vehicle.dynamics import loop_delay_s
from robot_agent.vehicle.estimate import Deviations, Ratios
from shoal.config.experiment import load_experiment
from shoal.config.vehicle import Vehicle, load_vehicle
from sim_bridge.plant.rigid_body import coriolis, hull_of, restoring
from sim_bridge.plant.vectors import NO_VECTOR, Rotation, SixVector, Vector, to_body

DOCS = Path(__file__).parents[4] / "docs" / "control.md"
SPHERICAL = load_experiment("pool").vehicle
USUAL = Deviations(0.001, 0.002, 0.002, 0.002, 0.0, 0.0, np.zeros(3), Ratios(0.0, 0.0, 0.0))


def vehicle(*settings: str) -> Vehicle:
    return load_experiment("pool", [f"vehicle.{setting}" for setting in settings]).vehicle


def test_the_docs_have_the_table_of_the_formulas() -> None:
    """Both vehicles' columns: `make docs` writes them."""
    page = DOCS.read_text(encoding="utf-8")
    for ours, theirs in zip(formulas(SPHERICAL, 0.05), formulas(load_vehicle("vectored"), 0.05), strict=True):
        assert f"| {' | '.join((*ours, theirs[2]))} |" in page


def test_the_weaker_side_thrust_limits_a_robot_that_has_it() -> None:
    """Surge 20 N/s on 19 kg, sway 15 N/s on 26.2 kg: the place follows as quickly as sideways, and both have their weights."""
    vectored, deviations = load_vehicle("vectored"), USUAL._replace(place_m=1e-6, ground_mps=1e-6)
    bandwidths = derive(vectored, 1e-3, deviations, (100.0, 2.0), 1.0)
    assert bandwidths.quickness == pytest.approx((15.0 / (26.2 * 0.4 * 0.30)) ** (1.0 / 3.0))
    surge, sway, yaw = planar_weights(vectored, bandwidths, 0.2, Manner(0.01, 0.0), 1.0).rate
    assert (surge / sway) ** 0.5 == pytest.approx(26.2 / 19.0) and yaw > 0.0
    assert planar_limits(vectored).size.tolist() == pytest.approx([20.0, 15.0, 5.0])


def test_a_heavier_robot_is_slower_and_looks_farther_ahead() -> None:
    heavy = vehicle("mass.surge_kg=40", "mass.sway_kg=40", "mass.yaw_kg_m2=1.0")
    light, slow = (derive(v, 0.1, USUAL, (4.0, 2.0), 0.2) for v in (SPHERICAL, heavy))
    assert slow.quickness == pytest.approx(light.quickness * (12.0 / 40.0) ** (1.0 / 3.0), rel=1e-6)
    assert slow.turning < 0.6 * light.turning
    assert horizon_s(SPHERICAL) < horizon_s(heavy) <= 12.0


@pytest.mark.parametrize("worse", ["noise", "delay", "observer", "thrust"])
def test_less_knowledge_makes_it_slower(worse: str) -> None:
    deviations = USUAL._replace(place_m=0.01, ground_mps=0.02) if worse == "noise" else USUAL
    if worse == "thrust":
        deviations = USUAL._replace(ratios=Ratios(0.0, 0.5, 0.0))
    delay, observer = (0.4 if worse == "delay" else 0.1), (1.0 if worse == "observer" else 4.0)
    assert (
        derive(SPHERICAL, delay, deviations, (observer, 2.0), 0.0).quickness
        < 0.7 * derive(SPHERICAL, 0.1, USUAL, (4.0, 2.0), 0.0).quickness
    )


def test_surge_does_not_tilt_the_hull_too_far() -> None:
    """Balance of moments at the limit: the thrust's and that of the mass it speeds up, against the righting moment."""
    strong = vehicle("limits.wrench=[18,9,1.5]", "limits.wrench_rate_per_s=[18,18,6]", "thruster.max_thrust_n=2.9")
    limits = planar_limits(strong)
    assert strong.righting is not None
    tilting = limits.size[0] * (strong.righting.thrusters_below_m + strong.righting.moment_nm / 9.81 / 12.0)
    assert math.asin(tilting / strong.righting.moment_nm) == pytest.approx(TILT_RAD)
    assert limits.rate[0] * 0.5 * strong.righting.swing_s == pytest.approx(limits.size[0])
    assert planar_limits(SPHERICAL).size[0] == 6.0 and planar_limits(SPHERICAL).rate[0] == 6.0


def test_light_robots_are_integrated_in_shorter_steps() -> None:
    light = vehicle("mass.yaw_kg_m2=0.02")
    slope = (0.08 + 2.0 * 0.10 * 1.9) / 0.02
    assert step_s(light) == pytest.approx(1.0 / slope) and step_s(SPHERICAL) == 0.2
    assert loop_delay_s(SPHERICAL, 0.05, 0.1) == pytest.approx(0.05 + 0.025 + 0.03)


def test_a_hull_at_its_greatest_speed_is_pitched_no_farther_than_by_thrust_alone() -> None:
    """The plant's own forces on a hull that is pitched by TILT_RAD and pushed against its drag: they right it a little below
    that speed, and pitch it on a little above. The shipped vehicle's greatest speed is its file's."""
    moment = ("vehicle.righting.moment_nm=0.9", "sim.plant.tilt.righting_nm=0.9")
    fast = load_experiment("straight", ["vehicle.limits.speed_mps=2.0", *moment])
    hull, vehicle = hull_of(fast), fast.vehicle
    turn = Rotation(0.0, 1.0, math.sin(TILT_RAD), math.cos(TILT_RAD), 0.0, 1.0)

    def moment_nm(speed_mps: float) -> float:
        velocity = SixVector(to_body(turn, Vector(speed_mps, 0.0, 0.0)), NO_VECTOR)
        thrust_n = (vehicle.drag.linear[0] + vehicle.drag.quadratic[0] * speed_mps) * speed_mps
        water_nm = coriolis(hull, velocity).angular.y + restoring(hull, turn, 5.0).angular.y
        return thrust_n * fast.sim.plant.tilt.legs_below_m - water_nm

    greatest_mps = fastest_mps(vehicle)
    thrust_n = (vehicle.drag.linear[0] + vehicle.drag.quadratic[0] * greatest_mps) * greatest_mps
    assert planar_limits(vehicle).size[0] == pytest.approx(thrust_n) and thrust_n < vehicle.limits.wrench[0]
    assert moment_nm(0.9 * greatest_mps) < 0.0 < moment_nm(1.05 * greatest_mps)
    assert fastest_mps(SPHERICAL) == SPHERICAL.limits.speed_mps
