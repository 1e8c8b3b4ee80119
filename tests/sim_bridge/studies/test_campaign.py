"""Campaigns: what is flown, that it can be flown again, resumed, and what the statistics are worth."""

import io
import json
import shlex
import subprocess
import sys
from concurrent.futures import Future
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
import psutil
import pyarrow.parquet as pq
import pytest
import tomli_w
from rich.console import Console
from scipy import stats
from typer.testing import CliRunner

from groundstation.analysis.measures import TIMINGS
from groundstation.analysis.statistics import Interval, mean
from groundstation.planning import planner
from shoal.config.experiment import EXPERIMENTS, NO_CAMERA, Experiment, load_experiment
from shoal.config.loader import check
from shoal.errors import ConfigError
from shoal.runtime.output import terminal
from shoal.runtime.runtime import Stop
from shoal.runtime.version import UNKNOWN, code
from sim_bridge.__main__ import cli
from sim_bridge.studies import campaign_runner
from sim_bridge.studies.campaign import Campaign, flights
from sim_bridge.studies.campaign_flight import planning_text
from sim_bridge.studies.dependence import KeyValue, dependence, dependences, lines, reasons
from sim_bridge.studies.report import _panel  # a report holds it as a picture
from sim_bridge.studies.statistics import distribution, quantile, rate
from tests.forked import ended
from tests.planted import installed
from tests.waiting import eventually

pytestmark = pytest.mark.long

TABLE: dict[str, Any] = {
    "name": "small",
    "experiment": "pool",
    "settings": ["duration_s=2"],
    "seeds": 2,
    "sweep": {"sim.plant.mass_error": [-0.2, 0.2]},
    "draw": {"sim.plant.current_mps": {"uniform": [[-0.01, 0.0, 0.0], [0.01, 0.0, 0.0]]}},
}


def campaign(**changes: Any) -> Campaign:
    return check(Campaign, {**TABLE, **changes}, "small.toml")


def fly(loaded: Campaign, folder: Path, **options: Any) -> int:
    defaults: dict[str, Any] = {"workers": 1, "scheduler": None, "resume": False, "stop": Stop(install=False)}
    defaults["console"] = Console(quiet=True)
    return campaign_runner.run(loaded, folder, **{**defaults, **options})


def rows(folder: Path) -> list[dict[str, Any]]:
    table: list[dict[str, Any]] = pq.read_table(folder / "results.parquet").to_pylist()
    return table


# --- what is flown


def test_every_combination_with_every_seed() -> None:
    all_of_them = list(flights(campaign(sweep={"a.b": [1, 2], "c": ["x", "y", "z"]}, draw={})))
    assert [f.index for f in all_of_them] == list(range(12))
    assert {(f.seed, f.values["a.b"], f.values["c"]) for f in all_of_them} == {
        (seed, b, c) for seed in (1, 2) for b in (1, 2) for c in "xyz"
    }


def test_draws_are_from_their_distributions_and_repeat() -> None:
    draws = {
        "u": {"uniform": [2.0, 4.0]},
        "n": {"normal": [1.0, 0.5]},
        "c": {"choice": ["a", "b"]},
        "v": {"uniform": [[0, 5], [1, 6]]},
    }
    loaded = campaign(seeds=2000, sweep={}, draw=draws)
    drawn = [f.values for f in flights(loaded)]
    assert stats.kstest([d["u"] for d in drawn], stats.uniform(2, 2).cdf).pvalue > 0.01
    assert stats.kstest([d["n"] for d in drawn], stats.norm(1, 0.5).cdf).pvalue > 0.01
    assert 900 < sum(d["c"] == "a" for d in drawn) < 1100
    assert all(0 <= d["v"][0] <= 1 and 5 <= d["v"][1] <= 6 for d in drawn)
    assert drawn == [f.values for f in flights(loaded)]
    assert drawn[:50] == [f.values for f in flights(campaign(seeds=50, sweep={}, draw=draws))]  # a longer one begins the same


@pytest.mark.parametrize(
    ("changes", "complaint"),
    [
        ({"draw": {"a": {"uniform": [0.0, 1.0], "choice": [1]}}}, "draw.a: has uniform and choice (allowed: one of"),
        ({"draw": {"a": {"normal": [[0.0, 1.0], 1.0]}}}, "draw.a: normal: the two must have as many components"),
        ({"draw": {"a": {"uniform": [0.3, -0.3]}}}, "draw.a: uniform: [0.3, -0.3]: must be from, to"),
        ({"draw": {"a": {"uniform": [[0.0, 1.0], [1.0, 0.0]]}}}, "must be from, to"),
        ({"draw": {"a": {"normal": [0.0, -1.0]}}}, "draw.a: normal: [0.0, -1.0]: must be mean, standard deviation"),
        ({"draw": {"sim.plant.mass_error": {"choice": [1]}}}, "sim.plant.mass_error: cannot be set twice"),
        ({"sweep": {"seed": [1]}}, "seed: cannot be set twice"),
        ({"sweep": {"a": []}}, "must be a list of at least 1"),
        ({"seeds": 0}, "seeds = 0"),
        ({"flights": 3}, "flights: unknown key"),
    ],
)
def test_invalid_campaign_is_refused(changes: dict[str, Any], complaint: str) -> None:
    with pytest.raises(ConfigError) as caught:
        campaign(**changes)
    assert complaint in str(caught.value)


def test_a_value_that_the_experiment_refuses_is_named_before_anything_flies(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"sim.plant.mass_error = -2.0: "):
        fly(campaign(sweep={"sim.plant.mass_error": [0.0, -2.0]}), tmp_path / "c")
    with pytest.raises(ConfigError, match=r"sim.plant.mas_error: unknown key"):
        fly(campaign(sweep={"sim.plant.mas_error": [0.0]}), tmp_path / "c")
    assert not (tmp_path / "c").exists()


# --- flying


def test_every_combination_of_a_seed_meets_the_same_draws() -> None:
    met: dict[int, set[Any]] = {}
    for flight in flights(campaign(seeds=5)):
        met.setdefault(flight.seed, set()).add(flight.values["sim.plant.current_mps"])
    assert [len(draws) for draws in met.values()] == [1] * 5 and len(set.union(*met.values())) == 5


def test_differences_are_paired_and_flights_with_a_fault_are_counted_but_not_averaged() -> None:
    """A tenth less than an error of 1, 3 or 8 mm: over seeds no difference is plain, pair by pair it is."""

    def row(key: str, seed: int, error_m: float, fault: float = 0.0) -> dict[str, Any]:
        reason = "faults; no pose" if fault else ""
        figures = {"rms_after_20s_m": error_m, "at_fault": fault, "passed": not fault, "reason": reason}
        return {"status": "flown", "seed": seed, "k": key, **figures}

    loaded = campaign(sweep={"k": ["a", "b"]}, draw={})
    flights = [
        row(key, seed, share * e) for seed, e in enumerate((0.001, 0.003, 0.008)) for key, share in (("a", 1), ("b", 0.9))
    ]
    flights.append(row("b", 9, 0.0, fault=0.5))
    first, second = dependence(loaded, "k", flights, ["rms_after_20s_m"])
    gain, level = second.against_first["rms_after_20s_m"], second.means["rms_after_20s_m"]
    assert first.against_first["rms_after_20s_m"] is None and gain is not None and level is not None
    assert gain.value == pytest.approx(-0.4) and gain.high is not None and gain.high < 0.0
    assert level.value == pytest.approx(3.6) and (second.flights, second.faults) == (4, 1)
    assert reasons(flights) == [(1, "faults"), (1, "no pose")]
    assert max(len(line) for line in lines(flights, dependences(loaded, flights))) <= 80


def test_an_interval_is_drawn_from_its_lower_end_to_its_upper_one() -> None:
    """A mean of one flight has no ends, and is drawn as a dot."""
    means = [Interval(2.0, 1.5, 2.5), Interval(-1.0, -2.0, 0.0), Interval(3.0, None, None)]
    none, measure = Interval(0.0, None, None), "rms_after_20s_m"
    values = [KeyValue(str(k), 1, none, 0, {measure: [mean.value]}, {measure: mean}, {}) for k, mean in enumerate(means)]
    axes = _panel("k", values, [0.0, 1.0, 2.0], measure, 4.0).axes[0]
    drawn = [np.asarray(line.get_ydata()).tolist() for line in axes.lines if line.get_linewidth() == 2.0]
    assert [ends for ends in ([1.5, 2.5], [-2.0, 0.0], [3.0, 3.0]) if ends not in drawn] == []


@pytest.fixture(scope="module")
def flown(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("campaign") / "small"
    assert fly(campaign(), folder) == 0
    return folder


def test_results_hold_every_flight(flown: Path) -> None:
    results = rows(flown)
    assert [(row["index"], row["seed"], row["sim.plant.mass_error"]) for row in results] == [
        (0, 1, -0.2), (1, 1, 0.2), (2, 2, -0.2), (3, 2, 0.2),
    ]  # fmt: skip
    assert all(row["status"] == "flown" and 0.1 < row["rms_m"] < 0.3 for row in results)
    # two seconds are not twenty: what comes after is neither known nor asked for
    assert all(row["rms_after_20s_m"] is None and row["passed"] and row["reason"] == "" for row in results)
    page = (flown / "report.html").read_text()
    assert "<svg" in page and results[0]["command"].replace("'", "&#39;") in page


def test_a_report_names_its_quantities_and_says_what_a_paper_needs(flown: Path) -> None:
    """n, seeds, intervals, the whole commit and the time of a control step; axes with quantity and unit; flights of a sweep
    are not pooled."""
    page = (flown / "report.html").read_text()
    assert "4 of 4" in page and "1 to 2" in page and "95 % confidence" in page and code().commit in page
    assert "Control step, median [µs]" in page and "RMS error [mm]" in page
    assert "rms_m [mm]" not in page and "Over all flights" not in page and "Distributions" not in page


def test_the_command_flies_it_again(flown: Path, tmp_path: Path) -> None:
    row = rows(flown)[1]
    program, *arguments = shlex.split(row["command"])
    assert program == "sim-bridge"
    ended(program, *arguments, "--out", str(tmp_path))
    (folder,) = tmp_path.iterdir()
    result = json.loads((folder / "result.json").read_text())
    per_axis = [value for part in ("robots", "pairs") for subject in result[part].values() for value in subject["rms_m"]]
    assert max(per_axis) == pytest.approx(row["rms_m"], rel=1e-6)  # the log holds single precision
    assert result["min_separation_m"] == pytest.approx(row["min_separation_m"], rel=1e-6)


@pytest.mark.slow
def test_a_campaign_with_the_camera_says_what_the_reports_of_its_flights_say(tmp_path: Path) -> None:
    """The command of the row flies it again, in one process, and its report has the row's figures."""
    loaded = campaign(camera=True, settings=["duration_s=1.5"], seeds=1, sweep={"sim.plant.mass_error": [0.2]}, draw={})
    assert fly(loaded, tmp_path / "c") == 0
    (row,) = rows(tmp_path / "c")
    assert row["status"] == "flown" and row["off_track"] == row["at_fault"] == 0.0 and row["reason"] == ""
    code, _, _ = ended(*shlex.split(row["command"]), "--out", str(tmp_path / "runs"))
    assert code == (0 if row["passed"] else 1)
    (folder,) = (tmp_path / "runs").iterdir()
    result = json.loads((folder / "result.json").read_text())
    per_axis = [value for part in ("robots", "pairs") for subject in result[part].values() for value in subject["rms_m"]]
    assert max(per_axis) == pytest.approx(row["rms_m"], rel=1e-9)
    assert result["min_separation_m"] == pytest.approx(row["min_separation_m"], rel=1e-9)


@pytest.mark.parametrize(
    ("changes", "complaint"),
    [
        ({"settings": ["localizer.uses_camera=false"]}, "localizer.uses_camera = false: no camera locates these robots"),
        ({"sweep": {"sim.faults": [[{"at_s": 1.0, "what": "disk full"}]]}}, "--one-process has none to break"),
    ],
)
def test_a_campaign_with_the_camera_refuses_what_has_none(changes: dict[str, Any], complaint: str, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=complaint):
        fly(campaign(camera=True, **changes), tmp_path / "c")


def test_interrupted_campaign_continues_where_it_was(flown: Path, tmp_path: Path) -> None:
    """Half a journal, lines that are no rows, its last line torn, and one flight that is now wanted otherwise."""
    lines = (flown / "journal.jsonl").read_text().splitlines()
    no_rows = ["12", "[1]", "null", '{"status": "flown"}']
    (tmp_path / "journal.jsonl").write_text("\n".join([*lines[:2], *no_rows, lines[2][:40]]) + "\n")
    with pytest.raises(ConfigError, match="--resume goes on with it"):
        fly(campaign(), tmp_path)
    assert fly(campaign(), tmp_path, resume=True) == 0
    kept, fresh = rows(flown), rows(tmp_path)
    for row in (*kept, *fresh):
        for measured in ("wall_s", *TIMINGS):
            assert row.pop(measured) > 0.0
    assert fresh == kept
    assert len((tmp_path / "journal.jsonl").read_text().splitlines()) == 5 + len(no_rows)


def test_any_key_can_be_swept_and_a_grown_campaign_goes_on(tmp_path: Path) -> None:
    """Lists, tables, numbers beside lists. What is torn at the journal's end takes nothing else with it, what was flown is
    kept wherever it stands now, and the report has each value once."""
    journal, fault = tmp_path / "journal.jsonl", {"at_s": 0.1, "what": "thruster 2/3 dead"}
    small: dict[str, Any] = {"sim.faults": [[], [fault]], "sim.plant.current_mps": [[0.01, 0.0, 0.0]]}
    large = {"sim.faults": [[], [fault]], "sim.plant.current_mps": [[0.0, 0.0, 0.0], [0.01, 0.0, 0.0]]}
    for sweep, flights_flown in ((small, 2), ({**large, "sim.plant.disturbance_hz": [0.0, [0.1, 0.2]]}, 8)):
        assert fly(campaign(seeds=1, draw={}, sweep=sweep, settings=["duration_s=0.3"]), tmp_path, resume=True) == 0
        whole = [line for line in journal.read_text().splitlines() if line.endswith("}")]
        assert len({json.loads(line)["hash"] for line in whole}) == len(whole) == flights_flown
        journal.write_text(journal.read_text() + whole[-1][:40])
    results = rows(tmp_path)
    assert [len(row["sim.faults"]) for row in results] == [0, 0, 0, 0, 1, 1, 1, 1]
    assert [json.loads(row["sim.plant.disturbance_hz"]) for row in results] == [0.0, [0.1, 0.2]] * 4
    page = (tmp_path / "report.html").read_text()
    assert [page.count(f"<td>{cell}</td>") for cell in ("(0.01, 0.0, 0.0)", "[0.01, 0.0, 0.0]")] == [1, 0]


def test_a_refused_plan_is_a_row(tmp_path: Path) -> None:
    assert fly(campaign(seeds=1, sweep={"path.lap_s": [1.0]}, draw={}), tmp_path / "c") == 1
    (row,) = rows(tmp_path / "c")
    assert (
        row["status"] == "refused"
        and "robot 1" in row["reason"]
        and "Not flown" in (tmp_path / "c" / "report.html").read_text()
    )


@pytest.mark.parametrize("scene", ["numeric", "numeric-disturbed"])
def test_a_campaign_of_a_numeric_scene_flies(scene: str, tmp_path: Path) -> None:
    """Its robots start above the surface of water that has none: planning must know that."""
    loaded = campaign(experiment=scene, settings=["duration_s=0.2"], seeds=1, sweep={}, draw={})
    assert fly(loaded, tmp_path / "c") == 0
    assert [row["status"] for row in rows(tmp_path / "c")] == ["flown"]


@pytest.mark.parametrize("scene", sorted(path.stem for path in EXPERIMENTS.glob("*.toml")))
def test_a_campaign_plans_every_scene_as_the_station_does(scene: str) -> None:
    """The parts that are dropped for a shared plan do not change the plan."""
    whole = load_experiment(scene, [NO_CAMERA])
    reduced = check(Experiment, json.loads(planning_text(whole)), scene)
    trajectories = planner.plan(whole)
    assert {r: t.id for r, t in planner.plan(reduced).items()} == {r: t.id for r, t in trajectories.items()}
    for robot, start in planner.start_poses(whole, trajectories).items():
        assert np.array_equal(planner.start_poses(reduced, trajectories)[robot], start)


def test_a_flight_that_does_not_arrive_has_not_passed(tmp_path: Path) -> None:
    """Three seconds are not enough for the way that `swap` has; its limit says that robots must be there at the end."""
    loaded = campaign(
        experiment="swap", settings=["duration_s=3", "robots.0.start_offset=[0,0.5,0,0]"], seeds=1, sweep={}, draw={}
    )
    assert fly(loaded, tmp_path / "c") == 0
    (row,) = rows(tmp_path / "c")
    limit_m = load_experiment("swap").limits.arrived_m
    assert limit_m is not None and row["arrived_m"] > limit_m
    assert not row["passed"] and "from its place at the end" in row["reason"]


@pytest.mark.parametrize(
    ("setting", "reason"),
    [
        ('sim.faults=[{at_s=0.2,what="battery 2 sag 4"}]', "faults"),
        ("robots.1.start=[0.71,-0.33,0.3,1.6]", "separation"),
        ("robots.1.start=[1.595,0.0,0.3,1.6]", "clearance of hulls"),
    ],
)
def test_a_flight_that_breaks_what_every_run_must_keep_has_not_passed(setting: str, reason: str, tmp_path: Path) -> None:
    """A robot that gives up, robots nearer to each other than twice safety.radius_m, and one that is carried against the wall:
    the command that flies the row again fails too, though no limit of the experiment is asked of so short a flight."""
    current = ["sim.plant.current_mps=[0.25,0.0,0.0]"] if reason == "clearance of hulls" else []
    loaded = campaign(settings=["duration_s=1.5", setting, *current], seeds=1, sweep={}, draw={})
    assert fly(loaded, tmp_path / "c") == 0
    (row,) = rows(tmp_path / "c")
    assert (row["status"], row["passed"]) == ("flown", False) and reason in row["reason"].split("; ")
    code, _, _ = ended(*shlex.split(row["command"]), "--out", str(tmp_path / "runs"))
    assert code == 1


def test_a_robot_that_refuses_is_a_refusal_with_its_reason_and_leaves_no_folder(tmp_path: Path) -> None:
    """In a numeric flight as in a campaign: the battery is too low to arm."""
    settings = ["duration_s=1", "sim.sensors.battery_v=9"]
    sets = [word for setting in settings for word in ("--set", setting)]
    done = CliRunner().invoke(cli, ["numeric", "pool", *sets, "--out", str(tmp_path / "runs")])
    assert isinstance(done.exception, ConfigError) and not (tmp_path / "runs").exists()
    assert str(done.exception).startswith("robot 1 refuses ARM: the battery has 9.0 V")
    assert fly(campaign(settings=settings, seeds=1, sweep={}, draw={}), tmp_path / "c") == 1
    (row,) = rows(tmp_path / "c")
    assert (row["status"], row["reason"]) == ("refused", str(done.exception))


def test_a_flight_that_failed_is_flown_again_by_resume(flown: Path, tmp_path: Path) -> None:
    """The cause of a failure, such as a machine without memory, may be over; a refusal would be repeated."""
    first, second, *others = [json.loads(line) for line in (flown / "journal.jsonl").read_text().splitlines()]
    spoilt = [
        {**first, "status": "failed", "reason": "MemoryError: "},
        {**second, "status": "refused", "reason": "why"},
        *others,
    ]
    (tmp_path / "journal.jsonl").write_text("".join(json.dumps(row) + "\n" for row in spoilt))
    assert fly(campaign(), tmp_path, resume=True) == 1
    assert [row["status"] for row in rows(tmp_path)] == ["flown", "refused", "flown", "flown"]


def test_resume_refuses_flights_of_another_version(flown: Path, tmp_path: Path) -> None:
    lines_ = (flown / "journal.jsonl").read_text().splitlines()
    assert {json.loads(line)["commit"] for line in lines_} == {row["commit"] for row in rows(flown)} == {code().commit}
    for other in ({"commit": "0" * 40}, None):  # None: of a version that did not record it
        row = json.loads(lines_[0])
        del row["commit"]
        (tmp_path / "journal.jsonl").write_text(
            "".join(f"{line}\n" for line in [json.dumps({**row, **(other or {})}), *lines_[1:]])
        )
        before = (tmp_path / "journal.jsonl").read_bytes()
        with pytest.raises(ConfigError, match=r"holds flights of (commit 0{40}|an earlier version), and this is "):
            fly(campaign(), tmp_path, resume=True)
        assert (tmp_path / "journal.jsonl").read_bytes() == before


def test_resume_goes_on_with_flights_of_an_unknown_commit_and_says_so(flown: Path, tmp_path: Path) -> None:
    """As of a program that could not ask git in time."""
    lines_ = [json.loads(line) for line in (flown / "journal.jsonl").read_text().splitlines()]
    lines_[0]["commit"] = UNKNOWN
    (tmp_path / "journal.jsonl").write_text("".join(f"{json.dumps(line)}\n" for line in lines_))
    text = io.StringIO()
    assert fly(campaign(), tmp_path, resume=True, console=Console(file=text)) == 0
    output = " ".join(text.getvalue().split())
    assert "nobody knows whether one version flies them all" in output
    assert f"{code().commit}, {UNKNOWN}" in output


def test_a_second_program_in_a_folder_is_refused(tmp_path: Path) -> None:
    complaint = pytest.raises(ConfigError, match="another program flies this campaign")
    with campaign_runner.Journal(tmp_path / "journal.jsonl"), complaint:
        fly(campaign(), tmp_path, resume=True)
    with campaign_runner.Journal(tmp_path / "journal.jsonl") as journal:
        assert not journal.rows


def test_a_journal_that_is_deleted_while_it_is_written_is_missed(tmp_path: Path) -> None:
    with campaign_runner.Journal(tmp_path / "journal.jsonl") as journal:
        journal.add({"seed": 1})
        (tmp_path / "journal.jsonl").unlink()
        with pytest.raises(OSError, match="was deleted"):
            journal.add({"seed": 2})


def with_room(size: int, folder: Path) -> subprocess.CompletedProcess[str]:
    """`sim-bridge campaign small.toml --out c --resume` in a folder where no file may grow beyond this many bytes."""
    (folder / "small.toml").write_text(tomli_w.dumps(TABLE))
    words = ["campaign", "small.toml", "--workers", "1", "--out", "c", "--resume"]
    limit = f"import resource; resource.setrlimit(resource.RLIMIT_FSIZE, ({size},) * 2)"
    script = f"{limit}; import sys; sys.argv[1:] = {words}; from sim_bridge.__main__ import app; app()"
    done = subprocess.run([sys.executable, "-c", script], cwd=folder, capture_output=True, text=True, check=False)
    assert done.returncode == 1 and "Traceback" not in done.stdout + done.stderr
    return done


def test_a_journal_on_a_full_disk_keeps_whole_rows(flown: Path, tmp_path: Path) -> None:
    """It has room for one and a half rows more."""
    row, empty = len((flown / "journal.jsonl").read_bytes().splitlines(keepends=True)[0]), b"\n" * 2**20
    (tmp_path / "c").mkdir()
    (tmp_path / "c" / "journal.jsonl").write_bytes(empty)
    done = with_room(len(empty) + row * 3 // 2, tmp_path)
    assert "c/journal.jsonl: " in done.stdout and "; --resume goes on" in done.stdout
    assert "2 of 4 flights flown" in done.stdout and "report:  c/report.html" in done.stdout
    (line,) = (tmp_path / "c" / "journal.jsonl").read_bytes().lstrip(b"\n").splitlines(keepends=True)
    assert line.endswith(b"\n") and json.loads(line)["status"] == "flown"


def test_results_that_find_no_room_are_not_announced(flown: Path, tmp_path: Path) -> None:
    (tmp_path / "c").mkdir()
    (tmp_path / "c" / "journal.jsonl").write_bytes((flown / "journal.jsonl").read_bytes())
    done = with_room(1000, tmp_path)
    assert "no results or report: c/results.parquet: File too large; --resume writes them" in done.stdout
    assert "4 of 4 flights flown" in done.stdout and "report:  " not in done.stdout


@pytest.mark.slow
def test_a_flight_whose_log_found_no_room_is_not_told_as_flown() -> None:
    """Its figures would be those of a part of it, and --resume would not fly it again."""
    experiment = load_experiment("pool", ["duration_s=1.5"]).model_dump_json()
    limit = "import resource; resource.setrlimit(resource.RLIMIT_FSIZE, (200_000,) * 2)"
    script = f"{limit}; import json, sys; from sim_bridge.studies.campaign_flight import fly_one"
    script += "; print(json.dumps(fly_one(sys.stdin.read())))"
    done = subprocess.run([sys.executable, "-c", script], input=experiment, capture_output=True, text=True, check=True)
    row = json.loads(done.stdout.splitlines()[-1])
    assert (row["status"], row["reason"].partition(":")[0]) == ("failed", "Failed")
    assert "Cut log" in row["reason"] and "rms_m" not in row


@pytest.mark.real_time
def test_workers_end_with_a_campaign_that_is_killed(tmp_path: Path) -> None:
    (tmp_path / "small.toml").write_text(tomli_w.dumps({**TABLE, "seeds": 1000}))
    words = [installed("sim-bridge"), "campaign", "small.toml", "--workers", "2", "--out", "c"]
    with subprocess.Popen(words, cwd=tmp_path, stdout=subprocess.DEVNULL) as flying:
        journal = tmp_path / "c" / "journal.jsonl"
        assert eventually(lambda: journal.exists() and journal.read_text())
        started = psutil.Process(flying.pid).children(recursive=True)
        flying.kill()
    assert len(started) >= 3  # the fork server and two workers
    assert eventually(lambda: not any(one.is_running() and one.status() != psutil.STATUS_ZOMBIE for one in started))


def test_a_campaign_in_which_no_flight_flew_says_so_with_the_first_reason(tmp_path: Path) -> None:
    console = terminal(io.StringIO())
    refused = campaign(sweep={"path.lap_s": [1.0, 2.0]}, draw={}, seeds=1, title="Dive [/b] :dash:")
    assert fly(refused, tmp_path / "c[red]", console=console) == 1
    assert isinstance(console.file, io.StringIO)
    text = console.file.getvalue()
    folder = tmp_path / "c[red]"  # in one piece, however long: a path is copied from there
    assert f"Dive [/b] :dash:: 2 flights, into {folder}\n" in text and f"{folder / 'results.parquet'}\n" in text
    assert "0 of 2 flights flown, 2 refused, 0 failed" in text
    assert "flight 0 (seed 1) refused: robot 1: speed" in text


def test_a_bad_value_of_the_last_flight_is_found_before_the_first_one_flies(tmp_path: Path) -> None:
    """Also among drawn values, and among seeds."""
    drawn = {"sim.plant.mass_error": {"choice": [0.1, -2.0]}}
    with pytest.raises(ConfigError, match=r"sim.plant.mass_error = -2.0: "):
        fly(campaign(seeds=9, sweep={}, draw=drawn), tmp_path / "c")
    with pytest.raises(ConfigError, match=r"seed = 2147483648: "):
        fly(campaign(seeds=2, first_seed=2**31 - 1, sweep={}, draw={}), tmp_path / "c")
    assert not (tmp_path / "c").exists()


def test_only_a_few_of_a_million_flights_are_prepared_at_a_time(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The flights are swept, so that two of them are checked; the executor counts how many it holds."""
    stop, held, most = Stop(install=False), [0], [0]

    class Counting:
        def submit(self, fly_one: Any, text: str) -> Future[dict[str, Any]]:
            held[0] += 1
            most[0] = max(most[0], held[0])
            future: Future[dict[str, Any]] = Future()
            future.set_result({"status": "flown", "reason": "", "passed": True, "wall_s": 0.0})
            return future

    loaded = campaign(seeds=1_000_000, sweep={}, draw={})
    # the public function makes its executor itself; this one counts what it holds
    coming = campaign_runner._fly(Counting(), loaded, {}, 4, stop, Console(quiet=True))  # type: ignore[arg-type]
    for _ in range(10):
        next(coming)
        held[0] -= 1
    assert most[0] <= 4
    checked: list[int] = []
    monkeypatch.setattr(campaign_runner, "_experiment", lambda campaign, flight: checked.append(flight.seed))
    monkeypatch.setattr(campaign_runner, "flights", lambda campaign: islice(flights(campaign), 50))
    # the public function would fly all flights after the check
    campaign_runner._check_all(loaded, stop)
    assert checked == [1], "seeds between the first and the last are not loaded"


@pytest.mark.slow
def test_a_dask_cluster_flies_the_same(flown: Path, tmp_path: Path) -> None:
    from distributed import LocalCluster  # takes 0.5 s of every process that collects this file

    with LocalCluster(n_workers=1, threads_per_worker=1, dashboard_address=None) as cluster:
        assert fly(campaign(seeds=1), tmp_path / "c", scheduler=cluster.scheduler_address) == 0
    results, expected = rows(tmp_path / "c"), rows(flown)[:2]
    assert [row["rms_m"] for row in results] == [row["rms_m"] for row in expected]


def test_absent_cluster_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(campaign_runner, "CLUSTER_WITHIN_S", 1.0)
    with pytest.raises(ConfigError, match=r"--scheduler tcp://127\.0\.0\.1:1: "):
        fly(campaign(seeds=1), tmp_path / "c", scheduler="tcp://127.0.0.1:1")


# --- statistics


@pytest.mark.slow
def test_intervals_hold_the_truth_as_often_as_they_say() -> None:
    """In 2,000 samples of 40 skewed values each: the true mean and quantiles lie inside in 95 %, or more."""
    random = np.random.default_rng(1)
    samples = np.sort(random.gamma(4.0, 1.0, (2000, 40)), axis=1)
    true = stats.gamma(4.0)
    means = [distribution(s).mean for s in samples]
    assert np.mean([(m.low or 0) <= 4.0 <= (m.high or 9e9) for m in means]) == pytest.approx(0.95, abs=0.03)
    for share in (0.5, 0.95):
        quantiles = [quantile(s, share) for s in samples]
        held = np.mean([(f.low or 0) <= true.ppf(share) <= (f.high or 9e9) for f in quantiles])
        assert 0.94 < held < 0.995


def test_an_interval_of_what_cannot_be_negative_has_no_negative_bound() -> None:
    bounds = mean([0.0, 0.001, 0.0, 0.09, 0.0, 0.002])
    assert bounds.low is not None and bounds.high is not None and 0.0 <= bounds.low < bounds.value < bounds.high <= 0.09


def test_a_rate_s_interval_is_wilson_s() -> None:
    interval = rate(8, 10)
    assert [interval.value, interval.low, interval.high] == pytest.approx([0.8, 0.4902, 0.9433], abs=1e-4)
    assert rate(0, 5).low == 0.0 and (rate(0, 5).high or 0) > 0.4


def test_one_flight_is_no_distribution() -> None:
    summary = distribution([3.0])
    assert summary.mean.value == summary.median.value == 3.0 and summary.mean.low is None and summary.high.high is None
