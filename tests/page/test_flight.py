"""The operator's page in a real browser, on a real run. The tests share the run, and leave it as they found it: disarmed."""

import re
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from itertools import groupby
from pathlib import Path

import numpy as np
import psutil
import pytest
from playwright.sync_api import Browser, Page, expect

from groundstation.logs.reader import open_log, read_log
from shoal.messages import topics
from shoal.messages.codec import decode
from shoal.messages.messages import (
    Mode,
    RobotState,
    Tuning,
)
from sim_bridge.replay.step_replay import rerun
from sim_bridge.sil.ports import free_port
from tests.page.elements import answer, button, in_mode, map_of, tile
from tests.page.flights import OperatorFlight, PageTraffic, open_page, serious

pytestmark = [pytest.mark.timeout(600), pytest.mark.real_time]  # what waits for a browser waits for a loaded machine

TURNING = "0.5"  # fifty times that of the file


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
    answer(page, "Clear")
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
    page: Page, browser: Browser, flight: OperatorFlight, traffic: PageTraffic
) -> None:
    expect(page.get_by_role("button", name="You have control")).to_be_visible()
    second = open_page(browser, flight, traffic, width=390, height=844)
    expect(second.get_by_role("button", name=re.compile("Watching"))).to_be_visible()
    for name in ("Arm", "Start", "Disarm"):
        expect(button(second, name)).to_be_disabled()
    second.get_by_role("button", name=re.compile("EMERGENCY STOP")).click()
    expect(page.get_by_role("alert")).to_contain_text("robot 2 confirms: stopped")
    second.get_by_role("button", name=re.compile("Watching")).click()
    answer(second, "Take over")
    expect(second.get_by_role("button", name="You have control")).to_be_visible()
    expect(page.get_by_role("button", name=re.compile("Watching"))).to_be_visible()
    clear_stop(second)
    second.context.close()
    page.get_by_role("button", name="Take control").click()
    expect(page.get_by_role("button", name="You have control")).to_be_visible()


def test_gains_are_changed_in_flight_and_changed_back(page: Page) -> None:
    """The last test reads the effect on the robots off the log."""
    again = button(page, "Load again")
    if again.is_enabled():  # a mission is over
        again.click()
    expect(button(page, "Start")).to_be_enabled()
    button(page, "Start").click()
    in_mode(page, "TRACKING")
    gains = page.locator(".tuning")
    gains.locator("summary").click()
    expect(gains.locator("h2")).to_contain_text("set A")
    field, apply = gains.get_by_label("turning", exact=True), button(page, "Apply")
    expect(apply).to_be_disabled()
    field.fill("-1")
    expect(gains).to_contain_text("controller.nmpc.turning_m: from 0 to 1")
    expect(apply).to_be_disabled()
    fly_on(page, 2)  # with the gains of the file
    field.fill(TURNING)
    apply.click()
    expect(gains.locator("h2")).to_contain_text("set B")
    answers = page.get_by_label("Orders given from here")
    expect(answers).to_contain_text("gains confirmed by 1, 2")
    expect(gains.get_by_label("Tracking error by lap").locator("tbody tr")).to_have_count(2)
    fly_on(page, 3)
    button(page, "Undo").click()
    expect(gains.locator("h2")).to_contain_text("set A")
    expect(field).to_have_value("0.01")
    page.keyboard.press("h")  # the focus is on a button, not in a field
    in_mode(page, "HOLDING")
    button(page, "Disarm").click()
    in_mode(page, "DISARMED")


def renderers() -> dict[int, psutil.Process]:
    """The browser's processes that hold pages."""
    processes = {}
    for process in psutil.Process().children(recursive=True):
        with suppress(psutil.NoSuchProcess):  # it has just ended
            if "--type=renderer" in " ".join(process.cmdline()):
                processes[process.pid] = process
    return processes


def test_a_stopped_tab_holds_nobody_up(page: Page, browser: Browser, flight: OperatorFlight, traffic: PageTraffic) -> None:
    """Neither the other tab nor the robots. That the recorder missed no step is told by the last test."""
    before = renderers()
    second = open_page(browser, flight, traffic)
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
    expect(verdict).to_contain_text("between centres0.80 m")
    middle, scale = map_of(page, 3.5, 2.5)
    place = (middle[0] + (0.45 / 2 + 0.4) * scale, middle[1])  # robot 1's place when the run begins

    page.mouse.move(*place)
    page.mouse.down()
    page.mouse.move(place[0] - 0.3 * scale, place[1], steps=4)
    expect(verdict).to_contain_text("cannot be flown")
    expect(verdict).to_contain_text("robots 1 and 2: 0.500 m apart")
    page.mouse.move(place[0] + 0.2 * scale, place[1], steps=4)
    page.mouse.up()
    expect(verdict).to_contain_text(re.compile(r"between centres(0\.99|1\.0[01]) m"))  # a pixel is 5 mm
    page.get_by_label("Name of the new experiment").fill("Not A Name")
    expect(button(page, "Save")).to_be_disabled()


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
        "controller.nmpc.turning_m": float(TURNING)
    }
    flown = [[(s.stamp_ns, s.message.tuning_id) for s in log.of(topics.STATE, RobotState, robot)] for robot in (1, 2)]
    assert flown[0] == flown[1], "all robots change over at one instant"
    assert [name for name, _ in groupby(name for _, name in flown[0])] == [a.id, b.id, a.id]

    (same,) = rerun(recorded, [1])
    assert same.exact  # the change is among what the log says was done to the robot
    (other,) = rerun(recorded, [1], [f"controller.nmpc.turning_m={TURNING}"])
    assert other.compared == len(flown[0])
    since = next(k for k, (_, name) in enumerate(flown[0]) if name == b.id)
    apart_n = np.abs(other.before["control.wrench"] - other.after["control.wrench"]).max(axis=1)
    assert np.nanmax(apart_n[:since]) > 0.005  # still another solver; NaN where the thrusters stood still


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
