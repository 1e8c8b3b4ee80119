"""The report's figures of how far off: robots, their formation, the localizer; and how near one another. Pure."""

from itertools import combinations

import numpy as np

from groundstation.analysis.series import SETTLED_S, Series
from groundstation.palette import colour
from groundstation.report.drawing import Curve, Panel, TimePlot
from groundstation.report.figures_control import flown
from shoal.frames import Array, wrap_angle

LEAST_MM, LEAST_DEG = 10.0, 0.5


def tracking_errors(series: Series) -> TimePlot:
    """Tracking error of each robot per axis (Figure 31)."""
    return _axis_errors(series, {f"robot {n}": r.error for n, r in series.robots.items()}, 3)


def formation_errors(series: Series) -> TimePlot:
    """Formation error of each pair per axis (Figure 32)."""
    pairs = {f"pair {a}-{b}": series.pair_error(a, b) for a, b in combinations(series.robots, 2)}
    return _axis_errors(series, pairs, 4)


def _axis_errors(series: Series, errors: dict[str, Array], axes: int) -> TimePlot:
    """Figure of errors (n, 4) by axis, one line for each robot or pair."""

    def lines(axis: int, factors: Array) -> list[Curve]:
        return [
            Curve(label, series.time_s, error[:, axis] * factors[axis], colour(i))
            for i, (label, error) in enumerate(errors.items())
        ]

    factors = np.array([1e3, 1e3, 1e3, np.degrees(1.0)])
    names = [
        ("x error [mm]", LEAST_MM),
        ("y error [mm]", LEAST_MM),
        ("z error [mm]", LEAST_MM),
        ("yaw error [deg]", LEAST_DEG),
    ]
    panels = [Panel(name, lines(axis, factors), least) for axis, (name, least) in enumerate(names[:axes])]
    return TimePlot(panels, mark_s=SETTLED_S)


def yaw(series: Series) -> TimePlot:
    """Heading error twice: to the path's tangent, and to the heading that was commanded."""
    tangent, commanded = [], []
    for i, (robot, r) in enumerate(series.robots.items()):
        tangent.append(Curve(f"robot {robot}", series.time_s, np.degrees(r.error[:, 3]), colour(i)))
        error = wrap_angle(r.truth_at_states[:, 3] - r.states.control(lambda c: c.eta_command)[:, 3])
        commanded.append(flown(series, r, f"robot {robot}", np.degrees(error), i))
    panels = [Panel("to tangent [deg]", tangent, LEAST_DEG), Panel("to command [deg]", commanded, LEAST_DEG)]
    return TimePlot(panels, mark_s=SETTLED_S)


def pose_error(series: Series) -> TimePlot:
    """Error of the localizer in the plane and in heading."""
    place, heading = [], []
    for i, (robot, r) in enumerate(series.robots.items()):
        inside = (r.pose_time_s >= 0.0) & (r.pose_time_s <= series.end_s)
        time_s, error = r.pose_time_s[inside], r.pose_error[inside]
        place.append(Curve(f"robot {robot}", time_s, 1e3 * np.hypot(error[:, 0], error[:, 1]), colour(i)))
        heading.append(Curve(f"robot {robot}", time_s, np.degrees(error[:, 2]), colour(i)))
    return TimePlot([Panel("place [mm]", place, least=1.0), Panel("heading [deg]", heading, LEAST_DEG)])


def separation(series: Series) -> TimePlot:
    """Distance of the robots' centres; the dashed line is 2 R, which they must not come below."""
    lines = [
        Curve(f"pair {a}-{b}", series.time_s, 1e3 * series.separation_m(a, b), colour(i))
        for i, (a, b) in enumerate(combinations(series.robots, 2))
    ]
    floor_mm = 2e3 * series.experiment.safety.radius_m
    return TimePlot([Panel("distance [mm]", lines, LEAST_MM, floor=floor_mm)], height_in=1.8)
