"""Depth at which a thruster board was switched on, by its own measurements before that. Pure.

A board takes the pressure at the surface when it is switched on, in air (docs/board.md). One that restarts under water takes
it there: each depth that it reports later is too small by the depth at which it restarted.
"""

MS_WRAPS = 2**32  # `time_boot_ms` begins at 0 again after 49.7 days


class PowerOnDepth:
    """Depth of one board's zero. A board that is restarted in air later has a right zero again."""

    def __init__(self) -> None:
        self.depth_m = 0.0  # where the board was switched on; 0 for a board that has not restarted since it is heard
        self._newest_ms, self._reported_m = -1, 0.0  # the last burst
        self._restarted_ms: int | None = None  # an earlier time than that, which the next burst has to confirm

    def note_burst(self, board_ms: int, reported_m: float) -> None:
        """Take in a burst's time on the board's clock, and its depth. Two bursts in a row of an earlier time: the board has
        restarted, where it was last heard."""
        if self._newest_ms >= 0 and not _follows(board_ms, self._newest_ms):
            before_ms, self._restarted_ms = self._restarted_ms, board_ms
            if before_ms is None or not _follows(board_ms, before_ms):
                return
            self.depth_m += self._reported_m
        self._newest_ms, self._reported_m, self._restarted_ms = board_ms, reported_m, None


def _follows(board_ms: int, before_ms: int) -> bool:
    """True if a time is not earlier than another one, through the clock's wrap too."""
    return (board_ms - before_ms) % MS_WRAPS < MS_WRAPS // 2
