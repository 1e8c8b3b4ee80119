"""Every process of the experiment for real: own processes, own Zenoh sessions, MAVLink over UDP, rendered frames."""

import io
import itertools
import json
import os
import re
import signal
import subprocess
import threading
import time
import urllib.request
from collections.abc import Callable, Mapping, Sequence
from datetime import datetime
from pathlib import Path
from typing import Any

import numpy as np
import psutil
import pytest
from mcap.reader import make_reader
from rich.console import Console

from groundstation.analysis.alignment import align
from groundstation.analysis.series import Series
from groundstation.logs.reader import read_log
from shoal.bus.endpoint import Endpoint
from shoal.bus.zenoh_transport import ZenohTransport
from shoal.config.experiment import load_experiment
from shoal.messages import codec, topics
from shoal.messages.messages import RobotState
from shoal.runtime.runtime import Stop
from sim_bridge.sil import commands, launcher
from sim_bridge.sil.commands import Program, RunOptions
from sim_bridge.sil.ports import free_port
from sim_bridge.sil.processes import Child, Children
from tests.forked import ended
from tests.planted import executed, installed, plant
from tests.waiting import wait_for_line

pytestmark = [pytest.mark.timeout(400), pytest.mark.long]


def start(out: Path, *arguments: str, cwd: Path | None = None) -> "subprocess.Popen[str]":
    return subprocess.Popen(
        [installed("sim-bridge"), "sil", "pool", "--no-web", "--out", str(out), *arguments],
        cwd=cwd,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        env={**os.environ, "COLUMNS": "160"},
    )


def finish(run: "subprocess.Popen[str]", timeout_s: float = 300.0) -> tuple[int, str]:
    output, _ = run.communicate(timeout=timeout_s)
    return run.returncode, output


def run_dir(out: Path) -> Path:
    (folder,) = out.iterdir()
    return folder


def states(folder: Path, robot: int) -> list[tuple[int, RobotState]]:
    with (folder / "run.mcap").open("rb") as file:
        messages = make_reader(file).iter_messages(topics=[f"shoal/{topics.STATE.key(robot)}"])
        return [(m.publish_time, codec.decode(RobotState, m.data, "log", "state")) for _, _, m in messages]


@pytest.fixture(scope="module")
def planted(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder in which a person works: programs start others there."""
    return plant(tmp_path_factory.mktemp("planted"))


@pytest.fixture(scope="module")
def lockstep_run(planted: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, int, str]:
    out = tmp_path_factory.mktemp("lockstep")
    code, output = finish(start(out, "--lockstep", "--duration", "9", "--seed", "2", cwd=planted))
    return run_dir(out), code, output


def test_a_lockstep_run_passes_and_leaves_what_it_promises(lockstep_run: tuple[Path, int, str]) -> None:
    folder, code, output = lockstep_run
    assert code == 0, output
    assert "passed" in output
    assert {"run.mcap", "experiment.toml", "result.json", "report.html"} <= {p.name for p in folder.iterdir()}
    assert load_experiment(str(folder / "experiment.toml")).seed == 2
    assert str(folder / "report.html") in output


@pytest.mark.parametrize("processes", [(), ("--one-process",)], ids=["processes", "one-process"])
def test_the_page_answers_at_its_address_from_when_that_is_printed(tmp_path: Path, processes: tuple[str, ...]) -> None:
    """A person clicks on it at once."""
    words = ["sil", "pool", "--manual", "--poses", *processes, "--web", f"127.0.0.1:{free_port()}", "--out", str(tmp_path)]
    environment = {**os.environ, "PYTHONUNBUFFERED": "1"}
    run = subprocess.Popen([installed("sim-bridge"), *words], stdout=subprocess.PIPE, text=True, env=environment)
    try:
        assert run.stdout is not None
        (address,) = itertools.islice((line.split()[-1] for line in run.stdout if line.startswith("operator page: ")), 1)
        with urllib.request.urlopen(address) as page:
            assert page.status == 200
    finally:
        run.terminate()
        run.wait(300.0)


def test_no_program_imports_from_the_working_folder(
    lockstep_run: tuple[Path, int, str], planted: Path, tmp_path: Path
) -> None:
    assert not executed(planted)
    words = [installed("sim-bridge"), "rerun", str(lockstep_run[0]), "--robot", "1"]
    subprocess.run(words, cwd=planted, capture_output=True, check=True)
    from_there = ["sil", "--from", str(lockstep_run[0]), "--at", "8.5", "--out", str(tmp_path)]
    subprocess.run([installed("sim-bridge"), *from_there], cwd=planted, capture_output=True, check=False)
    assert (run_dir(tmp_path) / "report.html").is_file()
    assert not executed(planted)


@pytest.mark.slow  # numeric flights of `make test` keep the same limits
def test_the_result_of_thirty_seconds_is_within_the_figures_to_reach(tmp_path: Path) -> None:
    code, output = finish(start(tmp_path, "--lockstep", "--duration", "30", "--seed", "2"))
    assert code == 0, output
    result: dict[str, Any] = json.loads((run_dir(tmp_path) / "result.json").read_text())
    assert (result["scene"], result["seed"], result["mode"]) == ("pool", 2, "lockstep")
    for row, most_m in [(r, 0.07) for r in result["robots"].values()] + [(p, 0.075) for p in result["pairs"].values()]:
        assert max(row["rms_m"][:2]) < most_m  # of the pair 0.069 to 0.072 with true poses too, by the offsets of the start
        assert max(row["rms_after_20s_m"][:2]) < 0.03
        assert max(row["max_after_20s_m"][:2]) < 0.08
    assert result["pose_error_m"]["rms"] < 0.005
    assert result["min_separation_m"] > 0.6
    assert result["real_time_factor"] > 0
    assert result["faults"] == []


def rerun(folder: Path, *arguments: str) -> list[dict[str, Any]]:
    """The output of `sim-bridge rerun --json` for a run."""
    code, output, errors = ended("sim-bridge", "rerun", str(folder), "--json", *arguments)
    assert output, errors
    robots: list[dict[str, Any]] = json.loads(output)
    assert code == (0 if arguments or all(robot["exact"] for robot in robots) else 1)
    return robots


def test_its_steps_done_again_come_out_the_same_to_the_last_bit(lockstep_run: tuple[Path, int, str]) -> None:
    for robot in rerun(lockstep_run[0]):
        assert robot["exact"], robot
        assert robot["compared"] >= 180  # the whole 9 s


def test_steps_of_a_cut_log_are_done_again_up_to_there_and_it_is_said(
    lockstep_run: tuple[Path, int, str], tmp_path: Path
) -> None:
    (tmp_path / "experiment.toml").write_bytes((lockstep_run[0] / "experiment.toml").read_bytes())
    whole = (lockstep_run[0] / "run.mcap").read_bytes()
    (tmp_path / "run.mcap").write_bytes(whole[: len(whole) * 2 // 3])
    code, output, errors = ended("sim-bridge", "rerun", str(tmp_path), "--json")
    assert code == 1 and "Cut log: run.mcap ends before its run does" in errors
    counts = {robot["robot"]: robot["compared"] for robot in rerun(lockstep_run[0])}
    assert all(robot["exact"] and 0 < robot["compared"] < counts[robot["robot"]] for robot in json.loads(output))


def test_another_weight_would_have_asked_for_other_thrust(lockstep_run: tuple[Path, int, str]) -> None:
    (robot,) = rerun(lockstep_run[0], "--robot", "2", "--set", "controller.nmpc.turning_m=0.1")
    differing = {difference["field"]: difference for difference in robot["differences"]}
    assert differing["control.wrench"]["largest"] > 1e-3
    assert "estimate.eta" not in differing  # what was estimated rests on what was sent, not on what would have been


def go_on(folder: Path, out: Path, *arguments: str) -> tuple[int, str]:
    code, output, errors = ended("sim-bridge", "sil", "--from", str(folder), "--out", str(out), *arguments)
    return code, output + errors


def flown(folder: Path) -> Series:
    return align(load_experiment(str(folder / "experiment.toml")), read_log(folder / "run.mcap"))


def test_a_simulation_goes_on_from_a_moment_of_it_as_it_went_on(lockstep_run: tuple[Path, int, str], tmp_path: Path) -> None:
    code, output = go_on(lockstep_run[0], tmp_path, "--at", "6")
    assert code == 0, output
    before, after = flown(lockstep_run[0]), flown(run_dir(tmp_path))
    for robot in (1, 2):
        apart = (after.robots[robot].truth - before.robots[robot].truth[: len(after.time_s)])[:, :3]
        steps = np.flatnonzero(np.isfinite(apart).all(axis=1))
        assert after.time_s[steps[0]] == pytest.approx(6.0, abs=0.11)
        assert after.time_s[steps[-1]] == pytest.approx(9.0, abs=0.11)
        assert np.abs(apart[steps[0]]).max() < 1e-4  # from where they were, as fast as they were,
        assert np.abs(apart[steps]).max() < 0.008  # and as they went on, but for the noise: 1 to 6 mm with seeds 2 to 4


def test_and_otherwise_where_something_is_otherwise(lockstep_run: tuple[Path, int, str], tmp_path: Path) -> None:
    changes = (
        "--at",
        "4",
        "--duration",
        "8",
        "--set",
        "sim.plant.current_mps=[0.05,0,0]",
        "--fault",
        "t=5 battery 1 sag 0.1",
    )
    code, output = go_on(lockstep_run[0], tmp_path, *changes)
    assert code in (0, 1) and "no report" not in output, output
    before, after = flown(lockstep_run[0]), flown(run_dir(tmp_path))
    apart = (after.robots[1].truth - before.robots[1].truth[: len(after.time_s)])[:, :2]
    assert np.nanmax(np.abs(apart)) > 0.01
    assert any(
        h.text == "fault: battery 1 sag 0.1" and h.time_s == pytest.approx(5.0, abs=0.11) for h in after.timeline_events
    )


@pytest.mark.parametrize(
    ("arguments", "words"),
    [(("--at", "31"), "at 31 s there is nothing: robot 1 came to 9"), (("--at", "5", "pool"), "the run says what is flown")],
)
def test_resuming_from_a_time_that_was_not_flown_is_refused(
    lockstep_run: tuple[Path, int, str], tmp_path: Path, arguments: tuple[str, ...], words: str
) -> None:
    code, output = go_on(lockstep_run[0], tmp_path, *arguments)
    assert code == 2
    assert words in " ".join(output.replace("│", " ").split())


def test_its_processes_are_gone(lockstep_run: tuple[Path, int, str]) -> None:
    left = [p for p in psutil.process_iter(["cmdline"]) if str(lockstep_run[0]) in " ".join(p.info["cmdline"] or [])]
    assert left == []


ELSEWHERE = [pytest.param(name, marks=pytest.mark.slow) for name in ("localizer", "agent-1")]  # in tests/faults as well


@pytest.mark.real_time
@pytest.mark.parametrize("victim", ["groundstation", *ELSEWHERE])
def test_a_process_killed_in_flight_leaves_neutral_boards_and_is_named(victim: str, tmp_path: Path) -> None:
    sight = () if victim == "localizer" else ("--poses",)
    run = start(tmp_path, "--real-time", "--duration", "60", *sight)
    try:
        while not list(tmp_path.glob("pool-*")):
            time.sleep(0.05)
        logs = run_dir(tmp_path) / "logs"
        for robot in (1, 2):
            wait_for_line(logs / f"agent-{robot}.log", "tracking")
        time.sleep(1.5)
        (process,) = [p for p in psutil.Process(run.pid).children() if _name(p.cmdline()) == victim]
        killed_at = datetime.now()
        process.kill()
        code, output = finish(run)
    finally:
        run.kill()
    assert code == 1
    assert f"{victim} killed by SIGKILL" in output
    assert output.count("killed by") == output.count(f"{victim} killed by")  # the others survived
    stopping = (1, 2) if victim != "agent-1" else (1,)
    for robot in stopping:
        assert _neutral_at(logs / "sim-bridge.log", robot, killed_at) <= 0.5
    if victim == "localizer":  # in real time, too, and with a fault in it
        assert [robot["exact"] for robot in rerun(run_dir(tmp_path))] == [True, True]


def _name(cmdline: list[str]) -> str:
    module = cmdline[cmdline.index("-m") + 1]
    return f"agent-{cmdline[cmdline.index('--robot') + 1]}" if module == "robot_agent" else module


def _neutral_at(log: Path, robot: int, since: datetime) -> float:
    """Seconds from `since` to the moment from which the board stayed at neutral."""
    lines = re.findall(rf"^(\S+) sim-bridge INFO board of robot {robot}: (\w+)$", log.read_text(), re.MULTILINE)
    assert lines[-1][1] == "neutral", lines
    at = datetime.combine(since.date(), datetime.strptime(lines[-1][0], "%H:%M:%S.%f").time())
    return (at - since).total_seconds()


@pytest.mark.real_time
def test_ctrl_c_stops_everything_cleanly(tmp_path: Path) -> None:
    run = start(tmp_path, "--duration", "60")
    while not list(tmp_path.glob("pool-*")):
        time.sleep(0.05)
    wait_for_line(run_dir(tmp_path) / "logs" / "agent-1.log", "ready")
    children = psutil.Process(run.pid).children()
    assert len(children) == 5
    run.send_signal(signal.SIGINT)
    code, output = finish(run, 30)
    assert code == 130
    assert "every process is stopped" in output
    assert {"report.html", "result.json"} <= {path.name for path in run_dir(tmp_path).iterdir()}  # of what there was
    assert psutil.wait_procs(children, timeout=1)[1] == []
    with (run_dir(tmp_path) / "run.mcap").open("rb") as file:
        assert make_reader(file).get_summary() is not None  # the log was closed, not cut


@pytest.mark.real_time
def test_a_manual_run_is_flown_and_ended_from_another_terminal(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Which finds it by itself; and the launcher reports what was flown."""
    tmp_path.chmod(0o700)
    monkeypatch.setenv("SHOAL_RUNTIME_DIR", str(tmp_path))
    out = tmp_path / "runs"
    run = start(out, "--lockstep", "--manual", "--poses", "--duration", "2")

    def order(*what: str) -> tuple[int, str]:
        code, output, errors = ended("groundstation", *what)
        return code, output + errors

    try:
        while not list(out.glob("pool-*")):
            time.sleep(0.05)
        wait_for_line(run_dir(out) / "logs" / "groundstation.log", "mission: fleet ready\n")
        code, reply = order("mission", "start")
        assert code == 0, reply
        wait_for_line(run_dir(out) / "logs" / "groundstation.log", "mission: done")
        code, reply = order("end")
        assert (code, reply.splitlines()[-1]) == (0, "end: confirmed by 1, 2"), reply
        code, output = finish(run)
    finally:
        run.kill()
    assert "interrupted" not in output
    assert re.search(r"station: tcp/127.0.0.1:\d+", output)
    assert {"report.html", "result.json"} <= {path.name for path in run_dir(out).iterdir()}
    assert json.loads((run_dir(out) / "result.json").read_text())["duration_s"] == pytest.approx(2.0, abs=0.2)
    assert order("stop")[0] == 1  # nobody is there any more


@pytest.mark.real_time
def test_no_process_outlives_a_launcher_that_is_killed(tmp_path: Path) -> None:
    run = start(tmp_path, "--duration", "60", "--poses")
    while not list(tmp_path.glob("pool-*")):
        time.sleep(0.05)
    wait_for_line(run_dir(tmp_path) / "logs" / "agent-1.log", "ready")
    children = psutil.Process(run.pid).children()
    run.kill()
    run.communicate()
    assert psutil.wait_procs(children, timeout=5)[1] == []


def test_a_setting_that_cannot_be_is_explained_at_once(tmp_path: Path) -> None:
    code, output = finish(start(tmp_path, "--set", "controller.mpc.horizon=1"))
    assert code == 2
    assert "controller.mpc.horizon = 1" in output
    assert "greater than or equal to 2" in output
    assert not list(tmp_path.iterdir())


def test_a_run_is_interrupted_while_it_connects(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """To a station that listens and says nothing. No process and no folder is left."""
    stop, started = Stop(install=False), []

    def silent(
        robots: tuple[int, ...],
        options: RunOptions,
        run_dir: Path,
        address: str,
        ports: int,
        boards: Path | None,
        ring: int | None,
        cameras: tuple[str, ...],
    ) -> list[Program]:
        return [Program("groundstation", "http.server", (address.rpartition(":")[2], "--bind", "127.0.0.1"))]

    class Watched(Children):
        def start(
            self,
            name: str,
            module: str,
            arguments: Sequence[str],
            environment: Mapping[str, str] | None = None,
            inherits: Sequence[int] = (),
        ) -> Child:
            started.append(super().start(name, module, arguments, environment, inherits))
            return started[-1]

    def open_and_stop(endpoint: Endpoint, stopped: Callable[[], bool]) -> ZenohTransport:
        threading.Timer(0.2, stop.request).start()  # while it waits
        return ZenohTransport(endpoint, stopped)

    monkeypatch.setattr(commands, "programs", silent)
    monkeypatch.setattr(launcher, "Children", Watched)
    monkeypatch.setattr(launcher, "ZenohTransport", open_and_stop)
    console = Console(record=True, file=io.StringIO())
    assert launcher.run(load_experiment("pool"), tmp_path / "run", RunOptions(), stop, console) == 130
    assert "interrupted: nothing was flown, and no folder is left" in console.export_text()
    assert not (tmp_path / "run").exists()
    assert [child.exit_code is not None for child in started] == [True]
