"""Scripts that start their own fleet, in software."""

from pathlib import Path

import pytest

import shoal
from shoal.errors import ConfigError
from shoal.runtime.runtime import Failed


@pytest.mark.parametrize("camera", [False, True])
def test_a_flight_that_the_station_refuses_raises_its_reason_and_leaves_no_folder(camera: bool, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"robot 1: yaw rate .* exceeds the limit"):
        shoal.simulate("pool", {"path.lap_s": 3.0, "duration_s": 5.0}, camera=camera, out=tmp_path)
    assert not list(tmp_path.iterdir())


@pytest.mark.real_time
def test_a_run_that_the_station_refuses_raises_its_reason(tmp_path: Path) -> None:
    with (
        pytest.raises(Failed, match=r"^\S+: .* a run needs 1e\+09"),
        shoal.simulation("pool", {"recording.min_free_gb": 1e9}, out=tmp_path),
    ):
        raise AssertionError("nothing can be led here")
    assert not list(tmp_path.iterdir())
