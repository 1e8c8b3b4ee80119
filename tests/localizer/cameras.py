"""The cameras of the optics tests: the pool's own, and a tilted one with a distorted picture."""

from shoal.config.experiment import load_experiment

CAMERA = load_experiment("pool").camera
TILTED = CAMERA.model_copy(
    update={
        "rotation_rad": (0.15, -0.2, 0.3),
        "position_m": (0.4, -0.3, -2.5),
        "centre_px": (620.3, 490.1),
        "distortion": (-0.25, 0.08, 0.001, -0.0015, -0.01),
    }
)

ASLANT = CAMERA.model_copy(
    update={"position_m": (0.0, 0.0, -2.0), "rotation_rad": (0.0, -0.8726646, 0.0), "distortion": (0.0,) * 5}
)  # along +x, 50 degrees from the vertical: places more than 1.7 m behind its foot are behind its lens
