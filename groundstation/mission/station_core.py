"""Everything that the station decides: mission, robots that are led alone, gains, and the outcomes of requests. Pure.

`step` takes the fleet and the robots' replies, and returns the commands to send. `request`, `drive` and `request_gains` are
the one entrance for people and scripts. groundstation/station/station.py has the network, the threads and the clock.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace

from groundstation.mission.command_dispatcher import MOVING, CommandResult
from groundstation.mission.gain_update import TUNING, GainUpdater
from groundstation.mission.lap_statistics import LapStatistics
from groundstation.mission.mission import AT_REST_MPS, Mission, may_have_power
from groundstation.mission.objections import LIVE
from groundstation.mission.obstacle_monitor import ObstacleSet
from groundstation.mission.plan_manager import PlanRequest
from groundstation.mission.request_progress import RequestTracker
from groundstation.mission.single_robot import SingleRobotControl
from groundstation.mission.state_machine import AT_REST, MissionState, states_allowing
from groundstation.planning.feasibility import PlanError
from groundstation.planning.segment import PlanSegment
from groundstation.telemetry import Fleet, RobotView
from shoal.bus.command_deduplication import ALWAYS_TAKEN
from shoal.config.experiment import Experiment
from shoal.messages.messages import WHOLE_FLEET, Command, CommandKind, DriveVelocity, Mode, Outcome, Progress

COURSE = frozenset(
    {CommandKind.STOP, CommandKind.RETURN, CommandKind.START}
)  # a person's: the first two take an automatic run over


class StationCore:
    """The station without its network: decisions of one run."""

    def __init__(self, experiment: Experiment, mission: Mission, tuner: GainUpdater) -> None:
        self.mission, self.tuner, self.laps = mission, tuner, LapStatistics()
        self.single = SingleRobotControl(experiment, mission)
        self.requests = RequestTracker(experiment.robot_ids)
        self.ended = False  # the run is over: every robot that is heard is at rest, or the program was interrupted
        self.by_hand = False  # a person stopped the fleet or sent it back, and has started no flight since

    # --- the cycle

    def step(
        self, fleet: Fleet, answers: Sequence[CommandResult], now_ns: int, obstacles: ObstacleSet | None = None
    ) -> tuple[Command, ...]:
        """Do one cycle; returns the commands to send now."""
        for_tuner = [answer for answer in answers if answer.command.order in TUNING]
        led = self.single.led
        for_one = [answer for answer in answers if answer not in for_tuner and answer.command.robot in led]
        for_mission = [answer for answer in answers if answer not in for_tuner and answer not in for_one]
        commands = self.mission.step(fleet, for_mission, now_ns, obstacles)
        commands += self.single.step(fleet, for_one, now_ns)
        commands += self.tuner.step(fleet, for_tuner, now_ns, self.mission.plans.laps)
        self.laps.update(self.mission.flying(fleet), self.mission.plans.laps)
        return commands

    def view(self, robot: int, view: RobotView, now_ns: int) -> RobotView:
        """A robot as it is seen, compared with what the fleet does: its lag, and whether it has the fleet's gains."""
        state = view.state
        other_gains = state is not None and state.tuning_id not in ("", self.tuner.status().flown.id)
        out = robot in self.mission.roster.out
        return replace(view, behind_s=self.mission.behind_s(robot, view, now_ns), other_gains=other_gains, out=out)

    def follow(self, fleet: Fleet, answers: Sequence[CommandResult]) -> tuple[Outcome, ...]:
        """Update the outcomes of requests; returns those that are over. The run has ended when a request END is done."""
        was_ending = self.requests.ending
        outcomes = self.requests.follow(self.mission, fleet, self.tuner.status(), answers)
        if was_ending and not self.requests.ending:
            ends = [outcome for outcome in self.requests.recent if outcome.order is CommandKind.END]
            self.ended = self.ended or ends[-1].progress is Progress.DONE
        return outcomes

    def plan_requests(self) -> Iterator[tuple[str, PlanRequest | None]]:
        """The plan that each owner waits for, with the owner's name."""
        yield "mission", self.mission.plan_request
        yield "single", self.single.plan_request

    def planned(self, owner: str, outcome: PlanSegment | PlanError, fleet: Fleet, now_ns: int) -> None:
        """Take the outcome of an owner's plan."""
        (self.mission if owner == "mission" else self.single).planned(outcome, fleet, now_ns)

    # --- requests, of a fleet as it is seen at `now_ns`; each returns the reason of a refusal, or nothing, and the request's
    #     number

    def request(
        self,
        order: CommandKind,
        fleet: Fleet,
        now_ns: int,
        via: Sequence[tuple[float, float]] = (),
        only: int = WHOLE_FLEET,
        text: str = "",
    ) -> tuple[str, int]:
        """Take a request for the whole fleet, or for the robot `only`; a STOP is for every robot. Once the run is ended, only
        what takes power away: the station is about to leave."""
        if self.ended and order not in ALWAYS_TAKEN | {CommandKind.END}:
            return "the run is ended", 0
        self._settle(fleet, now_ns)
        only = WHOLE_FLEET if order is CommandKind.STOP else only
        if only:
            reason = self.single.request(order, only, fleet, now_ns, via[0] if len(via) == 1 else None)
            return reason, 0 if reason else self._begin_task(only)
        reason = (
            self._end(fleet, now_ns) if order is CommandKind.END else self.mission.request(order, fleet, now_ns, via, text)
        )
        if not reason and order in COURSE:
            self.by_hand = order is not CommandKind.START
        return reason, 0 if reason else self.requests.begin(order, self.mission)

    def come_to_rest(self, fleet: Fleet, now_ns: int) -> bool:
        """Hold every robot that moves, also one that is led alone, before the station ends. Returns False once no robot that
        is heard moves."""
        self.mission.roster.take_back()
        if self.mission.state in states_allowing(CommandKind.HOLD) - {MissionState.PAUSED}:
            self.request(CommandKind.HOLD, fleet, now_ns)
        moving = [view for view in fleet.values() if view.heard and view.mode in LIVE - {Mode.ARMED}]
        return any(view.mode in MOVING or view.speed_mps > AT_REST_MPS for view in moving)

    def leave(self, fleet: Fleet, now_ns: int) -> None:
        """Disarm every robot: the station is about to leave, and no person has asked for it."""
        self.request(CommandKind.END, fleet, now_ns)
        if self.mission.state is MissionState.ENDING:
            self.mission.reason = "the station was told to end"

    def drive(self, robot: int, velocity: DriveVelocity, fleet: Fleet, now_ns: int) -> str:
        """Take a person's newest velocity for one robot: one request from the first to letting go. Returns the reason of a
        refusal, or nothing."""
        self._settle(fleet, now_ns)
        reason = self.single.drive(robot, velocity, fleet, now_ns)
        if not reason and robot in self.single.led:
            self._begin_task(robot)
        return reason

    def _settle(self, fleet: Fleet, now_ns: int) -> None:
        """Before a request: what those before it have reached is done, whatever this one does. Before the first cycle there is
        no view of any robot."""
        if fleet:
            self.single.settle(fleet, now_ns)
            self.requests.settle(self.mission, fleet, self.tuner.status())

    def _begin_task(self, robot: int) -> int:
        return self.requests.begin_task(robot, self.single.tasks[robot], self.mission)

    def request_gains(self, values: Mapping[str, float] | None, next_lap: bool, fleet: Fleet, now_ns: int) -> tuple[str, int]:
        """Change the fleet's gains; None: go back to those before."""
        self._settle(fleet, now_ns)
        formation = {robot: fleet[robot] for robot in self.mission.roster.active}
        if values is None:
            reason = self.tuner.undo(formation, now_ns)
        else:
            laps = self.mission.plans.laps if next_lap else None
            reason = self.tuner.request(values, formation, now_ns, self.mission.flying(formation), laps)
        return reason, 0 if reason else self.requests.begin(CommandKind.TUNE, self.mission, self.tuner.status().wanted)

    def _end(self, fleet: Fleet, now_ns: int) -> str:
        """Disarm all robots that may be armed. Returns the reason of a refusal, or nothing."""
        if self.mission.state is MissionState.STOPPED:
            return ""
        rests = self.mission.state in AT_REST and not any(may_have_power(view) for view in fleet.values())
        return "" if rests else self.mission.request(CommandKind.DISARM, fleet, now_ns)
