"""SHELL: the ground station: one cycle a control period, answers awaited in their own threads; process.py runs it.

The heartbeat goes out from the same cycle that runs the mission: no thread of its own could outlive it. In lockstep the
orders of a cycle are answered before its heartbeat, so a robot that has the heartbeat has the orders.
"""

import math
import re
import threading
import time
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor, wait
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np

from groundstation.logs.recorder import Recorder
from groundstation.mission.command_dispatcher import CommandResult
from groundstation.mission.gain_update import GainUpdater
from groundstation.mission.mission import ATTENDED, Mission
from groundstation.mission.objections import LIVE
from groundstation.mission.obstacle_monitor import ObstacleSet, obstacle_set
from groundstation.mission.plan_manager import PlanRequest
from groundstation.mission.state_machine import AT_REST, READY, MissionState, in_words
from groundstation.mission.station_core import StationCore
from groundstation.planning.feasibility import OutOfTime, PlanError
from groundstation.planning.segment import PlanSegment
from groundstation.telemetry import (
    DEPLOY,
    Finding,
    Fleet,
    FleetInboxes,
    LinkMonitor,
    blocking_findings,
    other_code,
    silent_sightings,
)
from groundstation.web.backend import ALWAYS, Status, Validity
from shoal.bus.access_control import INSECURE
from shoal.bus.bus import HELD_UP, Bus
from shoal.bus.command_deduplication import ALWAYS_TAKEN
from shoal.bus.endpoint import PATIENT_MS
from shoal.config.experiment import Experiment
from shoal.messages import topics
from shoal.messages.codec import Header
from shoal.messages.messages import (
    WHOLE_FLEET,
    Command,
    CommandKind,
    DriveVelocity,
    FaultRequest,
    Reply,
    StationHeartbeat,
    Trajectory,
)
from shoal.messages.topics import Role, process_name
from shoal.runtime.runtime import Clock, age_s, log
from shoal.runtime.version import code

ORDER_TIMEOUT_S = 0.5
PATIENT_ORDER_TIMEOUT_S = PATIENT_MS * 1e-3  # as long as a link is kept: sent again, an order would count at a later step
TROUBLED = frozenset({MissionState.FAILED, MissionState.ABORTING, MissionState.STOPPED})
PROMPT = frozenset({CommandKind.STOP, CommandKind.DISARM, CommandKind.HOLD})
MAX_UNANSWERED = 2  # orders of a kind to one robot that may be unanswered: the second goes out before the first is given up
# of orders that may be on their way to one robot at a time, but for PROMPT: LOAD or START, ARM, TUNE, ADOPT, DRIVE
COMMAND_KINDS = 5
PLANNING_S = 15.0  # for a plan of robots at rest; the formation holds meanwhile, and its battery does not last for ever
DRAFT_S = 5.0  # for a plan that a person looks at; a click plans it anew
OVERTAKEN = "another request was made before this one was ready: ask again if it is still wanted"
STATUS_WITHIN_S = 0.02  # a reader of the status waits no longer for the cycle, and gets the last one
FIGURE = re.compile(r"\d[\d.]*(?:%| (?:s|V|m|ms)\b)")  # a reason in which only these change is not told anew


@dataclass(frozen=True)
class Workers:
    """Threads for work that the cycle must not wait for. Commands that make robots safe have threads of their own, and so has
    planning: neither ever waits for a robot that does not answer."""

    prompt: ThreadPoolExecutor  # PROMPT
    orders: ThreadPoolExecutor
    plans: ThreadPoolExecutor  # one thread for each owner of a plan
    closing: threading.Event  # the station ends: no plan is waited for

    def of(self, order: CommandKind) -> ThreadPoolExecutor:
        """Threads that send a command."""
        return self.prompt if order in PROMPT else self.orders


@contextmanager
def workers(robots: int) -> Iterator[Workers]:
    """Start the station's threads for so many robots, and end them with the block. There are as many as commands that can be
    unanswered at once, so that no command waits for another."""
    per_kind = MAX_UNANSWERED * robots
    with (
        ThreadPoolExecutor(per_kind * len(PROMPT), "prompt") as prompt,
        ThreadPoolExecutor(per_kind * COMMAND_KINDS, "order") as orders,
        ThreadPoolExecutor(2, "plan") as plans,
    ):
        closing = threading.Event()
        try:
            yield Workers(prompt, orders, plans, closing)
        finally:
            closing.set()


class PublishedPaths(NamedTuple):
    """Paths as they were published last."""

    segment: PlanSegment
    alone: Mapping[int, Trajectory]  # of robots that fly alone


class PlanTask(NamedTuple):
    """A plan that is being computed."""

    request: PlanRequest
    outcome: "Future[PlanSegment | PlanError]"


@dataclass
class Station:
    """The station's cycle and its state. Other threads hold `lock`, or read only what is replaced and never changed: `views`,
    `paths`, `requests.recent`."""

    experiment: Experiment
    bus: Bus
    clock: Clock
    recorder: Recorder
    mission: Mission
    tuner: GainUpdater
    inboxes: FleetInboxes
    workers: Workers
    links: dict[int, LinkMonitor] = field(default_factory=dict)
    views: Fleet = field(default_factory=dict)  # as of the last cycle
    planning: "dict[str, PlanTask]" = field(default_factory=dict)
    published: PublishedPaths | None = None
    obstacles_up_to_ns: int | None = None  # where time waits: pictures up to then have been told of
    pending: list[tuple[Command, Future[Reply]]] = field(default_factory=list)
    paths: Mapping[int, tuple[Trajectory, float]] | None = None  # what each robot flies now, until when [s]
    asked_s: float = 0.0  # instant of the last request (s, monotonic)
    last_line: str = ""
    insecure: bool = False
    code: str = field(default_factory=lambda: code().short)  # of the station's program
    codes_told: set[str] = field(default_factory=set)
    recorder_told: bool = False
    pictures_told: bool = False
    lock: threading.Lock = field(default_factory=threading.Lock)  # requests come from network threads
    wake: threading.Event = field(default_factory=threading.Event)  # set by a request that cannot wait for the next cycle

    def __post_init__(self) -> None:
        self.core = StationCore(self.experiment, self.mission, self.tuner)
        self.single, self.requests = self.core.single, self.core.requests
        self.beat_s = time.monotonic()  # instant of the last heartbeat (s, monotonic)
        self._status = Status(state=self.mission.state, reason=self.mission.reason)

    def cycle(self, now_ns: int) -> None:
        """Read the fleet, step the mission, send its commands, publish the heartbeat."""
        with self.lock:
            self.views, answers = self.fleet(), self._answers()
            self.plan(now_ns)
            commands = self.core.step(self.views, answers, now_ns, self._around())
            self.plan(now_ns)
            self.publish_paths(now_ns)
            self._follow(answers)
            new_gains = self.tuner.take_unlogged()
        for gains in new_gains:
            self.bus.publish(topics.TUNING, gains, now_ns)
        timeout_s = PATIENT_ORDER_TIMEOUT_S if self.clock.waits else ORDER_TIMEOUT_S
        for command in commands:
            if self._unanswered(command) < MAX_UNANSWERED:
                # Sent from here, in the mission's order; only the waiting is for other threads.
                reply = self.bus.send_command(command, now_ns, timeout_s)
                self.pending.append((command, self.workers.of(command.order).submit(reply)))
        if self.clock.waits:
            for _, future in self.pending:
                future.result()
        stopped = self.mission.state is MissionState.STOPPED
        pace = self.mission.governor
        states = {robot: view.state for robot, view in self.views.items()}
        planned = tuple(robot for robot, state in states.items() if state is not None and state.estimate is not None)
        state = self.mission.state.name
        out, segment = tuple(sorted(self.mission.roster.out)), self.mission.segment
        sightings = silent_sightings(self.experiment, self.views)
        beat = StationHeartbeat(
            self.experiment.hash, stopped, state, pace.lag_s, 1.0 - pace.rate, planned, self.code, out, self.mission.began_ns,
            flight_s=0.0 if segment.is_return else segment.end_s,
            other_path=self.mission.plans.flown is not self.experiment or bool(segment.forms or segment.via),
            ready=self.mission.state in AT_REST and not self._unfit(),
            sightings=tuple(sightings),
            sightings_m=np.array(list(sightings.values())).reshape(-1, 2),
        )  # fmt: skip
        self.bus.publish(topics.HEARTBEAT, beat, now_ns)
        self.beat_s = time.monotonic()
        self._log_news()

    def _unanswered(self, command: Command) -> int:
        """Number of commands of this kind that the robot has not answered. More would only wait for one another."""
        return sum(c.robot == command.robot and c.order is command.order for c, _ in self.pending)

    def _follow(self, answers: Sequence[CommandResult]) -> None:
        """Update the progress of requests, and log those that have ended."""
        ended = self.ended
        for outcome in self.core.follow(self.views, answers):
            log.info("%s: %s", outcome.order.name, in_words(outcome))
        if self.ended and not ended:
            log.info("the run is ended")

    @property
    def ended(self) -> bool:
        """True once the run is over."""
        return self.core.ended

    def fleet(self) -> Fleet:
        """View of every robot now."""
        views = {}
        for robot in self.experiment.robot_ids:
            view = self.inboxes.view(robot, self.links.setdefault(robot, LinkMonitor()), self.clock)
            other = other_code(view.state.code, self.code) if view.state is not None else ""
            views[robot] = replace(self.core.view(robot, view, self.clock.now_ns()), other_code=other)
        return views

    def _lasting(self) -> dict[str, str]:
        """Warnings by key about what is so from a program's start: an open network, a localizer with other code."""
        texts = {"insecure": INSECURE if self.insecure else "", "localizer code": self._localizers_code()}
        return {key: text for key, text in texts.items() if text}

    def _localizers_code(self) -> str:
        """Text about a localizer with other code than the station's; empty if there is none."""
        localizer = self.inboxes.localizer.newest()
        text = other_code(localizer.message.code, self.code) if localizer is not None else ""
        return f"the localizer {text}" if text else ""

    def _around(self) -> ObstacleSet:
        """Obstacles that the localizer sees at rest; drifting ones are left to the robots, which see them too."""
        received = self.inboxes.obstacles.newest(self.obstacles_up_to_ns)
        if received is None:
            return ObstacleSet()
        return obstacle_set(received.message, age_s(self.clock, received), self.experiment.safety)

    def plan(self, now_ns: int) -> None:
        """Compute the plans that the mission and single robots wait for: in another thread, because the heartbeat must go on;
        where time waits at once. An outcome is dropped if no request waits for it any more."""
        for name, wanted in self.core.plan_requests():
            if name not in self.planning and wanted is not None:
                outcome = self.workers.plans.submit(_planned, wanted, self._patience(wanted))
                self.planning[name] = PlanTask(wanted, outcome)
            if self.clock.waits and name in self.planning:
                self._await_unlocked(self.planning[name].outcome)
        for name, wanted in self.core.plan_requests():  # asked again: requests came while this waited
            if name in self.planning and (self.clock.waits or self.planning[name].outcome.done()):
                task = self.planning.pop(name)
                if task.request is wanted:
                    self.core.planned(name, task.outcome.result(), self.views, now_ns)

    def _patience(self, plan: PlanRequest) -> OutOfTime:
        """Limit of time of a plan that begins now: while it is wanted, for its owner's next one waits until it has ended; and
        no longer than PLANNING_S, but where time waits: there a plan must not depend on the machine."""
        closing, deadline_s = self.workers.closing, math.inf if self.clock.waits else time.monotonic() + PLANNING_S

        def over() -> bool:
            wanted = any(request is plan for _, request in self.core.plan_requests())
            return closing.is_set() or not wanted or time.monotonic() > deadline_s

        return over

    def _await_unlocked(self, plan: "Future[PlanSegment | PlanError]") -> None:
        """Wait for a plan without the lock, which the cycle holds: an operator's requests are answered meanwhile."""
        self.lock.release()
        try:
            wait([plan])
        finally:
            self.lock.acquire()

    def publish_paths(self, now_ns: int) -> None:
        """Publish the trajectories flown from now on, for page and log: each robot's whole run with the formation from its
        beginning, or what it flies alone."""
        segment, trips = self.mission.segment, self.single.trips
        alone = {robot: trajectory for robot, (trajectory, _) in trips.items()}
        is_same_segment = self.published is not None and self.published.segment is segment
        alone_before = self.published.alone if self.published is not None and is_same_segment else None
        if alone == alone_before:
            return
        for robot, trajectory in self.mission.roster.history.items():
            flown = alone.get(robot, trajectory)
            if alone_before is None or flown is not alone_before.get(robot, trajectory):
                self.bus.publish(topics.TRAJECTORY, flown, now_ns, robot)
        formation = self.mission.roster.trajectories(segment)
        self.paths = {robot: (trajectory, segment.end_s) for robot, trajectory in formation.items()} | trips
        self.published = PublishedPaths(segment, alone)

    def _answers(self) -> list[CommandResult]:
        """The replies that have come since the last call, each once: a command is asked once whether it is answered."""
        done, still = list[CommandResult](), list[tuple[Command, Future[Reply]]]()
        for command, future in self.pending:
            if future.done():
                done.append(CommandResult(command, future.result()))
            else:
                still.append((command, future))
        self.pending = still
        return done

    def on_operator_command(self, header: Header, command: Command) -> Reply:
        """Serve a terminal: a request for the whole fleet or for one robot, or a query of its outcome. A TUNE without gains
        goes back to the gains before the last change."""
        valid = ALWAYS if command.order in ALWAYS_TAKEN else Validity(time.monotonic() + command.time_to_live_s)
        if command.about and command.order is CommandKind.NONE:
            outcome = self.requests.outcome(command.about)
            reason = "" if outcome is not None else f"request {command.about} is not known here (any more)"
            return Reply(WHOLE_FLEET, outcome is not None, reason, outcome=outcome)
        if command.tuning is not None and command.order is CommandKind.TUNE:
            keys = dict(zip(command.tuning.keys, command.tuning.values.tolist(), strict=False))
            reason, number = self.request_gains(keys or None, False, valid)
        else:
            via = [(x, y) for x, y in command.via.tolist()]
            reason, number = self.request(command.order, via, command.robot, command.text, valid)
        outcome = self.requests.outcome(number) if not reason else None
        return Reply(WHOLE_FLEET, not reason, reason, outcome=outcome)

    @contextmanager
    def _turn(self, valid: Validity) -> Iterator[str]:
        """Hold the lock for a request. Yields the reason for which its turn came too late, or nothing."""
        with self.lock:
            yield HELD_UP if time.monotonic() > valid.until_s else OVERTAKEN if self.asked_s > valid.asked_s else ""

    def request(
        self,
        order: CommandKind,
        via: Sequence[tuple[float, float]] = (),
        only: int = WHOLE_FLEET,
        text: str = "",
        valid: Validity = ALWAYS,
    ) -> tuple[str, int]:
        """Take an operator's request for the whole fleet, or for the robot `only`; a STOP is for everybody. Returns the reason
        of a refusal, or nothing, and the request's number."""
        if order is CommandKind.FAULT:
            return self._fault(text)
        with self._turn(valid) as reason:
            number = 0
            if not reason:
                reason, number = self.core.request(order, self.fleet(), self.clock.now_ns(), via, only, text)
            self.asked_s = time.monotonic()
        if order in PROMPT and not reason:
            self.wake.set()
        detail = f"for robot {only}" if only and order is not CommandKind.STOP else _shown(text)
        request = f"{order.name} {detail}".strip()
        log.info("%s %s", request, f"refused: {reason}" if reason else "asked for")
        return reason, number

    def _fault(self, text: str) -> tuple[str, int]:
        """Hand a person's fault to the simulator. Returns the reason of a refusal, or nothing, and the request's number."""
        simulator, number = process_name(Role.SIMULATOR), 0
        try:
            what, for_s = self.experiment.fault_request(text)
        except ValueError as error:
            reason = str(error)
        else:
            reason = ""
            if simulator not in self.bus.present:
                reason = "nothing here is simulated: only the simulator breaks things"
            elif what.startswith("radio") and not self.clock.waits:
                reason = "a radio breaks only in simulated time: start the run without --real-time"
        if not reason:
            self.bus.publish(topics.FAULT, FaultRequest(what, for_s), self.clock.now_ns())
            with self.lock:
                number = self.requests.note_done(CommandKind.FAULT, self.mission)
        log.info("FAULT %s %s", text, f"refused: {reason}" if reason else "asked for")
        return reason, number

    def draft(self, order: CommandKind, text: str) -> PlanSegment:
        """Plan another form of the formation, or another experiment's path, without flying it. Raises PlanError with the
        reason for which it cannot be."""
        with self.lock:
            make = self.mission.draft(order, text, self.views, self.clock.now_ns())
        until_s = time.monotonic() + DRAFT_S
        return make(lambda: time.monotonic() > until_s)

    def drive(self, robot: int, velocity: DriveVelocity, valid: Validity = ALWAYS) -> str:
        """Take a person's newest velocity for one robot. Returns the reason of a refusal, or nothing."""
        with self._turn(valid) as reason:
            return reason or self.core.drive(robot, velocity, self.fleet(), self.clock.now_ns())

    def come_to_rest(self) -> bool:
        """Hold every robot that moves: the station is about to leave. Returns False once none that is heard moves."""
        with self.lock:
            return self.core.come_to_rest(self.fleet(), self.clock.now_ns())

    def disarm(self) -> None:
        """Disarm every robot: the station is about to leave. No person has asked for it, so no request is logged."""
        with self.lock:
            self.core.leave(self.fleet(), self.clock.now_ns())

    def has_power(self) -> bool:
        """True while a robot that is heard may put out thrust."""
        return any(view.heard and view.mode in LIVE for view in self.views.values())

    def request_gains(self, values: Mapping[str, float] | None, next_lap: bool, valid: Validity = ALWAYS) -> tuple[str, int]:
        """Change the fleet's gains; None: go back to those before. Returns the reason of a refusal, or nothing, and the
        number."""
        with self._turn(valid) as reason:
            number = 0
            if not reason:
                reason, number = self.core.request_gains(values, next_lap, self.fleet(), self.clock.now_ns())
            self.asked_s = time.monotonic()
        what = "the gains before" if values is None else ", ".join(f"{key} = {value:g}" for key, value in values.items())
        when = " on the next lap" if next_lap else ""
        log.info("gains, %s%s: %s", what, when, f"refused: {reason}" if reason else "asked for")
        return reason, number

    def status(self) -> Status:
        """Status of mission and gains, for another thread. If the cycle holds the lock for longer than STATUS_WITHIN_S, the
        status of the last call."""
        if self.lock.acquire(timeout=STATUS_WITHIN_S):
            try:
                self._status = self._status_reply()
            finally:
                self.lock.release()
        return replace(self._status, beat_age_s=time.monotonic() - self.beat_s)

    def _status_reply(self) -> Status:
        """The station's status, for the page and terminals."""
        mission = self.mission
        return Status(
            state=mission.state,
            reason=mission.reason,
            recorder_error=self.recorder.error,
            lasting=self._lasting(),
            tuning=self.tuner.status(),
            laps=self.core.laps.laps(),
            preflight=self._unfit(),
            refused=mission.refusals(self.views) if self.views else {},
            views=self.views,
            requests=self.requests.recent,
            ended=self.ended,
            led=self.single.status(),
            began_ns=mission.began_ns,
            flown=mission.plans.flown.name,
            flown_s=mission.plans.flown.duration_s,
            left_s=max(mission.segment.end_s - mission.plans.progress_s, 0.0),
        )

    def _unfit(self) -> tuple[Finding, ...]:
        """Findings that keep robots from being armed."""
        return blocking_findings(self.experiment, self.views, self.mission.plans.starts)

    def _log_news(self) -> None:
        """Log, once each, other versions of the code, the recorder's troubles, and every change of the mission."""
        codes = {f"robot {robot} {view.other_code}" for robot, view in self.views.items() if view.other_code}
        codes |= {self._localizers_code()} - {""}
        for text in sorted(codes - self.codes_told):
            log.warning("%s (%s)", text, DEPLOY)
        self.codes_told |= codes
        if self.recorder.warning and not self.pictures_told:
            self.pictures_told = True
            log.warning("recorder: %s", self.recorder.warning)
        if self.recorder.error and not self.recorder_told:
            self.recorder_told = True
            log.error("recorder: %s", self.recorder.error)
        ready = self.mission.state is MissionState.WAITING and self.mission.reason in ("", ATTENDED)
        line = f"{READY if ready else self.mission.state.value}{f': {self.mission.reason}' if self.mission.reason else ''}"
        without_figures = FIGURE.sub("", line)
        if without_figures != self.last_line:
            self.last_line = without_figures
            degraded = self.mission.state is MissionState.DEGRADED and self.mission.roster.trouble
            (log.warning if degraded or self.mission.state in TROUBLED else log.info)("mission: %s", line)


def _shown(text: str) -> str:
    """A request's text for the log: of an experiment its name."""
    named = re.search(r'^name = "([\w-]+)"$', text, re.MULTILINE)
    return text if "\n" not in text else named[1] if named else "of another file"


def _planned(wanted: PlanRequest, out_of_time: OutOfTime) -> PlanSegment | PlanError:
    """Plan in the planner's thread. Returns the plan, or the reason why there is none."""
    try:
        return wanted.plan(out_of_time)
    except PlanError as error:
        return error
    except Exception as error:  # a bug in planning is no reason to leave a fleet in the water without its station
        log.exception("planning failed")
        return PlanError(f"planning failed: {type(error).__name__}: {error}")
