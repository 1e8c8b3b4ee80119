"""A recorded run on the operator's page: what was logged at a time is what is shown for it, however one gets there."""

import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from groundstation.logs.reader import LogFile, LogMessage
from groundstation.logs.recorder import Recorder
from groundstation.planning.planner import plan
from groundstation.planning.segment import concatenate
from groundstation.web.protocol import Edit
from groundstation.web.replay_backend import FRAME_S, ReplayBackend
from shoal.config.experiment import dump_experiment, load_experiment
from shoal.errors import ConfigError
from shoal.frames import Array
from shoal.messages import topics
from shoal.messages.codec import Header, encode
from shoal.messages.messages import (
    BoardReading,
    CommandKind,
    Event,
    LocalizerStatus,
    Mode,
    Plan,
    Preview,
    RobotState,
    StationHeartbeat,
    StepTiming,
    Trajectory,
    Truth,
)
from shoal.messages.topics import Topic
from tests.groundstation.synthetic import POSE_OFFSET_M, START_S, Script, tracking_error, write_run

SECOND = 1_000_000_000


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("run")
    write_run(folder, Script(duration_s=30.0))
    return folder


@pytest.fixture
def replay(run: Path) -> Iterator[ReplayBackend]:
    with ReplayBackend(run) as backend:
        yield backend


def at(replay: ReplayBackend, time_s: float) -> dict[str, Any]:
    replay.seek(time_s, 0.0)
    return replay.snapshot()


def error_m(robot: dict[str, Any]) -> Array:
    poses = robot["state"]["estimate"]["eta"], robot["state"]["control"]["eta_reference"]
    eta, reference = (np.frombuffer(pose, "<f4").astype(np.float64) for pose in poses)
    return np.asarray((eta - reference)[:2])


@pytest.mark.long
def test_replay_begins_where_the_robots_start_to_fly(replay: ReplayBackend) -> None:
    first = replay.snapshot()
    assert first["replay"] == {"time_s": pytest.approx(START_S + 0.05, abs=0.01), "rate": 0.0}
    assert first["robots"][0]["state"]["trajectory_s"] == pytest.approx(0.05, abs=0.01)
    assert replay.scene()["replay"]["end_s"] == pytest.approx(START_S + 30.5, abs=0.1)
    assert [path["robot"] for path in replay.scene()["paths"]] == [1, 2]


def test_replay_begins_where_any_robot_starts_to_fly(tmp_path: Path) -> None:
    """The first one was out of the water."""
    write_run(tmp_path, Script(duration_s=5.0, lost=((1, 0.0, 60.0),)))
    with ReplayBackend(tmp_path) as replay:
        assert replay.scene()["replay"]["begin_s"] == pytest.approx(START_S + 0.05, abs=0.01)


def test_a_silent_robot_is_shown_as_it_was_last_heard(tmp_path: Path) -> None:
    """However long ago: at the end of a failed run that is what people want to see."""
    write_run(tmp_path, Script(duration_s=20.0, lost=((2, 5.0, 60.0),)))
    with ReplayBackend(tmp_path) as replay:
        for flown_s in (6.5, 7.5, 12.5, 5.5):
            _, robot = (shown := at(replay, START_S + flown_s))["robots"]
            assert robot["state"]["mode"] == "TRACKING"
            assert robot["age_ms"] == pytest.approx(1e3 * (flown_s - 5.0), abs=60.0)
            if flown_s > 6.0:
                lines = [(alarm["level"], alarm["text"]) for alarm in shown["alarms"] if alarm["robot"] == 2]
                assert lines == [("critical", f"not heard for {robot['age_ms'] * 1e-3:.1f} s")]


@pytest.mark.parametrize("order", [(3.0, 12.5, 25.0), (25.0, 3.0, 12.5)])
def test_seeking_shows_the_states_of_that_time(replay: ReplayBackend, order: tuple[float, ...]) -> None:
    for flown_s in order:
        shown = at(replay, START_S + flown_s + 0.001)
        for robot in shown["robots"]:
            assert robot["state"]["trajectory_s"] == pytest.approx(flown_s, abs=1e-6)
            assert robot["age_ms"] == pytest.approx(1.3, abs=0.1)  # 0.3 ms of it are its step
            expected = np.add(tracking_error(robot["id"], flown_s)[:2], POSE_OFFSET_M)  # the estimate's own offset
            np.testing.assert_allclose(error_m(robot), expected, atol=1e-6)


def test_a_state_is_shown_from_the_last_seconds_of_the_log_which_are_read_once(
    replay: ReplayBackend, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The log of an hour takes too long to read for each state."""
    begins: list[int] = []
    messages = LogFile.messages

    def read(
        log: LogFile, wanted: Callable[[Topic, int], bool], from_ns: int = 0, before_ns: int = 1 << 64
    ) -> Iterator[LogMessage]:
        begins.append(from_ns)
        return messages(log, wanted, from_ns, before_ns)

    monkeypatch.setattr(LogFile, "messages", read)
    at(replay, 0.0)
    start_ns = min(begins)
    begins.clear()
    at(replay, 28.5)
    assert 0 < len(begins) <= 6 and min(begins) >= start_ns + 23 * SECOND
    begins.clear()
    at(replay, 28.5)
    assert begins == []


def test_a_replay_that_stands_shows_one_state_and_one_that_plays_goes_on_by_its_pace(replay: ReplayBackend) -> None:
    """Another state is sent to every page that watches."""
    replay.seek(3.0, 0.0)
    assert replay.changed() and replay.snapshot()["replay"]["time_s"] == pytest.approx(3.0)
    time.sleep(2 * FRAME_S)
    assert not replay.changed() and replay.snapshot()["replay"]["time_s"] == pytest.approx(3.0)
    began_s = time.monotonic()
    replay.seek(None, 4.0)
    assert replay.changed()
    time.sleep(2 * FRAME_S)
    assert replay.changed()
    least_s = 4.0 * (time.monotonic() - began_s)
    shown_s = replay.snapshot()["replay"]["time_s"] - 3.0
    assert least_s - 1e-3 <= shown_s <= 4.0 * (time.monotonic() - began_s) + 1e-3
    replay.seek(1e6, None)
    at_end = [replay.snapshot()["replay"]["time_s"] for _ in range(2)]
    assert at_end[0] == at_end[1] == replay.scene()["replay"]["end_s"]


def test_missing_and_old_messages_are_not_shown_as_present(run: Path, tmp_path: Path) -> None:
    write_run(tmp_path, Script(duration_s=30.0, until_s=10.0))
    with ReplayBackend(tmp_path) as cut:
        before = at(cut, 0.5)
        assert "state" not in before["robots"][0]
        assert at(cut, 1e6)["robots"][0]["age_ms"] < 100.0  # the end is the last message
    with ReplayBackend(run) as whole:
        assert not any("silent" in alarm["text"] for alarm in at(whole, START_S + 10.0)["alarms"])


def test_all_lines_of_the_log_come_once(replay: ReplayBackend) -> None:
    notes = replay.notes()
    assert ("mission: running", pytest.approx(START_S, abs=0.5)) in [(note["text"], note["time_s"]) for note in notes]
    assert replay.notes() == []


def test_the_past_of_a_recorded_run_is_all_of_it(replay: ReplayBackend) -> None:
    rows = replay.past()
    times = [row["time_s"] for row in rows]
    assert times[0] <= 0.5 and times[-1] > replay.scene()["replay"]["end_s"] - 0.5
    np.testing.assert_allclose(np.diff(times), 0.25, atol=1e-9)
    assert "state" not in rows[0]["robots"][0]  # nothing was heard then
    for row in (row for row in rows if row["time_s"] > START_S + 0.1):
        for robot, shown in zip(row["robots"], at(replay, row["time_s"])["robots"], strict=True):
            assert robot["state"] == shown["state"]
            assert robot["age_ms"] == pytest.approx(shown["age_ms"], abs=0.5)  # rows count from the arrival


def test_the_other_run_is_aligned_by_its_own_start(run: Path, tmp_path: Path) -> None:
    write_run(tmp_path, Script(duration_s=30.0, clock=lambda since_s: since_s - 2.0))  # its robots set off 2 s later
    with ReplayBackend(run, tmp_path) as both:
        shown = at(both, START_S + 10.05)
        ghosts = {ghost["id"]: np.frombuffer(ghost["eta"], "<f4") for ghost in shown["ghosts"]}
        for robot in shown["robots"]:
            here = np.frombuffer(robot["state"]["estimate"]["eta"], "<f4")
            np.testing.assert_allclose(ghosts[robot["id"]][:2], here[:2], atol=1e-3)


def test_each_camera_has_its_recorded_picture(tmp_path: Path) -> None:
    """Also in a log with pictures of the first camera alone."""
    experiment = load_experiment("two-cameras")
    (tmp_path / "experiment.toml").write_text(dump_experiment(experiment))
    recorder = Recorder(tmp_path / "run.mcap", "", {})
    for k in range(20):
        for number, name in enumerate(("west", "east") if k < 10 else ("west",)):
            topic = topics.PREVIEW.of_camera(name)
            header, jpeg = Header(1 + number, k + 1, k * SECOND // 5), f"{name} {k}".encode()
            recorder.put(topic, f"shoal/{topic.name}", header, encode(Preview(jpeg)), k * SECOND // 5)
    recorder.put(topics.STATE, "shoal/robot/1/state", Header(3, 1, 0), encode(RobotState()), 8 * SECOND)
    recorder.close()
    with ReplayBackend(tmp_path) as backend:
        assert [camera["name"] for camera in backend.scene()["cameras"]] == ["west", "east"]
        backend.seek(1.1, 0.0)
        shown = {name: backend.picture(name, -1) for name in ("west", "east")}
        assert {name: picture and picture.jpeg for name, picture in shown.items()} == {"west": b"west 5", "east": b"east 5"}
        east = shown["east"]
        assert east is not None and east.age_ms == pytest.approx(100.0) and east.time_s == pytest.approx(1.0)
        assert backend.picture("east", east.stamp_ns) is None  # it is shown already
        backend.seek(7.9, 0.0)
        assert backend.picture("east", east.stamp_ns) is None


def test_an_ended_run_is_followed_by_what_is_offered_and_can_be_flown(run: Path, replay: ReplayBackend) -> None:
    assert replay.choose("again", None) == ["this is not possible here"]
    with ReplayBackend(run, offers=("again", "edited")) as ended:
        assert ended.snapshot()["replay"]["time_s"] == pytest.approx(ended.scene()["replay"]["end_s"])
        assert ended.choose("edited", Edit(scale=0.1))  # too near one another
        assert ended.choice is None
        assert ended.choose("edited", Edit(duration_s=3.0)) == []
        assert ended.choice is not None and ended.choice.experiment is not None
        assert ended.choice.experiment.duration_s == 3.0
        assert ended.choose("again", None) == ["edited was chosen before"]  # another page's


def test_a_recorded_run_takes_no_orders(replay: ReplayBackend) -> None:
    assert replay.station.request(CommandKind.STOP) == ("this is a recorded run", 0)


def test_a_folder_without_a_run_is_refused_by_name(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"run\.mcap"):
        ReplayBackend(tmp_path)


def test_of_a_run_that_was_cut_off_a_copy_is_mended(run: Path, tmp_path: Path) -> None:
    whole = (run / "run.mcap").read_bytes()
    cut = whole[: len(whole) * 2 // 3]
    (tmp_path / "run.mcap").write_bytes(cut)
    (tmp_path / "experiment.toml").write_bytes((run / "experiment.toml").read_bytes())
    with ReplayBackend(tmp_path) as backend:
        assert at(backend, START_S + 3.0)["robots"][0]["state"]["trajectory_s"] == pytest.approx(3.0, abs=0.06)
    assert (tmp_path / "run.mcap").read_bytes() == cut  # a recorder may still be writing it


def test_a_run_that_never_flew_begins_with_the_first_word(tmp_path: Path) -> None:
    write_run(tmp_path, Script(duration_s=5.0, started=False))
    with ReplayBackend(tmp_path) as backend:
        assert backend.snapshot()["robots"][0]["state"]["mode"] == "DISARMED"


def test_alarms_are_those_that_were(tmp_path: Path) -> None:
    """A bad link, a clock that is off, a plan that is old: in flight robot 2 has each for a while."""
    experiment = load_experiment("pool")
    (tmp_path / "experiment.toml").write_text(dump_experiment(experiment))
    recorder = Recorder(tmp_path / "run.mcap", "", {})
    for k in range(800):
        since_s = 0.05 * k
        lost, off_ns = 10.0 <= since_s < 16.0 and k % 2, 100_000_000 if since_s >= 30.0 else 0
        for robot in (1, 2):
            bad = robot == 2
            stamp_ns = k * 50_000_000 + 10**18
            state = RobotState(
                mode=Mode.TRACKING,
                experiment_hash=experiment.hash,
                trajectory_s=since_s,
                board=BoardReading(battery_v=12.0),
                timing=StepTiming(step_us=18_000.0, board_age_ms=20.0),
            )
            for topic, message in ((topics.STATE, state), (topics.PLAN, Plan(0.05))):
                if bad and (lost or (topic is topics.PLAN and 20.0 <= since_s < 24.0)):
                    continue
                header = Header(robot, k + 1, stamp_ns + (off_ns if bad else 0))
                key = f"shoal/{topic.key(robot)}"
                recorder.put(topic, key, header, encode(message), stamp_ns + 20_000_000)
    recorder.close()

    def keys(replay: ReplayBackend, time_s: float) -> set[str]:
        return {alarm["key"] for alarm in at(replay, time_s)["alarms"] if alarm["key"].split(":")[-1] in KINDS}

    with ReplayBackend(tmp_path) as backend:
        for time_s in (34.9, 15.0, 22.0, 8.0):  # forth and back
            expected = {15.0: {"2:link"}, 22.0: {"2:plan"}, 34.9: {"2:clock"}}.get(time_s, set())
            assert keys(backend, time_s) == expected, time_s


KINDS = {"link", "clock", "plan"}


def test_a_robot_that_was_out_of_the_water_is_no_silent_one(tmp_path: Path) -> None:
    experiment = load_experiment("pool")
    (tmp_path / "experiment.toml").write_text(dump_experiment(experiment))
    recorder = Recorder(tmp_path / "run.mcap", "", {})
    for k in range(40):
        stamp_ns = k * 50_000_000 + 10**18
        beat = encode(StationHeartbeat(mission="DEGRADED", out=(2,)))
        recorder.put(topics.HEARTBEAT, f"shoal/{topics.HEARTBEAT.key()}", Header(9, k + 1, stamp_ns), beat, stamp_ns)
    recorder.close()
    with ReplayBackend(tmp_path) as backend:
        assert [alarm["key"] for alarm in at(backend, 1.0)["alarms"] if alarm["robot"] == 2] == ["2:out"]


@pytest.mark.parametrize("behind_s", [0.0, 20.0, -20.0])
def test_a_line_of_an_earlier_run_is_shown_at_its_own_time(tmp_path: Path, behind_s: float) -> None:
    """A robot's program outlives a station's, and the next station gets its lines of before. By its own clock they may be new;
    and a line that a robot keeps in a gap of its radio is shown where it belongs, too."""
    (tmp_path / "experiment.toml").write_text(dump_experiment(load_experiment("pool")))
    recorder, behind_ns, zero_ns = Recorder(tmp_path / "run.mcap", "", {}), round(behind_s * 1e9), 10**18

    def put(session: int, source: str, number: int, since_s: float, arrived_s: float) -> None:
        header = Header(session, number, zero_ns + round(since_s * 1e9) - (behind_ns if session == 1 else 0))
        event = Event(2, source, f"{source} at {since_s:g}")
        recorder.put(topics.EVENT, "shoal/event", header, encode(event), zero_ns + round(arrived_s * 1e9))

    put(7, "groundstation", 1, 0.0, 0.001)
    for number, since_s in enumerate((-3600.0, -20.0, 0.7), start=1):
        put(1, "agent-1", number, since_s, 0.9)
    for k in range(20, 300):
        if not 100 <= k < 200:
            header = Header(1, k + 1, zero_ns + k * 50_000_000 - behind_ns)
            recorder.put(
                topics.STATE, "shoal/robot/1/state", header, encode(RobotState()), zero_ns + k * 50_000_000 + 2_000_000
            )
    for session, source, topic, message in (
        (2, "sim-bridge", topics.TRUTH, Truth()),
        (3, "localizer", topics.LOCALIZER, LocalizerStatus()),
    ):
        put(session, source, 1, -30.0, 0.9)
        put(session, source, 2, 14.0, 14.1)
        for k in range(20, 300):
            stamp_ns = zero_ns + k * 50_000_000
            recorder.put(
                topic, f"shoal/{topic.key()}", Header(session, k + 1, stamp_ns), encode(message), stamp_ns + 2_000_000
            )
    put(1, "agent-1", 5, 7.0, 10.1)
    put(1, "agent-1", 6, 14.0, 14.1)
    put(7, "groundstation", 2, 14.2, 14.201)
    recorder.close()
    with ReplayBackend(tmp_path) as backend:
        notes = {note["text"]: note["time_s"] for note in backend.notes()}
    expected = {"groundstation at 0": 0.0, "agent-1 at -3600": -3600.0, "agent-1 at -20": -20.0, "agent-1 at 0.7": 0.9}
    expected |= {"agent-1 at 7": 7.0, "agent-1 at 14": 14.1, "groundstation at 14.2": 14.2}
    for source in ("sim-bridge", "localizer"):
        expected |= {f"{source} at -30": -30.0, f"{source} at 14": 14.1}
    assert notes == pytest.approx(expected, abs=0.01)


def test_the_map_shows_what_was_flown_at_the_time(run: Path, tmp_path: Path) -> None:
    """Of a later leg only what is new: the way home is not drawn over the circle."""
    experiment = load_experiment(str(run / "experiment.toml"))
    (tmp_path / "experiment.toml").write_text(dump_experiment(experiment))
    recorder = Recorder(tmp_path / "run.mcap", "", {})
    planned = plan(experiment)
    line = np.linspace(planned[1].eta[200], np.zeros(4), 100)
    rest = np.zeros((100, 4))
    segment = Trajectory("home", planned[1].period_s, line, rest, rest, begin_s=200 * planned[1].period_s)
    for begin_s, robot, trajectory in ((0, 1, planned[1]), (0, 2, planned[2]), (10, 1, concatenate(planned[1], segment))):
        key = f"shoal/{topics.TRAJECTORY.key(robot)}"
        recorder.put(topics.TRAJECTORY, key, Header(1, begin_s + robot, 0), encode(trajectory), begin_s * SECOND)
    recorder.put(topics.STATE, "shoal/robot/1/state", Header(2, 1, 0), encode(RobotState()), 20 * SECOND)
    recorder.close()
    with ReplayBackend(tmp_path) as backend:
        shown: dict[float, dict[int, Any]] = {}
        for time_s in (5.0, 15.0):
            backend.seek(time_s, 0.0)
            paths = backend.paths()
            assert paths is not None
            shown[time_s] = {path["robot"]: path for path in paths}
            assert backend.paths() is None  # once
            assert backend.scene()["paths"] == paths  # also for a page that comes now
        assert [shown[5.0][r]["id"] for r in (1, 2)] == [planned[r].id for r in (1, 2)]
        assert (shown[15.0][1]["id"], shown[15.0][2]["id"]) == ("home", planned[2].id)
        home = np.frombuffer(shown[15.0][1]["eta"], "<f4").reshape(-1, 4)
        np.testing.assert_allclose(home[[0, -1]], line[[1, -1]], atol=1e-5)  # its first point is still the circle's


@pytest.mark.long
def test_time_0_of_a_replay_is_the_reports(replay: ReplayBackend) -> None:
    assert replay.snapshot()["began_s"] == pytest.approx(START_S, abs=0.01)
