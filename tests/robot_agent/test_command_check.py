"""Which orders count: young, from the station that is heard, for this robot and this experiment."""

import pytest

from robot_agent.agent import LONGEST_LIFE_S, unacceptable
from robot_agent.inputs import StationView
from shoal.messages.codec import Header
from shoal.messages.messages import Command, CommandKind

HASH = "ab" * 32
STATION = StationView(session=7, clock_ns=10_000_000_000, age_s=0.03)


def order(kind: CommandKind = CommandKind.ARM, robot: int = 1, experiment_hash: str = HASH) -> Command:
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
def test_unacceptable_command_is_refused_with_the_reason(
    head: Header, command: Command, station: StationView, says: str
) -> None:
    assert says in unacceptable(1, HASH, head, command, station)


@pytest.mark.parametrize("kind", [CommandKind.STOP, CommandKind.DISARM])
@pytest.mark.parametrize(
    ("head", "station"),
    [
        (header(session=8), STATION),
        (header(age_s=1e6), STATION),
        (header(age_s=-1e6), STATION),
        (header(), StationView()),
        (header(session=8, age_s=99.0), StationView(9, 0, 20.0)),
    ],
    ids=["another station", "old", "from the future", "no station", "all of it"],
)
def test_power_can_be_taken_away_by_whoever_may_command_at_any_time(
    kind: CommandKind, head: Header, station: StationView
) -> None:
    assert unacceptable(1, HASH, head, order(kind, experiment_hash="cd" * 32), station) == ""
    assert "for robot 2" in unacceptable(1, HASH, head, order(kind, robot=2), station)


def test_no_order_lives_longer_than_the_robot_grants_whatever_its_sender_says() -> None:
    eternal = Command(CommandKind.START, 1, time_to_live_s=1e9, experiment_hash=HASH)
    assert unacceptable(1, HASH, header(age_s=LONGEST_LIFE_S - 0.001), eternal, STATION) == ""
    assert "5.001 s old, lives 5 s" in unacceptable(1, HASH, header(age_s=LONGEST_LIFE_S + 0.001), eternal, STATION)
