"""The process that fuses cameras, by the wall clock: what their localizers publish goes in, one fleet's poses come out."""

import threading
import time
from collections.abc import Callable, Iterator

import numpy as np
import pytest

from localizer.fusion_node import FusionNode
from tests.waiting import eventually
from wire.config.experiment import load_experiment
from wire.messages import topics
from wire.messages.messages import CameraHealth, LocalizerStatus, Obstacles, Pose, Track
from wire.process.runtime import Stop, WallClock
from wire.transport.bus import Bus
from wire.transport.memory_transport import MemoryHub, MemoryTransport

pytestmark = pytest.mark.real_time

EXPERIMENT = load_experiment("two-cameras")
SEEN = Obstacles((3,), np.zeros((1, 12, 2)), np.zeros((1, 2)), unseen_s=np.zeros(1))


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
    assert eventually(lambda: (told := poses.newest()) is not None and told.header.stamp_ns == stamp_ns)
    found, seen = poses.newest(), obstacles.newest()
    assert found is not None and found.message.x_m == pytest.approx(0.1) and found.header.age_ns >= 20_000_000
    assert seen is not None and seen.message.ids == (6,)  # of camera 0 of 2
    assert keeps_telling(world, ("west", "east"), lambda: out() == ())
    assert eventually(lambda: out() == ("west", "east"))  # both silent: said without a picture
