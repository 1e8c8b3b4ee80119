"""The numeric scenes' whole run against the best that is possible from the same start.

The bound is an optimal-control problem solved offline: the plant's own equations, the limits (39, 40), the whole reference and
disturbance known beforehand. What a controller without that knowledge adds to it is its own doing; the rest is the start's.
"""

from collections.abc import Iterator

import numpy as np

from benchmarks.flights import SceneFlight, flown
from benchmarks.harness import Row, run_peer
from wire.config.experiment import load_experiment

BENCHMARK = "optimum"
UNIT = "RMS, m and rad"
SECONDS, PERIOD_S = 35.0, 0.05
BOUND_S = 20.0  # what comes later costs the optimum nothing


def task(flight: SceneFlight) -> dict[str, object]:
    """The description of a flight for the peer that computes the optimum."""
    experiment = flight.experiment
    vehicle, plant = experiment.vehicle, experiment.sim.plant
    steps = round(BOUND_S / PERIOD_S)
    hz = np.broadcast_to(np.array(plant.disturbance_hz), len(experiment.robots))
    return {
        "name": experiment.name,
        "seconds": SECONDS,
        "unit": UNIT,
        "period_s": PERIOD_S,
        "inertia": vehicle.inertia.tolist(),
        "linear": vehicle.drag_linear.tolist(),
        "quadratic": vehicle.drag_quadratic.tolist(),
        "limit": list(vehicle.limits.wrench),
        "step": list(vehicle.limits.wrench_step(PERIOD_S)),
        "wave": list(plant.disturbance_wrench),
        "robots": [
            {"start": start.tolist(), "reference": trajectory.eta[: steps + 1].tolist(), "hz": float(hz[i])}
            for i, (start, trajectory) in enumerate(zip(flight.truth[0], flight.fleet.trajectories.values(), strict=True))
        ],
    }


def run() -> Iterator[Row]:
    """RMS over the whole run, ours and the bound, per robot."""
    for name in ("numeric", "numeric-disturbed"):
        flight = flown(load_experiment(name, [f"duration_s={SECONDS}"]))
        cost = PERIOD_S * np.sum(flight.error**2, axis=(0, 2))
        bounds = run_peer("optimum", ["numpy", "casadi"], task(flight))
        for i, robot in enumerate(flight.experiment.robot_ids):
            rms = float(np.sqrt(cost[i] / SECONDS))
            yield Row(BENCHMARK, f"{name}, robot {robot}", "ours", UNIT, rms, rms, rms, 1)
            yield from bounds[i : i + 1]
