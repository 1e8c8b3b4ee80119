"""Flights in which one bound of the guidance states (docs/modes.md) after the other stops the robot."""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
import pytest

from groundstation.planning import planner
from shoal.config.experiment import load_experiment
from shoal.messages.codec import Header
from shoal.messages.messages import Command, CommandKind, DriveVelocity, Guidance, Mode, RobotState, required
from tests.flights.cells import WIDE
from tests.flights.water import Trouble, TroubledFleet, TroubledPlant

pytestmark = pytest.mark.long

FASTEST_MPS = 0.48  # of the vehicle file; the plant's full thrust gives 5 % more
POSES = ("sim.numeric.pose_noise_m=0.0015", "sim.numeric.yaw_noise_rad=0.008")
Each = Callable[["BoundedFleet", float], None]


class StoppedFlight(NamedTuple):
    """Robot that stopped: when, in which guidance state, and its last state."""

    time_s: float
    guidance: Guidance
    last: RobotState


class BoundedFleet(TroubledFleet):
    """Robots on straight paths, in water whose current along x can be set."""

    def __init__(self, paths: Sequence[str], behind_m: float, current_mps: float) -> None:
        starts = [f"[{-behind_m if k == 0 else 0.0},0.0,0.0,0.0]" for k in range(len(paths))]
        robots = [
            f"{{id={k},node_m=[0,0,0],path={path},start_offset={start}}}"
            for k, (path, start) in enumerate(zip(paths, starts, strict=True), start=1)
        ]
        settings = [*WIDE, *POSES, f"path={paths[0]}", f"robots=[{','.join(robots)}]", "duration_s=170"]
        experiment = load_experiment("straight", [*settings, f"sim.plant.current_mps=[{current_mps},0,0]"])
        trajectories = planner.plan(experiment)
        places = planner.start_poses(experiment, trajectories)
        poses = np.array([places[robot] for robot in experiment.robot_ids])
        self.trouble = Trouble()
        self.water = TroubledPlant(experiment, experiment.seed, poses, self.trouble)
        super().__init__(experiment, trajectories, self.water, experiment.seed, self.trouble)

    def stream(self, current_mps: float) -> None:
        """Let the water stream along x."""
        self.water.stream(np.array([current_mps, 0.0, 0.0]))

    def until_it_stops(self, within_s: float, each: Each = lambda fleet, time_s: None) -> StoppedFlight:
        """Fly until the first robot stops or holds by itself."""
        self.start()
        states = self.robots[0].states
        while self.time_s < within_s:
            each(self, self.time_s)
            self.step()
            if states[-1].fault:
                break
        return StoppedFlight(self.time_s, states[-2].guidance, states[-1])


def line(begin: tuple[float, float], end: tuple[float, float], speed_mps: float) -> str:
    """A straight path with a rest at its end."""
    points = f"[[{begin[0]},{begin[1]}],[{end[0]},{end[1]}]]"
    return f'{{kind="waypoints",points_m={points},speed_mps={speed_mps},depth_m=1.0,slow=true,stop=true}}'


def ahead(share: float) -> str:
    """A long straight path at a share of the robot's speed."""
    return line((0.0, 0.0), (90.0, 0.0), share * FASTEST_MPS)


def test_robot_that_never_comes_nearer_to_its_path_stops_when_the_time_for_the_way_is_over() -> None:
    """A metre behind a path that moves as fast through the water as the robot can."""
    flown = BoundedFleet([ahead(0.5)], 1.0, -0.55 * FASTEST_MPS).until_it_stops(165.0)
    assert flown.guidance is Guidance.JOINING and flown.last.mode is Mode.FAULT
    assert flown.last.fault.startswith("not in time on its path: not on it after 97 s")


def test_error_that_grows_on_the_way_to_the_path_stops_the_robot() -> None:
    flown = BoundedFleet([ahead(0.6)], 2.0, -0.6 * FASTEST_MPS).until_it_stops(165.0)
    assert flown.guidance is Guidance.JOINING and flown.last.mode is Mode.FAULT
    assert "not in time on its path: off it by 6." in flown.last.fault and "2.00 m when it set out" in flown.last.fault


def test_error_that_grows_on_the_path_stops_the_robot() -> None:
    def rises(fleet: BoundedFleet, time_s: float) -> None:
        fleet.stream(-min(time_s / 60.0, 1.0) * 0.9 * FASTEST_MPS)

    flown = BoundedFleet([ahead(0.4)], 0.0, 0.0).until_it_stops(95.0, rises)
    assert flown.guidance is Guidance.ON_PATH and flown.last.mode is Mode.FAULT
    assert flown.last.fault.startswith("off its path")


def _hold_the_other(fleet: BoundedFleet, time_s: float) -> None:
    """Order the second robot to hold where it crosses the first one's path."""
    if time_s > 4.0 and fleet.robots[1].agent.mode is Mode.TRACKING:
        assert fleet.order(CommandKind.HOLD, 1).accepted


ACROSS = line((0.0, -1.5), (0.0, 1.5), 0.3)


@pytest.mark.slow
def test_robot_that_gives_way_to_what_never_goes_holds_after_two_minutes() -> None:
    """The other holds at the end of its path."""
    fleet = BoundedFleet([line((-4.0, 0.0), (0.0, 0.0), 0.2), ACROSS], 0.0, 0.0)
    flown = fleet.until_it_stops(165.0, _hold_the_other)
    assert flown.guidance is Guidance.GIVING_WAY and flown.last.mode is Mode.HOLDING
    assert flown.last.fault == "gives way for too long: 120 s" and 120.0 < flown.time_s < 140.0


@pytest.mark.parametrize("begins_s", [4.5, 6.0])
def test_error_that_grows_on_the_way_back_stops_the_robot(begins_s: float) -> None:
    """A current begins while it gives way, and the path goes on."""

    def rises(fleet: BoundedFleet, time_s: float) -> None:
        _hold_the_other(fleet, time_s)
        fleet.stream(-0.6 * FASTEST_MPS * min(max(time_s - begins_s, 0.0) / 5.0, 1.0))

    path = line((-3.0, 0.0), (87.0, 0.0), 0.7 * FASTEST_MPS)
    flown = BoundedFleet([path, ACROSS], 0.0, 0.0).until_it_stops(100.0, rises)
    assert flown.guidance is Guidance.RETURNING and flown.last.mode is Mode.FAULT
    assert flown.last.fault.startswith("not in time on its path: off it by")


@pytest.mark.slow
def test_robot_that_is_carried_from_the_place_it_holds_stops() -> None:
    """By a current a little faster than it: too slowly for the current to be called too strong."""

    def rises(fleet: BoundedFleet, time_s: float) -> None:
        if time_s > 5.0 and fleet.robots[0].agent.mode is Mode.TRACKING:
            assert fleet.order(CommandKind.HOLD, 0).accepted
        fleet.stream(-min(max(time_s - 10.0, 0.0) / 60.0, 1.0) * 1.06 * FASTEST_MPS)

    flown = BoundedFleet([ahead(0.2)], 0.0, 0.0).until_it_stops(170.0, rises)
    assert flown.guidance is Guidance.HOLDING and flown.last.mode is Mode.FAULT
    assert flown.last.fault.startswith("off its path")


@pytest.mark.parametrize(
    ("current", "held_s", "reason"), [(0.9, 99.0, ""), (1.1, 99.0, "current too strong"), (0.0, 12.0, "held")]
)
def test_driven_robot_stops_when_it_cannot_move_and_not_before(current: float, held_s: float, reason: str) -> None:
    """A person drives it against a current that rises within 20 s, or into a net. Held up, it is led by half a metre."""
    leads_m = []

    def drives(fleet: BoundedFleet, time_s: float) -> None:
        agent, now_ns, station = fleet.robots[0].agent, fleet.now_ns, fleet.station()
        if time_s > 5.0 and agent.mode is Mode.TRACKING:
            assert fleet.order(CommandKind.HOLD, 0).accepted
        fleet.trouble.held = time_s > held_s
        fleet.stream(-min(max(time_s - 10.0, 0.0) / 20.0, 1.0) * current * FASTEST_MPS)
        if time_s > 8.0:
            drive = Command(
                CommandKind.DRIVE, 1, experiment_hash=fleet.experiment.hash, drive=DriveVelocity(0.4 * FASTEST_MPS)
            )
            agent.handle_command(Header(station.session, 9, now_ns), drive, station, now_ns)
            leads_m.append(
                np.linalg.norm(
                    (
                        required(fleet.robots[0].states[-1].control).eta_reference
                        - required(fleet.robots[0].states[-1].estimate).eta
                    )[:2]
                )
            )

    flown = BoundedFleet([ahead(0.2)], 0.0, 0.0).until_it_stops(40.0, drives)
    assert flown.guidance is Guidance.DRIVEN and max(leads_m) < 0.55
    assert (flown.last.mode is Mode.FAULT) is (reason != "") and reason in flown.last.fault
    assert not held_s < flown.time_s - 3.0
