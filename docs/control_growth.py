"""SHELL: docs/images/control-growth.png: a control step over horizon and neighbours: `python -m docs.control_growth`."""

import time
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

from benchmarks.robot_agent.control_loop import Case, fly

STEPS, ROUNDS = 60, 4
HORIZONS = (15, 25, 50, 75, 100, 150, 200)  # the blocks take 15 steps
NEIGHBOURS = (0, 2, 5, 10, 20, 35, 50)


def step_us(case: Case) -> float:
    """Processor time that a tenth of the control steps stay below: other programs on the machine count least there."""
    return float(np.percentile(fly(case, STEPS, clock=time.thread_time_ns).step_us, 10))


def main() -> None:
    """Fly every point in rounds, and draw the least of each as a multiple of the default horizon alone."""
    figure, panels = plt.subplots(1, 2, figsize=(11, 4.2), sharey=True)
    longer = {n: Case("default", 0, more=(f"controller.mpc.horizon={n}",)) for n in HORIZONS}
    more = {n: Case("default", n) for n in NEIGHBOURS}
    rounds = [[{n: step_us(case) for n, case in cases.items()} for cases in (longer, more)] for _ in range(ROUNDS)]
    horizons, neighbours = ({n: min(each[n] for each in found) for n in found[0]} for found in zip(*rounds, strict=True))
    alone_us = neighbours[0]
    for axes, title, found in (
        (panels[0], "steps of the horizon, alone", horizons),
        (panels[1], "neighbours heard, horizon of 50 steps", neighbours),
    ):
        axes.plot(list(found), [us / alone_us for us in found.values()], "o-", color="#4477aa")
        axes.set(xlabel=title)
        axes.grid(True, alpha=0.3)
        print(title, {n: round(us / alone_us, 2) for n, us in found.items()})
    panels[0].set_ylim(0.0, 1.1 * max(*horizons.values(), *neighbours.values()) / alone_us)
    panels[0].set_ylabel("processor time of a control step")
    figure.suptitle("A control step, in multiples of 50 steps alone")
    figure.tight_layout()
    figure.savefig(Path(__file__).parent / "images" / "control-growth.png", dpi=90)


if __name__ == "__main__":
    main()
