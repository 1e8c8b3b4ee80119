"""Whole runs of the numeric scenes and of `pool` against the best that is possible from the same start.

The bound is an optimal-control problem solved offline: the nominal model's equations, the limits (39, 40), the whole reference
and disturbance known beforehand. In `pool`, flown without camera, the difference is also the cost of noise, delays and unlike
thrusters, and heading has no weight. The time until a robot stays near its place is that of the seconds for which the bound is
solved.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from benchmarks.harness import Row, run_peer
from benchmarks.robot_agent.error_budget import CAMERA
from shoal.config.experiment import load_experiment
from shoal.messages.messages import required
from tests.flights.scene_flights import SceneFlight, flown

BENCHMARK = "optimum"
PERIOD_S = 0.05
NEAR_M, NEAR_UNIT = 0.01, "s until within 10 mm"


@dataclass(frozen=True)
class BoundedRun:
    """A scene and what counts in it."""

    name: str
    settings: tuple[str, ...]
    seconds: float
    bound_s: float  # what comes later costs the optimum nothing
    axes: int  # x, y, z, yaw: the first so many count
    unit: str
    target: str = ""


WHOLE_HEADING = ("controller.nmpc.heading_m=1",)  # the bound weighs a radian as a metre
CASES = (
    BoundedRun("numeric", WHOLE_HEADING, 35.0, 20.0, 4, "RMS, m and rad", "1.04 x the bound"),
    BoundedRun("numeric-disturbed", WHOLE_HEADING, 35.0, 20.0, 4, "RMS, m and rad", "1.04 x the bound"),
    *(BoundedRun("pool", (*CAMERA, f"seed={seed}"), 60.0, 25.0, 3, "RMS, m") for seed in (1, 2, 3)),
)


def task(case: BoundedRun, flight: SceneFlight) -> dict[str, object]:
    """The description of a flight for the peer that computes the optimum. Its search begins at what was flown if there is
    sway: from the reference alone it does not find out how to turn."""
    experiment = flight.experiment
    vehicle, plant = experiment.vehicle, experiment.sim.plant
    steps = round(case.bound_s / PERIOD_S)
    hz = np.broadcast_to(np.array(plant.disturbance_hz), len(experiment.robots))
    robots = []
    for i, trajectory in enumerate(flight.fleet.trajectories.values()):
        robot = {"start": flight.truth[0, i].tolist(), "reference": trajectory.eta[: steps + 1].tolist(), "hz": float(hz[i])}
        if plant.sway:
            nu = [required(state.estimate).nu.tolist() for state in flight.states[i][: steps + 1]]
            robot["flown"] = np.column_stack([flight.truth[: steps + 1, i], nu]).tolist()
            robot["wrench"] = [required(state.control).wrench.tolist() for state in flight.states[i][:steps]]
        robots.append(robot)
    return {
        "name": experiment.name,
        "seconds": case.seconds,
        "unit": case.unit,
        "near_m": NEAR_M,
        "near_unit": NEAR_UNIT,
        "axes": case.axes,
        "period_s": PERIOD_S,
        "inertia": vehicle.inertia.tolist(),
        "linear": vehicle.drag_linear.tolist(),
        "quadratic": vehicle.drag_quadratic.tolist(),
        "sway": float(plant.sway),
        "lag_s": vehicle.thruster.lag_s,
        "dead_steps": round(vehicle.thruster.dead_time_s / PERIOD_S),
        "limit": list(vehicle.limits.wrench),
        "step": list(vehicle.limits.wrench_step(PERIOD_S)),
        "wave": list(plant.disturbance_wrench),
        "robots": robots,
    }


def run() -> Iterator[Row]:
    """RMS over the whole run and the time until a robot is near, ours and the bound, per robot."""
    for case in CASES:
        flight = flown(load_experiment(case.name, [*case.settings, f"duration_s={case.seconds}"]))
        cost = PERIOD_S * np.sum(flight.error[:, :, : case.axes] ** 2, axis=(0, 2))
        bounds = run_peer("optimum", ["numpy", "casadi"], task(case, flight))
        seed = f", seed {flight.experiment.seed}" if case.name == "pool" else ""
        for i, robot in enumerate(flight.experiment.robot_ids):
            name = f"{case.name}{seed}, robot {robot}"
            rms = float(np.sqrt(cost[i] / case.seconds))
            yield Row(BENCHMARK, name, "ours", case.unit, rms, rms, rms, 1, case.target)
            off_m = np.hypot(*flight.error[: round(case.bound_s / PERIOD_S), i, :2].T)
            near_s = PERIOD_S * float(np.max(np.nonzero(off_m > NEAR_M)[0], initial=-1) + 1)
            yield Row(BENCHMARK, name, "ours", NEAR_UNIT, near_s, near_s, near_s, 1)
            yield from (replace(row, case=name) for row in bounds[2 * i : 2 * i + 2])
