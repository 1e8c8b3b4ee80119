"""Every message of the fleet as a frozen dataclass. Its protobuf form follows from it (schema.py): the number beside a
field's type is the field's number there, which never changes and is never used again.

`eta` is a pose [x_m, y_m, z_m, yaw_rad] in the pool frame, `nu` a velocity [surge, sway, heave m/s, yaw rad/s] in the body
frame, a wrench [surge N, heave N, yaw N m], with sway N as its fourth number where the vehicle has side thrust; see
shoal/frames.py. Array fields state their shape; -1 is any length, but one
length for all of a message.
"""

import math
from dataclasses import dataclass, field
from enum import IntEnum
from typing import Annotated, Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from shoal.frames import Array
from shoal.messages.labels import ACCELERATION, CHANNELS, POSE, VELOCITY, WRENCH, Label, columns

# Integers, with the form that they have on the wire.
Int64 = Annotated[int, "int64"]
Uint32 = Annotated[int, "uint32"]
Uint64 = Annotated[int, "uint64"]


T = TypeVar("T")


def array(*shape: int) -> Any:
    """An array field: float64, finite, of this shape. Empty by default."""
    empty = tuple(0 if n == -1 else n for n in shape)
    return field(default_factory=lambda: np.zeros(empty), metadata={"shape": shape})


def wrench_array(*rows: int) -> Any:
    """An array field of wrenches: 3 numbers each, or 4 with sway. All of a message have the same."""
    empty = (*(0 for _ in rows), 3)
    return field(default_factory=lambda: np.zeros(empty), metadata={"shape": (*rows, 3), "wrench": True})


def is_finite(message: Any) -> bool:
    """True if every number of a message is finite; of None it is."""
    values = () if message is None else vars(message).values()
    floats = (float(value.sum()) if isinstance(value, np.ndarray) else value for value in values)
    return all(math.isfinite(value) for value in floats if isinstance(value, float))


def required(part: T | None) -> T:
    """A part of a message that has to be there. Raises ValueError where it is not."""
    if part is None:
        raise ValueError("the message has no such part: nothing was known")
    return part


def row_numbers() -> Any:
    """A field of integers, one for each row of the message's arrays: the id that the row belongs to."""
    return field(default=(), metadata={"each_row": True})


# The covariance of x, y and yaw row by row, and the corners of an outline, as tables have them.
COVARIANCE = columns(
    *(
        f"covariance_{a}_{b}_{unit}"
        for a, row in (("x", ("m2", "m2", "m_rad")), ("y", ("m2", "m2", "m_rad")), ("yaw", ("m_rad", "m_rad", "rad2")))
        for b, unit in zip(("x", "y", "yaw"), row, strict=True)
    )
)
CORNERS = columns(*(f"corner_{k}_{axis}_m" for k in range(1, 13) for axis in "xy"))
POSITIVE = {"positive": True}  # metadata of a float that receivers divide by: the codec refuses zero and less


class Track(IntEnum):
    """The source of a pose, from worst to best."""

    LOST = 0
    COAST = 1  # Predicted from earlier poses.
    KCF = 2  # Found by the correlation filter.
    MARKER = 3  # Read from the marker.


class Mode(IntEnum):
    """The mode of a robot. The table of transitions is in robot_agent/safety/modes.py."""

    DISARMED = 0
    ARMED = 1  # At neutral, ready to start.
    TRACKING = 2
    HOLDING = 3  # The robot keeps its position.
    STOPPED = 4  # Emergency stop, latched.
    FAULT = 5
    DRIVEN = 6  # A person drives; it holds when no DRIVE comes.


class Guidance(IntEnum):
    """State of a robot's guidance: it decides the robot's motion. robot_agent/safety/guidance_states.py has the table of
    transitions."""

    NONE = 0  # Nothing: the thrusters are at neutral.
    JOINING = 1  # On the way to the path, after START, RESUME, or a leap of the path.
    ON_PATH = 2
    GIVING_WAY = 3  # Around another robot or an obstacle.
    RETURNING = 4  # Back to the path after giving way.
    HOLDING = 5
    DRIVEN = 6


class Solve(IntEnum):
    """The result of a control step's optimisation."""

    NONE = 0  # No optimisation was needed.
    SOLVED = 1
    SHIFTED = 2  # The previous plan was used.
    FAILED = 3  # No plan was left: neutral.


class CommandKind(IntEnum):
    """Commands from the station to one robot. A *request* goes to the station only."""

    NONE = 0
    LOAD = 1
    ARM = 2
    START = 3
    HOLD = 4
    RESUME = 5
    STOP = 6
    DISARM = 7
    CLEAR_STOP = 8
    TUNE = 9  # Check these gains and keep them ready; nothing changes yet.
    ADOPT = 10  # Fly with the gains that are ready.
    RETURN = 11  # Request: all robots return to their starts.
    REJOIN = 12  # Request: lost robots take their places again.
    GO = 13  # Request: the formation goes to other places than planned.
    SWITCH = 14  # Change to the trajectory that was loaded in flight, at its first sample.
    TEST = 15  # Pulse each thruster and compare the board's echo.
    END = 20  # Request: disarm all robots, then end the run.
    DRIVE = 21  # Move at this velocity, for a short time.
    OUT = 22  # Request: the robot is out of the water.
    BACK_IN = 23  # Request: the robot is in the water again.
    FORMATION = 24  # Request: the formation takes another form.
    FAULT = 25  # Request, in simulation: something breaks.
    PATH = 26  # Request: the formation flies the path of another experiment.


class Progress(IntEnum):
    """The progress of an operator's request."""

    UNDER_WAY = 0
    DONE = 1
    FAILED = 2


class CameraHealth(IntEnum):
    """The health of the camera's pictures, as judged by the localizer."""

    ABSENT = 0
    OK = 1
    FROZEN = 2
    BLACK = 3
    WRONG_SIZE = 4


@dataclass(frozen=True, eq=False)
class Tick:
    """The simulator's clock in lockstep. A process acts when the inputs named here have reached it."""

    now_ns: Annotated[Int64, 1]  # Simulated time of this control step.
    previous_ns: Annotated[Int64, 2]  # Time of the step before: the stamp of the plans and states to use.
    frame_ns: Annotated[Int64, 3]  # Stamp of the newest camera frame that counts at this step.
    robots: Annotated[tuple[Uint32, ...], 4] = ()  # Robots that take part.
    board_ms: Annotated[tuple[Uint32, ...], 5] = ()  # For each robot, the board's time of the last sensor burst that counts.
    frames_ns: Annotated[tuple[Int64, ...], 6] = ()  # For each of several cameras, stamp of its newest frame; -1: none yet.
    no_radio: Annotated[tuple[Uint32, ...], 7] = ()  # Robots whose radio is dead at this step.
    unheard: Annotated[tuple[Uint32, ...], 8] = ()  # Robots whose radio was dead at the step before: nothing of it comes.

    @property
    def heard_robots(self) -> tuple[int, ...]:
        """Robots whose messages of the step before come."""
        return tuple(robot for robot in self.robots if robot not in self.unheard)


@dataclass(frozen=True, eq=False)
class Truth:
    """The true state of the simulated plant. Robots, localizer and planner may not read it."""

    robots: Annotated[tuple[Uint32, ...], 1] = row_numbers()
    eta: Annotated[Array, 2, Label("", parts=POSE)] = array(-1, 4)
    nu: Annotated[Array, 3, Label("", parts=VELOCITY)] = array(-1, 4)
    wrench: Annotated[Array, 4, Label("", parts=WRENCH)] = wrench_array(-1)  # Wrench that the thrusters deliver.
    disturbance: Annotated[Array, 5, Label("", parts=ACCELERATION, prefix="disturbance_")] = array(-1, 4)
    # Acceleration that the model does not explain, in the body frame.


@dataclass(frozen=True, eq=False)
class Pose:
    """A robot's position and heading from the camera, at the header's stamp (middle of the exposure)."""

    x_m: Annotated[float, 1]
    y_m: Annotated[float, 2]
    yaw_rad: Annotated[float, 3]
    covariance: Annotated[Array, 4, COVARIANCE] = array(3, 3)  # Covariance of x, y, yaw: m^2, m rad, rad^2.
    track: Annotated[Track, 5] = Track.LOST
    identity_verified: Annotated[bool, 6] = False  # A marker was read since the robot was last near another robot.
    peak: Annotated[float, 7] = 0.0  # Peak of the correlation, 0 to 1.
    depth_m: Annotated[float, 8] = 0.0  # Depth of the robot's centre that the refraction was computed with.


@dataclass(frozen=True, eq=False)
class LocalizerStatus:
    """The state of the localizer, once a frame."""

    camera: Annotated[CameraHealth, 1] = CameraHealth.ABSENT
    frames: Annotated[Uint64, 2] = 0  # Pictures processed.
    dropped: Annotated[Uint64, 3] = 0  # Pictures left out for a newer one.
    frame_ms: Annotated[float, 4] = 0.0  # Processing time of the last picture.
    frame_age_ms: Annotated[float, 5] = 0.0  # Time from the exposure to the publication.
    message: Annotated[str, 6] = ""  # The trouble in words.
    robots: Annotated[tuple[Uint32, ...], 7] = ()  # Robots whose poses in this picture are published.
    obstacles_ns: Annotated[Int64, 8] = -1  # Stamp of the newest Obstacles before those poses; -1: none yet.
    failed: Annotated[Uint64, 9] = 0  # Pictures skipped after an error.
    out: Annotated[tuple[str, ...], 10] = ()  # Of several cameras, those that give no poses now.
    moved: Annotated[bool, 11] = False  # Check marks show that the camera was moved.
    marks_seen: Annotated[bool, 12] = False  # Most check marks are seen: only then is a moved camera known to be back.
    code: Annotated[str, 13] = ""  # Version and commit.
    experiment_hash: Annotated[str, 14] = ""  # Of the experiment whose markers and camera its poses rest on.


@dataclass(frozen=True, eq=False)
class Obstacles:
    """All obstacles that the camera sees in the pool, in one message: an obstacle that is not in it has gone.

    Each has a convex outline of twelve corners (some may coincide), in order from x to y. The outline assumes that the
    obstacle is at `depth_m`, because one camera cannot measure depth. The k-th rows of all arrays and `ids` belong together.
    """

    ids: Annotated[tuple[Uint32, ...], 1] = row_numbers()  # Kept while the obstacle is tracked; none is used twice.
    outline: Annotated[Array, 2, CORNERS] = array(-1, 12, 2)  # Corners x, y in the pool frame, m.
    velocity: Annotated[Array, 3, columns("x_mps", "y_mps")] = array(-1, 2)  # Over the floor, in the pool frame, m/s.
    depth_m: Annotated[float, 4] = 0.0  # Assumed: that of the robots' path.
    watched: Annotated[float, 5] = 0.0  # Share of the pool that can be judged, 0 to 1.
    blind: Annotated[str, 6] = ""  # Reason why too little of the pool can be judged for the list to count.
    unseen_s: Annotated[Array, 7, columns("unseen_s")] = array(-1)
    # Time since each was last seen. The other fields are as of then.


@dataclass(frozen=True, eq=False)
class Plan:
    """A robot's predicted motion: node s is at the header's stamp + s * period_s, node 0 is the estimate."""

    period_s: Annotated[float, 1] = field(metadata=POSITIVE)
    eta: Annotated[Array, 2, Label("", parts=POSE)] = array(-1, 4)  # Predicted poses.
    eta_reference: Annotated[Array, 3, Label("", parts=POSE, prefix="reference_")] = array(-1, 4)
    # Reference poses at the same nodes.
    tracking_error_m: Annotated[float, 4] = 0.0  # Distance from the reference at node 0.
    urgent: Annotated[bool, 5] = False  # Others give way to it.
    heard: Annotated[tuple[Uint32, ...], 7] = ()  # Robots whose plans it receives: only they may rely on it to give way.
    adrift: Annotated[bool, 8] = False  # It has no thrust, drifts as predicted, and gives way to nobody.


@dataclass(frozen=True, eq=False)
class BoardReading:
    """The last telemetry of a thruster board, as far as its robot acts on it. Values are finite and within a sensor's range.
    The robot's link to its board adds its own state (Telemetry of shoal/mavlink/agent_link.py)."""

    board_ms: Annotated[Int64, 1] = -1  # The board's time of the last burst; -1: none yet.
    arrival_ns: Annotated[Int64, 2] = 0
    # Instant of that burst's measurement on the robot's clock; when it was read, until the board's clock is known.
    heading_rad: Annotated[float, 3] = 0.0
    yaw_rate_radps: Annotated[float, 4] = 0.0
    # Rate of the heading; about its own axis, of a board that does not measure its tilt.
    acceleration_mps2: Annotated[Array, 5, Label("", parts=ACCELERATION[:3], prefix="acceleration_")] = array(3)
    # Specific force, in the body frame.
    tilt: Annotated[Array, 13] = array(-1)  # Roll, pitch [rad] and their rates [rad/s]; empty if not measured.
    depth_m: Annotated[float, 6, Label("Measured depth", "m")] = 0.0
    battery_v: Annotated[float, 7, Label("Battery", "V")] = 0.0
    # One raw measurement under the present load; meaningless before the first report.
    armed: Annotated[bool, 8] = False
    echo_us: Annotated[tuple[Uint32, ...], 9, Label("Echo", parts=CHANNELS, prefix="echo_")] = ()
    # Pulses that the board puts out: 4 thrusters, 4 ankles.
    loss: Annotated[float, 10, Label("Board messages lost")] = 0.0  # Fraction of the board's messages lost in the last 5 s.
    charge: Annotated[Uint32, 11] = 0  # MAV_BATTERY_CHARGE_STATE; 0: not known.
    battery_reports: Annotated[Uint32, 12] = 0  # Voltages received from the board.
    heartbeats: Annotated[Uint32, 14] = 0  # HEARTBEATs received from the board; 0: whether it is armed is not known.
    autopilot: Annotated[Uint32, 15] = 0  # MAV_AUTOPILOT of the board's HEARTBEAT: 0 or 8 for a thruster board.
    power_on_depth_m: Annotated[float, 16] = 0.0  # Depth at which the board was restarted; 0: not restarted.
    objection: Annotated[str, 17] = ""  # Reason not to arm, from the board's parameters.
    zero_in_question: Annotated[bool, 18] = False  # A person has to confirm the board's depth zero.


@dataclass(frozen=True, eq=False)
class Estimate:
    """A robot's estimate of its own motion and of the water."""

    eta: Annotated[Array, 1, Label("Estimated", parts=POSE)] = array(4)  # Pose.
    nu: Annotated[Array, 2, Label("Velocity", parts=VELOCITY)] = array(4)  # Velocity over ground.
    disturbance: Annotated[Array, 3, Label("Disturbance", parts=ACCELERATION, prefix="disturbance_")] = array(4)
    # Acceleration that the model in still water does not explain.
    drag_ratio: Annotated[float | None, 4, Label("Learned drag per mass, × the file's")] = None  # None if it is not learned.
    thrust_ratio: Annotated[float | None, 5, Label("Learned thrust per mass, × the file's")] = None
    # None if it is not learned.


@dataclass(frozen=True, eq=False)
class Control:
    """A control step's goal and result."""

    eta_reference: Annotated[Array, 1, Label("Reference", parts=POSE, prefix="reference_")] = array(4)
    # Pose on the trajectory: yaw is the tangent of the path.
    eta_command: Annotated[Array, 2, Label("Command", parts=POSE, prefix="command_")] = array(4)
    # Pose given to the controller: yaw includes crab angle and correction.
    wrench: Annotated[Array, 3, Label("Wrench asked for", parts=WRENCH)] = wrench_array()  # Within the limits.
    wrench_step: Annotated[Array, 4, Label("Wrench step", parts=WRENCH, prefix="step_")] = wrench_array()
    # Change of the wrench in this step.
    wrench_wanted: Annotated[Array, 5, Label("Wrench before limits", parts=WRENCH, prefix="wanted_")] = wrench_array()
    # The law's result before limits.
    wrench_delivered: Annotated[Array, 6, Label("Wrench delivered", parts=WRENCH, prefix="delivered_")] = wrench_array()
    # After allocation and limits, by the nominal curve.
    solve: Annotated[Solve, 7] = Solve.NONE
    iterations: Annotated[Uint32, 8, Label("Solver iterations")] = 0
    slack_m: Annotated[float, 9, Label("Plan in another's space", "m")] = 0.0
    # Depth by which the plan enters the space of another robot.


@dataclass(frozen=True, eq=False)
class StepTiming:
    """Ages of a step's inputs, and the time that it took."""

    pose_age_ms: Annotated[float | None, 1, Label("Age of the pose", "ms")] = None  # None until there was one.
    exposure_to_pwm_ms: Annotated[float | None, 2, Label("Exposure to PWM", "ms")] = None  # None until there was a pose.
    step_us: Annotated[float, 3, Label("Control step", "us")] = 0.0  # Duration of the whole control step.
    missed_deadlines: Annotated[Uint32, 4, Label("Missed deadlines")] = 0
    board_age_ms: Annotated[float | None, 5, Label("Age of the board's word", "ms")] = None  # None until it was heard.
    board_round_trip_ms: Annotated[float, 6, Label("Round trip to the board", "ms")] = 0.0
    board_clock_offset_s: Annotated[float, 7] = 0.0  # The board's clock minus the robot's clock.


@dataclass(frozen=True, eq=False)
class RobotState:
    """The result of one control step, as the robot knows it. The header's stamp is the step's instant."""

    mode: Annotated[Mode, 1] = Mode.DISARMED
    fault: Annotated[str, 2] = ""  # Reason why the robot holds, stopped or failed.
    guidance: Annotated[Guidance, 3] = Guidance.NONE  # What decides the robot's motion.
    experiment_hash: Annotated[str, 4] = ""
    tuning_id: Annotated[str, 5] = ""  # Id of the gains in use.
    code: Annotated[str, 6] = ""  # Version and commit.
    trajectory_s: Annotated[float, 7, Label("Time along the trajectory", "s")] = 0.0  # 0 until it is started.
    trajectory_id: Annotated[str, 8] = ""
    pulse_us: Annotated[tuple[Uint32, ...], 9, Label("Pulse", parts=CHANNELS, prefix="pulse_")] = ()
    # Widths sent to the board: 4 thrusters and 4 ankles, or 8 thrusters.
    track: Annotated[Track, 10] = Track.LOST
    heard: Annotated[tuple[Uint32, ...], 11] = ()  # Neighbours whose plans are fresh.
    blind: Annotated[str, 12] = ""  # Reason why obstacles are unknown although they should be watched for.
    thruster_test: Annotated[str, 13] = ""  # "", "running", "passed", or the fault that was found.
    estimate: Annotated[Estimate | None, 14] = None  # None until the robot knows its place.
    control: Annotated[Control | None, 15] = None  # None while the robot has no goal: neutral.
    board: Annotated[BoardReading | None, 16] = None  # Depth less the robot's `depth_offset_m`; None until it was heard.
    timing: Annotated[StepTiming, 17] = StepTiming()

    @property
    def doing(self) -> str:
        """The mode, and along a path what decides the motion: "tracking, giving way"."""
        along = self.mode is Mode.TRACKING and self.guidance is not Guidance.NONE
        return self.mode.name.lower() + (f", {self.guidance.name.lower().replace('_', ' ')}" if along else "")

    @property
    def error_m(self) -> float | None:
        """Distance from the goal; None without estimate or goal."""
        if self.estimate is None or self.control is None:
            return None
        return float(np.linalg.norm(self.estimate.eta[:3] - self.control.eta_reference[:3]))


@dataclass(frozen=True, eq=False)
class StationHeartbeat:
    """The station's sign of life, with the state of the emergency stop. In lockstep it also says that the station's commands
    for this step are sent, and which plans to wait for."""

    experiment_hash: Annotated[str, 1] = ""
    emergency_stop: Annotated[bool, 2] = False
    mission: Annotated[str, 3] = ""  # State of the mission, for people.
    lag_s: Annotated[float, 4] = 0.0  # Delay behind the timetable at the header's stamp.
    slowing: Annotated[float, 5] = 0.0  # Rate at which lag_s grows: 0 at full speed, 1 at standstill.
    planned: Annotated[tuple[Uint32, ...], 6] = ()  # Robots that published a plan in their last step.
    code: Annotated[str, 7] = ""  # Version and commit.
    out: Annotated[tuple[Uint32, ...], 8] = ()  # Robots that are out of the water.
    began_ns: Annotated[Int64, 9] = 0  # Begin of the flight on the station's clock; 0: not known.
    flight_s: Annotated[float, 10] = 0.0  # Planned end of the flight; 0: none, or on the way home.
    other_path: Annotated[bool, 11] = False  # A person gave another path, form or way than the experiment's.
    ready: Annotated[bool, 12] = False  # No flight is under way, and no check of the preflight keeps robots from one.
    sightings: Annotated[tuple[Uint32, ...], 13] = ()  # Robots whose plans no longer come, and which the camera sees,
    sightings_m: Annotated[Array, 14, columns("x_m", "y_m")] = array(-1, 2)  # where they are.


ALONE = "alone-"  # begins the id of a trajectory that one robot flies on its own, and whose clock is its own


@dataclass(frozen=True, eq=False)
class Trajectory:
    """One robot's reference trajectory, sampled every period_s from `begin_s` on. Yaw is the path's tangent, unwrapped."""

    id: Annotated[str, 1]
    period_s: Annotated[float, 2] = field(metadata=POSITIVE)
    eta: Annotated[Array, 3, Label("", parts=POSE)] = array(-1, 4)
    velocity: Annotated[Array, 4, columns("x_mps", "y_mps", "z_mps", "yaw_radps")] = array(-1, 4)
    # d eta / dt, in the pool frame.
    acceleration: Annotated[Array, 5, columns("x_mps2", "y_mps2", "z_mps2", "yaw_radps2")] = array(-1, 4)
    # d2 eta / dt2, in the pool frame.
    begin_s: Annotated[float, 6] = 0.0  # Time of the first sample along the trajectories.


@dataclass(frozen=True, eq=False)
class Tuning:
    """The weights and gains of the controller that can be changed in flight (shoal/messages/live_gains.py). The k-th key and
    the k-th value belong together."""

    id: Annotated[str, 1]  # Id of exactly these values.
    keys: Annotated[tuple[str, ...], 2] = ()  # Keys of the file, one for each entry of a list: `controller.mpc.q.0`.
    values: Annotated[Array, 3, columns("value")] = array(-1)


@dataclass(frozen=True, eq=False)
class DriveVelocity:
    """A velocity that a person asks of one robot, in its body frame."""

    surge_mps: Annotated[float, 1] = 0.0
    heave_mps: Annotated[float, 2] = 0.0  # Downwards.
    yaw_rate_radps: Annotated[float, 3] = 0.0


WHOLE_FLEET = 0  # orders to "robot 0" are requests to the station, for the whole fleet


@dataclass(frozen=True, eq=False)
class Command:
    """A command to one robot, or a request to the station (robot 0). It is applied at most once, by the process that it
    names, while the header's session is the station's and the command is younger than its time to live."""

    order: Annotated[CommandKind, 1]
    robot: Annotated[Uint32, 2]
    time_to_live_s: Annotated[float, 3] = 1.0
    experiment_hash: Annotated[str, 4] = ""
    trajectory_id: Annotated[str, 5] = ""
    start_in_s: Annotated[float, 6] = 0.0  # ADOPT: time of the change, counted from the header's stamp.
    trajectory_s: Annotated[float, 8] = 0.0  # START, RESUME: time along the timetable at start_ns. ADOPT: earliest time.
    trajectory: Annotated[Trajectory | None, 7] = None
    tuning_id: Annotated[str, 9] = ""  # ADOPT: id of the gains.
    tuning: Annotated[Tuning | None, 10] = None
    recipient: Annotated[Uint64, 11] = 0  # Session of the process that it is for. A restarted process refuses it.
    via: Annotated[Array, 12] = array(-1, 2)  # GO: places x, y for the centre of the formation.
    start_ns: Annotated[Int64, 13] = 0  # START, RESUME: instant on the station's clock.
    about: Annotated[Uint32, 15] = 0  # To the station, with NONE: number of the request whose outcome is asked for.
    drive: Annotated[DriveVelocity | None, 16] = None  # DRIVE: the velocity.
    text: Annotated[str, 17] = ""  # FORMATION: the form, `line 0.8`. FAULT: what breaks. PATH: the other experiment as TOML.


@dataclass(frozen=True, eq=False)
class Outcome:
    """The outcome of an operator's request so far, as the station sees it (groundstation/mission/request_progress.py)."""

    request: Annotated[Uint32, 1]  # Number of the request since the station's start, from 1.
    order: Annotated[CommandKind, 2] = CommandKind.NONE
    progress: Annotated[Progress, 3] = Progress.UNDER_WAY
    reason: Annotated[str, 4] = ""  # Reason of the failure, or the result.
    mission: Annotated[str, 5] = ""  # State of the mission.
    confirmed: Annotated[tuple[Uint32, ...], 6] = ()  # Robots that have reached the state that was requested.
    waiting: Annotated[tuple[Uint32, ...], 7] = ()  # Robots that have not.
    why: Annotated[tuple[str, ...], 8] = ()  # Reasons. The k-th belongs to the k-th robot of `waiting`.


@dataclass(frozen=True, eq=False)
class Reply:
    """A robot's reply to a command, or the station's reply to an operator's request."""

    robot: Annotated[Uint32, 1]
    accepted: Annotated[bool, 2]
    reason: Annotated[str, 3] = ""  # Reason of the refusal.
    mode: Annotated[Mode, 4] = Mode.DISARMED
    session: Annotated[Uint64, 5] = 0  # Session of the process that replies.
    silent: Annotated[bool, 6] = False  # No reply came in time. The asking process made this one itself.
    outcome: Annotated[Outcome | None, 7] = None  # Outcome of an operator's request, from the station.


@dataclass(frozen=True, eq=False)
class StepInputs:
    """All inputs of a robot's control step. The header's stamp is the step's instant.

    With the plans and the obstacles that it names, and the commands, the step can be repeated (`sim-bridge rerun`).
    Instants are on the robot's clock."""

    step: Annotated[Uint32, 1]  # Number of the step, 0, 1, 2 ..., since the robot's program began or met a new station.
    pose: Annotated[Pose | None, 2] = None
    pose_instant_ns: Annotated[Int64, 3] = 0  # Instant of the pose.
    pose_told_age_ns: Annotated[Int64, 4] = 0  # Age of the pose when the localizer sent it, as the localizer stated it.
    heartbeat: Annotated[StationHeartbeat | None, 5] = None
    station_session: Annotated[Uint64, 6] = 0
    station_stamp_ns: Annotated[Int64, 7] = 0  # Stamp of the heartbeat, on the station's clock.
    station_instant_ns: Annotated[Int64, 8] = 0  # Instant of the heartbeat, on the robot's clock.
    board: Annotated[BoardReading | None, 9] = None
    plan_robots: Annotated[tuple[Uint32, ...], 10] = ()  # Senders of the plans. The next three fields have one entry for each.
    plan_sessions: Annotated[tuple[Uint64, ...], 11] = ()  # Session in the header of each plan.
    plan_sequences: Annotated[tuple[Uint32, ...], 12] = ()  # Sequence number in the header of each plan.
    plan_instants_ns: Annotated[tuple[Int64, ...], 13] = ()  # Instant of the first node of each plan.
    obstacles_session: Annotated[Uint64, 14] = 0  # Session in the header of the Obstacles message; 0: none was received.
    obstacles_sequence: Annotated[Uint32, 15] = 0  # Sequence number in that header.
    obstacles_instant_ns: Annotated[Int64, 16] = 0  # Instant of those obstacles.
    late_steps: Annotated[Uint32, 17] = 0  # Late steps minus timely steps before this one, at least 0.


@dataclass(frozen=True, eq=False)
class FaultRequest:
    """A person's request to the simulator: something breaks now (docs/simulator.md)."""

    what: Annotated[str, 1] = ""  # As in --fault without its times; empty: everything that a person broke is whole again.
    for_s: Annotated[float, 2] = 0.0  # Time after which it is whole again; 0: never.


@dataclass(frozen=True, eq=False)
class CommandTaken:
    """A command that has reached a robot, with the reply. It is for the log only. The header's stamp is its arrival."""

    before_step: Annotated[Uint32, 1]  # Number of the robot's next control step.
    number: Annotated[Uint32, 2]  # Number of the command: 0, 1, 2 ..., counted from the same beginning as the steps.
    command_session: Annotated[Uint64, 3]  # Session in the command's header.
    command_sequence: Annotated[Uint32, 4]  # Sequence number in the command's header.
    command_stamp_ns: Annotated[Int64, 5]  # Stamp in the command's header.
    station_session: Annotated[Uint64, 6] = 0  # Session of the heartbeat that it was judged by, as in StepInputs.
    station_stamp_ns: Annotated[Int64, 7] = 0  # Stamp of that heartbeat.
    station_instant_ns: Annotated[Int64, 8] = 0  # Instant of that heartbeat, on the robot's clock.
    command: Annotated[Command | None, 9] = None
    reply: Annotated[Reply | None, 10] = None
    heartbeat: Annotated[StationHeartbeat | None, 11] = None


@dataclass(frozen=True, eq=False)
class Frame:
    """A camera picture: (height, width) uint8 raw Bayer RGGB. On the wire a foxglove.RawImage `bayer_rggb8`.

    Between the programs of one `sim-bridge sil` its encoding is `shared_memory`, and its data are slot u32 and number u64,
    little-endian, of the picture in their ring (`shoal/bus/frame_ring.py`).
    """

    pixels: NDArray[np.uint8]


@dataclass(frozen=True, eq=False)
class Preview:
    """A JPEG for people. On the wire a foxglove.CompressedImage."""

    jpeg: bytes


@dataclass(frozen=True, eq=False)
class Video:
    """One picture of a video: H.264 in Annex B form without B-frames. On the wire a foxglove.CompressedVideo."""

    h264: bytes


@dataclass(frozen=True, eq=False)
class Picture:
    """One camera picture as JPEG, without drawings. On the wire a foxglove.CompressedImage."""

    jpeg: bytes


@dataclass(frozen=True, eq=False)
class Event:
    """A line of the log. On the wire a foxglove.Log."""

    level: int  # Foxglove's levels: 1 debug, 2 info, 3 warning, 4 error, 5 fatal.
    source: str
    message: str


Message = (
    Tick | Truth | Pose | LocalizerStatus | Obstacles | Plan | RobotState | Estimate | Control | StepTiming | StationHeartbeat
    | Trajectory | Tuning | DriveVelocity | Command | Outcome | Reply | BoardReading | StepInputs | FaultRequest | CommandTaken
    | Frame | Preview | Video | Picture | Event
)  # fmt: skip
