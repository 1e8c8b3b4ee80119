"""Logs, recordings, tables and campaigns stay readable up to where the disk failed or their command was killed.

The original of a mended log is kept, and what takes long is gone on with.
"""

import csv
import json
import os
import random
import re
import shutil
import time
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

import cv2
import numpy as np
import pyarrow.parquet as pq
import pytest
from mcap.records import Message
from mcap.stream_reader import StreamReader

from localizer.detection.image_regions import BAYER_TO_BGR
from localizer.sources.recording import recorded_frames
from shoal.config.experiment import load_experiment
from tests.disks import jobs
from tests.forked import EndedCommand, Programs, failing_disk
from tests.groundstation.small_log import sequences
from tests.localizer.scene import Scene

pytestmark = pytest.mark.long

SEED = int(os.environ.get("DISKS_SEED", "0")) or time.time_ns() % 1_000_000  # printed; the variable repeats a run


@pytest.fixture(scope="module")
def programs(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Programs]:
    with Programs(failing_disk(tmp_path_factory.mktemp("disk"))) as running:
        yield running


@pytest.fixture
def chance(request: pytest.FixtureRequest) -> random.Random:
    print(f"DISKS_SEED={SEED}")
    return random.Random(f"{SEED} {request.node.name}")


def whole_messages(path: Path) -> list[Message]:
    """The messages of a log up to where another reader finds it cut."""
    messages = list[Message]()
    with path.open("rb") as file, suppress(Exception):  # whatever the end of the file looks like
        messages.extend(record for record in StreamReader(file, validate_crcs=True).records if isinstance(record, Message))
    return messages


# --- a run's log


def record(programs: Programs, folder: Path, fault: str, call: int) -> EndedCommand:
    """Have the station's recorder write a run little by little."""
    folder.mkdir()
    return programs.run(["tests.disks.jobs:record_run"], folder, fault, call)


def check_log(programs: Programs, folder: Path, fault: str, call: int) -> None:
    ended = record(programs, folder, fault, call)
    log, case = folder / "run.mcap", f"{fault} at call {call}"
    if ended.code == 0 and ended.calls < call:
        pass  # on a busy machine it flushes less often: nothing has failed
    elif fault == "removed" and ended.code == 0:
        assert whole_messages(log), f"{case}: {ended}"  # before anything was written
    elif fault == "kill":
        assert ended.code == -9, f"{case}: {ended}"
    else:
        assert ended.code in (1, 2) and "run.mcap" in ended.last_line and "Traceback" not in ended.output, f"{case}: {ended}"
    if fault == "removed" and ended.code != 0:
        assert "was deleted" in ended.last_line, f"{case}: {ended}"
    if not log.exists():
        assert record(programs, folder.with_suffix(".again"), "count", 1).code == 0
        return
    before, whole = log.read_bytes(), [message.sequence for message in whole_messages(log)]
    mended = programs.run(["groundstation", "log", "repair", "run.mcap"], folder)
    if not whole and mended.code == 2:  # cut before its first record
        assert "nothing to keep" in mended.last_line and log.read_bytes() == before, f"{case}: {mended}"
        assert not (folder / "run.mcap.original").exists()
        return
    assert mended.code == 0, f"{case}: {mended}"
    assert sequences(log) == whole == [1 + k // jobs.ROBOTS for k in range(len(whole))], case
    if "mended" in mended.output:
        assert (folder / "run.mcap.original").read_bytes() == before, f"{case}: the original is lost"


@pytest.mark.parametrize("fault", ["kill", "kill", "full", "gone", "removed"])
def test_a_log_of_a_recorder_that_failed_can_be_mended(
    fault: str, programs: Programs, tmp_path: Path, chance: random.Random
) -> None:
    check_log(programs, tmp_path / "run", fault, chance.randint(1, 9))


@pytest.mark.slow
def test_a_log_of_a_recorder_that_failed_can_be_mended_whatever_call_fails(programs: Programs, tmp_path: Path) -> None:
    calls = record(programs, tmp_path / "whole", "count", 1).calls
    assert calls >= 5  # on a busy machine it flushes less often
    for fault in ("kill", "full", "gone", "read-only", "removed"):
        for call in range(1, calls - 1):  # a pace that is a flush quicker has fewer
            check_log(programs, tmp_path / f"{fault}-{call}", fault, call)


# --- a recording of frames


def check_frames(programs: Programs, folder: Path, fault: str, call: int) -> None:
    folder.mkdir()
    ended, case = programs.run(["tests.disks.jobs:record_frames"], folder, fault, call), f"{fault} at call {call}"
    file = folder / "recording" / "frames.mcap"
    whole = (
        sum(len(message.data) > jobs.SIZE_PX[0] * jobs.SIZE_PX[1] for message in whole_messages(file)) if file.exists() else 0
    )
    if whole:
        assert [int(frame.pixels[0, 0]) for frame in recorded_frames(file.parent)] == list(range(whole)), case
        assert load_experiment(str(file.parent / "experiment.toml")).name == "pool"
    if fault == "kill":
        assert ended.code == -9, f"{case}: {ended}"
    elif fault == "removed" and ended.code == 0:
        assert whole == jobs.FRAMES, f"{case}: {whole}: {ended}"  # before anything was written
    else:
        assert ended.code in (1, 2) and "recording" in ended.last_line and "Traceback" not in ended.output, f"{case}: {ended}"
        if match := re.search(r"ends after (\d+) frames", ended.last_line):
            assert int(match[1]) <= whole <= int(match[1]) + 1, f"{case}: {whole}: {ended}"  # the last one may have no index
    shutil.rmtree(folder)


def test_frames_until_the_kill_can_be_read(programs: Programs, tmp_path: Path, chance: random.Random) -> None:
    (tmp_path / "whole").mkdir()
    calls = programs.run(["tests.disks.jobs:record_frames"], tmp_path / "whole").calls
    assert calls > jobs.FRAMES
    for k, fault in enumerate(("kill", "kill", "kill", "full", "full", "gone", "read-only", "removed")):
        check_frames(programs, tmp_path / str(k), fault, chance.randint(1, calls))


@pytest.mark.slow
def test_frames_can_be_read_whatever_call_fails(programs: Programs, tmp_path: Path) -> None:
    (tmp_path / "whole").mkdir()
    for call in range(1, programs.run(["tests.disks.jobs:record_frames"], tmp_path / "whole").calls + 1):
        for fault in ("kill", "full", "gone", "read-only", "removed"):
            check_frames(programs, tmp_path / f"{fault}-{call}", fault, call)


# --- a table of poses


@pytest.fixture(scope="module")
def video(tmp_path_factory: pytest.TempPathFactory) -> Path:
    experiment, path = load_experiment("pool"), tmp_path_factory.mktemp("track") / "pool.avi"
    scene = Scene(experiment)
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"HFYU"), 20.0, experiment.camera.size_px)
    for k in range(8):
        writer.write(cv2.cvtColor(scene.frame({1: np.array([0.4 + 0.01 * k, 0.1, 0.3, 0.7])}), BAYER_TO_BGR))
    writer.release()
    return path


def frames_of(table: Path) -> list[int]:
    """The frames of a table's whole rows."""
    lines = table.read_text().splitlines(keepends=True) if table.exists() else []
    return [int(row["frame"]) for row in csv.DictReader(line for line in lines if line.endswith("\n"))]


def check_table(programs: Programs, video: Path, folder: Path, call: int, resumed: int) -> None:
    """Kill `localizer track` at a call, and what goes on with it at another one."""
    folder.mkdir()
    command = ["localizer", "track", str(video), "--experiment", "pool", "--out", "poses.csv"]
    assert programs.run(command, folder, "kill", call).code == -9
    frames = {frame for part in folder.glob("*.part") for frame in frames_of(part)}
    ended = programs.run([*command, "--resume"], folder, "kill", resumed)
    if ended.code == -9:
        parts = [*folder.glob("*.part"), *folder.glob("poses.csv")]
        kept = {frame for part in parts for frame in frames_of(part)}
        assert len(kept) >= len(frames) - 1, f"kill at call {call}, then {resumed}: {sorted(kept)} of {sorted(frames)} left"
        if not (folder / "poses.csv").exists():
            ended = programs.run([*command, "--resume"], folder)
    assert ended.code in (0, -9), f"kill at call {call}, then {resumed}: {ended}"
    assert frames_of(folder / "poses.csv") == list(range(1, 8)), f"kill at call {call}, then {resumed}"


def test_rows_of_a_table_outlive_two_kills(programs: Programs, video: Path, tmp_path: Path, chance: random.Random) -> None:
    check_table(programs, video, tmp_path / "late", 9, chance.randint(1, 3))


def test_a_table_that_is_deleted_meanwhile_is_missed(programs: Programs, video: Path, tmp_path: Path) -> None:
    command = ["localizer", "track", str(video), "--experiment", "pool", "--out", "poses.csv"]
    ended = programs.run(command, tmp_path, "removed", 4)
    assert ended.code in (1, 2) and "Traceback" not in ended.output, ended
    assert "poses.csv" in ended.last_line and "was deleted" in ended.last_line


@pytest.mark.slow
def test_rows_of_a_table_outlive_kills_at_any_call(
    programs: Programs, video: Path, tmp_path: Path, chance: random.Random
) -> None:
    for call in range(1, 11):
        check_table(programs, video, tmp_path / str(call), call, chance.randint(1, 5))


# --- a campaign


@pytest.mark.slow
@pytest.mark.parametrize("fault", ["kill", "full", "gone", "read-only", "removed"])
def test_a_campaign_goes_on_with_what_was_flown(fault: str, programs: Programs, tmp_path: Path, chance: random.Random) -> None:
    """A flight whose row is in the journal is not flown again, and the results have every flight once."""
    campaign = 'name = "short"\nexperiment = "numeric"\nseeds = 3\nsettings = ["duration_s=1"]\n'
    command = ["sim-bridge", "campaign", "c.toml", "--out", "out", "--workers", "1"]

    def fly(folder: Path, *more: str, fault: str = "count", call: int = 1) -> EndedCommand:
        folder.mkdir(exist_ok=True)
        (folder / "c.toml").write_text(campaign)
        return programs.run([*command, *more], folder, fault, call)

    whole = fly(tmp_path / "whole")
    assert whole.code == 0, whole.output
    calls = whole.calls
    for k in range(6):
        call, folder = chance.randint(1, calls), tmp_path / str(k)
        ended, case = fly(folder, fault=fault, call=call), f"{fault} at call {call} of {calls}"
        assert "Traceback" not in ended.output, f"{case}: {ended.output}"
        results = [folder / "out" / name for name in ("results.parquet", "report.html")]
        # the renames at the end need no room; what is deleted before anything is written, or at the last call, is not missed
        is_whole = all(file.exists() for file in results) if fault in ("full", "removed") else False
        too_late = ended.calls < call + (fault == "removed")
        failed = ended.code == -9 if fault == "kill" else ended.code != 0 or too_late or is_whole
        assert failed, f"{case}: {ended}"
        journal = folder / "out" / "journal.jsonl"
        lines = journal.read_text().splitlines(keepends=True) if journal.exists() else []
        flown = [line for line in lines if line.endswith("\n")]
        again = fly(folder, "--resume")
        assert again.code == 0, f"{case}: {again.output}"
        assert set(flown) <= set(journal.read_text().splitlines(keepends=True)), f"{case}: a row of the journal is lost"
        assert len([line for line in journal.read_text().splitlines() if line.endswith("}")]) == 3, f"{case}: flown twice"
        assert sorted(pq.read_table(folder / "out" / "results.parquet")["seed"].to_pylist()) == [1, 2, 3], case
        assert all(json.loads(line)["status"] == "flown" for line in flown), case
