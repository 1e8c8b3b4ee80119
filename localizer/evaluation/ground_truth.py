"""SHELL: files that say where things really were."""

from pathlib import Path

import numpy as np

from localizer.evaluation.metrics import Way
from wire.config.experiment import Experiment
from wire.frames import Array
from wire.toml_loader import ConfigError

COLUMNS = ("frame", "robot", "x_m", "y_m", "yaw_rad")  # of `read_poses`


def read_idtracker(path: Path) -> list[Array]:
    """Places (frames, 2) in pixels of each target of idTracker's text: a line of names, then X, Y and a probability per target
    and frame. Its first pixel is 1; ours is 0. Unknown places are NaN."""
    try:
        columns = np.loadtxt(path, skiprows=1, ndmin=2)
    except (OSError, ValueError) as error:
        raise ConfigError(f"{path}: {error}") from None
    if columns.shape[1] < 2:
        raise ConfigError(f"{path}: {columns.shape[1]} column, idTracker writes X, Y and a probability per target")
    return [columns[:, first : first + 2] - 1.0 for first in range(0, columns.shape[1] - 1, 3)]


def read_poses(path: Path, experiment: Experiment) -> tuple[dict[int, Way], dict[int, dict[int, float]]]:
    """Ways by robot, and known depths by frame and robot, from comma-separated values: a line of names, then a line per frame
    (from 0) and robot. COLUMNS are needed, in any order; `depth_m` may be there. Instants are by the experiment's frame rate.
    """
    try:
        with path.open(encoding="utf-8") as file:
            names = [name.strip() for name in file.readline().split(",")]
            if missing := [name for name in COLUMNS if name not in names]:
                needed = ",".join(COLUMNS)
                raise ConfigError(f"{path}: the first line lacks {', '.join(missing)} (needed: {needed}; depth_m may follow)")
            lines = np.loadtxt(file, delimiter=",", ndmin=2)
    except (OSError, ValueError) as error:
        raise ConfigError(f"{path}: {error}") from None
    if lines.shape[1] != len(names):
        raise ConfigError(f"{path}: {lines.shape[1]} values a line, {len(names)} names in the first")
    period_ns = round(1e9 / experiment.camera.rate_hz)
    samples: dict[int, list[tuple[int, Array]]] = {}
    depths: dict[int, dict[int, float]] = {}
    for line in lines:
        value = dict(zip(names, line.tolist(), strict=True))
        frame, robot = round(value["frame"]), experiment.robot(round(value["robot"])).id
        samples.setdefault(robot, []).append((frame * period_ns, np.array([value[name] for name in COLUMNS[2:]])))
        if "depth_m" in value:
            depths.setdefault(frame, {})[robot] = value["depth_m"]
    return {robot: way(found) for robot, found in samples.items()}, depths


def way(samples: list[tuple[int, Array]]) -> Way:
    """From (instant in ns, [x, y, yaw]) in any order."""
    ordered = sorted(samples, key=lambda sample: sample[0])
    return Way(np.array([stamp for stamp, _ in ordered]), np.array([pose for _, pose in ordered]))
