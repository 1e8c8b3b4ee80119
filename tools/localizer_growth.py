"""SHELL: docs/images/localizer-growth.png: time over the robots in the picture: `python -m tools.localizer_growth`."""

from pathlib import Path

import cv2
import matplotlib.pyplot as plt

from benchmarks.localizer.frame import fleet, real_time

FLEETS = (1, 3, 10, 20, 35, 49)  # the marker dictionary has no 51st marker, and robots are numbered 1 to 49
FRAMES = 80
CURVES = {"ms to the poses": "#4477aa", "ms to the poses, 95 %": "#88ccee", "ms per frame": "#cc3311"}


def main() -> None:
    """Measure every fleet and draw the curves."""
    cv2.setNumThreads(1)
    with real_time():
        rows = [(count, row) for count in FLEETS for row in fleet(count, markers=True, frames=FRAMES)]
    figure, axes = plt.subplots(figsize=(7.0, 4.2))
    for unit, colour in CURVES.items():
        points = [(count, row.p50) for count, row in rows if row.unit == unit]
        axes.plot(*zip(*points, strict=True), "o-", color=colour, label=unit)
        print(unit, ", ".join(f"{count}: {ms:.2f}" for count, ms in points))
    print(", ".join(f"{count}: {row.p50:g} {row.unit}" for count, row in rows if row.unit.startswith("%")))
    axes.set(xlabel="robots in the picture, all with markers", ylabel="ms, median where nothing else is said")
    axes.set(xlim=(0, 50), ylim=(0, None), title="Localizer, 1280 x 960, one core")
    axes.grid(True, alpha=0.3)
    axes.legend()
    figure.tight_layout()
    figure.savefig(Path(__file__).parents[1] / "docs" / "images" / "localizer-growth.png", dpi=90)


if __name__ == "__main__":
    main()
