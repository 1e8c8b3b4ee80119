"""The station's process, from its folder to its verdict: in simulated time, on a bus in memory, with nobody there."""

import errno
import logging
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import pytest

from groundstation.logs.reader import read_log
from groundstation.logs.recorder import Recorder
from groundstation.mission.state_machine import MissionState
from groundstation.station import process
from groundstation.station.process import EndOfRun, StationOptions, TimeOwner
from groundstation.station.station import Station
from groundstation.telemetry import RobotView
from shoal.bus.access_control import INSECURE
from shoal.bus.bus import Bus
from shoal.bus.memory_transport import MemoryHub, MemoryTransport
from shoal.config.experiment import dump_experiment, load_experiment
from shoal.errors import ConfigError
from shoal.messages import topics
from shoal.messages.messages import Command, CommandKind, Mode, RobotState, Tick
from shoal.runtime.output_files import PAGE_OPEN
from shoal.runtime.runtime import Stop, WallClock, log
from sim_bridge.lockstep.clock import LockstepClock

POOL = load_experiment("pool")
STEP_NS = 50_000_000
PLAIN = StationOptions()


@pytest.fixture(autouse=True)
def _same_log() -> Iterator[None]:
    """A station sends lines of the log as events, by a handler that stays."""
    before = list(log.handlers)
    yield
    log.handlers[:] = before


class _Run:
    """A station's run, whose time the test owns."""

    def __init__(self, folder: Path, options: StationOptions = PLAIN, settings: Iterable[str] = ()) -> None:
        self.hub, self.folder, self.stop, self.clock = MemoryHub(), folder, Stop(install=False), LockstepClock()
        self.other = Bus(MemoryTransport(self.hub))
        self.other.watch_presence()
        self.station: Station | None = None
        experiment = load_experiment("pool", list(settings))
        owner = TimeOwner(self.clock, self._instants)
        self.steps = process.cycles(experiment, Bus(MemoryTransport(self.hub)), folder, options, self.stop, owner)

    def _instants(self, station: Station) -> Iterable[int]:
        self.station = station
        return self._ticks()

    def _ticks(self) -> Iterator[int]:
        while not self.stop.requested:
            self.clock.tick_ns += STEP_NS
            yield self.clock.tick_ns

    def verdict(self) -> bool:
        """Of the run, to its end."""
        while True:
            try:
                next(self.steps)
            except StopIteration as end:
                return bool(end.value)


def test_the_station_is_present_when_it_can_be_asked_and_its_log_has_what_was_said(tmp_path: Path) -> None:
    run = _Run(tmp_path / "a" / "run")
    next(run.steps)
    assert "groundstation" in run.other.present
    reply = run.other.command(Command(CommandKind.HOLD, 0), 0, 1.0)
    assert not reply.silent and not reply.accepted
    next(run.steps)
    run.other.publish(topics.STATE, RobotState(fault="leak"), run.clock.tick_ns, 1)
    assert run.station is not None and run.station.recorder.whole_until_ns == -1, "nothing is whole yet"
    run.station.recorder.whole_until_ns = run.clock.tick_ns
    run.other.publish(topics.STATE, RobotState(fault="later than what is whole"), run.clock.tick_ns + 1, 1)
    run.other.publish(topics.TICK, Tick(0, 0, 0), 1)
    next(run.steps)
    run.stop.request()
    assert run.verdict() is False
    content = read_log(run.folder / "run.mcap")
    assert content.complete and content.ended and content.metadata["mode"] == "lockstep"
    states = [
        message
        for (topic, robot), kept in content.entries.items()
        if (topic, robot) == (topics.STATE.name, 1)
        for message in kept
    ]
    assert [entry.message.fault for entry in states] == ["leak"]
    assert not any(topic == topics.TICK.name for topic, _ in content.entries), "not recorded"
    assert {robot for topic, robot in content.entries if topic == topics.TRAJECTORY.name} == {1, 2}
    assert load_experiment(str(run.folder / "experiment.toml")).hash == POOL.hash
    assert not (run.folder / PAGE_OPEN).exists(), "no page was open"


@pytest.mark.parametrize("interrupted", [False, True])
def test_a_persons_interruption_is_told_and_ends_the_run(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, interrupted: bool
) -> None:
    run = _Run(tmp_path)
    next(run.steps)
    run.stop.request(interrupted=interrupted)
    with caplog.at_level(logging.INFO, "shoal"):
        assert run.verdict() is False
    assert run.station is not None and run.station.ended is interrupted
    assert (process.INTERRUPTED in caplog.messages) is interrupted
    assert any(message.startswith("mission waiting") for message in caplog.messages) or "mission" in caplog.text


@pytest.mark.parametrize(("mode", "is_told"), [(Mode.HOLDING, True), (Mode.DISARMED, False)])
def test_a_station_that_leaves_names_the_robots_that_it_leaves_with_power(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, mode: Mode, is_told: bool
) -> None:
    """They did not do in time what it told them at its end."""
    run = _Run(tmp_path)
    next(run.steps)
    assert run.station is not None
    run.station.clock = WallClock()  # as of robots that live on
    run.station.views = {1: RobotView(RobotState(mode), 0.1), 2: RobotView(RobotState(), 0.1)}
    run.stop.request()
    run.verdict()
    words = f"robot 1 may still have power: without this station it is neutral after {POOL.safety.station_neutral_s:g} s"
    assert (words in caplog.messages) is is_told


def test_an_open_network_is_told_once_more_when_the_log_has_begun(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    for insecure in (False, True):
        caplog.clear()
        run = _Run(tmp_path / str(insecure), StationOptions(insecure=insecure))
        next(run.steps)
        assert (INSECURE in caplog.messages) is insecure
        run.stop.request()
        run.verdict()


@pytest.mark.parametrize(
    ("state", "error", "done"), [("DONE", "", True), ("DONE", "log stopped", False), ("FAILED", "", False)]
)
def test_a_run_is_a_success_if_its_mission_is_done_and_its_log_whole(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture, state: str, error: str, done: bool
) -> None:
    run = _Run(tmp_path, StationOptions(automatic=True))
    next(run.steps)
    assert run.station is not None and run.station.mission.automatic
    run.station.mission.state = MissionState[state]
    run.station.mission.verdict = MissionState[state]
    run.stop.request()
    monkeypatch.setattr(Recorder, "error", error)
    assert run.verdict() is done
    assert (f"recorder: {error}" in caplog.messages) is bool(error)


def test_a_folder_that_holds_another_experiment_is_refused_and_the_same_one_stays(tmp_path: Path) -> None:
    file = tmp_path / "experiment.toml"
    file.write_text("# mine\n" + dump_experiment(POOL), encoding="utf-8")
    run = _Run(tmp_path)
    next(run.steps)
    run.stop.request()
    run.verdict()
    assert file.read_text(encoding="utf-8").startswith("# mine\n")
    other = tmp_path / "other"
    other.mkdir()
    (other / "experiment.toml").write_text(dump_experiment(POOL), encoding="utf-8")
    with pytest.raises(ConfigError, match=r"experiment\.toml: is there already, is another experiment"):
        next(_Run(other, settings=["seed=7"]).steps)
    assert not (other / "run.mcap").exists()


def test_a_run_without_room_for_its_log_makes_no_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for free_gb, fits in ((2.0, True), (1.99, False)):
        monkeypatch.setattr("groundstation.logs.recorder.disk_free", lambda folder, free=free_gb: round(free * 1e9))
        run = _Run(tmp_path / f"{free_gb}" / "run", settings=["recording.min_free_gb=2"])
        if fits:
            next(run.steps)
            run.stop.request()
            run.verdict()
        else:
            with pytest.raises(ConfigError, match=r"1\.99 GB free, a run needs 2 "):
                next(run.steps)
        assert (run.folder / "run.mcap").exists() is fits


class _Page:
    """A page's server, watched or not."""

    watched = False


def _end(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, automatic: bool = True
) -> tuple[EndOfRun, Station, _Page, list[float]]:
    run = _Run(tmp_path, StationOptions(automatic=automatic))
    next(run.steps)
    assert run.station is not None
    now = [1000.0]
    monkeypatch.setattr("groundstation.station.process.time.monotonic", lambda: now[0])
    page: Any = _Page()
    run.station.views = {}
    run.station.asked_s = 0.0
    return EndOfRun(run.station, page), run.station, page, now


def test_a_run_that_was_ended_is_told_for_a_second(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    end, station, _, now = _end(tmp_path, monkeypatch, automatic=False)
    assert not end.reached()
    station.core.ended = True
    reached = []
    for at_s in (0.0, 1.0, 1.01):
        now[0] = 1000.0 + at_s
        reached.append(end.reached())
    assert reached == [False, False, True]


@pytest.mark.parametrize(("watched", "idle_s"), [(False, 60.0), (True, 600.0)])
def test_a_run_that_a_person_took_over_is_ended_when_nobody_asks_for_anything(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, watched: bool, idle_s: float
) -> None:
    end, station, page, now = _end(tmp_path, monkeypatch)
    page.watched, station.core.by_hand = watched, True
    station.mission.state = MissionState.PAUSED  # nobody is armed in it, but it may go on
    assert not end.reached()
    now[0] += 2.0 * idle_s
    station.mission.state = MissionState.WAITING
    assert not end.reached(), "it rests from now on"
    now[0] += 10.0
    station.asked_s = now[0]
    for at_s, over in ((idle_s, False), (idle_s + 0.1, True)):
        now[0] = station.asked_s + at_s
        assert end.reached() is over and station.ended is over


def test_an_automatic_run_ends_with_its_mission(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    end, station, _, _ = _end(tmp_path, monkeypatch)
    assert not end.reached()
    station.mission.state = MissionState.DONE
    assert end.reached() and station.ended


def test_a_log_that_cannot_be_written_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(*_: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device", str(tmp_path / "run.mcap"))

    monkeypatch.setattr(process, "Recorder", full)
    with pytest.raises(ConfigError, match="No space left on device"):
        next(_Run(tmp_path).steps)


def test_pictures_stop_at_the_experiments_limit_of_room(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    limits: list[int] = []

    def recorder(path: Path, toml: str, metadata: dict[str, str], stop_pictures_below: int) -> Recorder:
        limits.append(stop_pictures_below)
        return Recorder(path, toml, metadata, stop_pictures_below)

    monkeypatch.setattr(process, "Recorder", recorder)
    run = _Run(tmp_path, settings=["recording.stop_video_below_gb=0.003", "recording.min_free_gb=0.001"])
    next(run.steps)
    run.stop.request()
    run.verdict()
    assert limits == [3_000_000]
