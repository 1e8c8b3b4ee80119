"""The simulated camera as the pool's process has it: what a fault timeline makes of it."""

from contextlib import closing

import numpy as np
import pytest

from shoal.config.experiment import load_experiment
from sim_bridge.node.simulated_camera import Exposure, SimulatedCamera


@pytest.mark.parametrize("fault", ["t=5 water gust 1.0", "t=5 water low 0.1"])
def test_a_shallow_pool_may_have_any_fault_of_its_water(fault: str) -> None:
    """A gust of 1 m/s is no level that is 1 m lower, below the floor."""
    experiment = load_experiment("pool", ["pool.size_m=[4.0, 3.0, 0.9]", "path.depth_m=0.3"], [fault])
    eta = np.array([[0.5, 0.0, 0.3, 0.0], [-0.5, 0.0, 0.3, 0.0]])
    with closing(SimulatedCamera(experiment)) as camera:
        camera.expose(Exposure(eta, np.zeros((2, 4)), np.zeros((2, 4)), 0.0, 1, 0))
        [(stamp_ns, pixels)] = camera.due(0)
    assert (stamp_ns, pixels.shape) == (0, (960, 1280))
