"""The bound of the benchmark `optimum`: direct multiple shooting, RK4 over each control period, solved with IPOPT."""

import importlib
import json
import sys
from dataclasses import asdict
from typing import Any

import numpy as np

from benchmarks.harness import Row

ca: Any = importlib.import_module("casadi")


def least_cost(task: dict[str, Any], robot: dict[str, Any]) -> float:
    """Integral of squared error of the best run from this start."""
    reference, h = np.array(robot["reference"]), task["period_s"]
    steps = len(reference) - 1
    inertia, linear, quadratic = (np.array(task[key]) for key in ("inertia", "linear", "quadratic"))
    limit, change = np.array(task["limit"]), np.array(task["step"])

    def rate(s: Any, tau: Any, t: float) -> Any:
        yaw, u, w, r = s[3], s[4], s[5], s[6]
        wave = np.array(task["wave"]) * np.sin(2.0 * np.pi * robot["hz"] * t)
        nu, push = ca.vertcat(u, w, r), tau + wave
        axes = [0, 2, 3]
        drag = (linear[axes] + quadratic[axes] * ca.sqrt(nu**2 + 1e-12)) * nu
        return ca.vertcat(ca.cos(yaw) * u, ca.sin(yaw) * u, w, r, (push - drag) / inertia[axes])

    problem = ca.Opti()
    s, tau = problem.variable(7, steps + 1), problem.variable(3, steps)
    problem.subject_to(s[:, 0] == ca.DM([*robot["start"], 0.0, 0.0, 0.0]))
    for k in range(steps):
        t, now, push = k * h, s[:, k], tau[:, k]
        k1 = rate(now, push, t)
        k2 = rate(now + h / 2 * k1, push, t + h / 2)
        k3 = rate(now + h / 2 * k2, push, t + h / 2)
        k4 = rate(now + h * k3, push, t + h)
        problem.subject_to(s[:, k + 1] == now + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4))
        before = tau[:, k - 1] if k else ca.DM.zeros(3)
        problem.subject_to(problem.bounded(-change, push - before, change))
        problem.subject_to(problem.bounded(-limit, push, limit))
    problem.minimize(h * ca.sumsqr(s[:4, :] - reference.T))
    problem.set_initial(s[:4, :], reference.T)
    problem.solver("ipopt", {"print_time": False}, {"print_level": 0, "max_iter": 2000})
    return float(problem.solve().value(problem.f))


task = json.load(sys.stdin)
rows = []
for i, robot in enumerate(task["robots"], 1):
    rms = float(np.sqrt(least_cost(task, robot) / task["seconds"]))
    case = f"{task['name']}, robot {i}"
    rows.append(Row("optimum", case, "bound, IPOPT", task["unit"], rms, rms, rms, 1))
print("\n" + json.dumps([asdict(row) for row in rows]))
