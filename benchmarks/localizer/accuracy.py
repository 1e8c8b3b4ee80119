"""Errors of the localizer in rendered frames with known truth: waves, glare, caustics, refraction, motion blur, sensor
noise, imperfect depth sensors. Errors of position are distances in the plane. Robots on prescribed courses are level; in the
flights they lean as the plant does.

A sample is the RMS over a run, runs differ by seed (water, paint, courses): `max` is the worst of the seeds. Beside ours, in
the same frames: OpenCV's markers with its default settings through our optics, the pose that `solvePnP` makes of them in a
camera that knows nothing of water, and a correlation filter over the picture as it is, not turned with the robot.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import groupby
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2

from benchmarks.harness import Row
from groundstation.planning import planner
from localizer.camera_model import RefractiveCamera
from localizer.detection.correlation_filter import CorrelationFilter, FilterShape
from localizer.tracking.fleet_localizer import FleetLocalizer
from shoal.config.experiment import Experiment, load_experiment
from shoal.config.scene import RobotConfig
from shoal.frames import Array, pool_to_body, wrap
from shoal.messages.messages import Pose, Track, Trajectory, required
from sim_bridge.camera.optics import project
from sim_bridge.camera.renderer import Renderer
from sim_bridge.in_process.fleet import AgentFleet, DirectPlant

SEEDS = range(1, 6)
PERIOD_S = 0.05
RUN_S = 15.0
CROWD_S = 18.0  # ten robots, five seeds: 15 robot-minutes
NO_MARKERS = "localizer.markers=false"
# 18 px across: 60 px/m from 16.7 m above the water.
HALL = ("pool.size_m=[16, 16, 1]", "camera.position_m=[0, 0, -16.75]", "camera.distortion=[0, 0, 0, 0, 0]", NO_MARKERS)
SENSOR_BIAS_M, SENSOR_NOISE_M = 0.003, 0.002  # of depth, as in the experiment's [sim.sensors]
CONFIDENCE = 0.95
FLIGHT_SEEDS, FLIGHT_S = range(1, 4), 20.0
AWAY_M = 50.0
UNDETECTED_S = 0.3  # a swap not flagged by then is not detected

Frame = NDArray[np.uint8]
Poses = dict[int, Array]  # by robot (index): [x, y, yaw], yaw NaN where not measured
Baseline = Callable[[Frame, Array], Poses]  # frame, true depths of the plates -> poses


class DrawnCourses:
    """Smooth courses of their own for each robot: eta (n, 4) at any time, inside `centres_m` +- `reach_m`."""

    def __init__(self, seed: int, centres_m: Sequence[tuple[float, float]], reach_m: tuple[float, float], speed_mps: float):
        random, n = np.random.default_rng([seed, 77]), len(centres_m)
        self._centres, self._reach = np.array(centres_m), np.array(reach_m)
        sides = random.choice([-1, 1], (n, 3))
        self._rates = speed_mps / max(reach_m) * random.uniform(0.7, 1.3, (n, 2)) * sides[:, :2]
        self._phases = random.uniform(0.0, 2.0 * np.pi, (n, 4))
        self._turn, self._swing = random.uniform(0.15, 0.5, n) * sides[:, 2], random.uniform(0.5, 1.0, n)
        self._depths = 0.3 if n <= 2 else np.linspace(0.2, 0.75, n)[random.permutation(n)]  # a crowd overlaps in the picture

    def eta(self, t_s: float) -> Array:
        place = self._centres + self._reach * np.sin(self._rates * t_s + self._phases[:, :2])
        yaw = self._phases[:, 2] + self._turn * t_s + 0.4 * np.sin(self._swing * t_s)
        depth = self._depths + 0.03 * np.sin(0.5 * t_s + self._phases[:, 3])
        return np.column_stack([place, depth, yaw])

    def nu(self, t_s: float) -> Array:
        h = 1e-4
        rate = (self.eta(t_s + h) - self.eta(t_s - h)) / (2.0 * h)
        return np.column_stack([pool_to_body(rate[:, :2], self.eta(t_s)[:, 3]), rate[:, 2:]])


@dataclass
class MeasuredRun:
    """Errors [x, y, yaw] of one run by subject, and our covariances."""

    errors: dict[str, list[Array]] = field(default_factory=dict)
    nees: list[Array] = field(default_factory=list)  # per frame: (robots,)

    def add(self, subject: str, poses: Poses, eta: Array) -> None:
        rows = [[p[0] - eta[i, 0], p[1] - eta[i, 1], wrap(float(p[2] - eta[i, 3]))] for i, p in poses.items()]
        self.errors.setdefault(subject, []).extend(np.array(row) for row in rows)

    def rms(self, subject: str) -> tuple[float, float]:
        """Millimetres and degrees."""
        mean = np.mean(np.square(self.errors[subject]), axis=0)
        return 1e3 * float(np.sqrt(mean[0] + mean[1])), float(np.degrees(np.sqrt(mean[2])))


def _experiment(seed: int, courses: DrawnCourses, settings: Sequence[str]) -> Experiment:
    starts = [f"robots.{i}.start={eta}" for i, eta in enumerate(courses.eta(0.0).tolist())]
    return load_experiment("pool", [*settings, *starts, f"seed={seed}"])


def _fly(
    seed: int, courses: DrawnCourses, settings: Sequence[str], baselines: dict[str, Baseline], depth_error_m: float
) -> MeasuredRun:
    experiment = _experiment(seed, courses, settings)
    renderer, locator, random, run = (
        Renderer(experiment, seed),
        FleetLocalizer(experiment),
        np.random.default_rng([seed, 5]),
        MeasuredRun(),
    )
    n, height_m = len(experiment.robots), experiment.vehicle.marker.height_m
    bias = random.normal(0.0, SENSOR_BIAS_M, n) + depth_error_m
    for k in range(round(RUN_S / PERIOD_S)):
        eta = courses.eta(k * PERIOD_S)
        frame = renderer.render(eta, courses.nu(k * PERIOD_S), k * PERIOD_S, k)
        depths = eta[:, 2] + bias + random.normal(0.0, SENSOR_NOISE_M, n)
        reported = dict(zip(experiment.robot_ids, depths.tolist(), strict=True))
        poses = dict(locator.step(frame, round(k * PERIOD_S * 1e9), reported).poses)
        if k == 0:
            continue  # without markers it is told where robots start
        ours = {i: poses[r] for i, r in enumerate(experiment.robot_ids) if r in poses}
        run.add("ours", {i: np.array([p.x_m, p.y_m, p.yaw_rad]) for i, p in ours.items()}, eta)
        run.nees.append(np.array([_nees(pose, eta[i]) for i, pose in ours.items()]))
        for subject, baseline in baselines.items():
            run.add(subject, baseline(frame, depths - height_m), eta)
    return run


def _nees(pose: Pose, eta: Array) -> float:
    error = np.array([pose.x_m - eta[0], pose.y_m - eta[1], wrap(pose.yaw_rad - float(eta[3]))])
    return float(error @ np.linalg.solve(pose.covariance, error))


def _accuracy(
    case: str, place: tuple[Sequence[tuple[float, float]], tuple[float, float], float], settings: Sequence[str],
    baselines: Callable[[Experiment, DrawnCourses], dict[str, Baseline]], depth_error_m: float = 0.0,
) -> Iterator[Row]:  # fmt: skip
    runs = []
    for seed in SEEDS:
        courses = DrawnCourses(seed, *place)
        beside = baselines(_experiment(seed, courses, settings), courses)
        runs.append(_fly(seed, courses, settings, beside, depth_error_m))
    for subject in runs[0].errors:
        figures = np.array([run.rms(subject) for run in runs])
        yield Row.of("accuracy", case, subject, "mm RMS", figures[:, 0].tolist())
        if np.all(np.isfinite(figures[:, 1])):
            yield Row.of("accuracy", case, subject, "deg RMS", figures[:, 1].tolist())
    yield from _consistency(case, np.concatenate([np.array(run.nees) for run in runs], axis=1))


def _consistency(case: str, nees: Array) -> Iterator[Row]:
    """Squared errors in units of the published covariance, (frames, robots of all runs). Errors of one run hang together (a
    depth sensor's zero stays), so that only as many count as independent as there are robots."""
    n = nees.shape[1]
    low, high = chi2.ppf([(1 - CONFIDENCE) / 2, (1 + CONFIDENCE) / 2], 3 * n) / n
    mean = float(nees.mean())
    yield Row("accuracy", case, f"ours, band {low:.2f}-{high:.2f}", "NEES, mean", mean, mean, mean, n)
    share = 100.0 * float(np.mean(nees < chi2.ppf(CONFIDENCE, 3)))
    yield Row("accuracy", case, "ours", "% in own 95 % ellipsoid", share, share, share, nees.size)


# --- robots that lean


class _SeenFleet(AgentFleet):
    """A flight of the plant, and what two localizers make of it: one sees the robots as they lean, the other one level."""

    def __init__(self, experiment: Experiment, trajectories: Mapping[int, Trajectory], water: DirectPlant, seed: int) -> None:
        super().__init__(experiment, trajectories, water, seed)
        self.runs = {"leaning": MeasuredRun(), "level": MeasuredRun()}
        self.lean_rad: list[float] = []
        self._flown, self._renderer, self._frames = water, Renderer(experiment, seed), 0
        self._locators = {how: FleetLocalizer(experiment) for how in self.runs}

    def expose(self, stamp_ns: int) -> None:
        super().expose(stamp_ns)
        water, ids = self._flown, self.experiment.robot_ids
        depths = {
            i: required(robot.states[-1].board).depth_m for i, robot in zip(ids, self.robots, strict=True) if robot.states
        }
        self._frames += 1
        self.lean_rad += np.hypot(*water.tilt[:, :2].T).tolist()
        for how, run in self.runs.items():
            tilt = water.tilt if how == "leaning" else None
            frame = self._renderer.render(water.eta, water.nu, self._frames * PERIOD_S, self._frames, tilt)
            poses = dict(self._locators[how].step(frame, stamp_ns, depths).poses)
            if len(poses) < len(ids):
                continue
            run.add(
                "ours", {k: np.array([poses[i].x_m, poses[i].y_m, poses[i].yaw_rad]) for k, i in enumerate(ids)}, water.eta
            )
            run.nees.append(np.array([_nees(poses[i], eta) for i, eta in zip(ids, water.eta, strict=True)]))


def _leaning(case: str, name: str, settings: Sequence[str]) -> Iterator[Row]:
    """Robots flown by their controllers, whose tilt is the plant's: the same flight rendered with it, and level."""
    figures: dict[str, list[tuple[float, float, float]]] = {"leaning": [], "level": []}
    leans = []
    for seed in FLIGHT_SEEDS:
        experiment = load_experiment(name, [*settings, f"seed={seed}"])
        trajectories = planner.plan(experiment)
        starts = planner.start_poses(experiment, trajectories)
        water = DirectPlant(experiment, seed, np.array([starts[i] for i in experiment.robot_ids]))
        fleet = _SeenFleet(experiment, trajectories, water, seed)
        fleet.start()
        while fleet.time_s < FLIGHT_S:
            fleet.step()
        leans.append(float(np.degrees(np.sqrt(np.mean(np.square(fleet.lean_rad))))))
        for how, run in fleet.runs.items():
            figures[how].append((*run.rms("ours"), float(np.mean(run.nees))))
    yield Row.of("accuracy", case, "the plant", "deg of lean, RMS", leans)
    for how, errors in figures.items():
        for unit, values in zip(("mm RMS", "deg RMS", "NEES, mean"), np.array(errors).T, strict=True):
            yield Row.of("accuracy", case, f"ours, {how}", unit, values.tolist())


# --- what others would do


def _aruco_alone(experiment: Experiment, _: DrawnCourses) -> dict[str, Baseline]:
    settings = cv2.aruco.DetectorParameters()
    settings.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
    detector = cv2.aruco.ArucoDetector(cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50), settings)
    robots = {robot.marker: i for i, robot in enumerate(experiment.robots)}
    camera, view, side_m = experiment.camera, RefractiveCamera(experiment.camera), experiment.vehicle.marker.side_m
    matrix = np.array([[camera.focal_px[0], 0, camera.centre_px[0]], [0, camera.focal_px[1], camera.centre_px[1]], [0, 0, 1]])
    square = side_m / 2.0 * np.array([[1.0, -1.0, 0.0], [1.0, 1.0, 0.0], [-1.0, 1.0, 0.0], [-1.0, -1.0, 0.0]])

    def found(frame: Frame) -> dict[int, Array]:
        corners, ids, _ = detector.detectMarkers(cv2.cvtColor(frame, cv2.COLOR_BayerRGGB2GRAY))
        pairs = zip([] if ids is None else [int(i) for i in ids.ravel()], corners, strict=True)
        return {robots[i]: np.asarray(c, dtype=np.float64).reshape(4, 2) for i, c in pairs if i in robots}

    def optics(frame: Frame, plates_m: Array) -> Poses:
        poses = {}
        for robot, corners in found(frame).items():
            at = view.pixel_to_pool(corners, float(plates_m[robot]))
            ahead = at[0] + at[1] - at[2] - at[3]
            poses[robot] = np.append(at.mean(axis=0), np.arctan2(ahead[1], ahead[0]))
        return poses

    def pinhole(frame: Frame, plates_m: Array) -> Poses:
        turn = np.asarray(cv2.Rodrigues(np.array(camera.rotation_rad))[0])
        poses = {}
        for robot, corners in found(frame).items():
            _, rotation, shift = cv2.solvePnP(square, corners, matrix, np.array(camera.distortion))
            ahead = turn.T @ np.asarray(cv2.Rodrigues(rotation)[0])[:, 0]
            place = turn.T @ shift.ravel() + camera.position_m
            poses[robot] = np.array([place[0], place[1], np.arctan2(ahead[1], ahead[0])])
        return poses

    return {"ArUco alone": optics, "ArUco, solvePnP, no water": pinhole}


def _plain_kcf(experiment: Experiment, courses: DrawnCourses) -> dict[str, Baseline]:
    """Henriques' tracker as published: patch in the picture's frame, 2.5 robots wide, learning from every frame."""
    view, size, n = RefractiveCamera(experiment.camera), 64, len(experiment.robots)
    start = courses.eta(0.0)
    plates = start[:, 2] - experiment.vehicle.marker.height_m
    places = view.pool_to_pixel(np.column_stack([start[:, :2], plates]))
    rim = view.pool_to_pixel(np.column_stack([start[:, :2] + [experiment.vehicle.radius_m, 0.0], plates]))
    pitch = 2.5 * 2.0 * np.linalg.norm(rim - places, axis=1) / size
    shape = FilterShape(size, size, 3, target_width=2.5, kernel_width=0.5, windowed=True, regularisation=1e-4)
    tracker, everyone = CorrelationFilter(n, shape), np.arange(n)
    started = False

    def patches(colour: Frame) -> NDArray[np.float32]:
        cut = []
        for i in range(n):
            warp = np.array([[pitch[i], 0.0, places[i, 0] - pitch[i] * (size // 2)],
                             [0.0, pitch[i], places[i, 1] - pitch[i] * (size // 2)]])  # fmt: skip
            patch = cv2.warpAffine(colour, warp, (size, size), flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP)
            cut.append(np.moveaxis(patch, -1, 0).astype(np.float32))
        return np.stack(cut)

    def follow(frame: Frame, plates_m: Array) -> Poses:
        nonlocal started
        colour = cv2.GaussianBlur(cv2.cvtColor(frame, cv2.COLOR_BayerRGGB2BGR), (0, 0), 1.0)
        if started:
            places[:] += tracker.detect(everyone, patches(np.asarray(colour, dtype=np.uint8)))[0] * pitch[:, None]
        rates = np.full(n, 0.02 if started else 1.0, np.float32)
        tracker.learn(everyone, patches(np.asarray(colour, dtype=np.uint8)), rates)
        started = True
        return {i: np.append(view.pixel_to_pool(places[i], float(plates_m[i])), np.nan) for i in range(n)}

    return {"KCF, not turned": follow}


# --- coming back, and staying oneself


def _paint_over(frame: Frame, experiment: Experiment, eta: Array) -> None:
    """A grey card over the plate of a robot at eta (4,)."""
    half = 0.85 * experiment.vehicle.marker.side_m
    card = pool_to_body(half * np.array([[1.0, -1.0], [1.0, 1.0], [-1.0, 1.0], [-1.0, -1.0]]), -eta[3])
    depth = np.full(4, eta[2] - experiment.vehicle.marker.height_m)
    corners = project(experiment.camera, np.column_stack([eta[:2] + card, depth]))
    cv2.fillConvexPoly(frame, np.rint(corners).astype(np.int32), (110,))


def _reacquisition() -> Iterator[Row]:
    """A robot is gone for 3 s, comes back at another place: until the first pose that is right and verified."""
    samples = []
    for seed in SEEDS:
        courses = DrawnCourses(seed, ((0.8, 0.0), (-0.8, 0.0)), (0.65, 0.9), 0.15)
        experiment, random = _experiment(seed, courses, ()), np.random.default_rng([seed, 6])
        renderer, locator, k = Renderer(experiment, seed), FleetLocalizer(experiment), 0
        for _ in range(6):
            gone, place = k + int(random.integers(5, 15)), random.uniform([-1.4, -1.0], [1.4, 1.0])
            back, is_found = gone + 60, False
            while not is_found:
                eta = courses.eta(k * PERIOD_S)
                if k >= gone:
                    eta[0, :2] = place if k >= back else AWAY_M
                frame = renderer.render(eta, np.zeros((2, 4)), k * PERIOD_S, k)
                depths = dict(zip(experiment.robot_ids, eta[:, 2].tolist(), strict=True))
                pose = dict(locator.step(frame, round(k * PERIOD_S * 1e9), depths).poses).get(experiment.robot_ids[0])
                right = (
                    pose is not None
                    and pose.identity_verified
                    and bool(np.hypot(pose.x_m - eta[0, 0], pose.y_m - eta[0, 1]) < 0.01)
                )
                is_found, k = k >= back and right, k + 1
            samples.append((k - 1 - back) * PERIOD_S)
    yield Row.of("accuracy", "lost for 3 s, back elsewhere", "ours", "s until found", samples)


def _identity() -> Iterator[Row]:
    """Ten robots in one paint at ten depths cross and cover each other; each one's marker is hidden a third of the time."""
    wrong, unflagged, doubted, placed, undetected = [], [], [], [], 0
    read: list[Any] = []
    for seed in SEEDS:
        n = 10
        courses = DrawnCourses(seed, ((0.0, 0.0),) * n, (1.4, 0.95), 0.3)
        pool = load_experiment("pool", [f"seed={seed}", "sim.picture.alike=true"])
        experiment = pool.model_copy(update={"robots": tuple(RobotConfig(id=i + 1, node_m=(0.0, 0.0, 0.0)) for i in range(n))})
        renderer, locator, random = Renderer(experiment, seed), FleetLocalizer(experiment), np.random.default_rng([seed, 8])
        aruco = _aruco_alone(experiment, courses)["ArUco alone"]
        hidden, silent = np.zeros(n, dtype=bool), np.zeros((round(CROWD_S / PERIOD_S), n), dtype=bool)
        for k in range(len(silent)):
            eta = courses.eta(k * PERIOD_S)
            hidden ^= random.random(n) < np.where(hidden, PERIOD_S / 2.0, PERIOD_S / 4.0)  # for 2 s after 4 s, on average
            frame = renderer.render(eta, courses.nu(k * PERIOD_S), k * PERIOD_S, k)
            for covered in np.flatnonzero(hidden):
                _paint_over(frame, experiment, eta[covered])
            depths = dict(zip(experiment.robot_ids, eta[:, 2].tolist(), strict=True))
            poses = dict(locator.step(frame, round(k * PERIOD_S * 1e9), depths).poses)
            for i, pose in ((i, poses[r]) for i, r in enumerate(experiment.robot_ids) if r in poses):
                away = bool(np.hypot(pose.x_m - eta[i, 0], pose.y_m - eta[i, 1]) > experiment.vehicle.radius_m)
                silent[k, i] = away and pose.identity_verified
                wrong.append(away)
                unflagged.append(silent[k, i])
                doubted.append(not pose.identity_verified)
                placed.append(pose.track >= Track.KCF and not away)
            plates = eta[:, 2] - experiment.vehicle.marker.height_m
            read.extend(i in aruco(frame, plates) for i in range(n)) if k % 5 == 0 else None
        episodes = [len(list(group)) for column in silent.T for bad, group in groupby(column) if bad]
        undetected += sum(length * PERIOD_S > UNDETECTED_S for length in episodes)
    case = "10 look-alike robots, 15 robot-min"
    yield Row("accuracy", case, "ours", "undetected swaps", undetected, undetected, undetected, len(wrong))
    shares = (
        ("wrong, not flagged", unflagged),
        ("wrong, flagged or not", wrong),
        ("doubted", doubted),
        ("seen, right", placed),
    )
    for what, values in (*((f"% {w}", v) for w, v in shares),):
        share = 100.0 * float(np.mean(values))
        yield Row("accuracy", case, "ours", what, share, share, share, len(values))
    share = 100.0 * float(np.mean(read))
    yield Row("accuracy", case, "ArUco alone", "% seen, right", share, share, share, len(read))


def run() -> Iterator[Row]:
    """Every case, all seeds."""
    cv2.setNumThreads(1)
    pool = (((0.8, 0.0), (-0.8, 0.0)), (0.65, 0.9), 0.15)
    hall = (((3.5, 0.0), (-3.5, 0.0)), (3.0, 6.0), 0.25)
    yield from _accuracy("pool, markers", pool, (), _aruco_alone)
    yield from _accuracy("pool, looks only", pool, (NO_MARKERS,), _plain_kcf)
    yield from _accuracy("16 x 16 m, robots 18 px, looks only", hall, HALL, _plain_kcf)
    yield from _accuracy("pool, markers, depth 2 cm wrong", pool, (), _aruco_alone, depth_error_m=0.02)
    yield from _leaning("flight, pool scene, 0.014 m/s", "pool", ())
    yield from _leaning("flight, figure of eight, 0.1 m/s", "figure-eight", ())
    yield from _leaning("flight, circle, 0.3 m/s", "pool", ("path.lap_s=10", "path.diameter_m=1.0"))
    yield from _reacquisition()
    yield from _identity()
