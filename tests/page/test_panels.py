"""The page's panels: alarms, log, map, pictures, runs, plots, and all of them on a phone."""

import csv
import json
import re
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from xml.etree import ElementTree

import cv2
import numpy as np
import pypdfium2 as pdfium
import pytest
from playwright.sync_api import Browser, Page, expect

from groundstation.planning import planner
from groundstation.telemetry import Finding, RobotView
from shoal.config.experiment import load_experiment
from shoal.messages import topics
from shoal.messages.messages import (
    BoardReading,
    CameraHealth,
    CommandKind,
    Control,
    Estimate,
    Event,
    Guidance,
    LocalizerStatus,
    Mode,
    Preview,
    RobotState,
    StepTiming,
    Trajectory,
)
from tests.page.elements import answer, button, map_of, tile
from tests.page.flights import PATIENCE_MS, serious
from tests.page.lone_station import lone_station
from tests.waiting import eventually

FRESH = StepTiming(board_age_ms=20.0)
pytestmark = [pytest.mark.timeout(600), pytest.mark.real_time]  # what waits for a browser waits for a loaded machine


def test_an_alarm_that_comes_again_is_loud_again(browser: Browser) -> None:
    with lone_station(browser, load_experiment("pool")) as desk:
        page, quiet = desk.page, desk.own_status
        loud = replace(quiet, recorder_error="no space left")
        desk.own_status = loud
        page.goto(desk.url)
        button(page, "Silence").click()
        expect(button(page, "Silence")).to_have_count(0)
        expect(page.get_by_label("Alarms")).to_contain_text("no space left")
        desk.own_status = quiet
        expect(page.get_by_label("Alarms")).not_to_contain_text("no space left")
        desk.own_status = loud
        expect(button(page, "Silence")).to_be_visible()


def test_an_alarm_that_grows_worse_is_loud_again(browser: Browser) -> None:
    """A person has silenced a battery's warning, with all else, when it falls below what a robot needs to arm."""
    with lone_station(browser, load_experiment("pool")) as desk:
        page, battery = desk.page, desk.experiment.vehicle.battery

        def falls_to(volts: float) -> None:
            state = RobotState(timing=FRESH, board=BoardReading(battery_v=volts))
            views = {1: RobotView(state, 0.0)}
            desk.own_status = replace(desk.own_status, recorder_error="no space left", views=views)

        falls_to(battery.warn_v - 0.1)
        page.goto(desk.url)
        expect(page.get_by_label("Alarms")).to_contain_text("battery")
        button(page, "Silence").click()
        expect(button(page, "Silence")).to_have_count(0)
        falls_to(battery.no_arm_v - 0.1)
        expect(button(page, "Silence")).to_be_visible()


def test_a_note_about_many_robots_stands_there_once(browser: Browser) -> None:
    with lone_station(browser, load_experiment("fleet-20")) as desk:
        page = desk.page
        desk.preflight = tuple(Finding(robot, "gone", "critical", "not heard", "", True) for robot in (1, 2, 5, 6, 7, 8))
        page.goto(desk.url)
        expect(page.locator(".preflight li")).to_have_text(
            [re.compile("robots 1, 2, 5 to 8 not heard"), re.compile("robots 3, 4, 9 to 20 ready")]
        )

        def alarms() -> list[str]:
            for robot in (3, 4, 20):
                desk.robots.publish(topics.STATE, RobotState(mode=Mode.FAULT, fault="no pose"), time.time_ns(), robot)
            page.wait_for_timeout(200)
            return page.locator(".alarms li").all_inner_texts()

        assert eventually(lambda: any("robots 3, 4, 20: fault: no pose" in text for text in alarms()), 60.0)


def test_the_log_takes_remarks_and_is_filtered(browser: Browser) -> None:
    with lone_station(browser, load_experiment("pool")) as desk:
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


def test_the_map_draws_what_is_flown_now(browser: Browser) -> None:
    experiment = load_experiment("pool")
    with lone_station(browser, experiment) as desk:
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
    with lone_station(browser, experiment) as desk:
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
            while (layers := (under(-2.2), under(2.2))) != ((name, "water") if name == "west" else ("water", name)):
                assert time.monotonic() < deadline, layers
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
        assert eventually(lambda: desk.orders) and desk.orders == [CommandKind.STOP]


def test_runs_are_found_named_read_and_deleted_on_the_page(browser: Browser, tmp_path: Path) -> None:
    for name in ("now", "first", "second"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "run.mcap").write_bytes(bytes(1_500_000))
    result = {"scene": "pool", "mode": "lockstep", "duration_s": 40.0, "passed": False, "tags": ["lamp"]}
    (tmp_path / "first" / "result.json").write_text(json.dumps(result))
    script = "<p id=told></p><script>told.textContent = `${origin}: its script runs`</script>"
    (tmp_path / "first" / "report.html").write_text(script)
    with lone_station(browser, load_experiment("pool"), tmp_path / "now") as desk:
        page = desk.page
        page.goto(desk.url)
        expect(button(page, "You have control")).to_be_visible()
        button(page, "Runs").click()
        rows = page.locator(".runs tbody tr")
        expect(rows).to_have_count(3)
        expect(page.locator("[data-run='now']")).to_contain_text("this run")
        expect(page.locator("[data-run='now']").get_by_role("button", name="Delete")).to_be_disabled()
        expect(page.locator("[data-run='first']")).to_contain_text("#lamp")
        expect(page.locator("[data-run='first']")).to_contain_text("pool, simulated time40 s1.5 MBfailed")
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
        page.locator("[data-run='second']").get_by_role("button", name="Delete").click()
        answer(page, "Cancel")
        assert (tmp_path / "second").is_dir()
        page.locator("[data-run='second']").get_by_role("button", name="Delete").click()
        assert serious(page) == []  # the question too
        answer(page, "Delete")
        expect(rows).to_have_count(2)
        assert not (tmp_path / "second").exists()
        page.keyboard.press("Escape")  # closes the list, and stops nothing
        expect(rows).to_have_count(0)
        assert desk.orders == []


@pytest.mark.parametrize("width", [840, 1024, 1280, 1440])
def test_titles_and_units_of_plots_are_whole_in_a_window_of_any_width(browser: Browser, width: int) -> None:
    with lone_station(browser, load_experiment("pool")) as desk:
        desk.page.set_viewport_size({"width": width, "height": 768})
        desk.page.goto(desk.url)
        desk.page.get_by_label("What plot 1 shows").select_option("disturbance")  # the longest
        expect(desk.page.locator(".plot .unit").first).to_have_text("mm/s², mrad/s²")
        for caption in desk.page.locator(".plot figcaption").all():
            assert caption.evaluate("all => [...all.children].every(one => one.scrollWidth <= one.clientWidth + 1)")
        edges = (
            "all => all.map(one => [one.getBoundingClientRect().right, one.closest('.canvas').getBoundingClientRect().right])"
        )
        for curve, plot in desk.page.locator(".plot .u-series").evaluate_all(edges):
            assert curve <= plot


def test_any_field_is_plotted_and_a_layout_is_an_address(browser: Browser) -> None:
    with lone_station(browser, load_experiment("pool")) as desk:
        page = desk.page
        page.goto(f"{desk.url}?plots=battery,state.estimate.nu.0&robot=2")
        expect(page.get_by_label("What plot 1 shows")).to_have_value("battery")
        expect(page.get_by_label("What plot 2 shows")).to_have_value("state.estimate.nu.0")
        expect(tile(page, 2)).to_have_class(re.compile("chosen"))
        for _ in range(8):
            state = RobotState(
                mode=Mode.TRACKING,
                guidance=Guidance.GIVING_WAY,
                estimate=Estimate(nu=np.array([0.25, 0.0, 0.0, 0.0]), drag_ratio=1.32, thrust_ratio=0.75),
                board=BoardReading(loss=0.5),
            )
            desk.robots.publish(topics.STATE, state, time.time_ns(), 1)
            page.wait_for_timeout(120)
        expect(tile(page, 1)).to_contain_text("× 1.32, 0.75")
        expect(tile(page, 1)).to_contain_text("tracking, giving way")
        held = RobotState(
            mode=Mode.HOLDING,
            estimate=Estimate(eta=np.array([1.0, 0.0, 0.3, 0.0])),
            control=Control(eta_reference=np.array([0.97, 0.04, 0.3, 0.0])),
        )
        desk.robots.publish(topics.STATE, held, time.time_ns(), 2)
        expect(tile(page, 2)).to_contain_text("from its place50 mm")
        figures = page.locator(".plot")
        expect(figures.nth(1).locator(".u-legend")).to_contain_text("0.25")
        page.get_by_label("What plot 3 shows").select_option("state.board.loss")  # of before it was asked for, too
        expect(figures.nth(2).locator(".u-legend")).to_contain_text("0.50")
        with page.expect_download() as download:
            page.get_by_label(re.compile("Save plot 3")).select_option("svg-1")
        texts = [node.text or "" for node in ElementTree.parse(download.value.path()).iter("{http://www.w3.org/2000/svg}text")]
        assert any(text.startswith("time ") and text.endswith("[s]") for text in texts) and "robot 1" in texts
        with page.expect_download() as download:
            page.get_by_label(re.compile("Save plot 3")).select_option("csv")
        rows = list(csv.reader(download.value.path().read_text(encoding="utf-8").splitlines()))
        assert any(row[1] == "0.5" for row in rows) and len({len(row) for row in rows}) == 1
        with page.expect_download() as download:
            page.get_by_label(re.compile("Save plot 3")).select_option("pdf-2")
        assert pdfium.PdfDocument(download.value.path().read_bytes())[0].get_width() == 520
        assert download.value.suggested_filename.endswith("-2col.pdf")
        page.get_by_label("Layouts of the plots").select_option("+")
        page.get_by_label("Name of this layout").locator("input").fill("mine")
        answer(page, "Save")
        page.goto(f"{desk.url}?plots=tracking")
        page.get_by_label("Layouts of the plots").select_option("=mine")
        expect(page.get_by_label("What plot 3 shows")).to_have_value("state.board.loss")
        desk.robots.publish(topics.STATE, RobotState(board=BoardReading(loss=0.25), timing=FRESH), time.time_ns(), 1)
        expect(tile(page, 1)).to_contain_text("25 %")
        expect(tile(page, 1)).not_to_contain_text("thrust")  # it learns nothing


def saved_times(page: Page) -> list[float]:
    """Times of the rows that plot 1 shows."""
    with page.expect_download() as download:
        page.get_by_label(re.compile("Save plot 1")).select_option("csv")
    rows = csv.reader(download.value.path().read_text(encoding="utf-8").splitlines())
    return [float(row[0]) for row in list(rows)[1:]]


def test_plots_show_the_flight_and_by_a_double_click_also_what_was_before_and_after(browser: Browser) -> None:
    with lone_station(browser, load_experiment("pool")) as desk:
        page = desk.page
        page.goto(desk.url)
        for mode in (Mode.DISARMED, Mode.TRACKING, Mode.DISARMED):
            if mode is Mode.TRACKING:
                desk.own_status = replace(desk.own_status, began_ns=desk.clock.now_ns())
            for _ in range(20):
                desk.robots.publish(topics.STATE, RobotState(mode=mode), time.time_ns(), 1)
                page.wait_for_timeout(100)
        flight = saved_times(page)
        assert flight[0] >= 0.0 and flight[-1] > 1.0
        plot = page.locator(".plot .u-over").first
        plot.dblclick()
        everything = saved_times(page)
        assert everything[0] < -1.0 and everything[-1] > flight[-1] + 1.0
        plot.dblclick()
        assert saved_times(page) == flight


def test_paper_gets_what_is_known_and_no_buttons(browser: Browser) -> None:
    with lone_station(browser, load_experiment("pool")) as desk:
        page = desk.page
        page.goto(desk.url)
        button(page, "Dark").or_(button(page, "Light")).click()
        if page.evaluate("document.documentElement.dataset.theme") == "light":
            button(page, "Dark").click()
        tile(page, 1).get_by_role("button").click()
        tile(page, 2).get_by_role("button").click(modifiers=["Shift"])
        page.emulate_media(media="print")
        page.evaluate("dispatchEvent(new Event('beforeprint'))")
        assert not re.search("(?i)click|press|hold a key", page.locator("body").inner_text())
        for shown in (".mission-state", ".pool canvas", ".alarms", ".plot >> nth=3"):
            expect(page.locator(shown)).to_be_visible()
        assert page.locator("button:visible").count() == page.locator(".tile button").count()
        assert page.evaluate("getComputedStyle(document.body).color") == "rgb(16, 36, 46)"  # ink, on white
        assert page.evaluate("getComputedStyle(document.body).backgroundColor") == "rgb(255, 255, 255)"
        assert page.evaluate("document.documentElement.scrollWidth <= innerWidth")
        page.set_viewport_size({"width": 680, "height": 950})  # of A4, where the screen's rules for phones would hold
        assert len({page.locator(".plot").nth(k).evaluate("(plot) => plot.offsetLeft") for k in range(4)}) == 2
        page.emulate_media(media="screen")
        page.evaluate("dispatchEvent(new Event('afterprint'))")
        expect(button(page, "Light")).to_be_visible()


def test_a_curve_ends_where_its_robot_or_the_localizer_falls_silent(browser: Browser) -> None:
    """And goes on with the others: a line that goes on would look like a robot that tracks."""
    off, here = np.array([0.1, 0.0, 0.0, 0.0]), np.zeros(4)
    with lone_station(browser, load_experiment("pool")) as desk:
        page = desk.page
        page.goto(f"{desk.url}?plots=tracking,formation,disturbance,latency&robot=1")
        expect(tile(page, 1)).to_be_visible()

        def say(robot: int) -> None:
            state = RobotState(
                mode=Mode.TRACKING,
                estimate=Estimate(eta=off, disturbance=off),
                control=Control(eta_reference=here),
                timing=StepTiming(exposure_to_pwm_ms=40.0),
            )
            desk.robots.publish(topics.STATE, state, time.time_ns(), robot)

        def read(plot: int, curve: str) -> str:
            row = page.locator(".plot").nth(plot).locator(".u-series").filter(has_text=curve)
            return row.locator(".u-value").inner_text()

        def publish_until(*robots: int, until: Callable[[], bool]) -> None:
            deadline = time.monotonic() + PATIENCE_MS * 1e-3
            while not until():
                assert time.monotonic() < deadline
                for robot in robots:
                    say(robot)
                if 1 in robots:
                    desk.robots.publish(topics.LOCALIZER, LocalizerStatus(CameraHealth.OK, frame_age_ms=30.0), time.time_ns())
                page.wait_for_timeout(100)

        values = (0, "robot 1"), (1, "1-2"), (2, "surge"), (3, "→ pose")
        publish_until(1, 2, until=lambda: [read(*value) for value in values] == ["100", "0.00", "100", "30"])
        publish_until(2, until=lambda: [read(*value) for value in values] == ["-"] * 4)
        assert read(0, "robot 2") == "100"


@pytest.mark.parametrize("mode", [Mode.DISARMED, Mode.HOLDING, Mode.TRACKING])
def test_a_robot_that_does_not_know_where_it_is_shows_no_numbers(browser: Browser, mode: Mode) -> None:
    """Its board is silent, and its estimate gone: zeros would look measured, and the trail would lead to the pool's middle."""
    with lone_station(browser, load_experiment("pool")) as desk:
        page = desk.page
        page.goto(f"{desk.url}?plots=tracking")

        def shown() -> dict[str, str]:
            facts = tile(page, 1).locator("dl > div").all_inner_texts()
            return dict(fact.split("\n", 1) for fact in facts)

        def shown_for(estimate: Estimate | None) -> dict[str, str]:
            for _ in range(15):
                state = RobotState(mode=mode, estimate=estimate, control=Control(eta_reference=np.full(4, 0.5)), timing=FRESH)
                desk.robots.publish(topics.STATE, state, time.time_ns(), 1)
                page.wait_for_timeout(100)
            facts = shown()
            return {
                name: facts[name].strip() for name in facts if name in ("error", "from its place", "depth", "yaw", "speed")
            }

        facts = shown_for(Estimate(eta=np.array([0.4, 0.2, 0.3, 1.0]), nu=np.array([0.1, 0.0, 0.0, 0.0])))
        assert (facts["depth"], facts["yaw"], facts["speed"]) == ("0.30 m", "57°", "0.100 m/s")
        assert set(shown_for(None).values()) == {"-"}
        plotted = page.locator(".plot").first.locator(".u-series").filter(has_text="robot 1").locator(".u-value")
        assert plotted.inner_text() == "-"


def test_on_a_phone_the_map_is_second_and_everything_is_large_enough(browser: Browser, tmp_path: Path) -> None:
    (tmp_path / "now").mkdir()
    (tmp_path / "now" / "run.mcap").touch()
    with lone_station(browser, load_experiment("pool"), tmp_path / "now") as desk:
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
