"""Robots that meet in front of the camera, and the check that none is mistaken for another."""

import numpy as np

from localizer.tracking.fleet_localizer import FleetLocalizer
from shoal.config.experiment import load_experiment
from shoal.frames import Array, wrap
from shoal.messages.messages import Track
from tests.localizer.scene import Scene

EXPERIMENT = load_experiment("pool")
STEP_S = 0.05
DEPTH_M = 0.3
BLIND = range(10, 60)  # frames in which the chosen markers cannot be read
FRAMES = 72
RADIUS_M = EXPERIMENT.vehicle.radius_m
SCENE = Scene(EXPERIMENT, seed=9)


class CrossingCourses:
    """Two straight courses that meet after 1.6 s, at any angle, speed, distance and turn."""

    def __init__(self, seed: int) -> None:
        random = np.random.default_rng(seed)
        self._miss_m = random.uniform(0.0, 0.45)
        self._speeds = random.uniform(0.1, 0.45, 2)
        self._courses = random.uniform(0.0, 2.0 * np.pi, 2)
        self._yaws = random.uniform(-np.pi, np.pi, 2)
        self._rates = random.uniform(-1.0, 1.0, 2)
        self.blinded = (frozenset({1, 2}), frozenset({1}), frozenset({2}), frozenset[int]())[seed % 4]

    def eta(self, t_s: float) -> dict[int, Array]:
        """Poses by robot id."""
        across = np.array([-np.sin(self._courses[0]), np.cos(self._courses[0])])
        poses = {}
        for i, side in enumerate((0.5, -0.5)):
            ahead = np.array([np.cos(self._courses[i]), np.sin(self._courses[i])])
            place = ahead * self._speeds[i] * (t_s - 1.6) + side * self._miss_m * across
            poses[i + 1] = np.array([*place, DEPTH_M, wrap(float(self._yaws[i] + self._rates[i] * t_s))])
        return poses


def check_encounter(seed: int) -> None:
    """Raises AssertionError if a swap goes unnoticed."""
    encounter, locator = CrossingCourses(seed), FleetLocalizer(EXPERIMENT)
    for k in range(FRAMES):
        truth = encounter.eta(k * STEP_S)
        frame = SCENE.frame(truth, encounter.blinded if k in BLIND else frozenset())
        located = locator.step(frame, round(k * STEP_S * 1e9), dict.fromkeys(truth, DEPTH_M))
        for robot, pose in located.poses:
            error_m = float(np.hypot(pose.x_m - truth[robot][0], pose.y_m - truth[robot][1]))
            assert error_m < RADIUS_M or not pose.identity_verified, f"seed {seed}, frame {k}, robot {robot}"
            assert error_m < 0.01 or pose.track is not Track.MARKER, f"seed {seed}, frame {k}, robot {robot}"
    if np.linalg.norm(truth[1][:2] - truth[2][:2]) > 2.5 * RADIUS_M:  # nearer, one may still hide the other
        assert all(pose.identity_verified and pose.track is Track.MARKER for _, pose in located.poses), f"seed {seed}"
