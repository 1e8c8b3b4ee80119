"""SHELL: the ground station: one cycle a control period, answers awaited in their own threads; process.py runs it.

The heartbeat goes out from the same cycle that runs the mission: no thread of its own could outlive it. In lockstep the
orders of a cycle are answered before its heartbeat, so a robot that has the heartbeat has the orders.
"""

import re
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, field, replace

from groundstation.inboxes import FleetInboxes
from groundstation.logs.recorder import Recorder
from groundstation.mission.command_dispatcher import CommandResult
from groundstation.mission.gain_update import TUNING, GainUpdater
from groundstation.mission.lap_statistics import LapStatistics
from groundstation.mission.mission import LIVE, Mission
from groundstation.mission.obstacle_monitor import ObstacleSet, obstacle_set
from groundstation.mission.plan_manager import PlanRequest
from groundstation.mission.request_progress import AT_REST, RequestTracker
from groundstation.mission.state_machine import MissionState
from groundstation.planning.feasibility import PlanError
from groundstation.planning.segment import PlanSegment
from groundstation.telemetry import Fleet, LinkMonitor, blocking_findings, robot_view
from groundstation.web.live_backend import Status
from wire.config.experiment import Experiment
from wire.frames import Array
from wire.messages import topics
from wire.messages.codec import Header
from wire.messages.messages import Command, Order, Progress, Reply, StationHeartbeat, Trajectory
from wire.messages.topics import WHOLE_FLEET
from wire.process.runtime import Clock, age_s, log
from wire.transport.bus import Bus
from wire.transport.endpoint import PATIENT_MS

ORDER_TIMEOUT_S = 0.5
LOCKSTEP_ORDER_TIMEOUT_S = PATIENT_MS * 1e-3  # as long as a link is kept: sent again, an order would count at a later step
TROUBLED = frozenset({MissionState.FAILED, MissionState.ABORTING, MissionState.STOPPED, MissionState.DEGRADED})
PROMPT = frozenset({Order.STOP, Order.DISARM, Order.HOLD})
MAX_UNANSWERED = 2  # orders of a kind to one robot that may be unanswered: the second goes out before the first is given up
COMMAND_KINDS = 4  # of orders that may be on their way to one robot at a time, but for PROMPT: LOAD or START, ARM, TUNE, ADOPT
STATUS_WITHIN_S = 0.02  # whoever asks for the status waits no longer for the cycle, and is told the last one
FIGURE = re.compile(r"\d[\d.]*(?:%| (?:s|V|m|ms)\b)")  # a reason in which only these change is not told anew


@dataclass(frozen=True)
class Workers:
    """Threads for what the cycle must not wait for. Orders that make robots safe have threads of their own, and so has
    planning: neither ever waits for a robot that does not answer."""

    prompt: ThreadPoolExecutor  # PROMPT
    orders: ThreadPoolExecutor
    plans: ThreadPoolExecutor

    def of(self, order: Order) -> ThreadPoolExecutor:
        """Who carries an order out."""
        return self.prompt if order in PROMPT else self.orders


@contextmanager
def workers(robots: int) -> Iterator[Workers]:
    """As many threads as there can be orders on their way, so that none waits for another one's."""
    most = MAX_UNANSWERED * robots
    with (
        ThreadPoolExecutor(most * len(PROMPT), "prompt") as prompt,
        ThreadPoolExecutor(most * COMMAND_KINDS, "order") as orders,
        ThreadPoolExecutor(1, "plan") as plans,
    ):
        yield Workers(prompt, orders, plans)


@dataclass
class Station:
    """The station's cycle and what it holds. Whoever is not the cycle's thread holds `turn`, or reads what is replaced and
    never changed: `seen`, `paths`, `requests.recent`."""

    experiment: Experiment
    bus: Bus
    clock: Clock
    recorder: Recorder
    mission: Mission
    tuner: GainUpdater
    laps: LapStatistics
    heard: FleetInboxes
    workers: Workers
    starts: dict[int, Array]
    links: dict[int, LinkMonitor] = field(default_factory=dict)
    seen: Fleet = field(default_factory=dict)  # as of the last cycle
    planning: "tuple[PlanRequest, Future[PlanSegment | PlanError]] | None" = None
    published: PlanSegment | None = None
    obstacles_up_to_ns: int | None = None  # in lockstep: pictures up to then have been told of
    pending: list[tuple[Command, Future[Reply]]] = field(default_factory=list)
    paths: tuple[Mapping[int, Trajectory], float] | None = None  # what each robot that takes part flies now, until when [s]
    ended: bool = False  # a person has ended the run: everybody who is heard is at rest
    told: str = ""
    insecure: bool = False
    recorder_told: bool = False
    pictures_told: bool = False
    turn: threading.Lock = field(default_factory=threading.Lock)  # a person's wish comes from a network thread
    hurry: threading.Event = field(default_factory=threading.Event)  # a wish that is not to wait for the next cycle

    def __post_init__(self) -> None:
        self.requests = RequestTracker(self.experiment.robot_ids)
        self._beat_s = time.monotonic()
        self._status = Status(self.mission.state, self.mission.reason)

    def cycle(self, now_ns: int, lockstep: bool) -> None:
        """Read the fleet, run the mission, send its orders, beat."""
        with self.turn:
            self.seen, answers = self.fleet(), self._answers()
            for_tuner = [answer for answer in answers if answer.command.order in TUNING]
            for_mission = [answer for answer in answers if answer not in for_tuner]
            self._plan(lockstep, now_ns)
            commands = self.mission.step(self.seen, for_mission, now_ns, self._around())
            self._plan(lockstep, now_ns)
            self.publish_paths(now_ns)
            commands += self.tuner.step(self.seen, for_tuner, now_ns)
            self.laps.update(self.seen)
            self._follow(answers)
            new_gains = self.tuner.take_unlogged()
        for gains in new_gains:
            self.bus.publish(topics.TUNING, gains, now_ns)
        timeout_s = LOCKSTEP_ORDER_TIMEOUT_S if lockstep else ORDER_TIMEOUT_S
        for command in commands:
            if self._on_their_way(command) < MAX_UNANSWERED:
                # Sent from here, in the mission's order; only the waiting is for other threads.
                reply = self.bus.send_order(command, now_ns, timeout_s)
                self.pending.append((command, self.workers.of(command.order).submit(reply)))
        if lockstep:
            for _, future in self.pending:
                future.result()
        stopped = self.mission.state is MissionState.STOPPED
        pace = self.mission.governor
        planned = tuple(robot for robot, seen in self.seen.items() if seen.state is not None and seen.state.planned)
        state = self.mission.state.name
        beat = StationHeartbeat(self.experiment.hash, stopped, state, pace.lag_s, 1.0 - pace.rate, planned)
        self.bus.publish(topics.HEARTBEAT, beat, now_ns)
        self._beat_s = time.monotonic()
        self._tell()

    def _on_their_way(self, command: Command) -> int:
        """How many orders of this kind its robot has not answered yet. More would only wait for one another."""
        return sum(c.robot == command.robot and c.order is command.order for c, _ in self.pending)

    def _follow(self, answers: Sequence[CommandResult]) -> None:
        """Take account of what became of people's requests; end the run if one of them says so."""
        ending = self.requests.ending
        self.requests.follow(self.mission, self.seen, self.tuner.status(), answers)
        ends = [outcome.progress for outcome in self.requests.recent if outcome.order is Order.END]
        if ending and not self.requests.ending and ends[-1] is Progress.DONE:
            self.ended = True
            log.info("the run is ended")

    def fleet(self) -> Fleet:
        """What is known of the robots now."""
        found = {}
        for robot in self.experiment.robot_ids:
            state, ear = self.heard.states[robot].newest(), self.links.setdefault(robot, LinkMonitor())
            if state is not None:
                ear.add(self.heard.states[robot].headers(), state.header, self.clock.instant_ns(state))
            seen = robot_view(state, self.heard.poses[robot].newest(), self.clock, self.heard.plans[robot].newest(), ear)
            found[robot] = replace(seen, behind_s=self.mission.behind_s(seen, self.clock.now_ns()))
        return found

    def _around(self) -> ObstacleSet:
        """What the localizer sees lying in the pool; what drifts is left to the robots, who see it too."""
        received = self.heard.obstacles.newest(self.obstacles_up_to_ns)
        if received is None:
            return ObstacleSet()
        return obstacle_set(received.message, age_s(self.clock, received), self.experiment.safety)

    def _plan(self, lockstep: bool, now_ns: int) -> None:
        """Have made what the mission waits for: beside the cycle, which must beat on; in lockstep at once. What it no longer
        waits for when it is done counts for nothing."""
        wanted = self.mission.plan_request
        if self.planning is None and wanted is not None:
            self.planning = wanted, self.workers.plans.submit(_planned, wanted.plan)
        if self.planning is not None and (lockstep or self.planning[1].done()):
            (asked, outcome), self.planning = self.planning, None
            if asked is wanted:
                self.mission.planned(outcome.result(), self.seen, now_ns)

    def publish_paths(self, now_ns: int) -> None:
        """Tell who shows or records it what is flown from now on: each robot's whole run, with what was flown before."""
        segment = self.mission.segment
        if segment is self.published:
            return
        for robot, trajectory in self.mission.roster.history.items():
            self.bus.publish(topics.TRAJECTORY, trajectory, now_ns, robot)
        self.paths = dict(self.mission.roster.trajectories(segment)), segment.end_s
        self.published = segment

    def _answers(self) -> list[CommandResult]:
        done = [(command, future) for command, future in self.pending if future.done()]
        self.pending = [entry for entry in self.pending if not entry[1].done()]
        return [CommandResult(command, future.result()) for command, future in done]

    def wish(self, header: Header, command: Command) -> Reply:
        """A person's request for the whole fleet, from a terminal, or a question what became of one. Gains without any are
        those before the last change."""
        if command.about:
            outcome = self.requests.outcome(command.about)
            reason = "" if outcome is not None else f"request {command.about} is not known here (any more)"
            return Reply(WHOLE_FLEET, outcome is not None, reason, outcome=outcome)
        if command.tuning is not None:
            keys = dict(zip(command.tuning.keys, command.tuning.values.tolist(), strict=False))
            reason, number = self.tune(keys or None, next_lap=False)
        else:
            reason, number = self.ask(command.order, [(x, y) for x, y in command.via.tolist()])
        outcome = self.requests.outcome(number) if not reason else None
        return Reply(WHOLE_FLEET, not reason, reason, outcome=outcome)

    def ask(self, order: Order, via: Sequence[tuple[float, float]] = ()) -> tuple[str, int]:
        """A person's request for the whole fleet. Returns why not, or nothing, and the request's number."""
        with self.turn:
            reason = self._end() if order is Order.END else self._wish(order, via)
            number = 0 if reason else self.requests.begin(order, self.mission)
        if order in PROMPT and not reason:
            self.hurry.set()
        log.info("%s asked for: %s", order.name, reason or "under way")
        return reason, number

    def _wish(self, order: Order, via: Sequence[tuple[float, float]] = ()) -> str:
        return self.mission.request(order, self.seen, self.clock.now_ns(), via)

    def _end(self) -> str:
        """Have everybody disarmed who may not be. Returns why not, or nothing."""
        moves = self.mission.state not in AT_REST or any(seen.heard and seen.mode in LIVE for seen in self.seen.values())
        return self._wish(Order.DISARM) if moves and self.mission.state is not MissionState.STOPPED else ""

    def tune(self, values: Mapping[str, float] | None, next_lap: bool) -> tuple[str, int]:
        """Other gains for the whole fleet; None: those before. Returns why not, or nothing, and the request's number."""
        with self.turn:
            fleet, now_ns = self.fleet(), self.clock.now_ns()
            if values is None:
                reason, what = self.tuner.undo(fleet, now_ns), "the gains before"
            else:
                reason = self.tuner.request(values, next_lap, fleet, now_ns)
                what = ", ".join(f"{key} = {value:g}" for key, value in values.items())
            number = 0 if reason else self.requests.begin(Order.TUNE, self.mission, self.tuner.status().wanted)
        log.info("asked for %s%s: %s", what, " on the next lap" if next_lap else "", reason or "under way")
        return reason, number

    def status(self) -> Status:
        """Where mission and gains stand, for another thread. While the cycle is at work for longer than that thread should
        wait, where they stood when last asked."""
        if self.turn.acquire(timeout=STATUS_WITHIN_S):
            try:
                self._status = self._stand()
            finally:
                self.turn.release()
        return replace(self._status, beat_age_s=time.monotonic() - self._beat_s)

    def _stand(self) -> Status:
        mission = self.mission
        return Status(
            mission.state,
            mission.reason,
            self.recorder.error,
            self.insecure,
            self.tuner.status(),
            self.laps.laps(),
            blocking_findings(self.experiment, self.seen, self.starts),
            seen=self.seen,
            requests=self.requests.recent,
            ended=self.ended,
        )

    def _tell(self) -> None:
        if self.recorder.warning and not self.pictures_told:
            self.pictures_told = True
            log.warning("recorder: %s", self.recorder.warning)
        if self.recorder.error and not self.recorder_told:
            self.recorder_told = True
            log.error("recorder: %s", self.recorder.error)
        line = f"{self.mission.state.value}{f': {self.mission.reason}' if self.mission.reason else ''}"
        told = FIGURE.sub("", line)
        if told != self.told:
            self.told = told
            (log.warning if self.mission.state in TROUBLED else log.info)("mission: %s", line)


def _planned(make: Callable[[], PlanSegment]) -> PlanSegment | PlanError:
    try:
        return make()
    except PlanError as error:
        return error
    except Exception as error:  # a bug in planning is no reason to leave a fleet in the water without its station
        log.exception("planning failed")
        return PlanError(f"planning failed: {type(error).__name__}: {error}")
