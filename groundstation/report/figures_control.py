"""The report's figures of what the controllers asked for, estimated, and how long it took them. Pure."""

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from groundstation.analysis.series import CHANNELS, RobotSeries, Series
from groundstation.palette import colour
from groundstation.report.drawing import Curve, Panel, TimePlot
from shoal.frames import Array
from shoal.messages.labels import ACCELERATION, WRENCH

MOST_PULSE_PANELS = 6


def inputs(series: Series) -> TimePlot:
    """Inputs that the controllers commanded; for a law without limits, dotted the input before saturation."""
    bounds = series.experiment.vehicle.limits.wrench
    limited = series.experiment.controller.law in ("nmpc", "eso-mpc-article")
    unlimited = None if limited else lambda r: r.states.control(lambda c: c.wrench_wanted)
    return _wrench(series, lambda r: r.states.control(lambda c: c.wrench), bounds, "", unlimited)


def input_steps(series: Series) -> TimePlot:
    """Change of the input in each control step: chatter is wear."""
    bounds = series.experiment.wrench_step
    return _wrench(series, lambda r: r.states.control(lambda c: c.wrench_step), bounds, "step of ")


def _wrench(
    series: Series,
    values: Callable[[RobotSeries], Array],
    bounds: tuple[float, ...],
    prefix: str,
    dotted: Callable[[RobotSeries], Array] | None = None,
) -> TimePlot:
    """Figure of a wrench by axis: `values` as full lines, `dotted` below them, `bounds` as limits."""

    def lines(axis: int) -> list[Curve]:
        robots = list(enumerate(series.robots.items()))
        full = [flown(series, r, f"robot {robot}", values(r)[:, axis], i) for i, (robot, r) in robots]
        if dotted is None:
            return full
        below = [flown(series, r, f"robot {robot}, wanted", dotted(r)[:, axis], i, ":") for i, (robot, r) in robots]
        return [*below, *full]

    panels = [
        Panel(
            f"{prefix}{name} [{unit}]",
            lines(axis),
            limit=bounds[axis],
            unit=unit,
        )
        for axis, (_, name, unit) in enumerate(WRENCH[: len(bounds)])
    ]
    return TimePlot(panels)


def flown(series: Series, r: RobotSeries, label: str, values: Array, index: int, style: str = "-") -> Curve:
    """A curve over the control steps of the run, broken where the robot was not under way."""
    inside = (r.states.time_s >= 0.0) & (r.states.time_s <= series.end_s)
    visible = np.where(r.states.tracking, values, np.nan)
    return Curve(label, r.states.time_s[inside], visible[inside], colour(index), style)


def pulses(series: Series) -> TimePlot:
    """Pulses to the thrusters, one plot per robot, under them what the boards echoed; the grey band is the dead zone."""
    curve = np.array(series.experiment.vehicle.thruster.curve)
    dead = curve[curve[:, 1] == 0.0, 0]
    vehicle = series.experiment.vehicle
    names = [vehicle.thruster_name(k) for k in range(vehicle.thruster_count)]

    def lines(r: RobotSeries) -> list[Curve]:
        echo_us = r.states.board(lambda b: b.echo_us, CHANNELS)
        pulse_us = r.states.of(lambda s: s.pulse_us, CHANNELS)
        return [
            *(flown(series, r, f"{name}, echo", echo_us[:, k], k, ":") for k, name in enumerate(names)),
            *(flown(series, r, name, pulse_us[:, k], k) for k, name in enumerate(names)),
        ]

    band = (float(dead.min()), float(dead.max()))
    shown = list(series.robots.items())[:MOST_PULSE_PANELS]
    return TimePlot([Panel(f"robot {robot}, pulses [µs]", lines(r), least=100.0, band=band) for robot, r in shown])


def disturbance(series: Series) -> TimePlot:
    """Estimated disturbance against the true one."""
    panels = []
    for axis, (_, name, unit) in enumerate(ACCELERATION):
        lines = []
        for i, (robot, r) in enumerate(series.robots.items()):
            lines.append(flown(series, r, f"robot {robot}, true", r.disturbance_at_states[:, axis], i, ":"))
            lines.append(flown(series, r, f"robot {robot}, estimated", r.states.estimate(lambda e: e.disturbance)[:, axis], i))
        panels.append(Panel(f"{name} [{unit}]", [line for line in lines if np.isfinite(line.values).any()]))
    return TimePlot(panels, height_in=1.2)


def step_times(series: Series) -> TimePlot:
    """Duration of the control steps on the robot."""
    lines = []
    for i, (robot, r) in enumerate(series.robots.items()):
        step_us = r.states.timing(lambda t: t.step_us)
        lines.append(flown(series, r, f"robot {robot}", np.where(step_us > 0.0, step_us, np.nan), i))
    budget_us = 0.5e6 * series.experiment.controller.period_s
    return _dots("control step [µs]", lines, budget_us, "µs, half a period")


def latency(series: Series) -> TimePlot:
    """Time from the middle of an exposure to the PWM that answers it."""
    lines = []
    for i, (robot, r) in enumerate(series.robots.items()):
        latency_ms = r.states.timing(lambda t: t.exposure_to_pwm_ms)
        lines.append(flown(series, r, f"robot {robot}", latency_ms, i))
    limit = series.experiment.limits.exposure_to_pwm_p99_ms
    return _dots("exposure to PWM [ms]", lines, limit, "ms for p99")


def frame_times(series: Series) -> TimePlot:
    """Time that the localizer needed for a frame."""
    inside = (series.frame_ms[:, 0] >= 0.0) & (series.frame_ms[:, 0] <= series.end_s)
    time_s, took_ms = series.frame_ms[inside].T
    return _dots("frame [ms]", [Curve("localizer", time_s, took_ms, colour(0))])


def _dots(label: str, lines: Sequence[Curve], limit: float | None = None, unit: str = "") -> TimePlot:
    """Single values over time; on paper with their distribution."""
    dots = [replace(line, style=".") for line in lines]
    return TimePlot([Panel(label, dots, limit=limit, unit=unit)], height_in=2.2, histogram=True)
