"""The simulated picture: geometry against projected points, blur against a long sum, noise against its own statistics."""

import itertools
from functools import cache

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from shoal.config.experiment import Experiment, load_experiment
from shoal.frames import Array, body_to_pool
from sim_bridge.camera.optics import project, rays
from sim_bridge.camera.rays import sample_mosaic
from sim_bridge.camera.renderer import Renderer
from sim_bridge.camera.water_optics import Caustics

pytestmark = pytest.mark.long

Bytes = NDArray[np.uint8]

STILL = tuple(f"sim.picture.{key}=0" for key in ("noise", "ripples_m", "caustics", "glare", "vignetting"))
CLEAN = (*STILL, "sim.picture.shadows=false")
SMALL = ("camera.size_px=[320, 240]", "camera.focal_px=[251.25, 251.25]", "camera.centre_px=[159.5, 119.5]")
AWAY = (50.0, 0.0, 0.3, 0.0)
REST = np.zeros((2, 4))


@cache
def experiment(*settings: str) -> Experiment:
    return load_experiment("pool", settings)


@cache
def renderer(*settings: str, seed: int = 1) -> Renderer:
    return Renderer(experiment(*settings), seed)


def bgr(raw: Bytes) -> Bytes:
    return np.asarray(cv2.cvtColor(raw, cv2.COLOR_BayerRGGB2BGR), dtype=np.uint8)


def poses(*eta: tuple[float, ...]) -> Array:
    return np.array(eta, dtype=np.float64)


def corners_px(setup: Experiment, eta: Array, tilt: tuple[float, float] = (0.0, 0.0)) -> Array:
    """Pixels of a marker's corners: front port, front starboard, rear starboard, rear port. `tilt`: roll, pitch."""
    half, height = setup.vehicle.marker.side_m / 2.0, setup.vehicle.marker.height_m
    body = np.array([[half, -half, -height], [half, half, -height], [-half, half, -height], [-half, -half, -height]])
    roll, pitch = tilt
    return project(setup.camera, eta[:3] + Rotation.from_euler("ZYX", [eta[3], pitch, roll]).apply(body))


def detect(raw: Bytes) -> dict[int, Array]:
    """Marker id -> corners (4, 2)."""
    settings = cv2.aruco.DetectorParameters()
    settings.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
    settings.cornerRefinementWinSize = 2  # at the default share of a 5 px cell it would round down to 1: three times the error
    settings.relativeCornerRefinmentWinSize = 0.6
    detector = cv2.aruco.ArucoDetector(cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50), settings)
    corners, ids, _ = detector.detectMarkers(bgr(raw))
    return {} if ids is None else {int(i): c[0].astype(np.float64) for i, c in zip(ids.ravel(), corners, strict=True)}


# --- geometry


@pytest.mark.parametrize("yaw", [0.0, 0.4, 1.6, 2.9, -0.8, -2.1])
@pytest.mark.parametrize("x,y,z", [(0.25, -0.1, 0.3), (1.1, 0.7, 0.2), (-0.9, 0.6, 0.7)])
def test_markers_are_read_with_their_top_ahead(x: float, y: float, z: float, yaw: float) -> None:
    """Right ids, corners in order. OpenCV's refinement pulls the corners of a soft-edged square inwards, by 0.28 px in these
    pictures and by as much in ideal drawings of the marker; the exactness of ours is the next test's."""
    eta = poses((x, y, z, yaw), (-x, -y, z, yaw + 0.7))
    corners = detect(renderer(*CLEAN).render(eta, REST, 0.0, 0))
    for robot, pose in enumerate(eta, start=1):
        expected = corners_px(experiment(*CLEAN), pose)
        assert np.linalg.norm(corners[robot] - expected, axis=1).max() < 0.7
        assert np.linalg.norm(corners[robot] - expected, axis=1).mean() < 0.45
        assert np.linalg.norm(np.mean(corners[robot] - expected, axis=0)) < 0.25


@pytest.mark.parametrize("yaw", [0.0, 0.3, 1.1, 2.5, -2.0])
@pytest.mark.parametrize("x,y,z", [(0.0, 0.0, 0.3), (1.1, 0.7, 0.2), (-0.9, 0.6, 0.7), (1.2, -0.8, 0.1), (-0.3, 0.9, -0.05)])
@pytest.mark.parametrize("tilt", [(0.0, 0.0), (0.15, -0.3)], ids=["level", "tilted"])
def test_markers_are_drawn_to_a_twentieth_of_a_pixel(
    x: float, y: float, z: float, yaw: float, tilt: tuple[float, float]
) -> None:
    """Shift, turn and scale against the marker drawn by a homography at eight times the resolution, on the green pixels
    (no demosaicing in between). At z <= 0.15 the marker stands in air, above a robot that breaks the surface."""
    pose = np.array([x, y, z, yaw])
    corners = corners_px(experiment(*CLEAN), pose, tilt)
    left, top = np.floor(corners.min(axis=0)).astype(int) // 2 * 2 - 2
    right, bottom = np.ceil(corners.max(axis=0)).astype(int) + 3
    picture = renderer(*CLEAN).render(poses(tuple(pose), AWAY), REST, 0.0, 0, np.array([tilt, (0.0, 0.0)]))
    raw = picture[top:bottom, left:right].astype(float)
    drawn = _ideal_marker(experiment(*CLEAN).robots[0].marker, corners - [left, top], raw.shape)
    rows, columns = np.mgrid[: raw.shape[0], : raw.shape[1]]
    dy, dx = np.gradient(drawn)
    u, v = columns - corners[:, 0].mean() + left, rows - corners[:, 1].mean() + top
    shapes = np.stack([drawn, np.ones_like(drawn), -dx, -dy, v * dx - u * dy, -(u * dx + v * dy)], axis=-1)
    body = body_to_pool(np.stack([u, v], axis=-1), -yaw)
    reach = 0.46 * np.linalg.norm(corners[0] - corners[1]) * 8 / 6  # on the plate
    used = ((rows + columns) % 2 == 1) & (np.abs(body).max(axis=-1) < reach)
    gain, _, shift_x, shift_y, turn, scale = np.linalg.lstsq(shapes[used], raw[used], rcond=None)[0]
    assert np.hypot(shift_x, shift_y) / gain < 0.05
    assert abs(turn) / gain < 0.003 and abs(scale) / gain < 0.007


def _ideal_marker(marker_id: int, corners: Array, shape: tuple[int, ...], fine: int = 8) -> Array:
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50)
    cell = 20
    texture = np.pad(
        cv2.aruco.generateImageMarker(dictionary, marker_id, 6 * cell, borderBits=1), 3 * cell, constant_values=255
    )
    square = np.array([[0, 0], [1, 0], [1, 1], [0, 1]]) * 6 * cell + 3 * cell - 0.5
    target = (corners + 0.5) * fine - 0.5
    warp = cv2.getPerspectiveTransform(square.astype(np.float32), target.astype(np.float32))
    large = cv2.warpPerspective(texture, warp, (shape[1] * fine, shape[0] * fine), flags=cv2.INTER_LINEAR, borderValue=255)
    small = cv2.resize(large, shape[::-1], interpolation=cv2.INTER_AREA).astype(np.float64)
    return np.asarray(cv2.GaussianBlur(small, (0, 0), 0.5), dtype=np.float64)


@pytest.mark.parametrize("x,y,z", [(0.3, 0.2, 0.3), (1.2, -0.8, 0.5), (-0.2, 0.9, 0.16)])
def test_the_sphere_has_the_right_outline(x: float, y: float, z: float) -> None:
    """Area and centre of the robot's picture are those of the hull of 5,000 projected points of its surface."""
    setup = (*CLEAN, "localizer.markers=false")
    eta = poses((x, y, z, 1.0), AWAY)
    picture, empty = (renderer(*setup).render(e, REST, 0.0, 0) for e in (eta, poses(AWAY, AWAY)))
    step = np.arange(5000) + 0.5
    up, angle = 1.0 - 2.0 * step / 5000, np.pi * (1.0 + np.sqrt(5.0)) * step
    ball = np.column_stack([np.sqrt(1 - up**2) * np.cos(angle), np.sqrt(1 - up**2) * np.sin(angle), up])
    outline = project(experiment(*setup).camera, eta[0, :3] + experiment(*setup).vehicle.radius_m * ball)
    hull = cv2.convexHull(outline.astype(np.float32))
    moments = cv2.moments(hull)
    difference = np.abs(picture.astype(np.int16) - empty.astype(np.int16)) > 12
    rows, columns = np.nonzero(cv2.morphologyEx(difference.astype(np.uint8), cv2.MORPH_CLOSE, np.ones((5, 5), np.uint8)))
    assert columns.mean() == pytest.approx(moments["m10"] / moments["m00"], abs=0.15)
    assert rows.mean() == pytest.approx(moments["m01"] / moments["m00"], abs=0.15)
    assert len(rows) == pytest.approx(moments["m00"], rel=0.02)


def test_the_upper_robot_hides_the_lower() -> None:
    upper, lower = (0.5, 0.3, 0.2, 0.0), (0.62, 0.33, 0.6, 0.0)
    assert set(detect(renderer(*CLEAN).render(poses(upper, lower), REST, 0.0, 0))) == {1}
    assert set(detect(renderer(*CLEAN).render(poses(lower, upper), REST, 0.0, 0))) == {2}


def test_robots_anywhere_do_no_harm() -> None:
    places = [*itertools.product((-2.0, -1.65, 1.7, 300.0), (-1.4, 0.0, 1.35)), (0.0, 0.0)]
    for (x, y), z in itertools.product(places, (0.3, -0.5, -2.79, -2.9, 5.0)):
        picture = renderer(*SMALL).render(poses((x, y, z, 1.0), (-x, y, z, 1e6)), np.full((2, 4), 0.4), 1.0, 3)
        assert picture.shape == (240, 320) and picture.dtype == np.uint8


def test_sizes_that_fit_no_block() -> None:
    odd = renderer("camera.size_px=[101, 75]", "camera.focal_px=[80, 80]", "camera.centre_px=[50, 37]")
    assert odd.render(poses((0.0, 0.0, 0.3, 0.0), (1.5, 1.0, 0.3, 0.0)), REST, 0.3, 1).shape == (75, 101)


def test_a_state_that_is_no_number_is_a_bug() -> None:
    with pytest.raises(ValueError, match="robot 2: eta"):
        renderer(*SMALL).render(poses((0, 0, 0.3, 0), (np.nan, 0, 0.3, 0)), REST, 0.0, 0)


# --- colours and looks


def test_bayer_order_gives_right_colours() -> None:
    column, row = np.meshgrid(np.arange(16, dtype=np.float32), np.arange(16, dtype=np.float32))
    for channel in range(3):
        plain = np.zeros((16, 16, 3), np.uint8)
        plain[..., channel] = 200
        raw = sample_mosaic([np.ascontiguousarray(plain[..., k]) for k in (2, 1, 0)], column, row)
        assert np.all(bgr(raw)[4:-4, 4:-4] == plain[4:-4, 4:-4])


def test_a_ball_adrift_comes_when_it_should_and_is_drawn_where_it_is() -> None:
    """Its outline is the hull of projected points of a sphere; robots are where they were."""
    settings = (*CLEAN, "sim.drifters=[{radius_m=0.12, start_m=[-0.9, 0.6, 0.4], velocity_mps=[0.1, -0.05, 0.0], from_s=2.0}]")
    eta = poses((0.5, 0.0, 0.3, 0.2), AWAY)
    before, without = renderer(*settings).render(eta, REST, 1.9, 0), renderer(*CLEAN).render(eta, REST, 1.9, 0)
    assert np.array_equal(before, without)
    changed = bgr(renderer(*settings).render(eta, REST, 4.0, 0)).astype(int) - bgr(without)
    rows, columns = np.nonzero(np.abs(changed).max(axis=2) > 60)  # half covered
    k = np.arange(2000) + 0.5
    up, angle = 1.0 - 2.0 * k / 2000, np.pi * (1.0 + np.sqrt(5.0)) * k
    ball = np.column_stack([np.sqrt(1 - up**2) * np.cos(angle), np.sqrt(1 - up**2) * np.sin(angle), up])
    hull = cv2.convexHull(project(experiment(*CLEAN).camera, np.array([-0.7, 0.5, 0.4]) + 0.12 * ball).astype(np.float32))
    assert len(rows) == pytest.approx(cv2.contourArea(hull), rel=0.04)
    assert [columns.mean(), rows.mean()] == pytest.approx(hull[:, 0].mean(axis=0), abs=1.5)
    blue, green, red = bgr(renderer(*settings).render(eta, REST, 4.0, 0))[rows, columns].mean(axis=0)
    assert red > 2 * green and red > 2 * blue


def test_the_mark_is_red_and_robots_are_yellow() -> None:
    picture = bgr(renderer(*CLEAN).render(poses((0.8, 0.0, 0.3, 0.0), AWAY), REST, 0.0, 0)).astype(int)
    blue, green, red = picture[475:485, 635:645].reshape(-1, 3).mean(axis=0)
    assert red > 2 * green and red > 2 * blue
    u, v = project(experiment(*CLEAN).camera, np.array([0.8, 0.1, 0.19]))[0].round().astype(int)  # shell beside the plate
    blue, green, red = picture[v - 2 : v + 3, u - 2 : u + 3].reshape(-1, 3).mean(axis=0)
    assert red > 1.05 * green and green > 1.5 * blue
    blue, green, red = picture[250:300, 400:460].reshape(-1, 3).mean(axis=0)
    assert blue > 1.4 * red and green > 1.4 * red


def test_heading_shows_without_a_marker() -> None:
    setup = (*CLEAN, "localizer.markers=false")
    camera = experiment(*setup).camera
    u, v = project(camera, np.array([0.5, 0.0, 0.2]))[0].round().astype(int)

    def look(yaw: float) -> NDArray[np.float32]:
        picture = bgr(renderer(*setup).render(poses((0.5, 0.0, 0.3, yaw), AWAY), REST, 0.0, 0))
        return picture[v - 38 : v + 39, u - 38 : u + 39, 1].astype(np.float32)

    def likeness(first: NDArray[np.float32], second: NDArray[np.float32]) -> float:
        return float(np.corrcoef(first.ravel(), second.ravel())[0, 1])

    same = likeness(look(0.0), look(0.01))
    assert same > 0.97
    assert all(likeness(look(0.0), look(yaw)) < 0.75 for yaw in (np.pi / 2, np.pi, -np.pi / 2))
    assert not detect(renderer(*setup).render(poses((0.5, 0.0, 0.3, 0.0), AWAY), REST, 0.0, 0))


def test_shadows_glare_and_vignetting() -> None:
    alone, low = poses(AWAY, AWAY), poses((0.0, 0.5, 0.5, 0.0), AWAY)
    plain = renderer(*STILL, *SMALL, "sim.picture.shadows=false")
    shadowed = renderer(*STILL, *SMALL).render(low, REST, 0.0, 0).astype(int) - plain.render(low, REST, 0.0, 0)
    assert shadowed.min() < -15 and shadowed.max() <= 0
    base = plain.render(alone, REST, 0.0, 0).astype(float)
    lamps = renderer(*CLEAN[:3], *CLEAN[4:], *SMALL, "sim.picture.glare=1.0").render(alone, REST, 0.0, 0) - base
    assert lamps.min() >= 0 and lamps.max() > 40 and np.mean(lamps > 5) < 0.15
    dim = renderer(*CLEAN[:4], *SMALL, "sim.picture.vignetting=0.4", "sim.picture.shadows=false").render(alone, REST, 0.0, 0)
    assert np.mean(dim[:6, :6]) == pytest.approx(0.6 * np.mean(base[:6, :6]), rel=0.03)
    assert np.mean(dim[115:125, 155:165]) == pytest.approx(np.mean(base[115:125, 155:165]), rel=0.01)


# --- time


def test_equal_inputs_give_equal_pictures() -> None:
    eta, nu = poses((0.1, 0.2, 0.3, 0.4), (-0.7, 0.1, 0.4, 2.0)), np.full((2, 4), 0.1)
    first = renderer(*SMALL).render(eta, nu, 1.23, 7)
    renderer(*SMALL).render(eta, nu, 9.0, 8)  # leaves no trace
    again = Renderer(experiment(*SMALL), 1).render(eta, nu, 1.23, 7)
    assert np.array_equal(first, again)
    assert np.array_equal(first, renderer(*SMALL).render(eta, nu, 1.23, 7))
    assert not np.array_equal(first, renderer(*SMALL).render(eta, nu, 1.23, 8))
    assert np.mean(first != renderer(*SMALL, seed=2).render(eta, nu, 1.23, 7)) > 0.5


def test_blur_is_the_mean_over_the_exposure() -> None:
    """Against 61 sharp pictures; and it keeps the marker where it is in the middle of the exposure."""
    fast = experiment(*CLEAN, "camera.exposure_s=0.015")
    blurring = Renderer(fast, 1)
    eta = poses((0.4, -0.3, 0.3, 0.7), (-0.5, 0.2, 0.3, -2.0))
    nu = np.array([[0.4, -0.15, 0.1, 1.5], [-0.3, 0.0, 0.0, -1.0]])
    picture = blurring.render(eta, nu, 0.0, 0).astype(float)
    total = np.zeros_like(picture)
    for t in (np.arange(61) - 30) / 61 * 0.015:
        moved = eta.copy()
        moved[:, :2] += body_to_pool(nu[:, :2], eta[:, 3]) * t
        moved[:, 2:] += nu[:, 2:] * t
        total += renderer(*CLEAN).render(moved, REST, 0.0, 0)
    sharp = renderer(*CLEAN).render(eta, REST, 0.0, 0)
    residual = np.sqrt(np.mean((picture - total / 61)[picture != sharp] ** 2))
    assert residual < 0.2 * np.sqrt(np.mean((sharp - total / 61)[picture != sharp] ** 2))
    backwards = blurring.render(eta, -nu, 0.0, 0)
    assert np.abs(backwards - picture).max() <= 1, "symmetric in time"
    corners = detect(picture.astype(np.uint8))
    for i in range(2):
        assert np.linalg.norm(np.mean(corners[i + 1] - corners_px(fast, eta[i]), axis=0)) < 0.1


def test_a_rolling_shutter_shows_each_robot_at_the_instant_of_its_row() -> None:
    """The middle row is exposed at the picture's time, others earlier or later by their share of 30 ms."""
    rolling = experiment(*CLEAN, "camera.readout_s=0.03")
    eta, nu = poses((0.4, -0.8, 0.3, 0.7), (-0.5, 0.8, 0.3, -2.0)), np.array([[0.4, 0.1, 0.0, 0.5], [-0.3, 0.2, 0.0, -0.5]])
    corners = detect(Renderer(rolling, 1).render(eta, nu, 0.0, 0))
    for i in range(2):
        late_s = 0.03 * (float(corners[i + 1][:, 1].mean()) / 960.0 - 0.5)
        moved = eta[i] + late_s * np.append(body_to_pool(nu[i, :2], float(eta[i, 3])), nu[i, 2:])
        assert np.linalg.norm(np.mean(corners[i + 1] - corners_px(rolling, moved), axis=0)) < 0.15
        assert np.linalg.norm(np.mean(corners[i + 1] - corners_px(rolling, eta[i]), axis=0)) > 0.7


def test_water_never_comes_back() -> None:
    """Autocorrelation of 15 minutes of the picture's moving part, by the power spectrum, at every lag beyond a wave."""
    moving = renderer("sim.picture.noise=0", "camera.size_px=[160, 120]", "camera.focal_px=[125.6, 125.6]",
                      "camera.centre_px=[79.5, 59.5]")  # fmt: skip
    count, period_s = 4500, 0.2
    pictures = np.array([moving.backdrop.at(k * period_s)[1][::4, 1::8].ravel() for k in range(count)], dtype=np.float64)
    pictures -= pictures.mean(axis=0)
    power = np.abs(np.fft.rfft(pictures, 2 * count, axis=0)) ** 2
    alike = np.fft.irfft(power.sum(axis=1))[: count // 2] / (count - np.arange(count // 2))
    assert np.abs(alike[5:] / alike[0]).max() < 0.35
    now = moving.backdrop.at(0.5)[1].astype(int)
    assert np.abs(now - moving.backdrop.at(0.65)[1]).mean() > 3


def test_water_makes_no_light() -> None:
    still = renderer(*CLEAN, *SMALL).render(poses(AWAY, AWAY), REST, 0.0, 0)
    moving = renderer(*CLEAN[:2], *CLEAN[3:], *SMALL, "sim.picture.caustics=0.25")
    mean = np.mean([moving.render(poses(AWAY, AWAY), REST, t, 0) for t in np.arange(0, 3.0, 0.1)])
    assert mean == pytest.approx(np.mean(still), rel=0.03), "caustics move light about, they do not make any"


def test_water_depends_on_seed_and_time_alone() -> None:
    """All phases drawn in advance, as in real time, or each when it is needed, as in lockstep."""
    times_s = [float(t) for t in np.random.default_rng(3).uniform(0.0, 500.0, 5)]
    prepared, lazy = Renderer(experiment(*SMALL), 4), Renderer(experiment(*SMALL), 4)
    prepared.backdrop.prepare()
    before = {t: prepared.backdrop.at(t)[1].copy() for t in times_s}
    assert all(np.array_equal(before[t], lazy.backdrop.at(t)[1]) for t in reversed(times_s))
    assert not np.array_equal(before[times_s[0]], Renderer(experiment(*SMALL), 5).backdrop.at(times_s[0])[1])


@pytest.mark.parametrize("depth_m", [0.3, 1.5, 100.0])
def test_no_light_is_lost_however_deep_the_basin(depth_m: float) -> None:
    caustics = Caustics(experiment(f"pool.size_m=[4,3,{depth_m}]").pool, np.random.default_rng(1))
    light = caustics.pattern(0.7)
    assert light.shape == (301, 401)
    assert light.min() >= 0.0
    assert light.mean() == pytest.approx(1.0, abs=0.05)  # foci are cut at CAUSTIC_BRIGHTEST


def test_ripples_shift_the_floor_as_tilted_water_does() -> None:
    """The red mark's centre against Snell's law in vectors at a tilted surface, traced through the pixels of the mark."""
    setup = (*CLEAN[:1], *CLEAN[2:], "sim.picture.ripples_m=0.006")
    camera, rippled = experiment(*setup).camera, renderer(*setup)
    u, v = np.meshgrid(np.arange(600.0, 680.0, 2.0), np.arange(440.0, 520.0, 2.0))
    lines = rays(camera, np.stack([u, v], axis=-1))
    waters = rippled.backdrop.at(0.0)[0].waters
    basis = waters.ripples.basis(*(lines.surface_m[..., i].astype(np.float32) for i in (0, 1)))
    moved = []
    for time_s in np.arange(0.0, 2.4, 0.2):
        loop_s = waters.ripple_clock.loop_s(float(time_s))
        slope = waters.ripples.slopes(basis, loop_s).reshape(2, *u.shape).astype(np.float64)
        floor = _through_tilted_water(lines.surface_m, lines.air, slope, camera.water_index, 1.0)
        inside = np.hypot(floor[..., 0], floor[..., 1]) < 0.085
        expected = np.array([u[inside].mean(), v[inside].mean()])
        picture = bgr(rippled.render(poses(AWAY, AWAY), REST, float(time_s), 0))[440:520, 600:680].astype(float)
        rows, columns = np.nonzero(picture[..., 2] > picture[..., 1])
        centre = np.array([columns.mean() + 600, rows.mean() + 440])
        assert centre == pytest.approx(expected, abs=0.35)
        moved.append(expected)
    assert np.ptp(moved, axis=0).min() > 1.0, "the test must see a shift worth the name"


def _through_tilted_water(surface: Array, air: Array, slope: Array, index: float, depth_m: float) -> Array:
    """Ends of rays at a depth when the surface rises by `slope` (z is down, so its upward normal is (-slope, -1))."""
    normal = np.concatenate([-slope.transpose(1, 2, 0), -np.ones((*air.shape[:2], 1))], axis=-1)
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    ray = np.concatenate([air, np.ones((*air.shape[:2], 1))], axis=-1)
    ray /= np.linalg.norm(ray, axis=-1, keepdims=True)
    cosine = -np.sum(ray * normal, axis=-1, keepdims=True)
    deflected = ray / index + (cosine / index - np.sqrt(1 - (1 - cosine**2) / index**2)) * normal
    return np.asarray(surface + depth_m * deflected[..., :2] / deflected[..., 2:])


def test_ripples_shift_robots_with_the_same_sign() -> None:
    """Marker centres against the same tracing, at the marker's depth."""
    setup = (*CLEAN[:1], *CLEAN[2:], "sim.picture.ripples_m=0.006")  # four times the default
    camera, rippled = experiment(*setup).camera, renderer(*setup)
    pose = np.array([0.4, -0.3, 0.6, 0.7])
    middle = corners_px(experiment(*setup), pose).mean(axis=0)
    u, v = (np.arange(-25.0, 25.0, 0.5) + centre for centre in middle)
    lines = rays(camera, np.stack(np.meshgrid(u, v), axis=-1))
    waters = rippled.backdrop.at(0.0)[0].waters
    basis = waters.ripples.basis(*(lines.surface_m[..., i].astype(np.float32) for i in (0, 1)))
    expected, centres = [], []
    for time_s in np.arange(0.0, 2.4, 0.2):
        loop_s = waters.ripple_clock.loop_s(float(time_s))
        slope = waters.ripples.slopes(basis, loop_s).reshape(2, *lines.air.shape[:2]).astype(np.float64)
        plate = _through_tilted_water(lines.surface_m, lines.air, slope, camera.water_index, pose[2] - 0.15)
        rows, columns = np.nonzero(np.abs(body_to_pool(plate - pose[:2], -pose[3])).max(axis=-1) < 0.05)
        expected.append([u[columns].mean(), v[rows].mean()])
        picture = rippled.render(poses(tuple(pose), AWAY), REST, float(time_s), 0)
        centres.append(detect(picture)[1].mean(axis=0))
    assert np.ptp(expected, axis=0).min() > 0.6, "the test must see a shift worth the name"
    assert np.sqrt(np.mean(np.square(np.subtract(centres, expected)), axis=0)).max() < 0.15


# --- noise


def test_noise_has_the_stated_size_and_no_memory() -> None:
    setup = (*CLEAN[1:], *SMALL, "sim.picture.noise=4")
    eta = poses((0.4, -0.3, 0.3, 0.7), (-0.5, 0.2, 0.3, -2.0))
    truth = renderer(*CLEAN, *SMALL).render(eta, REST, 0.0, 0)
    noisy = [renderer(*setup).render(eta, REST, 0.0, k).astype(np.int16) - truth for k in range(20)]
    for low, high in ((30, 40), (95, 105), (123, 133), (150, 160)):
        level = (truth >= low) & (truth < high)
        expected = 4.0 * np.sqrt(0.3 + 0.7 * (low + high) / 2 / 128)
        assert np.std([n[level] for n in noisy]) == pytest.approx(expected, rel=0.04)
        assert abs(np.mean([n[level] for n in noisy])) < 0.1
    for first, second in itertools.combinations(noisy, 2):
        assert abs(np.corrcoef(first.ravel(), second.ravel())[0, 1]) < 0.02
    beside = np.corrcoef(np.ravel([n[:, 1:] for n in noisy]), np.ravel([n[:, :-1] for n in noisy]))[0, 1]
    assert abs(beside) < 0.01
