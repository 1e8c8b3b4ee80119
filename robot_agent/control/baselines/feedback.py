"""READ FIRST (baselines): a feedback law in the place of the MPC, with the same estimate, reference and limits.

    wanted = law.wrench(errors)         by the law's equations, without limits
    wrench = wanted, limited            magnitude and rate (39, 40), as for the thrusters
    plan   = the model under the law    for the others' formation and collision terms

The plan is the shared model flown with the limited law over the horizon; its memory (integrals, network) stays as it is now.
Half-spaces that keep robots apart (36) are constraints of the MPC. A feedback law has no place for them, and stays clear of
the others only as far as its reference does.
"""

import math
from typing import Protocol

import numpy as np

from robot_agent.control.baselines.tracking_errors import PerAxis, TrackingErrors, tracking_errors
from robot_agent.control.mpc import MpcPlan
from robot_agent.guidance.formation import HalfSpaces
from robot_agent.vehicle.dynamics import Model, State
from shoal.config.vehicle import Vehicle
from shoal.frames import Array
from shoal.messages.messages import Solve

ABSURD = 1e6  # m, rad: no reference; NaN is none either


class FeedbackLaw(Protocol):
    def wrench(self, now: TrackingErrors) -> PerAxis:
        """Wrench by the law's equations, without limits. Does not change its memory."""

    def learn(self, now: TrackingErrors, short: PerAxis, period_s: float) -> None:
        """Update the memory, once per control step. `short` is wanted minus applied: not 0 on an axis at a limit."""

    def reset(self) -> None:
        """Clear the memory."""


class Feedback:
    """Adapter from a feedback law to the interface of law.py."""

    def __init__(self, law: FeedbackLaw, vehicle: Vehicle, model: Model, period_s: float, horizon: int) -> None:
        self._law, self._model, self._period_s = law, model, period_s
        self._limit, self._step_limit = vehicle.limits.wrench, vehicle.limits.wrench_step(period_s)
        self._nodes = horizon + 1

    def reset(self) -> None:
        """Forget its memory."""
        self._law.reset()

    def plan(
        self,
        state: State | Array,
        disturbance: Array,
        wrench: Array,
        reference: Array,
        weight: Array,
        keep_clear: HalfSpaces,
        current: complex = 0j,
        delivered: Array | None = None,
    ) -> MpcPlan:
        """Compute one step of the law, see `Law.plan`. Weights and half-spaces are not used."""
        state = tuple(np.asarray(state).tolist())
        if not np.abs(reference).max() < ABSURD:
            return self._give_up(state)
        gamma = disturbance.tolist()
        poses, velocities, accelerations = (rows.tolist() for rows in _derivatives(reference, self._period_s, current))
        errors = tracking_errors(self._model, state, gamma, poses[0], velocities[0], accelerations[0])
        wanted = self._law.wrench(errors)
        if not math.isfinite(sum(wanted)):
            return self._give_up(state)
        applied = self._limited(wanted, wrench.tolist())
        # The plan: the law flown along the horizon by the model, which moves with the water
        planned_poses, planned_wrench = [state[:4]], applied
        for k in range(1, len(poses)):
            x, y, *rest = self._model.advance(state, gamma, planned_wrench, self._period_s)
            state = (x + self._period_s * current.real, y + self._period_s * current.imag, *rest)
            planned_poses.append(state[:4])
            later_errors = tracking_errors(self._model, state, gamma, poses[k], velocities[k], accelerations[k])
            planned_wrench = self._limited(self._law.wrench(later_errors), planned_wrench)
        shortfall = (wanted[0] - applied[0], wanted[1] - applied[1], wanted[2] - applied[2])
        self._law.learn(errors, shortfall, self._period_s)
        return MpcPlan(np.array(applied), np.array(planned_poses), Solve.SOLVED, 0, 0.0, np.array(wanted))

    def _give_up(self, state: State) -> MpcPlan:
        """Return no wrench and FAILED, and clear the memory that led to it."""
        self.reset()
        return MpcPlan(np.zeros(3), np.tile(state[:4], (self._nodes, 1)), Solve.FAILED, 0, 0.0)

    def _limited(self, wanted: PerAxis, before: PerAxis) -> PerAxis:
        """A wrench within the limits of each axis, and of its change since the wrench before."""
        surge, heave, yaw = (
            min(max(w, b - step, -limit), b + step, limit)
            for w, b, step, limit in zip(wanted, before, self._step_limit, self._limit, strict=True)
        )
        return surge, heave, yaw


def _derivatives(reference: Array, period_s: float, current: complex) -> tuple[Array, Array, Array]:
    """Return a reference (n, 4), its velocity through the water and its acceleration, by differences of second order."""
    speed = np.gradient(reference, period_s, axis=0, edge_order=2)
    speed[:, :2] -= current.real, current.imag
    change = np.empty_like(reference)
    change[1:-1] = (reference[2:] - 2.0 * reference[1:-1] + reference[:-2]) / period_s**2
    change[0], change[-1] = change[1], change[-2]
    return reference, speed, change
