"""Obstacles in the simulated pool: drawn with the simulator's own optics, which are independent of the localizer's.

The water is that of the pool scene unless a test says otherwise. False alarms are counted over minutes in the slow test, with
water whose loop of 24 s is longer than the 20 s that the background remembers.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from localizer.detection.background_model import BackgroundModel, TemporalSmoother
from localizer.detection.blob_tracker import Blob, BlobTracker, convex_outline
from localizer.detection.obstacles import ObstacleDetector
from shoal.config.experiment import load_experiment
from shoal.config.fault_injection import read_what
from shoal.frames import Array
from shoal.messages.messages import Obstacles
from sim_bridge.camera.faults import CameraFaults
from sim_bridge.camera.optics import project
from sim_bridge.camera.renderer import Renderer
from sim_bridge.camera.scene import water_colour
from tests.localizer.cameras import ASLANT
from tests.localizer.scene import Pixels, bayer

pytestmark = pytest.mark.long

EXPERIMENT = load_experiment("pool")
STRONG = ("sim.picture.ripples_m=0.003", "sim.picture.caustics=0.6", "sim.picture.glare=0.8")
DEPTH_M = 0.3
LOOK_S = 0.1
LEARNT_S = 5.0  # by then all of the water is known
RADIUS_M = EXPERIMENT.vehicle.radius_m

Robots = Callable[[float], Array]  # time -> (n, 4) eta


@dataclass(frozen=True)
class Intruder:
    """Something in the water: its surface points (n, 3) and its outline (m, 2) at DEPTH_M around its middle; BGR."""

    body: Array
    outline: Array
    colour: tuple[float, float, float]
    start_m: tuple[float, float]
    velocity: tuple[float, float] = (0.0, 0.0)
    enters_s: float = LEARNT_S

    def middle(self, since_s: float) -> Array:
        return np.array(self.start_m) + since_s * np.array(self.velocity)


def ball(radius_m: float) -> tuple[Array, Array]:
    k = np.arange(300) + 0.5
    polar, azimuth = np.arccos(1.0 - 2.0 * k / 300), np.pi * (1.0 + np.sqrt(5.0)) * k
    points = np.column_stack([np.cos(azimuth) * np.sin(polar), np.sin(azimuth) * np.sin(polar), np.cos(polar)])
    turn = np.linspace(0.0, 2.0 * np.pi, 40, endpoint=False)
    return radius_m * points, radius_m * np.column_stack([np.cos(turn), np.sin(turn)])


def box(size_m: tuple[float, float, float], yaw_rad: float) -> tuple[Array, Array]:
    corners = np.array([[x, y, z] for z in (-1, 1) for x, y in ((1, -1), (1, 1), (-1, 1), (-1, -1))]) * np.array(size_m) / 2
    c, s = np.cos(yaw_rad), np.sin(yaw_rad)
    corners[:, :2] = corners[:, :2] @ np.array([[c, s], [-s, c]])
    return corners, corners[:4, :2]


INTRUDERS = {
    "red ball": Intruder(*ball(0.10), (40, 40, 200), (-1.2, -0.85), (0.1, 0.0)),
    "grey box": Intruder(*box((0.25, 0.20, 0.15), 0.4), (115, 115, 115), (0.2, 0.85)),
    "dark pole": Intruder(*box((0.70, 0.08, 0.08), 1.2), (25, 25, 25), (1.25, -0.1), (-0.08, -0.06)),
}


def standing(t_s: float) -> Array:
    return np.array([[0.45, 0.1, DEPTH_M, 0.3], [-0.45, -0.1, DEPTH_M, -0.4]])


def circling(t_s: float) -> Array:
    """0.11 m/s, as they might while searching."""
    angle = 0.5 * t_s
    eta = standing(t_s)
    eta[:, :2] += 0.22 * np.array([np.cos(angle), np.sin(angle)])
    eta[:, 3] = np.pi / 2 + angle
    return eta


@cache
def _renderer(settings: tuple[str, ...] = (), seed: int = 1) -> Renderer:
    return Renderer(load_experiment("pool", settings), seed)


def draw(raw: Pixels, intruder: Intruder, since_s: float, t_s: float, random: np.random.Generator) -> Pixels:
    """The picture with an intruder in it: its silhouette by exact optics, its colour through water, flicker, noise."""
    points = intruder.body + np.append(intruder.middle(since_s), DEPTH_M)
    hull = cv2.convexHull(project(EXPERIMENT.camera, points).astype(np.float32))[:, 0]
    left, top = (2 * int(low // 2) - 4 for low in hull.min(axis=0))
    right, bottom = (2 * int(high // 2) + 6 for high in hull.max(axis=0))
    under = raw[top:bottom, left:right]
    cover = np.zeros(under.shape, np.uint8)
    cv2.fillConvexPoly(cover, np.rint((hull - [left, top]) * 16).astype(np.int32), 255, cv2.LINE_AA, 4)
    share, veil = water_colour(2.0 * DEPTH_M)
    light = 1.0 + 0.15 * np.sin(11.0 * t_s)
    colour = bayer(np.broadcast_to(np.array(intruder.colour) * share * light + veil, (*under.shape, 3)))
    alpha = cover / 255.0
    mixed = under * (1.0 - alpha) + alpha * (colour + 2.0 * random.standard_normal(under.shape, np.float32))
    picture = raw.copy()
    picture[top:bottom, left:right] = np.clip(np.rint(mixed), 0, 255)
    return picture


def overlap(a: Array, b: Array) -> float:
    """Intersection over union of two polygons (n, 2), on a grid of 4 mm over the pool."""
    masks = []
    for polygon in (a, b):
        mask = np.zeros((700, 1000), np.uint8)
        cv2.fillPoly(mask, [np.rint((polygon + np.array([2.0, 1.4])) * 250 * 16).astype(np.int32)], 1, shift=4)
        masks.append(mask > 0)
    return int(np.count_nonzero(masks[0] & masks[1])) / int(np.count_nonzero(masks[0] | masks[1]))


@dataclass(frozen=True)
class Look:
    t_s: float
    robots: Array
    obstacles: Obstacles


def watch(
    seconds: float,
    robots: Robots,
    intruders: Mapping[str, Intruder] | None = None,
    settings: tuple[str, ...] = (),
    seed: int = 1,
    reported_places: Callable[[Array], Array] = lambda eta: eta[:, :3],
    least_m: float = 0.08,
) -> list[Look]:
    """Look at the pool ten times a second; intruders appear at LEARNT_S. `reported_places`: from a robot's eta."""
    renderer, random = _renderer(settings, seed), np.random.default_rng(seed)
    watcher, looks = ObstacleDetector(load_experiment("pool", [f"localizer.obstacle_min_m={least_m}"])), []
    for k in range(round(seconds / LOOK_S)):
        t_s = k * LOOK_S
        eta = robots(t_s)
        frame = renderer.render(eta, np.zeros((2, 4)), t_s, k)
        for intruder in (intruders or {}).values() if t_s >= LEARNT_S else ():
            frame = draw(frame, intruder, t_s - LEARNT_S, t_s, random)
        frame.setflags(write=False)  # as it comes out of a message
        obstacles = watcher.step(frame, round(t_s * 1e9), reported_places(eta))
        assert obstacles is not None
        looks.append(Look(t_s, eta, obstacles))
    return looks


@pytest.mark.parametrize("settings", [(), STRONG], ids=["pool scene", "strong glare and caustics"])
def test_intruders_are_outlined_with_their_speed_and_robots_are_not(settings: tuple[str, ...]) -> None:
    looks = watch(LEARNT_S + 5.0, circling, INTRUDERS, settings)
    assert not any(look.obstacles.ids for look in looks if look.t_s < LEARNT_S)
    numbers: dict[str, set[int]] = {name: set() for name in INTRUDERS}
    for look in (look for look in looks if look.t_s >= LEARNT_S + 1.0):
        assert len(look.obstacles.ids) == len(INTRUDERS), f"at {look.t_s:.1f} s"
        assert look.obstacles.depth_m == DEPTH_M and 0.8 < look.obstacles.watched < 1.0
        for name, intruder in INTRUDERS.items():
            truth = intruder.outline + intruder.middle(look.t_s - LEARNT_S)
            shares = [overlap(truth, outline) for outline in look.obstacles.outline]
            best = int(np.argmax(shares))
            assert shares[best] > 0.5, f"{name} at {look.t_s:.1f} s"
            numbers[name].add(look.obstacles.ids[best])
            if look.t_s >= LEARNT_S + 2.0:
                assert np.linalg.norm(look.obstacles.velocity[best] - intruder.velocity) < 0.03, f"{name} at {look.t_s:.1f} s"
    assert all(len(obstacles) == 1 for obstacles in numbers.values()), "an obstacle keeps its number"


def test_a_robot_that_stood_still_leaves_no_ghost_and_its_shadow_is_none() -> None:
    """The water under it and in its shadow was never seen before it left, at full speed."""

    def start_late(t_s: float) -> Array:
        eta = standing(t_s)
        eta[:, 0] += np.array([-0.35, 0.35]) * min(max(t_s - LEARNT_S, 0.0), 4.0)
        return eta

    looks = watch(LEARNT_S + 8.5, start_late)
    assert not any(look.obstacles.ids for look in looks)
    assert looks[-1].obstacles.watched > looks[70].obstacles.watched, "what they uncovered is learnt"


def test_a_robot_nobody_knows_of_is_an_obstacle() -> None:
    """Robot 2 is lost after LEARNT_S. It moves, so it can be told from what was always there."""

    def told(eta: Array) -> Array:
        return eta[:1, :3] if eta[1, 0] != standing(0.0)[1, 0] else eta[:, :3]

    def drifting(t_s: float) -> Array:
        eta = standing(t_s)
        eta[1, 0] -= 0.15 * max(t_s - LEARNT_S, 0.0)
        return eta

    last = watch(LEARNT_S + 4.0, drifting, reported_places=told)[-1]
    centres = last.obstacles.outline.mean(axis=1)
    assert np.linalg.norm(centres - last.robots[1, :2], axis=1).min(initial=9.0) < RADIUS_M


def test_a_robot_behind_a_camera_that_looks_aslant_hides_nothing_in_its_picture() -> None:
    """Of several cameras one is told of robots that another one sees."""
    pool = EXPERIMENT.pool.model_copy(update={"size_m": (8.0, 4.0, 1.2)})
    experiment = EXPERIMENT.model_copy(update={"camera": ASLANT, "pool": pool})
    frames = np.random.default_rng(1).integers(80, 90, (80, 960, 1280), dtype=np.uint8)
    for place in np.linspace([-3.7, 0.0, 0.3], [-1.9, 0.0, 0.3], 12):
        hidden, shaded = ObstacleDetector(experiment)._mask_robots(place[None])  # what it hides shows in no result
        assert not hidden.any() and shaded.mean() < 0.05, place
    watcher = ObstacleDetector(experiment)
    for k, frame in enumerate(frames):
        look = watcher.step(frame, k * 100_000_000, np.array([[-2.04, 0.0, 0.3]]))
    assert look is not None and look.watched > 0.9 and not look.blind


def test_small_thing_is_no_obstacle() -> None:
    small = {"cork": Intruder(*ball(0.03), (40, 40, 200), (0.9, -0.7))}
    assert not any(look.obstacles.ids for look in watch(LEARNT_S + 2.0, standing, small))
    wanted = watch(LEARNT_S + 2.0, standing, small, least_m=0.02)
    assert wanted[-1].obstacles.ids


def disturbed(fault: str, fault_s: float, seconds: float, *intruders: Intruder) -> list[Obstacles]:
    """Obstacles, ten times a second, with intruders that appear at LEARNT_S and a disturbed camera."""
    renderer, watcher, trouble = _renderer(), ObstacleDetector(EXPERIMENT), CameraFaults()
    random, broken, looks = np.random.default_rng(1), read_what(f"camera {fault}"), []
    for k in range(round(seconds / LOOK_S)):
        t_s = k * LOOK_S
        frame = renderer.render(standing(0.0), np.zeros((2, 4)), t_s, k)
        for intruder in (each for each in intruders if t_s >= each.enters_s):
            frame = draw(frame, intruder, t_s - intruder.enters_s, t_s, random)
        look = watcher.step(trouble.apply(frame, [broken] if t_s >= fault_s else []), round(t_s * 1e9), standing(0.0)[:, :3])
        assert look is not None
        looks.append(look)
    return looks


STILL = Intruder(*ball(0.1), (40, 40, 200), (0.9, 0.8))
DRIFTING = Intruder(*ball(0.1), (40, 40, 200), (-1.4, -0.8), (0.1, 0.0))


def test_when_a_lamp_is_switched_it_is_blind_and_goes_on_telling_what_was_there() -> None:
    """Of two balls, for how long they have not been seen. The one that drifts is found again; the one that lies still has
    become water by then, and is told of all the same."""
    fault = round(9.0 / LOOK_S)
    looks = disturbed("lamp 0.5", 9.0, 16.0, STILL, DRIFTING)
    assert all("learns what the water looks like" in obstacles.blind for obstacles in looks[:30])
    assert not any(obstacles.blind for obstacles in looks[round(LEARNT_S / LOOK_S) : fault])
    before = looks[fault - 1]
    assert len(before.ids) == 2 and not before.unseen_s.any()
    blind = [k for k, obstacles in enumerate(looks) if k >= fault and obstacles.blind]
    assert blind[0] <= fault + 4 and 35 <= len(blind) <= 50, "four seconds to learn it anew"
    for k in blind:
        assert "the light changed or the camera moved" in looks[k].blind
        assert looks[k].ids == before.ids, "what was there is still told of"
        assert looks[k].unseen_s == pytest.approx((k - blind[0] + 1) * LOOK_S)
    last = looks[-1]
    resting = before.ids[int(np.argmax(before.outline.mean(axis=1)[:, 0]))]
    assert not last.blind and last.watched > 0.8 and len(last.ids) == 2
    assert last.unseen_s[last.ids.index(resting)] > 6.0
    assert np.linalg.norm(last.velocity[1 - last.ids.index(resting)] - DRIFTING.velocity) < 0.04


def test_an_obstacle_that_passes_by_is_not_taken_for_one_that_has_become_water() -> None:
    """It passes half a metre away."""
    passing = Intruder(*ball(0.1), (40, 40, 200), (-0.6, 0.3), (0.3, 0.0), enters_s=14.0)
    last = disturbed("lamp 0.5", 9.0, 19.0, STILL, passing)[-1]
    assert not last.blind and len(last.ids) == 2
    assert np.linalg.norm(last.outline.mean(axis=1) - STILL.middle(0.0), axis=1).min() < 0.05


def test_after_an_error_it_is_blind_and_goes_on_telling_what_was_there() -> None:
    renderer, watcher, random, looks = _renderer(), ObstacleDetector(EXPERIMENT), np.random.default_rng(1), list[Obstacles]()
    fault = round((LEARNT_S + 1.0) / LOOK_S)
    for k in range(fault + 5):
        frame = renderer.render(standing(0.0), np.zeros((2, 4)), k * LOOK_S, k)
        frame = draw(frame, STILL, k * LOOK_S - LEARNT_S, k * LOOK_S, random) if k * LOOK_S >= LEARNT_S else frame
        if k == fault:
            watcher, look = watcher.begun_anew(k * 100_000_000)
        else:
            look = watcher.step(frame, k * 100_000_000, standing(0.0)[:, :3])  # type: ignore[assignment]
        looks.append(look)
    before = looks[fault - 1]
    assert len(before.ids) == 1 and not before.blind
    for k, look in enumerate(looks[fault:], start=1):
        assert "failed" in look.blind and look.ids == before.ids and look.unseen_s == pytest.approx([k * LOOK_S])


def test_when_the_camera_is_bumped_the_pool_never_looks_empty() -> None:
    """It is blind, or takes the edges of everything for obstacles; either keeps robots from going on as if it were clear."""
    looks = disturbed("bump 60", LEARNT_S + 1.0, LEARNT_S + 6.0)
    assert not any(obstacles.ids for obstacles in looks[: round((LEARNT_S + 1.0) / LOOK_S)])
    assert all(obstacles.blind or obstacles.ids for obstacles in looks[round((LEARNT_S + 2.0) / LOOK_S) :])


def test_frames_between_looks_and_of_another_size_are_left_out() -> None:
    watcher, frame, nobody = ObstacleDetector(EXPERIMENT), np.full((960, 1280), 90, np.uint8), np.zeros((0, 3))
    looked = [watcher.step(frame, stamp_ns, nobody) is not None for stamp_ns in (0, 50_000_000, 100_000_000, 120_000_000, 7)]
    assert looked == [True, False, True, False, True], "twenty frames a second are ten looks; a clock may be set back"
    assert watcher.step(frame[::2, ::2].copy(), 10**12, nobody) is None


def test_same_frames_same_bits() -> None:
    def run() -> list[bytes]:
        looks = watch(LEARNT_S + 1.0, circling, INTRUDERS)
        return [look.obstacles.outline.tobytes() + look.obstacles.velocity.tobytes() for look in looks]

    first = run()
    assert first == run() and len(first[-1]) > 0


# --- the parts


def test_background_forgives_what_it_has_seen_flicker_and_nothing_else() -> None:
    """Cells flicker in brightness only; then one is as bright as ever but greener, another darker than ever."""
    random, background_model, shape = np.random.default_rng(1), BackgroundModel((12, 16)), (12, 16)
    nowhere = np.zeros(shape, np.bool_)
    usual = np.array([4.0, 4.8, 4.9], np.float32)[:, None, None]
    for _ in range(60):
        colours = (usual + 0.3 * random.standard_normal(shape)).astype(np.float32)
        background_model.learn(colours, background_model.distance(colours, nowhere), ~nowhere, 0.2)
    assert background_model.is_known.all()
    probe = np.broadcast_to(usual, (3, *shape)).copy()
    probe[:, 2, 2] += 0.5
    probe[1, 5, 5] += 0.3
    probe[:, 8, 8] -= 2.0
    distance, shaded = (background_model.distance(probe, where) for where in (nowhere, ~nowhere))
    assert distance[2, 2] < 2.5 and distance[0, 0] < 0.6
    assert distance[5, 5] > 5.0 and distance[8, 8] > 5.0
    assert shaded[8, 8] < 0.7 * distance[8, 8] and shaded[5, 5] > 0.95 * distance[5, 5], "a shadow has no colour"


@given(st.integers(0, 2**31))
def test_distances_are_mahalanobis_by_plain_algebra(seed: int) -> None:
    random, shape = np.random.default_rng(seed), (8, 8)
    background_model = BackgroundModel(shape)
    nowhere = np.zeros(shape, np.bool_)
    mixing = random.normal(0.0, 0.3, (3, 3))
    for _ in range(25):
        same_everywhere = (4.0 + mixing @ random.standard_normal(3)).astype(np.float32)[:, None, None]
        colours = np.broadcast_to(same_everywhere, (3, *shape)).copy()
        background_model.learn(colours, np.zeros(shape, np.float32), ~nowhere, 0.2)
    # mean and covariance are told to nobody; only with them can the distance be computed independently
    mean, (rr, rg, rb, gg, gb, bb) = background_model._mean[:, 0, 0], background_model._covariance[:, 0, 0]
    covariance = np.array([[rr, rg, rb], [rg, gg, gb], [rb, gb, bb]], np.float64) + 0.03**2 * np.eye(3) + 0.08**2
    probe = random.normal(4.0, 0.5, 3).astype(np.float32)
    planes = np.broadcast_to(probe[:, None, None], (3, *shape)).copy()
    for where, wider in ((nowhere, 0.0), (~nowhere, 0.5**2)):
        off = (probe - mean).astype(np.float64)
        expected = np.sqrt(off @ np.linalg.solve(covariance + wider, off))
        assert background_model.distance(planes, where)[4, 4] == pytest.approx(expected, rel=2e-2, abs=1e-2)


def test_a_cell_is_calm_only_a_while_after_it_was_hidden() -> None:
    calm, shape = TemporalSmoother((2, 2)), (2, 2)
    hidden = np.array([[True, False], [False, False]])
    old, new = np.full((3, *shape), 2.0, np.float32), np.full((3, *shape), 5.0, np.float32)
    for _ in range(10):
        _, steady = calm.update(old, hidden, LOOK_S)
    assert steady.tolist() == [[False, True], [True, True]]
    averages, steady = calm.update(new, ~hidden & False, LOOK_S)
    assert averages[0, 0, 0] == 5.0 and not steady[0, 0], "nothing is left of what hid it"
    assert 2.0 < averages[0, 0, 1] < 4.0 and steady[0, 1]


points = arrays(np.float64, st.tuples(st.integers(4, 30), st.just(2)), elements=st.floats(-2.0, 2.0, width=32))


@given(points)
def test_outlines_are_convex_and_hold_everything(cloud: Array) -> None:
    outline = convex_outline(cloud)
    assert outline.shape == (12, 2)
    sides = np.roll(outline, -1, axis=0) - outline
    turns = sides[:, 0] * np.roll(sides[:, 1], -1) - sides[:, 1] * np.roll(sides[:, 0], -1)
    assert turns.min() > -1e-9, "from x to y, never back"
    to_points = cloud[:, None] - outline
    assert (sides[:, 0] * to_points[..., 1] - sides[:, 1] * to_points[..., 0]).min() > -1e-6, "no point outside"


@given(st.floats(-3.0, 3.0), st.floats(0.05, 1.0), st.floats(0.05, 1.0))
def test_the_outline_of_a_rectangle_is_the_rectangle(yaw_rad: float, length_m: float, width_m: float) -> None:
    _, corners = box((length_m, width_m, 0.1), yaw_rad)
    outline = convex_outline(corners)
    x, y = outline.T
    area = 0.5 * float(np.sum(x * np.roll(y, -1) - y * np.roll(x, -1)))
    assert area == pytest.approx(length_m * width_m, rel=1e-3)


def region(x_m: float, y_m: float = 0.0) -> Blob:
    middle = np.array([x_m, y_m])
    return Blob(np.zeros((2, 2), np.bool_), middle, middle + np.zeros((12, 2)))


def follow(tracker: BlobTracker, looks: Sequence[Sequence[Blob]]) -> list[list[int]]:
    """Numbers shown after each look, ten a second."""
    numbers = []
    for k, regions in enumerate(looks):
        tracker.update(regions, k * 100_000_000)
        numbers.append([blob.id for blob in tracker.blobs if blob.id])
    return numbers


def test_lasting_blob_is_shown_and_a_flickering_one_is_not() -> None:
    steady, gap = [region(0.0)], list[Blob]()
    assert follow(BlobTracker(), [steady] * 6) == [[], [], [], [], [1], [1]]
    assert follow(BlobTracker(), [steady, steady, steady, gap] * 5) == [[]] * 20
    shown = follow(BlobTracker(), [*[steady] * 5, *[gap] * 3, steady, *[gap] * 7, *[steady] * 5])
    assert shown[8] == [1] and shown[12] == [1] and shown[13] == [], "0.4 s unseen is gone"
    assert shown[-1] == [2], "no number is used twice"


def test_things_that_pass_each_other_keep_their_numbers_and_speeds() -> None:
    tracker = BlobTracker()
    follow(tracker, [[region(-1.0 + 0.02 * k, 0.08), region(1.0 - 0.03 * k, -0.08)] for k in range(100)])
    assert [blob.id for blob in tracker.blobs] == [1, 2]
    assert tracker.blobs[0].velocity_mps == pytest.approx([0.2, 0.0])
    assert tracker.blobs[1].velocity_mps == pytest.approx([-0.3, 0.0])


# --- minutes of water


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(1, 6))
@pytest.mark.parametrize("settings", [(), STRONG], ids=["pool scene", "strong glare and caustics"])
def test_water_and_robots_alone_raise_no_alarm(settings: tuple[str, ...], seed: int) -> None:
    """A minute each."""
    looks = watch(60.0, circling, settings=settings, seed=seed)
    alarms = {number for look in looks for number in look.obstacles.ids}
    assert not alarms, f"{len(alarms)} false alarms in a minute"
