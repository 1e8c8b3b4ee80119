"""A run's events, each once: what a robot's states, its agent and the station all tell is one event. Pure."""

import re
from collections.abc import Iterable, Sequence
from dataclasses import replace

from groundstation.analysis.series import TimelineEvent

SAME_S = 1.0  # within this time a robot's state and its agent's line are about one event
REPEATED_S = 5.0  # within this time a line that comes again is the same event, which goes on
CONFIRMED_BY = {"ARM": "armed", "START": "tracking", "HOLD": "holding", "STOP": "stopped", "DISARM": "disarmed"}
REMARK, TAG = "remark: ", re.compile(r"(?<!\S)#([\w-]+)")  # how the station tells a person's line
STOOD_STILL = "process stood still for "  # what a log shows of a computer that sleeps, or has no memory left
INJECTED, ENDED = "fault: ", "fault over: "  # how the simulator tells what it breaks (sim_bridge/fault_schedule.py)


def once(events: Iterable[TimelineEvent]) -> tuple[TimelineEvent, ...]:
    """The events in order of time, each once. Left out are an agent's lines about a mode that its states show, and replies
    that such a mode confirms. A line that repeats is one event with its number and last time; from the flight's beginning on,
    at 0, it is another event than before."""
    named = [replace(event, source=_source(event.source)) for event in events]
    kept: list[TimelineEvent] = []
    latest: dict[tuple[str, str, bool], int] = {}  # place in `kept` of the latest event with these words
    for event in sorted(named, key=lambda event: event.time_s):
        key = (event.source, event.text, event.time_s >= 0.0)
        if key in latest:
            earlier = kept[latest[key]]
            since_s = event.time_s - earlier.last_s
            if event.source.startswith("robot ") and since_s <= SAME_S:
                continue
            if since_s <= REPEATED_S:
                kept[latest[key]] = replace(earlier, until_s=event.time_s, times=earlier.times + 1)
                continue
        latest[key] = len(kept)
        kept.append(event)

    times_of: dict[tuple[str, str], list[float]] = {}  # of the events that begin with a mode, by source and mode
    for event in kept:
        mode, _, _ = event.text.partition(": ")
        times_of.setdefault((event.source, mode), []).append(event.time_s)

    def is_confirmed(event: TimelineEvent) -> bool:
        mode_times = times_of.get(_confirmation(event), [])
        return any(abs(time_s - event.time_s) <= SAME_S for time_s in mode_times)

    return tuple(event for event in kept if not is_confirmed(event))


def faults(events: Sequence[TimelineEvent]) -> tuple[TimelineEvent, ...]:
    """The faults among the events. A reaction of the station's mission is left out when another fault came before it."""
    all_faults = [e for e in events if e.fault]
    causes_s = [e.time_s for e in all_faults if not _is_reaction(e)]
    return tuple(e for e in all_faults if not (_is_reaction(e) and any(time_s <= e.time_s for time_s in causes_s)))


def is_injection(event: TimelineEvent) -> bool:
    """True for the begin and the end of what the simulator broke on purpose."""
    return not event.fault and not event.source.startswith("robot ") and event.text.startswith((INJECTED, ENDED))


def tags(events: Iterable[TimelineEvent]) -> tuple[str, ...]:
    """The #words of people's remarks, each once."""
    words = (word for e in events if e.text.startswith(REMARK) for word in TAG.findall(e.text))
    return tuple(dict.fromkeys(words))


def _source(name: str) -> str:
    """The source under which an event is listed: an agent's is its robot."""
    return f"robot {name.removeprefix('agent-')}" if name.startswith("agent-") else name


def _is_reaction(event: TimelineEvent) -> bool:
    """True for a line of the station's mission, which reacts to faults of others."""
    return event.source == "groundstation" and event.text.startswith("mission")


def _confirmation(event: TimelineEvent) -> tuple[str, str]:
    """Source and mode of the event that confirms an accepted order: the robot's new mode. The mode is empty for any other
    event."""
    order, _, outcome = event.text.partition(": ")
    return event.source, CONFIRMED_BY.get(order, "") if outcome == "accepted" else ""
