"""Identity through encounters: robots that look alike cross, brush or follow each other, with and without readable markers.

Never may a pose that claims a verified identity belong to the other robot.
"""

import pytest

from tests.localizer.encounters import check_encounter

pytestmark = pytest.mark.long


@pytest.mark.parametrize("seed", range(2))
def test_no_swap_goes_unnoticed(seed: int) -> None:
    check_encounter(seed)


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(2, 204))
def test_no_swap_goes_unnoticed_in_many_encounters(seed: int) -> None:
    check_encounter(seed)
