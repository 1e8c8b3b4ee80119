"""Which orders count: once, young, from the station that is heard, for this robot and this experiment."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from robot_agent.orders import OrderGate, StationView
from wire.codec import Header
from wire.messages import Command, Mode, Order

HASH = "ab" * 32
STATION = StationView(session=7, clock_ns=10_000_000_000, age_s=0.03)


def order(kind: Order = Order.ARM, robot: int = 1, experiment_hash: str = HASH) -> Command:
    return Command(kind, robot, experiment_hash=experiment_hash)


def header(sequence: int = 1, session: int = 7, age_s: float = 0.01) -> Header:
    return Header(session, sequence, STATION.clock_ns - round(age_s * 1e9))


def test_an_order_is_taken_once_and_a_repeat_gets_the_same_answer() -> None:
    gate = OrderGate(1, HASH)
    assert gate.repeated(header()) is None
    assert gate.refusal(header(), order(), STATION) == ""
    reply = gate.take(header(), True, "", Mode.ARMED)
    assert gate.repeated(header()) is reply
    assert "is old" in gate.refusal(header(), order(), STATION)
    assert gate.refusal(header(2), order(), STATION) == ""


@pytest.mark.parametrize(
    ("head", "command", "station", "says"),
    [
        (header(), order(robot=2), STATION, "for robot 2"),
        (header(session=8), order(), STATION, "not come from the station"),
        (header(age_s=1.1), order(), STATION, "1.100 s old, lives 1 s"),
        (header(age_s=-0.6), order(), STATION, "old"),
        (header(), order(experiment_hash="cd" * 32), STATION, "experiment cdcdcdcd, this robot holds abababab"),
        (header(), order(), StationView(), "not come from the station"),
    ],
)
def test_what_does_not_count_is_refused_with_the_reason(
    head: Header, command: Command, station: StationView, says: str
) -> None:
    assert says in OrderGate(1, HASH).refusal(head, command, station)


def test_power_can_be_taken_away_whatever_the_experiment() -> None:
    for kind in (Order.STOP, Order.DISARM):
        assert OrderGate(1, HASH).refusal(header(), order(kind, experiment_hash=""), STATION) == ""


@given(st.lists(st.integers(1, 20), max_size=40))
def test_however_orders_are_repeated_and_reordered_each_is_taken_at_most_once_and_in_order(sequences: list[int]) -> None:
    gate = OrderGate(1, HASH)
    taken = []
    for sequence in sequences:
        if gate.repeated(header(sequence)) is None and not gate.refusal(header(sequence), order(), STATION):
            gate.take(header(sequence), True, "", Mode.ARMED)
            taken.append(sequence)
    assert taken == sorted(set(taken))


def test_recorded_traffic_is_refused_in_the_session_and_after_a_restart_of_either_side() -> None:
    recorded = [(header(n), order()) for n in (1, 2, 3)]
    gate = OrderGate(1, HASH)
    for head, command in recorded:
        assert gate.refusal(head, command, STATION) == ""
        gate.take(head, True, "", Mode.ARMED)
    later = StationView(7, STATION.clock_ns + 5_000_000_000, 0.03)
    restarted_robot = OrderGate(1, HASH)
    restarted_station = StationView(9, later.clock_ns, 0.03)
    for head, command in recorded:
        assert gate.refusal(head, command, later)
        assert "lives" in restarted_robot.refusal(head, command, later)
        assert "not come from the station" in gate.refusal(head, command, restarted_station)
