"""READ FIRST. The mission: from robots lying in the water to a run that is over, along the table in groundstation/phases.py.

Pure: `step(fleet, answers, now_ns, around)` returns the orders to send; groundstation/station.py sends them. An order that is
refused or unanswered is sent again (asking.py) until PATIENCE_S have gone by in a phase. What is flown, now and next, is in
itinerary.py. Plans take time: the mission says which one it wants (`wanted`) and is told what came of it (`planned`).
"""

from collections.abc import Mapping, Sequence

from groundstation.asking import Answer, Asking
from groundstation.checks import PlanError
from groundstation.crew import Crew
from groundstation.fleet import Fleet, casualty, preflight
from groundstation.itinerary import Itinerary, Wanted
from groundstation.legs import Leg
from groundstation.lookout import Surroundings
from groundstation.pacing import Pace
from groundstation.phases import FLYING, OVER, UNDER_WAY, Event, Phase, after, refusal
from groundstation.stages import STAGES, Stage
from groundstation.watch import noticed
from groundstation.wishes import UNFIT, can_move, objection
from wire import topics
from wire.experiment import Experiment
from wire.frames import Array
from wire.messages import Command, Mode, Order

START_IN_S = 0.5  # from the order to the first step along the trajectory, so that all have heard it
PATIENCE_S = 10.0  # in a phase that waits for robots to obey
TEST_PATIENCE_S = 12.0
SETTLE_S = 1.0  # an automatic mission goes on this long after everybody holds and is well again
AT_REST_MPS = 0.03
REST_WITHIN_S = 8.0  # robots that hold against waves never quite rest

GETTING_READY = frozenset({Phase.ARMING, Phase.STARTING})
BEFORE_REST = frozenset({Phase.HALTING, Phase.RELOADING, Phase.REARMING, Phase.RELEASING, Phase.RESUMING})


class Mission:
    """One run of an experiment. `automatic` goes from WAITING to DONE by itself; otherwise START asks for it."""

    def __init__(self, experiment: Experiment, leg: Leg, starts: Mapping[int, Array], automatic: bool) -> None:
        """`starts`: poses (4,) in which the robots begin."""
        self.phase = Phase.WAITING
        self.reason = ""  # why it waits, or why it failed
        self.failed = False
        self.automatic = automatic
        self.pace = Pace(experiment.mission)
        self.crew = Crew(experiment.robot_ids, leg)
        self.itinerary = Itinerary(experiment, leg, starts, self.crew)
        self._asking = Asking(experiment.hash, self.itinerary, self.crew)
        self._experiment, self._starts = experiment, dict(starts)
        self._since_ns = 0
        self._stop_after: Phase | None = None  # a person asked for no more than this stage
        self._held_by_person = False
        self._gap = False  # somebody was lost while the others had to hold: they close up when they may go on

    @property
    def leg(self) -> Leg:
        """What is flown."""
        return self.itinerary.leg

    @property
    def wanted(self) -> Wanted | None:
        """The plan that is waited for."""
        return self.itinerary.wanted

    # --- what people ask for

    def wish(self, order: Order, fleet: Fleet, now_ns: int, via: Sequence[tuple[float, float]] = ()) -> str:
        """What a person at the station asks for. Returns why not, or nothing when it is under way."""
        reason = refusal(order, self.phase) or objection(
            order, self._experiment, fleet, self.crew, self.leg, self._starts, via
        )
        if reason:
            return reason
        if order in (Order.LOAD, Order.ARM, Order.START, Order.TEST):
            self._begin_anew()
        self._stop_after = {Order.LOAD: Phase.LOADING, Order.ARM: Phase.ARMING}.get(order)
        self._held_by_person = order in (Order.HOLD, Order.CLEAR_STOP)
        if order is Order.RETURN:
            self._come_home(fleet)
        if order is Order.REJOIN:
            self.crew.take_back()
            self.itinerary.take_places()
        self._go(order, now_ns)
        if order is Order.RESUME:
            self._clear_of_lost(fleet, now_ns)
        if order is Order.GO:
            self.itinerary.want_detour(fleet, now_ns, tuple(via))
        return ""

    def _begin_anew(self) -> None:
        self.failed = self._gap = False
        self.itinerary.begin_anew()
        self.pace.start()

    def _come_home(self, fleet: Fleet) -> None:
        if self.phase in (Phase.WAITING, *OVER):
            self._begin_anew()
        for robot in self.crew.active:
            if not can_move(fleet[robot]):
                self.crew.lose(robot, "not fit to move")
        self.itinerary.head_home()

    # --- the cycle

    def step(
        self, fleet: Fleet, answers: Sequence[Answer], now_ns: int, around: Surroundings | None = None
    ) -> tuple[Command, ...]:
        """One cycle: the orders to send now."""
        self.reason = self._asking.listen(answers) or self.reason
        self.itinerary.lookout.see(around, now_ns)
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

    def _wait(self, fleet: Fleet, now_ns: int) -> tuple[Command, ...]:
        reasons = preflight(self._experiment, fleet, self._starts)
        self.reason = "; ".join(reasons)
        if self.automatic and not self._held_by_person and not reasons:
            self._begin_anew()
            self._go(Event.FIT, now_ns)
        return ()

    def _watch(self, fleet: Fleet, now_ns: int) -> None:
        """Look for the end of the run, for robots that fell out of it, for what lies in the way."""
        self._count_losses(fleet, now_ns)
        if not self.crew.active or self.phase not in FLYING | {Phase.PAUSED}:
            return
        plans = self.itinerary
        plans.reached_s = min(fleet[r].trajectory_s for r in self.crew.active)
        if self.phase is Phase.PAUSED:
            return
        fresh, slowed = now_ns - self._since_ns <= topics.STATE.max_age_s * 1e9, self.pace.slowed
        notice = noticed(
            self.phase,
            fleet,
            self.crew,
            plans.leg,
            plans.reached_s,
            fresh,
            slowed,
            lambda: plans.blocked(fleet, now_ns),
            blind_holds=self._experiment.mission.blind == "hold",
        )
        if notice is None:
            return
        self._go(notice.cause, now_ns)
        self.reason = notice.reason
        if notice.cause is Event.OBSTACLE:
            plans.want_detour(fleet, now_ns)

    def _count_losses(self, fleet: Fleet, now_ns: int) -> None:
        """Robots that are gone: what then is the experiment's policy."""
        under_way = self.phase in UNDER_WAY
        trouble = casualty(self.crew.active, fleet, disarmed_counts=under_way)
        if trouble is None:
            return
        robot, why = trouble
        policy = self._experiment.mission.lost
        if policy == "abort" or len(self.crew.active) == 1:
            self._fail(f"robot {robot}: {why}", now_ns)
            return
        self.crew.lose(robot, why)
        if policy == "hold" and under_way:
            if self.phase is not Phase.PAUSED:
                self._go(Event.LOST_HOLD, now_ns)
            self._held_by_person = True  # who decides what then is a person
        if policy == "close-up" and under_way and not self.leg.home:
            self._gap = True
            if not self._held_by_person:
                self._close_up(fleet, now_ns)
        self.reason = f"robot {robot}: {why}"

    def _close_up(self, fleet: Fleet, now_ns: int) -> None:
        self._gap = False
        self.crew.close_up(self.leg, self.itinerary.reached_s, fleet)
        self.itinerary.take_places()
        self._go(Event.LOST_CLOSE_UP, now_ns)

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
        if moving or unfit or (self.itinerary.blocked(fleet) and not self.crew.out):
            self._since_ns = now_ns
        elif self.automatic and not self._held_by_person and now_ns - self._since_ns > SETTLE_S * 1e9:
            self._go(Event.WELL, now_ns)
            self._clear_of_lost(fleet, now_ns)
        return self._ask(Order.HOLD, moving, now_ns)

    def _clear_of_lost(self, fleet: Fleet, now_ns: int) -> None:
        """Robots coast on when they are lost, and those who hold do not turn back: where that leaves somebody's place beside
        one, all go on from the next places on their way that are free. A gap that came while a person had them hold closes."""
        if not self.crew.out or self.leg.home:
            return
        if self._gap:
            self._close_up(fleet, now_ns)
        elif self.itinerary.blocked(fleet):
            self.itinerary.take_places()
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
        if not fast or waited_s > REST_WITHIN_S:
            self.itinerary.want_way(fleet)
        return ()

    def _test(self, fleet: Fleet, now_ns: int) -> tuple[Command, ...]:
        states = {r: fleet[r].state for r in self.crew.active}
        results = {r: s.thruster_test if s is not None and r in self._asking.tested else "" for r, s in states.items()}
        if all(result not in ("", "running") for result in results.values()):
            self._go(Event.OBEYED, now_ns)
            failed = [f"robot {r}: {result}" for r, result in results.items() if result != "passed"]
            self.reason = "; ".join(failed) or "all thrusters as asked"
            return ()
        if now_ns - self._since_ns > TEST_PATIENCE_S * 1e9:
            self._unheeded(f"the thruster test does not end: {results}", now_ns)
            return ()
        return self._ask(Order.TEST, [r for r in self.crew.active if r not in self._asking.tested], now_ns)

    # --- another path under way

    def planned(self, outcome: Leg | PlanError, now_ns: int) -> None:
        """What came of the plan that was wanted."""
        self.itinerary.wanted = None
        if self.phase is Phase.HALTING:
            if isinstance(outcome, Leg):
                self.itinerary.adopt(outcome)
                self._go(Event.PLANNED, now_ns)
            else:
                self._go(Event.NO_PLAN, now_ns)
                self._held_by_person, self.reason = True, f"no way from here: {outcome}"
        elif self.phase is Phase.SWITCHING:
            if isinstance(outcome, Leg):
                self.itinerary.next, self._asking.accepted = outcome, set()
                return
            before = self.reason
            self._go(Event.NO_PLAN if self.itinerary.by_person else Event.BLOCKED, now_ns)
            self.reason = f"no way there: {outcome}" if self.itinerary.by_person else f"{before}; no way round: {outcome}"

    def _switch(self, fleet: Fleet, now_ns: int) -> tuple[Command, ...]:
        """Give everybody the next leg; when all have it, let all go over where it begins."""
        plans = self.itinerary
        if plans.next is None:
            if plans.reached_s > plans.deadline_s:
                self._unheeded("no plan in time", now_ns)
            return ()
        going = [r for r in self.crew.active if not self.crew.is_on(plans.next, fleet, r)]
        if not going:
            plans.adopt(plans.next)
            self._go(Event.OBEYED, now_ns)
            return ()
        if plans.reached_s > plans.deadline_s:
            self._unheeded(f"robot {', '.join(map(str, going))} has not gone over in time: {self.reason}", now_ns)
            return ()
        missing = [r for r in going if r not in self._asking.accepted]
        return self._ask(Order.LOAD, missing, now_ns) if missing else self._ask(Order.SWITCH, going, now_ns)

    # --- orders

    def _not_in(self, mode: Mode, fleet: Fleet, robots: Sequence[int]) -> list[int]:
        return [r for r in robots if fleet[r].mode is not mode]

    def _ask(self, order: Order, robots: Sequence[int], now_ns: int) -> tuple[Command, ...]:
        if order not in (Order.START, Order.RESUME):
            return self._asking.orders(order, robots, now_ns)
        left_s = START_IN_S - (now_ns - self._since_ns) * 1e-9  # a second try starts at the same instant as the first
        from_s = self.itinerary.reached_s if self.phase is Phase.RESUMING else self.leg.centre.begin_s
        return self._asking.orders(order, robots, now_ns, max(left_s, 0.0), from_s + self.pace.lag_s)

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
            self.itinerary.next = None
        self.itinerary.wanted = None  # a plan for what went before would be taken for the one that comes next
        if phase is Phase.TEST_ARMING:
            self._asking.tested = set()
        self.phase, self._since_ns = phase, now_ns
        self._asking.anew()
