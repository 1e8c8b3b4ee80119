"""The observer's own idea of its errors, held against the truth at the same exposure: normalised squared errors (NEES) per
degree of freedom, 1 where covariances are true.

The Kalman observer claims all of GROUPS, the ESO only place and velocity.
"""

import math
from typing import Any, NamedTuple

import numpy as np

from robot_agent.agent import Agent
from robot_agent.vehicle.filter_bank import CURRENT_X, CURRENT_Y, YAW, R, U, V, X, Y
from robot_agent.vehicle.kalman import KalmanEstimator
from shoal.frames import Array, wrap
from tests.flights.water import TrueState

KALMAN = ("x", "y", "yaw", "u", "v", "r", "current_x", "current_y")  # what the Kalman observer claims
CLAIMED = [X, Y, YAW, U, V, R, CURRENT_X, CURRENT_Y]
GROUPS = {"place": ("x", "y"), "turn": ("yaw", "r"), "velocity": ("u", "v"), "current": ("current_x", "current_y")}


class ObserverClaim(NamedTuple):
    """Belief at the exposure of a pose. Velocities u, v, r are through the water on the body's axes, the rest is in the pool's
    frame."""

    at_ns: int  # on the robot's clock
    names: tuple[str, ...]  # of GROUPS
    mean: Array
    covariance: Array


def claim_of(agent: Agent) -> ObserverClaim | None:
    """The belief of a robot's observer; None if it has none, or claims nothing."""
    estimator: Any = getattr(agent.controller, "_estimator", None)  # no robot publishes its covariances
    if not isinstance(estimator, KalmanEstimator) or not estimator._begun:  # a robot publishes none of this
        return None
    belief = estimator._belief  # the same
    # the same
    mean, covariance = belief[[0, 1, 3, 4, 5, 7, 15, 16]], estimator._bank.mixed[np.ix_(CLAIMED, CLAIMED)]
    count = len(KALMAN) if estimator._model.sway else 3  # without sway there is no current, and v is 0
    # the same: the time of the belief
    return ObserverClaim(estimator._at_ns, KALMAN[:count], mean[:count], covariance[:count, :count])


def nees(claim: ObserverClaim, truth: TrueState, i: int) -> dict[str, float]:
    """NEES per degree of freedom of each group of states that are all claimed, for the i-th robot."""
    (x, y, _, yaw), (surge, sway, _, rate) = truth.eta[i].tolist(), truth.nu[i].tolist()
    water_x, water_y = truth.water_mps[i, :2].tolist()
    cos, sin = math.cos(yaw), math.sin(yaw)
    u, v = surge - cos * water_x - sin * water_y, sway - cos * water_y + sin * water_x
    true = {"x": x, "y": y, "yaw": yaw, "u": u, "v": v, "r": rate, "current_x": water_x, "current_y": water_y}
    error = np.array([claim.mean[k] - true[name] for k, name in enumerate(claim.names)])
    if "yaw" in claim.names:
        error[claim.names.index("yaw")] = wrap(float(error[claim.names.index("yaw")]))
    ratios = {}
    for group, names in GROUPS.items():
        if set(names) <= set(claim.names):
            rows = [claim.names.index(name) for name in names]
            spread = claim.covariance[np.ix_(rows, rows)]
            ratios[group] = float(error[rows] @ np.linalg.solve(spread, error[rows])) / len(rows)
    return ratios
