"""SHELL: a recorded run as the page sees it, at any time of it and at any pace. The log is read a second at a time."""

import math
import time
from bisect import bisect_left, bisect_right
from collections import OrderedDict
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from pathlib import Path
from types import TracebackType
from typing import Any, TypeVar

import numpy as np

from groundstation.formation_clock import FormationPlans
from groundstation.logs.reader import LogMessage, open_log
from groundstation.mission.state_machine import MissionState
from groundstation.planning.feasibility import PlanError
from groundstation.planning.segment import PlanSegment
from groundstation.telemetry import LINK_WINDOW, LinkMonitor, RobotView
from groundstation.web.alarms import alarms
from groundstation.web.backend import ALWAYS, ShownPicture, Validity
from groundstation.web.experiment_editor import attempt, edited
from groundstation.web.protocol import Edit
from groundstation.web.scene import floats, flown_samples, paths, scene
from groundstation.web.snapshot import PAST_ROBOTS, AgedMessage, FleetSnapshot, RobotSnapshot, event_note, past_row, snapshot
from shoal.config.experiment import Experiment, load_experiment
from shoal.messages import session_clocks, topics
from shoal.messages.codec import DecodeError, Header, decode
from shoal.messages.messages import (
    WHOLE_FLEET,
    CommandKind,
    DriveVelocity,
    Event,
    LocalizerStatus,
    Preview,
    RobotState,
    StationHeartbeat,
    Trajectory,
    Truth,
)
from shoal.messages.topics import Topic

BLOCK_NS = 1_000_000_000
KEPT_BLOCKS = 8
LOOK_BACK = 2  # blocks: what was last said before that is long stale,
LASTING = (topics.STATE, topics.POSE, topics.LOCALIZER, topics.HEARTBEAT)  # but of these it is shown, with its age
LINK_BLOCKS = 5  # LINK_WINDOW messages of a robot
PAST_ROWS = 1200  # of a whole run, for plots and trails
PAST_EVERY_NS = 250_000_000  # and no row sooner after another
FRAME_S = 0.05  # a new state this often while it plays

M = TypeVar("M")
Arrivals = tuple[list[int], list[bytes], list[Header]]  # arrivals, ascending, payloads, headers


@dataclass(frozen=True)
class LogBlock:
    """A second of the log: its messages by topic and robot, and of each session by how much our clock was ahead of its own."""

    messages: dict[tuple[str, int], Arrivals] = field(default_factory=dict)
    ahead_ns: dict[int, int] = field(default_factory=dict)
    lines_ahead_ns: dict[int, int] = field(default_factory=dict)  # the same of the clocks that stamp lines of the log


class LogPlayer:
    """One recorded run: the newest message of a topic at a time, in ns from its first."""

    def __init__(self, run: Path) -> None:
        """Raises ConfigError for what is no run."""
        with ExitStack() as opened:
            self._log = opened.enter_context(open_log(run))
            self.experiment = load_experiment(str(run / "experiment.toml"))
            self._opened = opened.pop_all()
        self.start_ns, self.end_ns = self._log.start_ns, self._log.end_ns - self._log.start_ns
        self._blocks: OrderedDict[int, LogBlock] = OrderedDict()
        self._block_numbers = self._numbers_of_blocks()
        self._last: dict[tuple[str, int, int], Any] = {}  # by topic, robot and block: what was newest behind that block
        self.segments = self._segments()
        self.trajectories = {robot: changes[-1][1] for robot, changes in self.segments.items()}
        self.flown_ns, self._zero_ns = self._first_flown_ns()
        self._begun = list(self._flights())
        self._first_plan_ns = {robot: self._first_ns(topics.PLAN, robot) for robot in self.experiment.robot_ids}

    def _numbers_of_blocks(self) -> dict[tuple[str, int], list[int]]:
        """Numbers of the blocks, ascending, with a message of a lasting topic and robot."""
        blocks: dict[tuple[str, int], list[int]] = {}
        for line in self._log.messages(lambda topic, _: topic in LASTING):
            numbers = blocks.setdefault((line.topic.name, line.robot), [])
            number = (line.arrived_ns - self.start_ns) // BLOCK_NS
            if numbers[-1:] != [number]:
                numbers.append(number)
        return blocks

    def _each(self, topic: Topic, kind: type[M], robot: int | None = None) -> Any:
        """Yield robot, time since the log's start in ns, and message of a topic, for one robot or all."""
        for line in self._log.messages(lambda t, r: t is topic and robot in (None, r)):
            message = _read(kind, line.payload)
            if message is not None:
                yield line.robot, line.arrived_ns - self.start_ns, message

    def _segments(self) -> dict[int, list[tuple[int, Trajectory]]]:
        """Trajectories of each robot with the instant of each change; each holds the whole run from its beginning."""
        trajectories: dict[int, list[tuple[int, Trajectory]]] = {}
        for robot, at_ns, trajectory in self._each(topics.TRAJECTORY, Trajectory):
            trajectories.setdefault(robot, []).append((at_ns, trajectory))
        return {robot: trajectories[robot] for robot in self.experiment.robot_ids if robot in trajectories}

    def _first_ns(self, topic: Topic, robot: int) -> float:
        line = next(self._log.messages(lambda t, r: t is topic and r == robot), None)
        return math.inf if line is None else line.arrived_ns - self.start_ns

    def plan_age_s(self, plan: AgedMessage, robot: int, at_ns: int) -> float:
        """Age of a robot's newest plan: LOOK_BACK blocks where it is older than that, infinite before the first."""
        if plan.message is not None:
            return plan.age_ms * 1e-3
        return LOOK_BACK * BLOCK_NS * 1e-9 if self._first_plan_ns[robot] <= at_ns else math.inf

    def _flights(self) -> Iterator[tuple[int, int]]:
        """The beginning of each flight as the station gave it: the instant of its word, and that of the beginning."""
        begun = 0
        for line in self._log.messages(lambda topic, _: topic is topics.HEARTBEAT):
            beat = _read(StationHeartbeat, line.payload)
            if beat is not None and beat.began_ns not in (0, begun):
                begun, arrived_ns = beat.began_ns, line.arrived_ns - self.start_ns
                yield arrived_ns, arrived_ns + begun - line.header.stamp_ns

    def began_ns(self, at_ns: int) -> int:
        """Beginning of the flight at an instant of the log, or of the first one: time 0 for people."""
        if not self._begun:  # no station, or an early version of it
            return self._zero_ns
        begins = [begun for arrived_ns, begun in self._begun if arrived_ns <= at_ns]
        return begins[-1] if begins else self._begun[0][1]

    def _first_flown_ns(self) -> tuple[int, int]:
        """Instant of the first state of any robot on the formation's trajectory, and that trajectory's beginning; if there is
        none, of the first state."""
        said_ns = None
        for _, at_ns, state in self._each(topics.STATE, RobotState):
            said_ns = at_ns if said_ns is None else said_ns
            flown_s = FormationPlans().clock_s(state) or 0.0
            if flown_s > 0.0:
                return int(at_ns), int(at_ns) - round(flown_s * 1e9)
        return said_ns or 0, said_ns or 0

    def _block(self, index: int) -> LogBlock:
        """A second of the log, read once and kept for a while."""
        if index not in self._blocks:
            begin, block = self.start_ns + index * BLOCK_NS, LogBlock()
            for line in self._log.messages(lambda topic, robot: True, begin, begin + BLOCK_NS):
                arrivals, payloads, headers = block.messages.setdefault((line.topic.name, line.robot), ([], [], []))
                arrivals.append(line.arrived_ns - self.start_ns)
                payloads.append(line.payload)
                headers.append(line.header)
                says = line.topic.type in session_clocks.LINE_CLOCKS and line.arrived_ns != line.header.stamp_ns
                held_ns = session_clocks.held_ns(line.topic, _read(line.topic.type, line.payload)) if says else None
                if held_ns is not None:
                    session, ahead_ns = line.header.session, arrivals[-1] - line.header.stamp_ns - held_ns
                    if line.topic.type is not Truth:
                        block.ahead_ns[session] = min(block.ahead_ns.get(session, ahead_ns), ahead_ns)
                    if session_clocks.stamps_lines_too(line.topic, self.start_ns + ahead_ns):
                        block.lines_ahead_ns[session] = min(block.lines_ahead_ns.get(session, ahead_ns), ahead_ns)
            self._blocks[index] = block
        self._blocks.move_to_end(index)
        while len(self._blocks) > KEPT_BLOCKS:
            self._blocks.popitem(last=False)
        return self._blocks[index]

    def newest(self, topic: Topic, kind: type[M], at_ns: int, robot: int = 0) -> tuple[int, M] | None:
        """The newest message at a time, and the instant that it is about; None if there is none, or none that can be read."""
        newest, now = self._recent(topic, kind, at_ns, robot), at_ns // BLOCK_NS
        numbers = self._block_numbers.get((topic.name, robot), [])
        before = numbers[: bisect_left(numbers, now - LOOK_BACK + 1)][-1:]
        if newest is not None or not before:
            return newest
        of = topic.name, robot, before[0]
        if of not in self._last:
            self._last[of] = self._recent(topic, kind, (before[0] + 1) * BLOCK_NS - 1, robot)
        last: tuple[int, M] | None = self._last[of]
        return last

    def _recent(self, topic: Topic, kind: type[M], at_ns: int, robot: int) -> tuple[int, M] | None:
        """The newest message of the last blocks. One that came twice, or late behind the next, is not the newest again."""
        last: tuple[Header, int, bytes] | None = None
        for index in range(at_ns // BLOCK_NS, max(at_ns // BLOCK_NS - LOOK_BACK, -1), -1):
            arrivals, payloads, headers = self._block(index).messages.get((topic.name, robot), ([], [], []))
            for k in range(bisect_right(arrivals, at_ns) - 1, -1, -1):
                if last is None or (headers[k].session == last[0].session and headers[k].sequence > last[0].sequence):
                    last = headers[k], arrivals[k], payloads[k]
        message = None if last is None else _read(kind, last[2])
        return None if last is None or message is None else (self._instant_ns(last[0], last[1], at_ns // BLOCK_NS), message)

    def _instant_ns(self, header: Header, arrived_ns: int, index: int) -> int:
        """The instant that a message is about, on the recorder's clock: its stamp, carried over by what came quickest of its
        session in the last blocks. In lockstep, and of a session that tells no ages, the arrival."""
        leads_ns = [block.ahead_ns[header.session] for block in self._before(index) if header.session in block.ahead_ns]
        return min(header.stamp_ns + min(leads_ns), arrived_ns) if leads_ns else arrived_ns

    def _before(self, index: int) -> Iterator[LogBlock]:
        """A block, and those before it by which clocks are compared."""
        return map(self._block, range(index, max(index - LINK_BLOCKS, -1), -1))

    def events(self) -> list[dict[str, Any]]:
        """Lines of the run's log, for the page, each with the beginning of the flight from which people count it."""
        notes: list[dict[str, Any]] = []
        leads_ns: dict[int, int] = {}
        for line in self._log.messages(lambda topic, _: topic is topics.EVENT):
            event = _read(Event, line.payload)
            if event is not None:
                at_ns = self._event_ns(line, leads_ns)
                notes.append(event_note(event, at_ns) | {"began_s": self.began_ns(at_ns) * 1e-9})
        return notes

    def _event_ns(self, line: LogMessage, leads_ns: dict[int, int]) -> int:
        """Instant of an event: its arrival, or the instant at which its sender wrote it if the sender has kept it since.

        `leads_ns` holds by how much the log's clock is ahead of a sender's, by the sender's session; missing ones are added.
        """
        session, arrived_ns = line.header.session, line.arrived_ns - self.start_ns

        def nearby_ns() -> list[int]:
            blocks = self._before(arrived_ns // BLOCK_NS + 1)  # lines that were kept come with the sender's first state
            return [block.lines_ahead_ns[session] for block in blocks if session in block.lines_ahead_ns]

        if session not in leads_ns:
            if not (leads := nearby_ns()):
                return arrived_ns
            leads_ns[session] = min(leads)
        written_ns = line.header.stamp_ns + leads_ns[session]
        if session_clocks.is_old_line(written_ns, arrived_ns):  # unless the sender's clock was set meanwhile
            written_ns = line.header.stamp_ns + min(leads) if (leads := nearby_ns()) else arrived_ns
        return written_ns if session_clocks.is_old_line(written_ns, arrived_ns) else arrived_ns

    def past(self) -> list[dict[str, Any]]:
        """Rows of the whole run, evenly spaced."""
        rows = min(PAST_ROWS, PAST_ROBOTS // len(self.experiment.robot_ids))
        every_ns = max(self.end_ns // rows, PAST_EVERY_NS)
        newest: dict[tuple[Topic, int], tuple[int, bytes]] = {}
        past: list[dict[str, Any]] = []
        for line in self._log.messages(lambda topic, _: topic in (topics.STATE, topics.LOCALIZER)):
            arrived_ns = line.arrived_ns - self.start_ns
            while arrived_ns > (len(past) + 1) * every_ns:
                past.append(self._past_row((len(past) + 1) * every_ns, newest))
            newest[line.topic, line.robot] = arrived_ns, line.payload
        return past

    def _past_row(self, at_ns: int, newest: Mapping[tuple[Topic, int], tuple[int, bytes]]) -> dict[str, Any]:
        """The page's row at an instant, from the newest message of each topic and robot by then: its arrival, its payload."""

        def aged(topic: Topic, robot: int = 0) -> AgedMessage:
            arrived_ns, payload = newest.get((topic, robot), (0, b""))
            age_ns = at_ns - arrived_ns
            message = _read(topic.type, payload) if payload and age_ns < LOOK_BACK * BLOCK_NS else None
            return AgedMessage() if message is None else AgedMessage(message, age_ns * 1e-6)

        robots = {r: RobotSnapshot(aged(topics.STATE, r), AgedMessage(), AgedMessage()) for r in self.experiment.robot_ids}
        return past_row(snapshot(FleetSnapshot(time_s=at_ns * 1e-9, robots=robots, localizer=aged(topics.LOCALIZER))))

    def link(self, robot: int, at_ns: int) -> LinkMonitor:
        """Link and clock of a robot as the station knew them at a time, by the last states until then.

        The log does not record how old a message was when it was sent. For a state that is about the duration of its control
        step, and nothing in lockstep, where a message arrives at its stamp.
        """
        link = LinkMonitor()
        newest = self.newest(topics.STATE, RobotState, at_ns, robot)
        if newest is None:
            return link
        _, state = newest
        step_ns = round(state.timing.step_us * 1e3)
        last_block = at_ns // BLOCK_NS
        received: list[tuple[Header, int]] = []  # header and arrival in ns from the log's start, ascending
        for index in range(max(last_block - LINK_BLOCKS + 1, 0), last_block + 1):
            arrivals, _, headers = self._block(index).messages.get((topics.STATE.name, robot), ([], [], []))
            count = bisect_right(arrivals, at_ns)
            received += zip(headers[:count], arrivals[:count], strict=True)
        for header, arrival_ns in received[-LINK_WINDOW:]:
            arrived_ns = arrival_ns + self.start_ns
            is_lockstep = arrived_ns == header.stamp_ns
            link.add((header,), header, arrived_ns if is_lockstep else arrived_ns - step_ns)
        return link

    def close(self) -> None:
        """Give the file back."""
        self._opened.close()


def _read(kind: type[M], payload: bytes) -> M | None:
    """A recorded message; None if it is damaged, or of a version with other fields."""
    try:
        return decode(kind, payload, "log", kind.__name__)
    except DecodeError:
        return None


class _NoRequests:
    """Refuses all requests: a recorded run takes none."""

    def request(
        self,
        order: CommandKind,
        via: Sequence[tuple[float, float]] = (),
        only: int = WHOLE_FLEET,
        text: str = "",
        valid: Validity = ALWAYS,
    ) -> tuple[str, int]:
        return "this is a recorded run", 0

    def draft(self, order: CommandKind, text: str) -> PlanSegment:
        raise PlanError("this is a recorded run")

    def drive(self, robot: int, velocity: DriveVelocity, valid: Validity = ALWAYS) -> str:
        return "this is a recorded run"

    def request_gains(self, values: Mapping[str, float] | None, next_lap: bool, valid: Validity = ALWAYS) -> tuple[str, int]:
        return "this is a recorded run", 0


@dataclass(frozen=True)
class RunChoice:
    """Choice of a person after an ended run: "again", "edited" with the experiment to fly, or "close"."""

    what: str
    experiment: Experiment | None = None


class ReplayBackend:
    """A run, perhaps beside another one of the same robots: both counted from the moment when they began to fly."""

    def __init__(self, run: Path, against: Path | None = None, offers: Sequence[str] = (), problem: str = "") -> None:
        """`offers`: what a person may choose after it (RunChoice.what); it is then shown as it ended. `problem`: with the run,
        or with the last choice."""
        self.station, self.run_dir = _NoRequests(), run
        self.choice: RunChoice | None = None
        self._offers, self._problem = list(offers), problem
        self._log = LogPlayer(run)
        self._against = LogPlayer(against) if against is not None else None
        self._at_ns, self._rate, self._since_s = self._log.end_ns if offers else self._log.flown_ns, 0.0, time.monotonic()
        self._changed = True
        self._shown_s = 0.0
        self._past, self._events = self._log.past(), self._log.events()
        self.kept_events = len(self._events)  # all: they are shown up to the present time, however early that is
        self._drawn: list[int] = []

    def __enter__(self) -> "ReplayBackend":
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self._log.close()
        if self._against is not None:
            self._against.close()

    @property
    def experiment(self) -> Experiment:
        return self._log.experiment

    def _now_ns(self) -> int:
        played = round((time.monotonic() - self._since_s) * self._rate * 1e9)
        return min(self._at_ns + played, self._log.end_ns)

    def scene(self) -> dict[str, Any]:
        """The recorded scene, and how long it is."""
        replay = {"begin_s": self._log.flown_ns * 1e-9, "end_s": self._log.end_ns * 1e-9}
        constants = scene(self.experiment, self._log.trajectories, "replay")
        constants |= {"paths": self._paths_of(self._flown_segments())}
        return constants | {"replay": replay, "run": str(self.run_dir), "offers": self._offers, "problem": self._problem}

    def changed(self) -> bool:
        """True if there is another state to show."""
        playing = self._rate > 0.0 and time.monotonic() - self._shown_s >= FRAME_S
        changed, self._changed = self._changed or playing, False
        return changed

    def remark(self, text: str) -> None:
        """Refuse a remark: nothing is added to a recorded run."""

    def seek(self, time_s: float | None, rate: float | None) -> None:
        """Go to a time of the run, or on at another pace."""
        at_ns = self._now_ns() if time_s is None else min(round(time_s * 1e9), self._log.end_ns)
        self._at_ns, self._since_s, self._changed = at_ns, time.monotonic(), True
        self._rate = self._rate if rate is None else rate

    def choose(self, what: str, edit: Edit | None) -> list[str]:
        """Take what a person wants next, if it is offered and can be flown. Returns every reason against it."""
        if what not in self._offers:
            return ["this is not possible here"]
        if self.choice is not None:
            return [f"{self.choice.what} was chosen before"]
        if what == "edited":
            tried = attempt(self.experiment, edit or Edit())
            if not tried["ok"]:
                return list(tried["problems"])
        self.choice = RunChoice(what, edited(self.experiment, edit or Edit()) if what == "edited" else None)
        return []

    def _aged(self, topic: Topic, kind: type[Any], at_ns: int, robot: int = 0) -> AgedMessage:
        newest = self._log.newest(topic, kind, at_ns, robot)
        return AgedMessage() if newest is None else AgedMessage(newest[1], (at_ns - newest[0]) * 1e-6)

    def snapshot(self) -> dict[str, Any]:
        """The fleet at the present time of the replay."""
        self._shown_s = time.monotonic()
        now = self._now_ns()
        robots = {
            r: RobotSnapshot(*(self._aged(topic, topic.type, now, r) for topic in (topics.STATE, topics.POSE, topics.PLAN)))
            for r in self.experiment.robot_ids
        }
        beat = self._log.newest(topics.HEARTBEAT, StationHeartbeat, now)
        out = beat[1].out if beat is not None else ()
        views = {r: replace(self._view(r, messages, now), out=r in out) for r, messages in robots.items()}
        localizer = self._aged(topics.LOCALIZER, LocalizerStatus, now)
        mission = beat[1].mission if beat is not None and beat[1].mission in MissionState.__members__ else ""
        news = FleetSnapshot(
            time_s=now * 1e-9,
            began_s=self._log.began_ns(now) * 1e-9,
            robots=robots,
            localizer=localizer,
            obstacles=self._aged(topics.OBSTACLES, topics.OBSTACLES.type, now),
            mission=mission,
            mission_text=MissionState[mission].value if mission else "recorded",  # a numeric flight has no station
            emergency_stop=beat is not None and beat[1].emergency_stop,
            alarms=alarms(self.experiment, views, localizer.message, localizer.age_ms * 1e-3, ""),
        )
        return (
            snapshot(news)
            | {"replay": {"time_s": now * 1e-9, "rate": self._rate}, "ghosts": self._ghosts(now)}
            | {"next": self.choice.what if self.choice is not None else ""}
        )

    def _view(self, robot: int, news: RobotSnapshot, now_ns: int) -> RobotView:
        """A robot as a station would have seen it at an instant of the log."""
        ages_s = [n.age_ms * 1e-3 if n.message is not None else math.inf for n in (news.state, news.pose)]
        ages_s.append(self._log.plan_age_s(news.plan, robot, now_ns))
        link = self._log.link(robot, now_ns)
        return RobotView(
            news.state.message, ages_s[0], news.pose.message, ages_s[1], ages_s[2], link.clock_offset_s, link.loss
        )

    def paths(self) -> list[dict[str, Any]] | None:
        """Paths flown at that time, returned once after each change: of a later segment only the part that is new."""
        flown = self._flown_segments()
        if list(flown.values()) == self._drawn:
            return None
        self._drawn = list(flown.values())
        return self._paths_of(flown)

    def _flown_segments(self) -> dict[int, int]:
        """Number of the trajectory that each robot has at the present time of the replay."""
        now, segments = self._now_ns(), self._log.segments
        return {robot: max(bisect_right([at for at, _ in changes], now) - 1, 0) for robot, changes in segments.items()}

    def _paths_of(self, flown: Mapping[int, int]) -> list[dict[str, Any]]:
        """The paths that robots flew, each from where it leaves the one before; `flown`: index of each robot's segment."""
        path_list, segments = [], self._log.segments
        for robot, k in flown.items():
            trajectory = segments[robot][k][1]
            begin = _differ(segments[robot][k - 1][1], trajectory) if k > 0 else 0
            end = len(trajectory.eta) if k > 0 else flown_samples(self.experiment)
            path_list += paths({robot: replace(trajectory, eta=trajectory.eta[begin:])}, max(end - begin, 1))
        return path_list

    def _ghosts(self, now_ns: int) -> list[dict[str, Any]]:
        """The other run's robots, as long after its start as this one is after its own."""
        if self._against is None:
            return []
        then_ns = max(now_ns - self._log.flown_ns + self._against.flown_ns, 0)
        states = ((r, self._against.newest(topics.STATE, RobotState, then_ns, r)) for r in self._against.experiment.robot_ids)
        young = ((r, state) for r, state in states if state is not None and then_ns - state[0] < LOOK_BACK * BLOCK_NS)
        estimates = ((r, state[1].estimate) for r, state in young)
        return [{"id": r, "eta": floats(estimate.eta)} for r, estimate in estimates if estimate is not None]

    def picture(self, camera: str, shown_ns: int) -> ShownPicture | None:
        """The picture of a camera at that time, if it is not the one that arrived at `shown_ns`."""
        preview = self._log.newest(topics.PREVIEW.of_camera(camera), Preview, self._now_ns())
        if preview is None or preview[0] == shown_ns:
            return None
        return ShownPicture(preview[0], (self._now_ns() - preview[0]) * 1e-6, preview[1].jpeg, preview[0] * 1e-9)

    def past(self) -> list[dict[str, Any]]:
        """The whole run."""
        return self._past

    def notes(self) -> list[dict[str, Any]]:
        """All lines of the run's log, once; the page shows those before its present time."""
        notes, self._events = self._events, []
        return notes


def _differ(before: Trajectory, then: Trajectory) -> int:
    """Index of the first sample at which a trajectory differs from the one before."""
    both = min(len(before.eta), len(then.eta))
    other = np.flatnonzero((before.eta[:both] != then.eta[:both]).any(axis=1))
    return int(other[0]) if len(other) else both
