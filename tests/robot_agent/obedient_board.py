"""A thruster board on a link in memory, for tests of the robot's program."""

import math

from shoal.config.experiment import load_experiment
from shoal.mavlink.board_port import Link
from sim_bridge.thruster_board.board_link import BoardLink, ListParameters
from sim_bridge.thruster_board.parameters import Parameters

ME = 1


class Board(Link):
    """A board that puts out what it is told, is armed when asked, and has the parameters of the shipped experiments."""

    def __init__(self) -> None:
        self._link, self._ms, self._armed, self._pulses_us = BoardLink(ME), 0, False, (1500,) * 8
        self._answers = b""

    def send(self, data: bytes) -> None:
        for _, event in self._link.receive(data, self._ms * 1_000_000):
            self._armed = getattr(event, "arm", self._armed)
            self._pulses_us = getattr(event, "pulses_us", self._pulses_us)
            if isinstance(event, ListParameters):
                self._list_parameters()

    def _list_parameters(self) -> None:
        parameters = Parameters.of(load_experiment("pool"))
        count = len(parameters.table)
        for index, row in enumerate(parameters.table):
            self._answers += self._link.parameter(row.name, parameters[row.name], count, index)

    def read(self) -> bytes:
        self._ms += 50
        answers, self._answers = self._answers, b""
        return b"".join(
            [
                answers,
                self._link.imu(self._ms, (0.1, -0.2, -9.8), 0.01),
                self._link.pressure(self._ms, 0.3 + 0.001 * math.sin(self._ms)),
                self._link.servo_output(self._ms * 1000, self._pulses_us),
                self._link.status(12.1, 0, 0, 0),
                self._link.heartbeat(self._armed, True),
                self._link.attitude(self._ms, 0.2, 0.01),
            ]
        )

    def wait(self, timeout_s: float) -> None: ...
    def close(self) -> None: ...
