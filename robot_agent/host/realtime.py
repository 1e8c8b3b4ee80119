"""SHELL: what is asked of the operating system so that the loop runs when it must; what it does not allow is said, not fatal.

Only the calling thread gets the real-time priority: that is the control loop. Zenoh's network threads, begun before, stay as
they were, so a flood of messages cannot push the loop aside. The cores are for all threads of the process, Zenoh's too.
"""

import ctypes
import gc
import os
import resource
import sys
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path

from robot_agent.host.config import RealtimeConfig

_MCL_CURRENT, _MCL_FUTURE = 1, 2
_MCL_ONFAULT = 4  # what is used, once it is used: threads' stacks and pools that nobody fills would take another 250 MB
_GOVERNOR = Path("/sys/devices/system/cpu/cpu0/cpufreq/scaling_governor")


def apply(wanted: RealtimeConfig) -> list[str]:
    """Do what is wanted. Returns what could not be done, and why."""
    refused = []
    if sys.platform != "linux":
        return ["real-time options need Linux"] if wanted != RealtimeConfig() else []
    if wanted.cores:
        try:
            _pin(wanted.cores)
        except (OSError, ValueError) as error:
            refused.append(f"cores {list(wanted.cores)}: {error} (there are {_ranges(os.sched_getaffinity(0))})")
    everything = _MCL_CURRENT | _MCL_FUTURE | _MCL_ONFAULT
    if wanted.lock_memory and ctypes.CDLL(None, use_errno=True).mlockall(everything) != 0:
        refused.append(f"lock_memory: {os.strerror(ctypes.get_errno())} (LimitMEMLOCK=infinity in the unit, or CAP_IPC_LOCK)")
    if wanted.priority:
        try:
            os.sched_setscheduler(0, os.SCHED_FIFO | os.SCHED_RESET_ON_FORK, os.sched_param(wanted.priority))
        except OSError as error:
            refused.append(
                f"priority {wanted.priority}: {error.strerror} (LimitRTPRIO={wanted.priority} in the unit, or CAP_SYS_NICE)"
            )
    return refused


def settle() -> None:
    """Keep Python's collector off what there is by now: going through all of it takes longer than a control step lasts."""
    gc.collect()
    gc.freeze()


def _pin(cores: Sequence[int]) -> None:
    """Every thread of this process onto these cores; those that begin later inherit it. Raises OSError, ValueError."""
    for thread in (int(task.name) for task in Path("/proc/self/task").iterdir()):
        with suppress(ProcessLookupError):  # it has ended since
            os.sched_setaffinity(thread, cores)


def permitted() -> str:
    """What this process may ask for, for people."""
    if sys.platform != "linux":
        return "not Linux: no real-time options"
    most = resource.getrlimit(resource.RLIMIT_RTPRIO)[1]
    memory = resource.getrlimit(resource.RLIMIT_MEMLOCK)[1]
    root = os.geteuid() == 0
    fifo = "any" if root else "none" if most == 0 else f"up to {most}"
    lock = "all" if root or memory == resource.RLIM_INFINITY else f"{memory // 1024} KiB"
    return f"SCHED_FIFO priority: {fifo}; locked memory: {lock}; cores {_ranges(os.sched_getaffinity(0))}"


def governor() -> str:
    """The CPU's frequency governor; empty where there is none to see."""
    return _GOVERNOR.read_text(encoding="ascii").strip() if _GOVERNOR.is_file() else ""


def _ranges(cores: set[int]) -> str:
    return ",".join(map(str, sorted(cores)))
