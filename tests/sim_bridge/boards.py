"""Thruster boards on benches: processes that tests connect to."""

import subprocess
import sys
from collections.abc import Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path

ROOT = Path(__file__).parents[2]


def board(port: str, folder: Path, robot: int = 1) -> AbstractContextManager["subprocess.Popen[str]"]:
    """A simulated board that is plugged in when this begins."""
    command = ["sim_bridge", "board", "pool", "--port", port, "--boards", str(folder), "--robot", str(robot)]
    return plugged(command, "signed, at")


@contextmanager
def plugged(command: Sequence[str], says: str) -> Iterator["subprocess.Popen[str]"]:
    """A board's program, `python -m` and these words, from when its first line has been read, which `says` this."""
    words = [sys.executable, "-m", *command]
    process = subprocess.Popen(words, cwd=ROOT, stderr=subprocess.PIPE, text=True, errors="replace")
    try:
        assert process.stderr is not None
        assert says in process.stderr.readline()
        yield process
    finally:
        process.terminate()
        print(process.communicate(timeout=20)[1])
