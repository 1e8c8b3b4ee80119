"""Requests from the page: buttons, keys, places on the map and gamepads."""

import re
import time
from dataclasses import replace

import numpy as np
import pytest
from playwright.sync_api import Browser, Page, expect

from groundstation.mission.state_machine import MissionState
from groundstation.telemetry import Finding, RobotView
from shoal.config.experiment import load_experiment
from shoal.messages import topics
from shoal.messages.messages import (
    CommandKind,
    Mode,
    Outcome,
    Progress,
    RobotState,
)
from tests.groundstation.fake_station import FakeStation
from tests.page.elements import button, tile
from tests.page.flights import PATIENCE_MS
from tests.page.lone_station import LoneStation, lone_station

pytestmark = [pytest.mark.timeout(600), pytest.mark.real_time]  # what waits for a browser waits for a loaded machine

PADS = """
  window.pads = [null];
  navigator.getGamepads = () => window.pads;
  window.pad = (mapping, axes) => {
    window.pads = [null, {index: 1, id: mapping || 'some pad', connected: true, mapping, axes, buttons: []}];
  };
"""


def test_escape_leaves_what_is_open_and_else_stops_and_shift_space_always_stops(browser: Browser) -> None:
    with lone_station(browser, load_experiment("pool")) as desk:
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
        assert desk.orders == [CommandKind.STOP]
        page.get_by_label("Remark for the log").focus()
        page.keyboard.press("Shift+Space")
        expect(page.locator(".given li")).to_have_count(2)
        assert desk.orders == [CommandKind.STOP, CommandKind.STOP]
        button(page, "Fit").focus()
        page.get_by_role("button", name="Follow").focus()
        page.keyboard.press("Shift+Space")
        expect(page.locator(".given li")).to_have_count(3)
        expect(page.get_by_role("button", name="Follow")).to_have_attribute("aria-pressed", "false")  # not pressed by it


def test_places_clicked_on_the_map_are_where_the_formation_is_led(browser: Browser) -> None:
    with lone_station(browser, load_experiment("pool")) as desk:
        desk.own_status = replace(desk.own_status, state=MissionState.RUNNING)
        page = desk.page
        page.goto(desk.url)
        button(page, "Go to…").click()
        expect(button(page, "Fly there")).to_be_disabled()
        chart = page.locator(".pool > canvas")
        box = chart.bounding_box()
        assert box is not None
        places = []
        for x, y in ((0.5, 0.4), (0.6, 0.55)):
            chart.click(position={"x": x * box["width"], "y": y * box["height"]})
            under = re.fullmatch(r"x (\S+)\s+y (\S+) m", page.locator(".cursor").inner_text())
            assert under is not None
            places.append((float(under[1]), float(under[2])))
        button(page, "Fly there").click()
        expect(page.locator(".given")).to_contain_text("go sent")
        assert desk.orders == [CommandKind.GO]
        np.testing.assert_allclose(desk.via, places, atol=0.011)  # both are shown to the centimetre
        assert abs(places[0][0] - places[1][0]) > 0.05
        button(page, "Go to…").click()
        page.keyboard.press("Escape")  # leaves the choice, and stops nothing
        expect(button(page, "Go to…")).to_be_visible()
        assert desk.orders == [CommandKind.GO]


def test_a_request_has_one_line_and_that_says_how_it_ended(browser: Browser) -> None:
    with lone_station(browser, load_experiment("pool")) as desk:
        page, given = desk.page, desk.page.locator(".given li")
        page.goto(desk.url)
        button(page, "Return to start").click()
        expect(given).to_have_text("return sent")
        outcome = Outcome(1, CommandKind.RETURN, Progress.UNDER_WAY, "", "HALTING", (1,), (2,), ("is holding",))
        desk.own_status = replace(desk.own_status, requests=(outcome,))
        expect(given).to_have_text("return under way ✓ 1 … 2 is holding")
        failed = replace(outcome, progress=Progress.FAILED, reason="holding: no way from here", why=("refuses",))
        desk.own_status = replace(desk.own_status, requests=(failed,))
        expect(given).to_have_text("return failed: holding: no way from here ✓ 1 ✕ 2 refuses")
        desk.own_status = replace(
            desk.own_status, requests=(replace(outcome, progress=Progress.DONE, confirmed=(1, 2), waiting=()),)
        )
        expect(given).to_have_text("return confirmed by 1, 2")


def test_a_stop_of_an_earlier_station_can_be_cleared(browser: Browser) -> None:
    with lone_station(browser, load_experiment("pool")) as desk:
        desk.page.goto(desk.url)
        expect(button(desk.page, "You have control")).to_be_visible()
        expect(button(desk.page, "Clear stop")).to_have_count(0)
        desk.robots.publish(topics.STATE, RobotState(mode=Mode.STOPPED), time.time_ns(), 2)
        button(desk.page, "Clear stop").click()
        expect(desk.page.locator(".given")).to_contain_text("clear-stop sent")
        assert desk.orders == [CommandKind.CLEAR_STOP]


def test_thrusters_can_be_tested_where_preflight_waits_for_that(browser: Browser) -> None:
    with lone_station(browser, load_experiment("pool")) as desk:
        untested = Finding(1, "thrusters", "notice", "thruster test: not done", "groundstation mission test", True)
        desk.preflight = (untested,)
        desk.page.goto(desk.url)
        expect(desk.page.locator(".preflight")).to_contain_text("thruster test: not done")
        expect(button(desk.page, "Start")).to_be_disabled()
        button(desk.page, "Test thrusters").click()
        expect(desk.page.locator(".given")).to_contain_text("test sent")
        assert desk.orders == [CommandKind.TEST]


def choose_robot(desk: LoneStation, mode: Mode) -> None:
    """Open the page, and choose robot 2, which is in a mode."""
    desk.page.goto(desk.url)
    expect(button(desk.page, "You have control")).to_be_visible()
    desk.robots.publish(topics.STATE, RobotState(mode=mode), time.time_ns(), 2)
    tile(desk.page, 2).get_by_role("button").click()


def test_one_robot_is_driven_by_keys_and_sent_to_a_place(browser: Browser) -> None:
    with lone_station(browser, load_experiment("pool")) as desk:
        page = desk.page
        choose_robot(desk, Mode.HOLDING)
        panel = page.get_by_label("Robot 2 alone")
        expect(button(page, "Arm 2")).to_be_disabled()  # it is
        button(page, "Hold 2").click()
        expect(page.locator(".given")).to_contain_text("hold 2 sent")
        assert (desk.orders, desk.only) == ([CommandKind.HOLD], 2)

        page.keyboard.press("w")  # nobody has asked for keys to drive
        button(page, "Drive 2").click()
        page.keyboard.down("w")
        page.keyboard.down("d")
        page.wait_for_timeout(500)
        page.keyboard.up("w")
        page.keyboard.up("d")
        page.wait_for_timeout(300)
        count = len(desk.drives)
        (robot, ahead), (_, last) = desk.drives[-3], desk.drives[-1]
        assert count >= 4  # ten a second
        assert robot == 2
        assert max(velocity.surge_mps for _, velocity in desk.drives) == pytest.approx(0.4 * 0.48)
        assert ahead.yaw_rate_radps > 0.0  # to the right, as seen from above
        assert (last.surge_mps, last.heave_mps, last.yaw_rate_radps) == (0.0, 0.0, 0.0)
        page.wait_for_timeout(300)
        assert len(desk.drives) == count  # nothing is held: nothing is said
        page.keyboard.press("Shift+Space")
        expect(page.locator(".given")).to_contain_text("stop sent")

        button(page, "Send 2 to…").click()
        page.locator(".pool > canvas").click(position={"x": 300, "y": 200})
        panel.get_by_role("button", name=re.compile("^Send robot 2 to .* m$")).click()
        expect(page.locator(".given")).to_contain_text("go 2 sent")
        assert (desk.orders[-1], desk.only, len(desk.via)) == (CommandKind.GO, 2, 1)


def test_a_second_click_does_not_put_a_robot_back_into_the_water(browser: Browser) -> None:
    """Somebody holds the robot in his hands: a press that comes twice must not let the next start arm it."""
    with lone_station(browser, load_experiment("pool")) as desk:
        page = desk.page
        choose_robot(desk, Mode.DISARMED)
        expect(button(page, "2 is back in")).to_be_disabled()
        button(page, "2 is out of the water").click()  # at its place once that is steady
        expect(page.locator(".given")).to_contain_text("out 2 sent")
        box = button(page, "2 is out of the water").bounding_box()
        assert box is not None
        view = RobotView(RobotState(mode=Mode.DISARMED), 0.0, out=True)
        desk.own_status = replace(desk.own_status, views={2: view})
        expect(button(page, "2 is back in")).to_be_enabled()
        page.mouse.click(box["x"] + 9.0, box["y"] + 9.0)
        page.wait_for_timeout(500)
        assert desk.orders == [CommandKind.OUT]
        if not button(page, "Arm 2").is_visible():  # the line about it among the alarms has moved its tile under the pointer
            page.keyboard.press("2")
        expect(button(page, "Arm 2")).to_be_disabled()
        button(page, "2 is back in").click()
        expect(page.locator(".given")).to_contain_text("back-in 2 sent")
        assert desk.orders == [CommandKind.OUT, CommandKind.BACK_IN]


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
    with lone_station(browser, load_experiment("pool")) as desk:
        page = desk.page
        page.add_init_script(PADS)
        choose_robot(desk, Mode.HOLDING)
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
