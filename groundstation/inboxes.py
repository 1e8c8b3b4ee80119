"""SHELL: inboxes with the newest messages of the fleet. One set for the process; mission and page read it."""

from dataclasses import dataclass

from wire.messages import topics
from wire.messages.messages import LocalizerStatus, Obstacles, Plan, Pose, RobotState
from wire.transport.bus import Bus, Inbox


@dataclass(frozen=True, eq=False)
class FleetInboxes:
    """One inbox a topic, or one a robot."""

    states: dict[int, Inbox[RobotState]]
    poses: dict[int, Inbox[Pose]]
    plans: dict[int, Inbox[Plan]]
    localizer: Inbox[LocalizerStatus]
    obstacles: Inbox[Obstacles]


def subscribe_fleet(bus: Bus, robots: tuple[int, ...]) -> FleetInboxes:
    """Open inboxes that fill from now on."""
    return FleetInboxes(
        bus.inboxes(topics.STATE, RobotState, robots),
        bus.inboxes(topics.POSE, Pose, robots),
        bus.inboxes(topics.PLAN, Plan, robots),
        bus.inbox(topics.LOCALIZER, LocalizerStatus),
        bus.inbox(topics.OBSTACLES, Obstacles),
    )
