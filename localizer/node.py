"""SHELL: the localizer's process: the newest frame in, a pose per robot and the obstacles out.

In each frame: poses, status, obstacles, then the rest of the tracking (`FleetLocalizer.finish`). No pose waits for what
follows it, unless the next frame comes before that is done.
"""

import time
from collections.abc import Generator
from contextlib import ExitStack, closing
from dataclasses import astuple, dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from localizer.detection.obstacles import ObstacleDetector
from localizer.sources.base import CapturedFrame, FrameSource
from localizer.sources.bus import BusSource
from localizer.sources.factory import BUS, open_own
from localizer.sources.recording import FrameRecorder, RecordedFrame
from localizer.sources.session_stamps import SessionStamps
from localizer.tracking.check_marks import with_camera
from localizer.tracking.fleet_localizer import FleetLocalizer, LocalizationResult
from localizer.tracking.tilt import Attitude
from localizer.view.overlay import draw
from localizer.view.preview import PreviewPublisher
from localizer.view.video_encoder import VideoEncoder
from shoal.bus.bus import Bus, Received
from shoal.bus.endpoint import Endpoint
from shoal.bus.frame_ring import codec_of
from shoal.bus.zenoh_transport import ZenohTransport
from shoal.config.experiment import Experiment
from shoal.errors import ConfigError
from shoal.frames import Array
from shoal.messages import topics
from shoal.messages.codec import encode
from shoal.messages.messages import CameraHealth, LocalizerStatus, Obstacles, Pose, RobotState, Track
from shoal.messages.topics import Topic
from shoal.runtime.runtime import Clock, Failed, Stop, WallClock, age_s, log, log_to_bus, run_steps
from shoal.runtime.version import code

if TYPE_CHECKING:
    from localizer.view.mjpeg_server import MjpegServer

FAILURES_IN_A_ROW = 10  # frames (0.5 s at 20 Hz) that may fail before the process ends, for its supervisor to restart it


@dataclass(frozen=True)
class NodeOptions:
    """Choices of the command line beside the experiment."""

    source: str = BUS
    publish_frames: bool = False  # put the frames of a camera at this machine on the bus
    page_port: int | None = None  # port of the annotated pictures for a browser
    frame_ring: int | None = None  # descriptor of the ring that frames come in, beside the bus
    record: Path | None = None  # folder for the frames and all that the localizer goes by
    camera: str = ""  # one of several cameras


def run(experiment: Experiment, endpoint: Endpoint, fleet: str, stop: Stop, options: NodeOptions) -> None:
    """Open source, page and bus, localize, close them.

    Raises ConfigError for anything that cannot be opened, before it waits for a station; Failed if a part could not go on.
    """
    clock = WallClock()
    alone = with_camera(experiment, options.camera)
    if options.source == BUS and options.publish_frames:
        raise ConfigError(f"--publish-frames: the frames of --source {BUS} are on the bus already")
    with ExitStack() as stack:
        own, page, recorder = None, None, None
        if options.source != BUS:
            own = stack.enter_context(closing(open_own(options.source, alone.camera, clock)))
        if options.page_port is not None:
            from localizer.view.mjpeg_server import MjpegServer  # its web server takes long to import

            page = stack.enter_context(closing(MjpegServer(options.page_port, stop)))
        if options.record is not None:
            recorder = stack.enter_context(closing(FrameRecorder(options.record, alone)))
        bus = stack.enter_context(Bus(ZenohTransport(endpoint, stop), fleet, *codec_of(options.frame_ring)))
        bus.claim(topics.localizer_name(options.camera), stop)
        outlets = FrameOutlets(page, options.publish_frames, recorder)
        LocalizerNode(experiment, bus, stop, clock, own, outlets, options.camera).run()
    stop.raise_failure()
    if recorder is not None and recorder.failure:
        raise Failed(recorder.failure)


@dataclass(frozen=True)
class FrameOutlets:
    """Outlets of frames besides the localizer's core."""

    page: "MjpegServer | None" = None  # the picture with what was found in it, for people
    on_bus: bool = False  # as they are, for other programs
    recorder: FrameRecorder | None = None  # into a file
    whole_film: bool = False  # time waits for the log's video


class LocalizerNode:
    """The loop around the core. Frames come from `own`, or from the bus if that is None."""

    def __init__(
        self,
        experiment: Experiment,
        bus: Bus,
        stop: Stop,
        clock: Clock,
        own: FrameSource | None = None,
        outlets: FrameOutlets = FrameOutlets(),
        camera: str = "",
    ) -> None:
        """`camera` is one of several, whose topics it publishes; "" the only one."""
        self._camera, self._name = camera, topics.localizer_name(camera)
        self._hash = experiment.hash
        experiment = with_camera(experiment, camera)
        self._experiment, self._bus, self.stop, self._clock = experiment, bus, stop, clock
        self._outlets = outlets
        self.states = bus.inboxes(topics.STATE, RobotState, experiment.robot_ids)
        self._has_own_source = own is not None
        self.source = own  # may be replaced before the loop begins; None: frames come from the bus
        self._localizer = FleetLocalizer(experiment, sees_all=camera == "")
        self._obstacle_detector = _make_obstacle_detector(experiment)
        self._obstacles, self._obstacles_ns = Obstacles(), -1  # the newest, and the stamp of the newest that was told
        self._status = LocalizerStatus(code=code().short, experiment_hash=self._hash)
        self._reported_places = dict[int, Array]()  # where robots say that they are, (3,)
        self._last_health = CameraHealth.OK
        self._failed, self._failed_in_a_row = 0, 0  # pictures
        self._video: VideoEncoder | None = None
        self._stamps = SessionStamps()

    def run(self) -> None:
        """Localize until told to stop, or until a recording is over."""
        run_steps(self.steps())

    def steps(self) -> Generator[None]:
        """The loop: yields when the localizer is ready, and after each frame; `next` waits for the next one."""
        rate_hz = self._experiment.localizer.preview_rate_hz
        source = self.source or BusSource(self._bus, self._clock, self._experiment.camera.rate_hz, self._camera)
        show = partial(draw, self._localizer, labels=self._outlets.page is not None)
        with ExitStack() as stack:
            if self._experiment.recording.video != "none":
                whole = self._outlets.whole_film
                video = VideoEncoder(self._experiment, self._bus, self.stop, self._camera, whole)
                self._video = stack.enter_context(closing(video))
            previews = PreviewPublisher(
                show, self._bus, self._clock, self.stop, rate_hz, self._outlets.page, self._outlets.on_bus, self._camera
            )
            stack.enter_context(closing(previews))
            log_to_bus(self._bus, self._clock, self._name)
            self._bus.announce(self._name)
            log.info("%s", code())
            log.info("ready, experiment %s", self._hash[:8])
            if not (self._experiment.check_marks or self._experiment.landmarks):
                say = log.warning if self._has_own_source else log.info
                say(
                    "nothing guards the camera: without check_marks nobody notices that it was knocked, or that the water sank"
                )
            yield
            for captured in source.frames(self.stop):
                if captured is None:
                    self._report_absent(source, previews)
                else:
                    self._handle(captured, previews)
                yield

    def _handle(self, captured: CapturedFrame, previews: PreviewPublisher) -> None:
        """Localize one frame. An exception costs this frame; FAILURES_IN_A_ROW of them end the process."""
        started_ns = time.perf_counter_ns()
        stamp_ns = self._stamps.of("", captured.stamp_ns, captured.instant_ns, captured.session)
        captured = replace(captured, stamp_ns=stamp_ns)
        depths_m, known_attitudes = dict[int, float](), dict[int, Attitude]()
        try:
            states = self._fresh_states(captured.inputs_up_to_ns)
            estimates = {robot: state.message.estimate for robot, state in states.items()}
            self._reported_places = {robot: estimate.eta[:3] for robot, estimate in estimates.items() if estimate is not None}
            boards = {robot: state.message.board for robot, state in states.items()}
            depths_m = {robot: board.depth_m for robot, board in boards.items() if board is not None}
            attitudes = {robot: self._attitude(state, captured.instant_ns) for robot, state in states.items()}
            known_attitudes = {robot: attitude for robot, attitude in attitudes.items() if attitude is not None}
            result = self._localizer.locate(captured.pixels, captured.instant_ns, depths_m, known_attitudes)
            age_ns = max(self._clock.now_ns() - captured.instant_ns, 0)
            for robot, pose in result.poses:
                self._bus.publish(self._own(topics.POSE), pose, captured.stamp_ns, robot, age_ns=age_ns)
        except Exception as error:
            self._report_failure(captured, error, previews)
            self._record(captured, depths_m, known_attitudes, ())
            return
        frame_ms = (time.perf_counter_ns() - started_ns) * 1e-6
        result_status = result.status
        robots = tuple(robot for robot, _ in result.poses)
        status = replace(
            result_status, dropped=captured.dropped, frame_ms=frame_ms, frame_age_ms=age_ns * 1e-6, robots=robots,
            obstacles_ns=self._obstacles_ns, failed=self._failed, code=code().short, experiment_hash=self._hash,
        )  # fmt: skip
        self._publish_status(status, captured.stamp_ns, age_ns)
        self._detect_obstacles(captured, result)
        self._finish()
        previews.offer(captured, result, self._obstacles)
        if self._video is not None:
            self._video.offer(captured)
        self._record(captured, depths_m, known_attitudes, result.poses)

    def _record(
        self,
        captured: CapturedFrame,
        depths_m: dict[int, float],
        attitudes: dict[int, Attitude],
        poses: tuple[tuple[int, Pose], ...],
    ) -> None:
        """Give the recorder a frame, with the inputs for it and the results that were published."""
        if self._outlets.recorder is not None:
            attitude_values = {robot: astuple(attitude) for robot, attitude in attitudes.items()}
            published = {robot: encode(pose) for robot, pose in poses}
            self._outlets.recorder.put(
                RecordedFrame(captured.pixels, captured.stamp_ns, captured.instant_ns, depths_m, attitude_values, published)
            )

    def _finish(self) -> None:
        """Do the tracking that no pose waits for. The next status reports an exception here, as one before the poses."""
        try:
            self._localizer.finish()
        except Exception as error:
            self._count_failure(f"appearances not updated: {type(error).__name__}: {error}", error)
        else:
            self._failed_in_a_row = 0

    def _report_failure(self, captured: CapturedFrame, error: Exception, previews: PreviewPublisher) -> None:
        """Publish the reason for a frame without poses, so that nobody waits for its poses."""
        why = f"picture skipped: {type(error).__name__}: {error}"
        self._count_failure(why, error)
        status = replace(self._status, message=why, robots=(), obstacles_ns=self._obstacles_ns, failed=self._failed)
        self._publish_status(status, captured.stamp_ns)
        previews.offer_nothing(why, captured.stamp_ns)

    def _count_failure(self, why: str, error: Exception) -> None:
        """Count a picture in which localizing failed. Too many in a row end the process."""
        self._failed, self._failed_in_a_row = self._failed + 1, self._failed_in_a_row + 1
        if self._failed_in_a_row == 1:
            log.error("%s", why, exc_info=error)
        if self._failed_in_a_row >= FAILURES_IN_A_ROW:
            self.stop.fail(f"{self._failed_in_a_row} pictures in a row could not be localized in: {error}")

    def _detect_obstacles(self, captured: CapturedFrame, result: LocalizationResult) -> None:
        """Search a frame for obstacles; forget them while the camera is unwell."""
        if self._obstacle_detector is None:
            return
        if result.status.camera is not CameraHealth.OK:
            self._obstacles = Obstacles()
            return
        robot_places = {
            robot: [pose.x_m, pose.y_m, pose.depth_m] for robot, pose in result.poses if pose.track is not Track.LOST
        }
        if self._camera:  # at the picture's edge a robot is known by another camera's poses, and is no obstacle either
            robot_places = {robot: place.tolist() for robot, place in self._reported_places.items()} | robot_places
        try:
            obstacles = self._obstacle_detector.step(
                captured.pixels, captured.instant_ns, np.array(list(robot_places.values())).reshape(-1, 3)
            )
        except Exception as error:
            log.error("obstacles: %s: %s; the water is learnt anew", type(error).__name__, error, exc_info=error)
            self._obstacle_detector, obstacles = self._obstacle_detector.begun_anew(captured.instant_ns)
        if obstacles is not None:
            self._obstacles, self._obstacles_ns = obstacles, captured.stamp_ns
            self._bus.publish(
                self._own(topics.OBSTACLES),
                obstacles,
                captured.stamp_ns,
                age_ns=max(self._clock.now_ns() - captured.instant_ns, 0),
            )

    def _report_absent(self, source: FrameSource, previews: PreviewPublisher) -> None:
        """Publish a status, and a preview, that say that no frames come."""
        why = f"no frame for {source.silent_after_s:g} s" + (f": {source.trouble}" if source.trouble else "")
        now_ns = self._stamps.now_ns(self._clock.now_ns())
        self._publish_status(replace(self._status, camera=CameraHealth.ABSENT, message=why, robots=()), now_ns)
        previews.offer_nothing(why, now_ns)

    def _fresh_states(self, up_to_ns: int | None) -> dict[int, Received[RobotState]]:
        """The robots' states whose board was heard of late: their depth and attitude count."""
        newest_states = {robot: inbox.newest(up_to_ns) for robot, inbox in self.states.items()}
        limit_s = topics.STATE.max_age_s
        return {
            robot: state
            for robot, state in newest_states.items()
            if state is not None
            and age_s(self._clock, state) <= limit_s
            and state.message.timing.board_age_ms is not None
            and state.message.timing.board_age_ms <= limit_s * 1e3
        }

    def _attitude(self, state: Received[RobotState], exposed_ns: int) -> Attitude | None:
        """Roll and pitch at the exposure, if the robot's board measures them."""
        board, age_ms = state.message.board, state.message.timing.board_age_ms
        if board is None or age_ms is None:
            return None
        measured_ns = self._clock.instant_ns(state) - age_ms * 1e6
        later_s = (exposed_ns - measured_ns) * 1e-9
        return Attitude.at(board.tilt, later_s, self._experiment.localizer.attitude_sigma_rad)

    def _own(self, topic: Topic) -> Topic:
        """The topic of this localizer's camera."""
        return topic.of_camera(self._camera)

    def _publish_status(self, status: LocalizerStatus, stamp_ns: int, age_ns: int = 0) -> None:
        """Publish a status, and log a change of the camera's health."""
        self._status = status
        self._bus.publish(self._own(topics.LOCALIZER), status, stamp_ns, age_ns=age_ns)
        if status.camera is not self._last_health:
            self._last_health = status.camera
            say = log.info if status.camera is CameraHealth.OK else log.error
            say("camera %s%s", status.camera.name.lower(), f": {status.message}" if status.message else "")


def _make_obstacle_detector(experiment: Experiment) -> ObstacleDetector | None:
    """The detector, or None if the experiment asks for none or the background moves with the camera."""
    if experiment.localizer.obstacle_min_m <= 0.0:
        return None
    if experiment.landmarks:
        log.info("obstacles are not looked for: the camera moves")
        return None
    return ObstacleDetector(experiment)
