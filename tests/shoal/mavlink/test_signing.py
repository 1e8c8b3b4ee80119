"""Signed frames, held against pymavlink's own signing, and everything that must not get through."""

import hashlib
from itertools import pairwise

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pymavlink.dialects.v20 import common as dialect

from shoal.mavlink.agent_link import AgentLink
from shoal.mavlink.framing import FRAME_TIMEOUT_NS, PEERS, SILENCE_NS, Sender
from shoal.mavlink.signing import EPOCH_NS, LATEST, STREAMS, Key, SignatureVerdict, SignatureVerifier, Signer, ticks
from sim_bridge.thruster_board.board_link import Arm, BoardLink, Event, Heartbeat, Override

SECRET = hashlib.sha256(b"a secret of tests").digest()
KEY = Key(SECRET)
PULSES = (1500,) * 8
NOW = 47_338_560_000_000  # ticks: 2030
MS = 1_000_000


def agent(start: int = NOW, key: Key | None = KEY) -> AgentLink:
    """A computer whose clock stands still."""
    return AgentLink(1, key, lambda: start)


def board(floor: int = 0, key: Key | None = KEY) -> BoardLink:
    return BoardLink(1, SignatureVerifier(key, floor), key)


def events(link: BoardLink, data: bytes, now_ns: int = 0) -> list[Event]:
    return [event for _, event in link.receive(data, now_ns)]


def test_both_ends_understand_each_other() -> None:
    computer, device = agent(), board()
    assert events(device, computer.pulses(PULSES) + computer.arm(True)) == [Override(PULSES), Arm(True)]
    computer.receive(device.heartbeat(True, True) + device.pressure(7, 0.3) + device.attitude(7, 1.0, 0.5), 5)
    assert (computer.telemetry.armed, computer.telemetry.board_ms) == (True, 7)
    assert (device.unauthentic_frames, computer.telemetry.replayed_frames) == (0, 0)


def test_pymavlink_accepts_our_signatures() -> None:
    theirs = dialect.MAVLink(None)
    theirs.signing.secret_key, theirs.signing.timestamp = SECRET, NOW
    computer = agent()
    for _ in range(300):  # and our sequence and timestamps, all the way around
        message = theirs.decode(bytearray(computer.pulses(PULSES)))
        assert (message.get_type(), message.get_signed()) == ("RC_CHANNELS_OVERRIDE", True)
    assert theirs.signing.goodsig_count == 300
    theirs.signing.secret_key = bytes(32)
    with pytest.raises(dialect.MAVError, match="signature"):
        theirs.decode(bytearray(computer.heartbeat()))


def test_we_accept_the_signatures_of_pymavlink() -> None:
    theirs = dialect.MAVLink(None, 1, 191)
    theirs.signing.secret_key, theirs.signing.timestamp = SECRET, NOW
    theirs.signing.sign_outgoing, theirs.signing.link_id = True, 3
    frame = dialect.MAVLink_heartbeat_message(18, 8, 0, 0, 4, 3).pack(theirs)
    assert events(board(), frame) == [Heartbeat()]
    assert events(board(key=Key(bytes(32))), frame) == []


@pytest.mark.parametrize("sent", [KEY, None], ids=["signed", "unsigned"])
@pytest.mark.parametrize("expected", [KEY, Key(bytes(32)), None], ids=["our key", "another key", "no key"])
def test_frames_are_taken_only_as_both_ends_agree(sent: Key | None, expected: Key | None) -> None:
    link = board(key=expected)
    events_read = events(link, agent(key=sent).arm(True))
    assert events_read == ([Arm(True)] if sent == expected else [])
    assert link.unauthentic_frames == (0 if events_read else 1)


def test_the_computer_counts_what_it_drops() -> None:
    computer = agent()
    forged, unsigned = board(key=Key(bytes(32))), board(key=None)
    computer.receive(forged.heartbeat(True, True) + unsigned.heartbeat(True, True) + board().heartbeat(True, True), 0)
    telemetry = computer.telemetry
    assert (telemetry.forged_frames, telemetry.unsigned_frames, telemetry.replayed_frames, telemetry.armed) == (1, 1, 1, False)


def test_no_bit_of_a_signed_frame_can_be_changed() -> None:
    frame = agent().arm(True)
    assert len(frame) == len(agent(key=None).arm(True)) + 13
    for bit in range(len(frame) * 8):
        damaged = bytearray(frame)
        damaged[bit // 8] ^= 1 << bit % 8
        link = board()
        assert events(link, bytes(damaged)) + events(link, b"", FRAME_TIMEOUT_NS + 1) == [], f"bit {bit}"


def test_a_signed_frame_with_the_flag_taken_off_is_unsigned() -> None:
    """An attacker without the key cuts the signature off a recorded frame and repairs the checksum."""
    frame = agent().arm(True)
    content = bytes([frame[1], 0]) + frame[3:-15]
    checksum = dialect.x25crc(content)
    checksum.accumulate(bytes([152]))
    link = board()
    assert events(link, b"\xfd" + content + checksum.crc.to_bytes(2, "little")) == []
    assert link.unauthentic_frames == 1


def test_a_recording_does_not_count_again_even_after_the_silence() -> None:
    """Sequence numbers start anew after a silence; timestamps do not."""
    computer, device = agent(), board()
    recorded = [computer.pulses(PULSES) for _ in range(20)] + [computer.arm(True)]
    assert len(events(device, b"".join(recorded))) == 21
    for i, frame in enumerate(recorded):
        assert events(device, frame, (i + 1) * 2 * SILENCE_NS) == []
    assert device.unauthentic_frames == 21


def test_a_recording_does_not_count_after_a_restart_of_the_board() -> None:
    computer, verifier = agent(), SignatureVerifier(KEY)
    before = BoardLink(1, verifier, KEY)
    recorded = [computer.pulses(PULSES), computer.arm(True)]
    assert len(events(before, b"".join(recorded))) == 2
    after = board(floor=verifier.newest)
    assert events(after, b"".join(recorded)) == []
    assert events(after, computer.arm(False)) == [Arm(False)]


def test_a_restarted_computer_takes_no_old_telemetry_and_is_heard_at_once() -> None:
    device, first = board(), agent()
    events(device, first.heartbeat())
    old = device.heartbeat(True, True) + device.attitude(9, 0.0, 0.0)
    first.receive(old, 0)
    assert first.telemetry.armed
    second = agent(start=NOW + 100)  # its file says: later than all it sent before
    second.receive(old, 0)
    assert not second.telemetry.armed
    assert second.telemetry.replayed_frames == 2
    assert events(device, second.heartbeat(), 2 * SILENCE_NS) == [Heartbeat()]
    second.receive(device.heartbeat(True, True) + device.heartbeat(True, True), 1)
    assert second.telemetry.armed


def test_a_computer_whose_clock_is_behind_catches_up_with_the_board() -> None:
    """No battery-backed clock, and the board has heard somebody whose clock is right."""
    device, late = board(floor=NOW), agent(start=1000)
    assert events(device, late.heartbeat()) == []
    late.receive(BoardLink(1, SignatureVerifier(KEY, NOW), KEY).heartbeat(False, True), 0)
    assert events(device, late.heartbeat()) == [Heartbeat()]


def test_each_stream_keeps_its_own_timestamps() -> None:
    verifier = SignatureVerifier(KEY)
    ahead = Signer(Key(SECRET, 1), lambda: NOW + 1000)
    behind = Signer(Key(SECRET, 2), lambda: NOW)
    frame = bytes([0xFD, 0, 1])
    assert verifier.verify(ahead.sign(frame), 1, 191) is SignatureVerdict.GOOD
    assert verifier.verify(behind.sign(frame), 1, 191) is SignatureVerdict.GOOD
    assert verifier.verify(Signer(Key(SECRET, 1), lambda: NOW).sign(frame), 1, 190) is SignatureVerdict.GOOD
    assert verifier.newest == NOW + 1000


def test_time_begins_with_the_first_tick() -> None:
    frame = bytes([0xFD, 0, 1])
    assert SignatureVerifier(KEY).verify(Signer(KEY, lambda: 0).sign(frame), 1, 191) is SignatureVerdict.GOOD


def test_there_is_an_end_to_streams() -> None:
    verifier, frame = SignatureVerifier(KEY), bytes([0xFD, 0, 1])
    verdicts = [verifier.verify(Signer(Key(SECRET, i), lambda: NOW).sign(frame), 1, 1) for i in range(STREAMS + 3)]
    assert verdicts == [SignatureVerdict.GOOD] * STREAMS + [SignatureVerdict.REPLAYED] * 3
    assert verifier.verify(Signer(KEY, lambda: NOW + 1).sign(frame), 1, 1) is SignatureVerdict.GOOD


def test_a_forged_frame_leaves_no_trace() -> None:
    """Else one frame with the latest timestamp there is would shut the true sender out."""
    device, computer = board(), agent()
    stranger = Sender((1, 191), Key(bytes(32)), lambda: LATEST)
    message = dialect.MAVLink_heartbeat_message(18, 8, 0, 0, 4, 3)
    assert events(device, b"".join(stranger.pack(message) for _ in range(200))) == []
    assert events(device, computer.heartbeat()) == [Heartbeat()]


@given(clock=st.lists(st.integers(0, LATEST), min_size=1, max_size=50))
def test_timestamps_rise_whatever_the_clock_does(clock: list[int]) -> None:
    readings = iter(clock)
    signer = Signer(KEY, lambda: next(readings))
    stamps = [int.from_bytes(signer.sign(b"frame")[6:12], "little") for _ in clock]
    limit = LATEST
    assert all(a < b or b == limit for a, b in pairwise(stamps))
    assert all(stamp >= min(now, limit) for stamp, now in zip(stamps, clock, strict=True))


def test_a_clock_that_stands_still_uses_one_tick_for_each_frame() -> None:
    """Ticks have to last: the computer reserves 60 s at a time."""
    for now in (0, 1, NOW):
        signer = Signer(KEY, iter([now] * 3).__next__)
        stamps = [int.from_bytes(signer.sign(b"frame")[6:12], "little") for _ in range(3)]
        assert stamps == [max(now, 1) + i for i in range(3)]


def test_ticks() -> None:
    assert ticks(EPOCH_NS - 1) == 0
    assert ticks(EPOCH_NS + 10_000) == 1
    assert ticks(EPOCH_NS + 25_000) == 2
    assert ticks(1_893_456_000 * 10**9) == 47_338_560_000_000  # 2030: 5479 days of 8.64e9 ticks


def test_a_key_is_checked_and_never_shown() -> None:
    assert SECRET.hex() not in repr(KEY) and repr(SECRET) not in repr(KEY)
    for secret, link in ((b"short", 0), (SECRET, 256), (SECRET, -1)):
        with pytest.raises(ValueError, match="32 bytes"):
            Key(secret, link)
    assert [Key(SECRET, link).link_id for link in (0, 255)] == [0, 255]


def test_a_flood_of_system_ids_locks_others_out_only_for_a_while() -> None:
    link = board(key=None)
    for i in range(PEERS + 5):
        link.receive(Sender((2, i)).pack(dialect.MAVLink_heartbeat_message(18, 8, 0, 0, 4, 3)), 0)
    assert events(link, agent(key=None).heartbeat(), MS) == []
    assert events(link, agent(key=None).heartbeat(), SILENCE_NS) == [Heartbeat()]


def test_a_new_stream_may_begin_a_minute_ago_at_most() -> None:
    """As MAVLink's own library has it: a frame that was held back on a link not heard so far."""
    verifier, frame = SignatureVerifier(KEY), bytes([0xFD, 0, 1])
    minute = 6_000_000
    assert verifier.verify(Signer(KEY, lambda: NOW).sign(frame), 1, 191) is SignatureVerdict.GOOD
    late = Signer(Key(SECRET, 1), lambda: NOW - minute - 1).sign(frame)
    assert verifier.verify(late, 255, 190) is SignatureVerdict.REPLAYED
    just = Signer(Key(SECRET, 1), lambda: NOW - minute).sign(frame)
    assert verifier.verify(just, 255, 190) is SignatureVerdict.GOOD


def test_a_stream_unused_for_a_minute_gives_its_place_away() -> None:
    verifier, frame = SignatureVerifier(KEY), bytes([0xFD, 0, 1])
    first = Signer(KEY, lambda: NOW).sign(frame)
    assert verifier.verify(first, 1, 1) is SignatureVerdict.GOOD
    for component in range(2, 17):
        assert verifier.verify(Signer(KEY, lambda: NOW + 100).sign(frame), 1, component) is SignatureVerdict.GOOD
    assert verifier.verify(Signer(KEY, lambda: NOW + 100).sign(frame), 1, 17) is SignatureVerdict.REPLAYED  # all in use
    just = Signer(KEY, lambda: NOW + 6_000_000).sign(frame)
    assert verifier.verify(just, 1, 3) is SignatureVerdict.GOOD
    assert verifier.verify(just, 1, 17) is SignatureVerdict.REPLAYED  # the first is unused for a minute, and not for more
    later = NOW + 6_000_001
    assert verifier.verify(Signer(KEY, lambda: later).sign(frame), 1, 2) is SignatureVerdict.GOOD
    assert verifier.verify(Signer(KEY, lambda: later).sign(frame), 1, 17) is SignatureVerdict.GOOD
    assert verifier.verify(first, 1, 1) is SignatureVerdict.REPLAYED  # its stream is new again, and too old
