"""Kernels of the agent: nothing is compiled in flight, and without the compiler they say the same."""

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from numba import njit
from numba.core.event import install_recorder

from robot_agent.control.any_controller import make_controller
from robot_agent.control.controller import Setting
from robot_agent.guidance.formation import Neighbour
from robot_agent.guidance.obstacles import obstacles_from_message
from robot_agent.guidance.reference import Hold
from shoal.messages.messages import Obstacles, Plan
from tests.robot_agent.control.drawn_inputs import GOAL, POOL, STEP_NS, at

pytestmark = pytest.mark.long

ROOT = Path(__file__).parents[2]
KERNEL_TESTS = [
    "tests/robot_agent/control/test_linearisation.py",
    "tests/robot_agent/guidance/test_guidance_kernels.py",
    "tests/robot_agent/safety/test_safety_kernels.py",
    "tests/robot_agent/vehicle/test_eso.py::test_the_correction_is_equation_31_in_matrices",
    "tests/robot_agent/vehicle/test_dynamics.py::test_one_step_agrees_with_a_fine_integrator",
    "tests/robot_agent/vehicle/test_allocation.py",
]


def test_kernels_pass_their_tests_without_the_compiler() -> None:
    environment = {**os.environ, "NUMBA_DISABLE_JIT": "1"}
    command = [sys.executable, "-m", "pytest", "-q", "-n", "0", "-p", "no:cacheprovider", *KERNEL_TESTS]
    done = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout[-2000:]


def test_nothing_is_compiled_in_flight() -> None:
    """Alone, past a neighbour and a thing in the way, on hold, and in neutral."""
    one = make_controller(Setting(POOL.vehicle, POOL.controller, POOL.safety))
    other = np.tile([1.0, 0.0, 0.3, 0.0], (51, 1))
    box = np.array([[0.7, 0.4], [0.8, 0.4], [0.8, 0.5], [0.7, 0.5]])
    things = obstacles_from_message(
        Obstacles(ids=(1,), outline=box[None], velocity=np.zeros((1, 2)), unseen_s=np.zeros(1)), 0, 0.3
    )
    hold = Hold(GOAL.trajectory.eta[0])
    with install_recorder("numba:compile") as compilations:
        for k in range(1, 41):
            goal = GOAL if k < 25 else hold if k < 35 else None
            neighbours = [Neighbour(2, k * STEP_NS, Plan(0.05, other, other), True)] if k > 8 else []
            one.step(at(k), goal, neighbours, k * STEP_NS, things if k > 15 else ())
    assert not compilations.buffer
    with install_recorder("numba:compile") as compilations:
        njit(lambda x: x + 1.0)(2.0)
    assert compilations.buffer  # the recorder does notice
