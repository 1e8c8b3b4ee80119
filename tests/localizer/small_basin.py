"""A small basin whose camera is to be found: the true camera, the board, and markers surveyed on its rim and floor."""

from shoal.config.experiment import load_experiment

BOARD = "charuco:7x5:0.04:0.03:DICT_4X4_50"
TRUTH = load_experiment("pool").camera.model_copy(
    update={
        "size_px": (480, 360),
        "focal_px": (330.0, 331.5),
        "centre_px": (236.3, 184.8),
        "distortion": (-0.12, 0.03, 6e-4, -4e-4, 0.0),
        "position_m": (0.06, -0.04, -2.6),
        "rotation_rad": (0.03, -0.02, 0.05),
    }
)
POOL_M = [2.6, 1.9, 0.8]
# By marker: x, y m. The rim is 0.1 m above the water, the floor 0.8 m below.
RIM = {0: (-1.55, -1.1), 1: (1.5, -1.05), 2: (1.55, 1.1), 3: (-1.5, 1.15)}
FLOOR = {10: (-0.9, -0.6), 11: (0.9, -0.5), 12: (0.8, 0.6), 13: (-0.9, 0.6), 14: (0.0, 0.05)}
