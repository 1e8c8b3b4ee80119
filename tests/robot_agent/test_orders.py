"""Which orders count: young, from the station that is heard, for this robot and this experiment."""

import pytest

from robot_agent.orders import StationView, unacceptable
from wire.codec import Header
from wire.messages import Command, Order

HASH = "ab" * 32
STATION = StationView(session=7, clock_ns=10_000_000_000, age_s=0.03)


def order(kind: Order = Order.ARM, robot: int = 1, experiment_hash: str = HASH) -> Command:
    return Command(kind, robot, experiment_hash=experiment_hash)


def header(sequence: int = 1, session: int = 7, age_s: float = 0.01) -> Header:
    return Header(session, sequence, STATION.clock_ns - round(age_s * 1e9))


def test_an_order_that_counts_is_taken() -> None:
    assert unacceptable(1, HASH, header(), order(), STATION) == ""


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
    assert says in unacceptable(1, HASH, head, command, station)


def test_power_can_be_taken_away_whatever_the_experiment() -> None:
    for kind in (Order.STOP, Order.DISARM):
        assert unacceptable(1, HASH, header(), order(kind, experiment_hash=""), STATION) == ""
