"""SHELL: one camera of the simulated pool: exposures in, frames out, in time or late, with the faults of its timeline.

What is rendered ahead is rendered on a thread of its own: most of it is compiled, and runs beside the others' Python.
"""

from collections import deque
from collections.abc import Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from shoal.config.experiment import Experiment
from shoal.config.fault_injection import Break
from shoal.config.simulation import Drifter
from shoal.frames import Array
from shoal.runtime.runtime import log
from sim_bridge.camera.faults import CameraFaults
from sim_bridge.camera.renderer import Renderer, with_sunken_water


@dataclass(frozen=True, eq=False)
class Exposure:
    """The plant in the middle of an exposure, from which frames are rendered."""

    eta: Array
    nu: Array
    tilt: Array
    time_s: float
    index: int
    stamp_ns: int
    broken: tuple[Break, ...] = ()  # faults of cameras
    unmarked: frozenset[int] = frozenset()  # robots without markers, by index
    water_drop_m: float = 0.0  # that the water stands lower
    balls: tuple[Drifter, ...] = ()  # that a fault dropped

    @property
    def bubbles(self) -> int:
        """Streams of bubbles that a fault makes."""
        return round(sum(broken.value for broken in self.broken if broken.effect == "bubbles"))


class SimulatedCamera:
    """The only camera of an experiment (""), or one of several by its name."""

    def __init__(self, experiment: Experiment, name: str = "") -> None:
        self.name = name
        self.frame_ns = -1  # stamp of the newest frame that was handed out
        alone = experiment.of_camera(name)
        number = experiment.camera_names.index(name) if name else 0
        self._renderer = Renderer(alone, experiment.seed, number)
        drops = {fault.broken.value for fault in experiment.sim.faults if fault.broken.effect == "low"}
        self._sunk = {drop_m: Renderer(with_sunken_water(alone, drop_m), experiment.seed, number) for drop_m in sorted(drops)}
        self._trouble = CameraFaults()
        self._thread = ThreadPoolExecutor(1, f"render {name}")
        self._ahead: tuple[Exposure, Future[NDArray[np.uint8]]] | None = None
        self._unmarked: frozenset[int] = frozenset()
        self._water_drop_m = 0.0
        self._balls: tuple[Drifter, ...] = ()
        self._broken: tuple[Break, ...] = ()
        self._waiting: deque[Exposure] = deque()

    def prepare(self) -> None:
        """Draw all backgrounds now (seconds), so that no frame waits for its part."""
        for renderer in (self._renderer, *self._sunk.values()):
            renderer.backdrop.prepare()

    def expose(self, exposure: Exposure) -> None:
        """Take a picture, unless the camera is gone."""
        own = tuple(broken for broken in exposure.broken if broken.camera in ("", self.name))
        if not any(broken.effect == "gone" for broken in own):
            self._waiting.append(replace(exposure, broken=own))

    def due(self, newest_ns: int) -> list[tuple[int, NDArray[np.uint8]]]:
        """Frames, each with its stamp, of exposures up to `newest_ns`; of a slow camera, up to its delay before that."""
        frames = []
        while self._waiting and self._waiting[0].stamp_ns <= newest_ns - _delay_ns(self._waiting[0].broken):
            exposure = self._waiting.popleft()
            self.frame_ns = exposure.stamp_ns
            frames.append((exposure.stamp_ns, self._frame(exposure)))
        return frames

    def render_ahead(self, exposure: Exposure) -> None:
        """Render the next frame while there is time; it counts if the exposure comes as it was expected."""
        if not self._waiting:
            expected = replace(
                exposure, unmarked=self._unmarked, water_drop_m=self._water_drop_m, balls=self._balls, broken=self._broken
            )
            self._ahead = expected, self._thread.submit(self._rendered, expected)

    def close(self) -> None:
        """Wait for the frame that is being rendered."""
        self._thread.shutdown()

    def _frame(self, exposure: Exposure) -> NDArray[np.uint8]:
        """Picture of an exposure, with what is broken in it."""
        pixels = self._take_ahead(exposure)  # first: nothing may change while it is being rendered
        if exposure.unmarked != self._unmarked:
            self._unmarked = exposure.unmarked
            for each in (self._renderer, *self._sunk.values()):
                each.hide_markers(exposure.unmarked)
        if exposure.balls != self._balls:
            self._balls = exposure.balls
            for each in (self._renderer, *self._sunk.values()):
                each.drop_balls(exposure.balls)
        self._water_drop_m, self._broken = exposure.water_drop_m, exposure.broken
        if pixels is None:
            pixels = self._rendered(exposure)
        return self._trouble.apply(pixels, exposure.broken)

    def _rendered(self, exposure: Exposure) -> NDArray[np.uint8]:
        renderer = self._sunk.get(exposure.water_drop_m, self._renderer)
        return renderer.render(exposure.eta, exposure.nu, exposure.time_s, exposure.index, exposure.tilt, exposure.bubbles)

    def _take_ahead(self, exposure: Exposure) -> NDArray[np.uint8] | None:
        """The frame that was rendered ahead, if the exposure is the expected one to the bit; else None."""
        if self._ahead is None:
            return None
        (expected, rendered), self._ahead = self._ahead, None
        pixels = rendered.result()
        names = ("time_s", "index", "unmarked", "water_drop_m", "balls", "bubbles")
        same = all(getattr(expected, name) == getattr(exposure, name) for name in names)
        moved = ((expected.eta, exposure.eta), (expected.nu, exposure.nu), (expected.tilt, exposure.tilt))
        if same and all(np.array_equal(then, now) for then, now in moved):
            return pixels
        log.debug("frame %d came otherwise than expected", exposure.index)
        return None


def _delay_ns(broken: Sequence[Break]) -> int:
    return round(1e9 * max((b.value for b in broken if b.effect == "slow"), default=0.0))
