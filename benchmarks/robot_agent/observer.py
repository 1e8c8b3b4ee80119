"""One step of an observer: a pose, depth and yaw rate in, the estimate out, and the wrench that was sent noted.

The robot flies bends with changing thrust in poses with 1.5 mm of noise, 40 ms old; every period has a new pose.
"""

import math
import time
from collections.abc import Iterator

import numpy as np

from benchmarks.harness import Row
from robot_agent.vehicle.dynamics import Model
from robot_agent.vehicle.estimate import PoseMeasurement, StateMeasurement
from robot_agent.vehicle.kalman import make_estimator
from shoal.config.controller import EstimatorConfig
from shoal.config.vehicle import load_vehicle

BENCHMARK = "observer"
STEPS, WARM_UP = 3000, 200
STEP_NS, LATE_NS = 50_000_000, 40_000_000
SUBJECTS = {"eso": EstimatorConfig(), "kalman": EstimatorConfig(kind="kalman")}


def samples(config: EstimatorConfig) -> Iterator[float]:
    """Microseconds of each step."""
    vehicle, random = load_vehicle("spherical"), np.random.default_rng(1)
    observer = make_estimator(vehicle, Model(vehicle), config)
    for k in range(1, STEPS):
        t, now_ns = 0.05 * k, k * STEP_NS
        yaw, (dx, dy) = 0.3 * t, 0.0015 * random.standard_normal(2)
        x, y = 0.5 * math.sin(yaw) + dx, 0.5 - 0.5 * math.cos(yaw) + dy
        pose = PoseMeasurement(now_ns - LATE_NS, x, y, yaw, 0.0015**2, 0.008**2)
        measurement, wrench = StateMeasurement(pose, 0.3, 0.3), np.array([0.7 + 0.2 * math.sin(t), 0.0, 0.02])
        begin_ns = time.perf_counter_ns()
        observer.update(measurement, now_ns)
        observer.note_wrench(wrench, now_ns)
        if k > WARM_UP:
            yield (time.perf_counter_ns() - begin_ns) / 1e3


def run() -> Iterator[Row]:
    """Both observers."""
    for name, config in SUBJECTS.items():
        yield Row.of(BENCHMARK, "a step with a pose", name, "us", samples(config))
