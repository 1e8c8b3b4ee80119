"""Robots that a person drives, in the real plant: what holds them, what stops them, what they never touch."""

from collections.abc import Callable

import numpy as np
import pytest

from groundstation.planning import planner
from robot_agent.safety.modes import DRIVE_LASTS_S
from shoal.config.experiment import Experiment, load_experiment
from shoal.frames import Array
from shoal.messages.codec import Header
from shoal.messages.messages import Command, CommandKind, DriveVelocity, Mode, Reply
from sim_bridge.in_process.fleet import AgentFleet, DirectPlant

pytestmark = pytest.mark.long

POOL = load_experiment("pool")
DEEP = load_experiment("pool", ["pool.size_m=[3.5, 2.5, 2.0]"])
LONE = POOL.model_copy(update={"robots": (POOL.robots[0].model_copy(update={"neighbours": ()}),)})
FAST = DriveVelocity(surge_mps=9.0)  # more than any robot can do


class DrivenFleet:
    """Robots of the pool that hold at given places, and their commands."""

    def __init__(self, *starts: tuple[float, float, float, float], experiment: Experiment = POOL) -> None:
        experiment = experiment if len(starts) == len(experiment.robots) else LONE
        self.fleet = AgentFleet(experiment, planner.plan(experiment), DirectPlant(experiment, 1, np.array(starts)), 1)
        self.fleet.held = True
        for _ in range(20):
            self.fleet.step()
        for i in range(len(starts)):
            assert self.fleet.order(CommandKind.ARM, i).accepted
        self.fleet.step()
        for i in range(len(starts)):
            assert self.fleet.order(CommandKind.HOLD, i).accepted
        self.fleet.step()
        self.fleet.held = False

    def drive(self, velocity: DriveVelocity | None, i: int = 0, age_s: float = 0.0, number: int = 9) -> Reply:
        """Reply to a DRIVE that was given `age_s` ago."""
        robot, now_ns = POOL.robot_ids[i], self.fleet.now_ns
        command = Command(CommandKind.DRIVE, robot, experiment_hash=self.fleet.experiment.hash, drive=velocity)
        header = Header(self.fleet.station().session, number, now_ns - round(age_s * 1e9))
        return self.fleet.robots[i].agent.handle_command(header, command, self.fleet.station(), now_ns)

    def fly(self, seconds: float, velocity: Callable[[int], DriveVelocity | None] = lambda i: None) -> Array:
        """Fly on, with a DRIVE a period for each robot that is given a velocity. Returns true poses (steps, n, 4)."""
        began = len(self.fleet.truth)
        for _ in range(round(seconds / POOL.controller.period_s)):
            for i in range(len(self.fleet.robots)):
                command = velocity(i)
                if command is not None:
                    assert self.drive(command, i).accepted
            self.fleet.step()
        return np.array(self.fleet.truth[began:])

    def mode(self, i: int = 0) -> Mode:
        return self.fleet.robots[i].agent.mode


@pytest.fixture
def alone() -> DrivenFleet:
    return DrivenFleet((-1.0, 0.0, 0.3, 0.0), (1.3, 0.8, 0.3, 0.0))


def first(velocity: DriveVelocity) -> Callable[[int], DriveVelocity | None]:
    return lambda i: velocity if i == 0 else None


def test_driven_robot_moves_as_asked_and_holds_when_commands_end(alone: DrivenFleet) -> None:
    driven = alone.fly(6.0, first(DriveVelocity(0.15, 0.03, 0.1)))[:, 0]
    speed = np.linalg.norm(driven[-1, :2] - driven[-21, :2])  # in the last second
    assert speed == pytest.approx(0.15, rel=0.15)
    assert driven[-1, 2] - driven[-21, 2] == pytest.approx(0.03, rel=0.3)
    assert driven[-1, 3] - driven[-21, 3] == pytest.approx(0.1, rel=0.3)
    after = alone.fly(DRIVE_LASTS_S + 0.1)
    assert alone.mode() is Mode.HOLDING
    assert alone.fleet.robots[0].states[-1].fault == "no drive command"
    rest = alone.fly(8.0)[-20:, 0]
    assert np.linalg.norm(rest[:, :3] - after[-1, 0, :3], axis=1).max() < 0.16  # where it can stop
    assert np.ptp(rest[:, :2], axis=0).max() < 0.02


def test_robot_driven_by_a_slowly_rising_stick_is_on_its_path(alone: DrivenFleet) -> None:
    """A robot follows its reference a second behind, up to the lead that the reference may have. No path is left so."""
    began = alone.fleet.now_ns
    driven = alone.fly(6.0, lambda i: DriveVelocity(min(0.2 * (alone.fleet.now_ns - began) * 1e-9, 0.3)) if i == 0 else None)
    assert alone.mode() is Mode.DRIVEN
    assert np.linalg.norm(driven[-1, 0, :2] - driven[-21, 0, :2]) == pytest.approx(0.3, rel=0.15)


def test_robot_driven_again_begins_where_it_is(alone: DrivenFleet) -> None:
    """The reference leads the robot; the lead of one drive is none of the next."""
    alone.fly(2.0, first(DriveVelocity(surge_mps=-9.0, heave_mps=-0.1, yaw_rate_radps=0.5)))
    assert alone.fleet.order(CommandKind.HOLD, 0).accepted
    alone.fly(8.0)
    assert alone.mode() is Mode.HOLDING
    again = alone.fly(0.05, first(DriveVelocity()))
    control = alone.fleet.robots[0].states[-1].control
    assert alone.mode() is Mode.DRIVEN and control is not None
    np.testing.assert_allclose(control.eta_reference, again[-1, 0], atol=0.02)


@pytest.mark.parametrize("law", ["nmpc", "eso-mpc-article", "pid"])
@pytest.mark.parametrize("sign", [-1.0, 1.0])
def test_robot_that_a_slowly_rising_stick_takes_up_or_down_is_on_its_depth(law: str, sign: float) -> None:
    """A gamepad's stick rises so that the reference never leaps; the robot follows it a second behind."""
    water = load_experiment("pool", ["pool.size_m=[3.5, 2.5, 3.0]", f"controller.law={law}"])
    lone = water.model_copy(update={"robots": (water.robots[0].model_copy(update={"neighbours": ()}),)})
    fleet = DrivenFleet((0.0, 0.0, 1.5 - sign, 0.0), experiment=lone)
    fleet.fly(4.0)
    began, fastest_mps = fleet.fleet.now_ns, water.vehicle.limits.heave_mps

    def velocity(i: int) -> DriveVelocity:
        return DriveVelocity(heave_mps=sign * min(0.2 * (fleet.fleet.now_ns - began) * 1e-9, fastest_mps))

    driven = fleet.fly(5.0, velocity)
    assert fleet.mode() is Mode.DRIVEN
    assert sign * (driven[-1, 0, 2] - driven[-21, 0, 2]) == pytest.approx(fastest_mps, rel=0.15)  # in the last second


def test_robot_driven_full_ahead_around_and_up_keeps_its_depth_and_stops_below_the_surface() -> None:
    fleet = DrivenFleet((0.0, 0.0, 0.6, 0.0))
    began, full = fleet.fleet.now_ns, DriveVelocity(9.0, -9.0, 9.0)
    driven = fleet.fly(20.0, lambda i: full if fleet.fleet.now_ns - began < 10_000_000_000 else DriveVelocity(9.0, 0.0, 9.0))
    assert fleet.mode() is Mode.DRIVEN
    assert driven[-20:, 0, 2].mean() == pytest.approx(POOL.vehicle.radius_m, abs=0.5 * POOL.safety.off_depth_m)


def test_late_older_and_impossible_drives_are_refused(alone: DrivenFleet) -> None:
    assert "lives 1 s" in alone.drive(FAST, age_s=1.1).reason
    assert "no drive command" in alone.drive(FAST, age_s=DRIVE_LASTS_S + 0.1).reason
    assert "carries no velocity" in alone.drive(None).reason
    assert "drive.heave_mps = nan: must be a number" in alone.drive(DriveVelocity(heave_mps=float("nan"))).reason
    assert alone.drive(FAST, age_s=0.1).accepted
    assert "older than the one that is followed" in alone.drive(FAST, age_s=0.2).reason
    assert alone.drive(FAST, age_s=0.1).accepted  # the same again lasts no longer
    alone.fly(DRIVE_LASTS_S)
    assert alone.mode() is Mode.HOLDING
    assert alone.fleet.order(CommandKind.DISARM, 0).accepted
    assert "DRIVE is not accepted when DISARMED" in alone.drive(FAST).reason


def test_stop_ends_a_drive_at_once_and_stays(alone: DrivenFleet) -> None:
    alone.fly(1.0, first(FAST))
    assert alone.fleet.order(CommandKind.STOP, 0).accepted
    alone.fleet.step()
    assert alone.fleet.robots[0].states[-1].pulse_us == alone.fleet.robots[0].agent.neutral_us
    assert "not accepted when STOPPED" in alone.drive(FAST).reason


def test_late_pose_holds_a_driven_robot_and_refuses_drives(alone: DrivenFleet, monkeypatch: pytest.MonkeyPatch) -> None:
    alone.fly(1.0, first(DriveVelocity(0.1)))
    pose = alone.fleet.pose(0)
    monkeypatch.setattr(alone.fleet, "pose", lambda i: pose)
    for _ in range(6):
        alone.drive(DriveVelocity(0.1))
        alone.fleet.step()
    assert alone.mode() is Mode.HOLDING
    assert alone.fleet.robots[0].states[-1].fault == "pose late"
    assert alone.drive(DriveVelocity(0.1)).reason == "pose late"


@pytest.mark.parametrize(("surge_mps", "yaw_rad"), [(9.0, 0.0), (9.0, 0.7), (9.0, 2.0), (-9.0, 0.0), (-9.0, -2.6)])
def test_robot_driven_at_a_wall_stops_before_it(surge_mps: float, yaw_rad: float) -> None:
    fleet = DrivenFleet((0.0, 0.0, 0.3, yaw_rad))
    driven = fleet.fly(14.0, first(DriveVelocity(surge_mps, heave_mps=0.2)))[:, 0]
    room = np.array(POOL.pool.size_m[:2]) / 2.0 - np.abs(driven[:, :2]) - POOL.vehicle.radius_m
    assert room.min() > 0.0
    assert room.min() < 0.3  # it went there
    assert driven[:, 2].max() < POOL.pool.size_m[2] - POOL.vehicle.radius_m


@pytest.mark.parametrize("other", [None, DriveVelocity(9.0)], ids=["that holds", "that comes"])
@pytest.mark.parametrize("aside_m", [0.0, 0.25])
def test_robot_driven_at_another_stops_short_of_it(other: DriveVelocity | None, aside_m: float) -> None:
    fleet = DrivenFleet((-0.9, 0.0, 0.3, 0.0), (0.9, aside_m, 0.3, np.pi))
    flown = fleet.fly(14.0, lambda i: FAST if i == 0 else other)
    apart = np.linalg.norm(flown[:, 0, :2] - flown[:, 1, :2], axis=1)
    assert apart.min() > 2.0 * POOL.safety.radius_m - 0.005
    assert apart.min() < 2.0 * POOL.safety.radius_m + 0.3


def test_robot_driven_down_at_another_stops_above_it_or_the_other_makes_room() -> None:
    fleet = DrivenFleet((0.0, 0.0, 0.3, 0.0), (0.1, 0.0, 1.4, 0.0), experiment=DEEP)
    flown = fleet.fly(10.0, first(DriveVelocity(heave_mps=0.2)))
    above_m, beside_m = flown[:, 1, 2] - flown[:, 0, 2], np.hypot(*(flown[:, 1, :2] - flown[:, 0, :2]).T)
    assert np.maximum(above_m, beside_m).min() > 2.0 * POOL.safety.radius_m - 0.01
    assert above_m.min() < 2.0 * POOL.safety.radius_m + 0.2  # it went there
