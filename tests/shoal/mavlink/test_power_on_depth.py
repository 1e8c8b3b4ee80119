"""Restarts of a board, from the times and depths that it reports."""

import pytest

from shoal.mavlink.agent_link import AgentLink
from shoal.mavlink.power_on_depth import MS_WRAPS, PowerOnDepth
from sim_bridge.thruster_board.board_link import BoardLink


def told(*bursts: tuple[int, float]) -> PowerOnDepth:
    power_on = PowerOnDepth()
    for board_ms, depth_m in bursts:
        power_on.note_burst(board_ms, depth_m)
    return power_on


def test_a_board_that_restarts_under_water_has_its_zero_there() -> None:
    assert told((5000, 0.0), (9000, 0.3), (20, 0.0), (40, 0.0)).depth_m == 0.3


def test_a_board_that_restarts_in_air_after_that_has_a_right_zero_again() -> None:
    lifted = (9000, -0.3)  # by the wrong zero
    assert told((9000, 0.3), (20, 0.0), (40, 0.0), lifted, (20, 0.0), (40, 0.0)).depth_m == 0.0


def test_a_second_restart_deeper_adds_up() -> None:
    assert told((9000, 0.25), (20, 0.0), (40, 0.0), (60, 0.5), (10, 0.0), (30, 0.0)).depth_m == 0.75


def test_one_earlier_time_and_the_clocks_wrap_are_no_restart() -> None:
    assert told((9000, 0.3), (20, 0.0), (9050, 0.3), (9100, 0.3)).depth_m == 0.0
    assert told((MS_WRAPS - 20, 0.3), (10, 0.3), (30, 0.3)).depth_m == 0.0


def test_the_link_reports_where_a_board_was_switched_on() -> None:
    link, board = AgentLink(1), BoardLink(1)
    for board_ms, depth_m in ((9000, 0.2), (9050, 0.2), (20, 0.0), (40, 0.0)):
        link.receive(board.pressure(board_ms, depth_m) + board.attitude(board_ms, 0.0, 0.0), 0)
    assert link.telemetry.power_on_depth_m == pytest.approx(0.2, abs=1e-3)


def test_nothing_is_guessed_about_a_board_that_reports_how_its_lives_begin() -> None:
    power_on = told((9000, 1.5), (20, 0.0), (40, 0.0))
    assert power_on.depth_m == 1.5
    power_on.note_start_report()
    assert power_on.depth_m == 0.0
    power_on.note_burst(20, 1.5)
    power_on.note_burst(40, 1.5)
    assert power_on.depth_m == 0.0


def test_a_depth_that_was_set_stays_until_the_next_restart() -> None:
    power_on = told((9000, 0.0))
    power_on.set_depth(0.4)
    power_on.note_burst(9020, 0.1)
    assert power_on.depth_m == 0.4


def test_the_link_reports_how_the_boards_life_began() -> None:
    link, board = AgentLink(1), BoardLink(1)
    link.receive(board.heartbeat(armed=False, healthy=True, status=0x30A), 0)
    seen = link.telemetry
    assert seen.reset_causes == ("reset pin", "watchdog") and seen.restarted and seen.zero_in_question
    for board_ms, depth_m in ((9000, 0.2), (9050, 0.2), (20, 0.2), (40, 0.2)):
        link.receive(board.pressure(board_ms, depth_m) + board.attitude(board_ms, 0.0, 0.0), 0)
    assert link.telemetry.power_on_depth_m == 0.0
    link.receive(board.heartbeat(armed=False, healthy=True), 0)
    seen = link.telemetry
    assert seen.reset_causes == ("power-on",) and not seen.restarted and not seen.zero_in_question
