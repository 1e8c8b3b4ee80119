"""SHELL: the process that fuses what the localizers of several cameras publish: `localizer fuse EXPERIMENT`.

It publishes poses, status and obstacles under the names that the localizer of a single camera has, so that nobody else needs
to know how many cameras there are. Pictures that were exposed together are fused together; a camera that is late, silent or
gone is not waited for.
"""

import time
from collections.abc import Generator, Iterable, Iterator, Mapping
from dataclasses import replace

from localizer.sources.base import silent_after_s
from localizer.sources.session_stamps import SessionStamps
from localizer.tracking.camera_fusion import CameraFusion, CameraView, FusionResult, fuse_obstacles
from shoal.bus.bus import Bus, Received
from shoal.bus.endpoint import Endpoint
from shoal.bus.zenoh_transport import ZenohTransport
from shoal.config.experiment import Experiment
from shoal.errors import ConfigError
from shoal.messages import topics
from shoal.messages.codec import Header
from shoal.messages.messages import LocalizerStatus, Obstacles, Pose
from shoal.runtime.runtime import Clock, Stop, WallClock, age_s, log, log_to_bus, run_steps, wait
from shoal.runtime.version import code

TOGETHER = 0.25  # of a frame period: pictures nearer in time are fused as one, and no pose waits longer for another camera
PicturesUpTo = Mapping[str, tuple[int, int]]  # by camera, the stamps up to which its status and its obstacles may be used

DISAGREEMENT_LOG_S = 5.0  # s between log lines about cameras that disagree


def run(experiment: Experiment, endpoint: Endpoint, fleet: str, stop: Stop) -> None:
    """Fuse until told to stop. Raises ConfigError for an experiment with one camera."""
    if not experiment.cameras:
        raise ConfigError(f"{experiment.name}: has one camera, whose poses need no fusion (allowed: with [[cameras]])")
    with Bus(ZenohTransport(endpoint, stop), fleet) as bus:
        bus.claim(topics.localizer_name(""), stop)
        FusionNode(experiment, bus, stop, WallClock()).run()


class CameraInboxes:
    """Inboxes of one camera's localizer, and the messages that were taken from them last."""

    def __init__(self, bus: Bus, camera: str, robots: tuple[int, ...]) -> None:
        self.status = bus.inbox(topics.LOCALIZER.of_camera(camera), LocalizerStatus)
        self.poses = bus.inboxes(topics.POSE.of_camera(camera), Pose, robots)
        self.obstacles = bus.inbox(topics.OBSTACLES.of_camera(camera), Obstacles)
        self.status_header: Header | None = None  # of the last status that was looked at
        self.used_status: Received[LocalizerStatus] | None = None
        self.used_obstacles: Received[Obstacles] | None = None
        self.trusted_obstacles: Received[Obstacles] | None = None  # the last that it sent while it was not out

    @property
    def is_new(self) -> bool:
        """True if a status has come that was not looked at."""
        return self.status.newest_header() is not self.status_header

    def is_due(self, now_ns: int, period_s: float, silent_s: float) -> bool:
        """True if the next status is about to come, or a new one is here without its poses. A silent camera is not due."""
        if not self.is_new:
            since_s = float("inf") if self.used_status is None else (now_ns - self.used_status.arrived_ns) * 1e-9
            return (1.0 - TOGETHER) * period_s < since_s < silent_s
        status = self.status.newest()
        if status is None:
            return False
        poses = [self.poses[robot].newest_header() for robot in status.message.robots if robot in self.poses]
        return not all(pose is not None and pose.stamp_ns >= status.header.stamp_ns for pose in poses)

    def poses_of(self, status: Received[LocalizerStatus]) -> dict[int, Pose]:
        """The poses of the picture that a status is about."""
        stamp_ns = status.header.stamp_ns
        poses = {robot: self.poses[robot].newest(stamp_ns) for robot in status.message.robots if robot in self.poses}
        return {robot: pose.message for robot, pose in poses.items() if pose and pose.header.stamp_ns == stamp_ns}


class FusionNode:
    """The loop around the core."""

    def __init__(self, experiment: Experiment, bus: Bus, stop: Stop, clock: Clock) -> None:
        rate_hz = experiment.all_cameras[0].rate_hz
        self._period_s, self._silent_s = 1.0 / rate_hz, silent_after_s(rate_hz)
        self._bus, self.stop, self._clock, self._hash = bus, stop, clock, experiment.hash
        self.cameras = {name: CameraInboxes(bus, name, experiment.robot_ids) for name in experiment.camera_names}
        self._up_to_ns: PicturesUpTo | None = None  # of the pictures that may be used; None: whatever has come
        self._fusion = CameraFusion(experiment)
        self._views: dict[str, CameraView] = {}
        self._newest = (-1, -1)  # instant and stamp of the newest picture
        self._obstacles_ns = -1
        # What the loop waits for before each fusion; lockstep replaces it before the loop begins.
        self.pace: Iterable[PicturesUpTo | None] = self._when_cameras_report()
        self._out: tuple[str, ...] = ()
        self._distrusted: tuple[str, ...] = ()
        self._next_disagreement_log_ns = 0
        self._stamps = SessionStamps()

    def run(self) -> None:
        """Fuse until told to stop."""
        run_steps(self.steps())

    def steps(self) -> Generator[None]:
        """The loop: yields when it is ready, and after each fusion; `next` waits for the next one."""
        log_to_bus(self._bus, self._clock, topics.localizer_name(""))
        self._bus.announce(topics.localizer_name(""))
        log.info("%s", code())
        log.info("ready, experiment %s, cameras %s", self._hash[:8], ", ".join(self.cameras))
        yield
        for up_to_ns in self.pace:
            self._up_to_ns = up_to_ns
            self._fuse()
            yield

    def _when_cameras_report(self) -> Iterator[None]:
        """Yield when the pictures of one instant can be fused, by the wall clock.

        After the first camera's report the others have a quarter of a frame period (TOGETHER) for theirs. Yields too when
        every camera has been silent for `_silent_s`, so that a status goes out.
        """
        cameras = self.cameras.values()
        while not self.stop.requested:
            if wait(self._bus, self.stop, lambda: any(camera.is_new for camera in cameras), self._silent_s):
                wait(self._bus, self.stop, self._no_camera_is_due, TOGETHER * self._period_s)
            if not self.stop.requested:
                yield

    def _no_camera_is_due(self) -> bool:
        """True if every camera has reported its picture, or will not do so soon."""
        now_ns = time.monotonic_ns()
        return not any(camera.is_due(now_ns, self._period_s, self._silent_s) for camera in self.cameras.values())

    def _fuse(self) -> None:
        """Fuse the cameras' new messages, and publish poses, obstacles and status."""
        new = [at for name, camera in self.cameras.items() if (at := self._take_picture(name, camera)) is not None]
        now_ns = self._clock.now_ns()
        new = new or [(now_ns, self._stamps.now_ns(now_ns))]
        self._newest = max(self._newest, *new)  # a late camera's picture is carried on to the others'
        instant_ns, stamp_ns = self._newest
        try:
            result = self._fusion.step(self._views, instant_ns)
        except Exception as error:  # of a message that is not what it should be: others may wait for the status
            why = f"pictures not fused: {type(error).__name__}: {error}"
            log.error("%s", why, exc_info=error)
            result = FusionResult((), LocalizerStatus(message=why, out=self._out), "", self._distrusted)
        self._distrusted = result.distrusted
        age_ns = max(self._clock.now_ns() - instant_ns, 0)
        for robot, pose in result.poses:
            self._bus.publish(topics.POSE, pose, stamp_ns, robot, age_ns=age_ns)
        self._publish_obstacles(result.distrusted)
        status = replace(
            result.status,
            frame_age_ms=age_ns * 1e-6,
            obstacles_ns=self._obstacles_ns,
            code=self._of_all("code", code().short),
            experiment_hash=self._of_all("experiment_hash", self._hash),
        )
        self._bus.publish(topics.LOCALIZER, status, stamp_ns, age_ns=age_ns)
        self._log(status, result.disagreement)

    def _of_all(self, field: str, own: str) -> str:
        """Merge a status field (code version, experiment hash) of this program, `own`, and of all cameras' localizers: a value
        that differs from `own` if there is one, so that the station sees the difference. An empty one comes last."""
        values = sorted((str(getattr(view.status, field)) for view in self._views.values()), reverse=True)
        return next((value for value in values if value != own), own)

    def _take_picture(self, name: str, camera: CameraInboxes) -> tuple[int, int] | None:
        """Take a camera's newest picture. Returns its instant and stamp, None if there is no new one."""
        camera.status_header = camera.status.newest_header()
        status_ns, _ = self._newest_usable_ns(name)
        status = camera.status.newest(status_ns)
        if status is None or status is camera.used_status:
            return None
        camera.used_status = status
        instant_ns = self._clock.instant_ns(status)
        self._views[name] = CameraView(instant_ns, status.message, camera.poses_of(status))
        return instant_ns, self._stamps.of(name, status.header.stamp_ns, instant_ns, status.header.session)

    def _newest_usable_ns(self, camera: str) -> tuple[int | None, int | None]:
        """Stamps of the newest status and obstacles of a camera that may be used; None: whatever has come."""
        return (None, None) if self._up_to_ns is None else self._up_to_ns.get(camera, (-1, -1))

    def _publish_obstacles(self, out: tuple[str, ...]) -> None:
        """Publish the obstacles of all cameras when one that is not `out` has reported its own. Those that a camera saw before
        it was out, or silent, stay, with their age."""
        new = self._take_obstacles(out)
        if not new:
            return
        newest_ns, self._obstacles_ns = max(new)
        fresh: dict[str, Obstacles] = {}
        before: dict[str, tuple[Obstacles, float]] = {}
        for name, camera in self.cameras.items():
            trusted = camera.trusted_obstacles
            if trusted is None:
                continue
            if name not in out and age_s(self._clock, trusted) <= topics.OBSTACLES.max_age_s:
                fresh[name] = trusted.message
            else:
                before[name] = trusted.message, max((newest_ns - self._clock.instant_ns(trusted)) * 1e-9, 0.0)
        fused = fuse_obstacles(fresh, tuple(self.cameras), before)
        age_ns = max(self._clock.now_ns() - newest_ns, 0)
        self._bus.publish(topics.OBSTACLES, fused, self._obstacles_ns, age_ns=age_ns)

    def _take_obstacles(self, out: tuple[str, ...]) -> list[tuple[int, int]]:
        """Take each camera's newest obstacles; those of a camera in `out` are not trusted. Returns instants and stamps of the
        new ones that are trusted."""
        new: list[tuple[int, int]] = []
        for name, camera in self.cameras.items():
            obstacles = camera.obstacles.newest(self._newest_usable_ns(name)[1])
            if obstacles is not None and obstacles is not camera.used_obstacles:
                camera.used_obstacles = obstacles
                if name not in out:
                    camera.trusted_obstacles = obstacles
                    stamp_ns = self._stamps.carried(name, obstacles.header.stamp_ns, obstacles.header.session)
                    new.append((self._clock.instant_ns(obstacles), stamp_ns))
        return new

    def _log(self, status: LocalizerStatus, disagreement: str) -> None:
        """Log which cameras are out when that changes, and every DISAGREEMENT_LOG_S that they disagree."""
        if status.out != self._out:
            self._out = status.out
            (log.warning if status.out else log.info)("%s", status.message if status.out else "all cameras see")
        now_ns = self._clock.now_ns()
        if disagreement and now_ns >= self._next_disagreement_log_ns:
            self._next_disagreement_log_ns = now_ns + round(DISAGREEMENT_LOG_S * 1e9)
            log.warning("%s", disagreement)
