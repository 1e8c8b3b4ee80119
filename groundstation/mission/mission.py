"""READ FIRST. The mission: from robots lying in the water to a run that is over, along the table in
groundstation/mission/state_machine.py.

Pure: `step(fleet, answers, now_ns, around)` returns the orders to send; groundstation/station/station.py sends them. An order
that is refused or unanswered is sent again (command_dispatcher.py) until a robot has been waited for PATIENCE_S. What is
flown, now and next, is in plan_manager.py, since when, in timetable.py. Plans take time: the mission says which one it wants
(`wanted`) and is told what came of it (`planned`).
"""

from collections.abc import Iterator, Mapping, Sequence

import numpy as np

from groundstation.mission.command_dispatcher import Answer, Asking
from groundstation.mission.obstacle_monitor import Surroundings
from groundstation.mission.plan_manager import Itinerary, Wanted
from groundstation.mission.progress_governor import Pace
from groundstation.mission.roster import Crew
from groundstation.mission.stages import LIVE, STAGES, Stage
from groundstation.mission.state_machine import FLYING, JOINING, OVER, PLANNING, UNDER_WAY, Event, Phase, after, refusal
from groundstation.mission.timetable import Timetable
from groundstation.mission.watch import noticed
from groundstation.mission.wishes import UNFIT, mode_name, objection, stays
from groundstation.planning.feasibility import PlanError
from groundstation.planning.segment import Leg, at
from groundstation.telemetry import OUT_OF_STEP_S, Fleet, RobotView, casualty, preflight
from wire.config.experiment import Experiment
from wire.frames import Array
from wire.messages import topics
from wire.messages.messages import Command, Mode, Order

START_IN_S = 0.5  # from the order to the first step along the trajectory, so that all have heard it
PATIENCE_S = 10.0  # with a robot that does not do as told
JOIN_WITHIN_S = 3.5  # with a robot that does not begin to fly with the others, who fly already: as long as without a station
TEST_PATIENCE_S = 12.0
SETTLE_S = 1.0  # an automatic mission goes on this long after everybody holds and is well again
AT_REST_MPS = 0.03
REST_WITHIN_S = 8.0  # robots that hold against waves never quite rest
OUT_FOR_S = 0.3  # a robot is out of step for that long before all hold: states that come late count with their age, but jitter

GETTING_READY = frozenset({Phase.ARMING, Phase.STARTING})
# where the last refusal is what people wait for; elsewhere the reason why it came to this is not lost for it
TELLS_REFUSALS = frozenset(STAGES) - {Phase.ENDING, Phase.ABORTING}


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
        self._cycle_ns: int | None = None  # instant of the last cycle
        self._timetable: Timetable | None = None  # by which robots were last started
        self._waited_ns: dict[int, int] = {}  # for robots that have not done as told, since when
        self._out_of_step_ns: int | None = None  # since when somebody has been
        self._lying: frozenset[int] = frozenset()  # robots that may be disarmed until a new plan arms them
        self._cancelled = False  # a person ended the run
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
        anew = order is Order.RETURN and self._rests  # then also for robots that were out of the run before
        crew = Crew(self._experiment.robot_ids, self.leg) if anew else self.crew
        reason = refusal(order, self.phase) or objection(order, self._experiment, fleet, crew, self.leg, self._starts, via)
        if reason:
            return reason
        if order in (Order.LOAD, Order.ARM, Order.START, Order.TEST):
            self._begin_anew()
        self._stop_after = {Order.LOAD: Phase.LOADING, Order.ARM: Phase.ARMING}.get(order)
        if order is not Order.TEST:  # it asks nobody to fly: who waits for a person waits on
            self._held_by_person = order in (Order.HOLD, Order.CLEAR_STOP)
        if order is Order.RETURN:
            self._come_home(fleet)
        if order is Order.REJOIN:
            self.crew.take_back()
            self.itinerary.take_places()
        if order in (Order.RETURN, Order.REJOIN):
            self._lying = frozenset(r for r in self.crew.active if fleet[r].mode is Mode.DISARMED)
        if order is Order.HOLD and self.phase in PLANNING:
            self._leave_lying(fleet)
        before = self.phase
        self._go(order, now_ns)
        if order is Order.DISARM and before is not Phase.ENDING and before not in OVER:
            self._cancelled = True
            self.reason = f"a person asked for DISARM when {before.name}"
        if order is Order.RESUME:
            self._resume_anew(fleet, now_ns)
        if order is Order.GO:
            self.itinerary.want_detour(fleet, now_ns, tuple(via))
        return ""

    @property
    def _rests(self) -> bool:
        return self.phase is Phase.WAITING or self.phase in OVER

    def _begin_anew(self) -> None:
        self.failed = self._gap = self._cancelled = False
        self.itinerary.begin_anew()
        self.pace.start()

    def _come_home(self, fleet: Fleet) -> None:
        if self._rests:
            self._begin_anew()
        for robot in self.crew.active:
            why = stays(self._experiment, fleet, robot)
            if why:
                self.crew.lose(robot, why)
        self.itinerary.head_home()

    # --- the cycle

    def step(
        self, fleet: Fleet, answers: Sequence[Answer], now_ns: int, around: Surroundings | None = None
    ) -> tuple[Command, ...]:
        """One cycle: the orders to send now."""
        elapsed_s = (now_ns - self._cycle_ns) * 1e-9 if self._cycle_ns is not None else 0.0
        self._cycle_ns = now_ns
        refused = self._asking.listen(answers, now_ns)
        if refused and (not self.reason or self.phase in TELLS_REFUSALS):
            self.reason = refused
        self.itinerary.lookout.see(around, now_ns)
        if self.phase is Phase.WAITING:
            return self._wait(fleet, now_ns)
        if self.phase in UNDER_WAY:
            self._count_losses(fleet, now_ns)
        if self.phase in FLYING | JOINING:
            self._keep_step(fleet, now_ns)
        if self.phase in FLYING | {Phase.PAUSED} and self.crew.active:
            self._watch(fleet, now_ns)
        self._keep_pace(fleet, elapsed_s)
        return self._orders(fleet, now_ns) + self._tell_lost(fleet, now_ns)

    def _orders(self, fleet: Fleet, now_ns: int) -> tuple[Command, ...]:
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

    def _tell_lost(self, fleet: Fleet, now_ns: int) -> tuple[Command, ...]:
        """A robot that is out may fly on by a plan that the others have no longer, and hear though it is not heard: what it
        told last counts. Nobody waits for it."""
        if self.phase in UNDER_WAY:
            return self._ask(Order.HOLD, [r for r in self.crew.out if fleet[r].mode is Mode.TRACKING], now_ns)
        if self.phase is Phase.ENDING:  # those who are heard are among the others
            silent = [r for r in self.crew.out if not fleet[r].heard and fleet[r].mode in LIVE]
            return self._ask(Order.DISARM, silent, now_ns)
        return ()

    def _wait(self, fleet: Fleet, now_ns: int) -> tuple[Command, ...]:
        reasons = preflight(self._experiment, fleet, self._starts)
        self.reason = "; ".join(reasons)
        if self.automatic and not self._held_by_person and not reasons:
            self._begin_anew()
            self._go(Event.FIT, now_ns)
        return ()

    def behind_s(self, robot: RobotView, now_ns: int) -> float:
        """How far a robot is behind the fleet's timetable, by its own account; negative: ahead. 0 where there is none."""
        flown = self._timetable if self.phase in FLYING | JOINING else None
        return flown.behind_s(robot, self.pace, now_ns) if flown is not None else 0.0

    def _keep_step(self, fleet: Fleet, now_ns: int) -> None:
        """All fly one plan by one timetable, or all hold."""
        out = ""
        for robot in self.crew.active:
            behind_s = self.behind_s(fleet[robot], now_ns)
            if abs(behind_s) > OUT_OF_STEP_S:
                out = f"robot {robot} is {abs(behind_s):.1f} s {'behind' if behind_s > 0.0 else 'ahead of'} the others"
                break
            tracks = fleet[robot].heard and fleet[robot].mode is Mode.TRACKING
            if tracks and self.phase is not Phase.SWITCHING and not self.crew.is_on(self.leg, fleet, robot):
                out = f"robot {robot} flies another plan than the others"
                break
        if not out:
            self._out_of_step_ns = None
        elif self._out_of_step_ns is None:
            self._out_of_step_ns = now_ns
        elif now_ns - self._out_of_step_ns >= OUT_FOR_S * 1e9:
            self._go(Event.OUT_OF_STEP, now_ns)
            self.reason = out

    def _watch(self, fleet: Fleet, now_ns: int) -> None:
        """Look for the end of the run, for robots that hold or lag, for what lies in the way."""
        plans = self.itinerary
        in_step = [r for r in self.crew.active if abs(self.behind_s(fleet[r], now_ns)) <= OUT_OF_STEP_S]
        reached_s = min((fleet[r].trajectory_s for r in in_step), default=plans.reached_s)
        if self.phase is Phase.PAUSED:  # all go on from where the last was, but not from where one was that fell out of step
            plans.reached_s = max(plans.reached_s, reached_s)
            return
        plans.reached_s = reached_s
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
        if notice.cause is Event.IN_OWN_WAY:
            plans.plan_anew()
        self._go(notice.cause, now_ns)
        self.reason = notice.reason
        if notice.cause is Event.OBSTACLE:
            plans.want_detour(fleet, now_ns)

    def _count_losses(self, fleet: Fleet, now_ns: int) -> None:
        """Robots that are gone: what then is the experiment's policy. A plan from rest that counts on them is made anew."""
        trouble = casualty(self.crew.active, fleet, self._lying if self.phase in PLANNING else ())
        if trouble is None:
            return
        robot, why = trouble
        policy, home = self._experiment.mission.lost, self.leg.home or (self.phase in PLANNING and self.itinerary.heads_home)
        if policy == "abort" or len(self.crew.active) == 1:
            self._fail(Event.LOST, f"robot {robot}: {why}", now_ns)
            return
        self.crew.lose(robot, why)
        if policy == "hold":
            if self.phase in PLANNING:
                self._leave_lying(fleet)
            if not self.crew.active:
                self._fail(Event.LOST_ALL, f"robot {robot}: {why}", now_ns)
                return
            if self.phase is not Phase.PAUSED:
                self._go(Event.LOST_HOLD, now_ns)
            self._held_by_person = True  # who decides what then is a person
        elif policy == "close-up" and not home:
            self._gap = True
            if not self._held_by_person:
                self._close_up(fleet, now_ns)
        elif after(self.phase, Event.LOST_ANEW) is not None:
            self._go(Event.LOST_ANEW, now_ns)
        self.reason = f"robot {robot}: {why}"

    def _leave_lying(self, fleet: Fleet) -> None:
        """Robots that lie disarmed, and were to be armed for a plan that is now not flown, take no part: they cannot hold."""
        for robot in self.crew.active:
            if fleet[robot].mode is Mode.DISARMED:
                self.crew.lose(robot, "disarmed")

    def _close_up(self, fleet: Fleet, now_ns: int) -> None:
        self._gap = False
        self.crew.close_up(self.leg, self.itinerary.reached_s, fleet)
        self.itinerary.take_places()
        self._go(Event.LOST_CLOSE_UP, now_ns)

    def _keep_pace(self, fleet: Fleet, elapsed_s: float) -> None:
        flies = self.phase in FLYING
        self.pace.step(max((fleet[r].error_m for r in self.crew.active), default=0.0) if flies else None, elapsed_s)

    # --- stages

    def _drive(self, stage: Stage, fleet: Fleet, now_ns: int) -> tuple[Command, ...]:
        waiting = [r for r in self._concerned(fleet) if not self._has_obeyed(r, stage, fleet, now_ns)]
        if not waiting:
            if self.phase is not self._stop_after:
                self._go(self._obeyed, now_ns)
            self._waited_ns.clear()
            return ()
        fallen = casualty(
            [r for r in waiting if fleet[r].mode in UNFIT or self._is_disarmed_again(r, fleet[r], now_ns)], fleet
        )
        if fallen is not None and self.phase in GETTING_READY:  # no order but DISARM would reach it
            self._unheeded(f"robot {fallen[0]}: {fallen[1]}", now_ns)
            return ()
        flying = [r for r in waiting if fleet[r].heard and fleet[r].mode in LIVE]
        if flying and self.phase is Phase.CLEARING:  # the stop has not reached it, and it would fly on when nobody expects it
            self._unheeded(f"robot {flying[0]} has not stopped: it is {mode_name(fleet[flying[0]])}", now_ns)
            return ()
        self._waited_ns = {r: self._waited_ns.get(r, now_ns) for r in waiting}
        patience_s = JOIN_WITHIN_S if self.phase in JOINING else PATIENCE_S
        late = [r for r in waiting if now_ns - self._waited_ns[r] > patience_s * 1e9]
        if late:
            who = ", ".join(map(str, late))
            self._unheeded(f"robot {who} does not follow {stage.order.name}: {self.reason or 'no answer'}", now_ns)
            return ()
        return self._ask(stage.order, waiting, now_ns)

    def _is_disarmed_again(self, robot: int, seen: RobotView, now_ns: int) -> bool:
        """Whether it was armed for this start and is so no more, as after a restart: it is not armed again unasked."""
        armed_ns = self._asking.armed.get(robot)
        return seen.mode is Mode.DISARMED and armed_ns is not None and seen.state_age_s * 1e9 < now_ns - armed_ns

    def _has_obeyed(self, robot: int, stage: Stage, fleet: Fleet, now_ns: int) -> bool:
        """By what a robot has told lately, or since it was asked: what it told before that says nothing. That it is disarmed,
        or its stop cleared, counts only if told since: an ARM or a STOP may have been on its way."""
        seen = fleet[robot]
        told_since = seen.state_age_s * 1e9 <= now_ns - self._since_ns
        told = told_since or (seen.heard and stage.order not in (Order.DISARM, Order.CLEAR_STOP))
        return told and stage.obeyed(seen.mode, self.crew.is_on(self.leg, fleet, robot))

    @property
    def _obeyed(self) -> Event:
        """What it means that all have done as told: of a run that ends, how it ended."""
        if self.phase is not Phase.ENDING or not (self.failed or self._cancelled):
            return Event.OBEYED
        return Event.DISARMED_FAILED if self.failed else Event.DISARMED_CANCELLED

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
        if moving or unfit or (not self._may_plan_anew and self.itinerary.blocked(fleet)):
            self._since_ns = now_ns
        elif self.automatic and not self._held_by_person and now_ns - self._since_ns > SETTLE_S * 1e9:
            self._go(Event.WELL, now_ns)
            self._resume_anew(fleet, now_ns)
            return ()
        return self._ask(Order.HOLD, moving, now_ns)

    @property
    def _may_plan_anew(self) -> bool:
        """Whether a way that is blocked is given up for another one from rest, or waited at until it is free."""
        return bool(self.crew.out) or self.leg.apart(self.itinerary.reached_s)

    def _resume_anew(self, fleet: Fleet, now_ns: int) -> None:
        """Where those who held cannot just go on, they get a new plan from rest. Either some have gone over to another path
        and some have not; or one was carried farther off than it would go on from; or a gap came while a person had them hold,
        which closes now; or something lies on their way, a robot that is out and coasted on, say: all go on from the next
        places on their way that are free."""
        astray = [f"robot {r} has another plan" for r in self.crew.active if not self.crew.is_on(self.leg, fleet, r)]
        astray = astray or [f"robot {r} is {away_m:.2f} m from its place" for r, away_m in self._carried_off(fleet)]
        if astray:
            self.itinerary.plan_anew()
            self._go(Event.ASTRAY, now_ns)
            self.reason = "; ".join(astray)
        elif self._gap and self.crew.out and not self.leg.home:
            self._close_up(fleet, now_ns)
        elif self._may_plan_anew and self.itinerary.blocked(fleet):
            self.itinerary.plan_anew()
            self._go(Event.BESIDE_LOST if self.crew.out else Event.IN_OWN_WAY, now_ns)

    def _carried_off(self, fleet: Fleet) -> Iterator[tuple[int, float]]:
        """Robots that are too far from their places to go on from, and how far."""
        now = np.array([self.itinerary.reached_s])
        for robot, trajectory in self.crew.flown(self.leg).items():
            away_m = float(np.linalg.norm(at(trajectory, now).eta[0, :3] - fleet[robot].eta[:3]))
            if away_m > self._experiment.safety.join_within_m:
                yield robot, away_m

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
        results = {r: self._test_result(r, fleet[r], now_ns) for r in self.crew.active}
        if all(result not in ("", "running") for result in results.values()):
            self._go(Event.OBEYED, now_ns)
            failed = [f"robot {r}: {result}" for r, result in results.items() if result != "passed"]
            self.reason = "; ".join(failed) or "all thrusters as asked"
            return ()
        if now_ns - self._since_ns > TEST_PATIENCE_S * 1e9:
            self._unheeded(f"the thruster test does not end: {results}", now_ns)
            return ()
        return self._ask(Order.TEST, [r for r in self.crew.active if r not in self._asking.tested], now_ns)

    def _test_result(self, robot: int, seen: RobotView, now_ns: int) -> str:
        """As told since the robot took the order: what it told before is of another test."""
        taken_ns = self._asking.tested.get(robot)
        if seen.state is None or taken_ns is None or seen.state_age_s * 1e9 > now_ns - taken_ns:
            return ""
        return seen.state.thruster_test

    # --- another path under way

    def planned(self, outcome: Leg | PlanError, fleet: Fleet, now_ns: int) -> None:
        """What came of the plan that was wanted."""
        self.itinerary.wanted = None
        if self.phase is Phase.HALTING:
            if isinstance(outcome, Leg):
                self.itinerary.adopt(outcome)
                self._go(Event.PLANNED, now_ns)
            else:
                self._leave_lying(fleet)
                why = f"no way from here: {outcome}"
                if not self.crew.active:
                    self._fail(Event.LOST_ALL, why, now_ns)
                    return
                self._go(Event.NO_PLAN, now_ns)
                self._held_by_person, self.reason = True, why
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
        begins = order in (Order.START, Order.RESUME)
        return self._asking.orders(order, robots, now_ns, self._timetable if begins else None)

    def _fail(self, cause: Event, reason: str, now_ns: int) -> None:
        self.failed = True
        self._go(cause, now_ns)
        self.reason = reason

    def _go(self, cause: Order | Event, now_ns: int) -> None:
        """Along the table, and in no other way."""
        phase = after(self.phase, cause)
        if phase is None:
            raise RuntimeError(f"{cause.name} leads nowhere from {self.phase.name}")
        if phase not in OVER | {Phase.ABORTING}:
            self.reason = ""
        if phase is Phase.HALTING and self.phase not in PLANNING and isinstance(cause, Event):
            self._lying = frozenset()  # who flew just now, and is disarmed, is lost
        if phase in JOINING:  # one instant for all, the same in every order: who takes it late joins them where they are
            from_s = self.itinerary.reached_s if phase is Phase.RESUMING else self.leg.centre.begin_s
            self._timetable = Timetable(now_ns + round(START_IN_S * 1e9), from_s + self.pace.lag_s)
        if phase is not Phase.SWITCHING:
            self.itinerary.next = None
        self.itinerary.wanted = None  # a plan for what went before would be taken for the one that comes next
        if phase is Phase.TEST_ARMING:
            self._asking.tested = {}
        if phase is Phase.ARMING:
            self._asking.armed = {}
        self.phase, self._since_ns, self._out_of_step_ns = phase, now_ns, None
        self._waited_ns.clear()
        self._asking.anew()
