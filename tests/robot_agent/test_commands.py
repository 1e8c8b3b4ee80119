"""Commands of a robot's computer, without a board: each outcome of each, and its exit code."""

import json
from collections.abc import Callable
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest
from typer.testing import CliRunner, Result

from robot_agent.__main__ import cli
from robot_agent.host.board_zero import FILE, ZeroRecord, read_record, write_record
from robot_agent.preflight import findings
from robot_agent.preflight.findings import CheckFinding, CheckVerdict
from shoal.bus.key_ring import EXPIRES_SOON
from shoal.errors import ConfigError
from shoal.kernels.build import Compilation
from shoal.mavlink.agent_link import ACCEPTED, CALIBRATE, UNSUPPORTED, Telemetry

OK, WARN, FAIL, SKIPPED = CheckVerdict.OK, CheckVerdict.WARN, CheckVerdict.FAIL, CheckVerdict.SKIPPED


def _run(*words: str, answer: str = "") -> Result:
    return CliRunner().invoke(cli, [*words], input=answer)


@pytest.fixture
def config(tmp_path: Path) -> str:
    file = tmp_path / "agent.toml"
    options = ("--station", "tcp/127.0.0.1:7447", "--link", "udp:127.0.0.1:9", "--out", str(file))
    assert _run("init", "--robot", "1", *options).exit_code == 0
    again = _run("init", "--robot", "2", *options)
    assert isinstance(again.exception, ConfigError) and "is there already" in str(again.exception)
    assert _run("init", "--robot", "1", *options, "--force").exit_code == 0
    return str(file)


@pytest.mark.parametrize("complete", [True, False])
def test_kernels_that_do_not_stay_are_a_failure(monkeypatch: pytest.MonkeyPatch, complete: bool) -> None:
    """A deployment goes by the exit code."""
    requests: list[tuple[str, ...]] = []

    def compiled(packages: tuple[str, ...]) -> Compilation:
        requests.append(packages)
        return Compilation(7, complete)

    monkeypatch.setattr("shoal.kernels.build.ensure_compiled", compiled)
    done = _run("compile")
    assert (done.exit_code, done.stdout) == ((0, "7 kernels compiled\n") if complete else (1, ""))
    assert requests == [("robot_agent",)]


def test_folders_of_kernels_that_stay_are_named(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    gone = tmp_path / "gone"
    monkeypatch.setattr("shoal.kernels.cache.clear", lambda: [tmp_path, gone])
    done = _run("compile", "--clear")
    assert done.exit_code == 0 and done.stdout == f"{tmp_path}: cannot be removed\n{gone}: removed\n"


@pytest.mark.parametrize(
    "options", [("--home", "opt"), ("--home", "/o pt"), ("--home", "/"), ("--user", "Pi x"), ("--user", "1")]
)
def test_a_unit_that_systemd_would_misread_is_not_written(options: tuple[str, ...]) -> None:
    assert isinstance(_run("unit", *options).exception, ConfigError)


def test_a_unit_names_folder_and_user() -> None:
    text = _run("unit", "--home", "/srv/shoal-2/", "--user", "_pi-1").stdout
    assert "/srv/shoal-2/venv" in text and "User=_pi-1" in text and "@HOME@" not in text and "@USER@" not in text


# --- confirm-zero where no program runs


def _zero(monkeypatch: pytest.MonkeyPatch, telemetry: Telemetry, program: bool = False) -> Callable[..., Result]:
    requests: list[bool] = []

    def tell(board: object, in_air: bool) -> Telemetry:
        requests.append(in_air)
        return telemetry

    monkeypatch.setattr("robot_agent.host.zero_request.ask_program", lambda where, in_air: program)
    monkeypatch.setattr("robot_agent.host.zero_request.tell_board", tell)

    def run(config: str, state: Path, *options: str) -> Result:
        requests.clear()
        done = _run("confirm-zero", "--config", config, "--state", str(state), *options)
        assert requests == ([] if program else ["--in-air" in options])
        return done

    return run


def test_a_zero_that_the_program_confirms_is_its_own(monkeypatch: pytest.MonkeyPatch, config: str, tmp_path: Path) -> None:
    run = _zero(monkeypatch, Telemetry(), program=True)
    assert run(config, tmp_path).stdout == "the thruster board's depth zero is confirmed\n"
    assert run(config, tmp_path, "--in-air").stdout == "the thruster board takes its depth zero anew\n"


def test_a_zero_that_was_in_doubt_is_kept_as_confirmed_by_a_board_that_tells_its_depth(
    monkeypatch: pytest.MonkeyPatch, config: str, tmp_path: Path
) -> None:
    doubted = ZeroRecord("one", 10.0, 5.0, 0.8, 0.9)
    write_record(tmp_path, doubted, durable=False)
    silent = _zero(monkeypatch, Telemetry(board_ms=-1, acknowledged=(CALIBRATE, UNSUPPORTED)))(config, tmp_path)
    assert isinstance(silent.exception, ConfigError) and "reports no depth" in str(silent.exception)
    assert read_record(tmp_path) == doubted
    telling = Telemetry(board_ms=0, depth_m=0.25, acknowledged=(CALIBRATE, UNSUPPORTED))
    assert _zero(monkeypatch, telling)(config, tmp_path).exit_code == 0
    record = read_record(tmp_path)
    assert record is not None and (record.zero_m, record.depth_m) == (0.0, 0.25)


@pytest.mark.parametrize(("result", "exit_code"), [(ACCEPTED, 0), (UNSUPPORTED, 1)])
def test_a_board_that_keeps_no_zero_says_so(
    monkeypatch: pytest.MonkeyPatch, config: str, tmp_path: Path, result: int, exit_code: int
) -> None:
    done = _zero(monkeypatch, Telemetry(board_ms=5, acknowledged=(CALIBRATE, result)))(config, tmp_path)
    assert done.exit_code == exit_code and not (tmp_path / FILE).exists()
    assert ("keeps no zero" in str(done.exception)) is bool(exit_code)


# --- check


@pytest.mark.parametrize(("verdicts", "code"), [((OK, WARN, SKIPPED), 0), ((OK, FAIL, OK), 1), ((), 0)])
def test_a_check_fails_where_one_finding_does(
    monkeypatch: pytest.MonkeyPatch, config: str, verdicts: tuple[CheckVerdict, ...], code: int
) -> None:
    lines = [CheckFinding(f"part {k}", verdict, "so it is") for k, verdict in enumerate(verdicts)]
    monkeypatch.setattr("robot_agent.preflight.board.run_preflight", lambda board, turn: iter(lines))
    table, listed = _run("check", "--config", config), _run("check", "--config", config, "--json")
    assert table.exit_code == listed.exit_code == code
    assert [line.split() for line in table.stdout.splitlines()] == [
        ["part", str(k), verdict.value, "so", "it", "is"] for k, verdict in enumerate(verdicts)
    ]
    assert [entry["verdict"] for entry in json.loads(listed.stdout)] == [verdict.name.lower() for verdict in verdicts]


@pytest.mark.parametrize(
    ("options", "answer", "turns"),
    [((), "", False), (("--thrusters",), "n\n", False), (("--thrusters",), "y\n", True), (("--thrusters", "--yes"), "", True)],
)
def test_thrusters_turn_only_where_a_person_said_so(
    monkeypatch: pytest.MonkeyPatch, config: str, options: tuple[str, ...], answer: str, turns: bool
) -> None:
    given: list[object] = []

    def preflight(board: object, turn: object) -> list[CheckFinding]:
        given.append(turn)
        return []

    monkeypatch.setattr("robot_agent.preflight.board.run_preflight", preflight)
    assert _run("check", "--config", config, *options, answer=answer).exit_code == 0
    assert [turn is not None for turn in given] == [turns]


# --- what the findings judge, at their limits

NOW = datetime(2026, 1, 1, tzinfo=UTC)
DAY = timedelta(days=1)


@pytest.mark.parametrize(
    ("starts", "expires", "verdict"),
    [
        (NOW, NOW + EXPIRES_SOON, OK),
        (NOW + timedelta(seconds=1), NOW + EXPIRES_SOON, FAIL),
        (NOW - DAY, NOW + EXPIRES_SOON - timedelta(seconds=1), WARN),
        (NOW - DAY, NOW + timedelta(seconds=1), WARN),
        (NOW - DAY, NOW, FAIL),
    ],
)
def test_a_certificate_is_judged_by_its_period(starts: datetime, expires: datetime, verdict: CheckVerdict) -> None:
    assert findings.certificate("agent-1", starts, expires, NOW).verdict is verdict


def test_clock_code_and_timing_are_judged_at_their_limits() -> None:
    assert [findings.clock(s).verdict for s in (1.0, -1.0, 1.001, -1.001)] == [OK, OK, WARN, WARN]
    assert "ahead of" in findings.clock(0.5).detail and "behind" in findings.clock(-0.5).detail
    assert [findings.same_code(code, "1").verdict for code in ("1", "2", "")] == [OK, WARN, WARN]
    times = ((25.0, 25.0), (25.0, 25.1), (25.1, 25.1))
    assert [findings.timing(p50_ms, p99_ms, 0.05, 1).verdict for p50_ms, p99_ms in times] == [OK, WARN, FAIL]
