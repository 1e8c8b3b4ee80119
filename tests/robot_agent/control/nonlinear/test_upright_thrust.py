"""Thrust that leaves a hull upright, by the tilt that its board measures."""

import pytest

from robot_agent.control.nonlinear.upright_thrust import UprightThrust
from robot_agent.vehicle.estimate import StateMeasurement
from shoal.config.vehicle import load_vehicle

LEVEL, BOW_UP, BOW_DOWN = (StateMeasurement(pitch_rad=rad) for rad in (0.0, 0.6, -0.6))
SURGE, SWAY = 0, 3  # of a wrench
PERIOD_S = 0.05


@pytest.mark.parametrize("name", ["spherical", "vectored"])
def test_a_level_hull_has_all_thrust(name: str) -> None:
    thrust, vehicle = UprightThrust(load_vehicle(name)), load_vehicle(name)
    thrust.step(LEVEL, PERIOD_S)
    assert thrust.most == pytest.approx(vehicle.limits.wrench) and thrust.least == pytest.approx(-thrust.most)


def test_thrust_that_tilts_a_hull_on_ends_and_thrust_that_rights_it_does_not() -> None:
    for tilt, tilts_on, rights in ((BOW_UP, "most", "least"), (BOW_DOWN, "least", "most")):
        thrust = UprightThrust(load_vehicle("spherical"))
        thrust.step(tilt, PERIOD_S)
        assert getattr(thrust, tilts_on)[SURGE] == 0.0 and abs(getattr(thrust, rights)[SURGE]) > 5.0


def test_thrust_to_starboard_lifts_that_side() -> None:
    thrust = UprightThrust(load_vehicle("vectored"))
    thrust.step(StateMeasurement(roll_rad=-0.6), PERIOD_S)
    assert thrust.most[SWAY] == 0.0 and thrust.least[SWAY] < -10.0


def test_a_tilt_that_grows_counts_before_it_is_there() -> None:
    thrust = UprightThrust(load_vehicle("spherical"))
    thrust.step(StateMeasurement(pitch_rad=0.2, pitch_rate_radps=1.0), PERIOD_S)
    assert thrust.most[SURGE] == 0.0


def test_the_plan_has_less_thrust_after_a_tilt_and_gets_it_back_slowly() -> None:
    """Half a second too far is felt at once; a hull that swings back for a second has not shown that it may go faster."""
    thrust = UprightThrust(load_vehicle("spherical"))
    for _ in range(10):
        thrust.step(BOW_UP, PERIOD_S)
    lessened_n = float(thrust.limits.size[0])
    assert lessened_n < 2.5
    for _ in range(20):
        thrust.step(LEVEL, PERIOD_S)
    assert lessened_n < thrust.limits.size[0] < lessened_n + 0.5
    for _ in range(400):
        thrust.step(LEVEL, PERIOD_S)
    assert thrust.limits.size[0] == pytest.approx(6.0)


def test_a_vehicle_whose_file_has_no_righting_moment_keeps_its_thrust() -> None:
    thrust = UprightThrust(load_vehicle("spherical").model_copy(update={"righting": None}))
    thrust.step(BOW_UP, PERIOD_S)
    assert thrust.most[SURGE] == 6.0
