"""Agents, boards and plant in one process: the real cores and the real MAVLink bytes, without camera, network or clocks.

Poses are the plant's truth with noise and delay, so what is tested is everything between a pose and the water.
"""

from collections import deque
from dataclasses import dataclass, field

import numpy as np

from groundstation import planner
from robot_agent.agent import Agent, Heard, Inputs, Seen
from robot_agent.orders import StationView
from sim_bridge.world import World
from wire.codec import Header
from wire.experiment import Experiment
from wire.frames import Array
from wire.mavlink import AgentLink
from wire.messages import Command, Order, Plan, Pose, Reply, RobotState, Track

STATION_SESSION = 5


@dataclass
class Robot:
    """One robot's computer: the agent and its end of the link."""

    agent: Agent
    link: AgentLink
    inbox: bytes = b""
    plan: Heard | None = None
    states: list[RobotState] = field(default_factory=list)


class DryPool:
    """Steps everything by one control period at a time. What a test wants to break is an attribute."""

    def __init__(
        self,
        experiment: Experiment,
        seed: int = 1,
        pose_noise_m: float = 0.0015,
        yaw_noise_rad: float = 0.008,
        delay_s: float = 0.04,
    ) -> None:
        self.experiment = experiment
        self.trajectories = planner.plan(experiment)
        starts = planner.start_poses(experiment, self.trajectories)
        self.world = World(experiment, seed, np.array([starts[r] for r in experiment.robot_ids]))
        self.robots = [Robot(Agent(experiment, r), AgentLink(r)) for r in experiment.robot_ids]
        self.period_ns = round(experiment.controller.period_s * 1e9)
        self.now_ns = 0
        self.truth: list[Array] = []  # (n, 4) per control step
        self.pulses: list[Array] = []  # (n, 8) on the boards' outputs, per control step
        self.camera_works = True
        self.station_works = True
        self.agents_work = [True] * len(self.robots)
        self._noise = np.array([pose_noise_m, pose_noise_m, yaw_noise_rad])
        self._random = np.random.default_rng([seed, 77])
        self._delay = round(delay_s * 1e9)
        self._seen: deque[tuple[int, Array]] = deque(maxlen=8)
        self._station_ns = 0
        self._blind_ns = 0  # nothing exposed after this is seen while the camera fails
        self._orders = 0

    def order(self, order: Order, robot: int, **more: object) -> Reply:
        """Give one robot an order as the station would."""
        self._orders += 1
        trajectory = self.trajectories[self.experiment.robot_ids[robot]] if order is Order.LOAD else None
        command = Command(
            order, self.experiment.robot_ids[robot], experiment_hash=self.experiment.hash, trajectory=trajectory, **more  # type: ignore[arg-type]
        )  # fmt: skip
        header = Header(STATION_SESSION, self._orders, self.now_ns)
        return self.robots[robot].agent.order(header, command, self._station(), self.now_ns)

    def take_off(self, start_in_s: float = 0.2) -> None:
        """Load, arm and start every robot; an order that is refused is a failed test."""
        self.run(0.5)
        for order in (Order.LOAD, Order.ARM, Order.START):
            for robot in range(len(self.robots)):
                reply = self.order(order, robot, start_in_s=start_in_s)
                assert reply.accepted, f"{order.name}: {reply.reason}"

    def run(self, seconds: float) -> None:
        """Fly on."""
        for _ in range(round(seconds * 1e9 / self.period_ns)):
            self._step()

    def _step(self) -> None:
        end_ns = self.now_ns + self.period_ns
        while self.world.now_ns < end_ns:
            for i, data in self.world.step():
                self.robots[i].inbox += data
            if self.world.exposed:
                noise = self._random.normal(size=(len(self.robots), 3)) * self._noise
                self._seen.append((self.world.now_ns, self.world.eta[:, [0, 1, 3]] + noise))
        self.now_ns = end_ns
        if self.station_works:
            self._station_ns = self.now_ns
        plans = {r: robot.plan for r, robot in zip(self.experiment.robot_ids, self.robots, strict=True)}
        self.truth.append(self.world.eta.copy())
        for i, robot in enumerate(self.robots):
            if self.agents_work[i]:
                self._think(i, robot, plans)
        self.pulses.append(np.array([board.pulses for board in self.world._boards]))

    def _think(self, i: int, robot: Robot, plans: dict[int, Heard | None]) -> None:
        robot.link.receive(robot.inbox, self.now_ns)
        robot.inbox = b""
        others = {r: plan for r, plan in plans.items() if plan is not None and r != self.experiment.robot_ids[i]}
        outputs = robot.agent.step(Inputs(self._pose(i), robot.link.telemetry, self._station(), False, others), self.now_ns)
        if outputs.arm is not None:
            self.world.receive(i, robot.link.arm(outputs.arm))
        self.world.receive(i, robot.link.pulses(outputs.pulse_us))
        robot.plan = Heard(outputs.plan, self.now_ns) if isinstance(outputs.plan, Plan) else robot.plan
        robot.states.append(outputs.state)

    def _pose(self, i: int) -> Seen | None:
        if not self.camera_works:
            self._seen = deque((e for e in self._seen if e[0] <= self._blind_ns), maxlen=8)
        else:
            self._blind_ns = self.now_ns
        found = [entry for entry in self._seen if entry[0] <= self.now_ns - self._delay]
        if not found:
            return None
        stamp_ns, poses = found[-1]
        x, y, yaw = poses[i]
        return Seen(Pose(x, y, yaw, np.eye(3) * 1e-6, Track.MARKER, True, 0.9), stamp_ns)

    def _station(self) -> StationView:
        age_s = (self.now_ns - self._station_ns) * 1e-9
        return StationView(STATION_SESSION, self.now_ns, age_s if self._station_ns else float("inf"))

    def errors(self) -> Array:
        """Truth minus reference (steps, n, 4) from the start of the trajectories on, yaw against the path's tangent."""
        begin = next(k for k, s in enumerate(self.robots[0].states) if s.trajectory_s > 0)
        truth = np.array(self.truth)[begin:]
        reference = np.array([[s.eta_reference for s in robot.states[begin:]] for robot in self.robots])
        error: Array = truth - reference.transpose(1, 0, 2)
        return error
