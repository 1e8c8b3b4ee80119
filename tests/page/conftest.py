"""A browser, and the pool experiment flown for it with all its processes, in lockstep: slow machines are slow, not wrong."""

import ctypes
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

import psutil
import pytest
from playwright.sync_api import Browser, Page, expect, sync_playwright

from sim_bridge.sil.ports import free_port
from tests.page.flights import CHROMIUM, FLAGS, PATIENCE_MS, OperatorFlight, PageTraffic, open_page

PR_CAPBSET_DROP, CAP_SYS_NICE = 24, 23  # linux/prctl.h, linux/capability.h

expect.set_options(timeout=PATIENCE_MS)


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Put the tests of the flight last: in lockstep it takes all of two processors, as long as it lasts."""
    here = [k for k, item in enumerate(items) if item.path.is_relative_to(Path(__file__).parent)]
    ordered = sorted((items[k] for k in here), key=lambda item: "flight" in getattr(item, "fixturenames", ()))
    for k, item in zip(here, ordered, strict=True):
        items[k] = item


def _keep_programs_at_this_priority() -> None:
    """Take from programs started from now on the right to raise their priority.

    With root's rights Chromium draws at nice -8 and in real time, before any flight. Users without them have no such
    right to begin with, and the call does nothing."""
    ctypes.CDLL(None).prctl(PR_CAPBSET_DROP, CAP_SYS_NICE, 0, 0, 0)


def _let_flights_go_first() -> None:
    """Let programs that are in a session of their own, as Chromium is, wait for those of this one.

    Where Linux groups programs by session (sched_autogroup), nice values count inside a group only: with Chromium's
    group as dear as this one, sleeping programs of flights wake up to 0.2 s late (measured on two cores; 8 ms without).
    The file is empty for a program that is in no such group, as one that a container starts without a session."""
    here = Path("/proc/self/autogroup")
    if not here.exists():
        return
    ours = here.read_text(encoding="ascii").partition(" ")[0]
    for program in psutil.Process().children(recursive=True):
        with suppress(OSError):  # it has ended, or may not
            group = Path(f"/proc/{program.pid}/autogroup")
            if group.read_text(encoding="ascii").partition(" ")[0] != ours:
                group.write_text("15", encoding="ascii")


@pytest.fixture(scope="package")
def browser() -> Iterator[Browser]:
    if CHROMIUM is None:
        pytest.skip("needs Chromium, and none is installed")
    _keep_programs_at_this_priority()
    with sync_playwright() as playwright:
        found = playwright.chromium.launch(executable_path=CHROMIUM, args=FLAGS)
        _let_flights_go_first()
        yield found
        found.close()


@pytest.fixture(scope="package")
def flight(browser: Browser, tmp_path_factory: pytest.TempPathFactory) -> Iterator[OperatorFlight]:
    found = OperatorFlight(tmp_path_factory.mktemp("flight"), free_port())
    found.start()
    yield found
    found.stop()


@pytest.fixture
def asked() -> PageTraffic:
    return PageTraffic()


@pytest.fixture
def page(browser: Browser, flight: OperatorFlight, asked: PageTraffic) -> Iterator[Page]:
    found = open_page(browser, flight, asked)
    yield found
    found.context.close()
    assert asked.errors == []
    hosts = {url.split("/")[2] for url in asked.urls if not url.startswith(("blob:", "data:"))}
    assert hosts == {f"127.0.0.1:{flight.port}"}, "the page works without any other host"
