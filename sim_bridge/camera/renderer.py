"""The simulated overhead camera: plant in the middle of an exposure -> raw Bayer picture. Pure and repeatable.

Reads in the order light travels: backdrop (floor, walls, water), landmarks, shadows, robots and balls adrift from the farthest
to the nearest, noise. A camera under a drone (sim.camera_motion) is still during an exposure.
"""

from collections.abc import Collection, Sequence

import numpy as np
from numpy.typing import NDArray

from sim_bridge.camera.marker_plate import Plate, Sight
from sim_bridge.camera.moving_background import Hover, Motion
from sim_bridge.camera.optics import optical_path_m, project
from sim_bridge.camera.rays import Window
from sim_bridge.camera.robot_sprite import Pose, Sprite, attitude, parts, shade, shadow_box
from sim_bridge.camera.scene import Scene
from sim_bridge.camera.sensor_noise import ImageNoise
from sim_bridge.camera.static_background import Backdrop
from sim_bridge.camera.textures import Bytes, Float
from sim_bridge.plant.random_streams import Stream, generator
from wire.config.experiment import Experiment
from wire.config.perception import Camera
from wire.frames import Array

MARGIN_PX = 4.0  # around a robot's picture: ripples and soft edges
PROBE_M = 0.02  # distance over which the local scale is measured

Body = tuple[Sprite, Array, Array, Array]  # with eta (4,), nu (4,), and roll and pitch (2,)


class Renderer:
    """Draws what the camera of an experiment sees. Backgrounds are drawn at the start (seconds), frames in milliseconds."""

    def __init__(self, experiment: Experiment, seed: int) -> None:
        self._camera, self._picture = experiment.camera, experiment.sim.picture
        self._robots, self._landmarks = experiment.robot_ids, experiment.landmarks
        random = generator(seed, Stream.CAMERA, 0)
        motion = experiment.sim.camera_motion
        swings = Motion(experiment.camera, motion, generator(seed, Stream.CAMERA, 3))
        self._backdrop = Hover(experiment, swings, random) if motion.moves else Backdrop(experiment, random)
        shades = [0 if self._picture.alike else i for i in range(len(self._robots))]
        self._sprites = [
            Sprite.robot(robot, experiment, generator(seed, Stream.CAMERA, 1, shade))
            for robot, shade in zip(experiment.robots, shades, strict=True)
        ]
        self._balls = [(drifter, Sprite.ball(drifter.radius_m)) for drifter in experiment.sim.drifters]
        self._whole = self._sprites
        self._plates = [Plate(landmark.id, landmark.side_m, experiment.camera.px_per_m) for landmark in self._landmarks]
        random = generator(seed, Stream.CAMERA, 2)
        self._noise = ImageNoise(experiment.camera.size_px, self._picture.noise, random)

    def lose_markers(self, bare: Collection[int]) -> None:
        """From now on draw these robots, by index, without their markers, and the others with."""
        self._sprites = [sprite.unmarked() if i in bare else sprite for i, sprite in enumerate(self._whole)]

    def render(self, eta: Array, nu: Array, time_s: float, frame_index: int, tilt: Array | None = None) -> NDArray[np.uint8]:
        """Raw RGGB picture (height, width): COLOR_BayerRGGB2BGR gives right colours.

        eta (n, 4) and nu (n, 4) are the robots, in the experiment's order, in the middle of the exposure at `time_s`; `tilt`
        (n, 2 or more) begins with their roll and pitch, and they are level without it.
        Robots outside the picture are not in it; numbers that are not finite are a bug of the plant: ValueError.
        """
        for i, robot in enumerate(self._robots):
            if not (np.all(np.isfinite(eta[i])) and np.all(np.isfinite(nu[i]))):
                raise ValueError(f"robot {robot}: eta = {eta[i]}, nu = {nu[i]} must be finite")
        scene, raw = self._backdrop.at(time_s)
        self._draw_landmarks(raw, scene, time_s)
        roll_pitch = np.zeros((len(eta), 2)) if tilt is None else tilt[:, :2]
        bodies: list[Body] = [*zip(self._sprites, eta, nu, roll_pitch, strict=True), *self._adrift(time_s)]
        if self._picture.shadows:
            self._draw_shadows(raw, scene, bodies)
        self._draw_bodies(raw, scene, bodies, time_s)
        return self._noise.add(raw, frame_index)

    def _adrift(self, time_s: float) -> list[Body]:
        """The balls that are in the water: heading 0, so that body and pool axes agree."""
        places = [(sprite, drifter, drifter.place_m(time_s)) for drifter, sprite in self._balls]
        return [
            (sprite, np.append(place, 0.0), np.append(drifter.velocity_mps, 0.0), np.zeros(2))
            for sprite, drifter, place in places
            if place is not None
        ]

    def _draw_landmarks(self, raw: Bytes, scene: Scene, time_s: float) -> None:
        places = [np.array(landmark.position_m) for landmark in self._landmarks]
        corners = [plate.corners(place) for plate, place in zip(self._plates, places, strict=True)]
        windows = scene.view.windows(corners, MARGIN_PX)
        for plate, landmark, place, window in zip(self._plates, self._landmarks, places, windows, strict=True):
            if window is None:
                continue
            slopes = scene.slopes(window, time_s)
            colour, cover = plate.layer(_sight(scene, window, slopes, place[2], time_s), place, attitude(landmark.yaw_rad))
            _lay(raw, scene, window, slopes, colour, cover)

    def _draw_shadows(self, raw: Bytes, scene: Scene, bodies: Sequence[Body]) -> None:
        boxes = [shadow_box(eta, scene.depth_m, sprite.radius_m) for sprite, eta, _, _ in bodies]
        for (sprite, eta, _, _), window in zip(bodies, scene.view.windows(boxes, MARGIN_PX), strict=True):
            if window is not None:
                shade(raw, scene.block_z, scene.view, window, eta, sprite.radius_m)

    def _draw_bodies(self, raw: Bytes, scene: Scene, bodies: Sequence[Body], time_s: float) -> None:
        """The farthest first; not what is above the lens."""
        places = np.array([eta[:3] for _, eta, _, _ in bodies])
        scales = _scales(scene.view.camera, places)
        far_m = optical_path_m(scene.view.camera, places)
        seen = [i for i in np.argsort(-far_m, kind="stable").tolist() if np.isfinite(scales[i])]
        exposures = [self._exposure(bodies[i], scales[i]) for i in seen]
        windows = scene.view.windows([box for _, box in exposures], MARGIN_PX)
        for i, (instants, _), window in zip(seen, exposures, windows, strict=True):
            if window is not None:
                _draw_body(raw, scene, window, bodies[i], [_pose(at, bodies[i][3], scales[i]) for at in instants], time_s)

    def _exposure(self, body: Body, px_per_m: float) -> tuple[list[Array], Array]:
        """Where a body is during the exposure, and corners (16, 3) of a box around its way."""
        sprite, eta, nu, roll_pitch = body
        instants = parts(eta, nu, self._camera.exposure_s, sprite.radius_m, px_per_m)
        lean = float(np.hypot(*roll_pitch))
        return instants, np.concatenate([sprite.box(instant, lean) for instant in (instants[0], instants[-1])])


def _scales(camera: Camera, places_m: Array) -> list[float]:
    """Pixels per metre around places (k, 3); NaN above the lens."""
    probes = places_m[:, None] + PROBE_M * np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
    seen = project(camera, probes.reshape(-1, 3)).reshape(-1, 3, 2)
    scales: list[float] = (np.linalg.norm(seen[:, 1:] - seen[:, :1], axis=2).mean(axis=1) / PROBE_M).tolist()
    return scales


def _draw_body(raw: Bytes, scene: Scene, window: Window, body: Body, poses: Sequence[Pose], time_s: float) -> None:
    """The mean of its pictures in `poses`."""
    sprite, eta, _, _ = body
    slopes = scene.slopes(window, time_s)
    sight = _sight(scene, window, slopes, eta[2], time_s)
    layers = [sprite.layer(sight, pose) for pose in poses]
    colour, cover = layers[0]
    if len(layers) > 1:
        colour, cover = (np.asarray(sum(planes) / np.float32(len(planes))) for planes in zip(*layers, strict=True))
    _lay(raw, scene, window, slopes, colour, cover)


def _lay(raw: Bytes, scene: Scene, window: Window, slopes: Float, colour: Float, cover: Float) -> None:
    """Lay a layer, its colour weighted with its coverage, over the picture in place, and the water's glare over that."""
    bright = colour * scene.vignette[window.pixels] + cover * scene.view.spread(scene.glare(window, slopes), window)
    spot = raw[window.pixels]
    spot[:] = np.clip(np.rint(spot * (1.0 - cover) + bright), 0, 255).astype(np.uint8)


def _sight(scene: Scene, window: Window, slopes: Float, depth_m: float, time_s: float) -> Sight:
    view, bending = scene.view, scene.bending
    light = view.spread(scene.light(window, depth_m, time_s), window)
    bent = view.lines(window).bent(bending * view.spread(slopes[0], window), bending * view.spread(slopes[1], window))
    return Sight(bent, light)


def _pose(eta: Array, roll_pitch: Array, px_per_m: float) -> Pose:
    x_m, y_m, z_m, yaw_rad = (float(value) for value in eta)
    return Pose(x_m, y_m, z_m, attitude(yaw_rad, *roll_pitch.tolist()), px_per_m)
