"""The clocks of a log's senders against the recorder's. Pure.

Every sender stamps by its own clock. What a log says of several of them belongs together by the recorder's clock: between a
session's clock and that there is, up to drift, what its quickest messages show (shoal/bus/delay_estimator.py).
"""

from collections import defaultdict
from statistics import median

from shoal.messages import topics
from shoal.messages.messages import LocalizerStatus, RobotState
from shoal.messages.topics import Qos, Topic

ALIKE_NS = 20_000_000  # clocks that are nearer are one, and stamps stay as they are: a busy recorder is late by less
OLD_LINE_NS = 1_000_000_000  # a line of a log that comes later than this was kept by its sender: no network is so slow
WINDOW_NS = 10_000_000_000  # in which the quickest counts: clocks drift by at most 2 ms meanwhile


_UNKNOWN = (topics.POSE.type, topics.OBSTACLES.type)  # messages about a picture that do not say how old it was
_Clock = tuple[int, bool]  # session, and whether of the lines of its log: a localizer stamps all else by its camera's clock


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


class SessionClocks:
    """By how much the recorder's clock is ahead of each session's, at each time."""

    def __init__(self) -> None:
        self._quickest_ns: dict[_Clock, dict[int, int]] = defaultdict(dict)  # by window of the stamps
        self._localizers = set[int]()  # sessions

    def note(self, topic: Topic, session: int, stamp_ns: int, arrived_ns: int, message: object) -> None:
        """Take in a message. In lockstep all share one clock, and the arrival is the stamp."""
        if isinstance(message, LocalizerStatus):
            self._localizers.add(session)
        held = held_ns(topic, message)
        if held is not None and arrived_ns != stamp_ns:
            windows, at = self._quickest_ns[session, topic is topics.EVENT], stamp_ns // WINDOW_NS
            ahead_ns = arrived_ns - stamp_ns - held
            windows[at] = min(windows.get(at, ahead_ns), ahead_ns)

    def shift_ns(self, topic: str, session: int, stamp_ns: int) -> int:
        """Shift of a stamp in a topic of that name; 0 where the clocks are one, and where nothing is known."""
        windows, at = self._windows(session, topic == topics.EVENT.name), stamp_ns // WINDOW_NS
        if not windows or _is_alike(windows):
            return 0
        near = [windows[k] for k in (at - 1, at, at + 1) if k in windows]
        return min(near) if near else round(median(windows.values()))

    def _windows(self, session: int, of_log: bool) -> dict[int, int]:
        """Quickest messages of a clock, by window. Lines of a log go by what else their sender says: those of before the
        run come late, from its cache."""
        own, others = (self._quickest_ns.get((session, own), {}) for own in (of_log, False))
        return others if others and (session not in self._localizers or _is_alike(others)) else own


def _is_alike(windows: dict[int, int]) -> bool:
    return abs(median(windows.values())) <= ALIKE_NS
