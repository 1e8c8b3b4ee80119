"""The process that fuses cameras, by the wall clock: what their localizers publish goes in, one fleet's poses come out."""

import threading
import time
from collections import defaultdict
from collections.abc import Callable, Iterator

import numpy as np
import pytest

from localizer.fusion_node import FusionNode
from localizer.tracking.camera_fusion import CameraFusion
from shoal.bus.bus import Bus
from shoal.bus.memory_transport import MemoryHub, MemoryTransport
from shoal.config.experiment import load_experiment
from shoal.messages import topics
from shoal.messages.messages import CameraHealth, LocalizerStatus, Obstacles, Pose, Track
from shoal.runtime.runtime import Stop, WallClock
from shoal.runtime.version import code
from tests.waiting import eventually

pytestmark = pytest.mark.real_time

EXPERIMENT = load_experiment("two-cameras")
POSE = Pose(0.1, 0.0, 0.0, 1e-6 * np.eye(3), Track.MARKER, True)
ROUND = 0.1 * np.array([[np.cos(a), np.sin(a)] for a in np.arange(12) * np.pi / 6.0])
SEEN = Obstacles((3,), ROUND[None], np.zeros((1, 2)), unseen_s=np.zeros(1))
NONE = Obstacles()
ELSEWHERE = Obstacles((3,), ROUND[None] + 1.0, np.zeros((1, 2)), unseen_s=np.zeros(1))


@pytest.fixture
def world() -> Iterator[Bus]:
    """A bus beside a running node."""
    hub, stop = MemoryHub(), Stop(install=False)
    node = FusionNode(EXPERIMENT, Bus(MemoryTransport(hub)), stop, WallClock())
    thread = threading.Thread(target=node.run)
    thread.start()
    yield Bus(MemoryTransport(hub))
    stop.request()
    thread.join(10.0)
    assert not thread.is_alive()


def tell(bus: Bus, camera: str, robots: tuple[int, ...] = (1,)) -> int:
    """Publish what a camera's localizer tells of a picture that was exposed 20 ms ago. Returns its stamp."""
    stamp_ns = time.time_ns()
    for robot in robots:
        pose = Pose(0.1 * robot, 0.0, 0.0, 1e-6 * np.eye(3), Track.MARKER, True)
        bus.publish(topics.POSE.of_camera(camera), pose, stamp_ns, robot, age_ns=20_000_000)
    bus.publish(topics.OBSTACLES.of_camera(camera), SEEN, stamp_ns)
    status = LocalizerStatus(CameraHealth.OK, robots=robots)
    bus.publish(topics.LOCALIZER.of_camera(camera), status, stamp_ns, age_ns=20_000_000)
    return stamp_ns


def test_obstacles_of_a_camera_that_is_out_are_not_told_and_renew_no_list(monkeypatch: pytest.MonkeyPatch) -> None:
    """East is bumped: out. Then it alone tells of obstacles, and at last both do while the fusion fails."""
    hub = MemoryHub()
    bus, stop = Bus(MemoryTransport(hub)), Stop(install=False)
    steps = FusionNode(EXPERIMENT, Bus(MemoryTransport(hub)), stop, WallClock()).steps()
    obstacles, statuses = bus.inbox(topics.OBSTACLES, Obstacles), bus.inbox(topics.LOCALIZER, LocalizerStatus)
    next(steps)

    other = {"east": EXPERIMENT.hash, "west": "another"}

    def fuse(west: Obstacles | None) -> tuple[int, tuple[int, ...], LocalizerStatus]:
        """Fuse what both tell of a picture. The stamp that west gave, the list's numbers and the status."""
        stamp_ns = time.time_ns()
        for camera, message, moved in (("east", ELSEWHERE, True), ("west", west, False)):
            if message is not None:
                bus.publish(topics.OBSTACLES.of_camera(camera), message, stamp_ns)
            bus.publish(topics.POSE.of_camera(camera), POSE, stamp_ns, 1)
            its = "0.1.0 another" if moved else code().short
            status = LocalizerStatus(
                CameraHealth.OK,
                message="moved" if moved else "",
                robots=(1,),
                moved=moved,
                code=its,
                experiment_hash=other[camera],
            )
            bus.publish(topics.LOCALIZER.of_camera(camera), status, stamp_ns)
        next(steps)
        fused, newest_status = obstacles.newest(), statuses.newest()
        assert fused is not None and newest_status is not None and newest_status.message.code == "0.1.0 another"
        assert newest_status.message.experiment_hash == other["west"]  # "": not told
        assert newest_status.message.obstacles_ns == fused.header.stamp_ns
        return stamp_ns - fused.header.stamp_ns, fused.message.ids, newest_status.message

    later_ns, ids, status = fuse(SEEN)
    assert later_ns == 0 and ids == (6,) and status.out == ("east",)
    other |= {"east": "", "west": ""}  # of earlier versions
    later_ns, ids, status = fuse(None)
    assert later_ns > 0 and ids == (6,)
    monkeypatch.setattr(CameraFusion, "step", lambda *_: 1 // 0)
    later_ns, ids, status = fuse(SEEN)
    assert "pictures not fused" in status.message and status.out == ("east",)
    assert later_ns == 0 and ids == (6,)
    stop.request()


def test_obstacles_of_a_camera_from_before_it_was_out_are_told_with_their_age() -> None:
    """East sees an obstacle. Then it is bumped and sees others; or its localizer falls silent."""
    for bumped in (True, False):
        hub = MemoryHub()
        bus, stop = Bus(MemoryTransport(hub)), Stop(install=False)
        steps = FusionNode(EXPERIMENT, Bus(MemoryTransport(hub)), stop, WallClock()).steps()
        obstacles = bus.inbox(topics.OBSTACLES, Obstacles)
        next(steps)
        last_ns = 0
        for k in range(14):  # 0.7 s
            stamp_ns, was = time.time_ns(), k < 2
            for camera in ("west", "east") if was or bumped else ("west",):
                moved = camera == "east" and not was
                message = {"west": NONE, "east": ELSEWHERE if was else SEEN}[camera]
                bus.publish(topics.OBSTACLES.of_camera(camera), message, stamp_ns)
                bus.publish(topics.POSE.of_camera(camera), POSE, stamp_ns, 1)
                status = LocalizerStatus(CameraHealth.OK, message="moved" if moved else "", robots=(1,), moved=moved)
                bus.publish(topics.LOCALIZER.of_camera(camera), status, stamp_ns)
            last_ns = stamp_ns if was else last_ns
            next(steps)
            time.sleep(0.05)
        fused = obstacles.newest()
        assert fused is not None and fused.message.ids == (7,)
        np.testing.assert_allclose(fused.message.outline[0], ELSEWHERE.outline[0])
        assert fused.message.unseen_s == pytest.approx([(stamp_ns - last_ns) * 1e-9], abs=0.03)
        stop.request()


@pytest.mark.parametrize("ahead_s", [0.05, -0.2, 2.0, -20.0, 3600.0])
def test_ages_are_right_whatever_the_cameras_clocks_show(ahead_s: float) -> None:
    """East's computer is ahead of west's; then its localizer is started anew on one that is not. Who receives the fused poses
    knows how old they are."""
    hub, stop = MemoryHub(), Stop(install=False)
    bus, again = Bus(MemoryTransport(hub)), Bus(MemoryTransport(hub))
    steps = FusionNode(EXPERIMENT, Bus(MemoryTransport(hub)), stop, WallClock()).steps()
    poses, statuses = bus.inbox(topics.POSE, Pose, 1), bus.inbox(topics.LOCALIZER, LocalizerStatus)
    obstacles, receiver = bus.inbox(topics.OBSTACLES, Obstacles), WallClock()
    wrong_ns = defaultdict[tuple[str, Bus, str], list[int]](list)
    next(steps)
    for k in range(24):
        camera = ("west", "east")[k % 2]
        sender, ahead_ns = (again, 0) if k >= 16 else (bus, round(ahead_s * 1e9) * (camera == "east"))
        exposed_ns = receiver.now_ns()
        clock_ns = exposed_ns + ahead_ns
        sender.publish(topics.POSE.of_camera(camera), POSE, clock_ns, 1)
        sender.publish(topics.OBSTACLES.of_camera(camera), SEEN, clock_ns)
        sender.publish(topics.LOCALIZER.of_camera(camera), LocalizerStatus(CameraHealth.OK, robots=(1,)), clock_ns)
        next(steps)
        for inbox in (poses, statuses, obstacles) if k % 16 >= 4 else ():  # the first ones show what is quick
            received = inbox.newest()
            assert received is not None
            wrong_ns[camera, sender, inbox.name].append(abs(receiver.instant_ns(received) - exposed_ns))
    assert len(wrong_ns) == 12
    assert max(min(each) for each in wrong_ns.values()) < 20_000_000  # a busy computer delays some, a wrong clock all
    stop.request()


def keeps_telling(bus: Bus, cameras: tuple[str, ...], until: Callable[[], bool]) -> bool:
    """True as soon as `until()` is true; the cameras tell of a picture every 50 ms meanwhile."""

    def ready() -> bool:
        for camera in cameras:
            tell(bus, camera)
        time.sleep(0.05)
        return until()

    return eventually(ready, 30.0)


def test_poses_go_on_while_the_localizer_of_one_camera_is_silent_and_the_status_says_so(world: Bus) -> None:
    poses, statuses = world.inbox(topics.POSE, Pose, 1), world.inbox(topics.LOCALIZER, LocalizerStatus)
    obstacles = world.inbox(topics.OBSTACLES, Obstacles)

    def out() -> tuple[str, ...] | None:
        status = statuses.newest()
        return None if status is None else status.message.out

    assert keeps_telling(world, ("west", "east"), lambda: out() == ())
    assert keeps_telling(world, ("west",), lambda: out() == ("east",))
    stamp_ns = tell(world, "west")
    assert eventually(lambda: (pose := poses.newest()) is not None and pose.header.stamp_ns == stamp_ns)
    pose, blocked = poses.newest(), obstacles.newest()
    assert pose is not None and pose.message.x_m == pytest.approx(0.1) and pose.header.age_ns >= 20_000_000
    assert blocked is not None and blocked.message.ids == (6,)  # of camera 0 of 2
    assert keeps_telling(world, ("west", "east"), lambda: out() == ())
    assert eventually(lambda: out() == ("west", "east"))  # both silent: said without a picture
