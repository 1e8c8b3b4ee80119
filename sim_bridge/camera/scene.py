"""What the camera looks at in one picture, robots and landmarks aside: lines of sight, light in the water, glare upon it."""

import cv2
import numpy as np

from sim_bridge.camera.rays import View, Window
from sim_bridge.camera.textures import Bytes, Float
from sim_bridge.camera.water_optics import LOOP_S, Caustics, Ripples, glare
from wire.config.experiment import Experiment

PHASES = 48  # of moving light and ripples kept in a loop
CAUSTIC_UNIT = 50.0  # grey levels per mean light in the stored patterns


class Waters:
    """The water and its light, wherever they are seen from: ripples, and a loop of caustic patterns."""

    def __init__(self, experiment: Experiment, random: np.random.Generator) -> None:
        self.picture, self.depth_m = experiment.sim.picture, experiment.pool.size_m[2]
        self.ripples = Ripples(self.picture, experiment.camera, random)
        self.caustics = Caustics(experiment.pool, random)
        moving = self.picture.ripples_m > 0.0 or self.picture.caustics > 0.0
        self.times_s = np.arange(PHASES if moving else 1) * LOOP_S / PHASES
        self._patterns: list[Bytes] = [
            np.clip(self.caustics.pattern(time_s) * CAUSTIC_UNIT, 0, 255).astype(np.uint8) for time_s in self.times_s
        ]

    def light(self, column: Float, row: Float, reach: Float | np.float32, time_s: float) -> Float:
        """Caustic light relative to its mean at places of the caustics' grid, as much of it as `reach` (0 to 1) says."""
        pattern = self._patterns[round(time_s / LOOP_S * PHASES) % len(self._patterns)]
        levels = cv2.remap(pattern, column, row, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT_101)
        return np.asarray(1.0 + reach * (levels.astype(np.float32) / np.float32(CAUSTIC_UNIT) - 1.0), dtype=np.float32)

    def reach(self, depth_m: Float | float) -> Float:
        """How much of the caustics there is at a depth: they gather on the way down."""
        share = np.float32(self.picture.caustics) * np.clip(np.asarray(depth_m) / self.depth_m, 0.0, 1.0)
        return np.asarray(share, dtype=np.float32)


class Scene:
    """The waters from one point of view. `block_z` (block rows, columns) is how deep floor, wall or deck lie."""

    def __init__(self, waters: Waters, view: View, block_z: Float, vignette: Float) -> None:
        self.waters, self.view, self.block_z, self.vignette = waters, view, block_z, vignette
        self.depth_m, self.bending = waters.depth_m, np.float32(waters.ripples.bending)
        shape = view.blocks.surface_x.shape
        self._basis = waters.ripples.basis(view.blocks.surface_x, view.blocks.surface_y).reshape(-1, *shape)

    def slopes(self, window: Window, time_s: float) -> Float:
        """Slopes of the surface at the window's blocks, (2, block rows, block columns)."""
        basis = self._basis[:, *window.blocks]
        return self.waters.ripples.slopes(basis.reshape(len(basis), -1), time_s).reshape(2, *basis.shape[1:])

    def glare(self, window: Window, slopes: Float) -> Float:
        """Grey levels that mirrored lamps add at the window's blocks."""
        lines = self.view.blocks[window.blocks]
        levels = glare(lines.surface_x, lines.surface_y, slopes, self.view.camera)
        return levels * np.float32(255.0 * self.waters.picture.glare)

    def light(self, window: Window, depth_m: float, time_s: float) -> Float:
        """Light at a depth, relative to its mean, at the window's blocks."""
        lines, depth = self.view.blocks[window.blocks], np.float32(depth_m)
        x, y = lines.surface_x + depth * lines.water_x, lines.surface_y + depth * lines.water_y
        column, row = self.waters.caustics.grid_coordinates(x, y)
        return self.waters.light(column, row, np.float32(self.waters.reach(depth_m)), time_s)


def vignette(view: View, strength: float) -> Float:
    """How much of its light each pixel gets, (height, width)."""
    centre_x, centre_y = view.camera.centre_px
    column, row = (np.arange(view.width) - centre_x) ** 2, (np.arange(view.height) - centre_y) ** 2
    corner = max(column[0], column[-1]) + max(row[0], row[-1])
    return np.asarray(1.0 - strength * (column[None, :] + row[:, None]) / corner, dtype=np.float32)
