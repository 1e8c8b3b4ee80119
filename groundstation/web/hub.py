"""SHELL: everyone who watches, and what they watch. Lives in the page's event loop (server.py).

Frames to a page: u32 number, f32 round trip of the last one in ms, then a MessagePack map. From the page: small JSON texts
(requests.py). Nobody ever waits for a page: see window.py.
"""

import asyncio
import contextlib
import struct
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import msgspec
from starlette.websockets import WebSocket, WebSocketDisconnect

from groundstation.web import requests
from groundstation.web.desk import Source
from groundstation.web.guard import WebOptions, origin_allowed, token_allowed
from groundstation.web.lease import Lease
from groundstation.web.window import Window
from wire.messages import Order
from wire.runtime import log

LOOK_S = 0.02  # how often the inboxes are looked at; a state waits half of this on average
MOST_SHARE = 0.25  # of the interpreter, which the control cycle needs too: large fleets are shown less often
AT_LEAST_S = 0.25  # ages go on also when nothing comes
MOST_WATCHERS = 16
HELLO_WITHIN_S = 5.0
KEPT_EVENTS = 200  # of the log, for a watcher who comes late
HEAD = struct.Struct("<If")

TOO_MANY, NOT_ALLOWED, BAD_REQUEST = 4001, 4003, 4000  # WebSocket close codes of our own


@dataclass(eq=False)
class Watcher:
    """One open page."""

    id: int
    window: Window = field(default_factory=Window)
    wake: asyncio.Event = field(default_factory=asyncio.Event)
    busy: bool = False  # an edit of this watcher is being planned
    waiting: requests.Try | None = None  # the newest one that came meanwhile

    def note(self, message: dict[str, Any]) -> None:
        self.window.note(msgspec.msgpack.encode(message))
        self.wake.set()


class Hub:
    """All watchers, and what they watch. Lives in the event loop's thread."""

    def __init__(self, source: Source, options: WebOptions) -> None:
        self._source, self._options = source, options
        self._watchers: dict[int, Watcher] = {}
        self._lease = Lease()
        self._history: deque[bytes] = deque(maxlen=KEPT_EVENTS)
        self._picture = b""
        self._count = 0
        self._tasks: set[asyncio.Task[None]] = set()

    async def pump(self) -> None:
        """Look at the source for ever, and offer what is new to every watcher."""
        told_s, took_s = 0.0, 0.0
        while True:
            await asyncio.sleep(LOOK_S if self._watchers else AT_LEAST_S)
            for note in self._source.notes():
                self._history.append(msgspec.msgpack.encode(note))
                self._each(lambda w: w.window.note(self._history[-1]))
            if not self._watchers:
                continue
            picture = self._source.picture()
            if picture is not None:
                self._picture = msgspec.msgpack.encode({"k": "picture", "stamp_ms": time.time() * 1e3, **picture})
                self._each(lambda w: w.window.offer("picture", self._picture))
            now_s = time.monotonic()
            rested = now_s - told_s >= took_s / MOST_SHARE
            if rested and (self._source.changed() or now_s - told_s >= AT_LEAST_S):
                self.tell()
                told_s, took_s = now_s, time.monotonic() - now_s

    def tell(self) -> None:
        """Offer the present state to everyone."""
        self._lease.free(time.monotonic())  # a silent holder loses it
        head = {"k": "state", "stamp_ms": time.time() * 1e3, "holder": self._lease.holder, "watchers": len(self._watchers)}
        body = msgspec.msgpack.encode(head | self._source.snapshot())
        self._each(lambda w: w.window.offer("state", body))

    def _each(self, do: Callable[[Watcher], None]) -> None:
        for watcher in self._watchers.values():
            do(watcher)
            watcher.wake.set()

    async def watch(self, websocket: WebSocket) -> None:
        """One page's connection, from hello to its end."""
        headers = websocket.headers
        if not origin_allowed(self._options, headers.get("host", ""), headers.get("origin", "")):
            await websocket.close(NOT_ALLOWED)  # before accept: the handshake fails with 403
            return
        await websocket.accept()
        if len(self._watchers) >= MOST_WATCHERS:
            await websocket.close(TOO_MANY, f"{MOST_WATCHERS} pages are open already")
            return
        try:
            hello = await asyncio.wait_for(_receive(websocket), HELLO_WITHIN_S)
        except (requests.BadRequest, TimeoutError, WebSocketDisconnect):
            hello = None
        if not isinstance(hello, requests.Hello) or not token_allowed(self._options, hello.token):
            with contextlib.suppress(RuntimeError, WebSocketDisconnect):
                await websocket.close(NOT_ALLOWED, "wrong token")
            return
        self._count += 1
        watcher = Watcher(self._count)
        watcher.note({"k": "hello", "you": watcher.id, "scene": self._source.scene()})
        for body in self._history:
            watcher.window.note(body)
        if self._picture:
            watcher.window.offer("picture", self._picture)
        self._watchers[watcher.id] = watcher
        sender = asyncio.create_task(_send(websocket, watcher))
        try:
            await self._listen(websocket, watcher)
        finally:
            sender.cancel()
            del self._watchers[watcher.id]
            self._lease.leave(watcher.id)

    async def _listen(self, websocket: WebSocket, watcher: Watcher) -> None:
        while True:
            try:
                request = await _receive(websocket)
            except WebSocketDisconnect:
                return
            except requests.BadRequest as error:
                log.warning("page: a message that is none of ours: %s", error)
                await websocket.close(BAD_REQUEST, str(error)[:100])
                return
            self._lease.heard(watcher.id, time.monotonic())
            self._take(watcher, request)

    def _take(self, watcher: Watcher, request: requests.Request) -> None:
        now_s = time.monotonic()
        if isinstance(request, requests.Ack):
            watcher.window.acknowledge(request.n, now_s)
            watcher.wake.set()
        elif isinstance(request, requests.Take):
            self._lease.ask(watcher.id, now_s, request.over)
            self.tell()
        elif isinstance(request, requests.Release):
            self._lease.leave(watcher.id)
            self.tell()
        elif isinstance(request, requests.Wish):
            self._spawn(self._order(watcher, request))
        elif isinstance(request, requests.Tune):
            self._spawn(self._tune(watcher, request))
        elif isinstance(request, requests.Try):
            watcher.waiting = request
            if not watcher.busy:
                self._spawn(self._attempt(watcher))
        elif isinstance(request, requests.Save):
            self._spawn(self._save(watcher, request))
        elif isinstance(request, requests.Seek):
            self._source.seek(request.time_s, request.rate)

    def _spawn(self, work: Any) -> None:
        task: asyncio.Task[None] = asyncio.create_task(work)
        self._tasks.add(task)  # a task that nobody holds may vanish
        task.add_done_callback(self._tasks.discard)

    def _may_command(self, watcher: Watcher) -> str:
        if self._lease.holder == watcher.id:
            return ""
        return "another page has control" if self._lease.holder else "take control first"

    async def _order(self, watcher: Watcher, wish: requests.Wish) -> None:
        order = Order[wish.order.upper().replace("-", "_")]
        reason = "" if order is Order.STOP else self._may_command(watcher)
        if not reason:
            reason = await asyncio.to_thread(self._source.order, order)
        watcher.note({"k": "reply", "n": wish.n, "order": wish.order, "ok": not reason, "reason": reason})
        self.tell()

    async def _tune(self, watcher: Watcher, wish: requests.Tune) -> None:
        reason = self._may_command(watcher) or await asyncio.to_thread(self._source.tune, wish.values, wish.next_lap)
        watcher.note({"k": "reply", "n": wish.n, "order": "tune", "ok": not reason, "reason": reason})
        self.tell()

    async def _attempt(self, watcher: Watcher) -> None:
        """Plan the newest edit, and again while newer ones come; those in between were only passed over while dragging."""
        watcher.busy = True
        try:
            while (tried := watcher.waiting) is not None:
                watcher.waiting = None
                watcher.note({"k": "tried", "n": tried.n} | await asyncio.to_thread(self._source.attempt, tried.edit))
        finally:
            watcher.busy = False

    async def _save(self, watcher: Watcher, request: requests.Save) -> None:
        reason = self._may_command(watcher)
        done = (
            {"ok": False, "problems": [reason]}
            if reason
            else await asyncio.to_thread(self._source.save, request.edit, request.name)
        )
        watcher.note({"k": "saved", "n": request.n} | done)


async def _receive(websocket: WebSocket) -> requests.Request:
    message = await websocket.receive()
    if message["type"] == "websocket.disconnect":
        raise WebSocketDisconnect(message.get("code", 1000))
    return requests.read_request(message.get("text") or message.get("bytes") or "")


async def _send(websocket: WebSocket, watcher: Watcher) -> None:
    with contextlib.suppress(RuntimeError, WebSocketDisconnect, OSError):  # it has gone: `_listen` notices too
        while True:
            frame = watcher.window.next(time.monotonic())
            if frame is None:
                watcher.wake.clear()
                await watcher.wake.wait()
                continue
            await websocket.send_bytes(HEAD.pack(frame[0], watcher.window.round_trip_s * 1e3) + frame[1])
