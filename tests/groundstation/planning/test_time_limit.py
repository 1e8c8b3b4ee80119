"""The limit of the time of a plan: every part of the planner that takes long asks for it."""

from collections.abc import Callable

import numpy as np
import pytest

from groundstation.mission.plan_manager import FlownPath
from groundstation.planning import planner
from groundstation.planning.feasibility import OutOfTime, PlanError
from groundstation.planning.rest_to_rest import plan_return
from groundstation.planning.route_planner import find_route
from groundstation.planning.segment import first_segment
from groundstation.web import experiment_editor, protocol
from shoal.config.experiment import NO_CAMERA, Experiment, load_experiment

POOL = load_experiment("pool", [NO_CAMERA, "duration_s=30"])
ROUTE = load_experiment("islands", [NO_CAMERA])
FAST = load_experiment("figure-eight", [NO_CAMERA, "path.speed_mps=0.6", "path.slow=true", "duration_s=40"])


def over_after(looks: int) -> tuple[OutOfTime, Callable[[], int]]:
    """A limit that is over once it has been asked for so often, and how often it was."""
    count = 0

    def over() -> bool:
        nonlocal count
        count += 1
        return count > looks

    return over, lambda: count


@pytest.mark.parametrize("experiment", [POOL, ROUTE, FAST], ids=["pairs", "route", "slow"])
def test_a_draft_asks_many_times_and_ends_at_each(experiment: Experiment) -> None:
    never_over, looks = over_after(10**9)
    planner.draft(experiment, never_over)
    assert looks() >= 2
    for k in {0, looks() // 2, looks() - 1}:
        over, counted = over_after(k)
        with pytest.raises(PlanError, match="none was found in time"):
            first_segment(experiment, over)
        assert counted() == k + 1
        with pytest.raises(PlanError, match="none was found in time"):
            FlownPath(experiment).plan(over_after(k)[0])


def test_a_way_among_many_obstacles_is_given_up_within_one_try() -> None:
    discs = np.array([(x, y, 0.3) for x in range(-4, 5) for y in range(-4, 5)], dtype=np.float64)
    over, looks = over_after(3)
    with pytest.raises(PlanError, match="in time"):
        find_route([(-4.5, -4.5), (4.5, 4.5)], discs, (6.0, 6.0), out_of_time=over)
    assert looks() == 4
    rests = {1: np.array([-4.5, -4.5, 0.3, 0.0])}
    wide = POOL.model_copy(update={"pool": POOL.pool.model_copy(update={"size_m": (12.0, 12.0, 1.0)})})
    over, looks = over_after(3)  # the first is asked before the try
    with pytest.raises(PlanError, match="in time"):
        plan_return(wide, 0.0, rests, {1: np.array([4.5, 4.5, 0.3, 0.0])}, discs, over)
    assert looks() <= 6


def test_an_edit_that_takes_too_long_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    assert experiment_editor.attempt(ROUTE, protocol.Edit())["ok"]
    monkeypatch.setattr(experiment_editor, "LIMIT_S", 0.0)
    tried = experiment_editor.attempt(ROUTE, protocol.Edit())
    assert not tried["ok"] and tried["problems"] == ["none was found in time"]
