"""SHELL: the labs in which faults are injected, by name."""

import os
import subprocess
import tempfile
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path

from sim_bridge.sil.ports import free_port
from tests.faults.rig import Rig


@contextmanager
def small_disk(seed: int) -> Iterator[Rig]:
    """The log on a file system of its own of 64 MB, where that may be mounted; else anywhere."""
    folder = Path(tempfile.mkdtemp(prefix="shoal-disk-"))
    mounting = ["mount", "-t", "tmpfs", "-o", "size=64m", "tmpfs", str(folder)]
    mounted = os.geteuid() == 0 and subprocess.run(mounting, capture_output=True, check=False).returncode == 0
    try:
        small = ("recording.min_free_gb=0", "recording.stop_video_below_gb=0")
        with Rig(seed=seed, run_dir=folder / "run", own_router=True, settings=small) as rig:
            yield rig
    finally:
        if mounted:
            subprocess.run(["umount", str(folder)], check=False)


# Twenty agents at 20 Hz are more than two cores carry; an order does not go through the control loop. Slower than at 8 Hz a
# loop must not be, or a board would disarm for one step that fails to come.
SLOWLY = ("controller.period_s=0.125", "camera.rate_hz=8", "safety.pose_hold_s=0.6", "safety.pose_neutral_s=0.95")


# Where neither the camera nor the localizer matters ("seen"), their work is left out: it is most of what a lab costs.
RIGS: dict[str, Callable[[int], AbstractContextManager[Rig]]] = {
    "lab": lambda seed: Rig(seed=seed),
    "still": lambda seed: Rig(seed=seed, settings=("safety.off_path_m=0.1",)),
    "patched": lambda seed: Rig(seed=seed, patched=True),
    "router": lambda seed: Rig(seed=seed, own_router=True),
    "page": lambda seed: Rig(seed=seed, settings=("duration_s=200",), station_options=("--web", f"127.0.0.1:{free_port()}")),
    "disk": small_disk,
    "seen": lambda seed: Rig(seed=seed, poses=True),
    "seen-patched": lambda seed: Rig(seed=seed, poses=True, patched=True),
    "detour": lambda seed: Rig("blocked-path", ("sim.drifters=[]",), seed=seed, poses=True, wires=False, patched=True),
    "fleet": lambda seed: Rig("fleet-20", SLOWLY, seed=seed, poses=True, wires=False),
}
