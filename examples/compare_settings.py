"""Fly an experiment in software, twice, and compare the tracking errors in its tables.

python examples/compare_settings.py
"""

import numpy as np

import shoal


def worst_error_m(flown: shoal.FlownRun, robot: int) -> float:
    """Largest distance from the trajectory after 3 s."""
    state = flown.table("state", robot)
    off = np.hypot(
        state["estimate.x_m"] - state["control.reference_x_m"], state["estimate.y_m"] - state["control.reference_y_m"]
    )
    return float(off[state["time_s"] > 3.0].max())


for estimator in (True, False):
    flown = shoal.simulate("numeric-disturbed", {"controller.estimator.enabled": estimator}, duration_s=8.0)
    print(f"disturbance estimate {estimator}: worst error {worst_error_m(flown, 1):.3f} m, {flown.folder}")
