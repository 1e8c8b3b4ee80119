"""Every shipped scene flies as its users fly it; the article's Gazebo scenes and the big fleet also without their camera."""

from pathlib import Path

import numpy as np
import pytest

from groundstation.planning import planner
from groundstation.report.report import evaluated
from localizer.evaluation.runner import evaluate_log
from shoal.bus.bus import Bus
from shoal.bus.memory_transport import MemoryHub, MemoryTransport
from shoal.config.experiment import EXPERIMENTS, Experiment, load_experiment
from shoal.frames import Array
from shoal.messages import topics
from shoal.messages.codec import Header, decode
from shoal.messages.messages import RobotState
from shoal.messages.topics import Topic
from sim_bridge.in_process.executor import Executor
from tests.flights.scene_flights import flown

pytestmark = pytest.mark.long

SCENES = tuple(sorted(path.stem for path in EXPERIMENTS.glob("*.toml")))
# Seconds of flight, past the instant at which a scene has failed before. `make scenes` flies them whole, ten seeds each.
BEGINNING_S = {
    "open-water": 5.0,  # robots followed by their looks were lost while they accelerated, 1 to 3.5 s after the start
    "drifting-obstacle": 11.0,  # "pose late" at 8.6 s
    "blocked-path": 15.0,  # the ball falls at 12 s
    "drone": 5.0,
    "fleet-20": 2.0,  # twenty controllers: half of its time goes into the seconds before
}
# Seconds until robots have passed one another: a whole path with a shorter duration would end where they meet. Encounters to
# their ends, without a camera, are in test_encounters.py.
PASSED_S = {"crossing-2": 23.0, "swap": 23.0, "overtake": 33.0, "crossing-4": 23.0}
PASSES = "crossing-2"  # always flown until the robots have passed; the others in `make test-slow`
FLOWN_ELSEWHERE = (
    *("overtake", "swap"),  # as `PASSES`: two robots, the same pool and camera
    "two-cameras",  # test_two_cameras.py, by the same measures
)
ELSE_S = 4.0
ALL = "whole run flown"
OF_A_WHOLE_PATH = (ALL, "from its place at the end")  # checks


@pytest.mark.parametrize("name", [name for name in SCENES if name not in FLOWN_ELSEWHERE])
def test_scene_begins_without_a_hold_or_a_fault_as_its_users_fly_it(name: str, tmp_path: Path) -> None:
    """With the camera where the scene uses one: no fault, no limit exceeded, and poses that are as good as they claim."""
    begin(name, PASSED_S[name] if name == PASSES else BEGINNING_S.get(name, ELSE_S), tmp_path)


@pytest.mark.slow
@pytest.mark.parametrize("name", [name for name in PASSED_S if name != PASSES])
def test_robots_pass_one_another_without_a_hold_or_a_fault_as_their_users_fly_them(name: str, tmp_path: Path) -> None:
    begin(name, PASSED_S[name], tmp_path)


def begin(name: str, until_s: float, tmp_path: Path) -> None:
    """Fly a scene for so long, and judge it."""
    experiment = load_experiment(name, [] if name in PASSED_S else [f"duration_s={until_s}"])
    sees, hub = experiment.localizer.uses_camera, MemoryHub()
    executor = Executor(experiment, tmp_path, hub, poses=not sees)

    def end_when_passed(topic: Topic, key: str, header: Header, payload: bytes) -> None:
        if decode(RobotState, payload, "robot 1", key).trajectory_s > until_s:
            executor.stop.request()

    if name in PASSED_S:
        Bus(MemoryTransport(hub)).subscribe(topics.STATE, 1, end_when_passed)
    executor.fly()
    _, _, result = evaluated(tmp_path)
    assert [(fault.time_s, fault.source, fault.text) for fault in result.faults] == []
    flown_s = next(check.value for check in result.checks if check.name == ALL)
    assert flown_s == pytest.approx(until_s, abs=0.2)
    assert [check for check in result.checks if check.failed and check.name not in OF_A_WHOLE_PATH] == []
    if sees:
        poses = {row.subject: row for row in evaluate_log(tmp_path / "run.mcap")[0]}
        assert "lost" not in poses
        assert poses["all but lost"].max_mm < 60.0  # a fifth of the distance that robots keep
        assert poses["all but lost"].nees < 6.0  # 3 where the covariances are right


def clearance_m(experiment: Experiment, place_m: Array) -> float:
    """Least distance of any island from any centre (..., 2): R of equation (36) is meant from there."""
    gaps = [np.linalg.norm(place_m - island.position_m, axis=-1).min() - island.radius_m for island in experiment.islands]
    return float(min(gaps))


def test_open_water_is_within_three_centimetres_after_20_s() -> None:
    """In a current with gusts and a swell."""
    place_m, _ = flown(load_experiment("open-water", ["duration_s=32"])).settled_rms()
    assert place_m < 0.03


def test_a_line_forms_and_keeps_clear_of_the_islands() -> None:
    experiment = load_experiment("islands", ["duration_s=50"])
    flight = flown(experiment)
    assert flight.settled_rms()[0] < 0.05
    assert clearance_m(experiment, flight.truth[..., :2]) > experiment.safety.radius_m
    formed = flight.error[400:, :, :2] - flight.error[400:, :1, :2]
    assert np.abs(formed).max() < 0.15  # 20 s after starts 3 m off


def test_the_whole_path_between_the_islands_is_clear() -> None:
    experiment = load_experiment("islands")
    for trajectory in planner.plan(experiment).values():
        assert clearance_m(experiment, trajectory.eta[:, :2]) > experiment.safety.radius_m
    straight = np.linspace([-5.7, -7.4], [5.7, 7.4], 200)
    assert clearance_m(experiment, straight) < 0.0  # the islands are in the way


@pytest.mark.slow
@pytest.mark.parametrize("name", ["open-water", "islands", "fleet-20"])
def test_the_whole_scene_keeps_its_limits(name: str) -> None:
    experiment = load_experiment(name)
    flight = flown(experiment)
    truth = flight.truth
    assert flight.settled_rms()[0] < (experiment.limits.rms_after_20s_m or 0.0)
    apart = np.linalg.norm(truth[:, :, None, :2] - truth[:, None, :, :2], axis=-1)
    assert (apart + 9.0 * np.eye(truth.shape[1])).min() > 2 * experiment.safety.radius_m
    if experiment.islands:
        assert clearance_m(experiment, truth[..., :2]) > experiment.safety.radius_m
