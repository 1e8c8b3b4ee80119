"""Simulated boards that have restarted, at the other end of a link in this process."""

import numpy as np

from shoal.config.experiment import load_experiment
from shoal.frames import Array
from shoal.mavlink.agent_link import CALIBRATE, UNSUPPORTED
from shoal.mavlink.board_port import Link
from sim_bridge.thruster_board.board import ThrusterBoard
from sim_bridge.thruster_board.board_link import BoardLink, Calibrate
from sim_bridge.thruster_board.sensor_zero import BoardStart, ResetCause, SensorZero, Zeros
from tests.robot_agent.obedient_board import Board

POOL = load_experiment("pool")
STEP_NS = 50_000_000
STILL, DEEP = np.zeros(4), np.array([0.0, 0.0, 0.5, 0.0])
RESTARTED = BoardStart(int(ResetCause.BROWN_OUT), False, Zeros(0.0))


class RestartedBoard(Link):
    """The reference board 0.5 m under water, which a brown-out has restarted; it makes a step each time that it is read."""

    trouble = advice = ""
    first_word_s = 0.0

    def __init__(self, start: BoardStart = RESTARTED, eta: Array = DEEP) -> None:
        self.board, self.now_ns, self._eta = ThrusterBoard(POOL, 1, 1, zero=SensorZero(start)), 0, eta

    def send(self, data: bytes) -> None:
        self.board.receive(data, self.now_ns)

    def read(self) -> bytes:
        data = b""
        for _ in range(10):  # 5 ms each
            self.now_ns += STEP_NS // 10
            data += self.board.step(self.now_ns, self._eta, STILL, STILL)
        return data

    def wait(self, timeout_s: float) -> None: ...
    def close(self) -> None: ...


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
