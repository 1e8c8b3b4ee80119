"""A page on a station without robots, in this process."""

from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path

from playwright.sync_api import Browser, Page

from groundstation.planning import planner
from groundstation.web.live_backend import LiveBackend
from groundstation.web.server import WebServer
from shoal.bus.bus import Bus
from shoal.bus.memory_transport import MemoryHub, MemoryTransport
from shoal.config.experiment import Experiment
from shoal.runtime.web_access import WebOptions
from sim_bridge.sil.ports import free_port
from tests.groundstation.fake_station import FakeStation


@dataclass(kw_only=True)
class LoneStation(FakeStation):
    """A station without robots, and a page on it."""

    page: Page
    url: str
    robots: Bus
    server: ExitStack


@contextmanager
def lone_station(browser: Browser, experiment: Experiment, run_dir: Path | None = None) -> Iterator[LoneStation]:
    port, hub = free_port(), MemoryHub()
    page = browser.new_page(viewport={"width": 1440, "height": 900})
    with Bus(MemoryTransport(hub)) as bus, Bus(MemoryTransport(hub)) as robots:
        server = ExitStack()
        station = LoneStation(experiment, bus, page=page, url=f"http://127.0.0.1:{port}/", robots=robots, server=server)
        desk = LiveBackend(
            experiment, planner.plan(experiment), bus, station.inboxes, station.clock, station, "real-time", run_dir
        )
        with server:
            server.enter_context(WebServer(desk, WebOptions(port=port)))
            yield station
            page.context.close()
