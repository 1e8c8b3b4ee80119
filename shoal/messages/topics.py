"""ONE table of everything that is published: key, type, rate, age limit, quality of service, recorded or not, by and for whom.

Keys are relative to the fleet's name (`--fleet`, default "shoal"), so two fleets share a network without meeting. Where the
fleet has keys, the router lets nothing through that this table does not name (shoal/bus/access_control.py).
"""

from dataclasses import dataclass, replace
from enum import Enum

from shoal.config.controller import Safety
from shoal.messages import messages


class Qos(Enum):
    """The quality of service of a topic. Sending never blocks: one stopped viewer on a shared hub froze all commands for 5
    s."""

    CONTROL = "first in line, no batching, dropped rather than queued: only the newest counts"
    STATE = "as CONTROL, behind it"
    IMAGE = "last in line: a picture may be late or missing, a command may not"
    JOURNAL = "as EVENT, but a late subscriber gets nothing from before: it is for the log of the present run"
    EVENT = "cached by the publisher and recovered by the subscriber after an outage: each one counts"


RECOVERED = frozenset({Qos.EVENT, Qos.JOURNAL})  # from a cache that is asked for what was lost


class Role(Enum):
    """The role of a process, as its certificate states it."""

    STATION = "groundstation"
    OPERATOR = "operator"  # a terminal: makes requests of the station alone
    ROBOT = "robot_agent"
    LOCALIZER = "localizer"
    SIMULATOR = "sim_bridge"
    VIEWER = "viewer"  # reads


EVERYONE = tuple(Role)
POSE_SOURCES = (Role.SIMULATOR, Role.LOCALIZER)  # the simulator stands for a camera, and with --poses for the localizer
LOG_SOURCES = (Role.STATION, Role.ROBOT, Role.LOCALIZER, Role.SIMULATOR)  # roles whose log lines become events
OBSERVERS = (
    Role.STATION,
    Role.SIMULATOR,
    Role.OPERATOR,
    Role.VIEWER,
)  # roles that read the truth and the step records: none that controls


@dataclass(frozen=True)
class Topic:
    """One row. `max_age_s` is when a value stops being usable; freshness checks and the page's greying derive from it. Where
    an experiment sets that age, `limit` is the key of its [safety], and `max_age_s` the key's default: see `max_age_in`."""

    name: str  # key below the fleet's name; {robot} is filled in
    type: type
    rate_hz: float
    max_age_s: float
    qos: Qos
    recorded: bool
    writers: tuple[Role, ...]  # a robot only under its own number
    readers: tuple[Role, ...] = EVERYONE
    # messages that the publisher keeps, for subscribers that come late or were cut off: up to 20 s of a run that goes on
    cache_depth: int = 0
    limit: str = ""

    def max_age_in(self, safety: Safety) -> float:
        """The age at which a value stops being usable in an experiment with these limits, s. Station and robots use the
        same."""
        return float(getattr(safety, self.limit)) if self.limit else self.max_age_s

    def key(self, robot: int | None = None) -> str:
        """The key for one robot, or for all (`*`) when the topic has a robot and none is given."""
        return self.name.format(robot="*" if robot is None else robot)

    def of_camera(self, camera: str) -> "Topic":
        """The same topic of one of several cameras, `*` for all of them; this one for "", the only camera."""
        return replace(self, name=f"camera/{camera}/{self.name.removeprefix('camera/')}") if camera else self

    @property
    def publisher(self) -> str:
        """The writing roles, for people."""
        return " or ".join(role.value for role in self.writers)


def _limited(limit: str, name: str, kind: type, rate_hz: float, recorded: bool, writers: tuple[Role, ...]) -> Topic:
    """A topic for control whose greatest age an experiment sets."""
    default_s = float(Safety.model_fields[limit].default)
    return Topic(name, kind, rate_hz, default_s, Qos.CONTROL, recorded, writers, limit=limit)


TICK = Topic("sim/tick", messages.Tick, 20, 0.15, Qos.CONTROL, False, (Role.SIMULATOR,))
EXPOSED = Topic("sim/exposed", messages.Tick, 20, 0.15, Qos.CONTROL, False, (Role.SIMULATOR,))  # to the localizer, early
CLOCKS = (TICK, EXPOSED)  # simulated time, which reaches robots without a radio too
TRUTH = Topic("sim/truth", messages.Truth, 20, 0.15, Qos.STATE, True, (Role.SIMULATOR,), OBSERVERS)
FRAME = Topic("camera/frame", messages.Frame, 20, 0.15, Qos.IMAGE, False, POSE_SOURCES)
PREVIEW = Topic("camera/preview", messages.Preview, 5, 0.6, Qos.IMAGE, True, (Role.LOCALIZER,))
VIDEO = Topic("camera/video", messages.Video, 20, 0.6, Qos.IMAGE, True, (Role.LOCALIZER,))
PICTURE = Topic("camera/picture", messages.Picture, 20, 0.6, Qos.IMAGE, True, (Role.LOCALIZER,))
POSE = _limited("pose_hold_s", "robot/{robot}/pose", messages.Pose, 20, True, POSE_SOURCES)
LOCALIZER = Topic("localizer/status", messages.LocalizerStatus, 20, 0.3, Qos.STATE, True, POSE_SOURCES)
OBSTACLES = Topic("obstacles", messages.Obstacles, 10, 0.5, Qos.STATE, True, POSE_SOURCES)
PLAN = _limited("plan_max_age_s", "robot/{robot}/plan", messages.Plan, 20, True, (Role.ROBOT,))
STATE = Topic("robot/{robot}/state", messages.RobotState, 20, 0.3, Qos.STATE, True, (Role.ROBOT,))
HEARTBEAT = _limited("station_hold_s", "station/heartbeat", messages.StationHeartbeat, 20, True, (Role.STATION,))
TRAJECTORY = Topic(
    "robot/{robot}/trajectory", messages.Trajectory, 0, float("inf"), Qos.EVENT, True, (Role.STATION,), cache_depth=4
)
TUNING = Topic("station/tuning", messages.Tuning, 0, float("inf"), Qos.EVENT, True, (Role.STATION,), cache_depth=100)
INPUTS = Topic(
    "robot/{robot}/inputs", messages.StepInputs, 20, 0.5, Qos.JOURNAL, True, (Role.ROBOT,), OBSERVERS, cache_depth=400
)
COMMANDS = Topic(
    "robot/{robot}/commands",
    messages.CommandTaken,
    0,
    float("inf"),
    Qos.JOURNAL,
    True,
    (Role.ROBOT,),
    OBSERVERS,
    cache_depth=32,
)
# A simulator that is started again breaks nothing that was broken before.
FAULT = Topic(
    "sim/fault", messages.FaultRequest, 0, float("inf"), Qos.JOURNAL, True, (Role.STATION,), OBSERVERS, cache_depth=32
)
EVENT = Topic("event", messages.Event, 0, float("inf"), Qos.EVENT, True, LOG_SOURCES, cache_depth=1000)

TOPICS = (
    TICK, EXPOSED, TRUTH, FRAME, PREVIEW, VIDEO, PICTURE, POSE, LOCALIZER, OBSTACLES, PLAN, STATE, HEARTBEAT, TRAJECTORY,
    TUNING, INPUTS, COMMANDS, FAULT, EVENT,
)  # fmt: skip

# With several cameras each of them has these topics too (`Topic.of_camera`), and the fused poses have the names above.
OF_CAMERAS = (FRAME, PREVIEW, VIDEO, PICTURE, POSE, LOCALIZER, OBSTACLES)

COMMAND_KEY = "robot/{robot}/command"  # a queryable, not a topic: every order is answered
COMMANDERS = (Role.STATION,)  # roles that send commands to robots
OPERATORS = (Role.STATION, Role.OPERATOR)  # roles that make requests of the station

PRESENCE_KEY = "presence/{process}"  # a liveliness token: there, not necessarily well
CLAIM_KEY = "claim/{process}/{state}/{session}"  # a liveliness token: a session that wants, or has, a process's name
CANDIDATE, HOLDER = "candidate", "holder"
PROCESSES = {
    Role.STATION: "groundstation",
    Role.OPERATOR: "operator",
    Role.ROBOT: "agent-{robot}",
    Role.LOCALIZER: "localizer",
    Role.SIMULATOR: "sim-bridge",
    Role.VIEWER: "viewer",
}


def process_name(role: Role, robot: int = 0) -> str:
    """The name of a process: in the log, in its liveliness token, and in the key ring."""
    return PROCESSES[role].format(robot=robot)


def localizer_name(camera: str) -> str:
    """The name of the localizer of one of several cameras, or of the only one ("")."""
    return f"{process_name(Role.LOCALIZER)}-{camera}" if camera else process_name(Role.LOCALIZER)
