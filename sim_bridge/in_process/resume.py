"""SHELL: `sim-bridge sil --from RUN --at S`: a numeric flight that continues from a moment of a recorded run.

Each agent replays the log up to the moment, so estimates, horizons and trajectories continue without a jump, also with
other settings. The robots are put where they were. The plant knows their poses, velocities and last pulses; the rest of
the water's state (gusts, waves, noise) begins by the seed. Without the truth, as in a real pool, robots are put where
their own estimates were.
"""

import math
import re
import shlex
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from itertools import chain
from pathlib import Path
from typing import NamedTuple

import numpy as np

from groundstation.fleet_time import SIMULATED_BELOW_NS
from groundstation.formation_clock import FormationPlans
from groundstation.logs.reader import LogFile, LogMessage, open_log, read_log
from robot_agent.agent import Agent
from robot_agent.inputs import StampedPlan
from shoal.config.experiment import Experiment, load_experiment
from shoal.config.fault_injection import BY_HAND, read_what
from shoal.errors import ConfigError
from shoal.frames import Array
from shoal.messages import topics
from shoal.messages.codec import decode
from shoal.messages.messages import Event, Mode, Plan, RobotState, Truth
from sim_bridge import fault_schedule
from sim_bridge.in_process.fleet import NS, AgentFleet, DirectPlant
from sim_bridge.replay.rerun import Rerun
from sim_bridge.replay.step_replay import in_order_of_use, own_messages

THRUST_MEMORY_S = 1.0  # s of pulses that the plant is given, ten times a thruster's lag
AROUND_NS = 300_000_000  # of the truth: enough to have one before and one after
SAME_CLOCK_NS = 1_000_000_000  # ns; the truth's stamps and a robot's are of one clock if they are this near


@dataclass
class RobotHistory:
    """One robot's history up to the moment: its agent, last plan, and recorded states and truths with stamps."""

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
        """The robot's last state."""
        return self.states[-1][1]


def replay_history(experiment: Experiment, robot: int, lines: Iterable[LogMessage]) -> RobotHistory:
    """Lead an agent through a log up to a moment. Raises ConfigError if it was not under way then."""
    rerun = Rerun(experiment, robot)
    history = RobotHistory(rerun.agent)

    def noted() -> Iterator[LogMessage]:
        for line in lines:
            if line.topic is topics.STATE:
                history.states.append((line.header.stamp_ns, decode(RobotState, line.payload, "log", line.topic.name)))
            if line.topic is topics.TRUTH:
                history.truths.append((line.header.stamp_ns, decode(Truth, line.payload, "log", line.topic.name)))
            else:
                yield line

    for _, message, _ in rerun.run(noted()):
        if isinstance(message, Plan):
            history.plan = message
    history.agent = rerun.agent
    if not history.states or rerun.agent.trajectory is None or rerun.agent.mode is not Mode.TRACKING:
        held = ", and without a station nothing resumes it" if rerun.agent.mode is Mode.HOLDING else ""
        raise ConfigError(f"robot {robot}: was {rerun.agent.mode.name} then, not under way{held}; name another moment (--at)")
    return history


def resume(
    experiment: Experiment, histories: Sequence[RobotHistory], seed: int, clock_ns: Callable[[], int] = lambda: 0
) -> tuple[AgentFleet, DirectPlant]:
    """The fleet and its plant as they were at the end of the robots' histories, ready to fly on."""
    at_ns = round(max(FormationPlans().clock_s(history.state) or 0.0 for history in histories) * NS)
    eta, nu = np.array([_pose_at_moment(history, k, experiment.robot_ids) for k, history in enumerate(histories)]).transpose(
        1, 0, 2
    )
    water = DirectPlant(experiment, seed, eta)
    now_ns = histories[0].now_ns if histories[0].now_ns < SIMULATED_BELOW_NS else at_ns
    armed = [_is_armed(history.state) for history in histories]
    water.resume_at(eta, nu, _pulses(experiment, histories), armed, now_ns, now_ns - at_ns)
    trajectories = {r: h.agent.trajectory for r, h in zip(experiment.robot_ids, histories, strict=True) if h.agent.trajectory}
    fleet = AgentFleet(experiment, trajectories, water, seed, clock_ns)
    fleet.now_ns = at_ns
    for i, (robot, history) in enumerate(zip(fleet.robots, histories, strict=True)):
        robot.agent = history.agent
        robot.plan = StampedPlan(history.plan, at_ns) if history.plan is not None else None
        robot.states.append(history.state)
        fleet.ahead_ns[i] = history.now_ns - at_ns
    fleet.expose(at_ns)
    return fleet, water


def _is_armed(state: RobotState) -> bool:
    return state.board is not None and state.board.armed


def _pose_at_moment(history: RobotHistory, row: int, robots: Sequence[int]) -> tuple[Array, Array]:
    """Pose and velocity of a robot at the moment: the truth between its samples, or the robot's estimate."""
    stamps = np.array([stamp for stamp, _ in history.truths], dtype=np.float64)
    truths = [truth for _, truth in history.truths if truth.robots == tuple(robots)]
    if len(truths) != len(stamps) or len(stamps) < 2 or np.abs(stamps - history.now_ns).min() > SAME_CLOCK_NS:
        estimate = history.state.estimate
        if estimate is None:
            raise ConfigError("at that moment a robot does not know where it is, and the log has no truth of it")
        return estimate.eta, estimate.nu

    def between(rows: Array) -> Array:
        return np.array([np.interp(history.now_ns, stamps, column) for column in rows.T])

    eta = np.array([truth.eta[row] for truth in truths])
    eta[:, 3] = np.unwrap(eta[:, 3])
    return between(eta), between(np.array([truth.nu[row] for truth in truths]))


def _pulses(experiment: Experiment, histories: Sequence[RobotHistory]) -> list[Array]:
    """Pulses of all robots (n, 8) in their last control steps, the newest last; neutral for a board that was not armed."""
    count = round(THRUST_MEMORY_S / experiment.controller.period_s)
    neutral = tuple(map(float, experiment.vehicle.neutral_us))

    def of(history: RobotHistory) -> list[tuple[float, ...]]:
        pulses = [tuple(map(float, s.pulse_us)) if _is_armed(s) else neutral for _, s in history.states[-count:]]
        return [neutral] * (count - len(pulses)) + pulses

    return [np.array(step) for step in zip(*map(of, histories), strict=True)]


def load_changed(run: Path, settings: Sequence[str], more_faults: Sequence[str]) -> tuple[Experiment, list[str]]:
    """The experiment of a run with the changes, and remarks about the faults that are left out. Raises ConfigError.

    Faults that a person made during the run are made again. A fault of a camera or a board is left out: a flight that is
    resumed from a logged moment has neither. The last remark is the command that has all of them.
    """
    file, absent = run / "experiment.toml", "from a logged moment on there is none"
    faults, left_out = list[str](), list[str]()
    made_by_hand = faults_by_hand(run)
    for what, fault in made_by_hand:
        (faults if fault_schedule.is_among(read_what(what), fault_schedule.NUMERIC) else left_out).append(fault)
    experiment = load_experiment(str(file), settings, [*faults, *more_faults])
    fault_schedule.require_kinds(experiment, fault_schedule.NUMERIC, absent)
    if not left_out:
        return experiment, []
    all_faults = [*(fault for _, fault in made_by_hand), *more_faults]
    options = [*(("--set", setting) for setting in settings), *(("--fault", fault) for fault in all_faults)]
    command = shlex.join(["sim-bridge", "sil", str(file), *chain.from_iterable(options)])
    remarks = [f"left out, for {absent}: {fault}" for fault in left_out]
    return experiment, [*remarks, f"to have all that was made by hand, fly {command}"]


class _FaultByHand(NamedTuple):
    """A fault that a person made."""

    what: str
    at_s: float
    for_s: float

    def mended(self, now_s: float) -> "_FaultByHand":
        """The same, over at an instant if not before."""
        return self._replace(for_s=min(self.for_s, max(now_s - self.at_s, 0.001)))

    def __str__(self) -> str:
        """The fault as --fault takes it."""
        during = f" for={self.for_s:.10g}" if math.isfinite(self.for_s) else ""
        return f"t={self.at_s:.3f}{during} {self.what}"


def faults_by_hand(run: Path) -> list[tuple[str, str]]:
    """Faults that a person made in a recorded run: what broke, and the whole as --fault takes it."""
    faults: list[_FaultByHand] = []
    for entry in read_log(run / "run.mcap", (topics.EVENT,)).of(topics.EVENT, Event):
        line = entry.message.message
        for part in line.removeprefix(BY_HAND).split("; ") if line.startswith(BY_HAND) else ():
            if (made := re.fullmatch(r"t=(\S+)(?: for=(\S+))? (.+)", part)) is not None:
                faults.append(_FaultByHand(made[3], float(made[1]), float(made[2] or math.inf)))
            elif (mended := re.fullmatch(r"mended at (\S+) s: (.+)", part)) is not None:
                faults = [fault.mended(float(mended[1])) if fault.what == mended[2] else fault for fault in faults]
    return [(fault.what, str(fault)) for fault in faults]


def prepared(experiment: Experiment, source: Path, at_s: float) -> tuple[AgentFleet, DirectPlant]:
    """Fleet and plant as they were `at_s` along the trajectories of the run in `source`. Raises ConfigError, and leaves no
    files behind, if the run does not hold that moment."""
    histories = [_read_history(experiment, source, at_s, robot) for robot in experiment.robot_ids]
    return resume(experiment, histories, experiment.seed, time.perf_counter_ns)


def _read_history(experiment: Experiment, source: Path, at_s: float, robot: int) -> RobotHistory:
    with open_log(source) as log:
        return replay_history(experiment, robot, lines_until(log, experiment.robot_ids, at_s, robot))


def lines_until(log: LogFile, robots: Sequence[int], at_s: float, robot: int) -> Iterator[LogMessage]:
    """A robot's inputs, commands and states up to a moment, and the truth around it. The moment is when the first of `robots`
    to come so far was `at_s` along its trajectory. Raises ConfigError if there is none."""
    moment_ns = _moment_ns(log, robots, at_s)
    own = own_messages(log, robot, with_states=True)
    state_lines = [k for k, line in enumerate(own) if line.topic is topics.STATE and line.arrived_ns <= moment_ns]
    if not state_lines or not any(line.topic is topics.INPUTS for line in own):
        raise ConfigError(f"{log.path}: holds no inputs of robot {robot} before {at_s:g} s")
    yield from in_order_of_use(log, robot, own[: state_lines[-1] + 1])
    begin_ns, end_ns = max(moment_ns - AROUND_NS, log.start_ns), moment_ns + AROUND_NS
    yield from log.messages(lambda topic, _: topic is topics.TRUTH, begin_ns, end_ns + 1)


def _moment_ns(log: LogFile, robots: Sequence[int], at_s: float) -> int:
    """Instant at which the recorder heard of the progress with the formation, of the first robot that was not lost before.
    Where that robot held there, or stood before it went on, the last instant before it goes on."""
    reached_s = dict.fromkeys(robots, 0.0)
    for robot in robots:
        moment: tuple[int, float] | None = None
        for line in log.messages(lambda topic, of, robot=robot: topic is topics.STATE and of == robot):  # type: ignore[misc]
            state = decode(RobotState, line.payload, "log", line.topic.name)
            clock_s = FormationPlans().clock_s(state) if state.mode is Mode.TRACKING else None
            if moment is not None and clock_s != moment[1]:
                return moment[0]
            if clock_s is not None and clock_s >= at_s:
                moment = line.arrived_ns, clock_s
            reached_s[robot] = max(reached_s[robot], clock_s or 0.0)
        if moment is not None:
            return moment[0]
    furthest = max(robots, key=lambda robot: reached_s[robot])
    raise ConfigError(f"{log.path}: at {at_s:g} s there is nothing: robot {furthest} came to {reached_s[furthest]:.2f} s")
