"""The simulated overhead camera: the plant's state in the middle of an exposure -> a raw Bayer picture. Pure and repeatable.

The pipeline is described in this package's __init__. A camera under a drone (sim.camera_motion) is still during an
exposure.
"""

from collections.abc import Collection, Sequence
from typing import TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray

from shoal.config.experiment import Experiment
from shoal.config.perception import Camera, Landmark
from shoal.config.simulation import Drifter
from shoal.errors import ConfigError
from shoal.frames import Array
from sim_bridge.camera.bubbles import Bubbles, draw_bubbles
from sim_bridge.camera.moving_background import CameraSway, MovingBackground
from sim_bridge.camera.optics import Bytes, Optics
from sim_bridge.camera.robot_sprite import Bodies, BodySprite, exposures
from sim_bridge.camera.scene import WaterView
from sim_bridge.camera.sensor_noise import SensorNoise
from sim_bridge.camera.static_background import StaticBackground
from sim_bridge.plant.currents_waves import SurfaceWave
from sim_bridge.plant.random_streams import Stream, generator

MARGIN_PX = 4.0  # px around a body's projection, for ripples and soft edges
Raisable = TypeVar("Raisable", Camera, Landmark)  # what has a position
STEEPEST = 0.5  # largest difference of a line's slopes in air and in water: 60 degrees off the vertical
WATER, ROBOTS, PIXEL_NOISE, SWAY, BUBBLES = range(5)  # streams of random numbers within Stream.CAMERA


class Renderer:
    """The camera of an experiment. It draws a frame in milliseconds; each of the first ones, for 3 s, in tens of them,
    unless `backdrop.prepare` came before."""

    def __init__(self, experiment: Experiment, seed: int, number: int = 0) -> None:
        """Prepare backgrounds, sprites and noise. `number` is that of one of several cameras: they see the same water and
        robots, each with pixel noise of its own."""
        experiment = with_true_camera(experiment)
        self._camera, self._picture = experiment.camera, experiment.sim.picture
        self._robots = experiment.robot_ids
        self._hull_m = experiment.vehicle.radius_m
        self.backdrop = _background(experiment, seed)
        self._marked_sprites = _robot_sprites(experiment, seed)
        self._sprites = self._marked_sprites  # as they are drawn now: some without markers
        self._experiments_balls = [(drifter, BodySprite.ball(drifter.radius_m)) for drifter in experiment.sim.drifters]
        self._balls = self._experiments_balls  # in the water now: those of faults as well
        self._landmarks = _landmarks(experiment)
        self._margin_px = _margin_px(experiment)
        self._bubbles = Bubbles(experiment.pool, generator(seed, Stream.CAMERA, BUBBLES))
        random = generator(seed, Stream.CAMERA, PIXEL_NOISE, number)
        self._noise = SensorNoise(experiment.camera.size_px, self._picture.noise, random)

    def hide_markers(self, unmarked: Collection[int]) -> None:
        """From now on draw these robots, by index, without their markers, and the others with."""
        self._sprites = [sprite.unmarked() if i in unmarked else sprite for i, sprite in enumerate(self._marked_sprites)]

    def drop_balls(self, balls: Sequence[Drifter]) -> None:
        """From now on draw these balls besides the experiment's."""
        self._balls = [*self._experiments_balls, *((ball, BodySprite.ball(ball.radius_m)) for ball in balls)]

    def render(
        self, eta: Array, nu: Array, time_s: float, frame_index: int, tilt: Array | None = None, bubbles: int = 0
    ) -> NDArray[np.uint8]:
        """Raw RGGB picture (height, width) uint8 of the pool; COLOR_BayerRGGB2BGR gives its colours.

        eta (n, 4) and nu (n, 4) are the robots, in the experiment's order, in the middle of the exposure at `time_s`.
        `tilt` (n, 2 or more) begins with their roll and pitch; without it they are level. `bubbles` is the number of streams
        of them beside the experiment's own. A robot outside the picture is not drawn. Raises ValueError for numbers that are
        not finite, which are a bug of the plant.
        """
        for i in np.flatnonzero(~np.isfinite(eta + nu).all(axis=1)):
            raise ValueError(f"robot {self._robots[i]}: eta = {eta[i]}, nu = {nu[i]} must be finite")
        scene, raw = self.backdrop.at(time_s)
        if self._landmarks.sprites:
            self._draw(raw, scene, self._landmarks, time_s, shadows=False)
        bodies = self._bodies(eta, nu, np.zeros((len(eta), 2)) if tilt is None else tilt[:, :2], time_s)
        if self._camera.readout_s > 0.0:
            bodies = self._bodies_at_exposure(scene.view.optics, bodies)
        self._draw(raw, scene, bodies, time_s, self._picture.shadows)
        if streams := bubbles + self._picture.bubbles:
            draw_bubbles(raw, self._bubbles.at(time_s, streams), scene.view.camera, eta[:, :3], self._hull_m)
        return self._noise.add(raw, frame_index)

    def _bodies(self, eta: Array, nu: Array, tilt: Array, time_s: float) -> Bodies:
        """The robots, and the balls that are in the water: heading 0, so that body and pool axes agree."""
        places = [(sprite, drifter, drifter.place_m(time_s)) for drifter, sprite in self._balls]
        balls = [(sprite, drifter, place) for sprite, drifter, place in places if place is not None]
        if not balls:
            return Bodies(self._sprites, eta, nu, tilt)
        return Bodies(
            [*self._sprites, *(sprite for sprite, _, _ in balls)],
            np.concatenate([eta, [[*place, 0.0] for _, _, place in balls]]),
            np.concatenate([nu, [[*drifter.velocity_mps, 0.0] for _, drifter, _ in balls]]),
            np.concatenate([tilt, np.zeros((len(balls), 2))]),
        )

    def _draw(self, raw: Bytes, scene: WaterView, bodies: Bodies, time_s: float, shadows: bool) -> None:
        """Draw their shadows, and then the bodies, the farthest first; none that is above the lens."""
        looks, boxes, squares = exposures(bodies, scene.view.optics, self._camera.exposure_s, scene.depth_m)
        if shadows:
            for sprite, eta, window in zip(
                bodies.sprites, bodies.eta, scene.view.windows(squares, self._margin_px), strict=True
            ):
                if window is not None:
                    sprite.draw_shadow(raw, scene, window, eta)
        visible = zip(bodies.sprites, looks, scene.view.windows(boxes, self._margin_px), strict=True)
        for sprite, look, window in sorted(visible, key=lambda each: -each[1].path_m):
            if window is not None and look.px_per_m > 0.0:
                sprite.draw(raw, scene, window, look, time_s)

    def _bodies_at_exposure(self, optics: Optics, bodies: Bodies) -> Bodies:
        """The bodies where they are when the row of their centre is exposed, by a rolling shutter whose middle row is exposed
        at the time of the picture. Other rows are not told apart: 0.5 mm at 0.3 m/s, 100 px of 960 and 15 ms of read-out."""
        rows = optics.see(bodies.eta[:, :3]).pixels[:, 1]
        late_s = self._camera.readout_s * (rows / self._camera.size_px[1] - 0.5)
        return bodies.later(np.where(np.isnan(rows), 0.0, late_s))  # NaN: above the lens


def _background(experiment: Experiment, seed: int) -> MovingBackground | StaticBackground:
    """The pool and its water without robots, at any time."""
    motion, random = experiment.sim.camera_motion, generator(seed, Stream.CAMERA, WATER)
    if not motion.moves:
        return StaticBackground(experiment, random)
    sway = CameraSway(experiment.camera, motion, generator(seed, Stream.CAMERA, SWAY))
    return MovingBackground(experiment, sway, random)


def _robot_sprites(experiment: Experiment, seed: int) -> list[BodySprite]:
    """The robots' sprites, with markers; each robot has its own shades of colour, or all the same (sim.picture.alike)."""
    shades = [0 if experiment.sim.picture.alike else i for i in range(len(experiment.robots))]
    return [
        BodySprite.robot(robot, experiment, generator(seed, Stream.CAMERA, ROBOTS, shade))
        for robot, shade in zip(experiment.robots, shades, strict=True)
    ]


def _landmarks(experiment: Experiment) -> Bodies:
    """Landmarks and check marks as bodies that rest."""
    marks, family = experiment.marks, experiment.localizer.marker_family
    return Bodies(
        [BodySprite.landmark(mark, experiment.camera.px_per_m, family) for mark in marks],
        np.array([[*mark.position_m, mark.yaw_rad] for mark in marks]),
        np.zeros((len(marks), 4)),
        np.zeros((len(marks), 2)),
    )


def _margin_px(experiment: Experiment) -> float:
    """Margin around a body's projection: MARGIN_PX, and by how much the wave displaces a line of sight at most."""
    wave, depth_m = SurfaceWave(experiment), experiment.pool.size_m[2]
    displacement_share = 0.25 * float(np.linalg.norm(wave.number)) * depth_m + STEEPEST  # of the wave's amplitude
    return MARGIN_PX + experiment.camera.px_per_m * wave.amplitude_m * displacement_share


def with_true_camera(experiment: Experiment) -> Experiment:
    """The experiment with camera and marker plates as they are, which the localizer knows up to the errors of sim.camera.
    Raises ConfigError for a camera that would hang in the water."""
    errors, camera, marker = experiment.sim.camera, experiment.camera, experiment.vehicle.marker
    place = tuple(float(value) for value in np.add(camera.position_m, errors.position_error_m))
    if place[2] >= 0.0:
        raise ConfigError(
            f"sim.camera.position_error_m.2 = {errors.position_error_m[2]:g}: the camera at z = {camera.position_m[2]:g} "
            f"would hang in the water (allowed: below {-camera.position_m[2]:g})"
        )
    turn = cv2.Rodrigues(np.array(errors.rotation_error_rad))[0] @ cv2.Rodrigues(np.array(camera.rotation_rad))[0]
    turned = tuple(float(value) for value in cv2.Rodrigues(turn)[0].ravel())
    lens = {
        "focal_px": tuple(focal * (1.0 + errors.focal_error) for focal in camera.focal_px),
        "position_m": place,
        "rotation_rad": turned if any(errors.rotation_error_rad) else camera.rotation_rad,
    }
    higher = marker.model_copy(update={"height_m": marker.height_m + errors.plate_error_m})
    return experiment.model_copy(
        update={
            "camera": camera.model_copy(update=lens),
            "vehicle": experiment.vehicle.model_copy(update={"marker": higher}),
        }
    )


def with_sunken_water(experiment: Experiment, drop_m: float) -> Experiment:
    """The experiment as it is seen when its water stands `drop_m` lower. The surface is z = 0 again, so camera, floor and
    marks are higher by that; robots sink with the water, as their pressure sensors tell."""

    def raised(thing: Raisable) -> Raisable:
        """The same, higher above the surface: z points down."""
        x, y, z = thing.position_m
        return thing.model_copy(update={"position_m": (x, y, z - drop_m)})

    length, width, depth = experiment.pool.size_m
    return experiment.model_copy(
        update={
            "landmarks": tuple(map(raised, experiment.landmarks)),
            "check_marks": tuple(map(raised, experiment.check_marks)),
            "camera": raised(experiment.camera),
            "pool": experiment.pool.model_copy(update={"size_m": (length, width, depth - drop_m)}),
        }
    )
