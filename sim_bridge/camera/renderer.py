"""The simulated overhead camera: the plant's state in the middle of an exposure -> a raw Bayer picture. Pure and repeatable.

The pipeline is described in this package's __init__. A camera under a drone (sim.camera_motion) is still during an
exposure.
"""

from collections.abc import Collection, Sequence

import numpy as np
from numpy.typing import NDArray

from sim_bridge.camera.bubbles import Bubbles, draw_bubbles
from sim_bridge.camera.moving_background import CameraSway, MovingBackground
from sim_bridge.camera.optics import Bytes, optical_path_m, project
from sim_bridge.camera.robot_sprite import BodySprite, exposure_poses, pool_velocity, shadow_box
from sim_bridge.camera.scene import WaterView
from sim_bridge.camera.sensor_noise import SensorNoise
from sim_bridge.camera.static_background import StaticBackground
from sim_bridge.plant.random_streams import Stream, generator
from wire.config.experiment import Experiment
from wire.config.perception import Camera
from wire.frames import Array

MARGIN_PX = 4.0  # px around a body's projection, for ripples and soft edges
PROBE_M = 0.02  # m over which the local scale is measured

Body = tuple[BodySprite, Array, Array, Array]  # with eta (4,), nu (4,), and roll and pitch (2,)


class Renderer:
    """The camera of an experiment. It draws a frame in milliseconds; each of the first ones, for 3 s, in tens of them,
    unless `backdrop.prepare` came before."""

    def __init__(self, experiment: Experiment, seed: int, number: int = 0) -> None:
        """`number` is that of one of several cameras: they see the same water and robots, each with pixel noise of its own."""
        self._camera, self._picture = experiment.camera, experiment.sim.picture
        self._robots = experiment.robot_ids
        random = generator(seed, Stream.CAMERA, 0)
        motion = experiment.sim.camera_motion
        swings = CameraSway(experiment.camera, motion, generator(seed, Stream.CAMERA, 3))
        # the water without robots at any time
        self.backdrop = MovingBackground(experiment, swings, random) if motion.moves else StaticBackground(experiment, random)
        shades = [0 if self._picture.alike else i for i in range(len(self._robots))]
        self._sprites = [
            BodySprite.robot(robot, experiment, generator(seed, Stream.CAMERA, 1, shade))
            for robot, shade in zip(experiment.robots, shades, strict=True)
        ]
        self._balls = [(drifter, BodySprite.ball(drifter.radius_m)) for drifter in experiment.sim.drifters]
        self._whole = self._sprites
        px_per_m, family = experiment.camera.px_per_m, experiment.localizer.marker_family
        self._landmarks = [
            (BodySprite.landmark(landmark, px_per_m, family), np.array([[*landmark.position_m, landmark.yaw_rad]]))
            for landmark in experiment.marks
        ]
        self._bubbles = Bubbles(experiment.pool, generator(seed, Stream.CAMERA, 4))
        self._hull_m = experiment.vehicle.radius_m
        random = generator(seed, Stream.CAMERA, 2, number)
        self._noise = SensorNoise(experiment.camera.size_px, self._picture.noise, random)

    def hide_markers(self, unmarked: Collection[int]) -> None:
        """From now on draw these robots, by index, without their markers, and the others with."""
        self._sprites = [sprite.unmarked() if i in unmarked else sprite for i, sprite in enumerate(self._whole)]

    def render(
        self, eta: Array, nu: Array, time_s: float, frame_index: int, tilt: Array | None = None, bubbles: int = 0
    ) -> NDArray[np.uint8]:
        """Raw RGGB picture (height, width) uint8 of the pool; COLOR_BayerRGGB2BGR gives its colours.

        eta (n, 4) and nu (n, 4) are the robots, in the experiment's order, in the middle of the exposure at `time_s`.
        `tilt` (n, 2 or more) begins with their roll and pitch; without it they are level. `bubbles` is the number of streams
        of them beside the experiment's own. A robot outside the picture is not drawn. Raises ValueError for numbers that are
        not finite, which are a bug of the plant.
        """
        for i, robot in enumerate(self._robots):
            if not (np.all(np.isfinite(eta[i])) and np.all(np.isfinite(nu[i]))):
                raise ValueError(f"robot {robot}: eta = {eta[i]}, nu = {nu[i]} must be finite")
        scene, raw = self.backdrop.at(time_s)
        self._draw_landmarks(raw, scene, time_s)
        roll_pitch = np.zeros((len(eta), 2)) if tilt is None else tilt[:, :2]
        bodies: list[Body] = [*zip(self._sprites, eta, nu, roll_pitch, strict=True), *self._drifting_balls(time_s)]
        if self._camera.readout_s > 0.0:
            bodies = [self._when_read_out(scene.view.camera, body) for body in bodies]
        if self._picture.shadows:
            self._draw_shadows(raw, scene, bodies)
        self._draw_bodies(raw, scene, bodies, time_s)
        if streams := bubbles + self._picture.bubbles:
            draw_bubbles(raw, self._bubbles.at(time_s, streams), scene.view.camera, eta[:, :3], self._hull_m)
        return self._noise.add(raw, frame_index)

    def _drifting_balls(self, time_s: float) -> list[Body]:
        """The balls that are in the water: heading 0, so that body and pool axes agree."""
        places = [(sprite, drifter, drifter.place_m(time_s)) for drifter, sprite in self._balls]
        return [
            (sprite, np.append(place, 0.0), np.append(drifter.velocity_mps, 0.0), np.zeros(2))
            for sprite, drifter, place in places
            if place is not None
        ]

    def _draw_landmarks(self, raw: Bytes, scene: WaterView, time_s: float) -> None:
        windows = scene.view.windows([sprite.box(poses[0]) for sprite, poses in self._landmarks], MARGIN_PX)
        for (sprite, poses), window in zip(self._landmarks, windows, strict=True):
            if window is not None:
                sprite.draw(raw, scene, window, poses, np.zeros(2), self._camera.px_per_m, time_s)

    def _draw_shadows(self, raw: Bytes, scene: WaterView, bodies: Sequence[Body]) -> None:
        boxes = [shadow_box(eta, scene.depth_m, sprite.radius_m) for sprite, eta, _, _ in bodies]
        for (sprite, eta, _, _), window in zip(bodies, scene.view.windows(boxes, MARGIN_PX), strict=True):
            if window is not None:
                sprite.draw_shadow(raw, scene, window, eta)

    def _draw_bodies(self, raw: Bytes, scene: WaterView, bodies: Sequence[Body], time_s: float) -> None:
        """Draw the bodies, the farthest first; none that is above the lens."""
        places = np.array([eta[:3] for _, eta, _, _ in bodies])
        scales = _scales(scene.view.camera, places)
        far_m = optical_path_m(scene.view.camera, places)
        seen = [i for i in np.argsort(-far_m, kind="stable").tolist() if np.isfinite(scales[i])]
        exposures = [self._exposure(bodies[i], scales[i]) for i in seen]
        windows = scene.view.windows([box for _, box in exposures], MARGIN_PX)
        for i, (poses, _), window in zip(seen, exposures, windows, strict=True):
            if window is not None:
                sprite, _, _, roll_pitch = bodies[i]
                sprite.draw(raw, scene, window, poses, roll_pitch, scales[i], time_s)

    def _when_read_out(self, camera: Camera, body: Body) -> Body:
        """The body where it is when the row of its centre is exposed, by a rolling shutter whose middle row is exposed at the
        time of the picture. Its other rows are not told apart: 0.5 mm at 0.3 m/s, 100 px of 960 and 15 ms of read-out."""
        sprite, eta, nu, roll_pitch = body
        row = float(project(camera, eta[None, :3])[0, 1])
        if not np.isfinite(row):  # above the lens
            return body
        late_s = self._camera.readout_s * (row / camera.size_px[1] - 0.5)
        return sprite, eta + late_s * pool_velocity(eta, nu), nu, roll_pitch

    def _exposure(self, body: Body, px_per_m: float) -> tuple[Array, Array]:
        """Poses (k, 4) of a body during the exposure, and corners (16, 3) of a box around them."""
        sprite, eta, nu, roll_pitch = body
        poses = exposure_poses(eta, nu, self._camera.exposure_s, sprite.radius_m, px_per_m)
        lean = float(np.hypot(*roll_pitch))
        return poses, np.concatenate([sprite.box(pose, lean) for pose in (poses[0], poses[-1])])


def with_sunken_water(experiment: Experiment, drop_m: float) -> Experiment:
    """The experiment as it is seen when its water stands `drop_m` lower. The surface is z = 0 again, so camera, floor and
    marks are higher by that; robots sink with the water, as their pressure sensors tell."""
    camera, pool = experiment.camera, experiment.pool
    (x, y, z), (length, width, depth) = camera.position_m, pool.size_m
    marks = {
        key: tuple(m.model_copy(update={"position_m": (*m.position_m[:2], m.position_m[2] - drop_m)}) for m in held)
        for key, held in (("landmarks", experiment.landmarks), ("check_marks", experiment.check_marks))
    }
    lower = {"camera": camera.model_copy(update={"position_m": (x, y, z - drop_m)})}
    return experiment.model_copy(
        update={**marks, **lower, "pool": pool.model_copy(update={"size_m": (length, width, depth - drop_m)})}
    )


def _scales(camera: Camera, places_m: Array) -> list[float]:
    """Pixels per metre around places (k, 3); NaN above the lens."""
    probes = places_m[:, None] + PROBE_M * np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
    seen = project(camera, probes.reshape(-1, 3)).reshape(-1, 3, 2)
    scales: list[float] = (np.linalg.norm(seen[:, 1:] - seen[:, :1], axis=2).mean(axis=1) / PROBE_M).tolist()
    return scales
