"""Observer of a lab whose parts break: robots' states, warnings of the station, reports of the witnesses at the boards; and
the time from an instant to an event."""

import threading
import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from shoal.messages import topics
from shoal.messages.codec import DecodeError, Header, decode
from shoal.messages.messages import Event, Mode, RobotState, StationHeartbeat, Truth
from shoal.messages.topics import Topic

PATIENCE_S = 60.0  # for what must come and has no limit of its own
WARNING = 3  # an event's level


class Stuck(Exception):
    """The rig did not come to where an injection can be made, or recover from one."""


@dataclass(frozen=True)
class Heard:
    """A robot's state as it came over the bus."""

    ns: int
    state: RobotState


@dataclass
class BoardView:
    """The reports of the witness at one board."""

    changes: list[tuple[int, bool, bool]] = field(default_factory=list)  # instant, neutral, armed
    taken: list[tuple[int, tuple[int, ...]]] = field(default_factory=list)
    refused: int = 0

    @property
    def thrusting(self) -> bool:
        """True while the thrusters run."""
        return bool(self.changes) and not self.changes[-1][1]

    def told_s(self, such: Callable[[tuple[int, ...]], bool], from_ns: int, to_ns: int) -> float:
        """For how much of a time the pulses that were taken last were such."""
        total_ns, taken = 0, list(self.taken)
        for (ns, pulses), (until_ns, _) in zip(taken, [*taken[1:], (to_ns, ())], strict=True):
            total_ns += max(min(until_ns, to_ns) - max(ns, from_ns), 0) if such(pulses) else 0
        return total_ns * 1e-9

    def neutral_since(self, ns: int) -> int | None:
        """Since when the board has been neutral and has stayed so, not before `ns`; None if it is not."""
        if not self.changes or not self.changes[-1][1]:
            return None
        last_thrust = max((i for i, change in enumerate(self.changes) if not change[1]), default=-1)
        return max(self.changes[last_thrust + 1][0], ns)


class Onlooker:
    """Remembers what it is given, from any thread; whoever waits for something is woken."""

    def __init__(self, robots: tuple[int, ...], folder: Path) -> None:
        """`folder` is where the lab's logs are, for whoever reads why something did not come about."""
        self.robots, self.folder = robots, folder
        self.boards = {robot: BoardView() for robot in robots}
        self.states: dict[int, deque[Heard]] = {robot: deque(maxlen=4000) for robot in robots}
        self.events: deque[tuple[int, Event]] = deque(maxlen=4000)
        self.beats: deque[int] = deque(maxlen=4000)
        self.poses_ns: deque[int] = deque(maxlen=4000)
        self.truth = Truth()
        self.not_finite = 0
        self._changed = threading.Condition()
        self._mission = ""

    # --- what is heard

    def witnessed(self, report: dict[str, Any]) -> None:
        """Take up a report of a witness (witness.py)."""
        with self._changed:
            if "taken" in report:
                view = self.boards[report["robot"]]
                if report["taken"]:
                    view.taken.append((report["ns"], tuple(report["pulses"])))
                else:
                    view.refused += 1
            elif "neutral" in report:
                self.boards[report["robot"]].changes.append((report["ns"], report["neutral"], report["armed"]))
            elif "not_finite" in report:
                self.not_finite += 1
            self._changed.notify_all()

    def heard(self, topic: Topic, key: str, header: Header, payload: bytes) -> None:
        """Take up a message of the bus."""
        ns = time.monotonic_ns()
        try:
            message: Any = decode(topic.type, payload, "bus", topic.name)
        except DecodeError:
            return
        with self._changed:
            if topic is topics.STATE:
                self.states[int(key.split("/")[-2])].append(Heard(ns, message))
            elif topic is topics.EVENT:
                self.events.append((ns, message))
            elif topic is topics.POSE:
                self.poses_ns.append(ns)
            elif topic is topics.TRUTH:
                self.truth = message
            else:
                self.beats.append(ns)
                self._mission = message.mission if isinstance(message, StationHeartbeat) else ""
            self._changed.notify_all()

    def comes(self, ready: Callable[[], bool], within_s: float) -> bool:
        """Sleep until `ready()`; whether it came in time."""
        with self._changed:
            return self._changed.wait_for(ready, within_s)

    def wait(self, ready: Callable[[], bool], what: str, timeout_s: float = PATIENCE_S) -> None:
        """Sleep until `ready()`. Raises Stuck."""
        if not self.comes(ready, timeout_s):
            modes = {r: (self.mode(r).name, self.states[r][-1].state.fault if self.states[r] else "") for r in self.robots}
            raise Stuck(f"{what}: not within {timeout_s:g} s (mission {self._mission}, robots {modes}; {self.folder})")

    def mode(self, robot: int) -> Mode:
        """As last heard."""
        return self.states[robot][-1].state.mode if self.states[robot] else Mode.DISARMED

    @property
    def mission(self) -> str:
        """The mission's state as last heard."""
        return self._mission

    def since(self, robot: int, ns: int) -> Iterator[Heard]:
        """States heard after an instant."""
        return (state for state in list(self.states[robot]) if state.ns >= ns)

    # --- measuring

    def neutral_s(self, ns: int, robots: Sequence[int] | None = None, within_s: float = 15.0) -> float:
        """Seconds from `ns` until the last of the robots' boards is neutral for good (0.6 s at least)."""
        chosen = self.robots if robots is None else robots
        self.wait(lambda: all(not self.boards[r].thrusting for r in chosen), f"boards {tuple(chosen)} neutral", within_s)
        time.sleep(0.6)
        self.wait(lambda: all(not self.boards[r].thrusting for r in chosen), f"boards {tuple(chosen)} neutral", within_s)
        instants_ns = [self.boards[r].neutral_since(ns) for r in chosen]
        return (max(at for at in instants_ns if at is not None) - ns) * 1e-9

    def mode_s(self, robot: int, modes: set[Mode], ns: int, within_s: float = 15.0) -> float:
        """Seconds from `ns` until a robot says that it is in one of the modes."""
        self.wait(lambda: any(h.state.mode in modes for h in self.since(robot, ns)), f"robot {robot} {modes}", within_s)
        return (next(h.ns for h in self.since(robot, ns) if h.state.mode in modes) - ns) * 1e-9

    def alert_s(self, ns: int, text: str = "", within_s: float = 15.0) -> float:
        """Seconds from `ns` until a warning (with `text` in it) reaches whoever watches."""

        def first() -> int | None:
            return next((at for at, e in list(self.events) if at >= ns and e.level >= WARNING and text in e.message), None)

        self.wait(lambda: first() is not None, f"warning {text!r}", within_s)
        return ((first() or 0) - ns) * 1e-9
