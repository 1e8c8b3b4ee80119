"""The localizer against pictures by another renderer, in the rows where it is good. docs/cameras.md has all rows."""

from dataclasses import asdict

import pytest

from tests.localizer.photoreal.measure import measure

LEVEL_MM, LEVEL_DEG = 0.45, 0.35  # RMS of level robots in flat water, depths known: 0.1 px of a 1280 px camera is 0.29 mm


@pytest.mark.parametrize("split", ("tune",))
def test_level_robots_in_flat_water_are_where_another_renderer_put_them(split: str) -> None:
    found = measure("level", split, true_depths=True)
    assert found.marker_pct == 100.0, asdict(found)
    assert found.rms_mm < LEVEL_MM, asdict(found)
    assert found.rms_deg < LEVEL_DEG, asdict(found)
    assert found.nees < 5.0, asdict(found)
