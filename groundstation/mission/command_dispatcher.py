"""Commands to robots: their content, sending them again until they are answered, and the robots' replies. Pure."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

from groundstation.mission.timetable import Timetable
from groundstation.telemetry import Fleet
from shoal.messages.messages import Command, CommandKind, Mode, Reply, Trajectory

BEGINS = frozenset({CommandKind.START, CommandKind.RESUME})
MOVING = frozenset({Mode.TRACKING, Mode.DRIVEN})
ON_ITS_WAY_S = 1.5  # then no robot takes a command up any more: it lives for 1 s, by what they know of our clock
RETRY_S = 0.25  # between two tries of one command to one robot; half of the station's ORDER_TIMEOUT_S


@dataclass(frozen=True)
class CommandResult:
    """A command and the robot's reply to it; a reply may be silent."""

    command: Command
    reply: Reply


class RetryTimer:
    """Instant of the last try by robot: a command is due again after RETRY_S."""

    def __init__(self) -> None:
        self._sent_ns: dict[int, int] = {}

    def reset(self) -> None:
        """Make every robot due at once."""
        self._sent_ns.clear()

    def is_begun(self, robot: int) -> bool:
        """True if a robot was sent something since the last reset."""
        return robot in self._sent_ns

    def due(self, robots: Iterable[int], now_ns: int) -> list[int]:
        """Robots that are due now; counts them as sent to."""
        due_robots = [r for r in robots if r not in self._sent_ns or now_ns - self._sent_ns[r] >= RETRY_S * 1e9]
        self._sent_ns |= dict.fromkeys(due_robots, now_ns)
        return due_robots


class Departures:
    """Robots that may set off though they say that they hold: a START or RESUME may be on its way to them. They are told to
    hold in any case, which comes behind it."""

    def __init__(self) -> None:
        self._sent_ns: dict[int, int] = {}  # of the last START or RESUME, by robot that has not been seen to move since

    def note_sent(self, robot: int, now_ns: int) -> None:
        """Take note that a robot is sent a START or RESUME."""
        self._sent_ns[robot] = now_ns

    def note_fleet(self, fleet: Fleet, now_ns: int) -> None:
        """Take in what the robots say: one that has moved since has got it."""
        for robot, sent_ns in list(self._sent_ns.items()):
            gone = fleet[robot].mode in MOVING and fleet[robot].state_age_s * 1e9 < now_ns - sent_ns
            if gone or now_ns - sent_ns > ON_ITS_WAY_S * 1e9:
                del self._sent_ns[robot]

    def may_come(self, robot: int) -> bool:
        """True if a robot that says that it holds may set off all the same."""
        return robot in self._sent_ns


class CommandDispatcher:
    """Commands of one mission state, and the replies that count in it."""

    def __init__(self, experiment_hash: str, departures: Departures) -> None:
        self.loaded: set[tuple[int, str]] = set()  # (robot, trajectory id) of accepted LOADs
        self.tested: dict[int, int] = {}  # by robot that accepted TEST: instant of the reply [ns]
        self._hash, self._timer, self._departures = experiment_hash, RetryTimer(), departures

    def reset(self) -> None:
        """Begin another mission state: every robot is due at once."""
        self._timer.reset()

    def has_sent(self, robot: int) -> bool:
        """True if a robot was sent a command since the last reset."""
        return self._timer.is_begun(robot)

    def on_results(self, results: Sequence[CommandResult], now_ns: int) -> str:
        """Take replies in. Returns the last refusal with its reason; empty if there is none."""
        refusal = ""
        for result in results:
            command, reply = result.command, result.reply
            if not reply.accepted:
                how = "has not answered" if reply.silent else "refuses"
                refusal = f"robot {command.robot} {how} {command.order.name}: {reply.reason}"
            elif command.order is CommandKind.LOAD:
                self.loaded.add((command.robot, command.trajectory_id))
            elif command.order is CommandKind.TEST:
                self.tested[command.robot] = now_ns
        return refusal

    def commands(
        self,
        order: CommandKind,
        trajectories: Mapping[int, Trajectory | None],
        now_ns: int,
        timetable: Timetable | None = None,
    ) -> tuple[Command, ...]:
        """Commands for the robots in `trajectories` that are due. Each names its trajectory; LOAD carries it; START and
        RESUME carry the timetable."""
        due = self._timer.due(trajectories, now_ns)
        for robot in due if order in BEGINS else ():
            self._departures.note_sent(robot, now_ns)
        return tuple(
            Command(
                order,
                robot,
                experiment_hash=self._hash,
                trajectory_id=trajectory.id if (trajectory := trajectories[robot]) is not None else "",
                trajectory_s=timetable.from_s if timetable is not None else 0.0,
                trajectory=trajectory if order is CommandKind.LOAD else None,
                start_ns=timetable.start_ns if timetable is not None else 0,
            )
            for robot in due
        )
