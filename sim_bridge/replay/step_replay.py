"""SHELL: replay of control steps: a log's inputs through the robots' agents, compared with the recorded outputs.

An agent is handed what each step names just before the step (rerun.py).
"""

from collections import OrderedDict
from collections.abc import Iterator, Mapping, Sequence
from itertools import zip_longest
from pathlib import Path

from groundstation.logs.reader import LogFile, LogMessage, metadata_of, open_log
from shoal.config.experiment import Experiment, load_experiment
from shoal.errors import ConfigError
from shoal.messages import topics
from shoal.messages.codec import DecodeError, decode, encode
from shoal.messages.messages import StepInputs
from shoal.messages.topics import Topic
from shoal.runtime import runtime
from shoal.runtime.version import UNKNOWN, Code, are_known, code
from sim_bridge.replay.rerun import Rerun
from sim_bridge.replay.step_diff import StepComparison, StepOutputs, compare

KEPT = 400  # messages of one sender, 20 s: a step names one of the last few, or the last one there ever was
PATIENCE_NS = 5_000_000_000  # what a step names may have reached the recorder this much later than the step's own record

Name = tuple[Topic, int, int, int]  # topic, robot, session, sequence


def rerun(run: Path, robots: Sequence[int] = (), settings: Sequence[str] = ()) -> list[StepComparison]:
    """Do the steps of some robots of a run again, of all if none is named, with keys of the experiment changed. Raises
    ConfigError for a run that holds no inputs, and for settings that cannot be."""
    file = run / "experiment.toml"
    experiment = load_experiment(str(file), settings)
    chosen = [experiment.robot(robot).id for robot in robots] or list(experiment.robot_ids)
    same = experiment.hash == load_experiment(str(file)).hash
    with open_log(run) as log:
        comparisons = [_rerun_one(log, experiment, robot, same) for robot in chosen]
        differ = same and any(again.differing for again in comparisons)
        if differ and (recorded := recorded_by_other_code(metadata_of(log.path))):
            runtime.log.warning("%s", recorded)
        return comparisons


def recorded_by_other_code(metadata: Mapping[str, str]) -> str:
    """Text about a log that other code than this has recorded, or may have, by its metadata; empty if this has."""
    own, recorded = code(), Code(metadata.get("version", UNKNOWN), metadata.get("commit", UNKNOWN))
    if recorded == own and are_known(own.commit):
        return ""
    return f"the run was recorded by {recorded.short}, this is {own.short}: steps may differ"


def _rerun_one(log: LogFile, experiment: Experiment, robot: int, same: bool) -> StepComparison:
    """Lead an agent through the log, and compare its steps with the recorded ones."""
    own = own_messages(log, robot, with_states=not same)
    if not any(line.topic is topics.INPUTS for line in own):
        raise ConfigError(f"{log.path}: holds no inputs of robot {robot}: a numeric flight has none")
    before, again = StepOutputs(), StepOutputs()
    for topic, message, stamp_ns in Rerun(experiment, robot).run(in_order_of_use(log, robot, own)):
        again.add(topic, stamp_ns, encode(message, stamp_ns))
    for line in log.messages(lambda topic, of: topic in (topics.STATE, topics.PLAN) and of == robot):
        before.add(line.topic, line.header.stamp_ns, line.payload)
    return compare(robot, before, again, same)


_ORDER = (topics.COMMANDS, topics.INPUTS, topics.STATE)  # of one instant: a command, then the step, then what came of it


def own_messages(log: LogFile, robot: int, with_states: bool) -> list[LogMessage]:
    """A robot's inputs and commands in the order in which they came to it; perhaps its states."""
    kinds = _ORDER if with_states else _ORDER[:2]
    lines = log.messages(lambda topic, of: topic in kinds and of == robot)
    lives, messages = dict[int, int](), list(lines)  # sessions in order: one that was started again may have another clock
    for line in messages:
        lives.setdefault(line.header.session, len(lives))
    return sorted(
        messages,
        key=lambda line: (lives[line.header.session], line.header.stamp_ns, _ORDER.index(line.topic), line.header.sequence),
    )


def in_order_of_use(log: LogFile, robot: int, own: Sequence[LogMessage]) -> Iterator[LogMessage]:
    """A robot's inputs and commands, and before each step what it names and what was not named before."""
    others = log.messages(lambda topic, of: topic is topics.OBSTACLES or (topic is topics.PLAN and of != robot))
    by_sender: dict[tuple[Topic, int], OrderedDict[Name, LogMessage]] = {}
    last_names: dict[tuple[Topic, int], Name] = {}
    ahead_ns = 0
    for line in own:
        for name in _messages_used(line):
            sender = name[:2]
            while name not in by_sender.setdefault(sender, OrderedDict()) and ahead_ns <= line.arrived_ns + PATIENCE_NS:
                other = next(others, None)
                if other is None:
                    break
                ahead_ns = other.arrived_ns
                from_sender = by_sender.setdefault((other.topic, other.robot), OrderedDict())
                from_sender[other.topic, other.robot, other.header.session, other.header.sequence] = other
                if len(from_sender) > KEPT:
                    from_sender.popitem(last=False)
            if name in by_sender[sender] and last_names.get(sender) != name:
                last_names[sender] = name
                yield by_sender[sender][name]
        yield line


def _messages_used(line: LogMessage) -> Iterator[Name]:
    """Names of the plans and of the list of obstacles that a recorded step used; none for a command."""
    if line.topic is not topics.INPUTS:
        return
    try:
        record = decode(StepInputs, line.payload, "log", line.topic.name)
    except DecodeError:  # Rerun says so
        return
    for robot, session, sequence in zip_longest(record.plan_robots, record.plan_sessions, record.plan_sequences, fillvalue=0):
        yield topics.PLAN, robot, session, sequence
    if record.obstacles_session:
        yield topics.OBSTACLES, 0, record.obstacles_session, record.obstacles_sequence
