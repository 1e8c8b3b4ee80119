"""The correlation filter against ridge regression written out in full, brute-force search, and known shifts and turns."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy import ndimage

from localizer.detection.correlation_filter import CorrelationFilter, FilterShape

FIRST = np.zeros(1, dtype=np.intp)
ANEW = np.ones(1, dtype=np.float32)
SIZE = 48
Real = NDArray[np.float32]


def _texture(seed: int, channels: int = 3, size: int = 200) -> Real:
    random = np.random.default_rng(seed)
    smooth = ndimage.gaussian_filter(random.normal(size=(channels, size, size)), (0, 2.0, 2.0), mode="wrap")
    return (128.0 + 300.0 * smooth).astype(np.float32)


def _patch(texture: Real, right: float, down: float, size: int = SIZE) -> Real:
    """The texture's middle after it has moved right and down; interpolated by splines, unlike anything in the package."""
    grid = np.arange(size) - size // 2 + texture.shape[1] // 2
    rows, columns = np.meshgrid(grid - down, grid - right, indexing="ij")
    return np.stack([ndimage.map_coordinates(c, [rows, columns], order=3, mode="wrap") for c in texture]).astype(np.float32)[
        None
    ]


def test_colours_may_lie_pixel_by_pixel() -> None:
    """As OpenCV has them, seen through moveaxis: the same numbers in another order of memory."""
    texture = _texture(5)
    still, moved = _patch(texture, 0, 0), _patch(texture, 3.25, -2.5)
    matches = []
    for first, then in ((still, moved), (_pixel_by_pixel(still), _pixel_by_pixel(moved))):
        correlation = CorrelationFilter(1, FilterShape(SIZE, SIZE, 3, 2.5, 1.0, windowed=True))
        correlation.learn(FIRST, first, ANEW)
        matches.append(correlation.detect(FIRST, then))
    assert matches[0][0] == pytest.approx(matches[1][0], abs=1e-4) and matches[0][1] == pytest.approx(matches[1][1], abs=1e-4)
    assert matches[0][0][0] == pytest.approx([3.25, -2.5], abs=0.3)


def _pixel_by_pixel(patch: Real) -> Real:
    return np.moveaxis(np.ascontiguousarray(np.moveaxis(patch, 1, -1)), -1, 1)


def _window_pull(shift: float) -> float:
    return 0.08 * abs(shift) + 0.02  # the cosine window holds a pattern back; measured 4.5 % on average


@pytest.mark.parametrize("windowed", [False, True])
def test_equals_ridge_regression_written_out(windowed: bool) -> None:
    """Equations 17 and 22 are shortcuts for a dense kernel regression over all circular shifts: here it is, dense."""
    size, shape = 8, FilterShape(8, 8, 2, 1.0, 0.7, windowed)
    texture, other = _texture(3, 2, 8), _texture(4, 2, 8)
    correlation = CorrelationFilter(1, shape)
    learnt, looked = _features(texture, windowed), _features(other, windowed)
    shifts = [(r, c) for r in range(size) for c in range(size)]

    def kernel(a: NDArray[np.float64], b: NDArray[np.float64]) -> float:
        return float(np.exp(-np.sum((a - b) ** 2) / (shape.kernel_width**2 * a.size)))

    samples = [np.roll(learnt, s, axis=(1, 2)) for s in shifts]
    gram = np.array([[kernel(a, b) for b in samples] for a in samples])
    wrapped = [(min(r, size - r), min(c, size - c)) for r, c in shifts]
    wanted = np.array([np.exp(-0.5 * (r * r + c * c) / shape.target_width**2) for r, c in wrapped])
    dual = np.linalg.solve(gram + shape.regularisation * np.eye(len(shifts)), wanted)
    expected = [
        sum(d * kernel(np.roll(looked, (-r, -c), axis=(1, 2)), s) for d, s in zip(dual, samples, strict=True))
        for r, c in shifts
    ]

    correlation.learn(FIRST, texture[None], ANEW)
    _, peak = correlation.detect(FIRST, other[None])
    assert peak[0] == pytest.approx(max(expected), abs=2e-3)
    _, own = correlation.detect(FIRST, texture[None])
    assert own[0] == pytest.approx(float(gram[0] @ dual), abs=2e-3)


def _features(patch: Real, windowed: bool) -> NDArray[np.float64]:
    centred = patch.astype(np.float64) - patch.mean(axis=(1, 2), keepdims=True)
    wave = 0.5 - 0.5 * np.cos(2.0 * np.pi * np.arange(patch.shape[1]) / patch.shape[1])
    return np.asarray(centred / np.sqrt(np.mean(centred**2)) * (np.outer(wave, wave) if windowed else 1.0))


@pytest.mark.long
@given(right=st.integers(-8, 8), down=st.integers(-8, 8), seed=st.integers(0, 50))
def test_finds_what_exhaustive_search_finds(right: int, down: int, seed: int) -> None:
    texture = _texture(seed)
    correlation = CorrelationFilter(1, FilterShape(SIZE, SIZE, 3, 2.5, 1.0, windowed=True))
    correlation.learn(FIRST, _patch(texture, 0, 0), ANEW)
    moved = _patch(texture, right, down)
    middle = _patch(texture, 0, 0)[0, :, 16:32, 16:32]
    places = [(r, c) for r in range(-10, 11) for c in range(-10, 11)]
    differences = [np.sum((moved[0, :, 16 + r : 32 + r, 16 + c : 32 + c] - middle) ** 2) for r, c in places]
    best_down, best_right = places[int(np.argmin(differences))]
    shift, _ = correlation.detect(FIRST, moved)
    assert abs(shift[0, 0] - best_right) < 0.5 + _window_pull(right)
    assert abs(shift[0, 1] - best_down) < 0.5 + _window_pull(down)


@pytest.mark.long
@given(right=st.floats(-3, 3), down=st.floats(-3, 3), seed=st.integers(0, 50))
def test_sub_sample_shifts(right: float, down: float, seed: int) -> None:
    texture = _texture(seed)
    correlation = CorrelationFilter(1, FilterShape(SIZE, SIZE, 3, 2.5, 1.0, windowed=True))
    correlation.learn(FIRST, _patch(texture, 0, 0), ANEW)
    shift, peak = correlation.detect(FIRST, _patch(texture, right, down))
    assert shift[0, 0] == pytest.approx(right, abs=_window_pull(max(abs(right), abs(down))))
    assert shift[0, 1] == pytest.approx(down, abs=_window_pull(max(abs(right), abs(down))))
    assert 0.5 < peak[0] < 1.05


@given(turn=st.floats(-63.9, 63.9), seed=st.integers(0, 50))
def test_rings_measure_any_turn(turn: float, seed: int) -> None:
    """On a circle there are no edges and no window: every turn is found, also across the seam, to a twentieth of a sample."""
    waves = np.random.default_rng(seed).normal(size=(30, 12, 2))
    angle = 2.0 * np.pi * (np.arange(128)) / 128

    def rings(by: float) -> Real:
        turned = angle - 2.0 * np.pi * by / 128
        parts = [waves[:, k, :1] * np.cos(k * turned) + waves[:, k, 1:] * np.sin(k * turned) for k in range(12)]
        return np.asarray(128.0 + 10.0 * np.sum(parts, axis=0), dtype=np.float32)[None, :, None, :]

    correlation = CorrelationFilter(1, FilterShape(1, 128, 30, 2.5, 2.0, windowed=False))
    correlation.learn(FIRST, rings(0.0), ANEW)
    shift, peak = correlation.detect(FIRST, rings(turn))
    assert (shift[0, 0] - turn + 64.0) % 128.0 - 64.0 == pytest.approx(0.0, abs=0.05)
    assert shift[0, 1] == 0.0 and -64.0 <= shift[0, 0] < 64.0
    assert peak[0] > 0.95


def test_another_pattern_scores_low_and_light_does_not_matter() -> None:
    texture = _texture(1)
    correlation = CorrelationFilter(1, FilterShape(SIZE, SIZE, 3, 2.5, 1.0, windowed=True))
    patch = _patch(texture, 0, 0)
    correlation.learn(FIRST, patch, ANEW)
    assert correlation.detect(FIRST, _patch(_texture(2), 0, 0))[1][0] < 0.2
    shift, peak = correlation.detect(FIRST, 0.5 * patch + 20.0)
    assert peak[0] == pytest.approx(1.0, abs=0.01) and np.abs(shift).max() < 0.01
    assert correlation.detect(FIRST, np.full_like(patch, 90.0))[1][0] < 0.2


def test_robots_of_a_batch_do_not_mix() -> None:
    shape = FilterShape(SIZE, SIZE, 3, 2.5, 1.0, windowed=True)
    textures = [_texture(seed) for seed in (1, 2, 3)]
    batch = CorrelationFilter(3, shape)
    order = np.array([2, 0, 1])
    batch.learn(order, np.concatenate([_patch(textures[i], 0, 0) for i in order]), np.ones(3, np.float32))
    some = np.array([1, 2])
    shifts, peaks = batch.detect(some, np.concatenate([_patch(textures[1], 1, 0), _patch(textures[2], 0, -2)]))
    for row, (robot, right, down) in enumerate(((1, 1, 0), (2, 0, -2))):
        alone = CorrelationFilter(1, shape)
        alone.learn(FIRST, _patch(textures[robot], 0, 0), ANEW)
        shift, peak = alone.detect(FIRST, _patch(textures[robot], right, down))
        assert shifts[row] == pytest.approx(shift[0], abs=1e-4) and peaks[row] == pytest.approx(peak[0], abs=1e-4)


def test_learning_follows_a_change_at_its_rate() -> None:
    correlation = CorrelationFilter(1, FilterShape(SIZE, SIZE, 3, 2.5, 1.0, windowed=True))
    old, new = _patch(_texture(1), 0, 0), _patch(_texture(2), 0, 0)
    correlation.learn(FIRST, old, ANEW)
    peaks = []
    for _ in range(40):
        correlation.learn(FIRST, new, np.full(1, 0.1, np.float32))
        peaks.append(correlation.detect(FIRST, new)[1][0])
    assert peaks[0] < 0.3 and peaks[-1] > 0.9
    assert correlation.detect(FIRST, old)[1][0] < 0.3
