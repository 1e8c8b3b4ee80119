"""One instant of the fleet as the page gets it: flat maps and float32 arrays, ready for MessagePack. Pure.

MessagePack because names travel with the values (a page and a station that differ do not misread each other), numbers need no
parsing, and arrays are bytes that the browser views as they are. Ages are in ms at the instant of the snapshot; the page adds
what has gone by since it arrived, by its own clock.
"""

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from enum import IntEnum
from typing import Any

import numpy as np

from groundstation.mission.gain_update import GainStage, GainStatus
from groundstation.mission.lap_statistics import Lap
from groundstation.mission.state_machine import order_name
from groundstation.web.alarms import Alarm
from groundstation.web.backend import ShownStatus
from groundstation.web.scene import floats
from shoal.frames import Array
from shoal.messages.messages import Event, Outcome, Plan

OFF_PAGE = frozenset(  # fields that no panel shows
    {"experiment_hash", "code", "unseen_s", "marks_seen", "thruster_test", "blind", "board_ms", "arrival_ns", "charge"}
    | {"battery_reports", "heartbeats", "autopilot", "power_on_depth_m"}
)
NEVER_MS = 1e9  # finite stand-in for the age of what was never heard


@dataclass(frozen=True, eq=False)
class AgedMessage:
    """The newest message of a kind, and how old it is; None is "never heard"."""

    message: Any = None
    age_ms: float = NEVER_MS


@dataclass(frozen=True, eq=False)
class RobotSnapshot:
    """The newest of one robot."""

    state: AgedMessage = field(default_factory=AgedMessage)
    pose: AgedMessage = field(default_factory=AgedMessage)
    plan: AgedMessage = field(default_factory=AgedMessage)


PAST_ROBOTS = 3600  # robots in all rows of the past that a page gets: 700 bytes each


@dataclass(frozen=True, eq=False)
class FleetSnapshot:
    """The newest of everything."""

    time_s: float  # of the run, by the station's clock
    robots: Mapping[int, RobotSnapshot]
    began_s: float | None = None  # when the formation's flight began, by the same clock: time 0 for people
    localizer: AgedMessage = field(default_factory=AgedMessage)
    obstacles: AgedMessage = field(default_factory=AgedMessage)
    mission: str = ""
    mission_text: str = ""
    allowed: Sequence[str] = ()  # orders that the mission takes now
    emergency_stop: bool = False
    alarms: Sequence[Alarm] = ()
    present: Sequence[str] = ()
    status: ShownStatus = field(default_factory=ShownStatus)
    pace: float | None = None  # simulated seconds per second, lately; None for a fleet that lives by the wall clock


def snapshot(news: FleetSnapshot) -> dict[str, Any]:
    """The page's view of it all."""
    status = news.status
    return {
        "time_s": news.time_s,
        "began_s": news.began_s,
        "mission": news.mission,
        "mission_text": news.mission_text,
        "reason": status.reason,
        "allowed": list(news.allowed),
        "refused": {order_name(order): reason for order, reason in status.refused.items()},
        "preflight": [{"robot": finding.robot, "text": finding.message} for finding in status.preflight],
        "stop": news.emergency_stop,
        "alarms": [{"level": a.level, "key": a.key, "robot": a.robot, "text": a.text} for a in news.alarms],
        "present": list(news.present),
        "localizer": _aged(news.localizer),
        "obstacles": _aged(news.obstacles),
        "tuning": _tuning(status.tuning, status.laps),
        "requests": [_request(outcome) for outcome in status.requests],
        "ended": status.ended,
        "pace": news.pace,
        "flown": status.flown,
        "flown_s": status.flown_s,
        "left_s": status.left_s,
        "led": [{"robot": robot, "text": text} for robot, text in status.led.items()],
        "robots": [_robot(robot, view) for robot, view in news.robots.items()],
    }


def past_row(view: Mapping[str, Any]) -> dict[str, Any]:
    """The part of a snapshot that plots and trails are drawn from. A page gets rows of the past when it connects."""
    robots = []
    for robot in view["robots"]:
        row = {"id": robot["id"], "age_ms": robot["age_ms"]}
        if "state" in robot:
            row["state"] = robot["state"]
        robots.append(row)
    localizer = view["localizer"]
    return {
        "time_s": view["time_s"],
        "robots": robots,
        "localizer": None if localizer is None else {key: localizer[key] for key in ("age_ms", "frame_age_ms")},
    }


def event_note(event: Event, at_ns: int) -> dict[str, Any]:
    """A line of the log for the page."""
    return {"k": "event", "time_s": at_ns * 1e-9, "level": event.level, "source": event.source, "text": event.message}


def _request(outcome: Outcome) -> dict[str, Any]:
    """The outcome of a request, as the page gets it."""
    return {
        "request": outcome.request,
        "order": order_name(outcome.order),
        "progress": outcome.progress.name,
        "reason": outcome.reason,
        "confirmed": list(outcome.confirmed),
        "waiting": [{"robot": r, "why": why} for r, why in zip(outcome.waiting, outcome.why, strict=False)],
    }


def _robot(robot: int, news: RobotSnapshot) -> dict[str, Any]:
    """One robot's state, pose and plan, as far as they are known, as the page gets them."""
    fields: dict[str, Any] = {"id": robot, "age_ms": news.state.age_ms}
    if news.state.message is not None:
        fields["state"] = page_form(news.state.message)
    pose = _aged(news.pose)
    if pose is not None:
        fields["pose"] = pose | {"ellipse": ellipse(news.pose.message.covariance)}
    plan: Plan | None = news.plan.message
    if plan is not None:
        fields["plan"] = {"age_ms": news.plan.age_ms, "period_s": plan.period_s, "xyz": floats(plan.eta[:, :3])}
    return fields


def page_form(message: Any) -> dict[str, Any]:
    """A message for the page, field by field under its own names: arrays as float32, choices by name, None for a part that it
    lacks. src/messages.ts has the types."""
    return {f.name: _page_value(getattr(message, f.name)) for f in dataclasses.fields(message) if f.name not in OFF_PAGE}


def _page_value(value: Any) -> Any:
    """A value of a message in the form that JSON has."""
    if isinstance(value, np.ndarray):
        return floats(value)
    if isinstance(value, IntEnum):
        return value.name
    if dataclasses.is_dataclass(value):
        return page_form(value)
    return list(value) if isinstance(value, tuple) else value


def _aged(news: AgedMessage) -> dict[str, Any] | None:
    """A message with its age; None if there is none."""
    return None if news.message is None else {"age_ms": news.age_ms} | page_form(news.message)


def ellipse(covariance: Array) -> tuple[float, float, float]:
    """One-sigma half axes [m] of the position in a covariance (3, 3), the larger first, and the larger one's angle [rad]."""
    xx, xy, yy = float(covariance[0, 0]), float(covariance[0, 1]), float(covariance[1, 1])
    mean, spread = 0.5 * (xx + yy), float(np.hypot(0.5 * (xx - yy), xy))
    angle = 0.5 * float(np.arctan2(2.0 * xy, xx - yy))
    return float(np.sqrt(max(mean + spread, 0.0))), float(np.sqrt(max(mean - spread, 0.0))), angle


def _tuning(tuning: GainStatus | None, laps: Sequence[Lap]) -> dict[str, Any] | None:
    """Gains in the order of the scene's knobs, unrounded: a page that sends a value back must send the same value."""
    if tuning is None:
        return None
    return {
        "id": tuning.flown.id,
        "values": tuning.flown.values.tolist(),
        "wanted": tuning.wanted,
        "stage": tuning.stage.value,
        "waiting": tuning.stage is GainStage.WAITING,
        "reason": tuning.reason,
        "undo": tuning.undo,
        "known": list(tuning.history),
        "laps": [{"n": lap.number, "id": lap.tuning_id, "s": lap.time_s, "rms": lap.rms_m, "max": lap.max_m} for lap in laps],
    }
