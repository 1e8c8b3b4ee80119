"""Orders to robots: whom to ask once more, what an order says, and what the robots answered. Pure."""

from collections.abc import Sequence
from dataclasses import dataclass

from groundstation.mission.plan_manager import Itinerary
from groundstation.mission.roster import Crew
from groundstation.mission.timetable import Timetable
from wire.messages.messages import Command, Order, Reply

RETRY_S = 0.25


@dataclass(frozen=True)
class Answer:
    """What became of an order."""

    command: Command
    reply: Reply


class Asking:
    """What robots have been asked in a phase of the mission, and their answers."""

    def __init__(self, experiment_hash: str, itinerary: Itinerary, crew: Crew) -> None:
        self.accepted: set[int] = set()  # robots that hold the next leg's trajectory
        self.tested: dict[int, int] = {}  # robots that have taken a TEST, and when we heard of it
        self.armed: dict[int, int] = {}  # robots that have taken an ARM since the arming began, and when we heard of it
        self._hash, self._itinerary, self._crew = experiment_hash, itinerary, crew
        self._asked_ns: dict[int, int] = {}

    def anew(self) -> None:
        """Another phase begins: nobody has been asked."""
        self._asked_ns.clear()

    def listen(self, answers: Sequence[Answer], now_ns: int) -> str:
        """Take answers in. Returns the last refusal with its reason, empty if there is none."""
        refusal = ""
        for answer in answers:
            command = answer.command
            if command.robot not in self._crew.everybody:
                continue
            held = self._crew.trajectory(self._itinerary.next, command.robot)
            if answer.reply.silent and command.robot in self._crew.out:
                continue  # as is to be expected
            if not answer.reply.accepted:
                how = "has not answered" if answer.reply.silent else "refuses"
                refusal = f"robot {command.robot} {how} {command.order.name}: {answer.reply.reason}"
            elif command.order is Order.LOAD and held is not None and command.trajectory_id == held.id:
                self.accepted.add(command.robot)
            elif command.order is Order.TEST:
                self.tested[command.robot] = now_ns
            elif command.order is Order.ARM:
                self.armed[command.robot] = now_ns
        return refusal

    def orders(
        self, order: Order, robots: Sequence[int], now_ns: int, timetable: Timetable | None = None
    ) -> tuple[Command, ...]:
        """For those robots that have not been asked within RETRY_S. START and RESUME say by which timetable."""
        due = [r for r in robots if now_ns - self._asked_ns.get(r, -(10**18)) >= RETRY_S * 1e9]
        self._asked_ns |= dict.fromkeys(due, now_ns)
        return tuple(self._command(order, robot, timetable) for robot in due)

    def _command(self, order: Order, robot: int, timetable: Timetable | None) -> Command:
        trajectory = self._itinerary.about(order, robot)
        return Command(
            order,
            robot,
            experiment_hash=self._hash,
            trajectory_id=trajectory.id if trajectory is not None else "",
            trajectory_s=timetable.from_s if timetable is not None else 0.0,
            trajectory=trajectory if order is Order.LOAD else None,
            start_ns=timetable.start_ns if timetable is not None else 0,
        )
