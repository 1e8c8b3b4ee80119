"""Outputs of a board in HIL mode, known only by its next report, move a robot like those of a board in the simulator."""

import math

import numpy as np
import pytest

from shoal.config.experiment import Experiment, load_experiment
from shoal.frames import Array
from shoal.mavlink.agent_link import AgentLink
from sim_bridge.node.hil_board import HilBoard
from sim_bridge.thruster_board.board import ThrusterBoard
from sim_bridge.world import World, WorldBoard
from tests.closed_loop.dry_pool import MakeBoard
from tests.closed_loop.hil_desks import HilDesk

EXPERIMENT = load_experiment("pool", ["sim.board.slew_us_per_s=100000"])
STARTS = np.array([[0.8, 0.0, 0.3, 0.0], [-0.8, 0.0, 0.3, 0.0]])
STEPS_A_PERIOD = 10  # of the plant, 5 ms each


def order(k: int) -> tuple[int, ...]:
    """Pulses of the k-th control step, each other ones: thrust that swings and turns, and ankles that follow."""
    if k < 30:
        return (1500,) * 8
    left, right, ankle = (round(value) for value in (40 * math.sin(0.7 * k), 40 * math.cos(0.9 * k), 60 * math.sin(0.5 * k)))
    return (*(1560 + left, 1560 + right) * 2, *(1500 + ankle,) * 4)


def flown(make: MakeBoard) -> Array:
    """Poses (n, robots, 4), each 5 ms, of robots whose boards get the same orders, and tell nobody."""
    world, links = World(EXPERIMENT, 1, STARTS, make), [AgentLink(robot) for robot in EXPERIMENT.robot_ids]
    poses = []
    for k in range(120):
        for i, link in enumerate(links):
            world.receive(i, link.pulses(order(k)))
            if k == 25:  # its mode is told once a second
                world.receive(i, link.arm(True))
        for _ in range(STEPS_A_PERIOD):
            world.step()
            poses.append(world.eta.copy())
    assert all(board.armed for board in world.boards)
    return np.array(poses)


@pytest.mark.parametrize("late_steps", [0, 1, 2])
def test_outputs_of_a_board_in_hil_mode_act_as_soon_as_those_of_a_simulated_board(late_steps: int) -> None:
    """A report is up to 25 ms old, and 10 ms more on a slow way: less than the thrusters' dead time, 50 ms, and a little more
    than the ankles', 20 ms."""

    def make(experiment: Experiment, robot: int, seed: int) -> WorldBoard:
        board = ThrusterBoard(experiment, robot, seed)
        return HilBoard(experiment, robot, seed, "a desk", LateDesk(robot, board, late_steps), None)

    real, simulated = flown(make), flown(ThrusterBoard)
    apart = np.abs(real - simulated)
    assert np.ptp(simulated[:, 0, :3], axis=0).max() > 0.1
    assert apart[..., :3].max() < 1e-5
    assert apart[..., 3].max() < 1e-4


class LateDesk(HilDesk):
    """A board whose bytes are some steps of 5 ms on their way."""

    def __init__(self, robot: int, board: ThrusterBoard, late_steps: int) -> None:
        super().__init__(robot, board)
        self._under_way = [b""] * late_steps

    def read(self) -> bytes:
        self._under_way.append(super().read())
        return self._under_way.pop(0)
