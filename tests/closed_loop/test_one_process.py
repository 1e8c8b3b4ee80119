"""A lockstep run in one process: the same folder, the same messages and the same pulses as from a process for each node."""

import itertools
import json
import os
import re
import statistics
import subprocess
import sys
import threading
import time
from collections.abc import Generator, Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import pytest
from mcap.reader import make_reader

from shoal.bus.memory_transport import MemoryHub
from shoal.config.experiment import NO_CAMERA, load_experiment
from shoal.errors import ConfigError
from shoal.messages import topics
from shoal.messages.codec import Header, decode
from shoal.messages.messages import Event
from shoal.runtime import output
from shoal.runtime.runtime import Failed, log
from sim_bridge.in_process.executor import Executor, Part
from tests import compare_pulses
from tests.closed_loop.slow_network import COMPARED, OnLocalized
from tests.forked import ended
from tests.planted import executed, installed, plant

pytestmark = [pytest.mark.timeout(600), pytest.mark.long]

BROKEN = (
    "link 1 noisy 0.3",
    "thruster 2/3 dead",
    "camera occluded 0.1",
    "battery 1 sag 0.2",
    "marker 2 lost",
    "water low 0.02",
    "camera bubbles 10",
)
FAULTS = [part for i, what in enumerate(BROKEN) for part in ("--fault", f"t={0.3 + 0.2 * i:g} for=0.9 {what}")]
FAULTS += ["--fault", "t=2.1 for=0.12 radio 2 dead"]  # longer, and the mission would be over

CAMERA_FAULTS = ("--fault", "t=0.3 for=0.8 camera west slow 0.12", "--fault", "t=1.5 camera east gone")


def sil(out: Path, *arguments: str) -> tuple[int, str, Path]:
    """Exit code, output and folder of a lockstep run."""
    command = [installed("sim-bridge"), "sil", *arguments, "--lockstep", "--no-web", "--out", str(out)]
    around = {name: value for name, value in os.environ.items() if not name.endswith("_NUM_THREADS")}  # it begins itself anew
    planted = plant(out.with_name(f"{out.name}-planted"))
    done = subprocess.run(command, cwd=planted, env=around, capture_output=True, text=True, check=False)
    assert not executed(planted)
    folders = list(out.iterdir()) if out.exists() else []
    return done.returncode, done.stdout + done.stderr, folders[0] if folders else out


def told(folder: Path) -> OnLocalized:
    """All messages of a run but pictures, lines for people, and what must differ."""
    record, by_key = OnLocalized(), {f"shoal/{topic.name}": topic for topic in COMPARED}
    with (folder / "run.mcap").open("rb") as file:
        for _, channel, message in make_reader(file).iter_messages():
            parts = channel.topic.split("/")
            name = "/".join(["shoal", *parts[3:]]) if parts[1] == "robot" else channel.topic
            if name in by_key:
                header = Header(0, message.sequence, message.publish_time)
                record.note(by_key[name], channel.topic, header, message.data)
    return record


def lines(folder: Path) -> set[tuple[str, str]]:
    """Source and text of the events of a run, but for what they tell of signatures."""
    with (folder / "run.mcap").open("rb") as file:
        messages = make_reader(file).iter_messages(topics=[f"shoal/{topics.EVENT.key()}"])
        events = [decode(Event, message.data, "log", "event") for _, _, message in messages]
    return {(event.source, event.message) for event in events if "dropped for their signature" not in event.message}


@pytest.mark.parametrize(
    "arguments",
    [
        pytest.param(("pool", "--duration", "2.5", "--seed", "3", *FAULTS), id="faults", marks=pytest.mark.slow),
        pytest.param(("islands", "--duration", "2", "--poses"), id="poses"),
        pytest.param(("two-cameras", "--duration", "2.5", *CAMERA_FAULTS), id="two-cameras", marks=pytest.mark.slow),
        pytest.param(("pool", "--duration", "8"), id="pool", marks=pytest.mark.slow),
        pytest.param(("figure-eight", "--duration", "8"), id="figure-eight", marks=pytest.mark.slow),
        pytest.param(("pool", "--duration", "10", "--set", "sim.latency_s=0.12", *FAULTS), id="late", marks=pytest.mark.slow),
    ],
)
def test_one_process_flies_to_the_bit_what_processes_fly(arguments: tuple[str, ...], tmp_path: Path) -> None:
    """And what they fly with signed links: signatures take no part in it."""
    code, output, many = sil(tmp_path / "many", *arguments, "--signed")
    command = ["sil", *arguments, "--one-process", "--lockstep", "--no-web", "--out", str(tmp_path / "one")]
    code_of_one, output_of_one, errors_of_one = ended("sim-bridge", *command)
    output_of_one += errors_of_one
    (one,) = (tmp_path / "one").iterdir()
    assert code_of_one == code, output_of_one
    assert compare_pulses.main(str(many), str(one)) == 0
    assert told(one).messages.keys() == told(many).messages.keys()
    assert not told(one).differs(told(many))
    assert lines(one) == lines(many)
    assert {p.name for p in one.rglob("*")} == {p.name for p in many.rglob("*")}
    results: list[dict[str, Any]] = [json.loads((folder / "result.json").read_text()) for folder in (many, one)]
    assert results[0]["robots"].keys() == results[1]["robots"].keys()
    for robot in results[0]["robots"]:
        assert results[0]["robots"][robot]["rms_m"] == results[1]["robots"][robot]["rms_m"]
    verdict = "passed" if code == 0 else "failed"
    assert all(re.search(rf"^{verdict}\b", text, re.MULTILINE) for text in (output, output_of_one))


def test_another_seed_gives_other_pulses(tmp_path: Path) -> None:
    experiment = load_experiment("pool", ["duration_s=1", NO_CAMERA])
    folders = [tmp_path / str(seed) for seed in (3, 4)]
    for folder in folders:
        folder.mkdir()
        assert Executor(experiment.model_copy(update={"seed": int(folder.name)}), folder, MemoryHub(), poses=True).fly()
    assert compare_pulses.main(*map(str, folders)) == 1


def test_a_run_that_the_station_refuses_leaves_no_folder(tmp_path: Path) -> None:
    code, output, _ = sil(tmp_path, "pool", "--one-process", "--poses", "--set", "recording.min_free_gb=1e9")
    assert code == 2
    assert "a run needs" in output.replace("\n", " ")
    assert list(tmp_path.iterdir()) == []


def test_at_a_pace_each_second_takes_its_time_and_the_bits_stay(tmp_path: Path) -> None:
    experiment, folders, pace = load_experiment("islands", ["duration_s=1"]), [tmp_path / "free", tmp_path / "paced"], 4.0
    ticks_s: list[float] = []
    for folder, most in zip(folders, (None, pace), strict=True):
        folder.mkdir()
        ticks_s.clear()
        assert Executor(experiment, folder, MemoryHub(), poses=True, pace=most).fly(lambda: ticks_s.append(time.monotonic()))
    least_s = experiment.controller.period_s / pace
    # A tick may be noted late, and then the next ones seem early: half of them are not.
    assert statistics.median(after - before for before, after in itertools.pairwise(ticks_s)) > 0.9 * least_s
    later = [(ticks_s[-1] - tick_s, len(ticks_s) - 1 - k) for k, tick_s in enumerate(ticks_s[: len(ticks_s) // 2])]
    assert any(took_s >= 0.99 * least_s * ticks for took_s, ticks in later)
    assert compare_pulses.main(*map(str, folders)) == 0


def test_a_run_whose_reader_has_gone_is_flown_to_its_end(tmp_path: Path) -> None:
    """`sim-bridge sil ... | head -1`"""
    command = [sys.executable, "-m", "sim_bridge", "sil", "pool", "--lockstep", "--one-process", "--poses", "--no-web"]
    run = subprocess.Popen([*command, "--duration", "1", "--out", str(tmp_path)], stdout=subprocess.PIPE)
    assert run.stdout is not None
    assert b"pool" in run.stdout.readline()
    run.stdout.close()
    assert run.wait(300.0) == 0
    (result,) = tmp_path.glob("*/result.json")
    assert json.loads(result.read_text())["passed"]


def test_a_run_that_breaks_leaves_no_thread_that_keeps_the_program(tmp_path: Path) -> None:
    def broken() -> None:
        raise BrokenPipeError("whoever was shown each tick has gone")

    before = set(threading.enumerate())
    with pytest.raises(Failed, match="BrokenPipeError"):
        Executor(load_experiment("pool", ["duration_s=1", NO_CAMERA]), tmp_path, MemoryHub(), poses=True).fly(broken)
    assert not [thread for thread in threading.enumerate() if thread not in before and not thread.daemon]


@pytest.fixture
def closing() -> Iterator[ExitStack]:
    """Closes what a test opens, and gives the log its handlers back."""
    with ExitStack() as stack:
        stack.callback(log.handlers.__setitem__, slice(None), log.handlers[:])
        stack.callback(log.setLevel, log.level)
        log.setLevel("INFO")
        yield stack


def test_a_part_that_fails_is_named_and_its_log_says_why(tmp_path: Path, closing: ExitStack) -> None:
    hub = MemoryHub()
    part, other = (Part(name, hub, tmp_path, closing) for name in ("agent-1", "agent-2"))

    def steps() -> Generator[None]:
        log.info("ready")
        yield
        with other.acting():
            log.info("spoken meanwhile")
        raise ValueError("robot 1: no such thing")

    part.begin(lambda bus: steps())
    with pytest.raises(Failed, match="agent-1 has ended: ValueError: robot 1: no such thing"):
        part.step()
    output.flush()
    own_log, other_log = ((tmp_path / f"agent-{robot}.log").read_text() for robot in (1, 2))
    assert "agent-1 INFO ready" in own_log and "ValueError: robot 1: no such thing" in own_log and "meanwhile" not in own_log
    assert other_log.endswith("agent-2 INFO spoken meanwhile\n") and other_log.count("\n") == 1


def test_a_refusal_of_a_part_stays_one(tmp_path: Path, closing: ExitStack) -> None:
    def refused() -> Generator[None]:
        raise ConfigError("duration_s = 0")
        yield

    with pytest.raises(ConfigError, match="duration_s = 0"):
        Part("groundstation", MemoryHub(), tmp_path, closing).begin(lambda bus: refused())
