"""Fly an experiment in software, twice, and compare the tracking errors in its tables.

python examples/compare_settings.py
"""

import numpy as np

import shoal


def worst_error_m(flown: shoal.FlownRun, robot: int) -> float:
    """Largest distance from the trajectory after 20 s: before, a robot is still on its way to it."""
    state = flown.table("state", robot)
    off = np.hypot(
        state["estimate.x_m"] - state["control.reference_x_m"], state["estimate.y_m"] - state["control.reference_y_m"]
    )
    return float(off[state["time_s"] > 20.0].max())


for estimator in (True, False):
    flown = shoal.simulate("numeric-disturbed", {"controller.estimator.enabled": estimator}, duration_s=30.0)
    print(f"disturbance estimate {estimator}: worst error {1e3 * worst_error_m(flown, 1):.1f} mm, {flown.folder}")
