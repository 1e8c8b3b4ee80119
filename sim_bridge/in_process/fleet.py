"""Agents and plant stepped in one process: the article's numeric scenes, and studies that need many flights. Pure.

    water = DirectPlant(experiment, seed, starts)
    fleet = AgentFleet(experiment, trajectories, water, seed)
    fleet.start()                       # robots held in place: load, arm, let go at time 0 of the trajectories
    for topic, robot, message, stamp_ns in fly(fleet, water):
        ...                             # the messages that a recorder would have heard
    fleet.errors()                      # truth minus reference

All that a robot's computer runs is there, from commands to pulses. Camera, network and MAVLink are left out. Poses are the
plant's, with the noise and the age that the experiment asks for; plans arrive one control step later, as in lockstep. This
module, resume.py and env.py are the only ones of the simulator that may import the robots' code.
"""

from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Protocol

import numpy as np

from robot_agent.agent import Agent, Outputs
from robot_agent.inputs import Inputs, StampedObstacles, StampedPlan, StampedPose, StationView
from shoal.config.experiment import Experiment
from shoal.errors import ConfigError
from shoal.frames import Array, pose_error
from shoal.messages import topics
from shoal.messages.codec import Header
from shoal.messages.messages import BoardReading, Command, CommandKind, Event, Message, Pose, Reply, RobotState, Trajectory
from shoal.messages.topics import Topic
from sim_bridge.fault_schedule import FaultSchedule
from sim_bridge.node.ideal_localizer import IdealLocalizer
from sim_bridge.plant.fleet import PlantRun
from sim_bridge.plant.sensors import BoardSensors

NS = 1_000_000_000
STATION_SESSION = 1
READY_NS = NS // 2  # ns for which robots are held before they start, until their estimates are at rest
INFO = 2  # an event's level
STILL = np.zeros(4)  # the agents read no accelerometer
SEEN_KEPT = 64  # poses and obstacles kept: more than the longest latency of the fastest loop

Sent = tuple[Topic, int | None, Message, int]  # topic, robot, message, stamp in ns


class SimulatedPlant(Protocol):
    """The plant, thruster boards included, as the fleet drives it. Robots go by index in the experiment; time is the
    plant's."""

    @property
    def now_ns(self) -> int: ...
    @property
    def eta(self) -> Array: ...
    @property
    def faults(self) -> FaultSchedule: ...
    def advance(self, to_ns: int) -> None: ...
    def telemetry(self, i: int, now_ns: int) -> BoardReading: ...
    def act(self, i: int, outputs: Outputs) -> None: ...


class DirectPlant(PlantRun):
    """The plant without boards: pulses go straight to the thrusters, and sensor readings straight to the agent."""

    def __init__(self, experiment: Experiment, seed: int, starts: Array) -> None:
        super().__init__(experiment, seed, starts)
        self._steps_a_period = experiment.plant_steps
        self._sensors = [BoardSensors(experiment, robot, seed) for robot in experiment.robot_ids]
        self._pulses_us = self._state.motors.pulses_us[0].copy()
        self._armed = [False] * len(starts)
        self.faults = FaultSchedule(experiment)
        self._note_voltage()
        self._begin_ns = 0  # instant at which the trajectories begin
        self.happened: list[str] = []  # faults that began or ended, until they are taken

    def resume_at(
        self, eta: Array, nu: Array, pulses_us: Sequence[Array], armed: Sequence[bool], now_ns: int, begin_ns: int
    ) -> None:
        """Continue at `now_ns` with robots at poses and velocities (n, 4).

        `pulses_us` (n, 8) are those of the last control steps, each a period long, the newest last; they fill the
        thrusters' command history. The trajectories began at `begin_ns`.
        """
        for pulses in pulses_us:
            for _ in range(self._steps_a_period):
                self._state = self._plant.step(self._state, pulses)
        eta, nu = np.ascontiguousarray(eta), np.ascontiguousarray(nu)  # the plant's kernels take no other layout
        self._state = replace(self._state, eta=eta, nu=nu, tilt=np.zeros_like(eta), steps=now_ns // self._step_ns)
        self._pulses_us, self._armed, self._begin_ns = pulses_us[-1].copy(), list(armed), begin_ns
        self._note_voltage()

    def advance(self, to_ns: int) -> None:
        """Move on to the first plant step at or after `to_ns`."""
        while (left := -((self.now_ns - to_ns) // self._step_ns)) > 0:
            self.happened += self._apply_faults()
            steps = self.faults.quiet_steps(self._flown_s, self._step_ns / NS, left)
            pulses_us = self.faults.pulses(self._pulses_us)
            self._state = self._plant.step(self._state, pulses_us, self.faults.actuators, steps)
        self._note_voltage()

    def _note_voltage(self) -> None:
        """Take note of the batteries' voltages without load, now."""
        self._rest_v: list[float] = self._plant.rest_v(self._state, self.faults.actuators).tolist()

    @property
    def _flown_s(self) -> float:
        """Time along the trajectories."""
        return (self.now_ns - self._begin_ns) / NS

    def _apply_faults(self) -> list[str]:
        """Move the fault timeline to now. Returns a line of text for each fault that began or ended."""
        changes = self.faults.advance(self._flown_s)
        self._set_gust(self.faults.gust_mps)
        for sensors, faults in zip(self._sensors, self.faults.imu if changes else (), strict=False):
            sensors.faults = faults
        return changes

    def telemetry(self, i: int, now_ns: int) -> BoardReading:
        """A board's telemetry of the i-th robot, `now_ns` on the agent's clock."""
        state = self._state
        reading = self._sensors[i].read(state.eta[i], state.nu[i], STILL, state.tilt[i], self._plant.time_s(state))
        return BoardReading(
            board_ms=now_ns // 1_000_000,
            arrival_ns=now_ns,
            heading_rad=reading.heading_rad,
            yaw_rate_radps=reading.heading_rate_radps,
            tilt=np.array(reading.tilt),
            acceleration_mps2=np.array(reading.acceleration_mps2),
            depth_m=reading.depth_m,
            battery_v=self._rest_v[i],
            armed=self._armed[i],
        )

    def put_out(self, pulses_us: Array) -> None:
        """Put pulses (n, 8) out, from now on."""
        self._pulses_us[:] = pulses_us

    def act(self, i: int, outputs: Outputs) -> None:
        """Take the i-th agent's pulses, and its request to arm or disarm."""
        self._pulses_us[i] = outputs.pulse_us
        self._armed[i] = self._armed[i] if outputs.arm is None else outputs.arm


@dataclass
class FleetMember:
    """One agent with its last plan and its states."""

    agent: Agent
    plan: StampedPlan | None = None
    states: list[RobotState] = field(default_factory=list)


class AgentFleet:
    """All agents of an experiment, with the localizer, the network and the station as they see them."""

    def __init__(
        self,
        experiment: Experiment,
        trajectories: Mapping[int, Trajectory],
        water: SimulatedPlant,
        seed: int,
        clock_ns: Callable[[], int] = lambda: 0,
    ) -> None:
        """`clock_ns` times the control steps for the report; no result depends on it."""
        self.experiment, self.trajectories = experiment, trajectories
        self.robots = [FleetMember(Agent(experiment, robot)) for robot in experiment.robot_ids]
        self.period_ns = round(experiment.controller.period_s * NS)
        self.now_ns = 0  # the agents' clock
        self.held = False  # robots are kept in place: the plant's time stands
        self.truth: list[Array] = []  # poses (n, 4) at each control step
        self.ahead_ns = [0] * len(self.robots)  # each robot's own clock less `now_ns`
        self.begin = 0  # the control step at which the trajectories began
        self._start_ns = 0
        self._water, self._clock_ns = water, clock_ns
        self._latency_ns = round(experiment.sim.latency_s * NS)
        self._localizer = IdealLocalizer(experiment, seed)
        self.poses: deque[tuple[int, list[Pose]]] = deque(maxlen=SEEN_KEPT)  # instant on the agents' clock, pose of each robot
        self.watched: deque[StampedObstacles] = deque(maxlen=SEEN_KEPT)
        self._orders = 0

    @property
    def time_s(self) -> float:
        """Time along the trajectories since `start`."""
        return (self.now_ns - self._start_ns) / NS

    def order(self, order: CommandKind, i: int, start_in_s: float = 0.0, trajectory_s: float = 0.0) -> Reply:
        """Give the i-th robot a command as the station would."""
        self._orders += 1
        robot = self.experiment.robot_ids[i]
        command = Command(
            order,
            robot,
            experiment_hash=self.experiment.hash,
            trajectory_id=self.trajectories[robot].id,
            trajectory_s=trajectory_s,
            trajectory=self.trajectories[robot] if order is CommandKind.LOAD else None,
            start_ns=self.now_ns + round(start_in_s * NS),
        )
        return self.robots[i].agent.handle_command(
            Header(STATION_SESSION, self._orders, self.now_ns), command, self.station(), self.now_ns
        )

    def start(self) -> None:
        """Hold the robots until their estimates are at rest, then let go at the instant at which the trajectories begin:
        time 0 of the scene. Raises ConfigError if a robot refuses, with its reason."""
        self.held = True
        for _ in range(max(READY_NS // self.period_ns - 1, 1)):
            self.step()
        for order in (CommandKind.LOAD, CommandKind.ARM):
            self._command_all(order)
        self.step()  # the boards arm meanwhile
        self._command_all(CommandKind.START)
        self._start_ns = self.now_ns + self.period_ns
        self.step()
        self.held, self.begin = False, len(self.truth)

    def _command_all(self, order: CommandKind) -> None:
        """Give a command to every robot; START is for the next step. Raises ConfigError if one refuses."""
        for i in range(len(self.robots)):
            reply = self.order(order, i, start_in_s=self.period_ns / NS)
            if not reply.accepted:
                raise ConfigError(f"robot {reply.robot} refuses {order.name}: {reply.reason}")

    def step(self) -> None:
        """Advance the plant by one control period, then make one control step of every robot."""
        self._advance_plant()
        self.now_ns += self.period_ns
        self.truth.append(self._water.eta.copy())
        plans = {r: robot.plan for r, robot in zip(self.experiment.robot_ids, self.robots, strict=True)}
        for i in range(len(self.robots)):
            self.control_step(i, plans)

    def errors(self) -> Array:
        """Truth minus reference (steps, n, 4) since the trajectories began, yaw to the path's tangent.

        The reference is the trajectory's, because a robot that has given up reports its own pose as its reference.
        """
        truth = np.array(self.truth[self.begin :])
        time_s = np.arange(1.0, len(truth) + 1.0) * (self.period_ns / NS)
        reference = [_poses(self.trajectories[robot], time_s) for robot in self.experiment.robot_ids]
        return pose_error(truth, np.stack(reference, axis=1))

    def _advance_plant(self) -> None:
        """Advance the plant by one control period, to the next control step. On the way the camera exposes one frame, so early
        that with the camera's latency its poses arrive just in time for this step or a later one."""
        exposure_lead_ns = self._latency_ns % self.period_ns
        end_ns = self._water.now_ns + self.period_ns
        if not self.held:
            self._water.advance(end_ns - exposure_lead_ns)
        self.expose(self.now_ns + self.period_ns - exposure_lead_ns)
        if not self.held:
            self._water.advance(end_ns)

    def expose(self, stamp_ns: int) -> None:
        """Localize every robot, and the obstacles, as the plant has them now. `stamp_ns`: the exposure by the agents'
        clock."""
        self.poses.append((stamp_ns, self._localizer.poses(self._water.eta)))
        obstacles = self._localizer.obstacles(self._water.now_ns / NS, self._water.faults.balls)
        if obstacles is not None:
            self.watched.append(StampedObstacles(obstacles, stamp_ns))

    def control_step(self, i: int, plans: Mapping[int, StampedPlan | None]) -> None:
        """One control step of the i-th robot."""
        robot, robot_id, now_ns = self.robots[i], self.experiment.robot_ids[i], self.now_ns + self.ahead_ns[i]
        has_radio = robot_id not in self._water.faults.without_radio
        inputs = self._received(i, plans) if has_radio else self._remembered(i)
        inputs = replace(inputs, board=self._water.telemetry(i, now_ns))
        begin_ns = self._clock_ns()
        outputs = robot.agent.step(inputs, now_ns)
        took_ns = self._clock_ns() - begin_ns
        self._water.act(i, outputs)
        if outputs.plan is not None and has_radio:
            robot.plan = StampedPlan(outputs.plan, self.now_ns)
        timing = replace(outputs.state.timing, step_us=took_ns / 1000.0)
        robot.states.append(replace(outputs.state, timing=timing) if took_ns else outputs.state)

    def _received(self, i: int, plans: Mapping[int, StampedPlan | None]) -> Inputs:
        """Inputs of the i-th robot by radio. Their instants are on its own clock, which is `ahead_ns` ahead of the plant's."""
        robot, ahead_ns = self.experiment.robot_ids[i], self.ahead_ns[i]
        others = {other: plan for other, plan in plans.items() if plan is not None and other != robot}
        pose, obstacles = self.pose(i), self._newest_obstacles()
        return Inputs(
            pose=pose and StampedPose(pose.pose, pose.instant_ns + ahead_ns),
            station=self.station(),
            plans={other: StampedPlan(plan.plan, plan.instant_ns + ahead_ns) for other, plan in others.items()},
            obstacles=obstacles and StampedObstacles(obstacles.obstacles, obstacles.instant_ns + ahead_ns),
        )

    def _remembered(self, i: int) -> Inputs:
        """Inputs of the i-th robot without a radio: its last ones, a step older."""
        inputs = self.robots[i].agent.inputs
        clock_ns, age_s = inputs.station.clock_ns + self.period_ns, inputs.station.age_s + self.period_ns / NS
        return replace(inputs, station=replace(inputs.station, clock_ns=clock_ns, age_s=age_s))

    def pose(self, i: int) -> StampedPose | None:
        """The newest pose of the i-th robot that the localizer has published by now."""
        for stamp_ns, poses in reversed(self.poses):
            if stamp_ns <= self.now_ns - self._latency_ns:
                return StampedPose(poses[i], stamp_ns)
        return None

    def _newest_obstacles(self) -> StampedObstacles | None:
        """The newest obstacles that the localizer has published by now."""
        return next((w for w in reversed(self.watched) if w.instant_ns <= self.now_ns - self._latency_ns), None)

    def station(self) -> StationView:
        """The station as the robots hear it."""
        return StationView(STATION_SESSION, self.now_ns, 0.0)


def _poses(trajectory: Trajectory, time_s: Array) -> Array:
    """The reference (n, 4) at n instants."""
    grid = trajectory.period_s * np.arange(len(trajectory.eta))
    return np.array([np.interp(time_s, grid, column) for column in trajectory.eta.T]).T


def fly(fleet: AgentFleet, water: DirectPlant) -> Iterator[Sent]:
    """Fly a fleet that has started to the end of its experiment.

    Yields the messages that a pool's recorder hears, except plans: they are three quarters of a log, and no report reads
    them.
    """
    for robot, trajectory in fleet.trajectories.items():
        yield topics.TRAJECTORY, robot, trajectory, 0
    yield from _published(fleet, water)
    while fleet.time_s < fleet.experiment.duration_s - 1e-9:
        fleet.step()
        yield from _published(fleet, water)


def _published(fleet: AgentFleet, water: DirectPlant) -> Iterator[Sent]:
    """Truth, poses, states and events of the last step."""
    for text in water.happened:
        yield topics.EVENT, None, Event(INFO, "sim-bridge", text), fleet.now_ns
    water.happened.clear()
    yield topics.TRUTH, None, water.truth(), fleet.now_ns
    if fleet.watched:
        yield topics.OBSTACLES, None, fleet.watched[-1].obstacles, fleet.watched[-1].instant_ns
    stamp_ns, poses = fleet.poses[-1]
    for robot, pose, member in zip(fleet.experiment.robot_ids, poses, fleet.robots, strict=True):
        yield topics.POSE, robot, pose, stamp_ns
        if robot not in water.faults.without_radio:
            yield topics.STATE, robot, member.states[-1], fleet.now_ns
