"""SHELL: the guard in front of the router's public port: a process of its own that accepts, and passes bytes on unchanged.

    python -m groundstation.gate.guard LISTENER_FD NEW_PORT KNOWN_PORT

The gate (gate.py) starts it with the listening socket; the router listens at two loopback ports behind it. TLS
goes end to end between member and router: the guard reads a ClientHello's length and counts bytes, no more. Which connections
are passed on, and when, is decided in admission.py. Its standard input names connections that the router does
not want after all, each by the port from which it reaches the router; the guard ends when that input does, that is with the
station. It tells on its standard output of whom it refused, a line each.
"""

import contextlib
import os
import selectors
import signal
import socket
import sys
import time
from collections.abc import Callable

from groundstation.gate.admission import (
    MOST_HELLO,
    MOST_WAITING,
    Admission,
    NotTls,
    RefusalReason,
    Refusals,
    asks_for_another_hello,
    hello_is_whole,
)
from shoal.system.open_files import FILES_APART, NO_FILES, REST_S, allow_files

CHUNK = 256 * 1024  # bytes passed on in one go
INNER_BUFFER = 128 * 1024  # bytes: the kernel's between router and guard. What waits there for a slow member gets old
# A proof of a member's handshake: it has sent a certificate, and the router has answered with more than an alert (24 bytes).
# On what was measured here: certificate, signature and Finished 700 bytes and more; session tickets 150 and more.
CERTIFICATE_BYTES, ANSWER_BYTES = 300, 64
STALLED_S = 10.0  # s for which bytes wait for a peer that reads none: the router misses it after its lease of 1 s
MOST_PIECES = 64  # that a ClientHello comes in; each costs a look at all that has come
ACCEPTS = 32  # in one go, between which bytes are passed on
MOST_LINKS = 2048  # 49 robots take some 150

READ, WRITE = selectors.EVENT_READ, selectors.EVENT_WRITE


class PeerClosed(Exception):
    """Raised when the other end of a socket has closed it."""

    def __init__(self, which: socket.socket) -> None:
        super().__init__()
        self.which = which


class Pump:
    """One direction of a connection. Bytes that the receiver does not take at once wait, and meanwhile nothing more is
    read."""

    def __init__(self, source: socket.socket, sink: socket.socket) -> None:
        self.source, self.sink = source, sink
        self.waiting = b""
        self.passed = 0  # bytes read
        self.ended = False  # the source has said all

    @property
    def over(self) -> bool:
        """True if the source has ended and everything was sent."""
        return self.ended and not self.waiting

    @property
    def wanted(self) -> int:
        """READ while the source is to be read."""
        return 0 if self.ended or self.waiting else READ

    def read(self, buffer: bytearray) -> bytes | memoryview:
        """Read the source and send to the sink as much as it takes. Returns the bytes read. Raises PeerClosed."""
        try:
            size = self.source.recv_into(buffer)
        except BlockingIOError:
            return b""
        except OSError:
            raise PeerClosed(self.source) from None
        if not size:
            self.ended = True
            self.write()
            return b""
        self.passed += size
        read = memoryview(buffer)[:size]
        sent_bytes = self._send(read)
        if sent_bytes < size:
            self.waiting = bytes(read[sent_bytes:])
        return read

    def write(self) -> None:
        """Send the bytes that wait. Raises PeerClosed."""
        if self.waiting:
            self.waiting = self.waiting[self._send(self.waiting) :]
        if self.over:
            with contextlib.suppress(OSError):  # gone already
                self.sink.shutdown(socket.SHUT_WR)

    def _send(self, data: bytes | memoryview) -> int:
        """Send bytes to the sink. Returns how many it took. Raises PeerClosed if it has gone."""
        try:
            return self.sink.send(data)
        except BlockingIOError:
            return 0
        except OSError:
            raise PeerClosed(self.sink) from None


class ProxiedConnection:
    """A connection that was passed on: the peer's socket and the router's, and what has gone between them."""

    def __init__(self, number: int, peer: socket.socket, router: socket.socket, hello: bytes) -> None:
        self.number = number
        self.up, self.down = Pump(peer, router), Pump(router, peer)
        self.up.waiting = hello
        self.proven = self.by_router = False
        self.port = 0  # from which it reaches the router
        self.until_s = float("inf")  # when it is dropped, unless the peer reads
        self.claimed_at: int | None = None  # bytes from the router when the peer had sent as much as a certificate


class Guard:
    """The guard's event loop."""

    def __init__(self, listener: socket.socket, ports: tuple[int, int], tell: Callable[[str], None], most_links: int) -> None:
        """Accept connections of `listener`. `ports`: the router's loopback ports, of the lane of new origins and of known
        ones. `tell` takes a sentence for the station. `most_links`: connections to the router at a time."""
        self._ports, self._tell = ports, tell
        self._admission, self._refusals = Admission(most_links), Refusals()
        self._selector = selectors.DefaultSelector()
        self._interest: dict[socket.socket, int] = {}  # events for which a socket is registered
        self._peers: dict[int, tuple[socket.socket, str]] = {}  # all connections, with their address
        self._hellos: dict[int, list[bytes]] = {}  # of connections that wait: pieces of the ClientHello that have come
        self._links: dict[int, ProxiedConnection] = {}
        self._at_router: dict[int, int] = {}  # number of each link, by the port from which it reaches the router
        self._unwanted = b""  # begin of the next line on the watched descriptor: the port of a connection to end
        self._number = 0
        self._buffer = bytearray(CHUNK)
        self._next_deadline_s = float("inf")  # when `_serve_deadlines` is due; 0: at once
        self._ending = False
        listener.setblocking(False)
        self._listener = listener
        self._listen_again()

    def _listen_again(self) -> None:
        self._listens_s = float("inf")  # when a listener that rests is listened to again
        self._selector.register(self._listener, READ, lambda events: self._accept(self._listener))

    def watch(self, descriptor: int) -> None:
        """Expel the links whose ports come here, a line each; end when it ends."""
        self._selector.register(descriptor, READ, lambda events: self._listen(descriptor))

    def _listen(self, descriptor: int) -> None:
        """Read ports of connections to end, which the router's side reports."""
        try:
            read = os.read(descriptor, CHUNK)
        except BlockingIOError:
            return
        except OSError:
            read = b""
        self._ending = not read
        *lines, self._unwanted = (self._unwanted + read).split(b"\n")
        for line in lines:
            number = self._at_router.get(int(line)) if line.isdigit() else None
            if number is not None:
                self._admission.expel(number, time.monotonic())
                self._drop(number)

    def _ignore(self, events: int) -> None:
        """The callback of a socket that is watched for no events: never called."""

    def run(self) -> None:
        """Carry bytes until the watched process ends."""
        while not self._ending:
            next_s = min(self._next_deadline_s, self._listens_s)
            wait_s = None if next_s == float("inf") else max(next_s - time.monotonic(), 0.0)
            for key, events in self._selector.select(wait_s):
                key.data(events)
            if time.monotonic() >= self._listens_s:
                self._listen_again()
            if self._next_deadline_s != float("inf") and time.monotonic() >= self._next_deadline_s:
                self._serve_deadlines()

    def close(self) -> None:
        """Close every connection."""
        for number in list(self._links):
            self._drop(number)
        for number in list(self._peers):
            self._close(number)
        self._selector.close()

    def _set_events(self, one: socket.socket, events: int, call: Callable[[int], None]) -> None:
        """Have `call` called for these events of a socket from now on; for none with `events` 0."""
        before = self._interest.get(one, 0)
        if events == before:
            return
        if not before:
            self._selector.register(one, events, call)
        elif not events:
            self._selector.unregister(one)
        else:
            self._selector.modify(one, events, call)
        self._interest[one] = events

    def _shut(self, one: socket.socket) -> None:
        """Stop watching a socket, and close it."""
        if self._interest.pop(one, 0):
            self._selector.unregister(one)
        one.close()

    # --- connections that wait

    def _accept(self, listener: socket.socket) -> None:
        """Accept connections that wait, a few at a time, and read each one's hello."""
        for _ in range(ACCEPTS):
            try:
                peer, where = listener.accept()
            except OSError as error:  # none left, or gone already
                if error.errno in NO_FILES:  # a connection waits all the same, and would wake this loop without end
                    self._selector.unregister(listener)
                    self._listens_s = time.monotonic() + REST_S
                return
            peer.setblocking(False)
            self._number += 1
            number, address = self._number, str(where[0])
            self._peers[number], self._hellos[number] = (peer, address), []
            self._set_events(peer, READ, lambda events, number=number: self._greeted(number))  # type: ignore[misc]
            for other in self._admission.come(number, address, time.monotonic()):
                self._refuse(other, RefusalReason.CROWDED)
            self._next_deadline_s = 0.0

    def _greeted(self, number: int) -> None:
        """Read what a waiting connection has sent. Its hello goes to admission once it is whole; a connection that has ended,
        or speaks no TLS, is refused."""
        if number not in self._hellos:
            return  # closed meanwhile, for another
        peer, _ = self._peers[number]
        try:
            if hello_is_whole(b"".join(self._hellos[number])):  # it waits for its turn: is it still there?
                if not peer.recv(1, socket.MSG_PEEK):
                    raise NotTls
                self._set_events(peer, 0, self._ignore)  # what it says before the router's answer is read after it
                return
            data = peer.recv(2 * MOST_HELLO)
            self._hellos[number].append(data)
            if not data or len(self._hellos[number]) > MOST_PIECES:
                raise NotTls
            if hello_is_whole(b"".join(self._hellos[number])):
                self._admission.hello(number, time.monotonic())
        except BlockingIOError:
            return
        except (OSError, NotTls):
            self._admission.gone(number)
            self._refuse(number, self._reason_to_refuse(number))
        self._next_deadline_s = 0.0

    def _serve_deadlines(self) -> None:
        """Close connections that are overdue, connect those whose turn it is to the router, report refusals to the station."""
        now_s = time.monotonic()
        for number in self._admission.overdue(now_s):
            if number in self._links:
                self._drop(number)
            else:
                self._refuse(number, self._reason_to_refuse(number))
        for number in [number for number, link in self._links.items() if link.until_s <= now_s]:
            self._drop(number)
        for number, lane in self._admission.turns(now_s):
            self._connect_to_router(number, lane)
        for sentence in self._refusals.due_sentences(now_s):
            self._tell(sentence)
        ends_s = min((link.until_s for link in self._links.values()), default=float("inf"))
        self._next_deadline_s = min(self._admission.next_s(now_s), self._refusals.next_s(), ends_s)

    def _reason_to_refuse(self, number: int) -> RefusalReason:
        """The reason to refuse a connection that waits: its hello is whole, but no turn came; or it has sent no TLS hello."""
        try:
            has_hello = hello_is_whole(b"".join(self._hellos[number]))
        except NotTls:
            has_hello = False
        return RefusalReason.CROWDED if has_hello else RefusalReason.NO_TLS

    def _refuse(self, number: int, reason: RefusalReason) -> None:
        """Close a connection that was not passed on."""
        self._refusals.note(self._peers[number][1], reason)
        self._close(number)

    def _close(self, number: int) -> None:
        peer, _ = self._peers.pop(number)
        self._hellos.pop(number, None)
        self._shut(peer)

    # --- connections to the router

    def _connect_to_router(self, number: int, lane: int) -> None:
        """Connect a peer that was admitted to the router, by the inner port of its lane."""
        peer, _ = self._peers[number]
        self._set_events(peer, 0, self._ignore)
        router = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
        router.setblocking(False)
        router.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, INNER_BUFFER)
        for one in (peer, router):
            one.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        link = self._links[number] = ProxiedConnection(number, peer, router, b"".join(self._hellos.pop(number)))
        router.connect_ex(("127.0.0.1", self._ports[lane]))
        link.port = router.getsockname()[1]
        self._at_router[link.port] = number
        self._set_events(router, READ | WRITE, lambda events: self._from_router(link, events))

    def _from_router(self, link: ProxiedConnection, events: int) -> None:
        """Act on events of a connection's socket to the router: carry bytes, judge the peer, drop the connection if it has
        ended."""
        if link.number not in self._links:
            return
        try:
            if events & WRITE:
                link.up.write()
            if events & READ:
                first = not link.down.passed
                read = link.down.read(self._buffer)
                link.by_router = link.by_router or (link.down.ended and not link.up.ended)
                if first and (link.down.ended or asks_for_another_hello(bytes(read[:64]))):
                    self._drop(link.number)
                    return
                if not link.proven:
                    self._judge(link)
        except PeerClosed as error:
            link.by_router = link.by_router or (error.which is link.down.source and not link.up.ended)
            self._drop(link.number)
            return
        self._choose_events(link)

    def _from_peer(self, link: ProxiedConnection, events: int) -> None:
        """Pass on bytes of a connection that its peer can send or take."""
        if link.number not in self._links:
            return
        try:
            if events & WRITE:
                link.down.write()
                link.until_s = float("inf")
            if events & READ:
                link.up.read(self._buffer)
                if link.claimed_at is None and link.up.passed >= CERTIFICATE_BYTES:
                    link.claimed_at = link.down.passed
        except PeerClosed:
            self._drop(link.number)
            return
        self._choose_events(link)

    def _judge(self, link: ProxiedConnection) -> None:
        """Note that a peer is proven, once the router has sent ANSWER_BYTES after as much as a certificate came from it."""
        if link.claimed_at is not None and link.down.passed - link.claimed_at >= ANSWER_BYTES:
            link.proven = True
            self._admission.proven(link.number, time.monotonic())
            self._next_deadline_s = 0.0

    def _choose_events(self, link: ProxiedConnection) -> None:
        """Choose for which events both sockets are watched next. End a link that the router has ended, also when its peer is
        frozen or gone and keeps its end open."""
        up, down = link.up, link.down
        if down.over:
            self._drop(link.number)
            return
        # A peer that does not read keeps the router from being read, whose end would then go unnoticed: it has STALLED_S.
        if down.waiting and link.until_s == float("inf"):
            link.until_s = time.monotonic() + STALLED_S
            self._next_deadline_s = min(self._next_deadline_s, link.until_s)
        self._set_events(
            down.source, down.wanted | (WRITE if up.waiting else 0), lambda events: self._from_router(link, events)
        )
        if down.passed:
            self._set_events(
                up.source, up.wanted | (WRITE if down.waiting else 0), lambda events: self._from_peer(link, events)
            )

    def _drop(self, number: int) -> None:
        """End a connection at the router."""
        link = self._links.pop(number)
        self._at_router.pop(link.port, None)
        self._shut(link.down.source)
        if self._admission.ended(number, link.by_router, time.monotonic()):
            self._refusals.note(self._peers[number][1], RefusalReason.NO_CERTIFICATE)
        self._close(number)
        self._next_deadline_s = 0.0


def most_links() -> int:
    """Connections that the process may have files for, two each."""
    files = allow_files(2 * MOST_LINKS + MOST_WAITING + FILES_APART)
    return max(min((files - MOST_WAITING - FILES_APART) // 2, MOST_LINKS), 1)


def _tell(sentence: str) -> None:
    """Tell the station a sentence; what it does not take at once is lost."""
    with contextlib.suppress(OSError):
        os.write(sys.stdout.fileno(), f"{sentence}\n".encode())


def main() -> None:
    """Run the guard as a program (see the module's docstring)."""
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, signal.SIG_IGN)  # meant for the station, which ends us when it has ended its links
    os.set_blocking(sys.stdout.fileno(), False)
    listener = socket.socket(fileno=int(sys.argv[1]))
    guard = Guard(listener, (int(sys.argv[2]), int(sys.argv[3])), _tell, most_links())
    guard.watch(sys.stdin.fileno())
    try:
        guard.run()
    finally:
        guard.close()


if __name__ == "__main__":
    main()
