"""A thruster test against boards that echo, and boards that do not do as told."""

import pytest

from robot_agent.safety.thruster_selftest import PUSH_S, REST_S, ThrusterSelftest
from shoal.config.experiment import load_experiment

VEHICLE = load_experiment("pool").vehicle
NEUTRAL: tuple[int, ...] = (1500,) * 8
STEP_NS = 50_000_000


def run(
    echo: "dict[int, int] | None" = None, armed_from_ns: int = 0, silent: bool = False
) -> tuple[str, list[tuple[int, ...]]]:
    """Result and all pulses; the board echoes the last pulses, with `echo` {thruster: what it puts out instead}."""
    test, sent = ThrusterSelftest(VEHICLE, NEUTRAL), [NEUTRAL]
    for step in range(round(4 * (PUSH_S + REST_S) / 0.05) + 20):
        echo_us = list(sent[-1])
        for thruster, pulse in (echo or {}).items():
            echo_us[thruster] = pulse
        now_ns = step * STEP_NS
        sent.append(test.step(now_ns >= armed_from_ns, () if silent else echo_us, now_ns))
    return test.result, sent


def test_a_board_that_does_as_told_passes_and_one_thruster_pushes_at_a_time() -> None:
    result, sent = run()
    assert result == "passed"
    moved = [{k for k in range(4) if pulses[k] != 1500} for pulses in sent]
    assert [next(iter(m)) for m in moved if m] == sorted(next(iter(m)) for m in moved if m)
    assert set().union(*moved) == {0, 1, 2, 3} and max(map(len, moved)) == 1
    assert all(pulses[4:] == NEUTRAL[4:] for pulses in sent) and sent[-1] == NEUTRAL


@pytest.mark.parametrize(("echo", "says"), [({2: 1500}, "thruster 3 was asked for"), ({0: 1900}, "thruster 1 was asked for")])
def test_a_thruster_that_stays_or_runs_is_named(echo: dict[int, int], says: str) -> None:
    assert says in run(echo)[0]


@pytest.mark.parametrize(
    ("echo", "result", "turned"),
    [
        ({3: 1900}, "thruster 4 was asked for 1500 us, the board says 1900", {0}),
        ({0: 1900}, "thruster 1 was asked for 1540 us, the board says 1900", {0}),
        ({1: 1460}, "thruster 2 was asked for 1500 us, the board says 1460", {0}),
    ],
)
def test_a_thruster_that_runs_wild_ends_the_test_and_is_the_only_one_named(
    echo: dict[int, int], result: str, turned: set[int]
) -> None:
    """It may stand beside a person: the station disarms as soon as there is a result."""
    result_text, sent = run(echo)
    push_us = max(max(pulses[:4]) for pulses in sent)
    assert result_text == result.replace("1540", str(push_us))
    assert {k for pulses in sent for k in range(4) if pulses[k] != 1500} == turned
    assert sum(pulses != NEUTRAL for pulses in sent) <= 6  # 0.3 s


def test_a_board_that_says_nothing_fails_every_thruster() -> None:
    assert run(silent=True)[0].count("the board says nothing") == 4


def test_nothing_moves_before_the_board_is_armed() -> None:
    _, sent = run(armed_from_ns=STEP_NS * 10)
    assert all(pulses == NEUTRAL for pulses in sent[:11]) and sent[11] != NEUTRAL
