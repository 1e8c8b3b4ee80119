"""A run's events, each once: what a robot's states, its agent and the station all tell is one event. Pure."""

import re
from collections.abc import Iterable, Sequence
from dataclasses import replace

from groundstation.analysis.series import TimelineEvent

SAME_S = 1.0  # a robot's state and its agent's words about it come within this time
REPEATED_S = 5.0  # a line that comes again within this time goes on
CONFIRMED_BY = {"ARM": "armed", "START": "tracking", "HOLD": "holding", "STOP": "stopped", "DISARM": "disarmed"}
REMARK, TAG = "remark: ", re.compile(r"(?<!\S)#([\w-]+)")  # how the station tells a person's line
STOOD_STILL = "process stood still for "  # what a log shows of a computer that sleeps, or has no memory left
INJECTED, ENDED = "fault: ", "fault over: "  # how the simulator tells what it breaks (sim_bridge/fault_schedule.py)


def once(events: Iterable[TimelineEvent]) -> tuple[TimelineEvent, ...]:
    """The events in order of time, each once. Left out are an agent's words for a mode that its states show, and replies
    that such a mode confirms. A line that repeats is one event with its number and last time; what comes from the flight's
    beginning on, at 0, is another event than the same before."""
    ordered = sorted((replace(e, source=_source(e.source)) for e in events), key=lambda e: e.time_s)
    kept: list[TimelineEvent] = []
    latest: dict[tuple[str, str], int] = {}  # place in `kept` of the latest event with these words
    for event in ordered:
        key = (event.source, event.text)
        before = kept[latest[key]] if key in latest else None
        before = before if before is not None and (before.time_s >= 0.0) is (event.time_s >= 0.0) else None
        if before is not None and event.source.startswith("robot ") and event.time_s - before.last_s <= SAME_S:
            continue
        if before is not None and event.time_s - before.last_s <= REPEATED_S:
            kept[latest[key]] = replace(before, until_s=event.time_s, times=before.times + 1)
            continue
        latest[key] = len(kept)
        kept.append(event)
    modes: dict[tuple[str, str], list[float]] = {}
    for event in kept:
        modes.setdefault((event.source, event.text.partition(": ")[0]), []).append(event.time_s)
    return tuple(e for e in kept if not any(abs(at_s - e.time_s) <= SAME_S for at_s in modes.get(_confirmation(e), ())))


def faults(events: Sequence[TimelineEvent]) -> tuple[TimelineEvent, ...]:
    """The events that should not have been, without the station's words about those of others."""
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
    """An agent speaks for its robot."""
    return f"robot {name.removeprefix('agent-')}" if name.startswith("agent-") else name


def _is_reaction(event: TimelineEvent) -> bool:
    return event.source == "groundstation" and event.text.startswith("mission")


def _confirmation(event: TimelineEvent) -> tuple[str, str]:
    """The robot and the mode that shows that an order was accepted."""
    order, _, outcome = event.text.partition(": ")
    return event.source, CONFIRMED_BY.get(order, "") if outcome == "accepted" else ""
