from google.protobuf.internal import containers as _containers
from google.protobuf.internal import enum_type_wrapper as _enum_type_wrapper
from google.protobuf import descriptor as _descriptor
from google.protobuf import message as _message
from collections.abc import Iterable as _Iterable, Mapping as _Mapping
from typing import ClassVar as _ClassVar, Optional as _Optional, Union as _Union

DESCRIPTOR: _descriptor.FileDescriptor

class Track(int, metaclass=_enum_type_wrapper.EnumTypeWrapper):
    __slots__ = ()
    TRACK_LOST: _ClassVar[Track]
    TRACK_COAST: _ClassVar[Track]
    TRACK_KCF: _ClassVar[Track]
    TRACK_MARKER: _ClassVar[Track]

class Mode(int, metaclass=_enum_type_wrapper.EnumTypeWrapper):
    __slots__ = ()
    MODE_DISARMED: _ClassVar[Mode]
    MODE_ARMED: _ClassVar[Mode]
    MODE_TRACKING: _ClassVar[Mode]
    MODE_HOLDING: _ClassVar[Mode]
    MODE_STOPPED: _ClassVar[Mode]
    MODE_FAULT: _ClassVar[Mode]
    MODE_DRIVEN: _ClassVar[Mode]

class Guidance(int, metaclass=_enum_type_wrapper.EnumTypeWrapper):
    __slots__ = ()
    GUIDANCE_NONE: _ClassVar[Guidance]
    GUIDANCE_JOINING: _ClassVar[Guidance]
    GUIDANCE_ON_PATH: _ClassVar[Guidance]
    GUIDANCE_GIVING_WAY: _ClassVar[Guidance]
    GUIDANCE_RETURNING: _ClassVar[Guidance]
    GUIDANCE_HOLDING: _ClassVar[Guidance]
    GUIDANCE_DRIVEN: _ClassVar[Guidance]

class Solve(int, metaclass=_enum_type_wrapper.EnumTypeWrapper):
    __slots__ = ()
    SOLVE_NONE: _ClassVar[Solve]
    SOLVE_SOLVED: _ClassVar[Solve]
    SOLVE_SHIFTED: _ClassVar[Solve]
    SOLVE_FAILED: _ClassVar[Solve]

class Order(int, metaclass=_enum_type_wrapper.EnumTypeWrapper):
    __slots__ = ()
    ORDER_NONE: _ClassVar[Order]
    ORDER_LOAD: _ClassVar[Order]
    ORDER_ARM: _ClassVar[Order]
    ORDER_START: _ClassVar[Order]
    ORDER_HOLD: _ClassVar[Order]
    ORDER_RESUME: _ClassVar[Order]
    ORDER_STOP: _ClassVar[Order]
    ORDER_DISARM: _ClassVar[Order]
    ORDER_CLEAR_STOP: _ClassVar[Order]
    ORDER_TUNE: _ClassVar[Order]
    ORDER_ADOPT: _ClassVar[Order]
    ORDER_RETURN: _ClassVar[Order]
    ORDER_REJOIN: _ClassVar[Order]
    ORDER_GO: _ClassVar[Order]
    ORDER_SWITCH: _ClassVar[Order]
    ORDER_TEST: _ClassVar[Order]
    ORDER_END: _ClassVar[Order]
    ORDER_DRIVE: _ClassVar[Order]
    ORDER_OUT: _ClassVar[Order]
    ORDER_BACK_IN: _ClassVar[Order]
    ORDER_FORMATION: _ClassVar[Order]
    ORDER_FAULT: _ClassVar[Order]

class Progress(int, metaclass=_enum_type_wrapper.EnumTypeWrapper):
    __slots__ = ()
    PROGRESS_UNDER_WAY: _ClassVar[Progress]
    PROGRESS_DONE: _ClassVar[Progress]
    PROGRESS_FAILED: _ClassVar[Progress]

class CameraHealth(int, metaclass=_enum_type_wrapper.EnumTypeWrapper):
    __slots__ = ()
    CAMERA_ABSENT: _ClassVar[CameraHealth]
    CAMERA_OK: _ClassVar[CameraHealth]
    CAMERA_FROZEN: _ClassVar[CameraHealth]
    CAMERA_BLACK: _ClassVar[CameraHealth]
    CAMERA_WRONG_SIZE: _ClassVar[CameraHealth]
TRACK_LOST: Track
TRACK_COAST: Track
TRACK_KCF: Track
TRACK_MARKER: Track
MODE_DISARMED: Mode
MODE_ARMED: Mode
MODE_TRACKING: Mode
MODE_HOLDING: Mode
MODE_STOPPED: Mode
MODE_FAULT: Mode
MODE_DRIVEN: Mode
GUIDANCE_NONE: Guidance
GUIDANCE_JOINING: Guidance
GUIDANCE_ON_PATH: Guidance
GUIDANCE_GIVING_WAY: Guidance
GUIDANCE_RETURNING: Guidance
GUIDANCE_HOLDING: Guidance
GUIDANCE_DRIVEN: Guidance
SOLVE_NONE: Solve
SOLVE_SOLVED: Solve
SOLVE_SHIFTED: Solve
SOLVE_FAILED: Solve
ORDER_NONE: Order
ORDER_LOAD: Order
ORDER_ARM: Order
ORDER_START: Order
ORDER_HOLD: Order
ORDER_RESUME: Order
ORDER_STOP: Order
ORDER_DISARM: Order
ORDER_CLEAR_STOP: Order
ORDER_TUNE: Order
ORDER_ADOPT: Order
ORDER_RETURN: Order
ORDER_REJOIN: Order
ORDER_GO: Order
ORDER_SWITCH: Order
ORDER_TEST: Order
ORDER_END: Order
ORDER_DRIVE: Order
ORDER_OUT: Order
ORDER_BACK_IN: Order
ORDER_FORMATION: Order
ORDER_FAULT: Order
PROGRESS_UNDER_WAY: Progress
PROGRESS_DONE: Progress
PROGRESS_FAILED: Progress
CAMERA_ABSENT: CameraHealth
CAMERA_OK: CameraHealth
CAMERA_FROZEN: CameraHealth
CAMERA_BLACK: CameraHealth
CAMERA_WRONG_SIZE: CameraHealth

class Tick(_message.Message):
    __slots__ = ("now_ns", "previous_ns", "frame_ns", "robots", "board_ms", "frames_ns")
    NOW_NS_FIELD_NUMBER: _ClassVar[int]
    PREVIOUS_NS_FIELD_NUMBER: _ClassVar[int]
    FRAME_NS_FIELD_NUMBER: _ClassVar[int]
    ROBOTS_FIELD_NUMBER: _ClassVar[int]
    BOARD_MS_FIELD_NUMBER: _ClassVar[int]
    FRAMES_NS_FIELD_NUMBER: _ClassVar[int]
    now_ns: int
    previous_ns: int
    frame_ns: int
    robots: _containers.RepeatedScalarFieldContainer[int]
    board_ms: _containers.RepeatedScalarFieldContainer[int]
    frames_ns: _containers.RepeatedScalarFieldContainer[int]
    def __init__(self, now_ns: _Optional[int] = ..., previous_ns: _Optional[int] = ..., frame_ns: _Optional[int] = ..., robots: _Optional[_Iterable[int]] = ..., board_ms: _Optional[_Iterable[int]] = ..., frames_ns: _Optional[_Iterable[int]] = ...) -> None: ...

class Truth(_message.Message):
    __slots__ = ("robots", "eta", "nu", "wrench", "disturbance")
    ROBOTS_FIELD_NUMBER: _ClassVar[int]
    ETA_FIELD_NUMBER: _ClassVar[int]
    NU_FIELD_NUMBER: _ClassVar[int]
    WRENCH_FIELD_NUMBER: _ClassVar[int]
    DISTURBANCE_FIELD_NUMBER: _ClassVar[int]
    robots: _containers.RepeatedScalarFieldContainer[int]
    eta: _containers.RepeatedScalarFieldContainer[float]
    nu: _containers.RepeatedScalarFieldContainer[float]
    wrench: _containers.RepeatedScalarFieldContainer[float]
    disturbance: _containers.RepeatedScalarFieldContainer[float]
    def __init__(self, robots: _Optional[_Iterable[int]] = ..., eta: _Optional[_Iterable[float]] = ..., nu: _Optional[_Iterable[float]] = ..., wrench: _Optional[_Iterable[float]] = ..., disturbance: _Optional[_Iterable[float]] = ...) -> None: ...

class Pose(_message.Message):
    __slots__ = ("x_m", "y_m", "yaw_rad", "covariance", "track", "identity_verified", "peak", "depth_m")
    X_M_FIELD_NUMBER: _ClassVar[int]
    Y_M_FIELD_NUMBER: _ClassVar[int]
    YAW_RAD_FIELD_NUMBER: _ClassVar[int]
    COVARIANCE_FIELD_NUMBER: _ClassVar[int]
    TRACK_FIELD_NUMBER: _ClassVar[int]
    IDENTITY_VERIFIED_FIELD_NUMBER: _ClassVar[int]
    PEAK_FIELD_NUMBER: _ClassVar[int]
    DEPTH_M_FIELD_NUMBER: _ClassVar[int]
    x_m: float
    y_m: float
    yaw_rad: float
    covariance: _containers.RepeatedScalarFieldContainer[float]
    track: Track
    identity_verified: bool
    peak: float
    depth_m: float
    def __init__(self, x_m: _Optional[float] = ..., y_m: _Optional[float] = ..., yaw_rad: _Optional[float] = ..., covariance: _Optional[_Iterable[float]] = ..., track: _Optional[_Union[Track, str]] = ..., identity_verified: _Optional[bool] = ..., peak: _Optional[float] = ..., depth_m: _Optional[float] = ...) -> None: ...

class LocalizerStatus(_message.Message):
    __slots__ = ("camera", "frames", "dropped", "frame_ms", "frame_age_ms", "message", "robots", "obstacles_ns", "failed", "out", "moved", "marks_seen", "code", "experiment_hash")
    CAMERA_FIELD_NUMBER: _ClassVar[int]
    FRAMES_FIELD_NUMBER: _ClassVar[int]
    DROPPED_FIELD_NUMBER: _ClassVar[int]
    FRAME_MS_FIELD_NUMBER: _ClassVar[int]
    FRAME_AGE_MS_FIELD_NUMBER: _ClassVar[int]
    MESSAGE_FIELD_NUMBER: _ClassVar[int]
    ROBOTS_FIELD_NUMBER: _ClassVar[int]
    OBSTACLES_NS_FIELD_NUMBER: _ClassVar[int]
    FAILED_FIELD_NUMBER: _ClassVar[int]
    OUT_FIELD_NUMBER: _ClassVar[int]
    MOVED_FIELD_NUMBER: _ClassVar[int]
    MARKS_SEEN_FIELD_NUMBER: _ClassVar[int]
    CODE_FIELD_NUMBER: _ClassVar[int]
    EXPERIMENT_HASH_FIELD_NUMBER: _ClassVar[int]
    camera: CameraHealth
    frames: int
    dropped: int
    frame_ms: float
    frame_age_ms: float
    message: str
    robots: _containers.RepeatedScalarFieldContainer[int]
    obstacles_ns: int
    failed: int
    out: _containers.RepeatedScalarFieldContainer[str]
    moved: bool
    marks_seen: bool
    code: str
    experiment_hash: str
    def __init__(self, camera: _Optional[_Union[CameraHealth, str]] = ..., frames: _Optional[int] = ..., dropped: _Optional[int] = ..., frame_ms: _Optional[float] = ..., frame_age_ms: _Optional[float] = ..., message: _Optional[str] = ..., robots: _Optional[_Iterable[int]] = ..., obstacles_ns: _Optional[int] = ..., failed: _Optional[int] = ..., out: _Optional[_Iterable[str]] = ..., moved: _Optional[bool] = ..., marks_seen: _Optional[bool] = ..., code: _Optional[str] = ..., experiment_hash: _Optional[str] = ...) -> None: ...

class Obstacles(_message.Message):
    __slots__ = ("ids", "outline", "velocity", "depth_m", "watched", "blind", "unseen_s")
    IDS_FIELD_NUMBER: _ClassVar[int]
    OUTLINE_FIELD_NUMBER: _ClassVar[int]
    VELOCITY_FIELD_NUMBER: _ClassVar[int]
    DEPTH_M_FIELD_NUMBER: _ClassVar[int]
    WATCHED_FIELD_NUMBER: _ClassVar[int]
    BLIND_FIELD_NUMBER: _ClassVar[int]
    UNSEEN_S_FIELD_NUMBER: _ClassVar[int]
    ids: _containers.RepeatedScalarFieldContainer[int]
    outline: _containers.RepeatedScalarFieldContainer[float]
    velocity: _containers.RepeatedScalarFieldContainer[float]
    depth_m: float
    watched: float
    blind: str
    unseen_s: _containers.RepeatedScalarFieldContainer[float]
    def __init__(self, ids: _Optional[_Iterable[int]] = ..., outline: _Optional[_Iterable[float]] = ..., velocity: _Optional[_Iterable[float]] = ..., depth_m: _Optional[float] = ..., watched: _Optional[float] = ..., blind: _Optional[str] = ..., unseen_s: _Optional[_Iterable[float]] = ...) -> None: ...

class Plan(_message.Message):
    __slots__ = ("period_s", "eta", "eta_reference", "tracking_error_m", "urgent", "heard", "adrift")
    PERIOD_S_FIELD_NUMBER: _ClassVar[int]
    ETA_FIELD_NUMBER: _ClassVar[int]
    ETA_REFERENCE_FIELD_NUMBER: _ClassVar[int]
    TRACKING_ERROR_M_FIELD_NUMBER: _ClassVar[int]
    URGENT_FIELD_NUMBER: _ClassVar[int]
    HEARD_FIELD_NUMBER: _ClassVar[int]
    ADRIFT_FIELD_NUMBER: _ClassVar[int]
    period_s: float
    eta: _containers.RepeatedScalarFieldContainer[float]
    eta_reference: _containers.RepeatedScalarFieldContainer[float]
    tracking_error_m: float
    urgent: bool
    heard: _containers.RepeatedScalarFieldContainer[int]
    adrift: bool
    def __init__(self, period_s: _Optional[float] = ..., eta: _Optional[_Iterable[float]] = ..., eta_reference: _Optional[_Iterable[float]] = ..., tracking_error_m: _Optional[float] = ..., urgent: _Optional[bool] = ..., heard: _Optional[_Iterable[int]] = ..., adrift: _Optional[bool] = ...) -> None: ...

class RobotState(_message.Message):
    __slots__ = ("mode", "fault", "experiment_hash", "trajectory_s", "trajectory_id", "eta", "nu", "disturbance", "eta_reference", "eta_command", "wrench", "wrench_step", "wrench_delivered", "wrench_wanted", "pulse_us", "echo_us", "track", "pose_age_ms", "exposure_to_pwm_ms", "depth_m", "battery_v", "board_armed", "board_age_ms", "board_loss", "solve", "iterations", "step_us", "missed_deadlines", "slack_m", "heard", "tuning_id", "board_round_trip_ms", "board_clock_offset_s", "thruster_test", "planned", "blind", "tilt", "drag_ratio", "thrust_ratio", "code", "guidance")
    MODE_FIELD_NUMBER: _ClassVar[int]
    FAULT_FIELD_NUMBER: _ClassVar[int]
    EXPERIMENT_HASH_FIELD_NUMBER: _ClassVar[int]
    TRAJECTORY_S_FIELD_NUMBER: _ClassVar[int]
    TRAJECTORY_ID_FIELD_NUMBER: _ClassVar[int]
    ETA_FIELD_NUMBER: _ClassVar[int]
    NU_FIELD_NUMBER: _ClassVar[int]
    DISTURBANCE_FIELD_NUMBER: _ClassVar[int]
    ETA_REFERENCE_FIELD_NUMBER: _ClassVar[int]
    ETA_COMMAND_FIELD_NUMBER: _ClassVar[int]
    WRENCH_FIELD_NUMBER: _ClassVar[int]
    WRENCH_STEP_FIELD_NUMBER: _ClassVar[int]
    WRENCH_DELIVERED_FIELD_NUMBER: _ClassVar[int]
    WRENCH_WANTED_FIELD_NUMBER: _ClassVar[int]
    PULSE_US_FIELD_NUMBER: _ClassVar[int]
    ECHO_US_FIELD_NUMBER: _ClassVar[int]
    TRACK_FIELD_NUMBER: _ClassVar[int]
    POSE_AGE_MS_FIELD_NUMBER: _ClassVar[int]
    EXPOSURE_TO_PWM_MS_FIELD_NUMBER: _ClassVar[int]
    DEPTH_M_FIELD_NUMBER: _ClassVar[int]
    BATTERY_V_FIELD_NUMBER: _ClassVar[int]
    BOARD_ARMED_FIELD_NUMBER: _ClassVar[int]
    BOARD_AGE_MS_FIELD_NUMBER: _ClassVar[int]
    BOARD_LOSS_FIELD_NUMBER: _ClassVar[int]
    SOLVE_FIELD_NUMBER: _ClassVar[int]
    ITERATIONS_FIELD_NUMBER: _ClassVar[int]
    STEP_US_FIELD_NUMBER: _ClassVar[int]
    MISSED_DEADLINES_FIELD_NUMBER: _ClassVar[int]
    SLACK_M_FIELD_NUMBER: _ClassVar[int]
    HEARD_FIELD_NUMBER: _ClassVar[int]
    TUNING_ID_FIELD_NUMBER: _ClassVar[int]
    BOARD_ROUND_TRIP_MS_FIELD_NUMBER: _ClassVar[int]
    BOARD_CLOCK_OFFSET_S_FIELD_NUMBER: _ClassVar[int]
    THRUSTER_TEST_FIELD_NUMBER: _ClassVar[int]
    PLANNED_FIELD_NUMBER: _ClassVar[int]
    BLIND_FIELD_NUMBER: _ClassVar[int]
    TILT_FIELD_NUMBER: _ClassVar[int]
    DRAG_RATIO_FIELD_NUMBER: _ClassVar[int]
    THRUST_RATIO_FIELD_NUMBER: _ClassVar[int]
    CODE_FIELD_NUMBER: _ClassVar[int]
    GUIDANCE_FIELD_NUMBER: _ClassVar[int]
    mode: Mode
    fault: str
    experiment_hash: str
    trajectory_s: float
    trajectory_id: str
    eta: _containers.RepeatedScalarFieldContainer[float]
    nu: _containers.RepeatedScalarFieldContainer[float]
    disturbance: _containers.RepeatedScalarFieldContainer[float]
    eta_reference: _containers.RepeatedScalarFieldContainer[float]
    eta_command: _containers.RepeatedScalarFieldContainer[float]
    wrench: _containers.RepeatedScalarFieldContainer[float]
    wrench_step: _containers.RepeatedScalarFieldContainer[float]
    wrench_delivered: _containers.RepeatedScalarFieldContainer[float]
    wrench_wanted: _containers.RepeatedScalarFieldContainer[float]
    pulse_us: _containers.RepeatedScalarFieldContainer[int]
    echo_us: _containers.RepeatedScalarFieldContainer[int]
    track: Track
    pose_age_ms: float
    exposure_to_pwm_ms: float
    depth_m: float
    battery_v: float
    board_armed: bool
    board_age_ms: float
    board_loss: float
    solve: Solve
    iterations: int
    step_us: float
    missed_deadlines: int
    slack_m: float
    heard: _containers.RepeatedScalarFieldContainer[int]
    tuning_id: str
    board_round_trip_ms: float
    board_clock_offset_s: float
    thruster_test: str
    planned: bool
    blind: str
    tilt: _containers.RepeatedScalarFieldContainer[float]
    drag_ratio: float
    thrust_ratio: float
    code: str
    guidance: Guidance
    def __init__(self, mode: _Optional[_Union[Mode, str]] = ..., fault: _Optional[str] = ..., experiment_hash: _Optional[str] = ..., trajectory_s: _Optional[float] = ..., trajectory_id: _Optional[str] = ..., eta: _Optional[_Iterable[float]] = ..., nu: _Optional[_Iterable[float]] = ..., disturbance: _Optional[_Iterable[float]] = ..., eta_reference: _Optional[_Iterable[float]] = ..., eta_command: _Optional[_Iterable[float]] = ..., wrench: _Optional[_Iterable[float]] = ..., wrench_step: _Optional[_Iterable[float]] = ..., wrench_delivered: _Optional[_Iterable[float]] = ..., wrench_wanted: _Optional[_Iterable[float]] = ..., pulse_us: _Optional[_Iterable[int]] = ..., echo_us: _Optional[_Iterable[int]] = ..., track: _Optional[_Union[Track, str]] = ..., pose_age_ms: _Optional[float] = ..., exposure_to_pwm_ms: _Optional[float] = ..., depth_m: _Optional[float] = ..., battery_v: _Optional[float] = ..., board_armed: _Optional[bool] = ..., board_age_ms: _Optional[float] = ..., board_loss: _Optional[float] = ..., solve: _Optional[_Union[Solve, str]] = ..., iterations: _Optional[int] = ..., step_us: _Optional[float] = ..., missed_deadlines: _Optional[int] = ..., slack_m: _Optional[float] = ..., heard: _Optional[_Iterable[int]] = ..., tuning_id: _Optional[str] = ..., board_round_trip_ms: _Optional[float] = ..., board_clock_offset_s: _Optional[float] = ..., thruster_test: _Optional[str] = ..., planned: _Optional[bool] = ..., blind: _Optional[str] = ..., tilt: _Optional[_Iterable[float]] = ..., drag_ratio: _Optional[float] = ..., thrust_ratio: _Optional[float] = ..., code: _Optional[str] = ..., guidance: _Optional[_Union[Guidance, str]] = ...) -> None: ...

class StationHeartbeat(_message.Message):
    __slots__ = ("experiment_hash", "emergency_stop", "mission", "lag_s", "slowing", "planned", "code", "out", "began_ns")
    EXPERIMENT_HASH_FIELD_NUMBER: _ClassVar[int]
    EMERGENCY_STOP_FIELD_NUMBER: _ClassVar[int]
    MISSION_FIELD_NUMBER: _ClassVar[int]
    LAG_S_FIELD_NUMBER: _ClassVar[int]
    SLOWING_FIELD_NUMBER: _ClassVar[int]
    PLANNED_FIELD_NUMBER: _ClassVar[int]
    CODE_FIELD_NUMBER: _ClassVar[int]
    OUT_FIELD_NUMBER: _ClassVar[int]
    BEGAN_NS_FIELD_NUMBER: _ClassVar[int]
    experiment_hash: str
    emergency_stop: bool
    mission: str
    lag_s: float
    slowing: float
    planned: _containers.RepeatedScalarFieldContainer[int]
    code: str
    out: _containers.RepeatedScalarFieldContainer[int]
    began_ns: int
    def __init__(self, experiment_hash: _Optional[str] = ..., emergency_stop: _Optional[bool] = ..., mission: _Optional[str] = ..., lag_s: _Optional[float] = ..., slowing: _Optional[float] = ..., planned: _Optional[_Iterable[int]] = ..., code: _Optional[str] = ..., out: _Optional[_Iterable[int]] = ..., began_ns: _Optional[int] = ...) -> None: ...

class Trajectory(_message.Message):
    __slots__ = ("id", "period_s", "eta", "velocity", "acceleration", "begin_s")
    ID_FIELD_NUMBER: _ClassVar[int]
    PERIOD_S_FIELD_NUMBER: _ClassVar[int]
    ETA_FIELD_NUMBER: _ClassVar[int]
    VELOCITY_FIELD_NUMBER: _ClassVar[int]
    ACCELERATION_FIELD_NUMBER: _ClassVar[int]
    BEGIN_S_FIELD_NUMBER: _ClassVar[int]
    id: str
    period_s: float
    eta: _containers.RepeatedScalarFieldContainer[float]
    velocity: _containers.RepeatedScalarFieldContainer[float]
    acceleration: _containers.RepeatedScalarFieldContainer[float]
    begin_s: float
    def __init__(self, id: _Optional[str] = ..., period_s: _Optional[float] = ..., eta: _Optional[_Iterable[float]] = ..., velocity: _Optional[_Iterable[float]] = ..., acceleration: _Optional[_Iterable[float]] = ..., begin_s: _Optional[float] = ...) -> None: ...

class Tuning(_message.Message):
    __slots__ = ("id", "keys", "values")
    ID_FIELD_NUMBER: _ClassVar[int]
    KEYS_FIELD_NUMBER: _ClassVar[int]
    VALUES_FIELD_NUMBER: _ClassVar[int]
    id: str
    keys: _containers.RepeatedScalarFieldContainer[str]
    values: _containers.RepeatedScalarFieldContainer[float]
    def __init__(self, id: _Optional[str] = ..., keys: _Optional[_Iterable[str]] = ..., values: _Optional[_Iterable[float]] = ...) -> None: ...

class DriveVelocity(_message.Message):
    __slots__ = ("surge_mps", "heave_mps", "yaw_rate_radps")
    SURGE_MPS_FIELD_NUMBER: _ClassVar[int]
    HEAVE_MPS_FIELD_NUMBER: _ClassVar[int]
    YAW_RATE_RADPS_FIELD_NUMBER: _ClassVar[int]
    surge_mps: float
    heave_mps: float
    yaw_rate_radps: float
    def __init__(self, surge_mps: _Optional[float] = ..., heave_mps: _Optional[float] = ..., yaw_rate_radps: _Optional[float] = ...) -> None: ...

class Command(_message.Message):
    __slots__ = ("order", "robot", "time_to_live_s", "experiment_hash", "trajectory_id", "start_in_s", "trajectory", "trajectory_s", "tuning_id", "tuning", "recipient", "via", "start_ns", "about", "drive", "text")
    ORDER_FIELD_NUMBER: _ClassVar[int]
    ROBOT_FIELD_NUMBER: _ClassVar[int]
    TIME_TO_LIVE_S_FIELD_NUMBER: _ClassVar[int]
    EXPERIMENT_HASH_FIELD_NUMBER: _ClassVar[int]
    TRAJECTORY_ID_FIELD_NUMBER: _ClassVar[int]
    START_IN_S_FIELD_NUMBER: _ClassVar[int]
    TRAJECTORY_FIELD_NUMBER: _ClassVar[int]
    TRAJECTORY_S_FIELD_NUMBER: _ClassVar[int]
    TUNING_ID_FIELD_NUMBER: _ClassVar[int]
    TUNING_FIELD_NUMBER: _ClassVar[int]
    RECIPIENT_FIELD_NUMBER: _ClassVar[int]
    VIA_FIELD_NUMBER: _ClassVar[int]
    START_NS_FIELD_NUMBER: _ClassVar[int]
    ABOUT_FIELD_NUMBER: _ClassVar[int]
    DRIVE_FIELD_NUMBER: _ClassVar[int]
    TEXT_FIELD_NUMBER: _ClassVar[int]
    order: Order
    robot: int
    time_to_live_s: float
    experiment_hash: str
    trajectory_id: str
    start_in_s: float
    trajectory: Trajectory
    trajectory_s: float
    tuning_id: str
    tuning: Tuning
    recipient: int
    via: _containers.RepeatedScalarFieldContainer[float]
    start_ns: int
    about: int
    drive: DriveVelocity
    text: str
    def __init__(self, order: _Optional[_Union[Order, str]] = ..., robot: _Optional[int] = ..., time_to_live_s: _Optional[float] = ..., experiment_hash: _Optional[str] = ..., trajectory_id: _Optional[str] = ..., start_in_s: _Optional[float] = ..., trajectory: _Optional[_Union[Trajectory, _Mapping]] = ..., trajectory_s: _Optional[float] = ..., tuning_id: _Optional[str] = ..., tuning: _Optional[_Union[Tuning, _Mapping]] = ..., recipient: _Optional[int] = ..., via: _Optional[_Iterable[float]] = ..., start_ns: _Optional[int] = ..., about: _Optional[int] = ..., drive: _Optional[_Union[DriveVelocity, _Mapping]] = ..., text: _Optional[str] = ...) -> None: ...

class FaultRequest(_message.Message):
    __slots__ = ("what", "for_s")
    WHAT_FIELD_NUMBER: _ClassVar[int]
    FOR_S_FIELD_NUMBER: _ClassVar[int]
    what: str
    for_s: float
    def __init__(self, what: _Optional[str] = ..., for_s: _Optional[float] = ...) -> None: ...

class Outcome(_message.Message):
    __slots__ = ("request", "order", "progress", "reason", "mission", "confirmed", "waiting", "why")
    REQUEST_FIELD_NUMBER: _ClassVar[int]
    ORDER_FIELD_NUMBER: _ClassVar[int]
    PROGRESS_FIELD_NUMBER: _ClassVar[int]
    REASON_FIELD_NUMBER: _ClassVar[int]
    MISSION_FIELD_NUMBER: _ClassVar[int]
    CONFIRMED_FIELD_NUMBER: _ClassVar[int]
    WAITING_FIELD_NUMBER: _ClassVar[int]
    WHY_FIELD_NUMBER: _ClassVar[int]
    request: int
    order: Order
    progress: Progress
    reason: str
    mission: str
    confirmed: _containers.RepeatedScalarFieldContainer[int]
    waiting: _containers.RepeatedScalarFieldContainer[int]
    why: _containers.RepeatedScalarFieldContainer[str]
    def __init__(self, request: _Optional[int] = ..., order: _Optional[_Union[Order, str]] = ..., progress: _Optional[_Union[Progress, str]] = ..., reason: _Optional[str] = ..., mission: _Optional[str] = ..., confirmed: _Optional[_Iterable[int]] = ..., waiting: _Optional[_Iterable[int]] = ..., why: _Optional[_Iterable[str]] = ...) -> None: ...

class Reply(_message.Message):
    __slots__ = ("robot", "accepted", "reason", "mode", "session", "silent", "outcome")
    ROBOT_FIELD_NUMBER: _ClassVar[int]
    ACCEPTED_FIELD_NUMBER: _ClassVar[int]
    REASON_FIELD_NUMBER: _ClassVar[int]
    MODE_FIELD_NUMBER: _ClassVar[int]
    SESSION_FIELD_NUMBER: _ClassVar[int]
    SILENT_FIELD_NUMBER: _ClassVar[int]
    OUTCOME_FIELD_NUMBER: _ClassVar[int]
    robot: int
    accepted: bool
    reason: str
    mode: Mode
    session: int
    silent: bool
    outcome: Outcome
    def __init__(self, robot: _Optional[int] = ..., accepted: _Optional[bool] = ..., reason: _Optional[str] = ..., mode: _Optional[_Union[Mode, str]] = ..., session: _Optional[int] = ..., silent: _Optional[bool] = ..., outcome: _Optional[_Union[Outcome, _Mapping]] = ...) -> None: ...

class BoardReading(_message.Message):
    __slots__ = ("board_ms", "arrival_ns", "heading_rad", "yaw_rate_radps", "acceleration_mps2", "depth_m", "battery_v", "armed", "echo_us", "loss", "charge", "battery_reports", "tilt", "heartbeats", "autopilot", "power_on_depth_m")
    BOARD_MS_FIELD_NUMBER: _ClassVar[int]
    ARRIVAL_NS_FIELD_NUMBER: _ClassVar[int]
    HEADING_RAD_FIELD_NUMBER: _ClassVar[int]
    YAW_RATE_RADPS_FIELD_NUMBER: _ClassVar[int]
    ACCELERATION_MPS2_FIELD_NUMBER: _ClassVar[int]
    DEPTH_M_FIELD_NUMBER: _ClassVar[int]
    BATTERY_V_FIELD_NUMBER: _ClassVar[int]
    ARMED_FIELD_NUMBER: _ClassVar[int]
    ECHO_US_FIELD_NUMBER: _ClassVar[int]
    LOSS_FIELD_NUMBER: _ClassVar[int]
    CHARGE_FIELD_NUMBER: _ClassVar[int]
    BATTERY_REPORTS_FIELD_NUMBER: _ClassVar[int]
    TILT_FIELD_NUMBER: _ClassVar[int]
    HEARTBEATS_FIELD_NUMBER: _ClassVar[int]
    AUTOPILOT_FIELD_NUMBER: _ClassVar[int]
    POWER_ON_DEPTH_M_FIELD_NUMBER: _ClassVar[int]
    board_ms: int
    arrival_ns: int
    heading_rad: float
    yaw_rate_radps: float
    acceleration_mps2: _containers.RepeatedScalarFieldContainer[float]
    depth_m: float
    battery_v: float
    armed: bool
    echo_us: _containers.RepeatedScalarFieldContainer[int]
    loss: float
    charge: int
    battery_reports: int
    tilt: _containers.RepeatedScalarFieldContainer[float]
    heartbeats: int
    autopilot: int
    power_on_depth_m: float
    def __init__(self, board_ms: _Optional[int] = ..., arrival_ns: _Optional[int] = ..., heading_rad: _Optional[float] = ..., yaw_rate_radps: _Optional[float] = ..., acceleration_mps2: _Optional[_Iterable[float]] = ..., depth_m: _Optional[float] = ..., battery_v: _Optional[float] = ..., armed: _Optional[bool] = ..., echo_us: _Optional[_Iterable[int]] = ..., loss: _Optional[float] = ..., charge: _Optional[int] = ..., battery_reports: _Optional[int] = ..., tilt: _Optional[_Iterable[float]] = ..., heartbeats: _Optional[int] = ..., autopilot: _Optional[int] = ..., power_on_depth_m: _Optional[float] = ...) -> None: ...

class StepInputs(_message.Message):
    __slots__ = ("step", "pose", "pose_instant_ns", "pose_told_age_ns", "heartbeat", "station_session", "station_stamp_ns", "station_instant_ns", "board", "plan_robots", "plan_sessions", "plan_sequences", "plan_instants_ns", "obstacles_session", "obstacles_sequence", "obstacles_instant_ns", "late_steps")
    STEP_FIELD_NUMBER: _ClassVar[int]
    POSE_FIELD_NUMBER: _ClassVar[int]
    POSE_INSTANT_NS_FIELD_NUMBER: _ClassVar[int]
    POSE_TOLD_AGE_NS_FIELD_NUMBER: _ClassVar[int]
    HEARTBEAT_FIELD_NUMBER: _ClassVar[int]
    STATION_SESSION_FIELD_NUMBER: _ClassVar[int]
    STATION_STAMP_NS_FIELD_NUMBER: _ClassVar[int]
    STATION_INSTANT_NS_FIELD_NUMBER: _ClassVar[int]
    BOARD_FIELD_NUMBER: _ClassVar[int]
    PLAN_ROBOTS_FIELD_NUMBER: _ClassVar[int]
    PLAN_SESSIONS_FIELD_NUMBER: _ClassVar[int]
    PLAN_SEQUENCES_FIELD_NUMBER: _ClassVar[int]
    PLAN_INSTANTS_NS_FIELD_NUMBER: _ClassVar[int]
    OBSTACLES_SESSION_FIELD_NUMBER: _ClassVar[int]
    OBSTACLES_SEQUENCE_FIELD_NUMBER: _ClassVar[int]
    OBSTACLES_INSTANT_NS_FIELD_NUMBER: _ClassVar[int]
    LATE_STEPS_FIELD_NUMBER: _ClassVar[int]
    step: int
    pose: Pose
    pose_instant_ns: int
    pose_told_age_ns: int
    heartbeat: StationHeartbeat
    station_session: int
    station_stamp_ns: int
    station_instant_ns: int
    board: BoardReading
    plan_robots: _containers.RepeatedScalarFieldContainer[int]
    plan_sessions: _containers.RepeatedScalarFieldContainer[int]
    plan_sequences: _containers.RepeatedScalarFieldContainer[int]
    plan_instants_ns: _containers.RepeatedScalarFieldContainer[int]
    obstacles_session: int
    obstacles_sequence: int
    obstacles_instant_ns: int
    late_steps: int
    def __init__(self, step: _Optional[int] = ..., pose: _Optional[_Union[Pose, _Mapping]] = ..., pose_instant_ns: _Optional[int] = ..., pose_told_age_ns: _Optional[int] = ..., heartbeat: _Optional[_Union[StationHeartbeat, _Mapping]] = ..., station_session: _Optional[int] = ..., station_stamp_ns: _Optional[int] = ..., station_instant_ns: _Optional[int] = ..., board: _Optional[_Union[BoardReading, _Mapping]] = ..., plan_robots: _Optional[_Iterable[int]] = ..., plan_sessions: _Optional[_Iterable[int]] = ..., plan_sequences: _Optional[_Iterable[int]] = ..., plan_instants_ns: _Optional[_Iterable[int]] = ..., obstacles_session: _Optional[int] = ..., obstacles_sequence: _Optional[int] = ..., obstacles_instant_ns: _Optional[int] = ..., late_steps: _Optional[int] = ...) -> None: ...

class OrderTaken(_message.Message):
    __slots__ = ("before_step", "number", "order_session", "order_sequence", "order_stamp_ns", "station_session", "station_stamp_ns", "station_instant_ns", "command", "reply")
    BEFORE_STEP_FIELD_NUMBER: _ClassVar[int]
    NUMBER_FIELD_NUMBER: _ClassVar[int]
    ORDER_SESSION_FIELD_NUMBER: _ClassVar[int]
    ORDER_SEQUENCE_FIELD_NUMBER: _ClassVar[int]
    ORDER_STAMP_NS_FIELD_NUMBER: _ClassVar[int]
    STATION_SESSION_FIELD_NUMBER: _ClassVar[int]
    STATION_STAMP_NS_FIELD_NUMBER: _ClassVar[int]
    STATION_INSTANT_NS_FIELD_NUMBER: _ClassVar[int]
    COMMAND_FIELD_NUMBER: _ClassVar[int]
    REPLY_FIELD_NUMBER: _ClassVar[int]
    before_step: int
    number: int
    order_session: int
    order_sequence: int
    order_stamp_ns: int
    station_session: int
    station_stamp_ns: int
    station_instant_ns: int
    command: Command
    reply: Reply
    def __init__(self, before_step: _Optional[int] = ..., number: _Optional[int] = ..., order_session: _Optional[int] = ..., order_sequence: _Optional[int] = ..., order_stamp_ns: _Optional[int] = ..., station_session: _Optional[int] = ..., station_stamp_ns: _Optional[int] = ..., station_instant_ns: _Optional[int] = ..., command: _Optional[_Union[Command, _Mapping]] = ..., reply: _Optional[_Union[Reply, _Mapping]] = ...) -> None: ...
