"""Each reason against a request, one at a time: with it the request is refused for it alone, and without it there is none."""

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from groundstation.mission.objections import OBJECTIONS, RequestContext, fit_to_rejoin, objection, unfit_to_return
from groundstation.mission.roster import TAKEN_OUT, Leader, Roster
from groundstation.mission.state_machine import MissionState
from groundstation.planning.segment import PlanSegment
from groundstation.telemetry import RobotView
from shoal.config.experiment import dump_flight, load_experiment
from shoal.messages.messages import CommandKind, Mode, Trajectory
from tests.groundstation.mission.mission_run import ObedientRobot

WAY = 'path={kind="waypoints", points_m=[[-1, 0], [1, 0]], speed_mps=0.1}'
POOL, WAYPOINTS = load_experiment("pool"), load_experiment("pool", [WAY])
DIVING = load_experiment("pool", [WAY.replace("speed_mps", "dive_mps=0.01, speed_mps")])
APART = load_experiment("pool", ['robots.1.path={kind="circle", diameter_m=0.5, lap_s=60.0, depth_m=0.3}'])
X, Y = POOL.pool.size_m[0] / 2, POOL.pool.size_m[1] / 2
TWO = np.zeros((2, 4))
TRAJECTORIES = {r: Trajectory(f"t{r}", 0.05, TWO, TWO, TWO) for r in (1, 2)}
SEGMENT = PlanSegment(TRAJECTORIES, TRAJECTORIES[1], 10.0)
HOME = replace(SEGMENT, is_return=True)
STARTS = dict.fromkeys((1, 2), np.zeros(4))
K, S = CommandKind, MissionState

# of each request: the mission's state, and the robots' mode, in which nothing speaks against it
SOUND: dict[CommandKind, tuple[MissionState, Mode]] = {
    K.LOAD: (S.WAITING, Mode.DISARMED),
    K.ARM: (S.WAITING, Mode.DISARMED),
    K.START: (S.WAITING, Mode.DISARMED),
    K.TEST: (S.WAITING, Mode.DISARMED),
    K.RESUME: (S.PAUSED, Mode.HOLDING),
    K.CLEAR_STOP: (S.STOPPED, Mode.STOPPED),
    K.HOLD: (S.RUNNING, Mode.TRACKING),
    K.GO: (S.RUNNING, Mode.TRACKING),
    K.FORMATION: (S.RUNNING, Mode.TRACKING),
    K.PATH: (S.PAUSED, Mode.HOLDING),
    K.REJOIN: (S.PAUSED, Mode.HOLDING),
    K.RETURN: (S.PAUSED, Mode.HOLDING),
}


def _fresh(view: RobotView) -> RobotView:
    """The view of a robot that has just had a pose."""
    state = view.state
    return view if state is None else replace(view, state=replace(state, timing=replace(state.timing, pose_age_ms=20.0)))


def _context(order: CommandKind, robot: Mapping[str, Any], **changes: Any) -> RequestContext:
    """The sound context of a request, but for these values of robot 2 and of the context."""
    state, mode = SOUND[order]
    if changes.get("state") is S.WAITING and mode is not Mode.STOPPED:
        mode = Mode.DISARMED
    roster = Roster((1, 2), SEGMENT, out=changes.pop("out", ()))
    if order is K.REJOIN:
        roster.mark_lost(2, "silent")
    for name, value in changes.pop("roster", {}).items():
        setattr(roster, name, value)
    robots = {1: ObedientRobot(POOL, mode=mode), 2: replace(ObedientRobot(POOL, mode=mode), **robot)}
    context = RequestContext(
        POOL, WAYPOINTS, state, roster, SEGMENT, STARTS, {r: _fresh(one.view()) for r, one in robots.items()},
        via=[(0.1, 0.1)], text=dump_flight(WAYPOINTS) if order is K.PATH else "line",
    )  # fmt: skip
    return replace(context, **changes)


@pytest.mark.parametrize("order", SOUND, ids=lambda order: order.name)
def test_nothing_speaks_against_a_sound_request(order: CommandKind) -> None:
    assert objection(order, _context(order, {})) == ""


def test_every_request_with_reasons_has_a_sound_context_here() -> None:
    assert set(SOUND) == set(OBJECTIONS)
    assert objection(K.STOP, _context(K.HOLD, {})) == ""


Why = tuple[dict[str, Any], dict[str, Any], str]
MOVES: Why = ({"mode": Mode.TRACKING}, {}, "robot 2 still moves: let it hold first")
LED: Why = (
    {"mode": Mode.DRIVEN},
    {"roster": {"led_by": {1: Leader.MISSION, 2: Leader.PERSON}}},
    "robot 2 is led by a person: let it",
)
PLANNED: Why = ({}, {"planning": True}, "the other path or form is still being planned: wait for it")
FOREIGN: Why = ({"two_pose_senders": True}, {}, "robot 2: two programs publish its poses by turns")
UNHEARD: Why = ({"unknown": True}, {}, "robot 2: not heard")
FAR: Why = ({"eta": (1.0, 0.0, 0.0, 0.0)}, {}, "robot 2: is 1.00 m from its start")
AT_REST = {"state": S.WAITING}
DEAD = {"mode": Mode.FAULT}

REASONS: list[tuple[CommandKind, dict[str, Any], dict[str, Any], str]] = [
    *((order, *why) for order in (K.LOAD, K.ARM, K.START) for why in (MOVES, LED, PLANNED)),
    *((order, *why) for order in (K.ARM, K.START) for why in (UNHEARD, FAR)),
    *((K.TEST, *why) for why in (MOVES, LED, UNHEARD)),
    (K.TEST, {"mode": Mode.HOLDING}, {}, "robot 2 holds: disarm it first"),
    *((order, *FOREIGN) for order in (K.RESUME, K.GO, K.FORMATION, K.PATH, K.RETURN)),
    (K.RESUME, {"mode": Mode.ARMED}, {}, "robot 2 does not hold yet (ARMED)"),
    (K.RESUME, {"unknown": True}, {}, "robot 2 does not hold yet (never heard)"),
    *((K.CLEAR_STOP, {"mode": mode}, {}, "robot 2 has not stopped yet") for mode in (Mode.ARMED, Mode.HOLDING, Mode.TRACKING)),
    (K.CLEAR_STOP, {"mode": Mode.ARMED}, AT_REST, "robot 2 is armed: disarm it first (ARMED)"),
    *((order, {}, {"segment": HOME}, "the robots are on their way back to the start") for order in (K.GO, K.FORMATION)),
    (K.FORMATION, {}, {"homeward": True, "state": S.PAUSED}, "the robots are on their way back to the start"),
    (K.GO, {}, {"transfer": True}, "the robots are still on their way to their places"),
    (K.GO, {}, {"via": ()}, "where to?"),
    (K.GO, {}, {"flown": POOL}, "the path is a circle: it cannot be left"),
    (K.GO, {}, {"flown": DIVING}, "the path dives: it cannot be left"),
    (K.GO, {}, {"flown": APART}, "robots have paths of their own: it cannot be left"),
    (K.GO, {}, {"via": [(0.0, 0.0), (X + 0.001, 0.0)]}, f"({X + 0.001:g}, 0) m is outside the pool"),
    (K.GO, {}, {"via": [(0.0, -Y - 0.001)]}, f"(0, {-Y - 0.001:g}) m is outside the pool"),
    (K.FORMATION, {}, {"text": "star"}, "'star': must read"),
    (K.FORMATION, {}, {"text": "order 1,3"}, "order 1,3: must name each robot once (1, 2)"),
    (K.FORMATION, {}, {"flown": APART}, "robots have paths of their own: there is no formation"),
    (K.FORMATION, {}, {"transfer": True}, "the robots are still on their way to their places"),
    *((order, *MOVES[:1], AT_REST, MOVES[2]) for order in (K.FORMATION, K.PATH)),
    *((order, {**UNHEARD[0]}, {**AT_REST}, "robot 2: not heard") for order in (K.FORMATION, K.PATH)),
    (K.PATH, {}, {"text": "path = 3"}, "pool: path = 3: must be a table"),
    (K.REJOIN, {}, {"roster": {"lost": {}}}, "no robot is out"),
    (K.REJOIN, {}, {"segment": HOME}, "the others are on their way back to the start, where no place is left"),
    (K.REJOIN, {"unknown": True}, {}, "robot 2: not heard"),
    (
        K.REJOIN,
        {},
        {"out": (2,), "roster": {"lost": {2: TAKEN_OUT}}},
        "robot 2 is out of the water (groundstation mission back-in",
    ),
]


@pytest.mark.parametrize(("order", "robot", "changes", "says"), REASONS, ids=lambda value: getattr(value, "name", ""))
def test_a_request_is_refused_for_each_of_its_reasons(
    order: CommandKind, robot: dict[str, Any], changes: dict[str, Any], says: str
) -> None:
    reason = objection(order, _context(order, robot, **changes))
    assert reason.startswith(says) and reason.count(";") == says.count(";"), reason


@pytest.mark.parametrize(
    ("order", "robot", "changes"),
    [
        (K.GO, {}, {"via": [(X, Y), (-X, -Y)]}),
        (K.GO, {}, {"segment": HOME, "state": S.WAITING}),
        (K.FORMATION, {}, {"transfer": True, "state": S.PAUSED}),
        (K.FORMATION, {}, {"transfer": True, "segment": HOME, "state": S.WAITING}),  # the way home has been flown
        (K.FORMATION, {}, {"homeward": True, "state": S.WAITING}),  # as it ended
        (K.FORMATION, {}, {"text": "order 2,1"}),
        (K.FORMATION, {"eta": (1.0, 0.0, 0.0, 0.0), "mode": Mode.DISARMED}, AT_REST),
        (K.HOLD, {"mode": Mode.DISARMED}, {}),
        (K.RETURN, DEAD, {}),
        (K.CLEAR_STOP, {"mode": Mode.DISARMED}, {}),
        (K.CLEAR_STOP, {"mode": Mode.ARMED, "silent": True}, {}),
        (K.TEST, {"mode": Mode.ARMED}, {}),
        (K.TEST, {"eta": (1.0, 0.0, 0.0, 0.0)}, {}),
        (K.LOAD, {"eta": (1.0, 0.0, 0.0, 0.0)}, {}),
        (K.LOAD, {"mode": Mode.TRACKING}, {"state": S.RUNNING}),
        (K.LOAD, {"mode": Mode.TRACKING, "silent": True}, {}),
    ],
)
def test_no_reason_stands_against_the_edge(order: CommandKind, robot: dict[str, Any], changes: dict[str, Any]) -> None:
    assert objection(order, _context(order, robot, **changes)) == ""


def test_a_hold_and_a_return_need_one_robot_that_can() -> None:
    disarmed = {r: ObedientRobot(POOL).view() for r in (1, 2)}
    dead = {r: ObedientRobot(POOL, mode=Mode.FAULT, fault="leak").view() for r in (1, 2)}
    assert objection(K.HOLD, _context(K.HOLD, {}, fleet=disarmed)) == "no robot is armed"
    assert objection(K.RETURN, _context(K.RETURN, {}, fleet=disarmed)) == ""
    reason = objection(K.RETURN, _context(K.RETURN, {}, fleet=dead))
    assert reason == "no robot is fit to move; robot 1: fault (leak); robot 2: fault (leak)"
    weak = {r: ObedientRobot(POOL, battery_v=9.0).view() for r in (1, 2)}
    assert "battery" in unfit_to_return(_context(K.RETURN, {}, fleet=weak), 1)
    armed = {r: ObedientRobot(POOL, battery_v=9.0, mode=Mode.HOLDING).view() for r in (1, 2)}
    assert unfit_to_return(_context(K.RETURN, {}, fleet=armed), 1) == "", "it flies already"


def test_of_the_lost_those_rejoin_that_could_be_armed_and_are_in_the_water() -> None:
    both = {"lost": {1: "silent", 2: "silent"}}
    assert fit_to_rejoin(_context(K.REJOIN, {}, roster=both)) == (1, 2)
    assert fit_to_rejoin(_context(K.REJOIN, {"battery_v": 9.0}, roster=both)) == (1,)
    assert fit_to_rejoin(_context(K.REJOIN, {}, roster=both, out=(2,))) == (1,)
