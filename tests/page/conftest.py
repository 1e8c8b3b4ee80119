"""A browser, and the pool experiment flown for it with all its processes, in lockstep: slow machines are slow, not wrong."""

from collections.abc import Iterator

import pytest
from playwright.sync_api import Browser, Page, expect, sync_playwright

from sim_bridge.sil.ports import free_port
from tests.page.flights import CHROMIUM, FLAGS, PATIENCE_MS, OperatorFlight, PageTraffic, open_page

expect.set_options(timeout=PATIENCE_MS)


@pytest.fixture(scope="package")
def browser() -> Iterator[Browser]:
    if CHROMIUM is None:
        pytest.skip("needs Chromium, and none is installed")
    with sync_playwright() as playwright:
        instance = playwright.chromium.launch(executable_path=CHROMIUM, args=FLAGS)
        yield instance
        instance.close()


@pytest.fixture(scope="package")
def flight(browser: Browser, tmp_path_factory: pytest.TempPathFactory) -> Iterator[OperatorFlight]:
    operator = OperatorFlight(tmp_path_factory.mktemp("flight"), free_port())
    operator.start()
    yield operator
    operator.stop()


@pytest.fixture
def traffic() -> PageTraffic:
    return PageTraffic()


@pytest.fixture
def page(browser: Browser, flight: OperatorFlight, traffic: PageTraffic) -> Iterator[Page]:
    window = open_page(browser, flight, traffic)
    yield window
    window.context.close()
    assert traffic.errors == []
    hosts = {url.split("/")[2] for url in traffic.urls if not url.startswith(("blob:", "data:"))}
    assert hosts == {f"127.0.0.1:{flight.port}"}, "the page works without any other host"
