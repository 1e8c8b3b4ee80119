"""Tuning as a command: gains come back as a section of an experiment file that can be flown."""

import dataclasses
import tomllib
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from typing import get_args

import numpy as np
import pytest
from typer.testing import CliRunner

from groundstation.analysis.comparison import FlightMetrics, FlightRecord
from shoal.config.baseline_controllers import LawName
from shoal.config.experiment import load_experiment
from shoal.frames import Array
from sim_bridge.__main__ import cli
from sim_bridge.studies import gain_tuning
from sim_bridge.studies.comparison import FlightTask
from sim_bridge.studies.gain_tuning import WEAR, TuningResult, cost, search, values, with_gains
from tests.sim_bridge.studies.interrupted_flights import WatchedPool

FEEDBACK = [law.replace("-", "_") for law in get_args(LawName) if law not in ("eso-mpc-article", "nmpc")]
CONTROLLER = load_experiment("pool").controller


@pytest.mark.parametrize("name", FEEDBACK)
def test_gains_go_out_and_come_back_in_the_order_of_the_section(name: str) -> None:
    section = getattr(CONTROLLER, name)
    gains = np.array(values(section))
    assert with_gains(section, gains) == section and np.all(gains > 0.0)
    changed = with_gains(section, gains * np.arange(1, len(gains) + 1))
    np.testing.assert_allclose(values(changed), gains * np.arange(1, len(gains) + 1))
    assert type(changed) is type(section) and changed.guidance_per_s2 == section.guidance_per_s2


@pytest.mark.parametrize("name", FEEDBACK)
def test_printed_gains_are_a_section_of_an_experiment_file(name: str) -> None:
    section = getattr(CONTROLLER, name)
    changed = with_gains(section, 1.5 * np.array(values(section)))
    table = tomllib.loads(TuningResult(name.replace("_", "-"), 0.0, 0.0, changed.model_dump(), 1).toml())
    assert list(table) == ["controller"] and list(table["controller"]) == [name]
    flown = load_experiment("pool", [f"controller.{name}.{key}={value}" for key, value in table["controller"][name].items()])
    assert getattr(flown.controller, name) == changed


GOOD = FlightMetrics(
    rms_m=0.1, rms_after_20s_m=0.01, max_after_20s_m=0.02, rms_yaw_rad=0.0, rms_yaw_after_20s_rad=0.0, formation_rms_m=0.1,
    formation_after_20s_m=0.01, min_separation_m=None, input_step_rms=0.1, wanted_too_large=0.0, wanted_too_fast=0.0,
    wanted_beyond=0.0, wanted_most=1.0, under_way=1.0,
)  # fmt: skip
BEST = np.array([0.3, 7.0, 0.02, 40.0])


def bowl(gains: Array) -> float:
    return float(np.sum(np.log(gains / BEST) ** 2))


def bowls(generation: Sequence[Array]) -> list[float]:
    return [bowl(gains) for gains in generation]


def test_search_spends_its_budget_and_begins_with_the_guess() -> None:
    flown: list[Array] = []

    def fly(generation: Sequence[Array]) -> list[float]:
        flown.extend(generation)
        return bowls(generation)

    trials = list(search(np.ones(4), 30, 1, fly))
    assert len(trials) == len(flown) == 30
    np.testing.assert_array_equal(trials[0].gains, 1.0)
    for trial, gains in zip(trials, flown, strict=True):
        np.testing.assert_array_equal(trial.gains, gains)
        assert trial.cost == bowl(gains) and np.all(gains > 0.0)


def test_search_finds_gains_two_decades_away() -> None:
    costs = [min(t.cost for t in search(np.ones(4), 200, seed, bowls)) for seed in range(5)]
    assert bowl(np.ones(4)) > 30.0 and max(costs) < 0.1


def test_the_same_seed_tries_the_same_gains_and_another_does_not() -> None:
    def last(seed: int) -> Array:
        return list(search(np.ones(3), 20, seed, lambda candidates: [float(np.sum(gains)) for gains in candidates]))[-1].gains

    np.testing.assert_array_equal(last(3), last(3))
    assert not np.array_equal(last(3), last(4))


def test_the_search_leaves_the_random_numbers_of_others_alone() -> None:
    others = np.random.mtrand._rand  # numpy's global generator has no public name
    others.seed(1)
    wanted = others.random_sample()
    others.seed(1)
    list(search(np.ones(3), 20, 1, lambda candidates: [float(np.sum(np.log(gains) ** 2)) for gains in candidates]))
    assert others.random_sample() == wanted


def test_gains_that_are_zero_stay_out_of_it() -> None:
    assert all(t.gains[1] == 0.0 for t in search(np.array([1.0, 0.0]), 20, 1, lambda trials: [float(g[0]) for g in trials]))


@pytest.mark.parametrize(
    "worse", [{"rms_m": 0.2}, {"rms_after_20s_m": 0.02}, {"rms_yaw_rad": 0.3}, {"input_step_rms": 0.2}, {"under_way": 0.99}]
)
def test_worse_flight_costs_more(worse: dict[str, float]) -> None:
    assert cost([GOOD, dataclasses.replace(GOOD, **worse)]) > cost([GOOD, GOOD])


def test_wear_weighs_as_it_says() -> None:
    rough = dataclasses.replace(GOOD, input_step_rms=1.1)
    far = dataclasses.replace(GOOD, rms_m=np.exp(WEAR) * GOOD.rms_m)
    assert cost([rough]) == pytest.approx(cost([far]))


@pytest.mark.parametrize("flown", [6, 0])
def test_a_worker_that_dies_takes_no_gains_with_it_that_were_found(flown: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """A search may be hours: its best gains so far are printed, the other laws are tuned all the same, and the exit code
    tells."""
    tried: list[tuple[float, float]] = []

    def mortal(task: FlightTask) -> FlightRecord:
        gains = task.experiment.controller
        if gains.law == "pid":
            if len(tried) == flown:
                raise BrokenProcessPool("terminated abruptly")
            tried.append((1.0 / (1.0 + len(tried)), gains.pid.guidance_per_s2))
        return FlightRecord(task.seed, dataclasses.replace(GOOD, rms_m=tried[-1][0] if tried else 1.0), None, None)

    monkeypatch.setattr(gain_tuning, "fly", mortal)
    monkeypatch.setattr(gain_tuning, "worker_pool", ThreadPoolExecutor)
    command = ["tune", "--laws", "pid,lqr", "--scenes", "numeric-disturbed", "--budget", "12", "--jobs", "1"]
    done = CliRunner().invoke(cli, command)
    if flown == 0:
        assert isinstance(done.exception, BrokenProcessPool) and "[controller" not in done.stdout
        return
    assert done.exit_code == 1, done.output
    pid, lqr = done.stdout.split("[controller.lqr]")
    best = tomllib.loads(pid)["controller"]["pid"]["guidance_per_s2"]
    assert best in {guidance for _, guidance in tried} and tomllib.loads(f"[lqr]{lqr}")["lqr"]
    assert "of 12 trials" in done.stderr and "terminated abruptly" in done.stderr


def test_an_interrupted_search_prints_its_best_gains_and_goes_on_with_no_other_law(monkeypatch: pytest.MonkeyPatch) -> None:
    tried: list[float] = []

    def fly_until_interrupted(task: FlightTask) -> FlightRecord:
        if len(tried) == 1:
            WatchedPool.interrupt()
        tried.append(task.experiment.controller.pid.guidance_per_s2)
        return FlightRecord(task.seed, GOOD, None, None)

    monkeypatch.setattr(gain_tuning, "fly", fly_until_interrupted)
    monkeypatch.setattr(gain_tuning, "worker_pool", WatchedPool)
    command = ["tune", "--laws", "pid,lqr", "--scenes", "numeric-disturbed", "--budget", "12", "--jobs", "1"]
    done = CliRunner().invoke(cli, command)
    assert done.exit_code == 1, done.output
    assert tomllib.loads(done.stdout)["controller"]["pid"]["guidance_per_s2"] == tried[0]
    assert "after 1 of 12 trials" in done.stderr and "it was interrupted" in done.stderr and "lqr" not in done.stdout
