"""The page's server on a real socket, fed by a real desk on the in-memory bus: strangers, stopped pages, leases, orders."""

import contextlib
import fcntl
import json
import logging
import os
import select
import socket
import struct
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from itertools import pairwise
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
from foxglove_schemas_protobuf.Log_pb2 import Log
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.sync.client import ClientConnection, connect
from websockets.typing import Origin

from groundstation.deploy import key_ring
from groundstation.planning import planner
from groundstation.telemetry import RobotView
from groundstation.web import client_hub, connection_limits, protocol, server
from groundstation.web.backend import ALWAYS, Validity
from groundstation.web.live_backend import PAST_EVERY_S, LiveBackend
from groundstation.web.send_window import UNACKNOWLEDGED
from groundstation.web.server import WebServer, bind
from shoal.bus.bus import Bus
from shoal.bus.memory_transport import MemoryHub, MemoryTransport
from shoal.config.experiment import Experiment, load_experiment
from shoal.errors import ConfigError
from shoal.messages import codec, topics
from shoal.messages.messages import CommandKind, DriveVelocity, Event, Mode, Outcome, Preview, Progress, RobotState, Trajectory
from shoal.runtime.runtime import log
from shoal.runtime.web_access import WebOptions, body_fits
from tests.groundstation.fake_station import FakeStation
from tests.waiting import eventually

pytestmark = pytest.mark.real_time

POOL = load_experiment("pool")
HEAD = struct.Struct("<If")
PATIENCE_S = 20.0
TOKEN = "correct horse battery staple"


@dataclass(kw_only=True)
class ServedStation(FakeStation):
    """A station's bus, and the page's server on it."""

    port: int
    robots: Bus
    opened: contextlib.ExitStack
    blocked: threading.Event | None = None  # whoever asks for anything but a stop waits for it

    def say(self, robot: int = 1) -> None:
        self.robots.publish(topics.STATE, RobotState(mode=Mode.ARMED, fault="here"), time.time_ns(), robot)

    def request(
        self,
        order: CommandKind,
        via: Sequence[tuple[float, float]] = (),
        only: int = 0,
        text: str = "",
        valid: Validity = ALWAYS,
    ) -> tuple[str, int]:
        if self.blocked is not None and order is not CommandKind.STOP:
            self.blocked.wait(PATIENCE_S)
        accepted = super().request(order, via, only, text, valid)
        return ("not now", 0) if order is CommandKind.HOLD else accepted

    def drive(self, robot: int, velocity: DriveVelocity, valid: Validity = ALWAYS) -> str:
        if self.blocked is not None:
            self.blocked.wait(PATIENCE_S)
        return super().drive(robot, velocity, valid)

    def request_gains(self, values: Any, next_lap: bool, valid: Validity = ALWAYS) -> tuple[str, int]:
        if self.blocked is not None:
            self.blocked.wait(PATIENCE_S)
        return super().request_gains(values, next_lap, valid)

    def open(self, **options: Any) -> "PageClient":
        options.setdefault("origin", f"http://127.0.0.1:{self.port}")
        return PageClient(self.opened.enter_context(connect(f"ws://127.0.0.1:{self.port}/live", max_size=None, **options)))

    def open_in_control(self) -> "PageClient":
        """A page that has said who it is, and has been given control."""
        page = self.open()
        page.hello()
        page.say(kind="take")
        page.until(lambda f: state(f) and f["holder"] != 0)
        return page


@dataclass
class PageClient:
    """The actions of a browser that the server can see."""

    socket: ClientConnection
    last: int = 0
    clock_ms: int = 0

    def say(self, **request: Any) -> None:
        self.socket.send(json.dumps(request))

    def hear(self) -> dict[str, Any]:
        """The next frame, acknowledged."""
        data = self.socket.recv(timeout=20)
        assert isinstance(data, bytes)
        self.last, _ = HEAD.unpack(data[: HEAD.size])
        self.say(kind="ack", n=self.last)
        frame: dict[str, Any] = msgspec.msgpack.decode(data[HEAD.size :])
        self.clock_ms = frame.get("clock_ms", self.clock_ms)
        return frame

    def order(self, n: int, order: str) -> None:
        """Ask for something, having seen the newest state."""
        self.say(kind="order", n=n, order=order, seen_ms=self.clock_ms)

    def until(self, wanted: Callable[[dict[str, Any]], bool]) -> dict[str, Any]:
        for _ in range(500):
            frame = self.hear()
            if wanted(frame):
                return frame
        raise AssertionError("never came")

    def hello(self, token: str = TOKEN, page: str = "", camera: str = "") -> dict[str, Any]:
        """Introduced, and past the first state."""
        self.say(kind="hello", token=token, page=page, camera=camera)
        greeting = self.until(lambda frame: frame["k"] == "hello")
        self.until(state)
        return greeting


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def make_desk(lab: ServedStation, run_dir: Path | None = None) -> LiveBackend:
    return LiveBackend(
        lab.experiment, planner.plan(lab.experiment), lab.bus, lab.inboxes, lab.clock, lab, "real-time", run_dir
    )


@pytest.fixture
def lab() -> Iterator[ServedStation]:
    with _served() as station:
        yield station


@contextlib.contextmanager
def _served(run_dir: Path | None = None, experiment: Experiment = POOL) -> Iterator[ServedStation]:
    hub, port = MemoryHub(), free_port()
    with Bus(MemoryTransport(hub)) as bus, Bus(MemoryTransport(hub)) as robots:
        opened = contextlib.ExitStack()
        station = ServedStation(experiment, bus, port=port, robots=robots, opened=opened)
        with WebServer(make_desk(station, run_dir), WebOptions(port=port, token=TOKEN)), opened:
            yield station


def state(frame: dict[str, Any]) -> bool:
    return bool(frame["k"] == "state")


def test_a_page_gets_the_scene_then_states_as_they_come(lab: ServedStation) -> None:
    page = lab.open()
    hello = page.hello()
    assert [robot["id"] for robot in hello["scene"]["robots"]] == [1, 2]
    lab.say(robot=2)
    frame = page.until(lambda f: state(f) and "state" in f["robots"][1])
    assert frame["robots"][1]["state"]["mode"] == "ARMED"
    assert "state" not in frame["robots"][0]
    assert any(line["robot"] == 1 and line["text"].startswith("not heard (start its agent") for line in frame["preflight"])
    assert frame["allowed"] == [
        "load", "arm", "start", "stop", "disarm", "clear-stop", "return", "test", "end", "formation", "path",
    ]  # fmt: skip
    lab.robots.publish(topics.PREVIEW, Preview(b"jpeg"), time.time_ns())
    assert page.until(lambda f: f["k"] == "picture")["jpeg"] == b"jpeg"


def test_each_page_gets_the_picture_of_the_camera_that_it_chose() -> None:
    with _served(experiment=load_experiment("two-cameras")) as lab:
        first, second, third = lab.open(), lab.open(), lab.open()
        assert [camera["name"] for camera in first.hello()["scene"]["cameras"]] == ["west", "east"]
        second.hello(camera="east")
        third.hello(camera="a camera of another experiment")
        for name in ("west", "east"):
            lab.robots.publish(topics.PREVIEW.of_camera(name), Preview(name.encode()), time.time_ns())

        def shown(page: PageClient) -> tuple[str, bytes]:
            frame = page.until(lambda f: f["k"] == "picture")
            return frame["camera"], frame["jpeg"]

        assert [shown(page) for page in (first, second, third)] == [("west", b"west"), ("east", b"east"), ("west", b"west")]
        first.say(kind="camera", camera="east")  # its newest picture comes at once
        assert shown(first) == ("east", b"east")
        lab.robots.publish(topics.PREVIEW.of_camera("east"), Preview(b"next"), time.time_ns())
        assert shown(first) == shown(second) == ("east", b"next")


def test_a_remark_becomes_one_line_of_the_log(
    lab: ServedStation, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(log, "propagate", True)  # a command that ran before has its lines go nowhere else
    caplog.set_level("INFO", log.name)
    page = lab.open()
    page.hello()
    page.say(kind="remark", text="lamp\n switched  off")
    deadline = time.monotonic() + 10.0
    while "remark: lamp switched off" not in caplog.messages and time.monotonic() < deadline:
        time.sleep(0.01)
    assert [line for line in caplog.messages if line.startswith("remark")] == ["remark: lamp switched off"]


def test_a_page_that_connects_late_gets_what_was_before(lab: ServedStation) -> None:
    first = lab.open()
    first.hello()
    for _ in range(3):
        lab.say(robot=2)
        first.until(lambda f: state(f) and "state" in f["robots"][1])
        time.sleep(PAST_EVERY_S)  # by the wall clock, as the station's
    late = lab.open()
    late.hello()
    rows = late.until(lambda f: f["k"] == "past")["states"]
    assert len(rows) >= 3
    assert all(later["time_s"] - row["time_s"] >= PAST_EVERY_S for row, later in pairwise(rows))
    assert rows[-1]["robots"][1]["state"]["mode"] == "ARMED"


@pytest.mark.parametrize("origin", ["http://evil.example", "null", None, "https://127.0.0.1"])
def test_a_stranger_s_page_is_not_let_in(lab: ServedStation, origin: str | None) -> None:
    with pytest.raises(InvalidStatus) as refused:
        lab.open(origin=origin)
    assert refused.value.response.status_code == 403


def test_a_page_with_a_wrong_token_gets_no_state(lab: ServedStation) -> None:
    page = lab.open()
    page.say(kind="hello", token="guess")
    with pytest.raises(ConnectionClosed) as closed:
        page.hear()
    assert closed.value.rcvd is not None and closed.value.rcvd.code == 4003
    early = lab.open()
    early.say(kind="order", n=1, order="stop")  # before any hello
    with pytest.raises(ConnectionClosed):
        early.hear()
    assert lab.orders == []


@pytest.mark.parametrize("text", ["nonsense", '{"kind":"ack","n":-1}', "x" * (protocol.LONGEST_BYTES + 1)])
def test_nonsense_ends_only_its_own_connection(lab: ServedStation, text: str) -> None:
    good, bad = lab.open(), lab.open()
    good.hello()
    bad.hello()
    bad.socket.send(text)
    with pytest.raises(ConnectionClosed):
        while True:
            bad.hear()
    lab.say()
    assert good.until(lambda f: state(f) and f["watchers"] == 1)


def test_only_the_page_in_control_commands_and_all_may_stop(lab: ServedStation) -> None:
    first, second = lab.open(), lab.open()
    mine, yours = first.hello()["you"], second.hello()["you"]
    first.order(1, "start")
    refused = first.until(lambda f: f["k"] == "reply")
    assert (refused["ok"], refused["reason"]) == (False, "take control first")
    first.say(kind="take")
    assert first.until(lambda f: state(f) and f["holder"] != 0)["holder"] == mine
    second.say(kind="take")
    for n, order in enumerate(("start", "clear-stop", "disarm")):
        second.order(n, order)
        reply = second.until(lambda f: f["k"] == "reply")
        assert (reply["n"], reply["ok"], reply["reason"]) == (n, False, "another page has control")
    assert lab.orders == []
    second.say(kind="order", n=9, order="stop")  # however old what this page has seen
    assert second.until(lambda f: f["k"] == "reply")["ok"]
    first.order(2, "clear-stop")
    assert first.until(lambda f: f["k"] == "reply")["ok"]
    first.order(3, "hold")
    assert first.until(lambda f: f["k"] == "reply")["reason"] == "not now"
    assert lab.orders == [CommandKind.STOP, CommandKind.CLEAR_STOP, CommandKind.HOLD]
    first.socket.close()
    second.say(kind="take")
    assert second.until(lambda f: state(f) and f["holder"] == yours)


def test_orders_are_done_in_the_order_in_which_they_were_given(lab: ServedStation, monkeypatch: pytest.MonkeyPatch) -> None:
    """Also where the first has to wait for the station's cycle: what was said last counts."""
    page, request = lab.open(), lab.request

    def waits(order: CommandKind, *more: Any) -> tuple[str, int]:
        time.sleep(0.3 if order is CommandKind.RESUME else 0.0)
        return request(order, *more)

    monkeypatch.setattr(lab, "request", waits)
    page.hello()
    page.say(kind="take")
    page.until(lambda f: state(f) and f["holder"] != 0)
    page.order(1, "resume")
    page.order(2, "disarm")
    assert [page.until(lambda f: f["k"] == "reply")["n"] for _ in range(2)] == [1, 2]
    assert lab.orders == [CommandKind.RESUME, CommandKind.DISARM]


def test_a_run_that_still_goes_on_is_followed_by_no_other_whoever_asks(lab: ServedStation) -> None:
    page = lab.open()
    page.hello()
    for what, problem in (("again", "take control first"), ("close", "the run still goes on")):
        page.say(kind="after", n=1, what=what)
        assert page.until(lambda f: f["k"] == "chosen")["problems"] == [problem]
        page.say(kind="take")
        page.until(lambda f: state(f) and f["holder"] != 0)


def test_a_page_that_stops_reading_delays_no_other(lab: ServedStation) -> None:
    """It stays connected and takes nothing in; the other still gets every second state and more, and memory stays flat."""
    stopped, other = lab.open(), lab.open()
    stopped.say(kind="hello", token=TOKEN)  # and never a word again
    other.hello()
    done = threading.Event()

    def publish() -> None:
        while not done.is_set():
            lab.say()
            lab.robots.publish(topics.EVENT, Event(2, "robot", "x" * 1000), time.time_ns())
            time.sleep(0.002)

    publishing = threading.Thread(target=publish)
    publishing.start()
    try:
        stamps = [other.until(state)["stamp_ms"] for _ in range(60)]
    finally:
        done.set()
        publishing.join()
    assert stamps == sorted(stamps)
    stopped.socket.recv(timeout=20)  # two frames, and not one more
    stopped.socket.recv(timeout=20)
    with pytest.raises(TimeoutError):
        stopped.socket.recv(timeout=0.5)


def test_a_page_that_acknowledges_nothing_is_told_the_last_state_before_the_server_ends() -> None:
    with contextlib.ExitStack() as opened:
        with _served() as lab:
            address, origin = f"ws://127.0.0.1:{lab.port}/live", f"http://127.0.0.1:{lab.port}"
            page = PageClient(opened.enter_context(connect(address, max_size=None, origin=Origin(origin))))
            page.hello()
            for _ in range(UNACKNOWLEDGED):
                page.socket.recv(timeout=20)
            lab.robots.publish(topics.STATE, RobotState(mode=Mode.DISARMED, fault="the last"), time.time_ns(), 2)
        frames = []
        with pytest.raises(ConnectionClosed):
            while True:
                frame = page.socket.recv(timeout=20)
                assert isinstance(frame, bytes)
                frames.append(msgspec.msgpack.decode(frame[HEAD.size :]))
    assert next(f for f in reversed(frames) if state(f))["robots"][1]["state"]["fault"] == "the last"


def test_request_outcomes_and_log_lines_reach_the_page(lab: ServedStation) -> None:
    page = lab.open()
    page.hello()
    outcome = Outcome(7, CommandKind.CLEAR_STOP, Progress.FAILED, "aborting", "ABORTING", (1,), (2,), ("no pose",))
    lab.own_status = replace(lab.own_status, requests=(outcome,))
    (request,) = page.until(lambda f: state(f) and f["requests"])["requests"]
    assert request == {
        "request": 7,
        "order": "clear-stop",
        "progress": "FAILED",
        "reason": "aborting",
        "confirmed": [1],
        "waiting": [{"robot": 2, "why": "no pose"}],
    }
    lab.robots.publish(topics.EVENT, Event(4, "agent-1", "trouble"), 5_000_000_000)  # by the robot's clock
    event = page.until(lambda f: f["k"] == "event")
    assert (event["level"], event["text"]) == (4, "trouble")
    assert event["time_s"] == pytest.approx(time.time(), abs=10.0)  # by the station's
    late = lab.open()
    assert [line["text"] for line in late.hello()["events"]] == ["trouble"]


def test_while_dragging_the_newest_edit_is_answered(lab: ServedStation) -> None:
    page = lab.open()
    page.hello()
    for n in range(1, 40):
        page.say(kind="try", n=n, edit={"diameter_m": 0.4 + 0.001 * n})
    last = page.until(lambda f: f["k"] == "tried" and f["n"] == 39)
    assert last["ok"] and last["figures"][2]["value"] == pytest.approx(0.439 * 3.14159265 / 100, rel=1e-5)


def test_an_answer_about_an_older_edit_never_comes_last(lab: ServedStation, monkeypatch: pytest.MonkeyPatch) -> None:
    """The page shows the answer to its newest question alone: with an older one behind it, it would wait for ever."""
    begun, release = threading.Event(), threading.Event()

    def judged(experiment: Experiment, edit: protocol.Edit) -> dict[str, Any]:
        if edit.scale is None:
            begun.set()
            release.wait(PATIENCE_S)
        return {"ok": True, "problems": []}

    monkeypatch.setattr("groundstation.web.client_hub.attempt", judged)
    monkeypatch.setattr(LiveBackend, "remark", lambda self, text: time.sleep(0.3))
    page = lab.open()
    page.hello()
    page.say(kind="remark", text="a busy machine: what follows is taken in at once")
    for n in range(1, 10):
        page.say(kind="try", n=n, edit={})
    assert begun.wait(PATIENCE_S)
    time.sleep(0.2)  # all of them are taken in
    page.say(kind="try", n=40, edit={"scale": 1.0})
    threading.Timer(0.5, release.set).start()
    numbers = [page.until(lambda f: f["k"] == "tried")["n"]]
    while numbers[-1] != 40:
        numbers.append(page.until(lambda f: f["k"] == "tried")["n"])
    assert len(numbers) > 1 and numbers == sorted(numbers)


@pytest.mark.parametrize(
    ("broken", "request_of_page"),
    [
        ("attempt", {"kind": "try", "edit": {}}),
        ("drafted", {"kind": "draft", "order": "formation", "text": "line 0.8"}),
        ("save", {"kind": "save", "edit": {}, "name": "x"}),
        ("flight_text", {"kind": "order", "order": "path", "text": "pool"}),
    ],
)
def test_a_request_that_an_error_ends_is_numbers_with_the_reason(
    lab: ServedStation, monkeypatch: pytest.MonkeyPatch, broken: str, request_of_page: dict[str, Any]
) -> None:
    def fails(*arguments: Any) -> Any:
        raise KeyError("a bug")

    monkeypatch.setattr(f"groundstation.web.client_hub.{broken}", fails)
    page = lab.open_in_control()
    stamp = {"seen_ms": page.clock_ms} if request_of_page["kind"] == "order" else {}
    page.say(n=7, **request_of_page, **stamp)
    answer = page.until(lambda f: f.get("n") == 7)
    assert not answer["ok"] and "a bug" in str(answer.get("problems", answer.get("reason")))


def test_an_unusable_certificate_is_refused_at_start(lab: ServedStation, tmp_path: Path) -> None:
    """Not a line in the log, and then a station without a page that says where its page is."""
    (none := tmp_path / "none.pem").write_text("no certificate\n")
    for certificate in (tmp_path / "absent.pem", none):
        with pytest.raises(ConfigError, match=f"--web-certificate {certificate}"):
            WebServer(make_desk(lab), WebOptions(port=free_port(), certificate=certificate, key=none))


def test_pages_that_introduce_themselves_at_once_are_no_more_than_allowed(
    lab: ServedStation, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(client_hub, "MOST_WATCHERS", 2)
    pages = [lab.open() for _ in range(3)]  # all are there before the first has said who it is
    for page in pages[:2]:
        page.hello()
    with pytest.raises(ConnectionClosed, match="2 pages are open already"):
        pages[2].hello()


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("{", "Input data was truncated"),
        (json.dumps({"kind": "dance"}), "Invalid value 'dance' - at `$.kind`"),
        (json.dumps({"kind": "舞" * 90}, ensure_ascii=False), "Invalid value '舞"),
    ],
)
def test_a_message_that_is_no_request_ends_its_page_with_the_reason(
    lab: ServedStation, caplog: pytest.LogCaptureFixture, text: str, reason: str
) -> None:
    """Some characters of it are several bytes, and the reason of a closing connection has room for 123."""
    page, other = lab.open(), lab.open()
    page.hello()
    page.socket.send(text)
    with pytest.raises(ConnectionClosed) as closed:
        page.until(lambda frame: False)
    assert closed.value.rcvd is not None and closed.value.rcvd.code == 4000
    assert closed.value.rcvd.reason.startswith(reason)
    messages = [record.getMessage() for record in caplog.records if record.levelno >= logging.WARNING]
    assert len(messages) == 1 and messages[0].startswith(f"page: a message that is none of ours: {reason}")
    other.hello()


@pytest.mark.parametrize(
    ("message", "kind"),
    [
        ({"kind": "try", "edit": {"pool_m": [12_000_000.0, 6.0, 1.0]}}, "tried"),
        ({"kind": "try", "edit": {"kind": "waypoints", "laps": 10_000_000_000}}, "tried"),
        ({"kind": "save", "edit": {"islands_m": [[0.0, 0.0, 0.1]] * 101}, "name": "mine"}, "saved"),
        ({"kind": "after", "what": "edited", "edit": {"points_m": [[0.0, 0.0]] * 201}}, "chosen"),
        ({"kind": "draft", "order": "path", "text": "=" * 50_000}, "drafted"),
        ({"kind": "order", "order": "go", "via_m": [[0.0, 1e6]]}, "reply"),
        ({"kind": "tune", "values": {"controller.mpc.q.0": 1e300}}, "reply"),
    ],
)
def test_a_value_that_is_not_allowed_is_answered_and_ends_no_control(
    lab: ServedStation, message: dict[str, Any], kind: str
) -> None:
    page = lab.open_in_control()
    page.say(n=7, **message)
    answer = page.until(lambda f: f["k"] == kind)
    assert answer["n"] == 7 and not answer["ok"] and answer["problems"] == [answer["reason"]] and answer["reason"]
    assert page.until(state)["holder"] != 0


def test_a_private_key_that_others_can_read_is_refused_at_start(lab: ServedStation, tmp_path: Path) -> None:
    key_ring.init(tmp_path / "keys", [], "shoal", datetime.now(UTC))
    keys = tmp_path / "keys" / "groundstation"
    options = WebOptions(port=free_port(), certificate=keys / "cert.pem", key=keys / "key.pem")
    with bind(options):
        pass
    for mode in (0o640, 0o604, 0o620, 0o602):
        (keys / "key.pem").chmod(mode)
        with pytest.raises(ConfigError, match=f"key.pem: mode {mode:04o} lets others read the page's private key"):
            bind(options)


def test_bad_requests_do_not_fill_the_log(
    lab: ServedStation, caplog: pytest.LogCaptureFixture, capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def knock(data: bytes) -> None:
        with socket.create_connection(("127.0.0.1", lab.port), PATIENCE_S) as stranger:
            stranger.sendall(data)
            while stranger.recv(4096):
                pass

    def lines() -> list[str]:
        return [record.getMessage() for record in caplog.records if record.name == "shoal" and "HTTP" in record.getMessage()]

    caplog.clear()
    for _ in range(50):
        knock(b"\x00\r\n\r\n")
    assert lines() == ["page: Invalid HTTP request received."]
    monkeypatch.setattr(server, "SAY_AGAIN_S", 0.0)
    knock(b"\x00\r\n\r\n")
    assert lines()[1:] == ["page: Invalid HTTP request received. (49 more of them since last told)"]
    assert capfd.readouterr().err == ""


@pytest.mark.parametrize("length", [b"content-length: 300000000", b"transfer-encoding: chunked"])
@pytest.mark.parametrize("method", [b"POST", b"GET"])
def test_a_request_with_a_body_is_refused_and_its_body_is_not_read(lab: ServedStation, method: bytes, length: bytes) -> None:
    with socket.create_connection(("127.0.0.1", lab.port), PATIENCE_S) as sender:
        sender.sendall(method + b" / HTTP/1.1\r\nhost: 127.0.0.1\r\n" + length + b"\r\n\r\n")
        answer = b""
        with contextlib.suppress(ConnectionError):
            while read := sender.recv(4096):  # its end without a byte of the body: the connection is closed
                answer += read
    assert answer.startswith(b"HTTP/1.1 413 ") and b"connection: close" in answer


def test_a_body_is_measured_by_its_headers() -> None:
    assert body_fits([], 0) and body_fits([(b"content-length", b"0")], 0) and body_fits([(b"content-length", b"5")], 5)
    for headers in ([(b"content-length", b"6")], [(b"content-length", b"9" * 5000)], [(b"transfer-encoding", b"chunked")]):
        assert not body_fits(headers, 5)


def test_assets_are_served_with_security_headers(lab: ServedStation) -> None:
    from urllib.request import Request, urlopen

    with urlopen(f"http://127.0.0.1:{lab.port}/") as answer:
        page = answer.read().decode()
        assert "default-src 'self'" in answer.headers["content-security-policy"]
        assert answer.headers["x-content-type-options"] == "nosniff"
    assert "http" not in page.replace("http-equiv", "")
    rebound = Request(f"http://127.0.0.1:{lab.port}/", headers={"Host": "evil.example"})
    with pytest.raises(OSError, match="421"):
        urlopen(rebound)


# --- what must not be kept waiting, and by what


def test_a_stop_is_taken_while_all_other_threads_are_busy(lab: ServedStation, monkeypatch: pytest.MonkeyPatch) -> None:
    """Requests, changes of gains, edits and saves, more of each than there are threads for."""
    release = lab.blocked = threading.Event()

    def slow(*arguments: Any) -> dict[str, Any]:
        release.wait(PATIENCE_S)
        return {"ok": False, "problems": []}

    monkeypatch.setattr("groundstation.web.client_hub.attempt", slow)
    monkeypatch.setattr("groundstation.web.client_hub.save", slow)
    pages = [lab.open() for _ in range(8)]
    for page in pages:
        page.hello()
    pages[0].say(kind="take")
    pages[0].until(lambda f: state(f) and f["holder"] != 0)
    for n in range(12):
        pages[0].order(n, "start")
        pages[0].say(kind="tune", n=n, values=None, next_lap=False, seen_ms=pages[0].clock_ms)
        pages[0].say(kind="save", n=n, edit={}, name="x")
    for page in pages:
        page.say(kind="try", n=1, edit={})
    try:
        pages[-1].say(kind="order", n=99, order="stop")
        assert pages[-1].until(lambda f: f["k"] == "reply" and f["n"] == 99)["ok"]
        assert lab.orders == [CommandKind.STOP]
        assert not release.is_set()
    finally:
        release.set()


def test_a_disk_that_hangs_as_a_page_is_opened_keeps_no_stop_waiting(
    lab: ServedStation, monkeypatch: pytest.MonkeyPatch
) -> None:
    reads, release = threading.Event(), threading.Event()

    def read(robots: tuple[int, ...]) -> list[str]:
        reads.set()
        release.wait(PATIENCE_S)
        return ["pool"]

    page, other = lab.open(), lab.open()
    page.hello()
    monkeypatch.setattr(client_hub, "loadable", read)
    other.say(kind="hello", token=TOKEN)
    try:
        assert reads.wait(PATIENCE_S)
        page.say(kind="order", n=1, order="stop")
        assert page.until(lambda f: f["k"] == "reply")["ok"]
        other.say(kind="order", n=1, order="stop")
        assert eventually(lambda: len(lab.orders) == 2)
        hello = other.hear()
        assert hello["k"] == "hello" and hello["scene"]["loadable"] == []
        assert other.until(lambda f: f["k"] == "reply")["ok"]
        assert not release.is_set()
    finally:
        release.set()
    third = lab.open()
    assert third.hello()["scene"]["loadable"] == ["pool"]


@pytest.mark.parametrize("meanwhile", [None, "hold", "disarm", "stop"])
def test_a_path_that_is_read_from_a_slow_disk_delays_no_order_and_overtakes_none(
    lab: ServedStation, monkeypatch: pytest.MonkeyPatch, meanwhile: str | None
) -> None:
    reads, release = threading.Event(), threading.Event()

    def read(experiment: Experiment, order: CommandKind, text: str, edit: Any = None) -> str:
        reads.set()
        release.wait(PATIENCE_S)
        return f"the text of {text}"

    monkeypatch.setattr(client_hub, "flight_text", read)
    monkeypatch.setattr(client_hub, "ORDER_VALID_S", PATIENCE_S)
    page = lab.open_in_control()
    page.order(0, "load")
    page.say(kind="order", n=1, order="path", text="pool", seen_ms=page.clock_ms)
    try:
        assert reads.wait(PATIENCE_S)
        if meanwhile is not None:
            page.order(2, meanwhile)
            page.until(lambda f: f["k"] == "reply" and f["n"] == 2)
            assert not release.is_set()
    finally:
        release.set()
    assert page.until(lambda f: f["k"] == "reply" and f["n"] == 1)["ok"] == (meanwhile is None)
    assert (CommandKind.PATH in lab.orders, lab.text == "the text of pool") == (meanwhile is None, meanwhile is None)
    page.say(kind="order", n=3, order="path", text="pool", seen_ms=page.clock_ms)
    assert page.until(lambda f: f["k"] == "reply" and f["n"] == 3)["ok"]


def test_a_path_that_is_read_too_slowly_is_not_flown(lab: ServedStation, monkeypatch: pytest.MonkeyPatch) -> None:
    def read(experiment: Experiment, order: CommandKind, text: str, edit: Any = None) -> str:
        monkeypatch.setattr(client_hub, "ORDER_VALID_S", 0.0)
        return text

    monkeypatch.setattr(client_hub, "flight_text", read)
    monkeypatch.setattr(client_hub, "ORDER_VALID_S", PATIENCE_S)
    page = lab.open_in_control()
    page.say(kind="order", n=1, order="path", text="pool", seen_ms=page.clock_ms)
    assert page.until(lambda f: f["k"] == "reply")["reason"].endswith("late, and was not done")
    assert lab.orders == []


def test_an_order_that_was_long_on_its_way_is_not_done(lab: ServedStation) -> None:
    """A station that hung, or a link that did: what the operator saw when he gave it is past. What only takes power away is
    never too late."""
    page = lab.open_in_control()
    for n, kind in enumerate(("order", "tune")):
        late = {"order": "start"} if kind == "order" else {"values": None}
        page.say(kind=kind, n=n, seen_ms=page.clock_ms - 10_000, **late)
        reply = page.until(lambda f: f["k"] == "reply")
        assert not reply["ok"] and reply["reason"].endswith("late, and was not done")
        page.say(kind=kind, n=n, seen_ms=page.clock_ms + 100_000, **late)  # by the clock of before this computer's start
        reply = page.until(lambda f: f["k"] == "reply")
        assert not reply["ok"] and "before this computer's start" in reply["reason"]
    for n, order in enumerate(("disarm", "stop")):
        page.say(kind="order", n=n, order=order, seen_ms=page.clock_ms - 10_000)
        assert page.until(lambda f: f["k"] == "reply")["ok"]
    assert lab.orders == [CommandKind.DISARM, CommandKind.STOP]


@pytest.mark.skipif(not hasattr(time, "CLOCK_BOOTTIME"), reason="the system has no clock that counts a machine's sleep")
def test_an_order_that_came_while_the_station_s_machine_slept_is_not_done(
    lab: ServedStation, monkeypatch: pytest.MonkeyPatch
) -> None:
    page = lab.open_in_control()
    seen_ms, since_boot = page.clock_ms, time.clock_gettime_ns
    monkeypatch.setattr(
        time, "clock_gettime_ns", lambda clock: since_boot(clock) + (60 * 10**9 if clock == time.CLOCK_BOOTTIME else 0)
    )
    page.say(kind="order", n=1, order="start", seen_ms=seen_ms)
    reply = page.until(lambda f: f["k"] == "reply")
    assert not reply["ok"] and reply["reason"].endswith("late, and was not done")
    assert lab.orders == []


def test_an_order_that_waited_long_for_others_is_not_done(lab: ServedStation, monkeypatch: pytest.MonkeyPatch) -> None:
    """One before them waits, as for a disk."""
    release = lab.blocked = threading.Event()
    page = lab.open_in_control()
    for limit in ("ORDER_VALID_S", "DRIVE_VALID_S"):
        monkeypatch.setattr(client_hub, limit, PATIENCE_S)
    page.order(0, "load")
    page.order(1, "start")
    page.say(kind="drive", robot=1, surge_mps=0.1, heave_mps=0.0, yaw_rate_radps=0.0, seen_ms=page.clock_ms)
    page.say(kind="tune", n=2, values=None, next_lap=False, seen_ms=page.clock_ms)
    page.order(3, "disarm")
    page.say(kind="try", n=4, edit={})
    page.until(lambda f: f.get("n") == 4)  # all of them have come
    for limit in ("ORDER_VALID_S", "DRIVE_VALID_S"):
        monkeypatch.setattr(client_hub, limit, 0.0)
    release.set()
    replies = [page.until(lambda f: f["k"] == "reply") for _ in range(4)]
    assert [(reply["n"], reply["ok"]) for reply in replies] == [(0, True), (1, False), (2, False), (3, True)]
    assert lab.orders == [CommandKind.LOAD, CommandKind.DISARM] and lab.drives == []


def test_an_order_that_waited_long_for_the_station_s_cycle_is_not_done(
    lab: ServedStation, monkeypatch: pytest.MonkeyPatch
) -> None:
    release = lab.blocked = threading.Event()
    page = lab.open_in_control()
    monkeypatch.setattr(client_hub, "ORDER_VALID_S", 0.5)
    page.order(1, "start")
    page.say(kind="tune", n=2, values=None, next_lap=False, seen_ms=page.clock_ms)
    page.order(3, "disarm")
    time.sleep(1.0)
    release.set()
    replies = [page.until(lambda f: f["k"] == "reply") for _ in range(3)]
    assert {reply["n"]: reply["ok"] for reply in replies} == {1: False, 2: False, 3: True}
    assert lab.orders == [CommandKind.DISARM]


def test_a_velocity_that_waited_long_for_the_station_s_cycle_moves_no_robot(
    lab: ServedStation, monkeypatch: pytest.MonkeyPatch
) -> None:
    release = lab.blocked = threading.Event()
    page = lab.open_in_control()
    monkeypatch.setattr(client_hub, "DRIVE_VALID_S", 0.5)
    page.say(kind="drive", robot=1, surge_mps=0.1, heave_mps=0.0, yaw_rate_radps=0.0, seen_ms=page.clock_ms)
    time.sleep(1.0)
    release.set()
    assert "late" in page.until(lambda f: f["k"] == "undriven")["reason"]
    assert lab.drives == []


def test_a_page_that_comes_back_keeps_its_control_and_its_dead_connection_is_ended(lab: ServedStation) -> None:
    before, other = lab.open(), lab.open()
    before.hello(page="mine")
    before.say(kind="take")
    before.until(lambda f: state(f) and f["holder"] != 0)
    stranger = lab.open()
    stranger.hello(page="yours")
    assert stranger.until(state)["holder"] == 1
    again = lab.open()
    mine = again.hello(page="mine")["you"]
    assert again.until(lambda f: state(f) and f["holder"] == mine)
    with pytest.raises(ConnectionClosed) as closed:
        while True:
            before.hear()
    assert closed.value.rcvd is not None and closed.value.rcvd.code == 4002
    other.hello()
    assert other.until(state)["holder"] == mine


def test_a_failed_snapshot_is_logged_and_the_next_one_is_shown(
    lab: ServedStation, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    page = lab.open()
    page.hello()
    failed = threading.Event()

    def breaks(*arguments: Any) -> dict[str, Any]:
        failed.set()
        raise KeyError("a robot that nobody knows")

    monkeypatch.setattr(log, "propagate", True)
    with monkeypatch.context() as patched:
        patched.setattr("groundstation.web.live_backend.snapshot", breaks)
        assert failed.wait(PATIENCE_S)
        page.say(kind="order", n=1, order="stop")
        assert page.until(lambda f: f["k"] == "reply")["ok"]  # not even what it says then is lost
    stamp_ms = time.time() * 1e3
    assert page.until(lambda f: state(f) and f["stamp_ms"] > stamp_ms)
    assert "nothing new is shown: KeyError" in caplog.text


def test_idle_connections_do_not_block_new_ones(lab: ServedStation, monkeypatch: pytest.MonkeyPatch) -> None:
    from urllib.request import urlopen

    idle = [lab.opened.enter_context(socket.create_connection(("127.0.0.1", lab.port))) for _ in range(150)]
    with urlopen(f"http://127.0.0.1:{lab.port}/", timeout=PATIENCE_S) as answer:
        assert answer.status == 200
    assert lab.open().hello()
    ended = sum(connection.recv(1, socket.MSG_DONTWAIT) == b"" for connection in idle if _readable(connection))
    assert ended >= 150 - connection_limits.MOST_EACH


def _readable(connection: socket.socket) -> bool:
    return bool(select.select([connection], [], [], 0.0)[0])


@pytest.mark.parametrize("data", [b"", b"GET / HTTP/1.1\r\nHost: 127.0", b"GET / HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\nGET"])
def test_a_client_that_does_not_finish_a_request_in_time_is_cut_off(data: bytes, monkeypatch: pytest.MonkeyPatch) -> None:
    """Also one that has asked for something before, and one that lets bytes trickle."""
    monkeypatch.setattr(connection_limits, "ASKS_WITHIN_S", 0.2)
    with _served() as station, socket.create_connection(("127.0.0.1", station.port), PATIENCE_S) as slow:
        slow.sendall(data)
        while slow.recv(4096):  # what was asked for, then the end; a timeout here is a failure
            pass


def test_a_page_that_is_watched_is_not_cut_off(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(connection_limits, "ASKS_WITHIN_S", 0.1)
    monkeypatch.setattr(connection_limits, "TAKES_WITHIN_S", 0.1)
    with _served() as station:
        page = station.open()
        page.hello()
        for _ in range(4):  # a quarter of a second each: the page is told so often
            assert page.until(state)


def test_a_page_server_that_does_not_start_is_refused(lab: ServedStation, monkeypatch: pytest.MonkeyPatch) -> None:
    async def never(server: Any, sockets: Any = None) -> None:
        raise RuntimeError("no more file descriptors")

    monkeypatch.setattr("uvicorn.Server.serve", never)
    with (
        pytest.raises(ConfigError, match=r"--web 127.0.0.1:\d+: RuntimeError: no more file descriptors"),
        WebServer(make_desk(lab), WebOptions(port=free_port())),
    ):
        pass


# --- what a page shows


def test_an_event_of_megabytes_reaches_no_page_and_a_long_one_is_cut(lab: ServedStation) -> None:
    page = lab.open()
    page.hello()
    huge = Log(level=Log.Level.INFO, name="agent-2", message="x" * 4_000_000).SerializeToString()
    for _ in range(3):
        lab.robots.forward(topics.EVENT, huge, time.time_ns())
    lab.robots.publish(topics.EVENT, Event(2, "agent-2", "y" * 100_000), time.time_ns())
    event = page.until(lambda f: f["k"] == "event")
    assert event["text"] == "y" * (codec.LONGEST_LINE - 1) + "…"


def test_a_fault_of_megabytes_is_no_state_of_a_robot(lab: ServedStation) -> None:
    page = lab.open()
    page.hello()
    lab.say(robot=1)
    state_bytes = codec.protobuf_class(RobotState)(fault="x" * 4_000_000).SerializeToString()
    lab.robots.forward(topics.STATE, state_bytes, time.time_ns(), 1)
    frame = page.until(lambda f: state(f) and "state" in f["robots"][0])
    assert frame["robots"][0]["state"]["fault"] == "here"


def test_the_page_shows_what_the_station_knows_of_links_clocks_and_the_timetable(lab: ServedStation) -> None:
    view = RobotView(RobotState(mode=Mode.ARMED), 0.0)
    lab.own_status = replace(lab.own_status, views={1: replace(view, loss=0.5, clock_offset_s=0.3, behind_s=0.8), 2: view})
    page = lab.open()
    page.hello()
    for robot in (1, 2):
        lab.say(robot)
    frame = page.until(lambda f: state(f) and any(a["key"] == "1:link" for a in f["alarms"]))
    texts = {a["key"]: a["text"] for a in frame["alarms"]}
    assert texts["1:link"] == "50% of its messages are lost"
    assert texts["1:clock"] == "its clock is 300 ms ahead of the station's"
    assert texts["1:step"] == "is 0.8 s behind the others"
    assert not {"2:link", "2:step"} & texts.keys()


def test_the_map_gets_the_paths_that_are_flown_now(lab: ServedStation) -> None:
    """An early page is told of the change, a late one gets the new ones at once."""
    early = lab.open()
    planned = early.hello()["scene"]["paths"]
    line = np.zeros((60, 4))
    home = {1: Trajectory("home-1", 0.05, line, line, line, begin_s=40.0)}
    lab.paths = {robot: (trajectory, 42.0) for robot, trajectory in home.items()}  # 41 samples; the rest is horizon
    paths_now = early.until(lambda f: f["k"] == "paths")["paths"]
    late = lab.open().hello()["scene"]["paths"]
    assert [p["id"] for p in planned] == [t.id for t in planner.plan(POOL).values()]
    for paths in (paths_now, late):
        assert [(p["robot"], p["id"], len(p["eta"])) for p in paths] == [(1, "home-1", 41 * 4 * 4)]


def test_a_fleet_that_is_fit_is_ready_and_not_waited_for(lab: ServedStation) -> None:
    page = lab.open()
    page.hello()
    assert page.until(state)["mission_text"] == "waiting for the fleet"
    lab.preflight = ()
    assert page.until(lambda f: state(f) and f["mission_text"] == "fleet ready")["preflight"] == []


def test_velocity_is_taken_from_the_page_in_control_alone_and_only_while_it_is_new(lab: ServedStation) -> None:
    watcher, pilot = lab.open(), lab.open()
    watcher.hello(), pilot.hello()
    pilot.say(kind="take")
    pilot.until(lambda f: f["k"] == "state" and f["holder"])

    def steer(page: PageClient, robot: int, seen_ms: int) -> None:
        page.say(kind="drive", robot=robot, surge_mps=0.2, heave_mps=0.0, yaw_rate_radps=-0.1, seen_ms=seen_ms)

    steer(watcher, 2, watcher.clock_ms)
    assert watcher.until(lambda f: f["k"] == "undriven")["reason"] == "another page has control"
    steer(pilot, 2, pilot.clock_ms - 2000)
    assert "late, and was not done" in pilot.until(lambda f: f["k"] == "undriven")["reason"]
    assert lab.drives == []
    steer(pilot, 9, pilot.clock_ms)
    assert pilot.until(lambda f: f["k"] == "undriven") == {"k": "undriven", "robot": 9, "reason": "no robot 9"}
    steer(pilot, 2, pilot.clock_ms)
    pilot.until(lambda f: len(lab.drives) == 2)
    assert (lab.drives[1][0], lab.drives[1][1].surge_mps, lab.drives[1][1].yaw_rate_radps) == (2, 0.2, -0.1)
    pilot.say(kind="order", n=5, order="hold", robot=2, seen_ms=pilot.clock_ms)
    pilot.until(lambda f: f["k"] == "reply")
    assert lab.only == 2


# --- runs


@pytest.fixture
def shelf(tmp_path: Path) -> Iterator[tuple[ServedStation, Path]]:
    """A station that flies `now`, beside a run with a report, one without, and what is none."""
    for name in ("now", "old", "bare"):
        (tmp_path / "runs" / name).mkdir(parents=True)
        (tmp_path / "runs" / name / "run.mcap").write_bytes(bytes(1000))
    (tmp_path / "runs" / "old" / "report.html").write_text("<h1>of the old run</h1>")
    (tmp_path / "secret").mkdir()
    (tmp_path / "secret" / "report.html").write_text("secret")
    (tmp_path / "secret" / "run.mcap").touch()
    (tmp_path / "runs" / "link").symlink_to(tmp_path / "secret")
    (tmp_path / "runs" / "bare" / "report.html").symlink_to(tmp_path / "secret" / "report.html")
    with _served(tmp_path / "runs" / "now") as lab:
        yield lab, tmp_path / "runs"


def runs_of(page: PageClient, **request: Any) -> dict[str, Any]:
    """The answer to a request of runs, which are then listed by their folders' names."""
    page.say(**request)
    answer_frame = page.until(lambda f: f["k"] == "runs")
    return {**answer_frame, "runs": {run["run"]: run for run in answer_frame["runs"]}}


def answer(port: int, target: str) -> tuple[int, str, str]:
    """Status, text and policy of an answer to exactly this request: clients that tidy addresses up would hide an attack."""
    with socket.create_connection(("127.0.0.1", port), PATIENCE_S) as line:
        line.sendall(f"GET {target} HTTP/1.1\r\nHost: 127.0.0.1:{port}\r\nConnection: close\r\n\r\n".encode())
        response = b"".join(iter(lambda: line.recv(65536), b"")).decode()
    head, _, text = response.partition("\r\n\r\n")
    policy = next((row for row in head.lower().splitlines() if row.startswith("content-security-policy")), "")
    return int(head.split()[1]), text, policy


def test_a_report_is_served_to_a_page_that_was_told_its_address_and_to_no_other(shelf: tuple[ServedStation, Path]) -> None:
    lab, folder = shelf
    page = lab.open()
    page.hello()
    listing = runs_of(page, kind="runs")
    assert listing["folder"] == str(folder) and set(listing["runs"]) == {"now", "old", "bare"}
    assert listing["runs"]["now"]["shown"] and not listing["runs"]["old"]["shown"]
    addresses = {name: run["report"] for name, run in listing["runs"].items()}
    assert [name for name, address in addresses.items() if address] == ["old"]  # a link to a report is none
    status, text, policy = answer(lab.port, f"/{addresses['old']}")
    assert (status, text) == (200, "<h1>of the old run</h1>")
    assert "sandbox allow-scripts" in policy and "default-src 'none'" in policy  # it reaches nothing of the station's
    key = addresses["old"].partition("?key=")[2]
    for target in (
        "/runs/old/report.html",
        "/runs/old/report.html?key=",
        f"/runs/old/report.html?key={'0' * 64}",
        f"/runs/bare/report.html?key={key}",
        *(
            f"/runs/{name}/report.html?key={key}"
            for name in ("link", "..%2f..%2fsecret", "..", "%2e%2e", "old%00", "../secret")
        ),
        f"/runs/old/..%2f..%2f..%2fsecret/report.html?key={key}",
        f"/runs/old/run.mcap?key={key}",
        f"//runs/old/report.html?key={key}",
    ):
        status, text, _ = answer(lab.port, target)
        assert status == 404 and "secret" not in text, target
    assert answer(lab.port, "/")[0] == 200


@pytest.mark.parametrize("name", ["..", ".", "link", "../secret", "/etc", "nothing", "old/../old", "old\0"])
def test_a_name_that_is_no_run_of_the_folder_is_neither_labelled_nor_deleted(
    shelf: tuple[ServedStation, Path], name: str
) -> None:
    lab, folder = shelf
    page = lab.open()
    page.hello()
    page.say(kind="take")
    for request in ({"kind": "label", "name": "x", "tags": []}, {"kind": "delete"}):
        answer = runs_of(page, run=name, **request)
        assert answer["problem"] and set(answer["runs"]) == {"now", "old", "bare"}
    assert sorted(path.name for path in folder.iterdir()) == ["bare", "link", "now", "old"]
    assert not list(folder.parent.rglob("label.json"))


def test_runs_are_labelled_and_deleted_by_the_page_in_control_but_never_one_that_is_flown(
    shelf: tuple[ServedStation, Path],
) -> None:
    lab, folder = shelf
    page, watching = lab.open(), lab.open()
    page.hello()
    watching.hello()
    page.say(kind="take")
    page.until(lambda f: state(f) and f["holder"] != 0)
    for request in ({"kind": "label", "run": "old", "name": "x", "tags": []}, {"kind": "delete", "run": "old"}):
        assert runs_of(watching, **request)["problem"] == "another page has control"
    answer = runs_of(page, kind="label", run="now", name="first dive", tags=["lamp", "lamp"])
    assert (answer["problem"], answer["runs"]["now"]["name"], answer["runs"]["now"]["tags"]) == ("", "first dive", ["lamp"])
    assert "must be a word" in runs_of(page, kind="label", run="old", name="", tags=["a b"])["problem"]
    assert "is shown on this page" in runs_of(page, kind="delete", run="now")["problem"]
    with (folder / "bare" / "run.mcap").open("rb") as recorder:
        fcntl.flock(recorder, fcntl.LOCK_EX)  # as another station's
        assert "its run still goes on" in runs_of(page, kind="delete", run="bare")["problem"]
    answer = runs_of(page, kind="delete", run="old")
    assert answer["problem"] == "" and set(answer["runs"]) == {"now", "bare"}
    assert not (folder / "old").exists() and (folder / "now").is_dir() and (folder / "bare").is_dir()


def test_a_run_whose_files_hold_no_proper_text_hides_neither_itself_nor_the_others(shelf: tuple[ServedStation, Path]) -> None:
    """A folder with a name that is no UTF-8, half a character in a label, a number of 70 bits in the result of this run."""
    lab, folder = shelf
    odd = folder / os.fsdecode(b"caf\xe9")
    odd.mkdir()
    (odd / "run.mcap").touch()
    (odd / "report.html").write_text("<h1>odd</h1>")
    (folder / "bare" / "label.json").write_text('{"name": "\\ud800 dive"}')
    ended: dict[str, Any] = {"checks": [], "cause": None, "verdict": "\ud800", "notes": [1 << 70], "robots": {}, "pairs": {}}
    (folder / "now" / "result.json").write_text(json.dumps(ended))
    page = lab.open()
    end = page.hello()["scene"]["end"]
    assert (end["verdict"], end["notes"]) == ("\\ud800", [hex(1 << 70)])
    listing = runs_of(page, kind="runs")
    shown = r"caf\udce9"
    assert set(listing["runs"]) == {"now", "old", "bare", shown}
    assert listing["runs"]["bare"]["name"] == "\\ud800 dive"
    assert answer(lab.port, f"/{listing['runs'][shown]['report']}")[:2] == (200, "<h1>odd</h1>")
    page.say(kind="take")
    assert runs_of(page, kind="delete", run=shown)["problem"] == "" and not odd.exists()
