"""SHELL: the ground station: one cycle a control period, orders in their own threads; station_process.py runs it.

The heartbeat goes out from the same cycle that runs the mission: no thread of its own could outlive it. In lockstep the
orders of a cycle are answered before its heartbeat, so a robot that has the heartbeat has the orders.
"""

import re
import threading
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field, replace

from groundstation.asking import Answer
from groundstation.checks import PlanError
from groundstation.fleet import Ear, Fleet, preflight, view
from groundstation.inboxes import Inboxes
from groundstation.itinerary import Wanted
from groundstation.laps import Laps
from groundstation.legs import Leg
from groundstation.lookout import Surroundings, surroundings
from groundstation.mission import Mission
from groundstation.phases import Phase
from groundstation.recorder import Recorder
from groundstation.tuner import TUNING, Tuner
from groundstation.web.desk import Status
from wire import topics
from wire.bus import Bus
from wire.codec import Header
from wire.endpoint import PATIENT_MS
from wire.experiment import Experiment
from wire.frames import Array
from wire.messages import Command, Order, Reply, StationHeartbeat
from wire.runtime import Clock, age_s, log
from wire.topics import WHOLE_FLEET

ORDER_TIMEOUT_S = 0.5
LOCKSTEP_ORDER_TIMEOUT_S = PATIENT_MS * 1e-3  # as long as a link is kept: sent again, an order would count at a later step
TROUBLED = frozenset({Phase.FAILED, Phase.ABORTING, Phase.STOPPED, Phase.DEGRADED})
PROMPT = frozenset({Order.STOP, Order.DISARM, Order.HOLD})
FIGURE = re.compile(r"\d[\d.]*(?:%| (?:s|V|m|ms)\b)")  # a reason in which only these change is not told anew


@dataclass
class Station:
    """The station's cycle and what it holds."""

    experiment: Experiment
    bus: Bus
    clock: Clock
    recorder: Recorder
    mission: Mission
    tuner: Tuner
    laps: Laps
    heard: Inboxes
    pool: ThreadPoolExecutor
    starts: dict[int, Array]
    ears: dict[int, Ear] = field(default_factory=dict)
    seen: Fleet = field(default_factory=dict)  # as of the last cycle
    planning: "tuple[Wanted, Future[Leg | PlanError]] | None" = None
    published: Leg | None = None
    obstacles_up_to_ns: int | None = None  # in lockstep: pictures up to then have been told of
    pending: list[tuple[Command, Future[Reply]]] = field(default_factory=list)
    answers: deque[Answer] = field(default_factory=lambda: deque(maxlen=256))  # for people; taken from the left, if at all
    told: str = ""
    insecure: bool = False
    recorder_told: bool = False
    pictures_told: bool = False
    turn: threading.Lock = field(default_factory=threading.Lock)  # a person's wish comes from a network thread
    hurry: threading.Event = field(default_factory=threading.Event)  # a wish that is not to wait for the next cycle

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
            self.laps.note(self.seen)
            new_gains = self.tuner.untold()
        for gains in new_gains:
            self.bus.publish(topics.TUNING, gains, now_ns)
        timeout_s = LOCKSTEP_ORDER_TIMEOUT_S if lockstep else ORDER_TIMEOUT_S
        self.pending += [(c, self.pool.submit(self.bus.order, c, now_ns, timeout_s)) for c in commands]
        if lockstep:
            for _, future in self.pending:
                future.result()
        stopped = self.mission.phase is Phase.STOPPED
        pace = self.mission.pace
        planned = tuple(robot for robot, seen in self.seen.items() if seen.state is not None and seen.state.planned)
        phase = self.mission.phase.name
        beat = StationHeartbeat(self.experiment.hash, stopped, phase, pace.lag_s, 1.0 - pace.rate, planned)
        self.bus.publish(topics.HEARTBEAT, beat, now_ns)
        self._tell()

    def fleet(self) -> Fleet:
        """What is known of the robots now."""
        found = {}
        for robot in self.experiment.robot_ids:
            state, ear = self.heard.states[robot].newest(), self.ears.setdefault(robot, Ear())
            if state is not None:
                ear.hear(self.heard.states[robot].headers(), state.header, self.clock.instant_ns(state))
            found[robot] = view(state, self.heard.poses[robot].newest(), self.clock, self.heard.plans[robot].newest(), ear)
        return found

    def _around(self) -> Surroundings:
        """What the localizer sees lying in the pool; what drifts is left to the robots, who see it too."""
        received = self.heard.obstacles.newest(self.obstacles_up_to_ns)
        if received is None:
            return Surroundings()
        return surroundings(received.message, age_s(self.clock, received), self.experiment.safety)

    def _plan(self, lockstep: bool, now_ns: int) -> None:
        """Have made what the mission waits for: beside the cycle, which must beat on; in lockstep at once. What it no longer
        waits for when it is done counts for nothing."""
        wanted = self.mission.wanted
        if self.planning is None and wanted is not None:
            self.planning = wanted, self.pool.submit(_planned, wanted.plan)
        if self.planning is not None and (lockstep or self.planning[1].done()):
            (asked, outcome), self.planning = self.planning, None
            if asked is wanted:
                self.mission.planned(outcome.result(), now_ns)

    def publish_paths(self, now_ns: int) -> None:
        """Tell who shows or records it what is flown from now on: each robot's whole run, with what was flown before."""
        leg = self.mission.leg
        if leg is self.published:
            return
        for robot, trajectory in self.mission.crew.paths.items():
            self.bus.publish(topics.TRAJECTORY, trajectory, now_ns, robot)
        self.published = leg

    def _answers(self) -> list[Answer]:
        done = [(command, future) for command, future in self.pending if future.done()]
        self.pending = [entry for entry in self.pending if not entry[1].done()]
        answers = [Answer(command, future.result()) for command, future in done]
        self.answers.extend(replace(a, command=replace(a.command, trajectory=None)) for a in answers)  # paths are large
        return answers

    def wish(self, header: Header, command: Command) -> Reply:
        """A person's order for the whole fleet, from a terminal. Gains without any are those before the last change."""
        if command.tuning is not None:
            keys = dict(zip(command.tuning.keys, command.tuning.values.tolist(), strict=False))
            reason = self.tune(keys or None, next_lap=False)
        else:
            reason = self.ask(command.order, [(x, y) for x, y in command.via.tolist()])
        return Reply(WHOLE_FLEET, not reason, reason)

    def ask(self, order: Order, via: Sequence[tuple[float, float]] = ()) -> str:
        """A person's order for the whole fleet. Why not, or nothing when it is under way."""
        with self.turn:
            reason = self.mission.wish(order, self.seen, self.clock.now_ns(), via)
        if order in PROMPT and not reason:
            self.hurry.set()
        log.info("%s asked for: %s", order.name, reason or "under way")
        return reason

    def tune(self, values: Mapping[str, float] | None, next_lap: bool) -> str:
        """Other gains for the whole fleet; None: those before. Why not, or nothing when it is under way."""
        with self.turn:
            fleet, now_ns = self.fleet(), self.clock.now_ns()
            if values is None:
                reason, what = self.tuner.undo(fleet, now_ns), "the gains before"
            else:
                reason = self.tuner.wish(values, next_lap, fleet, now_ns)
                what = ", ".join(f"{key} = {value:g}" for key, value in values.items())
        log.info("asked for %s%s: %s", what, " on the next lap" if next_lap else "", reason or "under way")
        return reason

    def status(self) -> Status:
        """Where mission and gains stand."""
        mission, barred = self.mission, preflight(self.experiment, self.seen, self.starts)
        tuning, laps = self.tuner.status(), self.laps.rows()
        return Status(mission.phase, mission.reason, self.recorder.error, self.insecure, tuning, laps, barred)

    def _tell(self) -> None:
        if self.recorder.warning and not self.pictures_told:
            self.pictures_told = True
            log.warning("recorder: %s", self.recorder.warning)
        if self.recorder.error and not self.recorder_told:
            self.recorder_told = True
            log.error("recorder: %s", self.recorder.error)
        line = f"{self.mission.phase.value}{f': {self.mission.reason}' if self.mission.reason else ''}"
        told = FIGURE.sub("", line)
        if told != self.told:
            self.told = told
            (log.warning if self.mission.phase in TROUBLED else log.info)("mission: %s", line)


def _planned(make: Callable[[], Leg]) -> Leg | PlanError:
    try:
        return make()
    except PlanError as error:
        return error
    except Exception as error:  # a bug in planning is no reason to leave a fleet in the water without its station
        log.exception("planning failed")
        return PlanError(f"planning failed: {type(error).__name__}: {error}")
