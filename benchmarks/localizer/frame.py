"""Cost of the localizer: per frame to the poses and in all, for fleets of one to twenty, also with a lost robot; the obstacle
watch; and the correlation filter alone beside the one of OpenCV's contrib modules, in the same pictures.

Frames are 1280 x 960, rendered between the measurements, so that each is as cold in the cache as one from the network.
One core; fleets and obstacles at real-time priority (SCHED_FIFO) where that is permitted, and a line says so where it is
not. The filters and their peers have ordinary priority, all of them. Robots are as large in the picture as in the pool scene
(100 px), which is the dear case.
The real video is the public `mouse` of the tracktor project with idTracker's places; SHOAL_DATA says where the folder
with it lies, otherwise shared/data beside the project. Without it, its rows are left out.
"""

import os
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import cv2
import numpy as np

from benchmarks.harness import ROOT, Row, run_peer
from benchmarks.localizer.following import Begin, Picture, Place, Step, Task, follow
from localizer.detection.obstacles import ObstacleDetector
from localizer.tracking.fleet_localizer import FleetLocalizer
from shoal.config.experiment import Experiment, load_experiment
from shoal.config.scene import RobotConfig
from shoal.frames import Array, wrap
from shoal.messages.messages import Track
from sim_bridge.camera.optics import project
from sim_bridge.camera.renderer import Renderer
from tests.localizer.plain_video.idtracker import read_idtracker
from tests.localizer.plain_video.single_object import SingleObjectTracker

FLEETS = (1, 3, 10, 20)
FRAMES = 120
WARM_UP = 24  # a robot that is taken away after a quarter of them is lost at their end
PERIOD_S = 0.05
SPACING_M = (0.62, 0.55)  # of the robots' circles: hulls 0.25 m apart at least
ROW_OF = 5  # robots
DENSE_ABOVE, DENSE_SPACING_M, DENSE_ROW_OF = 20, (0.48, 0.4), 7  # robots that fill the picture: hulls 0.1 m apart
CIRCLE_M = 0.10
CIRCLE_RADPS = 1.0  # 0.1 m/s
DEPTH_M = 0.3
AWAY_M = 50.0

PRIORITY = 5  # of SCHED_FIFO, 1 to 99

VIDEO_FRAMES = 3000
VIDEO_WINDOW_PX = 64.0
SYNTHETIC_FRAMES = 200
CONTRIB = ("opencv-contrib-python-headless==5.0.0.93",)


def _eta(count: int, t_s: float) -> Array:
    """Robots on a grid, each on a circle of its own, in step, so that none comes near another: (count, 4)."""
    dense = count > DENSE_ABOVE
    spacing_m = DENSE_SPACING_M if dense else SPACING_M
    columns = min(count, DENSE_ROW_OF if dense else ROW_OF)
    rows = -(-count // columns)
    index = np.arange(count)
    x = (index % columns - (columns - 1) / 2.0) * spacing_m[0]
    y = (index // columns - (rows - 1) / 2.0) * spacing_m[1]
    angle = CIRCLE_RADPS * t_s
    yaw = [wrap(float(angle + i)) for i in index]
    return np.column_stack([x + CIRCLE_M * np.cos(angle), y + CIRCLE_M * np.sin(angle), np.full(count, DEPTH_M), yaw])


def _nu(count: int, t_s: float) -> Array:
    """Body velocities to `_eta`: the tangent, seen from each heading."""
    behind = _eta(count, t_s)[:, 3] - (CIRCLE_RADPS * t_s + np.pi / 2.0)
    speed = CIRCLE_M * CIRCLE_RADPS
    return np.column_stack([speed * np.cos(behind), -speed * np.sin(behind), np.zeros(count), np.full(count, CIRCLE_RADPS)])


def _experiment(count: int, markers: bool) -> Experiment:
    pool = load_experiment("pool", [f"localizer.markers={str(markers).lower()}"])
    starts = _eta(count, 0.0).tolist()
    robots = tuple(RobotConfig(id=i + 1, node_m=(0.0, 0.0, 0.0), start=tuple(start)) for i, start in enumerate(starts))
    return pool.model_copy(update={"robots": robots})


def fleet(count: int, markers: bool, lost: bool = False, frames: int = FRAMES) -> Iterator[Row]:
    """Time to the poses and for the whole frame, and, so that nobody is fast by not looking, errors of the robots' centres
    over the same frames. With `lost` the first robot is taken out of the pool before they begin, and is lost throughout."""
    experiment = _experiment(count, markers)
    renderer, locator = Renderer(experiment, experiment.seed), FleetLocalizer(experiment)
    depths = dict.fromkeys(experiment.robot_ids, DEPTH_M)
    poses_ms, frames_ms, errors_mm, followed = [], [], [], 0
    for k in range(WARM_UP + frames):
        t_s = k * PERIOD_S
        eta = _eta(count, t_s)
        if lost and k >= WARM_UP // 4:
            eta[0, :2] = AWAY_M
        frame = renderer.render(eta, _nu(count, t_s), t_s, k)
        start_ns = time.perf_counter_ns()
        located = locator.locate(frame, round(t_s * 1e9), depths)
        located_ns = time.perf_counter_ns()
        locator.finish()
        if k >= WARM_UP:
            poses_ms.append((located_ns - start_ns) * 1e-6)
            frames_ms.append((time.perf_counter_ns() - start_ns) * 1e-6)
            followed_poses = [(r, pose) for r, pose in located.poses if pose.track in (Track.MARKER, Track.KCF)]
            followed += len(followed_poses)
            errors_mm += [1e3 * float(np.hypot(p.x_m - eta[r - 1, 0], p.y_m - eta[r - 1, 1])) for r, p in followed_poses]
    case = f"{count} robot{'s' if count > 1 else ''}" + (", one of them lost" if lost else "")
    subject = "ours, markers" if markers else "ours, no markers"
    p95_ms = sorted(poses_ms)[-(-95 * frames // 100) - 1]
    share = 100.0 * followed / ((count - lost) * frames)
    yield Row.of("localizer", case, subject, "ms to the poses", poses_ms)
    yield Row("localizer", case, subject, "ms to the poses, 95 %", p95_ms, p95_ms, p95_ms, frames)
    yield Row.of("localizer", case, subject, "ms per frame", frames_ms)
    yield Row.of("localizer", case, subject, "mm off", errors_mm)
    yield Row("localizer", case, subject, "% of robots seen", share, share, share, (count - lost) * frames)


def _obstacles() -> Iterator[Row]:
    """The obstacle watch beside two robots: it looks at every other frame."""
    experiment = _experiment(2, True)
    renderer, watch = Renderer(experiment, experiment.seed), ObstacleDetector(experiment)
    frames_ms = []
    for k in range(WARM_UP + FRAMES):
        t_s = k * PERIOD_S
        frame, robots = renderer.render(_eta(2, t_s), _nu(2, t_s), t_s, k), _eta(2, t_s)[:, :3]
        start_ns = time.perf_counter_ns()
        watch.step(frame, round(t_s * 1e9), robots)
        frames_ms.append((time.perf_counter_ns() - start_ns) * 1e-6)
    mean_ms = sum(frames_ms[WARM_UP:]) / FRAMES
    yield Row.of("localizer", "obstacle watch", "ours", "ms per frame", frames_ms[WARM_UP:])
    yield Row("localizer", "obstacle watch", "ours", "ms per frame, mean", mean_ms, mean_ms, mean_ms, FRAMES)


# --- the correlation filter alone


def _ours(window_px: float) -> Begin:
    def begin(picture: Picture, place: Place) -> Step:
        follower = SingleObjectTracker(picture, np.array(place), window_px)

        def step(picture: Picture) -> Place:
            (x, y, _), _ = follower.step(picture)
            return float(x), float(y)

        return step

    return begin


def _synthetic(folder: Path) -> Task:
    """A robot without a marker circles and turns under waves, caustics and glare."""
    experiment = _experiment(1, markers=False)
    renderer, file = Renderer(experiment, experiment.seed), folder / "synthetic.npy"
    steps = [k * PERIOD_S for k in range(SYNTHETIC_FRAMES)]
    np.save(file, np.stack([renderer.render(_eta(1, t_s), _nu(1, t_s), t_s, k) for k, t_s in enumerate(steps)]))
    plate = np.array([0.0, 0.0, experiment.vehicle.marker.height_m])
    tops = np.stack([_eta(1, t_s)[0, :3] - plate for t_s in steps])
    places = project(experiment.camera, tops)
    rim = project(experiment.camera, tops[:1] + np.array([experiment.vehicle.radius_m, 0.0, 0.0]))
    window_px = 2.0 * float(np.linalg.norm(rim - places[:1]))
    return Task("rendered robot, no marker", str(file), [(float(x), float(y)) for x, y in places], window_px)


def _video() -> Task | None:
    """The real video, if it is at hand."""
    folder = Path(os.environ.get("SHOAL_DATA", ROOT.parent / "shared" / "data")) / "mouse"
    if not folder.is_dir():
        print(f"real video not measured: no folder {folder} (SHOAL_DATA says where)", file=sys.stderr)
        return None
    (places,) = read_idtracker(folder / "mouse_video_idtracked.txt")
    places_px = [(float(x), float(y)) for x, y in places[:VIDEO_FRAMES]]
    return Task(f"mouse video, first {VIDEO_FRAMES:,}", str(folder / "mouse_video.mp4"), places_px, VIDEO_WINDOW_PX)


@contextmanager
def real_time() -> Iterator[None]:
    """Take one core, and let no program of the ordinary scheduler before this one."""
    cores = os.sched_getaffinity(0)
    try:
        os.sched_setaffinity(0, {max(cores)})
        os.sched_setscheduler(0, os.SCHED_FIFO | os.SCHED_RESET_ON_FORK, os.sched_param(PRIORITY))
    except OSError as error:
        print(f"not at real-time priority, other programs take their share: {error}", file=sys.stderr)
    try:
        yield
    finally:
        os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))
        os.sched_setaffinity(0, cores)


def run() -> Iterator[Row]:
    """Fleets, obstacles, then the filters."""
    cv2.setNumThreads(1)
    with real_time():
        rows = [row for count in FLEETS for markers in (True, False) for row in fleet(count, markers)]
        rows += [row for count in FLEETS[1:] for row in fleet(count, markers=True, lost=True)]
        rows += _obstacles()
    yield from rows
    with tempfile.TemporaryDirectory() as folder:
        tasks = [task for task in (_synthetic(Path(folder)), _video()) if task is not None]
        peers = run_peer("kcf_contrib", CONTRIB, [task.as_dict() for task in tasks])
        for task in tasks:
            ours = follow(task, "ours", _ours(task.window_px))
            beside = [row for row in peers if row.case == task.case]
            for row in ours:
                yield row
                yield from (other for other in beside if other.unit == row.unit)
