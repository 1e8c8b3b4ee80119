"""What the watch on the legs makes of forces that are put together here from the geometry, not from its own formulas."""

import math
from collections.abc import Callable

import numpy as np
import pytest

from robot_agent.leg_watch import LegWatch
from wire.experiment import load_experiment

VEHICLE = load_experiment("pool").vehicle
STEP_NS = 50_000_000
STILL = np.zeros(3)
Forces = Callable[[float], tuple[float, float, float]]  # of the time in s: ahead N, to starboard N, yaw N m


def flown(
    told: Forces, unexplained: Forces, yaw: Callable[[float], float] = lambda t: 0.0, seconds: float = 40.0
) -> float | None:
    """When the watch says that a leg is broken, s."""
    watch, mass = LegWatch(VEHICLE), VEHICLE.mass
    for k in range(round(seconds / 0.05)):
        t = 0.05 * k
        ahead, aside, turn = unexplained(t)
        disturbance = np.array([ahead / mass.surge_kg, aside / mass.sway_kg, 0.0, turn / mass.yaw_kg_m2])
        rate = (yaw(t + 0.01) - yaw(t - 0.01)) / 0.02
        watch.step(np.array(told(t)), rate, disturbance, yaw(t), k * STEP_NS)
        if watch.broken:
            return t
    return None


def idling(t: float) -> tuple[float, float, float]:
    """Told to the legs: a little surge, and turns to and fro."""
    return 0.1, 0.0, 0.03 * math.sin(0.7 * t)


@pytest.mark.parametrize("leg", range(4))
def test_a_leg_whose_force_is_missing_is_found(leg: int) -> None:
    """As the observer shows it: little by little."""
    _, across = VEHICLE.legs.position_m[leg]

    def missing(t: float) -> tuple[float, float, float]:
        force = -0.15 * (1.0 - math.exp(-max(t - 25.0, 0.0) / 0.7))
        return force, 0.0, -across * force

    found = flown(idling, missing)
    assert found is not None and 25.0 < found < 27.5


def test_a_stuck_leg_of_a_robot_that_turns_to_and_fro_is_found() -> None:
    """A quarter of the moment is missing, as with a wrong inertia; and a surge nobody asked for comes of it."""
    _, across = VEHICLE.legs.position_m[3]

    def told(t: float) -> tuple[float, float, float]:
        return 0.1, 0.0, 0.2 * math.sin(1.2 * t)

    def missing(t: float) -> tuple[float, float, float]:
        force = 0.25 * told(t)[2] / across if t > 25.0 else 0.0
        return force, 0.0, -across * force

    found = flown(told, missing)
    assert found is not None and 25.0 < found < 30.0


@pytest.mark.parametrize(
    ("told", "unexplained"),
    [
        (idling, lambda t: (0.3 * math.sin(0.4 * t), 0.1, 0.0)),
        (idling, lambda t: (0.0, 0.0, 0.05 * math.sin(0.4 * t))),
        (idling, lambda t: (0.15, 0.0, 0.15 * 0.0833)),
        (lambda t: (0.5, 0.0, 0.0), lambda t: (0.15, 0.0, 0.003 * math.sin(t))),
        (
            lambda t: (0.8 * math.sin(0.3 * t), 0.0, 0.08 * math.sin(t)),
            lambda t: (0.2 * math.sin(0.3 * t), 0.0, 0.02 * math.sin(t)),
        ),
        (idling, lambda t: (0.3 * math.sin(3.0 * t), 0.3 * math.sin(3.0 * t + 1.0), 0.01 * math.sin(2.0 * t))),
    ],
    ids=["water pushes", "inertia is wrong", "from the start", "battery is weak", "mass is wrong", "waves"],
)
def test_what_is_no_leg_is_no_alarm(told: Forces, unexplained: Forces) -> None:
    assert flown(told, unexplained) is None


def test_a_current_is_no_alarm_while_the_robot_turns_in_it() -> None:
    """It pushes ahead, then astern; the turning itself shows a moment that the model has not."""

    def yaw(t: float) -> float:
        return 0.5 * t

    def current(t: float) -> tuple[float, float, float]:
        return 0.3 * math.cos(yaw(t)), -0.3 * math.sin(yaw(t)), 0.02 * math.sin(0.6 * t)

    assert flown(lambda t: (0.1, 0.0, 0.05), current, yaw) is None


def test_gaps_begin_anew_and_an_instant_counts_once() -> None:
    watch = LegWatch(VEHICLE)
    for k in range(400):
        for _ in range(3):
            watch.step(STILL, 0.0, np.zeros(4), 0.0, k * STEP_NS)
    for k in range(4):  # one step of what would be too much if it lasted, said again and again; then a gap
        watch.step(STILL, 0.0, np.array([0.05, 0.0, 0.0, 1.0]), 0.0, 400 * STEP_NS)
        watch.step(STILL, 0.0, np.array([0.05, 0.0, 0.0, 1.0]), 0.0, (500 + 100 * k) * STEP_NS)
    assert not watch.broken
    watch.reset()
    assert not watch.broken
