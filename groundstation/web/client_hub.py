"""SHELL: hub of all open pages and the backend that they watch. Lives in the page's event loop (server.py).

Frames to a page: u32 number, f32 round trip of the last one in ms, then a MessagePack map. From the page: small JSON texts
(protocol.py). Nothing ever waits for a page: see send_window.py.
"""

import asyncio
import contextlib
import struct
import time
from collections import deque
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from typing import Any, TypeVar

import msgspec
from starlette.websockets import WebSocket, WebSocketDisconnect

from groundstation.mission.state_machine import order_named
from groundstation.web import protocol
from groundstation.web.backend import ALWAYS, Backend, Validity
from groundstation.web.experiment_editor import attempt, drafted, flight_text, loadable, save
from groundstation.web.run_desk import RunDesk
from groundstation.web.send_window import SendWindow
from shoal.bus.bus import request_clock_ns
from shoal.bus.command_deduplication import ALWAYS_TAKEN
from shoal.errors import ConfigError
from shoal.messages.messages import WHOLE_FLEET, CommandKind, DriveVelocity
from shoal.runtime.runtime import log
from shoal.runtime.web_access import WebOptions, origin_allowed, token_allowed
from shoal.system.printable import printable

LOOK_S = 0.02  # how often the inboxes are looked at; a state waits half of this on average
MOST_SHARE = 0.25  # of the interpreter, which the control cycle needs too: large fleets are shown less often
AT_LEAST_S = 0.25  # ages go on also when nothing comes
MOST_WATCHERS = 16
HELLO_WITHIN_S = 5.0
MOST_STRANGERS = 32  # connections that have not said who they are: one more ends the oldest
SILENT_S = 5.0  # without a sign of life, then control is free
ORDER_VALID_S = 3.0  # from the newest state that the page had, to the order's arrival: what was meant for then is void now
DRIVE_VALID_S = 1.0  # the same for a velocity: a person steers by what the page shows
COMPLAIN_EVERY_S = 10.0  # when looking or telling fails again and again
FAREWELL_S = 0.2  # for pages to be sent the last state
HEAD = struct.Struct("<If")
FILES_WITHIN_S = 3.0  # what a page of a run that is flown waits for its files
NO_FILES = {"report": "", "end": None, "loadable": ()}  # of a run, where they cannot be read

# WebSocket close codes of our own
TOO_MANY, ELSEWHERE, NOT_ALLOWED, BAD_REQUEST = 4001, 4002, 4003, 4000
REASON_BYTES = 123  # of a closing connection (RFC 6455, section 5.5)

T = TypeVar("T")
NEWEST = (protocol.DriveRequest, protocol.PreviewEdit, protocol.PreviewFlight)  # requests of which only the newest counts


class ControlLease:
    """Lease of control: one page at a time may command; watchers are numbered from 1.

    A browser that has stopped taking frames loses control after SILENT_S, so that a closed laptop never keeps others out. If
    nobody has asked for it meanwhile, its next sign of life takes it back. The emergency stop needs no lease.
    """

    def __init__(self) -> None:
        self.holder = 0  # no page
        self._heard_s = 0.0
        self._silent = 0  # the page that lost control by silence

    def ask(self, client: int, now_s: float, over: bool = False) -> bool:
        """Ask for control; True if `client` has it now. It is given when it is free, or with `over` in any case."""
        if over or self.free(now_s) or self.holder == client:
            self.holder, self._heard_s, self._silent = client, now_s, 0
        return self.holder == client

    def note_life(self, client: int, now_s: float) -> None:
        """A sign of life."""
        if client == self._silent:
            self.ask(client, now_s)
        if client == self.holder:
            self._heard_s = now_s

    def free(self, now_s: float) -> bool:
        """True if no page has control, or its holder went silent."""
        if self.holder and now_s - self._heard_s > SILENT_S:
            self.holder, self._silent = 0, self.holder
        return self.holder == 0

    def leave(self, client: int) -> None:
        """Give it back, or be gone."""
        if client == self.holder:
            self.holder = 0
        if client == self._silent:
            self._silent = 0


@dataclass(eq=False)
class Client:
    """One open page."""

    id: int
    websocket: WebSocket
    page: str = ""  # by which it is known when it comes back
    camera: str = ""  # one of several: its picture is shown here
    shown_ns: int = -1  # stamp of the picture that was sent last
    window: SendWindow = field(default_factory=SendWindow)
    wake: asyncio.Event = field(default_factory=asyncio.Event)
    busy: set[type[protocol.Request]] = field(default_factory=set)  # kinds of NEWEST of which one is being dealt with
    waiting: dict[type[protocol.Request], protocol.Request] = field(default_factory=dict)  # the newest that came meanwhile

    def answer(self, message: dict[str, Any]) -> None:
        self.window.answer(packed(message))
        self.wake.set()


class ClientHub:
    """All open pages, and the backend. Lives in the event loop's thread."""

    def __init__(self, source: Backend, options: WebOptions, desk: RunDesk) -> None:
        self._source, self._options, self._desk = source, options, desk
        self._watchers: dict[int, Client] = {}
        self._lease = ControlLease()
        self._history: deque[bytes] = deque(maxlen=source.kept_events)
        self._count = 0
        self._tasks: set[asyncio.Task[None]] = set()
        self._strangers: deque[asyncio.Task[protocol.Request]] = deque()
        self._complained_s = -COMPLAIN_EVERY_S
        # The emergency stop has a thread of its own: nothing else that a page may ask for ever keeps it waiting.
        self._stops = ThreadPoolExecutor(1, "page-stop")
        self._orders = ThreadPoolExecutor(1, "page-order")  # one: what was asked for first is done first
        self._plans = ThreadPoolExecutor(2, "page-plan")
        self._runs = ThreadPoolExecutor(1, "page-runs")
        self._files = ThreadPoolExecutor(1, "page-files")

    @property
    def watched(self) -> bool:
        """True if a page is connected. From any thread."""
        return bool(self._watchers)

    async def farewell(self) -> None:
        """Tell the last state before the server ends, also to pages that are slow to acknowledge: all then know how the run
        ended."""
        if self._watchers:
            self._each(lambda w: w.window.end())
            self._offer_now()
            await asyncio.sleep(FAREWELL_S)

    def close(self) -> None:
        """Wait for nothing that is still at work."""
        for threads in (self._stops, self._orders, self._plans, self._runs, self._files):
            threads.shutdown(wait=False, cancel_futures=True)

    async def pump(self) -> None:
        """Offer what is new in the source to every page, for ever. A failure goes into the log, and the next look tries again:
        a page that receives nothing says so itself."""
        offered_s, took_s = 0.0, 0.0  # when the state was offered last, and how long that took
        while True:
            try:
                self._offer_news()
                now_s = time.monotonic()
                may_offer = now_s - offered_s >= took_s / MOST_SHARE  # so that pages take no more than a share of the time
                if may_offer and ((self._watchers and self._source.changed()) or now_s - offered_s >= AT_LEAST_S):
                    offered_s = now_s
                    self.offer_state()
                    took_s = time.monotonic() - now_s
            except Exception as error:
                self._complain(error)
            await asyncio.sleep(LOOK_S if self._watchers else AT_LEAST_S)

    def _complain(self, error: Exception) -> None:
        """Log an error that keeps the page from new states, at most once in COMPLAIN_EVERY_S."""
        now_s = time.monotonic()
        if now_s - self._complained_s >= COMPLAIN_EVERY_S:
            self._complained_s = now_s
            log.error("page: nothing new is shown: %s: %s", type(error).__name__, error)

    def _offer_news(self) -> None:
        """Offer what the backend has that is new to every page: log lines, the robots' paths, and pictures."""
        for note in self._source.notes():
            self._history.append(packed(note))
            self._each(lambda w: w.window.note(self._history[-1]))
        paths = self._source.paths()
        if paths is not None:
            body = packed({"k": "paths", "paths": paths})
            self._each(lambda w: w.window.offer("paths", body))
        for camera, shown_ns in {(w.camera, w.shown_ns) for w in self._watchers.values()}:
            self._show(camera, shown_ns)

    def _show(self, camera: str, shown_ns: int) -> None:
        """Offer a camera's newest picture to all pages that show this camera and were sent the picture of that stamp last."""
        picture = self._source.picture(camera, shown_ns)
        if picture is None:
            return
        frame = {
            "k": "picture",
            "stamp_ms": time.time() * 1e3,
            "clock_ms": request_clock_ns() // 1_000_000,
            "camera": camera,
            "age_ms": picture.age_ms,
            "time_s": picture.time_s,
            "jpeg": picture.jpeg,
        }
        body = packed(frame)
        for watcher in self._watchers.values():
            if (watcher.camera, watcher.shown_ns) == (camera, shown_ns):
                watcher.shown_ns = picture.stamp_ns
                watcher.window.offer("picture", body)
                watcher.wake.set()

    def offer_state(self) -> None:
        """Offer the present state to every watcher."""
        self._lease.free(time.monotonic())  # a silent holder loses it
        head: dict[str, Any] = {
            "k": "state",
            "stamp_ms": time.time() * 1e3,
            "holder": self._lease.holder,
            "watchers": len(self._watchers),
            "clock_ms": request_clock_ns() // 1_000_000,  # comes back with a request
        }
        body = packed(head | self._source.snapshot())
        self._each(lambda w: w.window.offer("state", body))

    def _each(self, do: Callable[[Client], None]) -> None:
        for watcher in self._watchers.values():
            do(watcher)
            watcher.wake.set()

    async def watch(self, websocket: WebSocket) -> None:
        """Serve one page's connection, from hello to its end."""
        headers = websocket.headers
        if not origin_allowed(self._options, headers.get("host", ""), headers.get("origin", "")):
            await websocket.close(NOT_ALLOWED)  # before accept: the handshake fails with 403
            return
        await websocket.accept()
        if len(self._watchers) >= MOST_WATCHERS:
            await websocket.close(TOO_MANY, f"{MOST_WATCHERS} pages are open already")
            return
        hello = await self._receive_hello(websocket)
        if hello is None or not token_allowed(self._options, hello.token):
            with contextlib.suppress(RuntimeError, WebSocketDisconnect):
                await websocket.close(NOT_ALLOWED, "wrong token")
            return
        if len(self._watchers) >= MOST_WATCHERS:  # others came while this one introduced itself
            await websocket.close(TOO_MANY, f"{MOST_WATCHERS} pages are open already")
            return
        self._count += 1
        watcher = Client(self._count, websocket, hello.page, self._camera(hello.camera))
        events = [msgspec.Raw(body) for body in self._history]
        greeting: dict[str, Any] = {"k": "hello", "you": watcher.id, "scene": self._source.scene(), "events": events}
        watcher.answer({"k": "past", "states": self._source.past()})
        self._replace(watcher)
        self._watchers[watcher.id] = watcher
        self._offer_now()
        sender = asyncio.create_task(self._greet(websocket, watcher, greeting))
        try:
            await self._listen(websocket, watcher)
        finally:
            sender.cancel()
            del self._watchers[watcher.id]
            self._lease.leave(watcher.id)

    async def _greet(self, websocket: WebSocket, watcher: Client, greeting: dict[str, Any]) -> None:
        """Send a page its greeting, with the files of its run, and then all that comes. In a flight the greeting does not wait
        for a disk that hangs: the page needs its STOP."""
        reading = asyncio.create_task(self._in_thread(self._files, lambda _: NO_FILES, self._files_of_run))
        scene = greeting["scene"]
        await asyncio.wait({reading}, timeout=None if scene["mode"] == "replay" else FILES_WITHIN_S)
        scene |= reading.result() if reading.done() else NO_FILES
        watcher.window.greet(packed(greeting))
        await _send(websocket, watcher)

    def _files_of_run(self) -> dict[str, Any]:
        """The part of a scene that is read from the disk: the run's report and end, and experiments that can be loaded."""
        experiments = loadable(self._source.experiment.robot_ids)
        return {"report": self._desk.shown_report, "end": self._desk.shown_end, "loadable": experiments}

    async def _receive_hello(self, websocket: WebSocket) -> protocol.Hello | None:
        """Receive a connection's first message: None if it is no hello, or does not come in time."""
        first = asyncio.create_task(_receive(websocket))
        self._strangers.append(first)
        if len(self._strangers) > MOST_STRANGERS:
            self._strangers[0].cancel()
        try:
            await asyncio.wait({first}, timeout=HELLO_WITHIN_S)
        finally:
            self._strangers.remove(first)
            first.cancel()
        if not first.done() or first.cancelled() or first.exception() is not None:
            return None
        message = first.result()
        return message if isinstance(message, protocol.Hello) else None

    def _replace(self, watcher: Client) -> None:
        """Give a page that comes back over another connection the control that it had: its earlier connection is dead, and
        does not know it yet."""
        for before in list(self._watchers.values()):
            if watcher.page and before.page == watcher.page:
                if self._lease.holder == before.id:
                    self._lease.ask(watcher.id, time.monotonic(), over=True)
                self._spawn(_close(before.websocket, ELSEWHERE, "the page has come back over another connection"))

    async def _listen(self, websocket: WebSocket, watcher: Client) -> None:
        """Act on a page's messages until its connection ends. A request with a wrong value is answered; a message that no page
        sends ends the connection."""
        while True:
            try:
                request = await _receive(websocket)
            except WebSocketDisconnect:
                return
            except protocol.BadRequest as error:
                if error.answer is not None:  # a typing error must not end the connection, and with it a person's lease
                    self._lease.note_life(watcher.id, time.monotonic())
                    watcher.answer(error.answer)
                    continue
                log.warning("page: a message that is none of ours: %s", error)
                await websocket.close(BAD_REQUEST, str(error).encode()[:REASON_BYTES].decode(errors="ignore"))
                return
            self._lease.note_life(watcher.id, time.monotonic())
            self._act_on(watcher, request)

    def _act_on(self, watcher: Client, request: protocol.Request) -> None:
        """Act on one message of a page."""
        now_s = time.monotonic()
        if isinstance(request, protocol.Ack):
            watcher.window.acknowledge(request.n, now_s)
            watcher.wake.set()
        elif isinstance(request, protocol.Take):
            self._lease.ask(watcher.id, now_s, request.over)
            self._offer_now()
        elif isinstance(request, protocol.Release):
            self._lease.leave(watcher.id)
            self._offer_now()
        elif isinstance(request, protocol.OrderRequest):
            self._spawn(self._request(watcher, request))
        elif isinstance(request, NEWEST):
            watcher.waiting[type(request)] = request
            if type(request) not in watcher.busy:
                watcher.busy.add(type(request))  # at once: the next request may be taken in before the task has begun
                self._spawn(self._follow(watcher, type(request)))
        elif isinstance(request, protocol.TuneRequest):
            self._spawn(self._request_gains(watcher, request))
        elif isinstance(request, protocol.Save):
            self._spawn(self._save(watcher, request))
        elif isinstance(request, protocol.OfRuns):
            self._spawn(self._answer_of_runs(watcher, request))
        elif isinstance(request, protocol.ChooseCamera):
            watcher.camera, watcher.shown_ns = self._camera(request.camera), -1
        elif isinstance(request, protocol.Remark):
            self._source.remark(request.text)
        elif isinstance(request, protocol.Seek):
            self._source.seek(request.time_s, request.rate)
        elif isinstance(request, protocol.AfterRun):
            self._spawn(self._choose(watcher, request))

    def _camera(self, name: str) -> str:
        """The camera of that name; the first one where there is none."""
        experiment = self._source.experiment
        return name if name in experiment.camera_names else experiment.shown_camera

    def _spawn(self, work: Any) -> None:
        task: asyncio.Task[None] = asyncio.create_task(work)
        self._tasks.add(task)  # a task without a reference may vanish
        task.add_done_callback(self._tasks.discard)

    def _control_refusal(self, watcher: Client) -> str:
        """Reason for which a page may not command the fleet; empty if it may."""
        if self._lease.holder == watcher.id:
            return ""
        return "another page has control" if self._lease.holder else "take control first"

    async def _in_thread(
        self, threads: ThreadPoolExecutor, failed: Callable[[str], T], do: Callable[..., T], *arguments: Any
    ) -> T:
        """Result of work in a thread; where it raises, what `failed` makes of the reason: the page waits for an answer."""
        try:
            return await asyncio.get_running_loop().run_in_executor(threads, do, *arguments)
        except Exception as error:
            reason = f"failed: {type(error).__name__}: {error}"
            log.error("page: a request %s", reason, exc_info=error)
            return failed(reason)

    async def _run_order(self, objection: Callable[[], str], failed: Callable[[str], T], do: Callable[[], T]) -> T:
        """Result of an order in the one thread of orders, or what `failed` makes of an objection. The objection is asked for
        again when the order's turn comes, for those before it may have taken long."""

        def judged() -> T:
            reason = objection()
            return failed(reason) if reason else do()

        reason = objection()
        return failed(reason) if reason else await self._in_thread(self._orders, failed, judged)

    async def _follow(self, watcher: Client, kind: type[protocol.Request]) -> None:
        """Deal with the newest request of a kind, and again while newer ones come; those in between are passed over."""
        try:
            while (request := watcher.waiting.pop(kind, None)) is not None:
                if isinstance(request, protocol.DriveRequest):
                    await self._drive(watcher, request)
                elif isinstance(request, protocol.PreviewEdit):
                    await self._preview_edit(watcher, request)
                elif isinstance(request, protocol.PreviewFlight):
                    await self._preview_flight(watcher, request)
        finally:
            watcher.busy.discard(kind)

    def _lateness_refusal(self, seen_ms: int, valid_s: float) -> str:
        """Reason for which a request is too old, by the newest state that the page had; empty if it is not."""
        late_s = _age_s(seen_ms)
        if late_s < -1.0:  # a page that was open when this computer started anew, and has seen nothing of this station
            return "this is about a run before this computer's start, and was not done"
        return f"this came {late_s:.0f} s late, and was not done" if late_s > valid_s else ""

    async def _request(self, watcher: Client, request: protocol.OrderRequest) -> None:
        """Make a page's request of the station, and answer the page. Any page may stop the fleet, however late it comes."""
        order, station = order_named(request.order), self._source.station
        valid = ALWAYS if order in ALWAYS_TAKEN else _validity(request.seen_ms, ORDER_VALID_S)

        def objection() -> str:
            late = "" if order in ALWAYS_TAKEN else self._lateness_refusal(request.seen_ms, ORDER_VALID_S)
            return self._control_refusal(watcher) or late

        if order is CommandKind.STOP:
            reason, number = await self._in_thread(self._stops, _refused, station.request, order)
        elif order is CommandKind.PATH:
            reason, number = await self._request_path(request, objection, valid)
        else:
            reason, number = await self._run_order(
                objection,
                _refused,
                lambda: station.request(order, request.via_m, request.robot, request.text, valid),
            )
        self._answer(watcher, request.n, request.order, reason, number)

    async def _request_path(
        self, request: protocol.OrderRequest, objection: Callable[[], str], valid: Validity
    ) -> tuple[str, int]:
        """Ask the station for another path. A disk that hangs keeps no other order waiting: the path has its turn, is read
        beside the orders, and is flown only if no request has been made since its turn."""
        path, station = CommandKind.PATH, self._source.station
        reason, asked_s = await self._run_order(objection, lambda why: (why, 0.0), lambda: ("", time.monotonic()))
        if reason:
            return reason, 0

        def read() -> tuple[str, str]:
            try:
                return "", flight_text(self._source.experiment, path, request.text, request.edit)
            except ConfigError as error:
                return str(error), ""

        reason, text = await self._in_thread(self._files, lambda why: (why, ""), read)
        if reason:
            return reason, 0
        valid = replace(valid, asked_s=asked_s)
        return await self._run_order(objection, _refused, lambda: station.request(path, (), WHOLE_FLEET, text, valid))

    async def _drive(self, watcher: Client, drive: protocol.DriveRequest) -> None:
        """Tell the station a velocity. The page hears of refusals alone."""
        velocity = DriveVelocity(drive.surge_mps, drive.heave_mps, drive.yaw_rate_radps)
        reason = await self._run_order(
            lambda: self._control_refusal(watcher) or self._lateness_refusal(drive.seen_ms, DRIVE_VALID_S),
            str,
            lambda: self._source.station.drive(drive.robot, velocity, _validity(drive.seen_ms, DRIVE_VALID_S)),
        )
        if reason:
            watcher.answer({"k": "undriven", "robot": drive.robot, "reason": reason})

    async def _request_gains(self, watcher: Client, request: protocol.TuneRequest) -> None:
        """Request a change of gains from the station, and reply to the page."""
        reason, number = await self._run_order(
            lambda: self._control_refusal(watcher) or self._lateness_refusal(request.seen_ms, ORDER_VALID_S),
            _refused,
            lambda: self._source.station.request_gains(
                request.values, request.next_lap, _validity(request.seen_ms, ORDER_VALID_S)
            ),
        )
        self._answer(watcher, request.n, "tune", reason, number)

    def _answer(self, watcher: Client, n: int, order: str, reason: str, number: int) -> None:
        watcher.answer({"k": "reply", "n": n, "order": order, "ok": not reason, "reason": reason, "request": number})
        self._offer_now()

    def _offer_now(self) -> None:
        """Offer the state as `offer_state` does, where a state that cannot be packed must end nothing else."""
        try:
            self.offer_state()
        except Exception as error:
            self._complain(error)

    async def _preview_edit(self, watcher: Client, request: protocol.PreviewEdit) -> None:
        """Answer a page with the paths that its edit of the experiment would give, or the reasons against it."""
        answer = await self._in_thread(self._plans, _unfit, attempt, self._source.experiment, request.edit)
        watcher.answer({"k": "tried", "n": request.n} | answer)

    async def _preview_flight(self, watcher: Client, request: protocol.PreviewFlight) -> None:
        """Answer a page with the plan that an order would give in flight, or the reasons against it."""
        order, station = order_named(request.order), self._source.station
        answer = await self._in_thread(
            self._plans, _unfit, drafted, self._source.experiment, order, request.text, station.draft
        )
        watcher.answer({"k": "drafted", "n": request.n} | answer)

    async def _save(self, watcher: Client, request: protocol.Save) -> None:
        """Save a page's edit as an experiment's file, and answer with its name or the reason against it."""
        reason = self._control_refusal(watcher)
        done = (
            _unfit(reason)
            if reason
            else await self._in_thread(self._plans, _unfit, save, self._source.experiment, request.edit, request.name)
        )
        watcher.answer({"k": "saved", "n": request.n} | done)

    async def _choose(self, watcher: Client, request: protocol.AfterRun) -> None:
        """Do what a page chose after an ended run: fly again, fly its edit, or close; answer with the problems, if any."""
        reason = self._control_refusal(watcher)
        problems = (
            [reason]
            if reason
            else await self._in_thread(self._plans, lambda why: [why], self._source.choose, request.what, request.edit)
        )
        watcher.answer({"k": "chosen", "n": request.n, "problems": problems})

    async def _answer_of_runs(self, watcher: Client, request: protocol.OfRuns) -> None:
        """The list of runs, after the change that was asked for. Pages that watch may look."""
        desk, reason = self._desk, self._control_refusal(watcher)
        if isinstance(request, protocol.ListRuns):
            answer = await self._in_thread(self._runs, desk.empty_listing, desk.listing)
        elif reason:
            answer = await self._in_thread(self._runs, desk.empty_listing, desk.listing, reason)
        elif isinstance(request, protocol.LabelRun):
            answer = await self._in_thread(self._runs, desk.empty_listing, desk.label, request.run, request.name, request.tags)
        else:
            answer = await self._in_thread(self._runs, desk.empty_listing, desk.delete, request.run)
        watcher.answer(answer)


def _age_s(seen_ms: int) -> float:
    """Age of what a page has seen, by the clock that it was told, which goes on while this machine sleeps."""
    return (request_clock_ns() - seen_ms * 1_000_000) * 1e-9


def _validity(seen_ms: int, valid_s: float) -> Validity:
    """Bounds of a request by what its page has seen."""
    return Validity(time.monotonic() + valid_s - _age_s(seen_ms))


def _refused(reason: str) -> tuple[str, int]:
    """The station's answer to a request that it refuses."""
    return reason, 0


def _unfit(reason: str) -> dict[str, Any]:
    """The planner's answer about what cannot be flown."""
    return {"ok": False, "problems": [reason]}


def packed(message: dict[str, Any]) -> bytes:
    """The wire form of a message for a page. Files may give what MessagePack cannot carry: half a character, a folder's name
    that is no UTF-8, an integer of more than 64 bits. It is written out, and the rest still comes."""
    try:
        return msgspec.msgpack.encode(message)
    except (UnicodeEncodeError, OverflowError):
        return msgspec.msgpack.encode(_carried(message))


def _carried(value: Any) -> Any:
    """A value in which every text and every integer can be packed."""
    if isinstance(value, dict):
        return {_carried(key): _carried(entry) for key, entry in value.items()}
    if isinstance(value, list | tuple):
        return [_carried(entry) for entry in value]
    if isinstance(value, str):
        return printable(value)
    too_large = isinstance(value, int) and not -(1 << 63) <= value < 1 << 64
    return f"{value:#x}" if too_large else value


async def _close(websocket: WebSocket, code: int, why: str) -> None:
    with contextlib.suppress(RuntimeError, WebSocketDisconnect, OSError):
        await websocket.close(code, why)


async def _receive(websocket: WebSocket) -> protocol.Request:
    """The next request of a page. Raises WebSocketDisconnect, and BadRequest for a message that is none."""
    message = await websocket.receive()
    if message["type"] == "websocket.disconnect":
        raise WebSocketDisconnect(message.get("code", 1000))
    return protocol.read_request(message.get("text") or message.get("bytes") or "")


async def _send(websocket: WebSocket, watcher: Client) -> None:
    """Send a page its frames as its window allows, until the connection ends."""
    with contextlib.suppress(RuntimeError, WebSocketDisconnect, OSError):  # it has gone: `_listen` notices too
        while True:
            frame = watcher.window.next(time.monotonic())
            if frame is None:
                watcher.wake.clear()
                await watcher.wake.wait()
                continue
            await websocket.send_bytes(HEAD.pack(frame[0], watcher.window.round_trip_s * 1e3) + frame[1])
