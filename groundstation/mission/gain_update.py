"""Change of gains in flight as a two-phase commit: all robots change together, or none does. Pure: time is an argument.

    IDLE -> ASKING: every robot checks the set (TUNE)      one refuses or is silent -> IDLE, nothing has changed
         -> ADOPTING: from the same instant on (ADOPT)     one does not -> the others go back to the set before
         -> WAITING, with `next_lap`: until the lap begins -> IDLE

`step` returns the commands to send now; groundstation/station/station.py sends them. A change is for the robots of the
formation. A robot that comes back with other gains than the fleet's (it was restarted, or out of reach) is given the fleet's.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from enum import Enum

from groundstation.mission.command_dispatcher import CommandResult, RetryTimer
from groundstation.mission.lap_statistics import FlownLaps
from groundstation.mission.timetable import START_IN_S
from groundstation.telemetry import Fleet, RobotView
from shoal.config.controller import ControllerConfig
from shoal.config.experiment import Experiment
from shoal.errors import ConfigError
from shoal.messages.live_gains import tuned, tuning
from shoal.messages.messages import Command, CommandKind, Mode, RobotState, Tuning

PATIENCE_S = 3.0  # for all robots to reply in one stage
AGAIN_S = 2.0  # between tries to give a restarted robot the fleet's gains
MOST_UNDONE = 50  # sets that can be undone

TUNING = frozenset({CommandKind.TUNE, CommandKind.ADOPT})


class GainStage(Enum):
    """Stage of a change; the value is for people."""

    IDLE = ""
    ASKING = "robots check the gains"
    ADOPTING = "robots change over"
    WAITING = "waiting for the next lap"


@dataclass(frozen=True, eq=False)
class GainStatus:
    """State of the gains for the page."""

    flown: Tuning
    wanted: str = ""  # id of the set that robots change to
    stage: GainStage = GainStage.IDLE
    reason: str = ""  # of the last change's failure
    undo: bool = False  # there is a set to go back to
    history: Sequence[str] = ()  # ids in the order of their first use


@dataclass(eq=False)
class _Change:
    """A change of gains under way."""

    message: Tuning
    config: ControllerConfig
    robots: tuple[int, ...]
    trajectory_s: float = 0.0
    back: bool = False  # to the set before, after one robot did not follow; or of a restarted robot
    returned: bool = False  # of robots that came back with other gains: no person has asked for it
    accepted: set[int] = field(default_factory=set)
    begun_ns: int | None = None  # instant at which the first robot flew with it


class GainUpdater:
    """The fleet's gains, and the change under way."""

    def __init__(self, experiment: Experiment) -> None:
        self._experiment, self._config = experiment, experiment.controller
        self._flown = tuning(self._config)
        self._before: list[ControllerConfig] = []
        self._history = [self._flown.id]
        self._stage, self._reason = GainStage.IDLE, ""
        self._change: _Change | None = None
        self._since_ns = 0
        self._timer = RetryTimer()
        self._unlogged = [self._flown]

    def status(self) -> GainStatus:
        """Gains in use, stage of the change, reason of the last failure."""
        target_id = self._change.message.id if self._change is not None else ""
        return GainStatus(self._flown, target_id, self._stage, self._reason, bool(self._before), tuple(self._history))

    def take_unlogged(self) -> list[Tuning]:
        """Sets of gains that are not in the log yet; each is returned once."""
        sets, self._unlogged = self._unlogged, []
        return sets

    # --- requests of the operator; each returns the reason of a refusal, or nothing

    def request(
        self,
        values: Mapping[str, float],
        fleet: Fleet,
        now_ns: int,
        flying: Mapping[int, RobotState],
        next_lap_of: FlownLaps | None = None,
    ) -> str:
        """Change these gains (key: value), keep the others: at once, or with the next lap of a path. `fleet`: the robots of
        the formation; `flying`: states of those that fly its trajectories."""
        if self._is_busy:
            return f"another change is under way: {self._stage.value}"
        try:
            config = tuned(self._config, values)
        except ConfigError as error:
            return str(error)
        if tuning(config).id == self._flown.id:
            return "this is what is flown already"
        if next_lap_of is None:
            return self._begin(config, fleet, now_ns)
        start_s, reason = _next_lap_s(next_lap_of, fleet, flying)
        return reason or self._begin(config, fleet, now_ns, start_s)

    def undo(self, fleet: Fleet, now_ns: int) -> str:
        """Go back to the set before; cancel a change that still waits for its lap."""
        if self._stage is GainStage.WAITING:
            return self._begin(self._config, fleet, now_ns)
        if self._is_busy:
            return f"another change is under way: {self._stage.value}"
        return self._begin(self._before[-1], fleet, now_ns) if self._before else "there is nothing to undo"

    @property
    def _is_busy(self) -> bool:
        """True while a change is under way that another may not replace. A robot that came back and does not answer, or has
        not answered yet, keeps nobody waiting."""
        asks_returned = self._change is not None and self._change.returned and self._stage is GainStage.ASKING
        return self._stage is not GainStage.IDLE and not asks_returned

    def _begin(self, config: ControllerConfig, fleet: Fleet, now_ns: int, trajectory_s: float = 0.0) -> str:
        """Begin a change of gains. Returns the reason why it cannot begin, or ""."""
        silent = [str(robot) for robot, view in fleet.items() if not view.heard]
        if silent:
            return f"robot {', '.join(silent)} is not heard"
        message = tuning(config)
        if message.id not in self._history:
            self._history.append(message.id)
            self._unlogged.append(message)
        self._begin_stage(_Change(message, config, tuple(fleet), trajectory_s), now_ns)
        self._reason = ""
        return ""

    def _begin_stage(self, change: _Change, now_ns: int) -> None:
        self._change = change
        self._enter(GainStage.ASKING, now_ns)

    def _enter(self, stage: GainStage, now_ns: int) -> None:
        self._stage, self._since_ns = stage, now_ns
        self._timer.reset()
        if (
            self._change is not None and stage is not GainStage.WAITING
        ):  # in WAITING all have accepted, and may be asked to go back
            self._change.accepted.clear()

    # --- the station's cycle

    def step(
        self, fleet: Fleet, results: Sequence[CommandResult], now_ns: int, laps: FlownLaps | None = None
    ) -> tuple[Command, ...]:
        """Do one cycle; returns the commands to send now. `laps`: of the path that is flown now; None: they have not moved."""
        change = self._change
        if change is None:
            return self._update_returned(fleet, now_ns)
        order = CommandKind.TUNE if self._stage is GainStage.ASKING else CommandKind.ADOPT
        for result in results:
            is_about_change = result.command.tuning_id == change.message.id and result.command.robot in change.robots
            if result.command.order is order and is_about_change:
                if not result.reply.accepted and not result.reply.silent:
                    return self._give_up(f"robot {result.reply.robot} refuses: {result.reply.reason}", fleet, now_ns)
                if result.reply.accepted:
                    change.accepted.add(result.command.robot)
        waiting = [robot for robot in change.robots if robot not in change.accepted]
        if waiting and self._stage is not GainStage.WAITING:
            if now_ns - self._since_ns > PATIENCE_S * 1e9:
                return self._give_up(f"robot {', '.join(map(str, waiting))} does not answer", fleet, now_ns)
            return self._due_commands(order, waiting, change, now_ns)
        if self._stage is GainStage.ASKING:
            self._enter(GainStage.ADOPTING, now_ns)
        elif self._stage is GainStage.ADOPTING and change.trajectory_s > 0.0:
            self._enter(GainStage.WAITING, now_ns)
        elif all(_flies_with(fleet, robot, change) for robot in change.robots):
            self._succeed(change)
        elif self._stage is GainStage.WAITING:
            return self._watch(change, fleet, now_ns, laps)
        elif now_ns - self._since_ns > (PATIENCE_S + START_IN_S) * 1e9:
            late = [str(robot) for robot in change.robots if not _flies_with(fleet, robot, change)]
            return self._give_up(f"robot {', '.join(late)} did not change over", fleet, now_ns)
        return ()

    def _due_commands(self, order: CommandKind, robots: Sequence[int], change: _Change, now_ns: int) -> tuple[Command, ...]:
        """Commands of a change of gains that are due to these robots."""
        left_s = max(START_IN_S - (now_ns - self._since_ns) * 1e-9, 0.0)  # a second try counts from the same instant
        return tuple(
            Command(
                order,
                robot,
                experiment_hash=self._experiment.hash,
                start_in_s=left_s if order is CommandKind.ADOPT else 0.0,
                trajectory_s=change.trajectory_s if order is CommandKind.ADOPT else 0.0,
                tuning_id=change.message.id,
                tuning=change.message if order is CommandKind.TUNE else None,
            )
            for robot in self._timer.due(robots, now_ns)
        )

    def _succeed(self, change: _Change) -> None:
        """Make the changed gains the fleet's. The gains before can be had back, unless this change has brought them back."""
        if not change.back:
            if self._before and tuning(self._before[-1]).id == change.message.id:
                self._before.pop()
            elif change.message.id != self._flown.id:
                self._before = [*self._before[1 - MOST_UNDONE :], self._config]
            self._config, self._flown = change.config, change.message
        self._change, self._stage = None, GainStage.IDLE

    def _watch(self, change: _Change, fleet: Fleet, now_ns: int, laps: FlownLaps | None) -> tuple[Command, ...]:
        """Wait for the lap. Gives the change up if a robot is disarmed, stopped or silent meanwhile, as it has forgotten the
        set, if the lap does not begin for all robots, or if a new plan has moved it."""
        flying = (Mode.TRACKING, Mode.HOLDING, Mode.DRIVEN)
        leavers = [r for r in change.robots if fleet[r].mode not in flying or fleet[r].state_age_s > PATIENCE_S]
        if leavers:
            return self._give_up(f"robot {', '.join(map(str, leavers))} left the run before the lap began", fleet, now_ns)
        late = [r for r in change.robots if not _flies_with(fleet, r, change)]
        is_moved = laps is not None and not laps.begins_at(change.trajectory_s)
        if is_moved and len(late) == len(change.robots):
            commands = self._give_up("", fleet, now_ns)  # robots are to forget the set
            self._reason = "a new plan has moved the lap: nothing was changed"
            return commands
        if change.begun_ns is None and len(late) < len(change.robots):
            change.begun_ns = now_ns
        if change.begun_ns is not None and now_ns - change.begun_ns > PATIENCE_S * 1e9:
            return self._give_up(f"robot {', '.join(map(str, late))} did not change over with the lap", fleet, now_ns)
        return ()

    def _give_up(self, reason: str, fleet: Fleet, now_ns: int) -> tuple[Command, ...]:
        """End a change without success: robots that have changed already go back."""
        change = self._change
        assert change is not None
        is_asked = self._stage is not GainStage.ASKING
        self._reason = f"{reason}; " + ("the fleet's gains may differ" if change.back else "nothing was changed")
        self._change, self._stage, self._since_ns = None, GainStage.IDLE, now_ns
        if is_asked and not change.back:
            changed = tuple(
                r for r in change.robots if fleet[r].heard and (r in change.accepted or _flies_with(fleet, r, change))
            )
            if changed:
                self._reason = f"{reason}; the others go back"
                self._begin_stage(_Change(self._flown, self._config, changed, back=True), now_ns)
        return ()

    def _update_returned(self, fleet: Fleet, now_ns: int) -> tuple[Command, ...]:
        """Give robots that have other gains the fleet's gains."""

        def needs_gains(view: RobotView) -> bool:
            if not takes_gains(view) or view.state is None:
                return False
            is_of_this_experiment = view.state.experiment_hash == self._experiment.hash
            return is_of_this_experiment and view.state.tuning_id != self._flown.id

        differing = tuple(robot for robot, view in fleet.items() if needs_gains(view))
        if differing and now_ns - self._since_ns > AGAIN_S * 1e9:
            self._begin_stage(_Change(self._flown, self._config, differing, back=True, returned=True), now_ns)
        return ()


def takes_gains(view: RobotView) -> bool:
    """True for a robot that may be given the fleet's gains: it speaks, however late its states come, and is not stopped."""
    return view.state_age_s < PATIENCE_S and view.mode is not Mode.STOPPED


def _flies_with(fleet: Fleet, robot: int, change: _Change) -> bool:
    state = fleet[robot].state
    return state is not None and state.tuning_id == change.message.id


def _next_lap_s(laps: FlownLaps, fleet: Fleet, flying: Mapping[int, RobotState]) -> tuple[float, str]:
    """Progress in s at which the next lap begins, and the reason if there is none."""
    if laps.lap_s is None:
        return 0.0, "this path has no laps"
    if not flying or set(flying) != set(fleet):
        return 0.0, "there is no next lap: not every robot is on its trajectory"
    start_s = laps.next_s(max(state.trajectory_s for state in flying.values()) + START_IN_S)
    return start_s, "there is no next lap: the run ends with this one" if start_s >= laps.end_s else ""
