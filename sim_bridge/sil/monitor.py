"""SHELL: the terminal's view of a run: a table of the robots, a progress bar, or lines for a log."""

import math
import textwrap
import time
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager

from rich.console import Console, Group, RenderableType
from rich.live import Live
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn
from rich.table import Table
from rich.text import Text

from groundstation.fleet_time import FleetTime, pace_in_words
from groundstation.formation_clock import FormationPlans
from shoal.bus.bus import Bus, Received
from shoal.config.experiment import Experiment
from shoal.messages import topics
from shoal.messages.codec import DecodeError, Header, decode
from shoal.messages.messages import Event, LocalizerStatus, Mode, RobotState, StationHeartbeat
from shoal.messages.topics import Topic

SAY_EVERY_S = 5.0  # s between lines of text, without a terminal to draw in
MISSION_LINE = "mission: "  # begins the station's line about its state
REASON_CHARS = 300  # of a reason: twenty robots may have one each, and the page has them all
FEW = 6  # robots that one line can name
SILENT_S = 3.0  # s of the fleet's time without a state after which a robot is silent
AT_REST = frozenset({"", "WAITING", "LOADING", "ARMING", "STOPPED", "DONE", "CANCELLED", "FAILED"})  # no flight is under way
WAITS = frozenset({"WAITING", "PAUSED", "STOPPED", "ABORTING", "FAILED"})  # states whose reason a person wants to read


class Monitor:
    """A view of the fleet through its own session, which only listens."""

    def __init__(self, experiment: Experiment, bus: Bus, pace: float | None = None) -> None:
        """`pace`: times real time that the run should keep up with; None: as fast as the machine can, or the wall clock."""
        self._experiment, self._wanted = experiment, pace
        self._states = bus.inboxes(topics.STATE, RobotState, experiment.robot_ids)
        self._heartbeat = bus.inbox(topics.HEARTBEAT, StationHeartbeat)
        self._time = FleetTime(self._heartbeat)
        self._reason = ""  # of the mission's state, as the station's log last gave it
        bus.subscribe(topics.EVENT, None, self._event)
        self._localizer = bus.inbox(topics.LOCALIZER, LocalizerStatus)
        self._progress = Progress(
            TextColumn("{task.description}", markup=False),
            BarColumn(),
            TextColumn("{task.fields[clock]}"),
            TextColumn("{task.fields[speed]}"),
            TimeElapsedColumn(),
        )
        self._task = self._progress.add_task(experiment.name, total=experiment.duration_s, speed="", clock="")
        self._flown_s, self._planned_s = 0.0, experiment.duration_s
        self._flew_s: float | None = None  # `time_s` when a flight was last under way

    @property
    def mission(self) -> str:
        """The mission's state as last heard."""
        heartbeat = self._heartbeat.newest()
        return heartbeat.message.mission if heartbeat is not None else "starting"

    @property
    def heartbeats(self) -> int:
        """Number of the station's cycles, as last heard; constant when the run is stuck."""
        header = self._heartbeat.newest_header()
        return header.sequence if header is not None else 0

    @property
    def flown_s(self) -> float:
        """Time along the formation's trajectory of the slowest robot that flies it now; while none does, the last one. The
        clock of a robot that fell out, or is led alone, stands."""
        states = [inbox.newest() for inbox in self._states.values()]
        if None in states:
            return self._flown_s
        reached = [s.message for s in states if s is not None and s.message.mode is Mode.TRACKING and not self._silent(s)]
        clocks_s = [clock_s for state in reached if (clock_s := FormationPlans().clock_s(state)) is not None]
        self._flown_s = min(clocks_s, default=self._flown_s)
        return self._flown_s

    @property
    def began_ns(self) -> int:
        """Instant at which the formation's flight began, or will begin, on the station's clock; 0 while it has not been
        started."""
        heartbeat = self._heartbeat.newest()
        return heartbeat.message.began_ns if heartbeat is not None else 0

    @property
    def time_s(self) -> float | None:
        """Time since then, negative just before; None while it has not been started."""
        heartbeat = self._heartbeat.newest()
        if heartbeat is None or not heartbeat.message.began_ns:
            return None
        return (heartbeat.header.stamp_ns - heartbeat.message.began_ns) * 1e-9

    @property
    def clock_s(self) -> float | None:
        """`time_s` as people read it: it stands while no flight is under way."""
        self._note_clock()
        return self._flew_s

    def _note_clock(self) -> None:
        if self.time_s is None or self.mission not in AT_REST:
            self._flew_s = self.time_s

    @property
    def planned_s(self) -> float:
        """Planned end of what is flown, by the clock of `time_s`: a hold, a detour or another path makes it a later one."""
        heartbeat = self._heartbeat.newest()
        flight_s = heartbeat.message.flight_s if heartbeat is not None else 0.0
        if flight_s > 0.0 and self.time_s is None:
            self._planned_s = flight_s
        elif flight_s > 0.0 and self.time_s is not None and self.mission not in AT_REST:
            self._planned_s = max(self.time_s, 0.0) + max(flight_s - self.flown_s, 0.0)
        return self._planned_s

    @property
    def pace(self) -> str:
        """The pace of simulated time lately, in words; empty for the wall clock."""
        pace = self._time.pace()
        return "" if pace is None else pace_in_words(pace, self._wanted)

    @property
    def reason(self) -> str:
        """The reason for which the mission does not go on; empty if it does."""
        return textwrap.shorten(self._reason, REASON_CHARS, placeholder=" ...") if self.mission in WAITS else ""

    def _event(self, topic: Topic, key: str, header: Header, payload: bytes) -> None:
        """Keep the reason from the station's line `mission: STATE: REASON`."""
        try:
            event: Event = decode(Event, payload, key, topic.name)
        except DecodeError:
            return
        if event.source == "groundstation" and event.message.startswith(MISSION_LINE):
            self._reason = event.message.removeprefix(MISSION_LINE).partition(": ")[2]

    @contextmanager
    def shown(self, console: Console) -> Iterator[Callable[[], None]]:
        """Draw the view in a terminal meanwhile; elsewhere the function that this gives prints a line now and then, if it is
        called often."""
        said_s = time.monotonic()

        def say() -> None:
            nonlocal said_s
            self._note_clock()  # a line that comes later says when the flight was over
            if not console.is_terminal and time.monotonic() - said_s >= SAY_EVERY_S:
                said_s = time.monotonic()
                console.print(self.line(), soft_wrap=True)

        with Live(console=console, refresh_per_second=5, get_renderable=self.render, transient=True) as live:
            live.auto_refresh = console.is_terminal
            yield say

    def render(self) -> RenderableType:
        """The table and the progress bar, now."""
        clock_s = self.clock_s
        flown_s, clock = max(clock_s or 0.0, 0.0), self._clock_text().strip()
        self._progress.update(self._task, completed=flown_s, total=self.planned_s, speed=self.pace, clock=clock)
        table = Table("robot", "mode", "error", "pose", "age", "step", "battery", "remarks", title=self._title(), expand=False)
        for robot, inbox in self._states.items():
            received = inbox.newest()
            if received is None:
                table.add_row(str(robot), "not heard", *[""] * 6)
                continue
            cells = ("silent", *[""] * 6) if self._silent(received) else _cells(received.message)
            table.add_row(str(robot), *cells)
        return Group(table, self._progress, *([Text(self.reason)] if self.reason else []))

    def line(self) -> str:
        """The same in one line, for a log; for a large fleet counts of modes, and the worst robot."""
        silent, states = list[int](), dict[int, RobotState]()
        for robot, inbox in self._states.items():
            received = inbox.newest()
            if received is not None and self._silent(received):
                silent.append(robot)
            elif received is not None:
                states[robot] = received.message
        if len(self._states) > FEW:
            robots = _summary(states)
        else:
            robots = [f"{r} {s.mode.name.lower()} {_error(s)}{_remark(s)}" for r, s in states.items()]
        robots += [f"{robot} silent" for robot in silent]
        parts = [f"{self._clock_text()}  {self.mission.lower():10s}", self.pace, self.reason or ", ".join(robots)]
        return "  ".join(part for part in parts if part)

    def _clock_text(self) -> str:
        """The flight's clock and its planned end; no end on the way home, of which heartbeats give none."""
        clock_s, heartbeat = self.clock_s, self._heartbeat.newest()
        since = "     -" if clock_s is None else f"{clock_s:6.1f}"
        homeward = heartbeat is not None and clock_s is not None and heartbeat.message.flight_s <= 0.0
        return f"{since} s" if homeward else f"{since} / {self.planned_s:.0f} s"

    def _silent(self, received: Received[RobotState]) -> bool:
        return self._time.age_s(received) > SILENT_S

    def _title(self) -> str:
        localizer = self._localizer.newest()
        camera = f", camera {localizer.message.camera.name.lower()}" if localizer is not None else ""
        return f"{self._experiment.title or self._experiment.name}: {self.mission.lower()}{camera}"


def _error_mm(state: RobotState) -> float | None:
    """Distance from the reference in the plane; None for a robot that follows none."""
    estimate, control = state.estimate, state.control
    if state.mode is not Mode.TRACKING or estimate is None or control is None:
        return None
    return math.hypot(*(estimate.eta - control.eta_reference)[:2]) * 1e3


def _summary(states: Mapping[int, RobotState]) -> list[str]:
    """A large fleet in words: how many robots are in each mode, the largest error, and remarks."""
    modes = Counter(state.mode for state in states.values())
    words = [f"{count} {mode.name.lower()}" for mode, count in sorted(modes.items())]
    errors = {robot: error for robot, state in states.items() if (error := _error_mm(state)) is not None}
    if errors:
        worst = max(errors, key=lambda robot: errors[robot])
        words.append(f"worst {worst}: {errors[worst]:.0f} mm")
    return words + [f"{robot}{remark}" for robot, state in states.items() if (remark := _remark(state))]


def _error(state: RobotState) -> str:
    error_mm = _error_mm(state)
    return "-" if error_mm is None else f"{error_mm:.0f} mm"


def _remark(state: RobotState) -> str:
    return f" ({state.fault})" if state.fault else ""


def _cells(state: RobotState) -> tuple[str, ...]:
    """Cells of a robot's row."""
    return (
        state.mode.name.lower(),
        _error(state),
        state.track.name.lower(),
        "never" if state.timing.pose_age_ms is None else f"{state.timing.pose_age_ms:.0f} ms",
        f"{state.timing.step_us:.0f} us",
        f"{state.board.battery_v:.1f} V" if state.board is not None and state.board.battery_v > 0.0 else "-",
        state.fault,
    )
