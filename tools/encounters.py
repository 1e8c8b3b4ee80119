"""SHELL: docs/images/encounters.png: the scenes of docs/collision.md, flown from one random start each."""

import sys
from pathlib import Path

import matplotlib
import numpy as np

from shoal.config.experiment import load_experiment
from tests.flights.encounters import SCENES, meet

matplotlib.use("Agg")
from matplotlib import pyplot as plt
from matplotlib.patches import Circle

EVERY = 40  # control steps between dots: 2 s


def main(seed: int = 3) -> None:
    figure, axes = plt.subplots(1, len(SCENES), figsize=(18.0, 4.0), sharey=True)
    for axis, name in zip(axes, SCENES, strict=True):
        experiment = load_experiment(name)
        flight = meet(experiment, seed)
        for robot in range(flight.track.shape[1]):
            x, y = flight.track[:, robot, :2].T
            (line,) = axis.plot(x, y, linewidth=1.0)
            axis.plot(x[::EVERY], y[::EVERY], ".", color=line.get_color())
        for ball in experiment.sim.drifters:
            begin, end = (np.array(ball.start_m[:2]) + t * np.array(ball.velocity_mps[:2]) for t in (0.0, 40.0))
            axis.add_patch(Circle((begin[0], begin[1]), ball.radius_m, color="0.6"))
            axis.annotate("", (end[0], end[1]), (begin[0], begin[1]), arrowprops={"arrowstyle": "->", "color": "0.4"})
        axis.set(title=name, aspect="equal", xlim=(-2.1, 2.1), ylim=(1.8, -1.8), xlabel="x, m")
    axes[0].set_ylabel("y, m")
    figure.tight_layout()
    figure.savefig(Path(__file__).parents[1] / "docs" / "images" / "encounters.png", dpi=60)


if __name__ == "__main__":
    main(*map(int, sys.argv[1:]))
