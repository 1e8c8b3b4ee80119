"""All processes of a lockstep run in this one, around their real shells, on a network and a machine that are slow by chance.

What they publish, hear, ask and answer is held up as long as a seed says: every process by itself, every topic by itself, so
that what was sent first may come last, as it may between processes. Only messages of one topic to one listener stay in order.
"""

import queue
import random
import threading
import time
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass, field, fields, is_dataclass
from pathlib import Path
from typing import Any

import numpy as np

from groundstation.station import process as station_process
from shoal.bus.bus import Bus
from shoal.bus.memory_transport import MemoryHub, MemoryTransport
from shoal.bus.transport import Answer, Deliver, Presence, Urgent
from shoal.config.experiment import Experiment
from shoal.mavlink.board_port import UdpLink
from shoal.messages import topics
from shoal.messages.codec import Header, decode
from shoal.messages.topics import Qos, Topic
from shoal.runtime.runtime import Stop, log, run_steps
from sim_bridge.lockstep.agent import agent_in_lockstep
from sim_bridge.lockstep.localizer import localizer_in_lockstep
from sim_bridge.lockstep.station import simulated_time
from sim_bridge.node.board_ports import UdpPorts
from sim_bridge.node.pool import PoolNode
from sim_bridge.sil.ports import free_base_port

SHORT_S, LONG_S = 0.002, 0.03  # how long something is held up: mostly, and where chance is against it
LATEST_S = (0.0, 0.0, SHORT_S, LONG_S)  # how late a listener may hear: one of these, drawn for each
STALLED, STALL_S = 0.01, 0.25  # share of what a process sends before which it is stopped, and for how long at most
BY_THE_WALL = frozenset({"step_us", "frame_ms"})  # what a message tells of the machine
DRAWN = frozenset(  # numbers that a process draws when it starts
    {"plan_sessions", "station_session", "obstacles_session", "command_session", "recipient", "session"}
)
COMPARED = tuple(
    topic for topic in topics.TOPICS if topic.recorded and topic not in (topics.EVENT, topics.PREVIEW, topics.TUNING)
)


class Slow(MemoryTransport):
    """One process's place on the hub. With no `chance` nothing is held up."""

    def __init__(self, hub: MemoryHub, chance: random.Random | None, closing: ExitStack) -> None:
        super().__init__(hub)
        self._chance, self._closing = chance, closing

    def publisher(self, key: str, qos: Qos, cache_depth: int = 0) -> Callable[[bytes, bytes], None]:
        put, chance = super().publisher(key, qos, cache_depth), self._chance
        if chance is None:
            return put

        def late(payload: bytes, header: bytes) -> None:
            if chance.random() < STALLED:
                time.sleep(STALL_S * chance.random())
            put(payload, header)

        return late

    def subscribe(self, key: str, qos: Qos, deliver: Deliver) -> None:
        super().subscribe(key, qos, self._queued(deliver))

    def watch(self, key: str, presence: Presence, anew: bool = False) -> None:
        super().watch(key, self._queued(presence), anew)

    def serve(self, key: str, answer: Answer, urgent: Urgent) -> None:
        def late(payload: bytes, header: bytes) -> bytes:
            self._hold_up()
            reply = answer(payload, header)
            self._hold_up()
            return reply

        super().serve(key, late, urgent)

    def _hold_up(self) -> None:
        if self._chance is not None:
            time.sleep((LONG_S if self._chance.random() < 0.2 else SHORT_S) * self._chance.random())

    def _queued(self, deliver: Callable[..., None]) -> Callable[..., None]:
        """In a thread of its own, as a callback of Zenoh's is."""
        chance = self._chance
        if chance is None:
            return deliver
        waiting: queue.Queue[tuple[Any, ...] | None] = queue.Queue()
        longest_s = chance.choice(LATEST_S)
        own = random.Random(chance.random())

        def work() -> None:
            while (message := waiting.get()) is not None:
                time.sleep(longest_s * own.random())
                deliver(*message)

        thread = threading.Thread(target=work, daemon=True)
        thread.start()
        self._closing.callback(thread.join, 10.0)
        self._closing.callback(waiting.put, None)
        return lambda *message: waiting.put(message)


@dataclass
class OnLocalized:
    """All that was published, by key: what every message was about, and what it said but for what must differ."""

    messages: dict[str, list[tuple[int, Any]]] = field(default_factory=dict)

    def note(self, topic: Topic, key: str, header: Header, payload: bytes) -> None:
        content = _plain(decode(topic.type, payload, "test", topic.name))
        self.messages.setdefault(key, []).append((header.stamp_ns, content))

    def differs(self, other: "OnLocalized") -> str:
        """The first message, by its stamp, that is not the same; empty if all are, as far as both go."""
        differences = []
        for key in sorted(self.messages.keys() | other.messages.keys()):
            ours, theirs = self.messages.get(key, []), other.messages.get(key, [])
            if abs(len(ours) - len(theirs)) > 2:  # the last may have been told before the end or not
                differences.append((0, key, f"{len(ours)} and {len(theirs)} messages"))
            pairs = zip(ours, theirs, strict=False)
            differences += [(min(a[0], b[0]), key, f"{a} and {b}") for a, b in pairs if a != b][:1]
        return "\n".join(f"{stamp_ns * 1e-9:.3f} s {key}: {what:.600}" for stamp_ns, key, what in sorted(differences))


def _plain(value: Any) -> Any:
    if is_dataclass(value):
        return {f.name: _plain(getattr(value, f.name)) for f in fields(value) if f.name not in BY_THE_WALL | DRAWN}
    if isinstance(value, np.ndarray):
        return value.tolist()
    return value


def fly(experiment: Experiment, folder: Path, seed: int | None, poses: bool = True) -> OnLocalized:
    """Fly an experiment to its end, everything held up as `seed` says (None: nothing); with `poses` without the camera."""
    hub, record, stop = MemoryHub(), OnLocalized(), Stop(install=False)
    handlers = log.handlers[:]
    folder.mkdir()
    with ExitStack() as closing:

        def bus(process: str) -> Bus:
            chance = None if seed is None else random.Random(f"{seed} {process}")
            return closing.enter_context(Bus(Slow(hub, chance, closing)))

        witness = Bus(MemoryTransport(hub))
        for topic in COMPARED:
            witness.subscribe(topic, None, record.note)
        ports = free_base_port(experiment.robot_ids)
        sockets = UdpPorts(ports, experiment.robot_ids, experiment.seed)
        shells = [PoolNode(experiment, bus("sim-bridge"), sockets, stop, True, poses).run]
        for robot in experiment.robot_ids:
            link = UdpLink("127.0.0.1", ports + robot)
            closing.callback(link.close)
            shells.append(agent_in_lockstep(experiment, robot, bus(f"agent-{robot}"), link, stop).run)
        if not poses:
            shells.append(localizer_in_lockstep(experiment, bus("localizer"), stop).run)
        threads = [threading.Thread(target=run, daemon=True) for run in shells]
        closing.callback(log.handlers.__setitem__, slice(None), handlers)
        try:
            for thread in threads:
                thread.start()
            station_bus = bus("groundstation")
            owner = simulated_time(station_bus, stop)
            options = station_process.StationOptions(automatic=True)
            run_steps(station_process.cycles(experiment, station_bus, folder, options, stop, owner))
        finally:
            stop.request()
            for thread in threads:
                thread.join(20.0)
    return record
