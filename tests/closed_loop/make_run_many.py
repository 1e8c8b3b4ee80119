"""Fly `make run` again and again beside a browser that shows its page; count the runs that pass, and measure their pace.

    .venv/bin/python -m tests.closed_loop.make_run_many --runs 20 --duration 25

Exit code 0 if all passed, and the page showed robots that moved in all of them.
"""

import argparse
import json
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

from playwright.sync_api import Browser, sync_playwright

from sim_bridge.sil.ports import free_port
from tests.page.flights import CHROMIUM, FLAGS, PATIENCE_MS, wait_for_port

ADDITIONS = 10_000_000  # of the loop that tells how fast this machine is now


@dataclass(frozen=True)
class WatchedRun:
    """One run: its verdict, the page's, and its times."""

    passed: bool
    shown: bool  # the page showed a robot that moved, and nothing that it took for stale for long
    took_s: float
    pace: float  # flown seconds per second
    last_line: str


def additions_s() -> float:
    """Seconds for ADDITIONS in a Python loop, now."""
    began_s, total = time.monotonic(), 0
    for k in range(ADDITIONS):
        total += k
    return time.monotonic() - began_s


def fly(browser: Browser, duration_s: float, options: list[str]) -> WatchedRun:
    """One run beside a page that is open from its first second to its last."""
    began_s, port = time.monotonic(), free_port()
    with tempfile.TemporaryDirectory() as out:
        command = [sys.executable, "-m", "sim_bridge", "sil", "pool", "--duration", f"{duration_s:g}", "--out", out]
        with (Path(out) / "said").open("wb") as output:
            run = subprocess.Popen([*command, "--web", f"127.0.0.1:{port}", *options], stdout=output, stderr=subprocess.STDOUT)
            shown = watch(browser, port, run)
            code = run.wait()
        lines = (Path(out) / "said").read_text(encoding="utf-8").splitlines()
        paces = [json.loads(file.read_text(encoding="utf-8"))["real_time_factor"] for file in Path(out).glob("*/result.json")]
    return WatchedRun(code == 0, shown, time.monotonic() - began_s, (paces and paces[0]) or 0.0, lines[-1] if lines else "")


def watch(browser: Browser, port: int, run: subprocess.Popen[bytes]) -> bool:
    """Show the page until the run ends. Returns whether its clock went on, of a robot that is not stale."""
    try:
        wait_for_port(port, run)
    except AssertionError:
        return False
    page = browser.new_context(viewport={"width": 1440, "height": 900}).new_page()
    page.set_default_timeout(PATIENCE_MS)
    clocks: set[str] = set()
    page.goto(f"http://127.0.0.1:{port}/")
    while run.poll() is None and not page.get_by_label("End of the run").count():
        fresh = page.locator("[data-robot='1']:not(.stale)")
        if fresh.count() and page.locator("header .clock").count():
            clocks.add(page.locator("header .clock").inner_text())
        page.wait_for_timeout(1000.0)
    page.context.close()
    return len(clocks) > 2


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--runs", type=int, default=20)
    parser.add_argument("--duration", type=float, default=25.0, help="seconds to fly in each run")
    parser.add_argument("options", nargs="*", help="for sim-bridge sil, after --")
    options = parser.parse_args()
    passed = 0
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=CHROMIUM, args=FLAGS)
        for number in range(1, options.runs + 1):
            machine_s = additions_s()
            outcome = fly(browser, options.duration, ["--seed", str(number), *options.options])
            passed += outcome.passed and outcome.shown
            print(
                f"run {number}: {'passed' if outcome.passed else 'FAILED'}, page {'shown' if outcome.shown else 'NOT SHOWN'}, "
                f"{outcome.pace:.2f} x real time, {outcome.took_s:.0f} s; {ADDITIONS} additions took {machine_s:.2f} s"
                f"{'' if outcome.passed else f'; {outcome.last_line}'}",
                flush=True,
            )
        browser.close()
    print(f"passed {passed} of {options.runs}")
    return 0 if passed == options.runs else 1


if __name__ == "__main__":
    sys.exit(main())
