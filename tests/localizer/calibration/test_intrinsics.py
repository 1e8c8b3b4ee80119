"""Lens from board views: against the lens that drew them, through the simulator's own optics."""

import cv2
import numpy as np
import pytest

from localizer.calibration.intrinsics import (
    CELLS,
    FEWEST_VIEWS,
    IntrinsicsFit,
    fit_intrinsics,
    intrinsics_faults,
    intrinsics_warnings,
)
from localizer.calibration.targets import TargetView, parse_target
from localizer.camera_model import Intrinsics, fold_px
from shoal.config.experiment import load_experiment
from shoal.errors import ConfigError
from shoal.frames import Array
from tests.localizer.board_scene import CameraBench, charuco, chessboard

pytestmark = pytest.mark.long

POOL = load_experiment("pool").camera
WIDE = POOL.model_copy(
    update={
        "focal_px": (1010.0, 1006.0),
        "centre_px": (630.2, 488.7),
        "distortion": (-0.21, 0.06, 0.001, -0.0005, 0.0),
    }
)
SMALL = WIDE.model_copy(
    update={
        "size_px": (480, 360),
        "focal_px": (390.0, 388.5),
        "centre_px": (236.3, 184.8),
        "distortion": (-0.12, 0.03, 6e-4, -4e-4, 0.0),
    }
)
BENCH, SMALL_BENCH = CameraBench(WIDE), CameraBench(SMALL)
BOARD_M = chessboard(9, 6, 0.03)[2]


def _miss(lens: Intrinsics, truth: Intrinsics) -> Array:
    """Error of fx, fy, cx, cy in px."""
    estimate, true = (np.array([*one.focal_px, *one.centre_px]) for one in (lens, truth))
    return np.asarray(estimate - true, dtype=np.float64)


def _assert_near(fit: IntrinsicsFit, truth: Intrinsics, focal: float = 0.003, centre_px: float = 1.5) -> None:
    miss = _miss(fit.lens, truth)
    assert np.abs(miss[:2] / truth.focal_px).max() < focal
    assert np.abs(miss[2:]).max() < centre_px


def _bending_px(lens: Intrinsics) -> Array:
    """Shift by distortion of points from the middle to four fifths of the way to the right side, (n,) px."""
    rays = np.linspace(0.0, 0.8, 9)[:, None] * np.array([[lens.size_px[0] / 2.0 / lens.focal_px[0], 0.0]])
    ahead = np.column_stack([rays, np.ones(len(rays))])
    both = (np.array(lens.distortion), np.zeros(5))
    bent, straight = (cv2.projectPoints(ahead, np.zeros(3), np.zeros(3), lens.matrix, k)[0][:, 0, 0] for k in both)
    return np.asarray(bent - straight, dtype=np.float64)


# --- from pictures


def test_lens_from_pictures_of_a_chessboard() -> None:
    texture, corner_m, board_m = chessboard(7, 5, 0.04)
    board, views = parse_target("chessboard:7x5:0.04"), []
    for i, (turn, move) in enumerate(SMALL_BENCH.poses(9, board_m, seed=3)):
        view = board.find(SMALL_BENCH.picture(texture, corner_m, turn, move), f"picture {i}")
        if view is None:
            continue
        truth = SMALL_BENCH.see(board_m @ turn.T + move)
        off = min(
            np.abs(view.pixels - truth).max(), np.abs(view.pixels - truth[::-1]).max()
        )  # a board may be read from its end
        assert off < 0.2
        views.append(view)
    assert len(views) >= 7
    fit = fit_intrinsics(views, SMALL.size_px)
    _assert_near(fit, Intrinsics.of(SMALL))
    assert fit.rms_px < 0.1
    assert np.abs(_bending_px(fit.lens) - _bending_px(Intrinsics.of(SMALL))).max() < 0.2
    assert not fit.rejected


def test_lens_from_boards_that_reach_out_of_the_picture() -> None:
    """A ChArUco board may be partly hidden: each corner is known by its number, so the picture's edges hold corners too."""
    board_m = np.array([[x, y, 0.0] for x in (0.0, 0.28) for y in (0.0, 0.2)])
    texture, board = charuco((7, 5), 0.04, 0.03), parse_target("charuco:7x5:0.04:0.03:DICT_4X4_50")
    views = []
    for i, (turn, move) in enumerate(SMALL_BENCH.poses(12, board_m, seed=5, margin_px=-60.0)):
        view = board.find(SMALL_BENCH.picture(texture, np.zeros(2), turn, move), f"picture {i}")
        assert view is not None
        off = view.pixels - SMALL_BENCH.see(view.board_m @ turn.T + move)
        assert np.abs(off).max() < 0.6 and np.std(off) < 0.12
        views.append(view)
    assert min(len(view.pixels) for view in views) < 20
    fit = fit_intrinsics(views, SMALL.size_px)
    _assert_near(fit, Intrinsics.of(SMALL))
    assert np.abs(_bending_px(fit.lens) - _bending_px(Intrinsics.of(SMALL))).max() < 0.2


@pytest.mark.parametrize(
    "text", ["chessboard:9x6:0.03", "charuco:7x5:0.04:0.03:DICT_4X4_50", "charuco:7x6:0.04:0.03:DICT_4X4_50:legacy"]
)
def test_no_board_is_found_where_there_is_none(text: str) -> None:
    board = parse_target(text)
    for grey in (np.full((240, 320), 90, np.uint8), np.random.default_rng(1).integers(0, 256, (240, 320)).astype(np.uint8)):
        assert board.find(grey, "nothing") is None


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        ("chess:9x6:0.03", "--board chess:9x6:0.03: not a board .allowed: chessboard:9x6:0.03"),
        ("chessboard:9x6", "not a board"),
        ("charuco:7x5:0.04:0.03:DICT_4X4_50:old", "not a board"),
        ("chessboard:9:0.03", "'9' must be COLUMNSxROWS, each 3 to 50"),
        ("chessboard:9x2:0.03", "'9x2' must be COLUMNSxROWS"),
        ("chessboard:9x-6:0.03", "'9x-6' must be COLUMNSxROWS"),
        ("chessboard:9x6:30", "'30' must be a side in metres .allowed: 0.001 to 2"),
        ("chessboard:9x6:3cm", "'3cm' must be a side in metres"),
        ("chessboard:9x6:nan", "'nan' must be a side in metres"),
        ("charuco:7x5:0.03:0.04:DICT_4X4_50", "marker 0.04 m must be smaller than its square 0.03 m"),
        ("charuco:7x5:0.04:0.03:DICT_4X4", "'DICT_4X4' is no dictionary .allowed: .*DICT_4X4_50"),
        ("charuco:12x10:0.04:0.03:DICT_4X4_50", "12x10 squares hold 60 markers, DICT_4X4_50 has only 50"),
    ],
)
def test_a_board_that_cannot_be_is_refused(text: str, complaint: str) -> None:
    with pytest.raises(ConfigError, match=complaint):
        parse_target(text)


# --- from corners


def test_exact_corners_give_the_exact_lens() -> None:
    fit = fit_intrinsics(BENCH.views(10, BOARD_M, seed=1, noise_px=0.0), WIDE.size_px)
    _assert_near(fit, Intrinsics.of(WIDE), focal=1e-5, centre_px=0.02)
    assert fit.lens.distortion == pytest.approx(WIDE.distortion, abs=1e-4)
    assert fit.rms_px < 1e-3


def test_deviations_are_honest() -> None:
    """The mean square of error over stated deviation is one: within the 98 % band for 4 x 12 of them, widened for ties."""
    scores = []
    for seed in range(12):
        fit = fit_intrinsics(BENCH.views(12, BOARD_M, seed, noise_px=0.3), WIDE.size_px)
        _assert_near(fit, Intrinsics.of(WIDE), focal=0.005, centre_px=6.0)
        scores.append((_miss(fit.lens, Intrinsics.of(WIDE)) / fit.deviations[:4]) ** 2)
        assert fit.rms_px == pytest.approx(0.3 * np.sqrt(2.0), rel=0.15)
    assert 0.5 < np.mean(scores) < 1.7


def test_more_views_make_a_better_lens() -> None:
    few, many = (fit_intrinsics(BENCH.views(count, BOARD_M, 4, noise_px=0.2), WIDE.size_px) for count in (6, 40))
    assert many.deviations[0] < 0.6 * few.deviations[0]
    _assert_near(many, Intrinsics.of(WIDE))


def _spoilt(view: TargetView, how: str) -> TargetView:
    random = np.random.default_rng(9)
    pixels = view.pixels.copy()
    if how == "blurred":
        pixels += 2.5 * random.normal(size=pixels.shape)
    elif how == "one corner misread":
        pixels[7] += [14.0, -9.0]
    else:  # the board was bent
        pixels[:, 0] += 6.0 * (view.board_m[:, 1] / 0.1) ** 2
    return TargetView(f"{view.name} {how}", view.board_m, pixels)


def test_bad_views_are_left_out_by_name() -> None:
    good = BENCH.views(12, BOARD_M, seed=6, noise_px=0.15)
    bad = [_spoilt(good[i], how) for i, how in ((2, "blurred"), (5, "one corner misread"), (9, "bent"))]
    fit = fit_intrinsics([*good[:4], *bad, *good[4:]], WIDE.size_px)
    assert {view.name for view, _ in fit.rejected} == {view.name for view in bad}
    assert all(rms > 0.5 for _, rms in fit.rejected)
    assert _miss(fit.lens, fit_intrinsics(good, WIDE.size_px).lens) == pytest.approx(np.zeros(4), abs=1e-3)
    assert [view.name for view in fit.views] == [view.name for view in good]


@pytest.mark.parametrize("noise_px", [0.02, 0.3, 1.0])
def test_equally_noisy_views_all_stay(noise_px: float) -> None:
    assert not fit_intrinsics(BENCH.views(14, BOARD_M, seed=7, noise_px=noise_px), WIDE.size_px).rejected


def test_when_most_views_are_bad_it_is_said_not_hidden() -> None:
    views = [_spoilt(view, "blurred") for view in BENCH.views(12, BOARD_M, seed=8, noise_px=0.1)]
    fit = fit_intrinsics(views, WIDE.size_px)
    assert len(fit.rejected) <= 4
    assert any("RMS of" in text for text in intrinsics_warnings(fit))


def test_k3_is_fitted_where_it_matters_only() -> None:
    fisher = CameraBench(WIDE.model_copy(update={"focal_px": (700.0, 700.0), "distortion": (-0.3, 0.12, 0.0, 0.0, -0.03)}))
    assert fit_intrinsics(fisher.views(20, BOARD_M, 3, noise_px=0.03), WIDE.size_px).lens.distortion[4] == pytest.approx(
        -0.03, abs=0.015
    )
    plain = [
        fit_intrinsics(BENCH.views(10, BOARD_M, seed, noise_px=0.2), WIDE.size_px).lens.distortion[4] for seed in range(6)
    ]
    assert plain.count(0.0) >= 5


def test_repeated_views_make_no_false_certainty() -> None:
    """A video shows the board again and again where it rests: five times the same noise is not five times the knowledge."""
    for seed in range(6):
        views = [view for view in BENCH.views(10, BOARD_M, seed, noise_px=0.2) for _ in range(5)]
        assert fit_intrinsics(views, WIDE.size_px).lens.distortion[4] == 0.0


@pytest.mark.parametrize("count", [0, 1, FEWEST_VIEWS - 1])
def test_too_few_views(count: int) -> None:
    views = BENCH.views(count, BOARD_M, seed=1, noise_px=0.1)
    with pytest.raises(
        ConfigError, match=rf"found in {count} pictures \({'view-0' if count else 'none'}.*at least {FEWEST_VIEWS}"
    ):
        fit_intrinsics(views, WIDE.size_px)


def test_the_same_view_again_and_again_makes_no_lens() -> None:
    """Copies of one picture, as a burst or a video of a board at rest has them, are one view."""
    flat = [TargetView(f"flat-{i}", BOARD_M, BENCH.see(BOARD_M + np.array([-0.12, -0.07, 0.4]))) for i in range(8)]
    noisy = [
        TargetView(v.name, v.board_m, v.pixels + 0.1 * np.random.default_rng(i).normal(size=(54, 2)))
        for i, v in enumerate(flat)
    ]
    with pytest.raises(ConfigError, match=r"found in 1 different pictures \(flat-0\), at least 5 are needed"):
        fit_intrinsics(noisy, WIDE.size_px)


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("tilt_deg", [0.0, 1.0, 3.0, 6.0])
def test_a_board_that_faces_the_camera_is_no_reason_to_be_sure(tilt_deg: float, seed: int) -> None:
    """Distance and focal length cannot be told apart then: whatever is found is within what it claims, and is refused."""
    truth, random = Intrinsics.of(WIDE), np.random.default_rng(seed)
    middle_m, views = BOARD_M.mean(axis=0), list[TargetView]()
    while len(views) < 20:
        turn = np.append(random.uniform(-1.0, 1.0, 2) * np.radians(tilt_deg), random.uniform(-3.0, 3.0))
        aim = (random.uniform(0.05, 0.95, 2) * truth.size_px - truth.centre_px) / truth.focal_px
        move = random.uniform(0.25, 0.6) * np.append(aim, 1.0) - cv2.Rodrigues(turn)[0] @ middle_m
        pixels = cv2.projectPoints(BOARD_M, turn, move, truth.matrix, np.array(truth.distortion))[0].reshape(-1, 2)
        inside = np.all((pixels > 2) & (pixels < np.array(truth.size_px) - 3), axis=1)
        if inside.sum() >= 12:
            noise = 0.05 * random.normal(size=(inside.sum(), 2))
            views.append(TargetView(str(len(views)), BOARD_M[inside], pixels[inside] + noise))
    fit = fit_intrinsics(views, truth.size_px)
    assert np.all(np.abs(_miss(fit.lens, truth)) < 4.0 * fit.deviations[:4])
    faults = " ".join(intrinsics_faults(fit))
    assert "only 0 views of a tilted board" in faults and ("is not known" in faults or tilt_deg > 3.0)


# --- what is said about it


def test_coverage_counts_every_corner_where_it_lies() -> None:
    fit = fit_intrinsics(BENCH.views(12, BOARD_M, seed=2, noise_px=0.1), WIDE.size_px)
    counts = fit.coverage
    assert counts.shape == CELLS[::-1]
    assert counts.sum() == 12 * 54
    column, row = (fit.corners_px[0] + 0.5) // [160, 160]
    mine = np.all((fit.corners_px + 0.5) // [160, 160] == [column, row], axis=1)
    assert counts[int(row), int(column)] == mine.sum()


def test_a_good_set_of_views_needs_no_warning_and_a_poor_one_gets_them() -> None:
    good = fit_intrinsics(BENCH.views(40, BOARD_M, seed=5, noise_px=0.1), WIDE.size_px)
    assert intrinsics_warnings(good) == []
    left = [view for view in BENCH.views(150, BOARD_M, seed=5, noise_px=0.1) if view.pixels[:, 0].max() < 640][:6]
    warnings = " ".join(intrinsics_warnings(fit_intrinsics(left, WIDE.size_px)))
    for what in ("only 6 views", "of the picture (wanted: 60%)", "towards a corner of the picture"):
        assert what in warnings


def test_a_lens_that_folds_over_is_noticed() -> None:
    """r (1 - 0.5 r^2) turns back at r = 0.82, which this wide picture reaches."""
    lens = Intrinsics.of(WIDE.model_copy(update={"focal_px": (600.0, 600.0), "distortion": (-0.5, 0.0, 0.0, 0.0, 0.0)}))
    assert fold_px(lens) > 10.0
    assert fold_px(Intrinsics.of(WIDE)) < 1e-6
    # folds over outside of the picture only, 450 px from its centre; a corner is 400 px from it
    beyond = Intrinsics(size_px=(640, 480), focal_px=(500.0, 500.0), centre_px=(319.5, 239.5), distortion=(-0.183, 0, 0, 0, 0))
    assert fold_px(beyond) < 0.01
