"""The report's figures of how far off: robots, their formation, the localizer; and how near one another. Pure."""

from collections.abc import Sequence
from itertools import combinations

import numpy as np
from matplotlib.figure import Figure

from groundstation.analysis.series import SETTLED_S, Series
from groundstation.palette import colour
from groundstation.report.figures_control import flown
from groundstation.report.plotting import GREY, Curve, Panel, stack
from wire.frames import Array, wrap_angle


def tracking_errors(series: Series) -> Figure | None:
    """Tracking error of each robot per axis (Figure 31)."""
    return _axis_errors(
        series, {f"robot {n}": r.error for n, r in series.robots.items()}, [f"{axis} error [m]" for axis in "xyz"]
    )


def formation_errors(series: Series) -> Figure | None:
    """Formation error of each pair per axis (Figure 32)."""
    pairs = {f"pair {a}-{b}": series.pair_error(a, b) for a, b in combinations(series.robots, 2)}
    return _axis_errors(series, pairs, ("x error [m]", "y error [m]", "z error [m]", "yaw error [rad]"))


def _axis_errors(series: Series, errors: dict[str, Array], names: Sequence[str]) -> Figure | None:
    return stack(
        [
            Panel(
                name,
                [Curve(label, series.time_s, error[:, axis], colour(i)) for i, (label, error) in enumerate(errors.items())],
            )
            for axis, name in enumerate(names)
        ],
        mark_s=SETTLED_S,
    )


def yaw(series: Series) -> Figure | None:
    """Heading error twice: to the path's tangent, and to the heading that was commanded."""
    tangent = [Curve(f"robot {n}", series.time_s, r.error[:, 3], colour(i)) for i, (n, r) in enumerate(series.robots.items())]
    commanded = []
    for i, (robot, r) in enumerate(series.robots.items()):
        error = wrap_angle(r.truth_at_states[:, 3] - r.states.eta_command[:, 3])
        commanded.append(flown(series, r, f"robot {robot}", error, i))
    return stack([Panel("tangent [rad]", tangent), Panel("command [rad]", commanded)], mark_s=SETTLED_S)


def pose_error(series: Series) -> Figure | None:
    """Error of the localizer in the plane and in heading."""
    place, heading = [], []
    for i, (robot, r) in enumerate(series.robots.items()):
        inside = (r.pose_time_s >= 0.0) & (r.pose_time_s <= series.end_s)
        time_s, error = r.pose_time_s[inside], r.pose_error[inside]
        place.append(Curve(f"robot {robot}", time_s, 1e3 * np.hypot(error[:, 0], error[:, 1]), colour(i)))
        heading.append(Curve(f"robot {robot}", time_s, error[:, 2], colour(i)))
    return stack([Panel("place [mm]", place, least=1.0), Panel("heading [rad]", heading)])


def separation(series: Series) -> Figure | None:
    """Distance of the robots' centres; the dashed line is 2 R, which they must not come below."""
    lines = [
        Curve(f"pair {a}-{b}", series.time_s, series.separation_m(a, b), colour(i))
        for i, (a, b) in enumerate(combinations(series.robots, 2))
    ]
    figure = stack([Panel("distance [m]", lines)], height_in=1.8)
    if figure is not None:
        axes = figure.axes[0]
        axes.axhline(2.0 * series.experiment.safety.radius_m, color=GREY, linewidth=0.8, linestyle="--")
        axes.set_ylim(bottom=0.0)
    return figure
