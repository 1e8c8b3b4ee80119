"""Robots whose marker plates are covered, glared on, dimmed or exchanged in rendered pictures, and the count of poses that are
wrong beyond what they claim."""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from types import MappingProxyType

import cv2
import numpy as np

from localizer.tracking.fleet_localizer import FleetLocalizer
from shoal.config.experiment import Experiment, load_experiment
from shoal.config.scene import RobotConfig
from shoal.frames import Array, body_to_pool, pool_to_body, wrap
from shoal.messages.messages import Pose, Track
from sim_bridge.camera.optics import project
from sim_bridge.camera.renderer import Renderer
from tests.localizer.scene import Pixels

ROBOTS, PERIOD_S, DEPTH_M = 6, 0.05, 0.3
_READ_FRAMES, _SPOILED_FRAMES = (10, 24), (3, 24)  # drawn from these ranges: a plate is read, then spoiled, and so on
# The robots are level and the depths true: what is left is the error of the picture.
_SURE = ("localizer.tilt_sigma_rad=0", "localizer.tilt_rad_per_n=0", "localizer.depth_sigma_m=0.002")
_GREY_DEPTH = 6.0  # grey levels, standard deviation of a cover's own grain
CLAIM_M = 0.005  # m; a pose that claims less than this has to be right
FALSE_SIGMAS = 5.0


@dataclass(frozen=True)
class PlateCase:
    """A robot's picture during one spoiled stretch: the truth (4,) and random numbers that stay as long as the stretch."""

    experiment: Experiment
    eta: Array
    since_s: float
    random: np.random.Generator
    draw: Array  # (8,), uniform in 0..1

    def pixels(self, body_m: Array) -> Array:
        """Pixels (n, 2) of points (n, 2) of the plate, metres ahead and to starboard."""
        places = self.eta[:2] + body_to_pool(body_m, float(self.eta[3]))
        depth = np.full(len(places), self.eta[2] - self.experiment.vehicle.marker.height_m)
        return np.asarray(project(self.experiment.camera, np.column_stack([places, depth])))

    def card(self, half_m: Array) -> Array:
        """Corners (4, 2) px of a card over the plate, half its sides (2,) ahead and to starboard."""
        return self.pixels(np.array([[1.0, -1.0], [1.0, 1.0], [-1.0, 1.0], [-1.0, -1.0]]) * half_m)


Spoil = Callable[[Pixels, PlateCase], None]


def _paint(frame: Pixels, corners_px: Array, grey: float, random: np.random.Generator) -> None:
    mask = np.zeros(frame.shape, np.uint8)
    cv2.fillConvexPoly(mask, np.rint(corners_px * 16).astype(np.int32), (255,), cv2.LINE_AA, 4)
    left, top, width, height = cv2.boundingRect(mask)
    box = np.s_[top : top + height, left : left + width]
    share, grain = mask[box] / 255.0, random.normal(grey, _GREY_DEPTH, (height, width))
    frame[box] = np.clip(frame[box] * (1.0 - share) + share * grain, 0, 255)


def _card(grey: float, low: float, high: float) -> Spoil:
    """A card of one grey, as wide as the marker times something between `low` and `high`."""

    def spoil(frame: Pixels, case: PlateCase) -> None:
        side = case.experiment.vehicle.marker.side_m * (low + (high - low) * case.draw[0])
        _paint(frame, case.card(np.full(2, side / 2.0)), grey, case.random)

    return spoil


def _glare(frame: Pixels, case: PlateCase) -> None:
    """A saturated disc with a soft edge, which drifts over the robot."""
    away = (case.draw[:2] - 0.5) * 0.12 + (case.draw[2:4] - 0.5) * 0.2 * case.since_s
    centre = case.pixels(pool_to_body((away)[None], float(case.eta[3])))[0]
    reach = 12.0 + 35.0 * case.draw[4]
    left, top = np.maximum(np.floor(centre - 2.5 * reach), 0).astype(int)
    right, bottom = np.ceil(centre + 2.5 * reach).astype(int)
    box = np.s_[top:bottom, left:right]
    y, x = np.mgrid[top : top + frame[box].shape[0], left : left + frame[box].shape[1]]
    light = 600.0 * np.exp(-0.5 * ((x - centre[0]) ** 2 + (y - centre[1]) ** 2) / (0.6 * reach) ** 2)
    frame[box] = np.clip(frame[box] + light, 0, 255)


def _dim(frame: Pixels, case: PlateCase) -> None:
    """A shadow over the whole robot."""
    box = cv2.boundingRect(np.rint(case.card(np.full(2, 1.3 * case.experiment.vehicle.radius_m))).astype(np.int32))
    rows, columns = slice(max(box[1], 0), box[1] + box[3]), slice(max(box[0], 0), box[0] + box[2])
    frame[rows, columns] = (frame[rows, columns] * (0.08 + 0.25 * case.draw[0])).astype(np.uint8)


def _other_pattern(frame: Pixels, case: PlateCase) -> None:
    """A marker that nobody knows, or the own one turned, where the own one was."""
    side, half = case.experiment.vehicle.marker.side_m, case.experiment.vehicle.marker.side_m * 2.0 / 3.0
    _paint(frame, case.card(np.full(2, half)), 215.0, case.random)
    _paint(frame, case.card(np.full(2, side / 2.0)), 25.0, case.random)
    cells = np.random.default_rng(int(case.draw[0] * 1e6)).random((4, 4)) < 0.5
    unit = side / 6.0
    for row, column in np.argwhere(cells):
        corner = np.array([side / 2.0 - unit * (row + 1), -side / 2.0 + unit * (column + 1)])
        _paint(frame, case.pixels(corner + unit * np.array([[0, 0], [0, 1], [-1, 1], [-1, 0]])), 205.0, case.random)


def _half_covered(frame: Pixels, case: PlateCase) -> None:
    """A card over one side of the plate."""
    side = case.experiment.vehicle.marker.side_m
    half = np.array([0.2 + 0.3 * case.draw[0], 0.7]) * side
    shift = np.array([(case.draw[1] - 0.5) * side, 0.0])
    corners = np.array([[1.0, -1.0], [1.0, 1.0], [-1.0, 1.0], [-1.0, -1.0]]) * half + shift
    _paint(frame, case.pixels(corners), 255.0 * case.draw[2], case.random)


SPOILS: Mapping[str, Spoil] = MappingProxyType({
    "white plate": _card(235.0, 1.0, 1.5),
    "dark plate": _card(25.0, 1.0, 1.5),
    "grey plate": _card(120.0, 1.0, 1.5),
    "half covered": _half_covered,
    "glare": _glare,
    "dim": _dim,
    "other pattern": _other_pattern,
})  # fmt: skip


@dataclass(frozen=True)
class SpoiledPose:
    """A published pose of a robot whose plate was spoiled since `frames` pictures, and its error [x, y, yaw]."""

    spoil: str
    robot: int
    frames: int
    pose: Pose
    error: Array

    @property
    def sigma_m(self) -> float:
        """Claimed standard deviation along the worse axis."""
        return float(np.sqrt(np.linalg.eigvalsh(self.pose.covariance[:2, :2])[-1]))

    @property
    def false(self) -> bool:
        """True if the pose is wrong and claims to be good."""
        off_m = float(np.hypot(*self.error[:2]))
        return self.pose.track is not Track.LOST and self.sigma_m < CLAIM_M and off_m > FALSE_SIGMAS * self.sigma_m

    @property
    def nees(self) -> float:
        """Squared error in units of the covariance."""
        return float(self.error @ np.linalg.solve(self.pose.covariance, self.error))


class _Courses:
    """Robots that swing about places of their own, in any direction, and turn: eta (n, 4) at any time."""

    def __init__(self, random: np.random.Generator) -> None:
        self._centres = np.array([[x, y] for x in (-1.1, 0.0, 1.1) for y in (-0.6, 0.6)])
        self._reach = random.uniform(0.05, 0.2, (ROBOTS, 2))
        self._rate, self._phase = random.uniform(0.2, 1.3, (ROBOTS, 2)), random.uniform(0.0, 2.0 * np.pi, (ROBOTS, 3))
        self._turn = random.uniform(-0.6, 0.6, ROBOTS)

    def eta(self, t_s: float) -> Array:
        place = self._centres + self._reach * np.sin(self._rate * t_s + self._phase[:, :2])
        yaw = self._phase[:, 2] + self._turn * t_s + 0.5 * np.sin(0.9 * t_s + self._phase[:, 0])
        return np.column_stack([place, np.full(ROBOTS, DEPTH_M), yaw])

    def nu(self, t_s: float) -> Array:
        step = (self.eta(t_s + 1e-4) - self.eta(t_s - 1e-4)) / 2e-4
        return np.column_stack([pool_to_body(step[:, :2], self.eta(t_s)[:, 3]), step[:, 2:]])


@dataclass(frozen=True)
class Film:
    """Pictures of six robots with readable markers, and the truth (n, 4) of each."""

    experiment: Experiment
    frames: tuple[Pixels, ...]
    eta: tuple[Array, ...]

    @classmethod
    def render(cls, seed: int, frames: int) -> "Film":
        """Render the courses of a seed, which begin and end at rest: played backwards no robot changes its speed at once."""
        courses = _Courses(np.random.default_rng([seed, 20]))
        starts = courses.eta(0.0).tolist()
        robots = tuple(RobotConfig(id=i + 1, node_m=(0.0, 0.0, 0.0), start=tuple(start)) for i, start in enumerate(starts))
        experiment = load_experiment("pool", [f"seed={seed}", *_SURE]).model_copy(update={"robots": robots})
        phase = np.pi * np.arange(frames) / (frames - 1)
        along_s, pace = 0.5 * (frames - 1) * PERIOD_S * (1.0 - np.cos(phase)), 0.5 * np.pi * np.sin(phase)
        etas, renderer = tuple(courses.eta(t_s) for t_s in along_s), Renderer(experiment, seed)
        pictures = (renderer.render(etas[k], pace[k] * courses.nu(along_s[k]), k * PERIOD_S, k) for k in range(frames))
        return cls(experiment, tuple(pictures), etas)

    def index(self, k: int) -> int:
        """The picture of step `k`: forwards and backwards again and again."""
        there, last = divmod(k, len(self.frames) - 1), len(self.frames) - 1
        return there[1] if there[0] % 2 == 0 else last - there[1]


def spoiled_poses(film: Film, seed: int, frames: int, spoils: Mapping[str, Spoil] = SPOILS) -> Iterator[SpoiledPose]:
    """Localize the robots of a film, each of which has its plate spoiled again and again, in ways drawn by the seed; yield
    their poses in those frames."""
    random, names = np.random.default_rng([seed, 21]), list(spoils)
    locator, depths = FleetLocalizer(film.experiment), dict.fromkeys(film.experiment.robot_ids, DEPTH_M)
    begin = random.integers(*_READ_FRAMES, ROBOTS)
    end = begin + random.integers(*_SPOILED_FRAMES, ROBOTS)
    which, draws = random.integers(len(names), size=ROBOTS), random.random((ROBOTS, 8))
    for k in range(frames):
        frame, eta = film.frames[film.index(k)].copy(), film.eta[film.index(k)]
        for i in np.flatnonzero((begin <= k) & (k < end)).tolist():
            case = PlateCase(film.experiment, eta[i], (k - begin[i]) * PERIOD_S, random, draws[i])
            spoils[names[which[i]]](frame, case)
        for robot, pose in locator.step(frame, round(k * PERIOD_S * 1e9), depths).poses:
            i = robot - 1
            if begin[i] <= k < end[i]:
                error = np.array([pose.x_m - eta[i, 0], pose.y_m - eta[i, 1], wrap(pose.yaw_rad - float(eta[i, 3]))])
                yield SpoiledPose(names[which[i]], robot, int(k - begin[i]), pose, error)
        for i in np.flatnonzero(end <= k).tolist():
            begin[i] = k + random.integers(*_READ_FRAMES)
            end[i] = begin[i] + random.integers(*_SPOILED_FRAMES)
            which[i], draws[i] = random.integers(len(names)), random.random(8)
