"""Comparison of control laws: variants, scattered starts, and figures equal to those of single flights."""

import io
import math
import os
import subprocess
import tempfile
import tomllib
from concurrent.futures import ThreadPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tomli_w
from rich.console import Console

from groundstation.analysis.comparison import Comparison, FlightRecord, Variant
from groundstation.planning import planner
from shoal.config.experiment import EXPERIMENTS, NO_CAMERA, Experiment, load_experiment
from shoal.errors import ConfigError
from shoal.messages.messages import required
from shoal.runtime.version import code
from sim_bridge.studies import comparison
from sim_bridge.studies.comparison import VARIANTS, FlightTask, fly, scattered
from tests.flights.scene_flights import flown_once
from tests.forked import ended
from tests.planted import executed, installed, plant
from tests.sim_bridge.studies.interrupted_flights import WatchedPool

pytestmark = pytest.mark.long

SHORT = ("duration_s=22",)
OWN = """
class Own:
    def __init__(self, vehicle, model, config, period_s): ...
    def wrench(self, now): return tuple(2.0 * e + 6.0 * v + load for e, v, load in zip(now.error, now.speed_error, now.load))
    def learn(self, now, short, period_s): ...
    def reset(self): ...
"""


class Idle:
    """A law that never pushes: its robots leave their paths, and give up."""

    def __init__(self, *about: object) -> None: ...
    def wrench(self, now: object) -> tuple[float, float, float]:
        return 0.0, 0.0, 0.0

    def learn(self, now: object, short: object, period_s: float) -> None: ...
    def reset(self) -> None: ...


def task(experiment: Experiment, with_traces: bool = True) -> FlightTask:
    trajectories = planner.plan(experiment)
    starts = planner.start_poses(experiment, trajectories)
    return FlightTask(
        experiment, trajectories, np.array([starts[r] for r in experiment.robot_ids]), experiment.seed, with_traces
    )


@pytest.mark.parametrize("name", sorted(path.stem for path in EXPERIMENTS.glob("*.toml")))
def test_every_variant_of_every_shipped_experiment_can_be_flown(name: str) -> None:
    hashes = {variant: load_experiment(name, changes).hash for variant, changes in VARIANTS.items()}
    same = {v for v, h in hashes.items() if v != "nmpc" and h == hashes["nmpc"]}
    assert same <= {"nmpc-without-sway"} and hashes["nmpc"] == load_experiment(name).hash


def test_a_seed_moves_the_starts_and_nothing_else_does() -> None:
    starts = np.zeros((4, 4))
    one, again, other = scattered(starts, 0.3, 1), scattered(starts, 0.3, 1), scattered(starts, 0.3, 2)
    np.testing.assert_array_equal(one, again)
    assert np.abs(one).max() <= 0.3 and np.abs(one).max() > 0.2 and not np.array_equal(one, other)
    np.testing.assert_array_equal(scattered(starts, 0.0, 1), starts)


def test_scattered_robots_begin_outside_of_one_another_s_space() -> None:
    starts = np.array([[0.0, 0.0, 0.0, 0.0], [0.5, 0.0, 0.0, 0.0], [0.0, 0.0, 0.7, 0.0]])
    for seed in range(50):
        one, two, below = scattered(starts, 0.5, seed, 0.6)[:, :3]
        assert np.hypot(*(one - two)[:2]) >= 0.6 or abs((one - two)[2]) >= 0.6
        assert np.hypot(*(one - below)[:2]) >= 0.6 or abs((one - below)[2]) >= 0.6
    with pytest.raises(ConfigError, match=r"--scatter 0.01: no starts of seed 1 keep the robots 0.6 m apart"):
        scattered(starts, 0.01, 1, 0.6)


def test_figures_are_those_of_the_flight() -> None:
    flight = flown_once("numeric", *SHORT, "controller.law=backstepping")
    figures = fly(task(flight.experiment)).figures
    error, states = flight.error[1:], [each[1:] for each in flight.states]  # time 0 is the start itself
    distance = np.sqrt((error[:, :, :3] ** 2).sum(axis=2))
    assert figures.rms_m == pytest.approx(np.sqrt((distance**2).mean()))
    assert figures.rms_after_20s_m == pytest.approx(np.sqrt((distance[400:] ** 2).mean()))
    assert figures.max_after_20s_m == pytest.approx(distance[400:].max())
    gaps = [error[:, a, :3] - error[:, b, :3] for a, b in ((0, 1), (0, 2), (1, 2))]
    assert figures.formation_rms_m == pytest.approx(math.sqrt(np.mean([(gap**2).sum(axis=1) for gap in gaps])))
    wanted = np.array([[required(s.control).wrench_wanted for s in each] for each in states])
    large = fast = either = 0
    for robot in wanted:
        for before, now in pairwise(robot):
            is_large, is_fast = any(abs(now) > [6.0, 3.0, 0.5]), any(abs(now - before) > [0.3, 0.3, 0.1])
            large, fast, either = large + is_large, fast + is_fast, either + (is_large or is_fast)
    count = wanted.shape[0] * (wanted.shape[1] - 1)
    assert (figures.wanted_too_large, figures.wanted_too_fast) == pytest.approx((large / count, fast / count))
    assert figures.wanted_beyond == pytest.approx(either / count) and 0.0 < figures.wanted_beyond < 1.0
    assert figures.wanted_most == pytest.approx((np.abs(wanted) / [6.0, 3.0, 0.5]).max())
    steps = np.array([[required(s.control).wrench_step for s in each] for each in states]) / [0.3, 0.3, 0.1]
    assert figures.input_step_rms == pytest.approx(np.sqrt((steps**2).mean(axis=1)).max())
    assert figures.under_way == 1.0


def test_a_law_that_gives_up_is_compared_all_the_same() -> None:
    """Its robots go to FAULT, at neutral from then on, and their errors grow on."""
    flight = fly(task(load_experiment("numeric", [*SHORT, f"controller.law={__name__}:Idle"])))
    figures, traces = flight.figures, flight.traces
    assert 0.0 < figures.under_way < 0.95 and figures.rms_after_20s_m > 0.5 and figures.input_step_rms == 0.0
    assert traces is not None and traces.applied_n[0][-1] == traces.wanted_n[0][-1] == 0.0


def test_the_mpc_wants_nothing_that_is_not_allowed_and_its_flight_is_kept_to_look_at() -> None:
    flight = fly(task(load_experiment("numeric", SHORT)))
    figures, traces = flight.figures, flight.traces
    assert figures.wanted_beyond == figures.wanted_too_large == figures.wanted_too_fast == 0.0 and figures.wanted_most <= 1.0
    assert traces is not None and traces.wanted_n == traces.applied_n and len(traces.wanted_n) == 3
    assert len(traces.applied_n[0]) == 400 and traces.input_period_s == 0.05 and traces.error_period_s == 0.5
    again = fly(task(load_experiment("numeric", SHORT), with_traces=False))
    assert again.figures == figures and again.traces is None
    comparison = Comparison("numeric", "", 22.0, 0.0, [], 6.0, [1, 2, 3], [Variant("nmpc", [], [flight, again])], 0.6, "")
    assert Comparison.from_json(comparison.to_json()) == comparison


def test_the_command_flies_in_processes_what_this_process_flies(tmp_path: Path) -> None:
    """The same figures to the last bit, whatever the number of processes; a variant that changes nothing is left out. The
    experiment wants a camera, which no flight here has; one law is a person's own."""
    flights = ["--laws", "nmpc,nmpc-without-sway,pid,ownlaw:Own", "--seeds", "3-3", "--duration", "21", "--scatter", "0.2"]
    table = tomllib.loads((EXPERIMENTS / "numeric.toml").read_text(encoding="utf-8"))
    del table["camera"], table["localizer"]["uses_camera"]
    (tmp_path / "lab.toml").write_text(tomli_w.dumps(table), encoding="utf-8")
    with pytest.raises(ConfigError, match="camera: missing"):
        load_experiment(str(tmp_path / "lab.toml"))
    (tmp_path / "own").mkdir()
    (tmp_path / "own" / "ownlaw.py").write_text(OWN, encoding="utf-8")
    planted = plant(tmp_path / "planted")  # no process of it imports from the folder it works in
    result = subprocess.run(
        [installed("sim-bridge"), "compare", str(tmp_path / "lab.toml"), *flights, "--jobs", "2", "--out", str(tmp_path)],
        cwd=planted,
        env={**os.environ, "PYTHONPATH": str(tmp_path / "own")},
        capture_output=True,
        text=True,
        check=False,
    )
    assert result.returncode == 0, result.stderr
    assert not executed(planted)
    assert "nmpc-without-sway is the same as nmpc here" in result.stdout and "pid" in result.stdout
    comparison = Comparison.from_json((tmp_path / "comparison.json").read_text(encoding="utf-8"))
    assert [v.name for v in comparison.variants] == ["nmpc", "pid", "ownlaw:Own"]
    assert comparison.variants[2].settings == ["controller.law=ownlaw:Own"] and (tmp_path / "comparison.html").is_file()
    assert comparison.commit == code().commit
    here = task(load_experiment("numeric", ["duration_s=21.0", "controller.law=pid"]))
    assert [fly(replace(here, starts=scattered(here.starts, 0.2, 3, 0.6), seed=3))] == comparison.variants[1].flights


class Hasty:
    """A law that fails the robot: it pushes away from the path until the robot is beyond its limits."""

    def __init__(self, *_: object) -> None: ...

    def wrench(self, now: Any) -> tuple[float, ...]:
        return tuple(-9.0 * e - 3.0 for e in now.error)

    def learn(self, *_: object) -> None: ...

    def reset(self) -> None: ...


@pytest.mark.long
def test_flights_are_kept_elsewhere_where_the_disk_does_not_take_them(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    with pytest.raises(ConfigError, match=r"gone/comparison.json: No such file or directory; it is in (\S+) \(") as refusal:
        comparison.run("numeric", ["duration_s=20.5"], ["nmpc"], [1], 0.0, 1, tmp_path / "gone", Console(quiet=True))
    (kept,) = tmp_path.glob("comparison-*/comparison.json")
    assert str(kept.parent) in str(refusal.value)
    assert [variant.name for variant in Comparison.from_json(kept.read_text()).variants] == ["nmpc"]


def test_an_interrupted_comparison_keeps_the_seeds_that_all_have_flown(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fly_until_interrupted(task: FlightTask) -> FlightRecord:
        if task.seed == 2:
            WatchedPool.interrupt()
        return fly(task)

    monkeypatch.setattr(comparison, "fly", fly_until_interrupted)
    monkeypatch.setattr(comparison, "worker_pool", WatchedPool)
    screen = io.StringIO()
    console = Console(file=screen, width=200)
    assert comparison.run("numeric", ["duration_s=20.5"], ["pid", "lqr"], [1, 2], 0.0, 1, tmp_path, console) == 1
    kept = Comparison.from_json((tmp_path / "comparison.json").read_text())
    assert [[flight.seed for flight in variant.flights] for variant in kept.variants] == [[1], [1]]
    assert "1 of 2 seeds were flown by all; of the others one ended so: KeyboardInterrupt" in screen.getvalue()


@pytest.mark.parametrize("lost", [{2}, {1, 2}])
def test_a_worker_that_dies_takes_no_seed_with_it_that_all_have_flown(
    lost: set[int], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def mortal(task: FlightTask) -> FlightRecord:
        if task.seed in lost:
            raise BrokenProcessPool("terminated abruptly")
        return fly(task)

    monkeypatch.setattr(comparison, "fly", mortal)
    monkeypatch.setattr(comparison, "worker_pool", ThreadPoolExecutor)
    screen = io.StringIO()

    def run() -> int:
        return comparison.run(
            "numeric", ["duration_s=20.5"], ["pid", "lqr"], [1, 2], 0.0, 1, tmp_path, Console(file=screen, width=200)
        )

    if lost == {1, 2}:
        with pytest.raises(BrokenProcessPool):
            run()
        return
    assert run() == 1
    kept = Comparison.from_json((tmp_path / "comparison.json").read_text())
    assert [[flight.seed for flight in variant.flights] for variant in kept.variants] == [[1], [1]]
    assert "1 of 2 seeds were flown by all" in screen.getvalue()


def test_a_law_that_loses_its_robots_is_compared_and_said_to_have_failed() -> None:
    """Robots that gave up are neutral for the rest of the flight: they want nothing and put out nothing."""
    experiment = load_experiment("pool", [*SHORT, NO_CAMERA, f"controller.law={__name__}:Hasty", "controller.own=[1.0]"])
    figures = fly(task(experiment)).figures
    assert 0.0 < figures.under_way < 0.9 and figures.rms_m > 0.3


def test_the_time_of_control_steps_is_measured_and_is_no_part_of_what_must_repeat() -> None:
    numeric = task(load_experiment("numeric", ["duration_s=21"]), with_traces=False)
    flight = fly(numeric)
    assert flight.step_us is not None and 10.0 < flight.step_us.median <= flight.step_us.p99 <= flight.step_us.most
    other = replace(flight, step_us=None)
    assert other == flight
    comparison = Comparison("numeric", "", 21.0, 0.0, [], 6.0, [1], [Variant("nmpc", [], [flight])], 0.6, "")
    assert Comparison.from_json(comparison.to_json()).variants[0].flights[0].step_us == flight.step_us


@pytest.mark.parametrize(
    "arguments,complaint",
    [
        (["numeric", "--laws", "pdi"], "'pdi' (allowed, once each: nmpc, eso-mpc-article"),
        (["numeric", "--seeds", "4-2"], "--seeds 4-2: must be a number of seeds or a range"),
        (["numeric", "--duration", "20"], "duration_s = 20: must be more than 20 s"),
        (["nowhere"], "no such experiment"),
        (["pool", "--scatter", "3.0", "--seeds", "1", "--laws", "pid"], "starts at"),
    ],
)
def test_impossible_comparison_is_refused(arguments: list[str], complaint: str, tmp_path: Path) -> None:
    code, _, errors = ended("sim-bridge", "compare", *arguments, "--out", str(tmp_path), "--jobs", "1")
    assert code == 2 and complaint in " ".join(errors.split()).replace("│ ", ""), errors
    assert "Traceback" not in errors and not list(tmp_path.glob("*"))
