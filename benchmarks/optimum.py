"""The numeric scenes' whole run against the best that is possible from the same start.

The bound is an optimal-control problem solved offline: the plant's own equations, the limits (39, 40), the whole reference and
disturbance known beforehand. What a controller without that knowledge adds to it is its own doing; the rest is the start's.
"""

from collections.abc import Iterator

import numpy as np

from benchmarks.harness import Row, run_peer
from groundstation import planner
from sim_bridge.numeric import AgentFleet, BareWater, fly
from wire.experiment import Experiment, load_experiment
from wire.frames import pose_error

BENCHMARK = "optimum"
UNIT = "RMS, m and rad"
SECONDS, PERIOD_S = 35.0, 0.05
BOUND_S = 20.0  # what comes later costs the optimum nothing


def ours(experiment: Experiment) -> list[float]:
    """Integral of squared error, x, y, z in m and yaw in rad, per robot over SECONDS."""
    trajectories = planner.plan(experiment)
    starts = planner.start_poses(experiment, trajectories)
    water = BareWater(experiment, experiment.seed, np.array([starts[r] for r in experiment.robot_ids]))
    fleet = AgentFleet(experiment, trajectories, water, experiment.seed)
    fleet.start()
    held = len(fleet.truth) - 1
    for _ in fly(fleet, water):
        pass
    truth = np.array(fleet.truth[held:])
    reference = np.array([t.eta[: len(truth)] for t in trajectories.values()]).transpose(1, 0, 2)
    cost = PERIOD_S * np.sum(pose_error(truth, reference) ** 2, axis=(0, 2))
    return [float(c) for c in cost]


def task(experiment: Experiment) -> dict[str, object]:
    """What the peer needs to know."""
    vehicle, plant = experiment.vehicle, experiment.sim.plant
    trajectories = planner.plan(experiment)
    starts = planner.start_poses(experiment, trajectories)
    steps = round(BOUND_S / PERIOD_S)
    hz = np.broadcast_to(np.array(plant.disturbance_hz), len(experiment.robots))
    return {
        "name": experiment.name,
        "period_s": PERIOD_S,
        "inertia": vehicle.inertia.tolist(),
        "linear": vehicle.drag_linear.tolist(),
        "quadratic": vehicle.drag_quadratic.tolist(),
        "limit": list(vehicle.limits.wrench),
        "step": list(vehicle.limits.wrench_step),
        "wave": list(plant.disturbance_wrench),
        "robots": [
            {
                "start": np.asarray(starts[robot]).tolist(),
                "reference": trajectories[robot].eta[: steps + 1].tolist(),
                "hz": float(hz[i]),
            }
            for i, robot in enumerate(experiment.robot_ids)
        ],
    }


def run() -> Iterator[Row]:
    """RMS over the whole run, ours and the bound, per robot."""
    for name in ("numeric", "numeric-disturbed"):
        experiment = load_experiment(name, [f"duration_s={SECONDS}"])
        bounds = run_peer("optimum", ["numpy", "casadi"], {**task(experiment), "seconds": SECONDS, "unit": UNIT})
        for i, (robot, cost) in enumerate(zip(experiment.robot_ids, ours(experiment), strict=True)):
            rms = float(np.sqrt(cost / SECONDS))
            yield Row(BENCHMARK, f"{name}, robot {robot}", "ours", UNIT, rms, rms, rms, 1)
            yield from bounds[i : i + 1]
