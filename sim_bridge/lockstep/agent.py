"""SHELL: a robot's node in lockstep: a step when a tick names it and all inputs of that tick have arrived."""

import logging
from collections.abc import Iterator

from robot_agent.node import AgentNode, StepTime
from shoal.bus.bus import Bus
from shoal.config.experiment import Experiment
from shoal.mavlink.board_port import Link
from shoal.mavlink.signing_key import Signing
from shoal.messages import topics
from shoal.messages.messages import LocalizerStatus, Tick
from shoal.runtime.runtime import SLICE_S, Stop
from sim_bridge.lockstep.clock import Lockstep, LockstepClock, Reminder

log = logging.getLogger("shoal")


def agent_in_lockstep(
    experiment: Experiment, robot: int, bus: Bus, link: Link, stop: Stop, signing: Signing | None = None
) -> AgentNode:
    """The node of a robot, with the simulator's time."""
    clock = LockstepClock()
    node = AgentNode(experiment, robot, bus, link, stop, signing=signing, clock=clock)
    node.pace = AgentPace(node, robot, bus, clock)
    return node


class AgentPace:
    """Times of one robot's control steps: one for each tick that names the robot, once the tick's inputs are here."""

    def __init__(self, node: AgentNode, robot: int, bus: Bus, clock: LockstepClock) -> None:
        self._node, self._robot = node, robot
        self._bus = bus
        self._lockstep = Lockstep(bus, node.stop, clock)
        self._localizer = bus.inbox(topics.LOCALIZER, LocalizerStatus)

    def __iter__(self) -> Iterator[StepTime]:
        """Yield the time of each step, until told to stop."""
        # The node sends heartbeats to its board only while it waits for the first tick: later the number of frames on the
        # board's link would depend on how long a tick takes.
        tick = self._lockstep.next(meanwhile=self._node.greet)
        while tick is not None and (instant := self._await_inputs(tick)) is not None:
            yield instant
            tick = self._lockstep.next()

    def _await_inputs(self, tick: Tick) -> StepTime | None:
        """Wait for all inputs of a tick. None when told to stop."""
        node, lockstep = self._node, self._lockstep
        self._bus.mute(self._robot in tick.no_radio)
        if self._bus.muted:
            return StepTime(tick.now_ns, tick.previous_ns) if self._await_board(tick) else None
        up_to_ns = lockstep.await_sight(tick, self._localizer, {self._robot: node.poses}, node.obstacles)
        if up_to_ns is None or not lockstep.await_all([(node.heartbeats, tick.now_ns)]):
            return None
        heartbeat = node.heartbeats.newest()
        planned = heartbeat.message.planned if heartbeat is not None else ()
        plans = [
            (inbox, tick.previous_ns) for robot, inbox in node.plans.items() if robot in planned and robot not in tick.unheard
        ]
        here = lockstep.await_all(plans) and self._await_board(tick)
        return StepTime(tick.now_ns, tick.previous_ns, up_to_ns) if here else None

    def _await_board(self, tick: Tick) -> bool:
        """Wait for the board's burst that belongs to this tick. False when told to stop."""
        wanted = dict(zip(tick.robots, tick.board_ms, strict=True)).get(self._robot, 0)
        node, reminder = self._node, Reminder()
        while not node.stop.requested:
            node.mavlink.receive(node.link.read(), tick.now_ns)
            if node.mavlink.telemetry.board_ms >= wanted:
                return True
            node.link.wait(SLICE_S)
            if reminder.due():
                log.warning("lockstep: waiting for the board's burst of %d ms", wanted)
        return False
