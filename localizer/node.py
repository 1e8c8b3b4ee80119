"""SHELL: the localizer's process: the newest picture in, a pose per robot out, and what else is in the water.

Obstacles are looked for when the poses are out: 2 ms on every other frame, in which no pose waits unless the camera is faster
than 100 Hz.
"""

import time
from contextlib import ExitStack, closing
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from localizer.detection.obstacles import ObstacleWatch
from localizer.sources.base import Shot, Source
from localizer.sources.factory import BUS, open_bus, open_own
from localizer.tracking.fleet_localizer import Located, Locator
from localizer.view.mjpeg_server import Page
from localizer.view.overlay import draw
from localizer.view.preview import Previews
from localizer.view.video_encoder import VideoMaker
from wire.config.experiment import Experiment
from wire.messages import topics
from wire.messages.messages import CameraHealth, LocalizerStatus, Obstacles, RobotState, Track
from wire.process.lockstep import LockstepClock
from wire.process.runtime import Clock, Stop, WallClock, age_s, log, log_to_bus
from wire.toml_loader import ConfigError
from wire.transport.bus import Bus
from wire.transport.endpoint import Endpoint
from wire.transport.zenoh_transport import ZenohTransport

FAILURES_IN_A_ROW = 10  # pictures, 0.5 s at 20 Hz: after that the localizer ends, to be started anew by who watches it


@dataclass(frozen=True)
class Options:
    """What a command line can ask for beside the experiment."""

    source: str = BUS
    publish_frames: bool = False  # of an own camera: put its pictures on the bus
    page_port: int | None = None  # serve the annotated pictures to a browser here


def run(experiment: Experiment, endpoint: Endpoint, fleet: str, stop: Stop, lockstep: bool, options: Options) -> None:
    """Open everything, localize, close everything. Raises ConfigError for what cannot be opened, before it waits for a
    station; Failed if a part of it could not go on."""
    clock: Clock = LockstepClock() if lockstep else WallClock()
    if options.source == BUS and options.publish_frames:
        raise ConfigError(f"--publish-frames: the frames of --source {BUS} are on the bus already")
    with ExitStack() as stack:
        own, page = None, None
        if options.source != BUS:
            own = stack.enter_context(closing(open_own(options.source, experiment.camera, clock)))
        if options.page_port is not None:
            page = stack.enter_context(closing(Page(options.page_port, stop)))
        bus = stack.enter_context(Bus(ZenohTransport(endpoint, stop), fleet))
        Shell(experiment, bus, stop, clock, own, page, options.publish_frames).run()
    stop.raise_failure()


class Shell:
    """Source, inboxes, locator. Pictures come from `own`, or from the bus if there is none."""

    def __init__(
        self,
        experiment: Experiment,
        bus: Bus,
        stop: Stop,
        clock: Clock,
        own: Source | None = None,
        page: Page | None = None,
        publish_frames: bool = False,
    ) -> None:
        self._experiment, self._bus, self._stop, self._clock = experiment, bus, stop, clock
        self._page, self._publish_frames = page, publish_frames
        self._states = bus.inboxes(topics.STATE, RobotState, experiment.robot_ids)
        self._source = own or open_bus(bus, clock, stop, experiment.camera.rate_hz, self._states)
        self._locator = Locator(experiment)
        self._watch = _obstacle_watch(experiment)
        self._obstacles, self._obstacles_ns = Obstacles(), -1  # the newest, and the stamp of the newest that was told
        self._status = LocalizerStatus()
        self._told = CameraHealth.OK
        self._failed, self._failed_in_a_row = 0, 0  # pictures
        self._video: VideoMaker | None = None

    def run(self) -> None:
        """Localize until told to stop, or until a recording is over."""
        rate_hz = self._experiment.localizer.preview_rate_hz
        show = partial(draw, self._locator)
        with ExitStack() as stack:
            if self._experiment.recording.video != "none":
                self._video = stack.enter_context(closing(VideoMaker(self._experiment, self._bus, self._stop)))
            previews = Previews(show, self._bus, self._clock, self._stop, rate_hz, self._page, self._publish_frames)
            stack.enter_context(closing(previews))
            log_to_bus(self._bus, self._clock, "localizer")
            self._bus.announce("localizer")
            log.info("ready, experiment %s", self._experiment.hash[:8])
            for shot in self._source.shots(self._stop):
                if shot is None:
                    self._say_absent(previews)
                else:
                    self._handle(shot, previews)

    def _handle(self, shot: Shot, previews: Previews) -> None:
        """One picture. An exception costs this picture, FAILURES_IN_A_ROW of them the process."""
        started_ns = time.perf_counter_ns()
        try:
            located = self._locator.step(shot.pixels, shot.instant_ns, self._depths(shot.inputs_up_to_ns))
            age_ns = max(self._clock.now_ns() - shot.instant_ns, 0)
            for robot, pose in located.poses:
                self._bus.publish(topics.POSE, pose, shot.stamp_ns, robot, age_ns=age_ns)
        except Exception as error:
            self._skip(shot, error, previews)
            return
        self._failed_in_a_row = 0
        frame_ms = (time.perf_counter_ns() - started_ns) * 1e-6
        found = located.status
        told = tuple(robot for robot, _ in located.poses)
        status = LocalizerStatus(
            found.camera,
            found.frames,
            shot.dropped,
            frame_ms,
            age_ns * 1e-6,
            found.message,
            told,
            self._obstacles_ns,
            self._failed,
        )
        self._publish_status(status, shot.stamp_ns)
        self._look_for_obstacles(shot, located)
        previews.offer(shot, located, self._obstacles)
        if self._video is not None:
            self._video.offer(shot)

    def _skip(self, shot: Shot, error: Exception, previews: Previews) -> None:
        """No poses of this picture: the status says why, so that in lockstep nobody waits for them."""
        self._failed, self._failed_in_a_row = self._failed + 1, self._failed_in_a_row + 1
        why = f"picture skipped: {type(error).__name__}: {error}"
        if self._failed_in_a_row == 1:
            log.error("%s", why, exc_info=error)
        status = replace(self._status, message=why, robots=(), obstacles_ns=self._obstacles_ns, failed=self._failed)
        self._publish_status(status, shot.stamp_ns)
        previews.offer_nothing(why, shot.stamp_ns)
        if self._failed_in_a_row >= FAILURES_IN_A_ROW:
            self._stop.fail(f"{self._failed_in_a_row} pictures in a row could not be localized in: {error}")

    def _look_for_obstacles(self, shot: Shot, located: Located) -> None:
        if self._watch is None:
            return
        if located.status.camera is not CameraHealth.OK:
            self._obstacles = Obstacles()
            return
        seen = [[pose.x_m, pose.y_m, pose.depth_m] for _, pose in located.poses if pose.track is not Track.LOST]
        try:
            found = self._watch.step(shot.pixels, shot.instant_ns, np.array(seen).reshape(-1, 3))
        except Exception as error:
            log.error("obstacles: %s: %s; the water is learnt anew", type(error).__name__, error, exc_info=error)
            self._watch, found = ObstacleWatch(self._experiment), Obstacles()  # nothing is watched, and that is told
        if found is not None:
            self._obstacles, self._obstacles_ns = found, shot.stamp_ns
            self._bus.publish(topics.OBSTACLES, found, shot.stamp_ns, age_ns=max(self._clock.now_ns() - shot.instant_ns, 0))

    def _say_absent(self, previews: Previews) -> None:
        why = f"no frame for {self._source.silent_after_s:g} s" + (f": {self._source.trouble}" if self._source.trouble else "")
        now_ns = self._clock.now_ns()
        self._publish_status(replace(self._status, camera=CameraHealth.ABSENT, message=why, robots=()), now_ns)
        previews.offer_nothing(why, now_ns)

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
        self._status = status
        self._bus.publish(topics.LOCALIZER, status, stamp_ns)
        if status.camera is not self._told:
            self._told = status.camera
            say = log.info if status.camera is CameraHealth.OK else log.error
            say("camera %s%s", status.camera.name.lower(), f": {status.message}" if status.message else "")


def _obstacle_watch(experiment: Experiment) -> ObstacleWatch | None:
    """None where none are asked for, or where the background moves with the camera."""
    if experiment.localizer.obstacle_min_m <= 0.0:
        return None
    if experiment.landmarks:
        log.info("obstacles are not looked for: the camera moves")
        return None
    return ObstacleWatch(experiment)
