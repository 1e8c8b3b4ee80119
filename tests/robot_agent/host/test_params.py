"""`robot-agent params`: what it says of a board's answers."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from pymavlink.dialects.v20 import common as dialect
from typer.testing import CliRunner, Result

from robot_agent.__main__ import cli
from robot_agent.host import params
from robot_agent.host.params import answered_value
from shoal.config.experiment import load_experiment
from shoal.errors import ConfigError
from shoal.mavlink.board_port import Link
from shoal.mavlink.framing import Receiver, Sender
from shoal.mavlink.parameters import STATION, ParameterClient
from shoal.mavlink.signing import SignatureVerifier
from sim_bridge.thruster_board.board import ThrusterBoard
from sim_bridge.thruster_board.board_link import BoardLink
from tests.robot_agent.autopilot import Autopilot

POOL, STILL = load_experiment("pool"), np.zeros(4)


@pytest.mark.parametrize(
    ("code", "says"), [(1, "CMD_AGE_MS: the board has no such parameter"), (3, "CMD_AGE_MS: the board refuses: error 3")]
)
def test_an_error_that_comes_before_the_value_is_told_as_what_it_is(code: int, says: str) -> None:
    """An armed board refuses a change; on a serial line, the end of its answer may come later."""
    board, client = BoardLink(1), ParameterClient(1)
    client.receive(board.heartbeat(armed=True, healthy=True), 0)
    client.set("CMD_AGE_MS", 100.0)
    client.receive(board.parameter_error(STATION, "CMD_AGE_MS", 0, code), 0)
    with pytest.raises(ConfigError) as refused:
        answered_value(client, "CMD_AGE_MS")
    assert str(refused.value) == says


@pytest.mark.parametrize("robot", [1, None])
def test_an_autopilots_parameters_are_left_alone(robot: int | None, monkeypatch: pytest.MonkeyPatch) -> None:
    there = Autopilot(kind=dialect.MAV_AUTOPILOT_PX4)
    monkeypatch.setattr("shoal.mavlink.board_port.open_link", lambda link, secured: there)
    with (
        pytest.raises(ConfigError, match=r"autopilot 12 \(PX4\) is there"),
        params.talk("udp:127.0.0.1:9", robot, None, False),
    ):
        raise AssertionError("a session with an autopilot")
    assert there.received == {"HEARTBEAT"}


# --- the commands, against the board's reference


class BoardInMemory(Link):
    """A thruster board on a link in memory; each wait is a tenth of a second of its time."""

    def __init__(self, silent: bool = False) -> None:
        self.board, self._now_ns, self._data, self._silent = ThrusterBoard(POOL, 1, 1), 0, b"", silent
        self.tells: Callable[[bytes], bytes] = lambda data: data

    def send(self, data: bytes) -> None:
        self.board.receive(data, self._now_ns)

    def wait(self, timeout_s: float) -> None:
        for _ in range(20):
            self._now_ns += 5_000_000
            self._data += self.board.step(self._now_ns, STILL, STILL, STILL)

    def read(self) -> bytes:
        data, self._data = self._data, b""
        return b"" if self._silent else self.tells(data)

    def close(self) -> None: ...


@pytest.fixture
def there(monkeypatch: pytest.MonkeyPatch) -> BoardInMemory:
    board = BoardInMemory()
    monkeypatch.setattr("shoal.mavlink.board_port.open_link", lambda link, secured: board)
    monkeypatch.setattr(params, "WITHIN_S", 0.5)
    monkeypatch.setattr(params, "AGAIN_S", 0.0)
    return board


def _run(*words: str) -> Result:
    return CliRunner().invoke(cli, ["params", *words, *(() if "--" in words else ("--link", "udp:127.0.0.1:9"))])


def _refused(*words: str) -> str:
    done = _run(*words)
    assert isinstance(done.exception, ConfigError), done.output
    return str(done.exception)


def test_all_parameters_are_listed_and_one_is_printed(there: BoardInMemory) -> None:
    lines = [line.split() for line in _run("list").stdout.splitlines()]
    values = dict(zip(there.board.rules.parameters.index, there.board.rules.parameters.values, strict=True))
    assert {name: float(value) for name, value in lines} == {name: pytest.approx(value) for name, value in values.items()}
    assert _run("get", "SLEW_US_S").stdout == "8000\n"
    assert _refused("get", "NOTHING") == "NOTHING: the board has no such parameter"
    for name in ("", "A" * 17, "A B", "Ä"):
        assert "no parameter's name" in _refused("get", name)


def test_a_list_that_breaks_off_is_told(there: BoardInMemory) -> None:
    receiver = Receiver(lambda peer: True, SignatureVerifier(None))
    sender = Sender((1, 1))

    def without_the_last(data: bytes) -> bytes:
        messages = [m for m in receiver.receive(data, 0) if m.get_type() != "PARAM_VALUE" or m.param_index < 10]
        return b"".join(map(sender.pack, messages))

    there.tells = without_the_last
    assert _refused("list").endswith("the board told 10 parameters, and then no more")


def test_a_value_is_set_or_refused_with_the_boards_reason(there: BoardInMemory) -> None:
    assert _run("set", "THR1_TRIM_US", "12").stdout == "THR1_TRIM_US = 12\n"
    assert there.board.rules.parameters["THR1_TRIM_US"] == 12.0
    refused = _refused("set", "THR1_TRIM_US", "9999")
    assert refused.startswith("THR1_TRIM_US is still 12: THR1_TRIM_US: ")
    assert "no value for a parameter" in _refused("set", "THR1_TRIM_US", "3.5e38")
    assert "no such parameter" in _refused("set", "NOTHING", "1")
    assert _run("set", "THR1_TRIM_US", "--link", "udp:127.0.0.1:9", "--", "-3").stdout == "THR1_TRIM_US = -3\n"


def test_a_key_is_given_once_and_a_board_that_takes_none_says_why(
    there: BoardInMemory, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    key, other = tmp_path / "one.key", tmp_path / "two.key"
    for file in (key, other):
        assert CliRunner().invoke(cli, ["link-key", str(file)]).exit_code == 0
    with monkeypatch.context() as armed:  # by somebody else: this end sends no pulses that would keep it so
        armed.setattr(there.board.rules, "set_key", lambda key, newest: "armed")
        assert _refused("give-key", str(key)) == "--link udp:127.0.0.1:9: no new key: armed" and not there.board.signed
    assert _run("give-key", str(key)).stdout == f"robot 1: the link is signed with {key}\n"
    assert there.board.signed
    assert "signs (--link-key FILE)" in _refused("get", "SLEW_US_S")
    assert _run("get", "SLEW_US_S", "--link-key", str(key)).stdout == "8000\n"
    assert "signs with another key" in _refused("get", "SLEW_US_S", "--link-key", str(other))


def _without_values(data: bytes) -> bytes:
    """The frames of a board, whole as they are, but for its PARAM_VALUE."""
    kept, at = b"", 0
    while at < len(data):
        end = at + 12 + data[at + 1] + (13 if data[at + 2] & 1 else 0)
        kept += b"" if int.from_bytes(data[at + 7 : at + 10], "little") == 22 else data[at:end]
        at = end
    return kept


def test_a_board_that_does_not_answer_to_its_new_key_is_told(there: BoardInMemory, tmp_path: Path) -> None:
    key = tmp_path / "one.key"
    assert CliRunner().invoke(cli, ["link-key", str(key)]).exit_code == 0
    there.tells = _without_values
    assert _refused("give-key", str(key)) == "--link udp:127.0.0.1:9: the board does not answer to the key"


def test_a_link_without_a_board_and_one_of_another_robot_are_told(
    monkeypatch: pytest.MonkeyPatch, there: BoardInMemory
) -> None:
    assert "heard: the board of robot 1, not that of robot 2" in _refused("list", "--robot", "2")
    monkeypatch.setattr("shoal.mavlink.board_port.open_link", lambda link, secured: BoardInMemory(silent=True))
    assert "no board is heard (is it powered?)" in _refused("list")
