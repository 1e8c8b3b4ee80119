"""Another form forms for on the page, places that are typed, several robots, one clock, and what stays in its place."""

import re
import threading
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from playwright.sync_api import Browser, expect

from groundstation.mission.state_machine import MissionState
from groundstation.planning.feasibility import PlanError
from groundstation.planning.segment import PlanSegment, first_segment
from groundstation.web.backend import Status
from shoal.config.experiment import Experiment, load_experiment, with_flight
from shoal.messages import topics
from shoal.messages.messages import CommandKind, Event, Mode, RobotState
from shoal.runtime.runtime import Clock
from tests.page.elements import button, tile
from tests.page.lone_station import LoneStation, lone_station

pytestmark = pytest.mark.real_time

MAP = "document.querySelector('.pool canvas').toDataURL()"


@pytest.fixture(scope="module")
def experiment() -> Experiment:
    return load_experiment("numeric", ["localizer.uses_camera=false"])


@pytest.fixture
def desk(browser: Browser, experiment: Experiment) -> Iterator[LoneStation]:
    with lone_station(browser, experiment) as lone:
        lone.own_status = Status(state=MissionState.RUNNING)
        lone.page.goto(lone.url)
        expect(button(lone.page, "You have control")).to_be_visible()
        yield lone


def test_a_form_is_planned_as_it_is_typed_and_flown_by_one_click(desk: LoneStation, experiment: Experiment) -> None:
    forms, goes_on = list[str](), threading.Event()

    def plan(order: CommandKind, text: str) -> PlanSegment:
        forms.append(text)
        if text.startswith("column"):
            raise PlanError("robot 3: 0.260 m beyond the wall's clearance in y")
        if text == "line 1.2":
            goes_on.wait(20.0)
        return first_segment(experiment)

    desk.draft = plan  # type: ignore[method-assign]
    page = desk.page
    button(page, "Formation…").click()
    map_before = page.evaluate(MAP)
    page.get_by_label("Shape of the formation").select_option("column")
    expect(page.get_by_text("beyond the wall's clearance")).to_be_visible()
    expect(button(page, "Fly this form")).to_be_disabled()
    page.get_by_label("Shape of the formation").select_option("line")
    page.get_by_label("spacing, m").fill("1.1")
    expect(page.get_by_text(re.compile("can be flown"))).to_be_visible()
    assert forms[-1] == "line 1.1" and desk.orders == []
    page.wait_for_function(f"(before) => {MAP} !== before", arg=map_before)  # the plan is drawn
    page.get_by_label("spacing, m").fill("1.2")  # what was said of another form is no answer to this one
    expect(page.get_by_text("asking the planner")).to_be_visible()
    expect(button(page, "Fly this form")).to_be_disabled()
    page.get_by_label("spacing, m").fill("1.1")
    expect(page.get_by_text(re.compile("can be flown"))).to_be_visible()
    goes_on.set()  # the answer about 1.2 comes last
    page.wait_for_timeout(500)
    button(page, "Fly this form").click()
    expect(page.locator(".given")).to_contain_text("formation line 1.1 sent")
    assert desk.orders == [CommandKind.FORMATION] and desk.text == "line 1.1"


def test_the_spacing_that_is_offered_can_be_flown_unless_none_can(desk: LoneStation, experiment: Experiment) -> None:
    """Robots come nearer on their ways into another shape. What a person types stays as it is."""
    least_m = 1.0

    def plan(order: CommandKind, text: str) -> PlanSegment:
        if text.startswith("turn") or float(text.split()[1]) < least_m:
            raise PlanError("robots 1 and 2: 0.598 m apart")
        return first_segment(experiment)

    desk.draft = plan  # type: ignore[method-assign]
    page = desk.page
    spacing = page.get_by_label("spacing, m")
    button(page, "Formation…").click()
    page.get_by_label("Shape of the formation").select_option("column")
    expect(page.get_by_text("can be flown")).to_be_visible()
    expect(spacing).to_have_value("1.00")
    spacing.fill("0.95")
    expect(page.get_by_text("0.598 m apart")).to_be_visible()
    expect(spacing).to_have_value("0.95")
    least_m = 9.0
    page.get_by_label("Shape of the formation").select_option("line")
    expect(page.get_by_text("0.598 m apart")).to_be_visible()
    expect(spacing).to_have_value(f"{experiment.formation.spacing_m:.2f}")
    page.get_by_label("Shape of the formation").select_option("")  # nothing to try
    page.get_by_label("turn, degrees").fill("30")
    expect(page.get_by_text("0.598 m apart")).to_be_visible()


def test_a_request_that_the_station_would_refuse_is_not_offered_and_says_why(desk: LoneStation) -> None:
    page, why = desk.page, "the path is a circle: it cannot be left for other places under way"
    expect(button(page, "Go to…")).to_be_enabled()
    desk.own_status = Status(state=MissionState.RUNNING, refused={CommandKind.GO: why, CommandKind.REJOIN: "no robot is out"})
    for name, reason in (("Go to…", why), ("Rejoin", "no robot is out")):
        expect(button(page, name)).to_be_disabled()
        expect(button(page, name)).to_have_attribute("title", reason)
    expect(button(page, "Formation…")).to_be_enabled()


def test_a_hold_makes_the_plan_another_one(desk: LoneStation, experiment: Experiment) -> None:
    def plan(order: CommandKind, text: str) -> PlanSegment:
        if desk.own_status.state is MissionState.PAUSED:
            raise PlanError("no way into place")
        return first_segment(experiment)

    desk.draft = plan  # type: ignore[method-assign]
    page = desk.page
    button(page, "Formation…").click()
    page.get_by_label("Shape of the formation").select_option("line")
    expect(page.get_by_text("can be flown")).to_be_visible()
    desk.own_status = Status(state=MissionState.PAUSED)
    expect(page.get_by_text("no way into place")).to_be_visible()
    expect(button(page, "Fly this form")).to_be_disabled()


def test_another_experiments_path_is_drawn_and_asked_for_by_name_or_as_a_file(
    desk: LoneStation, experiment: Experiment, tmp_path: Path
) -> None:
    page, drafts = desk.page, list[tuple[CommandKind, str]]()

    def plan(order: CommandKind, text: str) -> PlanSegment:
        drafts.append((order, text))
        return first_segment(with_flight(experiment, text))

    desk.draft = plan  # type: ignore[method-assign]
    expect(button(page, "Path…")).to_be_disabled()  # under way
    desk.own_status = Status(state=MissionState.PAUSED, flown="numeric")
    button(page, "Path…").click()
    page.get_by_label("Experiment whose path is flown").select_option("numeric-disturbed")
    expect(page.get_by_text("can be flown")).to_be_visible()
    expect(page.get_by_label("Figures of the plan")).to_contain_text("thrust")
    button(page, "Fly this path").click()
    expect(page.locator(".given")).to_contain_text("path numeric-disturbed sent")
    assert desk.orders == [CommandKind.PATH] and with_flight(experiment, desk.text).name == "numeric-disturbed"
    mine = tmp_path / "mine.toml"
    mine.write_text('name = "mine"\n[path]\nkind = "circle"\ndiameter_m = 0.5\nlap_s = 60.0\ndepth_m = 0.3\n')
    button(page, "Path…").click()
    page.get_by_label("File of an experiment").set_input_files(mine)
    expect(page.get_by_text("can be flown")).to_be_visible()
    button(page, "Fly this path").click()
    expect(page.locator(".given")).to_contain_text("path mine.toml sent")
    assert (CommandKind.PATH, mine.read_text()) in drafts and desk.text == mine.read_text()  # drafts of two questions overtake


def test_robots_are_given_their_places_and_each_has_one(desk: LoneStation, experiment: Experiment) -> None:
    page, ids = desk.page, [str(robot) for robot in experiment.robot_ids]
    desk.own_status = Status(state=MissionState.WAITING)
    button(page, "Formation…").click()
    page.get_by_label("Who takes which place").select_option("own")
    page.get_by_label("Robot at place 1").select_option(ids[1])
    expect(page.get_by_label("Robot at place 2")).to_have_value(ids[0])
    desk.draft = lambda order, text: first_segment(experiment)  # type: ignore[method-assign]
    page.get_by_label("turn, degrees").fill("10")
    button(page, "Take this form").click()
    expect(page.locator(".given")).to_contain_text("sent")
    assert desk.text == f"turn 10 order {','.join([ids[1], ids[0], *ids[2:]])}"


def test_places_are_typed_where_nobody_can_click(desk: LoneStation) -> None:
    page = desk.page
    button(page, "Go to…").click()
    for text in ("1.5, -0.5", "0.25 1"):
        page.get_by_label("Place: x and y in m").fill(text)
        page.keyboard.press("Enter")
    expect(page.get_by_text("1.5, -0.5 m → 0.25, 1 m")).to_be_visible()
    page.get_by_label("Place: x and y in m").fill("1.5,")
    expect(button(page, "Add place")).to_be_disabled()
    page.get_by_label("Place: x and y in m").fill("5000, 0")
    expect(button(page, "Add place")).to_be_disabled()
    expect(page.get_by_text("(5000, 0) m is outside the pool")).to_be_visible()
    page.keyboard.press("Enter")
    button(page, "Fly there").click()
    expect(page.locator(".given")).to_contain_text("go sent")
    expect(page.get_by_text("1.5, -0.5 m → 0.25, 1 m")).to_have_count(0)
    assert desk.orders == [CommandKind.GO] and list(desk.via) == [(1.5, -0.5), (0.25, 1.0)]


def test_places_that_the_station_refuses_can_be_put_right(desk: LoneStation) -> None:
    page = desk.page
    desk.request = lambda *_: ("no way leads to (1.5, -0.5) m", 0)  # type: ignore[method-assign]
    button(page, "Go to…").click()
    for text in ("1.5, -0.5", "0.25 1"):
        page.get_by_label("Place: x and y in m").fill(text)
        page.keyboard.press("Enter")
    button(page, "Fly there").click()
    expect(page.locator(".given")).to_contain_text("go refused: no way leads to (1.5, -0.5) m")
    expect(page.get_by_text("1.5, -0.5 m → 0.25, 1 m")).to_be_visible()
    button(page, "Cancel").click()
    expect(page.get_by_label("Place: x and y in m")).to_have_count(0)


def test_an_order_for_several_chosen_robots_is_asked_of_each(desk: LoneStation, experiment: Experiment) -> None:
    page, (one, two, *_) = desk.page, experiment.robot_ids
    for robot in experiment.robot_ids:
        desk.robots.publish(topics.STATE, RobotState(mode=Mode.TRACKING), desk.clock.now_ns(), robot)
    tile(page, one).get_by_role("button").click()
    tile(page, two).get_by_role("button").click(modifiers=["Shift"])
    panel = page.get_by_label(f"Robots {one}, {two}")
    expect(panel).to_be_visible()
    assert page.evaluate("getSelection().toString()") == "", "Shift takes a robot in, and marks no text"
    expect(panel.get_by_role("button", name="Hold 2", exact=True)).to_have_count(0)  # that is the button of robot 2 alone
    panel.get_by_role("button", name="Hold these 2").click()
    expect(page.locator(".given li")).to_have_count(2)
    assert desk.orders == [CommandKind.HOLD, CommandKind.HOLD] and sorted(desk.robots_asked) == sorted([one, two])
    for robot in experiment.robot_ids[2:]:
        tile(page, robot).get_by_role("button").click(modifiers=["Shift"])
    page.get_by_role("button", name="Disarm these").click()  # one by one the last would be refused, and fly on
    expect(page.locator(".given li")).to_have_count(3)
    assert (desk.orders[-1], desk.robots_asked[-1]) == (CommandKind.DISARM, 0)


def test_time_is_that_of_the_flight_and_negative_before_it(desk: LoneStation) -> None:
    page, clock = desk.page, desk.clock
    expect(page.locator("header .clock")).to_have_text(re.compile("^–"))
    desk.robots.publish(topics.EVENT, Event(2, "agent-1", "before the flight"), clock.now_ns())
    expect(page.get_by_text("before the flight")).to_be_visible()
    desk.own_status = replace(desk.own_status, began_ns=clock.now_ns() + 10**9)
    expect(page.locator(".log li", has_text="before the flight").locator("time")).to_have_text(re.compile(r"^-\d+(\.\d)? s$"))
    desk.own_status = replace(desk.own_status, state=MissionState.RUNNING, began_ns=_earlier(clock, 65), left_s=61.0)
    expect(page.locator("header .clock")).to_have_text(re.compile(r"^1:0\d / 2:(0[6-9]|1\d)$"))  # by the same clock
    desk.robots.publish(topics.STATE, RobotState(mode=Mode.TRACKING), clock.now_ns(), 1)
    expect(tile(page, 1)).to_contain_text("tracking")
    desk.own_status = replace(desk.own_status, state=MissionState.STOPPED)
    expect(page.locator("header .clock")).to_have_text(re.compile(r"^1:0\d$"))  # nothing goes on, and nothing comes to its end


def _earlier(clock: Clock, seconds: int) -> int:
    return clock.now_ns() - seconds * 10**9


def test_no_order_changes_its_place_when_others_become_possible(desk: LoneStation) -> None:
    names = ("Load again", "Return to start", "Rejoin", "Test thrusters", "Go to…", "Formation…", "Path…", "End run")

    def places() -> list[object]:
        return [button(desk.page, name).bounding_box() for name in names]

    running = places()
    desk.own_status = Status(state=MissionState.PAUSED)
    expect(button(desk.page, "Resume")).to_be_enabled()
    paused = places()
    assert np.all([running == paused, None not in running])


def test_no_button_moves_when_something_is_told(desk: LoneStation, experiment: Experiment) -> None:
    page, robot = desk.page, experiment.robot_ids[0]
    desk.robots.publish(topics.STATE, RobotState(mode=Mode.HOLDING), desk.clock.now_ns(), robot)
    tile(page, robot).get_by_role("button").click()
    names = ("Hold", "Disarm", "Rejoin", "End run", f"Hold {robot}", f"Disarm {robot}", f"Send {robot} to…")

    def places() -> list[object]:
        return [button(page, name).bounding_box() for name in names]

    expect(button(page, names[-1])).to_be_visible()
    before, lasting = places(), {"a": "a first alarm", "b": "a second alarm"}
    desk.own_status = Status(state=MissionState.PAUSED, reason="no way round it", lasting=lasting)
    for text in lasting.values():
        expect(page.locator(".alarms li", has_text=text)).to_be_attached()
    expect(page.get_by_text("no way round it")).to_be_visible()
    desk.own_status = Status(state=MissionState.WAITING)
    expect(page.get_by_text(re.compile("^Preflight: "))).to_be_visible()
    assert places() == before and None not in before
    desk.own_status = Status(state=MissionState.RUNNING)
    button(page, "Hold").click()
    expect(page.locator(".given li")).to_have_count(1)
    assert places() == before


def test_each_thruster_of_a_vehicle_can_be_broken(browser: Browser) -> None:
    with lone_station(browser, load_experiment("pool", ["vehicle='vectored'"])) as desk:
        desk.bus.watch_presence()
        desk.robots.announce("sim-bridge")
        desk.page.goto(desk.url)
        desk.page.get_by_text("Break something").click()
        desk.page.get_by_label("Which thruster breaks").select_option("8")
        button(desk.page, "Weaken thruster 1").click()
        expect(desk.page.locator(".given")).to_contain_text("sent")
        assert desk.text == "thruster 1/8 weak 0.5"


def test_the_simulation_is_broken_by_a_button_and_real_robots_have_none(browser: Browser, experiment: Experiment) -> None:
    with lone_station(browser, experiment) as desk:
        page = desk.page
        page.goto(desk.url)
        expect(button(page, "You have control")).to_be_visible()
        expect(page.get_by_text("Break something")).to_have_count(0)
        desk.bus.watch_presence()
        desk.robots.announce("sim-bridge")
        page.get_by_text("Break something").click()
        tile(page, experiment.robot_ids[1]).get_by_role("button").click()
        page.get_by_label("Which thruster breaks").select_option("3")
        page.get_by_label("How long it stays broken, s").fill("5")
        button(page, f"Kill thruster {experiment.robot_ids[1]}").click()
        expect(page.locator(".given")).to_contain_text("sent")
        assert desk.orders == [CommandKind.FAULT] and desk.text == f"thruster {experiment.robot_ids[1]}/3 dead for 5"
        desk.robots.publish(topics.EVENT, Event(2, "sim-bridge", "fault: camera frozen"), desk.clock.now_ns())
        expect(page.locator(".faults h2")).to_contain_text("camera frozen")
