"""SHELL: two people at pages, one in a terminal, and a script, who make requests of one running station at random, while its
robots are killed, started anew, stopped, or out of radio.

`plan(seed, robots)` draws a whole script before anything runs. Every person waits for their own answer, and for nobody else.
"""

import json
import struct
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass, field
from typing import Any, Protocol

import msgspec
import numpy as np
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import ClientConnection
from websockets.sync.client import connect as connect_page
from websockets.typing import Origin

import shoal
from groundstation import client
from groundstation.mission.state_machine import (
    FLEET_REQUESTS,
    MissionState,
    in_words,
    order_name,
    order_named,
    rejection_reason,
)
from shoal.bus.bus import Bus
from shoal.messages.messages import Command, CommandKind, Outcome, Progress
from tests.faults.onlooker import Stuck

ANSWER_WITHIN_S = 30.0  # a busy machine's station answers late; no answer at all is a defect
HEAD = struct.Struct("<If")
PEOPLE = ("page A", "page B", "terminal", "script")
FLEET_ORDERS = (
    CommandKind.START,
    CommandKind.START,
    CommandKind.HOLD,
    CommandKind.RESUME,
    CommandKind.RETURN,
    CommandKind.REJOIN,
    CommandKind.STOP,
    CommandKind.CLEAR_STOP,
    CommandKind.DISARM,
    CommandKind.LOAD,
    CommandKind.ARM,
    CommandKind.TEST,
)
ONE_ROBOT = (CommandKind.ARM, CommandKind.HOLD, CommandKind.DISARM, CommandKind.GO, CommandKind.GO)
MISHAPS = ("killed", "stopped", "cut", "deaf", "mute")
LASTS_S = 28.0  # of the requests, after the start of the first flight
AS_SHOWN = 0.5  # share of the requests that are possible when they are made
ENDS = frozenset({CommandKind.STOP, CommandKind.DISARM, CommandKind.END})  # always possible, and soon all that ever happened
GAIN = "controller.nmpc.turning_m"


@dataclass(frozen=True)
class ScriptLine:
    """A line of a script: who does what, and when."""

    at_s: float
    who: str  # one of PEOPLE, or a robot
    what: str
    command: Command | None = None
    shown: int = 0  # without a command: which of the requests that the page shows as possible then
    robot: int = 0
    lasts_s: float = 0.0  # of a mishap

    def __str__(self) -> str:
        lasts = f" for {self.lasts_s:.1f} s" if self.lasts_s else ""
        return f"{self.at_s:5.1f} s  {self.who}: {self.what}{lasts}"


def plan(seed: int, robots: tuple[int, ...]) -> list[ScriptLine]:
    """A random script, in the order of time; the script's START is its first line."""
    random = np.random.default_rng(seed)
    steps = [ScriptLine(0.0, "script", "start", Command(CommandKind.START, 0))]
    for who in PEOPLE:
        for at_s in random.uniform(3.0, LASTS_S, 6):
            if random.random() < AS_SHOWN:
                steps.append(ScriptLine(float(at_s), who, "what is possible", shown=int(random.integers(1000))))
                continue
            command = _command(random, robots)
            whom = f" robot {command.robot}" if command.robot else ""
            steps.append(ScriptLine(float(at_s), who, f"{order_name(command.order)}{whom}", command))
    for at_s in random.uniform(4.0, LASTS_S, 3):
        robot, what = int(random.choice(robots)), str(random.choice(MISHAPS))
        longest_s = 20.0 if what in ("cut", "deaf", "mute") else 8.0
        lasts_s = float(np.exp(random.uniform(np.log(0.1), np.log(longest_s))))
        steps.append(ScriptLine(float(at_s), f"robot {robot}", what, robot=robot, lasts_s=lasts_s))
    return sorted(steps, key=lambda step: step.at_s)


def _command(random: np.random.Generator, robots: tuple[int, ...]) -> Command:
    kind, robot = random.random(), int(random.choice(robots))
    if kind < 0.15:
        return client.gains_command([f"{GAIN}={random.choice([0.02, 0.04]):g}"])
    if kind < 0.5:
        order = ONE_ROBOT[int(random.integers(len(ONE_ROBOT)))]
        place = (round(float(random.uniform(-2.5, 2.5)), 2), round(float(random.uniform(-1.6, 1.6)), 2))
        return client.go_command([place], robot) if order is CommandKind.GO else Command(order, robot)
    return Command(FLEET_ORDERS[int(random.integers(len(FLEET_ORDERS)))], 0)


@dataclass(frozen=True)
class Answer:
    """The station's first answer to a request."""

    accepted: bool
    reason: str
    number: int = 0  # of a request that was taken


@dataclass
class PersonsRequest:
    """A request that was made, its answer, and what became of it."""

    step: ScriptLine
    command: Command
    asked_ns: int
    answer: Answer | None = None
    outcome: Outcome | None = None
    over_ns: int = 0  # when its end was seen

    def __str__(self) -> str:
        robot = f" for robot {self.command.robot}" if self.command.robot else ""
        text = f"{self.step.at_s:5.1f} s  {self.step.who}: {self.command.order.name}{robot}"
        if self.answer is None:
            return f"{text}: no answer"
        if self.outcome is None:
            return f"{text}: {'taken' if self.answer.accepted else f'refused: {self.answer.reason}'}"
        return f"{text}: {self.outcome.progress.name} {in_words(self.outcome)}"

    @property
    def over(self) -> bool:
        """True if it was refused, is done or has failed."""
        if self.answer is None:
            return False
        return not self.answer.accepted or (self.outcome is not None and self.outcome.progress is not Progress.UNDER_WAY)


class Person(Protocol):
    """Somebody who makes requests."""

    def ask(self, command: Command) -> Answer:
        """Make a request and wait for its answer."""


class Terminal:
    """Requests as `groundstation mission ...` makes them."""

    def __init__(self, bus: Bus) -> None:
        self._bus = bus

    def ask(self, command: Command) -> Answer:
        """See Person."""
        reply = self._bus.command(command, time.time_ns(), ANSWER_WITHIN_S, to=0)
        if reply.silent:
            raise Stuck(f"no answer to {command.order.name}: {reply.reason}")
        return Answer(reply.accepted, reply.reason, reply.outcome.request if reply.outcome is not None else 0)


class ShoalScript:
    """Requests of a program that does `import shoal`."""

    def __init__(self, fleet: shoal.ConnectedFleet) -> None:
        self._fleet = fleet

    def ask(self, command: Command) -> Answer:
        """See Person."""
        try:
            outcome = self._ask(command)
        except shoal.RequestFailed as error:
            return Answer(False, str(error)) if error.outcome is None else Answer(True, "", error.outcome.request)
        return Answer(True, "", outcome.request)

    def _ask(self, command: Command) -> Outcome:
        name, fleet = order_name(command.order), self._fleet
        if command.order is CommandKind.TUNE and command.tuning is not None:
            return fleet.set_gains({GAIN: float(command.tuning.values[0])}, wait_s=0.0)
        if command.order is CommandKind.GO:
            x_m, y_m = command.via[0].tolist()
            return fleet.go((x_m, y_m), wait_s=0.0, robot=command.robot)
        if command.robot:
            method: Callable[..., Outcome] = getattr(fleet, name)
            return method(wait_s=0.0, robot=command.robot)
        method = getattr(fleet, {"return": "return_to_start", "test": "test_thrusters"}.get(name, name.replace("-", "_")))
        return method(wait_s=None if command.order is CommandKind.STOP else 0.0)  # a STOP is asked for until it is answered


class Page:
    """A browser: it takes every frame, and takes control whenever another page has it."""

    def __init__(self, socket: ClientConnection, name: str) -> None:
        self._socket = socket
        self._clock_ms, self._count = 0, 0
        self._replies: dict[int, dict[str, Any]] = {}
        self._changed = threading.Condition()
        self._say(kind="hello", page=name)
        threading.Thread(target=self._listen, name=name, daemon=True).start()

    def _say(self, **request: Any) -> None:
        self._socket.send(json.dumps(request))

    def _listen(self) -> None:
        with suppress(ConnectionClosed):
            for data in self._socket:
                assert isinstance(data, bytes)
                frame = msgspec.msgpack.decode(data[HEAD.size :])
                with self._changed:
                    self._clock_ms = frame.get("clock_ms", self._clock_ms)
                    if frame["k"] == "reply":
                        self._replies[frame["n"]] = frame
                    self._changed.notify_all()
                self._say(kind="ack", n=HEAD.unpack(data[: HEAD.size])[0])

    def ask(self, command: Command) -> Answer:
        """See Person."""
        with self._changed:
            self._changed.wait_for(lambda: self._clock_ms > 0, ANSWER_WITHIN_S)
            self._count += 1
            n, seen_ms = self._count, self._clock_ms
        self._say(kind="take", over=True)
        if command.order is CommandKind.TUNE and command.tuning is not None:
            values = dict(zip(command.tuning.keys, command.tuning.values.tolist(), strict=True))
            self._say(kind="tune", n=n, values=values, seen_ms=seen_ms)
        else:
            robot, name = command.robot, order_name(command.order)
            self._say(kind="order", n=n, order=name, robot=robot, via_m=command.via.tolist(), seen_ms=seen_ms)
        with self._changed:
            if not self._changed.wait_for(lambda: n in self._replies, ANSWER_WITHIN_S):
                raise Stuck(f"the page got no answer to {command.order.name}")
            reply = self._replies[n]
        return Answer(reply["ok"], reply["reason"], reply["request"])


@dataclass
class Crowd:
    """All who make requests, and somebody who looks up what becomes of them."""

    people: dict[str, Person]
    bus: Bus  # of whoever looks up outcomes
    mission: Callable[[], str]  # its state, as the page shows it
    requests: list[PersonsRequest] = field(default_factory=list)
    trouble: list[str] = field(default_factory=list)
    _over: threading.Event = field(default_factory=threading.Event)
    _threads: list[threading.Thread] = field(default_factory=list)

    def act(self, steps: list[ScriptLine], begin_s: float) -> None:
        """Let everybody do their part of a script, each in a thread of their own."""
        for who, person in self.people.items():
            own = [step for step in steps if step.who == who]
            self._begin(self._work, person, own, begin_s)
        self._begin(self._look_up)

    def _begin(self, work: Callable[..., None], *arguments: Any) -> None:
        thread = threading.Thread(target=self._told, args=(work, *arguments), daemon=True)
        self._threads.append(thread)
        thread.start()

    def _told(self, work: Callable[..., None], *arguments: Any) -> None:
        try:
            work(*arguments)
        except Exception as error:
            self.trouble.append(f"{type(error).__name__}: {error}")

    def _work(self, person: Person, steps: list[ScriptLine], begin_s: float) -> None:
        for step in steps:
            time.sleep(max(begin_s + step.at_s - time.monotonic(), 0.0))
            self.ask(person, step)

    def ask(self, person: Person, step: ScriptLine) -> PersonsRequest:
        """Make one request."""
        command = step.command or self._shown(step.shown)
        request = PersonsRequest(step, command, time.monotonic_ns())
        self.requests.append(request)
        request.answer = person.ask(command)
        return request

    def _shown(self, k: int) -> Command:
        """The k-th request of the whole fleet that is possible now."""
        state = MissionState[self.mission()]
        orders = [order_named(name) for name in FLEET_REQUESTS]
        possible = [order for order in orders if order not in ENDS and not rejection_reason(order, state)] or [
            CommandKind.HOLD
        ]
        return Command(possible[k % len(possible)], 0)

    def _look_up(self) -> None:
        while not self._over.wait(0.2):
            self.look_up()

    def look_up(self) -> None:
        """Ask for the outcome of every request that is under way."""
        for request in list(self.requests):
            if request.over or request.answer is None:
                continue
            reply = self.bus.command(Command(CommandKind.NONE, 0, about=request.answer.number), time.time_ns(), 5.0, to=0)
            if reply.outcome is not None:
                request.outcome, request.over_ns = reply.outcome, time.monotonic_ns()
            elif not reply.silent:
                self.trouble.append(f"{request}: {reply.reason}")

    def finish(self) -> None:
        """Wait until all have done their part."""
        for thread in self._threads[:-1]:
            thread.join(3 * ANSWER_WITHIN_S)

    def leave(self) -> None:
        """Look up nothing any more."""
        self._over.set()
        self._threads[-1].join(3 * ANSWER_WITHIN_S)


@contextmanager
def crowd(station: str, page: str, mission: Callable[[], str]) -> Iterator[Crowd]:
    """People of a station, at its page and on its network."""
    with ExitStack() as opened:
        live, origin = f"ws://{page}/live", Origin(f"http://{page}")
        pages = [Page(opened.enter_context(connect_page(live, origin=origin, max_size=None)), name) for name in ("A", "B")]
        terminal = opened.enter_context(client.connect(station))
        fleet = opened.enter_context(shoal.connect(station))
        who: tuple[Person, ...] = (*pages, Terminal(terminal), ShoalScript(fleet))
        yield Crowd(dict(zip(PEOPLE, who, strict=True)), opened.enter_context(client.connect(station)), mission)
