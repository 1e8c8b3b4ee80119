"""SHELL: a recorded run back on the bus, for viewers and for programs that are fed by what robots say.

Only what was seen and said goes out, never what made anything move: no order, no heartbeat, no trajectory, no tick. And it
goes out as another fleet, `replay/NAME`: no listener takes it for the robots' own, and none of our programs can join
a fleet of that name. A robot in it would hear no station, so it could not be armed.
"""

import time
from collections.abc import Callable, Iterable, Iterator

from groundstation.logs.reader import LogFile, LogMessage
from shoal.bus.bus import Bus
from shoal.messages import topics
from shoal.messages.topics import Qos
from shoal.runtime.runtime import SLICE_S, Stop

SEEN_AND_SAID = (
    topics.TRUTH, topics.PREVIEW, topics.VIDEO, topics.PICTURE, topics.POSE, topics.LOCALIZER, topics.OBSTACLES, topics.PLAN,
    topics.STATE, topics.EVENT,
)  # fmt: skip


def chosen(log: LogFile, begin_s: float, end_s: float) -> Iterator[LogMessage]:
    """Messages to send of a part of the run, in seconds from the log's beginning."""
    end_ns = log.start_ns + end_s * 1e9
    for line in log.messages(
        lambda topic, _: topic in SEEN_AND_SAID or topic.qos is Qos.IMAGE, log.start_ns + round(begin_s * 1e9)
    ):
        if line.arrived_ns > end_ns:
            return
        yield line


def send(
    bus: Bus,
    lines: Iterable[LogMessage],
    rate: float,
    stop: Stop,
    clock_s: Callable[[], float] = time.monotonic,
    sleep: Callable[[float], None] = time.sleep,
) -> int:
    """Send lines as far apart as they arrived, `rate` times as fast. Stamps and bytes stay as they were. Returns how many."""
    count, first_ns, begin_s = 0, None, clock_s()
    for line in lines:
        first_ns = line.arrived_ns if first_ns is None else first_ns
        due_s = begin_s + (line.arrived_ns - first_ns) * 1e-9 / rate
        while not stop.requested and (left_s := due_s - clock_s()) > 0.0:
            sleep(min(left_s, SLICE_S))
        if stop.requested:
            break
        bus.forward(line.topic, line.payload, line.header.stamp_ns, line.robot or None)
        count += 1
    return count
