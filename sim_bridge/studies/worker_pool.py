"""SHELL: worker processes that fly in parallel, each forked from one process in which everything is loaded already.

A worker takes milliseconds to start, where a fresh interpreter takes seconds to load NumPy, Numba and the kernels.
"""

import multiprocessing
import os
import signal
import threading
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager

LOADED = ("sim_bridge.studies.campaign_flight", "sim_bridge.studies.comparison")  # with all that they import


def one_thread() -> None:
    """Keep numerical libraries on one thread, in this process's children too: results must not depend on their number."""
    for library in ("OMP", "OPENBLAS", "MKL"):
        os.environ[f"{library}_NUM_THREADS"] = "1"


@contextmanager
def worker_pool(workers: int) -> Iterator[ProcessPoolExecutor]:
    """An executor of processes with one thread each, which leave Ctrl-C and a hang-up to this process and end with it, however
    it ends. Like all children they import nothing from the working folder (shoal/system/programs.py)."""
    before = os.environ.get("PYTHONSAFEPATH")
    one_thread()
    os.environ["PYTHONSAFEPATH"] = "1"  # read by the interpreters that multiprocessing starts
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(list(LOADED))
    try:
        with ProcessPoolExecutor(workers, context, initializer=_begin) as pool:
            yield pool
    finally:
        if before is None:  # what this process starts itself says for itself what it imports
            del os.environ["PYTHONSAFEPATH"]


def _begin() -> None:
    for number in (signal.SIGINT, signal.SIGHUP):
        signal.signal(number, signal.SIG_IGN)
    threading.Thread(target=_end_with_parent, name="parent", daemon=True).start()


def _end_with_parent() -> None:
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()  # the fork server is not it: that lives as long as any worker
        os.kill(os.getpid(), signal.SIGKILL)
