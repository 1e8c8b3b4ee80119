"""The C board counts no order twice and tears no setting when power fails at any byte that its memory writes.

A byte takes 3.4 ms.
"""

import ctypes
import itertools
import random
import struct
from collections.abc import Iterator

import pytest
from pymavlink.dialects.v20 import common as dialect
from pymavlink.generator.mavcrc import x25crc

from shoal.mavlink.agent_link import CHANNELS, IGNORED, STANDARD_GRAVITY_MPS2, AgentLink
from shoal.mavlink.framing import Sender
from shoal.mavlink.parameters import ParameterClient
from shoal.mavlink.signing import Key
from sim_bridge.plant.sensors import Reading
from sim_bridge.thruster_board.board import HPA_PER_M
from tests.firmware.library import PARAMETERS, CReading, FirmwareBoard, core

KEY, OTHER = Key(bytes(range(1, 33))), Key(bytes(range(2, 34)))
EEPROM_BYTES, SLOTS, SLOT_BYTES, BYTE_US = 4096, 6, 256, 3400
STAMPS_AT, STAMPS_SLOTS, ZEROS_AT, ZEROS_SLOTS, SMALL = 1536, 144, 3840, 16, 16  # bytes of a place of either
BEYOND = b"\xa5" * 16  # what lies behind the memory's state
LOST = (2, "settings cannot be read: takes nothing")
NEVER, VALUES_AT = 2**32 - 2, 37
NEUTRAL, AHEAD = (1500,) * 4 + (IGNORED,) * 4, (1900,) * 4 + (IGNORED,) * 4


class StoredBoard(FirmwareBoard):
    """A C board with a memory in which each byte takes a pass."""

    def __init__(self, library: ctypes.CDLL, eeprom: bytes) -> None:
        super().__init__(library)
        self._memory = library.library_eeprom()
        ctypes.memmove(self._memory, eeprom, EEPROM_BYTES)
        library.library_cut(NEVER, 0)
        self._store = ctypes.create_string_buffer(b"\xee" * library.library_store_bytes() + BEYOND)
        library.library_boot(self._board, self._store, 1)
        self.now_us = 0

    @property
    def eeprom(self) -> bytes:
        assert self._store.raw.endswith(BEYOND + b"\0")
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

    def output(self) -> bytes:
        count = self._library.library_take_output(self._board, self._bytes)
        return self._bytes.raw[:count]


@pytest.fixture(scope="module")
def library() -> ctypes.CDLL:
    return core()


@pytest.fixture(scope="module")
def keyed(library: ctypes.CDLL) -> bytes:
    return keyed_memory(library)


def keyed_memory(library: ctypes.CDLL) -> bytes:
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


@pytest.mark.long
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


@pytest.mark.long
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


def test_an_order_does_not_wait_for_settings_that_are_being_written(library: ctypes.CDLL, keyed: bytes) -> None:
    """They take 256 bytes, the timestamps of an order 16, of which a write may just have begun."""
    board = StoredBoard(library, keyed)
    computer = OrderSender(board, 10_000)
    computer.say(computer.client.set("SLEW_US_S", 4321.0))
    board.go(40)  # the order is obeyed, and its settings are being written
    assert board.value("SLEW_US_S") == 4321.0
    computer.say(computer.link.pulses(list(NEUTRAL)))
    board.go()
    computer.say(computer.link.arm(True))
    board.go(2 * SMALL + 2)
    assert board.armed
    board.go(SLOT_BYTES)
    again = StoredBoard(library, board.eeprom)
    assert again.value("SLEW_US_S") == 4321.0
    for frame in computer.sent:
        again.put(frame)
        again.go(25)
        assert not again.armed


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
    assert board.texts() == [LOST, *[(4, "not armed: no override is arriving")] * 2]
    assert len(NEUTRAL) == CHANNELS


def settled(library: ctypes.CDLL, eeprom: bytes, excess_m: float, rate_radps: float) -> StoredBoard:
    """A board in air with these measurements until its zeros are taken and kept."""
    board = StoredBoard(library, eeprom)
    reading = CReading.of(Reading(0.0, rate_radps, (0.0, 0.0, -STANDARD_GRAVITY_MPS2), excess_m), 12.0)
    for count in range(1, 80):
        board.now_us = count * 20_000
        library.board_measure(board._board, board.now_us, ctypes.byref(reading))  # the C struct, which no method passes on
        library.library_busy(count % 2 == 0)  # a byte is not yet written
        board.go(1)
    library.library_busy(False)
    board.go(40)
    return board


def test_zeros_are_kept_and_the_older_ones_where_the_newest_are_torn(library: ctypes.CDLL) -> None:
    first = settled(library, b"\xff" * EEPROM_BYTES, 0.0, 0.25).eeprom
    for write, value in cuts(14):
        board = StoredBoard(library, first)
        board.cut(write, value)
        again = settled_zeros(library, settled(library, board.eeprom, 0.05, 0.5).eeprom)
        assert again == pytest.approx((0.05, 0.5), abs=0.01), (write, value)


def settled_zeros(library: ctypes.CDLL, eeprom: bytes) -> tuple[float, float]:
    """The zeros that a memory holds: the depth of the surface pressure, and the bias."""
    at = SLOTS * SLOT_BYTES + 144 * 16
    records = []
    for slot in range(16):
        record = eeprom[at + 16 * slot : at + 16 * slot + 16]
        if x25(record[:14]) == struct.unpack("<H", record[14:])[0]:
            records.append(struct.unpack("<Hff", record[:10]))
    _, surface_hpa, bias_radps = max(records)
    return surface_hpa / HPA_PER_M, bias_radps


def x25(data: bytes) -> int:
    """MAVLink's checksum, by pymavlink."""
    return int(x25crc(data).crc)


@pytest.mark.parametrize("at", [0, 7, SLOT_BYTES - 1])
def test_settings_are_lost_where_two_places_are_written_and_none_is_whole(library: ctypes.CDLL, at: int) -> None:
    """One alone is a first record that was torn; timestamps may have been written before it."""
    for places, is_lost in (((), False), ((0,), False), ((5,), False), ((0, 3), True), ((1, 5), True)):
        memory = bytearray(b"\xff" * EEPROM_BYTES)
        for place in places:
            memory[place * SLOT_BYTES + at] = 0x12
        memory[STAMPS_AT] = memory[ZEROS_AT] = 0
        assert (StoredBoard(library, bytes(memory)).texts() == [LOST]) is is_lost, places


def changed_places(before: bytes, after: bytes, base: int, size: int, count: int) -> list[int]:
    """Places of an area that were written; no byte of another area was."""
    changed = [at for at in range(EEPROM_BYTES) if before[at] != after[at]]
    assert all(base <= at < base + size * count for at in changed)
    return sorted({(at - base) // size for at in changed})


def test_each_write_goes_to_the_next_place_of_its_area_and_to_no_other_byte(library: ctypes.CDLL, keyed: bytes) -> None:
    board, stamp = StoredBoard(library, keyed), 10_000
    link = AgentLink(1, KEY, lambda: stamp)
    places: list[int] = []
    for _ in range(STAMPS_SLOTS + 3):
        before = board.eeprom
        stamp += 10
        board.put(link.arm(True))  # refused, as there is no override, but kept
        board.go(40)
        places += changed_places(before, board.eeprom, STAMPS_AT, SMALL, STAMPS_SLOTS)
    assert places == [(places[0] + k) % STAMPS_SLOTS for k in range(STAMPS_SLOTS + 3)]
    board, places = StoredBoard(library, b"\xff" * EEPROM_BYTES), []
    for k in range(SLOTS + 3):
        before = board.eeprom
        board.put(ParameterClient(1).set("SLEW_US_S", 1000.0 + k))
        board.go(1200)
        places += changed_places(before, board.eeprom, 0, SLOT_BYTES, SLOTS)
    assert places == [1, 2, 3, 4, 5, 0, 1, 2, 3, 4][: len(places)] and len(places) == SLOTS + 4  # the first one twice


@pytest.fixture
def worn(library: ctypes.CDLL) -> Iterator[None]:
    """A test may wear bytes of the memory."""
    yield
    library.library_wear(0, 0)


@pytest.mark.usefixtures("worn")
@pytest.mark.parametrize("places", [1, 3, STAMPS_SLOTS])
def test_an_order_waits_until_a_place_that_is_not_worn_has_kept_its_timestamp(
    library: ctypes.CDLL, keyed: bytes, places: int
) -> None:
    """Places of timestamps, from the next one on, have a byte that keeps what it has; with all worn nothing is obeyed."""
    board = StoredBoard(library, keyed)
    computer = OrderSender(board, 10_000)
    computer.say(computer.link.arm(True))  # refused, as there is no override, but kept
    board.go(40)
    (newest,) = changed_places(keyed, board.eeprom, STAMPS_AT, SMALL, STAMPS_SLOTS)
    all_of_them = places == STAMPS_SLOTS
    first = 0 if all_of_them else newest + 1
    library.library_wear(STAMPS_AT + first * SMALL + 2, STAMPS_AT + (first + places - 1) * SMALL + 3)
    board.texts()
    computer.say(computer.link.pulses(list(NEUTRAL)))
    computer.say(computer.link.arm(True))
    for passes in range(20 * SMALL * places):
        if passes % 10 == 0:
            computer.say(computer.link.pulses(list(NEUTRAL)))
        board.go()
        board.output()
    assert board.armed is not all_of_them
    assert ((2, "memory is worn: it keeps nothing") in board.texts()) is all_of_them
    again = StoredBoard(library, board.eeprom)
    for frame in computer.sent:
        again.put(frame)
        again.go(25)
        assert not again.armed


@pytest.mark.usefixtures("worn")
def test_settings_go_on_to_a_place_that_keeps_them(library: ctypes.CDLL, keyed: bytes) -> None:
    board = StoredBoard(library, b"\xff" * EEPROM_BYTES)
    board.put(ParameterClient(1).set("SLEW_US_S", 900.0))
    board.go(1200)
    library.library_wear(2 * SLOT_BYTES, 4 * SLOT_BYTES)
    board.put(ParameterClient(1).set("SLEW_US_S", 1234.0))
    board.go(3000)
    assert StoredBoard(library, board.eeprom).value("SLEW_US_S") == 1234.0


def test_the_table_in_a_record_is_the_checksum_of_all_names(keyed: bytes) -> None:
    names = b"".join(row.name.encode().ljust(16, b"\0") for row in PARAMETERS.table)
    slot = next(slot for slot in range(SLOTS) if keyed[slot * SLOT_BYTES + 2] == 1)
    assert keyed[slot * SLOT_BYTES + VALUES_AT - 2 : slot * SLOT_BYTES + VALUES_AT] == struct.pack("<H", x25(names))


@pytest.mark.parametrize(
    ("name", "value"),
    [(PARAMETERS.table[0].name, -1e9), ("SLEW_US_S", -1.0), ("SLEW_US_S", float("nan")), ("THR_NEUTRAL_US", 1890.0)],
)
def test_kept_parameters_that_no_board_may_have_are_those_of_the_build(
    library: ctypes.CDLL, keyed: bytes, name: str, value: float
) -> None:
    board = StoredBoard(library, rewritten(keyed, VALUES_AT + 4 * PARAMETERS.index[name], struct.pack("<f", value)))
    assert board.value(name) == PARAMETERS[name]


def rewritten(memory: bytes, at: int, data: bytes, slots: range = range(SLOTS)) -> bytes:
    """A memory with other bytes in each of its written records of settings, and with their checksums right."""
    changed = bytearray(memory)
    for base in (slot * SLOT_BYTES for slot in slots):
        if changed[base + 2] == 1:  # it has a key, and so is written
            changed[base + at : base + at + len(data)] = data
            struct.pack_into("<H", changed, base + SLOT_BYTES - 2, x25(bytes(changed[base : base + SLOT_BYTES - 2])))
    return bytes(changed)


def test_values_of_another_table_are_not_taken_but_the_key_is(library: ctypes.CDLL, keyed: bytes) -> None:
    other = rewritten(keyed, VALUES_AT + 4 * PARAMETERS.index["SLEW_US_S"], struct.pack("<f", 4321.0))
    assert StoredBoard(library, other).value("SLEW_US_S") == 4321.0
    board = StoredBoard(library, rewritten(other, VALUES_AT - 2, b"\x12\x34"))
    assert board.value("SLEW_US_S") == PARAMETERS["SLEW_US_S"]
    board.put(ParameterClient(1).set("SLEW_US_S", 1234.0))  # not signed
    board.go(5)
    assert board.value("SLEW_US_S") == PARAMETERS["SLEW_US_S"]


def test_the_newest_record_is_taken_through_the_wrap_of_its_count(library: ctypes.CDLL, keyed: bytes) -> None:
    record = keyed[:SLOT_BYTES] if keyed[2] == 1 else keyed[SLOT_BYTES : 2 * SLOT_BYTES]
    for counts, newest in (((7, 8, 6), 1), ((65535, 0, 65534), 1), ((3, 65535, 2), 0)):
        memory = bytearray(record * 3 + keyed[3 * SLOT_BYTES :])
        written = bytes(memory)
        for slot, count in enumerate(counts):
            written = rewritten(written, 0, struct.pack("<H", count), range(slot, slot + 1))
            value = struct.pack("<f", 1000.0 + slot)
            written = rewritten(written, VALUES_AT + 4 * PARAMETERS.index["SLEW_US_S"], value, range(slot, slot + 1))
        assert StoredBoard(library, written).value("SLEW_US_S") == 1000.0 + newest, counts


def frame_of(stamp: int, link_id: int) -> bytes:
    """A signed request of a stream of its own."""
    return ParameterClient(1, Key(KEY.secret, link_id), lambda: stamp).ask("SLEW_US_S")


def test_streams_older_than_a_minute_or_too_many_are_refused_and_unused_ones_freed(library: ctypes.CDLL, keyed: bytes) -> None:
    def takes(stamp: int, link_id: int) -> bool:
        board.put(frame_of(stamp, link_id))
        board.go(150)  # half a second: then any sequence number counts
        return any(b"SLEW_US_S" in piece for piece in [board.output()])

    board, minute, now = StoredBoard(library, keyed), 6_000_000, 100_000_000
    assert takes(now, 0)
    assert not takes(now, 0)  # again
    assert not takes(now - minute - 1, 1)  # held back for more than a minute
    assert takes(now - minute + 50, 2)
    for link_id in range(3, 17):
        assert takes(now + link_id, link_id), link_id
    assert not takes(now + 20, 17)  # 16 streams are in use
    assert takes(now + minute + 100, 0)
    assert takes(now + minute + 101, 17)  # in the place of one that nobody used for a minute
    assert not takes(now - minute + 1, 2)  # that one


def test_a_minute_of_a_stream_is_exactly_that(library: ctypes.CDLL, keyed: bytes) -> None:
    def takes(stamp: int, link_id: int) -> bool:
        board.put(frame_of(stamp, link_id))
        board.go(150)
        return b"SLEW_US_S" in board.output()

    board, minute, now = StoredBoard(library, keyed), 6_000_000, 100_000_000
    assert takes(now, 0) and takes(now - minute, 1)  # as old as a new stream may be
    assert all(takes(now + k, k) for k in range(2, 16))
    assert takes(now + minute, 0) and takes(now + minute + 1, 21)  # in the place of 1
    assert takes(now + minute + 2, 0) and not takes(now + minute + 3, 22)  # 2 was unused for a minute, and not for more
    assert takes(now + minute + 3, 0) and takes(now + minute + 4, 22)
    assert takes(now + 3 * minute, 0)
    assert all(takes(now + 3 * minute + k, 50 + k) for k in range(1, 16))  # all the others were freed
    assert takes(now + 5 * minute, 51)
    assert all(takes(now + 5 * minute + k, 70 + k) for k in range(1, 16))  # the first place, too


def test_signatures_of_frames_of_each_length_are_verified(library: ctypes.CDLL, keyed: bytes) -> None:
    """The last block of a hash has from none to all of its bytes."""
    board, stamps = StoredBoard(library, keyed), itertools.count(0x112233445566)  # no byte is 0
    sender = Sender((1, 191), KEY, lambda: next(stamps))
    for length in range(1, 51):
        frame = sender.pack(dialect.MAVLink_statustext_message(6, b"a" * length))
        assert board.receive(frame, board.now_us * 1000), length
        assert not board.receive(frame[:-1] + bytes([frame[-1] ^ 1]), board.now_us * 1000)


def test_a_new_key_frees_all_streams(library: ctypes.CDLL, keyed: bytes) -> None:
    board, now = StoredBoard(library, keyed), 100_000_000
    for link_id in range(16):
        board.put(frame_of(now + link_id, link_id))
        board.go(150)
    board.output()
    board.put(ParameterClient(1, KEY, lambda: now + 100).give(OTHER, now))
    board.go(600)
    board.output()
    for link_id in range(16, 32):
        board.put(ParameterClient(1, Key(OTHER.secret, link_id), lambda: now + 200 + link_id).ask("SLEW_US_S"))  # noqa: B023
        board.go(150)
        assert b"SLEW_US_S" in board.output(), link_id


def test_hil_mode_is_not_kept_but_the_other_settings_are(library: ctypes.CDLL, keyed: bytes) -> None:
    memory = keyed
    for name, value in (("HIL_MODE", 1.0), ("HIL_OUTPUTS", 1.0), ("SLEW_US_S", 4321.0)):
        memory = rewritten(memory, VALUES_AT + 4 * PARAMETERS.index[name], struct.pack("<f", value))
    board = StoredBoard(library, memory)
    assert [board.value(name) for name in ("HIL_MODE", "HIL_OUTPUTS", "SLEW_US_S")] == [0.0, 0.0, 4321.0]


def test_at_power_on_thrusters_are_neutral_and_ankles_in_the_middle_of_their_own_limits(
    library: ctypes.CDLL, keyed: bytes
) -> None:
    at, low_us = VALUES_AT + 4 * PARAMETERS.index["ANK_MAX_US"], PARAMETERS["ANK_MIN_US"]
    board = StoredBoard(library, rewritten(keyed, at, struct.pack("<f", 1801.0)))
    assert board.pulses == (*[1500] * 4, *[int(low_us + 1801.0) // 2] * 4)


def signed_at(data: bytes) -> list[int]:
    """Timestamps of the signatures of frames."""
    stamps = []
    while data:
        size = 12 + data[1] + 13
        stamps.append(int.from_bytes(data[size - 12 : size - 6], "little"))
        data = data[size:]
    return stamps


def test_a_board_signs_later_than_in_any_life_before(library: ctypes.CDLL, keyed: bytes) -> None:
    memory, latest = keyed, 0
    for life in range(3):
        board, stamp = StoredBoard(library, memory), itertools.count(1000 + 100 * life)
        client = ParameterClient(1, KEY, lambda: next(stamp))  # noqa: B023
        for _ in range(10):
            board.put(client.ask("SLEW_US_S"))
            board.go(1)
        board.put(AgentLink(1, KEY, lambda: next(stamp)).arm(True))  # noqa: B023  # is kept
        board.go(40)
        stamps = signed_at(board.output())
        assert len(stamps) > 9 and min(stamps) > latest
        memory, latest = board.eeprom, max(stamps)


def test_zeros_of_the_life_before_are_taken_off_what_is_measured_and_written_once(library: ctypes.CDLL) -> None:
    first = settled(library, b"\xff" * EEPROM_BYTES, 0.05, 0.25)
    memory = first.eeprom
    first.go(200)
    assert first.eeprom == memory
    again, link = settled(library, memory, 1.05, 0.25), AgentLink(1)
    link.receive(again.output(), again.now_us * 1000)
    assert link.telemetry.depth_m == pytest.approx(1.0, abs=0.01)
    assert link.telemetry.yaw_rate_radps == pytest.approx(0.0, abs=1e-3) and link.telemetry.restarted


def test_a_byte_is_written_at_a_time_and_none_while_one_is_being_written(library: ctypes.CDLL, keyed: bytes) -> None:
    board = StoredBoard(library, keyed)
    board.put(ParameterClient(1, KEY, lambda: 10_000).set("SLEW_US_S", 4321.0))
    written = 0
    for count in range(600):
        before = board.eeprom
        library.library_busy(count % 2 == 1)
        board.go()
        changed = sum(a != b for a, b in zip(before, board.eeprom, strict=True))
        assert changed <= 1 - count % 2
        written += changed
    library.library_busy(False)
    assert written > 20
