"""A terminal waits for what becomes of its request, and exits by that."""

import json
from collections.abc import Iterator
from typing import Any

import pytest
from typer.testing import CliRunner

from groundstation import client
from groundstation.__main__ import cli
from groundstation.cli.mission import OutcomePrinter
from groundstation.client import follow
from shoal.bus.bus import Bus
from shoal.bus.memory_transport import MemoryHub, MemoryTransport
from shoal.errors import ConfigError
from shoal.messages.messages import Command, CommandKind, Outcome, Progress, Reply

SILENT = Reply(0, False, "no answer within 2 s", silent=True)


def outcome(progress: Progress = Progress.UNDER_WAY, **more: Any) -> Reply:
    return Reply(0, True, outcome=Outcome(5, CommandKind.STOP, progress, **more))


@pytest.fixture(autouse=True)
def no_waiting(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(client, "ASK_EVERY_S", 0.0)


def asked(
    *replies: Reply, order: CommandKind = CommandKind.STOP, patience_s: float = 60.0
) -> tuple[Reply, list[Command], list[Outcome]]:
    """Outcome of a request that gets these answers; the last one repeats for ever."""
    commands: list[Command] = []
    outcomes: list[Outcome] = []

    def answers() -> Iterator[Reply]:
        yield from replies
        while True:
            yield replies[-1]

    answer = answers()

    def ask(command: Command) -> Reply:
        commands.append(command)
        return next(answer)

    over = client.limit(Bus(MemoryTransport(MemoryHub())), patience_s)
    return follow(ask, Command(order, 0), over, outcomes.append), commands, outcomes


def test_the_terminal_queries_the_outcome_until_it_is_over() -> None:
    done = outcome(Progress.DONE, confirmed=(1, 2))
    reply, commands, outcomes = asked(outcome(), outcome(confirmed=(1,)), done)
    assert reply is done
    assert [(c.order, c.about) for c in commands] == [(CommandKind.STOP, 0), (CommandKind.NONE, 5), (CommandKind.NONE, 5)]
    assert [o.confirmed for o in outcomes] == [(), (1,)]


def test_a_question_that_is_not_answered_is_asked_again_and_the_request_is_not() -> None:
    reply, commands, _ = asked(outcome(), SILENT, SILENT, outcome(Progress.DONE), order=CommandKind.GO)
    assert reply.outcome is not None and reply.outcome.progress is Progress.DONE
    assert [c.order for c in commands].count(CommandKind.GO) == 1


def test_only_an_unanswered_stop_is_repeated() -> None:
    _, commands, _ = asked(SILENT, SILENT, outcome(Progress.DONE))
    assert [c.order for c in commands] == [CommandKind.STOP] * 3
    reply, commands, _ = asked(SILENT, outcome(Progress.DONE), order=CommandKind.START)
    assert (reply.silent, len(commands)) == (True, 1)


def test_the_terminal_stops_waiting_after_a_refusal_or_a_reply_without_outcome() -> None:
    for reply in (Reply(0, False, "STOPPED"), Reply(0, True)):
        answer, commands, outcomes = asked(reply)
        assert (answer, len(commands), outcomes) == (reply, 1, [])


def test_patience_ends() -> None:
    reply, commands, _ = asked(outcome(), patience_s=0.0)
    assert reply.outcome is not None and reply.outcome.progress is Progress.UNDER_WAY
    assert len(commands) == 1
    assert len(asked(SILENT, patience_s=0.0)[1]) == 1


@pytest.mark.parametrize(
    ("reply", "code", "lines"),
    [
        (
            outcome(Progress.DONE, confirmed=(1, 2)),
            0,
            ["  robot 1: confirmed", "  robot 2: confirmed", "stop: confirmed by 1, 2"],
        ),
        (
            outcome(confirmed=(1,), waiting=(2,), why=("not heard",)),
            1,
            ["  robot 1: confirmed", "  robot 2: NOT confirmed: not heard", "stop: not done within 5 s"],
        ),
        (outcome(Progress.FAILED, reason="no way there"), 1, ["stop: failed: no way there"]),
        (Reply(0, False, "STOPPED"), 1, ["stop: refused: STOPPED"]),
        (SILENT, 1, ["stop: not heard: no answer within 2 s"]),
        (Reply(0, True), 1, ["stop: under way, and this station does not tell what becomes of it"]),
    ],
)
def test_the_exit_code_and_the_last_lines_say_what_was_achieved(
    reply: Reply, code: int, lines: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    assert OutcomePrinter("stop", False).end(reply, 5.0) == code
    assert [line for line in capsys.readouterr().out.splitlines() if not line.startswith("  mission")] == lines
    assert OutcomePrinter("stop", True).end(reply, 5.0) == code
    output = json.loads(capsys.readouterr().out)
    assert output["done"] is (code == 0)
    assert output["robots"].get("2", "confirmed") == ("not heard" if "NOT" in "".join(lines) else "confirmed")


def test_the_plan_of_another_path_is_printed_before_it_is_asked_for() -> None:
    """Starts, clearances, speeds and forces, and no station is asked; what cannot be flown is refused with its reason."""
    shown = CliRunner().invoke(cli, ["mission", "load", "pool", "--dry-run"])
    lines = shown.output.splitlines()
    assert shown.exit_code == 0 and lines[1].startswith("robot 1 starts at x ") and lines[2].startswith("robot 2 starts at x ")
    assert any(line.startswith("between centres ") for line in lines) and any(line.startswith("thrust ") for line in lines)
    refused = CliRunner().invoke(cli, ["mission", "load", "pool", "--set", "path.lap_s=1", "--dry-run"])
    assert isinstance(refused.exception, ConfigError) and "exceeds the limit" in str(refused.exception)
    alone = CliRunner().invoke(cli, ["mission", "load", "--dry-run"])
    assert alone.exit_code == 2 and "go with an experiment" in alone.output


def test_a_request_that_does_not_wait_is_told_no_more_than_taken(capsys: pytest.CaptureFixture[str]) -> None:
    assert OutcomePrinter("start", False).end(outcome(), 0.0) == 0
    assert capsys.readouterr().out == "start: taken by the station\n"


def test_progress_is_told_once(capsys: pytest.CaptureFixture[str]) -> None:
    printer = OutcomePrinter("start", False)
    for mission, confirmed in (("LOADING", ()), ("LOADING", ()), ("TEST_ARMING", (1,)), ("TEST_ARMING", (1,))):
        printer.progress(Outcome(1, CommandKind.START, mission=mission, confirmed=confirmed))
    assert capsys.readouterr().out.splitlines() == ["  mission: loading", "  mission: test arming", "  robot 1: confirmed"]
