"""Commands in processes of their own, forked from one process that has loaded every program.

    code, output, errors = ended("groundstation", "log", "repair", "run.mcap")

    with Programs(failing_disk(tmp_path)) as programs:
        command = programs.run(["groundstation", "log", "repair", "run.mcap"], folder, "kill", 7)

A fresh interpreter takes seconds of computing to load a program, a fork some hundredths; the rest is as when a person starts
it. What is tested about a program's start itself is started as a person does.
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
from functools import cache
from pathlib import Path
from types import TracebackType
from typing import Any

import pytest

from shoal.runtime.runtime import run_app

ROOT = Path(__file__).parents[1]
WITHIN_S = 120  # of one command, on a busy machine
APPS = {
    "groundstation": "groundstation.__main__",
    "localizer": "localizer.__main__",
    "sim-bridge": "sim_bridge.__main__",
    "robot-agent": "robot_agent.__main__",
}
LOADED = (  # what commands load when they begin
    *APPS.values(), "typer.rich_utils", "tests.disks.jobs", "groundstation.client", "groundstation.deploy.key_ring",
    "groundstation.export.foxglove_file", "groundstation.export.tables", "groundstation.logs.repair",
    "groundstation.report.report", "groundstation.report.run_comparison", "groundstation.report.terminal",
    "groundstation.station.discovery", "groundstation.station.process", "shoal.mavlink.parameters",
    "localizer.calibration.verify", "localizer.calibration.workflow", "localizer.evaluation.offline",
    "sim_bridge.in_process.executor", "sim_bridge.in_process.resume", "sim_bridge.in_process.run",
    "sim_bridge.replay.step_replay", "sim_bridge.sil.launcher", "sim_bridge.studies.campaign_runner",
    "sim_bridge.studies.comparison",
)  # fmt: skip


@dataclass(frozen=True)
class EndedCommand:
    """A command that has ended: its exit code (negative: the signal that killed it), what it printed, and the calls of all its
    processes that changed files below the folder, as lines with tabs: call, path, other path."""

    code: int
    output: str
    errors: str
    calls: int = 0
    trace: tuple[str, ...] = ()

    @property
    def last_line(self) -> str:
        lines = self.output.strip().splitlines()
        return lines[-1] if lines else ""


class Programs:
    """The process that commands are forked from."""

    def __init__(self, disk: Path | None = None) -> None:
        """`disk`: library of `failing_disk`, None for commands on the disk as it is."""
        self._has_disk = disk is not None
        self._process = subprocess.Popen(
            [sys.executable, "-m", "tests.forked"],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            cwd=ROOT,
            env=os.environ | ({"LD_PRELOAD": str(disk)} if disk is not None else {}),
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
        """Run a command in a folder; on a disk that can fail, it fails below the folder from the given call on, and the output
        holds the errors too."""
        assert self._process.stdin is not None and self._process.stdout is not None
        with tempfile.TemporaryDirectory() as beside:
            output, trace = Path(beside) / "output", Path(beside) / "trace"
            errors = output if self._has_disk else Path(beside) / "errors"
            trace.write_bytes(bytes(8))
            around = {} if self._has_disk else dict(os.environ)
            if self._has_disk:
                around |= {"DISK_FOLDER": str(folder.resolve()), "DISK_FAULT": fault}
                around |= {"DISK_CALL": str(call), "DISK_TRACE": str(trace)}
            streams = {"stdin": stdin, "stdout": str(output), "stderr": str(errors)}
            job = {"arguments": arguments, "folder": str(folder), "around": around, "streams": streams}
            self._process.stdin.write(json.dumps(job) + "\n")
            self._process.stdin.flush()
            code = int(self._process.stdout.readline())
            count, lines = trace.read_bytes()[:8], trace.read_bytes()[8:]
            return EndedCommand(
                code,
                output.read_text(errors="replace"),
                errors.read_text(errors="replace"),
                int.from_bytes(count, sys.byteorder),
                tuple(lines.decode().splitlines()),
            )


def failing_disk(folder: Path) -> Path:
    """Compile the disk that fails, into a folder. Skips the test where there is no compiler, or no Linux."""
    if sys.platform != "linux" or shutil.which("gcc") is None:
        pytest.skip("gcc is not installed" if sys.platform == "linux" else "only on Linux a disk can be made to fail")
    library = folder / "failing_disk.so"
    source = Path(__file__).parent / "disks" / "failing_disk.c"
    subprocess.run(["gcc", "-shared", "-fPIC", "-O1", "-o", str(library), str(source), "-ldl"], check=True)
    return library


@cache
def _programs() -> Programs:
    """Those of this process, without a disk that fails: they end with it."""
    return Programs()


def ended(*arguments: str, folder: Path | None = None) -> tuple[int, str, str]:
    """Run a command, in this folder if no other is named. Returns exit code, output and errors."""
    command = _programs().run(list(arguments), folder or Path.cwd())
    return command.code, command.output, command.errors


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
    streams = job["streams"]
    os.dup2(os.open(streams["stdin"], os.O_RDONLY), 0)
    for descriptor, name in ((1, "stdout"), (2, "stderr")):
        os.dup2(os.open(streams[name], os.O_WRONLY | os.O_CREAT | os.O_APPEND), descriptor)
    os.chdir(job["folder"])
    os.environ.update(job["around"])
    if "DISK_FOLDER" in job["around"]:
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
