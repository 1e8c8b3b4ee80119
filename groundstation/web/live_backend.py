"""SHELL: the live fleet as the page sees it: reads the station's inboxes and status.

Nothing here waits for the station's cycle, and the cycle never waits for anything here.
"""

import time
from collections import deque
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from groundstation.fleet_time import PaceMeter
from groundstation.mission.state_machine import READY, MissionState, order_name, states_allowing
from groundstation.telemetry import FleetInboxes
from groundstation.web.alarms import alarms
from groundstation.web.backend import ShownPicture, StationApi
from groundstation.web.protocol import Edit
from groundstation.web.scene import flown_paths, scene
from groundstation.web.snapshot import (
    NEVER_MS,
    PAST_ROBOTS,
    AgedMessage,
    FleetSnapshot,
    RobotSnapshot,
    event_note,
    past_row,
    snapshot,
)
from shoal.bus.bus import Bus, Inbox, Received
from shoal.config.experiment import Experiment
from shoal.messages import topics
from shoal.messages.codec import DecodeError, Header, decode
from shoal.messages.messages import CommandKind, Event, LocalizerStatus, Preview, Trajectory, Truth
from shoal.messages.session_clocks import is_old_line, stamps_lines_too
from shoal.messages.topics import Topic
from shoal.runtime.runtime import Clock, log

MOST_EVENTS = 256  # between two looks
SETTLE_NS = 1_000_000_000  # after the start: within it every robot has told its state
KEPT_EVENTS = 500  # for a page that connects later: as many as it shows
PAST_S = 600.0  # kept for pages that connect later
PAST_EVERY_S = 0.5  # a row of the past, in fleets of up to three
STANDS_S = 5.0  # without a cycle in lockstep, where a step that plans takes some: what is shown may be a process that hangs
STUCK_S = 1.0  # without a cycle of the station: robots hold by themselves then


class LiveBackend:
    kept_events = KEPT_EVENTS

    def __init__(
        self,
        experiment: Experiment,
        trajectories: Mapping[int, Trajectory],
        bus: Bus,
        inboxes: FleetInboxes,
        clock: Clock,
        station: StationApi,
        mode: str,
        run_dir: Path | None = None,
    ) -> None:
        self.experiment, self.station = experiment, station
        self._trajectories, self._bus, self._clock, self._mode, self.run_dir = trajectories, bus, clock, mode, run_dir
        self._inboxes = inboxes
        cameras = experiment.camera_names or ("",)
        self._previews = {name: bus.inbox(topics.PREVIEW.of_camera(name), Preview) for name in cameras}
        statuses = (topics.LOCALIZER.of_camera(name) for name in experiment.camera_names)
        self._dated: list[tuple[Topic, Inbox[Any]]] = [
            *((topics.STATE, inbox) for inbox in inboxes.states.values()),
            (topics.TRUTH, bus.inbox(topics.TRUTH, Truth)),
            (topics.LOCALIZER, inboxes.localizer),
            *((topic, bus.inbox(topic, LocalizerStatus)) for topic in statuses),
        ]  # by whose stamps lines of the log are dated
        self._events: deque[tuple[int, Header, bytes]] = deque(maxlen=MOST_EVENTS)  # with their arrival on our clock
        self._begun_ns = clock.now_ns()
        self._headers: list[Header | None] = []
        self._drawn: Mapping[int, tuple[Trajectory, float]] | None = None
        self._past_every_s = max(PAST_EVERY_S, PAST_S * len(inboxes.states) / PAST_ROBOTS)
        self._meter = PaceMeter()
        self._stands = False  # in lockstep: simulated time does not go on
        self._past: deque[dict[str, Any]] = deque(maxlen=round(PAST_S / self._past_every_s))
        bus.subscribe(topics.EVENT, None, self._event)

    def _event(self, topic: Topic, key: str, header: Header, payload: bytes) -> None:
        at_ns = self._clock.arrival_ns(header.stamp_ns)
        self._events.append((at_ns, header, payload))

    def scene(self) -> dict[str, Any]:
        """Constants of the run, and the paths that are flown now."""
        run = str(self.run_dir or "")
        constants = scene(self.experiment, self._trajectories, self._mode) | {"run": run, "life": f"{self._bus.session:x}"}
        return constants if self._drawn is None else constants | {"paths": flown_paths(self._drawn)}

    def paths(self) -> list[dict[str, Any]] | None:
        """Paths flown from now on; returned once after each change."""
        flown = self.station.paths
        if flown is None or flown is self._drawn:
            return None
        self._drawn = flown
        return flown_paths(flown)

    def changed(self) -> bool:
        """True if a robot's state has arrived since the last call."""
        headers = [inbox.newest_header() for inbox in self._inboxes.states.values()]
        changed, self._headers = headers != self._headers, headers
        return changed

    def snapshot(self) -> dict[str, Any]:
        """The fleet now. Some of it is kept as a row of the past."""
        view = self._newest_state()
        if not self._past or view["time_s"] - self._past[-1]["time_s"] >= self._past_every_s:
            self._past.append(past_row(view))
        return view

    def past(self) -> list[dict[str, Any]]:
        """The last PAST_S seconds."""
        return list(self._past)

    def _newest_state(self) -> dict[str, Any]:
        """The fleet's newest state, as the page gets it."""
        status, now_s = self.station.status(), self._clock.now_ns() * 1e-9
        self._stands = status.beat_age_s > STANDS_S
        states = {r: inbox.newest() for r, inbox in self._inboxes.states.items()}
        poses = {r: inbox.newest() for r, inbox in self._inboxes.poses.items()}
        plans = {r: inbox.newest() for r, inbox in self._inboxes.plans.items()}
        localizer = self._age(self._inboxes.localizer.newest())
        ready = status.state is MissionState.WAITING and not status.preflight
        return snapshot(
            FleetSnapshot(
                time_s=now_s,
                began_s=status.began_ns * 1e-9 if status.began_ns else None,
                robots={r: RobotSnapshot(self._age(states[r]), self._age(poses[r]), self._age(plans[r])) for r in states},
                localizer=localizer,
                obstacles=self._age(self._inboxes.obstacles.newest()),
                mission=status.state.name,
                mission_text=": ".join(filter(None, (READY, status.reason))) if ready else status.state.value,
                allowed=[
                    order_name(order)
                    for order in CommandKind
                    if order is CommandKind.END or status.state in states_allowing(order)
                ],
                emergency_stop=status.state is MissionState.STOPPED,
                alarms=alarms(
                    self.experiment,
                    status.views,
                    localizer.message,
                    self._localizer_age_s(localizer),
                    status.recorder_error,
                    status.lasting,
                    status.beat_age_s if status.beat_age_s > STUCK_S else 0.0,
                    self._mode == "lockstep",
                ),
                present=sorted(self._bus.present),
                status=status,
                pace=self._meter.add(now_s, time.monotonic()) if self._mode == "lockstep" else None,
            )
        )

    def _localizer_age_s(self, status: AgedMessage) -> float:
        """Age of the localizer's status. 0 in lockstep, where a slow machine is no silence, and poses are what counts."""
        return status.age_ms * 1e-3 if self._mode == "real-time" else 0.0

    def _age(self, received: Received[Any] | None) -> AgedMessage:
        """Age of a message by the machine's own clock. In lockstep by the simulated one, for a busy machine makes nothing old;
        but where simulated time stands, nothing that has stopped coming may look alive."""
        if received is None:
            return AgedMessage()
        now_ns = time.monotonic_ns()
        if not self._clock.waits:
            age_ms = received.age_ns(now_ns) * 1e-6
        else:
            age_ms = (now_ns - received.arrived_ns) * 1e-6
            age_ms = age_ms if self._stands else min(age_ms, max(self._clock.now_ns() - received.header.stamp_ns, 0) * 1e-6)
        return AgedMessage(received.message, min(age_ms, NEVER_MS))

    def picture(self, camera: str, shown_ns: int) -> ShownPicture | None:
        """The newest picture of a camera, if it is not the one of stamp `shown_ns`."""
        header = self._previews[camera].newest_header()
        if header is None or header.stamp_ns == shown_ns:
            return None
        newest = self._previews[camera].newest()
        return None if newest is None else ShownPicture(newest.header.stamp_ns, self._age(newest).age_ms, newest.message.jpeg)

    def notes(self) -> list[dict[str, Any]]:
        """Events since the last call, in the order in which they were written: lines of the log."""
        notes = []
        while self._events and not self._clocks_settle():
            at_ns, header, payload = self._events.popleft()
            try:
                event = decode(Event, payload, f"session {header.session:x}", topics.EVENT.name)
            except DecodeError:
                continue
            notes.append(event_note(event, self._event_ns(at_ns, header)))
        return sorted(notes, key=lambda note: float(note["time_s"]))  # several programs give what they have kept at once

    def _clocks_settle(self) -> bool:
        """True just after the start, when lines of an earlier run may come before the state that shows their robot's clock."""
        return not self._clock.waits and 0 <= self._clock.now_ns() - self._begun_ns < SETTLE_NS

    def _event_ns(self, arrived_ns: int, header: Header) -> int:
        """Instant at which a line of a log was written, on our clock. A program keeps its lines, and sends those of an earlier
        run to a station that starts. What else it says shows its clock, and by that they are old."""
        for topic, inbox in self._dated:
            newest = inbox.newest()
            if newest is not None and newest.header.session == header.session:
                ahead_ns = self._clock.instant_ns(newest) - newest.header.stamp_ns
                if stamps_lines_too(topic, ahead_ns):
                    written_ns = header.stamp_ns + ahead_ns
                    return written_ns if is_old_line(written_ns, arrived_ns) else arrived_ns
        return arrived_ns

    def remark(self, text: str) -> None:
        """Put a person's line into the run's log."""
        log.info("remark: %s", " ".join(text.split()))

    def seek(self, time_s: float | None, rate: float | None) -> None:
        """Refuse: only a recorded run can be at another time."""

    def choose(self, what: str, edit: Edit | None) -> list[str]:
        """Refuse: this run is not over."""
        return ["the run still goes on"]
