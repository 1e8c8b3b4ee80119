"""SHELL: worker processes that fly in parallel, each forked from one process in which everything is loaded already.

A worker takes milliseconds to start, where a fresh interpreter takes seconds to load NumPy, Numba and the kernels.
"""

import multiprocessing
import os
import signal
from concurrent.futures import ProcessPoolExecutor

LOADED = ("sim_bridge.studies.campaign_flight", "sim_bridge.studies.comparison")  # with all that they import


def one_thread() -> None:
    """Keep numerical libraries on one thread, in this process's children too: results must not depend on their number."""
    for library in ("OMP", "OPENBLAS", "MKL"):
        os.environ[f"{library}_NUM_THREADS"] = "1"


def worker_pool(workers: int) -> ProcessPoolExecutor:
    """An executor of processes with one thread each, which leave Ctrl-C to this process."""
    one_thread()
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(list(LOADED))
    return ProcessPoolExecutor(workers, context, initializer=_ignore_interrupts)


def _ignore_interrupts() -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)
