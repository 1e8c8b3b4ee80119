"""Cost of a control step over the number of neighbours heard."""

from collections.abc import Iterator

from benchmarks.harness import Row
from benchmarks.robot_agent.control_loop import Case, fly

BENCHMARK = "control_growth"
STEPS = 600
NEIGHBOURS = (0, 2, 5, 10, 20)


def run() -> Iterator[Row]:
    """With more and more neighbours."""
    for neighbours in NEIGHBOURS:
        case = Case("default", neighbours)
        yield Row.of(BENCHMARK, f"{neighbours} neighbours", "ours", "us", fly(case, STEPS).step_us)
