"""Camera health: exact repetition, darkness, size; sensor noise never looks frozen."""

import numpy as np
import pytest

from localizer.sources.health import FrameHealthMonitor
from shoal.messages.messages import CameraHealth

SIZE_PX = (1280, 960)


def _still_scene(random: np.random.Generator, noise: float) -> np.ndarray:
    return np.clip(np.rint(90.0 + random.normal(0.0, noise, (960, 1280))), 0, 255).astype(np.uint8)


def test_frozen_at_the_fifth_identical_frame_and_well_at_the_first_new_one() -> None:
    watch = FrameHealthMonitor(SIZE_PX, frozen_frames=5)
    random = np.random.default_rng(1)
    frame = _still_scene(random, 2.0)
    assert [watch.assess(frame.copy()) for _ in range(7)] == [CameraHealth.OK] * 4 + [CameraHealth.FROZEN] * 3
    assert watch.assess(_still_scene(random, 2.0)) is CameraHealth.OK
    assert not watch.repeated


@pytest.mark.parametrize("buffers", [2, 4, 10])
def test_a_camera_that_hands_out_its_buffers_in_turn_is_frozen(buffers: int) -> None:
    """Each picture differs from the one before, and none is new: poses would say that robots jump to and fro."""
    watch, random = FrameHealthMonitor(SIZE_PX, frozen_frames=5), np.random.default_rng(1)
    ring = [_still_scene(random, 2.0) for _ in range(buffers)]
    assert {watch.assess(frame) for frame in ring} == {CameraHealth.OK} and not watch.repeated
    states = [watch.assess(ring[k % buffers]) for k in range(4 * buffers)]
    assert watch.repeated and set(states[:3]) == {CameraHealth.OK} and set(states[3:]) == {CameraHealth.FROZEN}
    assert watch.assess(_still_scene(random, 2.0)) is CameraHealth.OK and not watch.repeated


@pytest.mark.long
def test_a_still_scene_with_the_faintest_noise_is_not_frozen() -> None:
    """0.2 grey levels of noise move one pixel in a hundred; nothing else changes for 50 frames."""
    watch = FrameHealthMonitor(SIZE_PX, frozen_frames=5)
    random = np.random.default_rng(2)
    for _ in range(50):
        assert watch.assess(_still_scene(random, 0.2)) is CameraHealth.OK
        assert not watch.repeated


def test_a_repeated_frame_is_known_at_once() -> None:
    watch = FrameHealthMonitor(SIZE_PX, frozen_frames=5)
    frame = _still_scene(np.random.default_rng(3), 2.0)
    watch.assess(frame)
    assert not watch.repeated
    watch.assess(frame)
    assert watch.repeated


def test_the_watch_keeps_no_reference_to_the_callers_buffer() -> None:
    """Cameras reuse their buffers: a picture changed in place is a new picture."""
    watch = FrameHealthMonitor(SIZE_PX, frozen_frames=2)
    frame = _still_scene(np.random.default_rng(3), 2.0)
    watch.assess(frame)
    frame += 1
    assert watch.assess(frame) is CameraHealth.OK


@pytest.mark.parametrize(("level", "health"), [(0, CameraHealth.BLACK), (3, CameraHealth.BLACK), (25, CameraHealth.OK)])
def test_black_frame_is_noticed(level: int, health: CameraHealth) -> None:
    noise = np.random.default_rng(4).integers(0, 3, (960, 1280))
    assert FrameHealthMonitor(SIZE_PX, 5).assess((level + noise).astype(np.uint8)) is health


@pytest.mark.parametrize(
    "frame", [np.full((480, 640), 90, np.uint8), np.full((960, 1280, 3), 90, np.uint8), np.full((960, 1280), 90.0)]
)
def test_frame_of_the_wrong_size_is_noticed(frame: np.ndarray) -> None:
    watch = FrameHealthMonitor(SIZE_PX, 5)
    assert watch.assess(frame) is CameraHealth.WRONG_SIZE
    assert watch.assess(np.full((960, 1280), 90, np.uint8)) is CameraHealth.OK
