"""SHELL: the ground station's process: log, page and viewers around the station, and the time of its next cycle.

A cycle a control period, at once after a request that cannot wait; or when an owner of the time says so (sim_bridge/lockstep).
"""

import contextlib
import time
from collections.abc import Callable, Generator, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

from groundstation.export.foxglove_live import ViewerServer
from groundstation.logs.recorder import Recorder, check_room, run_metadata
from groundstation.mission.gain_update import GainUpdater
from groundstation.mission.mission import Mission, may_have_power
from groundstation.mission.request_progress import UNARMED
from groundstation.mission.state_machine import TERMINAL, MissionState
from groundstation.planning import planner
from groundstation.planning.segment import first_segment
from groundstation.station.station import Station, workers
from groundstation.telemetry import subscribe_fleet
from groundstation.web.live_backend import LiveBackend
from groundstation.web.server import WebServer, bind
from shoal.bus.access_control import INSECURE
from shoal.bus.bus import Bus
from shoal.config.experiment import Experiment, dump_experiment, load_experiment
from shoal.errors import ConfigError, os_errors_as_config_errors
from shoal.messages import topics
from shoal.messages.messages import WHOLE_FLEET
from shoal.runtime.output_files import PAGE_OPEN, replace_text
from shoal.runtime.runtime import Clock, Stop, WallClock, log, log_to_bus
from shoal.runtime.version import code
from shoal.runtime.web_access import WebOptions

REST_WITHIN_S = 5.0  # of robots that hold because the station is told to end
DISARM_WITHIN_S = 2.0  # of robots that rest then
FAREWELL_S = 1.0  # a page gets four states in this time, a terminal asks five times
IDLE_S = 600.0  # without a request, then a run that a person has taken over is ended: time to fetch a robot from the water
IDLE_ALONE_S = 60.0  # the same while no page is open: time for the next command in a terminal
# groundstation/analysis/cause.py knows both
INTERRUPTED = "interrupted: Ctrl-C in the terminal"
TERMINATED = "interrupted: by another program, or its terminal was closed"


class TimeOwner(NamedTuple):
    """Another program that owns the time: its clock, and the instants of the cycles that it calls for (ns)."""

    clock: Clock
    instants: Callable[[Station], Iterable[int]]


def record_everything(bus: Bus, recorder: Recorder, clock: Clock) -> None:
    """Feed every recorded topic of the bus to the recorder, bytes unchanged."""
    every = (*topics.TOPICS, *(topic.of_camera("*") for topic in topics.OF_CAMERAS))
    recorder.gather(
        [bus.collect(topic) for topic in every if topic.recorded], lambda header: clock.arrival_ns(header.stamp_ns)
    )


@dataclass(frozen=True)
class StationOptions:
    """Options of a run of the station, as a person sets them."""

    automatic: bool = False  # the mission starts by itself, once all is fit
    give_up_s: float | None = None  # time without progress after which an automatic mission fails
    web: WebOptions | None = None  # the operator's page
    viewer: tuple[str, int] | None = None  # where Foxglove-family viewers are served
    insecure: bool = False  # the bus is open to everybody, and the station says so


def cycles(
    experiment: Experiment, bus: Bus, run_dir: Path, options: StationOptions, stop: Stop, owner: TimeOwner | None = None
) -> Generator[None, None, bool]:
    """The station until its run is over (EndOfRun) or it is told to stop. Makes `run_dir`. Returns whether the mission
    succeeded.

    With an `owner` of the time yields when the station is present, and after each cycle; `next` waits for the next instant.
    """
    experiment_toml = dump_experiment(experiment)
    clock: Clock = owner.clock if owner is not None else WallClock()
    segment = first_segment(experiment)
    trajectories = dict(segment.trajectories)
    starts = planner.start_poses(experiment, trajectories)
    mode = "lockstep" if clock.waits else "real-time"
    metadata = run_metadata(experiment, mode)
    stop_below = round(experiment.recording.stop_video_below_gb * 1e9)
    check_room(run_dir, experiment.recording.min_free_gb)
    # The router listens, the plan stands, page and viewers have their ports: a start that fails leaves no folder.
    with contextlib.ExitStack() as served:
        page = served.enter_context(bind(options.web)) if options.web is not None else None
        if options.viewer is not None:
            served.enter_context(ViewerServer(experiment, bus, clock, *options.viewer))
        with os_errors_as_config_errors(run_dir):
            run_dir.mkdir(parents=True, exist_ok=True)
            _write_experiment(run_dir / "experiment.toml", experiment, experiment_toml)
            recorder = Recorder(run_dir / "run.mcap", experiment_toml, metadata, stop_below)
        recorder.whole_until_ns = -1 if clock.waits else None
        served.callback(recorder.close)
        record_everything(bus, recorder, clock)
        threads = served.enter_context(workers(len(trajectories)))
        mission = Mission(experiment, segment, starts, options.automatic, options.give_up_s)
        inboxes, tuner = subscribe_fleet(bus, experiment.robot_ids), GainUpdater(experiment)
        station = Station(experiment, bus, clock, recorder, mission, tuner, inboxes, threads, insecure=options.insecure)
        station.views = station.fleet()
        bus.serve(WHOLE_FLEET, station.on_operator_command, expires=True)
        log_to_bus(bus, clock, "groundstation")
        log.info("%s", code())
        if options.insecure:
            log.warning(INSECURE)  # once more: now the recorder has it
        station.publish_paths(clock.now_ns())
        bus.watch_presence()
        server = None
        if options.web is not None:
            backend = LiveBackend(experiment, trajectories, bus, inboxes, clock, station, mode, run_dir.resolve())
            server = served.enter_context(WebServer(backend, options.web, page))
            log.info("operator page: %s", options.web.url)
        if options.viewer is not None:
            log.info("viewers: ws://%s:%d", *options.viewer)
        instants = owner.instants(station) if owner is not None else None
        bus.announce("groundstation")
        started_ns = clock.now_ns()
        end = EndOfRun(station, server)
        if instants is not None:
            yield from _cycles_at(instants, station, end)
            if not station.ended:
                _tell_interruption(stop)
        else:
            _wall_loop(station, stop, end)
        _conclude(station, server, stop, run_dir)
        log.info("mission %s; the station ran for %.1f s", mission.state.value, (clock.now_ns() - started_ns) * 1e-9)
        recorder.close()
        if recorder.error:  # also of the log's end, which nobody else tells
            log.error("recorder: %s", recorder.error)
        return mission.verdict is MissionState.DONE and not recorder.error


def _conclude(station: Station, server: WebServer | None, stop: Stop, run_dir: Path) -> None:
    """End the run at a person's Ctrl-C, warn of robots that are left with power, and mark the run's folder if a page is open:
    it is to show the ended run next."""
    if stop.interrupted:
        station.core.ended = True
    left = [str(robot) for robot, view in station.views.items() if may_have_power(view)]
    if left and not station.clock.waits:  # else the simulator ends with its robots
        log.warning(
            "robot %s may still have power: without this station it is neutral after %g s",
            ", ".join(left), station.experiment.safety.station_neutral_s,
        )  # fmt: skip
    if server is not None and server.watched:
        with contextlib.suppress(OSError):  # a full disk: the run has ended all the same
            (run_dir / PAGE_OPEN).touch()


def _tell_interruption(stop: Stop) -> None:
    """Record that the program was told to end, and by whom."""
    if stop.requested and not stop.failure:
        log.info(INTERRUPTED if stop.interrupted else TERMINATED)


def _write_experiment(file: Path, loaded: Experiment, text: str) -> None:
    """Write the experiment into the run's folder. A file that a launcher has put there stays; raises ConfigError if it holds
    another experiment."""
    if not file.exists():
        replace_text(file, text)
    elif load_experiment(str(file)).hash != loaded.hash:
        raise ConfigError(f"{file}: is there already, is another experiment, and would be lost (allowed: a new folder)")


class EndOfRun:
    """End of the run: at a request; of an automatic mission also by itself, and once it was left alone for long after a person
    stopped the fleet or sent it back. After a request pages and terminals are told for FAREWELL_S."""

    def __init__(self, station: Station, server: WebServer | None) -> None:
        self._station, self._server = station, server
        self._since_s = 0.0
        self._rests_since_s: float | None = None

    def reached(self) -> bool:
        """True if the loop is to be left."""
        core, now_s = self._station.core, time.monotonic()
        if core.ended:
            self._since_s = self._since_s or now_s
            return now_s - self._since_s > FAREWELL_S
        if core.mission.automatic:
            core.ended = self._left_alone(now_s) if core.by_hand else core.mission.state in TERMINAL
        return core.ended

    def _left_alone(self, now_s: float) -> bool:
        """True if every robot in the water is heard and at rest, none that is out of it may have power, and nobody has asked
        for anything for the idle time."""
        station = self._station
        robots = station.views.values()
        rest = all((view.heard or view.out) and not may_have_power(view) for view in robots)
        at_rest = station.mission.state in UNARMED and rest
        if not at_rest:
            self._rests_since_s = None
            return False
        if self._rests_since_s is None:
            self._rests_since_s = now_s
            log.info(
                "the run goes on until a person ends it (End run, groundstation end), or asks for nothing for %.0f s "
                "(%.0f s while no page is open)",
                IDLE_S,
                IDLE_ALONE_S,
            )
        idle_s = IDLE_S if self._server is not None and self._server.watched else IDLE_ALONE_S
        if now_s - max(self._rests_since_s, station.asked_s) <= idle_s:
            return False
        log.info("the run is ended: nobody has asked for anything for %.0f s", idle_s)
        return True


class _Leaving:
    """End of a station that is told to end while robots have power: they hold, and are disarmed when they rest."""

    def __init__(self, station: Station, stop: Stop) -> None:
        self._station, self._stop, self._until_s, self._disarms = station, stop, 0.0, False

    def over(self) -> bool:
        """True if the station may end now."""
        station, now_s = self._station, time.monotonic()
        if not self._until_s:
            self._until_s = now_s + REST_WITHIN_S
            _tell_interruption(self._stop)
            if station.has_power():
                log.warning("told to end while robots have power: they hold, and are disarmed when they rest")
        rests = not station.has_power() and station.mission.state in UNARMED  # else it may be arming robots
        if not self._disarms and (not station.come_to_rest() or now_s > self._until_s):
            self._disarms, self._until_s = True, now_s + DISARM_WITHIN_S
            if not rests:
                station.disarm()
        return self._disarms and (rests or now_s > self._until_s)


def _wall_loop(station: Station, stop: Stop, end: EndOfRun) -> None:
    """Run a cycle of the station each control period, and earlier when it is woken, until the run is over."""
    period_ns = round(station.experiment.controller.period_s * 1e9)
    due_ns, leaving = time.monotonic_ns(), _Leaving(station, stop)
    while not stop.requested or not leaving.over():
        station.wake.clear()
        station.cycle(station.clock.now_ns())
        if end.reached():
            return
        now_ns = time.monotonic_ns()
        if now_ns >= due_ns:
            due_ns = max(due_ns + period_ns, now_ns)
        station.wake.wait((due_ns - now_ns) * 1e-9)


def _cycles_at(instants: Iterable[int], station: Station, end: EndOfRun) -> Generator[None]:
    """Do a cycle of the station at each instant, and yield after it, until the run ends."""
    yield
    for now_ns in instants:
        station.cycle(now_ns)
        if end.reached():
            return
        yield
