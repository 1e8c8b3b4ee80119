"""A wire to a C board in simulated time, as the conformance run and other probes use it."""

from collections.abc import Callable, Iterator
from typing import Protocol

from shoal.mavlink.signing import Key
from sim_bridge.board_conformance.probe import BoardProbe
from sim_bridge.board_conformance.rules import RULES
from sim_bridge.board_conformance.runner import RuleResult, RuleVerdict, examine

STEP_NS = 5_000_000


class SteppedBoard(Protocol):
    """A board that is stepped as time is asked for."""

    def receive(self, data: bytes, now_ns: int) -> bool: ...
    def step(self, now_ns: int) -> bytes: ...


class Bench:
    """A wire to a board that is stepped as time is asked for."""

    def __init__(self, board: SteppedBoard) -> None:
        self.board, self._now_ns = board, 0

    def now_ns(self) -> int:
        return self._now_ns

    def send(self, data: bytes) -> None:
        self.board.receive(data, self._now_ns)

    def receive(self, until_ns: int) -> bytes:
        while True:
            self._now_ns += STEP_NS
            data = self.board.step(self._now_ns)
            if data or self._now_ns >= until_ns:
                return data

    def strangers(self) -> tuple[Callable[[], None], Callable[[], int]] | None:
        return None


def results(board: SteppedBoard, key: Key | None = None) -> Iterator[RuleResult]:
    """The results of the whole run, one by one."""
    return examine(BoardProbe(Bench(board), 1, key, lambda: 1000), False, RULES)


def first_failure(board: SteppedBoard, key: Key | None = None) -> RuleResult | None:
    """The first rule that the board breaks."""
    return next((result for result in results(board, key) if result.verdict is RuleVerdict.FAILED), None)
