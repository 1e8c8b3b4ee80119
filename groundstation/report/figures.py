"""The report's figures, in its order: the article's, and those that a tired engineer needs to see what went wrong. Pure.

They are drawn in figures_paths.py, figures_errors.py, figures_control.py and figures_timeline.py, all with the means of
plotting.py.
"""

from collections.abc import Callable
from dataclasses import dataclass

from groundstation.analysis.series import Series
from groundstation.report.drawing import BarPlot, PaperFigure, TimePlot
from groundstation.report.figures_control import disturbance, frame_times, input_steps, inputs, latency, pulses, step_times
from groundstation.report.figures_errors import formation_errors, pose_error, separation, tracking_errors, yaw
from groundstation.report.figures_paths import paths, references, space
from groundstation.report.figures_timeline import latency_budget, limits, links, slack, timeline


@dataclass(frozen=True)
class Kind:
    """A figure of the report: its short name, its title, what to see in it, and how it is drawn (None: no data)."""

    name: str
    title: str
    caption: str
    draw: Callable[[Series], TimePlot | BarPlot | PaperFigure | None]


FIGURES = (
    Kind(
        "timeline",
        "Modes and faults",
        "What each robot was doing. Faults as they were noticed, and as the simulator injected them.",
        timeline,
    ),
    Kind(
        "references", "Planned paths", "Seen from above, from their stars, and the heading of the path's tangent.", references
    ),
    Kind(
        "paths",
        "Paths in the pool",
        "Seen from above. Dashed: reference, from its star. Solid: robot, from circle to square; the disc is its hull. "
        "Grey lines join the formation every 20 s.",
        paths,
    ),
    Kind("space", "Paths in space", "Dashed: reference. Grey lines join the formation every 20 s; depth goes down.", space),
    Kind("tracking", "Tracking errors", "Robot minus reference. The dotted line is at 20 s.", tracking_errors),
    Kind("formation", "Formation errors", "Distance vector of a pair minus that of its references.", formation_errors),
    Kind("yaw", "Heading errors", "To the path's tangent, and to the heading commanded (with crab angle).", yaw),
    Kind("inputs", "Control inputs", "Surge, heave and yaw asked for, with their limits.", inputs),
    Kind("steps", "Input steps", "Change per control step. Smooth is part of good: chatter wears thrusters out.", input_steps),
    Kind("limits", "Active limits", "When a limit held an input back, or a plan entered another robot's space.", limits),
    Kind("slack", "Slack", "By how much a robot's plan enters the space of another.", slack),
    Kind(
        "pulses",
        "Thruster pulses",
        "Solid: sent. Dotted: the boards' echo, what was at their outputs. The grey band is the thrusters' dead zone.",
        pulses,
    ),
    Kind(
        "disturbance",
        "Disturbance",
        "Acceleration that the model does not explain: estimated, and true (dotted).",
        disturbance,
    ),
    Kind("step-times", "Control step", "Time of a whole control step on the robot.", step_times),
    Kind("latency", "Exposure to PWM", "From the middle of an exposure to the PWM that answers it.", latency),
    Kind(
        "latency-budget",
        "Where the time goes",
        "From exposure to PWM, hop by hop. Time on the wire counts with the wait for the control step.",
        latency_budget,
    ),
    Kind("frame-times", "Localizer", "Processing time of a camera frame.", frame_times),
    Kind("pose-error", "Localizer's error", "Located minus true pose.", pose_error),
    Kind("links", "Links to the boards", "Share of each board's messages that did not arrive.", links),
    Kind("separation", "Separation", "Distance between centres; dashed: 2 R.", separation),
)
