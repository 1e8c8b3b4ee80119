"""Everything that the station decides: mission, robots that are led alone, gains, and the outcomes of requests. Pure.

`step` takes the fleet and the robots' replies, and returns the commands to send. `request`, `drive` and `request_gains` are
the one entrance for people and scripts. groundstation/station/station.py has the network, the threads and the clock.
"""

from collections.abc import Iterator, Mapping, Sequence

from groundstation.mission.command_dispatcher import CommandResult
from groundstation.mission.gain_update import TUNING, GainUpdater
from groundstation.mission.lap_statistics import LapStatistics
from groundstation.mission.mission import LIVE, Mission
from groundstation.mission.obstacle_monitor import ObstacleSet
from groundstation.mission.plan_manager import PlanRequest
from groundstation.mission.request_progress import AT_REST, RequestTracker
from groundstation.mission.single_robot import SingleRobotControl
from groundstation.mission.state_machine import MissionState
from groundstation.planning.feasibility import PlanError
from groundstation.planning.segment import PlanSegment
from groundstation.telemetry import Fleet
from wire.config.experiment import Experiment
from wire.messages.messages import Command, DriveVelocity, Order, Outcome, Progress
from wire.messages.topics import WHOLE_FLEET


class StationCore:
    """The station without its network: decisions of one run."""

    def __init__(self, experiment: Experiment, mission: Mission, tuner: GainUpdater, laps: LapStatistics) -> None:
        self.mission, self.tuner, self.laps = mission, tuner, laps
        self.single = SingleRobotControl(experiment, mission)
        self.requests = RequestTracker(experiment.robot_ids, self.single.tasks)
        self.ended = False  # a person has ended the run: every robot that is heard is at rest

    # --- the cycle

    def step(
        self, fleet: Fleet, answers: Sequence[CommandResult], now_ns: int, obstacles: ObstacleSet | None = None
    ) -> tuple[Command, ...]:
        """Do one cycle; returns the commands to send now."""
        for_tuner = [answer for answer in answers if answer.command.order in TUNING]
        led = self.mission.led = self.single.led
        for_one = [answer for answer in answers if answer not in for_tuner and answer.command.robot in led]
        for_mission = [answer for answer in answers if answer not in for_tuner and answer not in for_one]
        commands = self.mission.step(fleet, for_mission, now_ns, obstacles)
        commands += self.single.step(fleet, for_one, now_ns)
        commands += self.tuner.step(fleet, for_tuner, now_ns)
        self.laps.update(fleet)
        return commands

    def follow(self, fleet: Fleet, answers: Sequence[CommandResult]) -> tuple[Outcome, ...]:
        """Update the outcomes of requests; returns those that have ended. The run ends if one of them asks for it and is
        done."""
        ending = self.requests.ending
        over = self.requests.follow(self.mission, fleet, self.tuner.status(), answers)
        ends = [outcome.progress for outcome in self.requests.recent if outcome.order is Order.END]
        self.ended = self.ended or (ending and not self.requests.ending and ends[-1] is Progress.DONE)
        return over

    def plan_requests(self) -> Iterator[tuple[str, PlanRequest | None]]:
        """The plan that each owner waits for, with the owner's name."""
        yield "mission", self.mission.plan_request
        yield "single", self.single.plan_request

    def planned(self, owner: str, outcome: PlanSegment | PlanError, fleet: Fleet, now_ns: int) -> None:
        """Take the outcome of an owner's plan."""
        (self.mission if owner == "mission" else self.single).planned(outcome, fleet, now_ns)

    # --- requests; each returns the reason of a refusal, or nothing, and the request's number

    def request(
        self, order: Order, fleet: Fleet, now_ns: int, via: Sequence[tuple[float, float]] = (), only: int = WHOLE_FLEET
    ) -> tuple[str, int]:
        """Take a request for the whole fleet, or for the robot `only`; a STOP is for every robot."""
        only = WHOLE_FLEET if order is Order.STOP else only
        if only:
            reason = self.single.request(order, only, fleet, now_ns, via[0] if len(via) == 1 else None)
        elif order is Order.END:
            reason = self._end(fleet, now_ns)
        else:
            reason = self.mission.request(order, fleet, now_ns, via)
        return reason, 0 if reason else self.requests.begin(order, self.mission, only=only)

    def drive(self, robot: int, velocity: DriveVelocity, fleet: Fleet, now_ns: int) -> str:
        """Take a person's newest velocity for one robot. Returns the reason of a refusal, or nothing."""
        return self.single.drive(robot, velocity, fleet, now_ns)

    def request_gains(self, values: Mapping[str, float] | None, next_lap: bool, fleet: Fleet, now_ns: int) -> tuple[str, int]:
        """Change the fleet's gains; None: go back to those before."""
        reason = self.tuner.undo(fleet, now_ns) if values is None else self.tuner.request(values, next_lap, fleet, now_ns)
        return reason, 0 if reason else self.requests.begin(Order.TUNE, self.mission, self.tuner.status().wanted)

    def _end(self, fleet: Fleet, now_ns: int) -> str:
        """Disarm all robots that may be armed. Returns the reason of a refusal, or nothing."""
        moves = self.mission.state not in AT_REST or any(seen.heard and seen.mode in LIVE for seen in fleet.values())
        stopped = self.mission.state is MissionState.STOPPED
        return self.mission.request(Order.DISARM, fleet, now_ns) if moves and not stopped else ""
