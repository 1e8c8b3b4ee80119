"""The page's server on a real socket, fed by a real desk on the in-memory bus: strangers, stopped pages, leases, orders."""

import contextlib
import json
import socket
import struct
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import msgspec
import pytest
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.sync.client import ClientConnection, connect

from groundstation import planner
from groundstation.asking import Answer
from groundstation.inboxes import listen
from groundstation.phases import Phase
from groundstation.web import requests
from groundstation.web.desk import Desk, Post, Status
from groundstation.web.guard import WebOptions
from groundstation.web.server import WebServer
from wire import topics
from wire.bus import Bus
from wire.experiment import load_experiment
from wire.messages import Command, Event, Mode, Order, Preview, Reply, RobotState
from wire.runtime import WallClock
from wire.toml_file import ConfigError
from wire.transport import MemoryHub, MemoryTransport

POOL = load_experiment("pool")
HEAD = struct.Struct("<If")
TOKEN = "correct horse battery staple"


@dataclass
class Lab:
    """A station's bus, and the page's server on it."""

    port: int
    bus: Bus
    robots: Bus
    opened: contextlib.ExitStack
    phase: Phase = Phase.WAITING
    orders: list[Order] = field(default_factory=list)
    answers: deque[Answer] = field(default_factory=deque)

    def say(self, robot: int = 1) -> None:
        self.robots.publish(topics.STATE, RobotState(mode=Mode.ARMED, fault="here"), time.time_ns(), robot)

    def order(self, order: Order) -> str:
        self.orders.append(order)
        return "" if order is not Order.HOLD else "not now"

    def open(self, **options: Any) -> "Page":
        options.setdefault("origin", f"http://127.0.0.1:{self.port}")
        return Page(self.opened.enter_context(connect(f"ws://127.0.0.1:{self.port}/live", max_size=None, **options)))


@dataclass
class Page:
    """What a browser does, as far as the server can tell."""

    socket: ClientConnection
    last: int = 0

    def say(self, **request: Any) -> None:
        self.socket.send(json.dumps(request))

    def hear(self) -> dict[str, Any]:
        """The next frame, acknowledged."""
        data = self.socket.recv(timeout=20)
        assert isinstance(data, bytes)
        self.last, _ = HEAD.unpack(data[: HEAD.size])
        self.say(kind="ack", n=self.last)
        found: dict[str, Any] = msgspec.msgpack.decode(data[HEAD.size :])
        return found

    def until(self, wanted: Callable[[dict[str, Any]], bool]) -> dict[str, Any]:
        for _ in range(500):
            frame = self.hear()
            if wanted(frame):
                return frame
        raise AssertionError("never came")

    def hello(self, token: str = TOKEN) -> dict[str, Any]:
        self.say(kind="hello", token=token)
        return self.until(lambda frame: frame["k"] == "hello")


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def make_desk(lab: Lab) -> Desk:
    post = Post(lambda: Status(lab.phase, ""), lab.order, lab.answers)
    return Desk(POOL, planner.plan(POOL), lab.bus, listen(lab.bus, POOL.robot_ids), WallClock(), post, "real-time")


@pytest.fixture
def lab() -> Iterator[Lab]:
    hub, port = MemoryHub(), free_port()
    with Bus(MemoryTransport(hub)) as bus, Bus(MemoryTransport(hub)) as robots:
        opened = contextlib.ExitStack()
        found = Lab(port, bus, robots, opened)
        with WebServer(make_desk(found), WebOptions(port=port, token=TOKEN)), opened:
            yield found


def state(frame: dict[str, Any]) -> bool:
    return bool(frame["k"] == "state")


def test_a_page_gets_the_scene_then_states_as_they_come(lab: Lab) -> None:
    page = lab.open()
    hello = page.hello()
    assert [robot["id"] for robot in hello["scene"]["robots"]] == [1, 2]
    lab.say(robot=2)
    seen = page.until(lambda f: state(f) and "state" in f["robots"][1])
    assert seen["robots"][1]["state"]["mode"] == "ARMED"
    assert "state" not in seen["robots"][0]
    assert any(line.startswith("robot 1: not heard (start its agent") for line in seen["preflight"])
    assert seen["allowed"] == ["load", "arm", "start", "stop", "disarm", "clear-stop", "return", "test"]
    lab.robots.publish(topics.PREVIEW, Preview(b"jpeg"), time.time_ns())
    assert page.until(lambda f: f["k"] == "picture")["jpeg"] == b"jpeg"


@pytest.mark.parametrize("origin", ["http://evil.example", "null", None, "https://127.0.0.1"])
def test_a_stranger_s_page_is_not_let_in(lab: Lab, origin: str | None) -> None:
    with pytest.raises(InvalidStatus) as refused:
        lab.open(origin=origin)
    assert refused.value.response.status_code == 403


def test_a_wrong_token_sees_nothing(lab: Lab) -> None:
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


@pytest.mark.parametrize("text", ["nonsense", '{"kind":"order","n":1,"order":"fly"}', "x" * (requests.LONGEST_BYTES + 1)])
def test_nonsense_ends_only_its_own_connection(lab: Lab, text: str) -> None:
    good, bad = lab.open(), lab.open()
    good.hello()
    bad.hello()
    bad.socket.send(text)
    with pytest.raises(ConnectionClosed):
        while True:
            bad.hear()
    lab.say()
    assert good.until(lambda f: state(f) and f["watchers"] == 1)


def test_who_has_control_commands_and_all_may_stop(lab: Lab) -> None:
    first, second = lab.open(), lab.open()
    mine, yours = first.hello()["you"], second.hello()["you"]
    first.say(kind="order", n=1, order="start")
    refused = first.until(lambda f: f["k"] == "reply")
    assert (refused["ok"], refused["reason"]) == (False, "take control first")
    first.say(kind="take")
    assert first.until(lambda f: state(f) and f["holder"] != 0)["holder"] == mine
    second.say(kind="take")
    for n, order in enumerate(("start", "clear-stop", "disarm")):
        second.say(kind="order", n=n, order=order)
        reply = second.until(lambda f: f["k"] == "reply")
        assert (reply["n"], reply["ok"], reply["reason"]) == (n, False, "another page has control")
    assert lab.orders == []
    second.say(kind="order", n=9, order="stop")
    assert second.until(lambda f: f["k"] == "reply")["ok"]
    first.say(kind="order", n=2, order="clear-stop")
    assert first.until(lambda f: f["k"] == "reply")["ok"]
    first.say(kind="order", n=3, order="hold")
    assert first.until(lambda f: f["k"] == "reply")["reason"] == "not now"
    assert lab.orders == [Order.STOP, Order.CLEAR_STOP, Order.HOLD]
    first.socket.close()
    second.say(kind="take")
    assert second.until(lambda f: state(f) and f["holder"] == yours)


def test_a_stopped_page_holds_nobody_up(lab: Lab) -> None:
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


def test_answers_of_robots_and_lines_of_the_log_reach_the_page(lab: Lab) -> None:
    page = lab.open()
    page.hello()
    lab.answers.append(Answer(Command(Order.ARM, 2), Reply(2, False, "no pose", Mode.DISARMED)))
    answer = page.until(lambda f: f["k"] == "answer")
    assert (answer["robot"], answer["order"], answer["ok"], answer["reason"]) == (2, "arm", False, "no pose")
    lab.robots.publish(topics.EVENT, Event(4, "agent-1", "trouble"), 5_000_000_000)
    event = page.until(lambda f: f["k"] == "event")
    assert (event["time_s"], event["level"], event["text"]) == (5.0, 4, "trouble")
    late = lab.open()
    late.hello()
    assert late.until(lambda f: f["k"] == "event")["text"] == "trouble"


def test_while_dragging_the_newest_edit_is_answered(lab: Lab) -> None:
    page = lab.open()
    page.hello()
    for n in range(1, 40):
        page.say(kind="try", n=n, edit={"diameter_m": 0.4 + 0.001 * n})
    last = page.until(lambda f: f["k"] == "tried" and f["n"] == 39)
    assert last["ok"] and last["fastest_mps"] == pytest.approx(0.439 * 3.14159265 / 100, rel=1e-5)


def test_a_certificate_that_cannot_be_used_is_told_before_anything_flies(lab: Lab, tmp_path: Path) -> None:
    """Not a line in the log, and then a station without a page that says where its page is."""
    (none := tmp_path / "none.pem").write_text("no certificate\n")
    for certificate in (tmp_path / "absent.pem", none):
        with pytest.raises(ConfigError, match=f"--web-certificate {certificate}"):
            WebServer(make_desk(lab), WebOptions(port=free_port(), certificate=certificate, key=none))


def test_assets_are_ours_alone_and_say_so(lab: Lab) -> None:
    from urllib.request import Request, urlopen

    with urlopen(f"http://127.0.0.1:{lab.port}/") as answer:
        page = answer.read().decode()
        assert "default-src 'self'" in answer.headers["content-security-policy"]
        assert answer.headers["x-content-type-options"] == "nosniff"
    assert "http" not in page.replace("http-equiv", "")
    rebound = Request(f"http://127.0.0.1:{lab.port}/", headers={"Host": "evil.example"})
    with pytest.raises(OSError, match="421"):
        urlopen(rebound)
