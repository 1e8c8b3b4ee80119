"""The bound of the benchmark `optimum`: direct multiple shooting, RK4 over each control period, solved with IPOPT."""

import importlib
import json
import sys
from dataclasses import asdict
from typing import Any

import numpy as np

from benchmarks.harness import Row

ca: Any = importlib.import_module("casadi")

STILL = 1e-12  # (m/s)^2: speeds have a slope at rest too
SMOOTH = 1e-8  # per squared change of the wrench: where heading does not count, many ways to turn cost the same


def one_step(task: dict[str, Any], hz: float) -> Any:
    """The function (state (11,), wrench (3,), time) -> state a period later: pose, velocity, acting wrench."""
    inertia, linear, quadratic = (np.array(task[key]) for key in ("inertia", "linear", "quadratic"))
    h, lag_s, sway, c = task["period_s"], task["lag_s"], task["sway"], inertia[1] / inertia[0]

    def rate(s: Any, tau: Any, t: Any) -> Any:
        yaw, u, v, w, r = (s[k] for k in range(3, 8))
        acts = (s[8:] if lag_s else tau) + np.array(task["wave"]) * ca.sin(2.0 * np.pi * hz * t)
        speed, sinking, turning = ca.sqrt(u**2 + v**2 + STILL), ca.sqrt(w**2 + STILL), ca.sqrt(r**2 + STILL)
        return ca.vertcat(
            ca.cos(yaw) * u - ca.sin(yaw) * v,
            ca.sin(yaw) * u + ca.cos(yaw) * v,
            w,
            r,
            (acts[0] - (linear[0] + quadratic[0] * speed) * u) / inertia[0] + c * v * r,
            sway * (-(linear[1] + quadratic[1] * speed) * v / inertia[1] - u * r / c),
            (acts[1] - (linear[2] + quadratic[2] * sinking) * w) / inertia[2],
            (acts[2] - (linear[3] + quadratic[3] * turning) * r) / inertia[3],
            (tau - s[8:]) / lag_s if lag_s else ca.DM.zeros(3),
        )

    s, tau, t = ca.MX.sym("s", 11), ca.MX.sym("tau", 3), ca.MX.sym("t")
    k1 = rate(s, tau, t)
    k2 = rate(s + h / 2 * k1, tau, t + h / 2)
    k3 = rate(s + h / 2 * k2, tau, t + h / 2)
    k4 = rate(s + h * k3, tau, t + h)
    return ca.Function("step", [s, tau, t], [s + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)])


def best_run(task: dict[str, Any], robot: dict[str, Any]) -> tuple[float, float]:
    """Integral of squared error of the best run from this start, and the seconds until it stays near its reference."""
    reference, h, axes = np.array(robot["reference"]), task["period_s"], task["axes"]
    steps, step = len(reference) - 1, one_step(task, robot["hz"])
    limit, change = ca.DM(task["limit"]), ca.DM(task["step"])
    problem = ca.Opti()
    s, tau = problem.variable(11, steps + 1), problem.variable(3, steps)
    before = ca.horzcat(ca.DM.zeros(3), tau[:, :-1])
    acts = ca.horzcat(ca.DM.zeros(3, task["dead_steps"]), tau[:, : steps - task["dead_steps"]])
    problem.subject_to(s[:, 0] == ca.DM([*robot["start"], *([0.0] * 7)]))
    problem.subject_to(s[:, 1:] == step.map(steps)(s[:, :-1], acts, ca.DM(h * np.arange(steps)).T))
    problem.subject_to(problem.bounded(ca.repmat(-change, 1, steps), tau - before, ca.repmat(change, 1, steps)))
    problem.subject_to(problem.bounded(ca.repmat(-limit, 1, steps), tau, ca.repmat(limit, 1, steps)))
    cost = h * ca.sumsqr(s[:axes, :] - reference.T[:axes, :])
    problem.minimize(cost + SMOOTH * ca.sumsqr(tau - before))
    problem.set_initial(s[:4, :], reference.T)
    if "flown" in robot:
        flown = np.array(robot["flown"])
        flown[:, 3] = robot["start"][3] + np.unwrap(flown[:, 3]) - flown[0, 3]
        problem.set_initial(s[:8, :], flown.T)
        problem.set_initial(s[8:, 1:], np.array(robot["wrench"]).T)
        problem.set_initial(tau, np.array(robot["wrench"]).T)
    problem.solver("ipopt", {"print_time": False}, {"print_level": 0, "max_iter": 2000})
    best = problem.solve()
    off_m = np.hypot(*(np.array(best.value(s))[:2] - reference.T[:2]))
    return float(best.value(cost)), h * float(np.max(np.nonzero(off_m > task["near_m"])[0], initial=-1) + 1)


task = json.load(sys.stdin)
rows = []
for i, robot in enumerate(task["robots"], 1):
    cost, near_s = best_run(task, robot)
    rms, case = float(np.sqrt(cost / task["seconds"])), f"{task['name']}, robot {i}"
    rows.append(Row("optimum", case, "bound, IPOPT", task["unit"], rms, rms, rms, 1))
    rows.append(Row("optimum", case, "bound, IPOPT", task["near_unit"], near_s, near_s, near_s, 1))
print("\n" + json.dumps([asdict(row) for row in rows]))
