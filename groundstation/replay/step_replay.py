"""SHELL: replay of control steps: the log's inputs through `robot-agent rerun`, compared with the recorded outputs.

The robot's own program does the steps, in a process of its own, so what runs here is what ran on the robot. It is handed what
each step names just before the step (robot_agent/rerun.py).
"""

import subprocess
import threading
from collections import OrderedDict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from itertools import zip_longest
from pathlib import Path
from typing import IO

from groundstation.logs.reader import LogFile, LogMessage, metadata_of, open_log
from groundstation.replay.step_diff import StepComparison, StepOutputs, compare
from shoal.config.experiment import load_experiment
from shoal.errors import ConfigError
from shoal.messages import topics
from shoal.messages.codec import DecodeError, decode
from shoal.messages.messages import StepInputs
from shoal.messages.pipe import read_pipe, write_raw
from shoal.messages.topics import Topic
from shoal.runtime import runtime
from shoal.runtime.version import UNKNOWN, Code, code
from shoal.system import programs

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
        found = [_rerun_one(log, file, robot, settings, same) for robot in chosen]
        differ = same and any(again.differing for again in found)
        if differ and (recorded := recorded_by_other_code(metadata_of(log.path))):
            runtime.log.warning("%s", recorded)
        return found


def recorded_by_other_code(metadata: Mapping[str, str]) -> str:
    """Text about a log that other code than this has recorded, by its metadata; empty if this has."""
    own, recorded = code(), Code(metadata.get("version", UNKNOWN), metadata.get("commit", UNKNOWN))
    return f"the run was recorded by {recorded.short}, this is {own.short}: steps may differ" if recorded != own else ""


def _rerun_one(log: LogFile, experiment: Path, robot: int, settings: Sequence[str], same: bool) -> StepComparison:
    """Run one robot's program through the log, and compare its steps with the recorded ones."""
    own = own_messages(log, robot, with_states=not same)
    if not any(line.topic is topics.INPUTS for line in own):
        raise ConfigError(
            f"{log.path}: holds no inputs of robot {robot}: it is of an older version, or of a numeric flight, which has none"
        )
    changes = [part for setting in settings for part in ("--set", setting)]
    words = ["rerun", str(experiment), "--robot", str(robot), *changes]
    with programs.start("robot_agent", words, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as program:
        assert program.stdin is not None and program.stdout is not None
        feeder = threading.Thread(target=_feed, args=(program.stdin, in_order_of_use(log, robot, own)), daemon=True)
        feeder.start()
        again = StepOutputs()
        try:
            for topic, _, header, payload in read_pipe(program.stdout):
                again.add(topic, header.stamp_ns, payload)
        except DecodeError as error:
            raise ConfigError(f"robot {robot}: its program broke off: {error}") from None
        feeder.join()
    if program.returncode != 0:
        raise ConfigError(f"robot {robot}: its program ended with exit code {program.returncode}")
    before = StepOutputs()
    for line in log.messages(lambda topic, of: topic in (topics.STATE, topics.PLAN) and of == robot):
        before.add(line.topic, line.header.stamp_ns, line.payload)
    return compare(robot, before, again, same)


def _feed(stream: IO[bytes], lines: Iterable[LogMessage]) -> None:
    """Write messages to a program's input until they, or the program, end."""
    try:
        with stream:
            for line in lines:
                write_raw(stream, line.topic, line.robot, line.header, line.payload)
    except BrokenPipeError:  # its own words are on stderr
        return


_ORDER = (topics.ORDERS, topics.INPUTS, topics.STATE)  # of one instant: an order, then the step, then what came of it


def own_messages(log: LogFile, robot: int, with_states: bool) -> list[LogMessage]:
    """A robot's inputs and orders in the order in which they came to it; perhaps its states."""
    wanted = _ORDER if with_states else _ORDER[:2]
    lines = log.messages(lambda topic, of: topic in wanted and of == robot)
    lives, found = dict[int, int](), list(lines)  # sessions in order: one that was started again may have another clock
    for line in found:
        lives.setdefault(line.header.session, len(lives))
    return sorted(
        found,
        key=lambda line: (lives[line.header.session], line.header.stamp_ns, _ORDER.index(line.topic), line.header.sequence),
    )


def in_order_of_use(log: LogFile, robot: int, own: Sequence[LogMessage]) -> Iterator[LogMessage]:
    """A robot's inputs and orders, and before each step what it names and what was not named before."""
    others = log.messages(lambda topic, of: topic is topics.OBSTACLES or (topic is topics.PLAN and of != robot))
    known: dict[tuple[Topic, int], OrderedDict[Name, LogMessage]] = {}
    given: dict[tuple[Topic, int], Name] = {}
    ahead_ns = 0
    for line in own:
        for name in _names(line):
            sender = name[:2]
            while name not in known.setdefault(sender, OrderedDict()) and ahead_ns <= line.arrived_ns + PATIENCE_NS:
                other = next(others, None)
                if other is None:
                    break
                ahead_ns = other.arrived_ns
                heard = known.setdefault((other.topic, other.robot), OrderedDict())
                heard[other.topic, other.robot, other.header.session, other.header.sequence] = other
                if len(heard) > KEPT:
                    heard.popitem(last=False)
            if name in known[sender] and given.get(sender) != name:
                given[sender] = name
                yield known[sender][name]
        yield line


def _names(line: LogMessage) -> Iterator[Name]:
    if line.topic is not topics.INPUTS:
        return
    try:
        record = decode(StepInputs, line.payload, "log", line.topic.name)
    except DecodeError:  # the robot's program says so
        return
    for robot, session, sequence in zip_longest(record.plan_robots, record.plan_sessions, record.plan_sequences, fillvalue=0):
        yield topics.PLAN, robot, session, sequence
    if record.obstacles_session:
        yield topics.OBSTACLES, 0, record.obstacles_session, record.obstacles_sequence
