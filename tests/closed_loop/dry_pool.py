"""Agents, boards and plant in one process: the real cores and the real MAVLink bytes, without camera, network or clocks.

Poses are the plant's truth with noise and delay, so what is tested is everything between a pose and the water. What a test
wants to break is an attribute.
"""

from collections.abc import Callable, Mapping

import numpy as np

from groundstation.planning import planner
from robot_agent.agent import Outputs
from robot_agent.inputs import StampedPlan, StationView
from shoal.config.experiment import Experiment
from shoal.config.simulation import Numeric
from shoal.frames import Array
from shoal.mavlink.agent_link import AgentLink, Telemetry
from shoal.messages.messages import CommandKind
from sim_bridge.fault_schedule import FaultSchedule
from sim_bridge.in_process.fleet import STATION_SESSION, AgentFleet
from sim_bridge.thruster_board.board import ThrusterBoard
from sim_bridge.world import World, WorldBoard

MakeBoard = Callable[[Experiment, int, int], WorldBoard]


class BoardWater:
    """The simulated world with its boards at the ends of the agents' links, byte for byte."""

    def __init__(self, experiment: Experiment, seed: int, starts: Array, make: MakeBoard) -> None:
        self.world = World(experiment, seed, starts, make)
        self.links = [AgentLink(robot) for robot in experiment.robot_ids]
        self._inboxes = [b""] * len(starts)

    @property
    def now_ns(self) -> int:
        return self.world.now_ns

    @property
    def eta(self) -> Array:
        return self.world.eta

    @property
    def faults(self) -> FaultSchedule:
        return self.world.faults

    def advance(self, to_ns: int) -> None:
        while self.world.now_ns < to_ns:
            for i, data in self.world.step(to_ns):
                self._inboxes[i] += data

    def telemetry(self, i: int, now_ns: int) -> Telemetry:
        self.links[i].receive(self._inboxes[i], now_ns)
        self._inboxes[i] = b""
        return self.links[i].telemetry

    def act(self, i: int, outputs: Outputs) -> None:
        if outputs.arm is not None:
            self.world.receive(i, self.links[i].arm(outputs.arm))
        self.world.receive(i, self.links[i].pulses(outputs.pulse_us))


class DryPool(AgentFleet):
    """Steps everything by one control period at a time."""

    def __init__(
        self,
        experiment: Experiment,
        seed: int = 1,
        pose_noise_m: float = 0.0015,
        yaw_noise_rad: float = 0.008,
        delay_s: float = 0.04,
        make: MakeBoard = ThrusterBoard,
    ) -> None:
        numeric = Numeric(pose_noise_m=pose_noise_m, yaw_noise_rad=yaw_noise_rad)
        sim = experiment.sim.model_copy(update={"latency_s": delay_s, "numeric": numeric})
        experiment = experiment.model_copy(update={"sim": sim})
        trajectories = planner.plan(experiment)
        starts = planner.start_poses(experiment, trajectories)
        water = BoardWater(experiment, seed, np.array([starts[r] for r in experiment.robot_ids]), make)
        super().__init__(experiment, trajectories, water, seed)
        self.world, self.links = water.world, water.links
        self.pulses: list[Array] = []  # (n, 8) on the boards' outputs, per control step
        self.camera_works = True
        self.station_works = True
        self.agents_work = [True] * len(self.robots)
        self._station_ns = 0

    def take_off(self, start_in_s: float = 0.2) -> None:
        """Load, arm and start every robot; an order that is refused is a failed test."""
        self.run(0.5)
        for order in (CommandKind.LOAD, CommandKind.ARM, CommandKind.START):
            for robot in range(len(self.robots)):
                reply = self.order(order, robot, start_in_s=start_in_s)
                assert reply.accepted, f"{order.name}: {reply.reason}"

    def run(self, seconds: float) -> None:
        """Fly on."""
        for _ in range(round(seconds * 1e9 / self.period_ns)):
            self.step()
            self.pulses.append(np.array([board.pulses for board in self.world.boards]))

    def expose(self, stamp_ns: int) -> None:
        if self.camera_works:
            super().expose(stamp_ns)

    def control_step(self, i: int, plans: Mapping[int, StampedPlan | None]) -> None:
        if self.agents_work[i]:
            super().control_step(i, plans)

    def station(self) -> StationView:
        if self.station_works:
            self._station_ns = self.now_ns
        age_s = (self.now_ns - self._station_ns) * 1e-9
        return StationView(STATION_SESSION, self.now_ns, age_s if self._station_ns else float("inf"))
