"""The end of a run on the operator's page, whatever ends it: verdict, cause, figures, and what may follow; no reload."""

import html
import json
import re
import signal
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import cv2
import numpy as np
import pytest
from playwright.sync_api import Browser, Locator, Page, WebSocketRoute, expect

from groundstation.logs.recorder import Recorder
from groundstation.web.replay_backend import ReplayBackend
from groundstation.web.server import WebServer
from shoal.config.experiment import dump_experiment, load_experiment
from shoal.messages import topics
from shoal.messages.codec import Header, encode
from shoal.messages.messages import Event, Message, Preview, RobotState, StationHeartbeat
from shoal.messages.topics import Topic
from shoal.runtime.web_access import WebOptions
from sim_bridge.sil.ports import free_port
from tests.page.elements import answer, button, in_mode
from tests.page.flights import PATIENCE_MS, OperatorFlight, PageTraffic, open_page, serious
from tests.waiting import eventually

pytestmark = [pytest.mark.timeout(600), pytest.mark.real_time]  # what waits for a browser waits for a loaded machine


@contextmanager
def flown(browser: Browser, folder: Path, *arguments: str) -> Iterator[tuple[OperatorFlight, Page]]:
    """An automatic flight, and a page on it."""
    flight, traffic = OperatorFlight(folder, free_port(), arguments), PageTraffic()
    flight.start()
    try:
        page = open_page(browser, flight, traffic)
        yield flight, page
        page.context.close()
        assert traffic.errors == []
    finally:
        flight.stop()


def end_of(page: Page) -> Locator:
    return page.get_by_label("End of the run")


def flies(page: Page) -> None:
    """A live flight is shown, and no recorded one."""
    expect(end_of(page)).to_have_count(0)
    in_mode(page, "TRACKING")
    expect(page.locator("header .clock")).to_have_text(re.compile(r"^\d:(0[1-9]|[1-5]\d)"))  # and the flight has begun


def agrees(page: Page, flight: OperatorFlight, verdict: str, words: str) -> None:
    """Page, result, report and terminal name the same verdict and cause."""
    expect(end_of(page).locator(".verdict b")).to_have_text(re.compile(f"{verdict}$"))
    expect(page.get_by_text("no connection")).to_have_count(0)
    expect(page.get_by_role("button", name=re.compile("STOP"))).to_have_count(0)
    run = flight.runs[-1]
    result = json.loads((run / "result.json").read_text())
    assert result["verdict"] == verdict
    cause = result["cause"]["sentence"] if result["cause"] else ""
    assert words in cause
    expect(end_of(page).locator(".verdict")).to_contain_text(cause)
    output = flight.output.rpartition(f"into {run}")[2]
    assert f"cause: {cause}" in output if cause else "cause: " not in output
    page_of_report = html.unescape((run / "report.html").read_text())
    assert f"{verdict}</span></h1>" in page_of_report and cause in page_of_report


def test_a_run_ends_with_its_verdict_and_is_flown_again_stopped_brought_back_and_started(
    browser: Browser, tmp_path: Path
) -> None:
    with flown(browser, tmp_path, "--duration", "8") as (flight, page):
        agrees(page, flight, "passed", "")
        expect(end_of(page).get_by_label("Errors in mm")).to_contain_text("the article's")
        expect(page.get_by_label("Alarms")).to_contain_text("none")
        assert serious(page) == []
        button(page, "Replay").click()
        expect(button(page, "Pause").first).to_be_visible()

        button(page, "Fly again").click()
        flies(page)
        assert len(flight.runs) == 2
        page.keyboard.press("Shift+Space")
        expect(page.get_by_role("alert")).to_contain_text("robot 2 confirms: stopped")
        page.get_by_role("button", name=re.compile("Clear stop")).click()
        answer(page, "Clear")
        button(page, "Return to start").click()
        expect(page.locator("header .mission-state")).to_have_text("done")
        button(page, "Load again").click()  # the program has not ended
        button(page, "Start").click()
        flies(page)
        button(page, "Disarm").click()
        agrees(page, flight, "not judged", "A person disarmed the robots at ")
        button(page, "Close").click()
        assert flight.process is not None
        assert flight.process.wait(PATIENCE_MS * 1e-3) == 1
        expect(page.locator("header .mission-state")).to_have_text("the program has ended")
    assert flight.output.count("the page shows the recorded run: Close there, close the page, or press Ctrl-C") == 2
    assert not list(tmp_path.rglob(".page-open"))


def test_a_run_that_fails_shows_its_cause_and_an_edit_of_it_flies_next(browser: Browser, tmp_path: Path) -> None:
    """All in one process."""
    failing = ("--fault", "t=4 link 2 cut", "--one-process")
    with flown(browser, tmp_path, "--duration", "20", *failing) as (flight, page):
        agrees(page, flight, "failed", "robot 2 at ")
        assert "link 2 cut at 4" in end_of(page).inner_text()
        assert serious(page) == []
        button(page, "Edit and fly").click()
        expect(page.locator(".editor .verdict")).to_contain_text("can be flown")
        expect(button(page, "Fly this")).to_be_in_viewport()
        page.locator(".editor").get_by_label("duration").fill("2")
        expect(button(page, "Fly this")).to_be_enabled()
        button(page, "Fly this").click()
        flies(page)
        expect(page.locator(".editor")).to_have_count(0)
        agrees(page, flight, "passed", "")
        assert json.loads((flight.runs[-1] / "result.json").read_text())["planned_duration_s"] == 2.0
        page.context.close()  # the program ends with it
        assert flight.process is not None
        assert flight.process.wait(PATIENCE_MS * 1e-3) == 0


def test_ctrl_c_in_the_terminal_ends_on_the_page_and_the_next_one_ends_the_program(browser: Browser, tmp_path: Path) -> None:
    with flown(browser, tmp_path, "--duration", "300") as (flight, page):
        flies(page)
        assert flight.process is not None
        flight.process.send_signal(signal.SIGINT)
        agrees(page, flight, "not judged", "A person interrupted the program (Ctrl-C) at ")
        assert flight.process.poll() is None
        flight.process.send_signal(signal.SIGINT)
        assert flight.process.wait(PATIENCE_MS * 1e-3) == 130


def test_a_run_that_nobody_watches_ends_by_itself(tmp_path: Path) -> None:
    flight = OperatorFlight(tmp_path, free_port(), ("--duration", "1", "--one-process"))
    flight.start()
    assert flight.process is not None
    assert flight.process.wait(PATIENCE_MS * 1e-3) == 0
    assert "the page shows" not in flight.output


@pytest.fixture
def run(tmp_path: Path) -> Path:
    """A log of 20 s whose pictures end after 2 s; seven hundred lines in seven seconds."""
    (tmp_path / "experiment.toml").write_text(dump_experiment(load_experiment("pool")))
    recorder = Recorder(tmp_path / "run.mcap", "", {})
    jpeg = cv2.imencode(".jpg", np.full((480, 640, 3), 200, np.uint8))[1].tobytes()
    for k in range(2000):
        at_ns = k * 10_000_000
        if k % 10 == 0:
            recorder.put(topics.STATE, "shoal/robot/1/state", Header(1, k + 1, at_ns), encode(RobotState()), at_ns)
        if k % 20 == 0 and k <= 200:
            recorder.put(topics.PREVIEW, "shoal/camera/preview", Header(2, k + 1, at_ns), encode(Preview(jpeg)), at_ns)
        if k < 700:
            recorder.put(
                topics.EVENT, "shoal/event", Header(3, k + 1, at_ns), encode(Event(2, "agent-1", f"line {k}.")), at_ns
            )
    recorder.close()
    return tmp_path


def test_a_recorded_run_shows_the_lines_and_the_picture_of_its_time(browser: Browser, run: Path) -> None:
    port = free_port()
    with ReplayBackend(run) as source, WebServer(source, WebOptions(port=port)):
        page = browser.new_page()
        source.seek(1.02, 0.0)
        page.goto(f"http://127.0.0.1:{port}/")
        age, lines = page.locator(".picture-age"), page.locator(".log li")
        expect(age).to_have_text("picture 0.0 s")
        expect(lines.first).to_contain_text("line 102.")
        for time_s in (2.9, 15.0):  # still in sight of the log's reader; and long gone
            source.seek(time_s, 0.0)
            expect(age).to_have_text(f"picture {time_s - 2.0:.1f} s old")
        source.seek(1.82, 0.0)
        expect(age).to_have_text("picture 0.0 s")
        page.context.close()


def test_a_mark_counts_from_its_own_flight_and_none_lies_on_another(browser: Browser, tmp_path: Path) -> None:
    """Two flights: 10 s and 40 s after the log's first message."""
    (tmp_path / "experiment.toml").write_text(dump_experiment(load_experiment("pool")))
    recorder = Recorder(tmp_path / "run.mcap", "", {})
    lines = [(12.0, "first"), (12.1, "second"), (12.3, "third"), (42.0, "fourth")]
    messages: list[tuple[Topic, Message, float]] = [(topics.EVENT, Event(3, "agent-1", text), at_s) for at_s, text in lines]
    messages += [(topics.HEARTBEAT, StationHeartbeat(began_ns=round(at_s * 1e9)), at_s) for at_s in (10.0, 40.0)]
    messages += [(topics.STATE, RobotState(), float(at_s)) for at_s in range(61)]
    for number, (topic, message, at_s) in enumerate(sorted(messages, key=lambda one: one[2])):
        at_ns = round(at_s * 1e9)
        recorder.put(topic, f"shoal/{topic.key(1)}", Header(1, number, at_ns), encode(message), at_ns)
    recorder.close()
    port = free_port()
    with ReplayBackend(tmp_path) as source, WebServer(source, WebOptions(port=port)):
        page = browser.new_page()
        page.goto(f"http://127.0.0.1:{port}/")
        marks, events = page.locator(".replay .mark"), page.locator(".log li")
        for time_s in (20.0, 60.0):
            source.seek(time_s, 0.0)
            expect(events.last).to_have_text(re.compile(r"^2 s\b.*first"))
            expect(marks).to_have_count(2)
            expect(marks.nth(0)).to_have_attribute("title", re.compile(r"^2 s .*first\n2.1 s .*second\n2.3 s .*third$"))
            expect(marks.nth(1)).to_have_attribute("title", re.compile(r"^2 s .*fourth$"))
        page.context.close()


def test_a_choice_is_shown_and_one_that_was_not_heard_can_be_made_again(browser: Browser, run: Path) -> None:
    port, lines = free_port(), list[WebSocketRoute]()

    def between(line: WebSocketRoute) -> None:
        """The first connection loses the choice."""
        lines.append(line)
        station, first = line.connect_to_server(), len(lines) == 1
        line.on_message(lambda message: None if first and '"after"' in str(message) else station.send(message))

    page, fly = browser.new_page(), "Fly again"
    page.route_web_socket("**/live", between)
    with ReplayBackend(run, offers=("again", "close")) as source:
        with WebServer(source, WebOptions(port=port)):
            page.goto(f"http://127.0.0.1:{port}/")
            other = browser.new_page()
            other.goto(f"http://127.0.0.1:{port}/")
            button(page, fly).click()
            expect(button(page, fly)).to_be_disabled()  # it waits for an answer
            lines[0].close()
            expect(button(page, fly)).to_be_enabled()
            assert source.choice is None
            button(page, fly).click()
            assert eventually(lambda: source.choice is not None, PATIENCE_MS * 1e-3)
        for window in (page, other):
            expect(window.locator("header .mission-state")).to_have_text("the next run is being started")
            expect(button(window, "Close")).to_be_disabled()
            window.context.close()
