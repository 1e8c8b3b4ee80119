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
    """Import the modules of the command line, and so compile their kernels. Ends early when the process has grown beyond its
    limit (MB, the first argument): another one goes on with the rest."""
    end_with_parent()
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C ends whoever started it, and so this
    gc.set_threshold(20_000, 20, 20)  # a compiler makes many objects that stay: 4 % less time than at 700, for 20 MB
    from shoal.kernels import decorator as kernels

    kernel_count = 0  # since the last report

    def report(file: str, compiled: bool) -> None:
        """Report a kernel with its file of machine code. A `part` has no file: it is counted with the next kernel that has
        one."""
        nonlocal kernel_count
        kernel_count += 1
        if file:
            _print_report({"kernels": kernel_count, "file": file, "compiled": compiled})
            kernel_count = 0

    kernels.listeners.append(report)
    limit_mb = float(sys.argv[1])
    for module in sys.argv[2:]:
        importlib.import_module(module)
        _print_report({"kernels": kernel_count, "module": module})
        kernel_count = 0
        if resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024 > limit_mb:
            break


def _print_report(report: dict[str, object]) -> None:
    """Print a line of JSON, which the process that started this one reads."""
    try:
        print(json.dumps(report), flush=True)
    except BrokenPipeError:  # whoever started this has been killed: with this process the lock is free
        os._exit(1)


if __name__ == "__main__":
    main()
