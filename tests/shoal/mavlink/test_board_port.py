"""The wire to the board: real sockets and a real pseudo-terminal."""

import errno
import itertools
import os
import pty
import re
import signal
import socket
import termios
import time
from pathlib import Path
from typing import Any

import pytest
import serial

from shoal.errors import ConfigError
from shoal.mavlink.agent_link import AgentLink
from shoal.mavlink.board_address import BOARD_BAUD, DEFAULT_LINK, Address, parse_link
from shoal.mavlink.board_port import READ_DATAGRAMS, SETTLE_S, SerialLink, UdpLink, open_link

FRAME = AgentLink(1).heartbeat()


def read_for(link: UdpLink | SerialLink, wanted: bytes, timeout_s: float = 5.0) -> bytes:
    got = b""
    deadline = time.monotonic() + timeout_s
    while wanted not in got and time.monotonic() < deadline:
        link.wait(0.05)
        got += link.read()
    return got


def hear_board(link: SerialLink, controller: int) -> None:
    """Have a board's frame come, without which nothing is sent."""
    time.sleep(SETTLE_S)
    os.write(controller, FRAME)
    assert FRAME in read_for(link, FRAME)


def test_udp_carries_bytes_both_ways_and_survives_a_board_that_comes_late() -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    link = open_link(f"udp:127.0.0.1:{port}")
    assert isinstance(link, UdpLink)
    try:
        for _ in range(3):  # nobody listens: refused, and not an error
            link.send(b"hello")
            assert link.read() == b""
        for _ in range(3):  # the second one is told of the first
            link.send(b"hello")
        assert "nothing listens on that port" in link.trouble
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as board:
            board.bind(("127.0.0.1", port))
            board.settimeout(5)
            link.read()
            link.send(b"pulses")
            data, peer = board.recvfrom(100)
            assert data == b"pulses"
            board.sendto(b"one", peer)
            board.sendto(b"two", peer)
            assert read_for(link, b"two") == b"onetwo"
            assert link.trouble == ""
    finally:
        link.close()


def test_udp_goes_over_ipv6_too() -> None:
    with socket.socket(socket.AF_INET6, socket.SOCK_DGRAM) as board:
        board.bind(("::1", 0))
        board.settimeout(5)
        link = open_link(f"udp:[::1]:{board.getsockname()[1]}")  # loopback: it needs no key
        assert isinstance(link, UdpLink)
        link.send(b"pulses")
        data, peer = board.recvfrom(100)
        assert data == b"pulses"
        board.sendto(b"one", peer)
        assert read_for(link, b"one") == b"one"
        link.close()


class Answered(socket.socket):
    """A socket that the network has answered, once, why something sent did not arrive (ICMP)."""

    answer: int | None = None

    def recv(self, size: int, flags: int = 0, /) -> bytes:
        if self.answer is not None:
            number, self.answer = self.answer, None
            raise OSError(number, os.strerror(number))
        return super().recv(size, flags)


@pytest.mark.parametrize("number", [errno.EHOSTUNREACH, errno.ENETUNREACH, errno.ENOPROTOOPT])
def test_network_errors_about_a_datagram_do_not_raise(number: int) -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as board:
        board.bind(("127.0.0.1", 0))
        link = UdpLink(*board.getsockname())
        answered = Answered(fileno=link.socket.detach())
        link.socket = answered
        try:
            board.sendto(b"burst", answered.getsockname())
            answered.answer = number
            assert link.read() == b""
            assert link.trouble == os.strerror(number)
            assert read_for(link, b"burst") == b"burst"
            assert link.trouble == ""
        finally:
            link.close()


def test_a_frame_from_before_the_opening_is_no_word_of_a_board_that_it_reset(tmp_path: Path) -> None:
    """Nothing is sent until it speaks again: its bootloader would take that for programming."""
    plug = tmp_path / "board"
    for _ in range(10):  # on a busy machine the frame may be read too late to be one from before
        controller, device = pty.openpty()
        plug.symlink_to(os.ttyname(device))
        os.set_blocking(controller, False)
        begin_s = time.monotonic()
        link = open_link(f"serial:{plug}:57600")
        assert isinstance(link, SerialLink)
        try:
            os.write(controller, FRAME)
            assert FRAME in read_for(link, FRAME)
            if time.monotonic() - begin_s > SETTLE_S:
                continue
            link.send(b"pulses")
            with pytest.raises(BlockingIOError):
                os.read(controller, 100)
            hear_board(link, controller)
            link.send(b"pulses")
            assert os.read(controller, 100) == b"pulses"
            return
        finally:
            link.close()
            os.close(controller)
            os.close(device)
            plug.unlink()
    pytest.fail("each frame was read too late")


def test_only_an_open_serial_port_asks_for_patience_with_a_boards_first_word(tmp_path: Path) -> None:
    """Its opening may have reset the board; no one comes to speak behind a port that is not there, and UDP resets nobody."""
    bootloader_s, start_s = 5.0, 2.0  # the end of a programming session, and the firmware's start
    controller, device = pty.openpty()
    link = open_link(f"serial:{os.ttyname(device)}")
    assert link.first_word_s >= bootloader_s + start_s
    link.close()
    os.close(controller)
    os.close(device)
    assert open_link(f"serial:{tmp_path / 'unplugged'}").first_word_s == 0.0
    assert open_link("udp:127.0.0.1:9").first_word_s == 0.0


def test_serial_carries_bytes_both_ways_and_comes_back_after_an_unplug(tmp_path: Path) -> None:
    plug = tmp_path / "board"
    controller, device = pty.openpty()
    plug.symlink_to(os.ttyname(device))
    link = open_link(f"serial:{plug}:57600")
    assert isinstance(link, SerialLink)
    try:
        hear_board(link, controller)
        link.send(b"pulses")
        assert os.read(controller, 100) == b"pulses"
        os.write(controller, b"burst")
        assert b"burst" in read_for(link, b"burst")
        os.close(controller)
        os.close(device)
        plug.unlink()
        for _ in range(3):  # unplugged: silence, and not an error
            link.send(b"x")
            assert link.read() == b""
        assert link.trouble == f"{plug}: not there; is the board plugged in, and powered?"
        controller, device = pty.openpty()
        plug.symlink_to(os.ttyname(device))
        link.read()
        hear_board(link, controller)
        link.send(b"again")
        assert os.read(controller, 100) == b"again"
        assert link.trouble == ""
        second = open_link(f"serial:{plug}")
        assert "in use by another program" in second.trouble
        second.close()
    finally:
        link.close()


def test_sending_to_a_board_that_does_not_read_does_not_block() -> None:
    controller, device = pty.openpty()
    link = open_link(f"serial:{os.ttyname(device)}")
    assert isinstance(link, SerialLink)
    hear_board(link, controller)
    signal.signal(signal.SIGALRM, lambda *_: pytest.fail("it waits for the board"))
    signal.alarm(10)
    try:
        for _ in range(4000):
            link.send(bytes(50))
        assert link.trouble == ""
        got = b""
        while b"again" not in got:
            got = got[-4:] + os.read(controller, 4096)
            link.send(b"again")
    finally:
        signal.alarm(0)
        signal.signal(signal.SIGALRM, signal.SIG_DFL)
        link.close()
        os.close(controller)
        os.close(device)


@pytest.mark.parametrize("baud", [57600, 250_001])
def test_a_board_that_is_pulled_out_while_its_port_is_being_opened_is_just_not_there(
    baud: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    plug, ask = tmp_path / "board", termios.tcgetattr
    controller, device = pty.openpty()
    plug.symlink_to(os.ttyname(device))
    os.close(device)

    def asked_and_pulled(port: int) -> list[Any]:
        answer = ask(port)
        os.close(controller)
        return answer

    monkeypatch.setattr(termios, "tcgetattr", asked_and_pulled)
    link = open_link(f"serial:{plug}:{baud}")
    monkeypatch.undo()
    try:
        assert link.trouble
        link.send(b"x")
        assert link.read() == b""
    finally:
        link.close()


def test_a_board_that_is_pulled_out_while_a_rate_is_being_tried_is_just_not_there(monkeypatch: pytest.MonkeyPatch) -> None:
    controller, device = pty.openpty()
    link = open_link(f"serial:{os.ttyname(device)}:57600")
    os.close(device)
    pulled = list[int]()

    def pulled_and_flushed(port: serial.Serial) -> None:
        os.close(controller)
        pulled.append(controller)
        termios.tcflush(port.fileno(), termios.TCIFLUSH)

    monkeypatch.setattr(serial.Serial, "reset_input_buffer", pulled_and_flushed)
    time.sleep(SETTLE_S)
    try:
        deadline = time.monotonic() + 10.0
        while not pulled and time.monotonic() < deadline:
            os.write(controller, b"no frame")
            link.wait(0.05)
            link.read()
        assert pulled and link.trouble
        assert link.read() == b""
    finally:
        link.close()


def test_a_wrong_address_is_explained() -> None:
    for address in ("udp:127.0.0.1", "udp:host:99999", "tcp:1.2.3.4:5", "", "serial:"):
        with pytest.raises(ConfigError, match=r"allowed: udp:HOST:PORT or serial:DEVICE"):
            open_link(address)
    for baud in (0, 299, 12_000_001):
        with pytest.raises(ConfigError, match=rf"--port 'serial:/dev/x:{baud}': no baud rate \(allowed: 300 to 12000000\)"):
            parse_link(f"serial:/dev/x:{baud}", "--port")
    assert parse_link("serial:/dev/x:300") == Address("serial", "/dev/x", 300)
    assert parse_link("serial:/dev/serial/by-id/usb:1-port") == Address("serial", "/dev/serial/by-id/usb:1-port", 250_000)


def test_a_frame_that_the_port_takes_half_of_is_not_cut(monkeypatch: pytest.MonkeyPatch) -> None:
    ours, theirs = pty.openpty()
    link, real = SerialLink(os.ttyname(theirs), 115200), os.write
    takes = [3, 0, 2, 100, 100, 100]  # bytes at each call; 0: the port is full

    def write(descriptor: int, data: bytes) -> int:
        taken = takes.pop(0)
        if taken == 0:
            raise BlockingIOError
        return real(descriptor, data[:taken])

    try:
        hear_board(link, ours)
        monkeypatch.setattr("shoal.mavlink.board_port.os.write", write)
        link.send(b"one two ")
        link.send(b"is dropped whole ")
        link.send(b"three ")
        assert takes == [100]
        monkeypatch.undo()
        wanted, come = b"one two three ", b""
        while len(come) < len(wanted):  # the terminal hands on what each write left in a read of its own
            come += os.read(ours, 100)
        assert come == wanted
    finally:
        link.close()
        os.close(ours)
        os.close(theirs)


def test_a_flood_of_datagrams_does_not_hold_up_a_read() -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as board:
        board.bind(("127.0.0.1", 0))
        link = UdpLink("127.0.0.1", board.getsockname()[1])
        try:
            flood = itertools.count()

            class EndlessSocket(socket.socket):
                def recv(self, size: int, flags: int = 0, /) -> bytes:
                    next(flood)
                    return b"x"

            link.socket.close()
            link.socket = EndlessSocket(socket.AF_INET, socket.SOCK_DGRAM)
            assert len(link.read()) == next(flood) == READ_DATAGRAMS
        finally:
            link.close()


def test_firmware_manual_and_links_have_one_baud_rate() -> None:
    root = Path(__file__).parents[3]
    built = re.findall(r"^BAUD \?= (\d+)", (root / "firmware" / "Makefile").read_text(), re.M)
    pages = [root / "README.md", root / "firmware" / "README.md", *(root / "docs").glob("*.md")]
    named = [rate for page in pages for rate in re.findall(r"serial:/dev/\S+?:(\d+)\b", page.read_text())]
    assert len(named) > 5
    assert {*built, *named} == {str(BOARD_BAUD)} == {str(parse_link(DEFAULT_LINK).number)}
