"""SHELL: localizers in lockstep: a frame, or a fusion of several cameras' poses, for each picture that is exposed."""

import math
from collections.abc import Iterator, Mapping
from dataclasses import replace

from localizer.fusion_node import FusionNode, PicturesUpTo
from localizer.node import FrameOutlets, LocalizerNode
from localizer.sources.base import CapturedFrame
from localizer.sources.bus import FrameCount
from shoal.bus.bus import Bus, Inbox
from shoal.config.experiment import Experiment
from shoal.messages import topics
from shoal.messages.messages import Frame, RobotState
from shoal.runtime.runtime import Stop
from sim_bridge.lockstep.clock import Lockstep, LockstepClock


def localizer_in_lockstep(experiment: Experiment, bus: Bus, stop: Stop, camera: str = "") -> LocalizerNode:
    """The localizer of one of several cameras, or of the only one, with the simulator's time."""
    clock = LockstepClock()
    node = LocalizerNode(experiment, bus, stop, clock, outlets=FrameOutlets(whole_film=True), camera=camera)
    number = experiment.camera_names.index(camera) if camera else None
    node.source = LockstepSource(bus, clock, stop, node.states, camera, number)
    return node


def fusion_in_lockstep(experiment: Experiment, bus: Bus, stop: Stop) -> FusionNode:
    """The fusion of several cameras' poses, with the simulator's time."""
    clock = LockstepClock()
    node = FusionNode(experiment, bus, stop, clock)
    node.pace = FusionPace(node, Lockstep(bus, stop, clock, topics.EXPOSED))
    return node


class FusionPace:
    """The ticks at which pictures are fused."""

    def __init__(self, node: FusionNode, lockstep: Lockstep) -> None:
        self._node, self._lockstep = node, lockstep

    def __iter__(self) -> Iterator[PicturesUpTo]:
        """Yield at each tick, once all that belongs to the cameras' pictures is here."""
        up_to_ns: dict[str, tuple[int, int]] = {}
        while (tick := self._lockstep.next()) is not None:
            for (name, camera), frame_ns in zip(self._node.cameras.items(), tick.frames_ns, strict=False):
                one = replace(tick, frame_ns=frame_ns)
                sight_ns = self._lockstep.await_sight(one, camera.status, camera.poses, camera.obstacles)
                if frame_ns >= 0 and sight_ns is not None:
                    up_to_ns[name] = frame_ns, sight_ns
            if not self._node.stop.requested:
                yield up_to_ns


class LockstepSource:
    """Frames of the simulator that owns the clock.

    Each step waits for the frame and the robots' states that its tick names, and the instants are the simulator's. The
    inputs of a tick are settled when its frame is taken, so poses are made while the simulator moves on to the tick.
    """

    trouble, silent_after_s = "", math.inf

    def __init__(
        self,
        bus: Bus,
        clock: LockstepClock,
        stop: Stop,
        states: Mapping[int, Inbox[RobotState]],
        camera: str = "",
        number: int | None = None,
    ) -> None:
        """Make it for the only camera, or for one of several with its number in the experiment."""
        self._lockstep = Lockstep(bus, stop, clock, topics.EXPOSED)
        self._clock, self._states, self._number = clock, states, number
        self._frames = bus.inbox(topics.FRAME.of_camera(camera), Frame)
        self._count = FrameCount()

    def frames(self, stop: Stop) -> Iterator[CapturedFrame]:
        """See FrameSource. Without a tick time stands still, so no frame is ever late."""
        done_ns = -1
        while not stop.requested and (tick := self._lockstep.next()) is not None:
            frame_ns = tick.frame_ns if self._number is None else dict(enumerate(tick.frames_ns)).get(self._number, -1)
            if frame_ns <= done_ns:  # one of several cameras may be late, or gone
                continue
            states = [(self._states[robot], tick.previous_ns) for robot in tick.heard_robots]
            if not self._lockstep.await_all([(self._frames, frame_ns), *states]):
                return
            received = self._frames.newest(frame_ns)
            if received is not None:
                done_ns = frame_ns
                stamp_ns, dropped = received.header.stamp_ns, self._count.note(received)
                yield CapturedFrame(
                    received.message.pixels,
                    stamp_ns,
                    stamp_ns,
                    self._clock.now_ns(),
                    dropped,
                    inputs_up_to_ns=tick.previous_ns,
                )

    def close(self) -> None:
        """Do nothing: the bus is the caller's."""
