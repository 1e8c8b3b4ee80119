"""Exported tables against mcap's own reader: every recorded topic, every message, every number under a name with its unit."""

import csv
import dataclasses
import re
import tracemalloc
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import pytest
from mcap.reader import make_reader
from mcap_protobuf.decoder import DecoderFactory
from typer.testing import CliRunner

from groundstation.__main__ import cli
from groundstation.export.tables import columns, export, rows
from groundstation.export.tables import table as in_memory
from groundstation.logs.recorder import Recorder
from shoal.config.experiment import dump_experiment, load_experiment
from shoal.errors import ConfigError
from shoal.messages import messages as m
from shoal.messages import topics
from shoal.messages.codec import Header, encode
from shoal.messages.labels import CHANNELS
from shoal.messages.topics import Topic

SECOND = 1_000_000_000
START_S = 4.0
CORNERS = np.arange(48, dtype=np.float64).reshape(2, 12, 2)
POSE = m.Pose(1.5, -0.5, 0.1, np.arange(9, dtype=np.float64).reshape(3, 3), m.Track.MARKER, True, 0.9, 0.3)
PATH = m.Trajectory("path", 0.05, np.arange(12.0).reshape(3, 4), np.ones((3, 4)), np.zeros((3, 4)), 0.5)
SAID: list[tuple[Topic, int, Any]] = [
    (topics.TRUTH, 0, m.Truth((1, 2), np.arange(8.0).reshape(2, 4), np.ones((2, 4)), np.ones((2, 3)), np.ones((2, 4)))),
    (topics.PREVIEW, 0, m.Preview(b"jpeg")),
    (topics.VIDEO, 0, m.Video(b"film")),
    (topics.PICTURE, 0, m.Picture(b"picture")),
    (topics.POSE, 1, POSE),
    (topics.LOCALIZER, 0, m.LocalizerStatus(m.CameraHealth.OK, 3, 1, 2.5, 30.0, "well", (1, 2), 7)),
    (topics.OBSTACLES, 0, m.Obstacles((4, 9), CORNERS, np.ones((2, 2)), 0.3, 1.0, unseen_s=np.zeros(2))),
    (topics.OBSTACLES, 0, m.Obstacles((), depth_m=0.3, watched=0.5)),
    (topics.PLAN, 2, m.Plan(0.05, np.arange(20.0).reshape(5, 4), np.zeros((5, 4)), 0.01)),
    (
        topics.STATE,
        1,
        m.RobotState(
            m.Mode.TRACKING, trajectory_s=0.5, pulse_us=tuple(range(1500, 1508)), estimate=m.Estimate(eta=np.arange(4.0))
        ),
    ),
    (topics.STATE, 1, m.RobotState(m.Mode.HOLDING, "pose late", trajectory_s=0.55, heard=(2, 3))),
    (topics.HEARTBEAT, 0, m.StationHeartbeat("hash", True, "RUNNING", 0.25, 0.0, (1, 2))),
    (topics.TRAJECTORY, 1, PATH),
    (topics.TUNING, 0, m.Tuning("set", ("controller.mpc.q.0", "controller.mpc.q.1"), np.array([1.0, 2.0]))),
    (topics.INPUTS, 1, m.StepInputs(7, POSE, board=m.BoardReading(5, depth_m=0.31), plan_robots=(2,), plan_sessions=(255,))),
    (topics.INPUTS, 1, m.StepInputs(8)),
    (topics.FAULT, 0, m.FaultRequest("camera frozen", 2.0)),
    (
        topics.COMMANDS,
        1,
        m.CommandTaken(
            3, 1, 9, 2, 5, command=m.Command(m.CommandKind.LOAD, 1, trajectory=PATH), reply=m.Reply(1, False, "why, then")
        ),
    ),
    (topics.EVENT, 0, m.Event(3, "agent-1", 'says "so",\nand more')),
]


def test_the_boards_eight_outputs_have_a_column_each() -> None:
    outputs = [*(f"thruster_{k}_us" for k in (1, 2, 3, 4)), *(f"ankle_{k}_us" for k in (1, 2, 3, 4))]
    assert [part.column for part in CHANNELS] == outputs


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("run")
    text = dump_experiment(load_experiment("pool"))
    (folder / "experiment.toml").write_text(text)
    recorder = Recorder(folder / "run.mcap", text, {"mode": "lockstep"})
    for k, (topic, robot, message) in enumerate(SAID):
        stamp_ns = round((START_S + 0.05 * k) * SECOND)
        key = f"shoal/{topic.key(robot or None)}"
        recorder.put(topic, key, Header(0xAB, k + 1, stamp_ns), encode(message, stamp_ns), stamp_ns + 3)
    recorder.close()
    return folder


def test_time_0_is_found_without_all_states_in_memory(tmp_path: Path) -> None:
    """A log of hours has millions of states, of 4 kB each."""
    count, recorder = 1500, Recorder(tmp_path / "run.mcap", "", {})
    for k in range(count):
        state = m.RobotState(
            m.Mode.TRACKING, trajectory_s=0.05 * k, pulse_us=tuple(range(1500, 1508)), estimate=m.Estimate(eta=np.arange(4.0))
        )
        recorder.put(topics.STATE, f"shoal/{topics.STATE.key(1)}", Header(1, k, k * SECOND // 20), encode(state), k)
    recorder.close()
    tracemalloc.start()
    try:
        in_memory(tmp_path / "run.mcap", topics.EVENT)
        assert tracemalloc.get_traced_memory()[1] < 2000 * count
    finally:
        tracemalloc.stop()


def table(path: Path) -> list[dict[str, str]]:
    with path.open(newline="", encoding="utf-8") as file:
        return list(csv.DictReader(file))


def test_every_recorded_topic_is_exported_and_every_message_of_it(run: Path, tmp_path: Path) -> None:
    assert {topic for topic, _, _ in SAID} == {topic for topic in topics.TOPICS if topic.recorded}
    done = export(run, tmp_path, parquet=False)
    with (run / "run.mcap").open("rb") as file:
        counted = Counter(channel.topic for _, channel, _ in make_reader(file).iter_messages())
    exported = Counter[str]()
    for path, count in done.files:
        key = re.sub(r"^robot-(\d+)-", r"robot/\1/", path.stem)
        key = key if key.startswith("robot/") else key.replace("-", "/", 1)
        rows = table(path)
        assert len(rows) == count
        exported[f"shoal/{key}"] += len({(row["session"], row["sequence"]) for row in rows})
    assert exported == counted
    assert (done.trouble, done.undecodable) == ("", 0)


def test_numbers_are_those_that_another_reader_decodes(run: Path, tmp_path: Path) -> None:
    export(run, tmp_path, parquet=False)
    with (run / "run.mcap").open("rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        decoded = {c.topic: (d, message) for _, c, message, d in reader.iter_decoded_messages()}
    pose, record = decoded["shoal/robot/1/pose"]
    (row,) = table(tmp_path / "robot-1-pose.csv")
    assert (float(row["x_m"]), float(row["y_m"]), float(row["yaw_rad"])) == (pose.x_m, pose.y_m, pose.yaw_rad)
    assert (int(row["stamp_ns"]), int(row["arrived_ns"]), row["session"]) == (record.publish_time, record.log_time, "ab")
    covariance = np.array(pose.covariance).reshape(3, 3)
    assert float(row["covariance_y_yaw_m_rad"]) == covariance[1, 2]
    assert float(row["covariance_yaw_yaw_rad2"]) == covariance[2, 2]
    truth, _ = decoded["shoal/sim/truth"]
    eta = np.array(truth.eta).reshape(2, 4)
    rows = table(tmp_path / "sim-truth.csv")
    assert [row["robot"] for row in rows] == ["1", "2"]
    assert [[float(row[name]) for name in ("x_m", "y_m", "z_m", "yaw_rad")] for row in rows] == eta.tolist()
    event, _ = decoded["shoal/event"]
    assert table(tmp_path / "event.csv")[0]["message"] == event.message


def test_time_is_zero_where_the_report_begins(run: Path, tmp_path: Path) -> None:
    """The first state under way, 0.5 s along the trajectory, is the tenth message: the path began 0.05 s after the log."""
    export(run, tmp_path, parquet=False)
    state = table(tmp_path / "robot-1-state.csv")
    assert [float(row["time_s"]) for row in state] == pytest.approx([0.5, 0.55])
    assert float(table(tmp_path / "sim-truth.csv")[0]["time_s"]) == pytest.approx(0.05)


def test_lists_have_a_row_per_entry_and_an_empty_one_says_so(run: Path, tmp_path: Path) -> None:
    export(run, tmp_path, parquet=False)
    obstacles = table(tmp_path / "obstacles.csv")
    assert [row["obstacle"] for row in obstacles] == ["4", "9", ""]
    assert (obstacles[1]["corner_12_y_m"], obstacles[2]["corner_1_x_m"], obstacles[2]["watched"]) == ("47.0", "", "0.5")
    plan = table(tmp_path / "robot-2-plan.csv")
    assert (plan[2]["node"], plan[2]["x_m"]) == ("2", "8.0")
    assert float(plan[2]["ahead_s"]) == pytest.approx(0.1)
    path = table(tmp_path / "robot-1-trajectory.csv")
    assert [float(row["trajectory_s"]) for row in path] == pytest.approx([0.5, 0.55, 0.6])
    assert [(row["key"], row["value"]) for row in table(tmp_path / "station-tuning.csv")][1] == ("controller.mpc.q.1", "2.0")


def test_a_message_within_a_message_has_columns_of_its_own(run: Path, tmp_path: Path) -> None:
    export(run, tmp_path, parquet=False)
    with_pose, without = table(tmp_path / "robot-1-inputs.csv")
    assert (with_pose["pose.x_m"], with_pose["pose.track"], with_pose["board.depth_m"]) == ("1.5", "MARKER", "0.31")
    assert (with_pose["plan_robots"], with_pose["plan_sessions"]) == ("2", "ff")
    assert (without["step"], without["pose.x_m"], without["board.depth_m"]) == ("8", "", "")
    (order,) = table(tmp_path / "robot-1-commands.csv")
    assert (order["command.order"], order["command.trajectory.id"], order["command.trajectory.eta_samples"]) == (
        "LOAD",
        "path",
        "3",
    )
    assert (order["reply.accepted"], order["reply.reason"]) == ("False", "why, then")


def test_every_array_of_a_recorded_message_has_names_with_units() -> None:
    for topic in topics.TOPICS:
        if topic.recorded:
            names = [column.name for column in columns(topic.type)]
            assert len(set(names)) == len(names), topic.name
            unnamed = [name for name in names if re.search(r"_\d+$", name)]
            assert not unnamed, f"{topic.name}: {unnamed}: give them names in groundstation/export/tables.py, NAMES"


def test_parquet_holds_the_same_as_csv(run: Path, tmp_path: Path) -> None:
    export(run, tmp_path / "csv", parquet=False)
    export(run, tmp_path / "parquet", parquet=True)
    names = sorted(path.stem for path in (tmp_path / "csv").iterdir())
    assert sorted(path.stem for path in (tmp_path / "parquet").iterdir()) == names
    for name in names:
        plain = table(tmp_path / "csv" / f"{name}.csv")
        columned = pq.read_table(tmp_path / "parquet" / f"{name}.parquet").to_pylist()
        as_text = [{key: "" if value is None else str(value) for key, value in row.items()} for row in columned]
        assert as_text == plain


def test_undecodable_messages_are_reported_with_exit_code_1(run: Path, tmp_path: Path) -> None:
    (tmp_path / "run").mkdir()
    recorder = Recorder(tmp_path / "run" / "run.mcap", "", {})
    for k, payload in enumerate((encode(POSE), b"\xff\xff")):
        recorder.put(topics.POSE, "shoal/robot/1/pose", Header(1, k + 1, k), payload, k)
    recorder.close()
    done = CliRunner().invoke(cli, ["log", "export", str(tmp_path / "run"), "--out", str(tmp_path / "out")])
    assert done.exit_code == 1
    assert "1 messages cannot be decoded" in done.output
    assert len(table(tmp_path / "out" / "robot-1-pose.csv")) == 1


def test_a_failed_export_leaves_no_half_table(run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(
        "groundstation.export.tables.rows", lambda message: 1 / 0 if isinstance(message, m.Event) else rows(message)
    )
    with pytest.raises(ZeroDivisionError):
        export(run, tmp_path, parquet=False)
    assert not list(tmp_path.iterdir())


def test_the_log_that_is_read_is_not_written_over(run: Path) -> None:
    before = {path.name: path.read_bytes() for path in run.iterdir()}
    export(run, run, parquet=False)  # beside the run's files, not over them
    assert {name: (run / name).read_bytes() for name in before} == before
    for path in run.glob("*.csv"):
        path.unlink()


def test_a_log_without_messages_is_refused(tmp_path: Path) -> None:
    (tmp_path / "run.mcap").write_bytes(b"")
    with pytest.raises(ConfigError, match="holds no messages"):
        export(tmp_path, tmp_path / "out", parquet=False)
    assert not (tmp_path / "out").exists()


def test_fields_are_all_told() -> None:
    """A field that a message gains has a column, or is part of one."""
    for topic in topics.TOPICS:
        if topic.recorded:
            cells = columns(topic.type)
            assert len(cells) >= len(dataclasses.fields(topic.type)) - 1, topic.name
