"""SHELL: the process that compiles kernels for `shoal/kernels/build.py`: imports modules, and reports each kernel on stdout.

Machine code, compiler and their memory are gone with it. It ends with whoever started it (shoal/system/programs.py).
"""

import gc
import importlib
import json
import os
import resource
import signal
import sys

from shoal.system.programs import end_with_parent


def main() -> None:
    """Import the modules of the command line; end early where the process has grown beyond its limit (MB, the first
    argument): another one goes on with the rest."""
    end_with_parent()
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C ends whoever started it, and so this
    gc.set_threshold(20_000, 20, 20)  # a compiler makes many objects that stay: 4 % less time than at 700, for 20 MB
    from shoal.kernels import decorator as kernels

    parts = 0

    def report(file: str, compiled: bool) -> None:
        nonlocal parts
        parts += 1
        if file:  # a part is compiled with the next kernel that is none
            _say({"kernels": parts, "file": file, "compiled": compiled})
            parts = 0

    kernels.listeners.append(report)
    limit_mb = float(sys.argv[1])
    for module in sys.argv[2:]:
        importlib.import_module(module)
        _say({"kernels": parts, "module": module})
        parts = 0
        if resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024 > limit_mb:
            break


def _say(report: dict[str, object]) -> None:
    try:
        print(json.dumps(report), flush=True)
    except BrokenPipeError:  # whoever started this has been killed: with this process the lock is free
        os._exit(1)


if __name__ == "__main__":
    main()
