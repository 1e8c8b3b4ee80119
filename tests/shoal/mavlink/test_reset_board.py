"""A board that the opening of its port resets: the host is silent until the board has spoken, and finds its baud rate."""

import logging
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from shoal.mavlink.agent_link import AgentLink
from shoal.mavlink.board_port import SerialLink, open_link
from tests.shoal.mavlink.resetting_board import ResettingBoard

pytestmark = pytest.mark.real_time


@pytest.fixture
def mega(tmp_path: Path) -> Iterator[ResettingBoard]:
    board = ResettingBoard(tmp_path / "board")
    try:
        yield board
    finally:
        board.close()


class Host:
    """An agent's end: it sends overrides at 20 Hz, come what may."""

    def __init__(self, board: ResettingBoard, baud: int = 250_000) -> None:
        link = open_link(f"serial:{board.path}:{baud}")
        assert isinstance(link, SerialLink)
        self.link, self.mavlink = link, AgentLink(1)

    def run(self, seconds: float, until_burst: bool = False, until_armed: bool = False) -> float:
        """Fly for so long, or until there is a burst, or the board is armed; returns the time that it took."""
        begin_s, before = time.monotonic(), self.mavlink.telemetry.board_ms
        while (now_s := time.monotonic()) < begin_s + seconds:
            self.link.send(self.mavlink.pulses((1500,) * 8))
            self.link.wait(0.01)
            time.sleep(0.04)
            self.mavlink.receive(self.link.read(), time.monotonic_ns())
            telemetry = self.mavlink.telemetry
            if (until_burst and telemetry.board_ms != before) or (until_armed and telemetry.armed):
                break
        return now_s - begin_s


def test_opening_the_port_holds_no_board_in_its_bootloader(mega: ResettingBoard) -> None:
    host = Host(mega)
    try:
        assert host.run(4.0, until_burst=True) < 1.5
        assert (mega.resets, mega.bytes_in_bootloader) == (1, 0)
        host.run(0.2)
        host.link.send(host.mavlink.arm(True))
        host.run(2.0, until_armed=True)
        assert host.mavlink.telemetry.armed  # so overrides have arrived
        assert host.link.trouble == ""
    finally:
        host.link.close()
    time.sleep(0.05)
    again = Host(mega)  # DTR has stayed up: no reset
    try:
        again.run(2.0, until_burst=True)
        assert mega.resets == 1
    finally:
        again.link.close()


@pytest.mark.slow
def test_a_reset_under_way_ends_the_hosts_words_until_the_board_speaks(tmp_path: Path) -> None:
    board = ResettingBoard(tmp_path / "board")
    host = Host(board)
    try:
        host.run(4.0, until_burst=True)
        board.reset()
        host.run(6.0, until_burst=True)
        assert board.runs  # the first overrides began a session; it ends, for no more come
        byte_count = board.bytes_in_bootloader
        assert byte_count < 15 * 40
        host.run(0.2)
        assert board.bytes_in_bootloader == byte_count
    finally:
        host.link.close()
        board.close()


@pytest.mark.slow
def test_a_board_that_never_speaks_is_told_nothing_and_explained(mega: ResettingBoard) -> None:
    mega.is_powered = False
    host = Host(mega)
    try:
        assert host.link.trouble == ""  # it may be in its bootloader yet
        host.run(2.2)
        assert "not a byte has come, and nothing is sent before it speaks" in host.link.trouble
        mega.is_powered = True
        host.run(4.0, until_burst=True)
        assert host.link.trouble == "" and mega.bytes_in_bootloader == 0
    finally:
        host.link.close()


@pytest.mark.parametrize("baud", [pytest.param(57_600, marks=pytest.mark.slow), 250_000])
def test_the_rate_of_a_board_is_found_by_listening_alone(baud: int, tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    board = ResettingBoard(tmp_path / "board", baud=baud)
    host = Host(board, baud=115_200)
    try:
        with caplog.at_level(logging.WARNING):
            assert host.run(8.0, until_burst=True) < 6.0
        assert board.host_baud == baud and board.bytes_in_bootloader == 0
        assert f"the board speaks at {baud} baud, not at 115200 as configured" in host.link.advice
        assert f"set the link to serial:{board.path}:{baud}" in host.link.advice
        assert host.link.advice in caplog.text
        caplog.clear()
        board.reset()
        with caplog.at_level(logging.WARNING):
            host.run(6.0, until_burst=True)
        assert caplog.text == ""  # it is known by now
    finally:
        host.link.close()
        board.close()


@pytest.mark.slow
def test_noise_at_every_rate_is_said_to_be_no_board(tmp_path: Path) -> None:
    board = ResettingBoard(tmp_path / "board", baud=1)
    host = Host(board)
    try:
        host.run(5.0)
        assert "what comes is no MAVLink 2 at any of 250000, 115200, 57600" in host.link.trouble
        assert board.bytes_in_bootloader == 0
    finally:
        host.link.close()
        board.close()
