"""READ FIRST. The mission: from robots lying in the water to a run that is over, along the table in groundstation/phases.py.

Pure: `step(fleet, answers, now_ns, things)` returns the orders to send; groundstation/station.py sends them. An order that is
refused or unanswered is sent again, at most once in RETRY_S, until PATIENCE_S have gone by in a phase. Plans take time: the
mission says which one it wants (`wanted`) and is told what came of it (`planned`).
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

from groundstation.checks import PlanError
from groundstation.crew import Crew
from groundstation.detour import detour
from groundstation.fleet import Fleet, casualty, preflight
from groundstation.from_rest import gathered, homeward
from groundstation.legs import Leg, on_grid
from groundstation.lookout import Lookout, Surroundings
from groundstation.pacing import Pace
from groundstation.phases import FLYING, OVER, Event, Phase, after, refusal
from groundstation.stages import STAGES, Stage
from groundstation.watch import noticed
from groundstation.wishes import UNFIT, can_move, objection
from wire import topics
from wire.experiment import Experiment
from wire.frames import Array
from wire.messages import Command, Mode, Order, Reply

__all__ = ["OVER", "STAGES", "Answer", "Mission", "Phase", "Surroundings"]

START_IN_S = 0.5  # from the order to the first step along the trajectory, so that all have heard it
RETRY_S = 0.25
PATIENCE_S = 10.0  # in a phase that waits for robots to obey
TEST_PATIENCE_S = 12.0
SETTLE_S = 1.0  # an automatic mission goes on this long after everybody holds and is well again
AHEAD_S = 2.0  # from asking for another path to where it begins: planning, and telling everybody
LAST_CALL_S = 0.3  # before that, everybody must have it
AT_REST_MPS = 0.03
REST_WITHIN_S = 8.0  # robots that hold against waves never quite rest

GETTING_READY = frozenset({Phase.ARMING, Phase.STARTING})
BEFORE_REST = frozenset({Phase.HALTING, Phase.RELOADING, Phase.REARMING, Phase.RELEASING, Phase.RESUMING})


@dataclass(frozen=True)
class Answer:
    """What became of an order."""

    command: Command
    reply: Reply


@dataclass(frozen=True)
class Wanted:
    """A plan that the mission waits for. Whoever computes it calls `plan` and gives the mission what comes of it."""

    what: str
    plan: Callable[[], Leg]


class Mission:
    """One run of an experiment. `automatic` goes from WAITING to DONE by itself; otherwise START asks for it."""

    def __init__(self, experiment: Experiment, leg: Leg, starts: Mapping[int, Array], automatic: bool) -> None:
        """`starts`: poses (4,) in which the robots begin."""
        self.phase = Phase.WAITING
        self.reason = ""  # why it waits, or why it failed
        self.failed = False
        self.automatic = automatic
        self.leg = leg
        self.pace = Pace(experiment.mission)
        self.wanted: Wanted | None = None
        self.crew = Crew(experiment.robot_ids, leg)
        self._experiment, self._first, self._starts = experiment, leg, dict(starts)
        self._lookout = Lookout(experiment)
        self._next: Leg | None = None  # flown from its beginning on, once all have it
        self._since_ns = 0
        self._asked_ns: dict[int, int] = {}
        self._accepted: set[int] = set()  # robots that hold the next leg's trajectory
        self._reached_s = 0.0  # along the trajectories; common to all, so that a resumed formation is still in step
        self._stop_after: Phase | None = None  # a person asked for no more than this stage
        self._held_by_person = False
        self._purpose: Callable[[Fleet, float], Leg] | None = None  # of coming to rest
        self._deadline_s = 0.0  # of SWITCHING, on the trajectories' clock
        self._asked_by_person = False  # for another path
        self._tested: set[int] = set()

    # --- what people ask for

    def wish(self, order: Order, fleet: Fleet, now_ns: int, via: Sequence[tuple[float, float]] = ()) -> str:
        """What a person at the station asks for. Returns why not, or nothing when it is under way."""
        reason = refusal(order, self.phase) or objection(
            order, self._experiment, fleet, self.crew, self.leg, self._starts, via
        )
        if reason:
            return reason
        if order in (Order.LOAD, Order.ARM, Order.START):
            self._begin_anew()
        self._stop_after = {Order.LOAD: Phase.LOADING, Order.ARM: Phase.ARMING}.get(order)
        self._held_by_person = order is Order.HOLD
        if order is Order.RETURN:
            self._come_home(fleet)
        if order is Order.REJOIN:
            self.crew.take_back()
            self._purpose = self._into_place
        self._go(order, now_ns)
        if order is Order.RESUME:
            self._clear_of_lost(fleet, now_ns)
        if order is Order.GO:
            self._want_detour(fleet, now_ns, tuple(via))
        return ""

    def _begin_anew(self) -> None:
        self.failed, self.leg, self._reached_s = False, self._first, 0.0
        self.crew.begin(self._first)
        self.pace.start()

    def _come_home(self, fleet: Fleet) -> None:
        if self.phase in (Phase.WAITING, *OVER):
            self._begin_anew()
        for robot in self.crew.active:
            if not can_move(fleet[robot]):
                self.crew.lose(robot, "not fit to move")
        self._purpose = lambda seen, begin_s: homeward(
            self._experiment, begin_s, self.crew.rests(seen), self._starts, self._in_the_way(seen)
        )

    def _into_place(self, fleet: Fleet, begin_s: float) -> Leg:
        rests, slots, things = self.crew.rests(fleet), self.crew.active_slots(), self._in_the_way(fleet)
        return gathered(self._experiment, self.leg, begin_s, self._reached_s, rests, slots, things)

    # --- the cycle

    def step(
        self, fleet: Fleet, answers: Sequence[Answer], now_ns: int, around: Surroundings | None = None
    ) -> tuple[Command, ...]:
        """One cycle: the orders to send now."""
        self._listen(answers)
        self._lookout.see(around, now_ns)
        if self.phase is Phase.WAITING:
            return self._wait(fleet, now_ns)
        if self.phase in FLYING or self.phase is Phase.PAUSED or self.phase in BEFORE_REST:
            self._watch(fleet, now_ns)
        self._keep_pace(fleet)
        if self.phase in STAGES:
            return self._drive(STAGES[self.phase], fleet, now_ns)
        if self.phase is Phase.SWITCHING:
            return self._switch(fleet, now_ns)
        if self.phase is Phase.HALTING:
            return self._halt(fleet, now_ns)
        if self.phase is Phase.TESTING:
            return self._test(fleet, now_ns)
        if self.phase is Phase.PAUSED:
            return self._pause(fleet, now_ns)
        if self.phase is Phase.STOPPED:
            return self._ask(Order.STOP, self._not_in(Mode.STOPPED, fleet, self._experiment.robot_ids), now_ns)
        return ()

    def _listen(self, answers: Sequence[Answer]) -> None:
        for answer in answers:
            command = answer.command
            if command.robot not in self.crew.everybody:
                continue
            held = self.crew.trajectory(self._next, command.robot)
            if not answer.reply.accepted:
                self.reason = f"robot {command.robot} refuses {command.order.name}: {answer.reply.reason}"
            elif command.order is Order.LOAD and held is not None and command.trajectory_id == held.id:
                self._accepted.add(command.robot)
            elif command.order is Order.TEST:
                self._tested.add(command.robot)

    def _wait(self, fleet: Fleet, now_ns: int) -> tuple[Command, ...]:
        reasons = preflight(self._experiment, fleet, self._starts)
        self.reason = "; ".join(reasons)
        if self.automatic and not reasons:
            self._begin_anew()
            self._go(Event.FIT, now_ns)
        return ()

    def _watch(self, fleet: Fleet, now_ns: int) -> None:
        """Look for the end of the run, for robots that fell out of it, for what lies in the way."""
        self._count_losses(fleet, now_ns)
        if not self.crew.active or self.phase not in FLYING | {Phase.PAUSED}:
            return
        self._reached_s = min(fleet[r].trajectory_s for r in self.crew.active)
        if self.phase is Phase.PAUSED:
            return
        fresh, slowed = now_ns - self._since_ns <= topics.STATE.max_age_s * 1e9, self.pace.slowed
        notice = noticed(
            self.phase, fleet, self.crew, self.leg, self._reached_s, fresh, slowed, lambda: self._blocked(fleet, now_ns)
        )
        if notice is None:
            return
        self._go(notice.cause, now_ns)
        self.reason = notice.reason
        if notice.cause is Event.OBSTACLE:
            self._want_detour(fleet, now_ns, ())

    def _count_losses(self, fleet: Fleet, now_ns: int) -> None:
        """Robots that are gone: what then is the experiment's policy."""
        under_way = self.phase in FLYING or self.phase is Phase.PAUSED
        trouble = casualty(self.crew.active, fleet, disarmed_counts=under_way)
        if trouble is None:
            return
        robot, why = trouble
        policy = self._experiment.mission.lost
        if policy == "abort" or len(self.crew.active) == 1:
            self._fail(f"robot {robot}: {why}", now_ns)
            return
        self.crew.lose(robot, why)
        if policy == "hold" and self.phase in FLYING:
            self._go(Event.LOST_HOLD, now_ns)
            self._held_by_person = True  # who decides what then is a person
        if policy == "close-up" and under_way and not self.leg.home:
            self.crew.close_up(self.leg, self._reached_s, fleet)
            self._purpose = self._into_place
            self._go(Event.LOST_CLOSE_UP, now_ns)
        self.reason = f"robot {robot}: {why}"

    def _keep_pace(self, fleet: Fleet) -> None:
        if self.phase in FLYING:
            worst_m = max((fleet[r].error_m for r in self.crew.active), default=0.0)
            self.pace.step(worst_m, self._experiment.controller.period_s)
        else:
            self.pace.reset()

    # --- stages

    def _drive(self, stage: Stage, fleet: Fleet, now_ns: int) -> tuple[Command, ...]:
        concerned = self._concerned(fleet)
        waiting = [r for r in concerned if not stage.obeyed(fleet[r].mode, self.crew.is_on(self.leg, fleet, r))]
        if not waiting:
            if self.phase is not self._stop_after:
                self._go(Event.OBEYED, now_ns)
            return ()
        fallen = casualty([r for r in waiting if fleet[r].mode in UNFIT], fleet)
        if fallen is not None and self.phase in GETTING_READY:  # no order but DISARM would reach it
            self._unheeded(f"robot {fallen[0]}: {fallen[1]}", now_ns)
            return ()
        if now_ns - self._since_ns > PATIENCE_S * 1e9:
            late = ", ".join(str(r) for r in waiting)
            self._unheeded(f"robot {late} does not follow {stage.order.name}: {self.reason or 'no answer'}", now_ns)
            return ()
        return self._ask(stage.order, waiting, now_ns)

    def _concerned(self, fleet: Fleet) -> Sequence[int]:
        """Who gets a stage's orders: to be disarmed, also robots that are out but can hear."""
        everybody = self._experiment.robot_ids
        if self.phase in (Phase.ABORTING, Phase.CLEARING):
            return everybody
        if self.phase is Phase.ENDING:
            return [r for r in everybody if r not in self.crew.out or (fleet[r].heard and fleet[r].mode is not Mode.STOPPED)]
        return self.crew.active

    def _unheeded(self, why: str, now_ns: int) -> None:
        if self.phase is not Phase.SWITCHING:
            self.failed = True
        self._go(Event.UNHEEDED, now_ns)
        self.reason = why

    def _pause(self, fleet: Fleet, now_ns: int) -> tuple[Command, ...]:
        """Everybody holds. Only an automatic mission goes on by itself, when all are well again."""
        moving = self._not_in(Mode.HOLDING, fleet, self.crew.active)
        unfit = preflight(self._experiment, {r: fleet[r] for r in self.crew.active})
        if moving or unfit or (self._blocked(fleet) and not self.crew.out):
            self._since_ns = now_ns
        elif self.automatic and not self._held_by_person and now_ns - self._since_ns > SETTLE_S * 1e9:
            self._go(Event.WELL, now_ns)
            self._clear_of_lost(fleet, now_ns)
        return self._ask(Order.HOLD, moving, now_ns)

    def _clear_of_lost(self, fleet: Fleet, now_ns: int) -> None:
        """Robots coast on when they are lost, and those who hold do not turn back: where that leaves somebody's place beside
        one, all go on from the next places on their way that are free."""
        if self.crew.out and not self.leg.home and self._blocked(fleet):
            self._purpose = self._into_place
            self._go(Event.BESIDE_LOST, now_ns)

    def _halt(self, fleet: Fleet, now_ns: int) -> tuple[Command, ...]:
        """Bring everybody who moves to rest, then ask for the plan."""
        flying = [r for r in self.crew.active if fleet[r].mode is Mode.TRACKING]
        waited_s = (now_ns - self._since_ns) * 1e-9
        if flying:
            if waited_s > PATIENCE_S:
                self._unheeded(f"robot {', '.join(map(str, flying))} does not follow HOLD", now_ns)
                return ()
            return self._ask(Order.HOLD, flying, now_ns)
        fast = any(fleet[r].speed_mps > AT_REST_MPS for r in self.crew.active if fleet[r].mode is Mode.HOLDING)
        if self.wanted is None and self._purpose is not None and (not fast or waited_s > REST_WITHIN_S):
            period_s = self._experiment.controller.period_s
            begin_s = on_grid(self._reached_s + period_s, period_s)
            purpose, seen = self._purpose, dict(fleet)
            self.wanted = Wanted("a way for everybody from rest", lambda: purpose(seen, begin_s))
        return ()

    def _test(self, fleet: Fleet, now_ns: int) -> tuple[Command, ...]:
        states = {r: fleet[r].state for r in self.crew.active}
        results = {r: s.thruster_test if s is not None and r in self._tested else "" for r, s in states.items()}
        if all(result not in ("", "running") for result in results.values()):
            self._go(Event.OBEYED, now_ns)
            failed = [f"robot {r}: {result}" for r, result in results.items() if result != "passed"]
            self.reason = "; ".join(failed) or "all thrusters as asked"
            return ()
        if now_ns - self._since_ns > TEST_PATIENCE_S * 1e9:
            self._unheeded(f"the thruster test does not end: {results}", now_ns)
            return ()
        return self._ask(Order.TEST, [r for r in self.crew.active if r not in self._tested], now_ns)

    # --- another path under way

    def _in_the_way(self, fleet: Fleet, now_ns: int | None = None, room_m: float | None = None) -> Array:
        return self._lookout.in_the_way([fleet[r] for r in self.crew.out], now_ns, room_m)

    def _blocked(self, fleet: Fleet, now_ns: int | None = None) -> str:
        """Where the formation would touch something; empty if nowhere."""
        leg = replace(self.leg, trajectories=self.crew.flown(self.leg))
        return self._lookout.contact(leg, self._reached_s, self._in_the_way(fleet, now_ns, 0.0))

    def _want_detour(self, fleet: Fleet, now_ns: int, via: tuple[tuple[float, float], ...]) -> None:
        begin_s = on_grid(self._reached_s + AHEAD_S, self._experiment.controller.period_s)
        leg, things = self.leg, self._in_the_way(fleet, now_ns)
        self._deadline_s, self._asked_by_person = begin_s - LAST_CALL_S, bool(via)
        self.wanted = Wanted("another path", lambda: detour(self._experiment, leg, begin_s, things, via))

    def planned(self, outcome: Leg | PlanError, now_ns: int) -> None:
        """What came of the plan that was wanted."""
        self.wanted = None
        if self.phase is Phase.HALTING:
            if isinstance(outcome, Leg):
                self._adopt(outcome)
                self._go(Event.PLANNED, now_ns)
            else:
                self._go(Event.NO_PLAN, now_ns)
                self._held_by_person, self.reason = True, f"no way from here: {outcome}"
        elif self.phase is Phase.SWITCHING:
            if isinstance(outcome, Leg):
                self._next, self._accepted = outcome, set()
                return
            before = self.reason
            self._go(Event.NO_PLAN if self._asked_by_person else Event.BLOCKED, now_ns)
            self.reason = f"no way there: {outcome}" if self._asked_by_person else f"{before}; no way round: {outcome}"

    def _adopt(self, leg: Leg) -> None:
        self.leg, self._next = leg, None
        self.crew.adopt(leg)

    def _switch(self, fleet: Fleet, now_ns: int) -> tuple[Command, ...]:
        """Give everybody the next leg; when all have it, let all go over where it begins."""
        if self._next is None:
            if self._reached_s > self._deadline_s:
                self._unheeded("no plan in time", now_ns)
            return ()
        going = [r for r in self.crew.active if not self.crew.is_on(self._next, fleet, r)]
        if not going:
            self._adopt(self._next)
            self._go(Event.OBEYED, now_ns)
            return ()
        if self._reached_s > self._deadline_s:
            self._unheeded(f"robot {', '.join(map(str, going))} has not gone over in time: {self.reason}", now_ns)
            return ()
        missing = [r for r in going if r not in self._accepted]
        return self._ask(Order.LOAD, missing, now_ns) if missing else self._ask(Order.SWITCH, going, now_ns)

    # --- orders

    def _not_in(self, mode: Mode, fleet: Fleet, robots: Sequence[int]) -> list[int]:
        return [r for r in robots if fleet[r].mode is not mode]

    def _ask(self, order: Order, robots: Sequence[int], now_ns: int) -> tuple[Command, ...]:
        """Orders for those robots that have not been asked within RETRY_S."""
        due = [r for r in robots if now_ns - self._asked_ns.get(r, -(10**18)) >= RETRY_S * 1e9]
        for robot in due:
            self._asked_ns[robot] = now_ns
        return tuple(self._command(order, robot, now_ns) for robot in due)

    def _command(self, order: Order, robot: int, now_ns: int) -> Command:
        leg = self._next if self._next is not None and order in (Order.LOAD, Order.SWITCH) else self.leg
        trajectory = self.crew.trajectory(leg, robot)
        starts = order in (Order.START, Order.RESUME)
        left_s = START_IN_S - (now_ns - self._since_ns) * 1e-9  # a second try starts at the same instant as the first
        from_s = self._reached_s if self.phase is Phase.RESUMING else self.leg.centre.begin_s
        return Command(
            order,
            robot,
            experiment_hash=self._experiment.hash,
            trajectory_id=trajectory.id if trajectory is not None else "",
            start_in_s=max(left_s, 0.0) if starts else 0.0,
            trajectory_s=from_s + self.pace.lag_s if starts else 0.0,
            trajectory=trajectory if order is Order.LOAD else None,
        )

    def _fail(self, reason: str, now_ns: int) -> None:
        self.failed = True
        self._go(Event.LOST if after(self.phase, Event.LOST) else Event.UNHEEDED, now_ns)
        self.reason = reason

    def _go(self, cause: Order | Event, now_ns: int) -> None:
        """Along the table, and in no other way."""
        phase = after(self.phase, cause)
        if phase is None:
            raise RuntimeError(f"{cause.name} leads nowhere from {self.phase.name}")
        if phase is Phase.DONE and self.failed:
            phase = Phase.FAILED
        if phase not in (Phase.FAILED, Phase.DONE, Phase.ABORTING):
            self.reason = ""
        if phase is not Phase.SWITCHING:
            self._next = None
        if phase is not Phase.HALTING and phase is not Phase.SWITCHING:
            self.wanted = None
        self._tested = set() if phase is Phase.TEST_ARMING else self._tested
        self.phase, self._since_ns = phase, now_ns
        self._asked_ns.clear()
