"""Depth at which a thruster board took its zero, by its own measurements before that. Pure.

For boards that do not report how their lives begin. Such a board takes the pressure at which it is switched on for that at the
surface; if it restarts under water, each depth that it reports later is too small by the depth there. A board that does report
it (docs/board.md, "After a reset") keeps its zero, and says when it is in question: nothing is guessed about it.
"""

MS_WRAPS = 2**32  # `time_boot_ms` begins at 0 again after 49.7 days


class PowerOnDepth:
    """Depth of one board's zero. A board that is switched on again in air has a right one again."""

    def __init__(self) -> None:
        self._guess_m = 0.0
        self._reports_start = False
        self._newest_ms, self._reported_m = -1, 0.0  # the last burst
        self._restarted_ms: int | None = None  # an earlier time than that, which the next burst has to confirm

    @property
    def depth_m(self) -> float:
        """Depth of the zero; 0 for a board that has not restarted since it is heard, or that reports how its lives begin."""
        return 0.0 if self._reports_start else self._guess_m

    def set_depth(self, depth_m: float) -> None:
        """Take the zero to be at this depth, whatever was seen of restarts."""
        self._guess_m = depth_m

    def note_start_report(self) -> None:
        """Take in that the board reports how its lives begin."""
        self._reports_start = True

    def note_burst(self, board_ms: int, reported_m: float) -> None:
        """Take in a burst's time on the board's clock, and its depth. Two bursts in a row of an earlier time: the board has
        restarted, where it was last heard."""
        if self._newest_ms >= 0 and not _follows(board_ms, self._newest_ms):
            before_ms, self._restarted_ms = self._restarted_ms, board_ms
            if before_ms is None or not _follows(board_ms, before_ms):
                return
            self._guess_m += self._reported_m
        self._newest_ms, self._reported_m, self._restarted_ms = board_ms, reported_m, None


def _follows(board_ms: int, before_ms: int) -> bool:
    """True if a time is not earlier than another one, through the clock's wrap too."""
    return (board_ms - before_ms) % MS_WRAPS < MS_WRAPS // 2
