"""A robot whose gyroscope or accelerometer is wrong goes to neutral with the sensor's name, and does not arm.

In step with the water, and with a board at the end of each link.
"""

from functools import partial

import pytest

from shoal.config.experiment import Experiment, load_experiment
from shoal.messages.messages import CommandKind, Mode
from sim_bridge.fault_schedule import ImuFaults
from sim_bridge.node.hil_board import HilBoard
from sim_bridge.thruster_board.board import ThrusterBoard
from tests.closed_loop.dry_pool import DryPool, MakeBoard
from tests.closed_loop.hil_desks import HilDesk, MegaDesk

pytestmark = pytest.mark.long

BEGUN_S, LONGEST_S = 2.0, 8.0  # along the trajectories, and the flight
GYROSCOPE, ACCELEROMETER = "gyroscope in doubt: ", "accelerometer in doubt: "
THRUSTERS = "thrusters do not do as told: "  # they are judged by the gyroscope, sooner than the camera can judge that
WRONG = {  # what is broken, the reasons that name it, and the time in which that is noticed, s
    "imu 1 scaled 0": ((GYROSCOPE, THRUSTERS), 5.0),
    "imu 1 scaled 3": ((GYROSCOPE, THRUSTERS), 5.0),
    "imu 1 scaled -1": ((GYROSCOPE, THRUSTERS), 3.0),
    "imu 1 turned 1.57": ((f"{ACCELEROMETER}off gravity by ", THRUSTERS), 1.0),
    "imu 1 stuck": ((GYROSCOPE, ACCELEROMETER, THRUSTERS), 5.0),
}


def on_a_desk(desk: type[HilDesk] | type[MegaDesk], experiment: Experiment, robot: int, seed: int) -> HilBoard:
    link = MegaDesk(robot) if desk is MegaDesk else HilDesk(robot, ThrusterBoard(experiment, robot, seed))
    return HilBoard(experiment, robot, seed, "a desk", link, None)


MAKERS: dict[str, MakeBoard] = {
    "simulated": ThrusterBoard,
    "HIL": partial(on_a_desk, HilDesk),
    "Mega in HIL": partial(on_a_desk, MegaDesk),
}
SLOW = pytest.mark.slow
FLIGHTS = [
    *(pytest.param("simulated", what, marks=() if what.endswith(("0", "1.57")) else SLOW) for what in WRONG),
    *(pytest.param(name, what, marks=SLOW) for name in ("HIL", "Mega in HIL") for what in WRONG),
]


def flown(make: MakeBoard, what: str) -> tuple[str, float]:
    """Fault of the first robot of `pool` when it first has one, and the seconds from the sensor's fault to that."""
    pool = DryPool(load_experiment("pool", ["duration_s=20"], [f"t={BEGUN_S:g} {what}"] if what else []), make=make)
    pool.take_off()
    pool.world.start_ns = pool.world.now_ns  # from which the timeline counts
    for _ in range(round(LONGEST_S / 0.05)):
        pool.world.apply_faults()
        pool.run(0.05)
        state = pool.robots[0].states[-1]
        if state.mode is Mode.FAULT:
            return state.fault, pool.world.flown_s - BEGUN_S
    return "", LONGEST_S


@pytest.mark.parametrize(("board", "what"), FLIGHTS)
def test_a_wrong_imu_leads_to_neutral_with_its_name(board: str, what: str) -> None:
    fault, after_s = flown(MAKERS[board], what)
    reasons, within_s = WRONG[what]
    assert fault.startswith(reasons) and 0.0 < after_s < within_s, (fault, after_s)


@SLOW
@pytest.mark.parametrize("board", MAKERS)
def test_a_right_imu_leads_to_none(board: str) -> None:
    assert flown(MAKERS[board], "") == ("", LONGEST_S)


def test_a_robot_whose_imu_is_mounted_otherwise_does_not_arm() -> None:
    pool = DryPool(load_experiment("pool", ["duration_s=20"]))
    pool.world.boards[0].sensors.faults = ImuFaults(turned_rad=1.57)
    pool.run(2.0)
    assert pool.order(CommandKind.LOAD, 0, start_in_s=0.2).accepted
    reply = pool.order(CommandKind.ARM, 0, start_in_s=0.2)
    assert not reply.accepted and reply.reason.startswith(f"{ACCELEROMETER}off gravity by ")
