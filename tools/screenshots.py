"""SHELL: docs/images/page-*.jpg, the pages on real runs: `python -m tools.screenshots` (Chromium; four minutes)."""

import shutil
import signal
import subprocess
import tempfile
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from itertools import count
from pathlib import Path
from typing import Literal

import cv2
import numpy as np
from playwright.sync_api import Browser, Page, ViewportSize, sync_playwright

from groundstation.logs.run_folders import give_label
from shoal.config.experiment import Experiment, load_experiment
from shoal.system import programs
from sim_bridge.camera.renderer import Renderer
from sim_bridge.sil.ports import free_port

IMAGES = Path(__file__).parents[1] / "docs" / "images"
FLAGS = ["--headless", "--no-sandbox", "--disable-gpu", "--no-first-run", "--disable-background-networking", "--disable-sync"]
PATIENCE_MS = 180_000
DESK: ViewportSize = {"width": 1440, "height": 900}
PHONE: ViewportSize = {"width": 390, "height": 844}


@contextmanager
def flight(out: str, *arguments: str) -> Iterator[str]:
    """A run in lockstep; where its page is."""
    port = free_port()
    words = ["sil", *arguments, "--lockstep", "--out", out, "--web", f"127.0.0.1:{port}"]
    process = programs.start("sim_bridge", words, stdout=subprocess.DEVNULL)
    try:
        yield f"http://127.0.0.1:{port}/"
    finally:
        process.terminate()
        process.wait()


def opened(browser: Browser, url: str, size: ViewportSize, scheme: Literal["dark", "light"] = "dark") -> Page:
    """The page, as soon as it is served."""
    page = browser.new_context(viewport=size, color_scheme=scheme).new_page()
    page.set_default_timeout(PATIENCE_MS)
    deadline = time.monotonic() + PATIENCE_MS * 1e-3
    while True:
        try:
            page.goto(url)
            break
        except Exception:
            if time.monotonic() > deadline:
                raise
            time.sleep(0.2)
    page.wait_for_selector("[data-robot='1']:not(.stale)")
    return page


def flown(page: Page, seconds: int) -> None:
    """Wait until the run has got this far."""
    page.wait_for_function(
        "s => { const t = document.querySelector('header .clock').textContent.split(' ')[0].split(':'); "
        "return 60 * Number(t[0]) + Number(t[1]) >= s; }",
        arg=seconds,
    )


def keep(page: Page, name: str) -> None:
    page.wait_for_timeout(600)
    page.screenshot(path=IMAGES / f"page-{name}.jpg", type="jpeg", quality=86)
    print(IMAGES / f"page-{name}.jpg")


def fly_before(out: str) -> None:
    """Two numeric runs with names, of which the first is too short to pass."""
    for scene, duration_s, name, tag in (("fleet-20", 16, "all twenty", "demo"), ("numeric", 25, "new weights", "tuning")):
        programs.ask("sim_bridge", ["numeric", scene, "--duration", str(duration_s), "--out", out])
        give_label(next(Path(out).glob(f"{scene}-*")), name, [tag])


def of_the_pool(browser: Browser, out: str) -> None:
    """Flying, the list of runs, other gains, editing, a phone, and the emergency stop."""
    with flight(out, "pool", "--set", "sim.plant.current_mps=[0.02,0.01,0]") as url:
        page = opened(browser, url, DESK)
        page.locator("[data-robot='1'] .name").click()
        flown(page, 24)
        keep(page, "flight")
        page.get_by_role("button", name="Runs").click()
        page.locator(".runs tbody tr").nth(2).wait_for()
        keep(page, "runs")
        page.get_by_role("button", name="Close").click()
        gains = page.locator(".tuning")
        gains.locator("summary").click()
        gains.get_by_label("turning", exact=True).fill("0.1")
        gains.get_by_role("button", name="Apply").click()
        gains.get_by_text("set B").wait_for()
        flown(page, 40)
        gains.scroll_into_view_if_needed()
        keep(page, "tuning")
        gains.locator("summary").click()
        page.locator("aside").evaluate("panel => panel.scrollTo(0, 0)")
        page.get_by_role("button", name="3-D").click()
        keep(page, "depth")
        phone = opened(browser, url, PHONE)
        keep(phone, "phone")
        phone.context.close()
        light = opened(browser, url, DESK, "light")
        light.get_by_role("button", name="Edit").click()
        light.get_by_label("scale").fill("0.7")
        keep(light, "editor")
        light.context.close()
        page.get_by_role("button", name="3-D").click()
        take = page.get_by_role("button", name="Take control")  # a machine that is slow enough has lost it
        if take.is_visible():
            take.click()
        page.keyboard.press("Escape")
        page.get_by_text("robot 2 confirms: stopped").wait_for()
        keep(page, "stop")
        page.context.close()


def of_an_end(browser: Browser, out: str) -> None:
    """A short run when it is over."""
    with flight(out, "pool", "--duration", "25") as url:
        page = opened(browser, url, DESK)
        page.get_by_label("End of the run").wait_for()
        page.locator(".end summary").click()
        keep(page, "end")
        page.context.close()


def of_a_fleet(browser: Browser, out: str) -> None:
    """Twenty robots replayed."""
    port, run = free_port(), next(Path(out).glob("fleet-20-*"))
    showing = programs.start("groundstation", ["log", "replay", str(run), "--web", f"127.0.0.1:{port}"])
    try:
        page = opened(browser, f"http://127.0.0.1:{port}/", DESK)
        page.get_by_role("button", name="Play", exact=True).click()
        flown(page, 12)
        keep(page, "fleet")
        page.context.close()
    finally:
        showing.terminate()
        showing.wait()


@contextmanager
def camera(folder: Path, experiment: Experiment) -> Iterator[None]:
    """A folder in which the pictures of a simulated pool come, over and over, ten a second."""
    folder.mkdir()
    renderer, eta = Renderer(experiment, 1), np.array([[0.5, 0.2, 0.3, 1.0], [-0.6, -0.3, 0.3, 2.5]])
    frames = [cv2.imencode(".bmp", renderer.render(eta, np.zeros((2, 4)), 0.1 * k, k))[1].tobytes() for k in range(20)]
    over = threading.Event()

    def play() -> None:
        for k in count():
            (folder / "next").write_bytes(frames[k % len(frames)])
            (folder / "next").rename(folder / f"{k}.bmp")
            (folder / f"{k - 50}.bmp").unlink(missing_ok=True)
            if over.wait(0.1):
                return

    player = threading.Thread(target=play)
    player.start()
    try:
        yield
    finally:
        over.set()
        player.join()


def of_a_camera(browser: Browser, out: str) -> None:
    """A camera of the simulated pool that is set up: its light, and its pose from the five check marks."""
    experiment, folder = load_experiment("figure-eight"), Path(out) / "camera"
    with camera(folder, experiment):
        _set_up(browser, experiment, ["--camera", f"folder:{folder}:10", "--out", f"{out}/lab.toml"])


def _set_up(browser: Browser, experiment: Experiment, options: list[str]) -> None:
    words = ["setup", experiment.name, *options, "--port", str(free_port())]
    program = programs.start("localizer", words, stdout=subprocess.PIPE)
    assert program.stdout is not None
    try:
        page = browser.new_context(viewport=DESK, color_scheme="dark").new_page()
        page.goto(program.stdout.readline().decode().split()[5])
        page.locator(".histogram").wait_for()
        keep(page, "setup")
        page.get_by_role("button", name="3 Survey").click()
        page.get_by_role("button", name="Find markers").click()
        for mark in experiment.check_marks:
            page.get_by_label("Name").fill(f"mark {mark.id}")
            for axis, value in zip("xyz", mark.position_m, strict=True):
                page.get_by_label(f"{axis}, m", exact=True).fill(f"{value}")
            page.get_by_role("button", name=f"is marker {mark.id}").click()
            page.get_by_role("button", name=f"mark {mark.id}", exact=True).wait_for()
        page.get_by_role("button", name="Find the pose").click()
        page.get_by_label("Grid at depth").click()
        page.get_by_text("RMS 0.").first.wait_for()
        keep(page, "setup-survey")
        page.context.close()
    finally:
        program.send_signal(signal.SIGINT)
        program.wait()


def main() -> None:
    with sync_playwright() as playwright, tempfile.TemporaryDirectory() as out:
        browser = playwright.chromium.launch(executable_path=shutil.which("chromium"), args=FLAGS)
        fly_before(out)
        of_the_pool(browser, out)
        of_an_end(browser, out)
        of_a_fleet(browser, out)
        of_a_camera(browser, out)
        browser.close()


if __name__ == "__main__":
    main()
