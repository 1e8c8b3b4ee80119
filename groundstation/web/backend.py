"""Interfaces of the page's server: what it shows (Backend), and what it asks of the station (StationApi). Pure."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol

from groundstation.mission.gain_update import GainStatus
from groundstation.mission.lap_statistics import Lap
from groundstation.mission.state_machine import MissionState
from groundstation.planning.segment import PlanSegment
from groundstation.telemetry import Finding, Fleet
from groundstation.web.protocol import Edit
from shoal.config.experiment import Experiment
from shoal.messages.messages import WHOLE_FLEET, CommandKind, DriveVelocity, Outcome, Trajectory


@dataclass(frozen=True)
class ShownStatus:
    """The part of the station's status that the page shows as it is."""

    reason: str = ""  # for the mission's state
    tuning: GainStatus | None = None
    laps: Sequence[Lap] = ()
    preflight: tuple[Finding, ...] = ()  # why not to arm
    refused: Mapping[CommandKind, str] = field(
        default_factory=dict
    )  # requests that the state allows, and why they are refused
    requests: Sequence[Outcome] = ()  # what became of people's requests, oldest first
    ended: bool = False  # a person has ended the run
    flown: str = ""  # name of the experiment whose path is flown, and the path's duration
    flown_s: float = 0.0
    left_s: float = 0.0  # until the end of the plan that flies, if nothing holds the robots up
    led: Mapping[int, str] = field(default_factory=dict)  # robots that a person leads one by one, and what they do


@dataclass(frozen=True, kw_only=True)
class Status(ShownStatus):
    """Status of the station, as of its last cycle."""

    state: MissionState
    recorder_error: str = ""
    lasting: Mapping[str, str] = field(default_factory=dict)  # warnings, by key, about what is so from a program's start
    views: Fleet = field(default_factory=dict)  # the fleet as of the station's last cycle
    beat_age_s: float = 0.0  # since the station's last cycle
    began_ns: int = 0  # instant at which the formation's flight began: time 0 for people; 0: not known


@dataclass(frozen=True)
class ShownPicture:
    """A camera's picture for the page, and its age when it was asked for. `time_s`: of a recorded run, when it was."""

    stamp_ns: int
    age_ms: float
    jpeg: bytes
    time_s: float | None = None


@dataclass(frozen=True)
class Validity:
    """Bounds of a request, as instants (s, monotonic): it is not done after `until_s`, nor if another request has been made
    since `asked_s`."""

    until_s: float = math.inf
    asked_s: float = math.inf


ALWAYS = Validity()


class OperatorRequests(Protocol):
    """Requests for the whole fleet, or for the robot `only`. Each returns the reason of a refusal, or nothing, and the
    request's number."""

    def request(
        self,
        order: CommandKind,
        via: Sequence[tuple[float, float]] = (),
        only: int = WHOLE_FLEET,
        text: str = "",
        valid: Validity = ALWAYS,
    ) -> tuple[str, int]:
        """Ask for an order; `via`: places of a GO, `text`: what a FORMATION, PATH or FAULT is about."""

    def draft(self, order: CommandKind, text: str) -> PlanSegment:
        """Plan another form, or another experiment's path, without flying it. Raises PlanError."""

    def drive(self, robot: int, velocity: DriveVelocity, valid: Validity = ALWAYS) -> str:
        """Move one robot at a velocity; it holds when none comes any more. Returns the reason of a refusal, or nothing."""

    def request_gains(self, values: Mapping[str, float] | None, next_lap: bool, valid: Validity = ALWAYS) -> tuple[str, int]:
        """Change gains; None: go back to those before."""


class StationApi(OperatorRequests, Protocol):
    """The station (groundstation/station/station.py) as the page needs it. All of it may be used from any thread."""

    @property
    def paths(self) -> Mapping[int, tuple[Trajectory, float]] | None:
        """Trajectory that each robot flies now, and its end in s; None: as planned before the run."""

    def status(self) -> Status: ...


class Backend(Protocol):
    """Data source of the page's server: the live fleet, or a recorded run. Used from one thread, but for `station`, whose
    requests may take their time in others."""

    @property
    def experiment(self) -> Experiment: ...
    @property
    def run_dir(self) -> Path | None:
        """Folder of the run that is shown."""

    @property
    def station(self) -> OperatorRequests: ...
    @property
    def kept_events(self) -> int:
        """Lines of the log, the newest, that a page gets when it connects."""

    def scene(self) -> dict[str, Any]: ...
    def changed(self) -> bool: ...
    def snapshot(self) -> dict[str, Any]: ...
    def past(self) -> list[dict[str, Any]]:
        """Rows of the past (snapshot.past_row), oldest first, for a page that has just connected."""

    def picture(self, camera: str, shown_ns: int) -> ShownPicture | None:
        """The newest picture of a camera ("" for the only one); None if it is the one of stamp `shown_ns`."""

    def paths(self) -> list[dict[str, Any]] | None: ...
    def notes(self) -> list[dict[str, Any]]: ...
    def remark(self, text: str) -> None: ...
    def seek(self, time_s: float | None, rate: float | None) -> None: ...
    def choose(self, what: str, edit: Edit | None) -> list[str]:
        """Take what a person wants after an ended run (protocol.AfterRun). Returns every reason against it."""
