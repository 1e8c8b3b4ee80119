"""The coverage of a camera, against the simulator's own optics: OpenCV's lens, and Snell's law solved another way."""

import numpy as np
import pytest

from shoal.config.experiment import load_experiment
from shoal.messages.camera_coverage import outside_m, project
from sim_bridge.camera.optics import project as exact

CAMERA = load_experiment("pool").camera
TILTED = CAMERA.model_copy(update={"rotation_rad": (0.1, -0.15, 0.4), "position_m": (0.3, -0.2, -2.5)})
# its polynomial turns back at r = 0.98
WIDE = CAMERA.model_copy(update={"distortion": (-0.35, 0.0, 0.0, 0.0, 0.0), "focal_px": (600.0, 600.0)})


@pytest.mark.parametrize("camera", [CAMERA, TILTED, WIDE])
def test_places_are_seen_where_the_exact_optics_show_them(camera: object) -> None:
    places = np.random.default_rng(1).uniform((-1.2, -0.9, 0.0), (1.2, 0.9, 1.0), (200, 3))
    assert project(camera, places) == pytest.approx(exact(camera, places), abs=1e-6)  # type: ignore[arg-type]


@pytest.mark.parametrize("camera", [CAMERA, TILTED])
def test_a_disc_is_outside_by_as_far_as_it_has_to_be_moved_to_be_inside(camera: object) -> None:
    """Along a line from the middle: the exact optics say where a disc of 0.2 m first touches the picture's edge."""
    turn = np.linspace(0.0, 2.0 * np.pi, 8, endpoint=False)
    rim = 0.2 * np.column_stack([np.cos(turn), np.sin(turn), np.zeros(8)])
    size = np.array(CAMERA.size_px)
    middle = np.array([camera.position_m[0], camera.position_m[1], 0.3])  # type: ignore[attr-defined]
    for way in ([1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]):
        along = np.linspace(0.0, 3.0, 601)
        places = middle + along[:, None] * np.array(way)
        pixels = exact(camera, (places[:, None] + rim).reshape(-1, 3)).reshape(-1, 8, 2)  # type: ignore[arg-type]
        inside = np.all((pixels > -0.5) & (pixels < size - 0.5), axis=(1, 2))
        distances_m = outside_m([camera], places, 0.2)  # type: ignore[list-item]
        assert np.array_equal(distances_m <= 0.0, inside)
        edge = int(np.argmin(inside))
        assert inside[:edge].all() and not inside[edge:].any()
        assert distances_m[edge + 60] == pytest.approx(0.3, abs=0.06), "0.3 m farther on"


def test_places_behind_the_lens_or_folded_by_its_distortion_are_outside() -> None:
    """At an angle where the distortion's polynomial falls again it would put far places into the picture."""
    far = np.array([[0.0, 5.0, 0.3], [9.0, 0.0, 0.3], [30.0, 30.0, 0.3]])
    folded = project(WIDE, far)
    size = np.array(WIDE.size_px)
    assert np.any(np.all((folded > 0) & (folded < size), axis=1)), "the polynomial alone would show one of them"
    assert np.all(outside_m([WIDE], far, 0.2) > 1.0)
    over = CAMERA.model_copy(update={"rotation_rad": (2.5, 0.0, 0.0)})
    assert np.all(outside_m([over], np.array([[0.0, 0.0, 0.3]]), 0.2) > 1.0)
