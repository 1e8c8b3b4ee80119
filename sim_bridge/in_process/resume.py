"""A numeric flight that goes on from a moment of a run: each agent led through what its robot had been through, robots put
where they were. Pure; sim_bridge/in_process/resume_run.py has the files.

The agents remember all that the log says, so estimates, horizons and trajectories go on without a jump, also with other
settings. The water knows where robots are and how fast, and what their thrusters were told last; what else was in it (gusts,
waves, noise) begins by the seed. Without the truth, as in a real pool, robots are put where they took themselves to be.
"""

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field

import numpy as np

from robot_agent.agent import Agent
from robot_agent.inputs import StampedPlan
from robot_agent.rerun import Logged, Rerun
from sim_bridge.in_process.fleet import NS, AgentFleet, BareWater
from wire.config.experiment import Experiment
from wire.frames import Array
from wire.messages import topics
from wire.messages.codec import decode
from wire.messages.messages import Mode, Plan, RobotState, Truth
from wire.toml_loader import ConfigError

THRUST_MEMORY_S = 1.0  # of pulses, ten times a thruster's lag
WALL_CLOCK_NS = 10**16  # stamps below are of a lockstep run, and so the plant's own time: it began at 0, not in 1970
SAME_CLOCK_NS = 1_000_000_000  # the truth's stamps and a robot's are of one clock if they are as near as this


@dataclass
class Memory:
    """What one robot had been through."""

    agent: Agent
    plan: Plan | None = None
    states: list[tuple[int, RobotState]] = field(default_factory=list)  # with their stamps: its own clock
    truths: list[tuple[int, Truth]] = field(default_factory=list)

    @property
    def now_ns(self) -> int:
        """The moment, on the robot's clock."""
        return self.states[-1][0]

    @property
    def state(self) -> RobotState:
        """What it said then."""
        return self.states[-1][1]


def remember(experiment: Experiment, robot: int, lines: Iterable[Logged]) -> Memory:
    """Lead an agent through a log up to a moment. Raises ConfigError if it was not under way then."""
    rerun = Rerun(experiment, robot)
    memory = Memory(rerun.agent)

    def listened() -> Iterator[Logged]:
        for line in lines:
            topic, _, header, payload = line
            if topic is topics.STATE:
                memory.states.append((header.stamp_ns, decode(RobotState, payload, "log", topic.name)))
            if topic is topics.TRUTH:
                memory.truths.append((header.stamp_ns, decode(Truth, payload, "log", topic.name)))
            else:
                yield line

    for _, message, _ in rerun.run(listened()):
        if isinstance(message, Plan):
            memory.plan = message
    memory.agent = rerun.agent
    if not memory.states or rerun.agent.trajectory is None or rerun.agent.mode not in (Mode.TRACKING, Mode.HOLDING):
        raise ConfigError(f"robot {robot}: was {rerun.agent.mode.name} then, not under way")
    return memory


def branch(
    experiment: Experiment, memories: Sequence[Memory], seed: int, clock_ns: Callable[[], int] = lambda: 0
) -> tuple[AgentFleet, BareWater]:
    """The fleet as it was, ready to fly on."""
    at_ns = round(max(memory.state.trajectory_s for memory in memories) * NS)
    eta, nu = np.array([_whereabouts(memory, k, experiment.robot_ids) for k, memory in enumerate(memories)]).transpose(1, 0, 2)
    water = BareWater(experiment, seed, eta)
    now_ns = memories[0].now_ns if memories[0].now_ns < WALL_CLOCK_NS else at_ns
    armed = [memory.state.board_armed for memory in memories]
    water.take_up(eta, nu, _pulses(experiment, memories), armed, now_ns, now_ns - at_ns)
    trajectories = {r: m.agent.trajectory for r, m in zip(experiment.robot_ids, memories, strict=True) if m.agent.trajectory}
    fleet = AgentFleet(experiment, trajectories, water, seed, clock_ns)
    fleet.now_ns = at_ns
    for i, (robot, memory) in enumerate(zip(fleet.robots, memories, strict=True)):
        robot.agent = memory.agent
        robot.plan = StampedPlan(memory.plan, at_ns) if memory.plan is not None else None
        robot.states.append(memory.state)
        fleet.ahead_ns[i] = memory.now_ns - at_ns
    fleet.expose(at_ns)
    return fleet, water


def _whereabouts(memory: Memory, row: int, robots: Sequence[int]) -> tuple[Array, Array]:
    """Pose and velocity of a robot at the moment: the truth between its samples, or what the robot took it to be."""
    stamps = np.array([stamp for stamp, _ in memory.truths], dtype=np.float64)
    known = [truth for _, truth in memory.truths if truth.robots == tuple(robots)]
    if len(known) != len(stamps) or len(stamps) < 2 or np.abs(stamps - memory.now_ns).min() > SAME_CLOCK_NS:
        return memory.state.eta, memory.state.nu

    def between(rows: Array) -> Array:
        return np.array([np.interp(memory.now_ns, stamps, column) for column in rows.T])

    eta = np.array([truth.eta[row] for truth in known])
    eta[:, 3] = np.unwrap(eta[:, 3])
    return between(eta), between(np.array([truth.nu[row] for truth in known]))


def _pulses(experiment: Experiment, memories: Sequence[Memory]) -> list[Array]:
    """Those of all robots (n, 8) in their last control steps, the newest last; neutral where a board was not armed."""
    count = round(THRUST_MEMORY_S / experiment.controller.period_s)
    thruster, legs = experiment.vehicle.thruster, experiment.vehicle.legs
    neutral = (*[float(thruster.neutral_us)] * 4, *[sum(legs.ankle_us) / 2.0] * 4)

    def of(memory: Memory) -> list[tuple[float, ...]]:
        told = [tuple(map(float, s.pulse_us)) if s.board_armed else neutral for _, s in memory.states[-count:]]
        return [neutral] * (count - len(told)) + told

    return [np.array(step) for step in zip(*map(of, memories), strict=True)]
