"""SHELL: docs/images/run.png for the README, from a real run: `python -m tools.picture runs/pool-...`."""

import io
import sys
from pathlib import Path

import matplotlib.image
import matplotlib.pyplot as plt
from mcap.reader import make_reader

from groundstation.analysis import alignment
from groundstation.logs.reader import read_log
from groundstation.report import figures_paths
from groundstation.report.plotting import picture
from shoal.config.experiment import load_experiment
from shoal.messages import codec, topics
from shoal.messages.messages import Preview

SHOW_AT = 0.45  # of the run: the transient is over, and the circle not yet closed


def main(run: Path) -> None:
    """Draw the camera's picture with the localizer's marks, beside the paths that were flown."""
    with (run / "run.mcap").open("rb") as file:
        previews = [m.data for _, c, m in make_reader(file).iter_messages() if c.topic.endswith(topics.PREVIEW.name)]
    jpeg = codec.decode(Preview, previews[round(SHOW_AT * len(previews))], str(run), topics.PREVIEW.name).jpeg
    series = alignment.align(load_experiment(str(run / "experiment.toml")), read_log(run / "run.mcap"))
    flown = picture(figures_paths.paths(series))
    assert flown is not None, "the run has no paths to show"
    png = io.BytesIO()
    flown.savefig(png, format="png", dpi=200, bbox_inches="tight")
    png.seek(0)
    figure, (left, right) = plt.subplots(1, 2, figsize=(14, 5.2), width_ratios=(1.25, 1))
    left.imshow(matplotlib.image.imread(io.BytesIO(jpeg), format="jpeg"))
    right.imshow(matplotlib.image.imread(png))
    for axes in (left, right):
        axes.set_axis_off()
    figure.tight_layout(pad=0.2)
    figure.savefig(Path(__file__).parents[1] / "docs" / "images" / "run.png", dpi=100)


if __name__ == "__main__":
    main(Path(sys.argv[1]))
