"""Faults found in flights of the plant, which shares no code with the detector; and no false ones."""

import math
from collections.abc import Sequence

import numpy as np
import pytest

from robot_agent.safety.thruster_fault_detection import ThrusterFaultDetector
from shoal.config.experiment import load_experiment
from shoal.frames import Array
from shoal.messages.messages import Mode
from tests.flights.cells import draw
from tests.flights.scene_flights import flew, rough_water
from tests.flights.vehicles import VEHICLES

pytestmark = pytest.mark.long

ROUGH = ("sim.plant.gust_mps=0.03", "sim.plant.waves.height_m=0.05")
WITHIN_S = 2.0
STEP_NS = 50_000_000
GYRO_RADPS = 0.003
LEVEL = np.zeros(4)  # ankles


def flagged(settings: Sequence[str], duration_s: float, faults: Sequence[str] = (), name: str = "pool") -> dict[int, float]:
    """Which robots stopped because of their thrusters, and when."""
    fleet = flew(load_experiment(name, [*settings, f"duration_s={duration_s}"], faults))
    instants_s: dict[int, float] = {}
    for number, robot in zip(fleet.experiment.robot_ids, fleet.robots, strict=True):
        begin = next(k for k, state in enumerate(robot.states) if state.trajectory_s > 0.0)
        times = [(k - begin) * 0.05 for k, s in enumerate(robot.states) if s.fault.startswith("thrusters do not do as told")]
        instants_s |= {number: times[0]} if times else {}
        assert all(s.mode is Mode.FAULT and s.pulse_us[:4] == (1500,) * 4 for s in robot.states[-1:] if times)
    return instants_s


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
    instants_s = flagged((), at_s + WITHIN_S, [f"t={at_s} thruster {what}"])
    assert list(instants_s) == [int(what[0])]
    assert at_s < instants_s[int(what[0])] <= at_s + WITHIN_S


@pytest.mark.parametrize(
    ("seed", "at_s", "what"),
    [(3, 10.0, "2/3 dead"), (12, 12.45, "1/4 dead"), (18, 9.59, "2/2 dead"), (52, 13.07, "2/4 dead"), (59, 10.81, "1/3 dead")],
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


def test_battery_that_falls_at_once_is_no_broken_thruster_and_one_that_breaks_then_is_found() -> None:
    """By 2.4 V, to what a robot may just fly with: all legs give a quarter less."""
    sag = [f"t=8 battery {robot} sag 2.4" for robot in (1, 2)]
    assert flagged((), 12.0, sag, "figure-eight") == {}
    instants_s = flagged((), 16.0, [*sag, "t=14 thruster 2/3 dead"])
    assert list(instants_s) == [2] and instants_s[2] > 14.0


@pytest.mark.parametrize("number", [5, 16, 17])
def test_water_past_a_long_hull_is_no_broken_thruster(number: int) -> None:
    """It turns such a hull with up to 0.4 N m, and as a flight begins nobody knows how it streams."""
    assert flagged((*draw("vehicle-vectored", number).settings, "duration_s=10"), 10.0, name="straight") == {}


@pytest.mark.parametrize(("name", "what"), [("pool", "2/4 dead"), ("figure-eight", "2/1 dead"), ("pool", "2/2 reversed")])
def test_a_broken_thruster_of_a_long_hull_is_found(name: str, what: str) -> None:
    instants_s = flagged(VEHICLES["vectored"].settings(), 15.0 + WITHIN_S, [f"t=15 thruster {what}"], name)
    assert list(instants_s) == [2] and instants_s[2] > 15.0


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(8))
@pytest.mark.parametrize("name", ["pool", "figure-eight"])
def test_no_false_alarm_in_long_flights(name: str, seed: int) -> None:
    settings = rough_water(np.random.default_rng(seed))
    assert flagged((*settings, f"seed={seed}"), 120.0, name=name) == {}


def legs(seconds: float, swing: float = 0.06, largest_nm: float = 0.05) -> Array:
    """Moments commanded to each leg (n, 4), N m: to and fro together, and a little against its neighbour of the same side."""
    k = np.arange(round(seconds / 0.05))
    bias_nm = 0.01 + 0.004 * np.sin(0.021 * k)
    together = 0.25 * largest_nm * np.sin(swing * k)
    return np.column_stack([together + bias_nm, together - bias_nm, together - bias_nm, together + bias_nm])


def watched(
    torque_nm: Array,
    told_nm: Array,
    gyro_error: float = 0.0,
    deaf: range = range(0),
    late: range = range(0),
    watch_late_ns: int = 0,
    volts: dict[int, float] | None = None,
) -> ThrusterFaultDetector:
    """Detector on a body that the moments (n,) turn, integrated independently in steps of 1 ms; the detector is given the
    moments of the legs (n, 4). In some steps no gyroscope sample arrives, in others one that is 0.1 s old; in all steps
    the samples may be older than stated. `volts` are the battery's, by step."""
    vehicle = load_experiment("pool").vehicle
    detector, rate, acting = ThrusterFaultDetector(vehicle), 0.0, 0.0
    drag, mass, thruster = vehicle.drag, vehicle.mass.yaw_kg_m2, vehicle.thruster
    noise = np.random.default_rng(1).normal(0.0, GYRO_RADPS, len(told_nm))
    line, rates = [0.0] * round(thruster.dead_time_s / 0.001), [0.0, 0.0]
    for k, (torque, command_nm) in enumerate(zip(torque_nm, told_nm, strict=True)):
        detector.note_moments(command_nm, LEVEL, k * STEP_NS)
        if volts and k in volts:
            detector.note_voltage(volts[k], k * STEP_NS)
        for _ in range(50):
            line.append(torque)
            acting += 0.001 / thruster.lag_s * (line.pop(0) - acting)
            rate += 0.001 / mass * (acting - drag.linear[3] * rate - drag.quadratic[3] * abs(rate) * rate)
        rates.append(rate + gyro_error + noise[k])
        at_ns = (k + 1) * STEP_NS + watch_late_ns
        if k in late and k % 4 < 2:
            detector.step(rates[-3], at_ns, at_ns - 2 * STEP_NS)
        elif k not in deaf:
            detector.step(rates[-1], at_ns, at_ns)
    return detector


def test_an_obeyed_moment_is_no_alarm_and_its_opposite_is() -> None:
    commands_nm = legs(20.0, swing=0.1, largest_nm=0.08)
    moment = commands_nm.sum(axis=1)
    assert not watched(moment, commands_nm).broken
    assert not watched(1.25 * moment, commands_nm).broken
    assert not watched(0.75 * moment, commands_nm).broken
    assert watched(np.where(np.arange(400) < 300, moment, -moment), commands_nm).broken


@pytest.mark.parametrize("leg", range(4))
@pytest.mark.parametrize("gives", [0.7, 0.3, 0.0, -1.0])
def test_each_leg_that_gives_little_is_found_and_one_that_gives_most_is_not(leg: int, gives: float) -> None:
    commands_nm = legs(34.0)
    given = commands_nm.copy()
    given[600:, leg] *= gives
    assert watched(given.sum(axis=1), commands_nm).broken is (gives < 0.5)


def test_how_a_robot_turns_is_learned() -> None:
    """Seven tenths of the moment all the time are a heavy robot, and one leg that is weaker than others was built so."""
    commands_nm = legs(35.0)
    obeyed = 0.7 * commands_nm
    obeyed[:, 1] *= 0.8
    assert not watched(obeyed.sum(axis=1), commands_nm).broken
    broken = obeyed.copy()
    broken[600:, 2] = 0.0
    assert watched(broken.sum(axis=1), commands_nm).broken


def test_learned_habit_outlasts_a_gap() -> None:
    """The gap itself is no alarm either, though the robot turned meanwhile."""
    commands_nm = legs(35.0)
    obeyed = 0.75 * commands_nm
    gap = range(560, 580)
    assert not watched(obeyed.sum(axis=1), commands_nm, deaf=gap).broken
    broken = obeyed.copy()
    broken[620:, 0] = 0.0
    assert watched(broken.sum(axis=1)[:660], commands_nm[:660], deaf=gap).broken


def test_a_leg_that_stuck_is_found_when_it_should_do_otherwise() -> None:
    commands_nm = legs(35.0)
    given = commands_nm.copy()
    given[600:, 3] = given[600, 3]
    assert watched(given.sum(axis=1), commands_nm).broken


def test_late_sample_raises_no_alarm() -> None:
    """Now and then, or all the time."""
    commands_nm = legs(35.0, swing=0.15, largest_nm=0.25)
    assert not watched(commands_nm.sum(axis=1), commands_nm, late=range(500, 600)).broken
    assert not watched(commands_nm.sum(axis=1), commands_nm, watch_late_ns=20_000_000).broken
    quick_nm = legs(30.0, swing=0.5, largest_nm=1.0)  # 0.1 s ago the robot turned quite otherwise
    assert not watched(quick_nm.sum(axis=1), quick_nm, late=range(500, 600)).broken


def test_a_gyroscope_with_a_bias_is_no_alarm() -> None:
    commands_nm = legs(20.0, swing=0.1, largest_nm=0.01)
    assert not watched(commands_nm.sum(axis=1), commands_nm, gyro_error=0.02).broken


def test_a_push_that_stays_is_no_alarm_until_it_is_as_strong_as_a_leg() -> None:
    commands_nm = legs(30.0)
    for push_nm, broken in ((0.003, False), (0.015, True)):  # idle, a leg gives 0.01
        push = np.where(np.arange(len(commands_nm)) > 400, push_nm, 0.0)
        assert watched(commands_nm.sum(axis=1) + push, commands_nm).broken is broken


@pytest.mark.parametrize("seed", range(4))
def test_water_that_turns_the_robot_is_no_alarm(seed: int) -> None:
    """Gusts of any length, a third of what a leg gives at its least."""
    commands_nm, random = legs(60.0), np.random.default_rng(seed)
    for seconds in (0.3, 2.0):
        gusts, kept = np.zeros(len(commands_nm)), math.exp(-0.05 / seconds)
        for k in range(1, len(gusts)):
            gusts[k] = kept * gusts[k - 1] + 0.003 * math.sqrt(1.0 - kept**2) * random.standard_normal()
        assert not watched(commands_nm.sum(axis=1) + gusts, commands_nm).broken


def test_a_flight_begins_with_thrusters_at_rest() -> None:
    """However they pushed when the last one ended."""
    commands_nm = legs(10.0, largest_nm=0.4)
    detector = watched(commands_nm.sum(axis=1), commands_nm)
    detector.reset()
    begin_ns, still = 1000 * STEP_NS, np.zeros(4)
    for k in range(40):
        detector.note_moments(still, LEVEL, begin_ns + k * STEP_NS)
        detector.step(0.0, begin_ns + k * STEP_NS, begin_ns + k * STEP_NS)
    # below its limit the evidence is told to nobody
    assert abs(detector._test.evidence) < 1e-9


def test_numbers_that_cannot_be_and_gaps_begin_anew() -> None:
    detector = watched(np.zeros(100), np.zeros((100, 4)))
    for at_ns in (10**12, 10**12, 10**12 - STEP_NS):  # after a gap the rate may be any
        detector.step(3.0, at_ns, at_ns)
    assert not detector.broken
    detector.reset()
    assert not detector.broken


TO_AND_FRO = [(1, (12.0, 11.3)), (5, (12.0, 9.9)), (20, (12.0, 9.9)), (5, (12.0, 11.4, 10.9, 10.4, 9.9, 10.4, 10.9, 11.4))]


@pytest.mark.parametrize(("steps", "volts"), TO_AND_FRO)
def test_readings_to_and_fro_blind_nobody(steps: int, volts: Sequence[float]) -> None:
    """All the time, while a leg is dead too."""
    commands_nm = legs(34.0)
    given = commands_nm.copy()
    given[600:, 1] = 0.0
    read = {k: volts[k // steps % len(volts)] for k in range(len(commands_nm))}
    assert not watched(commands_nm.sum(axis=1), commands_nm, volts=read).broken
    assert watched(given.sum(axis=1)[: 600 + round(WITHIN_S / 0.05)], commands_nm[:640], volts=read).broken


def test_readings_that_no_battery_gives_blind_nobody() -> None:
    commands_nm = legs(34.0)
    given = commands_nm.copy()
    given[600:, 1] = 0.0
    nonsense = (12.0, np.inf, np.nan, -3.0, 0.0, 1e-300, 65.0)
    read = {k: nonsense[k % len(nonsense)] for k in range(100, len(commands_nm))}
    with np.errstate(all="raise"):
        assert not watched(commands_nm.sum(axis=1), commands_nm, volts=read).broken
        assert watched(given.sum(axis=1), commands_nm, volts=read).broken
