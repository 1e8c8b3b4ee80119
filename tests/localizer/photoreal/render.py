"""SHELL: `make photoreal`: render the data set with Mitsuba 3 (development only) into `data/`. Ten minutes on two quiet cores.

`python -m tests.localizer.photoreal.render [ROW ...] [--split tune] [--missing]` renders some rows and leaves the others.
"""

import argparse
import csv
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import av
import cv2
import numpy as np
from numpy.typing import NDArray

from localizer.sources.base import as_bayer
from shoal.frames import Array
from tests.localizer.photoreal.dataset import COLUMNS, DATA, PERIOD_NS, frames, to_tiles
from tests.localizer.photoreal.mitsuba_scene import Corners, Situation, Studio, Waves
from tests.localizer.photoreal.rows import (
    CROP_PX,
    RATE_HZ,
    ROBOTS,
    ROWS,
    SPLITS,
    RobotStates,
    RowCourses,
    SceneRow,
    experiment,
    generator,
    reports,
)  # fmt: skip

_SAMPLES = 10  # of a pixel
_EXPOSURES = 4  # instants of an exposure that takes time
_BAND_PX = 16  # rows of a crop that are exposed at one instant, with a rolling shutter: 0.2 mm of motion
_BUBBLES = 45  # over each robot
_BUBBLES_RISE_MPS = 0.25
_DROPS = 30
_GLARE = {"full": (0.17, 60.0), "partial": (0.045, 14.0)}  # radius of the mirror image on the surface (m), radiance
_SIZE_PX = (CROP_PX, CROP_PX)


class RowRenderer:
    """The pictures of one row in one split."""

    def __init__(self, studio: Studio, row: SceneRow, split: str) -> None:
        self._studio, self._row, self._split = studio, row, split
        self._camera = experiment().camera
        self._courses = RowCourses(row, split)
        random = generator(row, split, "things")
        self._waves = None if row.waves == "flat" else Waves.of(row.waves, random)
        self._sun_rad = float(random.uniform(-np.pi, np.pi)) if row.low_sun else None
        self._bubbles = np.column_stack(
            [random.uniform(-0.12, 0.12, (ROBOTS * _BUBBLES, 2)), random.random((ROBOTS * _BUBBLES, 2))]
        )
        sides = random.uniform(-0.04, 0.04, (ROBOTS, 2))
        self._tethers = [_tether(side, random) for side in sides] if row.things == "tether" else []
        plate = np.column_stack(
            [random.uniform(-0.06, 0.06, (ROBOTS * _DROPS, 2)), random.uniform(0.0015, 0.004, ROBOTS * _DROPS)]
        )
        self._drops = tuple(plate.reshape(ROBOTS, _DROPS, 3)) if row.plate == "wet" else ()
        self._mirror = studio.lamps(*lamps_of(row, self._courses)) if row.glare != "none" else None
        self._light: Array | None = None

    def frame(self, k: int) -> tuple[NDArray[np.float64], Corners, RobotStates]:
        """The crops of frame `k` (robots, CROP_PX, CROP_PX), in grey levels, their corners, and the truth."""
        t = k / RATE_HZ
        truth = self._courses.at(t)
        corners = self._corners(truth)
        if self._light is None:
            self._light = self._studio.illumination(self._situation(k, truth, t), corners, _SIZE_PX, 2)
        if self._row.readout_s:
            return self._rolling(k, t, corners), corners, truth
        exposure_s = self._camera.exposure_s if self._row.blurred else 0.0
        instants = t + exposure_s * ((np.arange(_EXPOSURES) + 0.5) / _EXPOSURES - 0.5) if exposure_s else [t]
        samples = max(_SAMPLES // len(instants), 3)
        pictures = [self._picture(self._situation(k, self._courses.at(s), s), corners, k, samples) for s in instants]
        return np.mean(pictures, axis=0), corners, truth

    def _picture(
        self, situation: Situation, corners: Corners, k: int, samples: int = _SAMPLES, band: slice = slice(0, CROP_PX)
    ) -> NDArray[np.float64]:
        """A band of rows of each crop."""
        assert self._light is not None
        mirror, down = self._mirror if self._row.disturbed(k) else None, np.array([0, band.start])
        size_px = (CROP_PX, band.stop - band.start)
        return self._studio.render(situation, corners + down, size_px, samples, self._light[:, band], mirror)

    def _rolling(self, k: int, t: float, corners: Corners) -> NDArray[np.float64]:
        """Each band of a crop at the instant of its rows. `t` is that of the picture's middle row."""
        height = self._camera.size_px[1]
        crops = np.zeros((ROBOTS, CROP_PX, CROP_PX))
        for top in range(0, CROP_PX, _BAND_PX):
            band = slice(top, min(top + _BAND_PX, CROP_PX))
            rows = corners[:, 1] + (band.start + band.stop - 1) / 2.0
            instants = t + self._row.readout_s * (rows - (height - 1) / 2.0) / height
            states = [self._courses.at(s) for s in instants]
            mixed = RobotStates(*(
                np.array([getattr(states[i], name)[i] for i in range(ROBOTS)])
                for name in ("place_m", "attitude_rad", "velocity_mps", "yaw_rate_radps")
            ))  # fmt: skip
            crops[:, band] = self._picture(self._situation(k, mixed, t), corners, k, band=band)
        return crops

    def _situation(self, k: int, states: RobotStates, t: float) -> Situation:
        plates: list[str | int] = list(range(1, ROBOTS + 1))
        if self._row.disturbed(k) and self._row.plate in ("white", "dark"):
            plates = [self._row.plate] * ROBOTS
        elif self._row.disturbed(k) and self._row.plate == "swapped":
            plates = [2, 1, 4, 3, 6, 5]
        bubbles = np.zeros((0, 4))
        if self._row.things == "bubbles":
            place = np.repeat(states.place_m, _BUBBLES, axis=0)
            top, reach = place[:, 2] - 0.15, self._bubbles[:, :2]
            depth = top * (1.0 - (self._bubbles[:, 2] + _BUBBLES_RISE_MPS * t / top) % 1.0)
            bubbles = np.column_stack([place[:, :2] + reach, np.maximum(depth, 0.006), 0.001 + 0.004 * self._bubbles[:, 3]])
        sway = np.array([0.0, 0.015 * np.sin(4.0 * t), 0.0])
        tethers = tuple(line + sway for line in self._tethers)
        return Situation(states, tuple(plates), t, self._waves, bubbles, tethers, self._drops, self._sun_rad)

    def _corners(self, states: RobotStates) -> Corners:
        """Upper left pixels, even, of crops around the robots: roughly, by paraxial optics."""
        lens, focal = np.array(self._camera.position_m), np.array(self._camera.focal_px)
        place = states.place_m
        away = place[:, 2] / self._camera.water_index - lens[2]
        slope = (place[:, :2] - lens[:2]) / away[:, None]
        bent = 1.0 + self._camera.distortion[0] * np.sum(slope**2, axis=1)
        middle = np.array(self._camera.centre_px) + focal * slope * bent[:, None]
        limit = np.array(self._camera.size_px) - CROP_PX
        return np.asarray(np.clip(np.rint((middle - CROP_PX / 2) / 2) * 2, 0, limit), dtype=np.int64)


def lamps_of(row: SceneRow, courses: RowCourses) -> tuple[Array, float]:
    """Lamps whose mirror images lie over the middles of the robots' courses: x, y, radius on the surface, and radiance."""
    radius, radiance = _GLARE[row.glare]
    over = courses.middles_m * 2.8 / (2.8 + 0.15 / 1.333)  # of the plates, as seen by a camera 2.8 m above the middle
    aside = 0.0 if row.glare == "full" else 0.05
    return np.column_stack([over + aside, np.full(len(over), radius)]), radiance


def _tether(side: Array, random: np.random.Generator) -> Array:
    """A line from behind the robot up over its plate, (n, 3) in the body frame."""
    along = np.linspace(-0.16, 0.16, 9)
    across = side[0] + (side[1] - side[0]) * (along + 0.16) / 0.32 + random.normal(0.0, 0.002, 9)
    return np.column_stack([along, across, -0.165 - 0.06 * (along + 0.16)])


def background(studio: Studio, row: SceneRow | None, split: str) -> NDArray[np.uint8]:
    """The pool without robots, with a row's lamps: a raw picture."""
    camera, corner = experiment().camera, np.zeros((1, 2), np.int64)
    nobody = RobotStates(np.zeros((0, 3)), np.zeros((0, 3)), np.zeros((0, 2)), np.zeros(0))
    empty = Situation(nobody, ())
    mirror = studio.lamps(*lamps_of(row, RowCourses(row, split))) if row is not None else None
    light = studio.illumination(empty, corner, camera.size_px, 10)
    return levels(studio.render(empty, corner, camera.size_px, 4, light, mirror)[0])


def levels(picture: NDArray[np.float64]) -> NDArray[np.uint8]:
    """Clipped to the sensor's range and rounded."""
    return np.asarray(np.clip(np.rint(picture), 0, 255), dtype=np.uint8)


def compressed(row: SceneRow, pictures: list[NDArray[np.uint8]]) -> Iterator[NDArray[np.uint8]]:
    """Raw pictures as they come out of an H.264 film at the row's constant rate factor."""
    height, width = pictures[0].shape
    encoder: Any = av.CodecContext.create("libx264", "w")
    encoder.width, encoder.height, encoder.pix_fmt, encoder.framerate = width, height, "yuv420p", round(RATE_HZ)
    encoder.options = {"crf": str(row.h264_crf), "preset": "medium", "tune": "zerolatency"}
    decoder: Any = av.CodecContext.create("h264", "r")
    packets = []
    for picture in pictures:
        colour = np.asarray(cv2.cvtColor(picture, cv2.COLOR_BayerBG2BGR), dtype=np.uint8)
        packets += encoder.encode(av.VideoFrame.from_ndarray(colour, format="bgr24"))
    for packet in [*packets, *encoder.encode(None), None]:
        for shown in decoder.decode(packet):
            raw = as_bayer(shown.to_ndarray(format="bgr24"))
            assert raw is not None
            yield raw


def render_row(studio: Studio, row: SceneRow, split: str) -> None:
    """Write a row's crops as one picture (frames downwards, robots across) and its truth as a table."""
    renderer = RowRenderer(studio, row, split)
    shot = [renderer.frame(k) for k in range(row.frames)]
    folder = DATA / split
    folder.mkdir(parents=True, exist_ok=True)
    _write(folder / f"{row.name}.png", np.concatenate([to_tiles(levels(pictures)) for pictures, _, _ in shot]))
    states = [truth for _, _, truth in shot]
    readings = reports(row, split, states)
    with (folder / f"{row.name}.csv").open("w", encoding="utf-8", newline="") as file:
        table = csv.writer(file, lineterminator="\n")
        table.writerow(COLUMNS)
        for k, (_, corners, state) in enumerate(shot):
            for i in range(ROBOTS):
                # the robot is the one whose plate is carried: identity is the marker
                robot = ((i ^ 1) if row.plate == "swapped" and row.disturbed(k) else i) + 1
                pose = (*state.place_m[i], *state.attitude_rad[i])
                values = (*pose, *state.velocity_mps[i], state.yaw_rate_radps[i], *readings[k, i])
                where = (k, k * PERIOD_NS, robot, *corners[i].tolist(), int(row.disturbed(k)))
                table.writerow([*where, *(f"{value:.6f}" for value in values)])


def compress_row(row: SceneRow, split: str) -> None:
    """Write the crops of an undisturbed row as they come out of an H.264 film of the whole pictures, and its truth."""
    assert row.drawn_as is not None
    shown, tiles = list(frames(row.drawn_as, split)), []
    for true, film in zip(shown, compressed(row, [frame.pixels for frame in shown]), strict=True):
        tiles.append(to_tiles(np.array([film[y : y + CROP_PX, x : x + CROP_PX] for x, y in true.corners_px.tolist()])))
    _write(DATA / split / f"{row.name}.png", np.concatenate(tiles))


def main() -> None:
    """Render what was asked for."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("rows", nargs="*", metavar="ROW", help="all if none is named")
    parser.add_argument("--split", choices=SPLITS, help="both if not given")
    parser.add_argument("--missing", action="store_true", help="leave out the rows that are there")
    choice = parser.parse_args()
    studio, names = Studio(experiment()), choice.rows or list(ROWS)
    if not (choice.rows or choice.missing) or not (DATA / "clear.png").exists():
        DATA.mkdir(parents=True, exist_ok=True)
        _write(DATA / "clear.png", background(studio, None, ""))
    for split in [choice.split] if choice.split else SPLITS:
        for name in names:
            row = ROWS[name]
            if row.drawn_as is not None and row.h264_crf is None:
                continue
            if choice.missing and (DATA / split / f"{name}.png").exists():
                continue
            print(f"{split} {name}: {row.frames} frames", flush=True)
            if row.glare != "none":
                (DATA / split).mkdir(exist_ok=True)
                _write(DATA / split / f"{row.background}.png", background(studio, row, split))
            if row.h264_crf is not None:
                compress_row(row, split)
            else:
                render_row(studio, row, split)


def _write(path: Path, picture: NDArray[np.uint8]) -> None:
    cv2.imwrite(str(path), picture, [cv2.IMWRITE_PNG_COMPRESSION, 9])


if __name__ == "__main__":
    main()
