"""The tables of modes against the requirements they stand for."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from robot_agent.safety.modes import LIVE, ORDERS, POWERED, REACTIONS, Health, react, refusal, table
from shoal.config.experiment import load_experiment
from shoal.messages.messages import CommandKind, Mode

EXPERIMENT = load_experiment("pool")
SAFETY = EXPERIMENT.safety
WELL = Health(0.03, 0.03, 0.02, 0.02, 0.0, False, False, False)

healths = st.builds(
    Health,
    pose_age_s=st.floats(0, 20) | st.just(float("inf")),
    identity_age_s=st.floats(0, 20) | st.just(float("inf")),
    station_age_s=st.floats(0, 20) | st.just(float("inf")),
    board_age_s=st.floats(0, 20) | st.just(float("inf")),
    board_disarmed_s=st.floats(0, 5),
    battery_empty=st.booleans(),
    emergency_stop=st.booleans(),
    solver_failed=st.booleans(),
)


def after(mode: Mode, **change: object) -> Mode:
    return react(mode, WELL._replace(**change), SAFETY)[0]  # type: ignore[arg-type]


@pytest.mark.parametrize("mode", list(Mode))
def test_nothing_happens_while_all_is_well(mode: Mode) -> None:
    assert react(mode, WELL, SAFETY) == (mode, "")


def test_a_late_pose_means_hold_and_a_missing_one_neutral() -> None:
    assert after(Mode.TRACKING, pose_age_s=0.19) is Mode.TRACKING
    assert after(Mode.TRACKING, pose_age_s=0.21) is Mode.HOLDING
    assert after(Mode.HOLDING, pose_age_s=0.21) is Mode.HOLDING
    assert after(Mode.HOLDING, pose_age_s=0.46) is Mode.FAULT
    assert after(Mode.TRACKING, pose_age_s=0.46) is Mode.FAULT
    assert after(Mode.ARMED, pose_age_s=5.0) is Mode.ARMED  # puts out no thrust


def test_a_robot_that_may_be_another_holds() -> None:
    assert after(Mode.TRACKING, identity_age_s=0.24) is Mode.TRACKING
    assert after(Mode.TRACKING, identity_age_s=0.26) is Mode.HOLDING
    assert after(Mode.HOLDING, identity_age_s=9.0) is Mode.HOLDING


def test_where_older_poses_are_good_enough_a_robot_does_not_hold_for_doubt_of_a_pose_that_is_not_late() -> None:
    safety = load_experiment("pool", ["safety.pose_hold_s=0.4"]).safety
    for age_s, wanted in ((0.39, (Mode.TRACKING, "")), (0.41, (Mode.HOLDING, "pose late"))):
        assert react(Mode.TRACKING, WELL._replace(pose_age_s=age_s, identity_age_s=age_s), safety) == wanted
    assert react(Mode.TRACKING, WELL._replace(identity_age_s=0.41), safety) == (Mode.HOLDING, "identity in doubt")


def test_a_silent_station_means_hold_after_1_s_neutral_after_3_disarmed_after_10() -> None:
    assert after(Mode.TRACKING, station_age_s=0.9) is Mode.TRACKING
    assert after(Mode.TRACKING, station_age_s=1.1) is Mode.HOLDING
    assert after(Mode.HOLDING, station_age_s=2.9) is Mode.HOLDING
    assert after(Mode.HOLDING, station_age_s=3.1) is Mode.FAULT
    assert after(Mode.FAULT, station_age_s=10.1) is Mode.DISARMED


@pytest.mark.parametrize("mode", sorted(LIVE))
def test_a_silent_board_an_empty_battery_and_a_disarmed_board_are_faults(mode: Mode) -> None:
    assert after(mode, board_age_s=0.31) is Mode.FAULT
    assert after(mode, battery_empty=True) is Mode.FAULT
    assert after(mode, board_disarmed_s=1.6) is Mode.FAULT


@given(st.sampled_from(Mode), healths)
def test_no_reaction_ever_leads_towards_thrust(mode: Mode, health: Health) -> None:
    to, reason = react(mode, health, SAFETY)
    assert (to is mode) == (reason == "")
    if mode not in POWERED:
        assert to not in POWERED
    if mode not in LIVE:
        assert to not in LIVE
    if health.emergency_stop:
        assert to is Mode.STOPPED


@pytest.mark.long
@given(st.lists(healths, min_size=1, max_size=20))
def test_a_stop_is_latched_through_anything_that_happens(run: list[Health]) -> None:
    mode = Mode.STOPPED
    for health in run:
        mode, _ = react(mode, health, SAFETY)
    assert mode is Mode.STOPPED
    for order in CommandKind:
        if order not in (CommandKind.CLEAR_STOP, CommandKind.STOP):
            assert refusal(order, mode) != ""


def test_only_start_resume_hold_and_drive_lead_to_thrust_and_only_from_a_live_mode() -> None:
    for order, transition in ORDERS.items():
        if transition.to in POWERED:
            assert order in (CommandKind.START, CommandKind.RESUME, CommandKind.HOLD, CommandKind.DRIVE)
            assert transition.accepted_in <= LIVE


def test_a_refusal_names_the_modes_that_would_do() -> None:
    assert refusal(CommandKind.ARM, Mode.DISARMED) == ""
    assert refusal(CommandKind.ARM, Mode.TRACKING) == "ARM is not accepted when TRACKING (only when DISARMED)"
    assert "allowed" in refusal(CommandKind.NONE, Mode.DISARMED)


def test_every_transition_is_in_the_table_of_the_docs() -> None:
    assert all(order.name in table() for order in ORDERS)
    assert all(reaction.reason in table() for reaction in REACTIONS)
