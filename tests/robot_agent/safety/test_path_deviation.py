"""Detection of a left path: on constructed motions, and in flights of the plant with a broken thruster."""

from collections.abc import Sequence

import numpy as np
import pytest

from robot_agent.safety.path_deviation import PathDeviationMonitor
from shoal.config.experiment import load_experiment
from shoal.messages.messages import Mode, required
from tests.flights.broken_thrusters import STILL
from tests.flights.scene_flights import flew

STEP_NS = 50_000_000


def left(off_m: Sequence[float], is_free: Sequence[bool] | None = None, called: Sequence[bool] | None = None) -> int | None:
    """The step at which a robot that was so far off its path says so."""
    watch = PathDeviationMonitor(0.3)
    for k, off in enumerate(off_m):
        watch.step(complex(off), 0j, is_free is None or is_free[k], called is not None and called[k], k * STEP_NS)
        if watch.left:
            return k
    return None


def test_robot_off_its_path_for_half_a_second_reports_it() -> None:
    assert left([0.05] * 20 + [0.31] * 100) == 30
    assert left([0.05] * 20 + [0.29] * 100) is None
    assert left(([0.05] * 20 + [0.31] * 9) * 5) is None


def test_robot_that_has_not_arrived_or_comes_back_reports_nothing() -> None:
    assert left([4.0] * 200 + [0.2] * 20 + [0.4] * 200) is None
    assert left([4.0] * 200 + [0.1] * 20 + [0.4] * 200) is not None


def test_robot_that_gives_way_is_excused_until_it_is_back() -> None:
    off_m = [0.05] * 20 + [0.8] * 100 + [0.4] * 100 + [0.05] * 20 + [0.4] * 100
    is_free = [True] * 19 + [False] * 101 + [True] * 220
    assert left(off_m, is_free) == 20 + 100 + 100 + 20 + 10


def test_robot_that_drifts_towards_others_is_not_excused() -> None:
    assert left([0.05] * 20 + [0.2] * 20 + [0.31] * 100, [True] * 25 + [False] * 115) == 50


def test_robot_that_its_path_leads_to_others_is_excused_wherever_it_begins_to_give_way() -> None:
    """Until it is back on its path."""
    off_m = [0.05] * 20 + [0.2] * 20 + [0.8] * 100 + [0.4] * 100 + [0.05] * 20 + [0.4] * 100
    is_free, called = [True] * 30 + [False] * 110 + [True] * 220, [False] * 30 + [True] * 10 + [False] * 320
    assert left(off_m, is_free) == 50
    assert left(off_m, is_free, called) == 20 + 20 + 100 + 100 + 20 + 10


def test_where_a_path_sets_off_at_once_all_arrive_anew() -> None:
    watch, place_m, worst_m = PathDeviationMonitor(0.3), 0.0, 0.0
    for k in range(600):
        flown_s = max(k - 20, 0) * 0.05  # the path waits for a second
        path_m, speed_mps = 0.4 * flown_s, min(0.1 * flown_s, 0.5)
        place_m = min(place_m + 0.05 * speed_mps, path_m)
        worst_m = max(worst_m, path_m - place_m)
        watch.step(complex(place_m), complex(path_m), True, False, k * STEP_NS)
    assert worst_m > 0.6 and place_m == path_m and not watch.left
    for k in range(600, 640):  # and then something drives it off
        path_m += 0.05 * 0.4
        watch.step(complex(path_m, 0.02 * (k - 599)), complex(path_m), True, False, k * STEP_NS)
    assert watch.left


@pytest.mark.long
@pytest.mark.parametrize("speed_mps", [0.1, 0.2, 0.3, 0.4])
def test_robot_that_starts_from_rest_on_a_fast_path_flies_it(speed_mps: float) -> None:
    fleet = flew(load_experiment("straight", [f"path.speed_mps={speed_mps}", "duration_s=15"]))
    assert {state.mode for state in fleet.robots[0].states if state.trajectory_s > 0.0} == {Mode.TRACKING}
    assert np.linalg.norm(fleet.truth[-1][0][:2] - required(fleet.robots[0].states[-1].control).eta_reference[:2]) < 0.1


def test_once_said_it_stays_so_until_the_goal_is_another() -> None:
    watch = PathDeviationMonitor(0.3)
    for k, off in enumerate([0.0] * 2 + [1.0] * 40 + [0.0] * 10):
        watch.step(complex(off), 0j, True, False, k * STEP_NS)
    assert watch.left
    watch.reset()
    watch.step(1.0 + 0j, 0j, True, False, 0)
    assert not watch.left


def harm(broken: str, at_s: float, seed: int, settings: Sequence[str] = ()) -> tuple[float, str]:
    """Largest distance (m) of a robot with a broken thruster from its path before it stops; and the reason, if it stops in 10
    s."""
    faults = [f"t={at_s} thruster {broken}"]
    fleet = flew(load_experiment("pool", [*STILL, *settings, f"seed={seed}", f"duration_s={at_s + 10.0}"], faults))
    i = int(broken[0]) - 1
    flown = [(s, truth[i]) for s, truth in zip(fleet.robots[i].states, fleet.truth, strict=True) if s.trajectory_s > at_s]
    off_m = [
        float(np.hypot(*(required(s.control).eta_reference - truth)[:2])) for s, truth in flown if s.mode is Mode.TRACKING
    ]
    return max(off_m), flown[-1][0].fault


@pytest.mark.long
def test_a_thruster_that_goes_on_as_it_was_told_does_little_harm_in_still_water() -> None:
    """It sticks when the robot has just come onto its path, which it then cannot keep, if nobody feels that."""
    off_m, _ = harm("1/2 stuck", 3.0, 1, ["safety.watch_thrusters=false"])
    assert 0.02 < off_m < 0.15  # the law flies on with what the others give


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(24))
def test_broken_thruster_does_little_harm_in_still_water(seed: int) -> None:
    random = np.random.default_rng(seed)
    robot, thruster, at_s = random.integers(1, 3), random.integers(1, 5), random.uniform(8.0, 20.0)
    how = ("dead", "reversed", "stuck", "weak 0.2")[seed % 4]
    off_m, why = harm(f"{robot}/{thruster} {how}", float(at_s), seed)
    assert off_m < 0.15
    assert why or how == "stuck", "a stuck thruster may go on as it is told to for long"
