"""One clock for all stamps of a session, whatever clocks the cameras have. Pure.

Who receives a session's messages takes a jump of their stamps for a delay on the way, and poses for older than they are
(shoal/bus/delay_estimator.py). So what a session tells by the clocks of several cameras, or of one that was started
anew on another computer, is carried over to the clock that the session told by first: a camera's, or our own where there was
something to tell before any camera.
"""

ALIKE_NS = 4_000_000  # two cameras' clocks that are nearer are one: their stamps stay as they are, to the bit
JUMP_NS = 50_000_000  # of a camera against our own clock, from one picture to the next; busy computers are late by less
_FOLLOWED = 16  # pictures in which a drift of a camera's clock is followed


class SessionStamps:
    def __init__(self) -> None:
        self._begun = False
        self._first: tuple[str, int] | None = None  # the camera whose clock is the session's; None: it is our own
        self._lead_ns = 0  # of the session's clock before ours
        self._corrections_ns: dict[tuple[str, int], int] = {}  # by camera and its session: beyond the session's lead

    def of(self, camera: str, stamp_ns: int, instant_ns: int, session: int = 0) -> int:
        """The stamp by the session's clock of a camera's stamp, which was at an instant of our own clock. `session` is the
        camera's own: another one may have another clock."""
        name, lead_ns = (camera, session), stamp_ns - instant_ns
        if not self._begun:
            self._begun, self._first, self._lead_ns = True, name, lead_ns
        earlier_ns = self._corrections_ns.get(name)
        off_ns = lead_ns - self._lead_ns - (earlier_ns or 0)
        correction_ns = earlier_ns or 0
        if abs(off_ns) > (ALIKE_NS if earlier_ns is None else JUMP_NS):
            correction_ns += off_ns
        elif name == self._first:
            self._lead_ns += off_ns // _FOLLOWED
        elif correction_ns or abs(off_ns) > ALIKE_NS:
            correction_ns += off_ns // _FOLLOWED
        self._corrections_ns[name] = correction_ns
        return stamp_ns - correction_ns

    def carried(self, camera: str, stamp_ns: int, session: int = 0) -> int:
        """A stamp of a camera's other messages by the session's clock."""
        return stamp_ns - self._corrections_ns.get((camera, session), 0)

    def now_ns(self, now_ns: int) -> int:
        """An instant of our own clock by the session's."""
        self._begun = True
        return now_ns + self._lead_ns
