"""Requests for one robot: arm, hold, disarm, drive, go to a place, out of the water and back. Pure.

A robot that is led like this in flight is out of the formation until REJOIN, also while the formation takes another path or
flies home; the others see its plans and stay clear. While the mission is paused it keeps its place in the formation. Where the
mission arms, starts, ends or plans for all, it leads all robots again, and requests for one are over; but a DISARM of one goes
on while the mission disarms all.
"""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from groundstation.formation_clock import named_alone
from groundstation.mission.command_dispatcher import MOVING, CommandDispatcher, CommandResult
from groundstation.mission.mission import AT_REST_MPS, PATIENCE_S, REST_WITHIN_S, UNFIT, Mission, may_have_power
from groundstation.mission.objections import ARMED, LIVE, mode_name
from groundstation.mission.plan_manager import PlanRequest
from groundstation.mission.roster import TAKEN_OUT, Leader
from groundstation.mission.state_machine import AT_REST, IN_FLIGHT, NOMINAL, ONE_ROBOT, WATER, MissionState, command_name
from groundstation.mission.timetable import START_IN_S, Timetable
from groundstation.planning.feasibility import PlanError
from groundstation.planning.rest_to_rest import SETTLE_S, plan_return
from groundstation.planning.segment import PlanSegment
from groundstation.telemetry import Fleet, RobotView, blind_robots_reason, foreign_poses_reason, preflight
from shoal.config.experiment import Experiment
from shoal.messages.messages import Command, CommandKind, DriveVelocity, Mode, Progress, Trajectory

WHEN = NOMINAL | AT_REST | {MissionState.PAUSED}
# A robot that is led in flight is out of the formation, which may make itself a new plan at that very request.
GOES_ON = WHEN | IN_FLIGHT
# While the mission disarms all robots it does what a DISARM of one asks for; any other request for one is over then.
DISARMING = frozenset({MissionState.ENDING, MissionState.ABORTING})
LED = frozenset({CommandKind.DRIVE, CommandKind.GO})  # requests by which a robot moves by its poses
WATER_WHEN = WHEN | {MissionState.STOPPED}  # after an emergency stop people fetch robots from the water
VELOCITY_LASTS_S = 0.3  # of the person's last word; then the robot is told to hold

CONFIRMS: Mapping[CommandKind, frozenset[Mode]] = {
    CommandKind.ARM: ARMED,
    CommandKind.HOLD: frozenset({Mode.HOLDING}),
    CommandKind.DISARM: frozenset({Mode.DISARMED}),
}  # modes in which a robot has done a request


@dataclass(eq=False)
class RobotTask:
    """A request for one robot, from its beginning to its end: another request for the robot ends it, and never changes it."""

    order: CommandKind
    since_ns: int  # of its present stage
    progress: Progress = Progress.UNDER_WAY
    reason: str = ""  # of a failure, or the last refusal
    place_m: tuple[float, float] | None = None  # GO
    transfer: PlanSegment | None = None  # GO, once it is planned
    started: bool = False  # GO: the robot has begun to fly its transfer
    velocity: DriveVelocity | None = None  # DRIVE: the newest, asked at `since_ns`; None: let go, the robot comes to rest
    timetable: Timetable | None = None  # GO, once the robot has its trajectory
    armed_ns: int | None = None  # ARM: instant at which the robot said that it had done it


class SingleRobotControl:
    """Tasks of robots that are led one by one. The station calls `step` once a cycle, after the mission's."""

    def __init__(self, experiment: Experiment, mission: Mission) -> None:
        self.tasks: dict[int, RobotTask] = {}  # the last one of each robot
        self._experiment, self._mission = experiment, mission
        self._dispatchers = {robot: CommandDispatcher(experiment.hash, mission.departures) for robot in experiment.robot_ids}
        self._planned_for: tuple[int, RobotTask] | None = None
        self._interrupted_ns: dict[int, int] = {}  # by robot whose DRIVE another request ended: instant of the last velocity
        self.plan_request: PlanRequest | None = None

    @property
    def led(self) -> frozenset[int]:
        """Robots with a task under way."""
        return self._mission.roster.led_by_people

    @property
    def trips(self) -> dict[int, tuple[Trajectory, float]]:
        """Trajectories that robots fly alone, with their ends in s."""
        flown = {r: self.tasks[r].transfer for r in self.led}
        return {r: (transfer.trajectories[r], transfer.end_s) for r, transfer in flown.items() if transfer is not None}

    def status(self) -> dict[int, str]:
        """Text for people about each robot that is led."""
        return {robot: _text(task) for robot, task in self.tasks.items() if task.progress is Progress.UNDER_WAY}

    # --- requests

    def request(
        self, order: CommandKind, robot: int, fleet: Fleet, now_ns: int, place_m: tuple[float, float] | None = None
    ) -> str:
        """Take up a request. Returns the reason of a refusal; empty when it is under way."""
        if order not in ONE_ROBOT:
            return f"{command_name(order)} is not for one robot (allowed: {', '.join(map(command_name, ONE_ROBOT))})"
        reason = self._objection(order, robot, fleet, place_m, WATER_WHEN if order in WATER else WHEN)
        if not reason and order in WATER:
            self._note_water(order, robot, now_ns)
        elif not reason:
            self._begin(robot, RobotTask(order, now_ns, place_m=place_m))
        return reason

    def _note_water(self, order: CommandKind, robot: int, now_ns: int) -> None:
        """Take note that a person took a robot out of the water, or put it back: done at once."""
        if self._under_way(robot) is not None:
            self._end(robot, f"{command_name(order)} was asked for instead")
        self.tasks[robot] = RobotTask(order, now_ns, Progress.DONE)
        self._mission.note_water(robot, order is CommandKind.OUT)

    def drive(self, robot: int, velocity: DriveVelocity, fleet: Fleet, now_ns: int) -> str:
        """Take a person's newest velocity for a robot; all zeros let go. Returns the reason of a refusal, or nothing. A drive
        that another request has ended goes on only after it was let go."""
        task = self._under_way(robot)
        driven = task is not None and task.order is CommandKind.DRIVE
        lets_go = velocity.surge_mps == velocity.heave_mps == velocity.yaw_rate_radps == 0.0
        if lets_go:
            self._interrupted_ns.pop(robot, None)
            if task is not None and driven and task.velocity is not None:
                self._let_go(robot, task, now_ns)
            return ""
        reason = self._objection(CommandKind.DRIVE, robot, fleet, None, GOES_ON if driven else WHEN)
        reason = reason or self._interruption(robot, now_ns)
        if reason:
            return reason
        if task is None or not driven:
            self._begin(robot, RobotTask(CommandKind.DRIVE, now_ns, velocity=velocity))
            return ""
        task.velocity, task.since_ns = velocity, now_ns
        return task.reason

    def _interruption(self, robot: int, now_ns: int) -> str:
        """Reason to refuse a velocity of a drive that another request has ended; empty if there was none, or it was let go."""
        last_ns = self._interrupted_ns.pop(robot, None)
        if last_ns is None or now_ns - last_ns > VELOCITY_LASTS_S * 1e9:
            return ""
        self._interrupted_ns[robot] = now_ns
        return f"{command_name(self.tasks[robot].order)} was asked for instead: let go first"

    def _under_way(self, robot: int) -> RobotTask | None:
        task = self.tasks.get(robot)
        return task if task is not None and task.progress is Progress.UNDER_WAY else None

    def _begin(self, robot: int, task: RobotTask) -> None:
        """Begin a robot's new task; the task before it fails. A repetition of the same request is not a new one."""
        before = self._under_way(robot)
        if before is not None and before.order is task.order and task.order is not CommandKind.GO:
            return
        if before is not None:
            self._end(robot, f"{command_name(task.order)} was asked for instead")
            if before.order is CommandKind.DRIVE and before.velocity is not None:
                self._interrupted_ns[robot] = task.since_ns
        self.tasks[robot] = task
        self._dispatchers[robot].reset()
        self._mission.lead(robot, task.order)

    def _let_go(self, robot: int, task: RobotTask, now_ns: int) -> None:
        task.velocity, task.since_ns = None, now_ns
        self._dispatchers[robot].reset()

    def _end(self, robot: int, reason: str = "") -> None:
        """End a robot's task: done, or failed for a reason. The mission leads the robot again."""
        task = self.tasks[robot]
        task.progress, task.reason = Progress.FAILED if reason else Progress.DONE, reason
        self._mission.roster.led_by[robot] = Leader.MISSION

    def _objection(
        self,
        order: CommandKind,
        robot: int,
        fleet: Fleet,
        place_m: tuple[float, float] | None,
        when: Collection[MissionState] = WHEN,
    ) -> str:
        """Reason to refuse an order for one robot; empty if there is none."""
        mission = self._mission
        if robot not in fleet:
            return f"no robot {robot} (allowed: {', '.join(map(str, fleet))})"
        if mission.state not in when:
            names = ", ".join(state.name for state in MissionState if state in when)
            return f"{command_name(order)} for one robot is not possible when {mission.state.name} (only when {names})"
        if mission.takes_out(order) and set(mission.roster.active) == {robot}:
            return f"robot {robot} is the only one that flies: hold or disarm the fleet instead"
        view = fleet[robot]
        if order in WATER:
            return self._out_refusal(order, robot, view)
        if robot in mission.roster.out:
            return f"robot {robot} is {TAKEN_OUT} (groundstation mission back-in --robot {robot})"
        if not view.heard:
            return f"robot {robot} is not heard"
        if order is CommandKind.ARM:
            if view.mode is not Mode.DISARMED:
                return f"robot {robot} is {mode_name(view)}, not DISARMED"
            return "; ".join(preflight(self._experiment, {robot: view}))
        if order is CommandKind.DISARM:
            return f"robot {robot} is STOPPED: clear the stop" if view.mode is Mode.STOPPED else ""
        if view.mode not in LIVE:
            return f"robot {robot} is {mode_name(view)}: arm it first"
        if reason := self._may_not_move(order, robot, fleet):
            return reason
        return self._no_place(robot, fleet, place_m) if order is CommandKind.GO else ""

    def _may_not_move(self, order: CommandKind, robot: int, fleet: Fleet) -> str:
        """Reason why a robot may not do such a request as it sees now; empty if it may. Who drives it looks at the water."""
        foreign = foreign_poses_reason(self._experiment, fleet, (robot,)) if order in LED else ""
        return foreign or (blind_robots_reason(self._experiment, fleet, (robot,)) if order is CommandKind.GO else "")

    def _out_refusal(self, order: CommandKind, robot: int, view: RobotView) -> str:
        """Reason against OUT or BACK_IN for a robot; empty if there is none. One that may have power is not taken out."""
        roster = self._mission.roster
        if (robot in roster.out) is (order is CommandKind.OUT):
            return f"robot {robot} is {'' if order is CommandKind.OUT else 'not '}{TAKEN_OUT}"
        if order is CommandKind.OUT and may_have_power(view):
            return f"robot {robot} is {mode_name(view)}: disarm it first"
        if order is CommandKind.OUT and set(roster.all_robots) - roster.out == {robot}:
            return f"robot {robot} is the last one in the water"
        return ""

    def _no_place(self, robot: int, fleet: Fleet, place_m: tuple[float, float] | None) -> str:
        """The reason why a robot cannot go to a place, or ""."""
        if place_m is None:
            return "where to? (one place, x and y in m)"
        length, width, _ = self._experiment.pool.size_m
        if not (abs(place_m[0]) <= length / 2.0 and abs(place_m[1]) <= width / 2.0):
            return f"({place_m[0]:g}, {place_m[1]:g}) m is outside the pool"
        keep_m = 2.0 * self._experiment.safety.radius_m
        for other, view in self._others(robot, fleet).items():
            if np.hypot(*(view.eta[:2] - place_m)) < keep_m:
                return f"({place_m[0]:g}, {place_m[1]:g}) m is less than {keep_m:g} m from robot {other}"
        return ""

    def _others(self, robot: int, fleet: Fleet) -> Fleet:
        """The other robots in the water whose places are known."""
        return {r: v for r, v in fleet.items() if r != robot and r not in self._mission.roster.out and v.is_located}

    # --- the cycle

    def step(self, fleet: Fleet, results: Sequence[CommandResult], now_ns: int) -> tuple[Command, ...]:
        """Do one cycle; returns the commands to send now."""
        for result in results:
            task = self._under_way(result.command.robot)
            if task is not None:
                refusal = self._dispatchers[result.command.robot].on_results([result], now_ns)
                task.reason = refusal if result.command.order is not CommandKind.DRIVE or refusal else ""
                if task.order is result.command.order is CommandKind.ARM and result.reply.accepted:
                    task.armed_ns = now_ns if task.armed_ns is None else task.armed_ns
        commands: list[Command] = []
        for robot in self.tasks:
            task = self._under_way(robot)
            if task is None:
                continue
            goes_on = GOES_ON | DISARMING if task.order is CommandKind.DISARM else GOES_ON
            if self._is_reached(robot, task, fleet, now_ns):
                self._end(robot)
            elif self._mission.state not in goes_on or robot not in self.led:
                self._end(robot, f"the mission is {self._mission.state.value}")
            else:
                commands += self._advance(robot, task, fleet[robot], fleet, now_ns)
        return tuple(commands)

    def settle(self, fleet: Fleet, now_ns: int) -> None:
        """End the tasks whose aim is reached, before another request takes the robots."""
        for robot in self.led:
            if self._is_reached(robot, self.tasks[robot], fleet, now_ns):
                self._end(robot)

    def _is_reached(self, robot: int, task: RobotTask, fleet: Fleet, now_ns: int) -> bool:
        """True if a robot has done its task, by a state that it has sent since the task's present stage began."""
        view = fleet[robot]
        if task.order is CommandKind.GO:
            holds = task.started and view.heard and view.mode is Mode.HOLDING
            return holds and self._has_flown(task, view) and not self._not_there(robot, task, fleet)
        if task.order is CommandKind.DRIVE and task.velocity is not None:
            return False
        order = CommandKind.HOLD if task.order is CommandKind.DRIVE else task.order  # a drive without a velocity ends in HOLD
        if order is CommandKind.DISARM and not self._dispatchers[robot].has_sent(robot):
            return False  # a robot that is disarmed may still get an ARM that was sent before: DISARM has to follow it
        sent_since = view.state_age_s * 1e9 < now_ns - task.since_ns
        return sent_since and view.mode in CONFIRMS[order]

    def _advance(self, robot: int, task: RobotTask, view: RobotView, fleet: Fleet, now_ns: int) -> tuple[Command, ...]:
        """Follow one robot's task by a cycle; returns the commands to send for it."""
        if reason := self._may_not_move(task.order, robot, fleet):
            self._end(robot, reason)  # the mission lets it hold
            return ()
        if task.order is CommandKind.DRIVE and task.velocity is not None:
            return self._drive(robot, task, task.velocity, view, now_ns)
        if now_ns - task.since_ns > PATIENCE_S * 1e9 and not task.started:
            self._end(robot, task.reason or f"robot {robot} is {mode_name(view)}")
            return ()
        if task.order is CommandKind.GO:
            return self._go(robot, task, view, fleet, now_ns)
        if task.order is CommandKind.ARM:
            return self._arm(robot, task, view, now_ns)
        return self._send(CommandKind.HOLD if task.order is CommandKind.DRIVE else task.order, robot, None, now_ns)

    def _drive(
        self, robot: int, task: RobotTask, velocity: DriveVelocity, view: RobotView, now_ns: int
    ) -> tuple[Command, ...]:
        """Send the newest velocity, and HOLD when none comes any more."""
        if now_ns - task.since_ns > VELOCITY_LASTS_S * 1e9:
            self._let_go(robot, task, now_ns)
            return self._send(CommandKind.HOLD, robot, None, now_ns)
        if view.mode in (Mode.ARMED, Mode.TRACKING):
            return self._send(CommandKind.HOLD, robot, None, now_ns)
        if view.mode not in (Mode.HOLDING, Mode.DRIVEN):
            self._end(robot, f"robot {robot} is {mode_name(view)}")
            return ()
        return (Command(CommandKind.DRIVE, robot, VELOCITY_LASTS_S, self._experiment.hash, drive=velocity),)

    def _arm(self, robot: int, task: RobotTask, view: RobotView, now_ns: int) -> tuple[Command, ...]:
        """Send ARM to a robot without power. One that has lost it since, by a restart for example, is not armed again for the
        same request."""
        lost_power = task.armed_ns is not None and view.state_age_s * 1e9 < now_ns - task.armed_ns
        if view.mode in UNFIT or (view.mode is Mode.DISARMED and lost_power):
            self._end(robot, f"robot {robot} is {mode_name(view)}{' again' if lost_power else ''}")
            return ()
        return () if view.mode in LIVE else self._send(CommandKind.ARM, robot, None, now_ns)

    def _go(self, robot: int, task: RobotTask, view: RobotView, fleet: Fleet, now_ns: int) -> tuple[Command, ...]:
        """Hold, plan, load, start, fly, hold."""
        state, transfer = view.state, task.transfer
        if not view.heard or state is None or view.mode not in LIVE:
            self._end(robot, f"robot {robot} is {mode_name(view) if view.heard else 'not heard'}")
            return ()
        if transfer is None:
            if view.mode is not Mode.HOLDING or self._mission.departures.may_come(robot):
                return self._send(CommandKind.HOLD, robot, None, now_ns)
            rests = view.speed_mps < AT_REST_MPS or now_ns - task.since_ns > REST_WITHIN_S * 1e9
            if rests and self.plan_request is None:
                self._plan(robot, task, view, fleet)
            elif rests:  # a plan is made, its own or another robot's: that takes as long as the station lets it
                task.since_ns = now_ns
            return ()
        trajectory, flown = transfer.trajectories[robot], self._has_flown(task, view)
        if view.mode is Mode.HOLDING and task.started:
            on_the_way = f"robot {robot} holds: {state.fault or 'on the way'}"
            self._end(robot, self._not_there(robot, task, fleet) if flown else on_the_way)
            return ()
        if view.mode is Mode.TRACKING and state.trajectory_id == trajectory.id:
            task.started = True  # at the path's end a robot that lags has SETTLE_S to come up
            settled = flown and (view.speed_mps < AT_REST_MPS or state.trajectory_s >= transfer.end_s)
            return self._send(CommandKind.HOLD, robot, None, now_ns) if settled else ()
        if view.mode in MOVING:
            return self._send(CommandKind.HOLD, robot, None, now_ns)
        if state.trajectory_id != trajectory.id:
            return self._send(CommandKind.LOAD, robot, trajectory, now_ns)
        if task.timetable is None:
            task.timetable = Timetable(now_ns + round(START_IN_S * 1e9), trajectory.begin_s + self._mission.governor.lag_s)
            self._dispatchers[robot].reset()
        return self._send(CommandKind.START, robot, trajectory, now_ns, task.timetable)

    def _has_flown(self, task: RobotTask, view: RobotView) -> bool:
        """True if a robot has come to the end of its transfer."""
        ends_s = None if task.transfer is None else task.transfer.end_s - SETTLE_S
        return view.state is not None and ends_s is not None and view.state.trajectory_s >= ends_s

    def _not_there(self, robot: int, task: RobotTask, fleet: Fleet) -> str:
        """Reason to say that a robot is not at the place of its GO: it may have lagged, or had something in its way, or its
        poses are not its own. Empty if it is there."""
        assert task.place_m is not None
        away_m = float(np.hypot(*(fleet[robot].eta[:2] - task.place_m)))
        far = f"robot {robot} holds {away_m:.2f} m from there" if away_m > self._experiment.safety.off_path_m else ""
        return foreign_poses_reason(self._experiment, fleet, (robot,)) or far

    def _plan(self, robot: int, task: RobotTask, view: RobotView, fleet: Fleet) -> None:
        """Request a way to the task's place, clear of islands, obstacles and of where the other robots are now."""
        experiment, place_m = self._experiment, task.place_m
        assert place_m is not None
        away = self._mission.plans.monitor.discs_to_avoid(self._others(robot, fleet).values(), room_m=0.0)
        rest = view.rest
        goal = np.array([*place_m, rest[2], rest[3]])
        self._planned_for = robot, task
        self.plan_request = PlanRequest(
            f"robot {robot} alone",
            lambda out_of_time: plan_return(
                experiment, experiment.controller.period_s, {robot: rest}, {robot: goal}, away, out_of_time, away
            ),
        )

    def planned(self, outcome: PlanSegment | PlanError, fleet: Fleet, now_ns: int) -> None:
        """Take the outcome of the requested plan."""
        planned_for = self._planned_for
        self.plan_request = self._planned_for = None
        if planned_for is None:
            return
        robot, task = planned_for
        if self._under_way(robot) is not task:  # another request has taken its place
            return
        if isinstance(outcome, PlanSegment):
            alone = {robot: named_alone(trajectory) for robot, trajectory in outcome.trajectories.items()}
            task.transfer, task.since_ns = replace(outcome, trajectories=alone), now_ns
        else:
            self._end(robot, f"no way there: {outcome}")

    def _send(
        self, order: CommandKind, robot: int, trajectory: Trajectory | None, now_ns: int, timetable: Timetable | None = None
    ) -> tuple[Command, ...]:
        return self._dispatchers[robot].commands(order, {robot: trajectory}, now_ns, timetable)


def _text(task: RobotTask) -> str:
    """A robot's own task, as the operator reads it."""
    if task.order is CommandKind.GO and task.place_m is not None:
        return f"on its way to {task.place_m[0]:.2f}, {task.place_m[1]:.2f} m"
    if task.order is CommandKind.DRIVE and task.velocity is None:
        return "coming to rest"
    doing = {
        CommandKind.DRIVE: "driven",
        CommandKind.ARM: "arming",
        CommandKind.HOLD: "coming to rest",
        CommandKind.DISARM: "disarming",
    }[task.order]
    return f"{doing}{f': {task.reason}' if task.reason else ''}"
