"""Numeric flights of `pool` in still water in which a thruster breaks."""

from collections.abc import Sequence

import numpy as np

from shoal.config.experiment import load_experiment
from shoal.messages.messages import Mode
from tests.flights.scene_flights import flew

THRUST_LEFT = {"dead": 0.0, "reversed": -1.0, "weak 0.3": 0.3}  # of what a thruster is told
STILL = ("safety.off_path_m=0.1", "sim.numeric.pose_noise_m=0.0005", "sim.numeric.yaw_noise_rad=0.003")
WATCHED_S = 8.0
LACKING_N = 0.1  # the least that counts: two thirds of what a thruster idles with


def lacking_s(how: str, seed: int, settings: Sequence[str]) -> float:
    """Seconds for which a robot flew on though a thruster lacked force; WATCHED_S where it did not notice at all."""
    random = np.random.default_rng(seed)
    robot, number, at_s = int(random.integers(1, 3)), int(random.integers(1, 5)), float(random.uniform(8.0, 20.0))
    fault = f"t={at_s:.2f} thruster {robot}/{number} {how}"
    fleet = flew(load_experiment("pool", [*STILL, *settings, f"seed={seed}", f"duration_s={at_s + WATCHED_S}"], [fault]))
    states = [state for state in fleet.robots[robot - 1].states if state.trajectory_s > at_s]
    if states[-1].mode is not Mode.FAULT:
        return WATCHED_S
    pulses = np.array([state.pulse_us[number - 1] for state in states if state.mode is Mode.TRACKING], dtype=float)
    told_n = fleet.experiment.vehicle.thruster.force_n(pulses)
    given_n = told_n[0] if how == "stuck" else THRUST_LEFT[how] * told_n
    return fleet.experiment.controller.period_s * float((np.abs(told_n - given_n) > LACKING_N).sum())
