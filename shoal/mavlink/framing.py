"""MAVLink 2 frames in a stream of bytes, sans-IO: finding, checking and numbering them. frame_codec.py has single
frames, agent_link.py the messages.

pymavlink's own stream parser takes any start byte for a frame and throws away what the frame would have covered: at 20
overrides per second a false start byte cost it half a second of commands. It also passes messages it does not know without
looking at their checksum.
"""

from collections import deque
from collections.abc import Callable, Iterator
from typing import Any

from pymavlink.dialects.v20 import common as dialect

from shoal.mavlink import frame_codec
from shoal.mavlink.frame_codec import CHECKSUM_BYTES, HEADER_BYTES, MARKER, Peer
from shoal.mavlink.signing import SIGNATURE_BYTES, SIGNED, Key, SignatureVerdict, SignatureVerifier, Signer

EXTENSION_BYTES = 32  # a newer dialect at the other end may have appended this much to a message
FRAME_TIMEOUT_NS = 50_000_000  # 280 bytes take 25 ms at 115200 baud: after this, an unfinished frame is a false start byte
LOSS_WINDOW_NS = 5_000_000_000
# After this any sequence number counts as new: the peer was restarted. Longer than a board stays armed on its last override
# (0.3 s at most), or one frame repeated for ever could keep thrusters running.
SILENCE_NS = 500_000_000
PEERS = 16  # senders whose sequence numbers are followed at a time; more within SILENCE_NS are a flood


class Sequence8:
    """MAVLink's 8-bit sequence numbers of one peer: which frames are old or repeated, and how many were lost."""

    def __init__(self) -> None:
        self._last = -1
        self._last_ns = 0
        self._steps: deque[tuple[int, int]] = deque()
        self._expected = 0

    def accept(self, sequence: int, now_ns: int) -> bool:
        """True if a frame is newer than all before it. After a silence any frame is."""
        step = (sequence - self._last) % 256
        if self._last < 0:
            step = 1
        elif (step == 0 or step >= 128) and not self.silent(now_ns):
            return False
        self._last, self._last_ns = sequence, now_ns
        self._steps.append((now_ns, max(step, 1)))
        self._expected += max(step, 1)
        while now_ns - self._steps[0][0] > LOSS_WINDOW_NS:
            self._expected -= self._steps.popleft()[1]
        return True

    def silent(self, now_ns: int) -> bool:
        """True after a silence so long that any number counts as new."""
        return now_ns - self._last_ns >= SILENCE_NS

    @property
    def loss(self) -> float:
        """Fraction of the peer's frames that did not arrive, over the last 5 s."""
        return 1.0 - len(self._steps) / self._expected if self._expected else 0.0


class Receiver:
    """Finds the frames of some peers in a stream of bytes. After anything broken it looks again from the next byte, so that a
    false start byte or a damaged length hides no intact frame behind it."""

    def __init__(self, wanted: Callable[[Peer], bool], verifier: SignatureVerifier) -> None:
        """Takes frames of `wanted` peers that pass the `verifier`."""
        self._wanted, self._verifier = wanted, verifier
        self._buffer = bytearray()
        self._waiting_since_ns = 0
        self._waiting_bytes = 0  # of the buffer, from its beginning, were there when the wait began
        self._sequences: dict[Peer, Sequence8] = {}
        self.bad_frames = 0  # start bytes that led to no frame: checksum, impossible header, never completed
        self.foreign_frames = 0  # intact, but from another sender, or of a kind that the dialect does not have
        self.foreign_peer: Peer | None = None  # the last other sender of an intact frame
        self.stale_frames = 0  # old or repeated, by their sequence number
        self.refused = dict.fromkeys(SignatureVerdict, 0)  # by their signature
        self.frames: list[bytes] = []  # of the messages of the last `receive`

    @property
    def is_waiting(self) -> bool:
        """True if a frame has begun and not ended."""
        return bool(self._buffer)

    def loss(self, peer: Peer) -> float:
        """Fraction of a peer's frames that did not arrive, over the last 5 s."""
        sequence = self._sequences.get(peer)
        return sequence.loss if sequence is not None else 0.0

    def receive(self, data: bytes, now_ns: int) -> list[Any]:
        """The peers' messages, in order, that are complete with these bytes. Never raises, whatever the bytes are."""
        messages, self.frames = [], []
        if data or self._buffer:
            for message, frame in self.receive_each(data, now_ns):
                messages.append(message)
                self.frames.append(frame)
        return messages

    def receive_each(self, data: bytes, now_ns: int) -> Iterator[tuple[Any, bytes]]:
        """The same, each with its frame, one by one: the next is judged when it is asked for."""
        self._buffer += data
        at = 0
        while (at := self._buffer.find(MARKER, at)) >= 0:
            size = self._frame_size(at)
            if size > len(self._buffer) - at:
                if not self._waited_too_long(at, now_ns):
                    break
                size = 0
            if not size:
                at += 1
                continue
            frame = bytes(self._buffer[at : at + size])
            message = frame_codec.unpack(frame)
            if message is None:
                self.bad_frames += 1
                at += 1
                continue
            at += size
            if self._is_taken(message, frame, now_ns):
                self._drop(at)
                at = 0
                yield message, frame
        self._drop(len(self._buffer) if at < 0 else at)

    def _drop(self, done: int) -> None:
        """Forget so many bytes."""
        del self._buffer[:done]
        self._waiting_bytes = max(self._waiting_bytes - done, 0)

    def _frame_size(self, at: int) -> int:
        """Bytes of the frame that starts at `at`, by its header; 0 if there can be no frame."""
        header = self._buffer[at : at + HEADER_BYTES]
        if len(header) >= 3 and header[2] & ~SIGNED:  # flags that a receiver must understand
            self.bad_frames += 1
            return 0
        if len(header) < HEADER_BYTES:
            return HEADER_BYTES + CHECKSUM_BYTES + 1
        kind = dialect.mavlink_map.get(int.from_bytes(header[7:10], "little"))
        if kind is None:
            self.foreign_frames += 1
            return 0
        if not 1 <= header[1] <= kind.unpacker.size + EXTENSION_BYTES:
            self.bad_frames += 1
            return 0
        signature = SIGNATURE_BYTES if header[2] & SIGNED else 0
        return HEADER_BYTES + header[1] + CHECKSUM_BYTES + signature

    def _waited_too_long(self, at: int, now_ns: int) -> bool:
        """True if the frame that begins at `at` is overdue. False start bytes that came together are overdue together."""
        if at >= self._waiting_bytes:
            self._waiting_since_ns, self._waiting_bytes = now_ns, len(self._buffer)
        if now_ns - self._waiting_since_ns <= FRAME_TIMEOUT_NS:
            return False
        self.bad_frames += 1
        return True

    def _is_taken(self, message: Any, frame: bytes, now_ns: int) -> bool:
        """Signature before sequence: a forged frame must not make the true ones look old."""
        peer = (message.get_srcSystem(), message.get_srcComponent())
        if not self._wanted(peer):
            self.foreign_frames += 1
            self.foreign_peer = peer
            return False
        verdict = self._verifier.verify(frame, *peer)
        if verdict is not SignatureVerdict.GOOD:
            self.refused[verdict] += 1
            return False
        sequence = self._sequences.get(peer)
        if sequence is None:
            if not self._has_room(now_ns):
                self.foreign_frames += 1
                return False
            sequence = self._sequences[peer] = Sequence8()
        if not sequence.accept(message.get_seq(), now_ns):
            self.stale_frames += 1
            return False
        return True

    def _has_room(self, now_ns: int) -> bool:
        if len(self._sequences) >= PEERS:
            self._sequences = {peer: each for peer, each in self._sequences.items() if not each.silent(now_ns)}
        return len(self._sequences) < PEERS


class Sender:
    """Numbers, packs and signs the frames of one end."""

    def __init__(self, peer: Peer, key: Key | None = None, now: Callable[[], int] = lambda: 0) -> None:
        """Make it. With a key frames are signed; `now()` is the time in ticks of a signature's timestamp."""
        self._peer, self._sequence = peer, 0
        self.signer = Signer(key, now) if key is not None else None

    def pack(self, message: Any) -> bytes:
        """The frame of one message. Raises struct.error for a value that its field cannot hold."""
        frame = frame_codec.pack(message, self._peer, self._sequence, SIGNED if self.signer is not None else 0)
        self._sequence = (self._sequence + 1) % 256
        return frame if self.signer is None else self.signer.sign(frame)
