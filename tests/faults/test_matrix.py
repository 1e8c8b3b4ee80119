"""Injections of `make faults` work, and the robots stay safe: a few rows, once each, in every test run.

How fast they are is measured by `make faults` on a quiet machine; here a busy one must not fail, so times may be longer by
SLACK_S.
"""

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from tests.faults.onlooker import BoardView
from tests.faults.page import PAGE, write_page
from tests.faults.rig import Rig, moment
from tests.faults.row import FaultRow
from tests.faults.table import ROWS

pytestmark = pytest.mark.real_time

SLACK_S = 1.0
FAST = ("localizer-killed", "agent-hung", "agent-killed", "link-garbage", "partition", "emergency-stop")


@pytest.fixture(scope="module")
def lab() -> Iterator[Rig]:
    with Rig() as rig:
        yield rig


def test_the_page_is_what_the_results_say(tmp_path: Path) -> None:
    write_page(tmp_path / "faults.md", ROWS)
    page = PAGE.read_text(encoding="utf-8")
    assert (tmp_path / "faults.md").read_text(encoding="utf-8") == page, (
        "docs/evidence/faults.md is old: make faults writes it"
    )


@pytest.mark.parametrize("row", [row for row in ROWS if row.key in FAST], ids=lambda row: row.key)
def test_a_fault_leaves_robots_safe(row: FaultRow, lab: Rig) -> None:
    random = np.random.default_rng(1)
    lab.cruise(moment(random))
    figures = row.inject(lab, random)
    assert figures
    for name, value in figures.items():
        measure = row.measures[name]
        assert value <= measure.limit + (SLACK_S if measure.unit == "s" else 0.0), name
    assert lab.wrongly_taken() == 0 and lab.not_finite == 0


def test_time_counts_while_a_board_is_told_such_pulses() -> None:
    board = BoardView(
        taken=[(0, (1500, 1500)), (100, (1500, 1520)), (200, (1500, 1501)), (300, (1540, 1500)), (400, (1500, 1500))]
    )
    apart = [
        board.told_s(lambda pulses: abs(pulses[0] - pulses[1]) > 5, *span) * 1e9 for span in ((0, 500), (150, 350), (0, 50))
    ]
    assert apart == pytest.approx([200.0, 100.0, 0.0])
