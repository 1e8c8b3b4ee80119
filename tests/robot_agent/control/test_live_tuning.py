"""Gains changed in flight: refusals, and which set counts from which instant."""

from dataclasses import replace

import pytest

from robot_agent.control.any_controller import make_controller
from robot_agent.control.controller import Setting
from robot_agent.control.live_tuning import LiveTuning
from shoal.config.controller import ControllerConfig
from shoal.config.experiment import load_experiment
from shoal.messages.live_gains import tuned, tuning
from shoal.messages.messages import Command, CommandKind

POOL = load_experiment("pool")
KEY = tuning(POOL.controller).keys[0]


def other_gains(factor: float) -> ControllerConfig:
    gains = tuning(POOL.controller)
    return tuned(POOL.controller, {KEY: factor * float(gains.values[0])})


def tune(factor: float) -> Command:
    return Command(CommandKind.TUNE, 1, tuning=tuning(other_gains(factor)))


def adopt(factor: float, start_in_s: float = 0.0) -> Command:
    return Command(CommandKind.ADOPT, 1, tuning_id=tuning(other_gains(factor)).id, start_in_s=start_in_s)


@pytest.fixture
def gains() -> LiveTuning:
    return LiveTuning(make_controller(Setting(POOL.vehicle, POOL.controller, POOL.safety)), POOL.controller)


def give(gains: LiveTuning, command: Command) -> str:
    """Give a command as the agent does; returns the reason of a refusal."""
    prepared = gains.prepare(command)
    reason = gains.objection(command, prepared)
    if not reason:
        gains.apply(command, prepared, given_ns=0)
    return reason


def test_tune_without_gains_is_refused(gains: LiveTuning) -> None:
    assert give(gains, replace(tune(1.1), tuning=None)) == "carries no gains"


def test_adopt_of_a_set_that_is_not_prepared_is_refused(gains: LiveTuning) -> None:
    """Such a robot would fly with other gains than the fleet."""
    assert "is not ready" in give(gains, adopt(1.1)) and "ready: none" in give(gains, adopt(1.1))
    assert give(gains, tune(1.2)) == ""
    assert f"ready: {tuning(other_gains(1.2)).id}" in give(gains, adopt(1.1))
    flown = gains.id
    gains.step(10**12, 10**6)
    assert gains.id == flown


def test_adopt_of_the_prepared_set_counts_from_its_instant(gains: LiveTuning) -> None:
    assert give(gains, tune(1.1)) == "" and give(gains, adopt(1.1, start_in_s=2.0)) == ""
    gains.step(1_999_999_999, 0.0)
    assert gains.id == tuning(POOL.controller).id
    gains.step(2_000_000_000, 0.0)
    assert gains.id == tuning(other_gains(1.1)).id


def test_adopt_of_the_flown_set_takes_back_one_that_waits(gains: LiveTuning) -> None:
    assert give(gains, tune(1.1)) == "" and give(gains, adopt(1.1, start_in_s=2.0)) == ""
    assert give(gains, adopt(1.0)) == ""
    gains.step(10**12, 10**6)
    assert gains.id == tuning(POOL.controller).id


def test_a_set_that_is_prepared_while_another_one_waits_stays_ready(gains: LiveTuning) -> None:
    """Of two people who change gains, or of one who does so again during the lead."""
    assert give(gains, tune(1.1)) == "" and give(gains, adopt(1.1, start_in_s=2.0)) == ""
    assert give(gains, tune(1.2)) == ""
    gains.step(2_000_000_000, 0.0)
    assert gains.id == tuning(other_gains(1.1)).id
    assert give(gains, adopt(1.2)) == ""
    gains.step(2_000_000_000, 0.0)
    assert gains.id == tuning(other_gains(1.2)).id
