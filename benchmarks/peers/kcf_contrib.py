"""KCF of OpenCV's contrib modules, with its own settings (grey and colour-name features, compressed)."""

import importlib
import json
import sys
from typing import Any

from benchmarks.localizer.following import Begin, Picture, Place, Step, Task, follow

cv2: Any = importlib.import_module("cv2")  # the contrib build, which our environment must not have beside its own

# It looks at a square twice as wide as the box it is given. Ours is given a box and looks at that: the first variant sees what
# ours sees, the second is told what ours is told, and the third is the size with which it loses the real animal least.
BOXES = {"half our box": 0.5, "our box": 1.0, "1.5 times our box": 1.5}


def beginner(box_px: float) -> Begin:
    """Trackers of a box of this size."""

    def begin(picture: Picture, place: Place) -> Step:
        tracker = cv2.TrackerKCF.create()
        side = round(box_px)
        corner = [round(c - (side - 1) / 2.0) for c in place]
        tracker.init(picture, (*corner, side, side))

        def step(picture: Picture) -> Place | None:
            good, (left, top, width, height) = tracker.update(picture)
            return (left + (width - 1) / 2.0, top + (height - 1) / 2.0) if good else None

        return step

    return begin


if __name__ == "__main__":
    cv2.setNumThreads(1)
    rows = []
    for item in json.load(sys.stdin):
        task = Task(**item)
        for what, share in BOXES.items():
            rows += follow(task, f"contrib KCF, {what}", beginner(share * task.window_px))
    print(json.dumps([row.as_dict() for row in rows]))
