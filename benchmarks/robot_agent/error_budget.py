"""Budget of the tracking error: flights in which one thing is exchanged for the true one.

`pool` and `figure-eight` without a camera: poses with 1.5 mm and 8 mrad of noise, 40 ms old. "true" replaces a part of the
estimate by the plant's; "exact" takes an error of the sensors away, "no" one of the plant. A sample is a flight: RMS of the
worst robot after 20 s, axis by axis.
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np

from benchmarks.harness import Row
from robot_agent.vehicle.dynamics import propagate
from robot_agent.vehicle.eso import Estimator
from robot_agent.vehicle.estimate import Observation, StateMeasurement
from shoal.config.experiment import load_experiment
from shoal.frames import wrap
from sim_bridge.in_process.fleet import AgentFleet, DirectPlant, fly
from tests.flights.scene_flights import prepared

BENCHMARK = "error_budget"
SEEDS = range(1, 11)
SETTLED_S = 20.0
CAMERA = ("duration_s=70", "sim.latency_s=0.04", "sim.numeric.pose_noise_m=0.0015", "sim.numeric.yaw_noise_rad=0.008")
POSES = ("sim.numeric.pose_noise_m=0", "sim.numeric.yaw_noise_rad=0")
GYRO = ("sim.sensors.gyro_noise_radps=0", "sim.sensors.gyro_bias_radps=0")
PRESSURE = ("sim.sensors.pressure_noise_m=0", "sim.sensors.pressure_bias_m=0")
NOW = ("sim.latency_s=0",)
SPREAD, LEVEL = ("sim.plant.thruster_spread=0",), ("sim.plant.tilt.enabled=false",)
BATTERY, FLOAT = ("sim.plant.battery.capacity_wh=0",), ("sim.plant.buoyancy_n=0",)
# What is exchanged: settings, and parts of the estimate.
CASES: dict[str, tuple[tuple[str, ...], tuple[str, ...]]] = {
    "as it is": ((), ()),
    "exact poses": (POSES, ()),
    "poses of now": (NOW, ()),
    "exact gyroscope": (GYRO, ()),
    "exact pressure": (PRESSURE, ()),
    "exact sensors, of now": ((*POSES, *GYRO, *PRESSURE, *NOW), ()),
    "no unlike thrusters": (SPREAD, ()),
    "no battery": (BATTERY, ()),
    "no buoyancy": (FLOAT, ()),
    "no tilt": (LEVEL, ()),
    "the plant as the model": ((*SPREAD, *BATTERY, *FLOAT, *LEVEL), ()),
    "true pose": ((), ("eta",)),
    "true velocity": ((), ("nu",)),
    "true disturbance": ((), ("gamma",)),
    "true pose and velocity": ((), ("eta", "nu")),
    "all true": ((), ("eta", "nu", "gamma")),
}


class KnowingEstimator(Estimator):
    """An observer whose estimate is exchanged, in some parts, for the truth. An agent's own observer is made one."""

    water: DirectPlant
    robot: int
    parts: Sequence[str]

    def update(self, measurement: StateMeasurement, now_ns: int) -> Observation | None:
        """As `Estimator.update`; its state at the action is predicted from what is exchanged."""
        estimate = super().update(measurement, now_ns)
        if estimate is None or not self.parts:
            return estimate
        eta, nu, gamma, current = estimate.eta.copy(), estimate.nu.copy(), estimate.disturbance, estimate.current
        true, true_nu = self.water.eta[self.robot], self.water.nu[self.robot]
        if "eta" in self.parts:
            eta[:3], eta[3] = true[:3], eta[3] + wrap(true[3] - eta[3])
        if "nu" in self.parts:
            nu = true_nu.copy()
        thrust = self._predicted(now_ns)[8:]
        if "gamma" in self.parts:  # what the model without a disturbance lacks of the plant's acceleration
            step_s, still = 1e-6, (0.0, 0.0, 0.0, 0.0)
            after = self._model.advance((*true, *true_nu, *thrust), still, thrust, step_s)
            gamma = self.water._plant.acceleration(self.water._state)[self.robot] - (after[4:8] - true_nu) / step_s
            current = 0j
        carried = current * complex(math.cos(eta[3]), -math.sin(eta[3]))
        through = nu - [carried.real, carried.imag, 0.0, 0.0]
        state, water = (*eta.tolist(), *through.tolist(), *thrust), (current.real, current.imag)
        action = propagate(
            self._model.motion, state, tuple(gamma.tolist()), water, self._commands(), now_ns, now_ns + self._dead_ns
        )
        true_estimate = replace(estimate.estimate, eta=eta, nu=nu)
        return estimate._replace(estimate=true_estimate, disturbance=gamma, current=current, action=np.array(action))


def rms_mm(fleet: AgentFleet) -> list[float]:
    """Error in x, y and z (3,) of a fleet that has flown."""
    late = fleet.errors()[round(SETTLED_S / fleet.experiment.controller.period_s) :, :, :3]
    worst: list[float] = (1e3 * np.sqrt(np.mean(late**2, axis=0)).max(axis=0)).tolist()
    return worst


def flight(scene: str, settings: Sequence[str], parts: Sequence[str], seed: int) -> list[float]:
    """Error of one flight in x, y and z (3,), mm."""
    fleet, water = prepared(load_experiment(scene, [*CAMERA, *settings, f"seed={seed}"]))
    for i, robot in enumerate(fleet.robots):
        observer = robot.agent.controller._estimator
        observer.__class__ = KnowingEstimator
        observer.water, observer.robot, observer.parts = water, i, parts  # type: ignore[attr-defined]
    fleet.start()
    for _ in fly(fleet, water):
        pass
    return rms_mm(fleet)


def run() -> Iterator[Row]:
    """Both scenes, everything exchanged in turn."""
    for scene in ("pool", "figure-eight"):
        for case, (settings, parts) in CASES.items():
            flights = [flight(scene, settings, parts, seed) for seed in SEEDS]
            for i, axis in enumerate("xyz"):
                yield Row.of(BENCHMARK, f"{scene}, {axis}", case, "mm RMS", [each[i] for each in flights])
