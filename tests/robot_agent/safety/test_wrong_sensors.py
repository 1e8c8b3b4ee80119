"""Flights with a sensor that is wrong, as docs/stops.md lists them: each stops with its name."""

from dataclasses import replace

import numpy as np
import pytest

from robot_agent.safety.sensor_checks import APART_RAD, APART_S
from shoal.messages.messages import BoardReading, Mode
from tests.flights import cells, grid_flights
from tests.flights.water import TroubledPlant

pytestmark = pytest.mark.long

FROZEN_NS, TURNED_NS = 10_000_000_000, 5_000_000_000
SLOW = pytest.mark.slow


class WrongPlant(TroubledPlant):
    """Plant whose gyroscope measures `share` of the rate, whose accelerometer is mounted otherwise from the 5th second
    on, or of which sensors stay at what they read after 10 s."""

    share = 1.0
    freezes = turns = sticks = False
    last_m = 0.0
    last: BoardReading | None = None

    def telemetry(self, i: int, now_ns: int) -> BoardReading:
        """The board's measurements, made wrong."""
        telemetry = super().telemetry(i, now_ns)
        if not self.freezes or now_ns < FROZEN_NS:
            self.last_m = telemetry.depth_m
        if self.last is None or now_ns < FROZEN_NS:
            self.last = telemetry
        x, y, z = telemetry.acceleration_mps2
        imu = self.last if self.sticks else telemetry
        force_mps2 = np.array([x, z, -y]) if self.turns and now_ns > TURNED_NS else imu.acceleration_mps2
        return replace(
            telemetry, yaw_rate_radps=self.share * imu.yaw_rate_radps, acceleration_mps2=force_mps2, depth_m=self.last_m
        )


def flown(monkeypatch: pytest.MonkeyPatch, number: int) -> grid_flights.FlightLog:
    """An ordinary flight of the grid (tests/flights/cells.py), which ends soon after the robot has stopped."""
    monkeypatch.setattr(grid_flights, "TroubledPlant", WrongPlant)
    monkeypatch.setitem(cells.CELLS, "ordinary", replace(cells.CELLS["ordinary"], holds=False))
    return grid_flights.fly(cells.draw("ordinary", number), 20.0)


@pytest.mark.parametrize("number", [0, pytest.param(1, marks=SLOW), pytest.param(2, marks=SLOW)])
@pytest.mark.parametrize("share", [0.0, 0.2, 2.0, -1.0])
def test_gyroscope_that_measures_another_rate_stops_the_robot(
    monkeypatch: pytest.MonkeyPatch, share: float, number: int
) -> None:
    """Soon after it has missed a turn of 0.35 rad that lasts half a second. How long that takes is the path's: on a straight
    one the heading swings out and back at first."""
    monkeypatch.setattr(WrongPlant, "share", share)
    log = flown(monkeypatch, number)
    fault = log.states[0][-1].fault
    assert log.states[0][-1].mode is Mode.FAULT
    assert fault.startswith("gyroscope in doubt") or (share < 0.0 and fault.startswith("thrusters do not do as told"))
    stopped = next(k for k, state in enumerate(log.states[0]) if state.mode is Mode.FAULT)
    heading = np.unwrap(log.truth[: stopped + 1, 0, 3])
    missed_rad = np.abs((1.0 - share) * (heading - heading[0]))
    assert missed_rad.max() < 2.0
    last_near = int(np.flatnonzero(missed_rad < APART_RAD)[-1])
    assert (stopped - last_near) * log.period_s < APART_S + 0.3  # poses are late, and a mean heading follows in the end


@pytest.mark.parametrize("number", [1, pytest.param(0, marks=SLOW), pytest.param(2, marks=SLOW)])
def test_depth_that_stays_the_same_stops_the_robot_near_its_depth(monkeypatch: pytest.MonkeyPatch, number: int) -> None:
    monkeypatch.setattr(WrongPlant, "freezes", True)
    log = flown(monkeypatch, number)
    assert log.states[0][-1].fault.startswith("depth sensor stuck: exactly the same for 3.")
    flew = [k for k, state in enumerate(log.states[0]) if state.mode is Mode.TRACKING]
    assert abs(log.truth[flew[-1], 0, 2] - log.path[flew[-1], 0, 2]) < 0.1


@pytest.mark.parametrize("number", [0, pytest.param(1, marks=SLOW), pytest.param(2, marks=SLOW)])
@pytest.mark.parametrize(
    ("wrong", "faults", "begun_s", "within_s"),
    [
        ("turns", ("accelerometer in doubt: off gravity by ",), 5.0, 1.5),
        ("sticks", ("gyroscope in doubt: ", "accelerometer in doubt: ", "thrusters do not do as told"), 10.0, 3.5),
    ],
)
def test_an_imu_that_is_mounted_otherwise_or_stuck_stops_the_robot(
    monkeypatch: pytest.MonkeyPatch, number: int, wrong: str, faults: tuple[str, ...], begun_s: float, within_s: float
) -> None:
    monkeypatch.setattr(WrongPlant, wrong, True)
    log = flown(monkeypatch, number)
    assert log.states[0][-1].mode is Mode.FAULT and log.states[0][-1].fault.startswith(faults)
    stopped = next(k for k, state in enumerate(log.states[0]) if state.mode is Mode.FAULT)
    assert begun_s - 2.0 < (stopped + 1) * log.period_s < begun_s + within_s  # the flight begins later than the clock
