"""SHELL: a connection to a running station: the operator's requests, and what robots, localizer and station say."""

from collections import deque
from collections.abc import Callable, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any, TypeVar

from groundstation import client
from groundstation.fleet_time import FleetTime
from groundstation.mission.state_machine import request_named
from shoal.bus.bus import Bus, Inbox
from shoal.config.loader import toml_value
from shoal.messages import topics
from shoal.messages.codec import DecodeError, Header, decode
from shoal.messages.messages import (
    WHOLE_FLEET,
    Command,
    CommandKind,
    Event,
    Outcome,
    Pose,
    Progress,
    RobotState,
    StationHeartbeat,
)
from shoal.messages.topics import Topic
from shoal.runtime.cli_options import DEFAULT_FLEET

M = TypeVar("M")

ROBOTS = range(1, 50)  # the ids that an experiment may give
FRESH_S = 1.0  # since a message came; one that is older is no live state
LOOK_S = 0.2  # at most between two looks at the time that a wait has left
KEPT_EVENTS = 1000  # that no call has waited for yet; the oldest are dropped


class RequestFailed(Exception):
    """A request that was refused, failed, or was not done in time. The text is the station's, `outcome` what it knows of each
    robot."""

    def __init__(self, text: str, outcome: Outcome | None) -> None:
        super().__init__(text)
        self.outcome = outcome


class NotHeard(Exception):
    """No fresh message of a robot or of the station, or an event that did not come in time."""


class ConnectedFleet:
    """A fleet, seen and led through its station. Use it with `with`. Thread-safe.

    Each request waits until it is done by every robot that it concerns, and raises RequestFailed otherwise. `wait_s` says how
    long (docs/commands.md has the defaults); 0: only until the station has taken it. What is not waited for goes on.

    Waits and ages are in the fleet's time: where a busy machine simulates slowly, a wait of 60 s lasts 60 simulated seconds.
    """

    def __init__(self, bus: Bus, gone: Callable[[], str] = lambda: "") -> None:
        """`gone` gives the reason for which the fleet will never be heard again; empty while it may."""
        self._bus, self._gone = bus, gone
        self._states = bus.inboxes(topics.STATE, RobotState, ROBOTS)
        self._poses = bus.inboxes(topics.POSE, Pose, ROBOTS)
        self._heartbeat = bus.inbox(topics.HEARTBEAT, StationHeartbeat)
        self._time = FleetTime(self._heartbeat)
        self._has_listened = self._time.limit(FRESH_S)  # every robot that is heard at all has been heard by then
        self._events: deque[Event] = deque(maxlen=KEPT_EVENTS)
        self._mission_line = 0, ""  # the station's last, with its session
        self._taken_with: Header | None = None  # of the newest heartbeat when a request was taken that then went on
        self.ended = False  # True once the run was ended from here
        bus.subscribe(topics.EVENT, None, self._event)

    def __enter__(self) -> "ConnectedFleet":
        return self

    def __exit__(self, *exception: object) -> None:
        self.close()

    def close(self) -> None:
        """Leave the fleet. The mission goes on."""
        self._bus.close()

    # --- requests

    def load(
        self, experiment: str | None = None, settings: Mapping[str, Any] | None = None, *, wait_s: float | None = None
    ) -> Outcome:
        """Fly another experiment's path: robots at rest with the next `start`, robots that hold at once. Pool, vehicle,
        control and limits stay. Without an experiment: load the trajectories into all robots. Raises ConfigError."""
        if experiment is None:
            return self._fleet("load", wait_s)
        lines = [f"{key}={toml_value(value)}" for key, value in (settings or {}).items()]
        return self._ask("load", client.path_command(client.flight_of(experiment, lines)), wait_s)

    def arm(self, wait_s: float | None = None, robot: int = WHOLE_FLEET) -> Outcome:
        """Load the trajectories and arm all robots; or arm one robot alone."""
        return self._ask("arm", request_named("arm", robot), wait_s)

    def start(self, wait_s: float | None = None) -> Outcome:
        """Load, arm and start: fly the experiment."""
        return self._fleet("start", wait_s)

    def go(self, *places_m: tuple[float, float], wait_s: float | None = None, robot: int = WHOLE_FLEET) -> Outcome:
        """Lead the running formation through places x, y; or send one robot to one place, out of the formation until
        `rejoin`. Raises ValueError for what are none."""
        return self._ask("go", client.go_command(places_m, robot), wait_s)

    def formation(self, form: str, wait_s: float | None = None) -> Outcome:
        """Let the formation take another form, in flight or from a hold: "line 0.8 turn 30 over 20"."""
        return self._ask("formation", Command(CommandKind.FORMATION, WHOLE_FLEET, text=form), wait_s)

    def fault(self, what: str, wait_s: float | None = None) -> Outcome:
        """Break something in a simulated run: "thruster 2/3 dead for 5"; "repair" mends what was broken so."""
        return self._ask("fault", Command(CommandKind.FAULT, WHOLE_FLEET, text=what), wait_s)

    def hold(self, wait_s: float | None = None, robot: int = WHOLE_FLEET) -> Outcome:
        """Make all robots, or one, hold their places under power. One alone is out of the formation until `rejoin`."""
        return self._ask("hold", request_named("hold", robot), wait_s)

    def resume(self, wait_s: float | None = None) -> Outcome:
        """Go on after a hold."""
        return self._fleet("resume", wait_s)

    def return_to_start(self, wait_s: float | None = None) -> Outcome:
        """Bring every robot back to its start, then disarm."""
        return self._fleet("return", wait_s)

    def rejoin(self, wait_s: float | None = None) -> Outcome:
        """Let lost robots that are heard and fit again take part."""
        return self._fleet("rejoin", wait_s)

    def out(self, robot: int, wait_s: float | None = None) -> Outcome:
        """Say that a person has taken a robot out of the water: nobody keeps clear of it, and no run counts on it."""
        return self._ask("out", request_named("out", robot), wait_s)

    def back_in(self, robot: int, wait_s: float | None = None) -> Outcome:
        """Say that a robot is in the water again: at rest it takes part in the next run, in flight it may `rejoin`."""
        return self._ask("back-in", request_named("back-in", robot), wait_s)

    def test_thrusters(self, wait_s: float | None = None) -> Outcome:
        """Test every thruster of every robot, briefly and with little thrust."""
        return self._fleet("test", wait_s)

    def disarm(self, wait_s: float | None = None, robot: int = WHOLE_FLEET) -> Outcome:
        """Disarm all robots, or one."""
        return self._ask("disarm", request_named("disarm", robot), wait_s)

    def stop(self, wait_s: float | None = None) -> Outcome:
        """Emergency stop: every robot to neutral, latched until `clear_stop`. Without an answer it is asked for again."""
        return self._fleet("stop", wait_s)

    def clear_stop(self, wait_s: float | None = None) -> Outcome:
        """Clear an emergency stop. Robots stay disarmed."""
        return self._fleet("clear-stop", wait_s)

    def end(self, wait_s: float | None = None) -> Outcome:
        """End the run: disarm, write what there is, stop the station."""
        outcome = self._fleet("end", wait_s)
        self.ended = True
        return outcome

    def set_gains(self, gains: dict[str, Any], wait_s: float | None = None) -> Outcome:
        """Change keys that `groundstation keys-of` marks (live), for all robots at one instant. Raises ConfigError."""
        return self._ask("gains", client.gains_command([f"{key}={toml_value(value)}" for key, value in gains.items()]), wait_s)

    def undo_gains(self, wait_s: float | None = None) -> Outcome:
        """Go back to the gains before the last change."""
        return self._ask("gains", client.gains_command(()), wait_s)

    def _fleet(self, name: str, wait_s: float | None) -> Outcome:
        return self._ask(name, request_named(name), wait_s)

    def _ask(self, name: str, command: Command, wait_s: float | None) -> Outcome:
        """Send a request and follow it until it is done. Raises RequestFailed."""
        patience_s = client.patience_s(command) if wait_s is None else wait_s
        reply = client.follow(client.sender(self._bus), command, self._time.limit(patience_s), lambda outcome: None)
        if reply.outcome is not None and reply.outcome.progress is Progress.UNDER_WAY:
            self._taken_with = self._heartbeat.newest_header()
        done, text = client.verdict(reply, patience_s)
        if not done:
            missing = zip(reply.outcome.waiting, reply.outcome.why, strict=False) if reply.outcome is not None else ()
            raise RequestFailed("; ".join([f"{name}: {text}", *(f"robot {r}: {why}" for r, why in missing)]), reply.outcome)
        assert reply.outcome is not None  # or `verdict` is no success
        return reply.outcome

    # --- live state

    @property
    def robots(self) -> tuple[int, ...]:
        """Ids of the robots that are heard now. Right after the beginning it listens for FRESH_S."""
        with suppress(NotHeard):
            self._wait(self._has_listened, FRESH_S)
        return tuple(robot for robot, inbox in self._states.items() if self._fresh(inbox, FRESH_S))

    def state(self, robot: int, max_age_s: float = FRESH_S) -> RobotState:
        """Newest state of a robot: mode, estimate, reference, inputs, battery. Waits up to `max_age_s` for one. Raises
        NotHeard for a robot whose last one is older."""
        return self._newest(self._states, robot, "state", max_age_s)

    def pose(self, robot: int, max_age_s: float = FRESH_S) -> Pose:
        """Newest pose of a robot by the localizer, as `state`."""
        return self._newest(self._poses, robot, "pose", max_age_s)

    def mission(self, max_age_s: float = FRESH_S) -> str:
        """State of the mission, as `groundstation mission states` names them. Raises NotHeard without a fresh heartbeat."""
        if not self._wait(lambda: self._tells_mission(max_age_s), max_age_s):
            raise NotHeard("the station is not heard")
        return self._last_mission()

    def wait(self, condition: Callable[[], bool], timeout_s: float) -> None:
        """Wait until a condition holds. It is looked at with every message; one that raises NotHeard does not hold. Raises
        NotHeard when the time is over."""

        def holds() -> bool:
            with suppress(NotHeard):
                return condition()
            return False

        if not self._wait(holds, timeout_s):
            raise NotHeard(f"the condition did not hold within {timeout_s:g} s")

    def wait_mission(self, *states: str, timeout_s: float = 60.0) -> str:
        """Wait until the mission is in one of these states, for example "RUNNING" or "DONE". Returns it. Raises NotHeard."""
        if not self._wait(lambda: self._tells_mission(FRESH_S) and self._last_mission() in states, timeout_s):
            is_now = self._last_mission() or "not heard"
            raise NotHeard(f"the mission was not {' or '.join(states)} within {timeout_s:g} s: it is {is_now}")
        return self._last_mission()

    def _tells_mission(self, max_age_s: float) -> bool:
        """True if the newest heartbeat is fresh, and tells of a mission that knew of all requests from here: the one that was
        under way when a request was taken may still tell the state before."""
        header, before = self._heartbeat.newest_header(), self._taken_with
        if header is not None and before is not None and header.session == before.session:
            return header.sequence > before.sequence + 1 and self._fresh(self._heartbeat, max_age_s)
        return self._fresh(self._heartbeat, max_age_s)

    def _last_mission(self) -> str:
        """State of the mission as last told, however long ago; empty if it never was."""
        received = self._heartbeat.newest()
        return "" if received is None else received.message.mission

    def wait_ready(self, timeout_s: float = 60.0) -> None:
        """Wait until no flight is under way, and the station's preflight finds nothing amiss. Raises NotHeard with what it
        finds."""
        if not self._wait(self._is_ready, timeout_s):
            raise NotHeard(f"the fleet was not ready within {timeout_s:g} s: {self._present_line() or 'nothing heard'}")

    def _is_ready(self) -> bool:
        heartbeat = self._heartbeat.newest()
        return heartbeat is not None and heartbeat.message.ready and self._tells_mission(FRESH_S)

    def _present_line(self) -> str:
        """The last line about the mission of the station that is heard now; empty if there is none, or it is an earlier
        station's."""
        heartbeat, (session, line) = self._heartbeat.newest(), self._mission_line
        is_present = heartbeat is not None and heartbeat.header.session == session and self._fresh(self._heartbeat, FRESH_S)
        return line if is_present else ""

    def wait_event(self, text: str = "", timeout_s: float = 60.0) -> Event:
        """Next event (line of a process's log) with this text in it. Events before it are dropped. Raises NotHeard."""
        matching: list[Event] = []

        def take_events() -> bool:
            """Take events up to the first that matches. True if there is one."""
            while self._events and not matching:
                event = self._events.popleft()
                if text in event.message:
                    matching.append(event)
            return bool(matching)

        if not self._wait(take_events, timeout_s):
            raise NotHeard(f"no event with {text!r} within {timeout_s:g} s")
        return matching[0]

    def _wait(self, ready: Callable[[], bool], timeout_s: float) -> bool:
        """Wait until `ready()` is True, at most `timeout_s` of the fleet's time. Returns False after that. Raises NotHeard
        when the station is gone."""
        over = self._time.limit(timeout_s)
        while not self._bus.wait(ready, min(timeout_s, LOOK_S)):
            if reason := self._gone():
                raise NotHeard(reason)
            if over():
                return False
        return True

    def _fresh(self, inbox: Inbox[Any], max_age_s: float) -> bool:
        received = inbox.newest()
        return received is not None and self._time.age_s(received) <= max_age_s

    def _newest(self, inboxes: dict[int, Inbox[M]], robot: int, what: str, max_age_s: float) -> M:
        """The newest message of a robot, for which it waits. Raises NotHeard if none is young enough."""
        inbox = inboxes.get(robot)
        if inbox is None:
            raise NotHeard(f"robot {robot}: no such robot (allowed: {ROBOTS.start} to {ROBOTS.stop - 1})")
        self._wait(lambda: self._fresh(inbox, max_age_s), max_age_s)
        received = inbox.newest()
        if received is None or not self._fresh(inbox, max_age_s):
            raise NotHeard(f"robot {robot}: no {what} of the last {max_age_s:g} s")
        return received.message

    def _event(self, topic: Topic, key: str, header: Header, payload: bytes) -> None:
        """Keep an event, and the mission's last line, for those that wait for one."""
        try:
            event: Event = decode(Event, payload, key, topic.name)
        except DecodeError:
            return
        with self._bus.arrival:
            self._events.append(event)
            if event.source == "groundstation" and event.message.startswith("mission: "):
                self._mission_line = header.session, event.message
            self._bus.arrival.notify_all()


def connect(
    station: str | None = None,
    *,
    fleet: str = DEFAULT_FLEET,
    keys: str | Path | None = None,
    insecure: bool = False,
    patience_s: float = client.ORDER_TIMEOUT_S,
) -> ConnectedFleet:
    """Connect as an operator to a running station: the one at an endpoint (`tls/192.0.2.10:7447`), or the only one that runs
    on this machine. `keys` is the fleet's key ring. Raises ConfigError, or Unreached if none answers within `patience_s`."""
    return ConnectedFleet(client.connect(station, fleet, Path(keys) if keys is not None else None, insecure, patience_s))
