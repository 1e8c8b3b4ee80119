"""The camera's pose from points of the pool: against the pose that the simulator's own optics projected them with."""

import itertools

import cv2
import numpy as np
import pytest

from localizer.calibration.extrinsics import PoseFit, fit_pose
from localizer.calibration.survey_points import SurveyFile, SurveyPoint, seen_pixels
from shoal.config.experiment import load_experiment
from shoal.config.loader import check
from shoal.config.perception import Camera
from shoal.errors import ConfigError
from shoal.frames import Array
from sim_bridge.camera.optics import project, rays
from tests.localizer.board_scene import CameraBench, marks

POOL = load_experiment("pool").camera
RIM = [(x, y, -0.1) for x in (-1.6, 0.1, 1.6) for y in (-1.2, 1.2)]
FLOOR = [(x, y, 1.0) for x in (-1.3, 0.2, 1.4) for y in (-0.9, 1.0)]
SHELF = [(x, y, 0.35) for x in (-1.4, 0.0, 1.5) for y in (-1.0, 1.1)]
STEPS = [(x, y, z) for x, y, z in zip((-1.4, 1.3, 0.6, -0.5), (0.3, -0.6, 0.9, -1.0), (0.4, 0.7, 0.2, 0.55), strict=True)]
DEPTH_M = 0.3


def _hung(seed: int) -> Camera:
    """The pool's camera, hung a little otherwise: up to 0.15 m beside the middle, 3 degrees off the plumb line, turned at
    will, and looking somewhat wider, so that all points are seen."""
    random = np.random.default_rng(seed)
    tilt = np.asarray(cv2.Rodrigues(np.append(random.uniform(-0.05, 0.05, 2), 0.0))[0])
    turn = tilt @ np.asarray(
        cv2.Rodrigues(np.array([0.0, 0.0, random.uniform(-0.2, 0.2) + (np.pi if seed % 3 == 2 else 0.0)]))[0]
    )
    place = np.append(random.uniform(-0.15, 0.15, 2), random.uniform(-2.9, -2.7))
    return POOL.model_copy(
        update={
            "focal_px": (790.0, 792.0),
            "distortion": (-0.1, 0.02, 0.0005, -0.0003, 0.0),
            "rotation_rad": tuple(cv2.Rodrigues(turn)[0].ravel().tolist()),
            "position_m": tuple(place.tolist()),
        }
    )


def _points(places: list[tuple[float, float, float]]) -> list[SurveyPoint]:
    return [SurveyPoint(name=f"point {i}", pool_m=place, pixel_px=(0.0, 0.0)) for i, place in enumerate(places)]


def _fit(
    camera: Camera, places: list[tuple[float, float, float]], noise_px: float = 0.0, seed: int = 0, **changes: object
) -> PoseFit:
    """The fit to noisy pixels. The pose that goes in is nowhere near."""
    pixels = project(camera, np.array(places)) + noise_px * np.random.default_rng(seed + 500).normal(size=(len(places), 2))
    nowhere = {"position_m": (0.0, 0.0, -1.0), "rotation_rad": (0.0, 0.0, 0.0)}
    return fit_pose(camera.model_copy(update=nowhere | changes), _points(places), pixels)


def _moved(fit: PoseFit, truth: Camera) -> tuple[float, float]:
    """Distance and rotation of the found pose from the true one: m, rad."""
    rotation, true = (np.asarray(cv2.Rodrigues(np.array(camera.rotation_rad))[0]) for camera in (fit.camera, truth))
    turn = float(np.linalg.norm(cv2.Rodrigues(rotation @ true.T)[0]))
    return float(np.linalg.norm(np.subtract(fit.camera.position_m, truth.position_m))), turn


def _places_off_m(fit: PoseFit, truth: Camera, pixels: Array) -> Array:
    """Errors at DEPTH_M of the places that the fit gives for pixels (n, 2)."""
    lines, true = (rays(camera, pixels) for camera in (fit.camera, truth))
    apart = lines.surface_m + DEPTH_M * lines.water - true.surface_m - DEPTH_M * true.water
    return np.asarray(np.linalg.norm(apart, axis=-1), dtype=np.float64)


@pytest.mark.parametrize("seed", range(9))
@pytest.mark.parametrize(
    "places", [RIM + FLOOR, RIM, FLOOR, STEPS, RIM[:2] + FLOOR[-2:]], ids=["all", "rim", "floor", "steps", "four"]
)
def test_exact_pixels_give_the_exact_pose(places: list[tuple[float, float, float]], seed: int) -> None:
    truth = _hung(seed)
    fit = _fit(truth, places)
    shift_m, turn_rad = _moved(fit, truth)
    assert shift_m < 1e-5 and turn_rad < 1e-5
    assert fit.rms_px < 1e-4
    assert fit.suspect is None
    assert np.linalg.norm(fit.camera.rotation_rad) <= np.pi + 1e-9


@pytest.mark.parametrize("seed", range(9))
def test_two_millimetres_and_a_milliradian(seed: int) -> None:
    """With rim and floor in the picture, and pixels as good as markers give them."""
    truth = _hung(seed)
    shift_m, turn_rad = _moved(_fit(truth, RIM + FLOOR, noise_px=0.1, seed=seed), truth)
    assert shift_m < 0.002 and turn_rad < 0.001


@pytest.mark.parametrize("seed", range(5))
def test_without_refraction_it_is_worse(seed: int) -> None:
    truth = _hung(seed)
    pixels = np.array([[639.5, 479.5], [200.0, 150.0], [1100.0, 850.0]])
    wet = _fit(truth, RIM + SHELF, noise_px=0.1, seed=seed)
    dry = _fit(truth, RIM + SHELF, noise_px=0.1, seed=seed, water_index=1.0)
    assert dry.rms_px > 10.0 * wet.rms_px
    assert _moved(dry, truth)[0] > 10.0 * _moved(wet, truth)[0]
    assert _places_off_m(wet, truth, pixels).max() < 0.001 < 0.01 < _places_off_m(dry, truth, pixels).max()
    with pytest.raises(ConfigError, match=r"no pose of the camera explains them: they are 1\d px off"):
        _fit(truth, RIM + FLOOR, water_index=1.0)


def test_the_floor_alone_hides_the_error_of_ignoring_refraction() -> None:
    """A floor seen from above looks like a nearer one: residuals stay small while the camera hangs decimetres too low."""
    truth = _hung(0)
    dry = _fit(truth, FLOOR, water_index=1.0)
    assert dry.rms_px < 3.0
    assert _moved(dry, truth)[0] > 0.1
    assert _moved(_fit(truth, FLOOR), truth)[0] < 1e-5


# --- how sure it is


def test_covariance_is_honest() -> None:
    """Normalised error squared is 6 F(6, 18), mean 6.75; the mean of 60 such has a deviation of 0.7."""
    scores = []
    for seed in range(60):
        truth = _hung(3 * (seed // 3))  # upright ones: a turn by pi has two vectors
        fit = _fit(truth, RIM + FLOOR, noise_px=0.5, seed=seed)
        error = np.concatenate(
            [np.subtract(fit.camera.rotation_rad, truth.rotation_rad), np.subtract(fit.camera.position_m, truth.position_m)]
        )
        scores.append(error @ np.linalg.solve(fit.covariance, error))
    assert 5.0 < np.mean(scores) < 8.5


@pytest.mark.long
def test_deviation_of_places_is_honest() -> None:
    pixels = np.array([[639.5, 479.5], [250.0, 200.0]])
    off, stated = [], []
    for seed in range(100):
        truth = _hung(seed % 10)
        fit = _fit(truth, RIM + FLOOR, noise_px=0.5, seed=seed)
        off.append(_places_off_m(fit, truth, pixels))
        stated.append(fit.place_sigma_m(pixels, DEPTH_M))
    ratio = np.sqrt(np.mean(np.square(off), axis=0) / np.mean(np.square(stated), axis=0))
    assert np.all((ratio > 0.9) & (ratio < 1.55))  # both directions together over the worse one: 1 to sqrt(2)


def test_lucky_pixels_are_not_taken_for_certainty() -> None:
    fit = _fit(_hung(1), RIM[:2] + FLOOR[-2:])
    assert np.sqrt(np.diag(fit.covariance))[3:].max() > 0.0005


@pytest.mark.parametrize("wrong", range(0, 12, 2))
def test_a_wrong_point_is_named(wrong: int) -> None:
    """A coordinate 6 cm off, the width of a hand: an RMS of some pixels, and one point that explains it."""
    truth, places = _hung(wrong), RIM + FLOOR
    pixels = project(truth, np.array(places))
    x, y, z = places[wrong]
    mistaken = [*places[:wrong], (x + 0.06, y, z), *places[wrong + 1 :]]
    fit = fit_pose(truth, _points(mistaken), pixels + 0.2 * np.random.default_rng(wrong).normal(size=pixels.shape))
    assert fit.suspect == wrong


def test_noise_alone_makes_no_suspect() -> None:
    assert all(_fit(_hung(seed), RIM + FLOOR, noise_px=2.0, seed=seed).suspect is None for seed in range(10))


# --- what cannot be used


def _file(points: list[dict[str, object]], **more: object) -> SurveyFile:
    return check(SurveyFile, {"pool": {"size_m": [3.5, 2.5, 1.0]}, "points": points} | more, "points.toml")


def _entries(places: list[tuple[float, float, float]]) -> list[dict[str, object]]:
    return [{"name": f"point {i}", "pool_m": list(place), "pixel_px": [100.0 * i, 50.0]} for i, place in enumerate(places)]


@pytest.mark.parametrize(
    ("change", "complaint"),
    [
        ({"pool_m": [1.0, 1.0]}, r"points\.1\.pool_m = \[1\.0, 1\.0\]|points\.1\.pool_m\.2: missing"),
        ({"pool_m": [2.3, 0.0, 0.0]}, r"'point 1': pool_m x = 2\.3 is outside the pool \(allowed: -2\.25 to 2\.25"),
        ({"pool_m": [0.0, -1.8, 0.0]}, r"'point 1': pool_m y = -1\.8 is outside the pool \(allowed: -1\.75 to 1\.75"),
        ({"pool_m": [0.0, 0.0, 1.2]}, r"pool_m z = 1\.2 is outside the pool \(allowed: -1\.5 to 1; z is positive under water"),
        ({"pixel_px": None}, "points.1: needs either pixel_px or marker_id"),
        ({"marker_id": 4}, "points.1: needs either pixel_px or marker_id"),
        (
            {"pixel_px": None, "marker_id": 50},
            r"points: 'point 1': marker_id = 50: 4x4_50 has no such marker \(allowed: 0 to 49\)",
        ),
        ({"name": "point 0"}, "points: name = 'point 0' is used twice"),
        ({"pool_m": list(RIM[0])}, r"points: pool_m = \(-1\.6, -1\.2, -0\.1\) is used twice"),
        ({"pixel_px": [0.0, 50.0]}, r"points: pixel_px = \(0\.0, 50\.0\) is used twice"),
        (
            {"pixels": [1.0, 2.0]},
            r"points\.1\.pixels: unknown key; did you mean pixel_px\? \(allowed here: marker_id, name, pixel_px, pool_m\)",
        ),
    ],
)
def test_a_points_file_that_cannot_be_used(change: dict[str, object], complaint: str) -> None:
    entries = _entries(RIM)
    entries[1] = {key: value for key, value in (entries[1] | change).items() if value is not None}
    with pytest.raises(ConfigError, match=rf"^points\.toml: .*{complaint}" if "^" not in complaint else complaint):
        _file(entries)


def test_a_points_marker_may_be_any_of_its_family() -> None:
    """As `localizer print-markers` draws them."""
    entries = _entries(RIM)
    del entries[1]["pixel_px"]
    assert _file([entries[0], entries[1] | {"marker_id": 586}, *entries[2:]], marker_family="apriltag_36h11").points
    with pytest.raises(ConfigError, match=r"marker_id = 587: apriltag_36h11 has no such marker \(allowed: 0 to 586\)"):
        _file([entries[0], entries[1] | {"marker_id": 587}, *entries[2:]], marker_family="apriltag_36h11")


def test_four_points_at_least() -> None:
    assert len(_file(_entries(RIM[:4])).points) == 4
    with pytest.raises(ConfigError, match=r"points\.toml: .*points: 3 given, at least 4 are needed"):
        _file(_entries(RIM[:3]))


def test_points_on_one_line_or_in_one_place_tell_no_pose() -> None:
    with pytest.raises(ConfigError, match="points: they lie on one line"):
        _file(_entries([(x, 0.2 * x, 0.0) for x in (-1.0, -0.3, 0.4, 1.2)]))
    near = np.array([[604.1, 406.4], [607.9, 407.5], [606.1, 400.3], [606.9, 408.2], [608.2, 406.2], [605.0, 403.4]])
    with pytest.raises(ConfigError, match="points: their pixels lie too near to one another"):
        fit_pose(POOL, _points(RIM), near)
    line = np.array([[100.0 * i, 80.0 * i] for i in range(6)])
    with pytest.raises(ConfigError, match="points: their pixels lie on one line"):
        fit_pose(POOL, _points(RIM), line)


@pytest.mark.parametrize("pixel", [(-0.6, 3.0), (1279.6, 3.0), (3.0, 960.0)])
def test_pixels_outside_the_picture(pixel: tuple[float, float]) -> None:
    truth = _hung(0)
    pixels = project(truth, np.array(RIM))
    pixels[2] = pixel
    with pytest.raises(ConfigError, match=r"'point 2': pixel_px = .* is outside the picture \(allowed: 0 to 1279, 0 to 959\)"):
        fit_pose(truth, _points(RIM), pixels)


def test_a_mirrored_pool_is_refused() -> None:
    """y counted upwards in the picture, as on paper: no camera above the water sees that."""
    truth, places = _hung(0), RIM + FLOOR
    pixels = project(truth, np.array(places))
    for flip in ((1.0, -1.0, 1.0), (-1.0, 1.0, 1.0)):
        with pytest.raises(ConfigError, match=r"points: no .*camera"):
            fit_pose(truth, _points([tuple((np.array(place) * flip).tolist()) for place in places]), pixels)


@pytest.mark.parametrize("places", [[(x, y, 0.0) for x, y, _ in RIM], RIM, RIM + FLOOR])
def test_a_mirrored_picture_of_a_camera_on_the_plumb_line_is_refused(places: list[tuple[float, float, float]]) -> None:
    """To the pixel it is explained by a camera that looks up, away from the pool."""
    plain = {"focal_px": (790.0, 790.0), "centre_px": (639.5, 479.5), "distortion": (0.0,) * 5}
    truth = POOL.model_copy(update=plain | {"rotation_rad": (0.0, 0.0, 0.0), "position_m": (0.0, 0.0, -2.8)})
    pixels = project(truth, np.array(places))
    assert fit_pose(truth, _points(places), pixels).rms_px < 0.1
    pixels[:, 1] = truth.size_px[1] - 1.0 - pixels[:, 1]
    with pytest.raises(ConfigError, match=r"points: no .*camera"):
        fit_pose(truth, _points(places), pixels)


def test_swapped_points_are_refused() -> None:
    truth, places = _hung(0), RIM + FLOOR
    pixels = project(truth, np.array(places))[[1, 0, *range(2, len(places))]]
    with pytest.raises(ConfigError, match=r"no pose of the camera explains them.*worst 'point [01]'"):
        fit_pose(truth, _points(places), pixels)


# --- points that carry markers


def _marked(number: int, place: tuple[float, float, float]) -> SurveyPoint:
    return SurveyPoint(name=f"marker {number}", pool_m=place, marker_id=number)


@pytest.mark.long
def test_markers_are_found_where_they_are() -> None:
    """On the rim and through the water, some turned by the camera: centres to half a pixel."""
    camera = _hung(1).model_copy(update={"size_px": (640, 480), "focal_px": (400.0, 401.0), "centre_px": (321.0, 236.0)})
    rim = {
        i: place[:2] for i, place in enumerate([(-1.5, -1.1, -0.1), (1.5, -1.0, -0.1), (1.4, 1.1, -0.1), (-1.4, 1.05, -0.1)])
    }
    floor = {i + 10: place[:2] for i, place in enumerate(itertools.product((-0.9, 0.8), (-0.6, 0.7)))}
    picture = CameraBench(camera).pool([(1.0, marks(floor, 0.3)), (-0.1, marks(rim, 0.25))])
    points = [_marked(i, (*place, -0.1)) for i, place in rim.items()] + [
        _marked(i, (*place, 1.0)) for i, place in floor.items()
    ]
    pixels = seen_pixels(points, picture)
    truth = project(camera, np.array([point.pool_m for point in points]))
    assert np.linalg.norm(pixels - truth, axis=1).max() < 0.5
    assert _places_off_m(fit_pose(camera, points, pixels), camera, truth).max() < 0.002
    twice = CameraBench(camera).pool(
        [(-0.1, marks({3: (-1.0, 0.0), 4: (0.0, 0.0)}, 0.25)), (-0.2, marks({3: (1.0, 0.0)}, 0.25))]
    )
    with pytest.raises(ConfigError, match=r"'marker 3': marker_id = 3: 2 markers of that id .*found in it: 3, 4"):
        seen_pixels([_marked(3, (0.0, 0.0, 0.0))], twice)
    with pytest.raises(ConfigError, match=r"'marker 7': marker_id = 7: 0 markers of that id .*found in it: 3, 4"):
        seen_pixels([_marked(7, (0.0, 0.0, 0.0))], twice)
    with pytest.raises(ConfigError, match=r"'marker 7': marker_id = 7: there is no picture"):
        seen_pixels([_marked(7, (0.0, 0.0, 0.0))], None)
