"""SHELL: real-time settings of the control loop. A setting that the system refuses is reported, and is not fatal.

Only the calling thread gets the real-time priority: the control loop. Zenoh's network threads, started before, keep the
ordinary one, so a flood of messages cannot displace the loop. The CPU cores are set for all threads of the process.
"""

import ctypes
import gc
import os
import resource
import sys
import threading
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path

from robot_agent.host.config import RealtimeConfig

HIGHEST = 99  # real-time priority of Linux
_MCL_CURRENT, _MCL_FUTURE = 1, 2
_MCL_ONFAULT = 4  # lock pages at first use: unused stacks and pools of threads would take another 250 MB
_GOVERNOR = Path("/sys/devices/system/cpu/cpu0/cpufreq/scaling_governor")


def apply(config: RealtimeConfig) -> list[str]:
    """Apply the settings. Returns the refused ones, with reasons."""
    refused = []
    if sys.platform != "linux":
        return ["real-time options need Linux"] if config != RealtimeConfig() else []
    if config.cores:
        try:
            _pin(config.cores)
        except (OSError, ValueError, OverflowError) as error:
            refused.append(f"cores {list(config.cores)}: {error} (there are {_ranges(os.sched_getaffinity(0))})")
    everything = _MCL_CURRENT | _MCL_FUTURE | _MCL_ONFAULT
    if config.lock_memory and ctypes.CDLL(None, use_errno=True).mlockall(everything) != 0:
        refused.append(f"lock_memory: {os.strerror(ctypes.get_errno())} (LimitMEMLOCK=infinity in the unit, or CAP_IPC_LOCK)")
    if config.priority:
        try:
            os.sched_setscheduler(0, os.SCHED_FIFO | os.SCHED_RESET_ON_FORK, os.sched_param(config.priority))
        except OSError as error:
            refused.append(
                f"priority {config.priority}: {error.strerror} (LimitRTPRIO={config.priority} in the unit, or CAP_SYS_NICE)"
            )
    return refused


def settle() -> None:
    """Exclude all present objects from Python's garbage collection: a full pass takes longer than a control step."""
    gc.collect()
    gc.freeze()


def _pin(cores: Sequence[int]) -> None:
    """Pin every thread of this process to these cores; later threads inherit it. Raises OSError, ValueError."""
    for thread in (int(task.name) for task in Path("/proc/self/task").iterdir()):
        with suppress(ProcessLookupError):  # it has ended since
            os.sched_setaffinity(thread, cores)


def permitted() -> str:
    """Text of this process's real-time permissions. The priority is tried: limits do not tell what a control group or missing
    capabilities refuse."""
    if sys.platform != "linux":
        return "not Linux: no real-time options"
    most = resource.getrlimit(resource.RLIMIT_RTPRIO)[1]
    memory = resource.getrlimit(resource.RLIMIT_MEMLOCK)[1]
    root = os.geteuid() == 0
    highest = HIGHEST if root or most == resource.RLIM_INFINITY else min(most, HIGHEST)
    refusal = _refusal(highest) if highest else ""
    if refusal:
        fifo = f"none ({refusal})"
    elif not highest:
        fifo = "none"
    else:
        fifo = "any" if highest == HIGHEST else f"up to {highest}"
    lock = "all" if root or memory == resource.RLIM_INFINITY else f"{memory // 1024} KiB"
    return f"SCHED_FIFO priority: {fifo}; locked memory: {lock}; cores {_ranges(os.sched_getaffinity(0))}"


def _refusal(priority: int) -> str:
    """The reason why a thread of this process may not have a priority; empty if it may. Tried by one that ends at once."""
    refusals: list[str] = []

    def attempt() -> None:
        try:
            os.sched_setscheduler(0, os.SCHED_FIFO | os.SCHED_RESET_ON_FORK, os.sched_param(priority))
        except OSError as error:
            refusals.append(error.strerror or str(error))

    thread = threading.Thread(target=attempt, name="priority")
    thread.start()
    thread.join()
    return "".join(refusals)


def governor() -> str:
    """Frequency governor of the CPU; empty if unknown."""
    return _GOVERNOR.read_text(encoding="ascii").strip() if _GOVERNOR.is_file() else ""


def _ranges(cores: set[int]) -> str:
    return ",".join(map(str, sorted(cores)))
