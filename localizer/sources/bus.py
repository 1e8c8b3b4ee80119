"""SHELL: frames from the fleet's bus, from a camera process or the simulated pool."""

import time
from collections.abc import Iterator

from localizer.sources.base import CapturedFrame, silent_after_s
from shoal.bus.bus import Bus, Received
from shoal.messages import topics
from shoal.messages.messages import Frame
from shoal.runtime.runtime import Clock, Stop, wait


class FrameCount:
    """Counter of the frames of a session that never arrived."""

    def __init__(self) -> None:
        self.dropped = 0
        self._session = self._last = 0

    def note(self, received: Received[Frame]) -> int:
        """Count the frames that were dropped before a received one, by its sequence number. Returns their number so far."""
        session, sequence = received.header.session, received.header.sequence
        if session == self._session and sequence > self._last:
            self.dropped += sequence - self._last - 1
        self._session, self._last = session, sequence
        return self.dropped


class BusSource:
    """Frames that another process publishes, in real time. The newest wins; the sender's clock may be any."""

    def __init__(self, bus: Bus, clock: Clock, rate_hz: float, camera: str = "") -> None:
        self.trouble, self.silent_after_s = "", silent_after_s(rate_hz)
        self._bus, self._clock = bus, clock
        self._frames = bus.inbox(topics.FRAME.of_camera(camera), Frame)
        self._count = FrameCount()

    def frames(self, stop: Stop) -> Iterator[CapturedFrame | None]:
        """See FrameSource. Unreadable frames count as none, and so do those of two cameras in turn."""
        last = given = self._frames.newest_header()
        bad, silent_since = self._frames.bad, time.monotonic()
        while not stop.requested:
            left_s = self.silent_after_s - (time.monotonic() - silent_since)
            if left_s > 0.0 and wait(self._bus, stop, lambda last=last: self._frames.newest_header() is not last, left_s):  # type: ignore[misc]
                last = self._frames.newest_header()
                received = self._frames.newest()
                if received is None or received.header is given:  # unreadable; or it was newer than `last` a moment ago
                    continue
                given, bad = received.header, self._frames.bad
                if self._frames.has_two_senders(self.silent_after_s):
                    continue
                yield self._captured(received)
            elif not stop.requested:
                self.trouble = self._silence_reason(bad)
                yield None
            silent_since = time.monotonic()

    def _silence_reason(self, bad: int) -> str:
        """The reason for missing frames; `bad` were unreadable when the last one came."""
        if self._frames.has_two_senders(self.silent_after_s):
            return "two cameras publish frames: end one of them"
        return self._frames.last_error if self._frames.bad > bad else "no camera publishes frames"

    def _captured(self, received: Received[Frame]) -> CapturedFrame:
        """A received frame with its stamp, its instants on our clock, and the frames dropped before it."""
        header, instant_ns = received.header, self._clock.instant_ns(received)
        return CapturedFrame(
            received.message.pixels, header.stamp_ns, instant_ns, instant_ns + header.age_ns + received.late_ns,
            dropped=self._count.note(received), stamped=header.age_ns > 0, session=header.session,
        )  # fmt: skip

    def close(self) -> None:
        """Do nothing: the bus is the caller's."""
