"""MAVLink 2 signing, sans-IO: who may speak on the link, and that nothing said before counts again.

A signed frame ends in 13 bytes: link id, a timestamp in 10 us since 2015, and 48 bits of SHA-256 over the secret key and
everything before. Time comes from the caller; shoal/mavlink/signing_key.py keeps key and timestamps in files.
"""

import hashlib
import hmac
from collections.abc import Callable
from dataclasses import dataclass, field
from enum import Enum

SIGNED = 0x01  # incompatibility flag: a signature follows the checksum
KEY_BYTES, SIGNATURE_BYTES, HASH_BYTES = 32, 13, 6
TICK_NS = 10_000  # a timestamp counts in 10 us ...
EPOCH_NS = 1_420_070_400_000_000_000  # ... since the first of January 2015, UTC
LATEST = 2**48 - 1
STREAMS = 16  # one for each sender and link; a key holder that opens more within a minute is faulty
MINUTE = 6_000_000  # a stream that is new may be so much older than the newest timestamp, as in MAVLink's own library


@dataclass(frozen=True)
class Key:
    """The secret that both ends of a link share. Never in a log: it is not in the repr."""

    secret: bytes = field(repr=False)
    link_id: int = 0  # tells the links of one sender apart

    def __post_init__(self) -> None:
        if len(self.secret) != KEY_BYTES or not 0 <= self.link_id <= 255:
            raise ValueError(f"a signing key has {KEY_BYTES} bytes and a link id of 0 to 255")


class SignatureVerdict(Enum):
    """The result of verifying the signature of an intact frame."""

    GOOD = 0
    UNSIGNED = 1
    FORGED = 2  # signed with another key, or for a receiver that has none
    REPLAYED = 3  # well signed, but not later than what the same stream, or an earlier life, has had


def ticks(unix_ns: int) -> int:
    """The timestamp of an instant of Unix time; 0 before 2015."""
    return max((unix_ns - EPOCH_NS) // TICK_NS, 0)


def _hash(key: Key, signed: bytes) -> bytes:
    return hashlib.sha256(key.secret + signed).digest()[:HASH_BYTES]


class Signer:
    """Signs one end's frames. Each timestamp is later than all before it, whatever the clock does."""

    def __init__(self, key: Key, now: Callable[[], int]) -> None:
        """`now()` is the time in ticks, and need not rise."""
        self._key, self._now = key, now
        self.last = 0

    def sign(self, frame: bytes) -> bytes:
        """The frame, whose header already says that it is signed, with its signature."""
        self.last = min(max(self.last + 1, self._now()), LATEST)
        signed = frame + bytes([self._key.link_id]) + self.last.to_bytes(6, "little")
        return signed + _hash(self._key, signed)


class SignatureVerifier:
    """Verifies the frames that one end receives. Without a key it accepts unsigned frames only."""

    def __init__(self, key: Key | None, floor: int = 0) -> None:
        """A stream that is new must begin later than `floor`."""
        self._key, self._floor = key, floor
        self._streams: dict[tuple[int, int, int], int] = {}
        self.newest = floor  # the latest timestamp taken so far

    def verify(self, frame: bytes, system: int, component: int) -> SignatureVerdict:
        """Verify an intact frame by its flag and signature. Only a good frame changes the state."""
        if not frame[2] & SIGNED:
            return SignatureVerdict.GOOD if self._key is None else SignatureVerdict.UNSIGNED
        signed, signature = frame[:-HASH_BYTES], frame[-HASH_BYTES:]
        if self._key is None or not hmac.compare_digest(_hash(self._key, bytes(signed)), bytes(signature)):
            return SignatureVerdict.FORGED
        stream = (frame[-SIGNATURE_BYTES], system, component)
        timestamp = int.from_bytes(signed[-6:], "little")
        if timestamp <= self._streams.get(stream, self._floor):
            return SignatureVerdict.REPLAYED
        if stream not in self._streams and not self._make_room(timestamp):
            return SignatureVerdict.REPLAYED
        self._streams[stream] = timestamp
        self.newest = max(self.newest, timestamp)
        return SignatureVerdict.GOOD

    def _make_room(self, timestamp: int) -> bool:
        """Make room for a new stream that begins at this time. Returns False if there is none, and for one that begins more
        than a minute before the newest timestamp. If all places are taken, a stream that was silent for more than a minute
        is forgotten: all that it has sent is too old to begin a stream again."""
        if timestamp + MINUTE < self.newest:
            return False
        if len(self._streams) < STREAMS:
            return True
        unused = next((stream for stream, last in self._streams.items() if last + MINUTE < self.newest), None)
        if unused is None:
            return False
        del self._streams[unused]
        return True
