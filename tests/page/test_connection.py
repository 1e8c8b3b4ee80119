"""A page whose station hangs, is cut off or has ended: it says so, and no stop is lost."""

import re
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass, replace

import cv2
import numpy as np
import pytest
from foxglove_schemas_protobuf.Log_pb2 import Log
from playwright.sync_api import Browser, Page, WebSocketRoute, expect

from groundstation.mission.state_machine import MissionState
from shoal.config.experiment import load_experiment
from shoal.messages import topics
from shoal.messages.messages import (
    CommandKind,
    Event,
    Preview,
    RobotState,
)
from sim_bridge.sil.ports import free_port
from tests.page.elements import button
from tests.page.flights import PATIENCE_MS, wait_for_port
from tests.page.lone_station import lone_station

pytestmark = [pytest.mark.timeout(600), pytest.mark.real_time]  # what waits for a browser waits for a loaded machine


def looks_lost(page: Page) -> None:
    """As after a connection that was closed: header, link, control, alarms, buttons."""
    expect(page.locator("header .mission-state")).to_have_class(re.compile("lost"))
    expect(page.locator("header .mission-state")).to_have_text(re.compile("^last known: "))
    expect(page.get_by_text("no connection", exact=True)).to_be_visible()
    expect(button(page, "You have control")).to_have_count(0)
    expect(page.get_by_label("Alarms")).to_contain_text("no connection to the station: what you see is old")
    expect(page.locator(".page")).to_have_class(re.compile("lost"))
    for name in ("Arm", "Start", "Disarm", "End run"):
        expect(button(page, name)).to_be_disabled()


def stop_is_not_heard(page: Page) -> None:
    expect(page.get_by_role("button", name="STOP NOT HEARD")).to_be_visible()
    expect(page.get_by_role("alert").filter(has_text="Emergency stop not heard")).to_be_visible()
    expect(page.locator(".given")).to_contain_text("stop no answer: the station may not have heard it; it is sent again")
    expect(page.get_by_text("confirms: stopped")).to_have_count(0)


def test_a_stop_into_a_connection_that_is_dead_already_is_sent_on_return(browser: Browser) -> None:
    """The page cannot know yet: what it says goes into a buffer, and is lost with it."""
    with lone_station(browser, load_experiment("pool")) as desk:
        page, lines, dead = desk.page, list[WebSocketRoute](), set[int]()

        def between(line: WebSocketRoute) -> None:
            lines.append(line)
            station, number = line.connect_to_server(), len(lines)
            line.on_message(lambda message: None if number in dead else station.send(message))

        page.route_web_socket("**/live", between)
        page.goto(desk.url)
        expect(button(page, "You have control")).to_be_visible()
        dead.add(1)
        page.keyboard.press("Escape")
        expect(page.locator(".given")).to_contain_text("stop no answer: the station may not have heard it; it is sent again")
        assert desk.orders == []
        lines[0].close()
        expect(page.locator(".given")).to_contain_text("stop sent")
        assert desk.orders == [CommandKind.STOP]
        lines[1].close()
        expect(button(page, "You have control")).to_be_visible()
        page.wait_for_timeout(500)
        assert desk.orders == [CommandKind.STOP]  # answered: not again


def test_a_browser_that_is_cut_off_without_a_close_knows_it(browser: Browser) -> None:
    """Nothing comes and nothing goes, and no socket says so; when it is back, it is the same page."""
    with lone_station(browser, load_experiment("pool")) as desk:
        page, dead = desk.page, set[int]()
        lines: list[WebSocketRoute] = []

        def between(line: WebSocketRoute) -> None:
            lines.append(line)
            station, number = line.connect_to_server(), len(lines)
            line.on_message(lambda message: None if number in dead else station.send(message))
            station.on_message(lambda message: None if number in dead else line.send(message))

        page.route_web_socket("**/live", between)
        page.goto(desk.url)
        expect(button(page, "You have control")).to_be_visible()
        dead.update(range(1, 3))  # the next connection is no better
        looks_lost(page)
        page.keyboard.press("Escape")
        stop_is_not_heard(page)
        assert desk.orders == []
        expect(page.locator(".given")).to_contain_text("stop sent")  # over the third
        assert len(lines) >= 3
        assert desk.orders == [CommandKind.STOP]
        expect(button(page, "You have control")).to_be_visible()


@pytest.mark.parametrize("of", [".tile[data-robot='1'] .age", ".picture-age"])
def test_a_delay_of_the_line_counts_as_age(browser: Browser, of: str) -> None:
    """Robot and camera speak all the time; the way of every message to the page becomes longer, up to 2 s."""
    jpeg = cv2.imencode(".jpg", np.zeros((48, 64, 3), dtype=np.uint8))[1].tobytes()
    with lone_station(browser, load_experiment("pool")) as desk:
        page, slow_s = desk.page, [0.0]
        on_the_way: list[tuple[float, str | bytes]] = []

        def between(line: WebSocketRoute) -> None:
            station = line.connect_to_server()
            line.on_message(station.send)
            station.on_message(lambda message: on_the_way.append((time.monotonic() + slow_s[0], message)))
            lines.append(line)

        def pass_on(for_s: float) -> list[float]:
            """Ages that the page shows meanwhile, in s."""
            shown, end_s = [], time.monotonic() + for_s
            while time.monotonic() < end_s:
                desk.robots.publish(topics.STATE, RobotState(), time.time_ns(), 1)
                desk.robots.publish(topics.PREVIEW, Preview(jpeg), time.time_ns())
                page.wait_for_timeout(100)
                while on_the_way and on_the_way[0][0] <= time.monotonic():
                    lines[-1].send(on_the_way.pop(0)[1])
                texts = page.locator(of).all_text_contents()  # none before the page is ready
                if match := re.search(r"([0-9.]+) (m?s)", "".join(texts)):
                    shown.append(float(match[1]) * (1e-3 if match[2] == "ms" else 1.0))
            return shown

        lines: list[WebSocketRoute] = []
        page.route_web_socket("**/live", between)
        page.goto(desk.url)
        while not pass_on(1.0):
            pass
        assert min(pass_on(2.0)) < 0.5
        for tenths in range(2, 21, 2):  # a line that says nothing for a second would be lost
            slow_s[0] = tenths / 10
            pass_on(0.6)
        pass_on(3.0)  # until nothing is shown that came more quickly
        assert 1.95 < min(pass_on(3.0)) < 3.5  # a slow machine adds to it; counted twice it would be 4 s


def test_events_of_megabytes_leave_the_page_and_its_stop_alive(browser: Browser) -> None:
    with lone_station(browser, load_experiment("pool")) as desk:
        page = desk.page
        page.goto(desk.url)
        expect(button(page, "You have control")).to_be_visible()
        huge = Log(level=Log.Level.INFO, name="agent-2", message="x" * 4_100_000).SerializeToString()
        for _ in range(2):
            desk.robots.forward(topics.EVENT, huge, time.time_ns())
        desk.robots.publish(topics.EVENT, Event(2, "agent-2", "y" * 4_100_000), time.time_ns())
        expect(page.get_by_label("Log", exact=True)).to_contain_text("yyyy")
        page.keyboard.press("Escape")
        expect(page.locator(".given")).to_contain_text("stop sent")
        assert desk.orders == [CommandKind.STOP]
        assert page.evaluate("document.body.innerText.length") < 20_000


@pytest.mark.parametrize("width", [840, 1024, 1280])
def test_the_stop_button_is_whole_in_a_window_of_any_width(browser: Browser, width: int) -> None:
    with lone_station(browser, load_experiment("pool")) as lone:
        lone.page.set_viewport_size({"width": width, "height": 700})
        lone.own_status = replace(lone.own_status, state=MissionState.RETURNING)
        lone.page.goto(lone.url)
        expect(lone.page.locator("header .mission-state")).to_have_text("returning to the start")
        box = button(lone.page, "EMERGENCY STOP Shift+Space").bounding_box()
        assert box is not None and box["x"] >= 0.0 and box["x"] + box["width"] <= width
        assert lone.page.evaluate("document.documentElement.scrollWidth") <= width


@pytest.mark.parametrize("width", [1024, 1280, 1440])
def test_another_page_moves_nothing_on_this_one(browser: Browser, width: int) -> None:
    with lone_station(browser, load_experiment("pool")) as lone:
        lone.page.set_viewport_size({"width": width, "height": 800})
        lone.own_status = replace(lone.own_status, state=MissionState.RUNNING, began_ns=lone.clock.now_ns())
        lone.page.goto(lone.url)
        expect(button(lone.page, "You have control")).to_be_visible()
        every = "[...document.querySelectorAll('header > button, aside')]"
        places = f"{every}.map((e) => [e.innerText.slice(0, 20), e.offsetLeft, e.offsetTop, e.offsetWidth, e.offsetHeight])"
        before = lone.page.evaluate(places)
        other = browser.new_page()
        other.goto(lone.url)
        expect(lone.page.get_by_text("2 pages")).to_be_visible()
        assert lone.page.evaluate(places) == before
        other.close()


def test_the_clock_stands_when_the_mission_is_over(browser: Browser) -> None:
    with lone_station(browser, load_experiment("pool")) as lone:
        lone.own_status = replace(lone.own_status, state=MissionState.RUNNING, began_ns=lone.clock.now_ns() - 60_000_000_000)
        lone.page.goto(lone.url)
        clock = lone.page.locator("header .clock")
        expect(clock).to_have_text(re.compile(r"^1:0[3-9] / "))  # it goes on
        lone.own_status = replace(lone.own_status, state=MissionState.DONE)
        expect(lone.page.locator("header .mission-state")).to_have_text("done")
        stood = clock.inner_text()
        lone.page.wait_for_timeout(2500)
        assert clock.inner_text() == stood


def test_a_mission_that_is_done_and_its_station_gone_is_no_alarm(browser: Browser) -> None:
    with lone_station(browser, load_experiment("pool")) as desk:
        page = desk.page
        page.clock.install()
        desk.own_status = replace(desk.own_status, state=MissionState.RUNNING)
        page.goto(desk.url)
        expect(page.locator("header .mission-state")).to_have_text("running")
        desk.own_status = replace(
            desk.own_status, state=MissionState.DONE, ended=True
        )  # of the last cycle: an automatic station ends with it
        desk.server.close()
        expect(page.locator("header .mission-state")).to_have_text("the run is over: its report is being written")
        expect(page.get_by_text("no connection", exact=True)).to_have_count(0)
        expect(page.get_by_role("button", name=re.compile("STOP"))).to_have_count(0)  # there is nothing to stop
        page.clock.fast_forward(100_000)  # a report of a long run takes that; nobody knows from here
        expect(page.locator("header .mission-state")).to_have_text(
            re.compile("the report takes long, or the program has ended")
        )
        expect(page.get_by_label("Alarms")).to_contain_text("none")


@dataclass
class BareStation:
    """`groundstation run` by the wall clock, without robots."""

    url: str
    process: subprocess.Popen[bytes]


@pytest.fixture(scope="module")
def station(tmp_path_factory: pytest.TempPathFactory) -> Iterator[BareStation]:
    """Shared: the last of its tests ends it."""
    port = free_port()
    command = [sys.executable, "-m", "groundstation", "run", "pool", "--listen", f"tcp/127.0.0.1:{free_port()}"]
    process = subprocess.Popen([*command, "--web", f"127.0.0.1:{port}", "--out", str(tmp_path_factory.mktemp("station"))])
    try:
        wait_for_port(port, process)
        yield BareStation(f"http://127.0.0.1:{port}/", process)
    finally:
        process.send_signal(signal.SIGCONT)
        process.terminate()
        process.wait(30)


def test_a_station_that_hangs_looks_like_one_that_is_gone_and_a_stop_says_that_nobody_heard_it(
    browser: Browser, station: BareStation
) -> None:
    page = browser.new_page(viewport={"width": 1440, "height": 900})
    page.goto(station.url)
    expect(button(page, "You have control")).to_be_visible()
    station.process.send_signal(signal.SIGSTOP)
    looks_lost(page)
    page.keyboard.press("Escape")
    stop_is_not_heard(page)
    station.process.send_signal(signal.SIGCONT)
    expect(page.get_by_role("alert")).to_contain_text("robot 1 has not confirmed")
    expect(page.get_by_role("button", name="STOPPING")).to_be_visible()
    expect(page.locator(".given")).to_contain_text("stop under way … 1 not heard … 2 not heard")
    expect(button(page, "You have control")).to_be_visible()  # the same page as before
    expect(page.get_by_label("Alarms")).not_to_contain_text("no connection")
    page.context.close()


def test_a_stop_pressed_before_the_silence_is_noticed_says_so_too(browser: Browser, station: BareStation) -> None:
    page = browser.new_page()
    page.goto(station.url)
    expect(button(page, "You have control")).to_be_visible()
    station.process.send_signal(signal.SIGSTOP)
    page.keyboard.press("Escape")
    expect(page.locator(".given")).not_to_contain_text("sent;")
    stop_is_not_heard(page)
    looks_lost(page)
    station.process.send_signal(signal.SIGCONT)
    expect(page.locator(".given")).to_contain_text("stop under way")
    page.context.close()


def test_a_run_that_is_ended_on_the_page_is_shown_there_with_its_verdict_and_flown_again(
    browser: Browser, station: BareStation
) -> None:
    page = browser.new_page(viewport={"width": 1440, "height": 900})
    page.goto(station.url)
    button(page, "End run").click()  # nobody is armed: not asked twice
    expect(page.locator(".folder")).to_contain_text("The run is over; it is in")
    expect(page.locator("header .mission-state")).to_have_text("the run is over: its report is being written")
    expect(page.get_by_label("Alarms")).not_to_contain_text("no connection")  # while the report is written
    end = page.get_by_label("End of the run")
    expect(end.locator(".verdict")).to_contain_text("not judged")
    expect(end.locator(".verdict")).to_contain_text("A person pressed the emergency stop")  # of the tests before
    expect(button(page, "Edit and fly")).to_have_count(0)  # robots in a pool have the experiment that was deployed
    with page.expect_popup(timeout=PATIENCE_MS) as opened:
        page.locator(".replay").get_by_role("link", name="Report").click(timeout=PATIENCE_MS)
    expect(opened.value.locator("h1")).to_contain_text("Two robots in a line on a circle")
    button(page, "Fly again").click()
    expect(end).to_have_count(0)
    expect(page.get_by_label("News of the mission")).to_contain_text("robot 1 not heard")  # it waits for its robots again
    assert station.process.poll() is None
    button(page, "End run").click()
    button(page, "Close").click()
    assert station.process.wait(60) == 1
    expect(page.locator("header .mission-state")).to_have_text("the program has ended")
    expect(page.get_by_label("Alarms")).not_to_contain_text("no connection")
    page.context.close()
