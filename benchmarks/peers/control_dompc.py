"""do-mpc with IPOPT: the same task stated as a nonlinear program, in do-mpc's own words (orthogonal collocation).

State, limits, weights, horizon, thrusters' lag and the reference are ours; every step has an input of its own (no blocks).
"""

import importlib
from typing import Any

import numpy as np

from benchmarks.robot_agent.control_peer import print_rows
from robot_agent.control.controller import Controller
from robot_agent.control.law_controller import LawController
from robot_agent.control.mpc import MpcPlan
from robot_agent.vehicle.dynamics import State
from shoal.config.experiment import Experiment
from shoal.frames import Array
from shoal.messages.messages import Solve

ca: Any = importlib.import_module("casadi")
do_mpc: Any = importlib.import_module("do_mpc")

SMOOTH = 1e-6  # (m/s)^2: |v| without its corner


class DoMpc:
    """Stands where the controller's `Mpc` stood."""

    def __init__(self, experiment: Experiment) -> None:
        config, period_s = experiment.controller.mpc, experiment.controller.period_s
        self._horizon = config.horizon
        self._reference, self._gamma = np.zeros((config.horizon + 1, 4)), np.zeros(4)
        self._limits, self._step_limit = experiment.vehicle.limits, np.array(experiment.wrench_step)
        mpc = do_mpc.controller.MPC(self._model(experiment))
        mpc.settings.n_horizon, mpc.settings.t_step, mpc.settings.store_full_solution = config.horizon, period_s, False
        mpc.settings.supress_ipopt_output()
        self._goal(mpc, config)
        template = mpc.get_tvp_template()

        def follow(_: float) -> Any:
            for k in range(self._horizon + 1):
                template["_tvp", k, "reference"] = self._reference[k]
                template["_tvp", k, "gamma"] = self._gamma
            return template

        mpc.set_tvp_fun(follow)
        mpc.setup()
        self._mpc, self._started = mpc, False

    def _model(self, experiment: Experiment) -> Any:
        vehicle, estimator = experiment.vehicle, experiment.controller.estimator
        lag_s = vehicle.thruster.lag_s
        model = do_mpc.model.Model("continuous")
        eta, nu = model.set_variable("_x", "eta", (4, 1)), model.set_variable("_x", "nu", (4, 1))
        acts, wrench = model.set_variable("_x", "acts", (3, 1)), model.set_variable("_x", "wrench", (3, 1))
        change = model.set_variable("_u", "change", (3, 1))
        model.set_variable("_tvp", "reference", (4, 1))
        gamma = model.set_variable("_tvp", "gamma", (4, 1))
        push = acts if lag_s else wrench
        flow = ca.sqrt(nu[0] ** 2 + nu[1] ** 2 + SMOOTH)
        speed = ca.vertcat(flow, flow, ca.sqrt(nu[2] ** 2 + SMOOTH), ca.sqrt(nu[3] ** 2 + SMOOTH))
        drag = (vehicle.drag_linear + vehicle.drag_quadratic * speed) * nu
        m_u, m_v, m_w, m_r = vehicle.inertia
        sway = 1.0 if estimator.sway else 0.0
        rate = ca.vertcat(
            (push[0] - drag[0] + sway * m_v * nu[1] * nu[3]) / m_u + gamma[0],
            sway * ((-drag[1] - m_u * nu[0] * nu[3]) / m_v + gamma[1]),
            (push[1] - drag[2]) / m_w + gamma[2],
            (push[2] - drag[3]) / m_r + gamma[3],
        )
        c, s = ca.cos(eta[3]), ca.sin(eta[3])
        model.set_rhs("eta", ca.vertcat(c * nu[0] - s * nu[1], s * nu[0] + c * nu[1], nu[2], nu[3]))
        model.set_rhs("nu", rate)
        model.set_rhs("acts", (wrench - acts) / lag_s if lag_s else 0.0 * acts)
        model.set_rhs("wrench", change / experiment.controller.period_s)  # `change` is per control step, as in (40)
        model.setup()
        return model

    def _goal(self, mpc: Any, config: Any) -> None:
        model = mpc.model
        error = model.x["eta"] - model.tvp["reference"]
        cost = ca.sum1(ca.DM(np.array(config.q)) * error**2)
        mpc.set_objective(mterm=cost, lterm=cost + ca.sum1(ca.DM(np.array(config.r)) * model.u["change"] ** 2))
        mpc.bounds["lower", "_u", "change"] = -self._step_limit
        mpc.bounds["upper", "_u", "change"] = self._step_limit
        mpc.bounds["lower", "_x", "wrench"] = -np.array(self._limits.wrench)
        mpc.bounds["upper", "_x", "wrench"] = np.array(self._limits.wrench)

    def plan(
        self,
        state: State | Array,
        disturbance: Array,
        wrench: Array,
        reference: Array,
        weight: Array,
        keep_clear: object,
        current: complex = 0j,
        delivered: Array | None = None,
    ) -> MpcPlan:
        """One solve. Weighted references of a formation are references like any other."""
        self._reference, self._gamma = reference, disturbance
        x = np.concatenate([state[:8], state[8:11], wrench])
        if not self._started:
            self._mpc.x0 = x
            self._mpc.set_initial_guess()
            self._started = True
        change = self._mpc.make_step(x.reshape(-1, 1)).ravel()
        solved = bool(self._mpc.solver_stats["success"])
        eta = np.tile(state[:4], (self._horizon + 1, 1))  # what it tells its neighbours; ours are told no more by it
        limit = np.array(self._limits.wrench)
        return MpcPlan(np.clip(wrench + change, -limit, limit), eta, Solve.SOLVED if solved else Solve.SHIFTED, 0, 0.0)

    def reset(self) -> None:
        """Do nothing: nothing is kept."""


def tamper(controller: Controller, experiment: Experiment) -> None:
    """do-mpc in the place of the whole optimisation."""
    assert isinstance(controller, LawController)
    controller._law = DoMpc(experiment)


print_rows("do-mpc, IPOPT", tamper)
