"""Tests of how long `groundstation log replay` serves a recorded run."""

import threading
import time
import urllib.request
from pathlib import Path
from types import SimpleNamespace

import pytest

from groundstation.cli import replay
from shoal.runtime.runtime import Stop
from shoal.runtime.web_access import web_options
from sim_bridge.sil.ports import free_port
from tests.groundstation.synthetic import Script, write_run
from tests.waiting import eventually


def test_a_run_that_has_ended_waits_for_a_page_in_a_hidden_tab(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A browser lets such a page try once a minute. The clock goes twenty times as fast here."""
    fast = SimpleNamespace(monotonic=lambda: 20.0 * time.monotonic(), sleep=time.sleep)
    monkeypatch.setattr(replay, "time", fast)
    write_run(tmp_path, Script(until_s=1.0))
    address, stop = web_options(f"127.0.0.1:{free_port()}"), Stop()
    shown = threading.Thread(target=replay.show, args=(tmp_path, address, stop, None, True, ("close",)))
    shown.start()
    try:
        shown.join(3.1)
        assert shown.is_alive()
        shown.join(60.0)
        assert not shown.is_alive()  # but not for ever
    finally:
        stop.request()
        shown.join(60.0)


def test_a_recorded_run_waits_for_the_first_page_however_late_a_person_opens_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """With --until-closed, what has not been open is not closed."""
    monkeypatch.setattr(replay, "RETURN_S", 0.0)
    write_run(tmp_path, Script(until_s=1.0))
    address, stop = f"127.0.0.1:{free_port()}", Stop()
    shown = threading.Thread(target=replay.show, args=(tmp_path, web_options(address), stop, None, True))
    shown.start()

    def answers() -> bool:
        try:
            with urllib.request.urlopen(f"http://{address}/") as page:
                return bool(page.status == 200)
        except OSError:
            return False

    try:
        assert eventually(answers, 60.0)
        shown.join(1.0)
        assert shown.is_alive() and answers()
    finally:
        stop.request()
        shown.join(60.0)
    assert not shown.is_alive()
