"""Content of result.json: errors against the truth, timing, wear, faults, and what passed. Pure; metrics.py fills it.

Lengths in m, angles in rad. Lists of three are x, y, z of the pool, or surge, heave, yaw of a wrench (and sway, of a vehicle
with side thrust). None (null in JSON) is
a figure that this run cannot give.
"""

import dataclasses
import json
from dataclasses import dataclass, field
from typing import Any

from groundstation.analysis.series import TimelineEvent
from groundstation.logs.recorder import mode_text
from shoal.config.experiment import ArticleRow

Three = tuple[float, float, float]
WHOLE_RUN = "whole run flown"  # name of the check by which a flight went all its way


@dataclass(frozen=True)
class Errors:
    """Root mean square and maximum of an error, per axis, over the whole run and after 20 s."""

    rms_m: Three | None = None
    rms_yaw_rad: float | None = None
    rms_after_20s_m: Three | None = None
    rms_yaw_after_20s_rad: float | None = None
    max_m: Three | None = None
    max_after_20s_m: Three | None = None


@dataclass(frozen=True)
class RobotEnd:
    """State of a robot where the log ends, whichever flight is judged."""

    mode: str | None = None  # as it was last heard; None: never
    heard_s: float | None = None  # before the end of the log
    armed: bool | None = None  # None: not heard at the end, so nobody knows
    place_m: Three | None = None  # in truth where that was recorded, else by the robot's last state
    out_of_water: bool = False  # a person had taken it out


@dataclass(frozen=True)
class RobotResult(Errors):
    """Tracking error of one robot. Yaw counts to the path's tangent, and again to the heading it was commanded, which
    includes the crab angle."""

    rms_yaw_command_rad: float | None = None
    rms_yaw_command_after_20s_rad: float | None = None
    dtau_rms: tuple[float, ...] | None = None  # change of the wrench per step [N, N, N m, N]
    dtau_rms_after_20s: tuple[float, ...] | None = None
    pulse_step_rms_us: float | None = None  # change of the thruster pulses per step
    disturbance_error_rms: tuple[float, ...] | None = None  # estimated minus true [m/s^2 x 3, rad/s^2]
    control_steps: int = 0
    missed_deadlines: int = 0
    baseline: Errors | None = None  # of a robot that never moves, at the middle of its reference
    article: ArticleRow | None = None
    end: RobotEnd = RobotEnd()


@dataclass(frozen=True)
class PairResult(Errors):
    """Formation error (p_i - p_j) - (reference_i - reference_j) of a pair, and how close the two came."""

    min_separation_m: float | None = None
    baseline: Errors | None = None
    article: ArticleRow | None = None


@dataclass(frozen=True)
class Quantiles:
    """Median, 99th percentile and maximum of n values."""

    p50: float
    p99: float
    max: float
    n: int


@dataclass(frozen=True)
class Spread:
    """Root mean square and maximum."""

    rms: float
    max: float


@dataclass(frozen=True)
class Check:
    """One requirement: what, where it was worst, the value there, and the limit."""

    name: str  # of the experiment's limit, where it is one
    where: str
    value: float | None
    limit: float
    passed: bool | None  # None: of a part that the flight is too short to have; it decides nothing
    unit: str = ""  # m, rad, s, ms, fraction; empty for a number of things
    at_least: bool = False  # the limit is the least that is allowed

    @property
    def failed(self) -> bool:
        """True if it makes the run fail."""
        return self.passed is False

    @property
    def reached(self) -> bool:
        """True if the flight came so far that there is a value."""
        return self.value is not None


@dataclass(frozen=True)
class Cause:
    """The cause of a run that did not pass, as far as the log shows it."""

    text: str
    time_s: float | None  # None for what only the whole run shows
    noticed_by: str
    injected: str  # what the simulator had broken before, with its time; without `time_s`, in the flight. Empty for nothing
    outcome: str  # what became of the run
    place: str = ""  # where the robot was, or the middle of the fleet
    sentence: str = ""  # all of it for people

    @property
    def injected_label(self) -> str:
        """Name of `injected` for people. Nothing shows that an injection came before what was missed over the whole run."""
        return "injected in the flight" if self.time_s is None else "injected before"


@dataclass(frozen=True)
class FlightPart:
    """A flight of the log. Times are those of the report: 0 is the start of the one that is judged."""

    begin_s: float
    over_s: float  # its last step under way
    flown_s: float  # along the trajectory, by the robot that came farthest
    home: bool  # it was only the way home


@dataclass(frozen=True)
class Result:
    """Everything result.json holds."""

    scene: str
    seed: int
    mode: str
    passed: bool
    duration_s: float  # that could be evaluated
    planned_duration_s: float  # the experiment's
    real_time_factor: float | None
    errors_against: str | None  # "truth", or "localizer" in a pool that has none
    robots: dict[str, RobotResult]
    pairs: dict[str, PairResult]
    min_separation_m: float | None
    control_step_us: Quantiles | None
    pose_error_m: Spread | None
    pose_error_rad: Spread | None
    exposure_to_pwm_ms: Quantiles | None
    dtau_rms: tuple[float, ...] | None  # of the robot that is worst, per axis
    dtau_rms_after_20s: tuple[float, ...] | None
    pulse_step_rms_us: float | None
    missed_deadlines: int
    missed_deadlines_fraction: float | None
    log_complete: bool
    log_dropped: int
    experiment_hash: str
    notes: tuple[str, ...]
    checks: tuple[Check, ...]
    faults: tuple[TimelineEvent, ...]
    latency_hops_ms: dict[str, Quantiles | None] = field(default_factory=dict)  # of exposure to PWM, in order
    at_limit: dict[str, float] = field(default_factory=dict)  # share of the steps held back; the worst robot's
    slack_m: float | None = None  # the most by which a plan entered the space of another robot
    board_loss: float | None = None  # the most of a board's messages that were lost within 5 s
    messages_lost: dict[str, int] = field(default_factory=dict)  # on the way to the log, by kind, all robots
    asked_s: float = 0.0  # along the trajectory, what was to be flown: less than planned where the path was over before
    log_trouble: str = ""  # what is wrong with the log as a whole; empty if it holds the whole run
    version: str = "unknown"  # of the code that recorded the run,
    commit: str = "unknown"  # and its commit
    evaluated_by: str = "unknown"  # the commit of the code that wrote this
    flight: int = 0  # which of the flights is judged, from 1; 0: nothing flew
    flights: tuple[FlightPart, ...] = ()  # all of the log
    cameras_out: dict[str, float] = field(default_factory=dict)  # of several, share of the flight without its poses, by name
    tags: tuple[str, ...] = ()  # #words of the remarks that were made while it was flown
    cause: Cause | None = None  # None if the run passed
    verdict: str = ""  # passed, failed, or not judged: nothing was flown, or a person ended the flight before its end

    @property
    def rows(self) -> dict[str, RobotResult | PairResult]:
        """The rows of tables by name: robots, then pairs."""
        robots = {f"robot {name}": robot for name, robot in self.robots.items()}
        return {**robots, **{f"pair {name}": pair for name, pair in self.pairs.items()}}

    @property
    def mode_text(self) -> str:
        """The kind of time that the run had, for people."""
        return mode_text(self.mode)

    @property
    def is_whole(self) -> bool:
        """True if the flight went all its way: only then its figures stand beside those of other whole runs."""
        return all(check.passed for check in self.checks if check.name == WHOLE_RUN)

    def to_json(self) -> str:
        return json.dumps(dataclasses.asdict(self, dict_factory=_plain), indent=1, allow_nan=False) + "\n"


def _plain(items: list[tuple[str, Any]]) -> dict[str, Any]:
    """The article's rows are settings; the rest of a result is plain already."""
    return {key: value.model_dump() if isinstance(value, ArticleRow) else value for key, value in items}
