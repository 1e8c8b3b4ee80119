"""The calibration's report says what a person must know, and its picture shows errors where and as large as they are."""

from dataclasses import replace

import numpy as np

from localizer.calibration.extrinsics import PoseFit
from localizer.calibration.intrinsics import fit_intrinsics
from localizer.calibration.report import MAGNIFIED, intrinsics_lines, intrinsics_picture, pose_lines, pose_picture
from localizer.calibration.survey_points import SurveyPoint
from localizer.calibration.targets import TargetView
from shoal.config.experiment import load_experiment
from shoal.config.scene import PoolConfig
from tests.localizer.board_scene import CameraBench, chessboard

CAMERA = load_experiment("pool").camera
BENCH, BOARD_M = CameraBench(CAMERA), chessboard(9, 6, 0.03)[2]
POOL = PoolConfig(size_m=(3.5, 2.5, 1.0))


def _pose_fit(errors_px: list[tuple[float, float]], suspect: int | None = None) -> tuple[PoseFit, list[SurveyPoint]]:
    """Points in a row along y = 0.4 m, seen off their places."""
    places = [(-1.0 + 0.4 * i, 0.4, 0.3) for i in range(len(errors_px))]
    points = [SurveyPoint(name=f"mark {i}", pool_m=place, pixel_px=(0.0, 0.0)) for i, place in enumerate(places)]
    pixels = np.array([[200.0 + 150.0 * i, 300.0] for i in range(len(points))])
    return PoseFit(CAMERA, pixels, np.array(errors_px), 1e-6 * np.eye(6), suspect), points


def test_every_view_is_accounted_for() -> None:
    views = BENCH.views(8, BOARD_M, seed=2, noise_px=0.1)
    bad = TargetView("shaken", BOARD_M, views[3].pixels + 4.0 * np.random.default_rng(1).normal(size=(54, 2)))
    fit = fit_intrinsics([*views, bad], CAMERA.size_px)
    lines = intrinsics_lines(fit, {"dark.png": "no board found", "7 more views": "evenly taken out, not needed"})
    assert next(line for line in lines if "shaken" in line).endswith("left out: bad")
    assert next(line for line in lines if "dark.png" in line).endswith("left out: no board found")
    assert all(any(view.name in line for line in lines) for view in views)
    assert any("7 more views" in line for line in lines)
    assert any("WARNING: only 8 views" in line for line in lines)
    corners = next(line for line in lines if "all that were kept" in line)
    assert corners.split()[-2:] == [str(8 * 54), f"{fit_intrinsics(views, CAMERA.size_px).rms_px:.3f}"]


def test_the_map_is_empty_where_no_corner_fell() -> None:
    fit = fit_intrinsics(BENCH.views(6, BOARD_M, seed=3, noise_px=0.1), CAMERA.size_px)
    rows = [line.split() for line in intrinsics_lines(fit, {}) if len(line.split()) == 8 and set(line) <= set(" ·-+*#")]
    assert np.array_equal(np.array(rows) == "·", fit.coverage == 0)


def test_a_point_that_does_not_fit_is_named() -> None:
    fit, points = _pose_fit([(0.1, 0.0)] * 6 + [(6.0, -2.0)], suspect=6)
    lines = pose_lines(fit, points, POOL)
    assert any("WARNING: point 'mark 6' does not fit" in line for line in lines)
    assert any(line.split()[:5] == ["mark", "6", "1.400", "0.400", "0.300"] and "6.32" in line for line in lines)
    good, points = _pose_fit([(0.1, 0.0)] * 7)
    assert not any("WARNING" in line for line in pose_lines(good, points, POOL))


def test_points_that_prove_little_are_said_to() -> None:
    fit, points = _pose_fit([(3.0, 0.0)] * 4)
    dry = [point.model_copy(update={"pool_m": (*point.pool_m[:2], -0.1)}) for point in points]
    lines = "\n".join(pose_lines(fit, dry, POOL))
    for words in ("only 4 points", "a wrong one cannot be told", "RMS of 3.0 px is poor", "no point lies under water"):
        assert words in lines


def test_arrows_are_the_errors_magnified() -> None:
    """Red from the corner seen to MAGNIFIED times its error away, and nothing beyond."""
    fit = fit_intrinsics(BENCH.views(6, BOARD_M, seed=3, noise_px=0.1), CAMERA.size_px)
    lone = replace(fit, views=fit.views[:1], residuals_px=(np.tile([1.0, -0.5], (54, 1)),))
    picture = intrinsics_picture(np.zeros((960, 1280, 3), np.uint8), lone).astype(int)
    for share, there in ((0.5, True), (0.9, True), (1.3, False)):
        u, v = np.rint(lone.views[0].pixels[0] + share * MAGNIFIED * np.array([1.0, -0.5])).astype(int)
        blue, _, red = picture[v - 1 : v + 2, u - 1 : u + 2].reshape(-1, 3).max(axis=0)
        assert (red > 100 > blue) == there


def test_points_are_drawn_where_they_are_seen() -> None:
    fit, points = _pose_fit([(0.0, 0.0), (2.0, 0.0), (0.0, 0.0)])
    plain = np.zeros((960, 1280, 3), np.uint8)
    drawn = pose_picture(plain, fit, points, POOL)
    assert not plain.any()
    for u, v in fit.seen_px.astype(int):
        blue, green, red = drawn[v - 8, u].astype(int)  # the cross's upper arm
        assert green > 150 > max(blue, red)
    assert drawn[300, 350 + 30].astype(int)[2] > 150  # 40 px of arrow for 2 px of error
