"""Backgrounds without robots for a fixed camera: the pool through wavy water, under caustics and glare.

The still pool is drawn once, and from it a loop of raw mosaics with moving water. A frame blends the two nearest to its
time, which costs a quarter of a millisecond instead of thirty.
"""

import cv2
import numpy as np

from sim_bridge.camera.kernels import BLOCK
from sim_bridge.camera.optics import Bytes, Float
from sim_bridge.camera.rays import CameraRays, sample_mosaic
from sim_bridge.camera.scene import WaterView, draw_still_pool, plan_coordinates, trace_to_surfaces, vignette
from sim_bridge.camera.textures import LENS_SOFTNESS_PX
from sim_bridge.camera.water_optics import LOOP_S, PHASES, WaterLight
from wire.config.experiment import Experiment

UNSEEN_SHARE = 1e-3  # weight below which blending changes no pixel: less than half of one grey level in 255


class StaticBackground:
    """Cached backgrounds of a fixed camera."""

    def __init__(self, experiment: Experiment, random: np.random.Generator) -> None:
        self._view, self._pool = CameraRays(experiment.camera), experiment.pool
        waters = WaterLight(experiment, random)
        lines = self._view.lines(self._view.whole)
        self._hit = trace_to_surfaces(lines, experiment.pool)
        blocks = cv2.resize(self._hit.z, None, fx=1.0 / BLOCK, fy=1.0 / BLOCK, interpolation=cv2.INTER_AREA)
        blocks = cv2.resize(blocks, self._view.blocks.surface_x.shape[::-1], interpolation=cv2.INTER_LINEAR)
        shade = vignette(self._view, waters.picture.vignetting)
        self._scene = WaterView(waters, self._view, np.asarray(blocks, dtype=np.float32), shade)
        lean = np.sqrt(1.0 + lines.water_x**2 + lines.water_y**2)
        self._blend = np.empty((self._view.height, self._view.width), np.uint8)
        self._phases = self._draw_phases(draw_still_pool(experiment, self._hit, lean, LENS_SOFTNESS_PX, random))

    def at(self, time_s: float) -> tuple[WaterView, Bytes]:
        """The water's view at a time, and a raw mosaic (height, width) of it to draw on, valid until the next call."""
        place = time_s / LOOP_S * PHASES
        first = int(np.floor(place))
        share = place - first
        before, after = (self._phases[phase % len(self._phases)] for phase in (first, first + 1))
        if min(share, 1.0 - share) < UNSEEN_SHARE:
            np.copyto(self._blend, after if share > 0.5 else before)
        else:
            cv2.addWeighted(before, 1.0 - share, after, share, 0.0, dst=self._blend)
        return self._scene, self._blend

    def _draw_phases(self, still: Bytes) -> list[Bytes]:
        view, waters, window = self._view, self._scene.waters, self._view.whole
        pull_x, pull_y = self._shift_per_slope()
        column, row = np.meshgrid(np.arange(view.width, dtype=np.float32), np.arange(view.height, dtype=np.float32))
        grid = waters.caustics.grid_coordinates(*plan_coordinates(self._hit, self._pool))
        grid_column, grid_row = (np.ascontiguousarray(plane[0::2, 0::2]) for plane in grid)
        reach = waters.reach(self._hit.z[0::2, 0::2])
        planes = [np.ascontiguousarray(still[..., channel]) for channel in (2, 1, 0)]
        phases = []
        for time_s in waters.times_s.tolist():
            light = waters.light(grid_column, grid_row, reach, time_s)
            slopes = self._scene.slopes(window, time_s)
            map_x = column + view.spread(pull_x[0] * slopes[0] + pull_x[1] * slopes[1], window)
            map_y = row + view.spread(pull_y[0] * slopes[0] + pull_y[1] * slopes[1], window)
            raw = sample_mosaic(planes, map_x, map_y).astype(np.float32)
            raw *= cv2.resize(light, (view.width, view.height), interpolation=cv2.INTER_LINEAR)
            raw *= self._scene.vignette
            raw += view.spread(self._scene.glare(window, slopes), window)
            phases.append(np.clip(np.rint(raw, out=raw), 0, 255).astype(np.uint8))
        return phases

    def _shift_per_slope(self) -> tuple[tuple[Float, Float], tuple[Float, Float]]:
        """Pixels by which a unit slope (x, y) of the surface shifts the image of a block: the Jacobian from metres at the
        depth where the line of sight ends to pixels, times that depth, times the bending."""
        lines, z = self._view.blocks, self._scene.block_z
        (s_xr, s_xc), (s_yr, s_yc) = (np.gradient(p, BLOCK) for p in (lines.surface_x, lines.surface_y))
        (d_xr, d_xc), (d_yr, d_yc) = (np.gradient(p, BLOCK) for p in (lines.water_x, lines.water_y))
        x_c, x_r, y_c, y_r = s_xc + z * d_xc, s_xr + z * d_xr, s_yc + z * d_yc, s_yr + z * d_yr
        gain = self._scene.bending * z / (x_c * y_r - x_r * y_c)
        return (gain * y_r, -gain * x_r), (-gain * y_c, gain * x_c)
