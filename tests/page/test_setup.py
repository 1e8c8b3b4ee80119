"""The page of `localizer setup` in a real browser: all steps on a simulated camera, a folder of pictures that is played."""

import os
import re
import signal
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path

import cv2
import numpy as np
import psutil
import pytest
from playwright.sync_api import Browser, Page, Route, expect

from localizer.detection.image_regions import Pixels
from shoal.config.experiment import load_experiment
from shoal.frames import Array
from sim_bridge.camera.optics import project
from sim_bridge.sil.ports import free_port
from tests.localizer.board_scene import CameraBench, charuco, marks
from tests.page.flights import PATIENCE_MS, PageTraffic, serious
from tests.waiting import eventually

pytestmark = pytest.mark.real_time

TRUTH = load_experiment("pool").camera.model_copy(
    update={"size_px": (640, 480), "focal_px": (500.0, 501.0), "centre_px": (318.0, 242.0), "position_m": (0.05, -0.04, -2.7)}
)
FLOOR = {"nw": (-1.2, -0.8, 1.0), "ne": (1.1, -0.8, 1.0), "se": (1.1, 0.8, 1.0), "sw": (-1.1, 0.8, 1.0)}
POINTS = FLOOR | {"rim": (0.0, -1.0, -0.1)}


@dataclass
class FolderCamera:
    """A folder that the program watches: a picture that is put there is the camera's next."""

    folder: Path
    bench: CameraBench = field(default_factory=lambda: CameraBench(TRUTH))
    shown: int = 0

    def show(self, picture: Pixels) -> None:
        self.shown += 1
        new = self.folder / f"{self.shown:04}.part"
        new.write_bytes(cv2.imencode(".png", picture)[1].tobytes())
        new.rename(new.with_suffix(".png"))

    def board_views(self, count: int) -> list[Pixels]:
        board_m = np.array([[x, y, 0.0] for x in (0.0, 0.28) for y in (0.0, 0.2)])
        texture = charuco((7, 5), 0.04, 0.03)
        poses = self.bench.poses(count, board_m, seed=2, margin_px=2.0)
        return [self.bench.picture(texture, np.zeros(2), turn, move) for turn, move in poses]

    def pool(self) -> Pixels:
        """Squares of 0.2 m whose first corner is at each point."""

        def squares(names: list[str]) -> Callable[[Array], Array]:
            def colour(points: Array) -> Array:
                shade = np.full(points.shape[:2], np.nan)
                for name in names:
                    inside = np.all((points >= POINTS[name][:2]) & (points <= np.array(POINTS[name][:2]) + 0.2), axis=2)
                    shade = np.where(inside, 230.0, shade)
                return shade

            return colour

        planes = [(1.0, squares([*FLOOR])), (1.0, marks({7: (0.0, 0.1)}, 0.3)), (-0.1, squares(["rim"]))]
        return self.bench.pool(planes)


@pytest.fixture
def camera(tmp_path: Path) -> FolderCamera:
    folder = tmp_path / "camera"
    folder.mkdir()
    return FolderCamera(folder)


@pytest.fixture
def lab(tmp_path: Path) -> Path:
    text = (Path(__file__).parents[2] / "shoal" / "config" / "experiments" / "pool.toml").read_text(encoding="utf-8")
    text = text.replace("size_px = [1280, 960]", "size_px = [640, 480]").replace("[1005.0, 1005.0]", "[480.0, 480.0]")
    path = tmp_path / "lab.toml"
    path.write_text(text.replace("[639.5, 479.5]", "[319.5, 239.5]").replace("-2.8]", "-2.5]"), encoding="utf-8")
    return path


@pytest.fixture
def program(lab: Path, camera: FolderCamera) -> Iterator[tuple[psutil.Popen, str]]:
    """The running program, and the address that it printed."""
    camera.show(camera.pool())
    command = [sys.executable, "-m", "localizer", "setup", str(lab), "--camera", f"folder:{camera.folder}"]
    alone = {**os.environ, "SHOAL_RUNTIME_DIR": str(lab.parent)}  # a stop from here reaches no other test's station
    process = psutil.Popen([*command, "--port", str(free_port())], stdout=subprocess.PIPE, text=True, env=alone)
    printed = process.stdout.readline()
    match = re.search(r"http://\S+", printed)
    assert match is not None, printed
    yield process, match[0]
    process.send_signal(signal.SIGINT)
    assert process.wait(PATIENCE_MS * 1e-3) == 0


def _open(browser: Browser, address: str, traffic: PageTraffic, width: int = 1440, height: int = 900) -> Page:
    page = browser.new_context(viewport={"width": width, "height": height}).new_page()
    page.set_default_timeout(PATIENCE_MS)
    page.on("request", lambda request: traffic.urls.append(request.url))
    page.on("pageerror", lambda error: traffic.errors.append(str(error)))
    page.goto(address)
    expect(page.get_by_text("Camera of pool")).to_be_visible()
    return page


def _at(page: Page, pixel: Array) -> tuple[float, float]:
    """The place in the window of a pixel of the camera."""
    box = page.locator(".frame svg").bounding_box()
    assert box is not None
    scale = box["width"] / TRUTH.size_px[0]
    return box["x"] + (float(pixel[0]) + 0.5) * scale, box["y"] + (float(pixel[1]) + 0.5) * scale


def _step(page: Page, name: str) -> None:
    page.get_by_role("button", name=re.compile(rf"\d {name}")).click()


def _button(page: Page, name: str) -> None:
    page.get_by_role("button", name=name, exact=True).click()


def test_a_camera_is_set_up_from_the_first_look_to_the_saved_file(
    browser: Browser, program: tuple[psutil.Popen, str], camera: FolderCamera, lab: Path, tmp_path: Path, traffic: PageTraffic
) -> None:
    _, address = program
    page = _open(browser, address, traffic)
    expect(page.get_by_text(re.compile("light is right|dim"))).to_be_visible()
    expect(page.get_by_text("this source offers no controls")).to_be_visible()
    assert page.locator(".histogram rect").count() == 64
    expect(page.locator(".frame img")).to_have_js_property("naturalWidth", TRUTH.size_px[0])
    assert serious(page) == []
    page.screenshot(path=tmp_path / "1-picture.png")

    _step(page, "Lens")
    _button(page, "Collect")
    views = page.locator(".row b")
    advice = page.get_by_role("status").filter(has_text=re.compile("as in a view before|kept view"))
    for number, picture in enumerate(camera.board_views(12)):
        for copy in range(100):  # held still, for as long as the program takes
            camera.show(picture + np.uint8(copy % 2) * np.uint8(picture < 250))
            page.wait_for_timeout(150)
            if copy > 2 and advice.is_visible():
                break
        if number == 9:
            page.screenshot(path=tmp_path / "2-lens.png")
    assert int(views.inner_text()) >= 8
    _button(page, "Find the lens")
    expect(page.get_by_text(re.compile("px in views held out"))).to_be_visible()

    _step(page, "Survey")
    camera.show(camera.pool())
    for name, place in POINTS.items():
        page.get_by_label("Name").fill(name)
        for axis, value in zip("xyz", place, strict=True):
            page.get_by_label(f"{axis}, m", exact=True).fill("")
            page.get_by_label(f"{axis}, m", exact=True).press_sequentially(f"{value}")  # as a person types
        x, y = _at(page, project(TRUTH, np.array([place]))[0])
        page.mouse.move(x - 30, y)
        page.mouse.click(x + 1.0, y - 1.0)
        expect(page.get_by_role("button", name=name, exact=True)).to_be_visible()
    expect(page.locator(".magnifier canvas")).to_be_visible()
    _button(page, "Find the pose")
    expect(page.get_by_text(re.compile("pose: 5 points, RMS 0"))).to_be_visible()
    page.get_by_label("Grid at depth").click()
    corner = page.locator("circle.corner").first
    box = corner.bounding_box()
    assert box is not None
    middle = box["x"] + box["width"] / 2, box["y"] + box["height"] / 2
    page.mouse.move(*middle)
    page.mouse.down()
    page.mouse.move(middle[0] + 18, middle[1] + 14, steps=3)
    page.mouse.up()
    expect(page.get_by_role("button", name=re.compile("corner -x -y"), exact=False).first).to_be_visible()
    _button(page, "Find the pose")
    expect(page.locator(".said")).to_contain_text(re.compile("'(surface|floor) corner .*' does not fit"))
    page.screenshot(path=tmp_path / "3-survey.png")
    page.get_by_role("button", name=re.compile("Remove .* corner")).click()
    _button(page, "Find the pose")
    expect(page.get_by_text(re.compile("pose: 5 points, RMS 0"))).to_be_visible()

    _step(page, "Masks")
    for pixel in ([560.0, 20.0], [620.0, 20.0], [620.0, 100.0], [560.0, 100.0]):
        page.mouse.click(*_at(page, np.array(pixel)))
    _button(page, "Close the polygon")
    expect(page.get_by_text("mask 1, 4 corners")).to_be_visible()
    page.screenshot(path=tmp_path / "4-masks.png")

    other = _open(browser, address, traffic, 390, 844)  # a phone
    expect(other.get_by_text("2 pages are open")).to_be_visible()
    assert other.evaluate("document.documentElement.scrollWidth") <= 390
    assert serious(other) == []
    _step(other, "Survey")
    other.screenshot(path=tmp_path / "phone.png", full_page=True)
    other.context.close()

    _step(page, "Save")
    expect(page.locator(".difference .plus").first).to_be_visible()
    page.screenshot(path=tmp_path / "5-save.png")
    assert "masks_px" not in lab.read_text(encoding="utf-8")
    page.locator("button.main").click()
    expect(page.get_by_text(re.compile("wrote .*lab.toml; the old file is"))).to_be_visible()
    camera_found = load_experiment(str(lab)).camera
    assert camera_found.focal_px == pytest.approx(TRUTH.focal_px, rel=0.01)
    assert camera_found.position_m == pytest.approx(TRUTH.position_m, abs=0.04)
    assert len(camera_found.masks_px) == 1
    assert traffic.errors == []
    assert {url.split("/")[2] for url in traffic.urls} == {address.split("/")[2]}, "the page works without any other host"
    page.context.close()


def test_a_point_whose_place_is_not_whole_is_not_taken(
    browser: Browser, program: tuple[psutil.Popen, str], traffic: PageTraffic
) -> None:
    """Not with the number that stood in the field before."""
    page = _open(browser, program[1], traffic)
    _step(page, "Survey")
    field = page.get_by_label("x, m", exact=True)
    field.fill("-1.2")
    field.fill("")
    page.mouse.click(*_at(page, np.array([300.0, 200.0])))
    expect(page.locator(".problem")).to_contain_text("point 1: the place needs x")
    expect(field).to_have_value("")
    expect(page.get_by_role("button", name="Remove point 1")).to_have_count(0)
    field.fill("0.5")
    page.mouse.click(*_at(page, np.array([300.0, 200.0])))
    expect(page.get_by_role("row", name="point 1")).to_contain_text("0.5, 0, 0")
    page.context.close()


def test_the_difference_to_be_saved_is_what_all_pages_have_made_of_it(
    browser: Browser, program: tuple[psutil.Popen, str], traffic: PageTraffic
) -> None:
    """Another page moves a corner of a mask while this one looks at the difference."""
    address, key = program[1].split("#key=")
    page = _open(browser, program[1], traffic)

    def mask(*corner: float) -> None:
        change = {"do": "mask", "id": 1, "corners_px": [list(corner), [20.0, 10.0], [10.0, 20.0]]}
        assert page.request.post(f"{address}do", data=change, headers={"x-key": key}).json()["problem"] == ""

    mask(11.5, 12.5)
    _step(page, "Save")
    difference = page.locator(".difference")
    expect(difference).to_contain_text("11.5")
    mask(33.5, 12.5)
    expect(difference).to_contain_text("33.5")
    expect(difference).not_to_contain_text("11.5")
    page.context.close()


def test_a_page_without_the_key_sees_nothing_and_a_program_that_is_gone_is_told(
    browser: Browser, program: tuple[psutil.Popen, str], traffic: PageTraffic
) -> None:
    process, address = program
    page = _open(browser, address, traffic)
    bare = browser.new_context().new_page()
    bare.goto(address.partition("#")[0])
    expect(bare.get_by_role("alert")).to_contain_text("the key is missing or wrong")
    bare.goto(address)  # as it says, in the same tab: a browser takes that for a place on the same page
    expect(bare.get_by_text("Camera of pool")).to_be_visible()
    assert bare.request.get(address.partition("#")[0] + "live").status == 403
    bare.context.close()
    process.send_signal(signal.SIGINT)
    assert eventually(lambda: not process.is_running() or process.status() == psutil.STATUS_ZOMBIE, PATIENCE_MS * 1e-3)
    expect(page.get_by_text("localizer setup does not answer")).to_be_visible()
    page.context.close()


def test_the_fleet_is_stopped_from_this_page_too_by_key_and_by_pointer(
    browser: Browser, program: tuple[psutil.Popen, str]
) -> None:
    """No station runs here: what `groundstation stop` says of that is shown."""
    traffic = PageTraffic()
    page = _open(browser, program[1], traffic)
    page.keyboard.press("Shift+Space")
    expect(page.locator(".stop-said")).to_contain_text("no station")
    page.get_by_role("button", name="EMERGENCY STOP").dispatch_event("pointerdown")
    expect(page.locator(".stop-said")).to_have_text("emergency stop: asked")
    expect(page.locator(".stop-said")).to_contain_text("no station")
    for width, height in ((1024, 700), (390, 844)):
        page.set_viewport_size({"width": width, "height": height})
        _step(page, "Survey")
        page.mouse.wheel(0, 5000)
        for shown in (page.get_by_role("button", name="EMERGENCY STOP"), page.locator(".stop-said")):
            expect(shown).to_be_in_viewport(ratio=1.0)
        page.get_by_role("button", name="Find markers").click()  # it lies under nothing
    page.context.close()


def test_a_stop_that_gets_no_answer_is_said_so_and_is_given_again(
    browser: Browser, program: tuple[psutil.Popen, str], traffic: PageTraffic
) -> None:
    """The way to the program is dead, and nobody has said so to the browser."""
    page, requests = _open(browser, program[1], traffic), list[Route]()
    page.route("**/do", lambda route: requests.append(route))  # Playwright writes into what it is given
    page.keyboard.press("Shift+Space")
    expect(page.locator(".stop-said")).to_have_text("emergency stop: asked")
    expect(page.locator(".stop-said")).to_contain_text("no answer, press again, or run groundstation stop")
    page.keyboard.press("Shift+Space")
    expect(page.locator(".stop-said")).to_have_text("emergency stop: asked")
    assert len(requests) == 2
    page.context.close()


def test_a_save_that_failed_is_told_until_the_next_request(
    browser: Browser, program: tuple[psutil.Popen, str], lab: Path, traffic: PageTraffic
) -> None:
    """The difference, which the page asks for by itself after it, takes no word of it back."""
    address, key = program[1].split("#key=")
    page, problem = _open(browser, program[1], traffic), "was changed by somebody else"
    change = {"do": "mask", "corners_px": [[11.5, 12.5], [20.0, 10.0], [10.0, 20.0]]}
    assert page.request.post(f"{address}do", data=change, headers={"x-key": key}).json()["problem"] == ""
    _step(page, "Save")
    expect(page.locator(".difference")).to_contain_text("11.5")
    lab.write_text(lab.read_text(encoding="utf-8") + "# by somebody else\n", encoding="utf-8")
    with page.expect_response(lambda answer: "difference" in (answer.request.post_data or "")):
        page.get_by_role("button", name="Save", exact=True).click()
    for _ in range(3):
        with page.expect_response("**/state*"):
            pass
    expect(page.locator(".problem")).to_contain_text(problem)
    _button(page, "Read the file again")
    expect(page.get_by_text(problem)).to_have_count(0)
    page.context.close()


def test_a_picture_that_does_not_come_is_told_and_asked_for_again(browser: Browser, program: tuple[psutil.Popen, str]) -> None:
    """A browser goes on showing the last picture of a stream that has ended, and says nothing."""
    page, requests, passes = browser.new_context().new_page(), list[Route](), threading.Event()
    page.set_default_timeout(PATIENCE_MS)

    def stream(route: Route) -> None:
        requests.append(route)
        if len(requests) == 1:
            route.abort()
        elif passes.is_set():
            route.continue_()

    def await_request(number: int) -> None:
        for _ in range(PATIENCE_MS // 100):
            if len(requests) >= number:
                return
            page.wait_for_timeout(100)
        raise AssertionError(f"the page asked {len(requests)} times for the picture, and not {number}")

    page.route("**/live*", stream)
    page.goto(program[1])
    expect(page.locator(".trouble")).to_contain_text("not live")
    await_request(2)
    passes.set()
    for route in requests[1:]:
        route.continue_()
    expect(page.locator(".trouble")).not_to_contain_text("not live")
    count = len(requests)
    page.route("**/state*", lambda route: route.abort())
    expect(page.locator(".trouble")).to_have_text("no answer")
    page.unroute("**/state*")
    expect(page.locator(".trouble")).not_to_have_text("no answer")
    await_request(count + 1)  # the way was dead: the stream that went over it, too
    page.context.close()


def test_in_a_small_window_the_picture_covers_nothing_and_the_stop_stays_in_sight(
    browser: Browser, program: tuple[psutil.Popen, str]
) -> None:
    page = _open(browser, program[1], PageTraffic(), width=780, height=490)
    for step, name in (("Survey", "Find markers"), ("Save", "Read the file again")):
        _step(page, step)
        wanted = page.get_by_role("button", name=name)
        wanted.scroll_into_view_if_needed()
        stop = page.get_by_role("button", name="EMERGENCY STOP").bounding_box()
        assert stop is not None and 0.0 <= stop["y"] <= 490.0 - stop["height"]
        wanted.click(trial=True, timeout=10_000)  # the press would reach it
    page.get_by_role("button", name="EMERGENCY STOP").dispatch_event("pointerdown")
    expect(page.locator(".stop-said")).to_be_in_viewport()
    page.context.close()
