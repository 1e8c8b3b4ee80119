"""SHELL: the localizer's process: the newest frame in, a pose per robot out, a preview for people now and then."""

import time
from collections.abc import Iterator

import cv2

from localizer.locate import Located, Locator
from localizer.overlay import draw
from wire import topics
from wire.bus import Bus, Received
from wire.experiment import Experiment
from wire.messages import CameraHealth, Frame, LocalizerStatus, Preview, RobotState
from wire.runtime import Clock, Lockstep, LockstepClock, Stop, WallClock, age_s, log, log_to_bus, wait

SILENT_AFTER_S = 0.5  # without a frame for so long, say that the camera is absent, again and again
PREVIEW_QUALITY = 70  # JPEG: about 40 kB at 640 x 480


class Shell:
    """Inboxes, clock and locator."""

    def __init__(self, experiment: Experiment, bus: Bus, stop: Stop, lockstep: bool) -> None:
        self._experiment, self._bus, self._stop, self._lockstep = experiment, bus, stop, lockstep
        self._clock: Clock = LockstepClock() if lockstep else WallClock()
        self._locator = Locator(experiment)
        self._frames = bus.inbox(topics.FRAME, Frame)
        self._states = {r: bus.inbox(topics.STATE, RobotState, r) for r in experiment.robot_ids}
        self._sequence = 0
        self._dropped = 0
        self._preview_due_ns = 0
        self._told = CameraHealth.OK

    def run(self) -> None:
        """Localize until told to stop."""
        log_to_bus(self._bus, self._clock, "localizer")
        self._bus.announce("localizer")
        log.info("ready, experiment %s", self._experiment.hash[:8])
        for frame, up_to_ns in self._lockstep_frames() if self._lockstep else self._wall_frames():
            if frame is None:
                status = LocalizerStatus(CameraHealth.ABSENT, message=f"no frame for {SILENT_AFTER_S} s")
                self._publish_status(status, self._clock.now_ns())
                continue
            self._handle(frame, up_to_ns)

    def _handle(self, frame: Received[Frame], up_to_ns: int | None) -> None:
        started_ns = time.perf_counter_ns()
        stamp_ns = frame.header.stamp_ns
        if self._sequence and frame.header.sequence > self._sequence:
            self._dropped += frame.header.sequence - self._sequence - 1
        self._sequence = frame.header.sequence
        # One time base for the filter: our own instants of the exposures, so that a camera's clock may be anything.
        located = self._locator.step(frame.message.pixels, self._clock.instant_ns(frame), self._depths(up_to_ns))
        age_ns = max(round(age_s(self._clock, frame) * 1e9), 0)
        for robot, pose in located.poses:
            self._bus.publish(topics.POSE, pose, stamp_ns, robot, age_ns=age_ns)
        frame_ms = (time.perf_counter_ns() - started_ns) * 1e-6
        status = LocalizerStatus(
            located.status.camera, located.status.frames, self._dropped, frame_ms, age_ns * 1e-6, located.status.message
        )
        self._publish_status(status, stamp_ns)
        self._preview(frame, located)

    def _depths(self, up_to_ns: int | None) -> dict[int, float]:
        """Depths by the robots' own pressure sensors, as far as fresh."""
        found = {robot: inbox.newest(up_to_ns) for robot, inbox in self._states.items()}
        limit_s = topics.STATE.max_age_s
        return {
            robot: state.message.depth_m
            for robot, state in found.items()
            if state is not None and age_s(self._clock, state) <= limit_s and state.message.board_age_ms <= limit_s * 1e3
        }

    def _publish_status(self, status: LocalizerStatus, stamp_ns: int) -> None:
        self._bus.publish(topics.LOCALIZER, status, stamp_ns)
        if status.camera is not self._told:
            self._told = status.camera
            say = log.info if status.camera is CameraHealth.OK else log.error
            say("camera %s%s", status.camera.name.lower(), f": {status.message}" if status.message else "")

    def _preview(self, frame: Received[Frame], located: Located) -> None:
        """A small annotated picture, a few times a second. Poses are already out."""
        rate_hz = self._experiment.localizer.preview_rate_hz
        if rate_hz <= 0 or frame.header.stamp_ns < self._preview_due_ns:
            return
        self._preview_due_ns = frame.header.stamp_ns + round(1e9 / rate_hz)
        picture = draw(self._locator, frame.message.pixels, located)
        good, jpeg = cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, PREVIEW_QUALITY])
        if good:
            self._bus.publish(topics.PREVIEW, Preview(jpeg.tobytes()), frame.header.stamp_ns)

    # --- when there is a frame to look at

    def _wall_frames(self) -> Iterator[tuple[Received[Frame] | None, None]]:
        last = self._frames.newest_header()
        while not self._stop.requested:
            seen = last
            if wait(self._bus, self._stop, lambda seen=seen: self._frames.newest_header() is not seen, SILENT_AFTER_S):  # type: ignore[misc]
                last = self._frames.newest_header()
                received = self._frames.newest()
                if received is not None:
                    yield received, None
            elif not self._stop.requested:
                yield None, None

    def _lockstep_frames(self) -> Iterator[tuple[Received[Frame], int]]:
        assert isinstance(self._clock, LockstepClock)
        lockstep = Lockstep(self._bus, self._stop, self._clock)
        done_ns = -1
        while (tick := lockstep.next()) is not None:
            if tick.frame_ns <= done_ns:
                continue
            states = [(self._states[robot], tick.previous_ns) for robot in tick.robots]
            lockstep.await_all([(self._frames, tick.frame_ns), *states])
            received = self._frames.newest(tick.frame_ns)
            if received is not None:
                done_ns = tick.frame_ns
                yield received, tick.previous_ns
