"""A station's side of the page without a cycle: it views the fleet when asked, and notes what is requested."""

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

from groundstation.mission.state_machine import MissionState
from groundstation.planning.feasibility import PlanError
from groundstation.planning.segment import PlanSegment
from groundstation.telemetry import Finding, Fleet, FleetInboxes, LinkMonitor, blocking_findings, subscribe_fleet
from groundstation.web.backend import ALWAYS, Status, Validity
from shoal.bus.bus import Bus
from shoal.config.experiment import Experiment
from shoal.messages.messages import CommandKind, DriveVelocity, Trajectory
from shoal.runtime.runtime import Clock, WallClock


@dataclass
class FakeStation:
    """Takes every request, and calls the fleet ready or not by what its robots say."""

    experiment: Experiment
    bus: Bus
    own_status: Status = field(default_factory=lambda: Status(state=MissionState.WAITING))
    orders: list[CommandKind] = field(default_factory=list)
    via: Sequence[tuple[float, float]] = ()  # of the last order
    only: int = 0  # the robot that the last order was for
    robots_asked: list[int] = field(default_factory=list)  # of each order; 0: the whole fleet
    text: str = ""  # of the last order
    drives: list[tuple[int, DriveVelocity]] = field(default_factory=list)
    preflight: tuple[Finding, ...] | None = None  # None: as the robots are
    paths: Mapping[int, tuple[Trajectory, float]] | None = None
    asked_s: float = 0.0  # of the last request (s, monotonic)
    clock: Clock = field(default_factory=WallClock)
    inboxes: FleetInboxes = field(init=False)

    def __post_init__(self) -> None:
        self.inboxes = subscribe_fleet(self.bus, self.experiment.robot_ids)

    def status(self) -> Status:
        fleet: Fleet = {robot: self.inboxes.view(robot, LinkMonitor(), self.clock) for robot in self.inboxes.states}
        fleet = {**fleet, **self.own_status.views}
        preflight = blocking_findings(self.experiment, fleet) if self.preflight is None else self.preflight
        return replace(self.own_status, views=fleet, preflight=preflight)

    def request(
        self,
        order: CommandKind,
        via: Sequence[tuple[float, float]] = (),
        only: int = 0,
        text: str = "",
        valid: Validity = ALWAYS,
    ) -> tuple[str, int]:
        if time.monotonic() > valid.until_s or self.asked_s > valid.asked_s:
            return "too late", 0
        self.asked_s = time.monotonic()
        self.orders.append(order)
        self.robots_asked.append(only)
        self.via, self.only, self.text = via, only, text
        return "", len(self.orders)

    def draft(self, order: CommandKind, text: str) -> PlanSegment:
        raise PlanError(f"{text}: nothing flies here")

    def drive(self, robot: int, velocity: DriveVelocity, valid: Validity = ALWAYS) -> str:
        if time.monotonic() > valid.until_s:
            return "too late"
        self.drives.append((robot, velocity))
        return "" if robot in self.experiment.robot_ids else f"no robot {robot}"

    def request_gains(self, values: Mapping[str, float] | None, next_lap: bool, valid: Validity = ALWAYS) -> tuple[str, int]:
        return ("too late", 0) if time.monotonic() > valid.until_s else ("", 1)
