"""The operator's page in a real browser, on a real run. The tests share the run, and leave it as they found it: disarmed."""

import json
import re
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass, replace
from itertools import groupby
from pathlib import Path

import cv2
import numpy as np
import psutil
import pytest
from foxglove_schemas_protobuf.Log_pb2 import Log
from playwright.sync_api import Browser, Locator, Page, WebSocketRoute, expect

from groundstation.logs.reader import open_log, read_log
from groundstation.mission.state_machine import MissionState
from groundstation.planning import planner
from groundstation.replay.step_replay import rerun
from groundstation.telemetry import Finding
from groundstation.web.live_backend import LiveBackend
from groundstation.web.server import WebServer
from sim_bridge.sil.ports import free_port
from tests.groundstation.fake_station import FakeStation
from tests.page.flights import PATIENCE_MS, OperatorFlight, PageTraffic, open_page, serious, wait_for_port
from wire.config.experiment import Experiment, load_experiment
from wire.messages import topics
from wire.messages.codec import decode
from wire.messages.messages import (
    CameraHealth,
    Event,
    LocalizerStatus,
    Mode,
    Order,
    Outcome,
    Preview,
    Progress,
    RobotState,
    Trajectory,
    Tuning,
)
from wire.transport.bus import Bus
from wire.transport.memory_transport import MemoryHub, MemoryTransport
from wire.web_access import WebOptions

pytestmark = [pytest.mark.timeout(600), pytest.mark.real_time]  # what waits for a browser waits for a loaded machine

YAW_WEIGHT = "800"  # a hundred times that of the file


def tile(page: Page, robot: int) -> Locator:
    return page.locator(f"[data-robot='{robot}']")


def in_mode(page: Page, mode: str) -> None:
    for robot in (1, 2):
        expect(tile(page, robot)).to_have_attribute("data-mode", mode)


def button(page: Page, name: str) -> Locator:
    return page.get_by_role("button", name=name, exact=True)


def fly_on(page: Page, seconds: int) -> None:
    """By the run's own clock, in the header: machines differ in how fast they fly in lockstep."""

    def flown_s() -> int:
        minutes, whole = page.locator("header .clock").inner_text().split(" / ")[0].split(":")
        return 60 * int(minutes) + int(whole)

    until_s = flown_s() + seconds + 1  # it has just struck, or is about to
    while flown_s() < until_s:
        page.wait_for_timeout(100)


def clear_stop(page: Page) -> None:
    page.get_by_role("button", name=re.compile("Clear stop")).click()
    in_mode(page, "DISARMED")


def test_an_operator_flies_a_mission(page: Page) -> None:
    expect(page.get_by_text("Preflight: 2 of 2 ready")).to_be_visible(timeout=60_000)
    expect(button(page, "Hold")).to_be_disabled()
    button(page, "Arm").click()
    in_mode(page, "ARMED")
    answers = page.get_by_label("Orders given from here")
    expect(answers).to_contain_text("arm confirmed by 1, 2")
    button(page, "Start").click()
    in_mode(page, "TRACKING")
    expect(button(page, "Arm")).to_be_disabled()
    expect(page.locator("header .clock")).to_have_text(re.compile("^0:0[1-9]"))
    page.keyboard.press("h")
    in_mode(page, "HOLDING")
    button(page, "Resume").click()
    in_mode(page, "TRACKING")
    button(page, "Disarm").click()
    in_mode(page, "DISARMED")


def test_the_emergency_stop_is_latched_and_confirmed_by_name(page: Page) -> None:
    page.get_by_label("What plot 1 shows").focus()  # wherever the focus is
    page.keyboard.press("Shift+Space")
    stopped = page.get_by_role("alert")
    expect(stopped).to_contain_text("robot 1 confirms: stopped")
    expect(stopped).to_contain_text("robot 2 confirms: stopped")
    expect(page.get_by_role("button", name="STOPPED Shift+Space")).to_be_visible()
    for name in ("Arm", "Start", "Resume"):
        expect(button(page, name)).to_be_disabled()
    clear_stop(page)


def test_a_second_page_only_watches_but_may_stop(
    page: Page, browser: Browser, flight: OperatorFlight, asked: PageTraffic
) -> None:
    expect(page.get_by_role("button", name="You have control")).to_be_visible()
    second = open_page(browser, flight, asked, width=390, height=844)
    expect(second.get_by_role("button", name=re.compile("Watching"))).to_be_visible()
    for name in ("Arm", "Start", "Disarm"):
        expect(button(second, name)).to_be_disabled()
    second.get_by_role("button", name=re.compile("EMERGENCY STOP")).click()
    expect(page.get_by_role("alert")).to_contain_text("robot 2 confirms: stopped")
    second.get_by_role("button", name=re.compile("Watching")).click()  # take over, confirmed
    expect(second.get_by_role("button", name="You have control")).to_be_visible()
    expect(page.get_by_role("button", name=re.compile("Watching"))).to_be_visible()
    clear_stop(second)
    second.context.close()
    page.get_by_role("button", name="Take control").click()
    expect(page.get_by_role("button", name="You have control")).to_be_visible()


def test_gains_are_changed_in_flight_and_changed_back(page: Page) -> None:
    """The last test reads the effect on the robots off the log."""
    again = button(page, "Load again")
    if again.is_visible():  # a mission is over
        again.click()
    expect(button(page, "Start")).to_be_enabled()
    button(page, "Start").click()
    in_mode(page, "TRACKING")
    gains = page.locator(".tuning")
    gains.locator("summary").click()
    expect(gains.locator("h2")).to_contain_text("set A")
    field, apply = gains.get_by_label("Inputs R yaw"), button(page, "Apply")
    expect(apply).to_be_disabled()
    field.fill("-1")
    expect(gains).to_contain_text("controller.mpc.r.2: from 0 to 10000")
    expect(apply).to_be_disabled()
    fly_on(page, 2)  # with the gains of the file
    field.fill(YAW_WEIGHT)
    apply.click()
    expect(gains.locator("h2")).to_contain_text("set B")
    answers = page.get_by_label("Orders given from here")
    expect(answers).to_contain_text("gains confirmed by 1, 2")
    expect(gains.get_by_label("Tracking error by lap").locator("tbody tr")).to_have_count(2)
    fly_on(page, 3)
    button(page, "Undo").click()
    expect(gains.locator("h2")).to_contain_text("set A")
    expect(field).to_have_value("8")
    page.keyboard.press("h")  # the focus is on a button, not in a field
    in_mode(page, "HOLDING")
    button(page, "Disarm").click()
    in_mode(page, "DISARMED")


def renderers() -> dict[int, psutil.Process]:
    """The browser's processes that hold pages."""
    found = {}
    for process in psutil.Process().children(recursive=True):
        with suppress(psutil.NoSuchProcess):  # it has just ended
            if "--type=renderer" in " ".join(process.cmdline()):
                found[process.pid] = process
    return found


def test_a_stopped_tab_holds_nobody_up(page: Page, browser: Browser, flight: OperatorFlight, asked: PageTraffic) -> None:
    """Neither the other tab nor the robots. That the recorder missed no step is told by the last test."""
    before = renderers()
    second = open_page(browser, flight, asked)
    stopped = [process for pid, process in renderers().items() if pid not in before]
    assert stopped
    for process in stopped:
        process.suspend()
    try:
        button(page, "Load again").click()
        button(page, "Arm").click()
        in_mode(page, "ARMED")
        page.wait_for_timeout(3000)  # many times what a socket's buffers hold
        button(page, "Disarm").click()
        in_mode(page, "DISARMED")
    finally:
        for process in stopped:
            process.resume()
    in_mode(second, "DISARMED")
    second.context.close()


def test_old_values_are_not_shown_as_live(page: Page, flight: OperatorFlight) -> None:
    """In lockstep one robot that hangs stops all."""
    agent = flight.agent(2)
    agent.send_signal(signal.SIGSTOP)
    try:
        for robot in (1, 2):
            expect(tile(page, robot)).to_have_class(re.compile("stale"))
            expect(tile(page, robot)).to_contain_text("last heard")
        assert serious(page) == []  # grey, and still to be read
    finally:
        agent.send_signal(signal.SIGCONT)
    for robot in (1, 2):
        expect(tile(page, robot)).not_to_have_class(re.compile("stale"))


def test_a_formation_is_dragged_and_judged(page: Page) -> None:
    button(page, "Edit").click()
    verdict = page.locator(".verdict")
    expect(verdict).to_contain_text("can be flown: closest 0.80 m")
    middle, scale = map_of(page, 3.5, 2.5)
    place = (middle[0] + (0.45 / 2 + 0.4) * scale, middle[1])  # robot 1's place when the run begins

    page.mouse.move(*place)
    page.mouse.down()
    page.mouse.move(place[0] - 0.3 * scale, place[1], steps=4)
    expect(verdict).to_contain_text("cannot be flown")
    expect(verdict).to_contain_text("robots 1 and 2: 0.500 m apart")
    page.mouse.move(place[0] + 0.2 * scale, place[1], steps=4)
    page.mouse.up()
    expect(verdict).to_contain_text(re.compile(r"can be flown: closest (0\.99|1\.0[01]) m"))  # a pixel is 5 mm
    page.get_by_label("Name of the new experiment").fill("Not A Name")
    expect(button(page, "Save")).to_be_disabled()


@dataclass(kw_only=True)
class Alone(FakeStation):
    """A station without robots, and a page on it."""

    page: Page
    url: str
    robots: Bus
    server: ExitStack


@contextmanager
def alone(browser: Browser, experiment: Experiment, run_dir: Path | None = None) -> Iterator[Alone]:
    port, hub = free_port(), MemoryHub()
    page = browser.new_page(viewport={"width": 1440, "height": 900})
    with Bus(MemoryTransport(hub)) as bus, Bus(MemoryTransport(hub)) as robots:
        server = ExitStack()
        found = Alone(experiment, bus, page=page, url=f"http://127.0.0.1:{port}/", robots=robots, server=server)
        desk = LiveBackend(experiment, planner.plan(experiment), bus, found.heard, found.clock, found, "real-time", run_dir)
        with server:
            server.enter_context(WebServer(desk, WebOptions(port=port)))
            yield found
            page.context.close()


@contextmanager
def editor(browser: Browser) -> Iterator[Page]:
    """The editor open on a path of waypoints: the planner needs no robots for that."""
    curve = load_experiment(
        "figure-eight",
        ["path.points_m=[[-0.8,0.0],[0.0,0.3],[0.8,0.0]]", "path.laps=1", "path.start_index=0", "duration_s=15"],
    )
    with alone(browser, curve) as desk:
        desk.page.goto(desk.url)
        button(desk.page, "Edit").click()
        expect(desk.page.locator(".verdict")).to_contain_text("can be flown")
        yield desk.page


def test_a_route_is_edited_too_and_what_cannot_be_typed_is_answered(browser: Browser) -> None:
    """A request that is none of ours ends the connection, and with it the control over robots that fly: no edit may be one."""
    with alone(browser, load_experiment("islands")) as desk:
        page = desk.page
        page.goto(desk.url)
        expect(button(page, "You have control")).to_be_visible()
        button(page, "Edit").click()
        expect(page.locator(".verdict")).to_contain_text("can be flown")
        expect(page.get_by_label("speed")).to_have_value("0.15")
        expect(button(page, "Add waypoints")).to_be_visible()
        page.get_by_label("duration").fill("0")
        expect(page.locator(".verdict")).to_contain_text("duration_s")
        page.get_by_label("speed").fill("1000000")
        page.get_by_label("duration").fill("100")
        expect(page.locator(".verdict")).to_contain_text("cannot be flown")
        expect(button(page, "You have control")).to_be_visible()


def test_an_alarm_that_comes_again_is_loud_again(browser: Browser) -> None:
    with alone(browser, load_experiment("pool")) as desk:
        page, quiet = desk.page, desk.told
        loud = replace(quiet, recorder_error="no space left")
        desk.told = loud
        page.goto(desk.url)
        button(page, "Silence").click()
        expect(button(page, "Silence")).to_have_count(0)
        expect(page.get_by_label("Alarms")).to_contain_text("no space left")
        desk.told = quiet
        expect(page.get_by_label("Alarms")).not_to_contain_text("no space left")
        desk.told = loud
        expect(button(page, "Silence")).to_be_visible()


def test_a_stop_into_a_connection_that_is_dead_already_is_sent_on_return(browser: Browser) -> None:
    """The page cannot know yet: what it says goes into a buffer, and is lost with it."""
    with alone(browser, load_experiment("pool")) as desk:
        page, lines, dead = desk.page, list[WebSocketRoute](), set[int]()

        def between(line: WebSocketRoute) -> None:
            lines.append(line)
            station, number = line.connect_to_server(), len(lines)
            line.on_message(lambda said: None if number in dead else station.send(said))

        page.route_web_socket("**/live", between)
        page.goto(desk.url)
        expect(button(page, "You have control")).to_be_visible()
        dead.add(1)
        page.keyboard.press("Escape")
        expect(page.locator(".given")).to_contain_text("stop no answer: the station may not have heard it; it is sent again")
        assert desk.orders == []
        lines[0].close()
        expect(page.locator(".given")).to_contain_text("stop sent")
        assert desk.orders == [Order.STOP]
        lines[1].close()
        expect(button(page, "You have control")).to_be_visible()
        page.wait_for_timeout(500)
        assert desk.orders == [Order.STOP]  # answered: not again


def test_escape_leaves_what_is_open_and_else_stops_and_shift_space_always_stops(browser: Browser) -> None:
    with alone(browser, load_experiment("pool")) as desk:
        page = desk.page
        page.goto(desk.url)
        expect(button(page, "You have control")).to_be_visible()
        page.get_by_text("Layers", exact=True).click()
        page.get_by_label("trails").uncheck()
        page.keyboard.press("Escape")
        expect(page.get_by_label("trails")).not_to_be_visible()
        page.get_by_label("Remark for the log").fill("half a word")
        page.keyboard.press("Escape")
        expect(page.get_by_label("Remark for the log")).not_to_be_focused()
        page.wait_for_timeout(300)
        assert desk.orders == []
        page.keyboard.press("Escape")
        expect(page.locator(".given")).to_contain_text("stop sent")
        assert desk.orders == [Order.STOP]
        page.get_by_label("Remark for the log").focus()
        page.keyboard.press("Shift+Space")
        expect(page.locator(".given li")).to_have_count(2)
        assert desk.orders == [Order.STOP, Order.STOP]
        button(page, "Fit").focus()
        page.get_by_role("button", name="Follow").focus()
        page.keyboard.press("Shift+Space")
        expect(page.locator(".given li")).to_have_count(3)
        expect(page.get_by_role("button", name="Follow")).to_have_attribute("aria-pressed", "false")  # not pressed by it


def test_places_clicked_on_the_map_are_where_the_formation_is_led(browser: Browser) -> None:
    with alone(browser, load_experiment("pool")) as desk:
        desk.told = replace(desk.told, state=MissionState.RUNNING)
        page = desk.page
        page.goto(desk.url)
        button(page, "Go to…").click()
        expect(button(page, "Fly there")).to_be_disabled()
        chart = page.locator(".pool > canvas")
        box = chart.bounding_box()
        assert box is not None
        seen = []
        for x, y in ((0.5, 0.4), (0.6, 0.55)):
            chart.click(position={"x": x * box["width"], "y": y * box["height"]})
            under = re.fullmatch(r"x (\S+)\s+y (\S+) m", page.locator(".cursor").inner_text())
            assert under is not None
            seen.append((float(under[1]), float(under[2])))
        button(page, "Fly there").click()
        expect(page.locator(".given")).to_contain_text("go sent")
        assert desk.orders == [Order.GO]
        np.testing.assert_allclose(desk.via, seen, atol=0.011)  # both are shown to the centimetre
        assert abs(seen[0][0] - seen[1][0]) > 0.05
        button(page, "Go to…").click()
        page.keyboard.press("Escape")  # leaves the choice, and stops nothing
        expect(button(page, "Go to…")).to_be_visible()
        assert desk.orders == [Order.GO]


def test_the_log_takes_remarks_and_is_filtered(browser: Browser) -> None:
    with alone(browser, load_experiment("pool")) as desk:
        page = desk.page
        page.goto(desk.url)
        expect(button(page, "You have control")).to_be_visible()
        for level, source, text in ((2, "agent-1", "armed"), (4, "agent-2", "no pose"), (3, "groundstation", "robot 1: late")):
            desk.robots.publish(topics.EVENT, Event(level, source, text), time.time_ns())
        lines = page.locator(".log li")
        expect(lines).to_have_count(3)
        page.get_by_label("Lines of which robot").select_option("1")
        expect(lines).to_have_count(2)
        page.get_by_label("From which level on").select_option("3")
        expect(lines).to_have_text([re.compile("robot 1: late")])
        page.get_by_label("Lines of which robot").select_option("")
        page.get_by_label("Lines with this text").fill("POSE")
        expect(lines).to_have_text([re.compile("no pose")])


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


def test_a_browser_that_is_cut_off_without_a_close_knows_it(browser: Browser) -> None:
    """Nothing comes and nothing goes, and no socket says so; when it is back, it is the same page."""
    with alone(browser, load_experiment("pool")) as desk:
        page, dead = desk.page, set[int]()
        lines: list[WebSocketRoute] = []

        def between(line: WebSocketRoute) -> None:
            lines.append(line)
            station, number = line.connect_to_server(), len(lines)
            line.on_message(lambda said: None if number in dead else station.send(said))
            station.on_message(lambda said: None if number in dead else line.send(said))

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
        assert desk.orders == [Order.STOP]
        expect(button(page, "You have control")).to_be_visible()


def test_events_of_megabytes_leave_the_page_and_its_stop_alive(browser: Browser) -> None:
    with alone(browser, load_experiment("pool")) as desk:
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
        assert desk.orders == [Order.STOP]
        assert page.evaluate("document.body.innerText.length") < 20_000


def test_the_map_draws_what_is_flown_now(browser: Browser) -> None:
    experiment = load_experiment("pool")
    with alone(browser, experiment) as desk:
        canvas = desk.page.locator(".pool canvas")
        desk.page.goto(desk.url)
        planned = planner.plan(experiment)
        expect(canvas).to_have_attribute("data-paths", " ".join(t.id for t in planned.values()))
        before = desk.page.evaluate("document.querySelector('.pool canvas').toDataURL()")
        line = np.linspace([-1.0, -1.0, 0.3, 0.0], [1.0, 1.0, 0.3, 0.0], 100)
        home = {r: Trajectory(f"home-{r}", 0.05, line, 0 * line, 0 * line, begin_s=30.0) for r in planned}
        desk.paths = {robot: (way, 35.0) for robot, way in home.items()}
        expect(canvas).to_have_attribute("data-paths", "home-1 home-2")
        assert desk.page.evaluate("document.querySelector('.pool canvas').toDataURL()") != before


def test_of_several_cameras_the_picture_of_one_is_chosen(browser: Browser) -> None:
    """West's picture is red, east's is green; each lies under its own end of the map."""
    experiment = load_experiment("two-cameras")
    with alone(browser, experiment) as desk:
        page, choice = desk.page, desk.page.get_by_label("Camera whose picture is shown")

        def tell(*out: str) -> None:
            for name, colour in (("west", (0, 0, 255)), ("east", (0, 255, 0))):
                jpeg = cv2.imencode(".jpg", np.full((480, 640, 3), colour, np.uint8))[1].tobytes()
                desk.robots.publish(topics.PREVIEW.of_camera(name), Preview(jpeg), time.time_ns())
            desk.robots.publish(topics.LOCALIZER, LocalizerStatus(CameraHealth.OK, out=out), time.time_ns())

        def under(x_m: float) -> str:
            """The strongest colour of the map at a place of the pool; none of them in water."""
            middle, scale = map_of(page, 6.4, 2.5)
            place = [round(middle[0] + x_m * scale), round(middle[1] + 0.3 * scale)]
            script = """([x, y]) => {
                const c = document.querySelector('.pool canvas'), box = c.getBoundingClientRect();
                return [...c.getContext('2d').getImageData(x - box.left, y - box.top, 1, 1).data];
            }"""
            red, green, blue, _ = page.evaluate(script, place)
            return "west" if red > 2 * max(green, blue) else "east" if green > 2 * max(red, blue) else "water"

        def shows(name: str) -> None:
            deadline = time.monotonic() + PATIENCE_MS * 1e-3
            while (found := (under(-2.2), under(2.2))) != ((name, "water") if name == "west" else ("water", name)):
                assert time.monotonic() < deadline, found
                tell()
                page.wait_for_timeout(50)
            expect(page.locator(".picture-age")).to_contain_text(f"picture of {name} ")

        page.goto(desk.url)
        expect(choice).to_have_value("west")
        shows("west")
        page.keyboard.press("c")
        expect(choice).to_have_value("east")
        shows("east")
        page.reload()  # the choice is remembered
        expect(choice).to_have_value("east")
        shows("east")
        choice.focus()
        page.keyboard.press("ArrowUp")
        expect(choice).to_have_value("west")
        shows("west")
        tell("east")
        expect(choice.locator("option")).to_have_text(["west", "east (out)"])
        assert serious(page) == []
        desk.orders.clear()
        page.keyboard.press("Escape")  # leaves the choice, and stops nobody
        page.keyboard.press("Escape")
        expect(page.locator(".given")).to_contain_text("stop")
        assert desk.orders == [Order.STOP]


def test_a_request_has_one_line_and_that_says_how_it_ended(browser: Browser) -> None:
    with alone(browser, load_experiment("pool")) as desk:
        page, given = desk.page, desk.page.locator(".given li")
        page.goto(desk.url)
        button(page, "Return to start").click()
        expect(given).to_have_text("return sent")
        told = Outcome(1, Order.RETURN, Progress.UNDER_WAY, "", "HALTING", (1,), (2,), ("is holding",))
        desk.told = replace(desk.told, requests=(told,))
        expect(given).to_have_text("return under way ✓ 1 … 2 is holding")
        failed = replace(told, progress=Progress.FAILED, reason="holding: no way from here", why=("refuses",))
        desk.told = replace(desk.told, requests=(failed,))
        expect(given).to_have_text("return failed: holding: no way from here ✓ 1 ✕ 2 refuses")
        desk.told = replace(desk.told, requests=(replace(told, progress=Progress.DONE, confirmed=(1, 2), waiting=()),))
        expect(given).to_have_text("return confirmed by 1, 2")


def test_a_run_that_is_ended_on_the_page_is_shown_there_as_recorded_with_its_report(
    browser: Browser, station: BareStation
) -> None:
    page = browser.new_page(viewport={"width": 1440, "height": 900})
    page.goto(station.url)
    button(page, "End run").click()  # nobody is armed: not asked twice
    expect(page.locator(".folder")).to_contain_text("The run is ended; it is in")
    expect(page.locator("header .mission-state")).to_have_text("the run is ended")
    expect(page.get_by_label("Alarms")).not_to_contain_text("no connection")  # while the report is written
    with page.expect_popup(timeout=PATIENCE_MS) as opened:
        page.locator(".replay").get_by_role("link", name="Report").click(timeout=PATIENCE_MS)
    expect(opened.value.locator("h1")).to_contain_text("Two robots in a line on a circle")
    assert station.process.poll() is None  # until the page is closed, or Ctrl-C
    page.context.close()


def test_a_mission_that_is_done_and_its_station_gone_is_no_alarm(browser: Browser) -> None:
    with alone(browser, load_experiment("pool")) as desk:
        page = desk.page
        desk.told = replace(desk.told, state=MissionState.RUNNING)
        page.goto(desk.url)
        expect(page.locator("header .mission-state")).to_have_text("running")
        desk.told = replace(desk.told, state=MissionState.DONE)  # of the last cycle: an automatic station ends with it
        desk.server.close()
        expect(page.locator("header .mission-state")).to_have_text("the run is ended")
        expect(page.get_by_text("no connection", exact=True)).to_be_visible()
        expect(page.get_by_label("Alarms")).to_contain_text("none")


def test_a_stop_of_an_earlier_station_can_be_cleared(browser: Browser) -> None:
    with alone(browser, load_experiment("pool")) as desk:
        desk.page.goto(desk.url)
        expect(button(desk.page, "You have control")).to_be_visible()
        expect(button(desk.page, "Clear stop")).to_have_count(0)
        desk.robots.publish(topics.STATE, RobotState(mode=Mode.STOPPED), time.time_ns(), 2)
        button(desk.page, "Clear stop").click()
        expect(desk.page.locator(".given")).to_contain_text("clear-stop sent")
        assert desk.orders == [Order.CLEAR_STOP]


def test_thrusters_can_be_tested_where_preflight_waits_for_that(browser: Browser) -> None:
    with alone(browser, load_experiment("pool")) as desk:
        untested = Finding(1, "thrusters", "notice", True, "thruster test: not done", "groundstation mission test")
        desk.preflight = (untested,)
        desk.page.goto(desk.url)
        expect(desk.page.locator(".preflight")).to_contain_text("thruster test: not done")
        expect(button(desk.page, "Start")).to_be_disabled()
        button(desk.page, "Test thrusters").click()
        expect(desk.page.locator(".given")).to_contain_text("test sent")
        assert desk.orders == [Order.TEST]


def test_a_waypoint_is_dragged_and_judged(browser: Browser) -> None:
    with editor(browser) as page:
        verdict = page.locator(".verdict")
        middle, scale = map_of(page, 3.5, 2.5)
        page.mouse.move(middle[0], middle[1] + 0.3 * scale)
        page.mouse.down()
        page.mouse.move(middle[0], middle[1] + 1.2 * scale, steps=5)
        expect(verdict).to_contain_text("the wall's clearance in y")
        page.mouse.move(middle[0], middle[1], steps=5)  # straight: nothing in the way
        page.mouse.up()
        expect(verdict).to_contain_text("can be flown")


def test_a_preview_plays_in_time(browser: Browser) -> None:
    """By a clock of its own: fifteen seconds of run in twelve."""
    with editor(browser) as page:
        page.clock.install(time=0)
        page.clock.pause_at(60)
        button(page, "Preview").click()
        page.clock.run_for(5000)
        playing = page.get_by_role("button", name="6 s of 15")
        expect(playing).to_be_visible()
        map_now = "document.querySelector('.pool canvas').toDataURL()"
        before = page.evaluate(map_now)
        page.clock.run_for(3200)
        expect(page.get_by_role("button", name="10 s of 15")).to_be_visible()
        assert page.evaluate(map_now) != before
        page.clock.run_for(4200)
        expect(button(page, "Preview")).to_be_visible()


def test_one_robot_is_driven_by_keys_and_sent_to_a_place(browser: Browser) -> None:
    with alone(browser, load_experiment("pool")) as desk:
        page = desk.page
        page.goto(desk.url)
        expect(button(page, "You have control")).to_be_visible()
        desk.robots.publish(topics.STATE, RobotState(mode=Mode.HOLDING), time.time_ns(), 2)
        tile(page, 2).get_by_role("button").click()
        panel = page.get_by_label("Robot 2 alone")
        expect(button(page, "Arm 2")).to_be_disabled()  # it is
        button(page, "Hold 2").click()
        expect(page.locator(".given")).to_contain_text("hold 2 sent")
        assert (desk.orders, desk.only) == ([Order.HOLD], 2)

        page.keyboard.press("w")  # nobody has asked for keys to drive
        button(page, "Drive 2").click()
        page.keyboard.down("w")
        page.keyboard.down("d")
        page.wait_for_timeout(500)
        page.keyboard.up("w")
        page.keyboard.up("d")
        page.wait_for_timeout(300)
        said = len(desk.drives)
        (robot, ahead), (_, last) = desk.drives[-3], desk.drives[-1]
        assert said >= 4  # ten a second
        assert robot == 2
        assert max(velocity.surge_mps for _, velocity in desk.drives) == pytest.approx(0.4 * 0.48)
        assert ahead.yaw_rate_radps > 0.0  # to the right, as seen from above
        assert (last.surge_mps, last.heave_mps, last.yaw_rate_radps) == (0.0, 0.0, 0.0)
        page.wait_for_timeout(300)
        assert len(desk.drives) == said  # nothing is held: nothing is said
        page.keyboard.press("Shift+Space")
        expect(page.locator(".given")).to_contain_text("stop sent")

        button(page, "Send 2 to…").click()
        page.locator(".pool > canvas").click(position={"x": 300, "y": 200})
        panel.get_by_role("button", name=re.compile("^Send 2 to .* m$")).click()
        expect(page.locator(".given")).to_contain_text("go 2 sent")
        assert (desk.orders[-1], desk.only, len(desk.via)) == (Order.GO, 2, 1)


PADS = """
  window.pads = [null];
  navigator.getGamepads = () => window.pads;
  window.pad = (mapping, axes) => {
    window.pads = [null, {index: 1, id: mapping || 'some pad', connected: true, mapping, axes, buttons: []}];
  };
"""


def asked_of(desk: FakeStation) -> tuple[float, ...]:
    """Shares of the vehicle's limits in the newest velocity: ahead, down, right."""
    limits, (_, last) = desk.experiment.vehicle.limits, desk.drives[-1]
    shares = (
        last.surge_mps / limits.speed_mps,
        last.heave_mps / limits.heave_mps,
        last.yaw_rate_radps / limits.yaw_rate_radps,
    )
    return tuple(round(share / 0.4, 3) for share in shares)


def until_asked(desk: FakeStation, page: Page, wanted: tuple[float, ...]) -> None:
    for _ in range(PATIENCE_MS // 100):
        if desk.drives and asked_of(desk) == wanted:
            return
        page.wait_for_timeout(100)
    raise AssertionError(f"{asked_of(desk) if desk.drives else 'nothing'} and not {wanted}")


def test_a_gamepad_drives_in_any_layout_and_the_robot_holds_without_it(browser: Browser) -> None:
    """Layouts as browsers give them. A shifted rest, a trigger or a pad that is gone never moves a robot."""
    half = (0.5 - 0.12) / (1 - 0.12)
    with alone(browser, load_experiment("pool")) as desk:
        page = desk.page
        page.add_init_script(PADS)
        page.goto(desk.url)
        expect(button(page, "You have control")).to_be_visible()
        desk.robots.publish(topics.STATE, RobotState(mode=Mode.HOLDING), time.time_ns(), 2)
        tile(page, 2).get_by_role("button").click()
        page.evaluate("pad('standard', [0, -1, 0, 0])")  # held ahead before driving begins
        button(page, "Drive 2").click()
        page.wait_for_timeout(500)
        assert desk.drives == []
        page.evaluate("pad('standard', [0.1, -0.11, 0.05, 0.1])")  # at rest, as far as sticks are
        page.wait_for_timeout(300)
        assert desk.drives == []
        page.evaluate("pad('standard', [0, -1, 0, 0.5])")
        until_asked(desk, page, (1.0, round(half, 3), 0.0))
        page.evaluate("pad('standard', [0, 0, -1.2, 0])")  # the right stick turns, and no stick goes beyond its end
        until_asked(desk, page, (0.0, 0.0, -1.0))
        page.evaluate("window.pads = [null, null]")  # pulled out in the middle of it
        until_asked(desk, page, (0.0, 0.0, 0.0))
        for rest, pushed, wanted in (  # x, y, left trigger, right x, right y, right trigger, hat; and another maker's
            ([0, 0, -1, 0, 0, -1, 0, 0], [1, 0, -1, 0, 0, -1, 0, 0], (0.0, 0.0, 1.0)),
            ([0, 0, 0, -1, -1, 0], [0, -1, 1, -1, -1, 1], (1.0, 0.0, 0.0)),
        ):
            page.evaluate("axes => pad('', axes)", pushed)  # plugged in while it is pushed
            page.wait_for_timeout(300)
            assert asked_of(desk) == (0.0, 0.0, 0.0)
            page.evaluate("axes => pad('', axes)", rest)
            page.wait_for_timeout(300)
            assert asked_of(desk) == (0.0, 0.0, 0.0)
            page.evaluate("axes => pad('', axes)", pushed)
            until_asked(desk, page, wanted)
            page.evaluate("window.pads[1].connected = false")
            until_asked(desk, page, (0.0, 0.0, 0.0))
        page.evaluate("pad('', [NaN])")
        page.wait_for_timeout(300)
        assert asked_of(desk) == (0.0, 0.0, 0.0)


def test_runs_are_found_named_read_and_deleted_on_the_page(browser: Browser, tmp_path: Path) -> None:
    for name in ("now", "first", "second"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "run.mcap").write_bytes(bytes(1_500_000))
    result = {"scene": "pool", "mode": "lockstep", "duration_s": 40.0, "passed": False, "tags": ["lamp"]}
    (tmp_path / "first" / "result.json").write_text(json.dumps(result))
    told = "<p id=told></p><script>told.textContent = `${origin}: its script runs`</script>"
    (tmp_path / "first" / "report.html").write_text(told)
    with alone(browser, load_experiment("pool"), tmp_path / "now") as desk:
        page = desk.page
        page.goto(desk.url)
        expect(button(page, "You have control")).to_be_visible()
        button(page, "Runs").click()
        rows = page.locator(".runs tbody tr")
        expect(rows).to_have_count(3)
        expect(page.locator("[data-run='now']")).to_contain_text("this run")
        expect(page.locator("[data-run='now']").get_by_role("button", name="Delete")).to_be_disabled()
        expect(page.locator("[data-run='first']")).to_contain_text("#lamp")
        expect(page.locator("[data-run='first']")).to_contain_text("pool, lockstep40 s1.5 MBfailed")
        page.get_by_label("Runs with these words").fill("LAMP failed")
        expect(rows).to_have_count(1)
        with page.expect_popup() as opened:
            rows.get_by_role("link", name="Report").click()
        expect(opened.value.locator("#told")).to_have_text("null: its script runs")  # an origin of its own
        opened.value.close()
        page.get_by_label("Runs with these words").fill("")
        page.locator("[data-run='now']").get_by_role("button", name="Label").click()
        page.get_by_label("Name of now").fill("first dive")
        page.get_by_label("Tags of now").fill("#cold deep")
        button(page, "Keep").click()
        expect(page.locator("[data-run='now']")).to_contain_text("first dive this run #cold #deep")
        assert serious(page) == []
        page.once("dialog", lambda dialog: dialog.dismiss())
        page.locator("[data-run='second']").get_by_role("button", name="Delete").click()
        assert (tmp_path / "second").is_dir()
        page.once("dialog", lambda dialog: dialog.accept())
        page.locator("[data-run='second']").get_by_role("button", name="Delete").click()
        expect(rows).to_have_count(2)
        assert not (tmp_path / "second").exists()
        page.keyboard.press("Escape")  # closes the list, and stops nothing
        expect(rows).to_have_count(0)
        assert desk.orders == []


def test_the_editor_adds_removes_undoes_and_writes_a_commented_file(
    browser: Browser, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    with alone(browser, load_experiment("pool", ["pool.size_m=[6,5,1]", "camera.position_m=[0,0,-9]"])) as desk:
        page = desk.page
        page.goto(desk.url)
        button(page, "Edit").click()
        verdict = page.locator(".verdict")
        expect(verdict).to_contain_text("can be flown")
        page.locator(".editor select").first.select_option("waypoints")
        page.locator(".editor select").nth(1).select_option("column")
        expect(page.get_by_label("spacing")).to_have_value("0.8")
        button(page, "Add robot").click()
        button(page, "Add islands").click()
        middle, scale = map_of(page, 6.0, 5.0)
        page.mouse.click(middle[0] + 2.5 * scale, middle[1] - 2.0 * scale)
        expect(button(page, "Remove island 1")).to_be_enabled()
        page.wait_for_timeout(800)  # later than what is undone together
        page.keyboard.press("Delete")
        expect(button(page, "Remove")).to_be_disabled()
        button(page, "Undo").click()
        button(page, "Redo").click()
        page.keyboard.press("Control+z")
        page.get_by_label("duration").fill("5")
        expect(verdict).to_contain_text("can be flown")
        page.get_by_label("Name of the new experiment").fill("mine")
        button(page, "Save").click()
        expect(page.get_by_text("saved: experiments/mine.toml; fly it with groundstation run")).to_be_visible()
        expect(page.locator(".editor .number").first).to_have_attribute("title", re.compile("^path.kind: "))
    text = (tmp_path / "experiments" / "mine.toml").read_text()
    assert "Waypoints x, y of the formation's centre, in order." in text
    saved = load_experiment(str(tmp_path / "experiments" / "mine.toml"))
    assert (saved.path.kind, saved.formation.shape, saved.robot_ids) == ("waypoints", "column", (1, 2, 3))
    assert [island.position_m for island in saved.islands] == [pytest.approx((2.5, -2.0), abs=0.02)]


def test_any_field_is_plotted_and_a_layout_is_an_address(browser: Browser) -> None:
    with alone(browser, load_experiment("pool")) as desk:
        page = desk.page
        page.goto(f"{desk.url}?plots=battery,state.nu.0&robot=2")
        expect(page.get_by_label("What plot 1 shows")).to_have_value("battery")
        expect(page.get_by_label("What plot 2 shows")).to_have_value("state.nu.0")
        expect(tile(page, 2)).to_have_class(re.compile("chosen"))
        for _ in range(8):
            told = RobotState(nu=np.array([0.25, 0.0, 0.0, 0.0]), board_loss=0.5, drag_ratio=1.32, thrust_ratio=0.75)
            desk.robots.publish(topics.STATE, told, time.time_ns(), 1)
            page.wait_for_timeout(120)
        expect(tile(page, 1)).to_contain_text("× 1.32, 0.75")
        figures = page.locator(".plot")
        expect(figures.nth(1).locator(".u-legend")).to_contain_text("0.25")
        page.get_by_label("What plot 3 shows").select_option("state.loss")  # of before it was asked for, too
        expect(figures.nth(2).locator(".u-legend")).to_contain_text("0.50")
        page.on("dialog", lambda dialog: dialog.accept("mine"))
        page.get_by_label("Layouts of the plots").select_option("+")
        page.goto(f"{desk.url}?plots=tracking")
        page.get_by_label("Layouts of the plots").select_option("=mine")
        expect(page.get_by_label("What plot 3 shows")).to_have_value("state.loss")
        desk.robots.publish(topics.STATE, RobotState(board_loss=0.25), time.time_ns(), 1)
        expect(tile(page, 1)).to_contain_text("25 %")
        expect(tile(page, 1)).not_to_contain_text("thrust")  # it learns nothing


def test_on_a_phone_the_map_is_second_and_everything_is_large_enough(browser: Browser, tmp_path: Path) -> None:
    (tmp_path / "now").mkdir()
    (tmp_path / "now" / "run.mcap").touch()
    with alone(browser, load_experiment("pool"), tmp_path / "now") as desk:
        page = desk.page
        page.set_viewport_size({"width": 390, "height": 844})
        page.goto(desk.url)
        desk.robots.publish(topics.STATE, RobotState(mode=Mode.HOLDING), time.time_ns(), 1)
        expect(button(page, "You have control")).to_be_visible()
        tile(page, 1).get_by_role("button").click()
        button(page, "Drive 1").click()
        button(page, "Runs").click()
        button(page, "Label").click()
        places = page.evaluate(
            "['.mission', '.pool', '.one-robot', '.tiles', '.plots', '.log']"
            ".map((name) => document.querySelector(name).getBoundingClientRect().top)"
        )
        assert places == sorted(places)
        small = page.evaluate(
            "[...document.querySelectorAll('button, select, summary, input')]"
            ".filter((e) => e.checkVisibility() && e.type !== 'checkbox' && e.getBoundingClientRect().height < 43.5)"
            ".map((e) => e.outerHTML.slice(0, 80))"
        )
        assert small == []
        thin = page.evaluate(
            "[...document.querySelectorAll('body *')].filter((e) => e.checkVisibility() && "
            "[...e.childNodes].some((n) => n.nodeType === 3 && n.data.trim() !== '')"
            " && parseFloat(getComputedStyle(e).fontSize) < 14)"
            ".map((e) => e.outerHTML.slice(0, 80))"
        )
        assert thin == []
        assert page.evaluate("document.documentElement.scrollWidth") <= 390
        assert serious(page) == []


def map_of(page: Page, length_m: float, width_m: float) -> tuple[tuple[float, float], float]:
    """The pool's middle on the screen, and pixels per metre, as long as nobody has zoomed."""
    canvas = page.locator(".pool canvas").bounding_box()
    assert canvas is not None
    scale = min((canvas["width"] - 56) / length_m, (canvas["height"] - 56) / width_m)
    return (canvas["x"] + canvas["width"] / 2, canvas["y"] + canvas["height"] / 2), scale


@pytest.mark.parametrize("theme", ["dark", "light"])
def test_nothing_serious_for_who_sees_or_hears_badly(page: Page, theme: str) -> None:
    if page.evaluate("document.documentElement.dataset.theme") != theme:
        page.get_by_title("Dark or light").click()
    page.locator(".tuning summary").click()
    assert serious(page) == []
    button(page, "Edit").click()
    expect(page.locator(".verdict")).to_contain_text("can be flown")
    assert serious(page) == []


def test_page_reconnects_when_the_station_is_started_again(page: Page, flight: OperatorFlight) -> None:
    flight.stop()
    expect(page.get_by_text("no connection", exact=True)).to_be_visible()
    expect(page.get_by_label("Alarms")).to_contain_text("what you see is old")
    expect(tile(page, 1)).to_have_class(re.compile("stale"))
    flight.start()
    expect(tile(page, 1)).not_to_have_class(re.compile("stale"))
    expect(page.get_by_text("Preflight: 2 of 2 ready")).to_be_visible(timeout=60_000)
    flight.stop()  # what follows reads its logs; in lockstep it would take both processors meanwhile


def first_armed_s(run: Path) -> float:
    """The time of the first arming, counted from the log's first message as in a replay: machines differ in how long they
    idle."""
    with open_log(run) as log:
        for line in log.messages(lambda topic, robot: topic is topics.STATE):
            if decode(RobotState, line.payload, "log", "state").mode is not Mode.DISARMED:
                return (line.arrived_ns - log.start_ns) * 1e-9
    raise AssertionError("nobody ever armed")


def test_a_recorded_run_is_replayed(browser: Browser, flight: OperatorFlight) -> None:
    """The first run of these tests, which the restart above has ended."""
    recorded = min(folder for folder in flight.folder.iterdir() if folder.is_dir())
    with replayed(recorded) as url:
        page = browser.new_page()
        page.goto(url)
        expect(tile(page, 2)).not_to_have_class(re.compile("stale"))
        in_mode(page, "TRACKING")  # it waits where the robots began to fly
        slider = page.get_by_label("Time in the run, seconds")
        before = float(slider.input_value())
        drawn = page.locator(".plot canvas").first
        drawn.wait_for()
        # The whole run is there, with the values of now, before anything was played.
        expect(page.locator(".plot .u-legend").first).to_have_text(re.compile(r"robot 1:?\s*\d"))
        expect(page.locator(".replay .mark").first).to_be_attached()
        page.get_by_label("Pace").select_option("2")  # chooses, and plays nothing
        expect(page.get_by_role("status")).to_contain_text("paused")
        page.locator("body").press(".")
        page.wait_for_function(
            "before => Math.abs(document.querySelector('.replay input').valueAsNumber - before - 0.05) < 0.01", arg=before
        )
        page.locator("body").press(" ")
        expect(page.locator(".replay").get_by_role("button", name="Pause", exact=True)).to_be_visible()
        page.wait_for_function("before => document.querySelector('.replay input').valueAsNumber > before + 1", arg=before)
        page.locator("body").press(" ")
        expect(button(page, "Play")).to_be_visible()
        slider.fill(str(first_armed_s(recorded) - 0.1))
        in_mode(page, "DISARMED")
        expect(page.get_by_role("button", name=re.compile("STOP"))).to_have_count(0)  # there is nothing to stop
        page.get_by_role("button", name="3-D").click()
        expect(page.locator(".deep canvas")).to_have_count(2)
        page.close()


def test_the_log_holds_the_gains_and_the_solver_had_them(flight: OperatorFlight) -> None:
    """Of the same run. Beside what the robot did stands what its program would have done with these gains from the start."""
    recorded = min(folder for folder in flight.folder.iterdir() if folder.is_dir())
    log = read_log(recorded / "run.mcap")
    a, b = (entry.message for entry in log.of(topics.TUNING, Tuning))
    assert dict(zip(b.keys, b.values, strict=True)) == dict(zip(a.keys, a.values, strict=True)) | {
        "controller.mpc.r.2": float(YAW_WEIGHT)
    }
    flown = [[(s.stamp_ns, s.message.tuning_id) for s in log.of(topics.STATE, RobotState, robot)] for robot in (1, 2)]
    assert flown[0] == flown[1], "all robots change over at one instant"
    assert [name for name, _ in groupby(name for _, name in flown[0])] == [a.id, b.id, a.id]

    (same,) = rerun(recorded, [1])
    assert same.exact  # the change is among what the log says was done to the robot
    (other,) = rerun(recorded, [1], [f"controller.mpc.r=[0.05,0.05,{YAW_WEIGHT}]"])
    assert other.compared == len(flown[0])
    since = next(k for k, (_, name) in enumerate(flown[0]) if name == b.id)
    apart_n = np.abs(other.before["wrench"] - other.after["wrench"]).max(axis=1)
    assert apart_n[:since].max() > 0.005  # still another solver
    assert apart_n[since + 20 : since + 50].max() < 0.002  # the same one, but for where it started from and OSQP's tolerance


@contextmanager
def replayed(run: Path) -> Iterator[str]:
    """`groundstation log replay` at work; where its page is."""
    port = free_port()
    command = [sys.executable, "-m", "groundstation", "log", "replay", str(run), "--web", f"127.0.0.1:{port}"]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    try:
        assert process.stdout is not None
        yield process.stdout.readline().split()[-1]  # said when it serves
    finally:
        process.terminate()
        process.wait(30)
