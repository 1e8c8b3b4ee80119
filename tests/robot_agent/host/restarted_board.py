"""A simulated board that has restarted, at the other end of a link in this process."""

import numpy as np

from shoal.config.experiment import load_experiment
from shoal.frames import Array
from shoal.mavlink.board_port import Link
from sim_bridge.thruster_board.board import ThrusterBoard
from sim_bridge.thruster_board.sensor_zero import BoardStart, ResetCause, SensorZero, Zeros

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
