"""Every decoder and every step, given anything. `make fuzz` goes on for a million payloads."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.faults.targets import TARGETS, seeds
from tests.shoal.strategies import damaged

pytestmark = pytest.mark.long

EXAMPLES = {"agent": 40, "orders": 40, "locator": 40, "toml": 40}


@pytest.mark.parametrize("name", TARGETS)
def test_no_bytes_do_harm(name: str) -> None:
    target, good = TARGETS[name], seeds(name)

    @settings(max_examples=EXAMPLES.get(name, 200))
    @given(st.binary(max_size=400))
    def anything(data: bytes) -> None:
        target(data)

    @settings(max_examples=EXAMPLES.get(name, 200))
    @given(st.sampled_from(good), st.integers(0, 2**32 - 1))
    def nearly_good(data: bytes, seed: int) -> None:
        target(damaged(data, np.random.default_rng(seed)))

    anything()
    nearly_good()
