"""The gate before a real board: whatever bytes an agent sends, HIL_MODE and HIL_OUTPUTS stay as they were."""

import numpy as np
from hypothesis import example, given, settings
from hypothesis import strategies as st

from shoal.config.experiment import load_experiment
from shoal.mavlink.agent_link import AgentLink
from shoal.mavlink.board_port import Link
from shoal.mavlink.parameters import ParameterClient
from sim_bridge.node.hil_board import HilBoard
from sim_bridge.thruster_board.board import ThrusterBoard

EXPERIMENT = load_experiment("pool")
STILL = np.zeros(4)
STEP_NS = 5_000_000
TORN = bytes([0xFD, 255, 0, 0, 0, 1, 190]) + (131).to_bytes(3, "little")  # a header that promises 255 bytes more


class Cable(Link):
    """The link to a board in HIL mode, which steps with the simulator."""

    trouble = ""

    def __init__(self) -> None:
        self.board, self.now_ns, self._to_computer = ThrusterBoard(EXPERIMENT, 1, 1), 0, b""
        self.board.receive(ParameterClient(1).set("HIL_MODE", 1.0), 0)
        self.hil, self.agent = HilBoard(EXPERIMENT, 1, 1, "test", self, None), AgentLink(1)

    def send(self, data: bytes) -> None:
        self.board.receive(data, self.now_ns)

    def read(self) -> bytes:
        data, self._to_computer = self._to_computer, b""
        return data

    def wait(self, timeout_s: float) -> None:
        raise AssertionError("nothing waits here")

    def close(self) -> None:
        """Do nothing."""

    def run(self, steps: int) -> None:
        for _ in range(steps):
            self.now_ns += STEP_NS
            self._to_computer += self.board.step(self.now_ns, STILL, STILL, STILL)
            data = self.hil.step(self.now_ns, STILL, STILL, STILL, 12.0, STILL)
            self.agent.receive(data, self.now_ns)


PIECES = st.sampled_from([TORN, b"\xfd", b"\xfd\xff", b"other", "mode", "outputs", "arm"])


@given(st.lists(PIECES, max_size=8), st.integers(1, 300))
@settings(max_examples=25)
@example([TORN, "outputs"], 300)
@example([TORN[:7], "mode", "mode"], 5)
def test_no_bytes_change_what_keeps_the_thrusters_still(pieces: list[bytes | str], chunk: int) -> None:
    cable, client = Cable(), ParameterClient(1)
    cable.run(300)
    assert cable.agent.telemetry.hil
    frames = {"mode": ("HIL_MODE", 0.0), "outputs": ("HIL_OUTPUTS", 1.0)}
    data = b""
    for piece in pieces:
        if isinstance(piece, bytes):
            data += piece
        else:
            data += client.set(*frames[piece]) if piece in frames else cable.agent.arm(True)
    for at in range(0, len(data), chunk):
        cable.hil.receive(data[at : at + chunk], cable.now_ns)
        cable.run(1)
    cable.run(40)
    for _ in range(20):
        cable.hil.receive(cable.agent.pulses((1500,) * 8) + cable.agent.arm(True), cable.now_ns)
        cable.run(2)
    assert (cable.board.rules.parameters["HIL_MODE"], cable.board.rules.parameters["HIL_OUTPUTS"]) == (1.0, 0.0)
    assert cable.board.armed  # the rest goes through
