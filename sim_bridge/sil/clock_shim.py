"""SHELL: runs a program with a wall clock that is offset by the seconds in a file, read at each call.

    python -m sim_bridge.sil.clock_shim FILE MODULE ARGUMENTS...

The monotonic clock is left alone: no one can step it on a real machine either.
"""

import runpy
import sys
import time
from pathlib import Path


def install(file: Path) -> None:
    """Make `time.time` and `time.time_ns` of this process obey `file`."""
    real_ns = time.time_ns

    def time_ns() -> int:
        try:
            return real_ns() + round(float(file.read_text(encoding="utf-8")) * 1e9)
        except (OSError, ValueError):  # not there yet, or just being written
            return real_ns()

    time.time_ns, time.time = time_ns, lambda: time_ns() * 1e-9


if __name__ == "__main__":
    offset_file, module, *arguments = sys.argv[1:]
    install(Path(offset_file))
    sys.argv = [module, *arguments]
    runpy.run_module(module, run_name="__main__", alter_sys=True)
