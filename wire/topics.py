"""ONE table of everything that is published: key, type, rate, age limit, quality of service, recorded or not.

Keys are relative to the fleet's name (`--fleet`, default "shoal"), so two fleets share a network without meeting.
"""

from dataclasses import dataclass
from enum import Enum

from wire import messages


class Qos(Enum):
    """How a topic is sent. Nothing ever blocks: one stopped viewer on a shared hub froze everyone's commands for 5 s."""

    CONTROL = "first in line, no batching, dropped rather than queued: only the newest counts"
    STATE = "as CONTROL, behind it"
    IMAGE = "last in line: a picture may be late or missing, a command may not"
    JOURNAL = "as EVENT, but who comes later hears nothing of what was: it is for the log of the run that is on"
    EVENT = "cached by the publisher and recovered by the subscriber after an outage: each one counts"


@dataclass(frozen=True)
class Topic:
    """One row. `max_age_s` is when a value stops being usable; freshness checks and the page's greying derive from it."""

    name: str  # key below the fleet's name; {robot} is filled in
    type: type
    rate_hz: float
    max_age_s: float
    qos: Qos
    recorded: bool
    publisher: str

    def key(self, robot: int | None = None) -> str:
        """The key for one robot, or for all (`*`) when the topic has a robot and none is given."""
        return self.name.format(robot="*" if robot is None else robot)


TICK = Topic("sim/tick", messages.Tick, 20, 0.15, Qos.CONTROL, False, "sim_bridge")
TRUTH = Topic("sim/truth", messages.Truth, 20, 0.15, Qos.STATE, True, "sim_bridge")
FRAME = Topic("camera/frame", messages.Frame, 20, 0.15, Qos.IMAGE, False, "camera")
PREVIEW = Topic("camera/preview", messages.Preview, 5, 0.6, Qos.IMAGE, True, "localizer")
POSE = Topic("robot/{robot}/pose", messages.Pose, 20, 0.2, Qos.CONTROL, True, "localizer")
LOCALIZER = Topic("localizer/status", messages.LocalizerStatus, 20, 0.3, Qos.STATE, True, "localizer")
OBSTACLES = Topic("obstacles", messages.Obstacles, 10, 0.5, Qos.STATE, True, "localizer")
PLAN = Topic("robot/{robot}/plan", messages.Plan, 20, 0.5, Qos.CONTROL, True, "robot_agent")
STATE = Topic("robot/{robot}/state", messages.RobotState, 20, 0.3, Qos.STATE, True, "robot_agent")
HEARTBEAT = Topic("station/heartbeat", messages.StationHeartbeat, 20, 1.0, Qos.CONTROL, True, "groundstation")
TRAJECTORY = Topic("robot/{robot}/trajectory", messages.Trajectory, 0, float("inf"), Qos.EVENT, True, "groundstation")
INPUTS = Topic("robot/{robot}/inputs", messages.StepInputs, 20, 0.5, Qos.JOURNAL, True, "robot_agent")
ORDERS = Topic("robot/{robot}/orders", messages.OrderTaken, 0, float("inf"), Qos.JOURNAL, True, "robot_agent")
EVENT = Topic("event", messages.Event, 0, float("inf"), Qos.EVENT, True, "everyone")

TOPICS = (
    TICK, TRUTH, FRAME, PREVIEW, POSE, LOCALIZER, OBSTACLES, PLAN, STATE, HEARTBEAT, TRAJECTORY, INPUTS, ORDERS, EVENT
)  # fmt: skip

COMMAND_KEY = "robot/{robot}/command"  # a queryable, not a topic: every order is answered
PRESENCE_KEY = "presence/{process}"  # a liveliness token: there, not necessarily well
