"""Allocation against the forward equations of the legs, at and beyond the limits."""

import math

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from robot_agent.vehicle.allocation import Allocator
from shoal.config.vehicle import load_vehicle
from shoal.frames import Array
from shoal.messages.messages import required

VEHICLE = load_vehicle("spherical")
ALLOCATOR = Allocator(VEHICLE)
POSITION = np.array(required(VEHICLE.legs).position_m)
AHEAD, ASTERN = 3.0, 2.801  # ends of the vehicle's curve


def delivered(force: Array, ankle: Array) -> Array:
    """X = sum F cos a, Z = sum F sin a, N = sum of moments about z: -y X_i."""
    ahead = force * np.cos(ankle)
    return np.array([ahead.sum(), (force * np.sin(ankle)).sum(), -(POSITION[:, 1] * ahead).sum()])


wrenches = st.tuples(st.floats(-6, 6), st.floats(-3, 3), st.floats(-0.5, 0.5))


@settings(max_examples=400, deadline=None)
@given(wrenches)
def test_feasible_wrench_is_delivered_exactly(wrench: tuple[float, float, float]) -> None:
    surge, heave, yaw = wrench
    side = abs(surge) / 4 + abs(yaw) / (4 * 0.0833)
    assume(side < 2.2 and math.hypot(side, abs(heave) / 4) < 2.4 and abs(heave) / 4 < 1.1 * max(side, 0.7))
    force, ankle = ALLOCATOR.forces(wrench)
    assert delivered(force, ankle) == pytest.approx(np.array(wrench), abs=1e-9)


@settings(max_examples=400, deadline=None)
@given(wrenches)
def test_limits_hold_and_heave_gives_way_first(wrench: tuple[float, float, float]) -> None:
    force, ankle = ALLOCATOR.forces(wrench)
    assert max(force) <= AHEAD + 1e-9 and min(force) >= -ASTERN - 1e-9
    assert max(map(abs, ankle)) <= math.radians(60) + 1e-9
    got = delivered(force, ankle)
    assert got[0] == pytest.approx(wrench[0], abs=1e-9)  # 6 N always fit
    assert abs(got[2]) <= abs(wrench[2]) + 1e-9 and got[2] * wrench[2] >= -1e-12
    assert abs(got[1]) <= abs(wrench[1]) + 1e-9 and got[1] * wrench[1] >= -1e-12
    if abs(got[2]) < abs(wrench[2]) - 1e-9:  # yaw was cut: one side is at its end, and nothing is spent on heave there
        assert max(max(force) / AHEAD, -min(force) / ASTERN) > 1 - 1e-6


def test_full_box_corner_keeps_surge_and_yaw() -> None:
    force, ankle = ALLOCATOR.forces((6.0, 3.0, 0.4998))
    got = delivered(force, ankle)
    assert got[[0, 2]] == pytest.approx([6.0, 0.4998], abs=1e-9) and got[1] < 1.0


def test_reverse_has_less_and_yaw_gives_way() -> None:
    force, ankle = ALLOCATOR.forces((-6.0, 0.0, 0.5))
    got = delivered(force, ankle)
    assert got[0] == pytest.approx(-6.0) and 0.3 < got[2] < 0.5


def test_quiet_water_keeps_every_thruster_outside_its_dead_zone() -> None:
    """Front legs push, rear legs pull, at least half the idle thrust, over the wrenches of slow flight."""
    random = np.random.default_rng(0)
    for _ in range(300):
        wrench = random.uniform(-1, 1, 3) * [0.2, 0.4, 0.008]
        pulses = ALLOCATOR.pulses(wrench)
        assert all(p > 1530 for p in pulses[:2]) and all(p < 1470 for p in pulses[2:4])


def test_level_scenes_stay_level_and_heave_tilts_all_ankles_alike() -> None:
    assert ALLOCATOR.pulses(np.array([1.0, 0.0, 0.05]))[4:] == (1500,) * 4
    _, ankle = ALLOCATOR.forces((0.1, 0.3, 0.0))
    assert ankle[0] == pytest.approx(ankle[1]) and ankle[0] == pytest.approx(-ankle[2]) and ankle[0] > 0


def test_reversing_surge_never_turns_an_ankle_over() -> None:
    angles = np.array([ALLOCATOR.forces((x, -0.2, 0.0))[1] for x in np.linspace(-3, 3, 6001)])
    assert np.abs(angles).max() < math.radians(61)
    assert np.abs(np.diff(angles, axis=0)).max() < 0.03  # rad per millinewton: passes level, never jumps


@settings(max_examples=300, deadline=None)
@given(wrenches, st.tuples(*[st.floats(-1, 1)] * 3))
def test_forces_are_continuous(wrench: tuple[float, float, float], direction: tuple[float, float, float]) -> None:
    nudge = 1e-5 * np.array(direction) * [1, 1, 0.1]
    here, there = ALLOCATOR.forces(wrench), ALLOCATOR.forces(np.array(wrench) + nudge)
    assert np.abs(np.array(here[0]) - there[0]).max() < 2e-3
    assert np.abs(np.array(here[1]) - there[1]).max() < 2e-2


def test_pulses_move_little_when_the_wrench_does() -> None:
    """A walk through slow flight, 2 mN at a time: a few microseconds, dead-zone edges apart (46 us)."""
    before, jumps = ALLOCATOR.pulses(np.array([-1.5, 0.1, 0.0])), 0
    for x in np.arange(-1.5, 1.5, 0.002):
        now = ALLOCATOR.pulses(np.array([x, 0.1, 0.0]))
        for a, b in zip(now[:4], before[:4], strict=True):
            crossed = (a - 1500) * (b - 1500) <= 0
            jumps += crossed
            assert abs(a - b) <= (50 if crossed else 3)
        before = now
    assert jumps <= 4 * 2


@settings(max_examples=300, deadline=None)
@given(st.tuples(st.floats(-50, 50), st.floats(-50, 50), st.floats(-9, 9)))
def test_pulses_are_whole_and_in_range(wrench: tuple[float, float, float]) -> None:
    pulses = ALLOCATOR.pulses(np.array(wrench))
    assert len(pulses) == 8 and all(isinstance(p, int) for p in pulses)
    assert all(1100 <= p <= 1900 for p in pulses[:4]) and all(1000 <= p <= 2000 for p in pulses[4:])


@pytest.mark.parametrize("range_rad", [0.2, 0.7, math.pi / 2, math.pi])
def test_ankles_turn_no_farther_than_they_can(range_rad: float) -> None:
    """A board refuses a whole override for one pulse out of range. What fits within that range is delivered."""
    legs = required(VEHICLE.legs).model_copy(update={"ankle_range_rad": range_rad})
    allocator = Allocator(VEHICLE.model_copy(update={"legs": legs}))
    for heave in np.linspace(-3.0, 3.0, 61):
        assert all(1000 <= pulse <= 2000 for pulse in allocator.pulses(np.array([0.4, heave, 0.02]))[4:])
    most = 4.0 * 1.1 * math.sin(min(range_rad, math.radians(60.0)))
    assert delivered(*allocator.forces((0.0, 0.9 * most, 0.0))) == pytest.approx([0.0, 0.9 * most, 0.0], abs=1e-9)


@settings(max_examples=200, deadline=None)
@given(st.tuples(st.floats(-3, 3), st.floats(-1, 1), st.floats(-0.1, 0.1)))
def test_delivered_is_what_the_pulses_say(wrench: tuple[float, float, float]) -> None:
    """Through the pulses and back by the vehicle's own curve: right to the microsecond's worth."""
    pulses = ALLOCATOR.pulses(np.array(wrench))
    force = VEHICLE.thruster.force_n(np.array(pulses[:4], dtype=float))
    ankle = (np.array(pulses[4:]) - 1500) / 500 * required(VEHICLE.legs).ankle_range_rad
    got, moments = ALLOCATOR.delivered(pulses)
    assert got == pytest.approx(delivered(force, ankle), abs=1e-12)
    assert moments == pytest.approx(-POSITION[:, 1] * force * np.cos(ankle), abs=1e-12)
    level, turned = ALLOCATOR.level_moments(pulses)
    assert level == pytest.approx(-POSITION[:, 1] * force, abs=1e-12) and turned == pytest.approx(ankle, abs=1e-12)
    assert got[0] == pytest.approx(wrench[0], abs=0.04)


def test_neutral_delivers_nothing() -> None:
    assert ALLOCATOR.neutral_us == (1500,) * 8
    assert not ALLOCATOR.delivered(ALLOCATOR.neutral_us)[0].any()


@pytest.mark.parametrize("poison", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("axis", [0, 1, 2])
def test_wrench_that_is_not_finite_gives_neutral(axis: int, poison: float) -> None:
    wrench = np.zeros(3)
    wrench[axis] = poison
    allocator = Allocator(load_vehicle("spherical"))
    assert allocator.pulses(wrench) == allocator.neutral_us
