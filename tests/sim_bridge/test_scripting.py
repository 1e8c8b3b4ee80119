"""Scripts that start their own fleet, in software."""

from pathlib import Path

import pytest

import shoal
from shoal.runtime.runtime import Failed

pytestmark = pytest.mark.real_time


def test_a_run_that_the_station_refuses_raises_its_reason(tmp_path: Path) -> None:
    with (
        pytest.raises(Failed, match=r"^\S+: .* a run needs 1e\+09"),
        shoal.simulation("pool", {"recording.min_free_gb": 1e9}, out=tmp_path),
    ):
        raise AssertionError("nothing can be led here")
    assert not list(tmp_path.iterdir())
