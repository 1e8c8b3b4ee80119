"""Commands as processes on a disk that fails at the n-th call: forked from one process that has loaded every program.

    with Programs(tmp_path) as programs:
        ended = programs.run(["groundstation", "log", "repair", "run.mcap"], folder, "kill", 7)

A fresh interpreter takes seconds to load a program, a fork some hundredths; the rest is as when a person starts it.
"""

import atexit
import ctypes
import gc
import importlib
import json
import os
import shutil
import subprocess
import sys
import tempfile
import threading
import traceback
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any

import pytest

from shoal.runtime.runtime import run_app

ROOT = Path(__file__).parents[2]
WITHIN_S = 120  # of one command, on a busy machine
APPS = {
    "groundstation": "groundstation.__main__",
    "localizer": "localizer.__main__",
    "sim-bridge": "sim_bridge.__main__",
    "robot-agent": "robot_agent.__main__",
}
LOADED = (  # what commands load when they begin
    *APPS.values(), "tests.disks.jobs", "groundstation.deploy.key_ring", "groundstation.export.foxglove_file",
    "groundstation.export.tables", "groundstation.logs.repair", "groundstation.report.report", "localizer.calibration.verify",
    "localizer.calibration.workflow", "localizer.evaluation.offline", "sim_bridge.studies.campaign_runner",
)  # fmt: skip


@dataclass(frozen=True)
class EndedCommand:
    """A command that has ended: its exit code (negative: the signal that killed it), what it said, and the calls that changed
    files below the folder, of all its processes, as lines with tabs: call, path, other path."""

    code: int
    output: str
    calls: int
    trace: tuple[str, ...] = ()

    @property
    def last_line(self) -> str:
        lines = self.output.strip().splitlines()
        return lines[-1] if lines else ""


class Programs:
    """The process that commands are forked from."""

    def __init__(self, folder: Path) -> None:
        """`folder` is for the compiled disk. Skips the test where there is no compiler, or no Linux."""
        if sys.platform != "linux" or shutil.which("gcc") is None:
            pytest.skip("gcc is not installed" if sys.platform == "linux" else "only on Linux a disk can be made to fail")
        disk = folder / "failing_disk.so"
        source = Path(__file__).with_name("failing_disk.c")
        subprocess.run(["gcc", "-shared", "-fPIC", "-O1", "-o", str(disk), str(source), "-ldl"], check=True)
        self._process = subprocess.Popen(
            [sys.executable, "-m", "tests.disks.forked"],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            cwd=ROOT,
            env=os.environ | {"LD_PRELOAD": str(disk)},
        )

    def __enter__(self) -> "Programs":
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        assert self._process.stdin is not None
        self._process.stdin.close()
        self._process.wait(WITHIN_S)

    def run(
        self, arguments: list[str], folder: Path, fault: str = "count", call: int = 1, stdin: str = os.devnull
    ) -> EndedCommand:
        """Run a command in a folder, on a disk that fails below it from the given call on."""
        assert self._process.stdin is not None and self._process.stdout is not None
        with tempfile.TemporaryDirectory() as beside:
            output, trace = Path(beside) / "output", Path(beside) / "trace"
            trace.write_bytes(bytes(8))
            around = {
                "DISK_FOLDER": str(folder.resolve()),
                "DISK_FAULT": fault,
                "DISK_CALL": str(call),
                "DISK_TRACE": str(trace),
            }
            job = {"arguments": arguments, "folder": str(folder), "around": around, "output": str(output), "stdin": stdin}
            self._process.stdin.write(json.dumps(job) + "\n")
            self._process.stdin.flush()
            code = int(self._process.stdout.readline())
            count, lines = trace.read_bytes()[:8], trace.read_bytes()[8:]
            return EndedCommand(
                code,
                output.read_text(errors="replace"),
                int.from_bytes(count, sys.byteorder),
                tuple(lines.decode().splitlines()),
            )


def _serve() -> dict[str, Any] | None:
    """Fork for each job of the input. Returns the job in each child; None at the input's end."""
    for line in sys.stdin:
        child = os.fork()
        if not child:
            return dict(json.loads(line))
        _, status = os.waitpid(child, 0)
        print(os.waitstatus_to_exitcode(status), flush=True)
    return None


def _do(job: dict[str, Any]) -> None:
    """Be the command."""
    os.setsid()
    output = os.open(job["output"], os.O_WRONLY | os.O_CREAT)
    os.dup2(os.open(job["stdin"], os.O_RDONLY), 0)
    for descriptor in (1, 2):
        os.dup2(output, descriptor)
    os.chdir(job["folder"])
    os.environ.update(job["around"])
    ctypes.CDLL(None).failing_disk_arm()
    program, *arguments = job["arguments"]
    sys.argv = [program, *arguments]
    module, _, function = program.partition(":")
    code = 0
    try:
        if function:
            run_app(lambda: getattr(importlib.import_module(module), function)(*arguments))
        else:
            importlib.import_module(APPS[program]).app()
    except SystemExit as end:
        code = int(end.code or 0)
    except BaseException:
        traceback.print_exc()
        code = 1
    # As the interpreter ends, without taking everything apart that the other process has loaded: only private names do that.
    threading._shutdown()  # type: ignore[attr-defined]
    atexit._run_exitfuncs()  # likewise private
    for stream in (sys.stdout, sys.stderr):
        stream.flush()
    os._exit(code)


if __name__ == "__main__":
    for _module in LOADED:
        importlib.import_module(_module)
    gc.freeze()  # a child that collects would copy all pages
    _job = _serve()
    if _job is not None:
        _do(_job)
