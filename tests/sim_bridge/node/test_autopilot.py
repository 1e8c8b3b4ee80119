"""An autopilot where a thruster board belongs: no command of the simulator sends it a command, a pulse or a parameter."""

from collections.abc import Callable

import pytest
from pymavlink.dialects.v20 import common as dialect
from typer.testing import CliRunner

from shoal.errors import ConfigError
from shoal.mavlink import board_port
from shoal.mavlink.board_port import Link
from sim_bridge.__main__ import cli
from sim_bridge.node import hil_board
from tests.robot_agent.autopilot import Autopilot

PLACE = "udp:127.0.0.1:9"


def _conformance() -> None:
    done = CliRunner().invoke(cli, ["board-conformance", "--port", PLACE, "--yes"])
    assert done.exception is not None
    raise done.exception


def _hil() -> None:
    hil_board.connect(1, PLACE, None, insecure=False)


@pytest.mark.parametrize("command", [_conformance, _hil])
def test_an_autopilot_is_left_alone(command: Callable[[], None], monkeypatch: pytest.MonkeyPatch) -> None:
    there = Autopilot(kind=dialect.MAV_AUTOPILOT_PX4)

    def opened(place: str, secured: bool = False, option: str = "") -> Link:
        return there

    for module in (board_port, hil_board):
        monkeypatch.setattr(module, "open_link", opened)
    with pytest.raises(ConfigError, match=rf"{PLACE}: autopilot 12 \(PX4\) is there, no thruster board"):
        command()
    assert there.received <= {"HEARTBEAT", "PARAM_REQUEST_READ"}  # which ask who is there, and move nothing
