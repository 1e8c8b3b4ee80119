"""Faults of cameras in lockstep flights, in this process: how busy the machine is makes no difference."""

import math
import tempfile
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import TypeVar

import numpy as np

from shoal.bus.bus import Bus
from shoal.bus.memory_transport import MemoryHub, MemoryTransport
from shoal.config.experiment import dump_experiment, load_experiment
from shoal.messages import topics
from shoal.messages.codec import decode
from shoal.messages.messages import Event, LocalizerStatus, Mode, Pose, RobotState, Truth
from shoal.messages.topics import Topic
from sim_bridge.in_process.executor import Executor
from tests.faults.row import HELD, LEFT, Random, Sample

OFF_TRUTH = "pose off the truth"
FLOWN_S, FOR_S, LATEST_S = 12.0, 6.0, 5.0
# Of scene two-cameras, along the trajectories: the east sees both robots, or the west alone sees robot 2.
EAST_SEES_S, WEST_ALONE_S = (7.0, 14.0), (0.5, 2.5)
BUMPED_FOR_S, BEFORE_END_S = 3.0, 1.0

SAID = (topics.EVENT, topics.STATE, topics.POSE, topics.TRUTH, topics.LOCALIZER)

M = TypeVar("M")


class FaultyFlight:
    """A lockstep flight of a scene with one fault, and what was said in it: messages with their instants and robots."""

    def __init__(self, scene: str, settings: Sequence[str], what: str, times: str) -> None:
        hub = MemoryHub()
        experiment = load_experiment(scene, settings, [f"{times} {what}"])
        with Bus(MemoryTransport(hub)) as bus, tempfile.TemporaryDirectory() as out:
            recordings = {topic: bus.collect(topic) for topic in SAID}
            folder = Path(out)
            (folder / "experiment.toml").write_text(dump_experiment(experiment), encoding="utf-8")
            Executor(experiment, folder, hub).fly()
            self._recordings = {topic: collected() for topic, collected in recordings.items()}
        instants_ns = {event.message: at_ns for at_ns, _, event in self.said(topics.EVENT, Event)}
        self.begin_ns = instants_ns[f"fault: {what}"]
        self.end_ns = instants_ns.get(f"fault over: {what}", max(instants_ns.values()))

    def said(self, topic: Topic, kind: type[M]) -> list[tuple[int, int, M]]:
        """All messages of a topic: instant, robot (0: of none), message."""
        robot = topic.name.split("/").index("{robot}") - len(topic.name.split("/")) if "{robot}" in topic.name else 0
        return [
            (header.stamp_ns, int(key.split("/")[robot]) if robot else 0, decode(kind, data, "flight", key))
            for _, key, header, data in self._recordings[topic]
        ]

    def left(self) -> float:
        """The number of robots that did anything but track while the fault was there."""
        states = self.said(topics.STATE, RobotState)
        return float(
            len({r for at, r, state in states if self.begin_ns <= at <= self.end_ns and state.mode is not Mode.TRACKING})
        )

    def first_s(self, instants_ns: Iterable[int]) -> float:
        """Time from the fault to the first of some instants at which it was there."""
        return min(((at - self.begin_ns) * 1e-9 for at in instants_ns if at >= self.begin_ns), default=math.inf)

    def out_s(self, camera: str) -> float:
        """Time from the fault until a camera is told to be out."""
        return self.first_s(at for at, _, status in self.said(topics.LOCALIZER, LocalizerStatus) if camera in status.out)

    def off_truth_m(self) -> float:
        """The largest distance of a pose from the true place while the fault was there."""
        true = {at: dict(zip(t.robots, t.eta, strict=True)) for at, _, t in self.said(topics.TRUTH, Truth)}
        poses = [(at, r, pose) for at, r, pose in self.said(topics.POSE, Pose) if self.begin_ns <= at <= self.end_ns]
        return max(float(np.hypot(*(np.array([p.x_m, p.y_m]) - true[at][r][:2]))) for at, r, p in poses)


def camera_bubbles(rig: None, random: Random) -> Sample:
    """Bubbles rise before robots and floor: specks that come and go are neither obstacles nor a reason to lose a robot."""
    settings = [f"duration_s={FLOWN_S}", f"seed={int(random.integers(1 << 30))}"]
    what = f"camera bubbles {int(random.integers(10, 51))}"
    flight = FaultyFlight("figure-eight", settings, what, f"t={random.uniform(1.0, LATEST_S):.2f} for={FOR_S:g}")
    return {LEFT: flight.left(), OFF_TRUTH: flight.off_truth_m()}


def camera_bumped_of_two(rig: None, random: Random) -> Sample:
    """West is bumped while the east sees both robots."""
    flight = _bumped(random, EAST_SEES_S)
    return {"camera out": flight.out_s("west"), LEFT: flight.left(), OFF_TRUTH: flight.off_truth_m()}


def camera_bumped_alone(rig: None, random: Random) -> Sample:
    """West is bumped while it alone sees robot 2."""
    flight = _bumped(random, WEST_ALONE_S)
    held = (at for at, _, state in flight.said(topics.STATE, RobotState) if state.mode in HELD)
    return {"camera out": flight.out_s("west"), "hold": flight.first_s(held), OFF_TRUTH: flight.off_truth_m()}


def _bumped(random: Random, between_s: tuple[float, float]) -> FaultyFlight:
    begin_s, pixels = random.uniform(*between_s), 2 * int(random.integers(8, 41))
    settings = [f"duration_s={begin_s + BUMPED_FOR_S + BEFORE_END_S:.2f}", f"seed={int(random.integers(1 << 30))}"]
    return FaultyFlight("two-cameras", settings, f"camera west bump {pixels}", f"t={begin_s:.2f} for={BUMPED_FOR_S:g}")
