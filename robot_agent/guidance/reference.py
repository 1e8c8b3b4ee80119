"""Goals, their samples over the horizon, and the splice of one trajectory onto another in flight."""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from shoal.frames import Array
from shoal.kernels.decorator import kernel
from shoal.kernels.types import Cube, Floats, Table
from shoal.messages.messages import Trajectory


@kernel
def interpolate_rows(table: Table, place: Floats, out: Table) -> None:
    """Rows of `table` (rows, columns) at fractional row numbers `place` (n,), linearly; held beyond its ends. `out` (n,
    columns)."""
    last = len(table) - 1
    for i in range(len(place)):
        within = min(place[i], float(last)) if place[i] > 0.0 else 0.0  # NaN is no row either
        low = int(within)
        high = min(low + 1, last)
        share = within - low
        for j in range(table.shape[1]):
            out[i, j] = table[low, j] + share * (table[high, j] - table[low, j])


@kernel
def sample_trajectory(
    samples: Cube, begin_s: float, period_s: float, time_s: float, rate: float, waits_s: float, offset_s: Floats, out: Cube
) -> None:
    """Write poses, velocities and accelerations of a trajectory, `rate` times as fast, at some offsets from now into `out`
    (3, offsets, 4). Its `samples` (3, n, 4) are `period_s` apart from `begin_s` on, and interpolated linearly.

        time of the trajectory = time_s + rate (offset_s - waits_s)    velocity: times rate    acceleration: times rate^2

    At rest at `time_s` until `waits_s` are over, and at the first and the last pose before and after the trajectory.
    """
    path, path_velocity, path_acceleration = samples[0], samples[1], samples[2]
    eta, velocity, acceleration = out[0], out[1], out[2]
    last = len(path) - 1
    for k in range(len(offset_s)):
        place = (time_s + rate * max(offset_s[k] - waits_s, 0.0) - begin_s) / period_s
        within = min(place, float(last)) if place > 0.0 else 0.0  # NaN is no row either
        moves = rate if 0.0 <= place <= last and offset_s[k] >= waits_s else 0.0
        low = int(within)
        high = min(low + 1, last)
        share = within - low
        for c in range(4):
            eta[k, c] = path[low, c] + share * (path[high, c] - path[low, c])
            velocity[k, c] = moves * (path_velocity[low, c] + share * (path_velocity[high, c] - path_velocity[low, c]))
            change = path_acceleration[low, c] + share * (path_acceleration[high, c] - path_acceleration[low, c])
            acceleration[k, c] = moves * moves * change


@dataclass(frozen=True, eq=False)
class Follow:
    """Goal: fly a trajectory. `time_s` is the time along it now (before its beginning the robot waits at its first pose), and
    `rate` its speed: 1 as planned, 0 while the formation waits, above 1 while it catches up. The robot rests there for
    `waits_s` first."""

    trajectory: Trajectory
    time_s: float
    rate: float = 1.0
    waits_s: float = 0.0


@dataclass(frozen=True, eq=False)
class Hold:
    """Goal: keep station near a pose, shape (4,). Keep the same object as long as the hold lasts."""

    eta: Array


@dataclass(frozen=True, eq=False)
class Drive:
    """Goal: move from a pose, shape (4,), at a constant velocity in the body frame for `lasts_s`, then rest."""

    eta: Array
    surge_mps: float
    heave_mps: float
    yaw_rate_radps: float
    lasts_s: float


Goal = Follow | Hold | Drive


def is_other_goal(before: Goal | None, goal: Goal) -> bool:
    """True if what a robot does changes: goals of one kind follow one another, but each HOLD has a place of its own."""
    return type(before) is not type(goal) or (isinstance(goal, Hold) and before is not goal)


class Reference(NamedTuple):
    """Reference at now and at the horizon's nodes: rows 0 (now), 1.. (nodes 0..horizon)."""

    eta: Array  # (horizon + 2, 4)
    velocity: Array  # (horizon + 2, 4)
    acceleration: Array  # (horizon + 2, 4)


class ReferenceSampler:
    """Sampler of goals at now and at `offsets_s` (nodes) later."""

    def __init__(self, offsets_s: Array) -> None:
        self._offsets_s = np.concatenate([[0.0], offsets_s])
        self._path: Trajectory | None = None
        self._samples = np.zeros((3, 0, 4))
        self._rows = np.zeros((3, len(self._offsets_s), 4))
        self._sampled = Reference(*self._rows)

    def sample(self, goal: Goal) -> Reference:
        """Sample a goal over the horizon. The result holds until the next one."""
        count = len(self._offsets_s)
        if isinstance(goal, Hold):
            return Reference(np.tile(goal.eta, (count, 1)), np.zeros((count, 4)), np.zeros((count, 4)))
        if isinstance(goal, Drive):
            return self._driven(goal)
        path = goal.trajectory
        if path is not self._path:
            self._samples, self._path = np.array((path.eta, path.velocity, path.acceleration)), path
        sample_trajectory(
            self._samples, path.begin_s, path.period_s, goal.time_s, goal.rate, goal.waits_s, self._offsets_s, self._rows
        )
        return self._sampled

    def _driven(self, goal: Drive) -> Reference:
        """Arc of a constant surge and yaw rate: the chord after t is surge t sinc(yaw rate t / 2), in the mean heading."""
        time_s = np.clip(self._offsets_s, 0.0, goal.lasts_s)
        turned = goal.yaw_rate_radps * time_s
        chord_m = goal.surge_mps * time_s * np.sinc(turned / (2.0 * np.pi))  # NumPy's sinc is that of pi x
        mean, yaw = goal.eta[3] + 0.5 * turned, goal.eta[3] + turned
        eta = np.column_stack([
            goal.eta[0] + chord_m * np.cos(mean), goal.eta[1] + chord_m * np.sin(mean),
            goal.eta[2] + goal.heave_mps * time_s, yaw,
        ])  # fmt: skip
        moves = (self._offsets_s < goal.lasts_s).astype(np.float64)
        ahead, spin, zero = np.column_stack([np.cos(yaw), np.sin(yaw)]), goal.yaw_rate_radps, np.zeros((len(yaw), 2))
        velocity = np.column_stack([goal.surge_mps * ahead, np.full((len(yaw), 2), (goal.heave_mps, spin))])
        bend = np.column_stack([goal.surge_mps * spin * np.column_stack([-ahead[:, 1], ahead[:, 0]]), zero])
        return Reference(eta, velocity * moves[:, None], bend * moves[:, None])


def interpolate(table: Array, place: Array) -> Array:
    """Rows of a writable table (rows, columns) at fractional row numbers (n,), held beyond its ends."""
    out = np.empty((len(place), table.shape[1]))
    interpolate_rows(table, place, out)
    return out


def pose_at(trajectory: Trajectory, time_s: float) -> Array:
    """Pose (4,) at an instant of a trajectory's clock; before its start and after its end the first and the last one."""
    last = len(trajectory.eta) - 1
    row = min(max(_row(trajectory, time_s), 0.0), float(last))
    low = min(int(row), max(last - 1, 0))
    pose: Array = interpolate(np.array(trajectory.eta[low : low + 2]), np.array([row - low]))[0]
    return pose


SEAM_M, SEAM_MPS, SEAM_MPS2 = 1e-6, 1e-6, 1e-6  # and radians: the station continues the very samples that the robot has
ON_GRID = 1e-6  # of a period


def splice(old: Trajectory, new: Trajectory, from_s: float) -> Trajectory:
    """Join the old trajectory from `from_s` on with the new one from its beginning on, under the new one's id."""
    seam = _row(old, new.begin_s)
    first = min(max(int(_row(old, from_s)), 0), round(seam))
    kept = slice(first, round(seam))
    return Trajectory(
        new.id,
        old.period_s,
        np.concatenate([old.eta[kept], new.eta]),
        np.concatenate([old.velocity[kept], new.velocity]),
        np.concatenate([old.acceleration[kept], new.acceleration]),
        old.begin_s + first * old.period_s,
    )


def splice_objection(old: Trajectory, new: Trajectory) -> str:
    """Return the reason why `new` cannot follow `old` where `new` begins; empty if it can, without a jump."""
    row = _row(old, new.begin_s)
    if abs(new.period_s - old.period_s) > 1e-9 or abs(row - round(row)) > ON_GRID:
        return "its samples are not at the instants of the trajectory that is flown"
    if not 0 <= round(row) < len(old.eta):
        return f"begins at {new.begin_s:.2f} s, outside the trajectory that is flown"
    for what, unit, limit, before, after in (
        ("pose", "m or rad", SEAM_M, old.eta, new.eta),
        ("velocity", "m/s or rad/s", SEAM_MPS, old.velocity, new.velocity),
        ("acceleration", "m/s2", SEAM_MPS2, old.acceleration[:, :3], new.acceleration[:, :3]),
    ):
        jump = float(np.abs(after[0] - before[round(row)]).max())
        if not jump <= limit:
            return f"its {what} jumps by {jump:.3g} {unit} at the seam"
    return ""


def _row(trajectory: Trajectory, time_s: float) -> float:
    return (time_s - trajectory.begin_s) / trajectory.period_s
