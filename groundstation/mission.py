"""READ FIRST. The mission: from robots lying in the water to a run that is over, as one table of phases.

    WAITING -> LOADING -> ARMING -> STARTING -> RUNNING -> ENDING -> DONE
                                     RUNNING -> PAUSED -> RESUMING -> RUNNING;  on trouble -> ABORTING -> FAILED
                                     red button, from anywhere -> STOPPED

Pure: `step(fleet, replies, wish, now_ns)` returns the orders to send; groundstation/station.py sends them. An order that is
refused or unanswered is sent again, at most once in RETRY_S, until PATIENCE_S have gone by in a phase.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from enum import Enum

from groundstation.fleet import Fleet, RobotView, casualty, preflight
from wire import topics
from wire.experiment import Experiment
from wire.messages import Command, Mode, Order, Reply, Trajectory

START_IN_S = 0.5  # from the order to the first step along the trajectory, so that all have heard it
RETRY_S = 0.25
PATIENCE_S = 10.0  # in a phase that waits for robots to obey
SETTLE_S = 1.0  # an automatic mission goes on this long after everybody holds and is well again


class Phase(Enum):
    """Where the mission stands."""

    WAITING = "waiting for the fleet"
    LOADING = "loading trajectories"
    ARMING = "arming"
    STARTING = "starting"
    RUNNING = "running"
    PAUSED = "holding"
    RESUMING = "resuming"
    ENDING = "disarming"
    DONE = "done"
    ABORTING = "aborting"
    FAILED = "failed"
    STOPPED = "emergency stop"
    CLEARING = "clearing the emergency stop"


LIVE = frozenset({Mode.ARMED, Mode.TRACKING, Mode.HOLDING})
OVER = frozenset({Phase.DONE, Phase.FAILED})


@dataclass(frozen=True)
class Stage:
    """A phase that gives every robot one order until all obey."""

    order: Order
    obeyed: Callable[[Mode, bool], bool]  # (mode, trajectory loaded) -> done
    then: Phase


STAGES: dict[Phase, Stage] = {
    Phase.LOADING: Stage(Order.LOAD, lambda mode, loaded: loaded, Phase.ARMING),
    Phase.ARMING: Stage(Order.ARM, lambda mode, loaded: mode in (Mode.ARMED, Mode.HOLDING), Phase.STARTING),
    Phase.STARTING: Stage(Order.START, lambda mode, loaded: mode is Mode.TRACKING, Phase.RUNNING),
    Phase.RESUMING: Stage(Order.RESUME, lambda mode, loaded: mode is Mode.TRACKING, Phase.RUNNING),
    Phase.ENDING: Stage(Order.DISARM, lambda mode, loaded: mode is Mode.DISARMED, Phase.DONE),
    Phase.CLEARING: Stage(Order.CLEAR_STOP, lambda mode, loaded: mode is not Mode.STOPPED, Phase.WAITING),
    Phase.ABORTING: Stage(Order.DISARM, lambda mode, loaded: mode not in LIVE, Phase.FAILED),
}

# What a person may ask for, in which phases, and where that leads.
WISHES: dict[Order, tuple[frozenset[Phase], Phase]] = {
    Order.LOAD: (frozenset({Phase.WAITING, Phase.DONE, Phase.FAILED}), Phase.LOADING),
    Order.ARM: (frozenset({Phase.WAITING, Phase.LOADING}), Phase.LOADING),
    Order.START: (frozenset({Phase.WAITING, Phase.LOADING, Phase.ARMING}), Phase.LOADING),
    Order.HOLD: (frozenset({Phase.RUNNING}), Phase.PAUSED),
    Order.RESUME: (frozenset({Phase.PAUSED}), Phase.RESUMING),
    Order.DISARM: (frozenset(Phase) - {Phase.STOPPED}, Phase.ENDING),
    Order.STOP: (frozenset(Phase), Phase.STOPPED),
    Order.CLEAR_STOP: (frozenset({Phase.STOPPED}), Phase.CLEARING),
}


@dataclass(frozen=True)
class Answer:
    """What became of an order."""

    command: Command
    reply: Reply


class Mission:
    """One run of an experiment. `automatic` goes from WAITING to DONE by itself; otherwise START asks for it."""

    def __init__(self, experiment: Experiment, trajectories: dict[int, Trajectory], automatic: bool) -> None:
        self.phase = Phase.WAITING
        self.reason = ""  # why it waits, or why it failed
        self.failed = False
        self.automatic = automatic
        self._experiment, self._trajectories = experiment, trajectories
        self._since_ns = 0
        self._asked_ns: dict[int, int] = {}
        self._reached_s = 0.0  # along the trajectory; common to all, so that a resumed formation is still in step
        self._stop_after: Phase | None = None  # a person asked for no more than this stage
        self._held_by_person = False

    def wish(self, order: Order, fleet: Fleet, now_ns: int) -> str:
        """What a person at the station asks for. Returns why not, or nothing when it is under way."""
        if order not in WISHES:
            return f"{order.name} is not for a whole mission (allowed: {', '.join(o.name for o in WISHES)})"
        allowed, target = WISHES[order]
        if self.phase not in allowed:
            names = ", ".join(p.name for p in Phase if p in allowed)
            return f"{order.name} is not possible when {self.phase.name} (only when {names})"
        if order in (Order.ARM, Order.START):
            reasons = preflight(self._experiment, fleet)
            if reasons:
                return "; ".join(reasons)
            self.failed = False
        self._stop_after = {Order.LOAD: Phase.LOADING, Order.ARM: Phase.ARMING}.get(order)
        self._held_by_person = order is Order.HOLD
        self._enter(target, now_ns)
        return ""

    def step(self, fleet: Fleet, answers: Sequence[Answer], now_ns: int) -> tuple[Command, ...]:
        """One cycle: the orders to send now."""
        for answer in answers:
            if not answer.reply.accepted:
                self.reason = f"robot {answer.command.robot} refuses {answer.command.order.name}: {answer.reply.reason}"
        if self.phase is Phase.WAITING:
            return self._wait(fleet, now_ns)
        if self.phase in (Phase.RUNNING, Phase.PAUSED):
            self._watch(fleet, now_ns)
        if self.phase in STAGES:
            return self._drive(STAGES[self.phase], fleet, now_ns)
        if self.phase is Phase.PAUSED:
            return self._pause(fleet, now_ns)
        if self.phase is Phase.STOPPED:
            return self._ask(Order.STOP, self._not_in(Mode.STOPPED, fleet), now_ns)
        return ()

    def _wait(self, fleet: Fleet, now_ns: int) -> tuple[Command, ...]:
        reasons = preflight(self._experiment, fleet)
        self.reason = "; ".join(reasons)
        if self.automatic and not reasons:
            self._enter(Phase.LOADING, now_ns)
        return ()

    def _watch(self, fleet: Fleet, now_ns: int) -> None:
        """Look for the end of the run, and for robots that fell out of it."""
        trouble = casualty(self._experiment, fleet)
        if trouble:
            self._fail(trouble, now_ns)
            return
        self._reached_s = min(_trajectory_s(fleet[r]) for r in self._experiment.robot_ids)
        if self._reached_s >= self._experiment.duration_s:
            self._enter(Phase.ENDING, now_ns)
            return
        holding = [r for r in self._experiment.robot_ids if fleet[r].mode is Mode.HOLDING]
        if self.phase is Phase.RUNNING and holding and now_ns - self._since_ns > topics.STATE.max_age_s * 1e9:
            state = fleet[holding[0]].state
            self._enter(Phase.PAUSED, now_ns)
            self.reason = f"robot {holding[0]} holds: {state.fault if state else ''}"

    def _pause(self, fleet: Fleet, now_ns: int) -> tuple[Command, ...]:
        """Everybody holds. Only an automatic mission goes on by itself, when all are well again."""
        moving = self._not_in(Mode.HOLDING, fleet)
        if moving or preflight(self._experiment, fleet):
            self._since_ns = now_ns
        elif self.automatic and not self._held_by_person and now_ns - self._since_ns > SETTLE_S * 1e9:
            self._enter(Phase.RESUMING, now_ns)
        return self._ask(Order.HOLD, moving, now_ns)

    def _not_in(self, mode: Mode, fleet: Fleet) -> list[int]:
        return [r for r in self._experiment.robot_ids if fleet[r].mode is not mode]

    def _drive(self, stage: Stage, fleet: Fleet, now_ns: int) -> tuple[Command, ...]:
        waiting = [r for r in self._experiment.robot_ids if not stage.obeyed(fleet[r].mode, self._loaded(fleet, r))]
        if not waiting:
            if self.phase is self._stop_after:
                return ()
            self._enter(Phase.FAILED if stage.then is Phase.DONE and self.failed else stage.then, now_ns)
            return ()
        if now_ns - self._since_ns > PATIENCE_S * 1e9:
            why = self.reason or "no answer"
            late = ", ".join(str(r) for r in waiting)
            if self.phase is Phase.ABORTING:
                self._enter(Phase.FAILED, now_ns)
            else:
                self._fail(f"robot {late} does not follow {stage.order.name}: {why}", now_ns)
            return ()
        return self._ask(stage.order, waiting, now_ns)

    def _loaded(self, fleet: Fleet, robot: int) -> bool:
        state = fleet[robot].state
        return state is not None and state.trajectory_id == self._trajectories[robot].id

    def _ask(self, order: Order, robots: Sequence[int], now_ns: int) -> tuple[Command, ...]:
        """Orders for those robots that have not been asked within RETRY_S."""
        due = [r for r in robots if now_ns - self._asked_ns.get(r, -(10**18)) >= RETRY_S * 1e9]
        for robot in due:
            self._asked_ns[robot] = now_ns
        return tuple(self._command(order, robot, now_ns) for robot in due)

    def _command(self, order: Order, robot: int, now_ns: int) -> Command:
        trajectory = self._trajectories[robot]
        left_s = START_IN_S - (now_ns - self._since_ns) * 1e-9  # a second try starts at the same instant as the first
        return Command(
            order,
            robot,
            experiment_hash=self._experiment.hash,
            trajectory_id=trajectory.id,
            start_in_s=max(left_s, 0.0) if order in (Order.START, Order.RESUME) else 0.0,
            trajectory_s=self._reached_s if order is Order.RESUME else 0.0,
            trajectory=trajectory if order is Order.LOAD else None,
        )

    def _fail(self, reason: str, now_ns: int) -> None:
        self.failed = True
        self._enter(Phase.ABORTING, now_ns)
        self.reason = reason

    def _enter(self, phase: Phase, now_ns: int) -> None:
        if phase is not self.phase and phase not in (Phase.FAILED, Phase.DONE, Phase.ABORTING):
            self.reason = ""
        self.phase, self._since_ns = phase, now_ns
        self._asked_ns.clear()


def _trajectory_s(robot: RobotView) -> float:
    return robot.state.trajectory_s if robot.state is not None else 0.0
