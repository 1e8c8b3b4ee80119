"""A robot's control steps repeated from its log. Pure; step_replay.py reads the log.

Input messages come in the order of use: each plan and obstacles message before the first step that names it. No robot moves:
the pulses of a step have no effect, and the next step's inputs are again those of the log. If the log's states are given, each
behind its step, the agent assumes that their pulses went out. A changed agent is then asked at each step for its own output in
that situation, and does not mistake the thrust of the logged agent for a disturbance.
"""

from collections import deque
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from typing import Any

from groundstation.logs.reader import LogMessage
from robot_agent.agent import Agent
from robot_agent.step_record import inputs_of, station_view
from shoal.config.experiment import Experiment
from shoal.config.vehicle import OUTPUTS
from shoal.messages import topics
from shoal.messages.codec import DecodeError, Header, decode
from shoal.messages.messages import CommandTaken, Event, Message, Obstacles, Plan, RobotState, StepInputs
from shoal.messages.topics import Topic

Again = tuple[Topic, Message, int]  # topic, message, stamp in ns

KEPT = 8  # messages of one sender: a step names one of the last few
WARNING = 3  # an event's level


@dataclass(frozen=True)
class _SeenMessage:
    """A message of another sender that steps may name."""

    session: int
    sequence: int
    message: Any


class Rerun:
    """One robot's agent, run through its log again."""

    def __init__(self, experiment: Experiment, robot: int) -> None:
        self._experiment, self._robot = experiment, robot
        self.agent = Agent(experiment, robot)
        self._session, self._next = 0, 0
        self._commands: deque[tuple[int, CommandTaken]] = deque()
        self._kept: dict[tuple[Topic, int], deque[_SeenMessage]] = {}
        self._is_other_vehicle = False  # and a person has been told

    def run(self, lines: Iterable[LogMessage]) -> Iterator[Again]:
        """Yield states and plans of the repeated steps, and an event for each gap in the log."""
        for line in lines:
            header = line.header
            try:
                message: Any = decode(line.topic.type, line.payload, "log", line.topic.name)
                _check_columns(message)
            except DecodeError as error:
                yield self._missing(str(error), header.stamp_ns)
                continue
            if isinstance(message, CommandTaken):
                self._commands.append((header.stamp_ns, message))
            elif isinstance(message, StepInputs):
                yield from self._begin(message, header)
                yield from self._step(message, header.stamp_ns)
            elif isinstance(message, RobotState):
                yield from self._note_sent(message, header.stamp_ns)
            else:
                kept = self._kept.setdefault((line.topic, line.robot), deque(maxlen=KEPT))
                kept.append(_SeenMessage(header.session, header.sequence, message))

    def _note_sent(self, state: RobotState, now_ns: int) -> Iterator[Again]:
        """Have the agent assume that a logged state's pulses went out, if its vehicle can have put them out."""
        vehicle, control = self._experiment.vehicle, state.control
        slowest, fastest = vehicle.thruster.curve[0][0], vehicle.thruster.curve[-1][0]
        pulses = state.pulse_us[: vehicle.thruster_count]
        shape = (len(vehicle.limits.wrench),)
        fits = len(state.pulse_us) == OUTPUTS and all(slowest <= pulse <= fastest for pulse in pulses)
        if fits and (control is None or control.wrench.shape == control.wrench_delivered.shape == shape):
            self.agent.note_sent(state, now_ns)
        elif not self._is_other_vehicle:
            self._is_other_vehicle = True
            yield self._missing(
                "the log has pulses or wrenches that this vehicle does not have: its own count instead", now_ns
            )

    def _begin(self, record: StepInputs, header: Header) -> Iterator[Again]:
        """Start a new agent where the robot's process started one."""
        if header.session != self._session or record.step < self._next:
            self.agent = Agent(self._experiment, self._robot)
            self._session, self._next = header.session, 0
            self._commands = deque(taken for taken in self._commands if taken[1].before_step <= record.step)
        if record.step != self._next:
            yield self._missing(f"steps {self._next} to {record.step - 1} are not in the log", header.stamp_ns)
        self._next = record.step + 1

    def _step(self, record: StepInputs, now_ns: int) -> Iterator[Again]:
        """Do one recorded step again, with the inputs that its record names."""
        while self._commands and self._commands[0][1].before_step <= record.step:
            self._obey(*self._commands.popleft())
        plans: dict[int, Plan] = {}
        for robot, session, sequence in zip(record.plan_robots, record.plan_sessions, record.plan_sequences, strict=True):
            plan = self._find_message(topics.PLAN, robot, session, sequence)
            if plan is None:
                yield self._missing(f"plan {sequence} of robot {robot} is not in the log", now_ns)
            else:
                plans[robot] = plan
        obstacles: Obstacles | None = None
        if record.obstacles_session:
            obstacles = self._find_message(topics.OBSTACLES, 0, record.obstacles_session, record.obstacles_sequence)
            if obstacles is None:
                yield self._missing(f"obstacles {record.obstacles_sequence} are not in the log", now_ns)
        outputs = self.agent.step(inputs_of(record, plans, obstacles, now_ns), now_ns)
        if outputs.plan is not None:
            yield topics.PLAN, outputs.plan, now_ns
        yield topics.STATE, outputs.state, now_ns

    def _obey(self, now_ns: int, record: CommandTaken) -> None:
        """Give the agent a command that it was given in the run."""
        if record.command is None:
            return
        # A rerun with other settings has another hash on purpose: only a command that was refused for its hash keeps it.
        had_our_hash = record.reply is None or "is for experiment" not in record.reply.reason
        command = replace(record.command, experiment_hash=self._experiment.hash) if had_our_hash else record.command
        header = Header(record.command_session, record.command_sequence, record.command_stamp_ns)
        self.agent.handle_command(header, command, station_view(record, now_ns), now_ns)

    def _find_message(self, topic: Topic, robot: int, session: int, sequence: int) -> Any:
        """The message that a step record names by its sender's session and sequence number; None if the log has none."""
        for kept in reversed(self._kept.get((topic, robot), ())):
            if (kept.session, kept.sequence) == (session, sequence):
                return kept.message
        return None

    def _missing(self, what: str, now_ns: int) -> Again:
        """An event that says what a step needed and the log does not hold."""
        return topics.EVENT, Event(WARNING, f"agent-{self._robot}", what), now_ns


def _check_columns(message: Any) -> None:
    """Raise DecodeError for a step record whose four columns about plans differ in length. Other messages pass."""
    if isinstance(message, StepInputs):
        columns = (message.plan_sessions, message.plan_sequences, message.plan_instants_ns)
        if any(len(column) != len(message.plan_robots) for column in columns):
            text = "not as many as plan_sessions, plan_sequences or plan_instants_ns"
            raise DecodeError("log", topics.INPUTS.name, "plan_robots", text)
