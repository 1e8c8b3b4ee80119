"""One thread for the matrices and for OpenCV, so that results do not depend on the machine; the same examples in every run;
and no station that runs here for other reasons is found by a test's terminal.

Where tests run in several processes, run them with `--dist loadfile` as the Makefile does: a file's tests then stay together,
for they share what is dear to make. What is marked `real_time` runs in two processes at most: a
third would starve the others of processor time.
"""

import gc
import os
import re
import tempfile
from collections.abc import Iterator
from pathlib import Path

import pytest
import zenoh
from hypothesis import HealthCheck, settings

from tests import skipped

for library in ("OMP", "OPENBLAS", "MKL"):  # read when numpy is first imported, which is after this; `sil` asks for all three
    os.environ[f"{library}_NUM_THREADS"] = "1"
os.environ["OPENCV_FOR_THREADS_NUM"] = "1"
os.environ["SHOAL_CHECK_KERNELS"] = "1"  # types of arguments, which machine code does not look at

# What collecting the tests makes lives until the end. With the garbage collector at work it takes twice as long.
gc.disable()

# The first call in a process counts: without it, one verbose test would make Zenoh print in all later ones.
zenoh.init_log_from_env_or("error")

_runtime = tempfile.TemporaryDirectory(prefix="shoal-tests-")
os.environ["SHOAL_RUNTIME_DIR"] = _runtime.name

# A test suite that judges by the clock fails on a busy machine; one that draws new examples each time fails on a stranger's.
# A test that states no number gets fifty. HYPOTHESIS_PROFILE=explore looks for two thousand new ones, and keeps the bad ones
# in .hypothesis/.
settings.register_profile(
    "steady", derandomize=True, deadline=None, max_examples=50, suppress_health_check=[HealthCheck.too_slow]
)
settings.register_profile("explore", deadline=None, max_examples=2000, suppress_health_check=[HealthCheck.too_slow])
settings.load_profile(os.environ.get("HYPOTHESIS_PROFILE", "steady"))


def pytest_ignore_collect(collection_path: Path, config: pytest.Config) -> bool | None:
    """Leave out a file all of whose tests have a mark that is not wanted: what it imports would cost more than most tests."""
    if not collection_path.name.startswith("test_"):
        return None
    unwanted = re.findall(r"\bnot (\w+)", config.option.markexpr)
    marks = re.search(r"^pytestmark\b.*", collection_path.read_text(encoding="utf-8"), re.MULTILINE)
    return True if marks and any(re.search(rf"\bmark\.{mark}\b", marks[0]) for mark in unwanted) else None


def pytest_collection_finish() -> None:
    gc.freeze()
    gc.enable()


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter, config: pytest.Config) -> None:
    """Tell what was skipped, why, and the command that brings it; `make test` does so once for its three processes."""
    if hasattr(config, "workerinput"):  # one of xdist's: the process that started it counts for all
        return
    reasons = [str(report.longrepr[2]).removeprefix("Skipped: ") for report in terminalreporter.stats.get("skipped", ())]
    if not skipped.note(reasons):
        for line in skipped.summary(reasons):
            terminalreporter.write_line(line)


@pytest.fixture
def address() -> Iterator[str]:
    """Address of a router on this machine, for one test."""
    from shoal.bus.endpoint import Endpoint
    from shoal.bus.zenoh_transport import ZenohTransport
    from sim_bridge.sil.ports import free_port  # these import numpy: not before its number of threads is set

    where = f"tcp/127.0.0.1:{free_port()}"
    router = ZenohTransport(Endpoint(where, router=True))
    yield where
    router.close()
