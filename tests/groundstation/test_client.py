"""Requests as a terminal makes them, how long it waits for each, and what it makes of the answers."""

import math
import threading
import time
from pathlib import Path
from typing import Any

import pytest

from groundstation import client
from shoal.bus.bus import Bus
from shoal.bus.memory_transport import MemoryHub, MemoryTransport
from shoal.config.experiment import load_experiment
from shoal.errors import ConfigError
from shoal.messages.codec import LONGEST_TEXT, Header
from shoal.messages.messages import WHOLE_FLEET, Command, CommandKind, Outcome, Progress, Reply


@pytest.mark.parametrize(
    "places", [[], [1.0, 2.0], [[1.0, 2.0, 3.0]], [[1.0]], [[[1.0, 2.0]]], [[1.0, math.nan]], [[math.inf, 0.0]]]
)
def test_places_are_pairs_of_finite_numbers(places: Any) -> None:
    with pytest.raises(ValueError, match="no places"):
        client.go_command(places)


def test_one_place_and_several_are_a_request_of_the_fleet_or_of_one_robot() -> None:
    one, several = client.go_command([[1.0, -2.0]], 3), client.go_command([(0, 0), (1, 0)])
    assert (one.order, one.robot, one.via.tolist()) == (CommandKind.GO, 3, [[1.0, -2.0]])
    assert (several.robot, several.via.tolist()) == (WHOLE_FLEET, [[0.0, 0.0], [1.0, 0.0]])


@pytest.mark.parametrize(
    ("order", "robot", "wait_s"),
    [
        (CommandKind.STOP, WHOLE_FLEET, 5.0),
        (CommandKind.RETURN, WHOLE_FLEET, 600.0),
        (CommandKind.TUNE, WHOLE_FLEET, 120.0),
        (CommandKind.GO, 2, 600.0),
        (CommandKind.GO, WHOLE_FLEET, 60.0),
        (CommandKind.ARM, 2, 60.0),
    ],
)
def test_each_request_has_its_patience(order: CommandKind, robot: int, wait_s: float) -> None:
    assert client.patience_s(Command(order, robot)) == wait_s


def test_a_path_goes_in_one_message_or_is_refused() -> None:
    def path(points: int) -> Command:
        ways = ", ".join(f"[0.{k:03}, 0.0]" for k in range(points))
        way = f'path={{kind="waypoints", points_m=[{ways}], speed_mps=0.1}}'
        return client.path_command(client.flight_of("pool", [way]))

    command = path(100)
    assert (command.order, command.robot) == (CommandKind.PATH, WHOLE_FLEET) and len(command.text) <= LONGEST_TEXT
    with pytest.raises(ConfigError, match=rf"pool: its path has \d+ characters \(allowed: {LONGEST_TEXT}"):
        path(1000)
    assert not client.flight_of("pool", []).localizer.uses_camera and load_experiment("pool").localizer.uses_camera


@pytest.mark.parametrize("hung", ["path", "keys"])
def test_a_disk_that_hangs_holds_no_request_up_for_ever(hung: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A program that waits for such a disk hears no Ctrl-C either."""
    is_back = threading.Event()

    def read(*_: object) -> bytes:
        is_back.wait()
        raise OSError("the disk is back")

    monkeypatch.setattr("shoal.config.loader.read_regular", read)
    monkeypatch.setattr("shoal.bus.network.open_keys", read)
    monkeypatch.setattr(client, "READ_WITHIN_S", 0.2)
    try:
        with pytest.raises(ConfigError, match=rf"{tmp_path}.* cannot be read within 0.2 s: does its disk answer"):
            if hung == "path":
                client.flight_of(str(tmp_path / "square.toml"), [])
            else:
                client.connect("tls/192.0.2.10:7447", keys=tmp_path)
    finally:
        is_back.set()


def test_gains_without_any_are_those_of_before() -> None:
    command = client.gains_command(["nmpc.heading_m=0.02"])
    assert command.order is CommandKind.TUNE and command.tuning is not None
    assert command.tuning.values.tolist() == [0.02] and len(command.tuning.keys) == 1
    before = client.gains_command([])
    assert before.tuning is not None and before.tuning.keys == ()
    with pytest.raises(ConfigError):
        client.gains_command(["nmpc.heading_m"])


OUTCOME = {progress: Outcome(4, CommandKind.ARM, progress) for progress in Progress}


@pytest.mark.parametrize(
    ("reply", "patience_s", "done", "text"),
    [
        (Reply(0, False, "gone", silent=True), 5.0, False, "not heard: gone"),
        (Reply(0, False, "no"), 5.0, False, "refused: no"),
        (Reply(0, True), 5.0, False, "under way, and this station does not tell"),
        (Reply(0, True, outcome=OUTCOME[Progress.UNDER_WAY]), 0.0, True, "taken by the station"),
        (Reply(0, True, outcome=OUTCOME[Progress.UNDER_WAY]), 5.0, False, "not done within 5 s"),
        (Reply(0, True, outcome=OUTCOME[Progress.DONE]), 5.0, True, ""),
        (Reply(0, True, outcome=OUTCOME[Progress.FAILED]), 5.0, False, ""),
    ],
)
def test_the_verdict_on_a_request(reply: Reply, patience_s: float, done: bool, text: str) -> None:
    is_done, words = client.verdict(reply, patience_s)
    assert is_done is done and words.startswith(text)


def test_a_request_is_followed_to_its_end_over_lost_answers_and_a_stop_is_repeated(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(client, "ASK_EVERY_S", 0.0)
    silent, under_way, done = (
        Reply(0, False, silent=True),
        Reply(0, True, outcome=OUTCOME[Progress.UNDER_WAY]),
        Reply(0, True, outcome=OUTCOME[Progress.DONE]),
    )

    def followed(order: CommandKind, replies: list[Reply], looks: int = 99) -> tuple[Reply, list[Command], int]:
        requests, outcomes = list[Command](), list[Outcome]()
        left = iter(range(looks))

        def ask(command: Command) -> Reply:
            requests.append(command)
            return replies.pop(0)

        last = client.follow(ask, Command(order, WHOLE_FLEET), lambda: next(left, None) is None, outcomes.append)
        return last, requests, len(outcomes)

    def words(reply: Reply) -> str:
        is_done, text = client.verdict(reply, 5.0)
        assert not is_done
        return text

    last, requests, reports = followed(CommandKind.STOP, [silent, silent, under_way, silent, done])
    assert last is done and reports == 2
    assert [(c.order, c.about) for c in requests] == [(CommandKind.STOP, 0)] * 3 + [(CommandKind.NONE, 4)] * 2
    silent_now, other_life = Reply(0, False, "nobody answers there", silent=True), Reply(0, False, "is for another life")
    assert words(followed(CommandKind.ARM, [under_way, silent_now], looks=1)[0]) == (
        "not known whether it is done: nobody answers there"
    )
    assert words(followed(CommandKind.ARM, [under_way, silent_now, under_way], looks=2)[0]) == "not done within 5 s"
    assert words(followed(CommandKind.ARM, [under_way, other_life])[0]) == (
        "not known whether it is done: the station knows nothing of it any more (is for another life)"
    )
    assert followed(CommandKind.ARM, [silent])[:1] == (silent,)
    assert followed(CommandKind.STOP, [silent, silent], looks=1)[0] is silent
    assert followed(CommandKind.ARM, [under_way, under_way], looks=1)[0] is under_way


@pytest.mark.skipif(not hasattr(time, "CLOCK_BOOTTIME"), reason="the system has no clock that counts a machine's sleep")
def test_requests_are_dated_by_a_clock_that_goes_on_while_the_machine_sleeps(monkeypatch: pytest.MonkeyPatch) -> None:
    """A script that is open over night asks in the morning: by a clock that stood, a station elsewhere would take it for one
    that was held up all night."""
    hub, stamps = MemoryHub(), list[int]()

    def handle(header: Header, command: Command) -> Reply:
        stamps.append(header.stamp_ns)
        return Reply(WHOLE_FLEET, True)

    Bus(MemoryTransport(hub)).serve(WHOLE_FLEET, handle, expires=True)
    send, slept_ns, since_boot = client.sender(Bus(MemoryTransport(hub))), 8 * 3600 * 10**9, time.clock_gettime_ns
    assert send(Command(CommandKind.HOLD, WHOLE_FLEET)).accepted
    monkeypatch.setattr(time, "clock_gettime_ns", lambda clock: since_boot(clock) + slept_ns * (clock == time.CLOCK_BOOTTIME))
    assert send(Command(CommandKind.HOLD, WHOLE_FLEET)).accepted
    assert stamps[1] - stamps[0] >= slept_ns
