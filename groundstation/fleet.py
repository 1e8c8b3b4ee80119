"""What the station knows of its robots, and whether they are fit to start. Pure: time and messages are arguments."""

from collections.abc import Mapping
from dataclasses import dataclass

from wire import topics
from wire.bus import Received
from wire.experiment import Experiment
from wire.messages import Mode, Pose, RobotState, Track
from wire.runtime import Clock, age_s

READY_TO_START_M = 0.5  # a robot further than this from the start of its trajectory is in the wrong place


@dataclass(frozen=True)
class RobotView:
    """The newest of one robot, with ages in seconds; None is "never heard"."""

    state: RobotState | None = None
    state_age_s: float = float("inf")
    pose: Pose | None = None
    pose_age_s: float = float("inf")

    @property
    def mode(self) -> Mode:
        """The robot's mode as last heard."""
        return self.state.mode if self.state is not None else Mode.DISARMED

    @property
    def heard(self) -> bool:
        """Whether its state is fresh."""
        return self.state is not None and self.state_age_s <= topics.STATE.max_age_s


Fleet = Mapping[int, RobotView]


def view(state: Received[RobotState] | None, pose: Received[Pose] | None, clock: Clock) -> RobotView:
    """A robot's view from its two inboxes' newest messages, aged by the process's clock."""
    return RobotView(
        state.message if state else None,
        age_s(clock, state) if state else float("inf"),
        pose.message if pose else None,
        age_s(clock, pose) if pose else float("inf"),
    )


def preflight(experiment: Experiment, fleet: Fleet) -> tuple[str, ...]:
    """Every reason not to arm, robot by robot; empty when the fleet is ready."""
    return tuple(f"robot {robot}: {why}" for robot in experiment.robot_ids for why in _not_ready(experiment, fleet[robot]))


def _not_ready(experiment: Experiment, robot: RobotView) -> list[str]:
    state = robot.state
    if state is None or not robot.heard:
        return ["not heard"]
    reasons = []
    if state.experiment_hash != experiment.hash:
        reasons.append(f"has another experiment ({state.experiment_hash[:8]}, here {experiment.hash[:8]})")
    if robot.pose is None or robot.pose_age_s > topics.POSE.max_age_s:
        reasons.append("no fresh pose")
    elif robot.pose.track < Track.KCF or (experiment.localizer.markers and not robot.pose.identity_verified):
        reasons.append(f"pose is {robot.pose.track.name}, identity {'' if robot.pose.identity_verified else 'not '}verified")
    if state.board_age_ms * 1e-3 > topics.STATE.max_age_s:
        reasons.append("thruster board silent")
    if state.battery_v < experiment.vehicle.battery.no_arm_v:
        reasons.append(f"battery {state.battery_v:.1f} V, needs {experiment.vehicle.battery.no_arm_v:.1f} V")
    if state.mode in (Mode.STOPPED, Mode.FAULT):
        reasons.append(f"is {state.mode.name}: {state.fault}")
    return reasons


def casualty(experiment: Experiment, fleet: Fleet) -> str:
    """The first robot that fell out of a running mission, and why; empty while all fly."""
    for robot in experiment.robot_ids:
        if not fleet[robot].heard:
            return f"robot {robot}: silent"
        state = fleet[robot].state
        if state is not None and state.mode in (Mode.STOPPED, Mode.FAULT, Mode.DISARMED):
            return f"robot {robot}: {state.mode.name.lower()}{f' ({state.fault})' if state.fault else ''}"
    return ""
