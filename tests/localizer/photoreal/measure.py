"""SHELL: the localizer on the photoreal data set: `python -m tests.localizer.photoreal.measure [ROW ...] [--split tune]`.

Each row is one run of the localizer from its start, told the depths that the robots report. The same courses drawn by the
simulator's renderer stand beside the rows that it can draw (`--renderer simulator`).
"""

import argparse
import dataclasses
from collections.abc import Callable, Iterator, Mapping

import numpy as np

from localizer.tracking.fleet_localizer import FleetLocalizer
from localizer.tracking.tilt import Attitude
from shoal.frames import Array, pool_to_body, wrap
from shoal.messages.messages import Pose, Track
from sim_bridge.camera.renderer import Renderer
from tests.localizer.photoreal.dataset import DATA, PERIOD_NS, TrueFrame, frames
from tests.localizer.photoreal.rows import RATE_HZ, ROWS, SPLITS, RowCourses, experiment

_FIRST = 2  # frames that do not count: in the first a marker is a claim, in the second a pose
_FALSE_SIGMAS, _FALSE_SIGMA_M = 5.0, 0.005  # a match is false if it is farther off than so many sigmas that are below this

SIMULATED = (
    "level",
    "tilt-2",
    "tilt-4",
    "tilt-6",
    "tilt-8",
    "blur",
    "rolling-shutter",
)  # rows that the simulator's renderer can draw
Frames = Callable[[str, str], Iterator[TrueFrame]]


@dataclasses.dataclass(frozen=True)
class Figures:
    """One row's errors. NEES: of position (2 if the covariance is right) and of the pose (3). LOST poses count in the shares
    alone, and so do robots without a pose."""

    row: str
    split: str
    poses: int
    rms_mm: float
    max_mm: float
    rms_deg: float
    nees_xy: float
    nees: float
    marker_pct: float
    kcf_pct: float
    coast_pct: float
    lost_pct: float
    false_matches: int


def measure(
    row: str,
    split: str,
    source: Frames = frames,
    true_depths: bool = False,
    with_attitudes: bool = True,
    by_outline: bool = False,
) -> Figures:
    """The figures of one row: the localizer through its normal entry point, frame by frame. `by_outline` sets
    `localizer.tilt_from_outline`."""
    pool = experiment(ROWS[row])
    settings = pool.localizer.model_copy(update={"tilt_from_outline": by_outline})
    pool = pool.model_copy(update={"localizer": settings})
    localizer = FleetLocalizer(pool)
    errors: list[tuple[Array, float, float, float]] = []
    tracks: list[Track] = []
    sigma_rad = pool.localizer.attitude_sigma_rad if with_attitudes else None
    for k, frame in enumerate(source(row, split)):
        depths = {robot: true.depth_m if true_depths else true.reported_depth_m for robot, true in frame.robots.items()}
        attitudes: dict[int, Attitude] = {} if sigma_rad is None else {
            robot: Attitude(true.reported_roll_rad, true.reported_pitch_rad, sigma_rad) for robot, true in frame.robots.items()
        }  # fmt: skip
        poses = dict(localizer.step(frame.pixels, frame.stamp_ns, depths, attitudes).poses)
        if k >= _FIRST:
            tracks += [poses[robot].track if robot in poses else Track.LOST for robot in frame.robots]
            errors += _errors(poses, frame)
    share = {track: 100.0 * float(np.mean([t is track for t in tracks])) for track in Track}
    error, sigma, nees_xy, nees = (np.array(values) for values in zip(*errors, strict=True))
    distance_mm = 1e3 * np.hypot(error[:, 0], error[:, 1])
    return Figures(
        row, split, len(tracks), _rms(distance_mm), float(distance_mm.max()), float(np.degrees(_rms(error[:, 2]))),
        float(np.mean(nees_xy)), float(np.mean(nees)),
        share[Track.MARKER], share[Track.KCF], share[Track.COAST], share[Track.LOST],
        int(np.sum((nees_xy > _FALSE_SIGMAS**2) & (sigma < _FALSE_SIGMA_M))),
    )  # fmt: skip


def _errors(poses: Mapping[int, Pose], frame: TrueFrame) -> Iterator[tuple[Array, float, float, float]]:
    """Of each robot that is not lost: error [x, y, yaw], the largest sigma of its place, NEES of place and pose."""
    for robot, true in frame.robots.items():
        pose = poses.get(robot)
        if pose is None or pose.track is Track.LOST:
            continue
        error = np.array([pose.x_m - true.pose[0], pose.y_m - true.pose[1], wrap(pose.yaw_rad - true.pose[2])])
        place = pose.covariance[:2, :2]
        yield (
            error, float(np.sqrt(np.linalg.eigvalsh(place)[-1])),
            float(error[:2] @ np.linalg.solve(place, error[:2])), float(error @ np.linalg.solve(pose.covariance, error)),
        )  # fmt: skip


def _rms(values: Array) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


def simulated(row: str, split: str) -> Iterator[TrueFrame]:
    """The frames of a row as the simulator's renderer draws them: same courses, tilt and reports, its own water and light."""
    courses, renderer = RowCourses(ROWS[row], split), Renderer(experiment(ROWS[row]), SPLITS.index(split) + 1)
    for k, frame in enumerate(frames(row, split)):
        states = courses.at(k / RATE_HZ)
        eta = np.column_stack([states.place_m, states.attitude_rad[:, 2]])
        speed = pool_to_body(states.velocity_mps, eta[:, 3])
        nu = np.column_stack([speed, np.zeros(len(eta)), states.yaw_rate_radps])
        pixels = renderer.render(eta, nu, k * PERIOD_NS / 1e9, k, states.attitude_rad[:, :2])
        yield dataclasses.replace(frame, pixels=pixels)


def rendered_rows(split: str) -> list[str]:
    """Rows whose pictures are there."""
    names = []
    for name, row in ROWS.items():
        drawn_as = row.drawn_as or name
        pictures = name if row.h264_crf is not None else drawn_as
        if (DATA / split / f"{drawn_as}.csv").exists() and (DATA / split / f"{pictures}.png").exists():
            names.append(name)
    return names


def main() -> None:
    """Print a Markdown table, a line as soon as it is measured."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("rows", nargs="*", metavar="ROW", help="all if none is named")
    parser.add_argument("--split", choices=SPLITS, default="tune")
    parser.add_argument("--renderer", choices=("mitsuba", "simulator"), default="mitsuba")
    parser.add_argument("--true-depths", action="store_true", help="tell the true depths instead of the reported ones")
    parser.add_argument("--no-attitudes", action="store_true", help="robots whose boards do not measure roll and pitch")
    parser.add_argument("--outline", action="store_true", help="localizer.tilt_from_outline; with --no-attitudes")
    choice = parser.parse_args()
    source = frames if choice.renderer == "mitsuba" else simulated
    names = choice.rows or [name for name in rendered_rows(choice.split) if source is frames or name in SIMULATED]
    columns = [field.name for field in dataclasses.fields(Figures)]
    print(f"| {' | '.join(columns)} |\n|{'---|' * len(columns)}")
    for name in names:
        how = choice.true_depths, not choice.no_attitudes, choice.outline
        values = dataclasses.astuple(measure(name, choice.split, source, *how))
        print(f"| {' | '.join(f'{v:.3g}' if isinstance(v, float) else str(v) for v in values)} |", flush=True)


if __name__ == "__main__":
    main()
