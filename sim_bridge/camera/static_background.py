"""Backgrounds without robots for a fixed camera: the pool through wavy water, under caustics and glare.

The still pool is drawn once, and from it a loop of raw mosaics through moving water, each when it is first needed, and a
loop of caustic light. The loops are run through at different rates, which wander (water_optics.LoopClock). A frame blends
the two nearest pictures of each loop, in half a millisecond instead of thirty.
"""

import cv2
import numpy as np

from shoal.config.experiment import Experiment
from sim_bridge.camera.kernels import BLOCK
from sim_bridge.camera.optics import Bytes, Float
from sim_bridge.camera.rays import CameraRays, sample_mosaic
from sim_bridge.camera.scene import WaterView, draw_still_pool, plan_coordinates, trace_to_surfaces, vignette
from sim_bridge.camera.textures import LENS_SOFTNESS_PX
from sim_bridge.camera.water_optics import PHASE_S, Blend, RowLight, WaterLight, blend_lit_view, caustic_levels


class StaticBackground:
    """Cached backgrounds of a fixed camera."""

    def __init__(self, experiment: Experiment, random: np.random.Generator) -> None:
        self._view = view = CameraRays(experiment.camera)
        waters = WaterLight(experiment, random)
        lines = view.pixel_lines()
        hit = trace_to_surfaces(lines, experiment.pool)

        # Behind the moving water: the depth at each block of pixels, and the picture of the still pool.
        depths = cv2.resize(hit.z, None, fx=1.0 / BLOCK, fy=1.0 / BLOCK, interpolation=cv2.INTER_AREA)
        depths = cv2.resize(depths, view.blocks.surface_x.shape[::-1], interpolation=cv2.INTER_LINEAR)
        self._scene = WaterView(waters, view, np.asarray(depths, dtype=np.float32))
        self._vignette = vignette(view, waters.picture.vignetting)
        path_per_depth = np.sqrt(1.0 + lines.water_x**2 + lines.water_y**2)
        still = draw_still_pool(experiment, hit, path_per_depth, LENS_SOFTNESS_PX, random)
        self._planes = [np.ascontiguousarray(still[..., channel]) for channel in (2, 1, 0)]
        self._px_per_slope = self._shift_per_slope()
        self._pixels = np.meshgrid(np.arange(view.width, dtype=np.float32), np.arange(view.height, dtype=np.float32))

        # For each Bayer square: its place on the grid of the caustics' pattern, and the pattern's strength at that depth.
        grid = waters.caustics.grid_coordinates(*plan_coordinates(hit, experiment.pool))
        self._grid_column, self._grid_row = (np.ascontiguousarray(plane[0::2, 0::2]) for plane in grid)
        self._reach = waters.reach(hit.z[0::2, 0::2])
        squares = self._grid_column.shape
        self._scratch = RowLight(*(np.empty(n, np.float32) for n in (squares[1], squares[1], 2 * squares[1], 2 * squares[1])))
        self._blend = np.empty((view.height, view.width), np.uint8)

        # Pictures of the loops, drawn when first needed. Each loop is one array, for which the system uses large pages.
        ripples, caustics = waters.ripple_clock.phases, waters.caustic_clock.phases
        self._views = np.empty((ripples, view.height, view.width), np.uint8)
        self._glares = np.empty((ripples, *squares), np.uint8)
        self._levels = np.empty((caustics, *squares), np.uint8)
        self._are_drawn = np.zeros(ripples, np.bool_), np.zeros(caustics, np.bool_)

    def prepare(self) -> None:
        """Draw both loops now (seconds), so that no frame waits for its part."""
        for phase in range(len(self._views)):
            self._view_phase(phase)
        for phase in range(len(self._levels)):
            self._level_phase(phase)

    def at(self, time_s: float) -> tuple[WaterView, Bytes]:
        """The water's view at a time, and a raw mosaic (height, width) of it to draw on, valid until the next call."""
        waters = self._scene.waters
        first, second, share = waters.ripple_clock.phase(time_s)
        (view, glare), (next_view, next_glare) = self._view_phase(first), self._view_phase(second)
        views, glares = Blend(view, next_view, share), Blend(glare, next_glare, share)
        first, second, share = waters.caustic_clock.phase(time_s)
        levels = Blend(self._level_phase(first), self._level_phase(second), share)
        blend_lit_view(views, glares, levels, self._reach, self._scratch, self._blend)
        return self._scene, self._blend

    def _view_phase(self, number: int) -> tuple[Bytes, Bytes]:
        """The pool through the ripples' loop: a mosaic (height, width), and the glare over each of its Bayer squares."""
        if not self._are_drawn[0][number]:
            view = self._view
            (xx, xy), (yx, yy) = self._px_per_slope
            slopes = self._scene.slopes(number * PHASE_S)
            slope_x, slope_y = slopes
            pixel_x, pixel_y = self._pixels
            map_x = pixel_x + view.spread(xx * slope_x + xy * slope_y)
            map_y = pixel_y + view.spread(yx * slope_x + yy * slope_y)
            raw = sample_mosaic(self._planes, map_x, map_y).astype(np.float32) * self._vignette
            glare = view.spread(self._scene.glare(slopes))[0::2, 0::2]
            self._views[number], self._glares[number] = (np.clip(np.rint(plane), 0, 255) for plane in (raw, glare))
            self._are_drawn[0][number] = True
        return self._views[number], self._glares[number]

    def _level_phase(self, number: int) -> Bytes:
        """The pattern of the caustics' loop as each Bayer square of the picture meets it."""
        if not self._are_drawn[1][number]:
            self._levels[number] = caustic_levels(self._scene.waters.phase_pattern(number), self._grid_column, self._grid_row)
            self._are_drawn[1][number] = True
        levels: Bytes = self._levels[number]
        return levels

    def _shift_per_slope(self) -> tuple[tuple[Float, Float], tuple[Float, Float]]:
        """Pixels by which a unit slope (x, y) of the surface shifts the image of a block: the Jacobian from metres at the
        depth where the line of sight ends to pixels, times that depth, times the bending."""
        lines, z = self._view.blocks, self._scene.block_z
        (s_xr, s_xc), (s_yr, s_yc) = (np.gradient(p, BLOCK) for p in (lines.surface_x, lines.surface_y))
        (d_xr, d_xc), (d_yr, d_yc) = (np.gradient(p, BLOCK) for p in (lines.water_x, lines.water_y))
        x_c, x_r, y_c, y_r = s_xc + z * d_xc, s_xr + z * d_xr, s_yc + z * d_yc, s_yr + z * d_yr
        gain = self._scene.bending * z / (x_c * y_r - x_r * y_c)
        return (gain * y_r, -gain * x_r), (-gain * y_c, gain * x_c)
