"""Hands on the page: no stuck key, Caps Lock, lost pointer or open question acts for a person, and what nobody holds ends."""

import math
import re
import time
from collections.abc import Iterator
from dataclasses import replace

import pytest
from playwright.sync_api import Browser, Page, WebSocketRoute, expect

from groundstation.mission.state_machine import MissionState
from groundstation.telemetry import RobotView
from groundstation.web.backend import Status
from shoal.config.experiment import load_experiment
from shoal.messages import topics
from shoal.messages.messages import CommandKind, Mode, RobotState
from tests.page.elements import answer, button, tile
from tests.page.lone_station import LoneStation, lone_station
from tests.waiting import eventually

pytestmark = [pytest.mark.timeout(600), pytest.mark.real_time]  # what waits for a browser waits for a loaded machine


@pytest.fixture
def desk(browser: Browser) -> Iterator[LoneStation]:
    """A page in control, and two robots that hold."""
    with lone_station(browser, load_experiment("pool")) as lone:
        lone.page.goto(lone.url)
        expect(button(lone.page, "You have control")).to_be_visible()
        for robot in (1, 2):
            lone.robots.publish(topics.STATE, RobotState(mode=Mode.HOLDING), time.time_ns(), robot)
        expect(tile(lone.page, 2)).to_have_attribute("data-mode", "HOLDING")
        yield lone


def drive(desk: LoneStation, robot: int) -> None:
    tile(desk.page, robot).get_by_role("button").click()
    button(desk.page, f"Drive {robot}").click()
    expect(button(desk.page, "Drive ahead")).to_be_visible()


def press(page: Page, kind: str, code: str, key: str, **more: bool) -> None:
    """A key event with any place and meaning, as keyboards of other countries make it."""
    page.evaluate(
        "([kind, given]) => document.body.dispatchEvent(new KeyboardEvent(kind, {bubbles: true, cancelable: true, ...given}))",
        [kind, {"code": code, "key": key, **more}],
    )


def test_the_button_to_drive_says_what_it_does_or_why_not(desk: LoneStation) -> None:
    page = desk.page
    tile(page, 1).get_by_role("button").click()
    button_1, send = button(page, "Drive 1"), button(page, "Send 1 to…")
    expect(button_1).to_have_attribute("title", re.compile("arrows"))
    button_1.click()
    expect(button_1).to_have_attribute("title", re.compile("^Leave it"))
    button_1.click()
    for mode, why in ((Mode.DISARMED, "arm it first"), (Mode.STOPPED, "not before it is cleared and armed")):
        desk.robots.publish(topics.STATE, RobotState(mode=mode), time.time_ns(), 1)
        for led in (button(page, "Drive 1"), send):
            expect(led).to_have_attribute("title", why)
    button(page, "You have control").click()
    expect(send).to_have_attribute("title", "you are watching: take control first")


def test_a_robot_is_let_go_when_another_is_chosen_under_the_pointer(desk: LoneStation) -> None:
    page = desk.page
    drive(desk, 1)
    button(page, "Drive ahead").hover()
    page.mouse.down()
    assert eventually(lambda: bool(desk.drives and desk.drives[-1][1].surge_mps > 0.0))
    page.keyboard.press("2")
    assert eventually(lambda: desk.drives[-1][1].surge_mps == 0.0)
    page.mouse.up()
    assert desk.drives[-1][0] == 1
    count = len(desk.drives)
    page.keyboard.down("w")  # robot 2 is shown, and nobody drives it
    page.wait_for_timeout(400)
    page.keyboard.up("w")
    assert len(desk.drives) == count
    tile(page, 1).get_by_role("button").click()
    expect(button(page, "Drive 1")).to_have_attribute("aria-pressed", "false")


@pytest.mark.parametrize(
    ("kind", "code", "key", "more"),
    [("keyup", "KeyE", "€", {}), ("keydown", "AltRight", "AltGraph", {"modifierAltGraph": True}),
     ("keydown", "AltRight", "AltGraph", {}),
     ("keydown", "MetaLeft", "Meta", {"metaKey": True}), ("keydown", "ControlLeft", "Control", {"ctrlKey": True})],
    ids=["up with another meaning", "AltGr", "AltGr that does not count yet", "Command", "Ctrl"],
)  # fmt: skip
def test_no_key_sticks(desk: LoneStation, kind: str, code: str, key: str, more: dict[str, bool]) -> None:
    drive(desk, 1)
    press(desk.page, "keydown", "KeyE", "e")
    desk.page.wait_for_timeout(300)
    assert desk.drives[-1][1].heave_mps > 0.0
    press(desk.page, kind, code, key, **more)
    desk.page.wait_for_timeout(200)
    assert desk.drives[-1][1].heave_mps == 0.0


@pytest.mark.parametrize("leaves", ["a field", "a hidden tab", "another window"])
def test_nothing_is_held_by_hands_that_are_elsewhere(desk: LoneStation, leaves: str) -> None:
    page = desk.page
    drive(desk, 1)
    page.keyboard.down("w")
    page.wait_for_timeout(300)
    assert desk.drives[-1][1].surge_mps > 0.0
    if leaves == "a field":
        page.get_by_label("Remark for the log").focus()
    elif leaves == "another window":
        page.evaluate("dispatchEvent(new Event('blur'))")
    else:
        page.evaluate("Object.defineProperty(document, 'hidden', {get: () => true})")
        page.evaluate("document.dispatchEvent(new Event('visibilitychange'))")
    page.wait_for_timeout(200)
    assert desk.drives[-1][1].surge_mps == 0.0
    count = len(desk.drives)
    page.wait_for_timeout(400)
    assert len(desk.drives) == count


def test_the_pace_is_set_between_two_keys(desk: LoneStation) -> None:
    """The slider keeps the focus and its arrows, and letters drive."""
    page = desk.page
    drive(desk, 1)
    page.get_by_label(re.compile("^pace")).focus()
    page.keyboard.press("ArrowRight")
    expect(page.get_by_text("pace 45 %")).to_be_visible()
    assert desk.drives == []
    page.keyboard.down("w")
    page.wait_for_timeout(300)
    page.keyboard.up("w")
    assert max(velocity.surge_mps for _, velocity in desk.drives) > 0.0


def test_caps_lock_and_repeats_order_nothing_and_shift_does(desk: LoneStation) -> None:
    page = desk.page
    desk.own_status = Status(state=MissionState.PAUSED)
    expect(button(page, "Resume")).to_be_enabled()
    for letter in "ASDRB":
        press(page, "keydown", f"Key{letter}", letter)  # Caps Lock: a capital without Shift
        press(page, "keydown", f"Key{letter}", letter, shiftKey=True, repeat=True)
    page.wait_for_timeout(300)
    assert desk.orders == []
    press(page, "keydown", "KeyR", "r", shiftKey=True)  # Caps Lock and Shift
    expect(page.locator(".given")).to_contain_text("resume sent")
    assert desk.orders == [CommandKind.RESUME]


def test_shift_space_stops_the_fleet_over_an_open_question_and_answers_nothing(desk: LoneStation) -> None:
    page = desk.page
    button(page, "End run").click()
    question = page.get_by_role("alertdialog")
    expect(question).to_contain_text("Robots are armed. Disarm all of them and end the run?")
    expect(question.get_by_role("button", name="Cancel")).to_be_focused()
    page.keyboard.press("Shift+Space")
    expect(page.locator(".given")).to_contain_text("stop sent")
    assert desk.orders == [CommandKind.STOP]
    page.get_by_role("button", name=re.compile("STOP")).last.click()  # it lies under nothing
    expect(page.locator(".given li")).to_have_count(2)
    page.keyboard.press("Escape")  # the question's, not the fleet's
    expect(question).to_have_count(0)
    assert desk.orders == [CommandKind.STOP, CommandKind.STOP]
    button(page, "End run").click()
    question.get_by_role("button", name="Disarm and end").click()
    expect(page.locator(".given")).to_contain_text("end sent")
    assert desk.orders[-1] is CommandKind.END


@pytest.mark.parametrize("name", ["pool", "fleet-20"])
def test_a_stop_is_cleared_from_wherever_the_panels_are_scrolled_to(browser: Browser, name: str) -> None:
    with lone_station(browser, load_experiment(name)) as desk:
        page = desk.page
        page.set_viewport_size({"width": 1024, "height": 700})
        page.goto(desk.url)
        desk.own_status = Status(state=MissionState.STOPPED)
        clear = page.get_by_role("button", name=re.compile("^Clear stop"))
        expect(clear).to_be_enabled()
        page.locator("aside").evaluate("panels => (panels.scrollTop = panels.scrollHeight)")
        expect(clear).to_be_in_viewport(ratio=1.0)
        expect(page.locator("summary", has_text="Keys")).to_be_in_viewport()
        clear.click()
        answer(page, "Clear")
        expect(page.locator(".given")).to_contain_text("clear-stop sent")


def test_a_robot_that_is_not_heard_is_not_called_stopped(desk: LoneStation) -> None:
    page = desk.page
    desk.own_status = Status(state=MissionState.STOPPED)
    page.keyboard.press("Shift+Space")
    for k in range(40):
        for robot in (1, 2):
            if robot == 1 or k < 15:
                desk.robots.publish(topics.STATE, RobotState(mode=Mode.STOPPED), time.time_ns(), robot)
        page.wait_for_timeout(100)
        if k == 10:
            expect(page.get_by_role("button", name="STOPPED Shift+Space")).to_be_visible()
    expect(page.get_by_role("button", name="STOPPED, 1 NOT HEARD Shift+Space")).to_be_visible()


def test_a_stop_that_nobody_hears_is_said_so_whatever_is_asked_for_after_it(browser: Browser) -> None:
    """Only the stop is lost on its way: states go on to come, and other orders are answered."""
    with lone_station(browser, load_experiment("pool")) as desk:
        page = desk.page

        def between(line: WebSocketRoute) -> None:
            station = line.connect_to_server()
            line.on_message(lambda message: None if '"stop"' in str(message) else station.send(message))

        page.route_web_socket("**/live", between)
        page.goto(desk.url)
        expect(button(page, "You have control")).to_be_visible()
        page.keyboard.press("Shift+Space")
        expect(page.get_by_role("button", name="STOP NOT HEARD")).to_be_visible()
        for _ in range(10):
            page.keyboard.press("Shift+A")
        while len(desk.orders) < 10:
            page.wait_for_timeout(50)
        page.wait_for_timeout(500)
        expect(page.get_by_role("button", name="STOP NOT HEARD")).to_be_visible()
        expect(page.get_by_role("alert").filter(has_text="Emergency stop not heard")).to_be_visible()


def test_a_robot_that_is_out_of_the_water_keeps_nobody_waiting(desk: LoneStation) -> None:
    page = desk.page
    expect(page.get_by_text("Preflight: 0 of 2 ready")).to_be_visible()
    desk.own_status = replace(desk.own_status, views={2: RobotView(None, math.inf, out=True)})
    expect(page.get_by_text("Preflight: 0 of 1 ready")).to_be_visible()
    expect(page.locator(".preflight")).not_to_contain_text("2")
    desk.own_status = replace(desk.own_status, state=MissionState.STOPPED)
    expect(page.get_by_role("button", name="Clear stop (1 not confirmed)")).to_be_visible()
    expect(page.get_by_role("alert")).not_to_contain_text("robot 2")


def test_an_alarm_that_cannot_sound_yet_says_so(desk: LoneStation) -> None:
    page = desk.page
    expect(button(page, "Click for sound")).to_be_visible()
    button(page, "Click for sound").click()
    expect(button(page, "Sound on")).to_be_visible()


def test_a_draft_is_not_called_good_by_an_answer_to_another_one(desk: LoneStation) -> None:
    page = desk.page
    button(page, "Edit").click()
    expect(page.get_by_text("can be flown")).to_be_visible()
    desk.server.close()
    expect(page.get_by_text("no connection: the planner cannot be asked")).to_be_visible()
    expect(page.get_by_text("can be flown")).to_have_count(0)


def test_a_stop_is_given_by_the_press_wherever_the_pointer_comes_up(desk: LoneStation) -> None:
    """A hand that slips, and a finger that the browser takes for a scroll, have pressed."""
    page = desk.page
    page.get_by_role("button", name="EMERGENCY STOP").hover()
    page.mouse.down()
    page.mouse.move(300, 400)
    page.mouse.up()
    expect(page.locator(".given")).to_contain_text("stop sent")
    assert desk.orders == [CommandKind.STOP]


@pytest.mark.parametrize("how", ["pointer", "key", "assistive technology"])
def test_a_press_of_the_stop_button_is_one_stop(desk: LoneStation, how: str) -> None:
    page = desk.page
    stop = page.get_by_role("button", name="EMERGENCY STOP")
    if how == "pointer":
        stop.click()
    elif how == "key":
        stop.press("Enter")
    else:
        stop.evaluate("button => button.click()")
    expect(page.locator(".given")).to_contain_text("stop sent")
    page.wait_for_timeout(300)
    assert desk.orders == [CommandKind.STOP]


def test_space_that_comes_up_after_shift_presses_no_button(desk: LoneStation) -> None:
    """Some browsers press the focused button when Space comes up, whatever became of its going down."""
    page = desk.page
    page.evaluate("window.kept = []; addEventListener('keyup', (e) => e.key === ' ' && kept.push(e.defaultPrevented))")
    page.keyboard.down("Shift")
    page.keyboard.down("Space")
    page.keyboard.up("Shift")
    page.keyboard.up("Space")
    page.keyboard.press("Space")
    expect(page.locator(".given")).to_contain_text("stop sent")
    assert page.evaluate("kept") == [True, False]


@pytest.mark.parametrize("whose", ["of one robot", "of the formation"])
def test_places_that_nobody_sees_take_no_escape(desk: LoneStation, whose: str) -> None:
    """Escape leaves the choice of places while one is shown; else it stops the fleet."""
    page = desk.page
    desk.own_status = Status(state=MissionState.RUNNING)
    tile(page, 1).get_by_role("button").click()
    choose = "Send 1 to…" if whose == "of one robot" else "Go to…"
    button(page, choose).click()
    expect(page.get_by_label("Place: x and y in m")).to_be_visible()
    page.keyboard.press("Escape")
    expect(page.get_by_label("Place: x and y in m")).to_have_count(0)
    assert desk.orders == []
    button(page, choose).click()
    expect(page.get_by_label("Place: x and y in m")).to_be_visible()
    if whose == "of one robot":
        page.keyboard.press("2")
        expect(button(page, "Send 2 to…")).to_be_visible()
    else:
        button(page, "Edit").click()
        expect(page.get_by_label("Editor of the next run")).to_be_visible()
    page.keyboard.press("Escape")
    page.wait_for_timeout(500)
    assert desk.orders == [CommandKind.STOP]


def test_alarms_sound_again_after_the_browser_has_taken_the_sound_away(desk: LoneStation) -> None:
    """Some do so when the computer sleeps, or another program wants the loudspeaker."""
    page = desk.page
    page.add_init_script(
        "window.AudioContext = class extends AudioContext { constructor(...given) { super(...given); window.sound = this; } };"
    )
    page.reload()
    button(page, "Click for sound").click()
    expect(button(page, "Sound on")).to_be_visible()
    page.evaluate("sound.suspend()")
    expect(button(page, "Click for sound")).to_be_visible()
    button(page, "Click for sound").click()
    expect(button(page, "Sound on")).to_be_visible()


def test_the_clock_is_the_formations_and_not_that_of_a_robot_that_flies_alone(desk: LoneStation) -> None:
    page = desk.page
    state = RobotState(mode=Mode.TRACKING, trajectory_id="alone-x", trajectory_s=185.0)
    desk.robots.publish(topics.STATE, state, time.time_ns(), 2)
    began_ns = desk.clock.now_ns() - 65 * 10**9
    desk.own_status = replace(desk.own_status, state=MissionState.RUNNING, began_ns=began_ns, left_s=61.0)
    expect(tile(page, 2)).to_have_attribute("data-mode", "TRACKING")
    expect(page.locator("header .clock")).to_have_text(re.compile(r"^1:0\d / "))
