"""Figures of runs whose errors are known in closed form."""

import dataclasses
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.interpolate import CubicHermiteSpline

from groundstation.analysis.alignment import align, poses_along
from groundstation.analysis.metrics import evaluate
from groundstation.analysis.results import Check, Result
from groundstation.logs.reader import RunLog, read_log
from shoal.messages import topics
from shoal.messages.messages import Mode, RobotState, Trajectory, Truth
from tests.groundstation import synthetic
from tests.groundstation.synthetic import Script, write_run

pytestmark = pytest.mark.long

ROOT2 = np.sqrt(2.0)


def result_of(folder: Path, script: Script | None = None, **log_changes: Any) -> Result:
    experiment = write_run(folder, script)
    log = dataclasses.replace(read_log(folder / "run.mcap"), **log_changes)
    return evaluate(align(experiment, log), log)


def check(result: Result, name: str) -> Check:
    return next(c for c in result.checks if c.name.startswith(name))


@pytest.fixture(scope="module")
def result(tmp_path_factory: pytest.TempPathFactory) -> Result:
    return result_of(tmp_path_factory.mktemp("run"))


@pytest.mark.parametrize("robot", [1, 2])
def test_tracking_errors_are_the_closed_form(result: Result, robot: int) -> None:
    """Half of the 40 s with one amplitude, half with the other: whole periods of both sines."""
    figures = result.robots[str(robot)]
    early, late = synthetic.AMPLITUDE_M[robot]
    y = abs(synthetic.OFFSET_Y_M[robot])
    assert figures.rms_m == pytest.approx((np.sqrt((early**2 + late**2) / 4.0), y, 0.0), rel=2e-3, abs=1e-6)
    assert figures.rms_after_20s_m == pytest.approx((late / ROOT2, y, 0.0), rel=2e-3, abs=1e-6)
    assert figures.max_m == pytest.approx((early, y, 0.0), abs=6e-4)  # truth has a kink where the run begins
    assert figures.max_after_20s_m == pytest.approx((late, y, 0.0), abs=6e-4)
    assert figures.rms_yaw_rad == pytest.approx(synthetic.AMPLITUDE_RAD[robot] / ROOT2, rel=2e-3)
    assert figures.rms_yaw_after_20s_rad == pytest.approx(synthetic.AMPLITUDE_RAD[robot] / ROOT2, rel=2e-3)
    assert figures.rms_yaw_command_rad == pytest.approx(synthetic.COMMAND_OFFSET_RAD, rel=1e-2)


def test_formation_error_is_the_difference_of_the_robots(result: Result) -> None:
    """Both x errors are in phase, so the amplitudes subtract; the yaw errors too."""
    pair = result.pairs["1-2"]
    early, late = (abs(a - b) for a, b in zip(*synthetic.AMPLITUDE_M.values(), strict=True))
    assert pair.rms_m == pytest.approx((np.sqrt((early**2 + late**2) / 4.0), 0.03, 0.0), rel=5e-3, abs=1e-6)
    assert pair.rms_after_20s_m == pytest.approx((late / ROOT2, 0.03, 0.0), rel=5e-3, abs=1e-6)
    assert pair.rms_yaw_rad == pytest.approx(0.1 / ROOT2, rel=5e-3)
    # 0.8 m apart along x; the difference of the errors brings them closer by 0.02 m at most, early on
    assert pair.min_separation_m == pytest.approx(np.hypot(0.78, 0.03), abs=1e-4)
    assert result.min_separation_m == pair.min_separation_m


def test_baseline_is_a_robot_at_the_centre_of_its_circle(tmp_path: Path) -> None:
    """Over a whole lap: 0.225 m / sqrt 2 = 0.159 m per axis (ambiguity A16)."""
    baseline = result_of(tmp_path, Script(duration_s=100.0)).robots["1"].baseline
    assert baseline is not None
    assert baseline.rms_m == pytest.approx((0.225 / ROOT2, 0.225 / ROOT2, 0.0), abs=1e-3)
    assert baseline.max_m == pytest.approx((0.225, 0.225, 0.0), abs=1e-4)
    assert baseline.rms_yaw_rad is None


def test_article_stands_beside(result: Result) -> None:
    for subject, rms in (("1", (0.07, 0.11)), ("2", (0.09, 0.09))):
        article = result.robots[subject].article
        assert article is not None
        assert article.rms_m == rms
    assert result.pairs["1-2"].article is not None


def test_localizer_is_compared_with_the_truth(result: Result) -> None:
    assert result.pose_error_m is not None
    assert result.pose_error_rad is not None
    assert result.pose_error_m.rms == pytest.approx(0.005, abs=2e-5)
    assert result.pose_error_rad.rms == pytest.approx(0.002, abs=2e-5)


def test_timing_and_wear(result: Result) -> None:
    assert result.exposure_to_pwm_ms is not None
    assert result.exposure_to_pwm_ms.p50 == pytest.approx(34.5, abs=0.51)
    assert result.exposure_to_pwm_ms.max == 39.0
    assert result.control_step_us is not None
    assert result.control_step_us.max == 299.0
    assert result.control_step_us.p99 == pytest.approx(298.0, abs=1.0)
    assert result.dtau_rms == pytest.approx((0.03, 0.01, 0.04))  # of the robot that is worst in yaw
    assert result.dtau_rms_after_20s == pytest.approx((0.03, 0.01, 0.04))
    # three of four thrusters swing by 20 us each step
    assert result.pulse_step_rms_us == pytest.approx(20.0 * np.sqrt(3.0 / 4.0))
    assert result.robots["1"].disturbance_error_rms == pytest.approx((0.01, 0.0, 0.0, 0.0))
    assert result.missed_deadlines == 0


def test_run_is_described(result: Result) -> None:
    assert (result.scene, result.seed, result.mode) == ("pool", 1, "lockstep")
    assert result.duration_s == pytest.approx(40.0, abs=1e-6)
    assert (result.errors_against, result.log_complete, result.log_dropped) == ("truth", True, 0)
    assert result.notes == ()
    assert result.faults == ()


def test_json_has_the_agreed_names_and_no_nan(result: Result) -> None:
    fields = json.loads(result.to_json())
    agreed = {"scene", "seed", "mode", "duration_s", "real_time_factor", "robots", "pairs", "min_separation_m"}
    agreed |= {"control_step_us", "pose_error_m", "exposure_to_pwm_ms", "dtau_rms", "missed_deadlines", "faults"}
    assert agreed <= set(fields)
    errors = {"rms_m", "rms_yaw_rad", "rms_after_20s_m", "rms_yaw_after_20s_rad", "max_m", "max_after_20s_m"}
    for row in (fields["robots"]["1"], fields["pairs"]["1-2"]):
        assert errors <= set(row)
        assert len(row["rms_m"]) == 3
    assert set(fields["control_step_us"]) >= {"p50", "p99", "max"}
    assert set(fields["pose_error_m"]) == {"rms", "max"}
    assert fields["robots"]["1"]["article"]["rms_m"] == [0.07, 0.11]


def test_real_time_factor_counts_only_the_run(tmp_path: Path) -> None:
    """Four times real time while flying; waiting before and writing after do not count."""
    stamps_s = [0, 1, 2, 10, 20, 30, 46, 50]
    walls_s = [0, 60, 61, 63, 65.5, 68, 72, 200]
    pace = tuple((s * 10**9, round(w * 10**9)) for s, w in zip(stamps_s, walls_s, strict=True))
    assert result_of(tmp_path, pace=pace).real_time_factor == pytest.approx(4.0)


def test_keys_need_no_fleet_name(tmp_path: Path) -> None:
    rms_m = result_of(tmp_path, Script(prefix="", duration_s=25.0)).robots["1"].rms_after_20s_m
    assert rms_m == pytest.approx((synthetic.AMPLITUDE_M[1][1] / ROOT2, synthetic.OFFSET_Y_M[1], 0.0), rel=2e-2, abs=1e-6)


def test_missed_deadlines_count_in_the_run_and_across_a_restart(tmp_path: Path) -> None:
    """3 before the start do not count; 2 in the run do; then the process restarts at 0 and misses 4 more."""

    def missed(robot: int, since_s: float) -> int:
        if robot == 2:
            return 0
        return 3 if since_s < 5.0 else 5 if since_s < 10.0 else 0 if since_s < 12.0 else 4

    result = result_of(tmp_path, Script(duration_s=22.0, missed=missed))
    assert result.missed_deadlines == 6
    assert result.missed_deadlines_fraction == pytest.approx(6 / (2 * 441))
    assert not check(result, "missed deadlines").passed


def test_without_truth_errors_are_against_the_localizer(tmp_path: Path) -> None:
    result = result_of(tmp_path, Script(truth=False))
    assert result.errors_against == "localizer"
    assert result.pose_error_m is None
    assert result.robots["1"].disturbance_error_rms is None
    assert result.robots["1"].rms_after_20s_m is not None
    # against poses the localizer's own offset of 4 mm in y shows up as tracking error
    assert result.robots["1"].rms_after_20s_m[1] == pytest.approx(0.024, abs=1e-5)
    assert any("localizer" in note for note in result.notes)


def test_limits_name_the_worst_cell(tmp_path: Path) -> None:
    settings = ("limits.rms_m=0.05", "limits.rms_after_20s_m=0.025", "limits.max_after_20s_m=0.02", "limits.pose_rms_m=0.006")
    result = result_of(tmp_path, Script(settings=(*settings, "limits.wrench_step_rms=0.2")))
    assert check(result, "rms_m").passed
    assert not check(result, "rms_after_20s_m").passed  # y of the pair, 0.030
    assert check(result, "rms_after_20s_m").where == "1-2, y"
    worst = check(result, "max_after_20s_m")
    assert (worst.where, worst.passed) in (("robot 1, x", False), ("1-2, y", False))
    assert worst.value == pytest.approx(0.03, abs=1e-4)
    assert check(result, "pose error").passed
    wear = check(result, "input steps")
    assert (wear.where, wear.passed) == ("yaw", False)
    assert wear.value == pytest.approx(0.4)
    assert not result.passed


def test_a_good_run_passes(result: Result) -> None:
    assert result.passed
    assert {c.name for c in result.checks} == {
        "messages missing from the log",
        "whole run flown",
        "faults",
        "missed deadlines",
        "separation",
        "clearance of hulls",
    }


def test_too_close_fails(tmp_path: Path) -> None:
    result = result_of(tmp_path, Script(settings=("safety.radius_m=0.395",)))
    separation = check(result, "separation")
    assert (separation.where, separation.passed, separation.limit) == ("pair 1-2", False, 0.79)


@pytest.mark.parametrize("against", ["truth", "localizer"])
def test_a_hull_in_a_wall_fails(against: str, tmp_path: Path) -> None:
    """Robot 2 is for a second 0.02 m nearer to the pool's end than its hull is wide. A localizer's word for it is none."""
    experiment, log = write_run(tmp_path), read_log(tmp_path / "run.mcap")
    series = align(experiment, log)
    truth = series.robots[2].truth.copy()
    truth[100:120, 0] = 0.5 * experiment.pool.size_m[0] - experiment.vehicle.radius_m + 0.02
    robots = series.robots | {2: dataclasses.replace(series.robots[2], truth=truth)}
    result = evaluate(dataclasses.replace(series, robots=robots, errors_against=against), log)
    clear = [c for c in result.checks if c.name == "clearance of hulls"]
    assert [(c.where, c.failed) for c in clear] == ([("robot 2", True)] if against == "truth" else [])
    assert all(c.value == pytest.approx(-0.02) for c in clear)


def test_hold_and_resume_leave_the_reference_standing(tmp_path: Path) -> None:
    """Both robots hold for 5 s, then go on where they were: errors stay what they were, and the fault is told."""

    def clock(since_s: float) -> float:
        return since_s if since_s < 12.0 else 12.0 if since_s < 17.0 else since_s - 5.0

    def mode(robot: int, since_s: float) -> tuple[Mode, str]:
        return (Mode.HOLDING, "pose is 0.25 s old" if robot == 1 else "") if 12.0 <= since_s < 17.0 else (Mode.TRACKING, "")

    script = Script(duration_s=40.0, clock=clock, mode=mode)
    experiment = write_run(tmp_path, script)
    log = read_log(tmp_path / "run.mcap")
    series = align(experiment, log)
    held = (series.time_s > 12.1) & (series.time_s < 16.9)
    assert np.ptp(series.robots[1].reference[held], axis=0) == pytest.approx(np.zeros(4), abs=1e-12)
    error = series.robots[1].error
    expected = np.array([synthetic.tracking_error(1, clock(t)) for t in series.time_s])
    np.testing.assert_allclose(error[5:-5], expected[5:-5], atol=2e-3)
    result = evaluate(series, log)
    assert [(fault.source, fault.text) for fault in result.faults] == [("robot 1", "holding: pose is 0.25 s old")]
    assert not check(result, "faults").passed


def test_a_hold_that_was_asked_for_is_no_error(tmp_path: Path) -> None:
    """Both robots hold for 5 s, 0.2 m beyond their places on the path, and go on."""

    def clock(since_s: float) -> float:
        return since_s if since_s < 12.0 else 12.0 if since_s < 17.0 else since_s - 5.0

    def mode(robot: int, since_s: float) -> tuple[Mode, str]:
        return (Mode.HOLDING, "") if 12.0 <= since_s < 17.0 else (Mode.TRACKING, "")

    experiment = write_run(tmp_path, Script(duration_s=40.0, clock=clock, mode=mode))
    log = read_log(tmp_path / "run.mcap")
    truths = log.of(topics.TRUTH, Truth)
    for k, entry in enumerate(truths):
        if 12.0 <= entry.stamp_ns * 1e-9 - synthetic.START_S < 17.0:
            moved = dataclasses.replace(entry.message, eta=entry.message.eta + np.array([0.2, 0.0, 0.0, 0.0]))
            truths[k] = dataclasses.replace(entry, message=moved)
    result = evaluate(align(experiment, log), log)
    most_m = result.robots["1"].max_m
    assert most_m is not None and max(most_m) < 0.1


def test_a_robot_that_dies_makes_the_run_incomplete(tmp_path: Path) -> None:
    """Robot 2 falls silent after 15 s; robot 1 flies on."""
    experiment = write_run(tmp_path, Script(duration_s=30.0))
    log = read_log(tmp_path / "run.mcap")
    states = log.of(topics.STATE, RobotState, 2)
    states[:] = [entry for entry in states if entry.stamp_ns < (synthetic.START_S + 15.0) * 1e9]
    result = evaluate(align(experiment, log), log)
    assert result.duration_s == pytest.approx(30.0, abs=0.1)  # robot 1 is still evaluated
    flown = check(result, "whole run")
    assert not flown.passed
    assert flown.value == pytest.approx(14.95)
    assert any("not complete: 14.9" in note or "not complete: 15.0" in note for note in result.notes)


def test_gaps_in_the_truth_are_not_filled(tmp_path: Path) -> None:
    experiment = write_run(tmp_path, Script(duration_s=22.0))
    log = read_log(tmp_path / "run.mcap")
    truth = log.entries[topics.TRUTH.name, 0]
    start_ns = synthetic.START_S * 1e9
    truth[:] = [e for e in truth if not start_ns + 3e9 < e.stamp_ns < start_ns + 5e9]
    series = align(experiment, log)
    gap = (series.time_s > 3.1) & (series.time_s < 4.9)
    assert np.isnan(series.robots[1].truth[gap]).all()
    assert np.isfinite(series.robots[1].truth[~((series.time_s > 2.9) & (series.time_s < 5.1))][:-2]).all()
    assert evaluate(series, log).robots["1"].rms_m is not None


@pytest.mark.parametrize(
    ("script", "note"),
    [
        (Script(until_s=1.0), "not complete: 1.0 s of 40 s"),
        (Script(started=False), "No robot was ever under way"),
        (Script(until_s=-1.4), "No robot was ever under way"),
        (Script(trajectories=False, until_s=3.0), "not complete"),
        (Script(truth=False, until_s=0.05), "not complete"),
    ],
)
def test_parts_of_runs_give_results_that_say_so(tmp_path: Path, script: Script, note: str) -> None:
    result = result_of(tmp_path, script)
    assert any(note in text for text in result.notes)
    assert not result.passed
    json.loads(result.to_json())


def test_an_empty_log_gives_a_result() -> None:
    from shoal.config.experiment import load_experiment

    log = RunLog()
    result = evaluate(align(load_experiment("pool"), log), log)
    assert not result.passed
    assert result.robots["1"].rms_m is None
    assert result.min_separation_m is None
    json.loads(result.to_json())


def test_damaged_messages_are_counted_not_fatal(tmp_path: Path) -> None:
    from groundstation.logs.recorder import Recorder
    from shoal.messages.codec import Header

    recorder = Recorder(tmp_path / "run.mcap", "", {})
    recorder.put(topics.STATE, "shoal/robot/1/state", Header(1, 1, 0), b"\xff\xff", 0)
    recorder.close()
    log = read_log(tmp_path / "run.mcap")
    assert log.undecodable == 1
    assert log.entries == {}


def test_a_run_shorter_than_20_s_has_no_settled_checks(tmp_path: Path) -> None:
    settings = ("limits.rms_after_20s_m=0.001", "limits.max_after_20s_m=0.001", "limits.wrench_step_rms=0.01")
    result = result_of(tmp_path, Script(duration_s=10.0, settings=settings))
    assert result.robots["1"].rms_after_20s_m is None
    assert result.passed


@pytest.mark.parametrize(("loaded_s", "flown_s", "whole"), [(60.0, 60.0, True), (60.0, 40.0, False), (30.0, 30.0, True)])
def test_a_loaded_path_is_judged_by_its_own_length(tmp_path: Path, loaded_s: float, flown_s: float, whole: bool) -> None:
    """The session's experiment lasts 40 s. Of 60 s that a person has loaded, 40 are no whole flight."""
    script = Script(settings=("duration_s=40",), duration_s=flown_s, loaded_s=loaded_s)
    result = result_of(tmp_path, script)
    assert result.planned_duration_s == loaded_s
    assert not any(robot.article for robot in result.robots.values()), "nobody flew the article's path"
    assert result.duration_s == pytest.approx(flown_s, abs=0.1)
    assert any("not complete" in note for note in result.notes) is not whole
    assert result.passed is whole


@pytest.mark.parametrize("loaded_s", [10.0, 90.0])
def test_a_path_loaded_after_a_flight_and_not_flown_says_nothing_about_it(tmp_path: Path, loaded_s: float) -> None:
    """A person disarms at 15 of 40 s and has a shorter or longer path planned, which nobody flies."""

    def mode(robot: int, time_s: float) -> tuple[Mode, str]:
        return (Mode.TRACKING if time_s <= 15.0 else Mode.DISARMED), ""

    requests = ((15.0, "DISARM asked for"),)
    script = Script(loaded_s=loaded_s, loaded_at_s=17.0, clock=lambda s: min(s, 15.0), mode=mode, lines=requests)
    result = result_of(tmp_path, script)
    assert result.planned_duration_s == result.asked_s == 40.0
    assert result.verdict == "not judged"
    assert not result.passed
    assert any("15.0 s of 40 s" in note for note in result.notes)


@pytest.mark.parametrize("samples", [2, 3, 40])
def test_a_reference_is_the_cubic_through_samples_and_their_velocities(samples: int) -> None:
    random = np.random.default_rng(samples)
    eta, velocity = random.normal(size=(2, samples, 4))
    trajectory = Trajectory("t", 0.25, eta, velocity, np.zeros((samples, 4)))
    along_s = np.array([-1.0, *np.linspace(0.0, 0.25 * (samples - 1), 57), 99.0])
    curve = CubicHermiteSpline(0.25 * np.arange(samples), eta, velocity)
    expected = curve(np.clip(along_s, 0.0, 0.25 * (samples - 1)))
    np.testing.assert_allclose(poses_along(trajectory, along_s), expected, rtol=0.0, atol=1e-12)
