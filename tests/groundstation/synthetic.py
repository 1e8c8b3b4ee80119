"""A run that never happened, written through the real recorder, with errors known in closed form."""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from groundstation.logs.recorder import Recorder
from groundstation.planning.planner import plan
from shoal.config.experiment import Experiment, dump_experiment, load_experiment
from shoal.frames import Array, wrap
from shoal.messages import topics
from shoal.messages.codec import Header, encode
from shoal.messages.messages import (
    BoardReading,
    Control,
    Estimate,
    Event,
    LocalizerStatus,
    Message,
    Mode,
    Pose,
    RobotState,
    Solve,
    StationHeartbeat,
    StepTiming,
    Track,
    Truth,
    required,
)
from shoal.messages.topics import Topic

PERIOD_S = 0.05
START_S = 7.0  # of the trajectories, on the log's clock
TRUTH_OFFSET_S = 0.013  # truth is not sampled at the control steps
SECOND = 1_000_000_000

# x: sine of 10 s that shrinks at 20 s, where it crosses zero; y: constant; yaw: sine of 20 s
AMPLITUDE_M = {1: (0.05, 0.03), 2: (0.06, 0.01)}
OFFSET_Y_M = {1: 0.02, 2: -0.01}
AMPLITUDE_RAD = {1: 0.1, 2: 0.2}
COMMAND_OFFSET_RAD = 0.07
POSE_OFFSET_M = (0.003, 0.004)


def tracking_error(robot: int, time_s: float) -> Array:
    """True pose minus reference at a time along the trajectory, (4,)."""
    early, late = AMPLITUDE_M[robot]
    x = (early if time_s < 20.0 else late) * np.sin(2.0 * np.pi * time_s / 10.0)
    return np.array([x, OFFSET_Y_M[robot], 0.0, AMPLITUDE_RAD[robot] * np.sin(2.0 * np.pi * time_s / 20.0)])


@dataclass
class Script:
    """Properties of a synthetic run."""

    duration_s: float = 40.0
    loaded_s: float = 0.0  # planned end of a path that was loaded instead of the experiment's; 0: none was
    loaded_at_s: float = -1e9  # when it was loaded; before, the station tells the experiment's own
    settings: tuple[str, ...] = ()
    prefix: str = "shoal/"
    truth: bool = True
    trajectories: bool = True
    until_s: float = 1e9  # of the trajectory's time; then the log ends
    started: bool = True
    clock: Callable[[float], float] = lambda since_s: since_s  # where the robots are on their trajectories
    mode: Callable[[int, float], tuple[Mode, str]] = lambda robot, time_s: (Mode.TRACKING, "")
    missed: Callable[[int, float], int] = lambda robot, time_s: 0
    still: tuple[tuple[int, float, float], ...] = ()  # processes that did nothing for a while: robot (0: the station), times
    lost: tuple[tuple[int, float, float], ...] = ()  # messages that never came, likewise
    lines: tuple[tuple[float, str], ...] = ()  # the station's, with their times
    metadata: dict[str, str] = field(default_factory=lambda: {"mode": "lockstep", "version": "0.1.0", "zenoh": "1.10.0"})

    def experiment(self) -> Experiment:
        return load_experiment("pool", [f"duration_s={self.duration_s}", "limits={}", *self.settings])


class _Log:
    def __init__(self, recorder: Recorder, prefix: str) -> None:
        self._recorder, self._prefix = recorder, prefix
        self._sequences: dict[str, int] = {}

    def put(self, topic: Topic, message: Message, time_s: float, robot: int | None = None, lost: bool = False) -> None:
        key = self._prefix + topic.key(robot)
        self._sequences[key] = self._sequences.get(key, 0) + 1
        stamp_ns = round(time_s * SECOND)
        if lost:
            return
        header = Header(1, self._sequences[key], stamp_ns)
        self._recorder.put(topic, key, header, encode(message, stamp_ns), stamp_ns + 2_000_000)


def write_run(folder: Path, script: Script | None = None) -> Experiment:
    """Write run.mcap and experiment.toml into a folder."""
    script = script or Script()
    experiment = script.experiment()
    text = dump_experiment(experiment)
    (folder / "experiment.toml").write_text(text)
    recorder = Recorder(folder / "run.mcap", text, script.metadata)
    log = _Log(recorder, script.prefix)
    own_s = script.duration_s if script.loaded_at_s >= 0.0 or not script.loaded_s else script.loaded_s
    trajectories = plan(experiment.model_copy(update={"duration_s": own_s}))
    if script.trajectories:
        for robot, trajectory in trajectories.items():
            log.put(topics.TRAJECTORY, trajectory, 0.0, robot)
    log.put(topics.EVENT, Event(2, "groundstation", "mission: running"), START_S)
    for at_s, text in script.lines:
        log.put(topics.EVENT, Event(2, "groundstation", text), START_S + at_s)
    # One second armed, half a second under way but waiting, the run, half a second disarmed.
    for k in range(-30, round(script.duration_s / PERIOD_S) + 11):
        since_s = k * PERIOD_S
        if since_s > script.until_s:
            break
        _step(script, log, trajectories, k, since_s)
    recorder.close()
    assert recorder.error == ""
    assert recorder.dropped == 0
    return experiment


def _step(script: Script, log: _Log, trajectories: dict[int, Any], k: int, since_s: float) -> None:
    def true_eta(robot: int, at_s: float) -> Array:
        clock_s = float(np.clip(script.clock(at_s), 0.0, script.duration_s))
        trajectory = trajectories[robot]
        grid = trajectory.period_s * np.arange(len(trajectory.eta))
        reference = np.array([np.interp(clock_s, grid, trajectory.eta[:, c]) for c in range(4)])
        eta = reference + tracking_error(robot, clock_s)
        eta[3] = wrap(float(eta[3]))
        return eta

    at_s = START_S + since_s
    robots = sorted(trajectories)
    if script.truth:
        eta = np.array([true_eta(robot, since_s + TRUTH_OFFSET_S) for robot in robots])
        true_disturbance = np.tile([0.02, 0.01, 0.0, 0.05], (len(robots), 1))
        log.put(
            topics.TRUTH,
            Truth(tuple(robots), eta, np.zeros_like(eta), np.zeros((len(robots), 3)), true_disturbance),
            at_s + TRUTH_OFFSET_S,
        )
    log.put(topics.LOCALIZER, LocalizerStatus(frames=k + 31, frame_ms=2.0 + 0.1 * (k % 7)), at_s)
    for robot in robots:
        true = true_eta(robot, since_s)
        eta = true + np.array([*POSE_OFFSET_M, 0.0, 0.002])
        log.put(topics.POSE, Pose(eta[0], eta[1], wrap(eta[3]), 1e-6 * np.eye(3), Track.MARKER, True, 0.9, 0.3), at_s, robot)
        if not _within(script.still, robot, since_s):
            state = _state(script, robot, k, since_s, true, trajectories[robot])
            log.put(topics.STATE, state, at_s, robot, lost=_within(script.lost, robot, since_s))
    if (script.still or script.lost or script.loaded_s) and not _within(script.still, 0, since_s):
        loaded = script.loaded_s > 0.0 and since_s >= script.loaded_at_s
        planned_s = script.loaded_s if loaded else 0.0 if script.loaded_at_s < 0.0 else script.duration_s
        beat = StationHeartbeat(mission="RUNNING", flight_s=planned_s, other_path=loaded)
        log.put(topics.HEARTBEAT, beat, at_s, lost=_within(script.lost, 0, since_s))


def _within(times: tuple[tuple[int, float, float], ...], process: int, at_s: float) -> bool:
    return any(which == process and begin_s < at_s < end_s for which, begin_s, end_s in times)


def _state(script: Script, robot: int, k: int, since_s: float, true: Array, trajectory: Any) -> RobotState:
    clock_s = float(np.clip(script.clock(since_s), 0.0, script.duration_s))
    mode, fault = (Mode.ARMED, "") if since_s < -0.5 else script.mode(robot, since_s)
    if since_s > script.duration_s + 0.2 and not fault:
        mode = Mode.DISARMED
    if not script.started:
        mode, clock_s = Mode.DISARMED, 0.0
    swing = 1.0 if k % 2 else -1.0
    state = RobotState(
        mode=mode,
        fault=fault,
        trajectory_s=clock_s,
        trajectory_id=trajectory.id,
        pulse_us=tuple(
            round(v) for v in (1560 + 10 * swing, 1560 + 10 * swing, 1440 - 10 * swing, 1440, 1500, 1500, 1510, 1490)
        ),
        estimate=Estimate(eta=true + np.array([*POSE_OFFSET_M, 0.0, 0.0]), disturbance=np.array([0.03, 0.01, 0.0, 0.05])),
        control=Control(
            eta_reference=trajectory.eta[min(round(clock_s / PERIOD_S), len(trajectory.eta) - 1)],
            eta_command=true - [0.0, 0.0, 0.0, COMMAND_OFFSET_RAD],
            wrench=np.array([0.3 * np.sin(since_s), 0.2, 0.05 * np.cos(since_s)]),
            wrench_step=np.array([0.03 * swing, 0.01, 0.02 * robot]),
            solve=Solve.SOLVED,
            iterations=10 + k % 5,
        ),
        board=BoardReading(
            echo_us=(1550, 1550, 1450, 1440, 1500, 1500, 1510, 1490), depth_m=0.3, battery_v=12.2, armed=mode is Mode.TRACKING
        ),
        timing=StepTiming(
            exposure_to_pwm_ms=30.0 + k % 10, step_us=200.0 + k % 100, missed_deadlines=script.missed(robot, since_s)
        ),
    )
    if mode is Mode.TRACKING:
        return state
    control = replace(required(state.control), wrench_step=np.array([9.0, 9.0, 9.0]))
    return replace(state, control=control, pulse_us=(1500,) * 8)
