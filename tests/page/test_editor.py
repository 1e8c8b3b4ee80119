"""The page's editor: paths are dragged, judged, played and saved."""

import re
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from playwright.sync_api import Browser, Page, expect

from shoal.config.experiment import load_experiment
from shoal.config.scene import Waypoints
from tests.page.elements import button, map_of
from tests.page.lone_station import lone_station

pytestmark = [pytest.mark.timeout(600), pytest.mark.real_time]  # what waits for a browser waits for a loaded machine


@contextmanager
def editor(browser: Browser, *settings: str) -> Iterator[Page]:
    """The editor open on a path of waypoints: the planner needs no robots for that."""
    curve = load_experiment(
        "figure-eight",
        ["path.points_m=[[-0.8,0.0],[0.0,0.3],[0.8,0.0]]", "path.laps=1", "path.start_index=0", "duration_s=15", *settings],
    )
    with lone_station(browser, curve) as desk:
        desk.page.goto(desk.url)
        button(desk.page, "Edit").click()
        expect(desk.page.locator(".verdict")).to_contain_text("can be flown")
        yield desk.page


def test_a_route_is_edited_too_and_what_cannot_be_typed_is_answered(browser: Browser) -> None:
    """A request that is none of ours ends the connection, and with it the control over robots that fly: no edit may be one."""
    with lone_station(browser, load_experiment("islands")) as desk:
        page = desk.page
        page.goto(desk.url)
        expect(button(page, "You have control")).to_be_visible()
        button(page, "Edit").click()
        expect(page.locator(".verdict")).to_contain_text("can be flown")
        expect(page.get_by_label("speed")).to_have_value("0.15")
        expect(button(page, "Add waypoints")).to_be_visible()
        page.get_by_label("duration").fill("0")
        expect(page.locator(".verdict")).to_contain_text("duration_s")
        page.get_by_label("speed").fill("")
        page.get_by_label("speed").press_sequentially("0.105", delay=50)  # key by key: "0." and "0.10" are numbers too
        expect(page.get_by_label("speed")).to_have_value("0.105")
        button(page, "Reset").click()
        expect(page.get_by_label("speed")).to_have_value("0.15")
        page.get_by_label("speed").fill("1000000")
        page.get_by_label("duration").fill("100")
        expect(page.locator(".verdict")).to_contain_text("cannot be flown")
        expect(button(page, "You have control")).to_be_visible()


def test_a_short_circle_becomes_laps_that_last(browser: Browser) -> None:
    with lone_station(browser, load_experiment("pool", ["duration_s=15", "path.lap_s=15"])) as desk:
        desk.page.goto(desk.url)
        button(desk.page, "Edit").click()
        desk.page.get_by_label("kind").select_option("waypoints")
        expect(desk.page.get_by_label("laps")).to_have_value("2")
        expect(desk.page.locator(".verdict")).to_contain_text("can be flown")


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


def test_a_waypoint_more_moves_the_begin_of_no_run(browser: Browser, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The robots' places are drawn around the waypoint at which the run begins; the file begins there too."""
    monkeypatch.chdir(tmp_path)
    with editor(browser, "path.start_index=1", "duration_s=5") as page:
        middle, scale = map_of(page, 3.5, 2.5)
        button(page, "Add waypoints").click()
        page.mouse.click(middle[0] - 0.5 * scale, middle[1] + 0.15 * scale)
        expect(button(page, "Remove waypoint 2")).to_be_enabled()
        expect(page.locator(".verdict")).to_contain_text("can be flown")
        page.get_by_label("Name of the new experiment").fill("mine")
        button(page, "Save").click()
        expect(page.get_by_text("saved: experiments/mine.toml")).to_be_visible()
    path = load_experiment(str(tmp_path / "experiments" / "mine.toml")).path
    assert isinstance(path, Waypoints) and len(path.points_m) == 4
    assert path.points_m[path.start_index] == (0.0, 0.3)


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


def test_the_editor_adds_removes_undoes_and_writes_a_commented_file(
    browser: Browser, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    with lone_station(browser, load_experiment("pool", ["pool.size_m=[6,5,1]", "camera.position_m=[0,0,-9]"])) as desk:
        page = desk.page
        page.goto(desk.url)
        button(page, "Edit").click()
        verdict = page.locator(".verdict")
        expect(verdict).to_contain_text("can be flown")
        page.locator(".editor select").first.select_option("waypoints")
        page.get_by_label("shape").select_option("column")
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


def test_a_saved_draft_that_is_changed_is_not_called_saved(
    browser: Browser, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    with editor(browser) as page:
        page.get_by_label("Name of the new experiment").fill("one")
        button(page, "Save").click()
        expect(page.get_by_text("saved: experiments/one.toml")).to_be_visible()
        page.get_by_label("speed").fill("0.09")
        expect(page.get_by_text("saved: ")).to_have_count(0)
