"""Scene that the page gets once: pool, robots, limits, planned paths, mesh of the camera's picture. Pure."""

from collections.abc import Mapping
from functools import cache
from typing import Any

import numpy as np
import numpy.typing as npt

from shoal.config.controller import EstimatorConfig, MpcConfig
from shoal.config.experiment import Experiment
from shoal.config.key_reference import hints
from shoal.config.perception import Camera
from shoal.config.scene import Circle, FormationConfig, Island, PoolConfig, RobotConfig, Route, Waypoints
from shoal.frames import Array
from shoal.messages import topics
from shoal.messages.camera_coverage import project
from shoal.messages.labels import plotted
from shoal.messages.live_gains import tunable_parameters
from shoal.messages.messages import RobotState, Trajectory

MOST_POINTS = 1500  # of a path: 0.08 s apart for the pool scene, less than a pixel
CELLS = 16  # of the picture's mesh, along the longer side: straight edges are then within 1 mm of the lens's curves
MARGIN_M = 0.2  # of the mesh beyond the walls
LOCKSTEP_STALE_S = 1.0  # there a slow machine is no fault; periods are the simulator's
LOCKSTEP_PICTURE_STALE_S = 6.0  # a preview each 0.2 simulated s, at a thirtieth of real time


def floats(values: npt.ArrayLike) -> bytes:
    """Numbers as little-endian float32, which the page reads without parsing. Enough: 24 bits are 1 um in 10 m."""
    return np.ascontiguousarray(values, dtype="<f4").tobytes()


def paths(trajectories: Mapping[int, Trajectory], flown: int) -> list[dict[str, Any]]:
    """Each robot's path up to sample `flown`, thinned: every `every_s` seconds [x, y, z, yaw]."""
    step = max(1, -(-flown // MOST_POINTS))
    return [
        {"robot": robot, "id": t.id, "every_s": t.period_s * step, "eta": floats(t.eta[:flown:step])}
        for robot, t in trajectories.items()
    ]


def flown_paths(flown: Mapping[int, tuple[Trajectory, float]]) -> list[dict[str, Any]]:
    """The paths that are flown now, each up to its end in s; what comes after is horizon."""
    parts = []
    for robot, (t, end_s) in flown.items():
        samples = round((end_s - t.begin_s) / t.period_s) + 1
        parts += paths({robot: t}, min(max(samples, 1), len(t.eta)))
    return parts


def flown_samples(experiment: Experiment) -> int:
    """Number of samples of a trajectory that belong to the run; the rest is horizon."""
    return round(experiment.duration_s / experiment.controller.period_s) + 1


def scene(experiment: Experiment, trajectories: Mapping[int, Trajectory], mode: str) -> dict[str, Any]:
    """The whole scene. `mode`: `real-time`, `lockstep` or `replay`."""
    vehicle, controller, safety = experiment.vehicle, experiment.controller, experiment.safety
    return {
        "name": experiment.name,
        "title": experiment.title or experiment.name,
        "mode": mode,
        "hash": experiment.hash,
        "duration_s": experiment.duration_s,
        "period_s": controller.period_s,
        "stale_s": 3.0 * controller.period_s if mode == "real-time" else LOCKSTEP_STALE_S,
        "picture_stale_s": LOCKSTEP_PICTURE_STALE_S if mode == "lockstep" else topics.PREVIEW.max_age_s,
        "pool_m": list(experiment.pool.size_m),
        "walls": experiment.pool.walls,
        "hull_m": vehicle.radius_m,
        "safety_m": safety.radius_m,
        "margin_m": safety.margin_m,
        "limits": {
            "wrench": list(vehicle.limits.wrench),
            "speed_mps": vehicle.limits.speed_mps,
            "heave_mps": vehicle.limits.heave_mps,
            "yaw_rate_radps": vehicle.limits.yaw_rate_radps,
            "thrust_n": vehicle.thruster.max_thrust_n,
            "pulse_us": [vehicle.thruster.curve[0][0], vehicle.thruster.neutral_us, vehicle.thruster.curve[-1][0]],
            "battery_v": [vehicle.battery.neutral_v, vehicle.battery.no_arm_v, vehicle.battery.warn_v, vehicle.battery.full_v],
        },
        "thrusters": [[*place[:2], *place[3:5]] for place in vehicle.thruster_places],
        "outputs": list(vehicle.thruster_channels),
        "islands": [[*island.position_m, island.radius_m] for island in experiment.islands],
        "robots": [{"id": r.id, "node_m": list(r.node_m), "neighbours": list(r.neighbours)} for r in experiment.robots],
        "path": experiment.path.model_dump(mode="json"),
        "formation": experiment.formation.model_dump(mode="json"),
        "hints": _hints(),
        "fields": [{"path": path, "title": title, "unit": unit} for path, title, unit in plotted(RobotState)],
        "knobs": [
            {"key": k.key, "value": k.value, "least": k.least, "most": k.most, "above": k.above, "below": k.below}
            for k in tunable_parameters(controller)
        ],
        "paths": paths(trajectories, flown_samples(experiment)),
        "cameras": [
            {"name": name, "underlay": _underlay(experiment, camera)}
            for name, camera in zip(experiment.camera_names or ("",), experiment.all_cameras, strict=True)
        ],
    }


@cache
def _hints() -> dict[str, str]:
    """Meaning, range and default of the keys that panels show, by dotted key; of a path, of all its kinds together."""
    controller = ((EstimatorConfig, "estimator"), (MpcConfig, "mpc"))
    texts: dict[str, str] = {}
    for model, name in (
        (Route, "path"), (Waypoints, "path"), (Circle, "path"), (PoolConfig, "pool"), (FormationConfig, "formation"),
        (Island, "islands"), (RobotConfig, "robots"), *((model, f"controller.{name}") for model, name in controller),
    ):  # fmt: skip
        texts |= hints(model, name)
    return texts


def _underlay(experiment: Experiment, camera: Camera) -> dict[str, Any] | None:
    """The camera's picture as it lies under the map. None where the camera moves: its view is known only for each picture."""
    if experiment.landmarks:
        return None
    points, places = mesh(experiment, camera)
    return {"columns": points.shape[1], "pool": floats(points), "picture": floats(_finite(places))}


def _finite(places: Array) -> Array:
    return np.where(np.isfinite(places), places, -1e3)


def mesh(experiment: Experiment, camera: Camera) -> tuple[Array, Array]:
    """Mesh that lays a camera's picture under the map: points (rows + 1, columns + 1, 2) at the path's depth,
    pool frame, and the places (same shape) in the picture that show them, from 0 to 1 across its width and height."""
    length, width, _ = experiment.pool.size_m
    cell_m = max(length, width) / CELLS
    x = np.linspace(-length / 2 - MARGIN_M, length / 2 + MARGIN_M, max(2, round(length / cell_m)) + 1)
    y = np.linspace(-width / 2 - MARGIN_M, width / 2 + MARGIN_M, max(2, round(width / cell_m)) + 1)
    points = np.stack(np.meshgrid(x, y), axis=-1)
    flat = points.reshape(-1, 2)
    pixels = project(camera, np.column_stack([flat, np.full(len(flat), experiment.path.depth_m)]))
    return points, ((pixels + 0.5) / np.array(camera.size_px)).reshape(points.shape)
