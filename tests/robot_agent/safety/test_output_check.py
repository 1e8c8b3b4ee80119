"""The echo check against what boards do, and against a board of the simulator."""

from dataclasses import replace

import numpy as np
import pytest

from robot_agent.safety.output_check import OutputCheck
from shoal.config.experiment import load_experiment
from shoal.mavlink.agent_link import AgentLink
from shoal.messages.messages import BoardReading
from sim_bridge.thruster_board.board import ThrusterBoard

MS = 1_000_000
STILL = (1500,) * 8
AHEAD = (1600, 1600, 1600, 1600, 1500, 1500, 1500, 1500)


def wrong_s(check: OutputCheck, board: BoardReading, now_ns: int) -> float:
    """After a step that has looked at this reading."""
    check.note_board(board, now_ns)
    return check.wrong_s


def said(echo_us: tuple[int, ...], at_ns: int, armed: bool = True) -> BoardReading:
    return replace(BoardReading(), board_ms=at_ns // MS, arrival_ns=at_ns, echo_us=echo_us, armed=armed)


def test_an_echo_between_two_commands_is_on_its_way() -> None:
    check = OutputCheck(4)
    check.note_pulses(STILL, 0)
    check.note_pulses(AHEAD, 1000 * MS)
    for at_ms, thruster_us, is_right in ((1020, 1540, True), (1300, 1500, True), (1360, 1500, False), (1360, 1604, True)):
        echo = (thruster_us,) * 4 + (1500,) * 4
        check.note_pulses(AHEAD, at_ms * MS)
        before_s = wrong_s(check, said(AHEAD, at_ms * MS), (at_ms - 1) * MS)
        assert (wrong_s(check, said(echo, at_ms * MS), at_ms * MS) == before_s) is is_right, at_ms


@pytest.mark.parametrize("output", range(8))
def test_one_output_that_is_wrong_is_enough_and_a_right_echo_now_and_then_excuses_nothing(output: int) -> None:
    check = OutputCheck(4)
    check.note_pulses(STILL, 0)
    wrong = (*STILL[:output], 1506, *STILL[output + 1 :])
    durations_s = []
    for k, echo in enumerate((STILL, wrong, wrong, STILL, wrong, STILL)):
        at_ns = (500 + 50 * k) * MS
        durations_s.append(wrong_s(check, said(echo, at_ns), at_ns))
    assert durations_s == pytest.approx([0.0, 0.05, 0.1, 0.1, 0.15, 0.15])
    assert wrong_s(check, said(STILL, 1900 * MS), 1900 * MS) == 0.0, "long ago"


def test_a_pause_of_the_robots_computer_is_no_long_disobedience() -> None:
    check = OutputCheck(4)
    check.note_pulses(STILL, 0)
    assert wrong_s(check, said(AHEAD, 5000 * MS), 5000 * MS) <= 0.1


def test_outputs_that_change_places_are_found_though_each_was_told_the_others_pulse_a_moment_ago() -> None:
    """As the front legs' pulses swing against one another, each stays where it has been; the rear legs' give it away."""
    for is_crossed in (False, True):
        check, pulses_us = OutputCheck(4), [STILL]
        for k in range(1, 60):
            swing = round(30.0 * np.sin(0.5 * k))
            pulses_us.append((1550 + swing, 1550 - swing, 1450 + swing, 1450 - swing, *STILL[4:]))
            check.note_pulses(pulses_us[-1], k * 50 * MS)
            one, other, *rest = pulses_us[-2]
            found_s = wrong_s(check, said((other, one, *rest) if is_crossed else pulses_us[-2], k * 50 * MS), k * 50 * MS)
        assert found_s > 0.2 if is_crossed else found_s == 0.0


def test_a_board_that_is_disarmed_or_silent_about_it_is_not_wrong() -> None:
    check = OutputCheck(4)
    check.note_pulses(AHEAD, 0)
    for telemetry in (said(STILL, 900 * MS, armed=False), said((), 900 * MS)):
        assert wrong_s(check, telemetry, 900 * MS) == wrong_s(check, telemetry, 2000 * MS) == 0.0


@pytest.mark.parametrize(("swapped", "every_ms"), [(False, 50), (False, 1000), (True, 1000)])
def test_a_real_board_is_right_whatever_it_is_told_and_wrong_with_crossed_outputs(swapped: bool, every_ms: int) -> None:
    experiment = load_experiment("pool")
    board, link, check, random = ThrusterBoard(experiment, 1, 1), AgentLink(1), OutputCheck(4), np.random.default_rng(1)
    worst_s, pulse_us = 0.0, STILL
    for step_ms in range(5, 10_000, 5):
        now_ns = step_ms * MS
        if step_ms % 50 == 0:
            link.receive(b"", now_ns)
            worst_s = max(worst_s, wrong_s(check, link.telemetry, now_ns))
            if step_ms > 500 and step_ms % every_ms == 0:
                pulse_us = (*random.integers(1100, 1901, 4).tolist(), *random.integers(1000, 2001, 4).tolist())
            sent = (pulse_us[1], pulse_us[0], *pulse_us[2:]) if swapped else pulse_us
            board.receive(link.pulses(sent) + (b"" if link.telemetry.armed else link.arm(True)), now_ns)
            check.note_pulses(pulse_us, now_ns)
        link.receive(board.step(now_ns, np.zeros(4), np.zeros(4), np.zeros(4)), now_ns)
    assert link.telemetry.armed
    assert worst_s > 0.2 if swapped else worst_s == 0.0
