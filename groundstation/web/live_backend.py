"""SHELL: the live fleet as the page sees it: reads the station's inboxes, gives orders as a terminal would.

Nothing here waits for the station's cycle, and the cycle never waits for anything here.
"""

import time
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Protocol

from groundstation.inboxes import FleetInboxes
from groundstation.mission.gain_update import GainStatus
from groundstation.mission.lap_statistics import Lap
from groundstation.mission.state_machine import MissionState, order_name, states_allowing
from groundstation.telemetry import Finding, Fleet, RobotView, blocking_findings, robot_view
from groundstation.web import experiment_editor
from groundstation.web.alarms import alarms
from groundstation.web.protocol import Edit
from groundstation.web.scene import flown_paths, scene
from groundstation.web.snapshot import NEVER_MS, AgedMessage, FleetSnapshot, RobotSnapshot, snapshot
from wire.config.experiment import Experiment
from wire.messages import topics
from wire.messages.codec import DecodeError, Header, decode
from wire.messages.messages import Event, Order, Outcome, Preview, Trajectory
from wire.messages.topics import Topic
from wire.process.runtime import Clock
from wire.transport.bus import Bus, Inbox, Received

MOST_EVENTS = 256  # between two looks
STUCK_S = 1.0  # without a cycle of the station: robots hold by themselves then


class Backend(Protocol):
    """Data source of the page's server: the live fleet, or a recorded run. Used from one thread, but for `order`,
    `tune`, `attempt` and `save`, which may take their time in others."""

    def scene(self) -> dict[str, Any]: ...
    def changed(self) -> bool: ...
    def snapshot(self) -> dict[str, Any]: ...
    def picture(self) -> dict[str, Any] | None: ...
    def paths(self) -> list[dict[str, Any]] | None: ...
    def notes(self) -> list[dict[str, Any]]: ...
    def order(self, order: Order) -> tuple[str, int]: ...
    def tune(self, values: Mapping[str, float] | None, next_lap: bool) -> tuple[str, int]: ...
    def attempt(self, edit: Edit) -> dict[str, Any]: ...
    def save(self, edit: Edit, name: str) -> dict[str, Any]: ...
    def seek(self, time_s: float | None, rate: float | None) -> None: ...


@dataclass(frozen=True)
class Status:
    """Status of the station, as of its last cycle."""

    state: MissionState
    reason: str
    recorder_error: str = ""
    insecure: bool = False  # the network is open, as was asked for
    tuning: GainStatus | None = None
    laps: Sequence[Lap] = ()
    preflight: tuple[Finding, ...] | None = None  # why not to arm; None: whoever asks looks for himself
    seen: Fleet = field(default_factory=dict)  # the fleet as of the station's last cycle
    requests: Sequence[Outcome] = ()  # what became of people's requests, oldest first
    ended: bool = False  # a person has ended the run
    beat_age_s: float = 0.0  # since the station's last cycle


def _nobody_tunes(values: Mapping[str, float] | None, next_lap: bool) -> tuple[str, int]:
    return "gains cannot be changed here", 0


@dataclass(frozen=True, eq=False)
class StationApi:
    """Functions of the station that the page needs. Requests return the reason of a refusal, or nothing, and their number.
    `paths`: trajectories flown now and their end in s; None: as planned before the run."""

    status: Callable[[], Status]
    order: Callable[[Order], tuple[str, int]]
    tune: Callable[[Mapping[str, float] | None, bool], tuple[str, int]] = _nobody_tunes
    run: Path | None = None  # the run's folder
    paths: Callable[[], tuple[Mapping[int, Trajectory], float] | None] = lambda: None


class LiveBackend:
    """Backend of the live fleet."""

    def __init__(
        self,
        experiment: Experiment,
        trajectories: Mapping[int, Trajectory],
        bus: Bus,
        heard: FleetInboxes,
        clock: Clock,
        station: StationApi,
        mode: str,
    ) -> None:
        self._experiment, self._trajectories, self._bus, self._clock = experiment, trajectories, bus, clock
        self._station, self._mode = station, mode
        self._heard = heard
        self._previews = bus.inbox(topics.PREVIEW, Preview)
        self._events: deque[tuple[Header, bytes]] = deque(maxlen=MOST_EVENTS)
        self._seen: list[Header | None] = []
        self._shown: Header | None = None
        self._drawn: tuple[Mapping[int, Trajectory], float] | None = None
        bus.subscribe(topics.EVENT, None, self._event)

    def _event(self, topic: Topic, key: str, header: Header, payload: bytes) -> None:
        self._events.append((header, payload))

    def scene(self) -> dict[str, Any]:
        """Constants of the run, and the paths that are flown now."""
        run = str(self._station.run) if self._station.run is not None else ""
        found = scene(self._experiment, self._trajectories, self._mode) | {"run": run, "life": f"{self._bus.session:x}"}
        return found if self._drawn is None else found | {"paths": flown_paths(*self._drawn)}

    def paths(self) -> list[dict[str, Any]] | None:
        """Paths flown from now on; returned once after each change."""
        flown = self._station.paths()
        if flown is None or flown is self._drawn:
            return None
        self._drawn = flown
        return flown_paths(*flown)

    def changed(self) -> bool:
        """True if a robot's state has arrived since the last call."""
        seen = [inbox.newest_header() for inbox in self._heard.states.values()]
        changed, self._seen = seen != self._seen, seen
        return changed

    def snapshot(self) -> dict[str, Any]:
        """The fleet now."""
        status = self._station.status()
        states = {r: inbox.newest() for r, inbox in self._heard.states.items()}
        poses = {r: inbox.newest() for r, inbox in self._heard.poses.items()}
        plans = {r: inbox.newest() for r, inbox in self._heard.plans.items()}
        fleet = {r: _linked(robot_view(states[r], poses[r], self._clock, plans[r]), status.seen.get(r)) for r in states}
        why_not = blocking_findings(self._experiment, fleet) if status.preflight is None else status.preflight
        localizer = _aged(self._heard.localizer)
        return snapshot(
            FleetSnapshot(
                time_s=self._clock.now_ns() * 1e-9,
                robots={r: RobotSnapshot(_age(states[r]), _age(poses[r]), _age(plans[r])) for r in states},
                localizer=localizer,
                obstacles=_aged(self._heard.obstacles),
                phase=status.state.name,
                phase_text="ready" if status.state is MissionState.WAITING and not why_not else status.state.value,
                reason=status.reason,
                allowed=[order_name(order) for order in Order if order is Order.END or status.state in states_allowing(order)],
                preflight=why_not,
                emergency_stop=status.state is MissionState.STOPPED,
                alarms=alarms(
                    self._experiment,
                    fleet,
                    localizer.message,
                    self._localizer_age_s(localizer),
                    status.recorder_error,
                    status.insecure,
                    status.beat_age_s if self._mode == "real-time" and status.beat_age_s > STUCK_S else 0.0,
                ),
                present=sorted(self._bus.present),
                tuning=status.tuning,
                laps=status.laps,
                requests=status.requests,
                ended=status.ended,
            )
        )

    def _localizer_age_s(self, found: AgedMessage) -> float:
        """In lockstep a slow machine is no silence: what counts there is whether the robots get poses."""
        return found.age_ms * 1e-3 if self._mode == "real-time" else 0.0

    def picture(self) -> dict[str, Any] | None:
        """The camera's newest picture, once."""
        header = self._previews.newest_header()
        if header is None or header == self._shown:
            return None
        self._shown = header
        found = self._previews.newest()
        return None if found is None else {"age_ms": _age(found).age_ms, "jpeg": found.message.jpeg}

    def notes(self) -> list[dict[str, Any]]:
        """Events since the last call, in order: lines of the log."""
        found = []
        while self._events:
            header, payload = self._events.popleft()
            try:
                event = decode(Event, payload, f"session {header.session:x}", topics.EVENT.name)
            except DecodeError:
                continue
            found.append(
                {
                    "k": "event",
                    "time_s": header.stamp_ns * 1e-9,
                    "level": event.level,
                    "source": event.source,
                    "text": event.message,
                }
            )
        return found

    def order(self, order: Order) -> tuple[str, int]:
        """Make a request. Returns the reason of a refusal, or nothing, and the request's number."""
        return self._station.order(order)

    def tune(self, values: Mapping[str, float] | None, next_lap: bool) -> tuple[str, int]:
        """Other gains, or those before. As `order`."""
        return self._station.tune(values, next_lap)

    def attempt(self, edit: Edit) -> dict[str, Any]:
        """Plan an edit without flying it."""
        return experiment_editor.attempt(self._experiment, edit)

    def save(self, edit: Edit, name: str) -> dict[str, Any]:
        """Keep an edit for a later run."""
        return experiment_editor.save(self._experiment, edit, name)

    def seek(self, time_s: float | None, rate: float | None) -> None:
        """Only a recorded run can be at another time."""


def _linked(seen: RobotView, known: RobotView | None) -> RobotView:
    """A view with what only the station's cycle knows: it counts every message of a robot, here some are passed over, and it
    has the timetable."""
    if known is None:
        return seen
    return replace(seen, clock_offset_s=known.clock_offset_s, loss=known.loss, behind_s=known.behind_s)


def _aged(inbox: Inbox[Any]) -> AgedMessage:
    return _age(inbox.newest())


def _age(received: Received[Any] | None) -> AgedMessage:
    """By the machine's own clock, also in lockstep: nothing that has stopped coming may look alive."""
    if received is None:
        return AgedMessage()
    return AgedMessage(
        received.message, min((time.monotonic_ns() - received.arrived_ns + received.header.age_ns) * 1e-6, NEVER_MS)
    )
