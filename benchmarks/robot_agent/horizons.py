"""Slow robots that begin off their paths, under short and long horizons, other rates and other observers.

A flight is `pool` without a camera: poses with 1.5 mm and 8 mrad of noise, 40 ms old. Both robots begin 0.3 m from their
references in a random direction, with any heading, and more than two radii apart. Of each robot that is not stopped, the error
is the RMS of the worse axis from 25 to 35 s, against the plant's truth.
"""

import math
import sys
from collections.abc import Iterator, Sequence

import numpy as np

from benchmarks.flights import flown
from benchmarks.harness import Row
from wire.config.experiment import load_experiment

BENCHMARK = "horizons"
POOL = ("duration_s=35", "sim.latency_s=0.04", "sim.numeric.pose_noise_m=0.0015", "sim.numeric.yaw_noise_rad=0.008")
FROM_S, STARTS, APART_M, OFF_M = 25.0, 10, 0.7, 0.3
FEW_BLOCKS = "controller.mpc.blocks=[1,1,2,3]"
CASES: dict[str, tuple[str, ...]] = {
    "10 steps": ("controller.mpc.horizon=10", FEW_BLOCKS),
    **{f"{steps} steps": (f"controller.mpc.horizon={steps}",) for steps in (15, 20, 25, 30, 35, 40, 45, 50, 60, 80, 100)},
    "15 steps, blocks of one": ("controller.mpc.horizon=15", f"controller.mpc.blocks={[1] * 15}"),
    "15 steps, four blocks": ("controller.mpc.horizon=15", FEW_BLOCKS),
    **{
        f"{round(1 / period_s)} Hz, {seconds:g} s ahead": (
            f"controller.period_s={period_s}",
            f"controller.mpc.horizon={round(seconds / period_s)}",
        )
        for period_s in (0.1, 0.05, 0.04, 0.02)
        for seconds in (1.5, 2.5)
    },
    **{f"observer {w} rad/s": (f"controller.estimator.bandwidth_radps={w}",) for w in (1, 4)},
}


def starts(random: np.random.Generator) -> list[tuple[float, float, float, float]]:
    """Offsets (x, y, z, yaw) of both robots from their references, in m and rad."""
    while True:
        way, yaw = random.uniform(-math.pi, math.pi, 2), random.uniform(-math.pi, math.pi, 2)
        offsets = [(OFF_M * math.cos(w), OFF_M * math.sin(w), 0.0, y) for w, y in zip(way.tolist(), yaw.tolist(), strict=True)]
        if math.hypot(0.8 + offsets[0][0] - offsets[1][0], offsets[0][1] - offsets[1][1]) > APART_M:
            return offsets


def errors_mm(settings: Sequence[str], count: int) -> Iterator[float]:
    """Errors of all robots; infinite if it stopped."""
    for seed in range(1, count + 1):
        experiment = load_experiment("pool", [*POOL, *settings, f"seed={seed}"])
        offsets = starts(np.random.default_rng(seed))
        robots = [robot.model_copy(update={"start_offset": o}) for robot, o in zip(experiment.robots, offsets, strict=True)]
        flight = flown(experiment.model_copy(update={"robots": tuple(robots)}))
        late = flight.error[round(FROM_S / experiment.controller.period_s) :, :, :2]
        rms = 1e3 * np.sqrt(np.mean(late**2, axis=0)).max(axis=1)
        for error, states in zip(rms.tolist(), flight.states, strict=True):
            yield math.inf if any(state.fault for state in states) else error


def run(cases: Sequence[str] = tuple(CASES), count: int = STARTS) -> Iterator[Row]:
    """Robots that stopped, and the errors of the others."""
    for case in cases:
        errors = list(errors_mm(CASES[case], count))
        flew = [error for error in errors if error < math.inf]
        print(f"{case}: {len(errors) - len(flew)} of {len(errors)} robots stopped", file=sys.stderr)
        if flew:
            yield Row.of(BENCHMARK, case, "ours", "mm RMS, 25 to 35 s", flew)
