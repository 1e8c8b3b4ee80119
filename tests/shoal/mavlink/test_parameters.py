"""Parameters of a board, as a program beside the robot's asks for them."""

from shoal.mavlink.parameters import DOES_NOT_EXIST, STATION, ParameterClient
from sim_bridge.thruster_board.board_link import BoardLink


def test_a_late_error_is_not_about_the_parameter_that_was_asked_for_since() -> None:
    board, client = BoardLink(1), ParameterClient(1)
    client.ask("FIRST")
    client.ask("SECOND")
    client.receive(board.parameter_error(STATION, "FIRST", -1, DOES_NOT_EXIST), 0)
    assert client.error is None
    client.receive(board.parameter_error(STATION, "SECOND", -1, DOES_NOT_EXIST), 0)
    assert client.error == ("SECOND", DOES_NOT_EXIST)
