"""SHELL: the photoreal data set: frames of a row with their truth, from the crops, backgrounds and tables in `data/`.

A frame is the shared background, the robots' crops on it, and the sensor's noise, which is drawn here: pictures without it
are a third as large. README.md beside this file says what the columns mean.
"""

import csv
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from tests.localizer.photoreal.rows import CROP_PX, RATE_HZ, ROBOTS, ROWS, SceneRow, generator

DATA = Path(__file__).parent / "data"
PERIOD_NS = round(1e9 / RATE_HZ)
COLUMNS = (
    "frame", "stamp_ns", "robot", "left_px", "top_px", "disturbed", "x_m", "y_m", "depth_m", "roll_rad", "pitch_rad",
    "yaw_rad", "vx_mps", "vy_mps", "yaw_rate_radps", "reported_depth_m", "reported_roll_rad", "reported_pitch_rad",
)  # fmt: skip
_READ_NOISE = 1.2  # grey levels, standard deviation in the dark
_SHOT_NOISE = 0.02  # grey levels: variance per level; a dim picture is amplified, and its noise with it

Pixels = NDArray[np.uint8]


@dataclass(frozen=True)
class RobotTruth:
    """A robot in one frame: true at `stamp_ns`, the middle of the exposure of the picture's middle row. `disturbed` says that
    what the row disturbs was at work."""

    disturbed: bool
    pose: tuple[float, float, float]  # x m, y m, yaw rad
    depth_m: float
    roll_rad: float
    pitch_rad: float
    velocity: tuple[float, float, float]  # d pose / dt
    reported_depth_m: float
    reported_roll_rad: float
    reported_pitch_rad: float


@dataclass(frozen=True, eq=False)
class TrueFrame:
    """A raw picture (height, width) Bayer RGGB, its stamp, and the robots in it by id."""

    pixels: Pixels
    stamp_ns: int
    robots: dict[int, RobotTruth]
    corners_px: NDArray[np.int64]  # upper left pixels (n, 2) of the robots' crops


def frames(name: str, split: str) -> Iterator[TrueFrame]:
    """The frames of a row, in order."""
    row, folder = ROWS[name], DATA / split
    drawn_as = row.drawn_as or name
    tiles = _read(folder / f"{drawn_as if row.h264_crf is None else name}.png")
    backgrounds = {False: _read(DATA / "clear.png")}
    backgrounds[True] = backgrounds[False] if row.background == "clear" else _read(folder / f"{row.background}.png")
    with (folder / f"{drawn_as}.csv").open(encoding="utf-8", newline="") as file:
        lines = list(csv.DictReader(file))
    for k in range(row.frames):
        here = lines[k * ROBOTS : (k + 1) * ROBOTS]
        crops = from_tiles(tiles[2 * k * CROP_PX : 2 * (k + 1) * CROP_PX])
        corners = np.array([(int(line["left_px"]), int(line["top_px"])) for line in here])
        behind = backgrounds[row.disturbed(k)]
        picture = _with_crops(behind, crops, corners)
        if row.light != 1.0:
            picture = np.rint(row.light * picture).astype(np.uint8)
        if row.h264_crf is None:  # there it was in the film already
            picture = _sensor_noise(picture, row, split, k)
        yield TrueFrame(picture, int(here[0]["stamp_ns"]), {int(line["robot"]): _truth(line) for line in here}, corners)


def to_tiles(crops: NDArray[np.uint8]) -> Pixels:
    """Crops (n, CROP_PX, CROP_PX) beside one another, each as the four planes of its mosaic: so PNG packs them better."""
    planes = [np.concatenate([crop[0::2, 0::2], crop[0::2, 1::2], crop[1::2, 0::2], crop[1::2, 1::2]]) for crop in crops]
    return np.concatenate(planes, axis=1)


def from_tiles(tiles: Pixels) -> Pixels:
    """The crops (ROBOTS, CROP_PX, CROP_PX) of `to_tiles`."""
    half = CROP_PX // 2
    crops = np.empty((ROBOTS, CROP_PX, CROP_PX), np.uint8)
    for plane in range(4):
        rows = tiles[plane * half : (plane + 1) * half]
        crops[:, plane // 2 :: 2, plane % 2 :: 2] = rows.reshape(half, ROBOTS, half).swapaxes(0, 1)
    return crops


def _with_crops(background: Pixels, crops: NDArray[np.uint8], corners_px: NDArray[np.int64]) -> Pixels:
    """The background with crops (n, CROP_PX, CROP_PX) at their upper left pixels (n, 2)."""
    picture = background.copy()
    for crop, (x, y) in zip(crops, corners_px.tolist(), strict=True):
        picture[y : y + CROP_PX, x : x + CROP_PX] = crop
    return picture


def _sensor_noise(picture: Pixels, row: SceneRow, split: str, frame: int) -> Pixels:
    """The picture with a sensor's noise, the same whenever it is drawn. A saturated pixel has none."""
    random = generator(row, split, f"noise {frame}")
    level = picture.astype(np.float32)
    sigma = np.sqrt(_READ_NOISE**2 + _SHOT_NOISE * level / row.light)
    noisy = level + sigma * random.standard_normal(level.shape, dtype=np.float32)
    return np.asarray(np.where(picture == 255, 255, np.clip(np.rint(noisy), 0, 255)), dtype=np.uint8)


def _truth(line: dict[str, str]) -> RobotTruth:
    value = {key: float(text) for key, text in line.items()}
    return RobotTruth(
        bool(value["disturbed"]), (value["x_m"], value["y_m"], value["yaw_rad"]), value["depth_m"], value["roll_rad"],
        value["pitch_rad"], (value["vx_mps"], value["vy_mps"], value["yaw_rate_radps"]), value["reported_depth_m"],
        value["reported_roll_rad"], value["reported_pitch_rad"],
    )  # fmt: skip


def _read(path: Path) -> Pixels:
    picture = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    if picture is None:
        raise FileNotFoundError(f"{path}: no such picture; `make photoreal` renders it")
    return np.asarray(picture, dtype=np.uint8)
