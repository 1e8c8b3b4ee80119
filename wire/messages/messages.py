"""Every message of the fleet as a frozen dataclass. The wire form is wire/messages/fleet.proto; wire/messages/codec.py maps
the two by name.

`eta` is a pose [x_m, y_m, z_m, yaw_rad] in the pool frame, `nu` a velocity [surge, sway, heave m/s, yaw rad/s] in the body
frame, a wrench [surge N, heave N, yaw N m]; see wire/frames.py. Array fields state their shape; -1 is any length, but one
length for all of a message.
"""

from dataclasses import dataclass, field
from enum import IntEnum
from typing import Any

import numpy as np
from numpy.typing import NDArray

from wire.frames import Array


def array(*shape: int) -> Any:
    """An array field: float64, finite, of this shape. Empty by default."""
    empty = tuple(0 if n == -1 else n for n in shape)
    return field(default_factory=lambda: np.zeros(empty), metadata={"shape": shape})


def later_array(*shape: int) -> Any:
    """An array field that messages of earlier versions do not have: theirs are as many zeros as the other arrays have rows."""
    empty = tuple(0 if n == -1 else n for n in shape)
    return field(default_factory=lambda: np.zeros(empty), metadata={"shape": shape, "later": True})


def row_numbers() -> Any:
    """A field of integers, one for each row of the message's arrays: whose it is."""
    return field(default=(), metadata={"each_row": True})


POSITIVE = {"positive": True}  # metadata of a float that others divide by


class Track(IntEnum):
    """How a pose came about, worst to best."""

    LOST = 0
    COAST = 1  # predicted only
    KCF = 2
    MARKER = 3


class Mode(IntEnum):
    """What a robot is doing (robot_agent/safety/modes.py has the table of transitions)."""

    DISARMED = 0
    ARMED = 1  # thrusters at neutral, ready to start
    TRACKING = 2
    HOLDING = 3  # keeps its station
    STOPPED = 4  # emergency stop, latched until cleared
    FAULT = 5


class Solve(IntEnum):
    """What became of this step's optimisation."""

    NONE = 0  # none was asked for
    SOLVED = 1
    SHIFTED = 2  # the previous plan, moved on by one step
    FAILED = 3  # neutral


class Order(IntEnum):
    """Commands from the station to one robot."""

    NONE = 0
    LOAD = 1
    ARM = 2
    START = 3
    HOLD = 4
    RESUME = 5
    STOP = 6
    DISARM = 7
    CLEAR_STOP = 8
    TUNE = 9  # check these gains and keep them ready; nothing changes yet
    ADOPT = 10  # fly with the gains that are ready
    RETURN = 11  # to the station only: everybody back to where it started
    REJOIN = 12  # to the station only: robots that fell out take their places again
    GO = 13  # to the station only: on to other places than planned
    SWITCH = 14  # go over to the trajectory loaded under way, where that begins
    TEST = 15  # pulse each thruster, and watch what the board says it put out
    END = 20  # to the station only: disarm everybody, then end the run


class Progress(IntEnum):
    """How far a person's request has come."""

    UNDER_WAY = 0
    DONE = 1
    FAILED = 2


class CameraHealth(IntEnum):
    """What the localizer thinks of its pictures."""

    ABSENT = 0
    OK = 1
    FROZEN = 2
    BLACK = 3
    WRONG_SIZE = 4


@dataclass(frozen=True, eq=False)
class Tick:
    """Lockstep: the simulator's clock. A process acts when the inputs named here have reached it."""

    now_ns: int  # simulated time of this control step
    previous_ns: int  # of the one before: stamp of the plans and states to use
    frame_ns: int  # stamp of the newest camera frame that counts at this step
    robots: tuple[int, ...] = ()  # who takes part
    board_ms: tuple[int, ...] = ()  # per robot: board time of the last sensor burst that counts


@dataclass(frozen=True, eq=False)
class Truth:
    """The simulated plant's true state; nobody who controls may read it."""

    robots: tuple[int, ...] = row_numbers()
    eta: Array = array(-1, 4)
    nu: Array = array(-1, 4)
    wrench: Array = array(-1, 3)  # delivered by the thrusters
    disturbance: Array = array(-1, 4)  # acceleration that the nominal model does not explain, body frame


@dataclass(frozen=True, eq=False)
class Pose:
    """Where the localizer saw a robot's centre at the header's stamp (middle of the exposure)."""

    x_m: float
    y_m: float
    yaw_rad: float
    covariance: Array = array(3, 3)  # of x, y, yaw: m^2, m rad, rad^2
    track: Track = Track.LOST
    identity_verified: bool = False  # a marker has been read since the robot was last near another
    peak: float = 0.0  # of the correlation, 0 to 1
    depth_m: float = 0.0  # depth of the centre that the refraction was computed with


@dataclass(frozen=True, eq=False)
class LocalizerStatus:
    """The localizer's own health, once per frame."""

    camera: CameraHealth = CameraHealth.ABSENT
    frames: int = 0
    dropped: int = 0
    frame_ms: float = 0.0  # processing time of the last frame
    frame_age_ms: float = 0.0  # exposure to publish
    message: str = ""
    robots: tuple[int, ...] = ()  # whose poses in this picture are told
    obstacles_ns: int = -1  # stamp of the newest Obstacles told before them; -1: none yet
    failed: int = 0  # pictures skipped since the start, because localizing in them raised an error


@dataclass(frozen=True, eq=False)
class Obstacles:
    """What the camera sees in the pool that is no robot; all of them in one message, so that one that has gone is gone.

    Each has a convex outline of twelve corners (some may coincide), in order from x to y, as it lies if the obstacle is at
    `depth_m`: a camera alone cannot tell how deep. The k-th of all arrays and of `ids` belong together.
    """

    ids: tuple[int, ...] = row_numbers()  # an obstacle keeps its number while it is followed; no number is used twice
    outline: Array = array(-1, 12, 2)  # x, y
    velocity: Array = array(-1, 2)  # over the floor, pool frame
    depth_m: float = 0.0  # assumed: that of the robots' path, where an obstacle would be in their way
    watched: float = 0.0  # share of the pool that can be judged, 0 to 1: an empty list says nothing about the rest
    blind: str = ""  # why too little of it can be judged for the list to mean anything; empty: it means what it says
    unseen_s: Array = later_array(-1)  # for how long each has not been seen: the rest is of that long before the stamp


@dataclass(frozen=True, eq=False)
class Plan:
    """Where a robot expects to be: node s at the header's stamp + s * period_s; node 0 is the estimate."""

    period_s: float = field(metadata=POSITIVE)
    eta: Array = array(-1, 4)
    eta_reference: Array = array(-1, 4)
    tracking_error_m: float = 0.0
    urgent: bool = False
    heard: tuple[int, ...] = ()  # robots whose plans it hears: only they may count on it to give way


@dataclass(frozen=True, eq=False)
class RobotState:
    """One control step, as the robot saw it; the header's stamp is the step's instant."""

    mode: Mode = Mode.DISARMED
    fault: str = ""  # why it holds, stopped or failed; empty when all is well
    experiment_hash: str = ""
    tuning_id: str = ""  # of the gains it flies with
    trajectory_s: float = 0.0  # time along the trajectory; 0 until started
    trajectory_id: str = ""
    eta: Array = array(4)  # estimated
    nu: Array = array(4)
    disturbance: Array = array(4)  # estimated acceleration, body frame [m/s^2, rad/s^2]
    eta_reference: Array = array(4)  # of the trajectory: yaw is the path's tangent
    eta_command: Array = array(4)  # what the controller was given: yaw with crab angle and correction
    wrench: Array = array(3)  # asked for, within the limits
    wrench_step: Array = array(3)  # its change in this step
    wrench_wanted: Array = array(3)  # what the control law came to before magnitude and rate were limited
    wrench_delivered: Array = array(3)  # after allocation and limits, by the nominal thrust curve
    pulse_us: tuple[int, ...] = ()  # 4 thrusters, 4 ankles
    echo_us: tuple[int, ...] = ()  # what the board says it put out
    track: Track = Track.LOST
    pose_age_ms: float = 0.0
    exposure_to_pwm_ms: float = 0.0
    depth_m: float = 0.0  # measured
    battery_v: float = 0.0
    board_armed: bool = False
    board_age_ms: float = 0.0
    board_loss: float = 0.0  # fraction of the board's messages lost, last 5 s
    board_round_trip_ms: float = 0.0  # to the board and back, last measured
    board_clock_offset_s: float = 0.0  # the board's clock minus the robot's
    solve: Solve = Solve.NONE
    iterations: int = 0
    step_us: float = 0.0  # the whole control step
    missed_deadlines: int = 0
    slack_m: float = 0.0  # by how much the plan enters the space of another robot
    thruster_test: str = ""  # "", "running", "passed", or what was wrong
    heard: tuple[int, ...] = ()  # neighbours whose plans are fresh
    planned: bool = False  # and to whom it told its own in this step; not while it does not know where it is
    blind: str = ""  # why it does not know of obstacles though somebody should watch for them; empty when it does


@dataclass(frozen=True, eq=False)
class StationHeartbeat:
    """The station is alive, and whether the red button is down. In lockstep it also says: my orders for this step are out, and
    these are the plans to wait for."""

    experiment_hash: str = ""
    emergency_stop: bool = False
    mission: str = ""  # the mission's state, for people
    lag_s: float = 0.0  # by how much the virtual structure is behind its timetable at the header's stamp
    slowing: float = 0.0  # and how fast that grows: 0 at full pace, 1 where it stands
    planned: tuple[int, ...] = ()  # robots that told a plan in their last step, as far as heard


@dataclass(frozen=True, eq=False)
class Trajectory:
    """One robot's reference, sampled every period_s from `begin_s` on. Yaw is the path's tangent, unwrapped."""

    id: str
    period_s: float = field(metadata=POSITIVE)
    eta: Array = array(-1, 4)
    velocity: Array = array(-1, 4)  # d eta / dt, pool frame
    acceleration: Array = array(-1, 4)  # d2 eta / dt2, pool frame
    begin_s: float = 0.0  # of the first sample, on the clock that runs along the trajectories


@dataclass(frozen=True, eq=False)
class Tuning:
    """Weights and gains of the controller, all that can be changed in flight (wire/messages/live_gains.py). The k-th of both
    belong together."""

    id: str  # of exactly these values
    keys: tuple[str, ...] = ()  # of the experiment file, a list's entries one by one: `controller.mpc.q.0`
    values: Array = array(-1)


@dataclass(frozen=True, eq=False)
class Command:
    """An order to one robot. Applied at most once, by the process that it is for, and only while the header's session is the
    station's and the order is younger than its time to live."""

    order: Order
    robot: int
    time_to_live_s: float = 1.0
    experiment_hash: str = ""
    trajectory_id: str = ""
    start_in_s: float = 0.0  # ADOPT: when, counted from the header's stamp
    trajectory_s: float = (
        0.0  # START, RESUME: the timetable at start_ns (less the station's lag, where to be); ADOPT: not before
    )
    trajectory: Trajectory | None = None
    tuning_id: str = ""  # ADOPT: which
    tuning: Tuning | None = None
    recipient: int = 0  # session of the process that it is for, as its replies tell it: an earlier life's orders are void
    via: Array = array(-1, 2)  # GO: places for the formation's centre, x, y
    start_ns: int = 0  # START, RESUME: when, on the station's clock; 0 (older logs): start_in_s after the header's stamp
    about: int = 0  # to the station, with NONE: the number of the request whose outcome is asked for


@dataclass(frozen=True, eq=False)
class Outcome:
    """What has become of a person's request so far, by the station's account (groundstation/mission/request_progress.py)."""

    request: int  # its number in the station's life, from 1
    order: Order = Order.NONE
    progress: Progress = Progress.UNDER_WAY
    reason: str = ""  # why it failed, or what it led to
    mission: str = ""  # the mission's state
    confirmed: tuple[int, ...] = ()  # robots that are where the request wants them
    waiting: tuple[int, ...] = ()  # robots that are not
    why: tuple[str, ...] = ()  # the k-th belongs to the k-th of `waiting`


@dataclass(frozen=True, eq=False)
class Reply:
    """A robot's answer to a command; the station's to a person's request."""

    robot: int
    accepted: bool
    reason: str = ""  # why not
    mode: Mode = Mode.DISARMED
    session: int = 0  # of the process that answers
    silent: bool = False  # nobody answered in time: made by whoever asked
    outcome: Outcome | None = None  # of a person's request, from the station


@dataclass(frozen=True, eq=False)
class BoardReading:
    """What a thruster board said last, as far as its robot acts on it (wire/mavlink/agent_link.py, Telemetry)."""

    board_ms: int = -1  # the board's time of the last burst; -1: none yet
    arrival_ns: int = 0  # when it was measured, on the robot's clock; when it was read, while the board's clock is not known
    heading_rad: float = 0.0
    yaw_rate_radps: float = 0.0
    acceleration_mps2: Array = array(3)  # specific force, body frame
    depth_m: float = 0.0
    battery_v: float = 0.0
    armed: bool = False
    echo_us: tuple[int, ...] = ()
    loss: float = 0.0  # fraction of the board's messages lost, last 5 s
    charge: int = 0  # how low the board takes the battery to be: MAV_BATTERY_CHARGE_STATE, 0 not known
    battery_reports: int = 0  # how many voltages the board has told; 0: none yet, or an old log


@dataclass(frozen=True, eq=False)
class StepInputs:
    """Everything that a robot's control step had to go by; the header's stamp is the step's instant. With the plans and the
    obstacles that it names, and the orders, the step can be done again (`groundstation log rerun`). Instants are on a robot's
    clock."""

    step: int  # 0, 1, 2 ... since the robot's program began, or met a new station
    pose: Pose | None = None
    pose_instant_ns: int = 0  # when it was true
    pose_told_age_ns: int = 0  # how old the localizer says it was when it was sent
    heartbeat: StationHeartbeat | None = None
    station_session: int = 0
    station_stamp_ns: int = 0  # of the heartbeat, on the station's clock,
    station_instant_ns: int = 0  # and on the robot's
    board: BoardReading | None = None
    plan_robots: tuple[int, ...] = ()  # whose plans; the k-th of the next three belong to the k-th robot
    plan_sessions: tuple[int, ...] = ()  # of the plan's header,
    plan_sequences: tuple[int, ...] = ()  # as is this
    plan_instants_ns: tuple[int, ...] = ()  # of the plan's first node
    obstacles_session: int = 0  # of the message's header; 0: none has been heard
    obstacles_sequence: int = 0
    obstacles_instant_ns: int = 0  # when it was so
    late_steps: int = 0  # by how much late steps outnumber timely ones, before this one: +1 for a late one, -1 for another


@dataclass(frozen=True, eq=False)
class OrderTaken:
    """An order that has reached a robot, and its answer; for the log, nobody obeys it. The header's stamp is when."""

    before_step: int  # the robot's next control step
    number: int  # of the order: 0, 1, 2 ... with the same beginning as the steps
    order_session: int  # of the order's header,
    order_sequence: int  # as is this
    order_stamp_ns: int  # and this
    station_session: int = 0  # the heartbeat it was judged by, as in StepInputs
    station_stamp_ns: int = 0
    station_instant_ns: int = 0
    command: Command | None = None
    reply: Reply | None = None


@dataclass(frozen=True, eq=False)
class Frame:
    """A camera picture: (height, width) uint8 raw Bayer RGGB. On the wire a foxglove.RawImage `bayer_rggb8`."""

    pixels: NDArray[np.uint8]


@dataclass(frozen=True, eq=False)
class Preview:
    """A JPEG for people. On the wire a foxglove.CompressedImage."""

    jpeg: bytes


@dataclass(frozen=True, eq=False)
class Video:
    """One picture of a film: H.264 in Annex B form, nothing that looks ahead. On the wire a foxglove.CompressedVideo."""

    h264: bytes


@dataclass(frozen=True, eq=False)
class Picture:
    """One picture of the camera as JPEG, nothing drawn on it. On the wire a foxglove.CompressedImage."""

    jpeg: bytes


@dataclass(frozen=True, eq=False)
class Event:
    """Something worth a line in the log. On the wire a foxglove.Log."""

    level: int  # foxglove: 1 debug, 2 info, 3 warning, 4 error, 5 fatal
    source: str
    message: str


Message = (
    Tick | Truth | Pose | LocalizerStatus | Obstacles | Plan | RobotState | StationHeartbeat | Trajectory | Tuning | Command
    | Outcome | Reply | BoardReading | StepInputs | OrderTaken | Frame | Preview | Video | Picture | Event
)  # fmt: skip
