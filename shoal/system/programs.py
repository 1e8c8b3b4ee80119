"""SHELL: starts this project's own programs as child processes; nothing else does.

* Nothing is imported from the working folder (`-P`): runs, recordings and other people's files lie there. A child runs the
  code that its parent runs.
* Parent and child exchange UTF-8, whatever the terminal's locale is.
* A child ends with its parent, however that ends. One that reads its input to its end (`stdin=PIPE`) ends with that instead,
  so that it can finish its files.
* A child whose output goes elsewhere is in a process group of its own: Ctrl-C and a hang-up reach its parent alone, which ends
  it when it has done what needs the child.
"""

import ctypes
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import IO

ROOT = Path(__file__).parents[2]
PARENT = "SHOAL_PARENT"  # in a child's environment: the process with which it ends
LOOK_EVERY_S = 0.5  # for the parent, where the system does not tell of its end
_PR_SET_PDEATHSIG = 1


def command(module: str, arguments: Sequence[str] = ()) -> list[str]:
    """The command that runs a module as a program."""
    return [sys.executable, "-P", "-m", module, *arguments]


def environment(more: Mapping[str, str] | None = None) -> dict[str, str]:
    """This process's environment, in which a child finds the code that runs here, with `more`."""
    variables = {**os.environ, **(more or {})}
    if sys.path and Path(sys.path[0]).resolve() == ROOT:  # `python -m` in a work tree; -P would take another one, or none
        variables["PYTHONPATH"] = os.pathsep.join([str(ROOT), *filter(None, [variables.get("PYTHONPATH")])])
    return variables


def start(
    module: str,
    arguments: Sequence[str],
    *,
    stdin: int = subprocess.DEVNULL,
    stdout: int | IO[bytes] | None = None,
    stderr: int | IO[bytes] | None = None,
    more: Mapping[str, str] | None = None,
    inherits: Sequence[int] = (),
) -> "subprocess.Popen[bytes]":
    """Start a program. Without `stdout` or `stderr` it writes where this process does. `more`: of its environment; `inherits`:
    descriptors of open files that it keeps. The thread that starts it lives as long as it does: on Linux the thread's end is
    taken for the parent's."""
    around = environment(more)
    if stdin != subprocess.PIPE:
        around[PARENT] = str(os.getpid())
    if stdout is not None and stderr is not None:
        around["PYTHONIOENCODING"] = "utf-8:replace"
    return subprocess.Popen(
        command(module, arguments),
        stdin=stdin,
        stdout=stdout,
        stderr=stderr,
        env=around,
        process_group=None if stdout is None else 0,
        pass_fds=inherits,
    )


def ask(module: str, arguments: Sequence[str]) -> "subprocess.CompletedProcess[str]":
    """Run a program to its end. Returns its exit code and what it has said."""
    with start(module, arguments, stdout=subprocess.PIPE, stderr=subprocess.PIPE) as child:
        try:
            out, err = child.communicate()
        except BaseException:  # Ctrl-C
            child.kill()
            raise
    return subprocess.CompletedProcess(child.args, child.returncode, _text(out), _text(err))


def _text(output: bytes) -> str:
    return output.decode("utf-8", errors="replace")


def end_with_parent() -> None:
    """Let this process be killed when its parent ends, if that has started it with `start`. A program calls it first."""
    parent = os.environ.pop(PARENT, "")  # not for children that others start
    if not parent.isdecimal():
        return
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
    else:
        threading.Thread(target=_watch, args=(int(parent),), name="parent", daemon=True).start()
    if os.getppid() != int(parent):  # it has ended meanwhile
        os._exit(1)


def _watch(parent: int) -> None:
    while os.getppid() == parent:
        time.sleep(LOOK_EVERY_S)
    os.kill(os.getpid(), signal.SIGKILL)
