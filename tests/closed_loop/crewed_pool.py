"""The dry pool with the station's mission in command: orders, plans, pace, answers go their real ways, without a network."""

from collections.abc import Callable, Sequence

import numpy as np

from groundstation.mission.command_dispatcher import CommandResult
from groundstation.mission.mission import Mission
from groundstation.mission.obstacle_monitor import ObstacleSet
from groundstation.mission.state_machine import MissionState
from groundstation.planning import planner
from groundstation.planning.feasibility import PlanError
from groundstation.planning.segment import first_segment
from groundstation.telemetry import RobotView
from robot_agent.agent import Agent
from robot_agent.inputs import StationView
from shoal.config.experiment import Experiment
from shoal.frames import Array
from shoal.messages.codec import Header
from shoal.messages.messages import Command, CommandKind, Reply
from sim_bridge.in_process.fleet import STATION_SESSION
from tests.closed_loop.dry_pool import DryPool

NS = 1_000_000_000


class CrewedPool(DryPool):
    """Robots, water, and a mission that commands them. `things` is what the localizer would see, (k, 3: x, y, radius)."""

    def __init__(self, experiment: Experiment, automatic: bool = False, seed: int = 1) -> None:
        super().__init__(experiment, seed)
        segment = first_segment(self.experiment)
        starts = planner.start_poses(self.experiment, segment.trajectories)
        self.mission = Mission(self.experiment, segment, starts, automatic)
        self.starts = starts
        self.things = np.zeros((0, 3))
        self.loses: Callable[[Command], bool] = lambda command: False  # orders that do not arrive
        self.references: list[Array] = []  # (robots, 12) at each step: pose, velocity, acceleration of the goal now
        self.phases: list[MissionState] = []
        self.reasons: list[str] = []
        self._answers: list[CommandResult] = []
        self._sent = 0
        self._heard_ns = [-1] * len(self.robots)

    def station(self) -> StationView:
        pace = self.mission.governor
        return StationView(STATION_SESSION, self.now_ns, 0.0, pace.lag_s, 1.0 - pace.rate)

    def fleet(self) -> dict[int, RobotView]:
        views = {}
        for i, (robot, member) in enumerate(zip(self.experiment.robot_ids, self.robots, strict=True)):
            stamped_pose = self.pose(i)
            age_s = (self.now_ns - self._heard_ns[i]) / NS if self._heard_ns[i] >= 0 else float("inf")
            state = member.states[-1] if member.states else None
            views[robot] = RobotView(state, age_s, stamped_pose.pose if stamped_pose else None, 0.03)
        return views

    def step(self) -> None:
        self._advance_plant()
        self.now_ns += self.period_ns
        self.truth.append(self.world.eta.copy())
        self._command()
        plans = {r: robot.plan for r, robot in zip(self.experiment.robot_ids, self.robots, strict=True)}
        for i in range(len(self.robots)):
            if self.agents_work[i]:
                self.control_step(i, plans)
                self._heard_ns[i] = self.now_ns
        self.references.append(np.array([_goal(robot.agent) for robot in self.robots]))
        self.pulses.append(np.array([board.pulses for board in self.world.boards]))

    def run(self, seconds: float) -> None:
        for _ in range(round(seconds * NS / self.period_ns)):
            self.step()

    def until(self, *phases: MissionState, within_s: float) -> None:
        """Fly on until the mission is in one of these; not getting there is a failed test."""
        for _ in range(round(within_s * NS / self.period_ns)):
            self.step()
            if self.mission.state in phases:
                return
        raise AssertionError(f"still {self.mission.state.name}: {self.mission.reason}; came by {self.phases}")

    def request(self, order: CommandKind, via: Sequence[tuple[float, float]] = ()) -> str:
        return self.mission.request(order, self.fleet(), self.now_ns, via)

    def restart(self, i: int) -> None:
        """The i-th robot's program anew, as after a crash."""
        self.robots[i].agent = Agent(self.experiment, self.experiment.robot_ids[i])
        self.agents_work[i] = True

    def separation_m(self, since: int = 0) -> float:
        """The least distance between any two robots, in truth."""
        truth = np.array(self.truth[since:])[:, :, :3]
        pairs = [(a, b) for a in range(truth.shape[1]) for b in range(a)]
        return min(float(np.linalg.norm(truth[:, a] - truth[:, b], axis=1).min()) for a, b in pairs)

    def _command(self) -> None:
        around = ObstacleSet(tuple(range(len(self.things))), self.things)
        fleet = self.fleet()
        commands = self.mission.step(fleet, self._answers, self.now_ns, around)
        if self.mission.plan_request is not None:
            wanted = self.mission.plan_request
            try:
                self.mission.planned(wanted.plan(), fleet, self.now_ns)
            except PlanError as error:
                self.mission.planned(error, fleet, self.now_ns)
        self._answers = []
        for command in commands:
            i = self.experiment.robot_ids.index(command.robot)
            if self.loses(command):
                self._answers.append(CommandResult(command, Reply(command.robot, False, "no answer")))
            elif self.agents_work[i]:
                self._sent += 1
                header = Header(STATION_SESSION, self._sent, self.now_ns)
                reply = self.robots[i].agent.handle_command(header, command, self.station(), self.now_ns + self.ahead_ns[i])
                self._answers.append(CommandResult(command, reply))
        if not self.phases or self.phases[-1] is not self.mission.state:
            self.phases.append(self.mission.state)
            self.reasons.append(self.mission.reason)


def _goal(agent: Agent) -> Array:
    """The goal of a robot (12,), NaN where it has none."""
    goal = agent.controller.goal
    if goal is None:
        return np.full(12, np.nan)
    path = agent.controller.sampler.sample(goal)
    return np.concatenate([path.eta[0], path.velocity[0], path.acceleration[0]])
