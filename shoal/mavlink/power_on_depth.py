"""Depth at which a thruster board took its zero, by its own measurements before that and by what it says. Pure.

A board takes the pressure at the surface when it is switched on in air, and keeps it through all other resets (docs/board.md).
One that says nothing about its last reset may have taken its zero where it restarted: each depth that it reports later is then
too small by that depth.
"""

from enum import Enum

MS_WRAPS = 2**32  # `time_boot_ms` begins at 0 again after 49.7 days


class ZeroOrigin(Enum):
    """Origin of a board's zero, as the board reports it."""

    UNKNOWN = 0  # it says nothing
    KEPT = 1  # from before the last restart
    AIR = 2  # from a power-on in air


class PowerOnDepth:
    """Depth of one board's zero. A board that takes its zero in air later has a right one again."""

    def __init__(self) -> None:
        self._zero_m, self._taken_m = 0.0, 0.0  # of the zero before the last restart; how much deeper one taken there is
        self._before_m = 0.0  # of the zero at the last burst
        self._has_restarted = False  # since the depth was set
        self._origin = ZeroOrigin.UNKNOWN
        self._newest_ms, self._reported_m = -1, 0.0  # the last burst
        self._restarted_ms: int | None = None  # an earlier time than that, which the next burst has to confirm

    @property
    def depth_m(self) -> float:
        """Depth of the zero; 0 for a board that has not restarted since it is heard."""
        if self._has_restarted and self._origin is ZeroOrigin.AIR:
            return 0.0
        return self._zero_m if self._origin is ZeroOrigin.KEPT else self._zero_m + self._taken_m

    def set_depth(self, depth_m: float) -> None:
        """Take the zero to be at this depth, whatever was seen of restarts."""
        self._zero_m, self._taken_m, self._before_m, self._has_restarted = depth_m, 0.0, depth_m, False

    def note_origin(self, origin: ZeroOrigin) -> None:
        """Take in what a HEARTBEAT says."""
        self._origin = origin

    def note_burst(self, board_ms: int, reported_m: float) -> None:
        """Take in a burst's time on the board's clock, and its depth. Two bursts in a row of an earlier time: the board has
        restarted, where it was last heard."""
        if self._newest_ms >= 0 and not _follows(board_ms, self._newest_ms):
            before_ms, self._restarted_ms = self._restarted_ms, board_ms
            if before_ms is None or not _follows(board_ms, before_ms):
                return
            # A HEARTBEAT of the new life may have come already.
            self._zero_m, self._taken_m, self._has_restarted = self._before_m, self._reported_m, True
        self._before_m = self.depth_m
        self._newest_ms, self._reported_m, self._restarted_ms = board_ms, reported_m, None


def _follows(board_ms: int, before_ms: int) -> bool:
    """True if a time is not earlier than another one, through the clock's wrap too."""
    return (board_ms - before_ms) % MS_WRAPS < MS_WRAPS // 2
