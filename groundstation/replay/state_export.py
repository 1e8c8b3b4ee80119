"""SHELL: export of a robot's inputs up to an instant of a run, for `sim-bridge sil --from`, which goes on from there."""

from pathlib import Path
from typing import IO

from groundstation.formation_clock import FormationPlans
from groundstation.logs.reader import LogFile, LogMessage, open_log
from groundstation.replay.step_replay import in_order_of_use, own_messages
from shoal.config.experiment import load_experiment
from shoal.errors import ConfigError
from shoal.messages import topics
from shoal.messages.codec import decode
from shoal.messages.messages import RobotState
from shoal.messages.pipe import write_raw

AROUND_NS = 300_000_000  # of the truth: enough to have one before and one after


def hand_over(run: Path, at_s: float, robot: int, stream: IO[bytes]) -> None:
    """Write a robot's inputs, orders and states up to the moment at which the first robot was `at_s` along its trajectory,
    and the truth around it. Raises ConfigError if there is no such moment."""
    experiment = load_experiment(str(run / "experiment.toml"))
    with open_log(run) as log:
        moment_ns = _moment(log, experiment.robot_ids[0], at_s)
        own = own_messages(log, experiment.robot(robot).id, with_states=True)
        known = [k for k, line in enumerate(own) if line.topic is topics.STATE and line.arrived_ns <= moment_ns]
        if not known or not any(line.topic is topics.INPUTS for line in own):
            raise ConfigError(f"{log.path}: holds no inputs of robot {robot} before {at_s:g} s")
        for line in in_order_of_use(log, robot, own[: known[-1] + 1]):
            _write(stream, line)
        for line in log.messages(lambda topic, _: topic is topics.TRUTH, max(moment_ns - AROUND_NS, log.start_ns)):
            if line.arrived_ns > moment_ns + AROUND_NS:
                break
            _write(stream, line)


def _write(stream: IO[bytes], line: LogMessage) -> None:
    write_raw(stream, line.topic, line.robot, line.header, line.payload)


def _moment(log: LogFile, robot: int, at_s: float) -> int:
    """Instant at which the recorder heard of the robot's progress with the formation."""
    reached_s = 0.0
    for line in log.messages(lambda topic, of: topic is topics.STATE and of == robot):
        clock_s = FormationPlans().clock_s(decode(RobotState, line.payload, "log", line.topic.name))
        if clock_s is not None and clock_s >= at_s:
            return line.arrived_ns
        reached_s = max(reached_s, clock_s or 0.0)
    raise ConfigError(f"{log.path}: at {at_s:g} s there is nothing: robot {robot} came to {reached_s:.2f} s")
