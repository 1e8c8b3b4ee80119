"""A board of a firmware that says nothing about how its life began."""

from shoal.mavlink.agent_link import CALIBRATE, UNSUPPORTED
from sim_bridge.thruster_board.board_link import BoardLink, Calibrate
from tests.robot_agent.obedient_board import Board


class SilentAboutStarts(BoardLink):
    """A board's end that reports nothing about how its life began."""

    def heartbeat(self, armed: bool, healthy: bool, hil: bool = False, status: int = 0) -> bytes:
        return super().heartbeat(armed, healthy, hil, status)


class Switched(Board):
    """A board that took its zero `zero_m` deep, reports nothing about it, and knows no command to confirm it."""

    def __init__(self, zero_m: float) -> None:
        super().__init__()
        self._link, self._zero_m = SilentAboutStarts(1), zero_m

    def send(self, data: bytes) -> None:
        for asker, event in self._link.receive(data, self._ms * 1_000_000):
            if isinstance(event, Calibrate):
                self._answers += self._link.acknowledge(asker, CALIBRATE, UNSUPPORTED)

    def read(self) -> bytes:
        burst = super().read()
        deep = self._link.pressure(self._ms, 0.3 - self._zero_m) + self._link.attitude(self._ms, 0.2, 0.01)
        return burst + deep
