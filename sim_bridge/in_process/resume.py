"""SHELL: `sim-bridge sil --from RUN --at S`: a numeric flight that continues from a moment of a recorded flight.

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

from groundstation.analysis.alignment import chosen_flight
from groundstation.fleet_time import SIMULATED_BELOW_NS
from groundstation.formation_clock import FormationPlans
from groundstation.logs.reader import LogFile, LogMessage, RunLog, open_log, read_log
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


class Moment(NamedTuple):
    """A moment of a recorded flight. Instants are the recorder's."""

    at_s: float  # time along the trajectories, from which the resumed flight counts on
    stamp_ns: int
    arrived_ns: int  # when the recorder heard of it
    until_ns: int  # end of its flight in the log

    @property
    def zero_ns(self) -> int:
        """Instant of the log that is time 0 of the resumed flight."""
        return self.stamp_ns - round(self.at_s * NS)


def find_moment(source: Path, at_s: float, flight: int | None = None) -> Moment:
    """The moment of a run at which a flight, the one that a report is about if none is named, was `at_s` along its
    trajectories. Raises ConfigError if the run does not hold it."""
    robots = load_experiment(str(source / "experiment.toml")).robot_ids
    return moment_of(read_log(source / "run.mcap", (topics.STATE, topics.TRAJECTORY, topics.HEARTBEAT)), robots, at_s, flight)


def moment_of(log: RunLog, robots: Sequence[int], at_s: float, flight: int | None = None) -> Moment:
    """The moment of the first robot that was not lost before. Where that robot held there, or stood before it went on, the
    last instant before it goes on."""
    number, part = chosen_flight(log, robots, flight)
    if part is None:
        raise ConfigError("the log holds no flight")
    reached_s = dict.fromkeys(robots, 0.0)
    for robot in robots:
        moment: Moment | None = None
        for entry in log.of(topics.STATE, RobotState, robot):
            if not part.begin_ns <= entry.stamp_ns < part.until_ns:
                continue
            state = entry.message
            clock_s = FormationPlans().clock_s(state) if state.mode is Mode.TRACKING else None
            if moment is not None and clock_s != moment.at_s:
                return moment
            if clock_s is not None and clock_s >= at_s:
                moment = Moment(clock_s, entry.stamp_ns, entry.arrived_ns, part.until_ns)
            reached_s[robot] = max(reached_s[robot], clock_s or 0.0)
        if moment is not None:
            return moment
    furthest = max(robots, key=lambda robot: reached_s[robot])
    came_to = f"robot {furthest} came to {reached_s[furthest]:.2f} s"
    raise ConfigError(f"flight {number}: at {at_s:g} s there is nothing: {came_to}")


def load_changed(
    run: Path, moment: Moment, settings: Sequence[str], more_faults: Sequence[str]
) -> tuple[Experiment, list[str]]:
    """The experiment of a run with the changes, and remarks about the faults that are left out. Raises ConfigError.

    Faults that a person made up to the flight's end are made again. A fault of a camera or a board is left out: a flight that
    is resumed from a logged moment has neither. The last remark is the command that has all of them.
    """
    file, absent = run / "experiment.toml", "from a logged moment on there is none"
    faults, left_out = list[str](), list[str]()
    made_by_hand = faults_by_hand(run, moment)
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
    """A fault that a person made, in s of the resumed flight's time."""

    what: str
    at_s: float
    over_s: float

    def __str__(self) -> str:
        """The fault as --fault takes it; one that was made before time 0 holds from there on."""
        at_s = max(self.at_s, 0.0)
        during = f" for={round(max(self.over_s - at_s, 0.001), 3):.10g}" if math.isfinite(self.over_s) else ""
        return f"t={at_s:.3f}{during} {self.what}"


def faults_by_hand(run: Path, moment: Moment) -> list[tuple[str, str]]:
    """Faults that a person made in a recorded run before the end of the moment's flight, without those that were over before
    its time 0: what broke, and the whole as --fault takes it. Their times are their lines' stamps: what a line reads counts
    from the flight that was the newest then, and a hold lies between."""
    faults: list[_FaultByHand] = []
    for entry in read_log(run / "run.mcap", (topics.EVENT,)).of(topics.EVENT, Event):
        line, time_s = entry.message.message, (entry.stamp_ns - moment.zero_ns) / NS
        for part in (
            line.removeprefix(BY_HAND).split("; ") if line.startswith(BY_HAND) and entry.stamp_ns < moment.until_ns else ()
        ):
            if (made := re.fullmatch(r"(?:t=\S+|before the start)(?: for=(\S+))? (.+)", part)) is not None:
                faults.append(_FaultByHand(made[2], time_s, time_s + float(made[1] or math.inf)))
            elif (mended := re.fullmatch(r"mended at \S+ s: (.+)", part)) is not None:
                faults = [f._replace(over_s=min(f.over_s, time_s)) if f.what == mended[1] else f for f in faults]
    return [(fault.what, str(fault)) for fault in faults if fault.over_s > 0.0]


def prepared(experiment: Experiment, source: Path, moment: Moment) -> tuple[AgentFleet, DirectPlant]:
    """Fleet and plant as they were at a moment of the run in `source`. Raises ConfigError, and leaves no files behind, if the
    robots were not under way then, or nothing would be left to fly."""
    if moment.at_s >= experiment.duration_s:
        end_s = f"duration_s = {experiment.duration_s:g}"
        raise ConfigError(f"--at: the moment is at {moment.at_s:g} s, and the flight ends there or before ({end_s})")
    histories = [_read_history(experiment, source, moment, robot) for robot in experiment.robot_ids]
    return resume(experiment, histories, experiment.seed, time.perf_counter_ns)


def _read_history(experiment: Experiment, source: Path, moment: Moment, robot: int) -> RobotHistory:
    with open_log(source) as log:
        return replay_history(experiment, robot, lines_until(log, moment, robot))


def lines_until(log: LogFile, moment: Moment, robot: int) -> Iterator[LogMessage]:
    """A robot's inputs, commands and states up to a moment, and the truth around it. Raises ConfigError if there are none."""
    own = own_messages(log, robot, with_states=True)
    state_lines = [k for k, line in enumerate(own) if line.topic is topics.STATE and line.arrived_ns <= moment.arrived_ns]
    if not state_lines or not any(line.topic is topics.INPUTS for line in own):
        raise ConfigError(f"{log.path}: holds no inputs of robot {robot} before {moment.at_s:g} s")
    yield from in_order_of_use(log, robot, own[: state_lines[-1] + 1])
    begin_ns, end_ns = max(moment.arrived_ns - AROUND_NS, log.start_ns), moment.arrived_ns + AROUND_NS
    yield from log.messages(lambda topic, _: topic is topics.TRUTH, begin_ns, end_ns + 1)
