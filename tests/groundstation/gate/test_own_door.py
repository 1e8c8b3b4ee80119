"""A station's own door: requests through a real socket, whatever else is connected there."""

import socket
import struct
from collections.abc import Iterator
from contextlib import ExitStack, closing
from pathlib import Path

import pytest

from groundstation.gate import own_door
from groundstation.gate.own_door import MOST_BYTES, DoorTransport, OwnDoor, opens
from shoal.bus.bus import Bus
from shoal.bus.memory_transport import MemoryHub, MemoryTransport
from shoal.messages.codec import Header
from shoal.messages.messages import Command, CommandKind, Reply

pytestmark = pytest.mark.real_time


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "d.sock"


@pytest.fixture
def station(path: Path) -> Iterator[Bus]:
    """A station that takes a STOP, and names the order that it refuses."""

    def answer(header: Header, command: Command) -> Reply:
        return Reply(0, command.order is CommandKind.STOP, command.order.name)

    with Bus(MemoryTransport(MemoryHub())) as bus, closing(OwnDoor(path, bus.answer)):
        bus.serve(0, answer)
        yield bus


def ask(path: Path, order: CommandKind = CommandKind.STOP, fleet: str = "shoal", timeout_s: float = 5.0) -> Reply:
    with Bus(DoorTransport([path]), fleet) as bus:
        return bus.command(Command(order, 0), 1, timeout_s)


def test_a_request_is_answered_through_the_door(station: Bus, path: Path) -> None:
    assert opens(path)
    assert ask(path).accepted
    refused = ask(path, CommandKind.HOLD)
    assert (refused.accepted, refused.reason) == (False, "HOLD")


def test_a_request_to_another_fleet_or_robot_is_not_answered(station: Bus, path: Path) -> None:
    assert ask(path, fleet="other", timeout_s=0.3).silent
    with Bus(DoorTransport([path])) as bus:
        assert bus.command(Command(CommandKind.STOP, 1), 1, 0.3).silent


@pytest.mark.parametrize(
    "data",
    [
        b"",
        b"GET / HTTP/1.1\r\n\r\n",
        struct.pack("!III", 1, MOST_BYTES, 0) + b"k",
        struct.pack("!III", 2**32 - 1, 2**32 - 1, 2**32 - 1),
        struct.pack("!III", 2, 3, 4) + b"\xff\xfe" + bytes(7),
        struct.pack("!III", 21, 5, 4) + b"shoal/robot/0/command" + bytes(3),
    ],
    ids=str,
)
def test_other_bytes_hold_up_nobody(station: Bus, path: Path, data: bytes) -> None:
    with ExitStack() as stack:
        for _ in range(20):
            other = stack.enter_context(socket.socket(socket.AF_UNIX))
            other.connect(str(path))
            other.sendall(data)
        assert ask(path).accepted
        other.settimeout(2 * own_door.REQUEST_S + 5.0)
        assert other.recv(1) == b""  # in the end it is closed


def test_the_first_of_several_doors_that_opens_is_taken(station: Bus, path: Path, tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    with Bus(DoorTransport([tmp_path / "missing", tmp_path / "file", path])) as bus:
        assert bus.command(Command(CommandKind.STOP, 0), 1, 5.0).accepted


def test_a_door_that_is_closed_is_gone(path: Path) -> None:
    with Bus(MemoryTransport(MemoryHub())) as bus:
        door = OwnDoor(path, bus.answer)
        assert ask(path, timeout_s=0.3).silent  # nobody serves yet
        door.close()
    assert not path.exists() and not opens(path)
    assert ask(path, timeout_s=0.3).silent


def test_a_station_that_hangs_is_silent_and_is_there(path: Path) -> None:
    with closing(socket.socket(socket.AF_UNIX)) as hung, ExitStack() as stack:
        hung.bind(str(path))
        hung.listen(1)
        assert opens(path)
        assert ask(path, timeout_s=0.3).silent
        for _ in range(3):  # its queue is full
            waiting = stack.enter_context(socket.socket(socket.AF_UNIX))
            waiting.setblocking(False)
            waiting.connect_ex(str(path))
        assert opens(path)
        assert ask(path, timeout_s=0.3).silent


def test_a_door_carries_requests_only(path: Path) -> None:
    with pytest.raises(TypeError, match="takes requests only"):
        Bus(DoorTransport([path])).announce("operator")
