"""Thruster boards on benches: processes that tests connect to."""

import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

ROOT = Path(__file__).parents[2]


@contextmanager
def board(port: str, folder: Path, robot: int = 1) -> Iterator[subprocess.Popen[str]]:
    """A board that is plugged in when this begins."""
    command = [
        sys.executable,
        "-m",
        "sim_bridge",
        "board",
        "pool",
        "--port",
        port,
        "--boards",
        str(folder),
        "--robot",
        str(robot),
    ]
    process = subprocess.Popen(command, cwd=ROOT, stderr=subprocess.PIPE, text=True)
    try:
        assert process.stderr is not None
        assert "signed, at" in process.stderr.readline()
        yield process
    finally:
        process.terminate()
        process.communicate(timeout=20)
