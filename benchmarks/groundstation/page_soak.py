"""The operator's page for an hour: does it grow, does it slow down? `python -m benchmarks page --minutes 60`.

Memory is JavaScript's heap after a forced collection, and the renderer's resident memory, once a minute. Trails (1 min) and
plots (5 min) fill first: the slope is that of the time after. Latency as in page.py, the first sixth beside the last.
"""

import shutil
from collections.abc import Iterator

import numpy as np
import psutil
from playwright.sync_api import CDPSession, Page, sync_playwright

from benchmarks.groundstation.page import FLAGS, PROBE, SETTLE_S, lab
from benchmarks.harness import Row
from shoal.errors import ConfigError

ROBOTS = 10
FILLS_MIN = 6.0  # until trails and plots hold as much as they ever will
SAMPLES = 60  # at least; a minute apart at most
MB = 1e6


def run(minutes: float) -> Iterator[Row]:
    """All rows."""
    chromium = shutil.which("chromium") or shutil.which("google-chrome")
    if chromium is None:
        raise ConfigError("page: needs Chromium, and none is installed")
    with lab(ROBOTS) as url, sync_playwright() as playwright:
        before = set(_renderers())
        browser = playwright.chromium.launch(executable_path=chromium, args=FLAGS)
        page = browser.new_page(viewport={"width": 1440, "height": 900})
        page.add_init_script(PROBE)
        page.goto(url)
        page.wait_for_selector("[data-robot='1']:not(.stale)")
        page.wait_for_timeout(SETTLE_S * 1e3)
        session = page.context.new_cdp_session(page)
        renderers = [psutil.Process(pid) for pid in set(_renderers()) - before]
        yield from _rows(minutes, list(_samples(page, session, renderers, minutes)))
        browser.close()


def _renderers() -> Iterator[int]:
    for process in psutil.Process().children(recursive=True):
        if "--type=renderer" in " ".join(process.cmdline()):
            yield process.pid


Sample = tuple[float, float, float, list[float]]  # minutes, heap MB, resident MB, latencies of states in ms


def _samples(page: Page, session: CDPSession, renderers: list[psutil.Process], minutes: float) -> Iterator[Sample]:
    session.send("Performance.enable")
    every_min = min(1.0, minutes / SAMPLES)
    page.evaluate("measured.state = []")
    for k in range(1, round(minutes / every_min) + 1):
        page.wait_for_timeout(every_min * 60e3)
        latencies = page.evaluate("() => measured.state.splice(0)")
        page.evaluate("() => { measured.picture.length = 0; }")
        session.send("HeapProfiler.collectGarbage")
        heap = {m["name"]: m["value"] for m in session.send("Performance.getMetrics")["metrics"]}["JSHeapUsedSize"]
        resident = sum(renderer.memory_info().rss for renderer in renderers if renderer.is_running())
        yield k * every_min, heap / MB, resident / MB, latencies


def _rows(minutes: float, samples: list[Sample]) -> Iterator[Row]:
    case = f"{ROBOTS} robots, {minutes:g} min"
    steady = [sample for sample in samples if sample[0] >= min(FILLS_MIN, 0.6 * minutes)]
    times_h = np.array([sample[0] for sample in steady]) / 60.0
    for subject, values in (("JavaScript's heap", [s[1] for s in steady]), ("renderer, resident", [s[2] for s in steady])):
        yield Row.of("page", case, subject, "MB", values)
        yield Row.of("page", case, f"{subject}, slope", "MB/h", [float(np.polyfit(times_h, values, 1)[0])])
    part = max(1, len(samples) // 6)
    for subject, chosen in (("first sixth", samples[:part]), ("last sixth", samples[-part:])):
        latencies = [latency for sample in chosen for latency in sample[3]]
        yield Row.of("page", case, f"stamp to drawn, state, {subject}", "ms", latencies)
