"""The emergency stop of the setup's page says what became of it at every station of the machine."""

import json
import threading
from collections.abc import Callable
from contextlib import ExitStack
from http.client import HTTPConnection
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from groundstation.gate import user_folders
from groundstation.station.discovery import announced
from localizer.setup import server
from localizer.view.local_server import bind
from shoal.bus.bus import Bus
from shoal.bus.endpoint import Endpoint
from shoal.bus.memory_transport import MemoryHub, MemoryTransport
from shoal.messages.codec import Header
from shoal.messages.messages import WHOLE_FLEET, Command, CommandKind, Outcome, Progress, Reply
from shoal.runtime.runtime import Stop

pytestmark = pytest.mark.long

DONE = Outcome(1, CommandKind.STOP, Progress.DONE, confirmed=(1, 2))
FAILED = Outcome(1, CommandKind.STOP, Progress.FAILED, "robot 2 is tracking", confirmed=(1,), waiting=(2,), why=("tracking",))


def answers(outcome: Outcome) -> Callable[[Header, Command], Reply]:
    return lambda header, command: Reply(WHOLE_FLEET, True, outcome=outcome)


@pytest.mark.parametrize(
    ("outcomes", "parts"),
    [
        ((DONE,), ["stop: confirmed by 1, 2"]),
        (
            (DONE, FAILED),
            ["17501 (pool, process", "stop: confirmed by 1, 2", "17502 (pool", "stop: failed: robot 2 is tracking"],
        ),
        ((FAILED, DONE), ["17501 (pool, process", "stop: failed: robot 2 is tracking", "17502 (pool", "confirmed by 1, 2"]),
    ],
)
def test_stop_tells_the_outcome_of_every_station(
    outcomes: tuple[Outcome, ...], parts: list[str], tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder: Path = tmp_path_factory.mktemp("s")
    monkeypatch.setenv(user_folders.ONLY, str(folder))
    with ExitStack() as stack:
        for port, outcome in enumerate(outcomes, start=17501):
            bus = stack.enter_context(Bus(MemoryTransport(MemoryHub())))
            bus.serve(WHOLE_FLEET, answers(outcome))
            stack.enter_context(announced(Endpoint(f"tcp/127.0.0.1:{port}", router=True), "shoal", "pool", bus))
        text = server._stop_fleet()  # private: the page's button alone calls it
    assert all(part in text for part in parts)


def test_a_camera_that_hangs_keeps_no_stop_waiting(monkeypatch: pytest.MonkeyPatch) -> None:
    """Each look at the state waits for the controls, and there are only so many threads for that."""
    release, waits = threading.Event(), threading.Semaphore(0)

    def state(pages: int) -> dict[str, Any]:
        waits.release()
        release.wait(600.0)
        return {}

    def ask(method: str, path: str, body: str | None = None, within_s: float = 600.0) -> bytes:
        connection = HTTPConnection("127.0.0.1", port, timeout=within_s)
        connection.request(method, path, body, {"x-key": "key"})
        return connection.getresponse().read()

    monkeypatch.setattr(server, "_stop_fleet", lambda: "stop: confirmed by 1, 2")
    bound, stop = bind(0, "--port"), Stop(install=False)
    port = bound.getsockname()[1]
    served = server.SetupServer(SimpleNamespace(state=state), SimpleNamespace(next=lambda last: None), bound, "key")  # type: ignore[arg-type]
    threads = [threading.Thread(target=served.run, args=(stop,))]
    threads += [threading.Thread(target=ask, args=("GET", f"/state?page={page}")) for page in range(60)]
    for thread in threads:
        thread.start()
    try:
        assert all(waits.acquire(timeout=60.0) for _ in range(40))  # as many as there are
        answer = json.loads(ask("POST", "/do", json.dumps({"do": "stop"}), 60.0))
        assert answer["found"] == "stop: confirmed by 1, 2" and not release.is_set()
    finally:
        release.set()
        stop.request()
        for thread in threads:
            thread.join()
