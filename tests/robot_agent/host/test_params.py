"""`robot-agent params`: what it says of a board's answers."""

import pytest
from pymavlink.dialects.v20 import common as dialect

from robot_agent.host import params
from robot_agent.host.params import answered_value
from shoal.errors import ConfigError
from shoal.mavlink.parameters import STATION, ParameterClient
from sim_bridge.thruster_board.board_link import BoardLink
from tests.robot_agent.autopilot import Autopilot


@pytest.mark.parametrize(
    ("code", "says"), [(1, "CMD_AGE_MS: the board has no such parameter"), (3, "CMD_AGE_MS: the board refuses: error 3")]
)
def test_an_error_that_comes_before_the_value_is_told_as_what_it_is(code: int, says: str) -> None:
    """An armed board refuses a change; on a serial line, the end of its answer may come later."""
    board, client = BoardLink(1), ParameterClient(1)
    client.receive(board.heartbeat(armed=True, healthy=True), 0)
    client.receive(board.parameter_error(STATION, "CMD_AGE_MS", 0, code), 0)
    with pytest.raises(ConfigError) as refused:
        answered_value(client, "CMD_AGE_MS")
    assert str(refused.value) == says


@pytest.mark.parametrize("robot", [1, None])
def test_an_autopilots_parameters_are_left_alone(robot: int | None, monkeypatch: pytest.MonkeyPatch) -> None:
    there = Autopilot(kind=dialect.MAV_AUTOPILOT_PX4)
    monkeypatch.setattr(params, "open_link", lambda link, secured: there)
    with (
        pytest.raises(ConfigError, match=r"autopilot 12 \(PX4\) is there"),
        params.talk("udp:127.0.0.1:9", robot, None, False),
    ):
        raise AssertionError("a session with an autopilot")
    assert there.received == {"HEARTBEAT"}
