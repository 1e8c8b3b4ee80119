"""Flights under the hands of an operator's page, and the pages of a browser."""

import os
import shutil
import signal
import socket
import subprocess
import sys
import time
from dataclasses import dataclass, field
from importlib import resources
from pathlib import Path

import psutil
from playwright.sync_api import Browser, Page

CHROMIUM = next((path for name in ("chromium", "chromium-browser", "google-chrome") if (path := shutil.which(name))), None)
FLAGS = [
    "--headless",
    "--no-sandbox",
    "--disable-gpu",
    "--disable-quic",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
]
AXE = resources.files("axe_playwright_python") / "axe.min.js"
PACED = ("--lockstep", "--pace", "2", "--poses")
PATIENCE_MS = 120_000  # for anything that a loaded machine may take long over


def wait_for_port(port: int, process: subprocess.Popen[bytes]) -> None:
    """Until a program serves its page."""
    deadline = time.monotonic() + PATIENCE_MS * 1e-3
    while time.monotonic() < deadline and process.poll() is None:
        try:
            socket.create_connection(("127.0.0.1", port), 1.0).close()
            return
        except OSError:
            time.sleep(0.05)
    raise AssertionError(f"no page at port {port}")


@dataclass
class OperatorFlight:
    """`sim-bridge sil pool` under an operator's hands; without the camera and at twice real time, to leave processors free.
    `arguments` are those of its own."""

    folder: Path
    port: int
    arguments: tuple[str, ...] = ("--manual", "--duration", "900")
    process: subprocess.Popen[bytes] | None = None
    starts: int = 0
    stopped: list[psutil.Process] = field(default_factory=list)

    @property
    def url(self) -> str:
        return f"http://127.0.0.1:{self.port}/"

    def start(self) -> None:
        """Start all processes; returns when the page can be had."""
        self.starts += 1
        command = [sys.executable, "-m", "sim_bridge", "sil", "pool", *PACED, *self.arguments]
        log = (self.folder / f"sil-{self.starts}.log").open("wb")
        self.process = subprocess.Popen(
            [*command, "--out", str(self.folder), "--web", f"127.0.0.1:{self.port}"],
            stdout=log,
            stderr=subprocess.STDOUT,
            env={**os.environ, "PYTHONUNBUFFERED": "1"},
        )
        try:
            wait_for_port(self.port, self.process)
        except AssertionError as error:
            raise AssertionError(f"{error}: {self.output}") from None

    @property
    def output(self) -> str:
        """The program's output so far."""
        return (self.folder / f"sil-{self.starts}.log").read_text(encoding="utf-8")

    @property
    def runs(self) -> list[Path]:
        """The folders of all runs, the oldest first."""
        return sorted(folder for folder in self.folder.iterdir() if folder.is_dir())

    def agent(self, robot: int) -> psutil.Process:
        """The process of one robot's agent."""
        assert self.process is not None
        for child in psutil.Process(self.process.pid).children():
            arguments = child.cmdline()
            is_agent = "robot_agent" in arguments or {"sim_bridge.lockstep", "agent"} <= set(arguments)
            if is_agent and arguments[arguments.index("--robot") + 1] == str(robot):
                return child
        raise AssertionError(f"no agent {robot}")

    def stop(self) -> None:
        """End all processes."""
        if self.process is not None:
            self.process.send_signal(signal.SIGTERM)
            self.process.wait(PATIENCE_MS * 1e-3)


@dataclass
class PageTraffic:
    """Every address that a page asked for, and what it complained about."""

    urls: list[str] = field(default_factory=list)
    errors: list[str] = field(default_factory=list)


def open_page(browser: Browser, flight: OperatorFlight, traffic: PageTraffic, width: int = 1440, height: int = 900) -> Page:
    """A new browser window on the operator's page, past its first state."""
    page = browser.new_context(viewport={"width": width, "height": height}).new_page()
    page.set_default_timeout(PATIENCE_MS)
    page.on("request", lambda request: traffic.urls.append(request.url))
    page.on("websocket", lambda socket: traffic.urls.append(socket.url))
    page.on("pageerror", lambda error: traffic.errors.append(str(error)))
    page.goto(flight.url)
    page.wait_for_selector("[data-robot='1']:not(.stale)")
    return page


def serious(page: Page) -> list[tuple[str, list[str]]]:
    """The findings of axe that keep people out."""
    page.evaluate(AXE.read_text(encoding="utf-8"))  # not a script tag: the page's own policy forbids what is not its own
    violations = page.evaluate("axe.run(document, {resultTypes: ['violations']})")["violations"]
    return [(v["id"], [n["target"] for n in v["nodes"]][:5]) for v in violations if v["impact"] in ("serious", "critical")]
