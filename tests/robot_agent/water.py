"""A robot in water for the controller's tests: its own equations in continuous time, integrated finely. Shares no code with
robot_agent: it is what robot_agent is judged by."""

from collections.abc import Callable, Sequence

import numpy as np

from shoal.config.vehicle import Vehicle
from shoal.frames import Array


def integrate(
    vehicle: Vehicle,
    state: Array,
    command: Callable[[float], Sequence[float] | Array],
    seconds: float,
    disturbance: Sequence[float] | Array = (0.0, 0.0, 0.0, 0.0),
    lag: bool = True,
    steps_per_s: int = 1000,
) -> Array:
    """The state [eta, nu, thrust] (11,), (12,) with side thrust, after `seconds` of a commanded wrench(t); classical
    Runge-Kutta."""
    m_u, m_v, m_w, m_r = vehicle.inertia
    linear, quadratic = vehicle.drag_linear, vehicle.drag_quadratic

    def rate(t: float, s: Array) -> Array:
        yaw, u, v, w, r = s[3:8]
        target_n = np.array(command(t))
        thrust = s[8:] if lag else target_n
        horizontal = float(np.hypot(u, v))
        drag = (linear + quadratic * np.array([horizontal, horizontal, abs(w), abs(r)])) * s[4:8]
        out, side = np.zeros(len(s)), thrust[3] if len(thrust) > 3 else 0.0
        out[0] = u * np.cos(yaw) - v * np.sin(yaw)
        out[1] = u * np.sin(yaw) + v * np.cos(yaw)
        out[2], out[3] = w, r
        out[4] = (thrust[0] - drag[0] + m_v * v * r) / m_u + disturbance[0]
        out[5] = (side - drag[1] - m_u * u * r) / m_v + disturbance[1]
        out[6] = (thrust[1] - drag[2]) / m_w + disturbance[2]
        out[7] = (thrust[2] - drag[3] + (m_u - m_v) * u * v) / m_r + disturbance[3]
        out[8:] = (target_n - s[8:]) / vehicle.thruster.lag_s
        return out

    count = max(1, round(seconds * steps_per_s))
    h = seconds / count
    for k in range(count):
        t = k * h + 1e-9  # a command that changes at t counts from t on
        k1 = rate(t, state)
        k2 = rate(t + h / 2, state + h / 2 * k1)
        k3 = rate(t + h / 2, state + h / 2 * k2)
        k4 = rate(t + h - 2e-9, state + h * k3)
        state = state + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
    return state
