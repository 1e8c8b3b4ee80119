"""Check of a trajectory: its shape, its consistency, and its demands on this robot's vehicle. Pure.

The planner has checked the same before (groundstation/planning/feasibility.py). A robot checks again because a trajectory may
come from another version, another vehicle file, or a fault in the planner, and the robot would have to fly it.
"""

import numpy as np
from numpy.typing import NDArray

from shoal.config.scene import PoolConfig
from shoal.config.vehicle import Vehicle
from shoal.frames import follows_velocity
from shoal.messages.messages import Trajectory

PERIOD_S = (0.001, 1.0)
LATEST_S = 1e6  # of the first sample
OVER = 1.05  # times a limit: sampled derivatives of a smooth path overshoot by a few percent where a turn begins
# How far a velocity may be from where the accelerations before and after it lead, m/s and rad/s. A path that sets off or stops
# all at once leaps by more, from or to rest; planned paths do that at their first and last pose.
LEAP = np.array([0.05, 0.05, 0.05, 0.5])
STILL = 0.1 * LEAP  # of a velocity: that is rest
AXES = (("x", "m"), ("y", "m"), ("z", "m"), ("yaw", "rad"))


def unflyable(trajectory: Trajectory | None, pool: PoolConfig, vehicle: Vehicle) -> str:
    """Return the reason why this vehicle cannot fly a trajectory in this pool; empty if it can."""
    if trajectory is None:
        return "carries no trajectory"
    if not trajectory.id:
        return "trajectory.id is empty"
    low, high = PERIOD_S
    if not low <= trajectory.period_s <= high:
        return f"trajectory.period_s = {trajectory.period_s:g}: must be {low:g} to {high:g}"
    if not 0.0 <= trajectory.begin_s <= LATEST_S:
        return f"trajectory.begin_s = {trajectory.begin_s:g}: must be 0 to {LATEST_S:g}"
    lengths = {len(trajectory.eta), len(trajectory.velocity), len(trajectory.acceleration)}
    if len(lengths) != 1 or min(lengths) < 2:
        return "trajectory: eta, velocity and acceleration must have the same number of samples, at least 2"
    inside = pool.holds(trajectory.eta[:, :3])
    if not inside.all():
        return f"trajectory.eta leaves the pool at {_time_s(trajectory, int(np.argmin(inside))):.2f} s"
    return _inconsistent(trajectory) or _too_much(trajectory, vehicle)


def _inconsistent(trajectory: Trajectory) -> str:
    """Return the first contradiction between poses, velocities and accelerations, by the trapezoidal rule from each sample to
    the next; empty if there is none. A velocity may leap where the robot sets off or stops (LEAP)."""
    period_s, velocity = trajectory.period_s, trajectory.velocity
    where = _first(follows_velocity(trajectory.eta, velocity, period_s))
    if where is not None:
        k, axis = where
        name, unit = AXES[axis]
        moved = trajectory.eta[k + 1, axis] - trajectory.eta[k, axis]
        step = 0.5 * period_s * (velocity[k + 1, axis] + velocity[k, axis])
        at_s = _time_s(trajectory, k)
        return f"trajectory.eta moves by {moved:.3g} {unit} in {name} at {at_s:.2f} s, its velocities say {step:.3g} {unit}"
    expected_change = 0.5 * period_s * (trajectory.acceleration[1:] + trajectory.acceleration[:-1])
    rests: NDArray[np.bool_] = np.asarray((np.abs(velocity) <= STILL).all(axis=1))
    # Samples at rest and those beside them: a plan that was interpolated from another one's samples leaps in two steps.
    near_rest = rests.copy()
    near_rest[1:] |= rests[:-1]
    near_rest[:-1] |= rests[1:]
    may_leap = (near_rest[1:] | near_rest[:-1])[:, None]
    where = _first((np.abs(np.diff(velocity, axis=0) - expected_change) <= LEAP) | may_leap)
    if where is not None:
        k, axis = where
        name, unit = AXES[axis]
        change = velocity[k + 1, axis] - velocity[k, axis]
        at_s = _time_s(trajectory, k)
        return (
            f"trajectory.velocity changes by {change:.3g} {unit}/s in {name} at {at_s:.2f} s, its accelerations say "
            f"{expected_change[k, axis]:.3g} {unit}/s"
        )
    return ""


def _too_much(trajectory: Trajectory, vehicle: Vehicle) -> str:
    """Return the first demand beyond the vehicle's limits; empty if there is none."""
    for what, unit, _, limit, values in vehicle.demands(trajectory.velocity, trajectory.acceleration):
        k = int(np.argmax(values))
        if not values[k] <= OVER * limit:
            at_s = _time_s(trajectory, k)
            return f"trajectory takes a {what} of {values[k]:.3g} {unit} at {at_s:.2f} s, this robot's limit is {limit:g}"
    return ""


def _first(fine: NDArray[np.bool_]) -> tuple[int, int] | None:
    """Row and column of the first entry that is false; None if all are true."""
    bad = np.argwhere(np.logical_not(fine))
    return (int(bad[0, 0]), int(bad[0, 1])) if len(bad) else None


def _time_s(trajectory: Trajectory, sample: int) -> float:
    return trajectory.begin_s + sample * trajectory.period_s
