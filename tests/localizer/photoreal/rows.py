"""The rows of the data set: what disturbs the picture in each, and where the robots are at any time. Pure.

Six robots, one in each cell of a 3 x 2 grid, drive arcs through the middles of their cells. A row and a split fix all chance,
so that tuning on `tune` says nothing about the courses, waves and bubbles of `held_out`.
"""

from dataclasses import dataclass
from typing import Literal

import numpy as np

from shoal.config.experiment import Experiment, load_experiment
from shoal.config.scene import RobotConfig
from shoal.frames import Array

SPLITS = ("tune", "held_out")
ROBOTS = 6
RATE_HZ = 20.0
DEPTH_M = 0.3  # of the robots' centres: the plate is 0.15 m below the surface
SURFACED_M = 0.13  # the plate is 2 cm above the water
CROP_PX = 124  # of each robot: its hull is 104 px across
_CELLS_M = np.array([(x, y) for y in (-0.62, 0.62) for x in (-1.1, 0.0, 1.1)])
_STRAY_M = 0.12  # of an arc's middle from its cell's
_SWAY_RADPS = 1.5  # a tilted robot's tilt turns from roll to pitch and back at this rate

# Standard deviations of what a robot reports: a bias that stays for the row, then noise of every report.
_DEPTH_SIGMAS_M = (0.003, 0.002)  # as [sim.sensors] of the experiments
_TILT_SIGMAS_RAD = (0.003, 0.002)  # trim of the board in its hull, then the attitude filter


@dataclass(frozen=True)
class SceneRow:
    """One row: a sequence of pictures with one disturbance. Frames `first` to `last` (excluded) are disturbed."""

    name: str
    frames: int = 6
    first: int = 0
    last: int = 1000
    speed_mps: float = 0.1
    turn_radps: float = 0.3
    tilt_deg: float = 0.0
    waves: Literal["flat", "long", "short"] = "flat"
    plate: Literal["clear", "white", "dark", "swapped", "wet"] = "clear"
    glare: Literal["none", "full", "partial"] = "none"
    things: Literal["none", "bubbles", "tether"] = "none"
    low_sun: bool = False
    light: float = 1.0
    blurred: bool = False  # the exposure takes time; in the other rows it is an instant
    readout_s: float = 0.0  # from the first row of the picture to the last
    corner_sigma_px: float = 0.2  # of a marker's corners, as somebody who knows the film would set it
    slope_sigma_rad: float = 0.0043  # of the water's surface along an axis, as somebody who knows the waves would set it
    drawn_as: str | None = None  # the row whose courses and pictures these are, darkened or compressed
    h264_crf: int | None = None

    def disturbed(self, frame: int) -> bool:
        """True if this frame is one of the disturbed ones."""
        return self.first <= frame < self.last

    @property
    def background(self) -> str:
        """The name of the background with the disturbance in it; that without is `clear`."""
        return "clear" if self.glare == "none" else f"{self.glare}-lamps"


ROWS = {
    row.name: row
    for row in (
        SceneRow("level", frames=8),
        SceneRow("tilt-2", frames=5, tilt_deg=2.0),
        SceneRow("tilt-4", tilt_deg=4.0),
        SceneRow("tilt-6", frames=5, tilt_deg=6.0),
        SceneRow("tilt-8", frames=5, tilt_deg=8.0),
        SceneRow("covered-white", frames=30, first=6, last=26, speed_mps=0.15, plate="white"),
        SceneRow("covered-dark", frames=24, first=6, last=21, speed_mps=0.15, plate="dark"),
        SceneRow("glare", frames=28, first=6, last=20, speed_mps=0.15, glare="full"),
        SceneRow("waves-long", frames=12, waves="long", slope_sigma_rad=0.017),
        SceneRow("waves-short", frames=8, waves="short", slope_sigma_rad=0.019),
        SceneRow("swapped", frames=12, first=5, plate="swapped"),
        SceneRow("partial-glare", frames=10, speed_mps=0.2, glare="partial"),
        SceneRow("dim", frames=8, light=0.15, drawn_as="level"),
        SceneRow("h264", frames=8, h264_crf=30, corner_sigma_px=0.5, drawn_as="level"),
        SceneRow("blur", frames=5, speed_mps=0.4, turn_radps=0.8, blurred=True),
        SceneRow("rolling-shutter", frames=5, speed_mps=0.4, turn_radps=0.8, readout_s=0.03),
        SceneRow("bubbles", frames=7, things="bubbles"),
        SceneRow("tether", frames=7, things="tether"),
        SceneRow("low-sun", frames=5, low_sun=True),
        SceneRow("wet-plate", frames=5, plate="wet"),
    )
}


def experiment(row: SceneRow | None = None) -> Experiment:
    """The pool experiment with six robots in it, where they are is not told; sensors and film as they are known in a row."""
    robots = tuple(RobotConfig(id=i, node_m=(0.0, 0.0, 0.0)) for i in range(1, ROBOTS + 1))
    settings = [
        f"localizer.depth_sigma_m={np.hypot(*_DEPTH_SIGMAS_M)}",
        f"localizer.attitude_sigma_rad={np.hypot(*_TILT_SIGMAS_RAD)}",
    ]
    if row is not None:
        settings += [
            f"camera.readout_s={row.readout_s}", f"localizer.corner_sigma_px={row.corner_sigma_px}",
            f"localizer.surface_slope_rad={row.slope_sigma_rad}",
        ]  # fmt: skip
    return load_experiment("pool", settings).model_copy(update={"robots": robots})


@dataclass(frozen=True, eq=False)
class RobotStates:
    """The robots at one instant: [x, y, depth] (n, 3) of the centres, [roll, pitch, yaw] (n, 3), velocities (n, 2) and yaw
    rates (n,), pool frame."""

    place_m: Array
    attitude_rad: Array
    velocity_mps: Array
    yaw_rate_radps: Array


class RowCourses:
    """The robots' courses in one row of one split."""

    def __init__(self, row: SceneRow, split: str) -> None:
        random = generator(row, split, "courses")
        self._row = row
        self.middles_m = _CELLS_M + random.uniform(-_STRAY_M, _STRAY_M, (ROBOTS, 2))
        self._yaw = random.uniform(-np.pi, np.pi, ROBOTS)
        self._turn = row.turn_radps * random.uniform(0.6, 1.0, ROBOTS) * random.choice([-1, 1], ROBOTS)
        self._sway = random.uniform(-np.pi, np.pi, ROBOTS)

    def at(self, t_s: float) -> RobotStates:
        """The robots `t_s` after the middle of the first exposure."""
        t = t_s - 0.5 * (self._row.frames - 1) / RATE_HZ
        yaw, speed = self._yaw + self._turn * t, self._row.speed_mps
        arc = speed / self._turn  # radius, signed
        place = self.middles_m + np.column_stack(
            [arc * (np.sin(yaw) - np.sin(self._yaw)), -arc * (np.cos(yaw) - np.cos(self._yaw))]
        )
        sway, tilt = self._sway + _SWAY_RADPS * t, np.radians(self._row.tilt_deg)
        depth = np.full(ROBOTS, SURFACED_M if self._row.plate == "wet" else DEPTH_M)
        return RobotStates(
            np.column_stack([place, depth]),
            np.column_stack([tilt * np.cos(sway), tilt * np.sin(sway), yaw]),
            speed * np.column_stack([np.cos(yaw), np.sin(yaw)]),
            self._turn,
        )


def generator(row: SceneRow, split: str, use: str) -> np.random.Generator:
    """The source of all chance of one use in one row of one split."""
    return np.random.default_rng([*f"{row.name}/{split}/{use}".encode()])


def reports(row: SceneRow, split: str, states: list[RobotStates]) -> Array:
    """Depth, roll and pitch as imperfect sensors report them, (frames, robots, 3)."""
    random = generator(row, split, "reports")
    true = np.array([np.column_stack([s.place_m[:, 2], s.attitude_rad[:, :2]]) for s in states])
    bias, noise = np.array([_DEPTH_SIGMAS_M, _TILT_SIGMAS_RAD, _TILT_SIGMAS_RAD]).T
    return np.asarray(true + random.normal(0.0, bias, true.shape[1:]) + random.normal(0.0, noise, true.shape))
