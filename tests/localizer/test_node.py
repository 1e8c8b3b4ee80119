"""The localizer as a process of its own, on a real Zenoh bus, with a folder of images as its camera."""

import http.client
import re
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from localizer.camera_model import RefractiveCamera
from localizer.detection.image_regions import Pixels
from localizer.detection.obstacles import ObstacleDetector
from localizer.node import LocalizerNode, NodeOptions, run
from localizer.sources.base import CapturedFrame
from localizer.tracking.fleet_localizer import FleetLocalizer, LocalizationResult
from localizer.view.preview import PreviewPublisher, RateLimiter
from shoal.bus.bus import Bus, Inbox, Received
from shoal.bus.endpoint import Endpoint
from shoal.bus.memory_transport import MemoryHub, MemoryTransport
from shoal.bus.zenoh_transport import ZenohTransport
from shoal.config.experiment import Experiment, load_experiment
from shoal.errors import ConfigError
from shoal.messages import topics
from shoal.messages.codec import Header, decode
from shoal.messages.messages import (
    BoardReading,
    CameraHealth,
    Frame,
    LocalizerStatus,
    Obstacles,
    Pose,
    Preview,
    RobotState,
    StepTiming,
    Tick,
    Track,
)
from shoal.messages.obstacle_memory import blindness
from shoal.messages.topics import Topic
from shoal.runtime.runtime import Clock, Failed, Stop, WallClock, log
from shoal.runtime.version import code
from sim_bridge.camera.renderer import Renderer
from sim_bridge.lockstep.clock import LockstepClock
from sim_bridge.lockstep.localizer import localizer_in_lockstep
from sim_bridge.sil.ports import free_port
from tests.localizer.scene import Scene
from tests.localizer.stand_ins import MS
from tests.waiting import eventually

JUST_NOW = StepTiming(board_age_ms=0.0)
pytestmark = pytest.mark.real_time

EXPERIMENT = load_experiment("pool")
ETA = {1: np.array([0.45, 0.1, 0.3, 0.7]), 2: np.array([-0.4, -0.05, 0.3, -2.0])}
FROZEN_FRAMES = EXPERIMENT.localizer.frozen_frames
PATIENCE_S = 30.0


@dataclass
class LocalizerProgram:
    """A running `localizer`, the folder that it looks at, and all that it said."""

    folder: Path
    bus: Bus
    process: subprocess.Popen[str]
    written: int = 0
    statuses: list[LocalizerStatus] = field(default_factory=list)
    stamps_ns: list[int] = field(default_factory=list)  # of the statuses
    posed_ns: list[int] = field(default_factory=list)  # stamps of robot 1's poses

    def feed(self, *pictures: Pixels) -> None:
        """Complete before they have their names."""
        for picture in pictures:
            self.written += 1
            part = self.folder / f"{self.written}.part"
            part.write_bytes(cv2.imencode(".bmp", picture)[1].tobytes())
            part.rename(self.folder / f"{self.written}.bmp")

    def until(self, camera: CameraHealth) -> LocalizerStatus:
        """Wait until it has looked at every picture and has said this about its camera."""

        def said() -> list[LocalizerStatus]:
            return [status for status in self.statuses if status.frames == self.written and status.camera is camera]

        assert eventually(lambda: bool(said()), PATIENCE_S), (
            f"not {camera.name}: {self.statuses[-1:]}, process {self.process.poll()}"
        )
        return said()[-1]

    def first(self, camera: CameraHealth) -> int:
        """Number of the first picture that it said this about."""
        return next(status.frames for status in self.statuses if status.camera is camera)


@pytest.fixture
def start(tmp_path: Path) -> Iterator[Callable[..., LocalizerProgram]]:
    address = f"tcp/127.0.0.1:{free_port()}"
    running: list[LocalizerProgram] = []

    def run(*options: str) -> LocalizerProgram:
        folder = tmp_path / "camera"
        folder.mkdir()
        bus = Bus(ZenohTransport(Endpoint(address, router=True)))
        command = [sys.executable, "-m", "localizer", "run", "pool", "--station", address]
        process = subprocess.Popen([*command, "--source", f"folder:{folder}:max", *options], stderr=subprocess.PIPE, text=True)
        localizer = LocalizerProgram(folder, bus, process)
        running.append(localizer)

        def note(topic: Topic, key: str, header: Header, payload: bytes) -> None:
            localizer.stamps_ns.append(header.stamp_ns)
            localizer.statuses.append(decode(LocalizerStatus, payload, "localizer", topic.name))

        bus.subscribe(topics.LOCALIZER, None, note)
        bus.subscribe(topics.POSE, 1, lambda topic, key, header, payload: localizer.posed_ns.append(header.stamp_ns))
        return localizer

    yield run
    for localizer in running:
        localizer.process.kill()
        localizer.process.communicate()
        localizer.bus.close()


def test_every_ill_of_a_camera_is_noticed_and_over_when_it_is_over(start: Callable[..., LocalizerProgram]) -> None:
    """Well, frozen, well, black, another size, absent, well: nobody helps."""
    localizer, scene = start(), Scene(EXPERIMENT)
    poses = {robot: localizer.bus.inbox(topics.POSE, Pose, robot) for robot in ETA}

    def well(count: int) -> list[Pixels]:
        return [scene.frame(ETA) for _ in range(count)]

    def result() -> None:
        """A status may overtake the poses of its picture: they travel on another topic. A later one may say already that no
        picture comes."""
        by_stamp = zip(localizer.stamps_ns, localizer.statuses, strict=False)
        stamp_ns = max(stamp_ns for stamp_ns, status in by_stamp if status.camera is CameraHealth.OK)

        def here() -> bool:
            headers = [inbox.newest_header() for inbox in poses.values()]
            return all(header is not None and header.stamp_ns >= stamp_ns for header in headers)

        assert eventually(here, PATIENCE_S)
        for robot, inbox in poses.items():
            received = inbox.newest()
            assert received is not None and received.message.track is Track.MARKER
            pose = received.message
            assert np.hypot(pose.x_m - ETA[robot][0], pose.y_m - ETA[robot][1]) < 3e-3

    localizer.feed(*well(6))
    localizer.until(CameraHealth.OK)
    result()

    stuck = scene.frame(ETA)
    localizer.feed(*[stuck] * (FROZEN_FRAMES + 2))
    localizer.until(CameraHealth.FROZEN)
    assert localizer.first(CameraHealth.FROZEN) == 6 + FROZEN_FRAMES

    localizer.feed(*well(6))
    localizer.until(CameraHealth.OK)
    result()
    frozen_ns = [
        stamp
        for stamp, status in zip(localizer.stamps_ns, localizer.statuses, strict=False)
        if status.camera is CameraHealth.FROZEN
    ]
    assert len(frozen_ns) == 3
    assert not any(frozen_ns[0] <= stamp <= frozen_ns[-1] for stamp in localizer.posed_ns), "no poses from a frozen camera"
    assert any(stamp < frozen_ns[0] for stamp in localizer.posed_ns) and localizer.posed_ns[-1] > frozen_ns[-1]

    before = localizer.written
    localizer.feed(*[frame // 64 for frame in well(3)])
    localizer.until(CameraHealth.BLACK)
    assert localizer.first(CameraHealth.BLACK) == before + 1

    before = localizer.written
    localizer.feed(*[frame[:480, :640] for frame in well(3)])
    localizer.until(CameraHealth.WRONG_SIZE)
    assert localizer.first(CameraHealth.WRONG_SIZE) == before + 1

    assert "nothing new in" in localizer.until(CameraHealth.ABSENT).message
    localizer.feed(*well(6))
    localizer.until(CameraHealth.OK)
    result()

    localizer.process.send_signal(signal.SIGINT)
    _, output = localizer.process.communicate(timeout=PATIENCE_S)
    assert localizer.process.returncode == 0, output
    for ill in ("frozen", "black", "wrong_size", "absent", "ok"):
        assert f"camera {ill}" in output


def test_an_own_camera_is_shared_and_shown(start: Callable[..., LocalizerProgram]) -> None:
    """Its pictures go on the bus unchanged, annotated ones too, and to a browser here."""
    localizer, frame = start("--publish-frames", "--show", "--show-port", "0"), Scene(EXPERIMENT).frame(ETA)
    frames, previews = localizer.bus.inbox(topics.FRAME, Frame), localizer.bus.inbox(topics.PREVIEW, Preview)
    assert localizer.process.stderr is not None
    address = re.search(r"http://127.0.0.1:(\d+)/", localizer.process.stderr.readline())
    assert address is not None
    localizer.feed(frame)
    localizer.until(CameraHealth.OK)
    assert eventually(lambda: frames.newest() is not None and previews.newest() is not None)
    received = frames.newest()
    assert received is not None and np.array_equal(received.message.pixels, frame)
    connection = http.client.HTTPConnection("127.0.0.1", int(address[1]), timeout=5)
    connection.request("GET", "/stream")
    part = connection.getresponse().read(30_000)
    shown = cv2.imdecode(np.frombuffer(part[part.index(b"\r\n\r\n") + 4 :], np.uint8), cv2.IMREAD_COLOR)
    assert shown is not None and shown.shape == (480, 640, 3)


def test_a_camera_that_nothing_guards_is_told_of(start: Callable[..., LocalizerProgram]) -> None:
    localizer = start()
    localizer.feed(Scene(EXPERIMENT).frame(ETA))
    localizer.until(CameraHealth.OK)
    localizer.process.send_signal(signal.SIGINT)
    _, output = localizer.process.communicate(timeout=PATIENCE_S)
    assert "nothing guards the camera: without check_marks" in output


def test_impossible_setting_is_refused_without_waiting_for_a_station() -> None:
    command = [sys.executable, "-m", "localizer", "run", "pool", "--station", f"tcp/127.0.0.1:{free_port()}"]
    source = ["--source", "v4l2:/dev/video-nobody-has"]
    done = subprocess.run([*command, *source], capture_output=True, text=True, timeout=PATIENCE_S, check=False)
    assert done.returncode == 2
    assert done.stderr.startswith("camera /dev/video-nobody-has: no such device; there are: ")
    assert "Traceback" not in done.stderr


@pytest.mark.parametrize(
    ("options", "complaint"),
    [
        (NodeOptions(source="webcam"), "allowed: bus"),
        (NodeOptions(source="video:/nowhere.mp4"), "no such file"),
        (NodeOptions(publish_frames=True), "on the bus already"),
        (NodeOptions(source="folder:/tmp", page_port=99999), "--show-port 99999"),
    ],
)
def test_options_that_cannot_be_are_explained(options: NodeOptions, complaint: str) -> None:
    nobody = Endpoint(f"tcp/127.0.0.1:{free_port()}")
    with pytest.raises(ConfigError, match=complaint):
        run(EXPERIMENT, nobody, "shoal", Stop(install=False), options)


# --- in one process, on a bus in memory


@pytest.fixture
def hub() -> Iterator[tuple[Bus, Callable[..., LocalizerNode]]]:
    """A bus for the test, and a way to have the localizer run on another one, by a clock."""
    network, stop, handlers = MemoryHub(), Stop(install=False), list(log.handlers)
    ours, threads = Bus(MemoryTransport(network)), []

    def localize(clock: Clock, experiment: Experiment = EXPERIMENT) -> LocalizerNode:
        bus = Bus(MemoryTransport(network))
        if isinstance(clock, LockstepClock):
            shell = localizer_in_lockstep(experiment, bus, stop)
        else:
            shell = LocalizerNode(experiment, bus, stop, clock)
        threads.append(threading.Thread(target=shell.run))
        threads[-1].start()
        return shell

    ours.watch_presence()
    yield ours, localize
    stop.request()
    for thread in threads:
        thread.join()
    log.handlers[:] = handlers


def test_a_pose_carries_the_cameras_stamp_and_a_true_age(hub: tuple[Bus, Callable[..., LocalizerNode]]) -> None:
    """The camera's clock is an hour ahead: its stamp is passed on for the logs, ages are measured. On a machine that is too
    slow to draw the first picture in time the localizer has spoken before it, and all goes by its own clock."""
    bus, localize = hub
    poses, statuses = bus.inbox(topics.POSE, Pose, 1), bus.inbox(topics.LOCALIZER, LocalizerStatus)
    localize(WallClock())
    assert eventually(lambda: "localizer" in bus.present)
    scene = Scene(EXPERIMENT)
    for frames in (1, 2):
        pixels = scene.frame(ETA)
        stamp_ns, before_ns = time.time_ns() + 3_600_000_000_000, time.monotonic_ns()
        bus.publish(topics.FRAME, Frame(pixels), stamp_ns, age_ns=40 * MS)
        assert eventually(lambda k=frames: (s := statuses.newest()) is not None and s.message.frames == k)  # type: ignore[misc]
    elapsed_ns = time.monotonic_ns() - before_ns
    received, newest = poses.newest(), statuses.newest()
    assert newest is not None
    hour_ns = 3_600_000_000_000
    assert received is not None
    ahead_ns = hour_ns if received.header.stamp_ns == stamp_ns else 0
    assert abs(received.header.stamp_ns - time.time_ns() - ahead_ns) < 60_000 * MS
    assert 40 * MS <= received.header.age_ns <= 40 * MS + elapsed_ns
    assert eventually(lambda: bool(_absent(statuses)), PATIENCE_S)
    absent = _absent(statuses)
    assert abs(absent[0].header.stamp_ns - time.time_ns() - ahead_ns) < 10_000 * MS, "by the same clock"
    assert absent[0].message.code == newest.message.code == code().short
    assert absent[0].message.experiment_hash == newest.message.experiment_hash == EXPERIMENT.hash
    assert absent[0].late_ns < 2_000 * MS, "a jump of the clock would look like a delay of an hour"


def _absent(statuses: Inbox[LocalizerStatus]) -> list[Received[LocalizerStatus]]:
    """The newest status, if it says that no frames come."""
    received = statuses.newest()
    return [received] if received is not None and received.message.camera is CameraHealth.ABSENT else []


def test_in_lockstep_only_what_the_tick_names_is_used(hub: tuple[Bus, Callable[..., LocalizerNode]]) -> None:
    """A robot that is already a step ahead has reported depth and roll that do not count yet. Roll is carried over the 20 ms
    from the report to the exposure: the plate is drawn level, and its robot 0.15 m below it along a leaning axis."""
    bus, localize = hub
    pose = bus.inbox(topics.POSE, Pose, 1)
    localize(LockstepClock())
    assert eventually(lambda: "localizer" in bus.present)
    scene = Scene(EXPERIMENT)
    for stamp_ns, depth_m, roll_rad in ((80 * MS, 0.31, 0.1), (130 * MS, 0.35, -0.3)):
        for robot in ETA:
            tilt = np.array([roll_rad, 0.0, 0.5, 0.0])
            bus.publish(
                topics.STATE,
                RobotState(board=BoardReading(depth_m=depth_m, tilt=tilt), timing=JUST_NOW),
                stamp_ns,
                robot,
            )
    statuses = bus.inbox(topics.LOCALIZER, LocalizerStatus)
    for frame_ns in (0, 100 * MS):
        bus.publish(topics.FRAME, Frame(scene.frame(ETA)), frame_ns)
        bus.publish(topics.EXPOSED, Tick(frame_ns + 30 * MS, frame_ns - 20 * MS, frame_ns, (1, 2)), frame_ns + 30 * MS)
        assert eventually(lambda at=frame_ns: (h := statuses.newest_header()) is not None and h.stamp_ns == at)  # type: ignore[misc]
    received = pose.newest()
    assert received is not None
    assert received.message.depth_m == pytest.approx(0.31)
    aside_m, yaw = EXPERIMENT.vehicle.marker.height_m * np.sin(0.1 + 0.02 * 0.5), ETA[1][3]
    place = ETA[1][:2] - aside_m * np.array([-np.sin(yaw), np.cos(yaw)])
    assert [received.message.x_m, received.message.y_m] == pytest.approx(place.tolist(), abs=0.003)
    assert received.header.age_ns == 30 * MS


def test_obstacle_that_drifts_in_is_published_after_the_poses(hub: tuple[Bus, Callable[..., LocalizerNode]]) -> None:
    """A ball comes after 5 s, at the robots' depth: outlined ten times a second, with its speed; robots never are. A black
    camera has nothing to say."""
    ball = "sim.drifters=[{start_m=[-1.1, 0.5, 0.3], velocity_mps=[0.1, 0.0, 0.0], from_s=5.0}]"
    experiment = load_experiment("pool", [ball])
    bus, localize = hub
    messages: list[tuple[str, int, Obstacles]] = []

    def note(topic: Topic, key: str, header: Header, payload: bytes) -> None:
        content = decode(Obstacles, payload, "localizer", topic.name) if topic is topics.OBSTACLES else Obstacles()
        messages.append((topic.name, header.stamp_ns, content))

    statuses = bus.inbox(topics.LOCALIZER, LocalizerStatus)
    for topic in (topics.OBSTACLES, topics.POSE):
        bus.subscribe(topic, None, note)
    localize(LockstepClock(), experiment)
    assert eventually(lambda: "localizer" in bus.present)
    renderer, eta = Renderer(experiment, 1), np.array([*ETA.values()])
    for k in range(150):
        frame_ns = 50 * MS * k
        pixels = renderer.render(eta, np.zeros((2, 4)), frame_ns * 1e-9, k)
        bus.publish(topics.FRAME, Frame(pixels if k < 140 else pixels // 64), frame_ns)
        bus.publish(topics.EXPOSED, Tick(frame_ns + 30 * MS, frame_ns - 20 * MS, frame_ns, ()), frame_ns + 30 * MS)
        assert eventually(lambda at=frame_ns: (h := statuses.newest_header()) is not None and h.stamp_ns == at)  # type: ignore[misc]
    looks = [(stamp_ns * 1e-9, obstacles) for topic, stamp_ns, obstacles in messages if topic == topics.OBSTACLES.name]
    assert [round(t_s * 10) for t_s, _ in looks] == list(range(70)), "every other frame, none of a black camera"
    order = [topic for topic, stamp_ns, _ in messages if stamp_ns == 2000 * MS]
    assert order == [topics.POSE.name] * 2 + [topics.OBSTACLES.name]
    assert not any(obstacles.ids for t_s, obstacles in looks if t_s < 5.0)
    for t_s, obstacles in looks[60:]:
        assert len(obstacles.ids) == 1
        assert np.linalg.norm(obstacles.outline[0].mean(axis=0) - [-1.1 + 0.1 * (t_s - 5.0), 0.5]) < 0.04
    assert np.linalg.norm(looks[-1][1].velocity[0] - [0.1, 0.0]) < 0.03


def expose(bus: Bus, statuses: Inbox[LocalizerStatus], pixels: Pixels, frame_ns: int) -> LocalizerStatus:
    """Have the localizer look at a picture, in lockstep; what it says of it."""
    bus.publish(topics.FRAME, Frame(pixels), frame_ns)
    bus.publish(topics.EXPOSED, Tick(frame_ns + 30 * MS, frame_ns - 20 * MS, frame_ns, ()), frame_ns + 30 * MS)
    assert eventually(lambda: (h := statuses.newest_header()) is not None and h.stamp_ns == frame_ns)
    received = statuses.newest()
    assert received is not None
    return received.message


def test_in_lockstep_the_logs_video_holds_every_picture(
    hub: tuple[Bus, Callable[..., LocalizerNode]], monkeypatch: pytest.MonkeyPatch
) -> None:
    """However long it takes to encode one: simulated time has no need to go on without it."""
    bus, localize = hub
    statuses, filmed = bus.inbox(topics.LOCALIZER, LocalizerStatus), list[int]()

    def pack(pixels: Pixels, stamp_ns: int) -> bytes:
        time.sleep(1.0)  # in which several frames are located
        return b"picture"

    monkeypatch.setattr("localizer.view.video_encoder.packer", lambda recording, size_px: pack)
    bus.subscribe(topics.PICTURE, None, lambda topic, key, header, payload: filmed.append(header.stamp_ns))
    localize(LockstepClock(), load_experiment("pool", ['recording.video="jpeg"']))
    assert eventually(lambda: "localizer" in bus.present)
    scene = Scene(EXPERIMENT)
    for k in range(5):
        expose(bus, statuses, scene.frame(ETA), 50 * MS * k)
    assert eventually(lambda: len(filmed) == 5)
    assert filmed == [50 * MS * k for k in range(5)]


def test_an_error_in_a_picture_costs_that_picture_and_ten_in_a_row_the_process(
    hub: tuple[Bus, Callable[..., LocalizerNode]], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Nine errors, a good picture, then ten: only these end it. The status of a skipped picture names no robots, so that
    nobody waits for their poses."""
    bus, localize = hub
    statuses, scene, wrong = bus.inbox(topics.LOCALIZER, LocalizerStatus), Scene(EXPERIMENT), [False]
    shell = localize(LockstepClock())
    locate = FleetLocalizer.locate

    def sometimes(*args: Any) -> LocalizationResult:
        if wrong[0]:
            raise np.linalg.LinAlgError("Singular matrix")
        return locate(*args)

    monkeypatch.setattr(FleetLocalizer, "locate", sometimes)
    assert eventually(lambda: "localizer" in bus.present)
    failed = 0
    for k in range(22):
        wrong[0] = 2 <= k < 11 or k >= 12
        failed += wrong[0]
        status = expose(bus, statuses, scene.frame(ETA), 50 * MS * k)
        assert status.failed == failed
        if wrong[0]:
            assert status.robots == () and status.message == "picture skipped: LinAlgError: Singular matrix"
        elif k > 0:
            assert status.robots == (1, 2) and status.message == ""
        if k < 21:
            assert not shell.stop.requested
    assert eventually(lambda: shell.stop.requested)
    with pytest.raises(Failed, match="10 pictures in a row could not be localized in: Singular matrix"):
        shell.stop.raise_failure()


def test_an_error_after_the_poses_costs_no_pose_and_ten_in_a_row_the_process(
    hub: tuple[Bus, Callable[..., LocalizerNode]], monkeypatch: pytest.MonkeyPatch
) -> None:
    """The next status counts it; the poses of each picture are out."""
    bus, localize = hub
    statuses, scene = bus.inbox(topics.LOCALIZER, LocalizerStatus), Scene(EXPERIMENT)
    shell = localize(LockstepClock())
    finish = FleetLocalizer.finish
    finished = list[int]()

    def sometimes(localizer: FleetLocalizer) -> None:
        finish(localizer)
        finished.append(1)
        if len(finished) > 3:
            raise cv2.error("no memory")

    monkeypatch.setattr(FleetLocalizer, "finish", sometimes)
    assert eventually(lambda: "localizer" in bus.present)
    for k in range(13):
        assert not shell.stop.requested
        status = expose(bus, statuses, scene.frame(ETA), 50 * MS * k)
        assert status.failed == max(k - 3, 0) and (status.robots == (1, 2) or k == 0)
    assert eventually(lambda: shell.stop.requested)
    with pytest.raises(Failed, match="10 pictures in a row could not be localized in: no memory"):
        shell.stop.raise_failure()


def test_an_obstacle_watch_that_fails_says_that_it_is_blind(
    hub: tuple[Bus, Callable[..., LocalizerNode]], monkeypatch: pytest.MonkeyPatch
) -> None:
    """An empty list without that would say that the pool is clear. Poses go on."""
    bus, localize = hub
    statuses, scene = bus.inbox(topics.LOCALIZER, LocalizerStatus), Scene(EXPERIMENT)
    obstacles = bus.inbox(topics.OBSTACLES, Obstacles)

    def fails(*args: Any) -> None:
        raise cv2.error("no memory")

    monkeypatch.setattr(ObstacleDetector, "step", fails)
    shell = localize(LockstepClock())
    assert eventually(lambda: "localizer" in bus.present)
    for k in range(3):
        status = expose(bus, statuses, scene.frame(ETA), 50 * MS * k)
    assert status.robots == (1, 2) and status.obstacles_ns == 50 * MS
    assert eventually(lambda: (h := obstacles.newest_header()) is not None and h.stamp_ns == 100 * MS)
    received = obstacles.newest()
    assert received is not None and "failed" in blindness(received.message, 0.0)
    assert not shell.stop.requested


def test_a_preview_that_cannot_be_drawn_says_so_and_is_not_the_picture_before() -> None:
    hub, stop, wrong = MemoryHub(), Stop(install=False), [False]
    previews = Bus(MemoryTransport(hub)).inbox(topics.PREVIEW, Preview)

    def draw(pixels: Pixels, result: LocalizationResult, obstacles: Obstacles) -> Pixels:
        if wrong[0]:
            raise ValueError("cannot convert float NaN to integer")
        return np.full((480, 640, 3), 200, np.uint8)

    clock = WallClock()
    made = PreviewPublisher(draw, Bus(MemoryTransport(hub)), clock, stop, 5.0)
    result = LocalizationResult((), LocalizerStatus(), RefractiveCamera(EXPERIMENT.camera))
    shown = []
    for k in range(3):
        wrong[0], stamp_ns, exposed_ns = k == 1, 10**9 * (k + 1), clock.now_ns() - 300 * MS
        made.offer(CapturedFrame(np.zeros((8, 8), np.uint8), stamp_ns, exposed_ns, exposed_ns), result, Obstacles())
        assert eventually(lambda at=stamp_ns: (h := previews.newest_header()) is not None and h.stamp_ns == at)  # type: ignore[misc]
        received = previews.newest()
        assert received is not None and 300 * MS <= received.header.age_ns <= clock.now_ns() - exposed_ns
        picture = cv2.imdecode(np.frombuffer(received.message.jpeg, np.uint8), cv2.IMREAD_COLOR)
        assert picture is not None
        shown.append(round(float(picture.mean()), -2))
    made.close()
    assert shown == [200.0, 0.0, 200.0]
    assert not stop.requested


def test_a_preview_that_is_due_is_shown_though_newer_frames_come_before_it_is_drawn() -> None:
    hub, stop, drawing, go_on = MemoryHub(), Stop(install=False), threading.Event(), threading.Event()
    clock, previews = WallClock(), Bus(MemoryTransport(hub)).inbox(topics.PREVIEW, Preview)

    def draw(pixels: Pixels, result: LocalizationResult, obstacles: Obstacles) -> Pixels:
        drawing.set()
        assert go_on.wait(20.0)
        return np.full((480, 640, 3), 200, np.uint8)

    made = PreviewPublisher(draw, Bus(MemoryTransport(hub)), clock, stop, 5.0, publish_frames=True)
    result = LocalizationResult((), LocalizerStatus(), RefractiveCamera(EXPERIMENT.camera))
    first_ns = clock.now_ns()
    for stamp_ns in (first_ns, first_ns + 200 * MS, first_ns + 250 * MS):  # drawn at once; due; not due
        made.offer(CapturedFrame(np.zeros((8, 8), np.uint8), stamp_ns, stamp_ns, stamp_ns), result, Obstacles())
        assert drawing.wait(20.0)
    go_on.set()
    shown = eventually(lambda: (h := previews.newest_header()) is not None and h.stamp_ns == first_ns + 250 * MS)
    made.close()
    assert shown


@pytest.mark.parametrize(("scene", "settings"), [("pool", ["localizer.obstacle_min_m=0"]), ("drone", [])])
def test_obstacles_are_not_watched_unasked_or_from_a_moving_camera(scene: str, settings: list[str]) -> None:
    """Under a drone all of the background moves."""
    bus = Bus(MemoryTransport(MemoryHub()))
    assert (
        # whether a detector was made is not told before the first picture
        LocalizerNode(load_experiment(scene, settings), bus, Stop(install=False), LockstepClock())._obstacle_detector is None
    )
    # whether a detector was made is not told before the first picture
    assert LocalizerNode(EXPERIMENT, bus, Stop(install=False), LockstepClock())._obstacle_detector is not None


def test_previews_keep_their_rate_and_survive_a_clock_set_back() -> None:
    rate = RateLimiter(5.0)
    stamps = [1000, 1100, 1201, 1300, 1399, 1500, 20, 100, 220]
    assert [stamp for stamp in stamps if rate.due(stamp * MS)] == [1000, 1201, 1399, 20, 220]
    assert not any(RateLimiter(0.0).due(stamp) for stamp in stamps)


@pytest.mark.parametrize(("camera_hz", "wanted_hz"), [(20, 20.0), (20, 15.0), (20, 5.0), (30, 20.0), (60, 25.0), (10, 20.0)])
def test_as_many_go_through_as_asked_for_however_unevenly_a_camera_ticks(camera_hz: int, wanted_hz: float) -> None:
    jitter_ns = np.random.default_rng(1).normal(0.0, 0.5e6, 60 * camera_hz)
    stamps = 10**18 + np.arange(60 * camera_hz) * 1_000_000_000 // camera_hz + jitter_ns.astype(np.int64)
    rate = RateLimiter(wanted_hz)
    passed = np.array([stamp for stamp in stamps.tolist() if rate.due(stamp)])
    assert len(passed) == pytest.approx(60 * min(wanted_hz, camera_hz), abs=2)
    assert np.diff(passed).max() < 1e9 / min(wanted_hz, camera_hz) + 1e9 / camera_hz
