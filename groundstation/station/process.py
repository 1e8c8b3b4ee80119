"""SHELL: the ground station's process: log, page and viewers around the station, and the time of its next cycle.

By the wall clock a cycle a control period, at once after a request that cannot wait; in lockstep one a tick,
when all messages of that tick have come.
"""

import contextlib
import time
from collections.abc import Generator
from pathlib import Path

from groundstation.export.foxglove_live import ViewerServer
from groundstation.logs.recorder import Recorder, check_room, run_metadata
from groundstation.mission.gain_update import GainUpdater
from groundstation.mission.lap_statistics import LapStatistics
from groundstation.mission.mission import Mission
from groundstation.mission.state_machine import TERMINAL, MissionState
from groundstation.planning import planner
from groundstation.planning.segment import first_segment
from groundstation.station.station import Station, workers
from groundstation.telemetry import subscribe_fleet
from groundstation.web.live_backend import LiveBackend
from groundstation.web.server import WebServer, bind
from wire.config.experiment import Experiment, load_experiment
from wire.messages import topics
from wire.messages.codec import Header
from wire.messages.messages import Order
from wire.messages.topics import WHOLE_FLEET
from wire.process.lockstep import Lockstep, LockstepClock
from wire.process.output_files import replace_text
from wire.process.runtime import Clock, Stop, WallClock, log, log_to_bus
from wire.security.access_control import INSECURE
from wire.toml_loader import ConfigError, os_errors_as_config_errors
from wire.transport.bus import Bus
from wire.web_access import WebOptions

REST_WITHIN_S = 5.0  # of robots that hold because the station is told to end
DISARM_WITHIN_S = 2.0  # of robots that rest then
FAREWELL_S = 1.0  # a page gets four states in this time, a terminal asks five times


def record_everything(bus: Bus, recorder: Recorder, clock: Clock) -> None:
    """Feed every recorded topic of the bus to the recorder, bytes unchanged."""

    def arrival_ns(header: Header) -> int:
        return header.stamp_ns if isinstance(clock, LockstepClock) else clock.now_ns()

    known = (*topics.TOPICS, *(topic.of_camera("*") for topic in topics.OF_CAMERAS))
    recorder.gather([bus.collect(topic) for topic in known if topic.recorded], arrival_ns)


def cycles(
    experiment: Experiment,
    experiment_toml: str,
    bus: Bus,
    run_dir: Path,
    *,
    automatic: bool,
    lockstep: bool,
    stop: Stop,
    web: WebOptions | None = None,
    insecure: bool = False,
    viewer: tuple[str, int] | None = None,
) -> Generator[None, None, bool]:
    """The station until its mission is over (automatic) or it is told to stop; `viewer` is where Foxglove-family viewers are
    served. Makes `run_dir`. Returns whether the mission succeeded.

    In lockstep yields when the station is present, and after each cycle; `next` waits for a tick unless it is there already.
    """
    clock: Clock = LockstepClock() if lockstep else WallClock()
    segment = first_segment(experiment)
    trajectories = dict(segment.trajectories)
    starts = planner.start_poses(experiment, trajectories)
    mode = "lockstep" if lockstep else "real-time"
    metadata = run_metadata(experiment, mode)
    stop_below = round(experiment.recording.stop_video_below_gb * 1e9)
    check_room(run_dir, experiment.recording.min_free_gb)
    # The router listens, the plan stands, page and viewers have their ports: a start that fails leaves no folder.
    with contextlib.ExitStack() as served:
        page = served.enter_context(bind(web)) if web is not None else None
        if viewer is not None:
            served.enter_context(ViewerServer(experiment, bus, clock, *viewer))
        with os_errors_as_config_errors(run_dir):
            run_dir.mkdir(parents=True, exist_ok=True)
            _write_experiment(run_dir / "experiment.toml", experiment, experiment_toml)
            recorder = Recorder(run_dir / "run.mcap", experiment_toml, metadata, stop_below)
        recorder.whole_until_ns = -1 if lockstep else None
        served.callback(recorder.close)
        record_everything(bus, recorder, clock)
        threads = served.enter_context(workers(len(trajectories)))
        mission = Mission(experiment, segment, starts, automatic)
        heard, tuner = subscribe_fleet(bus, experiment.robot_ids), GainUpdater(experiment)
        laps = LapStatistics(tuner.lap_s)
        station = Station(experiment, bus, clock, recorder, mission, tuner, laps, heard, threads, starts, insecure=insecure)
        station.seen = station.fleet()
        bus.serve(WHOLE_FLEET, station.on_operator_command)
        log_to_bus(bus, clock, "groundstation")
        if insecure:
            log.warning(INSECURE)  # once more: now the recorder has it
        station.publish_paths(clock.now_ns())
        bus.watch_presence()
        if web is not None:
            backend = LiveBackend(experiment, trajectories, bus, heard, clock, station, mode, run_dir.resolve())
            served.enter_context(WebServer(backend, web, page))
            log.info("operator page: %s", web.url)
        if viewer is not None:
            log.info("viewers: ws://%s:%d", *viewer)
        ticks = Lockstep(bus, stop, clock) if isinstance(clock, LockstepClock) else None
        bus.announce("groundstation")
        started_s = time.monotonic()
        if ticks is not None:
            yield from _lockstep_cycles(station, ticks)
        else:
            _wall_loop(station, stop)
        log.info("mission %s after %.1f s", mission.state.value, time.monotonic() - started_s)
        recorder.close()
        if recorder.error:  # also of the log's end, which nobody else tells
            log.error("recorder: %s", recorder.error)
        return mission.verdict is MissionState.DONE and not recorder.error


def _write_experiment(file: Path, loaded: Experiment, text: str) -> None:
    """Write the experiment into the run's folder. A file that a launcher has put there stays; raises ConfigError if it holds
    another experiment."""
    if not file.exists():
        replace_text(file, text)
    elif load_experiment(str(file)).hash != loaded.hash:
        raise ConfigError(f"{file}: is there already, is another experiment, and would be lost (allowed: a new folder)")


class _End:
    """End of the run: of an automatic mission by itself, of any other at a request. Then pages and terminals are told for
    FAREWELL_S."""

    def __init__(self, station: Station) -> None:
        self._station = station
        self._since_s = 0.0

    def reached(self) -> bool:
        """True if the loop is to be left."""
        station, now_s = self._station, time.monotonic()
        if station.ended and not self._since_s:
            self._since_s = now_s
        if station.ended:
            return now_s - self._since_s > FAREWELL_S
        return station.mission.automatic and station.mission.state in TERMINAL


class _Leaving:
    """End of a station that is told to end while robots have power: they hold, and are disarmed when they rest."""

    def __init__(self, station: Station) -> None:
        self._station, self._until_s, self._disarms = station, 0.0, False

    def over(self) -> bool:
        """True if the station may end now."""
        station, now_s = self._station, time.monotonic()
        if not self._until_s:
            self._until_s = now_s + REST_WITHIN_S
            if station.has_power():
                log.warning("told to end while robots have power: they hold, and are disarmed when they rest")
        if not self._disarms and (not station.come_to_rest() or now_s > self._until_s):
            self._disarms, self._until_s = True, now_s + DISARM_WITHIN_S
            if station.has_power():
                station.request(Order.END)
        return self._disarms and (not station.has_power() or now_s > self._until_s)


def _wall_loop(station: Station, stop: Stop) -> None:
    period_ns = round(station.experiment.controller.period_s * 1e9)
    due_ns, end, leaving = time.monotonic_ns(), _End(station), _Leaving(station)
    while not stop.requested or not leaving.over():
        station.wake.clear()
        station.cycle(station.clock.now_ns(), lockstep=False)
        if end.reached():
            return
        now_ns = time.monotonic_ns()
        if now_ns >= due_ns:
            due_ns = max(due_ns + period_ns, now_ns)
        station.wake.wait((due_ns - now_ns) * 1e-9)


def _lockstep_cycles(station: Station, lockstep: Lockstep) -> Generator[None]:
    heard, end = station.heard, _End(station)
    yield
    while (tick := lockstep.next()) is not None:
        # What the robots found in the step before, and where the picture shows them.
        up_to_ns = lockstep.await_sight(tick, heard.localizer, heard.poses, heard.obstacles)
        if up_to_ns is None or not lockstep.await_all([(heard.states[r], tick.previous_ns) for r in tick.robots]):
            return
        station.recorder.whole_until_ns = tick.previous_ns  # whenever it ends: no step of which some robots are missing
        station.obstacles_up_to_ns = up_to_ns
        station.cycle(tick.now_ns, lockstep=True)
        if end.reached():
            return
        yield
