"""The C board with its memory, whose bytes take 3.4 ms each and whose power fails at any of them: no order counts twice, no
setting is torn."""

import ctypes
import random
from collections.abc import Iterator

import pytest

from shoal.mavlink.agent_link import CHANNELS, IGNORED, AgentLink
from shoal.mavlink.parameters import ParameterClient
from shoal.mavlink.signing import Key
from tests.firmware.library import PARAMETERS, FirmwareBoard, built, load

KEY = Key(bytes(range(1, 33)))
EEPROM_BYTES, SLOTS, SLOT_BYTES, BYTE_US = 4096, 6, 256, 3400
NEVER = 2**32 - 2
NEUTRAL, AHEAD = (1500,) * 4 + (IGNORED,) * 4, (1900,) * 4 + (IGNORED,) * 4


class StoredBoard(FirmwareBoard):
    """A C board with a memory in which each byte takes a pass."""

    def __init__(self, library: ctypes.CDLL, eeprom: bytes) -> None:
        super().__init__(library)
        self._memory = library.library_eeprom()
        ctypes.memmove(self._memory, eeprom, EEPROM_BYTES)
        library.library_cut(NEVER, 0)
        self._store = ctypes.create_string_buffer(library.library_store_bytes())
        library.library_boot(self._board, self._store, 1)
        self.now_us = 0

    @property
    def eeprom(self) -> bytes:
        return ctypes.string_at(self._memory, EEPROM_BYTES)

    def cut(self, write: int, value: int) -> None:
        """The power fails in a write, counted from now on; nothing is written after it."""
        self._library.library_cut(write, value)

    def put(self, data: bytes) -> None:
        self._library.library_put(self._board, data, len(data), self.now_us)

    def go(self, passes: int = 1) -> None:
        """Let time pass, of which the memory takes a byte with each pass."""
        for _ in range(passes):
            self._library.library_pass(self._board, self._store, self.now_us)
            self.now_us += BYTE_US

    def value(self, name: str) -> float:
        return float(self._library.library_parameter(self._board, PARAMETERS.index[name]))

    def output(self) -> bytes:
        count = self._library.library_take_output(self._board, self._bytes)
        return self._bytes.raw[:count]


@pytest.fixture(scope="module")
def library() -> ctypes.CDLL:
    return load(built("build/libboard.so"))


@pytest.fixture(scope="module")
def keyed(library: ctypes.CDLL) -> bytes:
    """The memory of a board that has been given a key."""
    board = StoredBoard(library, b"\xff" * EEPROM_BYTES)
    board.put(ParameterClient(1).give(KEY, 500))
    board.go(700)
    return board.eeprom


class OrderSender:
    """The robot's computer, which remembers what it has sent."""

    def __init__(self, board: StoredBoard, stamp: int) -> None:
        self.board, self.stamp, self.sent = board, stamp, list[bytes]()
        self.link = AgentLink(1, KEY, lambda: self.stamp)
        self.client = ParameterClient(1, KEY, lambda: self.stamp)

    def say(self, frame: bytes) -> None:
        self.sent.append(frame)
        self.board.put(frame)
        self.stamp += 10


def test_an_order_is_not_obeyed_before_its_timestamp_is_kept(library: ctypes.CDLL, keyed: bytes) -> None:
    """At each phase of a write of older timestamps the board is armed, its power fails, and all is said again."""
    armed = 0
    for phase in range(60):
        board = StoredBoard(library, keyed)
        computer = OrderSender(board, 10_000)
        computer.say(computer.client.set("SLEW_US_S", 4000.0 + phase))  # asks for a write of the timestamps
        for _ in range(phase):
            board.go()
        computer.say(computer.link.pulses(list(NEUTRAL)))
        board.go()
        computer.say(computer.link.arm(True))
        for passes in range(400):
            board.go()
            board.output()
            if passes % 10 == 0:
                computer.say(computer.link.pulses(list(NEUTRAL)))
            if board.armed:
                break
        armed += board.armed
        again = StoredBoard(library, board.eeprom)
        for frame in computer.sent:
            again.put(frame)
            again.go(25)  # time to keep a timestamp, and an override stays young
            assert not again.armed, phase
    assert armed > 40  # the first ones come while the order before waits: such a one has to be sent again


def test_an_override_behind_orders_that_wait_is_taken_at_once(library: ctypes.CDLL, keyed: bytes) -> None:
    board = StoredBoard(library, keyed)
    computer = OrderSender(board, 10_000)
    computer.say(computer.link.pulses(list(NEUTRAL)))
    computer.say(computer.link.arm(True))
    for passes in range(100):
        board.go()
        if passes % 10 == 0:
            computer.say(computer.link.pulses(list(NEUTRAL)))
    assert board.armed
    for _ in range(5):
        computer.say(computer.client.set("SLEW_US_S", 3000.0))
        board.go()
    computer.say(computer.link.pulses(list(AHEAD)))
    begun_us = board.now_us
    while board.armed:
        board.go()
        board.step_rules(board.now_us * 1000)
    assert board.now_us - begun_us <= PARAMETERS.age_ns // 1000 + BYTE_US


def test_a_disarming_withdraws_an_arming_that_waits(library: ctypes.CDLL, keyed: bytes) -> None:
    board = StoredBoard(library, keyed)
    computer = OrderSender(board, 10_000)
    computer.say(computer.link.pulses(list(NEUTRAL)))
    computer.say(computer.link.arm(True))
    board.go()
    assert not board.armed  # it waits
    computer.say(computer.link.arm(False))
    for passes in range(100):
        board.go()
        if passes % 10 == 0:
            computer.say(computer.link.pulses(list(NEUTRAL)))
        assert not board.armed


def cuts(writes: int) -> Iterator[tuple[int, int]]:
    """Each write at which the power fails, and what the byte then is."""
    draw = random.Random(1)
    for write in range(writes):
        yield write, draw.choice([0xFF, 0x00, draw.randrange(256)])


def test_settings_are_the_old_or_the_new_wherever_the_power_fails(library: ctypes.CDLL, keyed: bytes) -> None:
    values = set()
    for write, value in cuts(SLOT_BYTES + 40):
        board = StoredBoard(library, keyed)
        computer = OrderSender(board, 10_000)
        computer.say(computer.client.set("SLEW_US_S", 4321.0))
        board.cut(write, value)
        board.go(500)
        again = StoredBoard(library, board.eeprom)
        values.add(again.value("SLEW_US_S"))
        again.put(AgentLink(1).pulses(list(NEUTRAL)))  # without the key, which is never lost
        again.go()
        again.step_rules(again.now_us * 1000)
        assert again.arm(True, again.now_us * 1000) != 0, (write, value)
    assert values == {PARAMETERS["SLEW_US_S"], 4321.0}


def test_a_new_board_can_be_set_wherever_the_power_failed_in_its_first_write(library: ctypes.CDLL) -> None:
    for write, value in cuts(2 * SLOT_BYTES):
        board = StoredBoard(library, b"\xff" * EEPROM_BYTES)
        board.put(ParameterClient(1).set("SLEW_US_S", 4321.0))
        board.cut(write, value)
        board.go(600)
        again = StoredBoard(library, board.eeprom)
        assert again.value("SLEW_US_S") in (PARAMETERS["SLEW_US_S"], 4321.0)
        again.put(ParameterClient(1).set("SLEW_US_S", 1234.0))
        again.go()
        assert again.value("SLEW_US_S") == 1234.0, (write, value)


def test_a_board_whose_settings_cannot_be_read_takes_nothing(library: ctypes.CDLL, keyed: bytes) -> None:
    damaged = bytearray(keyed)
    for slot in range(SLOTS):
        if any(byte != 0xFF for byte in damaged[slot * SLOT_BYTES : (slot + 1) * SLOT_BYTES]):
            damaged[slot * SLOT_BYTES + 5] ^= 1  # in the key
    board = StoredBoard(library, bytes(damaged))
    for key in (None, KEY):
        client, link = ParameterClient(1, key, lambda: 100_000), AgentLink(1, key, lambda: 100_000)
        board.put(client.set("SLEW_US_S", 1234.0))
        board.go(100)
        board.put(link.pulses(list(NEUTRAL)))
        board.go()
        assert board.arm(True, board.now_us * 1000) != 0
    assert board.value("SLEW_US_S") == PARAMETERS["SLEW_US_S"]
    assert board.texts() == [(2, "settings cannot be read: takes nothing"), *[(4, "not armed: no override is arriving")] * 2]
    assert len(NEUTRAL) == CHANNELS
