"""The emergency stop of the setup's page says what became of it at every station of the machine."""

from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path

import pytest

from groundstation.gate import user_folders
from groundstation.station.discovery import announced
from localizer.setup import server
from shoal.bus.bus import Bus
from shoal.bus.endpoint import Endpoint
from shoal.bus.memory_transport import MemoryHub, MemoryTransport
from shoal.messages.codec import Header
from shoal.messages.messages import WHOLE_FLEET, Command, CommandKind, Outcome, Progress, Reply

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
