"""The clocks of a log's senders against the recorder's. Pure.

Every sender stamps by its own clock. What a log says of several of them belongs together by the recorder's clock: between a
session's clock and that there is, up to drift, what its quickest messages show (shoal/bus/delay_estimator.py).
"""

from collections import defaultdict
from statistics import median

from shoal.messages import topics
from shoal.messages.messages import LocalizerStatus, RobotState, Truth
from shoal.messages.topics import Qos, Topic

ALIKE_NS = 20_000_000  # clocks that are nearer are one, and stamps stay as they are: a busy recorder is late by less
OLD_LINE_NS = 1_000_000_000  # a line of a log that comes later than this was kept by its sender: no network is so slow
WINDOW_NS = 10_000_000_000  # in which the quickest counts: clocks drift by at most 2 ms meanwhile


LINE_CLOCKS = (RobotState, Truth, LocalizerStatus)  # types of messages by which lines of the log are dated, of each sender one
_UNKNOWN = (topics.POSE.type, topics.OBSTACLES.type)  # messages about a picture that do not say how old it was
_Clock = tuple[int, bool]  # session, and whether of its events: a localizer stamps all else by its camera's clock


def held_ns(topic: Topic, message: object) -> int | None:
    """Age of a message when it was published; None if it does not say so. The log has no ages."""
    if isinstance(message, RobotState):
        return round(message.timing.step_us * 1e3)
    if isinstance(message, LocalizerStatus):
        return round(message.frame_age_ms * 1e6)
    return None if topic.qos is Qos.IMAGE or topic.type in (*_UNKNOWN, RobotState, LocalizerStatus) else 0


def is_old_line(written_ns: int, arrived_ns: int) -> bool:
    """True for a line of a log that its sender has kept: a program that outlives the station, or was out of radio, gives the
    lines of before to whoever it hears next. Both instants are of one clock."""
    return arrived_ns - written_ns > OLD_LINE_NS


def stamps_lines_too(topic: Topic, ahead_ns: int) -> bool:
    """True if messages of a topic, by whose stamps our clock is so far ahead of their sender's, are stamped by the clock by
    which that sender stamps its lines of the log. A localizer's may be stamped by a camera's, unless that is our clock too."""
    return topic.type in LINE_CLOCKS and (topic.type is not LocalizerStatus or abs(ahead_ns) <= ALIKE_NS)


class SessionClocks:
    """By how much the recorder's clock is ahead of each session's, at each time."""

    def __init__(self) -> None:
        self._quickest_ns: dict[_Clock, dict[int, int]] = defaultdict(dict)  # by window of the stamps
        self._localizers = set[int]()  # sessions

    def note(self, topic: Topic, session: int, stamp_ns: int, arrived_ns: int, message: object) -> None:
        """Take in a message: keep, for each window of its sender's clock, the least time that one was on its way. In lockstep
        all share one clock, and a message arrives at its stamp: there is nothing to keep."""
        if isinstance(message, LocalizerStatus):
            self._localizers.add(session)
        age_ns = held_ns(topic, message)
        is_lockstep = arrived_ns == stamp_ns
        if age_ns is None or is_lockstep:
            return
        ahead_ns = arrived_ns - stamp_ns - age_ns
        quickest_ns = self._quickest_ns[session, topic is topics.EVENT]
        window = stamp_ns // WINDOW_NS
        quickest_ns[window] = min(quickest_ns.get(window, ahead_ns), ahead_ns)

    def shift_ns(self, topic: str, session: int, stamp_ns: int) -> int:
        """Time by which the recorder's clock is ahead of a stamp's; 0 where both are one clock, and where nothing is known."""
        quickest_ns = self._windows(session, topic == topics.EVENT.name)
        if not quickest_ns or _is_alike(quickest_ns):
            return 0
        window = stamp_ns // WINDOW_NS
        near = [quickest_ns[k] for k in (window - 1, window, window + 1) if k in quickest_ns]
        return min(near) if near else round(median(quickest_ns.values()))

    def _windows(self, session: int, is_event: bool) -> dict[int, int]:
        """Least time on the way in each window of a clock. For events, that of the sender's other messages where it is known:
        events of before the run come late, from the sender's cache."""
        own, others = (self._quickest_ns.get((session, kind), {}) for kind in (is_event, False))
        return others if others and (session not in self._localizers or _is_alike(others)) else own


def _is_alike(windows: dict[int, int]) -> bool:
    """True if a clock, by its quickest messages in each window, is the recorder's own."""
    return abs(median(windows.values())) <= ALIKE_NS
