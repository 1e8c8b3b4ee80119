"""Bubbles in the picture: where they are seen, that they rise, what they cover, and that nothing else changes."""

from functools import cache

import numpy as np
import pytest

from shoal.config.experiment import Experiment, load_experiment
from shoal.frames import Array
from sim_bridge.camera.bubbles import RISE_MPS, STREAM_HZ, Bubbles
from sim_bridge.camera.optics import project
from sim_bridge.camera.renderer import Renderer
from sim_bridge.plant.random_streams import Stream, generator

REST = np.zeros((2, 4))
ETA = np.array([[0.4, 0.1, 0.3, 0.2], [-0.5, 0.0, 0.3, 1.0]])


@cache
def experiment(*settings: str) -> Experiment:
    return load_experiment("pool", ("sim.picture.noise=0", *settings))


@cache
def renderer(*settings: str) -> Renderer:
    return Renderer(experiment(*settings), 1)


def added(streams: int, time_s: float, eta: Array = ETA) -> Array:
    """Grey levels (height, width) that bubbles add."""
    plain, bubbled = (renderer().render(eta, REST, time_s, 0, None, n).astype(np.float64) for n in (0, streams))
    return bubbled - plain


@pytest.mark.long
def test_off_by_default_and_a_setting_is_a_fault_from_the_start() -> None:
    assert experiment().sim.picture.bubbles == 0
    assert np.array_equal(
        renderer("sim.picture.bubbles=3").render(ETA, REST, 4.2, 0), renderer().render(ETA, REST, 4.2, 0, None, 3)
    )
    assert not added(0, 4.2).any()


@pytest.mark.long
def test_they_are_small_bright_specks_where_their_places_are_seen() -> None:
    """Light within 5 px of the projection of a bubble and nowhere else; robots cover those below them."""
    light, bubbles = added(6, 7.3), Bubbles(experiment().pool, _stream_random()).at(7.3, 6)
    assert light.min() >= 0.0 and light.max() > 40.0
    near = np.zeros(light.shape, bool)
    for column, row in project(experiment().camera, bubbles[:, :3]):
        near[max(int(row) - 5, 0) : int(row) + 6, max(int(column) - 5, 0) : int(column) + 6] = True
    assert not light[~near].any()
    assert 0.0 < np.mean(light > 10.0) < 0.01


@pytest.mark.long
def test_a_robot_covers_what_rises_below_it_and_not_what_rose_above() -> None:
    bubbles = Bubbles(experiment().pool, _stream_random()).at(7.3, 1)
    deep, high = bubbles[bubbles[:, 2] > 0.6], bubbles[bubbles[:, 2] < 0.1]
    for of, is_seen in ((deep, False), (high, True)):
        above = np.array([[*of[:, :2].mean(axis=0), 0.45, 0.0], [50.0, 0.0, 0.3, 0.0]])
        column, row = np.rint(project(experiment().camera, of[:1, :3])[0]).astype(int)
        patch = added(1, 7.3, above)[row - 4 : row + 5, column - 4 : column + 5]
        assert (patch.max() > 5.0) == is_seen


def test_each_rises_at_its_speed_and_is_gone_at_the_surface() -> None:
    streams = Bubbles(experiment().pool, np.random.default_rng(3))
    now, later = streams.at(100.0, 2), streams.at(100.0 + 1.0 / STREAM_HZ, 2)  # each has the age of the one before it
    assert len(now) == pytest.approx(2 * STREAM_HZ * experiment().pool.size_m[2] / RISE_MPS, abs=2)
    assert now[:, 2].min() >= 0.0 and now[:, 2].max() <= experiment().pool.size_m[2]
    for radius in now[now[:, 2] > 0.1][:20, 3]:
        (before,), (after,) = (rows[np.isclose(rows[:, 3], radius, atol=1e-12)] for rows in (now, later))
        assert before[2] - after[2] == pytest.approx(RISE_MPS / STREAM_HZ, abs=1e-9)
        assert np.linalg.norm(after[:2] - before[:2]) < 0.02


def _stream_random() -> np.random.Generator:
    return generator(1, Stream.CAMERA, 4)  # as the renderer's
