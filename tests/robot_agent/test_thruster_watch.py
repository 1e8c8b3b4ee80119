"""What the watch finds in flights of the plant, which knows nothing of it: what is broken, and nothing where nothing is."""

import math
from collections.abc import Sequence

import numpy as np
import pytest

from benchmarks.flights import prepared
from robot_agent.thruster_watch import ThrusterWatch
from sim_bridge.numeric import fly
from wire.experiment import load_experiment
from wire.messages import Mode

ROUGH = ("sim.plant.gust_mps=0.03", "sim.plant.waves.height_m=0.05")
WITHIN_S = 2.0
STEP_NS = 50_000_000


def flagged(settings: Sequence[str], duration_s: float, faults: Sequence[str] = ()) -> dict[int, float]:
    """Which robots stopped because of their thrusters, and when."""
    fleet, water = prepared(load_experiment("pool", [*settings, f"duration_s={duration_s}"], faults))
    fleet.start()
    for _ in fly(fleet, water):
        pass
    found: dict[int, float] = {}
    for number, robot in zip(fleet.experiment.robot_ids, fleet.robots, strict=True):
        begin = next(k for k, state in enumerate(robot.states) if state.trajectory_s > 0.0)
        times = [(k - begin) * 0.05 for k, s in enumerate(robot.states) if s.fault == "thrusters do not do as told"]
        found |= {number: times[0]} if times else {}
        assert all(s.mode is Mode.FAULT and s.pulse_us[:4] == (1500,) * 4 for s in robot.states[-1:] if times)
    return found


@pytest.mark.parametrize(
    ("at_s", "what"),
    [
        (12.0, "2/1 dead"),
        (11.0, "1/2 dead"),
        (14.0, "2/3 dead"),
        (17.0, "1/4 dead"),
        (8.0, "2/1 reversed"),
        (11.0, "1/4 reversed"),
    ],
)  # while each of them pushes
def test_a_broken_thruster_is_found_within_two_seconds(at_s: float, what: str) -> None:
    found = flagged((), at_s + WITHIN_S, [f"t={at_s} thruster {what}"])
    assert list(found) == [int(what[0])]
    assert at_s < found[int(what[0])] <= at_s + WITHIN_S


@pytest.mark.parametrize(
    ("seed", "at_s", "what"),
    [(3, 10.0, "2/3 dead"), (12, 11.45, "1/4 dead"), (18, 9.59, "2/2 dead"), (52, 13.07, "2/4 dead"), (59, 10.81, "1/3 dead")],
)
def test_a_leg_missing_from_a_turn_is_found_within_two_seconds(seed: int, at_s: float, what: str) -> None:
    """The others make up for it: of what turns the robot a quarter is missing, no more than a wrong inertia may explain."""
    assert list(flagged((f"seed={seed}",), at_s + WITHIN_S, [f"t={at_s} thruster {what}"])) == [int(what[0])]


@pytest.mark.parametrize(
    "settings",
    [
        ("sim.plant.mass_error=-0.3", "sim.plant.thruster_spread=0.3"),
        ("sim.plant.mass_error=-0.3", "sim.plant.drag_error=0.3", "seed=23"),
        (*ROUGH, "seed=3", "sim.plant.mass_error=0.3", "sim.plant.current_mps=[0.014,0,0]"),
    ],
    ids=str,
)
def test_a_wrong_model_and_rough_water_are_no_broken_thrusters(settings: Sequence[str]) -> None:
    assert flagged(settings, 20.0) == {}


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(8))
@pytest.mark.parametrize("name", ["pool", "figure-eight"])
def test_no_false_alarm_in_long_flights(name: str, seed: int) -> None:
    random = np.random.default_rng(seed)
    settings = (f"sim.plant.mass_error={random.uniform(-0.3, 0.3):.2f}", f"sim.plant.gust_mps={random.uniform(0, 0.03):.3f}")
    assert flagged((*settings, f"sim.plant.waves.height_m={random.uniform(0, 0.05):.3f}", f"seed={seed}"), 120.0) == {}


def watched(
    torque_nm: Sequence[float],
    told_nm: Sequence[float],
    gyro_error: float = 0.0,
    deaf: range = range(0),
    late: range = range(0),
) -> ThrusterWatch:
    """A watch on a body that these moments turn, by an integration of its own in steps of 1 ms; it is told of others. In some
    steps it hears nothing of the gyroscope, in some it hears 0.1 s late, and what was 0.1 s ago."""
    vehicle = load_experiment("pool").vehicle
    watch, rate, acting = ThrusterWatch(vehicle), 0.0, 0.0
    drag, mass, thruster = vehicle.drag, vehicle.mass.yaw_kg_m2, vehicle.thruster
    dead = round(thruster.dead_time_s / 0.001)
    line, rates = [0.0] * dead, [0.0, 0.0]
    for k, (torque, told) in enumerate(zip(torque_nm, told_nm, strict=True)):
        watch.told(told, k * STEP_NS)
        for _ in range(50):
            line.append(torque)
            acting += 0.001 / thruster.lag_s * (line.pop(0) - acting)
            rate += 0.001 / mass * (acting - drag.linear[3] * rate - drag.quadratic[3] * abs(rate) * rate)
        rates.append(rate + gyro_error)
        at_ns = (k + 1) * STEP_NS
        if k in late and k % 4 < 2:
            watch.step(rates[-3], at_ns, at_ns - 2 * STEP_NS)
        elif k not in deaf:
            watch.step(rates[-1], at_ns, at_ns)
    return watch


def test_an_obeyed_moment_is_no_alarm_and_its_opposite_is() -> None:
    told = [0.08 * math.sin(0.1 * k) for k in range(400)]
    assert not watched(told, told).broken
    assert not watched([1.25 * n for n in told], told).broken
    assert watched([*told[:300], *(-n for n in told[300:])], told).broken


def test_how_a_robot_turns_is_learned() -> None:
    """Seven tenths of the moment all the time are a heavy robot; seven tenths from now on are a broken one."""
    told = [0.05 * math.sin(0.06 * k) for k in range(700)]
    assert not watched([0.7 * n for n in told], told).broken
    assert not watched([*told[:600], *(0.95 * n for n in told[600:])], told).broken
    assert watched([*told[:600], *(0.7 * n for n in told[600:])], told).broken


def test_what_was_learned_outlasts_a_gap() -> None:
    """The gap itself is no alarm either, though the robot turned meanwhile."""
    told = [0.05 * math.sin(0.06 * k) for k in range(700)]
    obeyed = [0.8 * n for n in told]
    gap = range(560, 580)
    assert not watched(obeyed, told, deaf=gap).broken
    assert watched([*obeyed[:620], *(0.55 * n for n in told[620:660])], told[:660], deaf=gap).broken


def test_what_is_heard_late_is_no_alarm() -> None:
    told = [0.25 * math.sin(0.15 * k) for k in range(700)]
    assert not watched(told, told, late=range(500, 600)).broken


def test_a_gyroscope_with_a_bias_is_no_alarm() -> None:
    told = [0.01 * math.sin(0.1 * k) for k in range(400)]
    assert not watched(told, told, gyro_error=0.02).broken


def test_a_bump_is_no_alarm_and_a_push_that_lasts_is() -> None:
    none = [0.0] * 400
    for steps, broken in ((4, False), (30, True)):
        pushed = [*none[:300], *[0.012] * steps, *none[300 + steps :]]
        assert watched(pushed, none).broken is broken


def test_numbers_that_cannot_be_and_gaps_begin_anew() -> None:
    watch = watched([0.0] * 100, [0.0] * 100)
    for at_ns in (10**12, 10**12, 10**12 - STEP_NS):  # after a gap the rate may be any
        watch.step(3.0, at_ns, at_ns)
    assert not watch.broken
    watch.reset()
    assert not watch.broken
