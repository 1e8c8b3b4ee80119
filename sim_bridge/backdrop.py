"""The picture without robots: the pool through wavy water, under caustics and glare.

The still scene is drawn once; from it a loop of PHASES raw mosaics with moving water. A frame blends the two phases nearest
to its time, which costs a quarter of a millisecond instead of thirty.
"""

import cv2
import numpy as np

from sim_bridge.scenery import still_scene, trace
from sim_bridge.surface import LOOP_S, Caustics, Ripples, glare
from sim_bridge.textures import Bytes, Float
from sim_bridge.view import BLOCK, View, Window
from wire.experiment import Experiment

PHASES = 48
CAUSTIC_UNIT = 50.0  # grey levels per mean light in the stored patterns


class Backdrop:
    """Cached backgrounds, and the light in the water for whoever draws things into it."""

    def __init__(self, experiment: Experiment, view: View, random: np.random.Generator) -> None:
        self._picture, self._view = experiment.sim.picture, view
        self.ripples = Ripples(self._picture, experiment.camera, random)
        self._caustics = Caustics(experiment.pool, random)
        self._hit = trace(view, experiment.pool)
        blocks = cv2.resize(self._hit.z, None, fx=1.0 / BLOCK, fy=1.0 / BLOCK, interpolation=cv2.INTER_AREA)
        blocks = cv2.resize(blocks, view.block_surface_x.shape[::-1], interpolation=cv2.INTER_LINEAR)
        self.block_z: Float = np.asarray(blocks, dtype=np.float32)  # depth of floor, wall or deck
        self.depth_m = experiment.pool.size_m[2]
        self.basis = self.ripples.basis(view.block_surface_x, view.block_surface_y).reshape(-1, *view.block_surface_x.shape)
        self.vignette = _vignette(view, self._picture.vignetting)
        self._patterns: list[Bytes] = []
        self._phases: list[Bytes] = []
        self._draw_phases(still_scene(experiment, view, self._hit, random))

    def at(self, time_s: float) -> Bytes:
        """A fresh raw mosaic (height, width) of the scene at a time."""
        place = time_s / LOOP_S * PHASES
        first = int(np.floor(place))
        share = place - first
        before, after = (self._phases[phase % len(self._phases)] for phase in (first, first + 1))
        return np.asarray(cv2.addWeighted(before, 1.0 - share, after, share, 0.0), dtype=np.uint8)

    def slopes(self, window: Window, time_s: float) -> Float:
        """Slopes of the surface at the window's blocks, (2, block rows, block columns)."""
        basis = self.basis[:, *window.blocks]
        return self.ripples.slopes(basis.reshape(len(basis), -1), time_s).reshape(2, *basis.shape[1:])

    def glare(self, window: Window, slopes: Float) -> Float:
        """Grey levels that mirrored lamps add at the window's blocks."""
        x, y = self._view.block_surface_x[window.blocks], self._view.block_surface_y[window.blocks]
        return glare(x, y, slopes, self._view.camera) * np.float32(255.0 * self._picture.glare)

    def light(self, window: Window, depth_m: float, time_s: float) -> Float:
        """Caustic light at a depth, relative to its mean, at the window's blocks. It gathers on the way down."""
        pattern = self._patterns[round(time_s / LOOP_S * PHASES) % len(self._patterns)]
        x = self._view.block_surface_x[window.blocks] + np.float32(depth_m) * self._view.block_water_x[window.blocks]
        y = self._view.block_surface_y[window.blocks] + np.float32(depth_m) * self._view.block_water_y[window.blocks]
        place = self._caustics.grid_coordinates(x, y)
        levels = cv2.remap(pattern, *place, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT_101)
        share = self._picture.caustics * min(max(depth_m / self.depth_m, 0.0), 1.0)
        return np.asarray(1.0 + share * (levels.astype(np.float32) / CAUSTIC_UNIT - 1.0), dtype=np.float32)

    def _draw_phases(self, still: Bytes) -> None:
        view, window = self._view, self._view.whole
        pull_x, pull_y = self._pull()
        column, row = np.meshgrid(np.arange(view.width, dtype=np.float32), np.arange(view.height, dtype=np.float32))
        place = [(np.ascontiguousarray(p[0::2, 0::2])) for p in self._caustics.grid_coordinates(*self._plan())]
        reach = np.float32(self._picture.caustics) * np.clip(self._hit.z[0::2, 0::2] / np.float32(self.depth_m), 0.0, 1.0)
        planes = [np.ascontiguousarray(still[..., channel]) for channel in (2, 1, 0)]
        moving = self._picture.ripples_m > 0.0 or self._picture.caustics > 0.0
        for phase in range(PHASES if moving else 1):
            time_s = phase * LOOP_S / PHASES
            pattern = np.clip(self._caustics.pattern(time_s) * CAUSTIC_UNIT, 0, 255).astype(np.uint8)
            self._patterns.append(pattern)
            levels = cv2.remap(pattern, place[0], place[1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT_101)
            light = 1.0 + reach * (levels.astype(np.float32) / np.float32(CAUSTIC_UNIT) - 1.0)
            slopes = self.slopes(window, time_s)
            map_x = column + view.spread(pull_x[0] * slopes[0] + pull_x[1] * slopes[1], window)
            map_y = row + view.spread(pull_y[0] * slopes[0] + pull_y[1] * slopes[1], window)
            raw = _refract(planes, map_x, map_y)
            raw *= cv2.resize(light, (view.width, view.height), interpolation=cv2.INTER_LINEAR)
            raw *= self.vignette
            raw += view.spread(self.glare(window, slopes), window)
            self._phases.append(np.clip(np.rint(raw, out=raw), 0, 255).astype(np.uint8))

    def _plan(self) -> tuple[Float, Float]:
        """Where the light that each pixel sees falls on the plan; walls are laid open outwards."""
        down = np.float32(self.depth_m) - self._hit.z
        x = self._hit.x + np.where(self._hit.on_x_wall, np.copysign(down, self._hit.x), np.float32(0.0))
        y = self._hit.y + np.where(self._hit.on_y_wall, np.copysign(down, self._hit.y), np.float32(0.0))
        return x, y

    def _pull(self) -> tuple[tuple[Float, Float], tuple[Float, Float]]:
        """Pixels by which a unit slope (x, y) of the surface shifts what a block sees: the Jacobian from metres at the
        depth where the line of sight ends to pixels, times that depth, times the bending."""
        view, z = self._view, self.block_z
        (s_xr, s_xc), (s_yr, s_yc) = (np.gradient(p, BLOCK) for p in (view.block_surface_x, view.block_surface_y))
        (d_xr, d_xc), (d_yr, d_yc) = (np.gradient(p, BLOCK) for p in (view.block_water_x, view.block_water_y))
        x_c, x_r, y_c, y_r = s_xc + z * d_xc, s_xr + z * d_xr, s_yc + z * d_yc, s_yr + z * d_yr
        gain = np.float32(self.ripples.bending) * z / (x_c * y_r - x_r * y_c)
        return (gain * y_r, -gain * x_r), (-gain * y_c, gain * x_c)


def _refract(planes: list[Bytes], map_x: Float, map_y: Float) -> Float:
    """The still scene (red, green, blue planes) through displaced lines of sight, as a raw mosaic: each pixel's one colour."""
    raw = np.empty(map_x.shape, np.float32)
    for i, j, channel in ((0, 0, 0), (0, 1, 1), (1, 0, 1), (1, 1, 2)):
        x, y = np.ascontiguousarray(map_x[i::2, j::2]), np.ascontiguousarray(map_y[i::2, j::2])
        raw[i::2, j::2] = cv2.remap(planes[channel], x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return raw


def _vignette(view: View, strength: float) -> Float:
    centre_x, centre_y = view.camera.centre_px
    column, row = (np.arange(view.width) - centre_x) ** 2, (np.arange(view.height) - centre_y) ** 2
    corner = max(column[0], column[-1]) + max(row[0], row[-1])
    return np.asarray(1.0 - strength * (column[None, :] + row[:, None]) / corner, dtype=np.float32)
