"""Cost of a control step over the horizon (in the same blocks) and over the number of neighbours heard."""

from collections.abc import Iterator

from benchmarks.harness import Row
from benchmarks.robot_agent.control_loop import Case, fly

BENCHMARK = "control_growth"
STEPS = 600
HORIZONS = (25, 50, 75, 100)
NEIGHBOURS = (0, 2, 5, 10, 20)


def run() -> Iterator[Row]:
    """Alone with longer horizons; at the default horizon with more neighbours."""
    for horizon in (15, *HORIZONS):
        case = Case("default", 0, more=(f"controller.mpc.horizon={horizon}",))
        yield Row.of(BENCHMARK, f"horizon of {horizon} steps, alone", "ours, osqp", "us", fly(case, STEPS).step_us)
    for neighbours in NEIGHBOURS:
        case = Case("default", neighbours)
        yield Row.of(BENCHMARK, f"{neighbours} neighbours", "ours, osqp", "us", fly(case, STEPS).step_us)
