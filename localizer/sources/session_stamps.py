"""One clock for all stamps of a session, whatever clocks the cameras have. Pure.

Who receives a session's messages takes a jump of their stamps for a delay on the way, and poses for older than they are
(wire/transport/delay_estimator.py). So what a session tells by the clocks of several cameras, or of one that was started
anew on another computer, is carried over to the clock of the first.
"""

ALIKE_NS = 4_000_000  # two cameras' clocks that are nearer are one: their stamps stay as they are, to the bit
JUMP_NS = 50_000_000  # of a camera against our own clock, from one picture to the next; busy computers are late by less
_FOLLOWED = 16  # pictures in which a drift of the first camera's clock is followed


class SessionStamps:
    """The stamps of one session."""

    def __init__(self) -> None:
        self._first: str | None = None
        self._lead_ns = 0  # of the session's clock before ours
        self._corrections_ns: dict[str, int] = {}  # by camera: of its clock before the session's

    def of(self, camera: str, stamp_ns: int, instant_ns: int) -> int:
        """The stamp by the session's clock of a camera's stamp, which was at an instant of our own clock."""
        lead_ns = stamp_ns - instant_ns
        if self._first is None:
            self._first, self._lead_ns = camera, lead_ns
        is_first = camera == self._first
        correction_ns = self._corrections_ns.get(camera, 0)
        if abs(lead_ns - correction_ns - self._lead_ns) > (JUMP_NS if is_first else ALIKE_NS):
            correction_ns = self._corrections_ns[camera] = lead_ns - self._lead_ns
        if is_first:
            self._lead_ns += (lead_ns - correction_ns - self._lead_ns) // _FOLLOWED
        return stamp_ns - correction_ns

    def carried(self, camera: str, stamp_ns: int) -> int:
        """A stamp of a camera's other messages by the session's clock."""
        return stamp_ns - self._corrections_ns.get(camera, 0)

    def now_ns(self, now_ns: int) -> int:
        """An instant of our own clock by the session's."""
        return now_ns + self._lead_ns
