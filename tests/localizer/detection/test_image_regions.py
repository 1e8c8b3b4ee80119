"""Regions, patches and rings: Bayer phase, half-pixel places, and the hull's relief."""

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from localizer.camera_model import RefractiveCamera
from localizer.detection.image_regions import BAYER_TO_BGR, BodyProjection, BodySampler, RobotShape, cut, whole
from shoal.config.experiment import load_experiment
from shoal.frames import Array, body_to_pool
from tests.localizer.scene import bayer

FLAT = RobotShape(0.15, 0.0, 1.0)
EXPERIMENT = load_experiment("pool")


def _ramp() -> Array:
    """A BGR picture that says where it is: blue grows to the right, green downwards, red both."""
    v, u = np.mgrid[0:200, 0:240].astype(float)
    return np.stack([u, v, (u + v) / 2], axis=-1)


@given(x=st.floats(-50, 300), y=st.floats(-50, 250), half=st.floats(1, 120))
def test_regions_start_on_a_red_pixel_inside_the_picture(x: float, y: float, half: float) -> None:
    frame = bayer(_ramp().astype(np.uint8))
    region = cut(frame, np.array([x, y]), half)
    if region is None:
        visible = min(x + half, 239) - max(x - half, 0), min(y + half, 199) - max(y - half, 0)
        assert min(visible) < 20
        return
    height, width = region.bayer.shape
    assert region.left_px % 2 == region.top_px % 2 == height % 2 == width % 2 == 0
    assert 0 <= region.left_px <= max(x - half, 0) and 0 <= region.top_px <= max(y - half, 0)
    assert region.left_px + width >= min(x + half, 240) and region.top_px + height >= min(y + half, 200)
    assert np.array_equal(region.bayer, frame[region.top_px :, region.left_px :][:height, :width])


SCALES = pytest.mark.parametrize("shrink", [1, 2])


@SCALES
def test_colours_are_right(shrink: int) -> None:
    plain = np.zeros((32, 32, 3), np.uint8)
    plain[...] = (10, 90, 200)
    region = whole(bayer(plain))
    colour = region.demosaiced(shrink).bgr
    assert colour.shape == (32 // shrink, 32 // shrink, 3)
    assert np.all(colour == (10, 90, 200))
    assert region.grey()[8, 8] == pytest.approx(0.114 * 10 + 0.587 * 90 + 0.299 * 200, abs=1.5)


@SCALES
@given(x=st.floats(35, 45), y=st.floats(35, 45), yaw=st.floats(-3.2, 3.2))
def test_samples_lie_where_the_body_frame_says(shrink: int, x: float, y: float, yaw: float) -> None:
    """In a picture whose colours are coordinates, three levels a pixel, each sample's colour says where it was taken: a
    slip of half a pixel by the Bayer pattern, the half scale or the cut would show. 8-bit rounding is a fifth of a pixel."""
    frame = bayer(np.rint(3.0 * _ramp()[:80, :80]).astype(np.uint8))
    region = cut(frame, np.array([x, y]), 30.0)
    assert region is not None
    turn = 100.0 * np.array([[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]])
    body = BodyProjection(np.array([x, y]), np.column_stack([turn, np.zeros(2)]), np.array([0.0, 0.0, -1.0]))
    sampler = BodySampler(24, 0.008, 0.12, FLAT)
    colours = sampler.patch(region.demosaiced(shrink), body)[:2] / 3.0
    offsets = (np.arange(24) - 12) * 0.008
    ahead, starboard = np.meshgrid(offsets, offsets)
    expected = np.moveaxis(np.array([x, y]) + 100.0 * body_to_pool(np.stack([ahead, starboard], axis=-1), yaw), -1, 0)
    assert np.abs(np.mean(colours - expected, axis=(1, 2))).max() < 0.25
    assert np.abs(colours - expected).max() < 0.7
    rings = sampler.rings(region.demosaiced(shrink), body).reshape(3, 10, 128)[:2] / 3.0
    assert rings[:, -1, 0] == pytest.approx([x + 12 * np.cos(yaw), y + 12 * np.sin(yaw)], abs=0.5)
    assert rings[:, -1, 32] == pytest.approx([x - 12 * np.sin(yaw), y + 12 * np.cos(yaw)], abs=0.5)


def test_relief_puts_the_rim_where_the_camera_sees_it() -> None:
    """Points on the sphere, projected exactly, against the linear placement: to 2 px of the 17 px by which they slide."""
    view, hull = RefractiveCamera(EXPERIMENT.camera), RobotShape(0.15, 0.15, 0.0)
    x, y, z = 1.2, -0.7, 0.3
    tangent = view.linearize([np.array([x, y])], [z - 0.15])[0]
    turn = np.linspace(0, 2 * np.pi, 12, endpoint=False)
    points = 0.12 * np.stack([np.cos(turn), np.sin(turn)])
    drop = hull.drop_m(points)
    assert drop == pytest.approx(0.15 - 0.09)
    linear = tangent.pixel + (tangent.pool_to_px @ points + tangent.down_px[:, None] * drop).T
    exact = view.pool_to_pixel(np.column_stack([x + points[0], y + points[1], z - 0.15 + drop]))
    flat = tangent.pixel + (tangent.pool_to_px @ points).T
    assert np.linalg.norm(np.mean(exact - linear, axis=0)) < 0.3
    assert np.linalg.norm(np.mean(exact - flat, axis=0)) > 5.0


def test_the_plate_is_flat_and_the_sphere_ends_at_its_rim() -> None:
    hull = RobotShape(0.15, 0.15, 0.05)
    assert np.all(hull.drop_m(np.array([[0.0, 0.05, -0.04], [0.0, 0.05, 0.04]])) == 0.0)
    assert hull.drop_m(np.array([[0.0, 0.2], [0.1, 0.2]])) == pytest.approx([0.15 - np.sqrt(0.15**2 - 0.1**2), 0.15])


def test_half_scale_is_the_mean_of_its_four_pixels() -> None:
    random = np.random.default_rng(1)
    smooth = cv2.GaussianBlur(random.uniform(0, 255, (64, 64, 3)), (0, 0), 3.0).astype(np.uint8)
    half = whole(bayer(smooth)).demosaiced(2).bgr.astype(float)
    means = smooth.astype(float).reshape(32, 2, 32, 2, 3).mean(axis=(1, 3))
    assert np.abs(half - means)[2:-2, 2:-2].mean() < 1.0


def test_fine_detail_has_no_false_colour() -> None:
    """Grey stripes two pixels wide, at any phase: bilinear demosaicing paints them in colours that change with the phase."""
    column = np.arange(64)
    for phase in (0.0, 0.7, 1.9):
        stripes = np.rint(128 + 60 * np.sin(np.pi / 2 * (column + phase))).astype(np.uint8)
        region = whole(bayer(np.repeat(np.tile(stripes, (64, 1))[..., None], 3, axis=2)))
        plain = np.asarray(cv2.cvtColor(region.bayer, BAYER_TO_BGR), dtype=float)
        fine = region.demosaiced(1).bgr.astype(float)
        chroma = [np.ptp(picture[8:-8, 8:-8], axis=2).mean() for picture in (plain, fine)]
        assert chroma[1] < 0.35 * chroma[0]


@pytest.mark.parametrize(
    ("centre_px", "half_px"), [((np.nan, 50.0), 20.0), ((50.0, np.inf), 20.0), ((50.0, 50.0), np.nan), ((-1e9, 50.0), 20.0)]
)
def test_a_place_that_is_nowhere_has_no_region(centre_px: tuple[float, float], half_px: float) -> None:
    assert cut(np.zeros((96, 128), np.uint8), np.array(centre_px), half_px) is None
