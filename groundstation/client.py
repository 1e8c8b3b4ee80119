"""SHELL: requests of an operator to a running station, and their outcomes, for terminals and scripts (`import shoal`).

with connect() as bus:
    command = request_named("start")
    reply = follow(sender(bus), command, limit(bus, patience_s(command)), print)
    done, text = verdict(reply, 60.0)
"""

import threading
import time
from collections.abc import Callable, Sequence
from concurrent.futures import Future
from dataclasses import replace
from pathlib import Path
from typing import TypeVar

import numpy as np
from numpy.typing import ArrayLike

from groundstation.fleet_time import FleetTime
from groundstation.gate.gate import through_door
from groundstation.gate.own_door import DoorTransport, opens
from groundstation.mission.state_machine import in_words
from groundstation.station import discovery
from groundstation.station.discovery import RunningStation
from shoal.bus.bus import Bus, request_clock_ns
from shoal.bus.network import endpoint
from shoal.bus.zenoh_transport import ZenohTransport
from shoal.config.experiment import NO_CAMERA, Experiment, dump_flight, load_experiment
from shoal.errors import ConfigError
from shoal.messages.codec import LONGEST_TEXT
from shoal.messages.live_gains import values_of
from shoal.messages.messages import WHOLE_FLEET, Command, CommandKind, Outcome, Progress, Reply, StationHeartbeat, Tuning
from shoal.messages.topics import HEARTBEAT, Role, process_name
from shoal.runtime.cli_options import DEFAULT_FLEET

T = TypeVar("T")

READ_WITHIN_S = 10.0  # for a person's files; a disk that hangs lets nobody know
ORDER_TIMEOUT_S = 2.0
ASK_EVERY_S = 0.2
PATIENCE_S = {
    CommandKind.STOP: 5.0,
    CommandKind.RETURN: 600.0,
    CommandKind.TUNE: 120.0,
}  # a lap, for gains that change with the next one
TRANSFER_S = 600.0  # GO for one robot, which is done when it is there
OTHERWISE_S = 60.0  # the station itself gives a robot up after 10 s in each of a request's stages


def connect(
    station: str | None = None,
    fleet: str = DEFAULT_FLEET,
    keys: Path | None = None,
    insecure: bool = False,
    patience_s: float = ORDER_TIMEOUT_S,
    stopped: Callable[[], bool] = lambda: False,
) -> Bus:
    """The bus of a running station's fleet, as its operator. Without an endpoint it is the station that runs on this machine.
    Raises ConfigError where there are several, and Unreached if none answers within `patience_s` or until `stopped()`."""
    return _connected(discovery.station(station, fleet), fleet, keys, insecure, patience_s, stopped)


def connect_for_requests(station: RunningStation, fleet: str, keys: Path | None, insecure: bool, patience_s: float) -> Bus:
    """A bus that takes requests to a station, and nothing else: through the station's own door and without keys where it has
    one, else as `connect` does."""
    if any(opens(door) for door in station.doors):
        return Bus(DoorTransport(station.doors), fleet)
    return _connected(station, fleet, keys, insecure, patience_s, lambda: False)


def _connected(
    station: RunningStation, fleet: str, keys: Path | None, insecure: bool, patience_s: float, stopped: Callable[[], bool]
) -> Bus:
    """Connect to a station: by this machine's own door if there is one, else at its endpoint with keys."""
    where = through_door(station.endpoint)  # before the keys: whoever may use the door needs none
    if where is None:
        me = process_name(Role.OPERATOR)
        where = read_in_time(keys, lambda: endpoint(station.endpoint, me, keys, insecure=insecure))
    return Bus(ZenohTransport(where, stopped, patience_s), fleet)


def sender(bus: Bus) -> Callable[[Command], Reply]:
    """Function that sends a request, also one for a single robot, to the station and waits for the reply. A station that is
    held up for longer does not carry it out any more."""
    return lambda command: bus.command(command, request_clock_ns(), ORDER_TIMEOUT_S, to=WHOLE_FLEET)


def go_command(places_m: ArrayLike, robot: int = WHOLE_FLEET) -> Command:
    """Request to lead the formation through places (n, 2) x, y in m, or to send one robot to one place. Raises ValueError for
    what are none."""
    via = np.array(places_m, dtype=np.float64)
    if via.ndim != 2 or via.shape[1] != 2 or not len(via):
        raise ValueError(f"{via.tolist()}: no places (allowed: one or more, x and y each)")
    if not np.all(np.isfinite(via)):
        raise ValueError(f"{via.tolist()}: no places (allowed: finite numbers, in m)")
    return Command(CommandKind.GO, robot, via=via)


def read_in_time(name: object, read: Callable[[], T]) -> T:
    """The result of `read`, which reads the files of this name. Raises what it raises, and ConfigError where a disk hangs: a
    program that waits for one hears no Ctrl-C."""
    outcome = Future[T]()

    def work() -> None:
        try:
            outcome.set_result(read())
        except BaseException as error:
            outcome.set_exception(error)

    threading.Thread(target=work, name="reading", daemon=True).start()
    try:
        return outcome.result(READ_WITHIN_S)
    except TimeoutError:
        raise ConfigError(f"{name}: cannot be read within {READ_WITHIN_S:g} s: does its disk answer?") from None


def flight_of(name_or_path: str, settings: Sequence[str]) -> Experiment:
    """Another experiment whose path is to be flown: it needs no camera, which is the session's. Raises ConfigError."""
    return read_in_time(name_or_path, lambda: load_experiment(name_or_path, [*settings, NO_CAMERA]))


def path_command(experiment: Experiment) -> Command:
    """Request to fly the path, and the formation on it, of another experiment for the same robots. Raises ConfigError for one
    that no message holds."""
    text = dump_flight(experiment)
    if len(text) > LONGEST_TEXT:
        raise ConfigError(
            f"{experiment.name}: its path has {len(text)} characters (allowed: {LONGEST_TEXT}, about 300 points; a session "
            "can begin with more)"
        )
    return Command(CommandKind.PATH, WHOLE_FLEET, text=text)


def gains_command(changes: Sequence[str]) -> Command:
    """Request of these gains, each `key=value`; of those before if there are none. Raises ConfigError."""
    values = values_of(changes)
    return Command(CommandKind.TUNE, WHOLE_FLEET, tuning=Tuning("", tuple(values), np.array(list(values.values()))))


def patience_s(command: Command) -> float:
    """Time to wait for the outcome of a request where no time is given."""
    transfer = command.order is CommandKind.GO and command.robot != WHOLE_FLEET
    return TRANSFER_S if transfer else PATIENCE_S.get(command.order, OTHERWISE_S)


def limit(bus: Bus, patience_s: float) -> Callable[[], bool]:
    """A function that is true once so many seconds of the fleet's time have gone by."""
    return FleetTime(bus.inbox(HEARTBEAT, StationHeartbeat)).limit(patience_s)


def follow(
    ask: Callable[[Command], Reply], command: Command, over: Callable[[], bool], report: Callable[[Outcome], None]
) -> Reply:
    """Make a request, and query its outcome until it is known or the wait is `over`. Returns the last reply about the outcome;
    where the station does not answer, or has forgotten the request, with that as the reason.

    An emergency stop without a reply is repeated.
    """
    reply = ask(command)
    while command.order is CommandKind.STOP and reply.silent and not over():
        reply = ask(command)
    while reply.accepted and reply.outcome is not None and reply.outcome.progress is Progress.UNDER_WAY:
        report(reply.outcome)
        if over():
            return reply
        time.sleep(ASK_EVERY_S)
        answer = ask(Command(CommandKind.NONE, robot=WHOLE_FLEET, about=reply.outcome.request))
        if answer.outcome is not None:
            reply = answer
        elif answer.silent:
            reply = replace(reply, reason=answer.reason)
        else:  # it was started again: a request of that number would be another one
            return replace(reply, reason=f"the station knows nothing of it any more ({answer.reason})")
    return reply


def verdict(reply: Reply, patience_s: float) -> tuple[bool, str]:
    """True if the request is done, and its outcome in words. A request without a wait is done when it is taken."""
    outcome = reply.outcome
    if outcome is None and not reply.accepted:
        return False, f"not heard: {reply.reason}" if reply.silent else f"refused: {reply.reason}"
    if outcome is None:
        return False, "under way, and this station does not tell what becomes of it"
    if outcome.progress is Progress.UNDER_WAY:
        if reply.reason and patience_s > 0.0:
            return False, f"not known whether it is done: {reply.reason}"
        return (True, "taken by the station") if patience_s == 0.0 else (False, f"not done within {patience_s:g} s")
    return outcome.progress is Progress.DONE, in_words(outcome)
