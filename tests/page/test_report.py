"""A run's report in a real browser: it needs nothing from outside, fits, and its plots share cursor and time."""

from pathlib import Path

import pytest
from playwright.sync_api import Browser

from groundstation.report.report import write_report
from shoal.messages.messages import Mode
from tests.groundstation.synthetic import Script, write_run
from tests.page.flights import serious

pytestmark = [pytest.mark.timeout(120), pytest.mark.real_time]

CHARTS = "document.querySelectorAll('.uplot').length"
TOO_WIDE = "[...document.querySelectorAll('main, .card, figure')].filter((e) => e.scrollWidth > e.clientWidth + 1).length"
TIMES = "[...document.querySelectorAll('#tracking .u-legend tr:first-child .u-value')].map((e) => e.textContent)"


def test_a_broken_runs_report_zooms_together_and_requests_nothing(browser: Browser, tmp_path: Path) -> None:
    def mode(_: int, at_s: float) -> tuple[Mode, str]:
        return (Mode.FAULT, "no pose") if at_s > 8.0 else (Mode.TRACKING, "")

    write_run(tmp_path, Script(until_s=9.0, mode=mode))
    write_report(tmp_path)
    page = browser.new_page(viewport={"width": 1280, "height": 900})
    trouble: list[str] = []
    page.on("pageerror", lambda error: trouble.append(str(error)))
    page.on("request", lambda request: None if request.url.startswith(("file:", "data:")) else trouble.append(request.url))
    page.goto(f"file://{tmp_path / 'report.html'}")
    assert "no pose" in page.locator(".cause").inner_text()
    page.locator("#tracking").scroll_into_view_if_needed()
    page.wait_for_function(f"{CHARTS} >= 3")
    axis = page.locator("#tracking .u-over")
    box = axis.nth(0).bounding_box()
    assert box is not None
    y = box["y"] + box["height"] / 2
    page.mouse.move(box["x"] + 0.5 * box["width"], y)
    page.wait_for_function(f"new Set({TIMES}).size === 1 && {TIMES}[0] !== '–'")  # one cursor for all panels
    page.mouse.down()
    page.mouse.move(box["x"] + 0.75 * box["width"], y, steps=4)
    page.mouse.up()
    page.wait_for_function("document.body.classList.contains('zoomed')")
    page.mouse.move(box["x"] + 2, y)
    page.wait_for_function(f"{TIMES}.every((t) => parseFloat(t) > 3 && parseFloat(t) < 6)")  # they begin where the drag began
    page.keyboard.press("Escape")
    page.wait_for_function("!document.body.classList.contains('zoomed')")
    assert page.evaluate(TOO_WIDE) == 0
    assert serious(page) == []
    assert trouble == []
    page.close()
