"""A formation that changes its shape on the way: keys of the experiment, given by the script.

python examples/change_formation.py
"""

import numpy as np

import shoal

CHANGES = [{"at_s": 20.0, "over_s": 6.0, "scale": 0.85}, {"at_s": 26.0, "over_s": 4.0, "turn_rad": 0.1}]

flown = shoal.simulate("open-water", {"formation.changes": CHANGES}, duration_s=31.0)
one, two = flown.table("state", 1), flown.table("state", 2)
steps = min(len(one["time_s"]), len(two["time_s"]))
apart = np.hypot(
    one["estimate.x_m"][:steps] - two["estimate.x_m"][:steps], one["estimate.y_m"][:steps] - two["estimate.y_m"][:steps]
)
for moment_s in (20.0, 26.0, 30.0):  # by 20 s the robots have reached their places
    at = int(np.searchsorted(one["time_s"][:steps], moment_s))
    print(f"{moment_s:4.0f} s: {apart[at]:.2f} m apart")
