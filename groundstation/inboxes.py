"""SHELL: the newest that the station has heard of its fleet. One set for the process: the mission reads it, and the page."""

from dataclasses import dataclass

from wire.messages import topics
from wire.messages.messages import LocalizerStatus, Obstacles, Plan, Pose, RobotState
from wire.transport.bus import Bus, Inbox


@dataclass(frozen=True, eq=False)
class Inboxes:
    """By robot where a topic is."""

    states: dict[int, Inbox[RobotState]]
    poses: dict[int, Inbox[Pose]]
    plans: dict[int, Inbox[Plan]]
    localizer: Inbox[LocalizerStatus]
    obstacles: Inbox[Obstacles]


def listen(bus: Bus, robots: tuple[int, ...]) -> Inboxes:
    """Inboxes that fill from now on."""
    return Inboxes(
        bus.inboxes(topics.STATE, RobotState, robots),
        bus.inboxes(topics.POSE, Pose, robots),
        bus.inboxes(topics.PLAN, Plan, robots),
        bus.inbox(topics.LOCALIZER, LocalizerStatus),
        bus.inbox(topics.OBSTACLES, Obstacles),
    )
